"""/v1/codebooks over real HTTP."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from math import comb
from typing import Any

import httpx
import pytest

from app.encoders.magnet import CodebookRules, list_conflicts
from app.markers.magnet import parse_tag
from app.markers.magnet_design import Codebook, Meaning, TagDesign
from app.services.access.access import Scope
from tests.conftest import LiveServer
from tests.http import created, refused

pytestmark = pytest.mark.both_databases

DESIGN = {"magnets": 3, "length_m": 4.0, "segment_m": 0.1}
MEANINGS = [
    {"kind": "bend-right", "value": 125},
    {"kind": "arrow", "value": "straight-left"},
    {"kind": "notice", "value": "school – slow"},
]


def _new_codebook(client: httpx.Client, **body: Any) -> dict[str, Any]:
    return created(client, "/v1/codebooks", **{"name": "City", "design": DESIGN} | body)


def _codes(book: dict[str, Any]) -> list[str]:
    return [entry["code"] for entry in book["entries"]]


@pytest.mark.slow
def test_a_codebook_gives_codes_to_meanings(client: httpx.Client) -> None:
    rules = {"speed_m_s": 13.4, "clearance_m": 0.3, "confusion": 0.0001, "wrong_way_safe": True}
    response = client.post(
        "/v1/codebooks", json={"name": "City", "design": DESIGN, "rules": rules, "meanings": MEANINGS}
    )
    book = response.json()
    assert response.status_code == 201, response.text
    assert response.headers["location"] == f"/v1/codebooks/{book['id']}"
    assert response.headers["etag"] == '"1"'
    assert client.get(response.headers["location"]).json() == book
    given = [(entry["meaning"]["kind"], entry["meaning"]["value"]) for entry in book["entries"]]
    assert given == [(meaning["kind"], meaning["value"]) for meaning in MEANINGS]
    tags = [parse_tag(code) for code in _codes(book)]
    read_back = Codebook("x", TagDesign(3, 4.0, 0.1), tuple(zip(tags, map(_meaning, book["entries"]), strict=True)))
    assert list_conflicts(read_back, CodebookRules(confusion=0.0001, wrong_way_safe=True)) == []
    assert {name: book["rules"][name] for name in rules} == rules


def _meaning(entry: dict[str, Any]) -> Meaning:
    return Meaning(entry["meaning"]["kind"], entry["meaning"]["value"])


def test_figures_say_what_fits(client: httpx.Client) -> None:
    figures = _new_codebook(client)["figures"]
    assert figures["ideal_capacity"] == 2**3 * comb(39, 1)  # equation 2
    assert figures["coupled_capacity"] == 2**3 * comb(40 - 2 * 5 + 1, 1)
    assert figures["wrong_way_safe_capacity"] == figures["coupled_capacity"] // 2
    assert figures["capacity_under_rules"] == 200
    assert figures["capacity_is_exact"] is False
    assert figures["distinguishable"]["codes"] <= figures["coupled_capacity"]
    coarse = _new_codebook(client, name="Motorway", rules={"speed_m_s": 31.0, "clearance_m": 0.4})["figures"]
    assert coarse["capacity_is_exact"] is True
    assert coarse["capacity_under_rules"] < figures["capacity_under_rules"]
    assert coarse["distinguishable"]["worst_accuracy"] < figures["distinguishable"]["worst_accuracy"]


def test_further_meanings_leave_codes_as_they_are(client: httpx.Client) -> None:
    book = _new_codebook(client, meanings=MEANINGS)
    path = f"/v1/codebooks/{book['id']}/entries"
    more = [{"kind": "speed-limit-mph", "value": limit} for limit in (25, 35)]
    longer = client.post(path, json={"meanings": more})
    assert longer.status_code == 201, longer.text
    assert longer.headers["etag"] == '"2"'
    assert _codes(longer.json())[:3] == _codes(book)
    assert len(set(_codes(longer.json()))) == 5
    assert client.get(f"/v1/codebooks/{book['id']}").json() == longer.json()
    refused(client.post(path, json={"meanings": more[:1]}), 409, "conflict")
    assert client.get(f"/v1/codebooks/{book['id']}").json()["version"] == 2
    whole = _new_codebook(client, name="At once", meanings=[*MEANINGS, *more])
    assert _codes(whole) == _codes(longer.json())


def test_a_full_book_refuses_with_figures(client: httpx.Client) -> None:
    design = {"magnets": 2, "length_m": 2.0, "segment_m": 0.5}
    meanings = [{"kind": "notice", "value": str(number)} for number in range(5)]
    problem = refused(
        client.post("/v1/codebooks", json={"name": "Small", "design": design, "meanings": meanings}),
        409,
        "codebook-full",
        field="meanings",
    )
    assert "5 codes were asked for, 4 more fit" in problem["detail"]
    assert client.get("/v1/codebooks").json() == {"items": []}
    book = _new_codebook(client, name="Small", design=design, meanings=meanings[:3])
    assert book["figures"]["capacity_under_rules"] == 4
    path = f"/v1/codebooks/{book['id']}/entries"
    assert "1 more fit" in refused(client.post(path, json={"meanings": meanings[3:]}), 409, "codebook-full")["detail"]
    assert len(client.get(path).json()["items"]) == 3
    assert client.post(path, json={"meanings": meanings[3:4]}).status_code == 201


def test_entries_by_code_and_by_meaning(client: httpx.Client) -> None:
    book = _new_codebook(client, meanings=MEANINGS)
    path = f"/v1/codebooks/{book['id']}/entries"
    assert client.get(path).json() == {"items": book["entries"]}
    for entry in book["entries"]:
        assert client.get(f"{path}/{entry['code']}").json() == entry
    for meaning, entry in zip(MEANINGS, book["entries"], strict=True):
        assert client.get(path, params=meaning).json() == {"items": [entry]}
    assert client.get(path, params={"kind": "bend-right", "value": "90"}).json() == {"items": []}
    refused(client.get(f"{path}/SSS_4_0.1_20-20"), 404, "not-found")
    refused(client.get(f"{path}/nonsense"), 404, "not-found")
    refused(client.get(path, params={"kind": "bend-right"}), 422, "invalid-parameter", field="value")
    refused(client.get(path, params={"kind": "bend-right", "value": "left"}), 422, "invalid-parameter", field="value")
    refused(client.get(path, params={"kind": "bend-right", "value": "nan"}), 422, "invalid-parameter", field="value")
    refused(client.get(path, params={"kind": "banana", "value": "1"}), 422, "invalid-parameter", field="kind")


def test_names_are_unique_in_an_agency(client: httpx.Client, server: LiveServer) -> None:
    book = _new_codebook(client)
    assert (
        book["id"]
        in refused(
            client.post("/v1/codebooks", json={"name": "City", "design": DESIGN}), 409, "conflict", field="name"
        )["detail"]
    )
    with server.agency("a stranger with the same name") as stranger:
        assert stranger.get("/v1/codebooks").json() == {"items": []}
        _new_codebook(stranger)
        for path in ("", "/entries", "/entries/SNS_4_0.1_10-30"):
            refused(stranger.get(f"/v1/codebooks/{book['id']}{path}"), 404, "not-found")
        added = stranger.post(f"/v1/codebooks/{book['id']}/entries", json={"meanings": MEANINGS})
        refused(added, 404, "not-found")
    with server.agency("readers of books", Scope.VIEWER) as reader:
        assert reader.get("/v1/codebooks").status_code == 200
        refused(reader.post("/v1/codebooks", json={"name": "x", "design": DESIGN}), 403, "not-allowed")


def test_pages_follow_the_link(client: httpx.Client) -> None:
    made = [_new_codebook(client, name=f"Book {number}")["id"] for number in range(5)]
    url: str | None = "/v1/codebooks?limit=2"
    pages = []
    while url:
        response = client.get(url)
        pages.append([item["id"] for item in response.json()["items"]])
        assert all("entries" not in item and item["entry_count"] == 0 for item in response.json()["items"])
        url = response.links.get("next", {}).get("url")
    assert pages == [made[:2], made[2:4], made[4:]]


def test_repeated_and_simultaneous_requests(client: httpx.Client) -> None:
    body = {"name": "Once", "design": DESIGN, "meanings": MEANINGS}
    key = {"Idempotency-Key": "book-1"}
    first, second = (client.post("/v1/codebooks", json=body, headers=key) for _ in range(2))
    assert (first.status_code, second.status_code) == (201, 201)
    assert first.json() == second.json()
    assert second.headers["idempotency-replayed"] == "true"
    refused(client.post("/v1/codebooks", json=body | {"name": "Else"}, headers=key), 409, "idempotency-conflict")
    path = f"/v1/codebooks/{first.json()['id']}/entries"

    def add(number: int) -> int:
        meanings = [{"kind": "notice", "value": f"notice {number}"}]
        return client.post(path, json={"meanings": meanings}, headers={"Idempotency-Key": f"n{number}"}).status_code

    with ThreadPoolExecutor(4) as threads:
        answers = list(threads.map(add, [*range(4), *range(4)]))
    assert set(answers) == {201}
    entries = client.get(path).json()["items"]
    assert len(entries) == 7
    assert len({entry["code"] for entry in entries}) == 7


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"name": ""}, "name"),
        ({"name": "x" * 81}, "name"),
        ({"name": " padded"}, "name"),
        ({"design": DESIGN | {"magnets": 1}}, "design.magnets"),
        ({"design": DESIGN | {"magnets": 8}}, "design.magnets"),
        ({"design": DESIGN | {"magnets": 3.5}}, "design.magnets"),
        ({"design": DESIGN | {"length_m": 31}}, "design.length_m"),
        ({"design": DESIGN | {"length_m": 4.05}}, "design.length_m"),
        ({"design": DESIGN | {"segment_m": 0.01}}, "design.segment_m"),
        ({"design": DESIGN | {"segment_m": 0.100001}}, "design.segment_m"),
        ({"design": DESIGN | {"min_gap_m": 0.4}}, "design.min_gap_m"),
        ({"design": DESIGN | {"min_gap_m": 5}}, "design.min_gap_m"),
        ({"rules": {"speed_m_s": 0}}, "rules.speed_m_s"),
        ({"rules": {"speed_m_s": 71}}, "rules.speed_m_s"),
        ({"rules": {"clearance_m": 1.1}}, "rules.clearance_m"),
        ({"rules": {"confusion": 0}}, "rules.confusion"),
        ({"rules": {"confusion": 0.5}}, "rules.confusion"),
        ({"rules": {"survive_missing": True}}, "rules.survive_missing"),
        ({"rules": {"odometer": {"rate_hz": 0}}}, "rules.odometer.rate_hz"),
        ({"rules": {"odometer": {"drift": -0.1}}}, "rules.odometer.drift"),
        ({"meanings": [{"kind": "banana", "value": 1}]}, "meanings.0.kind"),
        ({"meanings": [*MEANINGS, {"kind": "arrow", "value": "up"}]}, "meanings.3.value"),
        ({"meanings": [{"kind": "arrow", "value": 1}]}, "meanings.0.value"),
        ({"meanings": [{"kind": "bend-right", "value": "left"}]}, "meanings.0.value"),
        ({"meanings": [{"kind": "bend-right", "value": 181}]}, "meanings.0.value"),
        ({"meanings": [{"kind": "bend-right", "value": True}]}, "meanings.0.value"),
        ({"meanings": [{"kind": "bend-right", "value": [1]}]}, "meanings.0.value"),
        ({"meanings": [{"kind": "notice", "value": "x" * 81}]}, "meanings.0.value"),
        ({"meanings": [{"kind": "notice", "value": str(n)} for n in range(101)]}, "meanings"),
        ({"extra": 1}, "extra"),
    ],
)
def test_bad_input_is_named(client: httpx.Client, change: dict[str, Any], field: str) -> None:
    body = {"name": "City", "design": DESIGN} | change
    refused(client.post("/v1/codebooks", json=body), 422, "invalid-parameter", field=field)


def test_the_same_meaning_twice(client: httpx.Client) -> None:
    body = {"name": "City", "design": DESIGN, "meanings": [MEANINGS[0], MEANINGS[0]]}
    refused(client.post("/v1/codebooks", json=body), 409, "conflict", field="meanings")


def test_books_end_somewhere(client: httpx.Client) -> None:
    design = {"magnets": 5, "length_m": 6.0, "segment_m": 0.1}
    book = _new_codebook(client, design=design)
    path = f"/v1/codebooks/{book['id']}/entries"
    for start in range(0, 450, 90):
        meanings = [{"kind": "notice", "value": str(number)} for number in range(start, start + 90)]
        assert client.post(path, json={"meanings": meanings}).status_code == 201
    meanings = [{"kind": "notice", "value": str(number)} for number in range(450, 501)]
    assert "500" in str(refused(client.post(path, json={"meanings": meanings}), 422, "invalid-parameter")["limit"])


@pytest.mark.slow
def test_the_documented_examples_and_members(client: httpx.Client) -> None:
    schemas = client.get("/openapi.json").json()["components"]["schemas"]
    (example,) = schemas["CodebookIn"]["examples"]
    book = client.post("/v1/codebooks", json=example).json()
    (more,) = schemas["MeaningsIn"]["examples"]
    book = client.post(f"/v1/codebooks/{book['id']}/entries", json=more).json()
    assert set(book) == set(schemas["CodebookDocument"]["properties"])
    shapes = {"design": "TagDesign-Output", "rules": "CodebookRules-Output", "figures": "FiguresDocument"}
    for part, schema in shapes.items():
        assert set(book[part]) == set(schemas[schema]["properties"])
    assert set(book["entries"][0]) == set(schemas["EntryDocument"]["properties"])
    (item,) = client.get("/v1/codebooks").json()["items"]
    assert set(item) == set(schemas["CodebookSummary"]["properties"])
    etag = {"If-None-Match": '"2"'}
    assert client.get(f"/v1/codebooks/{book['id']}", headers=etag).status_code == 304
