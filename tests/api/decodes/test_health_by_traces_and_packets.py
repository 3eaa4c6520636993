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

from app.demo.cerpms import BuiltLane, build_lane, load_lane, register_lane
from app.encoders.cerpm import encode_message
from app.geodesy import wgs84_from_enu
from app.markers.magnet import InformationTag, parse_tag
from app.planning.cerpm_placement import place_markers
from app.services.access.access import Scope
from app.simulation.magnetic.drive import Course, Scene, Vehicle, simulate_drive
from app.simulation.magnetic.recorder import write_recorder_files
from app.simulation.magnetic.road import PlacedTag, Road
from app.simulation.radio.attacks import move_claim
from app.simulation.radio.drive import Driver, drive_lane, drive_past, write_packets, write_poses
from app.simulation.radio.lanes import InstalledMarkers, install_markers, lane_between
from app.simulation.radio.link import Radio
from tests.api.decodes.conftest import post_frame
from tests.api.decodes.test_health import _check_recomputed
from tests.conftest import LiveServer

pytestmark = pytest.mark.slow

CODES = (
    "SNS_4_0.1_10-30", "NNS_4_0.1_15-25", "SSN_4_0.1_30-10", "NSN_4_0.1_12-28", "SNN_4_0.1_25-15", "SNS_4_0.1_16-24",
    "NNS_4_0.1_22-18", "SSN_4_0.1_13-27",
)  # fmt: skip
AT_M = tuple(25.0 * number for number in range(1, 9))
CLONED, MISSING, MOVED, REVERSED, FADING, FAR = 0, 1, 2, 4, 5, 6
LENGTH_M, MOVED_M, CLONE_AT_M, FAR_AT_M, FADED_SHARE = 215.0, 2.0, 137.0, 87.0, 0.75
SPEED_M_S = 20.0
Origin = tuple[float, float, float]
ORIGIN, ELSEWHERE = (31.0, 47.0, 100.0), (33.0, 47.0, 100.0)
BEGAN = datetime(2026, 6, 1, 8, tzinfo=UTC)
NORTH_M, FEW = 1.2, 12
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
    """What a bar records of tags of which one is gone, one lies 2 m further on, one 88 m from its place, one was
    installed in reverse, one has a copy 112 m away, and the magnets of one are weak.
    """
    at_m, tags = list(AT_M), [_tag(code) for code in CODES]
    if faults:
        at_m[MOVED], at_m[FAR] = AT_M[MOVED] + MOVED_M, FAR_AT_M
        tags[REVERSED] = tags[REVERSED].reversed_wrong_way()
    placed = [PlacedTag(tag, at, 0.0) for tag, at in zip(tags, at_m, strict=True)]
    if faults:
        placed[MISSING] = PlacedTag(tags[CLONED], CLONE_AT_M, 0.0)
    if wrong_way:
        placed = [replace(one, chainage_m=LENGTH_M - one.chainage_m - one.tag.length_m) for one in reversed(placed)]
    scene = Scene(road, Vehicle.compact(), Course(speed_m_s=SPEED_M_S), tags=placed, wrong_way=wrong_way)
    drive = simulate_drive(scene, np.random.default_rng(seed))
    if faults:  # the same drive over weak magnets, while it passes one of the tags
        weak = simulate_drive(replace(scene, moment_am2=FADED_SHARE * scene.moment_am2), np.random.default_rng(seed))
        passed_s = [magnet.t_s for magnet in drive.magnets if magnet.tag == FADING]
        near = (drive.trace.t_s > min(passed_s) - 0.3) & (drive.trace.t_s < max(passed_s) + 0.3)
        drive.trace.field_ut[near] = weak.trace.field_ut[near]
    return _zipped(write_recorder_files(drive.trace))


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
        assert len(first["tags"]) == len(CODES)
        for hour in range(1, 4):
            _post(owner, traces[hour % 2], _context(road, hour))
        assert _found(owner) == set()  # however often one vehicle passes
        faults = {"cloned": CLONED, "missing": MISSING, "wrong-way": REVERSED, "fading": FADING}
        wanted = {(what, ids[number]) for what, number in faults.items()}
        wanted |= {("moved", ids[MOVED]), ("moved", ids[FAR])}
        passed = 0
        while _found(owner) != wanted:
            passed += 1
            assert passed <= MANY, _found(owner)
            with server.agency(name, Scope.VEHICLE) as vehicle:
                _post(vehicle, traces[passed % 2], _context(road, 10 + passed))
            assert _found(owner) <= wanted
            if passed == 5:
                assert _found(owner) >= wanted - {("missing", ids[MISSING])}
        items = {item["marker_id"]: item for item in owner.get("/v1/maintenance").json()["items"]}
        assert items[ids[MOVED]]["evidence"]["offset_m"] == pytest.approx(MOVED_M, abs=0.3)
        seen = items[ids[FAR]]["evidence"]
        there = _lon_lat(road, FAR_AT_M)
        assert (seen["elsewhere_lon_deg"], seen["elsewhere_lat_deg"]) == pytest.approx(there, abs=5e-5)
        assert {owner.get(f"/v1/markers/{marker_id}").json()["status"] for marker_id in ids} == {"active"}
        decided = owner.post(f"/v1/maintenance/{items[ids[FAR]]['id']}/approve", json={"outcome": "suspect"})
        assert decided.status_code == 200, decided.text
        assert owner.get(f"/v1/markers/{ids[FAR]}").json()["status"] == "suspect"
        assert owner.get(f"/v1/markers/{ids[FAR]}/health").json()["ratios"] == {}


def test_a_driver_on_the_wrong_way_is_an_item_and_accuses_no_tag(server: LiveServer, road: Road) -> None:
    with server.agency("wrong way by traces", Scope.ADMIN) as owner:
        _register_tags(owner, road, ELSEWHERE)
        _post(owner, _trace(road, 3, faults=False), _context(road, 0, ELSEWHERE))
        assert _found(owner) == set()
        _post(owner, _trace(road, 4, faults=False, wrong_way=True), _context(road, 1, ELSEWHERE))
        assert {what for what, _marker in _found(owner)} == {"wrong-way-driver"}


# --- CERPMs -----------------------------------------------------------------------------------------------------------


def _log(
    built: BuiltLane, installed: InstalledMarkers, hour: int, *, wrong_way: bool = False, seed: int | None = None
) -> bytes:
    """What a vehicle hears: every hour markers go on counting their messages. Of two with one number one is ahead."""
    rng = np.random.default_rng(hour % 2 if seed is None else seed)
    lane, start_s = built.lane, BEGAN.timestamp() + 3600.0 * hour
    first_sequence = np.full(len(installed), 3600 * hour)
    first_sequence[-1] += 5
    against = lane_between(lane.right_m[::-1], lane.left_m[::-1], lane.origin)
    heard = drive_past(
        lane, installed, rng, radio=Radio(interval_s=1.0), start_s=start_s, first_sequence=first_sequence,
        sign=lambda message: encode_message(message, built.keys[message.number]),
        drive=drive_lane(against, Driver(), rng, start_s=start_s) if wrong_way else None,
    )  # fmt: skip
    return _zipped({
        "packets.jsonl": write_packets(heard.packets).encode(), "poses.csv": write_poses(heard.track).encode(),
    })  # fmt: skip


def test_cerpms_with_faults_are_found_by_the_logs_of_several_vehicles(server: LiveServer) -> None:
    """One sends another place, one is gone, one was registered 5 km away, and the number of one is sent by two."""
    name = "health by packets"
    with server.agency(name, Scope.ADMIN) as owner:
        built = build_lane(owner, np.random.default_rng(1901))
        count, numbers = len(built.installed), built.installed.number
        ids = {int(marker["code"]["number"]): marker["id"] for marker in built.markers}
        moved, missing, far, cloned, copy = (count * k // 6 for k in range(1, 6))
        place = {"lon_deg": 8.4, "lat_deg": 49.1, "horizontal_rmse_m": 0.03, "realization": "ITRF2014", "epoch": 2026.4}
        path, unchanged = f"/v1/markers/{ids[int(numbers[far])]}", {"If-Match": '"1"'}
        answer = owner.patch(path, json={"position": place}, headers=unchanged)
        assert answer.status_code == 200, answer.text
        installed = move_claim(built.lane, built.installed, moved, np.random.default_rng(1))
        installed = installed.chosen(np.array([row for row in [*range(count), copy] if row != missing]))
        installed.number[-1] = numbers[cloned]
        found = {(what, ids[int(numbers[row])]) for what, row in (("moved", moved), ("moved", far), ("cloned", cloned))}
        wanted = {*found, ("missing", ids[int(numbers[missing])])}
        for hour in range(4):
            _post(owner, _log(built, installed, hour), {"packets": {}})
        assert _found(owner) == set()  # however often one vehicle passes
        hour = 4
        while _found(owner) != wanted:
            assert hour < MANY, _found(owner)
            with server.agency(name, Scope.VEHICLE) as vehicle:
                _post(vehicle, _log(built, installed, hour), {"packets": {}})
            assert _found(owner) <= wanted
            hour += 1
        _post(owner, _log(built, built.installed, hour, wrong_way=True), {"packets": {}})
        drivers = owner.get("/v1/maintenance", params={"what": "wrong-way-driver"}).json()["items"]
        assert [driver["family"] for driver in drivers] == ["cerpm"]


def test_a_survey_in_another_datum_is_found_by_the_logs_of_several_vehicles(server: LiveServer) -> None:
    """All markers are registered and programmed 1.2 m north of where they are."""
    name = "health of stretches"
    with server.agency(name, Scope.ADMIN) as owner:
        rng, lane = np.random.default_rng(1902), load_lane()
        installed = install_markers(lane, place_markers(lane.left_m, lane.right_m), rng)
        built = register_lane(owner, lane, replace(installed, lat_deg=installed.lat_deg + NORTH_M / 111_200.0))
        for hour in range(3):
            _post(owner, _log(built, built.installed, hour, seed=hour), {"packets": {}})
        assert _found(owner) == set()  # however often one vehicle passes
        hour = 3
        while not owner.get("/v1/maintenance").json()["items"]:
            assert hour < FEW, "not found"
            with server.agency(name, Scope.VEHICLE) as vehicle:
                _post(vehicle, _log(built, built.installed, hour, seed=hour), {"packets": {}})
            hour += 1
        items = owner.get("/v1/maintenance").json()["items"]
        assert {(item["what"], item["family"], item["marker_id"]) for item in items} == {("shifted", "cerpm", None)}
        assert all(item["vehicles"] >= 3 for item in items)
        # each stretch shows the part of the shift that is across it
        evidence = max((item["evidence"] for item in items), key=lambda one: one["offset_north_m"])
        assert evidence["offset_north_m"] == pytest.approx(NORTH_M, abs=0.4)
        assert evidence["offset_sigma_m"] < 0.3
        assert evidence["directions"] == 1
        assert "datum" in evidence["check"]
        _check_recomputed(server, owner)
        answer = owner.post(f"/v1/maintenance/{items[0]['id']}/approve", json={"outcome": "none"})
        assert answer.status_code == 200, answer.text
        with server.agency(name, Scope.VEHICLE) as vehicle:
            _post(vehicle, _log(built, built.installed, hour, seed=hour), {"packets": {}})
        again = owner.get("/v1/maintenance", params={"status": "open"}).json()["items"]
        assert items[0]["id"] not in {item["id"] for item in again}  # the test begins again
        assert len(again) == len(items) - 1
