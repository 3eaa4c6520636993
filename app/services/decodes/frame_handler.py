"""Frames: through a decoder process, then matched against the registered markers."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from datetime import datetime

import sqlalchemy as sa

from app.families.frames import Match
from app.formats.archives import Member
from app.formats.images import ImageLimits, inspect_image
from app.geodesy import decimal_year
from app.registry.database import Database
from app.registry.decodes import NewObservation
from app.sensors.camera import Camera
from app.services.decoder_processes import DecoderProcesses, Pending
from app.services.decodes.context import DecodeContext
from app.services.decodes.fixes import fix_from_match, fuse_fixes
from app.services.decodes.frame_documents import ReadFrame, ReadMarker, frames_result
from app.services.decodes.frame_task import FramePicture, FrameResult, FrameSearch, FrameTask
from app.services.decodes.kinds import DecodeKind
from app.services.decodes.matching import FRAME_READERS, NearbyMarkers, find_nearby_markers, match_reading
from app.services.decodes.rules import DecodeRules
from app.services.decodes.upload_path import Decoded, Upload, UploadHandler


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
        searches = {name: reader.search(nearby.of(name), self.camera) for name, reader in FRAME_READERS.items()}
        self.search.set_result(FrameSearch({name: search for name, search in searches.items() if search is not None}))

    def result(self) -> FrameSignal:
        """Wait for the readings."""
        assert self.nearby is not None
        return FrameSignal(self.pending.result(), self.nearby)

    def cancel(self) -> None:
        """Stop the process."""
        self.pending.cancel()


class FrameHandler(UploadHandler[FrameSignal]):
    """A single frame, decoded while the caller waits. It accepts every upload, so it comes last."""

    kind = DecodeKind.FRAME

    def __init__(self, database: Database, processes: DecoderProcesses, rules: DecodeRules) -> None:
        self._database, self._processes, self._rules = database, processes, rules

    def accepts(self, context: DecodeContext, data: bytes) -> bool:
        """Every upload."""
        return True

    def is_job(self, data: bytes) -> bool:
        """Never: a frame takes some milliseconds."""
        return False

    def start(self, upload: Upload) -> StartedFrame:
        """Hand the frame over, and look up the markers near by while the process loads the picture."""
        started = start_frame(self._processes, upload.data, upload.context, self._rules.images, wait_s=upload.wait_s)
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
        member = Member(0, "")
        frame = read_frame(connection, upload, member, signal.result, signal.nearby)
        return decoded_frames([frame], signal.nearby, upload.observed_at)


def start_frame(
    processes: DecoderProcesses, data: bytes, context: DecodeContext, limits: ImageLimits, *, wait_s: float = 0.0
) -> StartedFrame:
    """Hand a frame to a decoder process, after checking its header against the limits and the camera.

    Raises
    ------
    UnreadableUpload, InvalidParameter
        The frame is refused, or it is not this camera's.
    Unavailable
        The decoder processes are busy.
    """
    header = inspect_image(data, limits, thermal=context.thermal)
    camera = context.camera.camera_for(header) if context.camera else None
    task = FrameTask(FramePicture(data, context.thermal, context.thermal_range, limits))
    return StartedFrame(camera, processes.submit(task, wait_s=wait_s), task.search)


def read_frame(
    connection: sa.Connection, upload: Upload, member: Member, result: FrameResult, nearby: NearbyMarkers
) -> ReadFrame:
    """Match a frame's readings and compute the vehicle's position from them."""
    context, epoch = upload.context, decimal_year(upload.observed_at)
    camera = context.camera.camera_for(result.header) if context.camera else None
    markers = []
    for reading in result.readings:
        match = match_reading(connection, upload.agency_id, reading, context.coarse_position, nearby)
        fix = None
        if match is not None and camera is not None and reading.pose is not None:
            fix = fix_from_match(reading.pose, camera, match, context.heading_deg, epoch=epoch)
        markers.append(ReadMarker(reading, match, fix))
    return ReadFrame(
        index=member.index,
        name=member.name or None,
        header=result.header,
        markers=tuple(markers),
        fix=fuse_fixes([marker.fix for marker in markers if marker.fix is not None]),
        load_ms=result.load_ms,
        decode_ms=result.decode_ms,
    )


def decoded_frames(frames: Sequence[ReadFrame], nearby: NearbyMarkers, observed_at: datetime) -> Decoded:
    """Frames that were matched, ready to be stored."""
    document = frames_result(frames, codebook_plates=len(nearby.codebook))
    return Decoded(document, _observations(frames, observed_at))


def _observations(frames: Sequence[ReadFrame], observed_at: datetime) -> list[NewObservation]:
    """One row for each marker and frame; of a marker that a frame shows twice the more confident reading counts."""
    rows: dict[tuple[int, str], NewObservation] = {}
    for frame in frames:
        for marker in sorted(frame.markers, key=lambda marker: -marker.reading.confidence):
            if marker.match is None or marker.match.row is None:
                continue
            marker_id, detail = (
                str(marker.match.row.id),
                FRAME_READERS[marker.reading.family].observation(marker.reading),
            )
            row = NewObservation(marker_id, frame.index, observed_at, _what(marker.match), detail)
            rows.setdefault((frame.index, marker_id), row)
    return list(rows.values())


def _what(match: Match) -> str:
    if not match.plausible:
        return "out-of-place"
    return "ambiguous" if match.ambiguous else "seen"
