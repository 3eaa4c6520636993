"""Frames: through a decoder process, then matched against the registered markers."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from datetime import datetime

import sqlalchemy as sa

from app.decoders.plate.rolling_shutter import locate_moving_plate
from app.errors import UploadTooLarge
from app.families.frames import FrameReading, Match
from app.families.plate.plates import PLATE
from app.formats.archives import Member
from app.formats.image_headers import is_picture, unknown_picture
from app.formats.images import ImageHeader, ImageLimits, inspect_image
from app.formats.kinds import list_decoded
from app.formats.spooled_file import SpooledFile
from app.geodesy import decimal_year
from app.markers.reading import PlateReading
from app.registry.database import Database
from app.registry.decodes import NewObservation
from app.sensors.camera import Camera
from app.services.decoder_processes import DecoderProcesses, Pending
from app.services.decodes.context import DecodeContext
from app.services.decodes.fixes import fix_from_match, fuse_fixes
from app.services.decodes.frame_documents import DriveNotes, ReadFrame, ReadMarker, frames_result
from app.services.decodes.frame_poses import FramePlaces, FramePose
from app.services.decodes.frame_task import FramePicture, FrameResult, FrameSearch, FrameTask
from app.services.decodes.kinds import DecodeKind
from app.services.decodes.matching import FRAME_READERS, NearbyMarkers, find_nearby_markers, match_reading
from app.services.decodes.rules import DecodeRules
from app.services.decodes.upload_path import Decoded, Upload, UploadHandler
from app.services.health.evidence import EVIDENCE
from app.services.health.frames import frame_health, missed_observations, unregistered_readings

_SIGNATURE_BYTES = 16
_DECLARE = "send one of these; a trace or a packet log of any name is read where the context has trace or packets"
_LARGE = threading.Semaphore(2)
"""Frames that are not held in memory are inspected two at a time, because that reads them whole."""


@dataclass(frozen=True, slots=True)
class FrameSignal:
    """What a decoder process found in a frame, and the markers that it was looking for."""

    result: FrameResult
    nearby: NearbyMarkers


@dataclass(slots=True)
class StartedFrame:
    """A frame in a decoder process, which loads the picture and then waits for `look_for`."""

    camera: Camera | None
    pending: Pending[FrameResult]
    search: Future[FrameSearch]
    nearby: NearbyMarkers | None = None

    def look_for(self, nearby: NearbyMarkers) -> None:
        """Let the process go on: the markers that the registry has near by are known."""
        self.nearby = nearby
        self.search.set_result(search_for(nearby, self.camera))

    def result(self) -> FrameSignal:
        """Wait for the readings."""
        assert self.nearby is not None
        return FrameSignal(self.pending.result(), self.nearby)

    def cancel(self) -> None:
        """Stop the process."""
        self.pending.cancel()


def search_for(nearby: NearbyMarkers, camera: Camera | None) -> FrameSearch:
    """What to look for in a frame of this camera."""
    searches = {name: reader.search(nearby.of(name), camera) for name, reader in FRAME_READERS.items()}
    return FrameSearch({name: search for name, search in searches.items() if search is not None})


class FrameHandler(UploadHandler[FrameSignal]):
    """A single frame, decoded while the caller waits. It accepts every upload, so it comes last."""

    kind = DecodeKind.FRAME

    def __init__(self, database: Database, processes: DecoderProcesses, rules: DecodeRules) -> None:
        self._database, self._processes, self._rules = database, processes, rules

    def accepts(self, context: DecodeContext, file: SpooledFile) -> bool:
        """Every upload."""
        return True

    def is_job(self, file: SpooledFile) -> bool:
        """Never: a frame takes some milliseconds. What is no picture is of no kind that any handler decodes."""
        head = file.head(_SIGNATURE_BYTES)
        if head and not is_picture(head):
            raise unknown_picture(head, list_decoded(), _DECLARE)
        return False

    def start(self, upload: Upload) -> StartedFrame:
        """Hand the frame over, and look up the markers near by while the process loads the picture."""
        started = start_frame(self._processes, upload.file, upload.context, self._rules.images, wait_s=upload.wait_s)
        try:
            with self._database.read() as connection:
                nearby = find_nearby_markers(connection, upload.agency_id, upload.context.coarse_position)
            started.look_for(nearby)
        except BaseException:
            started.cancel()
            raise
        return started

    def match(self, connection: sa.Connection, upload: Upload, signal: FrameSignal) -> Decoded:
        """Match the frame's readings."""
        context = upload.context
        at = context.captured_at or FramePlaces(context).time_of(0, taken=signal.result.header.taken)
        pose = FramePlaces(context).pose_of(None)
        frame = read_frame(
            connection, upload, Member(0, ""), signal.result, signal.nearby, FrameMoment(context, at, pose)
        )
        return decoded_frames([frame], len(signal.nearby.codebook), upload.observed_at)


def start_frame(
    processes: DecoderProcesses, file: SpooledFile, context: DecodeContext, limits: ImageLimits, *, wait_s: float = 0.0
) -> StartedFrame:
    """Hand a frame to a decoder process, after checking its header against the limits and the camera.

    Raises
    ------
    UnreadableUpload, InvalidParameter
        The frame is refused, or it is not this camera's.
    Unavailable
        The decoder processes are busy.
    """
    header = inspect_frame(file, context, limits)
    camera = context.camera.camera_for(header) if context.camera else None
    task = FrameTask(FramePicture(file, context.thermal, context.thermal_range, limits))
    return StartedFrame(camera, processes.submit(task, wait_s=wait_s), task.search)


def inspect_frame(file: SpooledFile, context: DecodeContext, limits: ImageLimits) -> ImageHeader:
    """Header of a frame, checked against the limits; raises as `start_frame`."""
    if file.size > limits.file_bytes:
        raise UploadTooLarge(
            f"a picture of {file.size} bytes",
            field="file",
            limit=f"{limits.file_bytes} bytes",
            cure="send the frame as the camera wrote it",
        )
    if file.path is None:
        return inspect_image(file.read(), limits, thermal=context.thermal)
    with _LARGE:
        return inspect_image(file.read(), limits, thermal=context.thermal)


@dataclass(frozen=True, slots=True)
class FrameMoment:
    """When a frame was taken, where the vehicle was, and the context that follows from it."""

    context: DecodeContext
    at: datetime | None = None
    pose: FramePose | None = None


def read_frame(
    connection: sa.Connection, upload: Upload, member: Member, result: FrameResult, nearby: NearbyMarkers,
    moment: FrameMoment, *, speed_m_s: float | None = None,
) -> ReadFrame:  # fmt: skip
    """Match a frame's readings and compute the vehicle's position from them.

    The speed is the one that successive frames show; that of the frame's pose goes first.
    """
    context, epoch = moment.context, decimal_year(moment.at or upload.observed_at)
    camera = context.camera.camera_for(result.header) if context.camera else None
    if moment.pose is not None and moment.pose.speed_m_s is not None:
        speed_m_s = moment.pose.speed_m_s
    markers = []
    for found in result.readings:
        reading = at_middle_row(found, camera, speed_m_s)
        match = match_reading(connection, upload.agency_id, reading, context.coarse_position, nearby)
        fix = None
        if match is not None and camera is not None and reading.pose is not None:
            fix = fix_from_match(reading.pose, camera, match, context.heading_deg, epoch=epoch)
        markers.append(ReadMarker(reading, match, fix))
    frame = ReadFrame(
        index=member.index,
        name=member.name or None,
        header=result.header,
        markers=tuple(markers),
        fix=fuse_fixes([marker.fix for marker in markers if marker.fix is not None]),
        load_ms=result.load_ms,
        decode_ms=result.decode_ms,
        captured_at=moment.at,
        pose=moment.pose,
    )
    return replace(frame, health=frame_health(frame, context, nearby.of(PLATE.name), moment.at or upload.observed_at))


def at_middle_row(reading: FrameReading, camera: Camera | None, speed_m_s: float | None) -> FrameReading:
    """A plate's reading with its pose at the time of the frame's middle row, if the camera has a rolling shutter."""
    if (
        camera is None or not camera.readout_s or not speed_m_s or not isinstance(reading, PlateReading)
        or reading.pose is None or reading.geometry is None or reading.corners_px is None
        or reading.corners_covariance_px2 is None
    ):  # fmt: skip
        return reading
    pose = locate_moving_plate(reading.corners_px, reading.corners_covariance_px2, reading.geometry, camera, speed_m_s)
    return replace(reading, pose=pose)


def decoded_frames(
    frames: Sequence[ReadFrame], codebook_plates: int, observed_at: datetime, notes: DriveNotes | None = None
) -> Decoded:
    """Frames that were matched, ready to be stored."""
    document = frames_result(frames, codebook_plates=codebook_plates, notes=notes)
    observations = [*_observations(frames, observed_at), *missed_observations(frames, observed_at)]
    return Decoded(document, observations, unregistered=unregistered_readings(frames))


def _observations(frames: Sequence[ReadFrame], observed_at: datetime) -> list[NewObservation]:
    """One row for each marker and frame; of a marker that a frame shows twice the more confident reading counts."""
    rows: dict[tuple[int, str], NewObservation] = {}
    for frame in frames:
        evidence = frame.health.of_readings or ({},) * len(frame.markers)
        shown = zip(frame.markers, evidence, strict=True)
        for marker, evident in sorted(shown, key=lambda one: -one[0].reading.confidence):
            if marker.match is None or marker.match.row is None:
                continue
            marker_id = str(marker.match.row.id)
            detail = FRAME_READERS[marker.reading.family].observation(marker.reading)
            if evident:
                detail[EVIDENCE] = evident
            at = frame.captured_at or observed_at
            row = NewObservation(marker_id, frame.index, at, _what(marker.match), detail)
            rows.setdefault((frame.index, marker_id), row)
    return list(rows.values())


def _what(match: Match) -> str:
    if not match.plausible:
        return "out-of-place"
    return "ambiguous" if match.ambiguous else "seen"
