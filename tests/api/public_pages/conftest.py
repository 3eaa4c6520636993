"""Callers of the public pages."""

from __future__ import annotations

from collections.abc import Iterator

import httpx
import pytest

from tests.conftest import LiveServer


@pytest.fixture
def anybody(server: LiveServer) -> Iterator[httpx.Client]:
    """A client without a key."""
    with server.client(None) as client:
        yield client
