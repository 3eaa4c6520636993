"""On board without a connection: a snapshot and the decoders give what the server gives."""

from __future__ import annotations

import base64
import itertools
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from app.decoders.cerpm.merge import grade_markers, list_numbers, match_known_markers
from app.decoders.cerpm.verify import FreshnessRules, Verdict
from app.decoders.magnet.decoder import decode_trace
from app.decoders.magnet.identify import match_tags
from app.decoders.plate.reader import decode_plates
from app.decoders.snapshot import Snapshot, open_snapshot
from app.demo.cerpms import build_lane
from app.formats.format import SpooledFile
from app.formats.traces.declaration import TraceDeclaration
from app.formats.traces.read import read_trace
from app.geodesy import decimal_year, move_to_epoch
from app.lanes.estimate import fit_lane
from app.lanes.types import LaneMarkers
from app.main import create_app
from app.markers.snapshot import Trust
from app.sensors.magnetometer_bar import MagnetometerBar
from app.services.access.access import Scope
from app.services.decodes.packet_tasks import read_drive
from app.settings import Settings
from app.simulation.magnetic.recorder import write_recorder_files
from app.simulation.radio.attacks import number_entries
from tests.api.decodes.conftest import post_frame
from tests.api.decodes.test_packets import decoded, packed
from tests.api.decodes.test_packets import drive as drive_past_cerpms
from tests.api.decodes.test_road import CAMERA, CAMERA_IN, Road
from tests.api.decodes.test_traces import Place as Lane
from tests.api.decodes.test_traces import _drive, _zipped
from tests.conftest import ADMIN_KEY, LiveServer

pytestmark = [pytest.mark.slow, pytest.mark.both_databases]

_AGENCIES = itertools.count(1)


@pytest.fixture(scope="module")
def real_server(
    tmp_path_factory: pytest.TempPathFactory, new_database_url: Callable[[Path], str]
) -> Iterator[LiveServer]:
    """A server with the decoder that is shipped, on either database."""
    folder = tmp_path_factory.mktemp("offline") / "var"
    settings = Settings(
        data_dir=folder, database_url=new_database_url(folder), admin_key=ADMIN_KEY, warm_decoders=False
    )
    with LiveServer(create_app(settings)) as running:
        yield running


def _download(client: httpx.Client, lon_deg: float, lat_deg: float) -> bytes:
    box = f"{lon_deg - 0.02},{lat_deg - 0.02},{lon_deg + 0.02},{lat_deg + 0.02}"
    answer = client.get("/v1/snapshots", params={"bbox": box})
    assert answer.status_code == 200, answer.text
    return answer.content


def _trust(client: httpx.Client) -> Trust:
    return Trust.from_document(client.get("/v1/snapshots/trust").json())


def _snapshot(client: httpx.Client, lon_deg: float, lat_deg: float) -> Snapshot:
    return open_snapshot(_download(client, lon_deg, lat_deg), _trust(client), datetime.now(UTC))


def test_a_frame_matches_the_same_plate(real_client: httpx.Client, place: Callable[[], dict[str, Any]]) -> None:
    vehicle = place()
    road = Road(real_client, vehicle, (4.2, 0.9, 0.0), (5.0, -0.8, 10.0)).register()
    lon, lat = vehicle["lon_deg"], vehicle["lat_deg"]
    frame = road.frame()
    context = {"coarse_position": {"lon_deg": lon, "lat_deg": lat, "accuracy_m": 20.0}, "camera": CAMERA_IN}
    decode = post_frame(real_client, frame, context).json()
    online = {r["match"]["marker_id"]: r["match"]["distance_m"] for r in decode["readings"] if r["match"]}
    assert len(online) == 2

    snapshot = _snapshot(real_client, lon, lat)
    pixels = cv2.imdecode(np.frombuffer(frame, np.uint8), cv2.IMREAD_COLOR)
    readings = decode_plates(pixels, camera=CAMERA, codebook=snapshot.plate_codebook(lon, lat, 120.0))
    matches = [snapshot.match_plate(r.code, lon, lat, 120.0) for r in readings if r.code is not None]
    offline = {match.marker_id: match.distance_m for match in matches if match is not None}
    assert offline.keys() == online.keys()
    # the snapshot has the plates where they are today, half a year of plate motion from their survey
    assert all(abs(offline[marker_id] - online[marker_id]) < 0.1 for marker_id in online)


def test_a_trace_gives_the_same_tags_meanings_and_fixes(real_client: httpx.Client) -> None:
    real_client.timeout = httpx.Timeout(120)
    book = _codebook(real_client)
    codes = tuple(entry["code"] for entry in book["entries"])
    lane, drive = Lane(real_client, codes, book["id"]), _drive(codes=codes)
    data = _zipped(write_recorder_files(drive.trace))
    context = lane.context | {"captured_at": datetime.now(UTC).isoformat()}  # a snapshot has today's positions
    decode = post_frame(real_client, data, context, name="drive.zip").json()
    assert [tag["match"]["marker_id"] for tag in decode["tags"]] == lane.ids
    coarse = lane.context["coarse_position"]
    snapshot = _snapshot(real_client, coarse["lon_deg"], coarse["lat_deg"])
    place = (coarse["lon_deg"], coarse["lat_deg"], 2050.0)
    bar = MagnetometerBar.metro()
    trace = read_trace({"drive.zip": data}, TraceDeclaration()).trace
    found = decode_trace(trace, bar, candidates=snapshot.tag_candidates(*place))
    offline = match_tags(found, snapshot.registered_tags(*place), bar).tags
    assert len(offline) == len(decode["tags"]) == 3
    for tag, online in zip(offline, decode["tags"], strict=True):
        assert tag.reading.tag is not None
        assert tag.match is not None
        assert tag.match.tag is not None
        assert tag.fix is not None
        assert tag.reading.tag.text == online["tag"]
        assert tag.reading.confidence == pytest.approx(
            online["confidence"], rel=1e-12
        )  # another process, other threads
        matched, meaning = tag.match.tag, tag.match.tag.meaning
        assert (matched.marker_id, matched.status) == (online["match"]["marker_id"], online["match"]["status"])
        assert meaning is not None
        assert {"kind": meaning.kind, "value": meaning.value} == online["match"]["meaning"]
        fix = online["fix"]
        assert (tag.fix.localization_grade, list(tag.fix.notes)) == (fix["localization_grade"], fix["notes"])
        assert tag.fix.lon_deg == pytest.approx(fix["lon_deg"], abs=2e-9)
        assert tag.fix.lat_deg == pytest.approx(fix["lat_deg"], abs=2e-9)
        assert tag.fix.heading_deg == pytest.approx(fix["heading_deg"], abs=1e-4)
        # in a snapshot an RMSE is rounded up to the millimetre, here from 10.7 mm
        assert np.allclose(tag.fix.covariance, fix["covariance"], rtol=0.1, atol=1e-7)


def test_where_no_tag_is_registered_the_codebooks_say_what_to_look_for(real_client: httpx.Client) -> None:
    real_client.timeout = httpx.Timeout(120)
    made = _codebook(real_client)
    codes = tuple(entry["code"] for entry in made["entries"])
    data = _zipped(write_recorder_files(_drive(codes=codes).trace))
    decode = post_frame(real_client, data, {"trace": {}}, name="drive.zip").json()
    snapshot = _snapshot(real_client, 8.4, 49.0)
    bar = MagnetometerBar.metro()
    trace = read_trace({"drive.zip": data}, TraceDeclaration()).trace
    found = decode_trace(trace, bar, candidates=snapshot.tag_candidates(8.4, 49.0, 2050.0))
    tags = match_tags(found, (), bar).tags
    assert [tag.reading.tag.text for tag in tags if tag.reading.tag] == [tag["tag"] for tag in decode["tags"]]
    assert len(tags) == 3
    (book,) = snapshot.codebooks
    assert [tag.text for tag, _meaning in book.entries] == list(codes)
    assert [meaning.value for _tag, meaning in book.entries] == [e["meaning"]["value"] for e in made["entries"]]


def test_packets_give_the_same_verdicts_markers_and_lane(real_server: LiveServer) -> None:
    with real_server.agency(f"offline roads {next(_AGENCIES)}", Scope.ADMIN) as client:
        client.timeout = httpx.Timeout(120)
        built = build_lane(client, np.random.default_rng(1901))
        first, hour = drive_past_cerpms(built, 5)
        decoded(client, packed(first))
        retired = int(built.installed.number[3])
        _retire(client, retired)
        listed = client.get("/v1/markers", params={"family": "cerpm", "limit": 1000}).json()["items"]
        lon, lat = (float(np.median([m["position"][n] for m in listed])) for n in ("lon_deg", "lat_deg"))
        answer = _download(client, lon, lat)
        snapshot = open_snapshot(answer, _trust(client), datetime.now(UTC))
        later, _ = drive_past_cerpms(built, 6, hour=hour + 1)
        # some of the first drive are sent again an hour later: authentic, and stale
        again = [replace(p, received_at_s=p.received_at_s + 3600.0) for p in first.packets[:40]]
        packets = number_entries([*later.packets, *again])
        online = decoded(client, packed(later, packets))

    files = read_drive("drive.zip", SpooledFile.of(packed(later, packets)))
    known = snapshot.known_cerpms(list_numbers(files.packets))
    freshness = FreshnessRules(uploaded_at_s=datetime.now(UTC).timestamp())
    verification, merged = match_known_markers(files.packets, built.keys, known, files.track, freshness)
    verdicts = {str(verdict): count for verdict, count in verification.counts().items()}
    assert verdicts == online["report"]["verdicts"]
    assert verdicts["replayed"] > 30
    markers = {marker["number"]: marker for marker in online["markers"]}
    assert sorted([*merged.number.tolist(), *merged.left_out]) == sorted(markers)
    assert merged.left_out == {n: m["left_out"] for n, m in markers.items() if m["left_out"]}
    assert list(merged.left_out) == [retired]
    grade, localization_warnings = grade_markers(merged, verification, known)
    assert grade == online["lane"]["localization_grade"]
    assert not localization_warnings
    driven = datetime.fromtimestamp(float(np.median([p.received_at_s for p in packets])), UTC)
    then = move_to_epoch(merged.lon_deg, merged.lat_deg, decimal_year(datetime.now(UTC)), decimal_year(driven))
    used = (merged.number, then.lon_deg, then.lat_deg, merged.side, merged.sigma_m, merged.speed_limit_kmh)
    lane = fit_lane(LaneMarkers(*used), files.track)
    stations = online["lane"]["stations"]
    # within 2 mm: the path's weights are those of accuracies rounded up to the millimetre
    assert np.allclose(lane.lon_deg, stations["lon_deg"], rtol=0, atol=2e-8)
    assert np.allclose(lane.lat_deg, stations["lat_deg"], rtol=0, atol=2e-8)
    assert np.allclose(lane.speed_limit_kmh, stations["speed_limit_kmh"])

    # the keys are the operator's to hand out: they are not in the file, and without them no packet is believed
    content = zlib.decompress(answer[104:-64])
    for key in built.keys.values():
        assert key not in content
        assert key.hex().encode() not in content.lower()
        assert base64.b64encode(key) not in content
    unkeyed, nothing = match_known_markers(files.packets, {}, known, files.track, freshness)
    assert unkeyed.counts()[Verdict.AUTHENTIC] == 0
    assert len(nothing.number) == 0


def _codebook(client: httpx.Client) -> dict[str, Any]:
    """A book with three codes."""
    body = {
        "name": "streets",
        "design": {"magnets": 3, "length_m": 4.0, "segment_m": 0.1},
        "rules": {"speed_m_s": 13.4, "clearance_m": 0.3, "confusion": 0.001},
        "meanings": [{"kind": "bend-right", "value": angle} for angle in (30, 60, 125)],
    }
    answer = client.post("/v1/codebooks", json=body)
    assert answer.status_code == 201, answer.text
    book: dict[str, Any] = answer.json()
    return book


def _retire(client: httpx.Client, number: int) -> None:
    (marker,) = client.get("/v1/markers", params={"family": "cerpm", "code": str(number)}).json()["items"]
    answer = client.patch(f"/v1/markers/{marker['id']}", json={"status": "retired"}, headers={"If-Match": "*"})
    assert answer.status_code == 200, answer.text
