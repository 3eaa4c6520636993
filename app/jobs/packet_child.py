"""Packet logs, read and laid through a lane inside a decoder process."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from app.decoders.cerpm.lane import fit_lane
from app.decoders.cerpm.lane_frame import plane_from_wgs84
from app.decoders.cerpm.lane_types import Lane
from app.decoders.cerpm.log_report import LogReport
from app.decoders.cerpm.log_text import decode_text, find_table, is_text, match_columns, numbered_lines
from app.decoders.cerpm.overlay import LaneOverlay, VehiclePose, lane_in_frame, ned_from_enu
from app.decoders.cerpm.packet_log import read_packets
from app.decoders.cerpm.packet_log_rows import ALIASES, NEEDED
from app.decoders.cerpm.packets import HeardPacket
from app.decoders.cerpm.poses import read_poses
from app.decoders.images import ImageHeader, inspect_image, load_image
from app.decoders.traces.declaration import TraceLimits
from app.decoders.traces.parts import Part, open_parts
from app.errors import InvalidParameter, UnreadableUpload
from app.jobs.annotate import draw_lane, encode_picture
from app.jobs.lane_plot import picture_of_lane, plot_lane
from app.jobs.memory import memory_is_the_limit
from app.jobs.signal_plot import SignalPicture
from app.sensors.pose_track import PoseTrack
from app.services.packets import DriveFiles, DriveTask, LaneResult, LaneTask, OverlayTask, packet_terms
from app.services.positions import naming
from app.simulation.steering import SteeringCheck, check_steering

_DEFAULT_SPEED_KM_H = 50.0
_POSE_SUFFIXES = (".gpx", ".nmea", ".nma")
_LOG = ("log", "cut the log into shorter ones")
_PICTURES = (b"\xff\xd8\xff", b"\x89PNG")


# --- reading ------------------------------------------------------------------------------------------------------


def read_drive(task: DriveTask, _before: None) -> DriveFiles:
    """Read the files of a drive."""
    with memory_is_the_limit(*_LOG):
        return _read_drive(task)


def _read_drive(task: DriveTask) -> DriveFiles:
    began = time.perf_counter()
    terms = packet_terms(task.declared)
    packets: list[HeardPacket] = []
    track: PoseTrack | None = None
    frame: tuple[str, ImageHeader] | None = None
    reports: dict[str, LogReport] = {}
    for part in open_parts({task.name: task.data}, TraceLimits(file_bytes=task.packets.file_bytes)):
        if part.name.startswith("."):
            continue  # what a desktop leaves in a ZIP
        data = part.content()
        kind = terms.files.get(part.name) or _kind_of(part, data)
        if kind == "frame":
            if frame is not None:
                raise _twice("camera frame", part.name)
            frame = (part.name, inspect_image(data, task.images))
        elif kind == "poses":
            if track is not None:
                raise _twice("track", part.name)
            with naming("packets"):
                track, reports[part.name] = read_poses(part.name, data, terms.poses)
        else:
            with naming("packets"):
                log = read_packets(part.name, data, terms.packets, task.packets)
            first = sum(report.entries for name, report in reports.items() if name != part.name)
            packets += [replace(packet, entry=packet.entry + first) for packet in log.packets]
            reports[part.name] = log.report
    if not packets:
        raise UnreadableUpload(
            "there is no packet log in the upload",
            field="file",
            limit="one packet log at least",
            cure="declare which file it is in packets.files if its content does not show it",
        )
    driven_m = None if track is None else round(track.driven_m(), 2)
    return DriveFiles(packets, track, reports, frame, 1e3 * (time.perf_counter() - began), driven_m)


def _kind_of(part: Part, data: bytes) -> str:
    """What a file is, by its content; its suffix only where that cannot tell."""
    if data.startswith(_PICTURES):
        return "frame"
    if part.name.lower().endswith(_POSE_SUFFIXES):
        return "poses"
    if not is_text(data):
        return "packets"
    text, _note = decode_text(part.name, data[: 1 << 16])
    start = text.lstrip("\ufeff \t\r\n")
    if start.startswith(("<", "$G", "$P", "!")):
        return "poses"
    if start[:1] in ("{", "["):
        return "packets"
    _number, header = next(numbered_lines(text), (0, ""))
    found = match_columns(find_table(header).columns, ALIASES, {})
    if "payload" in found or all(quantity in found for quantity in NEEDED):
        return "packets"
    return "poses" if "lon" in found and "lat" in found else "packets"


def _twice(what: str, name: str) -> UnreadableUpload:
    return UnreadableUpload(
        f"{name} is a second {what}",
        field="file",
        limit=f"one {what} in an upload",
        cure="send each drive by itself, or name the kinds of its files in packets.files",
    )


# --- the lane -----------------------------------------------------------------------------------------------------


def lay_lane(task: LaneTask, _before: None) -> LaneResult:
    """Lay a lane through verified markers, check that it can be driven, and draw it."""
    with memory_is_the_limit(*_LOG):
        return _lay_lane(task)


def _lay_lane(task: LaneTask) -> LaneResult:
    began = time.perf_counter()
    terms = task.terms
    lane = fit_lane(task.markers, task.track, method=terms.method, rules=terms.lane)  # type: ignore[arg-type]
    steering = _check_steering(lane, task)
    overlay = _overlay(lane, task)
    decode_ms = 1e3 * (time.perf_counter() - began)
    return LaneResult(lane, steering, overlay, _plot(lane, task).encode(), decode_ms)


def _check_steering(lane: Lane, task: LaneTask) -> SteeringCheck | str | None:
    if task.terms.controller is None or len(lane.station_m) < 2:
        return None
    limit = lane.speed_limit_km_h
    speed = np.where(np.isfinite(limit), limit, np.nanmin(limit) if np.isfinite(limit).any() else _DEFAULT_SPEED_KM_H)
    try:
        return check_steering(lane.position_enu_m, speed, controller=task.terms.controller)
    except InvalidParameter as error:
        return error.message


def _overlay(lane: Lane, task: LaneTask) -> LaneOverlay | None:
    if task.camera is None or task.pose is None or len(lane.station_m) < 2:
        return None
    origin = (lane.origin_lon_deg, lane.origin_lat_deg)
    lon_deg, lat_deg, heading_deg = task.pose
    east, north = plane_from_wgs84(np.array([lon_deg]), np.array([lat_deg]), origin)[0]
    points = plane_from_wgs84(task.markers.lon_deg, task.markers.lat_deg, origin)
    return lane_in_frame(
        ned_from_enu(lane.left_enu_m),
        ned_from_enu(lane.right_enu_m),
        ned_from_enu(lane.position_enu_m),
        pose=VehiclePose((float(north), float(east), 0.0), heading_deg),
        camera=task.camera,
        markers_ned_m=ned_from_enu(points[lane.side > 0]),
    )


def _plot(lane: Lane, task: LaneTask) -> str:
    picture = picture_of_lane(lane, task.markers, task.track)
    if task.left_out:
        origin = (lane.origin_lon_deg, lane.origin_lat_deg)
        numbers, lon_deg, lat_deg, reasons = zip(*task.left_out, strict=True)
        first = len(picture.marker_number)
        picture = replace(
            picture,
            marker_m=np.vstack([picture.marker_m, plane_from_wgs84(np.array(lon_deg), np.array(lat_deg), origin)]),
            marker_number=np.append(picture.marker_number, numbers),
            marker_side=np.append(picture.marker_side, np.zeros(len(numbers), int)),
            left_out={**picture.left_out, **{first + k: reason for k, reason in enumerate(reasons)}},
        )
    distance_m, rssi_dbm = task.strengths
    signals = SignalPicture(distance_m, rssi_dbm, *(task.path_loss or (None, None))) if len(distance_m) else None
    return plot_lane(picture, signals)


def draw_overlay(task: OverlayTask, _before: None) -> bytes:
    """Draw a lane over the camera frame of an upload."""
    with memory_is_the_limit("frame", "send the frame at the camera's resolution"):
        parts = open_parts({task.frame: task.data}, TraceLimits())
        data = next(part.content() for part in parts if part.name == task.frame)
        return encode_picture(draw_lane(load_image(data, task.images).pixels, task.overlay), task.suffix)
