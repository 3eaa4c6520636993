"""The demo's CERPMs: registered along a real lane, programmed, driven past, and what a vehicle uploads of them."""

from __future__ import annotations

import csv
import io
import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files

import cv2
import httpx
import numpy as np

from app.demo.server import checked
from app.demo.table import LaneResult
from app.encoders.cerpm import encode_message
from app.lanes.overlay import VehiclePose, lane_in_frame, ned_from_enu
from app.markers.cerpm import CerpmMessage, LaneSide
from app.planning.cerpm_placement import place_markers
from app.sensors.camera import Camera
from app.sensors.pose_track import ReceivedPacket
from app.simulation.radio.attacks import forge_packets, move_claim, number_entries, replay_packets
from app.simulation.radio.drive import SatelliteReceiver, SimulatedDrive, drive_past, write_packets, write_poses
from app.simulation.radio.lanes import InstalledMarkers, TrueLane, install_markers, lane_from_wgs84
from app.simulation.radio.link import Radio
from app.simulation.steering import PoseNoise, check_steering
from app.values import Floats, JsonObject

INTERVAL_S = 1.6  # [s] at 20 dBm the transmitter may send 1 % of the time: `app.radio.settings`
SPEED_KM_H = 30
SPEED_LIMIT = {"value": SPEED_KM_H, "unit": "km/h"}
SURVEY_RMSE_M = 0.03
FORGED, REPLAYED = 200, 200
MOVED_M = 30.0
_START_S = datetime(2026, 6, 2, 8, tzinfo=UTC).timestamp()
_DRIVE_APART_S = 3600.0
CAMERA = {"horizontal_fov_deg": 70.0, "height_m": 1.5, "depression_deg": 8.0}
_FRAME_PX = (1280, 720)
_FRAME_AT = 0.3  # of the drive
_COVERED_M = 1.0


@dataclass(frozen=True, slots=True)
class LaneDrive:
    """A drive past the markers, and what is wrong with it."""

    name: str
    receiver: SatelliteReceiver
    attacked: bool = False
    moved: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class BuiltLane:
    """What was registered and programmed."""

    lane: TrueLane
    installed: InstalledMarkers
    markers: list[dict[str, object]]  # as the registry has them
    keys: dict[int, bytes]  # as the programming station got them
    table: str


def list_lane_drives() -> tuple[LaneDrive, ...]:
    """An ordinary one, one under attack, one past a marker that was moved, and one without RTK."""
    return (
        LaneDrive("ordinary", SatelliteReceiver.rtk()),
        LaneDrive("forged, replayed", SatelliteReceiver.rtk(), attacked=True),
        LaneDrive("a marker moved", SatelliteReceiver.rtk(), moved=True),
        LaneDrive("2 m positions", SatelliteReceiver.plain()),
    )


def load_lane() -> TrueLane:
    """The demo's lane in Karlsruhe."""
    lane = json.loads(files("app.demo").joinpath("data/lane.geojson").read_text())
    sides = {feature["properties"]["side"]: feature["geometry"]["coordinates"] for feature in lane["features"]}
    return lane_from_wgs84(sides["L"], sides["R"])


def build_lane(client: httpx.Client, rng: np.random.Generator) -> BuiltLane:
    """Place markers along the demo's lane, survey them, and register them."""
    lane = load_lane()
    return register_lane(client, lane, install_markers(lane, place_markers(lane.left_m, lane.right_m), rng))


def register_lane(client: httpx.Client, lane: TrueLane, installed: InstalledMarkers) -> BuiltLane:
    """Register the markers of a road with a lane, and fetch what they are programmed with."""
    markers = [
        checked(
            client.post(
                "/v1/markers",
                json={
                    "family": "cerpm",
                    "position": {
                        "lon_deg": float(installed.lon_deg[k]),
                        "lat_deg": float(installed.lat_deg[k]),
                        "height_m": 0.0,
                        "realization": "ITRF2014",
                        "epoch": 2026.4,
                        "horizontal_rmse_m": SURVEY_RMSE_M,
                        "survey_method": "GNSS RTK",
                    },
                    "number": int(installed.number[k]),
                    "side": LaneSide(int(installed.side[k])).name.lower(),
                    "speed_limit": SPEED_LIMIT,
                    "radio": {"interval_s": INTERVAL_S},
                    "status": "active",
                    "measure_m": round(float(installed.chainage_m[k]), 3),
                },
            )
        ).json()
        for k in range(len(installed))
    ]
    wanted = {"marker_ids": [marker["id"] for marker in markers]}
    table = checked(client.post("/v1/programs", json=wanted)).text
    secret = checked(client.post("/v1/programs", json={**wanted, "with_keys": True})).text
    programs = csv.DictReader(io.StringIO(secret))
    keys = {int(program["number"]): bytes.fromhex(program["key_hex"]) for program in programs}
    return BuiltLane(lane, installed, markers, keys, table)


def drive_lane_and_judge(
    client: httpx.Client, built: BuiltLane, drive: LaneDrive, number: int, before: Sequence[ReceivedPacket],
    rng: np.random.Generator,
) -> tuple[LaneResult, JsonObject, bytes, JsonObject, list[ReceivedPacket]]:  # fmt: skip
    """Drive past what is built, upload what was received, compare with the truth.

    Returns
    -------
    result : LaneResult
    decode : dict
        The server's answer.
    recording : bytes
        ZIP of packets, poses and a camera frame, as uploaded.
    context : dict
        Uploaded with it.
    packets : list of ReceivedPacket
        For others to replay.
    """
    installed, moved = built.installed, None
    if drive.moved:
        row = len(installed) // 2
        moved = int(installed.number[row])
        installed = move_claim(built.lane, installed, row, rng, distance_m=MOVED_M)
    start_s = _START_S + number * _DRIVE_APART_S
    first = np.full(len(installed), int(number * _DRIVE_APART_S / INTERVAL_S))
    simulated = drive_past(
        built.lane, installed, rng, sign=lambda message: _sign(built, message), radio=Radio(interval_s=INTERVAL_S),
        receiver=drive.receiver, start_s=start_s, first_sequence=first,
    )  # fmt: skip
    packets = list(simulated.packets)
    if drive.attacked:
        span = (float(simulated.drive.time_s[0]), float(simulated.drive.time_s[-1]))
        packets += forge_packets(packets, FORGED, rng) + replay_packets(list(before), REPLAYED, rng, at_s=span)
        packets = number_entries(sorted(packets, key=lambda packet: packet.received_at_s))
    recording, captured_at = _pack(built, simulated, packets)
    context = {
        "camera": {**CAMERA, "width_px": _FRAME_PX[0], "height_px": _FRAME_PX[1]},
        "captured_at": captured_at,
        "packets": {},
    }
    parts = {
        "file": ("drive.zip", recording, "application/zip"),
        "context": ("context", json.dumps(context).encode(), "application/json"),
    }
    decode: JsonObject = checked(client.post("/v1/decodes", files=parts)).json()
    return judge_lane(built, drive, moved, simulated, decode), decode, recording, context, list(simulated.packets)


def _sign(built: BuiltLane, message: CerpmMessage) -> bytes:
    return encode_message(message, built.keys[message.number])


def judge_lane(
    built: BuiltLane, drive: LaneDrive, moved: int | None, simulated: SimulatedDrive, decode: JsonObject
) -> LaneResult:
    """The server's answer against what was simulated."""
    verdicts, lane = decode["report"]["verdicts"], decode["lane"]
    true = {packet.payload for packet in simulated.packets}
    result = LaneResult(
        drive.name,
        markers=len(built.installed),
        packets=decode["report"]["packets"],
        authentic=verdicts["authentic"],
        true_packets=len(true),
        left_out=[marker["number"] for marker in decode["markers"] if marker["left_out"]],
        moved=moved,
    )
    if lane is None or lane["refusal"]:
        return result
    stations = lane["stations"]
    path = built.lane.enu_from_wgs84(stations["lon_deg"], stations["lat_deg"])
    errors, covered = path_errors_m(built.lane, path)
    result.path_rms_m = float(np.sqrt(np.mean(errors**2)))
    result.path_max_m = float(np.abs(errors).max())
    result.coverage = covered
    track_errors, _covered = path_errors_m(
        built.lane, built.lane.enu_from_wgs84(simulated.track.lon_deg, simulated.track.lat_deg)
    )
    result.track_rms_m = float(np.sqrt(np.mean(track_errors**2)))
    steering = check_steering(
        path, SPEED_KM_H, truth_enu_m=built.lane.centre_m, noise=PoseNoise(), rng=np.random.default_rng(0)
    )
    if steering.completed:
        result.steering_rms_m = steering.rms_m
    return result


def path_errors_m(lane: TrueLane, path_m: Floats) -> tuple[Floats, float]:
    """How far the centre line's points are from a path, left of it positive, where it passes them; and the share."""
    centre = lane.centre_m
    step = np.diff(path_m, axis=0)
    square = np.maximum((step**2).sum(1), 1e-12)
    errors = np.full(len(centre), np.nan)
    for k, point in enumerate(centre):
        share = ((point - path_m[:-1]) * step).sum(1) / square
        on = path_m[:-1] + np.clip(share, 0, 1)[:, None] * step
        away = np.linalg.norm(point - on, axis=1)
        near = int(away.argmin())
        beyond = (near == 0 and share[0] < -1e-6) or (near == len(step) - 1 and share[-1] > 1 + 1e-6)
        if not beyond:
            side = step[near, 0] * (point - on[near])[1] - step[near, 1] * (point - on[near])[0]
            errors[k] = np.copysign(away[near], side)
    known = np.isfinite(errors)
    return errors[known], float((np.abs(errors[known]) < _COVERED_M).sum() / len(centre))


# --- what the vehicle uploads -------------------------------------------------------------------------------------


def _pack(built: BuiltLane, simulated: SimulatedDrive, packets: Sequence[ReceivedPacket]) -> tuple[bytes, str]:
    at_s = float(simulated.track.time_s[int(_FRAME_AT * len(simulated.track.time_s))])
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("packets.jsonl", write_packets(packets))
        archive.writestr("poses.csv", write_poses(simulated.track))
        archive.writestr("frame.jpg", draw_frame(built.lane, simulated, at_s))
    return packed.getvalue(), datetime.fromtimestamp(at_s, UTC).isoformat()


def draw_frame(lane: TrueLane, simulated: SimulatedDrive, at_s: float) -> bytes:
    """A plain camera frame of the true lane: asphalt, sky and painted lines. JPEG."""
    width, height = _FRAME_PX
    camera = Camera.from_field_of_view(width, height, **CAMERA)
    drive = simulated.drive
    east, north = (float(np.interp(at_s, drive.time_s, drive.point_m[:, k])) for k in range(2))
    heading_deg = float(90.0 - np.degrees(np.interp(at_s, drive.time_s, drive.yaw_rad)))
    picture = np.full((height, width, 3), 90, np.uint8)
    horizon = round(camera.cy_px - camera.fy_px * np.tan(np.radians(camera.depression_deg)))
    picture[: max(horizon, 0)] = (235, 206, 170)
    sides = [ned_from_enu(line) for line in (lane.left_m, lane.right_m, lane.centre_m)]
    seen = lane_in_frame(*sides, pose=VehiclePose((north, east, 0.0), heading_deg), camera=camera)
    for line in (seen.left, seen.right):
        for piece in line.pieces_px:
            points = np.round(piece * 16).astype(np.int32).reshape(-1, 1, 2)
            cv2.polylines(picture, [points], False, (235, 235, 235), 5, cv2.LINE_AA, 4)
    noise = np.random.default_rng(0).normal(0, 6, picture.shape)
    picture = np.clip(picture + noise, 0, 255).astype(np.uint8)
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
