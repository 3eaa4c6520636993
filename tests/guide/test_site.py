"""The built guide: nothing inline, nothing from another host, no link that leads nowhere; and as a visitor meets it."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

import lxml.html
import pytest
from pydantic import SecretStr

from app.api.http.problems import PROBLEMS
from app.main import create_app
from app.settings import Settings
from guide.api_pages import openapi_document
from guide.command_pages import list_commands
from tests.browser import Browser
from tests.conftest import ADMIN_KEY, LiveServer
from tests.http import refused
from tests.machine import require_tool

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.slow  # the build takes half a minute
LOADED = (
    ("script", "src"), ("img", "src"), ("img", "srcset"), ("link", "href"), ("iframe", "src"), ("source", "src"),
    ("video", "src"), ("audio", "src"), ("object", "data"), ("embed", "src"), ("use", "href"), ("form", "action"),
)  # fmt: skip
"""What a browser loads, or sends to, by itself or by a form."""
OUTSIDE = re.compile(r"^\s*(?:[a-z][a-z0-9+.-]*:)?//", re.IGNORECASE)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that `make docs` writes; a fault in any document fails here, with its place."""
    out = tmp_path_factory.mktemp("guide") / "site"
    command = [sys.executable, "-m", "guide", "--out", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return out


@pytest.fixture(scope="module")
def guide_server(site: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveServer]:
    """A server that shows it at /guide."""
    folder = tmp_path_factory.mktemp("guide-server")
    settings = Settings(data_dir=folder, admin_key=SecretStr(ADMIN_KEY), warm_decoders=False, guide_dir=site)
    with LiveServer(create_app(settings)) as server:
        yield server


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


# --- as a visitor meets it -------------------------------------------------------------------------------------------


def test_a_guide_that_is_not_built_says_how_to_build_it(tmp_path: Path) -> None:
    folder = tmp_path / "guide"
    settings = Settings(
        data_dir=tmp_path / "var", admin_key=SecretStr(ADMIN_KEY), warm_decoders=False, guide_dir=folder
    )
    with LiveServer(create_app(settings)) as server, server.client(None) as client:
        for path in ("/guide", "/guide/", "/guide/plans.html"):
            problem = refused(client.get(path, follow_redirects=True), 404, "not-found")
            assert "`make docs`" in problem["cure"]
        folder.mkdir()
        (folder / "index.html").write_text("<title>Waymark</title>")
        assert client.get("/guide/").status_code == 200  # it was built while the server ran
        assert client.get("/guide/plans.html").status_code == 404
        assert client.post("/guide/").status_code == 405


def test_every_file_has_a_strict_policy(guide_server: LiveServer, site: Path) -> None:
    with guide_server.client(None) as client:
        assert client.get("/guide").headers["location"].endswith("/guide/")
        script = next((site / "_static").glob("inline-*.js")).relative_to(site)
        for path in ("", "index.html", "search.html", "tutorials/planner.html", str(script), "searchindex.js"):
            response = client.get(f"/guide/{path}")
            assert response.status_code == 200, path
            policy = response.headers["content-security-policy"]
            assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:;")
            assert "unsafe" not in policy
            assert response.headers["x-content-type-options"] == "nosniff"
            assert response.headers["cache-control"] == "no-cache"


def test_no_file_outside_the_folder_is_sent(guide_server: LiveServer, site: Path) -> None:
    (site.parent / "secret.txt").write_text("confidential")
    (site / "link.txt").symlink_to(site.parent / "secret.txt")
    host, port = guide_server.url.removeprefix("http://").split(":")
    try:
        for path in (
            "../secret.txt", "..%2fsecret.txt", "%2e%2e/secret.txt", "_static/../../secret.txt",
            "..%5csecret.txt", "/etc/hostname", "link.txt", "%00", "tutorials/..%2f..%2fsecret.txt",
        ):  # fmt: skip
            with socket.create_connection((host, int(port))) as connection:  # as it is: clients normalize paths
                connection.sendall(f"GET /guide/{path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode())
                response = b"".join(iter(lambda: connection.recv(65536), b""))
            status = response.split(b" ", 2)[1]
            assert status in (b"400", b"404"), (path, response[:200])
            assert b"confidential" not in response
    finally:
        (site / "link.txt").unlink()


def test_the_search_works_in_a_browser_and_the_policy_refuses_nothing(guide_server: LiveServer, tmp_path: Path) -> None:
    chromium = require_tool("chromium")
    with Browser(chromium, tmp_path / "profile") as browser:
        browser.open(f"{guide_server.url}/guide/")
        assert "Planner" in browser.run("document.querySelector('.sidebar-tree').innerText").title()
        browser.fill(".sidebar-search", "residual map")
        browser.run("document.querySelector('.sidebar-search-container').submit()")
        results = "[...document.querySelectorAll('#search-results .search a')].map((link) => link.pathname)"
        browser.until(f"{results}.includes('/guide/imports.html')")
        browser.until(
            "document.querySelector('#search-results .search p.context') !== null"
        )  # the text around the words
        browser.click("#search-results .search a")
        browser.until("document.querySelector('article h1') && !document.querySelector('#search-results')")
        for page in ("reference/api/markers.html", "tutorials/vehicle-engineer.html", "artwork.html"):
            browser.open(f"{guide_server.url}/guide/{page}")
            browser.until("[...document.images].every((image) => image.complete && image.naturalWidth > 0)")
            assert browser.run("document.body.dataset.theme") == "auto"  # the theme's script was run
            loaded = browser.run("performance.getEntriesByType('resource').map((entry) => entry.name)")
            assert loaded
            assert all(address.startswith((guide_server.url, "data:")) for address in loaded)
        assert browser.complaints == []
