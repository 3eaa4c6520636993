"""Frames and ZIP archives of frames: through decoder processes, then matched against the registered markers."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from functools import partial

import sqlalchemy as sa

from app.decoders.plate.confirm import DriveFrame, list_expected, with_expected
from app.decoders.plate.pose import locate_moving_plate, with_pose
from app.decoding.declarations import CoarsePosition, DeclaredFrames, DecodeContext
from app.decoding.frames import Match, PlateSearch, fix_from_match, fuse_fixes, with_registered_size
from app.errors import ProcessStopped, Unavailable, UnsupportedUpload, UploadTooLarge, WaymarkError
from app.families import get_family
from app.families.family import FrameReading
from app.families.plate.plates import PLATE
from app.formats.format import Member, SpooledFile, count_members, is_archive, list_names, read_members
from app.formats.frame_list import is_beside_frames
from app.formats.images import FIELD, ImageHeader, ImageLimits, inspect_image, is_picture, unknown_picture
from app.formats.kinds import UploadKind, guess_kind, list_decoded
from app.geodesy import decimal_year
from app.markers.plate import PlateCode
from app.markers.reading import PlateReading
from app.registry.database import Database
from app.registry.decodes import NewObservation
from app.sensors.camera import Camera
from app.services.decodes.context import DecodeKind, DecodeRules
from app.services.decodes.frame_documents import DriveNotes, ReadFrame, ReadMarker, frames_result
from app.services.decodes.frame_poses import FramePlaces, FramePose, find_gaps
from app.services.decodes.frame_tasks import (
    FramePicture,
    FrameResult,
    FrameSearch,
    confirm_plates,
    decode_frame,
    decode_frames,
    find_expected_plates,
)
from app.services.decodes.matching import FRAME_READERS, NearbyMarkers, find_nearby_markers, match_reading
from app.services.decodes.upload_path import Decoded, PendingSignal, Upload, UploadHandler, cancelled_on_error
from app.services.decodes.video_tasks import read_frame_lists
from app.services.health.frames import frame_health, missed_observations, unregistered_readings
from app.services.health.record import EVIDENCE
from app.services.ports import Clock, DecoderProcesses, Pending

# === Frames: through a decoder process, then matched against the registered markers.


_SIGNATURE_BYTES = 16
_DECLARE = "send one of these; a trace or a packet log of any name is read where the context has trace or packets"
_LARGE = threading.Semaphore(2)
"""Frames that are not held in memory are inspected two at a time, because that reads them whole."""


@dataclass(frozen=True, slots=True)
class FrameSignal:
    """What a decoder process found in a frame, and the markers that it was looking for."""

    nearby: NearbyMarkers
    result: FrameResult


def search_for(nearby: NearbyMarkers, camera: Camera | None, *, is_paper: bool = False) -> FrameSearch:
    """What to look for in a frame of this camera; for plates by the paper's own algorithm, if wanted."""
    searches = {name: reader.search(nearby.of(name), camera) for name, reader in FRAME_READERS.items()}
    plates = searches[PLATE.name]
    if is_paper and isinstance(plates, PlateSearch):
        searches[PLATE.name] = replace(plates, is_paper=True)
    return {name: search for name, search in searches.items() if search is not None}


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
            raise unknown_picture(head, list_decoded(), _DECLARE, of_drive=True)
        return False

    def start(self, upload: Upload) -> Pending[FrameSignal]:
        """Hand the frame over, and look up the markers nearby while the process loads the picture.

        Raises
        ------
        UnreadableUpload, InvalidParameter
            The frame is refused, or it is not this camera's.
        Unavailable
            The decoder processes are busy.
        """
        context, limits = upload.context, self._rules.images
        header = inspect_frame(upload.file, context, limits)
        moment = _moment(context, header)
        camera = context.camera_of(header)
        picture = FramePicture(upload.file, context.is_thermal, context.thermal_range, limits)
        search: Future[FrameSearch] = Future()
        pending = self._processes.submit(decode_frame, picture, search, wait_s=upload.wait_s)
        with cancelled_on_error(pending):
            with self._database.read() as connection:
                nearby = find_nearby_markers(connection, upload.agency_id, moment.context.coarse_position)
            search.set_result(search_for(nearby, camera, is_paper=context.is_paper))
        return PendingSignal(pending, partial(FrameSignal, nearby))

    def match(self, connection: sa.Connection, upload: Upload, signal: FrameSignal) -> Decoded:
        """Match the frame's readings."""
        moment = _moment(upload.context, signal.result.header)
        frame = read_frame(connection, upload, Member(0, ""), signal.result, signal.nearby, moment)
        return decoded_frames([frame], len(signal.nearby.codebook), upload)


def _moment(context: DecodeContext, header: ImageHeader) -> FrameMoment:
    """When and where a single frame was taken."""
    places = FramePlaces(context)
    pose = places.pose_of(None, taken_at=header.position)
    at = context.captured_at or places.time_of(0, taken=header.taken)
    return FrameMoment(places.context_at(pose), at, pose)


def inspect_frame(file: SpooledFile, context: DecodeContext, limits: ImageLimits) -> ImageHeader:
    """Header of a frame, checked against the limits; raises as `FrameHandler.start`."""
    if file.size > limits.file_bytes:
        raise UploadTooLarge(
            f"a picture of {file.size} bytes",
            field="file",
            limit=f"{limits.file_bytes} bytes",
            cure="send the frame as the camera wrote it",
        )
    if file.path is None:
        return inspect_image(file.read(), limits, thermal=context.is_thermal)
    with _LARGE:
        return inspect_image(file.read(), limits, thermal=context.is_thermal)


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
    camera = context.camera_of(result.header)
    if moment.pose is not None and moment.pose.speed_m_s is not None:
        speed_m_s = moment.pose.speed_m_s
    markers = []
    for found in result.readings:
        match = match_reading(connection, upload.agency_id, found, context.coarse_position, nearby)
        reading = found
        if match is not None and isinstance(found, PlateReading):
            reading = with_registered_size(found, match, camera)
            if match.row is not None and match.plausible:
                reading = replace(reading, is_registered=True)
        reading = at_middle_row(reading, camera, speed_m_s)
        fix = None
        if match is not None and camera is not None:
            heading_deg, label = context.heading_deg, get_family(reading.family).label
            reading, pose_warning = FRAME_READERS[reading.family].orient(reading, match, camera, heading_deg)
            if reading.pose is not None:
                fix = fix_from_match(
                    reading.pose, camera, match, label, heading_deg, epoch=epoch, pose_warning=pose_warning
                )
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
    frames: Sequence[ReadFrame], codebook_plates: int, upload: Upload, notes: DriveNotes | None = None
) -> Decoded:
    """Frames that were matched, ready to be stored. What the paper's algorithm misses is no evidence about a marker."""
    is_paper, at = upload.context.is_paper, upload.observed_at
    document = frames_result(frames, codebook_plates=codebook_plates, notes=notes, is_paper=is_paper)
    observations = [*_observations(frames, at), *(() if is_paper else missed_observations(frames, at))]
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


# === ZIP archives of frames: always jobs, with progress, and with one entry for each frame that cannot be read.


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

    def start(self, upload: Upload) -> PendingArchive:
        """Frames are handed over as the decoder processes become free."""
        return PendingArchive(upload, self._database, self._clock, self._processes, self._rules)

    def match(self, connection: sa.Connection, upload: Upload, signal: ArchiveSignal) -> Decoded:
        """Collect the frames, which were matched as they came."""
        return decoded_frames(signal.frames, signal.codebook_plates, upload, signal.notes)


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


class PendingArchive:
    """An archive whose frames go through the decoder processes in runs, more than one at the same time."""

    def __init__(
        self, upload: Upload, database: Database, clock: Clock, processes: DecoderProcesses, rules: DecodeRules
    ) -> None:
        self._upload = upload
        self._database, self._clock = database, clock
        self._processes, self._rules = processes, rules
        self._waiting: deque[PendingRun] = deque()
        self._frames: list[ReadFrame] = []
        self._reported_at = self._part_at = clock()
        self._nearby: tuple[CoarsePosition | None, NearbyMarkers] | None = None
        self._codebook: set[PlateCode] = set()
        self._search: tuple[NearbyMarkers, Camera | None, FrameSearch] | None = None
        self._places = FramePlaces(upload.context)
        self._ordinal = 0
        self._results: dict[int, tuple[ArchiveFrame, FrameResult]] = {}

    def result(self) -> ArchiveSignal:
        """Decode all frames."""
        file, limits = self._upload.file, self._rules.archives
        total = count_members(file, limits)
        self._read_lists(file)
        self._upload.report(0, total)
        self._reported_at = self._part_at = self._clock()
        for run in in_runs(self._prepare(m) for m in read_members(file, limits) if not is_beside_frames(m.name)):
            self._waiting.append(PendingRun(self._processes, run, self._upload.wait_s))
            if len(self._waiting) > self._rules.frames_in_flight:  # one run waits, so that no process does
                self._finish(self._waiting.popleft(), total)
        while self._waiting:
            self._finish(self._waiting.popleft(), total)
        self._confirm()
        self._find_expected()
        gaps, warnings = find_gaps([(frame.index, frame.captured_at) for frame in self._frames])
        notes = DriveNotes((*self._places.warnings, *warnings), gaps, receiver=self._places.receiver)
        return ArchiveSignal(self._frames, len(self._codebook), notes)

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
            poses = (context.frames or DeclaredFrames()).track
            lists = self._processes.run(read_frame_lists, files, poses, wait_s=self._upload.wait_s)
            self._places = FramePlaces(context, lists, self._upload.observed_at)
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
            camera = moment.context.camera_of(header)
        except WaymarkError as error:
            return ArchiveFrame(member.index, member.name, moment, error=error)
        nearby = self._markers_near(moment.context.coarse_position)
        picture = FramePicture(file, context.is_thermal, context.thermal_range, images)
        pixels = header.width_px * header.height_px
        return ArchiveFrame(member.index, member.name, moment, picture, self._look_for(nearby, camera), nearby, pixels)

    def _moment(self, member: Member, header: ImageHeader) -> FrameMoment:
        at = self._places.time_of(self._ordinal, member.name, header.taken)
        self._ordinal += 1
        pose = self._places.pose_of(at, member.name, header.position)
        return FrameMoment(self._places.context_at(pose), at, pose)

    def _look_for(self, nearby: NearbyMarkers, camera: Camera | None) -> FrameSearch:
        """The same object for frames that share it, so that a run has it once."""
        if self._search is None or self._search[0] is not nearby or self._search[1] != camera:
            self._search = nearby, camera, search_for(nearby, camera, is_paper=self._upload.context.is_paper)
        return self._search[2]

    def _markers_near(self, position: CoarsePosition | None) -> NearbyMarkers:
        """The markers that could be in view from a position; those of the frame before serve at the same position."""
        if self._nearby is None or self._nearby[0] != position:
            with self._database.read() as connection:
                self._nearby = position, find_nearby_markers(connection, self._upload.agency_id, position)
            self._codebook.update(self._nearby[1].codebook)
        return self._nearby[1]

    def _finish(self, run: PendingRun, total: int) -> None:
        """Wait for a run, and match its frames."""
        results = run.results(lambda: self._report(total))
        with self._database.read() as connection:
            self._frames += [self._matched(connection, frame, result) for frame, result in results]
        self._results |= {
            frame.index: (replace(frame, picture=None), result)
            for frame, result in results
            if isinstance(result, FrameResult)
        }
        self._report(total)

    def _report(self, total: int) -> None:
        """Record now and then how far the job is; what this raises stops it."""
        now, done = self._clock(), len(self._frames)
        if now - self._reported_at < self._rules.progress_every:
            return
        self._reported_at = now
        part = None
        if now - self._part_at >= PART_EVERY:
            self._part_at = now
            notes = DriveNotes(self._places.warnings)
            is_paper = self._upload.context.is_paper
            part = frames_result(self._frames, codebook_plates=len(self._codebook), notes=notes, is_paper=is_paper)
        self._upload.report(done, total, part)

    def _confirm(self) -> None:
        """Match plates again that are unsure in single frames, and that several frames confirm together."""
        shown = [(index, _plates(result)) for index, (_frame, result) in self._results.items()]
        if any(
            reading.symbols is not None or reading.certainty is not None for _, plates in shown for reading in plates
        ):
            self._replace_plates(self._processes.run(confirm_plates, shown, wait_s=self._upload.wait_s))

    def _find_expected(self) -> None:
        """Look for plates in the frames beside those that show them."""
        cameras = {
            index: frame.moment.context.camera_of(result.header) for index, (frame, result) in self._results.items()
        }
        plates = [DriveFrame(index, _plates(result), cameras[index]) for index, (_, result) in self._results.items()]
        expected = {} if self._upload.context.is_thermal else list_expected(plates)
        names = {self._results[index][0].name for index in expected}
        waiting: deque[tuple[int, Pending[tuple[PlateReading, ...]]]] = deque()
        found: dict[int, list[PlateReading]] = {}

        def finish() -> None:
            index, pending = waiting.popleft()
            if readings := pending.result():
                found[index] = with_expected(_plates(self._results[index][1]), readings)

        for member in read_members(self._upload.file, self._rules.archives, only=names.__contains__) if names else ():
            camera = cameras.get(member.index)
            if member.index not in expected or member.error is not None or camera is None:
                continue
            picture = FramePicture(SpooledFile.of(member.data), limits=self._rules.images)
            wanted = tuple(expected[member.index])
            task = self._processes.submit(find_expected_plates, picture, camera, wanted, wait_s=self._upload.wait_s)
            waiting.append((member.index, task))
            if len(waiting) > self._rules.frames_in_flight:
                finish()
        while waiting:
            finish()
        self._replace_plates(found)

    def _replace_plates(self, changed: Mapping[int, list[PlateReading]]) -> None:
        """Match frames again whose plates other frames have changed."""
        places = {frame.index: place for place, frame in enumerate(self._frames)}
        with self._database.read() as connection:
            for index, plates in changed.items():
                frame, result = self._results[index]
                camera = frame.moment.context.camera_of(result.header)
                others = tuple(one for one in result.readings if not isinstance(one, PlateReading))
                result = replace(result, readings=(*(with_pose(one, camera) for one in plates), *others))
                self._results[index] = frame, result
                self._frames[places[index]] = self._matched(connection, frame, result)

    def _matched(self, connection: sa.Connection, frame: ArchiveFrame, result: FrameResult | WaymarkError) -> ReadFrame:
        moment = frame.moment
        if isinstance(result, WaymarkError):
            return ReadFrame(frame.index, frame.name, error=result, captured_at=moment.at, pose=moment.pose)
        return read_frame(connection, self._upload, Member(frame.index, frame.name), result, frame.nearby, moment)


def _plates(result: FrameResult) -> list[PlateReading]:
    return [reading for reading in result.readings if isinstance(reading, PlateReading)]


# === Frames of an archive on their way through the decoder processes, several in one task.
#
# Handing over a task costs the server the same for one frame as for eight. With runs it takes 2.8 ms of processor time
# a frame, without 4.4 (two runs of `benchmarks.service.throughput` each on a busy machine, 800 frames of 1080p).


RUN_FRAMES = 8
"""Frames of a run at most."""
RUN_PIXELS = 20_000_000
"""Pixels of a run at most, unless one frame has more. [px] Less than the largest frame, which must
be decoded within the same time."""
RUN_BYTES = 8 * 1024**2
"""Bytes of a run at most, unless one frame has more. [byte]"""


@dataclass(frozen=True, slots=True)
class ArchiveFrame:
    """A frame that was inspected."""

    index: int  # number of its file in the archive
    name: str
    moment: FrameMoment
    picture: FramePicture | None = None  # None where an error keeps it from the decoder processes
    search: FrameSearch = field(default_factory=dict)
    nearby: NearbyMarkers = field(default_factory=NearbyMarkers)
    pixels: int = 0
    error: WaymarkError | None = None


def in_runs(frames: Iterable[ArchiveFrame]) -> Iterator[list[ArchiveFrame]]:
    """Frames in their order, as many together as a run may have."""
    run: list[ArchiveFrame] = []
    pixels = size = 0
    for frame in frames:
        frame_bytes = frame.picture.file.size if frame.picture is not None else 0
        pixels, size = pixels + frame.pixels, size + frame_bytes
        if run and (len(run) == RUN_FRAMES or pixels > RUN_PIXELS or size > RUN_BYTES):
            yield run
            run, pixels, size = [], frame.pixels, frame_bytes
        run.append(frame)
    if run:
        yield run


class PendingRun:
    """Frames in a decoder process.

    Parameters
    ----------
    wait_s : float
        How long to wait for a place. [s]

    Raises
    ------
    Unavailable
        The decoder processes are busy.
    """

    def __init__(self, processes: DecoderProcesses, frames: list[ArchiveFrame], wait_s: float) -> None:
        self._processes, self._frames, self._wait_s = processes, frames, wait_s
        self._pending = self._submit(frames)

    def results(self, report: Callable[[], None]) -> list[tuple[ArchiveFrame, FrameResult | WaymarkError]]:
        """Each frame with what was found in it, or the error.

        Where a frame stops the process of the run, each is decoded alone: only that frame has the error. `report` is
        called before each of these; what it raises ends the run.
        """
        try:
            found = iter(self._pending.result() if self._pending is not None else ())
        except ProcessStopped as error:
            decodable = [frame for frame in self._frames if frame.picture is not None]
            found = iter([error] if len(decodable) == 1 else [self._alone(frame, report) for frame in decodable])
        return [(frame, frame.error if frame.error is not None else next(found)) for frame in self._frames]

    def cancel(self) -> None:
        """Stop the process."""
        if self._pending is not None:
            self._pending.cancel()

    def _submit(self, frames: list[ArchiveFrame]) -> Pending[tuple[FrameResult | WaymarkError, ...]] | None:
        run = tuple((frame.picture, frame.search) for frame in frames if frame.picture is not None)
        return self._processes.submit(decode_frames, run, wait_s=self._wait_s) if run else None

    def _alone(self, frame: ArchiveFrame, report: Callable[[], None]) -> FrameResult | WaymarkError:
        report()
        try:
            self._pending = self._submit([frame])
            assert self._pending is not None
            return self._pending.result()[0]
        except Unavailable:
            raise
        except WaymarkError as error:
            return error
