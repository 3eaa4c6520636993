"""ZIP archives of frames: always jobs, with progress, and with one entry for each frame that cannot be read."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from datetime import timedelta

import sqlalchemy as sa

from app.decoders.plate.confirm import confirm_frames
from app.decoders.plate.pose import with_pose
from app.errors import UnsupportedUpload, WaymarkError
from app.formats.archives import Member, count_members, is_archive, list_names, read_members
from app.formats.frame_list import is_beside_frames
from app.formats.image_headers import FIELD
from app.formats.images import ImageHeader
from app.formats.kinds import UploadKind, guess_kind
from app.formats.spooled_file import SpooledFile
from app.markers.plate import PlateCode
from app.markers.reading import PlateReading
from app.registry.database import Database
from app.sensors.camera import Camera
from app.services.decoder_processes import DecoderProcesses
from app.services.decodes.context import CoarsePosition, DecodeContext
from app.services.decodes.frame_documents import DriveNotes, ReadFrame, frames_result
from app.services.decodes.frame_handler import FrameMoment, decoded_frames, inspect_frame, read_frame, search_for
from app.services.decodes.frame_poses import FrameListTask, FramePlaces, find_gaps
from app.services.decodes.frame_runs import ArchiveFrame, StartedRun, in_runs
from app.services.decodes.frame_task import FramePicture, FrameResult, FrameSearch
from app.services.decodes.frame_terms import frame_terms
from app.services.decodes.kinds import DecodeKind
from app.services.decodes.matching import NearbyMarkers, find_nearby_markers
from app.services.decodes.rules import DecodeRules
from app.services.decodes.upload_path import Decoded, Upload, UploadHandler
from app.services.ports import Clock

_PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png")
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
        """Always; an archive that breaks a limit, or that holds a trace or packets, is refused before it is queued."""
        count_members(file, self._rules.archives)
        names = list_names(file, self._rules.archives)
        if not any(name.lower().endswith(_PICTURE_SUFFIXES) for name in names):
            _check_holds_frames(file)
        return True

    def start(self, upload: Upload) -> StartedArchive:
        """Frames are handed over as the decoder processes become free."""
        return StartedArchive(upload, self._database, self._clock, self._processes, self._rules)

    def match(self, connection: sa.Connection, upload: Upload, signal: ArchiveSignal) -> Decoded:
        """Collect the frames, which were matched as they came."""
        return decoded_frames(signal.frames, signal.codebook_plates, upload.observed_at, signal.notes)


def _check_holds_frames(file: SpooledFile) -> None:
    """Refuse an archive of another kind, which would be decoded to nothing but frames that cannot be read."""
    kind = guess_kind("upload.zip", file)
    if kind in (UploadKind.TRACE, UploadKind.PACKETS):
        raise UnsupportedUpload(
            f"the archive holds {'a trace' if kind is UploadKind.TRACE else 'packets'} and no frames",
            field=FIELD,
            limit="JPEG or PNG frames, where the context has neither trace nor packets",
            cure=f'add "{kind}": {{}} to the context',
        )


class StartedArchive:
    """An archive whose frames go through the decoder processes in runs, more than one at the same time."""

    def __init__(
        self, upload: Upload, database: Database, clock: Clock, processes: DecoderProcesses, rules: DecodeRules
    ) -> None:
        self._upload = upload
        self._database, self._clock = database, clock
        self._processes, self._rules = processes, rules
        self._waiting: deque[StartedRun] = deque()
        self._frames: list[ReadFrame] = []
        self._reported_at = self._part_at = clock()
        self._nearby: tuple[CoarsePosition | None, NearbyMarkers] | None = None
        self._codebook: set[PlateCode] = set()
        self._search: tuple[NearbyMarkers, Camera | None, FrameSearch] | None = None
        self._places = FramePlaces(upload.context)
        self._ordinal = 0
        self._with_plates: dict[int, tuple[ArchiveFrame, FrameResult]] = {}

    def result(self) -> ArchiveSignal:
        """Decode all frames."""
        file, limits = self._upload.file, self._rules.archives
        total = count_members(file, limits)
        self._read_lists(file)
        frames = self._frames
        frames.clear()
        self._with_plates.clear()
        self._upload.report_progress(0, total)
        self._reported_at = self._part_at = self._clock()
        for run in in_runs(self._prepare(m) for m in read_members(file, limits) if not is_beside_frames(m.name)):
            self._waiting.append(StartedRun(self._processes, run, self._upload.wait_s))
            if len(self._waiting) > self._rules.frames_in_flight:  # one waits, so that no process does
                self._finish(self._waiting.popleft(), total)
        while self._waiting:
            self._finish(self._waiting.popleft(), total)
        self._confirm()
        gaps, warnings = find_gaps([(frame.index, frame.captured_at) for frame in frames])
        notes = DriveNotes((*self._places.warnings, *warnings), gaps, receiver=self._places.receiver)
        return ArchiveSignal(frames, len(self._codebook), notes)

    def _report(self, total: int) -> None:
        """Record now and then how far the job is; what this raises stops it."""
        now, done = self._clock(), len(self._frames)
        if now - self._reported_at < self._rules.progress_every:
            return
        self._reported_at = now
        if now - self._part_at < PART_EVERY:
            self._upload.report_progress(done, total)
            return
        self._part_at = now
        notes = DriveNotes(self._places.warnings)
        part = frames_result(self._frames, codebook_plates=len(self._codebook), notes=notes)
        self._upload.report_part(done, total, part)

    def cancel(self) -> None:
        """Stop the frames that are on their way."""
        for waiting in self._waiting:
            waiting.cancel()

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

    def _prepare(self, member: Member) -> ArchiveFrame:
        """Check a frame's header, and find out what to look for in it."""
        context, images = self._upload.context, self._rules.images
        moment = FrameMoment(context)
        try:
            if member.error is not None:
                raise member.error
            file = SpooledFile.of(member.data)
            header = inspect_frame(file, context, images)
            moment = self._moment(member, header)
            camera = moment.context.camera.camera_for(header) if moment.context.camera else None
        except WaymarkError as error:
            return ArchiveFrame(member.index, member.name, moment, error=error)
        nearby = self._markers_near(moment.context.coarse_position)
        picture = FramePicture(file, context.thermal, context.thermal_range, images)
        pixels = header.width_px * header.height_px
        return ArchiveFrame(member.index, member.name, moment, picture, self._look_for(nearby, camera), nearby, pixels)

    def _moment(self, member: Member, header: ImageHeader) -> FrameMoment:
        at = self._places.time_of(self._ordinal, member.name, header.taken)
        self._ordinal += 1
        pose = self._places.pose_of(at, member.name)
        return FrameMoment(self._places.context_at(pose), at, pose)

    def _look_for(self, nearby: NearbyMarkers, camera: Camera | None) -> FrameSearch:
        """The same object for frames that share it, so that a run has it once."""
        if self._search is None or self._search[0] is not nearby or self._search[1] != camera:
            self._search = nearby, camera, search_for(nearby, camera)
        return self._search[2]

    def _markers_near(self, position: CoarsePosition | None) -> NearbyMarkers:
        """The markers that could be in view from a position; those of the frame before serve at the same position."""
        if self._nearby is None or self._nearby[0] != position:
            with self._database.read() as connection:
                self._nearby = position, find_nearby_markers(connection, self._upload.agency_id, position)
            self._codebook.update(self._nearby[1].codebook)
        return self._nearby[1]

    def _finish(self, run: StartedRun, total: int) -> None:
        """Wait for a run, and match its frames."""
        results = run.results(lambda: self._report(total))
        with self._database.read() as connection:
            self._frames += [self._matched(connection, frame, result) for frame, result in results]
        self._with_plates |= {
            frame.index: (replace(frame, picture=None), result)
            for frame, result in results
            if isinstance(result, FrameResult) and any(one.certainty is not None for one in _plates(result))
        }
        self._report(total)

    def _confirm(self) -> None:
        """Match plates anew that are tentative in single frames, and that several frames confirm together."""
        places = {frame.index: place for place, frame in enumerate(self._frames)}
        known = self._with_plates
        confirmed = confirm_frames([(index, _plates(known[index][1]) if index in known else ()) for index in places])
        with self._database.read() as connection:
            for index, plates in confirmed.items():
                frame, result = known[index]
                camera = frame.moment.context.camera.camera_for(result.header) if frame.moment.context.camera else None
                others = tuple(one for one in result.readings if not isinstance(one, PlateReading))
                readings = (*(with_pose(one, camera) for one in plates), *others)
                self._frames[places[index]] = self._matched(connection, frame, replace(result, readings=readings))

    def _matched(self, connection: sa.Connection, frame: ArchiveFrame, result: FrameResult | WaymarkError) -> ReadFrame:
        moment = frame.moment
        if isinstance(result, WaymarkError):
            return ReadFrame(frame.index, frame.name, error=result, captured_at=moment.at, pose=moment.pose)
        return read_frame(connection, self._upload, Member(frame.index, frame.name), result, frame.nearby, moment)


def _plates(result: FrameResult) -> list[PlateReading]:
    return [reading for reading in result.readings if isinstance(reading, PlateReading)]
