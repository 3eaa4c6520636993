"""Gathers the sources of the guide: documents as they are, generated references, and the navigation.

docs/index.md is the navigation: each of its headings is a group, each link of its lists a page. It is also the page
that the repository shows, so it has no directives; they are added to the copy. docs/decisions/README.md does the same
for the decision records.
"""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

from guide.api_pages import write_api_pages
from guide.command_pages import write_command_page

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
OUTSIDE = {ROOT / name: name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE")}
"""Files beside the folder of documents that are part of the guide, with their names there."""
GENERATED_MARK = "<!-- generated pages -->\n"
"""Where docs/index.md lists the pages that only the built guide has."""
_LINK = re.compile(r"(?P<before>\]\()(?P<path>(?!https?://|#|mailto:)[^)#\s]+)(?P<anchor>#[^)\s]*)?(?P<after>\))")
_GROUP = re.compile(r"^## (?P<title>.+)\n(?P<body>(?:(?!^## ).*\n?)*)", re.MULTILINE)
_PAGE = re.compile(r"^- \[(?P<title>[^\]]+)\]\((?P<path>[^)#]+)\.md\)", re.MULTILINE)


def gather_sources(folder: Path) -> None:
    """Write everything that Sphinx reads."""
    shutil.copytree(DOCS, folder)
    for path, name in OUTSIDE.items():
        shutil.copyfile(path, folder / name)
        if name.endswith(".md"):
            (folder / name).write_text(_with_moved_links(path, (folder / name).read_text()))
    for path in DOCS.rglob("*.md"):
        copy = folder / path.relative_to(DOCS)
        copy.write_text(_with_moved_links(path, copy.read_text()))
    decisions = folder / "decisions" / "README.md"
    decisions.write_text(with_navigation(decisions.read_text()))
    generated = [*write_api_pages(folder), write_command_page(folder)]
    index = folder / "index.md"
    text = index.read_text()
    assert GENERATED_MARK in text, "docs/index.md does not say where generated pages are listed"
    links = "".join(f"- [{title}]({name}.md): {text}\n" for name, title, text in generated)
    index.write_text(with_navigation(text.replace(GENERATED_MARK, links)))


def with_navigation(index: str) -> str:
    """The text of the index with a hidden list of pages for each of its groups, from which the theme makes the menu."""
    return _GROUP.sub(_with_menu, index)


def _with_menu(group: re.Match[str]) -> str:
    pages = [f"{found['title']} <{found['path']}>" for found in _PAGE.finditer(group["body"])]
    if not pages:
        return group[0]
    lines = ["```{toctree}", ":hidden:", f":caption: {group['title']}", "", *pages, "```", ""]
    return group[0].rstrip("\n") + "\n\n" + "\n".join(lines) + "\n"


def _with_moved_links(document: Path, text: str) -> str:
    """A document's text with links to where the guide has their targets."""

    def moved(found: re.Match[str]) -> str:
        target = (document.parent / found["path"]).resolve()
        if target in OUTSIDE:
            place = DOCS / OUTSIDE[target]
        elif target.is_dir() and DOCS in target.parents:
            place = target / "README.md"
        elif DOCS in target.parents:
            place = target
        else:
            return found[0]  # Sphinx reports it
        start = DOCS if document in OUTSIDE else document.parent
        return f"{found['before']}{os.path.relpath(place, start)}{found['anchor'] or ''}{found['after']}"

    return _LINK.sub(moved, text)
