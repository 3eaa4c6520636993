"""What is refused at the door: bad keys, bad lengths, bad JSON, bad values. Nothing of it is stored."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest

from app.services.access.access import Scope
from app.settings import Settings
from tests.conftest import ADMIN_KEY, LiveServer
from tests.formats.pictures import png
from tests.http import WITHIN_S

JSON = {"Content-Type": "application/json"}
GOOD = '{"position": {"lon_deg": 5.5, "lat_deg": 45.5}}'


@pytest.fixture(autouse=True)
def _nothing_is_stored(client: httpx.Client) -> Iterator[None]:
    yield
    assert client.get("/v1/markers").json() == {"items": []}


def _problem(response: httpx.Response, status: int) -> dict[str, Any]:
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    return dict(response.json())


# --- JSON ---------------------------------------------------------------------------------------------------------

MALFORMED = {
    "not JSON": "{",
    "empty": "",
    "NaN": '{"position": {"lon_deg": NaN, "lat_deg": 1}}',
    "infinity": '{"position": {"lon_deg": -Infinity, "lat_deg": 1}}',
    "beyond double": '{"position": {"lon_deg": 1e999, "lat_deg": 1}}',
    "24 digits": '{"code": {"scheme": "id", "registry_number": 123456789012345678901234}, "position": {}}',
    "5000 digits": '{"x": ' + "9" * 5000 + "}",
    "duplicate key": '{"position": {"lon_deg": 1, "lon_deg": 2, "lat_deg": 1}}',
    "lone surrogate": '{"position": {"lon_deg": 1, "lat_deg": 1}, "road": "\\ud800"}',
    "surrogate key": '{"\\udfff": 1}',
    "NUL": '{"position": {"lon_deg": 1, "lat_deg": 1}, "road": "a\\u0000b"}',
    "deep": "[" * 100 + "]" * 100,
    "very deep": '{"a":' * 100_000 + "1" + "}" * 100_000,
    "UTF-16": GOOD.encode("utf-16"),
    "Latin-1": '{"road": "é"}'.encode("latin-1"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_json(client: httpx.Client, name: str) -> None:
    response = client.post("/v1/markers", content=MALFORMED[name], headers=JSON)
    problem = _problem(response, 422 if name == "empty" else 400)
    assert problem["detail"]
    assert problem["cure"]


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", None])
def test_json_of_another_content_type(client: httpx.Client, kind: str | None) -> None:
    headers = {"Content-Type": kind} if kind else {}
    _problem(client.post("/v1/markers", content=GOOD, headers=headers), 415)


# --- values -------------------------------------------------------------------------------------------------------

PLACED = {"lon_deg": 5.5, "lat_deg": 45.5}
BAD_VALUES: list[tuple[dict[str, Any] | list[Any] | str, str]] = [
    ({}, "position"),
    ([], "body"),
    ("text", "body"),
    ({"position": None}, "position"),
    ({"position": {}}, "position"),
    ({"position": {"lon_deg": 5.5}}, "position"),
    ({"position": {"lon_deg": "5.5", "lat_deg": 45.5}}, "position.lon_deg"),
    ({"position": {"lon_deg": "nan", "lat_deg": 45.5}}, "position.lon_deg"),
    ({"position": {"lon_deg": True, "lat_deg": 45.5}}, "position.lon_deg"),
    ({"position": {"lon_deg": [5.5], "lat_deg": 45.5}}, "position.lon_deg"),
    ({"position": {"lon_deg": 180.0000001, "lat_deg": 45.5}}, "position.lon_deg"),
    ({"position": {"lon_deg": 22.3, "lat_deg": 114.1}}, "position.lat_deg"),
    ({"position": {"lon_deg": 1e308, "lat_deg": 45.5}}, "position.lon_deg"),
    ({"position": PLACED | {"height_m": 1e9}}, "position.height_m"),
    ({"position": PLACED | {"epoch": 20250.4}}, "position.epoch"),
    ({"position": PLACED | {"horizontal_rmse_m": -1}}, "position.horizontal_rmse_m"),
    ({"position": PLACED | {"crs": "EPSG:999999"}}, "position.crs"),
    ({"position": PLACED | {"crs": "my grid"}}, "position.crs"),
    ({"position": PLACED | {"crs": "EPSG:5703"}}, "position.crs"),
    ({"position": PLACED | {"crs": "x" * 101}}, "position.crs"),
    ({"position": PLACED | {"crs": 4326}}, "position.crs"),
    ({"position": PLACED | {"crs": "EPSG:6318"}}, "position"),
    ({"position": PLACED | {"crs": "EPSG:2326"}}, "position"),
    ({"position": PLACED | {"easting_m": 1.0, "northing_m": 2.0}}, "position"),
    ({"position": {"easting_m": 1.0, "northing_m": 2.0}}, "position"),
    ({"position": {"easting_m": 1e300, "northing_m": 2.0, "crs": "EPSG:2326"}}, "position.easting_m"),
    ({"position": {"easting_m": 9e7, "northing_m": 9e7, "crs": "EPSG:2326"}}, "position"),
    ({"position": PLACED | {"longitude": 5.5}}, "position.longitude"),
    ({"position": PLACED, "heading_deg": 360}, "heading_deg"),
    ({"position": PLACED, "heading_deg": -1}, "heading_deg"),
    ({"position": PLACED, "status": "lost"}, "status"),
    ({"position": PLACED, "family": "balise"}, "family"),
    ({"position": PLACED, "road": ""}, "road"),
    ({"position": PLACED, "road": "x" * 201}, "road"),
    ({"position": PLACED, "agency_id": "someone else"}, "agency_id"),
    ({"position": PLACED, "code": {"scheme": "barcode"}}, "code.scheme"),
    ({"position": PLACED, "code": {"scheme": "position", "digits": "12345678901"}}, "code.digits"),
    ({"position": PLACED, "code": {"scheme": "position", "digits": "12345678901A"}}, "code.digits"),
    ({"position": PLACED, "code": {"scheme": "position", "digits": "٠٢٣٧٩٢١٦٨٤١١"}}, "code.digits"),
    ({"position": PLACED, "code": {"digits": 500000500000}}, "code.digits"),
    ({"position": PLACED, "code": {"scheme": "position", "digits": "500000500001"}}, "code.digits"),
    ({"position": PLACED, "code": {"digits": "500000500000"}}, "code.digits"),
    ({"position": PLACED, "code": {"scheme": "position-robust", "digits": "0" * 21}}, "code.digits"),
    ({"position": PLACED, "code": {"scheme": "position-robust", "check_digits": 1}}, "code.check_digits"),
    ({"position": PLACED, "code": {"scheme": "position-robust"}, "geometry": {"n": 8}}, "geometry.n"),
    ({"position": PLACED, "code": {"scheme": "position-check", "digits": "000000000001"}}, "code.digits"),
    ({"position": PLACED, "code": {"scheme": "position-check", "check_digits": 3}}, "code.check_digits"),
    ({"position": PLACED, "code": {"scheme": "position", "check_digits": 1}}, "code.check_digits"),
    ({"position": PLACED, "code": {"scheme": "position", "registry_number": 5}}, "code.registry_number"),
    ({"position": PLACED, "code": {"scheme": "id", "registry_number": 2**32}}, "code.registry_number"),
    ({"position": PLACED, "code": {"scheme": "id", "registry_number": -1}}, "code.registry_number"),
    ({"position": PLACED, "code": {"scheme": "id", "registry_number": 1.5}}, "code.registry_number"),
    ({"position": PLACED, "code": {"scheme": "id", "digits": "0123456789AB"}}, "code.digits"),
    ({"position": PLACED, "code": {"scheme": "id", "digits": "deadbeef0000"}}, "code.digits"),
    ({"position": PLACED, "code": {"scheme": "id", "allow_mismatched_digits": True}}, "code.allow_mismatched_digits"),
    (
        {"position": PLACED, "code": {"scheme": "position", "digits": "1" * 12, "allow_mismatched_digits": 1}},
        "code.allow_mismatched_digits",
    ),
    ({"position": PLACED, "geometry": {"n": 9}}, "geometry.n"),
    ({"position": PLACED, "geometry": {"n": 8.5}}, "geometry.n"),
    ({"position": PLACED, "geometry": {"unit_mm": 19.9}}, "geometry.unit_mm"),
    ({"position": PLACED, "geometry": {"unit_mm": 50.1}}, "geometry.unit_mm"),
    ({"position": PLACED, "geometry": {"gap_mm": 1.9}}, "geometry.gap_mm"),
    ({"position": PLACED, "geometry": {"gap_mm": 10.1}}, "geometry.gap_mm"),
    ({"position": PLACED, "geometry": {"thickness_mm": 4.9}}, "geometry.thickness_mm"),
    ({"position": PLACED, "geometry": {"thickness_mm": 50.1}}, "geometry.thickness_mm"),
    ({"position": PLACED, "geometry": {"n": 12, "unit_mm": 40}}, "geometry.side_mm"),
]


@pytest.mark.parametrize(("body", "field"), BAD_VALUES, ids=[f"{i}-{field}" for i, (_, field) in enumerate(BAD_VALUES)])
def test_bad_values_name_field_limit_and_cure(client: httpx.Client, body: Any, field: str) -> None:
    problem = _problem(client.post("/v1/markers", content=json.dumps(body), headers=JSON), 422)
    assert problem["field"] == field, problem
    assert problem["limit"]
    assert problem["cure"]
    assert problem["errors"][0]["field"] == field


def test_every_bad_value_is_named_at_once(client: httpx.Client) -> None:
    body = {"position": PLACED | {"epoch": 1.0}, "heading_deg": 400, "nonsense": 1}
    problem = _problem(client.post("/v1/markers", json=body), 422)
    assert {error["field"] for error in problem["errors"]} == {"position.epoch", "heading_deg", "nonsense"}


@pytest.mark.parametrize(
    "query",
    [
        "bbox=1,2,3",
        "bbox=1,2,3,nan",
        "bbox=0,10,1,5",
        "bbox=-181,0,0,1",
        "bbox=a,b,c,d",
        "near=0,0",
        "near=0,0,-1",
        "near=0,0,1e9",
        "near=0,91,5",
        "near=0,0,inf",
        "near=0,0,%00",
        "limit=0",
        "limit=1001",
        "limit=ten",
        "after=1",
        "after=%27%20OR%201=1",
        "status=lost",
        "code=",
        "code=%00",
    ],
)
def test_bad_queries(client: httpx.Client, query: str) -> None:
    problem = _problem(client.get(f"/v1/markers?{query}"), 422)
    assert problem["field"].split(".")[0] == query.split("=")[0]


@pytest.mark.parametrize("marker_id", ["x", "%00", "1'--", "%ED%A0%80", "01A1FB99-93E6-79AB-93C1-FE6E95603CAB"])
def test_identifiers_that_cannot_be(client: httpx.Client, marker_id: str) -> None:
    _problem(client.get(f"/v1/markers/{marker_id}"), 422)


@pytest.mark.parametrize("key", ["", "x" * 201, "a\tb"])
def test_bad_idempotency_keys(client: httpx.Client, key: str) -> None:
    response = client.post("/v1/markers", json={"position": PLACED}, headers={"Idempotency-Key": key})
    assert _problem(response, 422)["field"] == "Idempotency-Key"


# --- paths and methods --------------------------------------------------------------------------------------------


def test_unknown_paths_and_methods_are_problems_too(client: httpx.Client) -> None:
    assert _problem(client.get("/v1/nothing"), 404)["detail"] == "there is no resource at /v1/nothing"
    response = client.put("/v1/markers", json={})
    assert _problem(response, 405)["type"] == "urn:waymark:problem:method-not-allowed"
    assert "POST" in response.headers["allow"] or "GET" in response.headers["allow"]


# --- keys ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Authorization": "Bearer"},
        {"Authorization": "Bearer wrong"},
        {"Authorization": "Basic YTpi"},
        {"Authorization": ADMIN_KEY},
        {"X-API-Key": ""},
        {"X-API-Key": "\xff\xfe"},
        {"Authorization": "Bearer wrong", "X-API-Key": ADMIN_KEY},
    ],
)
@pytest.mark.parametrize("path", ["/v1/markers", "/v1/nothing", "/v1", "/ogc/collections"])
def test_without_a_valid_key(server: LiveServer, headers: dict[str, str], path: str) -> None:
    raw = [(name.encode(), value.encode("latin-1")) for name, value in headers.items()]
    with server.client(None) as anonymous:
        response = anonymous.get(path, headers=raw)
    assert _problem(response, 401)["type"] == "urn:waymark:problem:not-authenticated"
    assert response.headers.get_list("www-authenticate") == [
        'Bearer realm="waymark"',
        'Basic realm="waymark", charset="UTF-8"',
    ]


@pytest.mark.slow
@pytest.mark.parametrize("path", ["/healthz", "/readyz", "/metrics", "/docs", "/openapi.json"])
def test_what_needs_no_key(server: LiveServer, path: str) -> None:
    with server.client(None) as anonymous:
        assert anonymous.get(path).status_code == 200


def _talk(server: LiveServer, head: str, body: bytes = b"") -> tuple[str, int]:
    """Send a request by hand; the answer's first line, and how much of the body could be sent before it came."""
    host, port = server.url.removeprefix("http://").split(":")
    sent = 0
    with socket.create_connection((host, int(port)), timeout=WITHIN_S) as connection:
        connection.sendall(head.replace("\n", "\r\n").encode() + b"\r\n\r\n")
        connection.setblocking(False)
        try:
            while sent < len(body):
                sent += connection.send(body[sent : sent + 65536])
        except (BlockingIOError, ConnectionError):
            pass
        connection.setblocking(True)
        connection.settimeout(WITHIN_S)
        try:
            return connection.recv(65536).decode().split("\r\n")[0], sent
        except ConnectionResetError:
            return "reset", sent


def test_a_wrong_key_is_answered_before_the_body_is_sent(server: LiveServer) -> None:
    head = "POST /v1/markers HTTP/1.1\nHost: x\nContent-Type: application/json\nContent-Length: 900\nX-API-Key: wrong"
    assert _talk(server, head)[0] == "HTTP/1.1 401 Unauthorized"


def test_a_declared_length_over_the_limit_is_answered_before_the_body_is_sent(server: LiveServer) -> None:
    for length in (1024**2 + 1, 10**30):
        head = f"POST /v1/markers HTTP/1.1\nHost: x\nContent-Length: {length}\nX-API-Key: {ADMIN_KEY}"
        assert _talk(server, head)[0].split()[1] in ("413", "400")


def test_a_chunked_body_over_the_limit_is_cut_off(client: httpx.Client) -> None:
    chunks = (b" " * 65536 for _ in range(17))
    problem = _problem(client.post("/v1/markers", content=chunks, headers=JSON), 413)
    assert problem["limit"] == f"{1024**2} bytes"


def test_a_body_at_the_limit_is_read(client: httpx.Client) -> None:
    filled = b'{"nonsense": 1' + b" " * (1024**2 - 15) + b"}"
    assert _problem(client.post("/v1/markers", content=filled, headers=JSON), 422)["errors"]


def test_a_body_that_does_not_come_is_given_up(serve: Callable[[Settings], LiveServer], settings: Settings) -> None:
    server = serve(settings.model_copy(update={"body_timeout_s": 0.3}))
    head = (
        "POST /v1/markers HTTP/1.1\nHost: x\nContent-Type: application/json\n"
        f"Content-Length: 90\nX-API-Key: {ADMIN_KEY}"
    )
    started = time.monotonic()
    assert _talk(server, head)[0] == "HTTP/1.1 408 Request Timeout"
    assert time.monotonic() - started > 0.25


def test_a_body_that_comes_byte_by_byte_is_given_up(
    serve: Callable[[Settings], LiveServer], settings: Settings
) -> None:
    server = serve(settings.model_copy(update={"body_timeout_s": 0.5, "min_bytes_per_s": 1e6}))
    sent = 0

    def slowly() -> Iterator[bytes]:
        nonlocal sent
        while sent < 1000:
            sent += 1
            yield b" "
            time.sleep(0.01)  # the sender's slowness is what is tested

    with server.client() as client:
        problem = _problem(client.post("/v1/markers", content=slowly(), headers=JSON), 408)
    assert sent < 1000
    assert "bytes/s" in problem["detail"]


# --- bugs ---------------------------------------------------------------------------------------------------------


def test_a_bug_is_a_problem_without_details(serve: Callable[[Settings], LiveServer], settings: Settings) -> None:
    server = serve(settings)

    def broken() -> None:
        raise ZeroDivisionError("a secret")

    server.app.add_api_route("/broken", broken)
    with server.client() as client:
        response = client.get("/broken", headers={"X-Request-ID": "my-id"})
        problem = _problem(response, 500)
        assert problem["request_id"] == response.headers["x-request-id"] == "my-id"
        assert "secret" not in response.text
        assert client.get("/healthz").status_code == 200


@pytest.mark.parametrize("path", ["/v1/markers?stauts=active", "/v1/markers?limit=1&Limit=2", "/v1/vehicles?x=%00"])
def test_parameters_that_a_route_does_not_know_are_refused(client: httpx.Client, path: str) -> None:
    response = client.get(path)
    assert response.status_code == 422, response.text
    assert response.json()["field"] in ("stauts", "Limit", "x")


@pytest.mark.parametrize("year", ["0001-01-01T00:00:00", "9999-12-31T23:59:59"])
@pytest.mark.parametrize("zone", ["Z", "+14:00", "-14:00"])
def test_times_beyond_the_calendar_are_refused(server: LiveServer, year: str, zone: str) -> None:
    time = year + zone
    context = json.dumps({"captured_at": time, "frames": {"rate_hz": 5}})
    with server.agency("calendar", Scope.ADMIN) as client:
        answers = {
            "captured_at": client.post("/v1/decodes", files={"file": ("a.png", png())}, data={"context": context}),
            "expires_at": client.post("/v1/keys", json={"scope": "viewer", "label": "a", "expires_at": time}),
        }
        for field in ("since", "until"):
            answers[f"audit {field}"] = client.get("/v1/audit", params={field: time})
            answers[f"decodes {field}"] = client.get("/v1/decodes", params={field: time})
            answers[f"reprocessings {field}"] = client.post("/v1/reprocessings", json={field: time})
    for name, answer in answers.items():
        assert answer.status_code == 422, (name, answer.text)
        problem = answer.json()
        assert problem["field"] == name.split()[-1]
        assert problem["limit"] == "years 1900 to 2199"
        assert problem["cure"]
