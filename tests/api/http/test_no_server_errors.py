"""Whatever comes in, no route fails: requests made from the OpenAPI document, valid and broken, on both databases.

``WAYMARK_FUZZ_EXAMPLES`` says how many requests each operation gets beside those that cover its schemas. Of operations
with large schemas, every fourth of those beyond the first sixty is sent; with more examples, all of them.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import schemathesis
import sqlalchemy as sa
from hypothesis import HealthCheck, settings
from schemathesis.generation.feedback import FeedbackSources
from schemathesis.pytest._test_builder import build_operation_test

from app.main import create_app
from app.services.access.access import Scope
from app.settings import Settings
from tests.conftest import LiveServer, verified_server
from tests.databases import PostgresServer

EXAMPLES = int(os.environ.get("WAYMARK_FUZZ_EXAMPLES", "2"))
ALL_SENT, EACH = (60, 4) if EXAMPLES == 2 else (1, 1)
NOT_HTTP = b"Invalid HTTP request received."  # what uvicorn itself says, of a URL over 64 KiB
FILES = ("application/offset+octet-stream", "application/zip", "application/x-ndjson", "application/vnd.apache.parquet")
API = schemathesis.openapi.from_dict(create_app(Settings(data_dir=Path("var"))).openapi())
OPERATIONS = [operation.ok().label for operation in API.get_all_operations()]


@schemathesis.serializer(*FILES)
def as_it_is(_context: schemathesis.SerializationContext, value: object) -> bytes:
    """Bodies that are files go out as they are; what else is made for them, as text."""
    return value if isinstance(value, bytes) else str(value).encode("utf-8", "replace")


class Fuzzed:
    """A server that gets the requests, and the number of statements that its database has run."""

    def __init__(self, server: LiveServer) -> None:
        self._url = server.url
        key = server.app.state.use_cases.access.create_key("an agency for fuzzing", Scope.ADMIN, label="fuzz")
        self._headers = {"Authorization": f"Bearer {key}"}
        self.statements = 0
        self._dialect = server.app.state.database.engine.dialect.name
        sa.event.listen(sa.Engine, "before_cursor_execute", self._count)

    def _count(self, connection: sa.Connection, *_: object) -> None:
        self.statements += connection.dialect.name == self._dialect

    def close(self) -> None:
        sa.event.remove(sa.Engine, "before_cursor_execute", self._count)

    def send(self, case: schemathesis.Case) -> None:
        headers = self._headers | ({"Accept": "application/json"} if case.path.startswith("/m/") else {})  # no page
        response = case.call(base_url=self._url, headers=headers, timeout=250)
        assert response.status_code < 500, f"{case.as_curl_command()}\n{response.content[:2000]!r}"
        if response.status_code >= 400 and case.method != "HEAD" and response.content != NOT_HTTP:
            assert response.headers["content-type"][0] == "application/problem+json"


@pytest.fixture(scope="module")
def on_sqlite(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fuzzed]:
    folder = tmp_path_factory.mktemp("fuzzed") / "var"
    with verified_server(folder, f"sqlite:///{folder / 'waymark.sqlite3'}") as server:
        fuzzed = Fuzzed(server)
        yield fuzzed
        fuzzed.close()
        assert fuzzed.statements


@pytest.fixture(scope="module")
def on_postgresql(postgres: PostgresServer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fuzzed]:
    with verified_server(tmp_path_factory.mktemp("fuzzed") / "var", postgres.empty()) as server:
        fuzzed = Fuzzed(server)
        yield fuzzed
        fuzzed.close()
        assert fuzzed.statements


@pytest.mark.parametrize("label", OPERATIONS)
def test_no_request_makes_a_server_error(label: str, on_sqlite: Fuzzed, on_postgresql: Fuzzed) -> None:
    """A request for which SQLite runs no statement is answered before the database, so it is not sent again."""

    made = itertools.count()

    @settings(max_examples=EXAMPLES, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    def send(case: schemathesis.Case) -> None:
        number = next(made)
        if number > ALL_SENT and number % EACH:
            return
        before = on_sqlite.statements
        on_sqlite.send(case)
        if on_sqlite.statements > before:
            on_postgresql.send(case)

    method, path = label.split(" ")
    # `API.parametrize` makes the requests of all operations while tests are collected, which each worker does
    build_operation_test(
        config=API.config, operation=API[path][method], test_func=send, given_kwargs={}, feedback=FeedbackSources()
    )()
