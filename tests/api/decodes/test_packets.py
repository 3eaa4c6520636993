"""Packet logs over HTTP, against a real registry and real decoder processes."""

from __future__ import annotations

import base64
import io
import itertools
import json
import struct
import zipfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
import sqlalchemy as sa

from app.demo.cerpms import BuiltLane, build_lane, draw_frame, path_errors_m, register_lane
from app.encoders.cerpm import encode_message
from app.errors import TooManyRequests
from app.main import create_app
from app.markers.cerpm import CerpmMessage
from app.registry.decodes import decodes, observations
from app.sensors.pose_track import ReceivedPacket
from app.services.access.access import Scope
from app.services.decodes.recordings import InvalidTagLimit
from app.settings import Settings
from app.simulation.radio.attacks import forge_packets, move_claim, number_entries, replay_packets
from app.simulation.radio.drive import SimulatedDrive, drive_past, write_packets, write_poses
from app.simulation.radio.lanes import InstalledMarkers
from app.simulation.radio.link import Radio
from benchmarks.cerpm.topologies import make_topology
from tests.conftest import ADMIN_KEY, LiveServer
from tests.http import finished
from tests.jobs import standin

START_S = datetime(2026, 5, 4, 8, tzinfo=UTC).timestamp()
_HOURS = itertools.count()
_AGENCIES = itertools.count(1)


@pytest.fixture(scope="module")
def road(server: LiveServer) -> Iterator[tuple[httpx.Client, BuiltLane]]:
    """An agency with markers along the demo's lane, and its client."""
    name = f"roads {next(_AGENCIES)}"
    with server.agency(name, Scope.ADMIN) as client:
        yield client, build_lane(client, np.random.default_rng(1901))


def drive(
    built: BuiltLane, seed: int, installed: InstalledMarkers | None = None, hour: int | None = None
) -> tuple[SimulatedDrive, int]:
    """A drive at an hour of its own; sequences go on from hour to hour."""
    at = next(_HOURS) if hour is None else hour
    markers = installed or built.installed
    heard = drive_past(
        built.lane, markers, np.random.default_rng(seed), sign=lambda m: encode_message(m, built.keys[m.number]),
        radio=Radio(interval_s=1.0), start_s=START_S + 3600.0 * at, first_sequence=np.full(len(markers), 3600 * at),
    )  # fmt: skip
    return heard, at


def packed(heard: SimulatedDrive, packets: Sequence[ReceivedPacket] | None = None, **more: bytes) -> bytes:
    """What a vehicle uploads."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("packets.jsonl", write_packets(heard.packets if packets is None else packets))
        archive.writestr("poses.csv", write_poses(heard.track))
        for name, data in more.items():
            archive.writestr(name.replace("_", "."), data)
    return stream.getvalue()


def post(client: httpx.Client, data: bytes, context: Any = None, name: str = "drive.zip", **headers: str) -> Any:
    body = json.dumps({"packets": {}} if context is None else context)
    parts = {"file": (name, data, "application/octet-stream"), "context": ("context", body, "application/json")}
    return client.post("/v1/decodes", files=parts, headers=headers)


def decoded(client: httpx.Client, data: bytes, context: Any = None, name: str = "drive.zip") -> dict[str, Any]:
    answer = post(client, data, context, name)
    assert answer.status_code == 201, answer.text
    found: dict[str, Any] = answer.json()
    assert found["kind"] == "packets"
    return found


def path_rms_m(built: BuiltLane, found: dict[str, Any]) -> float:
    stations = found["lane"]["stations"]
    errors, covered = path_errors_m(built.lane, built.lane.enu_from_wgs84(stations["lon_deg"], stations["lat_deg"]))
    assert covered > 0.99
    return float(np.sqrt(np.mean(errors**2)))


# --- roads with more than one lane --------------------------------------------------------------------------------


def test_a_road_of_two_lanes_gives_the_driven_one(server: LiveServer) -> None:
    with server.agency(f"roads {next(_AGENCIES)}", Scope.ADMIN) as client:
        two = make_topology("two lanes, shared line", np.random.default_rng(1951))
        built = register_lane(client, two.lane, two.installed)
        heard, _hour = drive(built, 1952)
        found = decoded(client, packed(heard))
        others = {marker["number"] for marker in found["markers"] if marker["left_out"]}
        assert others == set(two.installed.number.tolist()) - two.own
        assert f"{len(others)} of other lanes" in found["summary"]["text"]
        assert found["summary"]["left_out"] == []
        assert path_rms_m(built, found) < 0.03
        assert found["lane"]["localization_grade"] == "cm", found["lane"]["localization_warnings"]
        assert all(marker["registered"] and marker["authentic"] for marker in found["markers"])
        rows = client.get(f"/v1/decodes/{found['id']}/readings.geojson").json()["features"]
        assert {row["properties"]["outcome"] for row in rows} == {"received"}  # to be of another lane is no fault
        seen = client.get(f"/v1/markers/{built.markers[-1]['id']}/observations").json()
        assert [one["what"] for one in seen["items"]] == ["seen"]
        (other,) = found["lane"]["other_lanes"]
        assert abs(other["position"]) == 1
        assert others <= set(other["markers"])
        assert len(other["path"]) > 400
        shapes = client.get(f"/v1/decodes/{found['id']}/lane.geojson").json()["features"]
        assert [shape["geometry"]["type"] for shape in shapes if shape["properties"]["kind"] == "other lane"] == [
            "LineString"
        ]


def test_a_change_of_lane_is_in_the_result(server: LiveServer) -> None:
    with server.agency(f"roads {next(_AGENCIES)}", Scope.ADMIN) as client:
        road = make_topology("lane change", np.random.default_rng(1953))
        built = register_lane(client, road.lane, road.installed)
        heard, _hour = drive(replace(built, lane=road.course), 1954)
        found = decoded(client, packed(heard))
        assert path_rms_m(built, found) < 0.03
        stays = [stretch["lane"] for stretch in found["lane"]["stretches"] if not stretch["changing"]]
        assert stays in ([1, 0], [-1, 0])
        assert "changed lane once" in found["summary"]["text"]
        assert found["lane"]["localization_grade"] == "cm", found["lane"]["localization_warnings"]


# --- what a drive gives -------------------------------------------------------------------------------------------


def _off_painted_line_px(frame: np.ndarray[Any, Any], line_px: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """How far the points of a line near the vehicle lie from the painted line of their row. [px]"""
    near = line_px[(line_px[:, 1] > 400) & (line_px[:, 1] < len(frame) - 1)]
    off_px = []
    for u, v in near:
        painted = np.flatnonzero(frame[round(v)].min(axis=1) > 180)
        assert painted.size, f"no painted line in row {v:.0f}"
        off_px.append(np.abs(painted - u).min())
    return np.array(off_px)


@pytest.mark.slow
def test_a_drive_gives_the_lane_its_pictures_and_observations(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    heard, _hour = drive(built, 1902)
    at_s = float(heard.track.time_s[200])
    frame = draw_frame(built.lane, heard, at_s)
    camera = {"horizontal_fov_deg": 70.0, "height_m": 1.5, "depression_deg": 8.0}
    context = {"packets": {}, "camera": camera, "captured_at": datetime.fromtimestamp(at_s, UTC).isoformat()}
    found = decoded(client, packed(heard, frame_jpg=frame), context)
    verdicts = found["report"]["verdicts"]
    assert verdicts["authentic"] == len(heard.packets)
    assert sum(verdicts.values()) == len(heard.packets)
    assert path_rms_m(built, found) < 0.05
    lane = found["lane"]
    assert lane["localization_grade"] == "cm", lane["localization_warnings"]
    assert lane["refusal"] is None
    assert lane["speed_limits_kmh"] == [30.0]
    lengths = {name: len(column) for name, column in lane["stations"].items()}
    assert set(lengths.values()) == {lengths["station_m"]}
    assert min(lane["stations"]["confidence"]) > 0.5
    assert {m["number"] for m in found["markers"]} <= {int(n) for n in built.installed.number}
    assert all(marker["registered"] and not marker["left_out"] for marker in found["markers"])
    truth = {int(n): int(s) for n, s in zip(built.installed.number, built.installed.side, strict=True)}
    assert all(marker["side"] == ("left", "right")[truth[marker["number"]] - 1] for marker in found["markers"])
    assert found["steering"]["completed"]
    assert found["steering"]["max_m"] < 0.1

    written = client.get(found["links"]["lane"])
    assert written.headers["content-type"] == "application/geo+json"
    kinds = [feature["properties"]["kind"] for feature in written.json()["features"]]
    assert kinds.count("path") == 1
    assert kinds.count("marker") == len(found["markers"])
    overlay = client.get(found["links"]["overlay"])
    picture = cv2.imdecode(np.frombuffer(overlay.content, np.uint8), cv2.IMREAD_COLOR)
    original = cv2.imdecode(np.frombuffer(frame, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert original is not None
    assert picture.shape == original.shape
    assert np.abs(picture.astype(int) - original).mean() > 2
    for side in ("left_px", "right_px"):
        off_px = _off_painted_line_px(original, np.vstack(found["overlay"][side]))
        assert len(off_px) >= 3
        assert np.median(off_px) < 12.0
    plot = client.get(found["links"]["plot"])
    assert plot.headers["content-type"].startswith("image/svg")
    assert "Lane of" in plot.text
    for marker in found["markers"]:
        strengths, health = marker["rssi_profile"], marker["health"]
        assert strengths["distance_m"] == sorted(strengths["distance_m"])
        assert len(strengths["distance_m"]) == len(strengths["rssi_dbm"]) == marker["packets"]
        assert max(strengths["rssi_dbm"]) == pytest.approx(marker["best_rssi_dbm"], abs=0.01)
        assert strengths["distance_m"][-1] == pytest.approx(health["farthest_m"], abs=0.1)


@pytest.mark.slow
def test_the_path_is_driven_by_the_controller_that_is_asked_for(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    heard, _hour = drive(built, 1903)
    driven = {
        law: decoded(client, packed(heard), {"packets": {"steering": law}})["steering"]
        for law in ("predictive", "mpc", "stanley", "none")
    }
    assert driven.pop("none") is None
    assert [steering["controller"] for steering in driven.values()] == list(driven)
    assert all(steering["completed"] and steering["unsolved_steps"] == 0 for steering in driven.values())
    assert driven["mpc"]["max_m"] < 0.1
    assert driven["mpc"]["steer_rate_max_deg_s"] < driven["predictive"]["steer_rate_max_deg_s"]
    refused = post(client, packed(heard), {"packets": {"steering": "pure-pursuit"}})
    assert refused.status_code == 422
    assert "mpc" in refused.text


def test_a_track_of_another_day_is_said(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    heard, _hour = drive(built, 1915)
    later = replace(heard, track=replace(heard.track, time_s=heard.track.time_s + 86_400.0))
    found = decoded(client, packed(later))
    assert any("no packet was received while" in warning for warning in found["report"]["warnings"])
    assert all(marker["rssi_profile"] is None for marker in found["markers"])
    assert not any("no packet" in text for text in decoded(client, packed(heard))["report"]["warnings"])


def test_a_track_a_week_rollover_behind_is_warned_of(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    heard, _hour = drive(built, 1916)
    behind = replace(heard, track=replace(heard.track, time_s=heard.track.time_s - 1024 * 7 * 86_400.0))
    at = datetime.fromtimestamp(float(heard.track.time_s[0]), UTC).isoformat()
    found = decoded(client, packed(behind), {"packets": {}, "captured_at": at})
    assert any("1024 weeks" in warning for warning in found["report"]["warnings"])
    cured = {"packets": {"poses": {"clock": {"offset_s": 619315200}}}, "captured_at": at}
    again = decoded(client, packed(behind), cured)
    assert not any("weeks" in warning or "no packet" in warning for warning in again["report"]["warnings"])


def test_packets_without_poses_or_times_still_give_a_lane(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    heard, _hour = drive(built, 1903)
    newest = {}
    for packet in heard.packets:
        newest[packet.payload[:16] if packet.payload else b""] = packet.payload
    lines = "".join(f"{payload.hex()}\n" for payload in newest.values() if payload)
    found = decoded(client, lines.encode(), name="packets.txt")
    assert any("freshness unknown" in warning for warning in found["report"]["warnings"])
    assert path_rms_m(built, found) < 0.15
    assert found["overlay"] is None


def test_the_papers_own_way_is_there_as_a_peer(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    heard, _hour = drive(built, 1904)
    data = packed(heard)
    ours = decoded(client, data)
    paper = decoded(client, data, {"packets": {"method": "paper"}})
    assert paper["lane"]["method"] == "paper"
    assert path_rms_m(built, ours) < path_rms_m(built, paper)


@pytest.mark.parametrize("network", ["chirpstack", "things-stack"])
def test_uplinks_of_network_servers_are_packets(road: tuple[httpx.Client, BuiltLane], network: str) -> None:
    client, built = road
    heard, _hour = drive(built, 1905)
    write = {"chirpstack": chirpstack_uplink, "things-stack": things_stack_uplink}[network]
    lines = "".join(json.dumps(write(packet)) + "\n" for packet in heard.packets)
    found = decoded(client, lines.encode(), name="uplinks.jsonl")
    assert found["report"]["verdicts"]["authentic"] == len(heard.packets)
    assert path_rms_m(built, found) < 0.15


def chirpstack_uplink(packet: ReceivedPacket) -> dict[str, Any]:
    """As ChirpStack v4 publishes it; what is zero is left out."""
    assert packet.payload is not None
    uplink: dict[str, Any] = {
        "deduplicationId": f"00000000-0000-4000-8000-{packet.entry:012d}",
        "time": datetime.fromtimestamp(packet.received_at_s, UTC).isoformat(),
        "deviceInfo": {"applicationName": "cerpms", "devEui": "0011223344556677"},
        "fPort": 24,
        "data": base64.b64encode(packet.payload).decode(),
        "rxInfo": [{"gatewayId": "a1", "rssi": int(packet.rssi_dbm), "snr": packet.snr_db}],
        "txInfo": {"frequency": 915000000},
    }
    if packet.entry:
        uplink["fCnt"] = packet.entry
    return uplink


def things_stack_uplink(packet: ReceivedPacket) -> dict[str, Any]:
    """As The Things Stack v3 publishes it."""
    assert packet.payload is not None
    at = datetime.fromtimestamp(packet.received_at_s, UTC).isoformat()
    return {
        "end_device_ids": {"device_id": "cerpm", "dev_eui": "0011223344556677"},
        "received_at": at,
        "uplink_message": {
            "session_key_id": "AXA=",
            "f_port": 24,
            "f_cnt": packet.entry + 1,
            "frm_payload": base64.b64encode(packet.payload).decode(),
            "rx_metadata": [{"gateway_ids": {"gateway_id": "g"}, "rssi": int(packet.rssi_dbm), "snr": packet.snr_db}],
            "settings": {"frequency": "915000000"},
            "received_at": at,
        },
    }


def test_a_network_server_posts_one_uplink_as_it_is(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    heard, _hour = drive(built, 1923)
    answer = client.post(
        "/v1/decodes", json=chirpstack_uplink(heard.packets[0]), headers={"Waymark-Context": '{"packets": {}}'}
    )
    assert answer.status_code == 201, answer.text
    assert answer.json()["report"]["verdicts"]["authentic"] == 1
    assert answer.json()["lane"]["refusal"]


# --- what is not accepted -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_forged_and_replayed_packets_are_refused_and_move_nothing(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    first, _hour = drive(built, 1906)
    decoded(client, packed(first))
    second, _later = drive(built, 1907)
    rng = np.random.default_rng(1908)
    span = (float(second.drive.time_s[0]), float(second.drive.time_s[-1]))
    bad = forge_packets(second.packets, 300, rng) + replay_packets(first.packets, 300, rng, at_s=span)
    packets = number_entries(sorted([*second.packets, *bad], key=lambda packet: packet.received_at_s))
    found = decoded(client, packed(second, packets))
    verdicts = found["report"]["verdicts"]
    assert verdicts["authentic"] == len(second.packets)
    assert verdicts["replayed"] + verdicts["out-of-order"] + verdicts["duplicate"] >= 290
    refused = found["report"]["refused"]
    assert refused
    assert all(entry["reason"] for entry in refused)
    assert path_rms_m(built, found) < 0.05


@pytest.mark.slow
def test_forged_tags_are_limited_and_in_the_audit_log(server: LiveServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """One entry for an upload, whatever it contains; the limit is of the key, not of its agency."""
    handler = next(handler for handler in server.app.state.use_cases.decodes._handlers if handler.kind == "packets")
    monkeypatch.setattr(handler, "_invalid_tags", InvalidTagLimit(10))
    name = f"guessed roads {next(_AGENCIES)}"
    with server.agency(name, Scope.ADMIN) as admin, server.agency(name, Scope.VEHICLE) as vehicle:
        built = build_lane(admin, np.random.default_rng(1901))
        heard, _hour = drive(built, 1930)
        packets = heard.packets[:20]
        forged = [replace(p, payload=p.payload[:-4] + bytes(4)) for p in packets if p.payload is not None]

        def sent(chosen: Sequence[ReceivedPacket]) -> httpx.Response:
            answer = post(vehicle, write_packets(number_entries(chosen)).encode(), name="packets.jsonl")
            assert isinstance(answer, httpx.Response)
            return answer

        before = len(admin.get("/v1/audit").json()["items"])
        assert sent(packets).json()["report"]["verdicts"]["authentic"] == 20
        assert len(admin.get("/v1/audit").json()["items"]) == before
        first = sent(forged[:6]).json()
        second = sent(forged[6:]).json()["report"]["verdicts"]
        assert (second["forged"] + second["wrong-key"], second["unchecked"]) == (4, 10)
        entries = admin.get("/v1/audit").json()["items"][before:]
        assert [(entry["action"], entry["detail"]["invalid_tags"]) for entry in entries] == [
            ("packets.forged", 6), ("packets.forged", 4)
        ]  # fmt: skip
        assert entries[0]["subject"] == first["id"]
        assert entries[0]["who"] == f"{name} vehicle"
        assert entries[1]["detail"]["unchecked"] == 10
        refused = sent(forged[:6])
        assert (refused.status_code, refused.json()["limit"]) == (429, "10 invalid tags in a day (UTC)")
        assert 1 <= int(refused.headers["retry-after"]) <= 86_400
        other = post(admin, write_packets(number_entries(packets)).encode(), name="packets.jsonl")
        assert other.status_code == 201


@pytest.mark.parametrize("hour", [0, 23])
def test_the_limit_of_invalid_tags_begins_anew_at_midnight(hour: int) -> None:
    limit, now = InvalidTagLimit(1500), datetime(2026, 5, 4, hour, 59, 59, 500_000, tzinfo=UTC)
    assert limit.left("one", now) == 1000
    limit.add("one", 1000, now)
    assert (limit.left("one", now), limit.left("two", now)) == (500, 1000)
    limit.add("one", 500, now)
    with pytest.raises(TooManyRequests) as refused:
        limit.left("one", now)
    assert refused.value.retry_after_s == (23 - hour) * 3600 + 1
    limit.add("one", 0, now + timedelta(seconds=refused.value.retry_after_s))
    assert limit.left("one", now + timedelta(seconds=refused.value.retry_after_s)) == 1000


@pytest.mark.slow
def test_what_was_heard_is_known_after_a_restart(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / "var", admin_key=ADMIN_KEY, warm_decoders=False, decode_workers=1)
    with LiveServer(create_app(settings, decode=standin.decode)) as server, server.client() as client:
        built = build_lane(client, np.random.default_rng(1909))
        heard, hour = drive(built, 1910)
        decoded(client, packed(heard))
    replayed = [replace(packet, received_at_s=packet.received_at_s + 1800.0) for packet in heard.packets]
    with LiveServer(create_app(settings, decode=standin.decode)) as server, server.client() as client:
        found = decoded(client, write_packets(replayed).encode(), name="packets.jsonl")
        assert found["report"]["verdicts"]["authentic"] == 0
        assert found["lane"]["refusal"]
        later, _hour = drive(built, 1911, hour=hour + 1)
        assert decoded(client, packed(later))["report"]["verdicts"]["authentic"] == len(later.packets)
        assert client.get(f"/v1/markers/{built.markers[0]['id']}/payload.bin").status_code == 200


@pytest.mark.slow
def test_uploads_at_once_cannot_pass_by_each_other(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    heard, _hour = drive(built, 1912)
    honest = packed(heard)
    late = write_packets([replace(p, received_at_s=p.received_at_s + 1200.0) for p in heard.packets]).encode()
    with ThreadPoolExecutor(4) as threads:
        answers = list(threads.map(lambda data: post(client, data), [honest, late] * 3))
    counts = [answer.json()["report"]["verdicts"]["authentic"] for answer in answers if answer.status_code == 201]
    assert {answer.status_code for answer in answers} <= {201, 503}
    # whichever came first holds; the others of its kind repeat it, the other kind is refused
    assert set(counts) == {0, len(heard.packets)}
    after = [decoded(client, data)["report"]["verdicts"]["authentic"] for data in (honest, late)]
    assert sorted(after) == [0, len(heard.packets)]


def test_a_marker_that_claims_another_place_is_named(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    row = 11
    heard, _hour = drive(built, 1913, move_claim(built.lane, built.installed, row, np.random.default_rng(1914)))
    found = decoded(client, packed(heard))
    out = {marker["number"]: marker for marker in found["markers"] if marker["left_out"]}
    assert list(out) == [int(built.installed.number[row])]
    marker = out[int(built.installed.number[row])]
    assert marker["off_registered_m"] == pytest.approx(30.0, abs=0.2)
    assert "moved" in marker["left_out"]
    assert path_rms_m(built, found) < 0.06


@pytest.mark.slow
def test_two_markers_with_one_number_are_named(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    heard, _hour = drive(built, 1915)
    row, other = 5, 20
    number = int(built.installed.number[row])
    cloned = []
    for packet in heard.packets:
        cloned.append(packet)
        if packet.payload and int.from_bytes(packet.payload[1:5]) == int(built.installed.number[other]):
            sequence = int.from_bytes(packet.payload[16:20]) + 50
            place = (float(built.installed.lon_deg[other]), float(built.installed.lat_deg[other]))
            twin = encode_message(CerpmMessage(number, *place, sequence=sequence), built.keys[number])
            cloned.append(replace(packet, payload=twin))
    found = decoded(client, packed(heard, number_entries(cloned)))
    named = {marker["number"]: marker["left_out"] for marker in found["markers"] if marker["left_out"]}
    assert list(named) == [number]
    assert path_rms_m(built, found) < 0.06


def test_positions_of_another_datum_are_named(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    shifted = replace(
        built.installed, lon_deg=built.installed.lon_deg + 1.5e-5, lat_deg=built.installed.lat_deg - 0.8e-5
    )
    heard, _hour = drive(built, 1916, shifted)
    found = decoded(client, packed(heard))
    assert found["lane"]["refusal"]
    assert all("datum" in marker["left_out"] for marker in found["markers"])
    assert all(marker["off_registered_m"] == pytest.approx(1.41, abs=0.1) for marker in found["markers"])


def test_swapped_positions_are_named(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    lon, lat = built.installed.lon_deg.copy(), built.installed.lat_deg.copy()
    lon[3], lat[3] = lat[3], lon[3]
    heard, _hour = drive(built, 1917, replace(built.installed, lon_deg=lon, lat_deg=lat))
    found = decoded(client, packed(heard))
    named = {marker["number"]: marker["left_out"] for marker in found["markers"] if marker["left_out"]}
    assert list(named) == [int(built.installed.number[3])]
    assert "exchanged" in named[int(built.installed.number[3])]


def test_one_side_only_gives_a_path_with_less_confidence(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    heard, _hour = drive(built, 1918, built.installed.chosen(built.installed.side == 1))
    found = decoded(client, packed(heard))
    lane = found["lane"]
    assert lane["refusal"] is None
    assert any("one side" in doubt for doubt in lane["localization_warnings"])
    assert lane["sigma_median_m"] > 0.1
    assert lane["left"]
    assert min(lane["stations"]["confidence"]) < 0.99


@pytest.mark.parametrize(
    ("spoil", "verdict"),
    [
        (lambda payload: bytes([0x24, *payload[1:]]), "corrupt"),
        (lambda payload: bytes([payload[0] | 1, *payload[1:]]), "corrupt"),
        (lambda payload: payload[:-1] + b"", "undecodable"),
        (lambda payload: payload[:-4] + bytes(4), "forged"),
        (lambda payload: struct.pack(">BI", payload[0], 4_000_000_000) + payload[5:], "unknown-marker"),
    ],
    ids=["version", "reserved bit", "length", "key", "number"],
)
def test_bad_payloads_are_named_one_by_one(
    road: tuple[httpx.Client, BuiltLane], spoil: Callable[[bytes], bytes], verdict: str
) -> None:
    client, built = road
    heard, _hour = drive(built, 1919)
    spoilt = [replace(heard.packets[0], payload=spoil(heard.packets[0].payload or b"")), *heard.packets[1:]]
    found = decoded(client, packed(heard, spoilt))
    refused = found["report"]["refused"]
    assert [entry["entry"] for entry in refused] == [0]
    assert refused[0]["verdict"] in (verdict, "undecodable", "corrupt")
    assert refused[0]["reason"]
    assert found["report"]["verdicts"]["authentic"] == len(heard.packets) - 1


def test_a_track_of_another_place_accuses_no_marker(road: tuple[httpx.Client, BuiltLane], server: LiveServer) -> None:
    client, built = road
    heard, _hour = drive(built, 1924)
    away = replace(heard, track=replace(heard.track, lat_deg=heard.track.lat_deg + 0.1))
    found = decoded(client, packed(away))
    assert any("another drive" in warning for warning in found["report"]["warnings"])
    assert found["lane"]["localization_grade"] == "unfit"
    database = server.app.state.database
    with database.read() as connection:
        agency_id = find_agency_of(connection, found["id"])
        own = (observations.c.agency_id == agency_id, observations.c.decode_id == found["id"])
        assert connection.execute(sa.select(observations).where(*own)).all() == []


def test_markers_that_are_all_shifted_against_the_track_do_not_localize(road: tuple[httpx.Client, BuiltLane]) -> None:
    """A survey in another datum shifts registered and sent positions alike: only the vehicle's track shows it."""
    client, built = road
    heard, _hour = drive(built, 1926)
    shifted = replace(
        heard, track=replace(heard.track, lon_deg=heard.track.lon_deg - 4e-5, lat_deg=heard.track.lat_deg + 2.4e-5)
    )
    found = decoded(client, packed(shifted))
    agreement = found["lane"]["track_agreement"]
    assert agreement["disagrees"]
    assert agreement["significance"] > 4.5
    assert found["lane"]["localization_grade"] == "unfit"
    assert any("against the vehicle's track" in text for text in found["lane"]["localization_warnings"])


def test_markers_far_from_the_track_do_not_localize(road: tuple[httpx.Client, BuiltLane]) -> None:
    """So far that nothing can be compared: that is no agreement."""
    client, built = road
    heard, _hour = drive(built, 1927)
    track = replace(heard.track, lon_deg=heard.track.lon_deg + 0.009, lat_deg=heard.track.lat_deg + 0.0065)
    found = decoded(client, packed(replace(heard, track=track)))
    assert found["lane"]["refusal"] is None
    assert found["lane"]["track_agreement"] is None
    assert found["lane"]["localization_grade"] == "unfit"
    assert any("does not run beside the path" in text for text in found["lane"]["localization_warnings"])


def test_a_path_that_is_not_sure_is_not_for_localization(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    heard, _hour = drive(built, 1925)
    paper = decoded(client, packed(heard), {"packets": {"method": "paper"}})
    assert paper["lane"]["localization_grade"] == "unfit"
    assert any("no standard deviation" in text for text in paper["lane"]["localization_warnings"])


def find_agency_of(connection: sa.Connection, decode_id: str) -> str:
    """Whose a decode is."""
    return str(connection.execute(sa.select(decodes.c.agency_id).where(decodes.c.id == decode_id)).scalar_one())


def test_a_log_in_clear_is_used_only_if_that_is_said(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    rows = ["id,latitude,longitude,altitude,rssi,snr,timestamp"]
    for k in range(len(built.installed)):
        at = datetime.fromtimestamp(START_S + k, UTC).isoformat()
        rows.append(
            f"{built.installed.number[k]},{built.installed.lat_deg[k]:.8f},{built.installed.lon_deg[k]:.8f},0,-90,5,{at}"
        )
    data = "\n".join(rows).encode()
    refused = decoded(client, data, name="log.csv")
    assert refused["report"]["verdicts"]["unauthenticated"] == len(built.installed)
    assert refused["lane"]["refusal"]
    used = decoded(client, data, {"packets": {"accept_clear": True}}, name="log.csv")
    assert used["lane"]["refusal"] is None
    assert used["lane"]["localization_grade"] == "unfit"
    assert any("in clear" in doubt for doubt in used["lane"]["localization_warnings"])


def test_another_agency_learns_nothing(road: tuple[httpx.Client, BuiltLane], server: LiveServer) -> None:
    client, built = road
    heard, _hour = drive(built, 1920)
    with server.agency("strangers on the road", Scope.VEHICLE) as stranger:
        found = decoded(stranger, packed(heard))
        assert found["report"]["verdicts"]["unknown-marker"] == len(heard.packets)
        assert found["markers"] == []
        mine = decoded(client, packed(heard))
        for name in ("self", "plot", "lane"):
            assert stranger.get(mine["links"][name]).status_code == 404


@pytest.mark.parametrize(
    ("data", "context", "status", "field"),
    [
        (b"", None, 422, "file"),
        (b"hello world, this is no log\n", None, 415, "file"),
        (b"\x89PNG\r\n\x1a\n", None, 422, "file"),
        (b"x,y\n1,2\n", {"packets": {"columns": {"payload": "raw"}}}, 422, "packets.columns"),
        (b"x,y\n1,2\n", {"packets": {"columns": {"colour": "raw"}}}, 422, "packets.columns"),
        (b"x,y\n1,2\n", {"packets": {"method": "guess"}}, 422, "method"),
        (b"x,y\n1,2\n", {"packets": {"lane": {"usual_width_m": -1}}}, 422, "packets"),
        (b"x,y\n1,2\n", {"packets": {"freshness": {"echo_s": -1}}}, 422, "packets"),
        (b"x,y\n1,2\n", {"packets": {}, "trace": {}}, 422, "packets"),
        (b"x,y\n1,2\n", {"packets": {"poses": {"date": "2026-02-31"}}}, 422, "packets"),
    ],
)
def test_bad_uploads_name_what_is_wrong_and_leave_nothing(
    server: LiveServer, folder: Path, data: bytes, context: Any, status: int, field: str
) -> None:
    with server.agency("those with bad logs", Scope.VEHICLE) as client:
        before = sorted(path for path in (folder / "blobs").rglob("*") if path.is_file())
        answer = post(client, data, context, name="log.csv")
        assert answer.status_code == status, answer.text
        problem = answer.json()
        assert field in problem["field"], problem
        assert problem.get("cure") or problem["limit"]
        assert client.get("/v1/decodes").json()["items"] == []
        assert sorted(path for path in (folder / "blobs").rglob("*") if path.is_file()) == before


def test_a_repeated_request_gets_the_first_answer(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    heard, _hour = drive(built, 1921)
    data = packed(heard)
    first = post(client, data, **{"Idempotency-Key": "drive-1921"})
    again = post(client, data, **{"Idempotency-Key": "drive-1921"})
    assert (first.status_code, again.status_code) == (201, 201)
    assert again.headers["idempotency-replayed"] == "true"
    assert again.json() == first.json()


def test_a_long_log_is_a_job(road: tuple[httpx.Client, BuiltLane]) -> None:
    client, built = road
    heard, _hour = drive(built, 1922)
    lines = [json.loads(line) | {"note": "x" * 25_000} for line in write_packets(heard.packets).splitlines()]
    data = "".join(json.dumps(line) + "\n" for line in lines).encode()
    assert len(data) > 8 * 1024**2
    queued = post(client, data, name="packets.jsonl")
    assert queued.status_code == 202, queued.text
    path = queued.headers["location"]
    found = finished(client, path)
    assert found["state"] == "done", found
    assert found["report"]["verdicts"]["authentic"] == len(heard.packets)
    assert path_rms_m(built, found) < 0.15
