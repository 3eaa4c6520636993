"""The OpenAPI document: one for all settings, with the headers that requests carry and the media types of files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from app.api.http.openapi import STORED, stored_text
from app.main import create_app
from app.settings import Settings
from tests.conftest import LiveServer
from tests.documented import DEVIATIONS


@pytest.mark.slow
def test_the_document_does_not_depend_on_settings(server: LiveServer, tmp_path: Path) -> None:
    other = create_app(Settings(data_dir=tmp_path, public_url="https://example.org", max_upload_bytes=1 << 20))
    assert other.openapi() == server.app.openapi()


def test_the_stored_document_is_that_of_the_app(server: LiveServer) -> None:
    """If it is not: python -m tests.stored_openapi."""
    assert STORED.read_text("utf-8") == stored_text(server.app.openapi())
    with server.client(None) as anyone:
        assert anyone.get("/openapi.json").content == STORED.read_bytes()


def _headers(document: dict[str, Any], path: str, method: str) -> dict[str, bool]:
    parameters = document["paths"][path][method]["parameters"]
    return {one["name"]: one["required"] for one in parameters if one["in"] == "header"}


def test_headers_of_requests_are_parameters(server: LiveServer) -> None:
    document = server.app.openapi()
    assert _headers(document, "/v1/markers/{marker_id}", "patch") == {"If-Match": True}
    assert _headers(document, "/v1/markers/{marker_id}", "get") == {"If-None-Match": False}
    assert _headers(document, "/v1/imports", "post") == {"Idempotency-Key": False, "Prefer": False}
    assert _headers(document, "/v1/decodes", "post") == {"Idempotency-Key": False, "Waymark-Context": False}


def test_every_operation_belongs_to_a_part_that_is_described(server: LiveServer) -> None:
    document = server.app.openapi()
    used = {tag for path in document["paths"].values() for operation in path.values() for tag in operation["tags"]}
    assert used == {tag["name"] for tag in document["tags"]}
    assert all(tag["description"].endswith(".") for tag in document["tags"])


def test_every_operation_has_a_summary_that_somebody_wrote(server: LiveServer) -> None:
    for path, operations in server.app.openapi()["paths"].items():
        for method, operation in operations.items():
            summary = operation["summary"]
            assert 8 < len(summary) <= 70, (method, path, summary)
            assert summary != operation["operationId"].replace("_", " ").title(), (method, path)
            assert summary[0].isupper(), (method, path)
            assert not summary.endswith("."), (method, path)


def test_problems_that_operations_share_are_described_once(server: LiveServer) -> None:
    document = server.app.openapi()
    read = document["paths"]["/v1/markers/{marker_id}"]["get"]["responses"]
    assert read["404"] == {"$ref": "#/components/responses/Problem404"}
    assert "not-found" in document["components"]["responses"]["Problem404"]["description"]
    public = document["paths"]["/m/{marker_id}"]["get"]["responses"]
    assert public["404"] == {"$ref": "#/components/responses/ProblemOrPage404"}
    described = [
        json.dumps(response)
        for operations in document["paths"].values()
        for operation in operations.values()
        for response in operation["responses"].values()
        if "application/problem+json" in response.get("content", {})
    ]
    assert len(described) == len(set(described))


def test_files_have_media_types_and_are_binary(server: LiveServer) -> None:
    artwork = server.app.openapi()["paths"]["/v1/markers/{marker_id}/artwork.{form}"]["get"]["responses"]
    assert set(artwork["200"]["content"]) == {"image/svg+xml", "application/pdf", "image/vnd.dxf", "image/png"}
    assert artwork["200"]["content"]["image/png"]["schema"] == {"type": "string", "format": "binary"}
    assert "content" not in artwork["304"]


@pytest.mark.parametrize(
    ("document", "fault"),
    [({"status": "fine"}, "status: "), ({"status": "ok", "load": 1}, "'load'"), ({}, "required property")],
)
def test_a_deviation_is_found(
    server: LiveServer, monkeypatch: pytest.MonkeyPatch, document: dict[str, Any], fault: str
) -> None:
    monkeypatch.setattr("app.api.http.system.ProcessHealth", lambda **_: document)
    with server.client() as client:
        client.get("/healthz")
    found = DEVIATIONS.pop()
    assert found.startswith("GET /healthz: 200 application/json: ")
    assert fault in found
    assert DEVIATIONS == []
