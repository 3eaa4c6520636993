"""Whatever comes in, no route fails: requests made from the OpenAPI document, valid and broken, on both databases.

``WAYMARK_FUZZ_EXAMPLES`` says how many requests each operation gets.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import schemathesis
from hypothesis import HealthCheck, settings

from app.main import create_app
from app.services.access import Scope
from app.settings import Settings
from tests.conftest import LiveServer

EXAMPLES = int(os.environ.get("WAYMARK_FUZZ_EXAMPLES", "3"))
NOT_HTTP = b"Invalid HTTP request received."  # what uvicorn itself says, of a URL over 64 KiB
FILES = ("application/zip", "application/x-ndjson", "application/vnd.apache.parquet")


@schemathesis.serializer(*FILES)
def as_it_is(_context: schemathesis.SerializationContext, value: object) -> bytes:
    """Bodies that are files go out as they are; what else is made for them, as text."""
    return value if isinstance(value, bytes) else str(value).encode("utf-8", "replace")


api = schemathesis.openapi.from_dict(create_app(Settings(data_dir=Path("var"))).openapi())


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def backend(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def key(server: LiveServer) -> Iterator[str]:
    return server.app.state.access.create_key("an agency for fuzzing", Scope.ADMIN, label="fuzz")


@pytest.mark.slow
@api.parametrize()
@settings(max_examples=EXAMPLES, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
def test_no_request_makes_a_server_error(case: schemathesis.Case, server: LiveServer, key: str) -> None:
    response = case.call(base_url=server.url, headers={"Authorization": f"Bearer {key}"}, timeout=250)
    assert response.status_code < 500, f"{case.as_curl_command()}\n{response.content[:2000]!r}"
    if response.status_code >= 400 and case.method != "HEAD" and response.content != NOT_HTTP:
        assert response.headers["content-type"][0] == "application/problem+json"
