"""Videos: always jobs, decoded segment by segment, with progress and partial results."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from typing import TYPE_CHECKING

import numpy as np
import sqlalchemy as sa

from app.decoding.declarations import MAX_ACCURACY_M, CoarsePosition, DeclaredFrames, DecodeContext
from app.decoding.frames import Nearby, distance_to_row
from app.errors import InvalidParameter
from app.families.family import FrameReading
from app.formats.format import ArchiveLimits, Member, SpooledFile
from app.formats.images import ImageHeader, ImageKind
from app.formats.video_file import (
    VideoFile,
    VideoIndex,
    VideoKind,
    VideoSegment,
    detect_video,
    holds_video,
    open_packed_video,
)
from app.geodesy.frames import distance_m
from app.registry.database import Database
from app.services.decodes.context import DecodeKind, DecodeRules
from app.services.decodes.frame_documents import (
    DriveNotes,
    ReadFrame,
    SeenPlateDocument,
    frames_result,
    seen_plate_document,
)
from app.services.decodes.frame_poses import (
    FrameLists,
    FramePlaces,
    FramePose,
    GapDocument,
    ReceiverPositions,
)
from app.services.decodes.frame_tasks import FrameResult
from app.services.decodes.frames import FrameMoment, decoded_frames, read_frame, search_for
from app.services.decodes.matching import NearbyMarkers, find_nearby_markers
from app.services.decodes.upload_path import Decoded, Upload, UploadHandler
from app.services.decodes.video_tasks import SegmentResult, decode_segment, index_frames, read_frame_lists
from app.services.ports import Clock, DecoderProcesses, Pending

if TYPE_CHECKING:  # it loads numba
    from app.decoders.plate.video_search import FoundPlate

POSE_EVERY_S = 0.5
"""[s] between the poses along a segment by which markers are looked up. 15 m at 30 m/s."""
PART_EVERY = timedelta(seconds=10)
"""Shortest time between two partial results. Each is written whole."""

_DAMAGED, _OTHER_SIZE = "could not be decoded", "have another size than the video"


@dataclass(slots=True)
class VideoSignal:
    """The frames of a video in which something was found, and what to know about the video."""

    frames: list[ReadFrame] = field(default_factory=list)
    plates: list[SeenPlateDocument] = field(default_factory=list)
    codebook: set[str] = field(default_factory=set)
    searched: int = 0
    damaged: int = 0
    other_size: int = 0
    gaps: list[GapDocument] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    receiver: ReceiverPositions | None = None

    @property
    def notes(self) -> DriveNotes:
        """As the result has them."""
        return DriveNotes(tuple(self.warnings), tuple(self.gaps), tuple(self.plates), self.searched, self.receiver)


class VideoHandler(UploadHandler[VideoSignal]):
    """Videos of a drive: MP4, AVI or MJPEG, or one of them in a ZIP beside the vehicle's track."""

    kind = DecodeKind.VIDEO

    def __init__(self, database: Database, clock: Clock, processes: DecoderProcesses, rules: DecodeRules) -> None:
        self._database, self._clock = database, clock
        self._processes, self._rules = processes, rules

    def accepts(self, context: DecodeContext, file: SpooledFile) -> bool:
        """Videos by their first bytes, and archives that name one."""
        return _kind_of(context, file) is not None or holds_video(file)

    def is_job(self, file: SpooledFile) -> bool:
        """Always."""
        return True

    def start(self, upload: Upload) -> PendingVideo:
        """Segments are handed over as the decoder processes become free."""
        return PendingVideo(upload, self._database, self._clock, self._processes, self._rules)

    def match(self, connection: sa.Connection, upload: Upload, signal: VideoSignal) -> Decoded:
        """Collect the frames, which were matched as they came."""
        return decoded_frames(signal.frames, len(signal.codebook), upload, signal.notes)


@dataclass(frozen=True, slots=True)
class _PendingSegment:
    segment: VideoSegment
    pending: Pending[SegmentResult]
    nearby: NearbyMarkers


class PendingVideo:
    """A video whose segments go through the decoder processes, some at the same time."""

    def __init__(
        self, upload: Upload, database: Database, clock: Clock, processes: DecoderProcesses, rules: DecodeRules
    ) -> None:
        self._upload = upload
        self._database, self._clock = database, clock
        self._processes, self._rules = processes, rules
        self._waiting: deque[_PendingSegment] = deque()
        self._signal = VideoSignal()
        self._places = FramePlaces(upload.context)
        self._began_at: datetime | None = None
        self._last: list[FoundPlate] = []
        self._part_at = clock()

    def result(self) -> VideoSignal:
        """Decode all segments."""
        index = self._index()
        total = len(index.stamps)
        self._upload.report(0, total)
        for number, segment in enumerate(index.segments):
            self._waiting.append(self._start(index, number, segment))
            if len(self._waiting) >= self._rules.frames_in_flight:
                self._finish(index, self._waiting.popleft())
        while self._waiting:
            self._finish(index, self._waiting.popleft())
        signal = self._signal
        for count, what in ((signal.damaged, _DAMAGED), (signal.other_size, _OTHER_SIZE)):
            if count:
                signal.warnings.append(f"{count} of {total} frames {what}; {signal.searched} were searched")
        signal.warnings += [text for text in self._places.warnings if text not in signal.warnings]
        return signal

    def cancel(self) -> None:
        """Stop the segments that are on their way."""
        for waiting in self._waiting:
            waiting.pending.cancel()

    # --- what the video holds -----------------------------------------------------------------------------------------

    def _index(self) -> VideoIndex:
        upload, wait_s = self._upload, self._upload.wait_s
        context, declared = upload.context, upload.context.frames or DeclaredFrames()
        if context.is_paper:
            raise InvalidParameter(
                "the method paper reads pictures, not videos",
                field="frames.method",
                limit="waymark for a video",
                cure="send the frames as a ZIP of pictures, or leave frames.method out",
            )
        kind = _kind_of(context, upload.file)
        if kind is None:
            packed = open_packed_video(upload.file, self._rules.archives)
            video = packed.video
            if packed.beside:
                lists = self._processes.run(read_frame_lists, packed.beside, declared.track, wait_s=wait_s)
                self._places = FramePlaces(context, lists, upload.observed_at)
        else:
            video = VideoFile(upload.file, kind)
        index = self._processes.run(index_frames, video, self._rules.videos, declared.rate_hz, wait_s=wait_s)
        self._signal.warnings += index.warnings
        self._signal.gaps += [
            {
                "after_frame": gap.after_frame,
                "before_frame": gap.before_frame,
                "seconds": gap.seconds,
                "reason": gap.reason,
            }
            for gap in index.gaps
        ]
        if index.track is not None:
            self._places = FramePlaces(context, FrameLists(track=index.track), upload.observed_at)
        self._signal.receiver = self._places.receiver
        self._began_at = index.created_at if index.has_clock else context.captured_at
        if self._began_at is None and index.created_at is not None:
            self._began_at = index.created_at
            self._signal.warnings.append(
                "captured_at is the file's creation time, which some cameras write at the end, or in local time; "
                "send captured_at in the context"
            )
        return index

    # --- segments -----------------------------------------------------------------------------------------------------

    def _start(self, index: VideoIndex, number: int, segment: VideoSegment) -> _PendingSegment:
        poses = list(self._poses(index, segment))
        with self._database.read() as connection:
            nearby = find_nearby_markers(connection, self._upload.agency_id, _around(pose for _at, pose in poses))
        self._signal.codebook.update(f"{code.n} {code.digits}" for code in nearby.codebook)
        setup = self._upload.context.camera
        camera = None
        if setup is not None:
            size = setup.width_px or index.width_px, setup.height_px or index.height_px
            camera = setup.camera_of(*size)
        pending = self._processes.submit(
            decode_segment,
            index,
            number,
            search_for(nearby, camera),
            self._upload.context.is_thermal,
            tuple((at, pose.speed_m_s) for at, pose in poses if pose.speed_m_s is not None),
            wait_s=self._upload.wait_s,
        )
        return _PendingSegment(segment, pending, nearby)

    def _poses(self, index: VideoIndex, segment: VideoSegment) -> Iterator[tuple[float, FramePose]]:
        first_s, last_s = float(index.time_s[segment.first]), float(index.time_s[segment.end - 1])
        for time_s in np.arange(first_s, last_s + POSE_EVERY_S, POSE_EVERY_S):
            pose = self._places.pose_of(self._at(float(time_s)))
            if pose is not None:
                yield float(time_s), pose

    def _at(self, time_s: float) -> datetime | None:
        return None if self._began_at is None else self._began_at + timedelta(seconds=time_s)

    def _finish(self, index: VideoIndex, waiting: _PendingSegment) -> None:
        """Wait for a segment, and match what it shows."""
        result, signal = waiting.pending.result(), self._signal
        signal.searched += result.frames
        signal.damaged += result.damaged
        signal.other_size += result.other_size
        for count, what in ((result.damaged, _DAMAGED), (result.other_size, _OTHER_SIZE)):
            if count:
                signal.gaps.append(
                    {
                        "after_frame": waiting.segment.first,
                        "before_frame": waiting.segment.end,
                        "seconds": None,
                        "reason": f"{count} frames {what}",
                    }
                )
        plates = [plate for plate in result.plates if not _was_followed(plate, self._last)]
        self._last = [plate for plate in result.plates if plate.seen[-1].frame >= waiting.segment.end - 1]
        by_frame = _by_frame(plates, result.others)
        frames: dict[int, ReadFrame] = {}
        header = _header(result.width_px, result.height_px) if result.width_px else None
        with self._database.read() as connection:
            for number in sorted(by_frame):
                assert header is not None
                readings, speed_m_s = by_frame[number]
                time_s = float(index.time_s[number])
                moment = self._moment(time_s)
                nearby = _within_reach(waiting.nearby, moment.context.coarse_position)
                found = FrameResult(header, readings, 0.0, result.decode_ms / max(result.frames, 1))
                member, upload = Member(number, ""), self._upload
                frame = read_frame(connection, upload, member, found, nearby, moment, speed_m_s=speed_m_s)
                frames[number] = replace(frame, time_s=time_s)
        signal.frames += frames.values()
        signal.plates += [seen_plate_document(plate, frames) for plate in plates if len(plate.seen) > 1 or plate.alone]
        self._report(waiting.segment.end, len(index.stamps))

    def _moment(self, time_s: float) -> FrameMoment:
        at = self._at(time_s)
        pose = self._places.pose_of(at)
        return FrameMoment(self._places.context_at(pose), at, pose)

    def _report(self, done: int, total: int) -> None:
        now, signal, part = self._clock(), self._signal, None
        if now - self._part_at >= PART_EVERY:
            self._part_at = now
            part = frames_result(signal.frames, codebook_plates=len(signal.codebook), notes=signal.notes)
        self._upload.report(done, total, part)


def _kind_of(context: DecodeContext, file: SpooledFile) -> VideoKind | None:
    is_stream = context.frames is not None and context.frames.rate_hz is not None
    return detect_video(file.head(), is_stream=is_stream)


def video_of(context: DecodeContext, file: SpooledFile, limits: ArchiveLimits) -> VideoFile:
    """The video of an upload, which may be in an archive."""
    kind = _kind_of(context, file)
    return open_packed_video(file, limits).video if kind is None else VideoFile(file, kind)


def _header(width_px: int, height_px: int) -> ImageHeader:
    return ImageHeader(ImageKind.VIDEO, width_px, height_px, 3)


def _around(poses: Iterator[FramePose]) -> CoarsePosition | None:
    """A position with the radius that holds the vehicle all along a segment."""
    listed = list(poses)
    if not listed:
        return None
    middle = listed[len(listed) // 2]
    radius_m = max(
        distance_m(middle.lon_deg, middle.lat_deg, pose.lon_deg, pose.lat_deg) + pose.radius_m for pose in listed
    )
    return CoarsePosition(lon_deg=middle.lon_deg, lat_deg=middle.lat_deg, accuracy_m=min(radius_m, MAX_ACCURACY_M))


def _within_reach(nearby: NearbyMarkers, position: CoarsePosition | None) -> NearbyMarkers:
    """Of the markers along a segment those that could be in view from one position, nearest first."""
    if position is None:
        return nearby

    def of(known: Nearby) -> Nearby:
        near = [(distance_to_row(row, position), k) for k, row in enumerate(known.rows)]
        return Nearby(tuple(known.rows[k] for away, k in sorted(near) if away <= position.reach_m), known.complete)

    return NearbyMarkers({name: of(known) for name, known in nearby.by_family.items()})


def _was_followed(plate: FoundPlate, before: Sequence[FoundPlate]) -> bool:
    """Whether a plate was followed into this segment from the one before."""
    first = plate.seen[0]
    for other in before:
        for seen in other.seen:
            if seen.frame == first.frame and _same_place(seen.reading.corners_px, first.reading.corners_px):
                return True
    return False


def _same_place(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    if a is None or b is None:
        return False
    return bool((np.abs(a.mean(axis=0) - b.mean(axis=0)) < np.ptp(a, axis=0)).all())


def _by_frame(
    plates: Sequence[FoundPlate], others: Mapping[int, tuple[FrameReading, ...]]
) -> dict[int, tuple[tuple[FrameReading, ...], float | None]]:
    """Readings of each frame, and the speed that its plates show."""
    found: dict[int, tuple[tuple[FrameReading, ...], float | None]] = {}
    for number, readings in others.items():
        found[number] = readings, None
    for plate in plates:
        if len(plate.seen) == 1 and not plate.alone:
            continue  # something that looked like a plate in one frame
        for seen in plate.seen:
            readings, speed = found.get(seen.frame, ((), None))
            found[seen.frame] = (*readings, seen.reading), plate.speed_m_s or speed
    return found
