"""Fixtures of the tests of the web pages: a server with data, a browser, pages of both sizes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from playwright.sync_api import Browser

from tests.conftest import ADMIN_KEY, LiveServer
from tests.web.browsing import Watched, chromium, watched_page
from tests.web.demo_data import fill

OpenPage = Callable[..., Watched]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """The operating system's Chromium."""
    with chromium() as running:
        yield running


@pytest.fixture(scope="module")
def ids(server: LiveServer) -> dict[str, str]:
    """Ids of what the server has, see demo_data.py."""
    with server.client() as client:
        return fill(client)


@pytest.fixture
def new_page(browser: Browser, server: LiveServer) -> Iterator[OpenPage]:
    """Makes pages; each has a browser profile of its own, and must not complain until the test ends."""
    with ExitStack() as stack:

        def make(key: str | None = ADMIN_KEY, **options: Any) -> Watched:
            return stack.enter_context(watched_page(browser, server.url, key, **options))

        yield make


@pytest.fixture
def watched(new_page: OpenPage) -> Watched:
    """A wide page, signed in as an admin."""
    return new_page()
