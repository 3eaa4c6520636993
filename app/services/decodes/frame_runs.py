"""Frames of an archive on their way through the decoder processes, several in one task.

Handing over a task costs the server the same for one frame as for eight. With runs it takes 2.8 ms of processor time a
frame, without 4.4 (two runs of `benchmarks.service.throughput` each on a busy machine, 800 frames of 1080p).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from app.errors import ProcessStopped, Unavailable, WaymarkError
from app.services.decoder_processes import DecoderProcesses, Pending
from app.services.decodes.frame_handler import FrameMoment
from app.services.decodes.frame_task import FramePicture, FrameResult, FrameRunTask, FrameSearch
from app.services.decodes.matching import NearbyMarkers

RUN_FRAMES = 8
"""Frames of a run at most. Source: by hand."""
RUN_PIXELS = 20_000_000
"""Pixels of a run at most, unless one frame has more. [px] Source: by hand; less than the largest frame, which must
be decoded within the same time."""
RUN_BYTES = 8 * 1024**2
"""Bytes of a run at most, unless one frame has more. [byte] Source: by hand."""


@dataclass(frozen=True, slots=True)
class ArchiveFrame:
    """A frame that was inspected.

    Attributes
    ----------
    index : int
        Number of its file in the archive.
    name : str
    moment : FrameMoment
    picture : FramePicture or None
        None where an error keeps it from the decoder processes.
    search : FrameSearch
    nearby : NearbyMarkers
    pixels : int
        [px]
    error : WaymarkError or None
    """

    index: int
    name: str
    moment: FrameMoment
    picture: FramePicture | None = None
    search: FrameSearch = field(default_factory=lambda: FrameSearch({}))
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


class StartedRun:
    """Frames in a decoder process.

    Parameters
    ----------
    processes : DecoderProcesses
    frames : list of ArchiveFrame
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
        tasks = tuple((frame.picture, frame.search) for frame in frames if frame.picture is not None)
        return self._processes.submit(FrameRunTask(tasks), wait_s=self._wait_s) if tasks else None

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
