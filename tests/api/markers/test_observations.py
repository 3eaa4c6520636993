"""What vehicles saw of a marker, over HTTP."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import pytest

from app.registry import decodes
from app.registry.column_types import new_id
from app.registry.markers import get_marker
from tests.conftest import LiveServer

pytestmark = pytest.mark.both_databases

START = datetime(2026, 3, 4, 5, 6, 7, 890123, tzinfo=UTC)
WHATS = ("seen", "seen", "wrong-way", "out-of-place")


@pytest.fixture
def marker_id(server: LiveServer, client: httpx.Client, place: Callable[[], dict[str, Any]]) -> str:
    """A marker with 12 observations: three frames of each of four decodes, a minute apart, two at the same time."""
    marker: str = client.post("/v1/markers", json={"position": place()}).json()["id"]
    agency = client.headers["Authorization"].removeprefix("Bearer ")
    agency_id = server.app.state.use_cases.access.authenticate(agency).agency_id
    with server.app.state.database.write() as connection:
        get_marker(connection, agency_id, marker)
        for k, what in enumerate(WHATS):
            at = START + timedelta(minutes=max(k, 1))
            decode_id = new_id(at)
            decodes.add_decode(connection, agency_id, None, decodes.DecodeRow(decode_id, "archive", {}, at))
            rows = [decodes.NewObservation(marker, frame, at, what, {"k": k}) for frame in range(3)]
            decodes.add_observations(connection, agency_id, decode_id, rows)
    return marker


def test_observations_come_newest_first_in_pages_without_gaps(client: httpx.Client, marker_id: str) -> None:
    url = f"/v1/markers/{marker_id}/observations"
    everything = client.get(url).json()["items"]
    assert len(everything) == 12
    keys = [(datetime.fromisoformat(item["at"]), item["decode_id"], item["frame"]) for item in everything]
    assert keys == sorted(keys, reverse=True)
    assert everything[0]["what"] == "out-of-place"
    assert everything[0]["detail"] == {"k": 3}
    paged, page = [], client.get(f"{url}?limit=5")
    while True:
        paged += page.json()["items"]
        if "next" not in page.links:
            break
        page = client.get(page.links["next"]["url"])
    assert paged == everything


def test_observations_are_narrowed(client: httpx.Client, marker_id: str) -> None:
    url = f"/v1/markers/{marker_id}/observations"
    assert {item["what"] for item in client.get(f"{url}?what=wrong-way").json()["items"]} == {"wrong-way"}
    since = (START + timedelta(minutes=2)).isoformat()
    assert len(client.get(url, params={"since": since}).json()["items"]) == 6
    assert len(client.get(url, params={"since": since, "until": since}).json()["items"]) == 3


def test_a_summary_says_when_and_how_often(client: httpx.Client, marker_id: str) -> None:
    summary = client.get(f"/v1/markers/{marker_id}/observations/summary").json()
    assert summary["counts"] == {"seen": 6, "wrong-way": 3, "out-of-place": 3}
    assert (summary["observations"], summary["last_what"]) == (12, "out-of-place")
    times = [datetime.fromisoformat(summary[name]) for name in ("first_at", "last_at", "last_seen_at")]
    assert times == [START + timedelta(minutes=minutes) for minutes in (1, 3, 2)]


def test_a_marker_that_nobody_saw(client: httpx.Client, place: Callable[[], dict[str, Any]]) -> None:
    marker = client.post("/v1/markers", json={"position": place()}).json()["id"]
    assert client.get(f"/v1/markers/{marker}/observations").json() == {"items": []}
    summary = client.get(f"/v1/markers/{marker}/observations/summary").json()
    assert (summary["observations"], summary["last_at"], summary["counts"]) == (0, None, {})


def test_nobody_sees_what_was_seen_of_anothers_marker(server: LiveServer, marker_id: str) -> None:
    with server.agency("one who looks") as other:
        for path in ("", "/summary"):
            assert other.get(f"/v1/markers/{marker_id}/observations{path}").status_code == 404


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ("after=x", "after"),
        ("after=2026-03-04T05:06:07,x,1", "after"),
        ("after=2026-03-04T05:06:07Z,x,-1", "after"),
        ("after=0001-01-01T00:00:00Z,x,1", "after"),
        ("since=2026-03-04T05:06:07", "since"),
        ("since=0001-01-01T00:00:00Z", "since"),
        ("until=9999-12-31T23:59:59-14:00", "until"),
        ("limit=0", "limit"),
        ("limit=1000000000", "limit"),
        ("what=%00", "what"),
    ],
)
def test_queries_that_cannot_be_are_refused(client: httpx.Client, marker_id: str, query: str, field: str) -> None:
    answer = client.get(f"/v1/markers/{marker_id}/observations?{query}")
    assert answer.status_code == 422, answer.text
    assert answer.json()["field"] == field
    assert answer.json()["limit"]
