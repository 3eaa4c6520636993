"""Packet logs, read inside a decoder process, and the lane through their markers."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import BinaryIO

import numpy as np

from app.errors import InvalidParameter, UnreadableUpload, naming
from app.formats.images import ImageHeader, inspect_image, load_image
from app.formats.kinds import detect_drive_file
from app.formats.log_report import LogReport
from app.formats.packets.read import read_packets
from app.formats.poses.read import read_poses
from app.formats.traces.declaration import TraceLimits
from app.formats.traces.parts import open_parts
from app.jobs.memory_limit import memory_is_the_limit
from app.lanes.estimate import fit_lane
from app.lanes.local_plane import plane_from_wgs84
from app.lanes.overlay import LaneOverlay, VehiclePose, lane_in_frame, ned_from_enu
from app.lanes.types import Lane
from app.plots.annotated_frame import draw_lane, encode_picture
from app.plots.lane import picture_of_lane, plot_lane
from app.plots.signal import SignalPicture
from app.sensors.pose_track import PoseTrack
from app.sensors.receiver import ReceivedPacket
from app.services.decodes.packet_task import DriveFiles, DriveTask, LaneResult, LaneTask, OverlayTask, packet_terms
from app.simulation.steering import SteeringCheck, check_steering

_DEFAULT_SPEED_KM_H = 50.0
_LOG = ("log", "cut the log into shorter ones")


# --- reading ------------------------------------------------------------------------------------------------------


def read_drive(task: DriveTask, _before: None) -> DriveFiles:
    """Read the files of a drive."""
    with memory_is_the_limit(*_LOG), task.file.open() as stream:
        return _read_drive(task, stream)


def _read_drive(task: DriveTask, stream: BinaryIO) -> DriveFiles:
    began = time.perf_counter()
    terms = packet_terms(task.declared)
    packets: list[ReceivedPacket] = []
    track: PoseTrack | None = None
    frame: tuple[str, ImageHeader] | None = None
    reports: dict[str, LogReport] = {}
    for part in open_parts({task.name: stream}, TraceLimits(file_bytes=task.packets.file_bytes)):
        if part.name.startswith("."):
            continue  # what a desktop leaves in a ZIP
        data = part.content()
        kind = terms.files.get(part.name) or detect_drive_file(part.name, data)
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


def _twice(what: str, name: str) -> UnreadableUpload:
    return UnreadableUpload(
        f"{name} is a second {what}",
        field="file",
        limit=f"one {what} in an upload",
        cure="send each drive by itself, or name the kinds of its files in packets.files",
    )


# --- the lane -----------------------------------------------------------------------------------------------------


def estimate_lane(task: LaneTask, _before: None) -> LaneResult:
    """Estimate a lane through verified markers, simulate a drive along it, and plot it."""
    with memory_is_the_limit(*_LOG):
        return _estimate_lane(task)


def _estimate_lane(task: LaneTask) -> LaneResult:
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
    with memory_is_the_limit("frame", "send the frame at the camera's resolution"), task.file.open() as stream:
        parts = open_parts({task.frame: stream}, TraceLimits())
        data = next(part.content() for part in parts if part.name == task.frame)
        return encode_picture(draw_lane(load_image(data, task.images).pixels, task.overlay), task.suffix)
