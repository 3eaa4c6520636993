"""The built guide: nothing inline, nothing from another host, and no link that leads nowhere."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import unquote

import lxml.html
import pytest

from app.api.http.problems import PROBLEMS
from guide.api_pages import openapi_document
from guide.command_pages import list_commands

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.slow  # the build takes half a minute
LOADED = (
    ("script", "src"), ("img", "src"), ("img", "srcset"), ("link", "href"), ("iframe", "src"), ("source", "src"),
    ("video", "src"), ("audio", "src"), ("object", "data"), ("embed", "src"), ("use", "href"), ("form", "action"),
)  # fmt: skip
"""What a browser loads, or sends to, by itself or by a form."""
OUTSIDE = re.compile(r"^\s*(?:[a-z][a-z0-9+.-]*:)?//", re.IGNORECASE)


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, lxml.html.HtmlElement]:
    """All pages, parsed."""
    return {path: lxml.html.fromstring(path.read_bytes()) for path in sorted(site.rglob("*.html"))}


def test_every_document_is_a_page(site: Path, pages: dict[Path, lxml.html.HtmlElement]) -> None:
    documents = {path.relative_to(ROOT / "docs").with_suffix(".html") for path in (ROOT / "docs").rglob("*.md")}
    built = {path.relative_to(site) for path in pages}
    assert documents <= built
    assert {Path("README.html"), Path("CHANGELOG.html"), Path("search.html")} <= built


def test_pages_work_without_inline_scripts_and_styles(pages: dict[Path, lxml.html.HtmlElement]) -> None:
    for path, page in pages.items():
        for script in page.iter("script"):
            assert script.get("src") or script.get("type"), path
            assert script.get("type") in (None, "application/json", "module"), path
        assert not list(page.iter("style")), path
        for element in page.iter(lxml.html.etree.Element):
            inline = [name for name in element.attrib if name == "style" or name.startswith("on")]
            assert not inline, f"{path}: {element.tag} {inline}"
            assert not any(value.lower().lstrip().startswith("javascript:") for value in element.attrib.values()), path


def test_nothing_is_loaded_from_another_host(site: Path, pages: dict[Path, lxml.html.HtmlElement]) -> None:
    found = 0
    for path, page in pages.items():
        for tag, name in LOADED:
            for element in page.iter(tag):
                if value := element.get(name):
                    found += 1
                    assert not OUTSIDE.match(value), f"{path}: {tag} {name}={value}"
    assert found > 1000
    for path in site.rglob("*.css"):
        text = path.read_text()
        addresses = re.findall(r"url\(\s*[\"']?([^\"')]+)", text) + re.findall(r"@import\s+[\"']([^\"']+)", text)
        assert not [address for address in addresses if OUTSIDE.match(address)], path


def test_links_lead_somewhere(site: Path, pages: dict[Path, lxml.html.HtmlElement]) -> None:
    ids = {path: set(page.xpath("//@id")) for path, page in pages.items()}
    checked, faults = 0, []
    for path, page in pages.items():
        for target in page.xpath("//a/@href | //img/@src | //link/@href | //script/@src"):
            if re.match(r"^[a-z]+:", target):
                continue
            name, _, anchor = unquote(target).partition("#")
            name = name.partition("?")[0]
            file = (path.parent / name).resolve() if name else path
            checked += 1
            if not file.is_file() or site not in file.parents or (anchor and file in ids and anchor not in ids[file]):
                faults.append(f"{path.relative_to(site)}: {target}")
    assert not faults, "\n".join(sorted(set(faults))[:20])
    assert checked > 5000


def test_the_references_have_every_operation_command_and_problem(
    site: Path, pages: dict[Path, lxml.html.HtmlElement]
) -> None:
    api = "\n".join(pages[path].text_content() for path in sorted((site / "reference" / "api").glob("*.html")))
    for path, methods in openapi_document()["paths"].items():
        for method in methods:
            assert f"{method.upper()} {path}" in api
    commands = pages[site / "reference" / "commands.html"].text_content()
    for name, command in list_commands():
        assert name in commands
        for parameter in command.params:
            assert all(option in commands for option in parameter.opts if option.startswith("--"))
    problems = pages[site / "reference" / "problems.html"].text_content()
    assert all(kind.type in problems for kind in PROBLEMS.values())


def test_pages_are_small_enough_to_be_in_the_image(site: Path) -> None:
    assert sum(path.stat().st_size for path in site.rglob("*") if path.is_file()) < 20_000_000
    assert not list(site.rglob("*.map"))
    assert not list(site.rglob("*.doctree"))
