"""Packet logs of CERPMs in a decoder process: read, and a lane estimated through their markers."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from app.decoding.declarations import DeclaredPackets
from app.decoding.recordings import DriveFiles, estimate_path, read_drive_files
from app.errors import InvalidParameter
from app.formats.format import SpooledFile
from app.formats.images import ImageLimits, load_image
from app.formats.packets.rows import PacketLimits
from app.formats.traces.declaration import TraceLimits
from app.formats.traces.parts import open_parts
from app.lanes.overlay import LaneInFrame, LaneOverlay, VehiclePose, lane_in_frame, ned_from_enu
from app.lanes.smooth_line import plane_from_wgs84
from app.lanes.types import Lane, LaneMarkers, PacketStrengths
from app.plots.annotated_frame import draw_lane, encode_picture
from app.plots.lane import SignalPicture, picture_of_lane, plot_lane
from app.sensors.camera import Camera
from app.sensors.pose_track import PoseTrack
from app.services.decoder_tasks import decoder_task

if TYPE_CHECKING:  # it loads numba
    from app.simulation.steering import SteeringCheck

_LOG = ("log", "cut the log into shorter ones")

# === Reading.


@decoder_task(*_LOG)
def read_drive(
    name: str,
    file: SpooledFile,
    declared: DeclaredPackets = DeclaredPackets(),
    limits: PacketLimits = PacketLimits(),
    images: ImageLimits = ImageLimits(),
) -> DriveFiles:
    """Read the files of a drive."""
    return read_drive_files(name, file, declared, limits, images)


# === The lane.


_DEFAULT_SPEED_KM_H = 50.0
Pose = tuple[float, float, float]
"""Longitude, latitude and heading of a vehicle. [deg]"""
LeftOutMarker = tuple[int, float, float, str]
"""Number of a marker, longitude and latitude that it claims [deg], and why it was left out."""


class PosedCamera(NamedTuple):
    """The camera of a frame, and where the vehicle was when it was taken."""

    camera: Camera
    pose: Pose


@dataclass(frozen=True, slots=True, eq=False)
class LaneResult:
    """The lane and what follows from it."""

    lane: Lane
    steering: SteeringCheck | str | None  # the check, or why it could not be made
    overlay: LaneOverlay | None
    plot: bytes  # SVG
    decode_ms: float


@decoder_task(*_LOG)
def estimate_lane(
    markers: LaneMarkers,
    strengths: PacketStrengths,
    left_out: tuple[LeftOutMarker, ...],
    track: PoseTrack | None,
    declared: DeclaredPackets,
    signals: SignalPicture | None,
    camera: PosedCamera | None,
) -> LaneResult:
    """Estimate a lane through verified markers, simulate a drive along it, and draw it."""
    began = time.perf_counter()
    lane = estimate_path(markers, strengths, track, declared)
    steering = _check_steering(lane, declared.steering)
    overlay = _overlay(lane, markers, camera)
    decode_ms = 1e3 * (time.perf_counter() - began)
    return LaneResult(lane, steering, overlay, _plot(lane, markers, left_out, track, signals).encode(), decode_ms)


def _check_steering(lane: Lane, controller: str) -> SteeringCheck | str | None:
    if controller == "none" or len(lane.station_m) < 2:
        return None
    from app.lanes.control import Controller
    from app.simulation.steering import check_steering

    limit = lane.speed_limit_kmh
    speed = np.where(np.isfinite(limit), limit, np.nanmin(limit) if np.isfinite(limit).any() else _DEFAULT_SPEED_KM_H)
    try:
        return check_steering(lane.position_enu_m, speed, controller=Controller(controller))
    except InvalidParameter as error:
        return error.message


def _overlay(lane: Lane, markers: LaneMarkers, camera: PosedCamera | None) -> LaneOverlay | None:
    if camera is None or len(lane.station_m) < 2:
        return None
    origin = (lane.origin_lon_deg, lane.origin_lat_deg)
    lon_deg, lat_deg, heading_deg = camera.pose
    east, north = plane_from_wgs84(np.array([lon_deg]), np.array([lat_deg]), origin)[0]
    points = plane_from_wgs84(markers.lon_deg, markers.lat_deg, origin)
    return lane_in_frame(
        ned_from_enu(lane.left_enu_m),
        ned_from_enu(lane.right_enu_m),
        ned_from_enu(lane.position_enu_m),
        pose=VehiclePose((float(north), float(east), 0.0), heading_deg),
        camera=camera.camera,
        markers_ned_m=ned_from_enu(points[lane.side > 0]),
    )


def _plot(
    lane: Lane,
    markers: LaneMarkers,
    left_out: tuple[LeftOutMarker, ...],
    track: PoseTrack | None,
    signals: SignalPicture | None,
) -> str:
    picture = picture_of_lane(lane, markers, track)
    if left_out:
        origin = (lane.origin_lon_deg, lane.origin_lat_deg)
        numbers, lon_deg, lat_deg, reasons = zip(*left_out, strict=True)
        first = len(picture.marker_number)
        picture = replace(
            picture,
            marker_m=np.vstack([picture.marker_m, plane_from_wgs84(np.array(lon_deg), np.array(lat_deg), origin)]),
            marker_number=np.append(picture.marker_number, numbers),
            marker_side=np.append(picture.marker_side, np.zeros(len(numbers), int)),
            left_out={**picture.left_out, **{first + k: reason for k, reason in enumerate(reasons)}},
        )
    return plot_lane(picture, signals)


@decoder_task("frame", "send the frame at the camera's resolution", is_long=False)
def draw_overlay(file: SpooledFile, lane: LaneInFrame, suffix: str, images: ImageLimits) -> bytes:
    """Draw a lane over its camera frame in an upload, and encode it as ``png`` or ``jpg``."""
    with file.open() as stream:
        parts = open_parts({lane["frame"]: stream}, TraceLimits())
        data = next(part.content() for part in parts if part.name == lane["frame"])
    return encode_picture(draw_lane(load_image(data, images).pixels, lane), suffix)
