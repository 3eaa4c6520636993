"""Several vehicles' keys upload traces and packet logs: exactly the tags and CERPMs with faults become the work list.

Each trace and each log is uploaded as it is by several vehicles: they drive the same way, with the same noise.
"""

from __future__ import annotations

import io
import zipfile
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import numpy as np
import pytest

from app.demo.cerpms import BuiltLane, build_lane, write_packets, write_poses
from app.encoders.cerpm.payload import encode_message
from app.geodesy import wgs84_from_enu
from app.markers.magnet import InformationTag, parse_tag
from app.services.access.access import Scope
from app.simulation.magnetic.drive import Scene, simulate_drive
from app.simulation.magnetic.recorder import write_recorder_files
from app.simulation.magnetic.road import PlacedTag, Road
from app.simulation.magnetic.vehicle import Course, Vehicle
from app.simulation.radio.attacks import move_claim
from app.simulation.radio.drive import drive_past
from app.simulation.radio.link import Radio
from app.simulation.radio.markers import InstalledMarkers
from tests.api.decodes.conftest import post_frame
from tests.conftest import LiveServer

CODES = (
    "SNS_4_0.1_10-30", "NNS_4_0.1_15-25", "SSN_4_0.1_30-10", "NSN_4_0.1_12-28", "SNN_4_0.1_25-15", "SNS_4_0.1_16-24",
)  # fmt: skip
AT_M = (30.0, 60.0, 90.0, 120.0, 150.0, 180.0)
MISSING, MOVED, REVERSED = 1, 2, 4
LENGTH_M, MOVED_M = 205.0, 2.0
Origin = tuple[float, float, float]
ORIGIN, ELSEWHERE = (31.0, 47.0, 100.0), (33.0, 47.0, 100.0)
BEGAN = datetime(2026, 6, 1, 8, tzinfo=UTC)
MANY = 20
"""Vehicles that may be needed for a tag or a CERPM that is gone."""


def _zipped(files: dict[str, bytes]) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return packed.getvalue()


def _post(client: httpx.Client, data: bytes, context: dict[str, Any]) -> dict[str, Any]:
    answer = post_frame(client, data, context, name="drive.zip")
    assert answer.status_code == 201, answer.text
    document: dict[str, Any] = answer.json()
    return document


def _found(client: httpx.Client) -> set[tuple[str, str | None]]:
    items = client.get("/v1/maintenance", params={"limit": 100}).json()["items"]
    assert all(item["vehicles"] >= 3 for item in items if item["what"] != "wrong-way-driver")
    return {(item["what"], item["marker_id"]) for item in items}


# --- tags -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def road() -> Road:
    return Road(LENGTH_M)


def _tag(code: str) -> InformationTag:
    tag = parse_tag(code)
    assert isinstance(tag, InformationTag)
    return tag


def _lon_lat(road: Road, chainage_m: float, origin: Origin = ORIGIN) -> list[float]:
    east, north = road.world_m(np.array([chainage_m]))[0]
    lon, lat, _up = wgs84_from_enu(np.array([east, north, 0.0]), origin)
    return [float(lon), float(lat)]


def _register_tags(client: httpx.Client, road: Road, origin: Origin = ORIGIN) -> list[str]:
    line = [_lon_lat(road, s, origin) for s in np.arange(0.0, LENGTH_M + 1, 5.0)]
    lane = {
        "geometry": {"type": "LineString", "coordinates": line}, "height_m": ORIGIN[2], "realization": "ITRF2014",
        "epoch": 2026.4, "horizontal_rmse_m": 0.02,
    }  # fmt: skip
    ids = []
    for code, at_m in zip(CODES, AT_M, strict=True):
        tag = {"code": code, "codebook_id": None, "chainage_m": at_m, "offset_m": 0.0}
        answer = client.post("/v1/markers", json={"family": "magnet", "lane": lane, "status": "active", "tag": tag})
        assert answer.status_code == 201, answer.text
        ids.append(answer.json()["id"])
    return ids


def _trace(road: Road, seed: int, *, wrong_way: bool = False, faults: bool = True) -> bytes:
    """What a bar records: one tag is gone, one lies 2 m further on, one was installed in reverse."""
    placed = []
    for number, (code, at_m) in enumerate(zip(CODES, AT_M, strict=True)):
        if faults and number == MISSING:
            continue
        tag = _tag(code).reversed_wrong_way() if faults and number == REVERSED else _tag(code)
        placed.append(PlacedTag(tag, at_m + (MOVED_M if faults and number == MOVED else 0.0), 0.0))
    if wrong_way:
        placed = [replace(one, chainage_m=LENGTH_M - one.chainage_m - one.tag.length_m) for one in reversed(placed)]
    scene = Scene(road, Vehicle.compact(), Course(speed_m_s=13.0), tags=placed, wrong_way=wrong_way)
    return _zipped(write_recorder_files(simulate_drive(scene, np.random.default_rng(seed)).trace))


def _context(road: Road, hour: int, origin: Origin = ORIGIN) -> dict[str, Any]:
    lon, lat = _lon_lat(road, LENGTH_M / 2, origin)
    near = {"lon_deg": lon, "lat_deg": lat, "accuracy_m": 150.0}
    return {"coarse_position": near, "trace": {}, "captured_at": (BEGAN + timedelta(hours=hour)).isoformat()}


def test_tags_with_faults_are_found_by_the_traces_of_several_vehicles(server: LiveServer, road: Road) -> None:
    name = "health by traces"
    traces = [_trace(road, seed) for seed in (1, 2)]
    with server.agency(name, Scope.ADMIN) as owner:
        ids = _register_tags(owner, road)
        first = _post(owner, traces[0], _context(road, 0))
        assert len(first["tags"]) == len(CODES) - 1
        for hour in range(1, 4):
            _post(owner, traces[hour % 2], _context(road, hour))
        assert _found(owner) == set()  # however often one vehicle passes
        wanted = {("missing", ids[MISSING]), ("moved", ids[MOVED]), ("wrong-way", ids[REVERSED])}
        passed = 0
        while _found(owner) != wanted:
            passed += 1
            assert passed <= MANY, _found(owner)
            with server.agency(name, Scope.VEHICLE) as vehicle:
                _post(vehicle, traces[passed % 2], _context(road, 10 + passed))
            assert _found(owner) <= wanted
            if passed == 5:
                assert _found(owner) >= wanted - {("missing", ids[MISSING])}
        moved = next(item for item in owner.get("/v1/maintenance").json()["items"] if item["what"] == "moved")
        assert moved["evidence"]["offset_m"] == pytest.approx(MOVED_M, abs=0.3)
        assert {owner.get(f"/v1/markers/{marker_id}").json()["status"] for marker_id in ids} == {"active"}


def test_a_driver_on_the_wrong_way_is_an_item_and_accuses_no_tag(server: LiveServer, road: Road) -> None:
    with server.agency("wrong way by traces", Scope.ADMIN) as owner:
        _register_tags(owner, road, ELSEWHERE)
        _post(owner, _trace(road, 3, faults=False), _context(road, 0, ELSEWHERE))
        assert _found(owner) == set()
        _post(owner, _trace(road, 4, faults=False, wrong_way=True), _context(road, 1, ELSEWHERE))
        assert {what for what, _marker in _found(owner)} == {"wrong-way-driver"}


# --- CERPMs -----------------------------------------------------------------------------------------------------------


def _log(built: BuiltLane, installed: InstalledMarkers, hour: int) -> bytes:
    """What a vehicle hears: every hour markers go on counting their messages."""
    heard = drive_past(
        built.lane, installed, np.random.default_rng(hour % 2), radio=Radio(interval_s=1.0),
        sign=lambda message: encode_message(message, built.keys[message.number]),
        start_s=BEGAN.timestamp() + 3600.0 * hour, first_sequence=np.full(len(installed), 3600 * hour),
    )  # fmt: skip
    return _zipped({
        "packets.jsonl": write_packets(heard.packets).encode(), "poses.csv": write_poses(heard.track).encode(),
    })  # fmt: skip


def test_a_cerpm_that_claims_another_place_is_found_by_the_logs_of_several_vehicles(server: LiveServer) -> None:
    name = "health by packets"
    with server.agency(name, Scope.ADMIN) as owner:
        built = build_lane(owner, np.random.default_rng(1901))
        ids = {int(marker["code"]["number"]): marker["id"] for marker in built.markers}
        row = len(built.installed) // 2
        moved = move_claim(built.lane, built.installed, row, np.random.default_rng(1))
        for hour in range(4):
            _post(owner, _log(built, moved, hour), {"packets": {}})
        assert _found(owner) == set()  # however often one vehicle passes
        for hour in range(4, 10):
            with server.agency(name, Scope.VEHICLE) as vehicle:
                _post(vehicle, _log(built, moved, hour), {"packets": {}})
        assert _found(owner) == {("moved", ids[int(built.installed.number[row])])}
