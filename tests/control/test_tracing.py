"""One trace goes through a request, its job and the decoder process, to a collector; logs have ids and no secrets."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

from app import tracing
from app.control.exporting import start_tracing
from app.main import create_app
from app.settings import Settings
from tests.conftest import LiveServer
from tests.http import finished

SURVEY = "number,lon,lat\n" + "".join(f"{k},{8.4 + k * 1e-4:.7f},49.0\n" for k in range(1, 4))
DECLARED = json.dumps({"crs": "EPSG:4326", "family": "cerpm", "columns": {"code": "number"}})
CLIENT = "00-0123456789abcdef0123456789abcdef-0123456789abcdef-01"


@pytest.fixture
def collector() -> Iterator[tuple[str, list[bytes]]]:
    """A collector of traces: its address, and what it was sent."""
    received: list[bytes] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            assert self.path == "/v1/traces"
            assert self.headers["Content-Type"] == "application/x-protobuf"
            received.append(self.rfile.read(int(self.headers["Content-Length"])))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            return

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}", received
        server.shutdown()
        thread.join()


def spans_of(received: list[bytes]) -> list[Any]:
    spans = []
    for content in received:
        request = ExportTraceServiceRequest.FromString(content)
        for resource in request.resource_spans:
            assert {a.key: a.value.string_value for a in resource.resource.attributes}["service.name"] == "test"
            spans += [span for scope in resource.scope_spans for span in scope.spans]
    return spans


@pytest.mark.slow
@pytest.mark.both_databases
def test_a_span_goes_through_request_job_and_decoder_process(
    settings: Settings, collector: tuple[str, list[bytes]]
) -> None:
    url, received = collector
    provider = start_tracing(settings.model_copy(update={"otlp_endpoint": url}), "test")
    try:
        with LiveServer(create_app(settings)) as server, server.client() as client:
            response = client.post(
                "/v1/imports",
                files={"file": ("survey.csv", SURVEY, "text/csv"), "declaration": (None, DECLARED)},
                headers={"traceparent": CLIENT, "Prefer": "respond-async"},
            )
            assert response.status_code == 202, response.text
            done = finished(client, response.headers["location"])
            assert done["state"] == "done"
        assert provider.force_flush()
    finally:
        tracing.install(None)
        provider.shutdown()
    mine = [span for span in spans_of(received) if span.trace_id.hex() == CLIENT[3:35]]
    by_name = {span.name: span for span in mine}
    request, job = by_name.pop("request"), by_name.pop("job")
    assert request.parent_span_id.hex() == CLIENT[36:52]
    assert job.parent_span_id == request.span_id
    (step,) = by_name.values()
    assert step.parent_span_id == job.span_id
    assert job.start_time_unix_nano <= step.start_time_unix_nano < step.end_time_unix_nano <= job.end_time_unix_nano
    attributes = {a.key: a.value.string_value for span in mine for a in span.attributes}
    assert attributes["http.route"] == "/v1/imports"
    assert attributes["http.response.status_code"] == "202"
    assert not any(text in repr(mine) for text in ("8.4", "49.0", "survey.csv"))


def test_nothing_is_recorded_or_imported_unless_it_is_asked_for(settings: Settings) -> None:
    assert start_tracing(settings, "test") is None
    assert not tracing.is_on()
    assert tracing.current() is None
    with tracing.span("request") as attributes:
        assert tracing.current() is None
    assert attributes == {}


@pytest.mark.parametrize("sent", ["", "x", "00-zz", CLIENT + "0", "00-" + "g" * 32 + "-" + "0" * 16 + "-01"])
def test_a_context_that_is_none_is_ignored(sent: str) -> None:
    assert tracing.accepted(sent) is None
