"""/v1/snapshots over HTTP, on both databases."""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import numpy as np
import pytest

from app.decoders.snapshot import open_snapshot
from app.geodesy import decimal_year, move_to_epoch
from app.geodesy.operations import MovedPositions
from app.markers.snapshot import ExpiredSnapshot, ForeignSnapshot, Trust
from app.services.access.access import Scope
from app.services.fleet import snapshots
from app.settings import Settings
from app.storage.keys import add_signing_key, remove_signing_key, switch_signing_keys
from tests.conftest import LiveServer

pytestmark = pytest.mark.both_databases


BOX = "8.3,48.9,8.6,49.1"


def _trust(client: httpx.Client) -> Trust:
    answer = client.get("/v1/snapshots/trust")
    assert answer.status_code == 200, answer.text
    assert (answer.json()["algorithm"], answer.json()["snapshot_version"]) == ("Ed25519", 3)
    return Trust.from_document(answer.json())


def test_a_vehicle_gets_its_agencys_markers_and_no_others(server: LiveServer, client: httpx.Client) -> None:
    place = {"lon_deg": 8.412345678, "lat_deg": 49.012345678, "height_m": 120.5, "horizontal_rmse_m": 0.02}
    limit = {"value": 30, "unit": "mph"}
    cerpm = {"family": "cerpm", "position": place, "side": "right", "speed_limit": limit}
    bare = {"family": "cerpm", "position": place}
    made = [client.post("/v1/markers", json=body).json() for body in ({"position": place}, cerpm, bare)]
    retired = client.post("/v1/markers", json={"position": {"lon_deg": 8.5, "lat_deg": 49.0}}).json()
    client.patch(f"/v1/markers/{retired['id']}", json={"status": "retired"}, headers={"If-Match": "*"})
    client.post("/v1/markers", json={"position": {"lon_deg": 8.7, "lat_deg": 49.0}})
    answer = client.get("/v1/snapshots", params={"bbox": BOX, "hours": 2})
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/vnd.waymark.snapshot"
    snapshot = open_snapshot(answer.content, _trust(client), datetime.now(UTC))
    assert len(snapshot) == 3
    plate = snapshot.near("plate", 8.4123, 49.0123, 100.0)[0]
    assert (plate.marker_id, plate.code) == (made[0]["id"], made[0]["code"]["digits"])
    assert (plate.lon_deg, plate.lat_deg, plate.height_m) == (8.412345678, 49.012345678, 120.5)
    known = {marker.code: marker.kind for marker in snapshot.near("cerpm", 8.4123, 49.0123, 100.0)}
    radio = made[1]["radio"]
    min_s = pytest.approx(radio["interval_s"] * (1 - radio["jitter_share"]))
    said = {"family": "cerpm", "min_interval_s": min_s, "transform_note": None}
    assert known["1"] == {**said, "side": "right", "speed_limit": limit}
    assert known["2"] == {**said, "side": "unknown", "speed_limit": None}
    with pytest.raises(ExpiredSnapshot):
        open_snapshot(answer.content, _trust(client), datetime.now(UTC) + timedelta(hours=2))
    with server.agency("snapshots of another", Scope.VEHICLE) as other:
        foreign = other.get("/v1/snapshots", params={"bbox": BOX})
        with pytest.raises(ForeignSnapshot, match="another agency"):
            open_snapshot(foreign.content, _trust(client), datetime.now(UTC))
        nothing = open_snapshot(foreign.content, _trust(other), datetime.now(UTC))
        assert (len(nothing), nothing.codebooks) == (0, ())


def test_a_survey_in_another_frame_is_as_good_as_its_transformation(server: LiveServer, client: httpx.Client) -> None:
    now = datetime.now(UTC)
    place = {"lon_deg": 8.41, "lat_deg": 49.01, "horizontal_rmse_m": 0.02}
    exact = client.post("/v1/markers", json={"position": {**place, "crs": "EPSG:4258", "epoch": 2020.0}}).json()
    vague = client.post("/v1/markers", json={"position": {**place, "lon_deg": 8.42, "crs": "EPSG:4314"}}).json()
    answer = client.get("/v1/snapshots", params={"bbox": BOX})
    snapshot = open_snapshot(answer.content, _trust(client), datetime.now(UTC))
    for marker in (exact, vague):
        position = marker["position"]
        (found,) = snapshot.near("plate", position["lon_deg"], position["lat_deg"], 1.0)
        bound_m = position["transform_accuracy_m"] or 0.0
        if position["epoch"] is not None:  # the snapshot has it where it is today
            moved = move_to_epoch(position["lon_deg"], position["lat_deg"], position["epoch"], decimal_year(now))
            assert (found.lon_deg, found.lat_deg) == pytest.approx((moved.lon_deg[0], moved.lat_deg[0]), abs=2e-9)
            assert abs(found.lon_deg - position["lon_deg"]) > 5e-7
            bound_m = math.hypot(bound_m, moved.accuracy_m[0])
        assert found.horizontal_rmse_m == pytest.approx(math.hypot(0.02, bound_m), abs=0.001)
        assert found.horizontal_rmse_m >= math.hypot(0.02, bound_m) - 1e-9
        assert found.grade == position["localization_grade"]
        unfit = [position["transform_note"]] if found.grade == "unfit" else []
        assert found.localization_warnings("plate") == (
            *unfit,
            "the plate is planned, its position is not surveyed",
        )
    assert [marker["position"]["localization_grade"] for marker in (exact, vague)] == ["dm", "unfit"]


@pytest.mark.parametrize(
    ("params", "field"),
    [
        ({}, "bbox"),
        ({"bbox": "1,2,3"}, "bbox"),
        ({"bbox": "1,5,3,2"}, "bbox"),
        ({"bbox": "nan,1,2,3"}, "bbox"),
        ({"bbox": BOX, "hours": "0"}, "hours"),
        ({"bbox": BOX, "hours": "nan"}, "hours"),
        ({"bbox": BOX, "hours": "1e9"}, "hours"),
        ({"bbox": BOX, "hours": "-1"}, "hours"),
        ({"bbox": BOX, "hours": "168.001"}, "hours"),
    ],
)
def test_bad_input_is_a_problem(client: httpx.Client, params: dict[str, str], field: str) -> None:
    answer = client.get("/v1/snapshots", params=params)
    assert answer.status_code == 422, answer.text
    assert field in answer.json()["field"]


def test_a_rotation_needs_no_restart(serve: Callable[..., LiveServer], settings: Settings) -> None:
    """The server reads its keys for every snapshot."""
    path = settings.resolved_signing_key_file
    with serve(settings).client() as client:
        before = _trust(client)
        add_signing_key(path)
        both = _trust(client)
        assert both.public_keys[:1] == before.public_keys
        assert len(both.public_keys) == 2
        switch_signing_keys(path)
        snapshot = client.get("/v1/snapshots", params={"bbox": BOX, "hours": 168}).content
        open_snapshot(snapshot, both, datetime.now(UTC))
        with pytest.raises(ForeignSnapshot, match="another key"):
            open_snapshot(snapshot, before, datetime.now(UTC))
        remove_signing_key(path)
        assert _trust(client).public_keys == both.public_keys[1:]


def test_markers_are_moved_and_counted_together(client: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not one after the other: 200,000 took 43 s of processor time. Too many are refused before one is read."""
    for k in range(5):
        place = {"lon_deg": 8.4 + 0.01 * k, "lat_deg": 49.0, "epoch": 2020.0, "horizontal_rmse_m": 0.02}
        client.post("/v1/markers", json={"position": place}).raise_for_status()
    moved: list[int] = []

    def count(lon_deg: np.ndarray, *rest: Any) -> MovedPositions:
        moved.append(np.size(lon_deg))
        return move_to_epoch(lon_deg, *rest)

    monkeypatch.setattr(snapshots, "move_to_epoch", count)
    assert client.get("/v1/snapshots", params={"bbox": BOX}).status_code == 200
    assert moved == [5]
    monkeypatch.setattr(snapshots, "MAX_MARKERS", 4)
    refusal = client.get("/v1/snapshots", params={"bbox": BOX})
    assert refusal.status_code == 422
    assert refusal.json()["cure"] == "ask for a smaller area"
    assert moved == [5]
