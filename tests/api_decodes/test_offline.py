"""On board without a connection: a snapshot and the decoders give what the server gives."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

import cv2
import httpx
import numpy as np

from app.decoders.cerpm.merge import MergeRules, merge_markers
from app.decoders.cerpm.verify import verify_packets
from app.decoders.magnet.book import TagBook
from app.decoders.magnet.decoder import decode_trace
from app.decoders.magnet.readings import TagReading
from app.decoders.plate import decode_plates
from app.decoders.snapshot import Snapshot, open_snapshot
from app.demo.cerpms import build_lane
from app.services.access import Scope
from app.simulation.magnetic.recorder import write_recorder_files
from app.simulation.magnetic.vehicle import Vehicle
from tests.api_decodes.conftest import post_frame
from tests.api_decodes.test_packets import drive as drive_past_cerpms
from tests.api_decodes.test_road import CAMERA, CAMERA_IN, Road
from tests.api_decodes.test_traces import Place as Lane
from tests.api_decodes.test_traces import _drive
from tests.conftest import LiveServer


def _snapshot(client: httpx.Client, lon_deg: float, lat_deg: float) -> Snapshot:
    box = f"{lon_deg - 0.02},{lat_deg - 0.02},{lon_deg + 0.02},{lat_deg + 0.02}"
    answer = client.get("/v1/snapshots", params={"bbox": box})
    assert answer.status_code == 200, answer.text
    public = bytes.fromhex(client.get("/v1/snapshots/public-key").json()["public_key"])
    return open_snapshot(answer.content, public, datetime.now(UTC))


def test_a_frame_matches_the_same_plate(real_client: httpx.Client, place: Callable[[], dict[str, Any]]) -> None:
    vehicle = place()
    road = Road(real_client, vehicle, (4.5, 0.2, 0.0), (7.0, -1.0, 10.0)).register()
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
    assert all(abs(offline[marker_id] - online[marker_id]) < 1e-3 for marker_id in online)


def test_a_trace_matches_the_same_tags(real_client: httpx.Client) -> None:
    real_client.timeout = httpx.Timeout(120)
    lane, drive = Lane(real_client), _drive()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, data in write_recorder_files(drive.trace).items():
            archive.writestr(name, data)
    decode = post_frame(real_client, packed.getvalue(), lane.context, name="drive.zip").json()
    coarse = lane.context["coarse_position"]
    snapshot = _snapshot(real_client, coarse["lon_deg"], coarse["lat_deg"])
    reach_m = 1000.0
    book = TagBook(snapshot.tags(coarse["lon_deg"], coarse["lat_deg"], reach_m))
    found = [f for f in decode_trace(drive.trace, Vehicle.compact().bar, book=book) if isinstance(f, TagReading)]
    matches = [
        snapshot.match_tag(reading.tag, coarse["lon_deg"], coarse["lat_deg"], reach_m)
        for reading in sorted(found, key=lambda reading: reading.start_s)
        if reading.tag is not None
    ]
    assert [m.marker_id if m else None for m in matches] == [t["match"]["marker_id"] for t in decode["tags"]]
    assert [m.marker_id if m else None for m in matches] == lane.ids


def test_packets_are_held_against_the_same_markers(server: LiveServer) -> None:
    with server.agency("offline roads", Scope.ADMIN) as client:
        built = build_lane(client, np.random.default_rng(1901))
        heard, _ = drive_past_cerpms(built, 5)
        listed = client.get("/v1/markers", params={"family": "cerpm", "limit": 1000}).json()["items"]
        lon, lat = (float(np.median([m["position"][n] for m in listed])) for n in ("lon_deg", "lat_deg"))
        snapshot = _snapshot(client, lon, lat)
    known = snapshot.registered_cerpms(lon, lat, 5_000.0)
    assert sorted(known) == sorted(m["code"]["number"] for m in listed)
    # the keys are the operator's to hand out; without them no packet is believed
    verified = verify_packets(heard.packets, built.keys)
    merged = merge_markers(verified.packets, known, heard.track, MergeRules())
    assert len(merged.number) > 10
    assert merged.registered.all()
    unkeyed = merge_markers(verify_packets(heard.packets, {}).packets, known, heard.track, MergeRules())
    assert len(unkeyed.number) == 0
