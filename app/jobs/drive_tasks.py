"""Traces, packet logs and tracks of drives, inside a decoder process."""

from __future__ import annotations

import time
import zlib
from dataclasses import replace
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.decoder import VERSION, decode_trace
from app.decoders.magnet.identify import TagCandidates
from app.decoders.magnet.readings import Finding
from app.decoders.magnet.recording_check import find_mistakes
from app.errors import InvalidParameter, UnreadableUpload, naming
from app.formats.images import ImageHeader, inspect_image, load_image
from app.formats.kinds import detect_drive_file
from app.formats.logs import LogReport
from app.formats.packets.read import read_packets
from app.formats.poses import read_poses
from app.formats.traces.declaration import TraceLimits
from app.formats.traces.parts import NEAR_S, open_parts
from app.formats.traces.read import read_trace
from app.jobs.frame_tasks import memory_is_the_limit
from app.lanes.estimate import fit_lane
from app.lanes.overlay import LaneOverlay, VehiclePose, lane_in_frame, ned_from_enu
from app.lanes.smooth_line import plane_from_wgs84
from app.lanes.types import Lane
from app.markers.magnet import MOMENT_AM2, InformationTag, Orientation, parse_tag
from app.plots.annotated_frame import draw_lane, encode_picture
from app.plots.lane import SignalPicture, picture_of_lane, plot_lane
from app.plots.trace import plot_trace
from app.sensors.magnetometer_bar import MagnetTrace
from app.sensors.pose_track import PoseTrack, ReceivedPacket
from app.services.decodes.tasks import TRACE_METHODS as METHODS
from app.services.decodes.tasks import (
    CompileTracesTask,
    DriveFiles,
    DriveTask,
    LaneResult,
    LaneTask,
    OverlayTask,
    TraceMotion,
    TraceResult,
    TraceTask,
    TraceTerms,
    packet_terms,
    trace_terms,
)
from app.services.drives.documents import TrackTask, WrittenTrack, track_report
from app.simulation.magnetic.dipoles import dipole_field_ut
from app.simulation.steering import SteeringCheck, check_steering

# === A recording, read and decoded inside a decoder process.


_MOTION_STEP_S = 0.1  # [s] source: app/tracks/time_base.py has a node every 0.1 s
_MOTION_VALUES = 36_000  # at most; an hour, 0.5 MB of JSON

# the drive that is decoded to compile the kernels
_COMPILED_M, _COMPILED_M_S, _COMPILED_STEP_S, _COMPILED_CLEARANCE_M = 40.0, 12.0, 0.005, 0.2
_EARTH_UT, _NOISE_UT = (20.0, 0.0, -43.0), 1.0


def decode_recording(task: TraceTask, _before: None) -> TraceResult:
    """Read the files of a recording and decode their trace."""
    with memory_is_the_limit("recording", "cut the recording into shorter ones"):
        return _decode_recording(task)


def compile_traces(_task: CompileTracesTask, _before: None) -> None:
    """Decode a drive over one tag: the kernels are compiled, or loaded from numba's cache.

    The drive is straight and even. `simulate_drive` would load 45 MB of scipy into an idle process.
    """
    tag = parse_tag("SNS_4_0.1_10-30")
    assert isinstance(tag, InformationTag)
    bar = trace_terms({}).bar
    rng = np.random.default_rng(1)
    t_s = np.arange(0.0, _COMPILED_M / _COMPILED_M_S, _COMPILED_STEP_S)
    travelled_m = _COMPILED_M_S * t_s[:, None] * (1.0, 0.0, 0.0)
    points_m = (travelled_m[:, None] + bar.positions_m + (0.0, 0.0, _COMPILED_CLEARANCE_M)).reshape(-1, 3)
    field_ut = rng.normal(_EARTH_UT, _NOISE_UT, points_m.shape)
    for magnet in tag.magnets:
        place_m = np.array([_COMPILED_M / 2 + magnet.along_m, magnet.lateral_m, 0.0])
        axis = (0.0, 0.0, 1.0) if magnet.orientation is Orientation.UP else (1.0, 0.0, 0.0)
        field_ut += dipole_field_ut(points_m, place_m, magnet.polarity.sign * MOMENT_AM2 * np.array(axis))
    trace = MagnetTrace(t_s, field_ut.reshape(t_s.size, -1, 3), t_s, np.full(t_s.size, _COMPILED_M_S))
    decode_trace(trace, bar, candidates=TagCandidates(tags=[tag]))


def _decode_recording(task: TraceTask) -> TraceResult:
    began = time.perf_counter()
    terms = trace_terms(task.declared)
    with task.file.open() as stream:
        file = read_trace({task.name: stream}, terms.declaration, task.limits)
    loaded = time.perf_counter()
    trace = file.trace
    findings, version = _decode(task, terms, trace)
    if terms.method == METHODS[0]:
        for mistake in find_mistakes(trace, terms.bar, findings):
            file.report.warn(mistake.text)
    decoded = time.perf_counter()
    return TraceResult(
        tuple(findings),
        file.report,
        _driven_m(trace),
        version,
        plot_trace(trace, terms.bar, findings).encode(),
        1e3 * (loaded - began),
        1e3 * (decoded - loaded),
        _motion(trace),
    )


def _decode(task: TraceTask, terms: TraceTerms, trace: MagnetTrace) -> tuple[list[Finding], str]:
    """Findings, and the decoder's version."""
    if terms.method == "metro":
        from app.decoders.magnet import metro  # only here: scipy.signal takes most of a second to load

        return metro.decode_trace_metro(trace, terms.bar), metro.VERSION
    tags = [tag for text in task.tags if isinstance(tag := parse_tag(text), InformationTag)]
    candidates = TagCandidates(tags=tags) if tags else TagCandidates(formats=terms.formats or task.formats)
    return decode_trace(trace, terms.bar, candidates=candidates), VERSION


def _motion(trace: MagnetTrace) -> TraceMotion:
    """Speed and heading ten times a second, less often in recordings of more than an hour."""
    duration = float(trace.t_s[-1] - trace.t_s[0])
    step = max(_MOTION_STEP_S, duration / _MOTION_VALUES)
    at = trace.t_s[0] + step * np.arange(int(duration / step) + 1)
    speed = _near(at, trace.speed_t_s, trace.speed_m_s)
    heading: list[float] = []
    if trace.heading_t_s is not None and trace.heading_deg is not None:
        heading = _near(at, trace.heading_t_s, np.unwrap(trace.heading_deg, period=360.0))
    return TraceMotion(float(trace.t_s[0]), step, tuple(speed), tuple(value % 360.0 for value in heading))


def _near(at: npt.NDArray[np.float64], time_s: npt.ArrayLike, values: npt.ArrayLike) -> list[float]:
    """Values between samples; NaN where none is near, an empty list where there are none."""
    time, given = np.asarray(time_s, float), np.asarray(values, float)
    kept = np.isfinite(time) & np.isfinite(given)
    time, given = time[kept], given[kept]
    if not time.size:
        return []
    after = np.clip(np.searchsorted(time, at), 1, max(time.size - 1, 1))
    near = np.minimum(np.abs(at - time[after - 1]), np.abs(at - time[np.minimum(after, time.size - 1)])) <= NEAR_S
    joined: list[float] = np.where(near, np.interp(at, time, given), np.nan).tolist()
    return joined


def _driven_m(trace: MagnetTrace) -> float:
    """Length of the drive by the vehicle's speed. [m]"""
    speed = np.interp(trace.t_s, trace.speed_t_s, trace.speed_m_s)
    return float(np.sum(np.diff(trace.t_s) * (speed[1:] + speed[:-1]) / 2))


# === Packet logs, read inside a decoder process, and the lane through their markers.


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


# === A drive's track, inside a decoder process.


def write_track(task: TrackTask, _before: None) -> WrittenTrack:
    """Estimate a track and write its files."""
    from app.plots.track import plot_track  # only here: numba takes a second to load
    from app.tracks.estimate import estimate_track
    from app.tracks.files import write_csv, write_geojson, write_gpx

    with memory_is_the_limit("drive", "make several drives of it"):
        track = estimate_track(task.given, task.rules)
        others = [
            {
                "marker_id": entry.marker_id, "family": entry.family, "decode_id": entry.decode_id,
                "place": entry.place, "used": False, "reason": str(entry.reason), "detail": entry.detail,
            }
            for entry in task.left_out
        ]  # fmt: skip
        texts = {
            "track.geojson": write_geojson(track, task.name, others),
            "track.csv": write_csv(track),
            "track.gpx": write_gpx(track, task.name),
            "plot.svg": plot_track(track, task.name),
        }
        report = track_report(track, task.left_out, task.on_lane, task.warnings)
        return WrittenTrack(report, {name: zlib.compress(text.encode()) for name, text in texts.items()})
