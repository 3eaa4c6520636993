"""Tasks of decoder processes about videos, and their results: plain values that can be pickled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from app.families.frames import FrameReading
from app.formats.video.container import VideoFile
from app.formats.video.index import VideoIndex, VideoLimits
from app.services.decoder_processes import Task

if TYPE_CHECKING:  # it loads numba
    from app.decoders.plate.video_search import FoundPlate


@dataclass(frozen=True, slots=True)
class IndexVideoTask(Task[VideoIndex]):
    """A video whose frames are to be listed.

    Attributes
    ----------
    file : VideoFile
    limits : VideoLimits
    rate_hz : float or None
        Frames a second of a stream without times. [Hz]
    """

    file: VideoFile
    limits: VideoLimits = field(default_factory=VideoLimits)
    rate_hz: float | None = None


@dataclass(frozen=True, slots=True)
class SegmentTask(Task["SegmentResult"]):
    """A segment of a video to decode.

    Attributes
    ----------
    index : VideoIndex
    number : int
        Of the segment.
    by_family : mapping of str to object
        What to look for, as in `FrameSearch`.
    thermal : bool
    speeds : tuple of (float, float)
        Speed of the vehicle at times of the video. [s, m/s]
    """

    index: VideoIndex
    number: int
    by_family: Mapping[str, object]
    thermal: bool = False
    speeds: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True)
class SegmentResult:
    """What a segment shows.

    Attributes
    ----------
    width_px, height_px : int
        Of the upright frames; 0 if no frame could be decoded. [px]
    frames, decoded : int
        Frames that were searched, and those that went through the whole plate decoder.
    damaged, other_size : int
        Frames that could not be decoded, or that have another size than the video.
    plates : tuple of FoundPlate
    others : mapping of int to tuple of FrameReading
        Readings of other families by frame.
    load_ms, decode_ms : float
        Time spent on the video's codec and on the search. [ms]
    """

    width_px: int
    height_px: int
    frames: int
    decoded: int
    damaged: int
    other_size: int
    plates: tuple[FoundPlate, ...]
    others: Mapping[int, tuple[FrameReading, ...]]
    load_ms: float
    decode_ms: float
