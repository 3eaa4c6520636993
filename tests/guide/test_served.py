"""/guide as a visitor meets it: the policy, what is outside its folder, and the search in a browser."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from app.main import create_app
from app.settings import Settings
from tests.browser import Browser
from tests.conftest import ADMIN_KEY, LiveServer
from tests.http import refused
from tests.machine import require_tool

pytestmark = pytest.mark.slow


def test_a_guide_that_is_not_built_says_how_to_build_it(tmp_path: Path) -> None:
    folder = tmp_path / "guide"
    settings = Settings(data_dir=tmp_path / "var", admin_key=ADMIN_KEY, warm_decoders=False, guide_dir=folder)  # type: ignore[arg-type]
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
