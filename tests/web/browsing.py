"""Chromium for tests of the web pages, driven by Playwright: pages that are watched for errors and foreign requests.

Pages change at any time, so what a test asserts of one is waited for: `expect`, `shows` and `until`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from playwright.sync_api import Browser, BrowserContext, Locator, Page, expect, sync_playwright

from tests.machine import require_tool

WITHIN_MS = 600_000
"""How long a page may take until it shows what a test waits for. Generous: the suite runs beside other work."""
expect.set_options(timeout=WITHIN_MS)
_FLAGS = [
    "--no-sandbox",
    "--disable-background-networking",
    "--disable-component-update",
    "--use-angle=swiftshader",  # the map needs WebGL, also on a machine without a graphics card
    "--enable-unsafe-swiftshader",
]
DESKTOP = (1440, 900)
PHONE = (390, 844)
_KEY = "waymark-key"


@contextmanager
def chromium() -> Iterator[Browser]:
    """The browser of the operating system; without it the test is skipped, on CI it fails."""
    path = require_tool("chromium", "chromium-browser")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=_FLAGS)
        yield browser
        browser.close()


def until(page: Page, condition: str) -> None:
    """Wait until an expression is true in the page. Playwright's own way needs `eval`, which the policy refuses."""
    deadline = time.monotonic() + WITHIN_MS / 1000
    while not page.evaluate(f"() => Boolean({condition})"):
        assert time.monotonic() < deadline, f"never came true: {condition}"
        page.wait_for_timeout(50)


def shows(part: Locator, *texts: str) -> None:
    """Wait until a part of the page shows all these texts."""
    for text in texts:
        expect(part).to_contain_text(text)


def open_sections(page: Page) -> None:
    """Open all closed parts of the panel."""
    closed = page.locator(".panel .section:not([open]) > summary")
    while closed.count():
        closed.first.click()


class Watched:
    """A page, and what it did that it should not.

    Attributes
    ----------
    page : Page
    complaints : list of str
        Exceptions, refused scripts and errors in the console. A test that provokes one empties the list.
    foreign : list of str
        Requests to other hosts.
    """

    def __init__(self, page: Page, url: str) -> None:
        self.page = page
        self.url = url
        self.complaints: list[str] = []
        self.foreign: list[str] = []
        page.set_default_timeout(WITHIN_MS)
        page.set_default_navigation_timeout(WITHIN_MS)
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("console", self._note)
        page.on("request", self._check_host)

    def open(self, path: str) -> Page:
        """Go to an address of ours."""
        self.page.goto(f"{self.url}{path}")
        return self.page

    def check(self) -> None:
        """Nothing went wrong, and no other host was asked."""
        assert self.complaints == [], self.complaints
        assert self.foreign == [], self.foreign

    def _note(self, message: Any) -> None:
        if message.type == "error":
            self.complaints.append(message.text)

    def _check_host(self, request: Any) -> None:
        parts = urlsplit(request.url)
        if parts.scheme not in ("blob", "data") and f"{parts.scheme}://{parts.netloc}" != self.url:
            self.foreign.append(request.url)


@contextmanager
def watched_page(
    browser: Browser, url: str, key: str | None, size: tuple[int, int] = DESKTOP, **options: Any
) -> Iterator[Watched]:
    """A page of a browser profile of its own, signed in with a key; it must not complain."""
    context: BrowserContext = browser.new_context(
        viewport={"width": size[0], "height": size[1]}, **{"locale": "en-GB", **options}
    )
    if key is not None:
        context.add_init_script(
            f"if (!sessionStorage.getItem('{_KEY}-given')) {{ sessionStorage.setItem('{_KEY}', {key!r});"
            f" sessionStorage.setItem('{_KEY}-given', 'yes'); }}"
        )
    watched = Watched(context.new_page(), url)
    try:
        yield watched
        watched.check()
    finally:
        context.close()
