"""/docs and /redoc in a browser: everything comes from this server, and the content security policy refuses nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.browser import Browser
from tests.conftest import LiveServer
from tests.machine import require_tool

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("path", "operations"), [("/docs", ".opblock"), ("/redoc", "[data-section-id]")])
def test_the_api_is_described_without_another_host(
    server: LiveServer, tmp_path: Path, path: str, operations: str
) -> None:
    chromium = require_tool("chromium")
    with server.client(None) as client:
        policy = client.get(path).headers["content-security-policy"]
    assert "default-src 'none'; script-src 'self';" in policy
    assert "unsafe" not in policy
    with Browser(chromium, tmp_path / "profile") as browser:
        browser.open(f"{server.url}{path}")
        browser.until(f"document.querySelectorAll('{operations}').length > 50")
        loaded = browser.until("performance.getEntriesByType('resource').map(entry => entry.name).join(' ')").split()
        assert f"{server.url}/openapi.json" in loaded
        assert all(address.startswith(server.url) for address in loaded)
        assert browser.complaints == []
