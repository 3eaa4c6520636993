"""Drives over HTTP: decodes become one track, refusals name the decode, and others see nothing of it."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import httpx
import numpy as np
import pytest

from app.geodesy import wgs84_from_enu
from app.main import create_app
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.decodes import DecodeRow, add_decode
from app.registry.jobs import JobKind, add_job, new_job
from app.services.access.access import Caller, Scope
from app.settings import Settings
from app.simulation.magnetic.recorder import write_recorder_files
from tests.api.decodes.conftest import post_frame
from tests.api.decodes.test_traces import Place, _drive, _zipped
from tests.conftest import ADMIN_KEY, UNLIMITED, LiveServer
from tests.http import finished, refused
from tests.jobs import standin

pytestmark = [pytest.mark.slow, pytest.mark.both_databases]

BEGAN = datetime(2026, 6, 1, 8, 0, tzinfo=UTC)
ORIGIN = (11.0, 48.0, 0.0)
SPEED_M_S = 12.0


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, new_database_url: Any) -> Iterator[LiveServer]:
    folder: Path = tmp_path_factory.mktemp("drives") / "var"
    url = new_database_url(folder)
    settings = Settings(data_dir=folder, database_url=url, admin_key=ADMIN_KEY, decode_workers=1, **UNLIMITED)
    with LiveServer(create_app(settings, decode=standin.decode)) as running:
        yield running


@pytest.fixture(scope="module")
def client(server: LiveServer) -> Iterator[httpx.Client]:
    with server.agency("drives agency") as agency:
        yield agency


def caller_of(server: LiveServer, client: httpx.Client) -> Caller:
    caller: Caller = server.app.state.use_cases.access.authenticate(client.headers["authorization"].split()[1])
    return caller


def store(server: LiveServer, client: httpx.Client, kind: str, result: dict[str, Any] | None, **context: Any) -> str:
    """A decode that is done, as its handler would have stored it."""
    caller, database = caller_of(server, client), server.app.state.database
    assert isinstance(database, Database)
    row = DecodeRow(new_id(datetime.now(UTC)), kind, context, BEGAN, finished_at=BEGAN, result=result)
    with database.write() as connection:
        add_decode(connection, caller.agency_id, caller.key_id, row)
    return row.id


def lon_lat(t_s: float, left_m: float = 0.0) -> tuple[float, float]:
    """Where the vehicle is, which drives to the east."""
    lon, lat, _height = wgs84_from_enu(np.array([SPEED_M_S * t_s + 4.0 * math.sin(t_s / 3.0), left_m, 0.0]), ORIGIN)
    return lon, lat


def motion(seconds: float) -> dict[str, Any]:
    t = np.arange(0.0, seconds, 0.1)
    speed = SPEED_M_S + 4.0 / 3.0 * np.cos(t / 3.0)
    return {"start_s": 0.0, "step_s": 0.1, "speed_m_s": speed.round(3).tolist(), "heading_deg": [90.0] * t.size}


def trace(seconds: float = 60.0, tags: tuple[float, ...] = (5.0, 25.0, 45.0)) -> dict[str, Any]:
    return {"motion": motion(seconds), "tags": [tag(at) for at in tags]}


def tag(at_s: float) -> dict[str, Any]:
    lon, lat = lon_lat(at_s)
    fix = {
        "t_s": at_s, "lon_deg": lon, "lat_deg": lat, "heading_deg": 90.0, "localization_grade": "cm", "notes": [],
        "covariance": [[0.0025, 0, 0], [0, 0.0025, 0], [0, 0, 1e-5]],
    }  # fmt: skip
    return {
        "match": {"registered": True, "marker_id": new_id(BEGAN), "status": "active", "ambiguous": False},
        "fix": fix,
    }


def frames(*times_s: float, late_s: float = 0.0, left_m: float = 0.0, **match: Any) -> dict[str, Any]:
    """Frames with a plate each, by a clock that is behind."""
    readings, pictures = [], []
    for number, at_s in enumerate(times_s):
        lon, lat = lon_lat(at_s, left_m)
        covariance = np.diag([0.01, 0.01, 0.04, 1e-4]).tolist()
        grade = "unfit" if match.get("status") == "suspect" else "dm"
        readings.append({
            "frame": number, "family": "plate",
            "match": {
                "registered": True, "marker_id": new_id(BEGAN), "status": "active", "plausible": True,
                "ambiguous": False, "note": None, **match,
            },
            "fix": {
                "lon_deg": lon, "lat_deg": lat, "heading_deg": 90.0, "covariance": covariance,
                "localization_grade": grade, "notes": [],
            },
        })  # fmt: skip
        captured = BEGAN + timedelta(seconds=at_s - late_s)
        pictures.append({"frame": number, "captured_at": captured.isoformat().replace("+00:00", "Z")})
    return {"readings": readings, "frames": pictures}


def receiver(*times_s: float, left_m: float = 0.0, accuracy_m: float | None = 1.0) -> dict[str, Any]:
    """Positions as the decodes of frames, videos and packet logs keep them."""
    places = [lon_lat(at_s, left_m) for at_s in times_s]
    return {
        "time_s": [BEGAN.timestamp() + at_s for at_s in times_s],
        "lon_deg": [lon for lon, _lat in places],
        "lat_deg": [lat for _lon, lat in places],
        "accuracy_m": [accuracy_m] * len(times_s),
    }


def lane() -> dict[str, Any]:
    at = np.arange(-50.0, 900.0, 5.0)
    places = [wgs84_from_enu(np.array([x, 0.0, 0.0]), ORIGIN) for x in at]
    stations = {"lon_deg": [p[0] for p in places], "lat_deg": [p[1] for p in places]}
    path = {"refusal": None, "sigma_median_m": 0.05, "localization_grade": "dm", "stations": stations}
    heard = {"marker_id": new_id(BEGAN), "number": 7, "left_out": None}
    return {"lane": path, "markers": [heard, {**heard, "number": 8, "left_out": "off the line, 1.20 m"}]}


def make(client: httpx.Client, *decodes: Any, **more: Any) -> httpx.Response:
    named = [entry if isinstance(entry, dict) else {"id": entry} for entry in decodes]
    return client.post("/v1/drives", json={"decodes": named, **more})


def made(client: httpx.Client, *decodes: Any, **more: Any) -> dict[str, Any]:
    answer = make(client, *decodes, **more)
    assert answer.status_code == 202, answer.text
    drive = finished(client, answer.headers["location"])
    assert drive["state"] == "done", drive["error"]
    return drive


@pytest.fixture(scope="module")
def drive(server: LiveServer, client: httpx.Client) -> dict[str, Any]:
    """Trace, pictures with one wrong plate and one suspect marker, and a packet log."""
    bar = store(server, client, "trace", trace(), captured_at=BEGAN.isoformat())
    camera = frames(8.0, 12.0, 16.0, 20.0, 24.0, 28.0, 30.0, 35.0, 40.0, late_s=0.3)
    wrong = frames(50.0, left_m=30.0, late_s=0.3)
    suspect = frames(55.0, late_s=0.3, status="suspect")
    for extra in (wrong, suspect):
        number = len(camera["frames"])
        camera["frames"].append({**extra["frames"][0], "frame": number})
        camera["readings"].append({**extra["readings"][0], "frame": number})
    pictures = store(server, client, "archive", camera)
    packets = store(server, client, "packets", lane())
    return made(
        client, {"id": bar, "clock": "bar"}, {"id": pictures, "clock": "camera"}, packets,
        name="A <drive> & co", options={"rate_hz": 5},
    )  # fmt: skip


def test_every_marker_is_used_or_left_out_with_its_reason(drive: dict[str, Any]) -> None:
    report = drive["report"]
    reasons = {(marker["family"], marker["place"]): marker["reason"] for marker in report["markers"]}
    assert reasons.pop(("plate", 9)) == "outlier"
    assert reasons.pop(("plate", 10)) == "status"
    assert reasons.pop(("cerpm", 1)) == "off-lane"
    assert set(reasons.values()) == {None}
    assert len(reasons) == 3 + 9 + 1
    assert report["statistics"]["markers_used"] == 13
    assert report["statistics"]["markers_left_out"] == 3
    clocks = {clock["clock"]: clock for clock in report["clocks"]}
    assert clocks["bar"]["state"] == "reference"
    assert clocks["camera"]["state"] == "estimated"
    assert abs(clocks["camera"]["offset_s"] - 0.3) < 4 * clocks["camera"]["sigma_s"] < 0.1
    assert drive["links"]["csv"] == f"{drive['links']['self']}/track.csv"


def test_the_track_as_csv_is_where_the_vehicle_was(client: httpx.Client, drive: dict[str, Any]) -> None:
    answer = client.get(drive["links"]["csv"])
    assert answer.headers["content-type"].startswith("text/csv")
    rows = list(csv.DictReader(io.StringIO(answer.text)))
    assert len(rows) > 250
    for row in rows[10:-10]:
        at = (datetime.fromisoformat(row["time"]) - BEGAN).total_seconds()
        lon, lat = lon_lat(at)
        assert math.hypot((float(row["lon_deg"]) - lon) * 74600, (float(row["lat_deg"]) - lat) * 111200) < 0.5
        assert float(row["sigma_m"]) < 0.5


def test_the_track_as_geojson_gpx_and_plot(client: httpx.Client, drive: dict[str, Any]) -> None:
    collection = client.get(drive["links"]["geojson"]).json()
    lines = [feature for feature in collection["features"] if feature["properties"]["kind"] == "track"]
    points = [feature for feature in collection["features"] if feature["properties"]["kind"] == "marker"]
    assert lines[0]["properties"]["name"] == "A <drive> & co"
    assert len(lines[0]["geometry"]["coordinates"]) == len(lines[0]["properties"]["times"])
    assert len([point for point in points if point["properties"]["reason"] == "outlier"]) == 1
    gpx = ElementTree.fromstring(client.get(drive["links"]["gpx"]).text)
    space = {"g": "http://www.topografix.com/GPX/1/1"}
    assert gpx.findtext("g:trk/g:name", namespaces=space) == "A <drive> & co"
    assert len(gpx.findall("g:wpt", space)) == 12
    plot = client.get(drive["links"]["plot"])
    ElementTree.fromstring(plot.text)
    assert "A &lt;drive&gt; &amp; co" in plot.text
    again = client.get(drive["links"]["plot"], headers={"If-None-Match": plot.headers["etag"]})
    assert again.status_code == 304


def test_a_real_trace_becomes_a_drive(client: httpx.Client) -> None:
    place = Place(client)
    context = {**place.context, "captured_at": "2026-06-01T08:00:00Z"}
    upload = post_frame(client, _zipped(write_recorder_files(_drive().trace)), context, name="drive.zip")
    decode = upload.json()
    assert decode["motion"]["step_s"] == pytest.approx(0.1)
    assert max(decode["motion"]["speed_m_s"]) == pytest.approx(12.0, abs=0.5)
    drive = made(client, decode["id"])
    assert drive["report"]["statistics"]["markers_used"] == 3
    assert drive["report"]["statistics"]["length_m"] == pytest.approx(110.0, abs=3.0)
    collection = client.get(drive["links"]["geojson"]).json()
    lines = [
        f["geometry"]["coordinates"] for f in collection["features"] if f["properties"]["kind"] in ("track", "gap")
    ]
    path = [point for line in lines for point in line]
    bar_m = 3.2  # ahead of the simulated vehicle's origin, and not declared
    first, last = place._lon_lat(bar_m), place._lon_lat(110.0 + bar_m)
    for end, true in ((path[0], first), (path[-1], last)):
        assert math.hypot((end[0] - true[0]) * 82500, (end[1] - true[1]) * 111000) < 8.0


def test_positions_of_the_receiver_are_used_and_gated(server: LiveServer, client: httpx.Client) -> None:
    bar = store(server, client, "trace", trace(), captured_at=BEGAN.isoformat())
    every = [float(at) for at in range(2, 58, 5)]
    good = {**lane(), "receiver": receiver(*every)}
    biased = {**frames(8.0, 12.0), "receiver": receiver(*every, left_m=9.0, accuracy_m=0.03)}
    unknown = {**frames(9.0), "receiver": receiver(*every, accuracy_m=None)}
    logs = [store(server, client, kind, result) for kind, result in (("packets", good), ("archive", biased))]
    silent = store(server, client, "archive", unknown)
    drive = made(client, {"id": bar, "clock": "bar"}, *logs, silent)
    by_decode = {entry["decode_id"]: entry for entry in drive["report"]["receivers"]}
    assert list(by_decode) == logs
    assert (by_decode[logs[0]]["used"], by_decode[logs[0]]["left_out"]) == (12, 0)
    assert by_decode[logs[0]]["stated_m"] == by_decode[logs[0]]["assumed_m"] == 1.0
    assert by_decode[logs[1]]["assumed_m"] > 4.0
    assert all(marker["used"] for marker in drive["report"]["markers"] if marker["family"] != "cerpm")
    warned = "\n".join(drive["report"]["warnings"])
    assert f"decode {logs[1]} are further from the markers" in warned
    assert f"decode {silent} state no accuracy" in warned
    rows = list(csv.DictReader(io.StringIO(client.get(drive["links"]["csv"]).text)))
    for row in rows[10:-10]:
        _lon, lat = lon_lat((datetime.fromisoformat(row["time"]) - BEGAN).total_seconds())
        assert abs(float(row["lat_deg"]) - lat) * 111200 < 0.3


def test_a_drive_of_positions_alone_is_refused(server: LiveServer, client: httpx.Client) -> None:
    alone = {"readings": [], "frames": [], "receiver": receiver(1.0, 6.0, 11.0)}
    refused(make(client, store(server, client, "archive", alone)), 422, field="decodes")


def test_an_idempotency_key_makes_one_drive(server: LiveServer, client: httpx.Client) -> None:
    bar = store(server, client, "trace", trace(), captured_at=BEGAN.isoformat())
    body, headers = {"decodes": [{"id": bar}]}, {"Idempotency-Key": "drive-1"}
    first, again = (client.post("/v1/drives", json=body, headers=headers) for _ in range(2))
    assert first.json()["id"] == again.json()["id"]
    assert again.headers["Idempotency-Replayed"] == "true"
    path = first.headers["location"]
    finished(client, path)
    listed = client.get("/v1/drives", params={"limit": 1})
    assert listed.json()["items"][0]["id"] == first.json()["id"]
    assert 'rel="next"' in listed.headers["link"]
    with server.app.state.database.read() as connection:
        keys = connection.exec_driver_sql(f"SELECT result FROM jobs WHERE id = '{first.json()['id']}'").scalar()
    stored = json.loads(keys) if isinstance(keys, str) else keys
    assert client.delete(path).status_code == 204
    assert client.get(path).status_code == 404
    if stored is not None:
        with pytest.raises(Exception, match=r"\w"):
            server.app.state.use_cases.drives._blobs.get(stored["keys"]["track.csv"])


def test_bad_drives_name_the_decode_the_field_and_the_cure(server: LiveServer, client: httpx.Client) -> None:
    bar = store(server, client, "trace", trace(), captured_at=BEGAN.isoformat())
    no_time = store(server, client, "trace", trace())
    problem = refused(make(client, bar, no_time), 422, field="decodes.1.captured_at")
    assert no_time in problem["detail"]
    timeless = frames(5.0, 6.0)
    for picture in timeless["frames"]:
        picture["captured_at"] = None
    pictures = store(server, client, "archive", timeless)
    assert pictures in refused(make(client, pictures), 422, field="decodes.0.captured_at")["detail"]
    old = store(server, client, "trace", {"tags": []}, captured_at=BEGAN.isoformat())
    assert "older version" in refused(make(client, old), 422, field="decodes.0")["detail"]
    empty = store(server, client, "archive", frames(5.0, registered=False))
    refused(make(client, empty), 422, field="decodes")
    unfit = store(server, client, "archive", frames(5.0, 9.0, status="suspect"))
    assert "use_unfit" in refused(make(client, unfit), 422, field="decodes")["cure"]
    refused(make(client, bar, bar), 422, field="decodes.1.id")
    refused(make(client, "019cb624-0000-7000-8000-00000000ffff"), 404, field="decodes.0.id")
    clashing = [{"id": bar, "clock": "a"}, {"id": unfit, "clock": "a", "offset_s": 1.0}]
    refused(make(client, *clashing), 422, field="decodes.1.offset_s")
    refused(client.post("/v1/drives", json={"decodes": []}), 422)
    refused(client.post("/v1/drives", json={"decodes": [{"id": bar}], "options": {"rate_hz": 1e9}}), 422)


def test_a_decode_that_is_not_done_is_refused(server: LiveServer, client: httpx.Client) -> None:
    caller = caller_of(server, client)
    waiting = store(server, client, "trace", None, captured_at=BEGAN.isoformat())
    with server.app.state.database.write() as connection:
        job = new_job(JobKind.DECODE, waiting, caller.agency_id, caller.key_id, BEGAN, job_input={"label": "l"})
        add_job(connection, job._replace(state="failed"))
    assert "failed" in refused(make(client, waiting), 409, field="decodes.0")["detail"]


def test_decodes_of_two_vehicles_are_refused(server: LiveServer, client: httpx.Client) -> None:
    first, second = (client.post("/v1/vehicles", json={"name": name, "profile": {}}).json() for name in ("one", "two"))
    decodes = [
        store(
            server, client, "trace", trace(), captured_at=BEGAN.isoformat(), vehicle={"id": v["id"], "name": v["name"]}
        )
        for v in (first, second)
    ]
    refused(make(client, *decodes), 409, field="decodes.1.id")
    refused(make(client, decodes[0], vehicle="two"), 409, field="decodes.0.id")
    drive = made(client, decodes[0], vehicle="one")
    assert drive["vehicle"] == first["id"]
    listed = client.get("/v1/drives", params={"vehicle": first["id"]}).json()["items"]
    assert [entry["id"] for entry in listed] == [drive["id"]]
    assert client.get("/v1/drives", params={"vehicle": second["id"]}).json()["items"] == []


def test_sensors_that_do_not_overlap_fail_with_a_clear_error(server: LiveServer, client: httpx.Client) -> None:
    bar = store(server, client, "trace", trace(), captured_at=BEGAN.isoformat())
    later = store(server, client, "archive", frames(5.0, 9.0, late_s=-7200.0))
    problem = refused(make(client, bar, {"id": later, "clock": "camera"}), 422, field="decodes")
    assert "do not overlap in time" in problem["detail"]
    assert "camera" in problem["detail"]


def test_a_pause_between_two_sensors_is_a_gap(server: LiveServer, client: httpx.Client) -> None:
    bar = store(server, client, "trace", trace(), captured_at=BEGAN.isoformat())
    later = store(server, client, "archive", frames(*(140.0 + 0.5 * k for k in range(12))))
    drive = made(client, {"id": bar, "clock": "vehicle"}, {"id": later, "clock": "vehicle"})
    (gap,) = [gap for gap in drive["report"]["gaps"] if gap["reason"] == "no sensor recorded"]
    times = [(datetime.fromisoformat(gap[name]) - BEGAN).total_seconds() for name in ("from_time", "to_time")]
    assert times == pytest.approx([60.0, 140.0], abs=2.0)


def test_a_drive_that_is_too_long_is_refused(server: LiveServer, client: httpx.Client) -> None:
    def day(hours: float, **more: Any) -> str:
        values = {"speed_m_s": [15.0] * 13, "heading_deg": [90.0] * 13}
        motion = {"start_s": 0.0, "step_s": hours * 300.0, **values}
        return store(server, client, "trace", {"motion": motion, "tags": [tag(5.0)]}, **more)

    hours = [day(0.5, captured_at=(BEGAN + timedelta(hours=hour)).isoformat()) for hour in np.arange(0.0, 20.0, 0.5)]
    problem = refused(make(client, *({"id": entry, "clock": "bar"} for entry in hours)), 422, field="decodes")
    assert "20.0 h" in problem["detail"]
    problem = refused(make(client, *hours[:12]), 422, field="decodes")
    assert "11 clocks" in problem["detail"]
    assert "same clock" in problem["cure"]


def test_vehicles_see_their_own_drives_only(server: LiveServer, client: httpx.Client) -> None:
    with server.agency("fleet of drives", Scope.VEHICLE) as one, server.agency("fleet of drives", Scope.VEHICLE) as two:
        bar = store(server, one, "trace", trace(), captured_at=BEGAN.isoformat())
        drive = made(one, bar)
        assert [entry["id"] for entry in one.get("/v1/drives").json()["items"]] == [drive["id"]]
        assert two.get("/v1/drives").json()["items"] == []
        for path in ("", "/track.csv", "/plot.svg"):
            refused(two.get(drive["links"]["self"] + path), 404)
        refused(two.delete(drive["links"]["self"]), 404)
        refused(make(two, bar), 404, field="decodes.0.id")
    refused(client.get(drive["links"]["self"]), 404)
