"""Details of decodes: samples of traces, packets of logs, the vehicle's track, lists of readings, their filters."""

from __future__ import annotations

import csv
import io
import itertools
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from app.demo.cerpms import BuiltLane, build_lane
from app.services.access.access import Scope
from app.simulation.magnetic.recorder import write_recorder_files
from app.simulation.radio.attacks import forge_packets, number_entries
from tests.api.decodes import test_packets, test_traces
from tests.api.decodes.conftest import near, post_frame
from tests.api.decodes.test_archives import wait_for
from tests.api.decodes.videos import DECLARED, video_past
from tests.conftest import LiveServer
from tests.formats.pictures import corner_frame, png

_AGENCIES = itertools.count(1)
CAPTURED_S = datetime(2026, 5, 4, 8, 30, tzinfo=UTC).timestamp()
CAMERA = {"height_m": 1.4, "horizontal_fov_deg": 70}
GPX = {"g": "http://www.topografix.com/GPX/1/1"}


@pytest.fixture(scope="module")
def agency(server: LiveServer) -> Iterator[httpx.Client]:
    """An agency of its own, whose drives are decoded once for all tests."""
    with server.agency(f"details {next(_AGENCIES)}", Scope.ADMIN) as client:
        yield client


@pytest.fixture(scope="module")
def trace(agency: httpx.Client) -> dict[str, Any]:
    """A drive over three registered tags."""
    place = test_traces.Place(agency)
    drive = test_traces._drive()
    context = place.context | {"captured_at": "2026-05-04T08:30:00Z"}
    answer = post_frame(agency, test_traces._zipped(write_recorder_files(drive.trace)), context, name="drive.zip")
    assert answer.status_code == 201, answer.text
    document: dict[str, Any] = answer.json()
    return document


@pytest.fixture(scope="module")
def road(agency: httpx.Client) -> BuiltLane:
    """CERPMs along a lane."""
    return build_lane(agency, np.random.default_rng(1901))


@pytest.fixture(scope="module")
def log(agency: httpx.Client, road: BuiltLane) -> dict[str, Any]:
    """A drive past them."""
    heard, _hour = test_packets.drive(road, 1902)
    return test_packets.decoded(agency, test_packets.packed(heard))


def _rows(answer: httpx.Response) -> list[dict[str, str]]:
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"].startswith("text/csv")
    return list(csv.DictReader(io.StringIO(answer.text)))


# --- samples ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_all_samples_of_a_trace_or_the_extremes_of_groups(agency: httpx.Client, trace: dict[str, Any]) -> None:
    whole = agency.get(trace["links"]["samples"]).json()
    assert [series["name"] for series in whole["series"]] == ["vertical", "forward"]
    assert (whole["samples"], whole["thinned"]) == (trace["report"]["samples"], False)
    assert len(whole["t_s"]) == len(whole["series"][0]["values"]) == whole["samples"]
    thin = agency.get(trace["links"]["samples"], params={"points": 400, "series": "vertical"}).json()
    assert thin["thinned"]
    assert len(thin["t_s"]) <= 400
    assert thin["t_s"] == sorted(thin["t_s"])
    assert max(thin["series"][0]["values"]) == max(whole["series"][0]["values"])  # no peak is lost
    peak_s = whole["t_s"][int(np.argmax(whole["series"][0]["values"]))]
    assert min(abs(magnet["t_s"] - peak_s) for magnet in trace["magnets"]) < 0.2


def test_a_stretch_of_one_sensor(agency: httpx.Client, trace: dict[str, Any]) -> None:
    from_s, to_s = trace["tags"][0]["start_s"], trace["tags"][0]["end_s"]
    parameters = {"series": ["s3_z", "s3_x"], "from_s": from_s, "to_s": to_s}
    found = agency.get(trace["links"]["samples"], params=parameters).json()
    assert {series["name"] for series in found["series"]} == {"s3_z", "s3_x"}
    assert from_s <= found["t_s"][0] < found["t_s"][-1] <= to_s
    assert {"vertical", "s1_x", "s14_z"} <= set(found["available"])
    nothing = agency.get(trace["links"]["samples"], params={"from_s": 1e6}).json()
    assert (nothing["samples"], nothing["t_s"]) == (0, [])


@pytest.mark.parametrize(
    ("parameters", "status", "field"),
    [
        ({"series": "s99_x"}, 422, "series"),
        ({"series": [f"s{k}_x" for k in range(1, 9)]}, 422, "series"),
        ({"points": 1}, 422, "points"),
        ({"from_s": 5, "to_s": 2}, 422, "from_s"),
        ({"from_s": "nan"}, 422, "from_s"),
    ],
)
def test_bad_questions_about_samples_are_refused(
    agency: httpx.Client, trace: dict[str, Any], parameters: dict[str, Any], status: int, field: str
) -> None:
    answer = agency.get(trace["links"]["samples"], params=parameters)
    assert answer.status_code in (400, status), answer.text
    problem = answer.json()
    assert field in str(problem.get("field") or problem["errors"])


def test_only_traces_have_samples_and_only_logs_have_packets(
    agency: httpx.Client, trace: dict[str, Any], log: dict[str, Any]
) -> None:
    for decode, part in ((log, "samples"), (trace, "packets")):
        answer = agency.get(f"/v1/decodes/{decode['id']}/{part}")
        assert answer.status_code == 404
        assert answer.json()["field"] == "decode_id"


def test_others_see_nothing_of_a_decode(server: LiveServer, trace: dict[str, Any]) -> None:
    with server.agency(f"strangers {next(_AGENCIES)}") as stranger:
        for part in ("samples", "track.gpx", "readings.csv"):
            assert stranger.get(f"/v1/decodes/{trace['id']}/{part}").status_code == 404


# --- the vehicle's way --------------------------------------------------------------------------------------------


def test_the_way_over_tags_goes_through_their_fixes(agency: httpx.Client, trace: dict[str, Any]) -> None:
    (line,) = agency.get(trace["links"]["track"]).json()["features"]
    properties = line["properties"]
    assert (line["geometry"]["type"], properties["clock"]) == ("LineString", "utc")
    assert properties["times"][0].startswith("2026-05-04T08:30:0")
    assert properties["time_s"] == sorted(properties["time_s"])
    places = dict(zip(properties["time_s"], line["geometry"]["coordinates"], strict=True))
    for tag in trace["tags"]:
        time_s = CAPTURED_S + tag["fix"]["t_s"] - trace["motion"]["start_s"]
        reckoned = np.array([places[moment] for moment in sorted(places, key=lambda m: abs(m - time_s))[:3]])
        off_m = np.abs(reckoned - [tag["fix"]["lon_deg"], tag["fix"]["lat_deg"]]).max() * 111_000
        assert off_m < 3.0  # 12 m/s, and a point every 0.1 s
    rows = _rows(agency.get(f"/v1/decodes/{trace['id']}/track.csv"))
    assert len(rows) == len(properties["time_s"])
    assert {row["source"] for row in rows} == {"motion", "fix"}
    gpx = ET.fromstring(agency.get(f"/v1/decodes/{trace['id']}/track.gpx").text)
    points = gpx.findall(".//g:trkpt", GPX)
    assert len(points) == len(rows)
    assert points[0].findtext("g:time", None, GPX) == properties["times"][0]


def test_a_decode_without_positions_has_no_track(agency: httpx.Client) -> None:
    decode = post_frame(agency, png(corner_frame())).json()
    assert agency.get(decode["links"]["track"]).json()["features"] == []
    answer = agency.get(f"/v1/decodes/{decode['id']}/track.gpx")
    assert answer.status_code == 404
    assert "coarse_position" in answer.json()["cure"]


# --- readings -----------------------------------------------------------------------------------------------------


def test_readings_of_a_trace_lead_to_their_markers(agency: httpx.Client, trace: dict[str, Any]) -> None:
    features = agency.get(trace["links"]["readings"]).json()["features"]
    found = [feature["properties"] for feature in features]
    assert [row["marker_id"] for row in found] == [tag["match"]["marker_id"] for tag in trace["tags"]]
    assert all(row["family"] == "magnet" and row["registered"] for row in found)
    assert features[0]["geometry"]["type"] == "Point"
    rows = _rows(agency.get(f"/v1/decodes/{trace['id']}/readings.csv"))
    assert [row["code"] for row in rows] == [tag["tag"] for tag in trace["tags"]]


def test_packets_have_time_strength_verdict_and_place(agency: httpx.Client, log: dict[str, Any]) -> None:
    packets = agency.get(log["links"]["packets"]).json()
    columns = {name: values for name, values in packets.items() if isinstance(values, list)}
    assert {len(values) for values in columns.values()} == {packets["total"]} == {log["report"]["packets"]}
    assert packets["time_s"] == sorted(packets["time_s"])
    assert set(packets["verdict"]) == {"accepted"}
    numbers = {marker["number"] for marker in log["markers"]}
    assert set(packets["number"]) == numbers
    best = {marker["number"]: marker["best_rssi_dbm"] for marker in log["markers"]}
    strongest = max(
        rssi for number, rssi in zip(packets["number"], packets["rssi_dbm"], strict=True) if number == min(numbers)
    )
    assert strongest == pytest.approx(best[min(numbers)], abs=0.02)
    assert sum(value is not None for value in packets["lon_deg"]) > 0.9 * packets["total"]
    assert len(packets["track"]["time_s"]) == len(packets["track"]["heading_deg"]) > 100
    rows = _rows(agency.get(f"/v1/decodes/{log['id']}/track.csv"))
    assert {row["source"] for row in rows} == {"receiver"}


def test_refused_packets_say_why(agency: httpx.Client, road: BuiltLane) -> None:
    heard, _hour = test_packets.drive(road, 1903)
    rng = np.random.default_rng(1)
    forged = forge_packets(heard.packets, 20, rng)
    packets = number_entries([*heard.packets, *forged])
    attacked = test_packets.decoded(agency, test_packets.packed(heard, packets))
    columns = agency.get(attacked["links"]["packets"]).json()
    refused = [k for k, verdict in enumerate(columns["verdict"]) if verdict != "accepted"]
    assert len(refused) == 20
    assert {columns["verdict"][k] for k in refused} <= {"forged", "corrupt", "unknown-marker", "wrong-key"}
    assert all(columns["reason"][k] for k in refused)


# --- frames -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_frame_of_a_video_is_a_picture(client: httpx.Client, plate: dict[str, Any]) -> None:
    data = video_past(plate["code"])
    context = near(plate, camera=DECLARED, captured_at="2026-05-04T08:30:00Z")
    decode = wait_for(client, post_frame(client, data, context, name="drive.mp4").headers["location"])
    assert decode["file_name"] == "drive.mp4"
    assert decode["upload_bytes"] == len(data)
    number = decode["frames"][-1]["frame"]
    path = f"/v1/decodes/{decode['id']}/annotated.png"
    plain, drawn = (
        cv2.imdecode(np.frombuffer(client.get(path, params={"frame": number, "outlines": on}).content, np.uint8), 1)
        for on in ("false", "true")
    )
    assert plain.shape == drawn.shape == (540, 960, 3)
    (corners,) = [reading["corners_px"] for reading in decode["readings"] if reading["frame"] == number]
    inside = np.zeros(plain.shape[:2], np.uint8)
    cv2.fillPoly(inside, [np.array(corners).round().astype(np.int32)], 1)
    assert plain[inside > 0].std() > 30  # the plate is where its corners are
    changed = np.abs(plain.astype(int) - drawn).max(axis=2) > 20
    assert changed.any()
    assert client.get(decode["links"]["annotated"]).status_code == 200
    answer = client.get(path, params={"frame": 400_000})
    assert answer.status_code == 404
    assert answer.json()["field"] == "frame"
    rows = _rows(client.get(f"/v1/decodes/{decode['id']}/readings.csv"))
    assert {row["marker_id"] for row in rows if row["outcome"] == "read"} == {plate["id"]}
    assert rows[0]["time"].startswith("2026-05-04T08:30:00")


# --- lists --------------------------------------------------------------------------------------------------------


def test_decodes_are_listed_by_kind_vehicle_and_time(
    agency: httpx.Client, trace: dict[str, Any], log: dict[str, Any]
) -> None:
    vehicle = agency.post("/v1/vehicles", json={"name": "VAN-1", "profile": {"camera": CAMERA}}).json()
    own = post_frame(agency, png(corner_frame()), {"vehicle": "VAN-1"}, name="frame.png").json()
    assert own["file_name"] == "frame.png"

    def ids(**parameters: str) -> set[str]:
        answer = agency.get("/v1/decodes", params=parameters)
        assert answer.status_code == 200, answer.text
        return {item["id"] for item in answer.json()["items"]}

    assert trace["id"] in ids(kind="trace")
    assert log["id"] not in ids(kind="trace")
    assert ids(vehicle="VAN-1") == ids(vehicle=vehicle["id"]) == {own["id"]}
    assert trace["id"] in ids(since="2020-01-01T00:00:00Z", until="2100-01-01T00:00:00Z")
    assert ids(until="2020-01-01T00:00:00Z") == ids(since="2100-01-01T00:00:00Z") == set()
    assert agency.get("/v1/decodes", params={"kind": "song"}).status_code in (400, 422)
    assert agency.get("/v1/decodes", params={"since": "yesterday"}).status_code in (400, 422)
