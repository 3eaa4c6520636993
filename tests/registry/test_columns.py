"""Rows written by column are byte by byte what they would be one by one."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import orjson
import pytest

from app.markers.reading import MarkerRow
from app.registry.audit import AuditEntry, version_sha256
from app.registry.bulk_load import Columns, JsonTexts, json_objects
from app.registry.column_types import new_ids, row_of
from app.registry.features import feature_text, feature_texts

NOW = datetime(2026, 3, 4, 5, 6, 7, 890123, tzinfo=UTC)
AWKWARD = ("", "plain", "a, b", '"%s" 100 %', "back\\slash\n", "Straße 日本", "null", "\x7f\u2028")


def _rows(count: int) -> list[dict[str, Any]]:
    return [
        {
            "name": AWKWARD[k % len(AWKWARD)], "%d of 100 %": "50 %", "height_m": None if k % 3 else -0.1 * k,
            "lon_deg": 8.000000001 + k / 7, "is_new": (None, True, False)[k % 3], "at": NOW, "none": None,
            "zero": (0, False, 0.0)[k % 3], "nested": {"b": [k, "x,y"], "a": {"z": None, "y": 1e-300}},
        }
        for k in range(count)
    ]  # fmt: skip


def _columns(rows: list[dict[str, Any]]) -> Columns:
    return Columns.of(len(rows), {}, {name: [row[name] for row in rows] for name in rows[0]})


def _dumped(value: Any) -> str:
    return orjson.dumps(value, option=orjson.OPT_SORT_KEYS).decode()


@pytest.mark.parametrize("count", [1, 2, 40])
def test_objects_are_those_that_orjson_writes(count: int) -> None:
    rows = _rows(count)
    columns = _columns(rows)
    assert json_objects(columns) == list(map(_dumped, rows))
    assert columns.rows() == rows
    for row, wanted in zip(columns.rows(), rows, strict=True):
        assert {name: type(value) for name, value in row.items()} == {name: type(v) for name, v in wanted.items()}


def test_members_may_have_an_order_of_their_own() -> None:
    names = ("b", "a", "c")
    columns = Columns.of(2, {"a": 1}, {"b": [1, 2], "c": ["x", "x"]})
    assert json_objects(columns, names=names) == ['{"b":1,"a":1,"c":"x"}', '{"b":2,"a":1,"c":"x"}']


@pytest.mark.parametrize("count", [1, 7])
def test_features_by_column_are_those_by_row(count: int) -> None:
    rows = [
        {
            **dict.fromkeys(MarkerRow._fields), "id": str(k), "family": ("cerpm", "plate")[k % 5 % 2],
            "spec": None if k % 3 == 1 else {"side": ("left", "right")[k % 2]}, "lon_deg": 8.0 + k / 7,
            "lat_deg": -1e-7, "height_m": None if k % 3 else 0.1, "road": AWKWARD[k], "updated_at": NOW, "version": 1,
        }
        for k in range(count)
    ]  # fmt: skip
    assert feature_texts(_columns(rows)) == [feature_text(row_of(MarkerRow, row)) for row in rows]


def test_what_is_json_already_goes_in_as_it_is() -> None:
    inner = JsonTexts(['{"b":1.0}', '{"b":1.0}', "null"])
    columns = Columns(3, {"a": 1}, {"inner": inner})
    assert json_objects(columns) == ['{"a":1,"inner":{"b":1.0}}'] * 2 + ['{"a":1,"inner":null}']
    assert columns.rows()[0] == {"a": 1, "inner": {"b": 1.0}}


def test_optional_members_are_left_out_where_there_is_no_value() -> None:
    rows = _rows(12)
    columns = _columns(rows)
    for optional in (("height_m",), ("at", "height_m", "is_new"), ("name",)):
        wanted = [{name: v for name, v in row.items() if v is not None or name not in optional} for row in rows]
        own = {name: columns.values(name) for name in rows[0]}
        assert json_objects(Columns(12, {}, own), optional=optional) == list(map(_dumped, wanted))


def test_other_values_may_be_one_value() -> None:
    columns = _columns(_rows(4)).but(name=["same"] * 4, none=[1, 2, 3, 4])
    assert columns.same["name"] == "same"
    assert columns.own["none"] == [1, 2, 3, 4]
    assert columns.values("name") == ["same"] * 4


def test_first_versions_have_the_hashes_of_single_ones() -> None:
    why = 'import "of" 100 %'
    ids = new_ids(NOW, 5)
    rows = [{**row, "id": marker_id} for row, marker_id in zip(_rows(5), ids, strict=True)]
    kinds = ["as-built", "as-planned", "as-built", "as-built", "as-planned"]
    entry, single = (AuditEntry("agency", 3, NOW, "Jürgen, surveyor") for _ in range(2))
    texts = json_objects(_columns(rows))
    made = [
        *entry.first_versions(ids[:2], JsonTexts(texts[:2]), kinds=kinds[:2], why=why).rows(),
        *entry.first_versions(ids[2:], JsonTexts(texts[2:]), kinds=kinds[2:], why=why).rows(),
    ]
    for row, kind, version in zip(rows, kinds, made, strict=True):
        alone = single.version(row["id"], 1, row, kind=kind, why=why)
        assert {**version, "marker": None} == {**alone, "marker": None}
        assert version["marker"] == orjson.loads(_dumped(row))
        said = ("agency", row["id"], 1, NOW, "Jürgen, surveyor", why, kind)
        assert version["sha256"] == version_sha256(*said, version["marker"])
    assert (entry.versions, entry.digest) == (single.versions, single.digest) == (5, entry.digest)


def test_versions_of_an_entry_rise_by_their_ids() -> None:
    entry, ids = AuditEntry("agency", 1, NOW, "me"), new_ids(NOW, 3)
    for wrong in (ids[::-1], [ids[0], ids[0]]):
        with pytest.raises(ValueError, match="in the order"):
            entry.first_versions(wrong, JsonTexts(["{}"] * len(wrong)), kinds=["as-built"] * len(wrong), why=None)
    entry.first_versions(ids[1:], JsonTexts(["{}"] * 2), kinds=["as-built"] * 2, why=None)
    with pytest.raises(ValueError, match="in the order"):
        entry.first_versions(ids[:1], JsonTexts(["{}"]), kinds=["as-built"], why=None)
