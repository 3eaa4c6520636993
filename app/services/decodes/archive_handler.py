"""ZIP archives of frames: always jobs, with progress, and with one entry for each frame that cannot be read."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from datetime import timedelta

import sqlalchemy as sa

from app.errors import Unavailable, WaymarkError
from app.formats.archives import Member, count_members, is_archive, list_names, read_members
from app.formats.frame_list import is_beside_frames
from app.formats.images import inspect_image
from app.formats.spooled_file import SpooledFile
from app.markers.plate import PlateCode
from app.registry.database import Database
from app.services.decoder_processes import DecoderProcesses
from app.services.decodes.context import CoarsePosition, DecodeContext
from app.services.decodes.frame_documents import DriveNotes, FramesResult, ReadFrame, frames_result
from app.services.decodes.frame_handler import FrameMoment, StartedFrame, decoded_frames, read_frame, start_frame
from app.services.decodes.frame_poses import FrameListTask, FramePlaces, find_gaps
from app.services.decodes.frame_terms import frame_terms
from app.services.decodes.kinds import DecodeKind
from app.services.decodes.matching import NearbyMarkers, find_nearby_markers
from app.services.decodes.rules import DecodeRules
from app.services.decodes.upload_path import Decoded, Upload, UploadHandler
from app.services.ports import Clock

PART_EVERY = timedelta(seconds=10)
"""Time between two stores of the frames so far. Source: a result of 500 frames is written in a tenth of a second."""


@dataclass(frozen=True, slots=True)
class ArchiveSignal:
    """The frames of an archive, matched one after the other."""

    frames: list[ReadFrame]
    codebook_plates: int
    notes: DriveNotes


class ArchiveHandler(UploadHandler[ArchiveSignal]):
    """Frames of a drive in a ZIP archive."""

    kind = DecodeKind.ARCHIVE

    def __init__(self, database: Database, clock: Clock, processes: DecoderProcesses, rules: DecodeRules) -> None:
        self._database, self._clock = database, clock
        self._processes, self._rules = processes, rules

    def accepts(self, context: DecodeContext, file: SpooledFile) -> bool:
        """ZIP files."""
        return is_archive(file.head())

    def is_job(self, file: SpooledFile) -> bool:
        """Always; an archive that breaks a limit is refused before it is queued."""
        count_members(file, self._rules.archives)
        return True

    def start(self, upload: Upload) -> StartedArchive:
        """Frames are handed over as the decoder processes become free."""
        return StartedArchive(upload, self._database, self._clock, self._processes, self._rules)

    def match(self, connection: sa.Connection, upload: Upload, signal: ArchiveSignal) -> Decoded:
        """Collect the frames, which were matched as they came."""
        return decoded_frames(signal.frames, signal.codebook_plates, upload.observed_at, signal.notes)


@dataclass(frozen=True, slots=True)
class _OnItsWay:
    """A frame in a decoder process, or the error that kept it from there."""

    member: Member
    started: StartedFrame | WaymarkError
    moment: FrameMoment


class StartedArchive:
    """An archive whose frames go through the decoder processes, some at the same time."""

    def __init__(
        self, upload: Upload, database: Database, clock: Clock, processes: DecoderProcesses, rules: DecodeRules
    ) -> None:
        self._upload = upload
        self._database, self._clock = database, clock
        self._processes, self._rules = processes, rules
        self._waiting: deque[_OnItsWay] = deque()
        self._nearby: tuple[CoarsePosition | None, NearbyMarkers] | None = None
        self._codebook: set[PlateCode] = set()
        self._places = FramePlaces(upload.context)
        self._ordinal = 0

    def result(self) -> ArchiveSignal:
        """Decode all frames."""
        file, limits = self._upload.file, self._rules.archives
        total = count_members(file, limits)
        self._read_lists(file)
        frames: list[ReadFrame] = []
        reported_at = part_at = self._clock()
        for member in read_members(file, limits):
            if is_beside_frames(member.name):
                continue
            self._waiting.append(self._start(member))
            if len(self._waiting) >= self._rules.frames_in_flight:
                frames.append(self._finish(self._waiting.popleft()))
            if self._clock() - reported_at >= self._rules.progress_every:
                reported_at = self._clock()
                if reported_at - part_at < PART_EVERY:
                    self._upload.report_progress(len(frames) / total)
                    continue
                part_at = reported_at
                self._upload.report_part(len(frames) / total, self._result_so_far(frames))
        while self._waiting:
            frames.append(self._finish(self._waiting.popleft()))
        gaps, warnings = find_gaps([(frame.index, frame.captured_at) for frame in frames])
        notes = DriveNotes((*self._places.warnings, *warnings), gaps, receiver=self._places.receiver)
        return ArchiveSignal(frames, len(self._codebook), notes)

    def _result_so_far(self, frames: list[ReadFrame]) -> FramesResult:
        return frames_result(frames, codebook_plates=len(self._codebook), notes=DriveNotes(self._places.warnings))

    def cancel(self) -> None:
        """Stop the frames that are on their way."""
        for waiting in self._waiting:
            if not isinstance(waiting.started, WaymarkError):
                waiting.started.cancel()

    def _read_lists(self, file: SpooledFile) -> None:
        """Have the files beside the frames read."""
        context, limits = self._upload.context, self._rules.archives
        names = list_names(file, limits)
        beside = [name for name in names if is_beside_frames(name)]
        if beside:
            files = tuple(
                (m.name, m.data) for m in read_members(file, limits, only=is_beside_frames) if m.error is None
            )
            task = FrameListTask(files, frame_terms(context.frames or {}).poses)
            lists = self._processes.submit(task, wait_s=self._upload.wait_s).result()
            self._places = FramePlaces(context, lists)
        self._places.check_names([name for name in names if not is_beside_frames(name)])

    def _start(self, member: Member) -> _OnItsWay:
        moment = FrameMoment(self._upload.context)
        if member.error is not None:
            return _OnItsWay(member, member.error, moment)
        try:
            moment = self._moment(member)
            started = start_frame(
                self._processes,
                SpooledFile.of(member.data),
                moment.context,
                self._rules.images,
                wait_s=self._upload.wait_s,
            )
        except Unavailable:
            raise
        except WaymarkError as error:
            return _OnItsWay(member, error, moment)
        started.look_for(self._markers_near(moment.context.coarse_position))
        return _OnItsWay(member, started, moment)

    def _moment(self, member: Member) -> FrameMoment:
        taken = inspect_image(member.data, self._rules.images, thermal=self._upload.context.thermal).taken
        at = self._places.time_of(self._ordinal, member.name, taken)
        self._ordinal += 1
        pose = self._places.pose_of(at, member.name)
        return FrameMoment(self._places.context_at(pose), at, pose)

    def _markers_near(self, position: CoarsePosition | None) -> NearbyMarkers:
        """The markers that could be in view from a position; those of the frame before serve at the same position."""
        if self._nearby is None or self._nearby[0] != position:
            with self._database.read() as connection:
                self._nearby = position, find_nearby_markers(connection, self._upload.agency_id, position)
            self._codebook.update(self._nearby[1].codebook)
        return self._nearby[1]

    def _finish(self, waiting: _OnItsWay) -> ReadFrame:
        member, started, moment = waiting.member, waiting.started, waiting.moment
        try:
            if isinstance(started, WaymarkError):
                raise started
            signal = started.result()
        except Unavailable:
            raise
        except WaymarkError as error:
            return ReadFrame(member.index, member.name, error=error, captured_at=moment.at, pose=moment.pose)
        with self._database.read() as connection:
            return read_frame(connection, self._upload, member, signal.result, signal.nearby, moment)
