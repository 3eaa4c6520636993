"""The pages of /ogc: links, tables, pages before and after, escaped texts, and a policy that Chromium enforces."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import httpx
import lxml.html
import pytest
from jinja2 import UndefinedError

from app.api.ogc import pages
from app.api.templates import render_page
from app.services.access.access import Scope
from app.services.markers.features import COLLECTIONS
from tests.api.ogc.test_features import ITEMS, MERCATOR, ROW, add
from tests.browser import Browser
from tests.conftest import ADMIN_KEY, LiveServer

pytestmark = pytest.mark.both_databases

EVIL = """<script>alert(1)</script> & "A7" 'x'"""


@pytest.fixture
def row(client: httpx.Client) -> list[str]:
    return [add(client, lon, lat, road=EVIL, measure_m=float(k)) for k, (lon, lat) in enumerate(ROW)]


def page_of(client: httpx.Client, path: str) -> Any:
    response = client.get(path, headers={"Accept": "text/html,*/*;q=0.8"})
    assert response.status_code == 200, response.text
    assert response.headers["content-type"] == "text/html; charset=utf-8"
    assert response.headers["cache-control"] == "private, no-cache"
    assert "accept" in {name.strip().lower() for name in response.headers["vary"].split(",")}
    policy = dict(part.strip().partition(" ")[::2] for part in response.headers["content-security-policy"].split(";"))
    assert (policy["default-src"], policy["script-src"], policy["style-src"]) == ("'none'", "'self'", "'self'")
    assert response.text.startswith('<!doctype html>\n<html lang="en">')
    return check_page(lxml.html.document_fromstring(response.text, base_url=str(response.url)))


def check_page(page: Any) -> Any:
    """What every page has: one heading, a title, no inline script or style, tables that name their cells."""
    assert len(page.findall(".//h1")) == 1
    assert page.findtext(".//title")
    assert not page.findall(".//script")
    assert not page.findall(".//style")
    assert not page.xpath("//@style | //@onclick | //@onload")
    assert page.find(".//main").get("id") == "content"
    assert page.xpath("//a[@class='skip']/@href") == ["#content"]
    for found in page.findall(".//table"):
        assert found.findtext("caption")
        assert {cell.get("scope") for cell in found.findall("thead//th")} == {"col"}
        assert all(line[0].tag == "th" and line[0].get("scope") == "row" for line in found.findall("tbody/tr"))
    assert all(nav.get("aria-label") for nav in page.findall(".//nav"))
    assert len(page.xpath("//@id")) == len(set(page.xpath("//@id")))
    assert all(link.get("href") and link.text_content().strip() for link in page.findall(".//a"))
    return page


@pytest.mark.slow
def test_every_page_and_every_link_of_it(client: httpx.Client, row: list[str]) -> None:
    todo, seen = [f"{client.base_url}/ogc/"], set()
    while todo:
        url = todo.pop()
        seen.add(url)
        page = page_of(client, url)
        page.make_links_absolute()
        for link in [*page.findall(".//a"), *page.findall(".//link")]:
            href = link.get("href").partition("#")[0]
            response = client.get(href, headers={"Accept": "text/html,*/*;q=0.8"})
            assert response.status_code == 200, href
            if kind := link.get("type"):
                assert response.headers["content-type"].partition(";")[0] == kind, href
            is_page = response.headers["content-type"].startswith("text/html") and "/ogc" in href
            href = href.removesuffix("?f=html")
            if is_page and href not in seen and "f=html" not in href and href not in todo:
                todo.append(href)
    paths = {urlsplit(url).path for url in seen}
    assert {"/ogc/", "/ogc/conformance", "/ogc/api", "/ogc/collections"} <= paths
    for name in COLLECTIONS:
        assert {f"/ogc/collections/{name}{rest}" for rest in ("", "/items", "/schema", "/queryables")} <= paths
    assert {f"{ITEMS}/{marker}" for marker in row} <= paths


def test_a_table_shows_what_geojson_has(client: httpx.Client, row: list[str]) -> None:
    page = page_of(client, ITEMS)
    features = client.get(ITEMS).json()["features"]
    names = [cell.text_content() for cell in page.findall(".//thead//th")]
    lines = [[cell.text_content() for cell in line] for line in page.findall(".//tbody/tr")]
    assert [line[0] for line in lines] == row
    for line, feature in zip(lines, features, strict=True):
        lon, lat = feature["geometry"]["coordinates"]
        assert line[1] == f"{lon:.10g}, {lat:.10g}"
        cells = dict(zip(names[2:], line[2:], strict=True))
        assert list(cells) == list(feature["properties"])
        for name, value in feature["properties"].items():
            assert cells[name] == ("" if value is None else str(value)), name
    assert "12 features on this page, 12 in all" in page.findtext(".//caption")
    one = page_of(client, f"{ITEMS}/{row[3]}?crs={MERCATOR}")
    cells = {line[0].text_content(): line[1].text_content() for line in one.findall(".//tbody/tr")}
    assert cells["road"] == EVIL
    assert MERCATOR in one.text_content()


def _href(page: Any, rel: str) -> str | None:
    found = set(page.xpath(f"//nav[@aria-label='Pages']//a[@rel='{rel}']/@href"))
    assert len(found) < 2
    return found.pop() if found else None


def _shown(page: Any) -> list[str]:
    return [line[0].text_content() for line in page.findall(".//tbody/tr")]


def test_next_and_previous_pages(client: httpx.Client, row: list[str]) -> None:
    page = page_of(client, f"{ITEMS}?limit=2&bbox=0,40,10,50")
    there = [_shown(page)]
    assert _href(page, "prev") is None
    assert _href(page, "first") is None
    while onward := _href(page, "next"):
        assert parse_qs(urlsplit(onward).query)["bbox"] == ["0,40,10,50"]
        page = page_of(client, onward)
        there.append(_shown(page))
    assert [name for names in there for name in names] == row
    back = [_shown(page)]
    while backward := _href(page, "prev"):
        page = page_of(client, backward)
        back.append(_shown(page))
    assert back == there[::-1]
    json_link = page_of(client, f"{ITEMS}?limit=2").xpath("//footer//a[@type='application/geo+json']/@href")[0]
    assert [feature["id"] for feature in client.get(json_link).json()["features"]] == row[:2]


def test_only_the_last_pages_are_kept(client: httpx.Client, row: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "_KEPT_PAGES", 2)
    page = page_of(client, f"{ITEMS}?limit=2")
    for _ in range(5):
        page = page_of(client, str(_href(page, "next")))
    assert _shown(page) == row[10:]
    back = 0
    while backward := _href(page, "prev"):
        page, back = page_of(client, backward), back + 1
    assert (back, _shown(page)) == (2, row[6:8])
    assert _shown(page_of(client, str(_href(page, "first")))) == row[:2]


@pytest.mark.parametrize("earlier", ["", ",", "a,,b", "é", "x" * 301])
def test_earlier_pages_that_are_none(client: httpx.Client, earlier: str) -> None:
    response = client.get(ITEMS, params={"earlier": earlier, "f": "html"})
    assert (response.status_code, response.json()["field"]) == (400, "earlier")


def test_limits_and_counts_in_html(client: httpx.Client, row: list[str]) -> None:
    assert len(_shown(page_of(client, f"{ITEMS}?limit=5000"))) == 12
    assert page_of(client, f"{ITEMS}?road=none").find(".//table") is None
    hits = page_of(client, f"{ITEMS}?resultType=hits&f=html")
    assert "There are no such features" in hits.text_content()


def test_every_text_is_escaped(client: httpx.Client, row: list[str]) -> None:
    for path in (ITEMS, f"{ITEMS}/{row[0]}"):
        text = client.get(path, params={"f": "html"}).text
        assert "<script" not in text
        assert "&lt;script&gt;alert(1)&lt;/script&gt; &amp; &#34;A7&#34; &#39;x&#39;" in text
    injected = f"{ITEMS}?road=%22%3E%3Cscript%3E&limit=1"
    assert "<script" not in client.get(injected, headers={"Accept": "text/html"}).text


def test_a_value_that_a_template_lacks_is_an_error() -> None:
    with pytest.raises(UndefinedError):
        render_page("ogc/schema.html", title="no collection")


def test_problems_stay_documents(client: httpx.Client) -> None:
    response = client.get("/ogc/collections/none", headers={"Accept": "text/html"})
    assert (response.status_code, response.headers["content-type"]) == (404, "application/problem+json")


# --- in Chromium --------------------------------------------------------------------------------------------------


@pytest.fixture
def browser(tmp_path: Path, require_tool: Callable[..., str]) -> Iterator[Browser]:
    with Browser(require_tool("chromium"), tmp_path / "profile") as started:
        yield started


def test_a_browser_shows_the_pages_with_a_password(server: LiveServer, browser: Browser, tmp_path: Path) -> None:
    key = str(server.app.state.use_cases.access.create_key("of the pages", Scope.PLANNER, label="pages"))
    with server.client(key) as client:
        for k, (lon, lat) in enumerate(ROW):
            add(client, lon, lat, road=EVIL, measure_m=float(k))
    browser.open(server.url.replace("http://", f"http://me:{key}@") + f"{ITEMS}?limit=5")
    browser.until("document.querySelectorAll('tbody tr').length === 5 && document.readyState === 'complete'")
    for onward in ("next", "next", "prev"):
        before = browser.run("document.querySelector('tbody').textContent")
        browser.run(f"document.querySelector('nav.pages a[rel={onward}]').click()")
        shown = f"document.querySelector('tbody') && document.querySelector('tbody').textContent !== {before!r}"
        browser.until(f"{shown} && document.readyState === 'complete'")
    assert browser.run("getComputedStyle(document.querySelector('table')).borderCollapse") == "collapse"
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")
    assert browser.complaints == []
    assert ADMIN_KEY not in browser.run("document.documentElement.outerHTML")
