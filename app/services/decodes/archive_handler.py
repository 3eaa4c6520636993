"""ZIP archives of frames: always jobs, with progress, and with one entry for each frame that cannot be read."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import sqlalchemy as sa

from app.errors import Unavailable, WaymarkError
from app.formats.archives import Member, count_members, is_archive, read_members
from app.registry.database import Database
from app.services.decoder_processes import DecoderProcesses
from app.services.decodes.context import DecodeContext
from app.services.decodes.frame_documents import ReadFrame
from app.services.decodes.frame_handler import StartedFrame, decoded_frames, read_frame, start_frame
from app.services.decodes.kinds import DecodeKind
from app.services.decodes.matching import NearbyMarkers, find_nearby_markers
from app.services.decodes.rules import DecodeRules
from app.services.decodes.upload_path import Decoded, Upload, UploadHandler
from app.services.ports import Clock


@dataclass(frozen=True, slots=True)
class ArchiveSignal:
    """The frames of an archive, matched one after the other."""

    frames: list[ReadFrame]
    nearby: NearbyMarkers


class ArchiveHandler(UploadHandler[ArchiveSignal]):
    """Frames of a drive in a ZIP archive."""

    kind = DecodeKind.ARCHIVE

    def __init__(self, database: Database, clock: Clock, processes: DecoderProcesses, rules: DecodeRules) -> None:
        self._database, self._clock = database, clock
        self._processes, self._rules = processes, rules

    def accepts(self, context: DecodeContext, data: bytes) -> bool:
        """ZIP files."""
        return is_archive(data)

    def is_job(self, data: bytes) -> bool:
        """Always; an archive that breaks a limit is refused before it is queued."""
        count_members(data, self._rules.archives)
        return True

    def start(self, upload: Upload) -> StartedArchive:
        """Look up the markers near by; frames are handed over as the decoder processes become free."""
        with self._database.read() as connection:
            nearby = find_nearby_markers(connection, upload.agency_id, upload.context.coarse_position)
        return StartedArchive(upload, nearby, self._database, self._clock, self._processes, self._rules)

    def match(self, connection: sa.Connection, upload: Upload, signal: ArchiveSignal) -> Decoded:
        """Collect the frames, which were matched as they came."""
        return decoded_frames(signal.frames, signal.nearby, upload.observed_at)


class StartedArchive:
    """An archive whose frames go through the decoder processes, some at the same time."""

    def __init__(
        self, upload: Upload, nearby: NearbyMarkers, database: Database, clock: Clock, processes: DecoderProcesses,
        rules: DecodeRules,
    ) -> None:  # fmt: skip
        self._upload, self._nearby = upload, nearby
        self._database, self._clock = database, clock
        self._processes, self._rules = processes, rules
        self._waiting: deque[tuple[Member, StartedFrame | WaymarkError]] = deque()

    def result(self) -> ArchiveSignal:
        """Decode all frames."""
        data, limits = self._upload.data, self._rules.archives
        total = count_members(data, limits)
        frames: list[ReadFrame] = []
        reported_at = self._clock()
        for member in read_members(data, limits):
            self._waiting.append((member, self._start(member)))
            if len(self._waiting) >= self._rules.frames_in_flight:
                frames.append(self._finish(*self._waiting.popleft()))
            if self._clock() - reported_at >= self._rules.progress_every:
                reported_at = self._clock()
                self._upload.report_progress(len(frames) / total)
        while self._waiting:
            frames.append(self._finish(*self._waiting.popleft()))
        return ArchiveSignal(frames, self._nearby)

    def cancel(self) -> None:
        """Stop the frames that are on their way."""
        for _member, started in self._waiting:
            if not isinstance(started, WaymarkError):
                started.cancel()

    def _start(self, member: Member) -> StartedFrame | WaymarkError:
        if member.error is not None:
            return member.error
        upload = self._upload
        try:
            started = start_frame(
                self._processes, member.data, upload.context, self._rules.images, wait_s=upload.wait_s
            )
        except Unavailable:
            raise
        except WaymarkError as error:
            return error
        started.look_for(self._nearby)
        return started

    def _finish(self, member: Member, started: StartedFrame | WaymarkError) -> ReadFrame:
        try:
            if isinstance(started, WaymarkError):
                raise started
            result = started.result().result
        except Unavailable:
            raise
        except WaymarkError as error:
            return ReadFrame(member.index, member.name, error=error)
        with self._database.read() as connection:
            return read_frame(connection, self._upload, member, result, self._nearby)
