"""Public pages in a browser as narrow as a phone: nothing is cut off, and the form works without scripts."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from app.services.access.access import Scope
from tests.api.public_pages.markers import EVERYTHING, new_marker, old_token, release
from tests.browser import Browser
from tests.conftest import LiveServer
from tests.formats.pictures import jpeg

LONG = "Bundesstraßenverwaltungsbehörde"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory, require_tool: Callable[..., str]) -> Iterator[Browser]:
    with Browser(require_tool("chromium"), tmp_path_factory.mktemp("profile"), (320, 640)) as opened:
        opened.call("Emulation.setScriptExecutionDisabled", value=False)
        yield opened


@pytest.fixture
def marker(server: LiveServer, place: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    with server.agency(LONG, Scope.ADMIN) as owner:
        release(owner, EVERYTHING)
        return new_marker(owner, place(), road=LONG * 3)


OVERFLOW = """[...document.querySelectorAll('body *')].filter(e => !e.closest('.trap')).filter(e => {
  const box = e.getBoundingClientRect(); return box.right > innerWidth + 0.5 || box.left < -0.5;
}).map(e => e.outerHTML.slice(0, 80))"""
CONTRAST = """(() => {
  const light = c => { const v = c.map(x => x / 255).map(x => x <= .04045 ? x / 12.92 : ((x + .055) / 1.055) ** 2.4);
    return .2126 * v[0] + .7152 * v[1] + .0722 * v[2]; };
  const parse = text => text.match(/[0-9.]+/g).map(Number);
  const ground = e => { for (; e; e = e.parentElement) { const c = parse(getComputedStyle(e).backgroundColor);
    if (c.length < 4 || c[3] > 0) return c.slice(0, 3); } return [255, 255, 255]; };
  const low = [];
  for (const e of document.querySelectorAll('body *')) {
    if (e.closest('.trap') || ![...e.childNodes].some(n => n.nodeType === 3 && n.data.trim())) continue;
    const [a, b] = [light(parse(getComputedStyle(e).color).slice(0, 3)), light(ground(e))].sort((x, y) => y - x);
    if ((a + .05) / (b + .05) < 4.5) low.push(e.outerHTML.slice(0, 80));
  }
  return low; })()"""
SMALL = """[...document.querySelectorAll('a, button, input:not([type=hidden]), textarea')]
  .filter(e => !e.closest('.trap')).filter(e => { const box = (e.closest('label') || e).getBoundingClientRect();
    return Math.min(box.width, box.height) < 24; }).map(e => e.outerHTML.slice(0, 80))"""
UNNAMED = """[...document.querySelectorAll('input:not([type=hidden]), textarea')].filter(e => !e.labels.length)
  .map(e => e.outerHTML.slice(0, 80))"""


def check(browser: Browser) -> None:
    """What WCAG 2.2 AA asks of every state of a page, as far as a program sees it."""
    assert browser.run("document.documentElement.scrollWidth") <= browser.run("innerWidth")
    assert browser.run(OVERFLOW) == []
    assert browser.run(CONTRAST) == []
    assert browser.run(SMALL) == []
    assert browser.run(UNNAMED) == []
    assert browser.run("document.querySelectorAll('h1').length") == 1
    assert browser.run("document.querySelectorAll('script, [style]').length") == 0


@pytest.mark.slow
@pytest.mark.parametrize("width", [320, 390])
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_the_page_fits_and_a_report_is_sent(
    server: LiveServer, browser: Browser, marker: dict[str, Any], tmp_path: Path, width: int, dark: bool
) -> None:
    browser.resize(width, 640, dark=dark)
    browser.complaints.clear()
    browser.open(f"{server.url}/v1/markers/{marker['id']}")  # as plates from before have it
    browser.until(f"location.pathname === '/m/{marker['id']}' && document.readyState === 'complete'")
    check(browser)
    loaded = browser.run("performance.getEntriesByType('resource').map(entry => entry.name)")
    assert set(loaded) <= {f"{server.url}/static/{name}" for name in ("public.css", "favicon.svg")}
    assert browser.complaints == []
    browser.click("nav a")
    browser.until("document.documentElement.lang === 'de' && document.readyState === 'complete'")
    check(browser)
    browser.fill("#email", "nobody")
    browser.fill("#text", "</textarea><b>x")
    browser.click("button")
    browser.until("document.querySelector('.problem') !== null && document.readyState === 'complete'")
    check(browser)
    assert browser.run("document.activeElement.className") == "problem"
    assert browser.run("document.documentElement.lang") == "de"
    assert browser.run("document.querySelector('#text').value") == "</textarea><b>x"
    assert browser.run("document.querySelector('#email').getAttribute('aria-invalid')") == "true"
    browser.click(".problem a")
    assert browser.run("location.hash") == "#kind-damaged"
    photo = tmp_path / "photo.jpg"
    photo.write_bytes(jpeg())
    token = json.dumps(old_token(server, marker["id"]))
    browser.run(f"document.querySelector('[name=token]').value = {token}")
    browser.click("#kind-loose")
    browser.fill("#email", "somebody@example.org")
    browser.choose_file("#photo", photo)
    browser.click("button")
    browser.until("location.pathname.endsWith('/thanks') && document.readyState === 'complete'")
    check(browser)
    assert "Vielen Dank" in browser.run("document.body.innerText")
    browser.click("main a")
    browser.until(f"location.pathname === '/m/{marker['id']}' && document.readyState === 'complete'")
    with server.agency(LONG, Scope.VIEWER) as owner:
        (report,) = owner.get("/v1/damage-reports", params={"marker_id": marker["id"]}).json()["items"]
    assert (report["kind"], report["has_photo"], report["has_contact"]) == ("loose", True, True)
    assert report["text"] == "</textarea><b>x"


def test_a_page_that_does_not_exist_fits(server: LiveServer, browser: Browser) -> None:
    browser.resize(320, 640)
    browser.open(f"{server.url}/m/nothing")
    browser.until("document.querySelector('h1') !== null")
    check(browser)
