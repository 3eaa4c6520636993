"""From documents to sources of the site: the navigation, moved links, inline scripts and styles."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from guide.inline import move_inline
from guide.markdown import cell, code
from guide.schema_text import meaning_text, type_text
from guide.sources import GENERATED_MARK, with_navigation

ROOT = Path(__file__).resolve().parents[2]


def test_every_document_is_in_the_index_once() -> None:
    index = (ROOT / "docs/index.md").read_text()
    listed = re.findall(r"^- \[[^\]]+\]\(([^)#]+)\)", index, re.MULTILINE)
    documents = {str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")}
    documents -= {"index.md", *(name for name in documents if name.startswith("decisions/"))}
    assert len(listed) == len(set(listed))
    assert documents - set(listed) == set(), "not in docs/index.md, which is the guide's navigation"
    assert GENERATED_MARK in index


def test_every_decision_record_is_in_their_index_once_in_order_with_its_topics() -> None:
    folder = ROOT / "docs/decisions"
    listed = re.findall(r"^- \[(\d{4}): [^\]]+\]\(([^)#]+)\): \S", (folder / "README.md").read_text(), re.MULTILINE)
    records = sorted(path.name for path in folder.glob("*.md") if path.name != "README.md")
    assert [name for _, name in listed] == records
    assert [number for number, _ in listed] == [f"{k:04d}" for k in range(1, len(records) + 1)]
    for number, name in listed:
        text = (folder / name).read_text()
        assert name.startswith(f"{number}-")
        assert text.startswith(f"# {number}: ")
        assert re.findall(r"^## (.+)", text, re.MULTILINE) in (
            ["Context", "Decision", "Rejected", "Measured"],
            ["Context", "Decision", "Rejected", "Measured", "Limits"],
        ), name
        assert len(text.splitlines()) <= 150, name
        assert max(map(len, text.splitlines())) <= 120, name


def test_each_group_of_the_index_becomes_a_menu() -> None:
    index = "# Top\n\nText\n\n## One\n\n- [A page](a.md): text\n- [B](x/b.md): text\n\n## Two\n\nno pages\n"
    text = with_navigation(index)
    assert "```{toctree}\n:hidden:\n:caption: One\n\nA page <a>\nB <x/b>\n```\n" in text
    assert text.count("toctree") == 1
    assert text.startswith("# Top\n\nText\n\n## One\n\n- [A page](a.md): text\n")


def test_inline_scripts_and_styles_become_files_and_classes(tmp_path: Path) -> None:
    (tmp_path / "_static").mkdir()
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "page.html").write_text(
        "<html><head><style>body { color: red }</style></head><body><script>alert('run')</script>"
        '<script type="application/json">{"a": 1}</script><script src="x.js"></script>'
        '<p class="old" style="opacity: 50%;">text</p><svg style="display: none"></svg>'
        '&lt;p style="color: red"&gt;</body>'
    )
    move_inline(tmp_path)
    text = (tmp_path / "sub" / "page.html").read_text()
    assert "alert" not in text
    assert "<style" not in text
    assert text.count(' style="') == 1, "only in text, where it is no attribute"
    assert '<script type="application/json">{"a": 1}</script><script src="x.js"></script>' in text
    (script,) = re.findall(r'<script src="\.\./(_static/inline-\w+\.js)"', text)
    assert (tmp_path / script).read_text() == "alert('run')\n"
    names = re.findall(r'<p class="old (inline-\w+)">|<svg class="(inline-\w+)">', text)
    rules = (tmp_path / "_static" / "inline.css").read_text()
    assert f".{names[0][0]} {{ opacity: 50%; }}" in rules
    assert f".{names[1][1]} {{ display: none; }}" in rules
    sheets = re.findall(r'<link rel="stylesheet" href="\.\./(_static/[\w.-]+)"', text)
    assert len(sheets) == 2
    assert all((tmp_path / sheet).is_file() for sheet in sheets)


@pytest.mark.parametrize(
    ("schema", "type_", "meaning"),
    [
        ({"anyOf": [{"type": "string", "maxLength": 1}, {"type": "null"}]}, "string or null", "At most 1 character."),
        (
            {"type": "array", "items": {"$ref": "#/components/schemas/X"}, "minItems": 2},
            "array of X",
            "At least 2 items.",
        ),
        ({"enum": ["a", "b"], "default": "a", "description": "Which."}, "`a`, `b`", "Which. Default `a`."),
        (
            {"type": "number", "exclusiveMinimum": 0.0, "maximum": 70.0},
            "number",
            "At most 70; greater than 0.",
        ),
        ({"type": "object", "additionalProperties": {"type": "integer"}}, "object of integer", ""),
    ],
)
def test_schemas_are_put_in_words(schema: dict[str, object], type_: str, meaning: str) -> None:
    assert type_text(schema, lambda name: name) == type_
    words = sorted(meaning_text(schema).rstrip(".").lower().split("; "))
    assert words == sorted(meaning.rstrip(".").lower().split("; "))


def test_code_and_cells_keep_what_markdown_would_take() -> None:
    assert code("a`b") == "`` a`b ``"
    assert cell("a | b\n c") == "a \\| b c"
