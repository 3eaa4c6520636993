"""Health, metrics, logs and the OpenAPI document."""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import re
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import orjson
import pytest
import sqlalchemy as sa
import structlog
from fastapi.routing import APIRoute

from app.api.http.middleware import PROTECTED
from app.api.http.problems import MEDIA_TYPE, PROBLEMS, kind_of
from app.api.http.system import Readiness
from app.api.http.ui import PAGES
from app.errors import StorageFull, WaymarkError
from app.logs import configure_logs
from app.settings import Settings
from app.storage import spool
from tests.conftest import ADMIN_KEY, LiveServer
from tests.http import refused, wait_until

OPEN = {"/", "/healthz", "/readyz", "/metrics", "/docs", "/docs/oauth2-redirect", "/redoc", "/openapi.json"}


def _descendants(kind: type) -> set[type]:
    return {kind}.union(*(_descendants(child) for child in kind.__subclasses__()))


def test_every_error_of_the_domain_is_in_the_table() -> None:
    missing = {kind for kind in _descendants(WaymarkError) if kind_of(kind.__new__(kind)) is None}
    assert missing == {WaymarkError}
    assert len({kind.slug for kind in PROBLEMS.values()}) == len(PROBLEMS)


def test_not_ready_while_nothing_can_be_written(
    fresh_server: LiveServer, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    fresh_server.app.state.readiness.valid_s = 0.0

    def fail(_descriptor: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with fresh_server.client(None) as anyone:
        assert anyone.get("/readyz").json()["parts"]["storage"] is True
        for module, name, fault in ((os, "fsync", fail), (spool, "MIN_FREE_BYTES", 2**62)):
            with monkeypatch.context() as broken:
                broken.setattr(module, name, fault)
                late = anyone.get("/readyz")
                assert (late.status_code, late.json()["parts"]["storage"]) == (503, False)
            assert anyone.get("/readyz").status_code == 200


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "no space left"), StorageFull("the database")])
def test_a_full_disk_is_507_with_a_time_to_try_again(fresh_server: LiveServer, error: Exception) -> None:
    def fail() -> None:
        raise error

    fresh_server.app.add_api_route("/full", fail)
    with fresh_server.client() as client:
        response = client.get("/full")
    assert "room" in refused(response, 507, "storage-full")["detail"]
    assert int(response.headers["retry-after"]) > 0


def test_ready_only_while_the_database_is_migrated(fresh_server: LiveServer, settings: Settings) -> None:
    fresh_server.app.state.readiness.valid_s = 0.0
    with fresh_server.client(None) as anyone:
        assert anyone.get("/healthz").json() == {"status": "ok"}
        ready = anyone.get("/readyz")
        assert ready.status_code == 200
        assert ready.json()["parts"]["database"] is True
        engine = sa.create_engine(settings.resolved_database_url)
        with engine.begin() as connection:
            connection.exec_driver_sql("UPDATE alembic_version SET version_num = 'other'")
        engine.dispose()
        late = anyone.get("/readyz")
        assert (late.status_code, late.json()["parts"]["database"]) == (503, False)
        assert anyone.get("/healthz").status_code == 200


def test_not_ready_without_the_file_of_the_database(fresh_server: LiveServer, settings: Settings) -> None:
    if not settings.resolved_database_url.startswith("sqlite"):
        pytest.skip("this database is no file")
    fresh_server.app.state.readiness.valid_s = 0.0
    path = Path(settings.resolved_database_url.removeprefix("sqlite:///"))
    with fresh_server.client(None) as anyone:
        assert anyone.get("/readyz").status_code == 200
        path.rename(path.with_suffix(".away"))
        assert anyone.get("/readyz").json()["parts"]["database"] is False
        path.write_bytes(path.with_suffix(".away").read_bytes())  # another file of the same name
        assert anyone.get("/readyz").json()["parts"]["database"] is False
        path.with_suffix(".away").rename(path)
        assert anyone.get("/readyz").status_code == 200


def test_not_ready_without_the_blob_store(serve: Callable[[Settings], LiveServer], settings: Settings) -> None:
    nowhere = settings.model_copy(update={"blobs_url": "s3://nope/x"})
    with serve(nowhere).client(None) as anyone:
        late = anyone.get("/readyz")
        assert (late.status_code, late.json()["parts"]["storage"]) == (503, False)
        assert late.json()["parts"]["database"] is True


def test_readiness_asks_every_part(fresh_server: LiveServer) -> None:
    fresh_server.app.state.readiness.checks["workers"] = lambda: "they have ended"
    with fresh_server.client(None) as anyone:
        answer = anyone.get("/readyz")
    assert answer.status_code == 503
    assert answer.json()["status"] == "not ready"


def test_checks_run_once_for_all_who_ask_and_the_log_names_the_cause() -> None:
    calls, cause = [], ["the disk is gone"]

    def check() -> str | None:
        calls.append(1)
        return cause[0]

    async def ask() -> None:
        asked = Readiness({"storage": check, "hangs": lambda: hang.wait() and None})
        asked.valid_s, asked.within_s, hang = 60.0, 0.05, threading.Event()
        for _ in range(2):
            for found in await asyncio.gather(*(asked.parts() for _ in range(100))):
                assert found == {"storage": False, "hangs": False}
        asked.valid_s, asked._until_s = 0.0, 0.0
        hang.set()
        cause[0] = None
        assert await asked.parts() == {"storage": True, "hangs": True}

    with structlog.testing.capture_logs() as lines:
        asyncio.run(ask())
    assert len(calls) == 2
    assert [(line["event"], line["part"], line["cause"]) for line in lines] == [
        ("not ready", "storage", "the disk is gone"),
        ("not ready", "hangs", "no answer within 0.05 s"),
        ("ready again", "storage", None),
        ("ready again", "hangs", None),
    ]


def test_a_client_that_leaves_is_one_line(fresh_server: LiveServer) -> None:
    head = f"POST /v1/markers HTTP/1.1\r\nHost: x\r\nX-API-Key: {ADMIN_KEY}\r\n"
    body = "Content-Type: application/json\r\nContent-Length: 100\r\n\r\n{"
    with structlog.testing.capture_logs() as lines:
        address = httpx.URL(fresh_server.url)
        with socket.create_connection((address.host, address.port)) as client:
            client.sendall((head + body).encode())
        line = wait_until(lambda: next((each for each in lines if each["event"] == "request"), None), "a line")
    assert (line["path"], line["log_level"]) == ("/v1/markers", "info")
    assert len(lines) == 1, lines


def test_answers_to_probes_are_not_logged(fresh_server: LiveServer) -> None:
    with structlog.testing.capture_logs() as lines, fresh_server.client(None) as anyone:
        for path in ("/readyz", "/healthz", "/openapi.json"):
            assert anyone.get(path).status_code == 200
        wait_until(lambda: any(line.get("path") == "/openapi.json" for line in lines), "a line")
    assert [line.get("path") for line in lines] == ["/openapi.json"]


@pytest.mark.slow
def test_metrics_count_by_route_not_by_path(server: LiveServer, client: httpx.Client) -> None:
    for number in range(3):
        client.get(f"/v1/markers/01a1fb99-93e6-79ab-93c1-fe6e9560000{number}")
    client.get("/v1/some/path/that/is/not/there")
    client.request("BREW", "/healthz")
    text = client.get("/metrics").text
    counts = dict(re.findall(r"^waymark_http_requests_total(\{.*\}) (\S+)$", text, re.M))
    assert float(counts['{method="GET",route="/v1/markers/{marker_id}",status="404"}']) >= 3
    assert float(counts['{method="GET",route="unmatched",status="404"}']) >= 1
    assert "fe6e9560000" not in text
    assert "BREW" not in text
    assert "waymark_http_request_seconds_bucket" in text


def test_request_ids_are_kept_if_they_are_harmless(client: httpx.Client) -> None:
    assert client.get("/healthz", headers={"X-Request-ID": "trace-1.a_b"}).headers["x-request-id"] == "trace-1.a_b"
    for bad in ("a b", "x" * 65, '{"a":1}', ""):
        given = client.get("/healthz", headers={"X-Request-ID": bad}).headers["x-request-id"]
        assert re.fullmatch(r"[0-9a-f]{32}", given)


@pytest.mark.slow
def test_only_known_paths_need_no_key(server: LiveServer) -> None:
    paths = set(server.app.openapi()["paths"]) | {
        route.path for route in server.app.routes if isinstance(route, APIRoute)
    }
    assert {path for path in paths if not path.startswith((*PROTECTED, "/m/"))} <= OPEN | set(PAGES)


# --- OpenAPI ------------------------------------------------------------------------------------------------------


@pytest.fixture
def document(server: LiveServer) -> dict[str, Any]:
    with server.client(None) as anyone:
        return dict(anyone.get("/openapi.json").json())


def _operations(document: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    return [
        (f"{method.upper()} {path}", operation)
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    ]


def test_every_protected_operation_documents_keys_and_problems(document: dict[str, Any]) -> None:
    assert "Problem" in document["components"]["schemas"]
    protected = [(n, op) for n, op in _operations(document) if " /v1/" in n and not n.endswith(" /v1/page-settings")]
    assert len(protected) >= 5
    for name, operation in protected:
        assert operation["security"] == [{"bearer": []}, {"apiKey": []}, {"basic": []}], name
        for status in ("400", "401", "403", "413", "422", "500", "503"):
            response = operation["responses"][status]
            if "$ref" in response:
                response = document["components"]["responses"][response["$ref"].rpartition("/")[2]]
            assert MEDIA_TYPE in response["content"], (name, status)
        assert operation["summary"], name


def test_every_reference_resolves(document: dict[str, Any]) -> None:
    for reference in set(re.findall(r'"\$ref":"#/([^"]+)"', orjson.dumps(document).decode())):
        node: Any = document
        for part in reference.split("/"):
            node = node[part]


def test_every_schema_has_a_name_of_its_own(document: dict[str, Any]) -> None:
    assert [name for name in document["components"]["schemas"] if "__" in name] == []


def test_responses_have_the_documented_members(client: httpx.Client, document: dict[str, Any]) -> None:
    schemas = document["components"]["schemas"]
    made = client.post("/v1/markers", json={"position": {"lon_deg": 71.5, "lat_deg": 5.25}}).json()
    assert set(made) == set(schemas["PlateDocument"]["properties"]) - {"position_warnings"}  # there are none
    for part, shape in (("code", "PlateCode"), ("geometry", "PlateGeometry"), ("position", "Position")):
        assert set(made[part]) == set(schemas[f"{shape}Document"]["properties"])
    entry = client.get(f"/v1/markers/{made['id']}/versions").json()["items"][0]
    assert set(entry) == set(schemas["VersionDocument"]["properties"])


# --- logs ---------------------------------------------------------------------------------------------------------


def test_logs_are_one_json_object_a_line(
    serve: Callable[[Settings], LiveServer], settings: Settings, capsys: pytest.CaptureFixture[str]
) -> None:

    root = logging.getLogger()
    before, level = root.handlers, root.level
    try:
        configure_logs("json", "INFO")
        lines: list[dict[str, Any]] = []

        def access_line() -> dict[str, Any] | None:
            lines.extend(orjson.loads(line) for line in capsys.readouterr().err.splitlines())
            return next((line for line in lines if line.get("request_id") == "one"), None)

        with serve(settings).client() as client:
            client.get("/v1/markers", headers={"X-Request-ID": "one"})
        access = wait_until(access_line, "the line of the request")  # written after the response is sent
        logging.getLogger("elsewhere").warning("from the standard library")
        lines.extend(orjson.loads(line) for line in capsys.readouterr().err.splitlines())
    finally:
        root.handlers, root.level = before, level
        structlog.reset_defaults()
    assert (access["event"], access["status"], access["route"]) == ("request", 200, "/v1/markers")
    assert {"agency", "ms", "timestamp", "level"} <= access.keys()
    assert lines[-1]["event"] == "from the standard library"
    assert settings.admin_key is not None
    assert settings.admin_key.get_secret_value() not in str(lines)
