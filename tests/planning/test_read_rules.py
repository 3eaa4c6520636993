"""Rules from YAML and JSON: each error names the place, the limit and the cure."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from app.errors import InvalidParameter, UnreadableUpload, WaymarkError
from app.planning.rules import MAX_RULES_BYTES, read_rules, rules_schema

DOCS = Path(__file__).resolve().parents[2] / "docs/plans"
EXAMPLES = sorted(DOCS.glob("rules-*.yaml"))
BASE = "version: 1\nplates: {}\n"


def test_the_published_schema_is_the_generated_one() -> None:
    schema = json.loads((DOCS / "rules.schema.json").read_text("utf-8"))
    assert schema == rules_schema()
    assert schema["$schema"].endswith("2020-12/schema")
    assert schema["$id"].startswith("https://")
    assert schema["additionalProperties"] is False


def test_there_are_four_examples_and_they_are_read() -> None:
    assert len(EXAMPLES) == 4
    rules = {path.stem: read_rules(path.read_bytes()) for path in EXAMPLES}
    assert rules["rules-rural-plates"].plates is not None
    assert rules["rules-city-magnets"].tags is not None
    assert rules["rules-city-magnets"].lines is not None
    cerpms = rules["rules-work-zone-cerpms"]
    assert cerpms.cerpm is not None
    assert cerpms.cerpm.n_m == 12.192
    assert cerpms.temporary is not None
    assert cerpms.temporary.from_.isoformat() == "2026-04-01"


def test_of_very_many_faults_the_first_are_named() -> None:
    """Each was once looked up in a schema that was made again: minutes for this document."""
    with pytest.raises(InvalidParameter) as caught:
        read_rules(json.dumps({"version": 1, **{f"rule{k}": 1 for k in range(990)}}).encode())
    assert [part.field for part in caught.value.parts] == [f"rule{k}" for k in range(100)]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_yaml_and_json_give_the_same_rules(path: Path) -> None:
    rules = read_rules(path.read_bytes())
    assert read_rules(rules.model_dump_json(by_alias=True).encode()) == rules


def test_yaml_is_version_1_2() -> None:
    text = 'version: 1\nname: no\nplates: {spacing_m: 1e2}\nlines: {solid: N}\ncosts: {currency: "NOK"}\n'
    rules = read_rules(text.encode())
    assert rules.name == "no"
    assert rules.plates is not None
    assert rules.plates.spacing_m == 100.0


@pytest.mark.parametrize(
    ("text", "field", "cure"),
    [
        ("", "rules", "docs/plans"),
        ("- 1", "rules", "docs/plans"),
        ("plates: {}", "version", "add it"),
        ("version: 2\nplates: {}", "version", "correct"),
        ("version: 1", "rules", "correct"),
        (f"{BASE}plats: {{}}", "plats", "write 'plates'"),
        ("version: 1\nplates: {spacing: 100}", "plates.spacing", "write 'spacing_m'"),
        ("version: 1\nplates: {spacing_m: .nan}", "plates.spacing_m", "correct"),
        ("version: 1\nplates: {spacing_m: .inf}", "plates.spacing_m", "correct"),
        ("version: 1\nplates: {spacing_m: 12:30}", "plates.spacing_m", "correct"),
        ('{"version": 1, "plates": {"spacing_m": NaN}}', "plates.spacing_m", "correct"),
        ("version: 1\nplates: {n: 9}", "plates.n", "correct"),
        ("version: 1\nplates: {n: 12, unit_mm: 50}", "plates.side_mm", "choose"),
        (f"{BASE}tags: {{at: [stop]}}", "tags.at[0]", "correct"),
        (f"{BASE}tags: {{before: soon}}", "tags.before", "correct"),
        (f"{BASE}tags: {{before: -5}}", "tags.before", "choose"),
        (f"{BASE}tags: {{segment_m: 0.3}}", "tags.length_m", "choose"),
        (f"{BASE}tags: {{clearance_class: tank}}", "tags.clearance_class", "choose"),
        (f"{BASE}lines: {{solid: null, dashed: null}}", "lines.solid", "leave lines out"),
        (f"{BASE}cerpm: {{marking_rules: atlantis}}", "cerpm.marking_rules", "choose"),
        (f"{BASE}cerpm: {{straight: 1, curve: 2}}", "cerpm.curve", "swap"),
        (f"{BASE}cerpm: {{spreading_factor: 12, interval_s: 0.05}}", "cerpm.interval_s", "send less often"),
        (f"{BASE}costs: {{items: [{{item: a, per: day, price: 1}}]}}", "costs.markers_per_day", "crew"),
        (f"{BASE}costs: {{items: [{{item: a, per: moon, price: 1}}]}}", "costs.items[0].per", "correct"),
        (f"{BASE}quality: {{budget: 1000}}", "costs.items", "unit costs"),
        (f"{BASE}applies: {{speed_kmh: [100, 50]}}", "applies", "correct"),
        (f"{BASE}temporary: {{from: 2026-05-01, to: 2026-04-01}}", "temporary", "correct"),
        (f"{BASE}cameras: [{{name: a}}, {{name: a}}]\n", "rules", "correct"),
        (f"{BASE}temporary: {{from: 2026-13-01, to: 2026-14-01}}", "temporary.from", "correct"),
        (f"{BASE}costs: {{currency: 0x{'f' * 4000}}}", "costs.currency", "correct"),
        (f"version: 0x{'f' * 4000}", "version", "correct"),
        ('{"version": 1, "plates": {"spacing_m": 1e400}}', "plates.spacing_m", "correct"),
        (f'{BASE}name: "\\ud800"', "name", "correct"),
        (f'{BASE}name: "\\0"', "name", "correct"),
    ],
)
def test_a_value_that_is_not_allowed_is_named(text: str, field: str, cure: str) -> None:
    with pytest.raises(InvalidParameter) as raised:
        read_rules(text.encode())
    assert raised.value.field == field
    assert raised.value.limit
    assert cure in str(raised.value.cure)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        (f"{BASE}plates: {{}}", "line 3"),
        ('{"version": 1, "plates": {}, "plates": {}}', "'plates' appears twice"),
        (f"{BASE}costs: [", "line 3"),
        ('{"version": 1,, }', "line 1, column 15"),
        ("a: &x [1]\nb: *x", "alias"),
        ("---\na: 1\n---\nb: 1", "another document"),
        ("[" * 150_000, "at most 20 levels: line 1, column 21"),
        ("- " * 90_000, "at most 20 levels"),
        ("version: !!python/object:os.system 1", "tag"),
        ("a: \x00", "YAML"),
        (f"{BASE}1: 2", "a key is no text"),
        ("? [1, {a: 1}]\n: x", "unhashable"),
        (f"version: {'9' * 4301}", "4300 digits"),
        ('{"version": ' + "9" * 4301 + "}", "beyond 64 bits"),
        ("[" + "a," * 20_000 + "]", "10000 tokens"),
        (" " * (MAX_RULES_BYTES + 1), "bytes"),
    ],
)
def test_text_that_cannot_be_read_is_refused_with_its_place(text: str, part: str) -> None:
    with pytest.raises(UnreadableUpload, match=part) as raised:
        read_rules(text.encode())
    assert raised.value.cure


def test_text_in_another_encoding_is_refused() -> None:
    with pytest.raises(UnreadableUpload, match="UTF-8"):
        read_rules("name: Stra\u00dfe".encode("latin-1"))


def test_all_faults_are_listed() -> None:
    with pytest.raises(WaymarkError) as raised:
        read_rules(b"version: 1\nplates: {n: 9, spacing_m: 1, unit: 3}")
    assert [part.field for part in raised.value.parts] == ["plates.n", "plates.spacing_m", "plates.unit"]
    assert raised.value.parts[1].limit == "5 to 5000"
