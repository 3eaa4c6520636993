"""Hostile JSON costs no more than honest JSON of the same size, and its answers stay small."""

from __future__ import annotations

import json
from collections.abc import Callable

import httpx
import pytest

from app.api.http.problems import MAX_ERRORS
from app.errors import MalformedRequest
from app.formats.json_text import MAX_DEPTH, MAX_MEMBERS, MAX_VALUES, parse_json
from app.services.documents import cut_text

JSON = {"Content-Type": "application/json"}
MAX_ANSWER_BYTES = 64_000


def _refused(raw: str) -> MalformedRequest:
    with pytest.raises(MalformedRequest) as refused:
        parse_json(raw.encode())
    return refused.value


# --- the parser ---------------------------------------------------------------------------------------------------


def test_values_are_counted_before_they_are_read() -> None:
    assert _refused("[" + "[]," * MAX_VALUES + "[]]").limit == f"{MAX_VALUES} values"
    assert len(parse_json(json.dumps([0] * (MAX_VALUES - 1)).encode())) == MAX_VALUES - 1
    assert "200000 values" in _refused(json.dumps([["a"]] * 100_001)).message
    assert parse_json(json.dumps([",[{" * MAX_VALUES]).encode()) == [",[{" * MAX_VALUES]
    assert parse_json(json.dumps(['\\",[{"' * MAX_VALUES]).encode())
    assert _refused('"' + '\\"' * MAX_VALUES + "," * (MAX_VALUES + 1)).message.startswith("not JSON")


def test_an_object_has_a_limit_of_members() -> None:
    members = {f"a{number}": 0 for number in range(MAX_MEMBERS)}
    assert parse_json(json.dumps(members).encode()) == members
    assert _refused(json.dumps(members | {"one more": 0})).limit == f"{MAX_MEMBERS} members of an object"


def test_duplicate_keys_are_named() -> None:
    names = [f'"a{number}":0' for number in range(MAX_MEMBERS - 1)]
    assert _refused("{" + ",".join([*names, '"a998":1']) + "}").field == "a998"
    assert _refused("{" + ",".join([*names, '"a1":1', '"a2":1']) + "}").limit == f"{MAX_MEMBERS} members of an object"


@pytest.mark.parametrize(
    ("raw", "field"),
    [
        ('{"a": [0, {"b": "\\u0000"}]}', "body.a.1.b"),
        ('{"a": [0, {"b\\ud800": 1}]}', "body.a.1"),
        ('{"a": {"' + "b" * 5000 + '": "\\ud800"}}', "body.a." + "b" * 193),
    ],
)
def test_the_path_of_a_fault_is_named_and_cut(raw: str, field: str) -> None:
    assert _refused(raw).field == field


def test_depth() -> None:
    assert parse_json(b"[" * MAX_DEPTH + b"]" * MAX_DEPTH)
    assert _refused("[" * (MAX_DEPTH + 1) + "]" * (MAX_DEPTH + 1)).limit == f"{MAX_DEPTH} levels"


@pytest.mark.slow
def test_many_values_under_a_long_key_are_walked_without_their_paths() -> None:
    """The path of each value would take gigabytes: 190,000 times 200,000 characters."""
    value = {"k" * 200_000: [[]] * 190_000}
    assert parse_json(json.dumps(value).encode()) == value


@pytest.mark.parametrize("text", ["a" * 1000, "ä" * 1000, "\x01" * 1000, "\U0001f6a7" * 1000, "\ud800" * 1000])
def test_texts_are_cut_to_bytes(text: str) -> None:
    cut = cut_text(text, 500)
    assert len(json.dumps(cut, ensure_ascii=False).encode()) <= 502
    assert cut.endswith("…")
    assert cut_text("short", 500) == "short"


# --- requests -----------------------------------------------------------------------------------------------------

HOSTILE: dict[str, tuple[str, Callable[[], str]]] = {
    "empty positions": (
        "/v1/markers/search",
        lambda: '{"polygon":{"type":"Polygon","coordinates":[[' + "[]," * 190_000 + "[]]]}}",
    ),
    "more empty positions": (
        "/v1/markers/search",
        lambda: '{"polygon":{"type":"Polygon","coordinates":[[' + "[]," * 340_000 + "[]]]}}",
    ),
    "unknown fields": ("/v1/markers", lambda: json.dumps({f"a{number}": 0 for number in range(900)})),
    "more unknown fields": ("/v1/markers", lambda: json.dumps({f"a{number}": 0 for number in range(70_000)})),
    "unknown fields of many references": (
        "/v1/roads/019cb624-0000-7000-8000-00000000aaaa/position",
        lambda: json.dumps({"references": [{f"a{number}": 0 for number in range(90)}] * 1000}),
    ),
    "a long unknown field": ("/v1/markers", lambda: json.dumps({"x" * 1_000_000: 0})),
    "a long value": ("/v1/markers", lambda: json.dumps({"family": "x" * 1_000_000})),
    "invalid numbers": (
        "/v1/roads",
        lambda: json.dumps({"name": "a", "geometry": {"type": "LineString", "coordinates": [["x", "y"]] * 20_000}}),
    ),
    "invalid chainages": ("/v1/radio-checks", lambda: json.dumps({"chainage_m": ["x"] * 190_000})),
    "invalid items": (
        "/v1/markers/bulk",
        lambda: json.dumps({"items": [{"create": {"x" * 900: {"y" * 100: 0}}}] * 900}),
    ),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_answers_to_hostile_bodies_are_small(client: httpx.Client, name: str) -> None:
    path, body = HOSTILE[name]
    response = client.post(path, content=body(), headers=JSON)
    assert response.status_code in (400, 422), response.text[:500]
    assert len(response.content) < (1_000_000 if name == "invalid items" else MAX_ANSWER_BYTES)
    problem = response.json()
    assert problem["detail"]
    assert len(problem.get("errors", ())) <= MAX_ERRORS


def test_errors_that_are_not_listed_are_counted(client: httpx.Client) -> None:
    problem = client.post("/v1/markers", json={f"a{number}": 0 for number in range(25)}).json()
    assert len(problem["errors"]) == MAX_ERRORS
    assert problem["errors_left_out"] == 26 - MAX_ERRORS


@pytest.mark.parametrize("header", [{"Waymark-Context": '{"a":1,"a":2}'}])
def test_the_context_of_a_decode_is_read_strictly(client: httpx.Client, header: dict[str, str]) -> None:
    response = client.post("/v1/decodes", content=b"x", headers={"Content-Type": "image/jpeg", **header})
    assert response.status_code == 400
    assert "appears twice" in response.json()["detail"]


@pytest.mark.parametrize("kind", ["text/plain", "", "application/xml"])
def test_another_content_type_is_refused_with_the_right_one(client: httpx.Client, kind: str) -> None:
    response = client.post("/v1/markers", content=b'{"position": {}}', headers={"Content-Type": kind})
    assert response.status_code == 415
    assert response.json()["field"] == "Content-Type"
    assert response.json()["limit"] == "application/json"
