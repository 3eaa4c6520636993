"""What the documents say is what the code does."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import tomllib
from pathlib import Path

import pytest
from typer.main import get_command

from app.cli import cli
from app.markers.plate import PlateGeometry
from app.settings import Settings
from benchmarks.readme import DEMO, fill_excerpt, find_demo

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
_HEADING = re.compile(r"^(#{2,4}) (.+)$", re.MULTILINE)
_FIGURE = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?![\w.]*\d)")


def test_every_setting_is_documented_with_its_default() -> None:
    rows = re.findall(
        r"^\| `WAYMARK_(\w+)` \| (?:`(.*?)`)? ?\| (.+) \|$", (ROOT / "docs/settings.md").read_text(), re.M
    )
    documented = {name.lower(): (default, text) for name, default, text in rows}
    declared = {
        name: ("" if field.default in (None, "") else str(field.default), field.description)
        for name, field in Settings.model_fields.items()
    }
    assert documented == declared


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_documented_commands_targets_settings_and_files_exist(document: Path) -> None:
    text = document.read_text()
    commands = set(getattr(get_command(cli), "commands", {}))
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.M))
    settings = {f"WAYMARK_{name.upper()}" for name in Settings.model_fields}
    settings |= set(re.findall(r"WAYMARK_BENCH_[A-Z_]+[A-Z]", (ROOT / "benchmarks/service/__main__.py").read_text()))
    assert set(re.findall(r"`waymark ([a-z]+(?:-[a-z]+)*)", text)) <= commands
    assert set(re.findall(r"(?:`|^ +)make ([a-z]+)", text, re.M)) <= targets
    assert set(re.findall(r"WAYMARK_[A-Z_]+[A-Z]", text)) <= settings
    for path in re.findall(r"`((?:app|docs|tests|migrations|benchmarks|docker)/[\w./-]*)`", text):
        assert "NAME" in path or (ROOT / path).exists(), path


def test_links_lead_somewhere() -> None:
    for document in DOCUMENTS:
        for target in re.findall(r"\]\((?!https?://|#|mailto:)([^)#]+)", document.read_text()):
            assert (document.parent / target).exists(), f"{document.name}: {target}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_documented_python_imports_what_exists_and_calls_it_as_declared(document: Path) -> None:
    for example in re.findall(r"^```python\n(.*?)^```", document.read_text(), re.M | re.S):
        names: dict[str, object] = {}
        tree = ast.parse(example)
        imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
        for line in (node for node in imports if (node.module or "").split(".")[0] == "app"):
            for alias in line.names:
                names[alias.name] = getattr(importlib.import_module(line.module or ""), alias.name)
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            if isinstance(call.func, ast.Name) and call.func.id in names:
                declared = inspect.signature(names[call.func.id]).parameters  # type: ignore[arg-type]
                assert {keyword.arg for keyword in call.keywords} <= set(declared), call.func.id


def test_the_architecture_page_has_every_folder_the_layers_and_only_paths_that_exist() -> None:
    text = (ROOT / "docs/architecture.md").read_text()
    listed = set(re.findall(r"`app/(\w+)/`", text.split("## Direction of imports")[0]))
    assert listed == {path.parent.name for path in (ROOT / "app").glob("*/__init__.py")}
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    assert text.split("```text\n")[1].split("\n```")[0].splitlines() == contracts[0]["layers"]
    for path in re.findall(r"\b(?:app|docs|tests|migrations|benchmarks|docker|static)/[\w./-]*[\w/]", text):
        assert (ROOT / path).exists(), path


def test_the_readme_is_short_and_shows_lines_of_the_demo() -> None:
    readme = (ROOT / "README.md").read_text()
    assert len(readme.splitlines()) <= 300, "tables and details belong into docs/"
    assert fill_excerpt(readme, find_demo(DEMO.read_text())) == readme


def test_the_figures_of_the_readme_are_those_of_the_benchmarks() -> None:
    text = (ROOT / "docs/benchmarks.md").read_text()
    headings = [
        (m.start(), m[1], re.sub(r"[^\w -]", "", m[2]).lower().replace(" ", "-")) for m in _HEADING.finditer(text)
    ]
    sections = {}
    for start, level, anchor in headings:
        end = next((at for at, other, _ in headings if at > start and len(other) <= len(level)), len(text))
        sections[anchor] = set(_FIGURE.findall(text[start:end]))
    table = (ROOT / "README.md").read_text().split("## How good it is")[1].split("\n## ")[0]
    rows = [line.split(" | ") for line in table.splitlines() if "docs/benchmarks.md#" in line and line.startswith("|")]
    assert 8 <= len(rows) <= 12
    for what, *cells in rows:
        (anchor,) = re.findall(r"docs/benchmarks\.md#([\w-]+)", what)
        for figure in _FIGURE.findall(" ".join(cells)):
            assert figure in sections[anchor], f"{figure} is not in docs/benchmarks.md#{anchor}: {what}"


def test_smaller_units_need_as_many_more_rows_as_documented() -> None:
    coarse, fine = PlateGeometry(n=8, unit_mm=35.0), PlateGeometry(n=10, unit_mm=27.0)
    assert coarse.side_mm == fine.side_mm
    stated = re.search(
        r"plates of the same width need (\d+) % more rows in the frame for units of 27 mm",
        (ROOT / "docs/artwork.md").read_text(),
    )
    assert stated is not None
    assert int(stated[1]) == round(100 * (coarse.unit_mm / fine.unit_mm - 1))
