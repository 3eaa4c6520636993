"""The examples of request bodies in the OpenAPI document can be sent as they are."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest

from app.api.http.openapi import STORED
from tests.conftest import ADMIN_KEY, LiveServer
from tests.formats.pictures import png

NOBODY_ID = "019cb624-0000-7000-8000-00000000ffff"
FORM = "multipart/form-data"
INVALID = "urn:waymark:problem:invalid-parameter"
VALUES = {"form": "svg", "collection": "markers"}
"""Values of parameters of paths; others are ids of nothing."""
FILES = {
    "jpg": png(np.full((1080, 1920), 128, np.uint8)),
    "geojson": json.dumps({"type": "LineString", "coordinates": [[8.40, 49.0], [8.42, 49.0]]}).encode(),
    "csv": b"1,5427000.0,457000.0,110.0,CERPM\n",
}
"""Contents of the files that examples name, by suffix."""
ELSEWHERE = {"POST /m/{marker_id}/reports", "POST /v1/reprocessings", "POST /v1/uploads"}
"""They depend on a token, on stored uploads and on an S3 store; their own tests send them."""


def _examples() -> list[tuple[str, str, dict[str, Any]]]:
    """Route, media type and example of every body."""
    document = json.loads(STORED.read_text("utf-8"))
    schemas, found = document["components"]["schemas"], []
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            for kind, content in operation.get("requestBody", {}).get("content", {}).items():
                if "$ref" not in content["schema"] and kind != FORM:
                    continue  # a file as it comes
                schema = schemas.get(content["schema"].get("$ref", "").rpartition("/")[2], {})
                examples = schema.get("examples") or [content.get("example", schema.get("example"))]
                found += [(f"{method.upper()} {path}", kind, example) for example in examples]
    return found


EXAMPLES = _examples()


def test_every_body_but_files_has_an_example() -> None:
    assert len(EXAMPLES) > 60
    assert [route for route, _, example in EXAMPLES if example is None] == []


@pytest.fixture(scope="module")
def markers(server: LiveServer) -> None:
    """Markers of all families, which other examples select."""
    with server.client(ADMIN_KEY) as client:
        for route, _, example in EXAMPLES:
            if route == "POST /v1/markers":
                assert client.post("/v1/markers", json=example).status_code in (201, 409)


@pytest.mark.usefixtures("markers")
@pytest.mark.parametrize(
    ("route", "kind", "example"),
    [pytest.param(*case, id=f"{case[0]} {number}") for number, case in enumerate(EXAMPLES) if case[0] not in ELSEWHERE],
)
def test_an_example_is_accepted(server: LiveServer, route: str, kind: str, example: dict[str, Any]) -> None:
    method, _, path = route.partition(" ")
    address = re.sub(r"\{(\w+)\}", lambda found: VALUES.get(found[1], NOBODY_ID), path)
    key = server.app.state.use_cases.access.create_operator_key("ops") if path == "/v1/agencies" else ADMIN_KEY
    with server.client(key) as client:
        if kind == FORM:
            answer = client.post(address, files=_parts(example))
        else:
            headers = {"Content-Type": kind, "If-Match": "*"}
            answer = client.request(method, address, content=json.dumps(example), headers=headers)
    if kind == FORM and answer.status_code == 422:  # there is nothing in the file
        assert answer.json()["type"] != INVALID, answer.text
    else:
        assert answer.status_code in (200, 201, 202, 204, 404, 409), answer.text


def _parts(example: dict[str, Any]) -> list[tuple[str, tuple[str | None, bytes, str]]]:
    parts: list[tuple[str, tuple[str | None, bytes, str]]] = []
    for name, value in example.items():
        if isinstance(value, dict):
            parts.append((name, (None, json.dumps(value).encode(), "application/json")))
        else:
            files = [value] if isinstance(value, str) else value
            parts += [(name, (file, FILES[file.rpartition(".")[2]], "application/octet-stream")) for file in files]
    return parts
