"""Agencies that an operator creates over HTTP: names, first keys, repetitions, and what an operator may not do."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from app.registry.agencies import agencies, idempotency_keys
from app.registry.engines import across_agencies
from app.services.access.access import Scope
from tests.conftest import LiveServer
from tests.http import PERMISSIONS, refused

pytestmark = [pytest.mark.slow, pytest.mark.both_databases]


@pytest.fixture
def operator(server: LiveServer) -> Iterator[httpx.Client]:
    with server.client(server.app.state.use_cases.access.create_operator_key("ops")) as client:
        yield client


def _created(operator: httpx.Client, name: str, **headers: str) -> dict[str, Any]:
    response = operator.post("/v1/agencies", json={"name": name}, headers=headers)
    assert response.status_code == 201, response.text
    return dict(response.json())


def test_an_agency_works_with_its_first_key(server: LiveServer, operator: httpx.Client) -> None:
    answer = operator.post("/v1/agencies", json={"name": "Straßen Süd", "key_label": "Ada"})
    assert answer.status_code == 201
    assert answer.headers["cache-control"] == "private, no-store"
    made = answer.json()
    with server.client(made["admin_key"]["key"]) as admin:
        assert (me := admin.get("/v1/me").json())["agency"] == "Straßen Süd"
        assert (me["scope"], me["label"]) == ("admin", "Ada")
        listed = admin.get("/v1/keys").json()["items"]
        shown = {name: value for name, value in made["admin_key"].items() if name not in ("key", "last_used_at")}
        assert [{name: key[name] for name in shown} for key in listed] == [shown]
        assert admin.post("/v1/keys", json={"scope": "vehicle", "label": "bus"}).status_code == 201
        entry = admin.get("/v1/audit").json()["items"][0]
        assert (entry["action"], entry["who"]) == ("key.created", "ops")
        refused(admin.get("/v1/agencies"), 403, "not-allowed")
        problem = refused(admin.post("/v1/agencies", json={"name": "mine"}), 403, "not-allowed")
        assert problem["limit"] == "scope operator"
    found = [item for item in operator.get("/v1/agencies?limit=1000").json()["items"] if item["id"] == made["id"]]
    assert found == [{name: made[name] for name in ("id", "name", "created_at")}]
    entry = operator.get("/v1/audit").json()["items"][-1]
    assert (entry["action"], entry["subject"], entry["detail"]) == (
        "agency.created", made["id"], {"name": "Straßen Süd"},
    )  # fmt: skip


def test_a_repeated_request_gets_the_same_key_which_is_stored_encrypted(
    server: LiveServer, operator: httpx.Client
) -> None:
    key = {"Idempotency-Key": "agency-of-the-east"}
    first = _created(operator, "East", **key)
    again = operator.post("/v1/agencies", json={"name": "East"}, headers=key)
    assert (again.status_code, again.headers["idempotency-replayed"]) == (201, "true")
    assert again.json() == first
    refused(operator.post("/v1/agencies", json={"name": "West"}, headers=key), 409, field="Idempotency-Key")
    with across_agencies(), server.app.state.database.read() as connection:
        query = sa.select(idempotency_keys.c.response).where(idempotency_keys.c.key == key["Idempotency-Key"])
        stored = connection.execute(query).scalar_one()
        count = sa.select(sa.func.count()).select_from(agencies).where(agencies.c.name == "East")
        assert connection.execute(count).scalar_one() == 1
    assert stored["id"] == first["id"]
    assert first["admin_key"]["key"] not in str(stored)
    with server.client(server.app.state.use_cases.access.create_operator_key("other")) as other:
        refused(other.post("/v1/agencies", json={"name": "East"}, headers=key), 409, field="name")


@pytest.mark.parametrize(
    ("name", "limit"),
    [
        ("", "at least 1 long"), ("a" * 201, "at most 200 long"), ("a\tb", "printable characters"),
        ("a\u200bb", "printable characters"), ("a\u202eb", "printable characters"),
        ("a\u2028b", "printable characters"),
        ("Su\u0308d", "NFC"), (" a", "single spaces between words"), ("a  b", "single spaces between words"),
        ("(operators)", "any name but (operators)"),
    ],
)  # fmt: skip
def test_a_name_that_cannot_be_read_or_typed_is_refused(operator: httpx.Client, name: str, limit: str) -> None:
    problem = refused(operator.post("/v1/agencies", json={"name": name}), 422, field="name")
    assert limit in problem["limit"], problem


def test_a_name_is_given_once_and_pages_list_all(server: LiveServer, operator: httpx.Client) -> None:
    first = _created(operator, "Once")
    refused(operator.post("/v1/agencies", json={"name": "Once"}), 409, field="name")
    others = [_created(operator, f"Page {number}")["id"] for number in range(3)]
    assert server.app.state.use_cases.access.create_key("Once", Scope.VIEWER, "by command")
    seen, url = [], "/v1/agencies?limit=2"
    while url:
        page = operator.get(url)
        assert len(page.json()["items"]) <= 2
        seen += page.json()["items"]
        url = page.links.get("next", {}).get("url", "")
    assert [item["id"] for item in seen if item["id"] in {first["id"], *others}] == [first["id"], *others]
    assert len({item["id"] for item in seen}) == len(seen)
    assert "(operators)" not in {item["name"] for item in seen}


def test_an_operators_key_reads_no_agencys_rows_and_is_made_on_the_host_only(
    server: LiveServer, operator: httpx.Client
) -> None:
    with server.agency("with rows", Scope.ADMIN) as admin:
        marker = admin.post("/v1/markers", json={"position": {"lon_deg": 12.5, "lat_deg": 51.5}}).json()["id"]
        own = admin.get("/v1/keys").json()["items"][0]["id"]
        refused(admin.post("/v1/keys", json={"scope": "operator", "label": "x"}), 422, field="scope")
    for path in ("/v1/markers", f"/v1/markers/{marker}", "/v1/decodes", "/v1/jobs", "/v1/events", "/ogc/collections"):
        refused(operator.get(path), 403, "not-allowed")
    refused(operator.get(f"/v1/keys/{own}"), 404, "not-found", field="key_id")
    refused(operator.delete(f"/v1/keys/{own}"), 404, "not-found", field="key_id")
    assert {key["scope"] for key in operator.get("/v1/keys").json()["items"]} == {"operator"}
    assert {entry["action"] for entry in operator.get("/v1/audit?limit=1000").json()["items"]} <= {
        "key.created", "agency.created",
    }  # fmt: skip
    assert operator.get("/v1/me").json()["permissions"] == sorted(
        route for route, allowed in PERMISSIONS.items() if Scope.OPERATOR in allowed
    )


def test_operators_replace_and_end_their_keys(server: LiveServer, operator: httpx.Client) -> None:
    mine = operator.get("/v1/me").json()["holder_id"]
    rotated = operator.post(f"/v1/keys/{mine}/rotate", json={"overlap_s": 3600})
    assert (rotated.status_code, rotated.json()["scope"]) == (201, "operator")
    with server.client(rotated.json()["key"]) as successor:
        assert successor.delete(f"/v1/keys/{mine}").status_code == 204
        assert operator.get("/v1/agencies").status_code == 401
        assert successor.get("/v1/agencies").status_code == 200
