"""One simulated vehicle past markers of all families: what it uploads, and where it truly was.

The trace, the frames and the packets are of one motion, by the project's own simulators. The vehicle's point is the
middle of its magnetometer bar, above which the camera is mounted.
"""

from __future__ import annotations

import csv
import io
import math
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

import cv2
import httpx
import numpy as np

from app.encoders.cerpm import encode_message
from app.geodesy import enu_from_wgs84, wgs84_from_enu
from app.markers.cerpm import LaneSide
from app.markers.magnet import InformationTag, parse_tag
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme
from app.planning.cerpm_placement import place_markers
from app.sensors.camera import Camera
from app.simulation.backgrounds import road_background, road_photos
from app.simulation.camera import render_plate_scene
from app.simulation.conditions import draw_daylight
from app.simulation.magnetic.drive import Course, Scene, Vehicle, drive_course, simulate_drive
from app.simulation.magnetic.recorder import write_recorder_files
from app.simulation.magnetic.road import PlacedTag, Road
from app.simulation.plate_face import plate_face
from app.simulation.plate_scene import PlacedFace, PlateScene
from app.simulation.radio.drive import Drive, SatelliteReceiver, drive_past, observe_track, write_packets, write_poses
from app.simulation.radio.lanes import InstalledMarkers, TrueLane, install_markers, lane_between
from app.simulation.radio.link import Radio
from app.values import Floats

LENGTH_M, HALF_WIDTH_M = 170.0, 1.75
TAGS = (("SNS_4_0.1_10-30", 30.0), ("NNS_4_0.1_15-25", 85.0), ("SSN_4_0.1_30-10", 140.0))
PLATES_M, AHEAD_M, PLATE_LEFT_M = (45.0, 65.0, 105.0, 125.0, 160.0), (7.0, 5.0), 0.4
COURSE = Course(speeds=((0.0, 8.0), (60.0, 13.0), (110.0, 9.0), (LENGTH_M, 14.0)), weave_m=0.1)
CAMERA_LATE_S, LOG_LATE_S = 0.3, -0.15
"""[s] by which the clocks of the camera and of the packet log are behind that of the trace."""
CAMERA = Camera.from_field_of_view(1280, 720, 70.0)
T0_S = datetime(2026, 6, 1, 8, tzinfo=UTC).timestamp()
_POSITION = {"realization": "ITRF2014", "epoch": 2026.4, "horizontal_rmse_m": 0.01, "vertical_rmse_m": 0.02}


@dataclass(frozen=True, slots=True, eq=False)
class InstalledRoad:
    """A straight lane with registered markers of all families."""

    origin: tuple[float, float, float]  # longitude, latitude [deg] and height [m] of its first point
    road: Road
    lane: TrueLane
    plates: list[PlateCode]
    installed: InstalledMarkers
    keys: dict[int, bytes]  # of the CERPMs, by number

    def place(self, chainage_m: float, left_m: float = 0.0) -> tuple[float, float]:
        """Longitude and latitude of a point beside the lane. [deg]"""
        east, north = self.road.world_m(np.array([chainage_m]), left_m)[0]
        lon, lat, _up = wgs84_from_enu(np.array([east, north, 0.0]), self.origin)
        return float(lon), float(lat)


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """What a vehicle recorded: content and context of each upload; and the truth."""

    road: InstalledRoad
    uploads: dict[str, tuple[bytes, dict[str, Any]]]
    time_s: Floats
    chainage_m: Floats
    left_m: Floats

    def errors_m(self, time_s: Floats, lon_deg: Floats, lat_deg: Floats) -> tuple[Floats, Floats]:
        """Errors along and across the lane of positions at times on the trace's clock."""
        east, north, _up = enu_from_wgs84(lon_deg, lat_deg, np.zeros_like(lon_deg), (*self.road.origin[:2], 0.0))
        chainage, left = (np.interp(time_s, self.time_s, values) for values in (self.chainage_m, self.left_m))
        off = np.column_stack([east, north]) - self.road.road.world_m(chainage, left)
        yaw = self.road.road.yaw_rad(chainage)
        return off[:, 0] * np.cos(yaw) + off[:, 1] * np.sin(yaw), off[:, 1] * np.cos(yaw) - off[:, 0] * np.sin(yaw)


def install(client: httpx.Client, origin: tuple[float, float, float], rng: np.random.Generator) -> InstalledRoad:
    """Register plates, tags and CERPMs along a lane, over HTTP."""
    road = Road(LENGTH_M)
    sides = [road.world_m(np.arange(-20.0, LENGTH_M + 21.0, 2.0), left) for left in (HALF_WIDTH_M, -HALF_WIDTH_M)]
    lane = lane_between(sides[0], sides[1], origin)
    built = InstalledRoad(origin, road, lane, [], install_markers(lane, place_markers(*sides), rng), {})
    for at_m in PLATES_M:
        lon, lat = built.place(at_m, PLATE_LEFT_M)
        position = {"lon_deg": lon, "lat_deg": lat, "height_m": origin[2], **_POSITION}
        plate = _registered(client, {"position": position, "heading_deg": 30.0, "status": "surveyed"})
        built.plates.append(PlateCode(plate["code"]["digits"], PlateScheme(plate["code"]["scheme"])))
    line = {"type": "LineString", "coordinates": [built.place(s) for s in np.arange(0.0, LENGTH_M + 1, 10.0)]}
    for code, at_m in TAGS:
        survey = {name: value for name, value in _POSITION.items() if name != "vertical_rmse_m"}
        of_lane = {"geometry": line, "height_m": origin[2], **survey}
        tag = {"code": code, "codebook_id": None, "chainage_m": at_m, "offset_m": 0.0}
        _registered(client, {"family": "magnet", "lane": of_lane, "status": "surveyed", "tag": tag})
    _register_cerpms(client, built)
    return built


def record(road: InstalledRoad, seed: int, *, frames: bool = True) -> Recorded:
    """Drive along the road once."""
    vehicle = Vehicle.compact()
    motion = drive_course(COURSE, vehicle, LENGTH_M, np.random.default_rng(seed))  # the first that the drive draws
    tags = [PlacedTag(_tag(code), at_m, 0.0) for code, at_m in TAGS]
    trace = simulate_drive(Scene(road.road, vehicle, COURSE, tags=tags), np.random.default_rng(seed)).trace
    bar_m = float(np.mean(vehicle.bar.positions_m[vehicle.bar.array, 0]))
    chainage, left = motion.chainage_m + bar_m, motion.left_m + bar_m * np.sin(motion.slip_rad)
    point = road.road.world_m(chainage, left)
    yaw = road.road.yaw_rad(chainage) + motion.slip_rad
    drive = Drive(T0_S + motion.t_s, chainage, left, point, yaw, motion.speed_m_s)
    rng = np.random.default_rng([seed, 1])
    lon, lat = road.place(LENGTH_M / 2)
    near = {"coarse_position": {"lon_deg": lon, "lat_deg": lat, "accuracy_m": LENGTH_M}}
    uploads = {
        "trace": (_zipped(write_recorder_files(trace)), {**near, "captured_at": _stamp(trace.t_s[0]), "trace": {}})
    }
    if frames:
        uploads["frames"] = (_frames(road, drive, rng), {**near, "camera": {"horizontal_fov_deg": 70.0}})
    heard = drive_past(
        road.lane, road.installed, rng, sign=lambda m: encode_message(m, road.keys[m.number]), drive=drive,
        radio=Radio(interval_s=0.5), first_sequence=np.full(len(road.installed), 1000 * seed),
    )  # fmt: skip
    packets = [replace(packet, received_at_s=packet.received_at_s - LOG_LATE_S) for packet in heard.packets]
    track = replace(heard.track, time_s=heard.track.time_s - LOG_LATE_S)
    log = {"packets.jsonl": write_packets(packets).encode(), "poses.csv": write_poses(track).encode()}
    uploads["packets"] = (_zipped(log), {"packets": {}})
    return Recorded(road, uploads, drive.time_s, chainage, left)


def _frames(road: InstalledRoad, drive: Drive, rng: np.random.Generator) -> bytes:
    """A ZIP of frames in which plates are in view, with a list of their times and of a receiver's positions."""
    receiver = observe_track(road.lane, drive, SatelliteReceiver.plain(), rng)
    files, rows = {}, ["file,time,lon,lat,heading,accuracy"]
    for number, (at_s, scene) in enumerate(_scenes(road, drive, rng)):
        photo = road_photos()[number % len(road_photos())]
        image = render_plate_scene(scene, road_background(photo, CAMERA, rng), rng).image
        files[f"{number}.jpg"] = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
        lon, lat = (float(np.interp(at_s, receiver.time_s, v)) for v in (receiver.lon_deg, receiver.lat_deg))
        heading = float(90.0 - np.degrees(np.interp(at_s, drive.time_s, drive.yaw_rad))) % 360.0
        stamp = _stamp(at_s - T0_S - CAMERA_LATE_S)
        rows.append(f"{number}.jpg,{stamp},{lon:.9f},{lat:.9f},{heading:.2f},{receiver.accuracy_m[0]:.2f}")
    return _zipped({**files, "frames.csv": "\n".join(rows).encode()})


def _scenes(road: InstalledRoad, drive: Drive, rng: np.random.Generator) -> Iterator[tuple[float, PlateScene]]:
    for code, plate_m in zip(road.plates, PLATES_M, strict=True):
        conditions = draw_daylight(rng)
        face = plate_face(code, PlateGeometry(code.n), conditions.look, conditions.wear, rng)
        for ahead_m in AHEAD_M:
            at_s = float(np.interp(plate_m - ahead_m, drive.chainage_m, drive.time_s))
            left, speed = (float(np.interp(at_s, drive.time_s, v)) for v in (drive.left_m, drive.speed_m_s))
            slip = float(np.interp(at_s, drive.time_s, drive.yaw_rad)) - math.radians(60.0)
            c, s, aside = math.cos(slip), math.sin(slip), PLATE_LEFT_M - left
            placed = PlacedFace(face, ahead_m * c + aside * s, aside * c - ahead_m * s, math.degrees(slip))
            yield at_s, PlateScene(
                CAMERA, (placed,), speed, conditions.exposure_s, road_reflectance=conditions.road_reflectance,
                sensor=replace(conditions.sensor, readout_s=0.0, jpeg_quality=None),
            )  # fmt: skip


def _register_cerpms(client: httpx.Client, built: InstalledRoad) -> None:
    ids, marks = [], built.installed
    for k in range(len(marks)):
        position = {"lon_deg": float(marks.lon_deg[k]), "lat_deg": float(marks.lat_deg[k]), "height_m": 0.0}
        body = {
            "family": "cerpm", "position": {**position, **_POSITION}, "number": int(marks.number[k]),
            "side": LaneSide(int(marks.side[k])).name.lower(),
            "speed_limit": {"value": 50, "unit": "km/h"}, "radio": {"interval_s": 1.6}, "status": "active",
        }  # fmt: skip
        ids.append(_registered(client, body)["id"])
    programs = client.post("/v1/programs", json={"marker_ids": ids, "with_keys": True})
    assert programs.status_code == 200, programs.text
    for program in csv.DictReader(io.StringIO(programs.text)):
        built.keys[int(program["number"])] = bytes.fromhex(program["key_hex"])


def _registered(client: httpx.Client, body: dict[str, Any]) -> dict[str, Any]:
    answer = client.post("/v1/markers", json=body)
    assert answer.status_code == 201, answer.text
    document: dict[str, Any] = answer.json()
    return document


def _tag(code: str) -> InformationTag:
    tag = parse_tag(code)
    assert isinstance(tag, InformationTag)
    return tag


def _stamp(seconds: float) -> str:
    return datetime.fromtimestamp(T0_S + float(seconds), UTC).isoformat()


def _zipped(files: dict[str, bytes]) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return packed.getvalue()
