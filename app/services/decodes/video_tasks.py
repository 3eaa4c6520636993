"""Videos, and the lists and tracks beside frames, in a decoder process."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from app.decoding.frames import PlateSearch
from app.errors import InvalidParameter, NotFound
from app.families.family import FrameReading
from app.families.plate.plates import PLATE
from app.formats.frame_list import is_frame_list, read_frame_list
from app.formats.poses import PoseDeclaration, PoseLimits, read_poses
from app.formats.video import AnyFrame, index_video, read_frames
from app.formats.video_file import ReadReport, VideoFile, VideoIndex, VideoLimits, VideoSegment
from app.plots.annotated_frame import Outline, draw_outlines, encode_picture
from app.services.decoder_tasks import decoder_task
from app.services.decodes.frame_poses import FrameLists, describe_report
from app.services.decodes.frame_tasks import FrameSearch
from app.services.decodes.matching import FRAME_READERS

if TYPE_CHECKING:  # it loads numba
    from app.decoders.plate.video_search import FoundPlate, PlateVideoSearch

OTHER_STEP = 3
"""[frames] of which one is searched for markers of other families than plates. For speed."""
MAX_BEYOND = 45
"""[frames] after a segment in which a plate that is in view at its end is followed."""
_VIDEO = ("video", "record at a lower resolution")


@decoder_task(*_VIDEO)
def index_frames(file: VideoFile, limits: VideoLimits = VideoLimits(), rate_hz: float | None = None) -> VideoIndex:
    """List the frames of a video. A stream without times has so many frames a second."""
    return index_video(file, limits, rate_hz=rate_hz)


@decoder_task(*_VIDEO)
def draw_video_frame(
    file: VideoFile,
    number: int,
    outlines: tuple[Outline, ...],
    suffix: Literal["png", "jpg"],
    limits: VideoLimits,
    rate_hz: float | None = None,
) -> bytes:
    """Decode a video up to one of its frames, and draw outlines over it."""
    index = index_video(file, limits, rate_hz=rate_hz)
    segment = next((part for part in index.segments if part.first <= number < part.end), None)
    frames = read_frames(index, segment, ReadReport()) if segment is not None else iter(())
    frame = next((frame for frame in frames if frame.number == number), None)
    if frame is None:
        raise NotFound(f"frame {number} of the video cannot be decoded", field="frame")
    return encode_picture(draw_outlines(frame.bgr(), outlines), suffix)


# === Segments.


@dataclass(frozen=True, slots=True)
class SegmentResult:
    """What a segment shows."""

    width_px: int  # of the upright frames; 0 if no frame could be decoded
    height_px: int
    frames: int  # that were searched
    decoded: int  # that went through the whole plate decoder
    damaged: int  # that could not be decoded
    other_size: int  # that have another size than the video
    plates: tuple[FoundPlate, ...]
    others: Mapping[int, tuple[FrameReading, ...]]  # readings of other families by frame
    load_ms: float  # spent on the video's codec
    decode_ms: float  # spent on the search


@decoder_task(*_VIDEO)
def decode_segment(
    index: VideoIndex,
    number: int,
    search: FrameSearch,
    thermal: bool = False,
    speeds: tuple[tuple[float, float], ...] = (),
) -> SegmentResult:
    """Search the frames of a segment, and follow the plates that are in view at its end.

    `speeds` are those of the vehicle at times of the video. [s, m/s]
    """
    return _SegmentDecoder(search, speeds, thermal=thermal).run(index, index.segments[number])


class _SegmentDecoder:
    def __init__(self, wanted: FrameSearch, speeds: Sequence[tuple[float, float]], *, thermal: bool) -> None:
        plates = wanted.get(PLATE.name)
        self._wanted = plates if isinstance(plates, PlateSearch) else PlateSearch()
        self._others = {name: search for name, search in wanted.items() if name != PLATE.name}
        self._speeds, self._thermal = speeds, thermal
        self._search: PlateVideoSearch | None = None
        self._size = (0, 0)
        self._load_s = 0.0

    def run(self, index: VideoIndex, segment: VideoSegment) -> SegmentResult:
        began, report = time.perf_counter(), ReadReport()
        plates, others, frames = [], {}, 0
        for frame in self._timed(read_frames(index, segment, report, beyond=MAX_BEYOND)):
            search = self._search_of(frame)
            if frame.number >= segment.end and not search.expects:
                break
            plates += search.look(frame.number, frame.time_s, frame.half_bgr, self._full(frame), self._speed(frame))
            if frame.number < segment.end:
                frames += 1
                if self._others and frame.number % OTHER_STEP == 0:
                    others[frame.number] = tuple(self._read_others(frame))
        if self._search is not None:
            plates += self._search.finish()
        own = tuple(plate for plate in plates if plate.seen[0].frame < segment.end)
        decode_ms = 1e3 * (time.perf_counter() - began - self._load_s)
        return SegmentResult(
            *self._size,
            frames,
            self._search.decoded if self._search else 0,
            report.damaged,
            report.other_size,
            own,
            {number: found for number, found in others.items() if found},
            1e3 * self._load_s,
            decode_ms,
        )

    def _timed(self, frames: Iterator[AnyFrame]) -> Iterator[AnyFrame]:
        while True:
            began = time.perf_counter()
            frame = next(frames, None)
            self._load_s += time.perf_counter() - began
            if frame is None:
                return
            yield frame

    def _search_of(self, frame: AnyFrame) -> PlateVideoSearch:
        if self._search is None:
            from app.decoders.plate.video_search import PlateVideoSearch

            self._size = frame.size_px
            camera = self._wanted.camera
            if camera is not None and (camera.width_px, camera.height_px) != self._size:
                raise InvalidParameter(
                    f"the camera has {camera.width_px} x {camera.height_px} px, the video "
                    f"{self._size[0]} x {self._size[1]} (upright)",
                    field="camera.width_px",
                    limit=f"{self._size[0]} x {self._size[1]} px",
                    cure="send the camera parameters of this video",
                )
            codebook, geometries = self._wanted.codebook, self._wanted.geometries
            self._search = PlateVideoSearch(camera, codebook, geometries, thermal=self._thermal)
        return self._search

    def _full(self, frame: AnyFrame) -> Any:
        return frame.grey if self._thermal else frame.bgr

    def _speed(self, frame: AnyFrame) -> float | None:
        if not self._speeds:
            return None
        times, speeds = np.array(self._speeds).T
        return float(np.interp(frame.time_s, times, speeds))

    def _read_others(self, frame: AnyFrame) -> Iterator[FrameReading]:
        pixels = frame.grey() if self._thermal else frame.bgr()
        for name, search in self._others.items():
            yield from FRAME_READERS[name].read(pixels, search, thermal=self._thermal)


# === Lists of frames and tracks beside them.


@decoder_task("list", "send shorter lists and tracks", is_long=False)
def read_frame_lists(
    files: tuple[tuple[str, bytes], ...], declaration: PoseDeclaration, limits: PoseLimits = PoseLimits()
) -> FrameLists:
    """Read the first list of frames and the first track, of files by name."""
    read = FrameLists()
    for name, data in files:
        if is_frame_list(name):
            if read.frames is None:
                frames = read_frame_list(name, data, declaration)
                read = replace(read, frames=frames, warnings=(*read.warnings, *describe_report(name, frames.report)))
                continue
        elif read.track is None:
            track, report = read_poses(name, data, declaration, limits)
            read = replace(read, track=track, warnings=(*read.warnings, *describe_report(name, report)))
            continue
        read = replace(read, warnings=(*read.warnings, f"{name} is not used: there is another file of its kind"))
    return read
