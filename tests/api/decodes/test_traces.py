"""Magnetometer traces over HTTP: registered tags, a simulated drive as the recorder's own files, and bad input."""

from __future__ import annotations

import io
import itertools
import json
import math
import zipfile
from collections.abc import Iterator, Sequence
from typing import Any

import httpx
import numpy as np
import pytest

from app.geodesy import enu_from_wgs84, wgs84_from_enu
from app.markers.magnet import InformationTag, Polarity, parse_tag
from app.services.decodes.context import DecodeRules
from app.simulation.magnetic.drive import Course, Scene, SimulatedDrive, Vehicle, simulate_drive
from app.simulation.magnetic.recorder import CanBus, write_array_stream, write_recorder_files
from app.simulation.magnetic.road import PlacedTag, Road, line_magnets
from tests.api.decodes.conftest import post_frame
from tests.conftest import LiveServer
from tests.http import finished, refused

_PLACES = itertools.count()
_CODES = ("SNS_4_0.1_10-30", "NNS_4_0.1_15-25", "SSN_4_0.1_30-10")
_AT_M = (45.0, 65.0, 85.0)
LENGTH_M = 110.0
_HEAP = {"sensors": [{"position_m": [0.0, 0.0, 0.0]}] * 3}


def _tag(code: str) -> InformationTag:
    tag = parse_tag(code)
    assert isinstance(tag, InformationTag)
    return tag


def _drive(
    seed: int = 1, *, wrong_way: bool = False, road: Road | None = None, codes: Sequence[str] = _CODES, **scene: Any
) -> SimulatedDrive:
    tags = [PlacedTag(_tag(code), at, 0.05) for code, at in zip(codes, _AT_M, strict=True)]
    return simulate_drive(
        Scene(
            road or Road(LENGTH_M), Vehicle.compact(), Course(speed_m_s=12.0), tags=tags, wrong_way=wrong_way, **scene
        ),
        np.random.default_rng(seed),
    )


def _zipped(files: dict[str, bytes]) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return packed.getvalue()


class Place:
    """A lane somewhere on earth that is the simulation's road, with its tags registered."""

    def __init__(self, client: httpx.Client, codes: Sequence[str] = _CODES, codebook_id: str | None = None) -> None:
        self.client = client
        self.road = Road(LENGTH_M)
        self.origin = (-80.0 + next(_PLACES) * 0.7, 42.0, 100.0)
        lane = [self._lon_lat(s) for s in np.arange(0.0, LENGTH_M + 1, 10.0)]
        self.ids = []
        for code, at in zip(codes, _AT_M, strict=True):
            body = {
                "family": "magnet",
                "lane": {
                    "geometry": {"type": "LineString", "coordinates": lane},
                    "height_m": self.origin[2],
                    "realization": "ITRF2014",
                    "epoch": 2025.0,
                    "horizontal_rmse_m": 0.01,
                },
                "status": "surveyed",
                "tag": {"code": code, "codebook_id": codebook_id, "chainage_m": at, "offset_m": 0.05},
            }
            answer = client.post("/v1/markers", json=body)
            assert answer.status_code == 201, answer.text
            self.ids.append(answer.json()["id"])

    def _lon_lat(self, chainage_m: float) -> list[float]:
        east, north = self.road.world_m(np.array([chainage_m]))[0]
        lon, lat, _ = wgs84_from_enu(np.array([east, north, 0.0]), self.origin)
        return [lon, lat]

    @property
    def context(self) -> dict[str, Any]:
        lon, lat = self._lon_lat(50.0)
        return {"coarse_position": {"lon_deg": lon, "lat_deg": lat, "accuracy_m": 50.0}, "trace": {}}

    def across_along_m(self, fix: dict[str, Any], chainage_m: float) -> tuple[float, float]:
        """Place of a fix against the lane's centre at a chainage, left and ahead positive."""
        east, north, _ = enu_from_wgs84(fix["lon_deg"], fix["lat_deg"], self.origin[2], self.origin)
        yaw = float(self.road.yaw_rad(np.array([chainage_m]))[0])
        off = np.array([east, north]) - self.road.world_m(np.array([chainage_m]))[0]
        return float(off @ [-math.sin(yaw), math.cos(yaw)]), float(off @ [math.cos(yaw), math.sin(yaw)])


@pytest.fixture(scope="module")
def client(server: LiveServer) -> Iterator[httpx.Client]:
    """A client of an agency of its own; traces need no decoder of plates."""
    with server.agency("traces agency") as agency:
        yield agency


@pytest.fixture(scope="module")
def place(client: httpx.Client) -> Place:
    """Tags on a lane."""
    return Place(client)


@pytest.mark.slow
def test_a_drive_over_registered_tags_gives_tuples_matches_and_fixes(client: httpx.Client, place: Place) -> None:
    drive = _drive()
    answer = post_frame(client, _zipped(write_recorder_files(drive.trace)), place.context, name="drive.zip")
    assert answer.status_code == 201, answer.text
    decode = answer.json()
    assert decode["kind"] == "trace"
    assert [tag["tag"] for tag in decode["tags"]] == list(_CODES)
    assert [tag["match"]["marker_id"] for tag in decode["tags"]] == place.ids
    assert {tag["direction"] for tag in decode["tags"]} == {"legal"}
    assert decode["summary"]["magnets"] == 9
    assert any("steering" in warning for warning in decode["report"]["warnings"])
    for number, tag in enumerate(decode["tags"]):
        last = [m for m in drive.magnets if m.tag == number][-1]
        fix = tag["fix"]
        across_m, along_m = place.across_along_m(fix, _AT_M[number] + 4.0)
        true_across_m = 0.05 - last.lateral_cm / 100
        assert abs(across_m - true_across_m) < 0.03
        assert abs(along_m) < 0.03
        assert abs(along_m) < 4 * fix["sigma"]["along_m"]
        assert abs(fix["t_s"] - last.t_s) < 0.005
        assert fix["localization_grade"] == "cm"
        assert abs((fix["heading_deg"] - 30.0 + 180) % 360 - 180) < 1.0
    stored = client.get(f"/v1/decodes/{decode['id']}").json()
    assert stored["tags"] == decode["tags"]
    plot = client.get(decode["links"]["plot"])
    assert plot.headers["content-type"].startswith("image/svg+xml")
    assert plot.text.count("<circle") + plot.text.count('z" fill=') == 9
    assert all(code in plot.text for code in _CODES)


@pytest.mark.slow
def test_the_wrong_way_is_flagged_and_turns_the_heading(client: httpx.Client, place: Place) -> None:
    tags = [PlacedTag(_tag(code), LENGTH_M - at - 4.0, -0.05) for code, at in zip(_CODES, _AT_M, strict=True)]
    scene = Scene(Road(LENGTH_M), Vehicle.compact(), Course(speed_m_s=12.0), tags=tags, wrong_way=True)
    drive = simulate_drive(scene, np.random.default_rng(5))
    answer = post_frame(client, _zipped(write_recorder_files(drive.trace)), place.context, name="drive.zip")
    decode = answer.json()
    assert [tag["direction"] for tag in decode["tags"]] == ["wrong-way"] * 3
    assert "WRONG WAY" in decode["summary"]["text"]
    assert {tag["match"]["marker_id"] for tag in decode["tags"]} == set(place.ids)
    for tag in decode["tags"]:
        assert abs((tag["fix"]["heading_deg"] - 210.0 + 180) % 360 - 180) < 1.0


@pytest.mark.slow
def test_lines_that_are_crossed_are_departures(client: httpx.Client) -> None:
    lines = line_magnets(40, 80, 5.0, 0.6, Polarity.S) + line_magnets(90, 105, 5.0, -0.7, Polarity.N)
    scene = Scene(Road(LENGTH_M), Vehicle.compact(), Course(speed_m_s=12.0), lines=lines)
    drive = simulate_drive(scene, np.random.default_rng(6))
    decode = post_frame(client, _zipped(write_recorder_files(drive.trace)), {"trace": {}}, name="drive.zip").json()
    assert [(c["style"], c["side"]) for c in decode["crossings"]] == [("dashed", "left"), ("solid", "right")]
    assert decode["tags"] == []
    assert decode["fix"] is None


@pytest.mark.slow
def test_the_stream_is_resynchronised_and_says_so(client: httpx.Client, place: Place) -> None:
    drive = _drive(7)
    stream = bytearray(write_array_stream(drive.trace))
    middle = 172 * int(np.searchsorted(drive.trace.t_s, 1.0)) + 61
    del stream[middle : middle + 300]
    context = {**place.context, "trace": {"speed_m_s": 12.0, "rate_hz": 350.0}}
    answer = post_frame(client, bytes(stream), context, name="array.bin")
    assert answer.status_code == 201, answer.text
    report = answer.json()["report"]
    assert report["gap_count"] >= 1
    assert report["gaps"][0]["skipped_bytes"] > 0
    assert [tag["tag"] for tag in answer.json()["tags"]] == list(_CODES)


@pytest.mark.slow
def test_the_same_key_gets_the_same_answer(client: httpx.Client, place: Place) -> None:
    data = _zipped(write_recorder_files(_drive(8).trace))
    first = post_frame(client, data, place.context, name="drive.zip", **{"Idempotency-Key": "trace-1"})
    again = post_frame(client, data, place.context, name="drive.zip", **{"Idempotency-Key": "trace-1"})
    assert first.json()["id"] == again.json()["id"]
    assert again.headers["Idempotency-Replayed"] == "true"


@pytest.mark.slow
def test_a_long_recording_becomes_a_job(client: httpx.Client, place: Place) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
        for name, data in write_recorder_files(_drive(9).trace).items():
            archive.writestr(name, data)
        archive.writestr(
            "RawSWA_long.csv", ",Time Stamp,SWA\n" + "".join(f"{i},{i / 100},0.0\n" for i in range(600_000))
        )
    data = packed.getvalue()
    assert len(data) > DecodeRules().immediate_trace_bytes
    answer = post_frame(client, data, place.context, name="drive.zip")
    assert answer.status_code == 202, answer.text
    decode = finished(client, answer.headers["location"])
    assert decode["state"] == "done", decode["error"]
    assert [tag["tag"] for tag in decode["tags"]] == list(_CODES)
    assert client.get(decode["links"]["plot"]).status_code == 200


def _csv(drive: SimulatedDrive, *, speed: bool = True, scale: float = 1.0, backwards: bool = False) -> bytes:
    trace = drive.trace
    held = np.interp(trace.t_s, trace.speed_t_s, trace.speed_m_s)
    names = ["t_s", *(f"s{i}_{a}" for i in range(1, 15) for a in "xyz"), *(["speed_m_s"] if speed else [])]
    rows = np.column_stack([trace.t_s, scale * trace.field_ut.reshape(len(trace.t_s), -1), *([held] if speed else [])])
    if backwards:
        rows = rows[::-1]
    return (",".join(names) + "\n" + "\n".join(",".join(f"{v:.6g}" for v in row) for row in rows)).encode()


@pytest.mark.slow
def test_a_plain_csv_is_read_with_its_declaration(client: httpx.Client, place: Place) -> None:
    context = {**place.context, "trace": {"unit": "uT", "axes": "ISO8855"}}
    answer = post_frame(client, _csv(_drive(10)), context, name="trace.csv")
    assert answer.status_code == 201, answer.text
    assert [tag["tag"] for tag in answer.json()["tags"]] == list(_CODES)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("data", "trace", "status", "field"),
    [
        (lambda d: _csv(d), {}, 422, "unit"),
        (lambda d: _csv(d, speed=False), {"unit": "uT", "axes": "FLU"}, 422, "speed"),
        (lambda d: _csv(d, backwards=True), {"unit": "uT", "axes": "FLU"}, 422, ""),
        (lambda d: _csv(d).replace(b"s3_x", b"sensor3_x", 1), {"unit": "uT", "axes": "FLU"}, 422, "trace.csv"),
        (lambda d: b"", {}, 422, "file"),
        (lambda d: b"\x00" * 5000, {}, 415, "trace.csv"),
        (lambda d: _csv(d), {"unit": "uT", "axes": "FLU", "method": "guess"}, 422, "method"),
        (lambda d: _csv(d), {"unit": "tesla"}, 422, "unit"),
        (lambda d: _csv(d), {"unit": "uT", "axes": "FLU", "reach_m": 1e6}, 422, "reach_m"),
        (lambda d: _csv(d), {"unit": "uT", "axes": "FLU", "speed": 3}, 422, "speed"),
        (lambda d: _csv(d), {"unit": "uT", "axes": "FLU", "bar": _HEAP}, 422, "bar"),
        (lambda d: _zipped(write_recorder_files(d.trace))[:-2000], {}, 422, ""),
    ],
    ids=["no-unit", "no-speed", "backwards", "wrong-column", "empty", "zeros", "method", "unit", "reach", "unknown",
         "bar-of-three", "cut-zip"],
)  # fmt: skip
def test_bad_input_names_what_is_wrong_and_leaves_nothing(
    client: httpx.Client, data: Any, trace: dict[str, Any], status: int, field: str
) -> None:
    before = len(client.get("/v1/decodes?limit=1000").json()["items"])
    answer = post_frame(client, data(_drive(11)), {"trace": trace}, name="trace.csv")
    problem = refused(answer, status)
    assert field in problem.get("field", ""), problem
    assert problem["detail"]
    assert len(client.get("/v1/decodes?limit=1000").json()["items"]) == before


@pytest.mark.slow
def test_microtesla_declared_as_gauss_are_refused(client: httpx.Client, place: Place) -> None:
    context = {**place.context, "trace": {"unit": "gauss", "axes": "FLU"}}
    answer = post_frame(client, _csv(_drive(12)), context, name="trace.csv")
    problem = refused(answer, 422, field="unit")
    assert "uT" in problem["cure"]


@pytest.mark.slow
def test_frames_have_no_plot_and_traces_no_annotation(client: httpx.Client, place: Place) -> None:
    data = _zipped(write_recorder_files(_drive(13).trace))
    decode = post_frame(client, data, place.context, name="drive.zip").json()
    assert client.get(f"/v1/decodes/{decode['id']}/annotated.png").status_code == 404
    assert client.get(decode["links"]["plot"], headers={"If-None-Match": f'"{decode["id"]}-plot"'}).status_code == 304
    assert json.loads(client.get("/v1/decodes?limit=1").text)["items"][0]["kind"] == "trace"


@pytest.mark.slow
def test_a_wrong_scale_of_the_speed_does_not_move_the_fix(client: httpx.Client, place: Place) -> None:
    drive = _drive(14, can=CanBus(speed_scale=0.04))
    decode = post_frame(client, _zipped(write_recorder_files(drive.trace)), place.context, name="drive.zip").json()
    assert len(decode["tags"]) == 3
    for number, tag in enumerate(decode["tags"]):
        last = [m for m in drive.magnets if m.tag == number][-1]
        _across_m, along_m = place.across_along_m(tag["fix"], _AT_M[number] + 4.0)
        assert abs(along_m - (tag["fix"]["t_s"] - last.t_s) * last.speed_m_s) < 0.02
