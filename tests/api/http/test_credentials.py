"""The three ways to send a key; Basic credentials, and what a browser may do with those that it remembers."""

from __future__ import annotations

import base64
from typing import Any

import httpx
import pytest

from tests.conftest import ADMIN_KEY, LiveServer
from tests.http import refused


def _basic(credentials: str | bytes) -> str:
    raw = credentials.encode() if isinstance(credentials, str) else credentials
    return f"Basic {base64.b64encode(raw).decode()}"


@pytest.fixture
def anonymous(server: LiveServer) -> Any:
    with server.client(None) as client:
        yield client


PATHS = ("/v1/markers?limit=1", "/ogc/collections", "/v1/jobs", "/v1/snapshots/trust", "/v1/keys", "/v1/events")


@pytest.mark.slow
@pytest.mark.parametrize(
    "headers",
    [
        {"Authorization": f"bearer {ADMIN_KEY}"},
        {"X-API-Key": ADMIN_KEY},
        {"Authorization": _basic(f"anybody:{ADMIN_KEY}")},
        {"Authorization": _basic(f":{ADMIN_KEY}").replace("Basic", "BASIC")},
        {"Authorization": _basic(f"Ståle Ø:{ADMIN_KEY}")},
        {"Authorization": _basic("of a proxy:secret"), "X-API-Key": ADMIN_KEY},
    ],
)
def test_every_way_to_send_a_key(anonymous: httpx.Client, headers: dict[str, str]) -> None:
    for path in PATHS:
        with anonymous.stream("GET", path, headers=headers) as response:
            assert response.status_code in (200, 404), path
    made = anonymous.post("/v1/markers", headers=headers, json={"position": {"lon_deg": 8.4, "lat_deg": 49.0}})
    assert made.status_code == 201, made.text


@pytest.mark.parametrize(
    ("sent", "detail"),
    [
        (_basic(f"{ADMIN_KEY}:"), "no password"),
        (_basic("anybody"), "cannot be read"),
        (_basic(b"a:\xff\xfe"), "cannot be read"),
        ("Basic !!!", "cannot be read"),
        ("Basic", "cannot be read"),
        (_basic(":"), "requires a key"),
        (_basic("anybody:wrong"), ""),
        (_basic(f"anybody:{ADMIN_KEY}x"), ""),
        ("Digest username=a", "requires a key"),
    ],
)
def test_basic_credentials_without_a_valid_key(anonymous: httpx.Client, sent: str, detail: str) -> None:
    for method, path in (("GET", "/v1/markers"), ("POST", "/v1/decodes"), ("GET", "/ogc/collections")):
        response = anonymous.request(method, path, headers={"Authorization": sent})
        assert detail in refused(response, 401, "not-authenticated")["detail"]
        assert [value.split()[0] for value in response.headers.get_list("www-authenticate")] == ["Bearer", "Basic"]
        assert all('realm="waymark"' in value for value in response.headers.get_list("www-authenticate"))


OTHER_SITES = [
    {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "cors", "Origin": "https://evil.example"},
    {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "no-cors", "Origin": "https://evil.example"},
    {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Origin": "https://evil.example"},  # a form
    {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Origin": "null"},
    {"Origin": "https://evil.example"},
    {"Origin": "null"},
]


@pytest.mark.parametrize("sent", OTHER_SITES)
def test_a_remembered_password_is_of_no_use_to_other_sites(anonymous: httpx.Client, sent: dict[str, str]) -> None:
    headers = {"Authorization": _basic(f"me:{ADMIN_KEY}"), **sent}
    before = anonymous.get("/v1/markers", headers={"X-API-Key": ADMIN_KEY}).json()["items"]
    refused(anonymous.post("/v1/imports", headers=headers, files={"file": b"x"}), 403, "not-allowed")
    refused(anonymous.post("/v1/markers", headers=headers, content=b"{}"), 403, "not-allowed")
    assert anonymous.get("/v1/markers", headers={"X-API-Key": ADMIN_KEY}).json()["items"] == before
    bearer = {"Authorization": f"Bearer {ADMIN_KEY}", **sent}  # nothing remembers that by itself
    assert anonymous.get("/v1/markers", headers=bearer).status_code == 200


def test_own_pages_and_links_are_served(anonymous: httpx.Client) -> None:
    host = anonymous.base_url.netloc.decode()
    for sent in (
        {"Sec-Fetch-Site": "none", "Sec-Fetch-Mode": "navigate"},
        {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"},  # a link in a wiki
        {"Sec-Fetch-Site": "same-origin", "Sec-Fetch-Mode": "cors", "Origin": f"http://{host}"},
        {"Origin": f"http://{host}"},
        {"Origin": "https://roads.example", "X-Forwarded-Host": "roads.example"},
    ):
        headers = {"Authorization": _basic(f"me:{ADMIN_KEY}"), **sent}
        assert anonymous.get("/ogc/collections", headers=headers).status_code == 200, sent


@pytest.mark.slow
def test_both_documents_describe_basic(anonymous: httpx.Client) -> None:
    documents = [
        anonymous.get("/openapi.json").json(),
        anonymous.get("/ogc/api", headers={"X-API-Key": ADMIN_KEY}).json(),
    ]
    for document in documents:
        schemes = document["components"]["securitySchemes"]
        assert (schemes["basic"]["type"], schemes["basic"]["scheme"]) == ("http", "basic")
        assert "Basic" in document["info"]["description"]
    assert {"basic": []} in documents[1]["security"]
