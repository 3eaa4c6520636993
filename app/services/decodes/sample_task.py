"""Tasks of decoder processes that read an upload again for a closer look, and their results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field
from typing_extensions import TypedDict

from app.formats.spooled_file import SpooledFile
from app.formats.traces.declaration import TraceLimits
from app.formats.video.container import VideoFile
from app.formats.video.index import VideoLimits
from app.plots.annotated_frame import Outline
from app.services.decoder_processes import Task

MAX_POINTS = 200_000
"""Points of each series at most. Source: chosen by hand; 2 MB of JSON for a series."""
MAX_SERIES = 6
DEFAULT_SERIES = ("vertical", "forward")
MAX_PACKETS = 20_000
"""Packets that are listed at most. Source: chosen by hand; 2 MB of JSON."""


class SampleSeries(TypedDict):
    """Values of one series, null where a sample is missing. [uT]"""

    name: str
    values: list[float | None]


class SamplesDocument(TypedDict):
    """Samples of a recording.

    If there are more than asked for, two points stand for each group of samples: the smallest and the largest value of
    a series, at the times of the group's first and middle sample. `t_s` is the recording's time, as in `tags` and
    `magnets` of the decode.
    """

    series: list[SampleSeries]
    t_s: list[float]
    from_s: float
    to_s: float
    samples: Annotated[int, Field(description="Between from_s and to_s.")]
    thinned: bool
    available: Annotated[list[str], Field(description="Names that `series` may have.")]


@dataclass(frozen=True, slots=True)
class SamplesTask(Task[SamplesDocument]):
    """Samples of a recording to read.

    Attributes
    ----------
    name : str
        Of the file.
    file : SpooledFile
    declared : mapping
        The declaration that came with the upload.
    series : tuple of str
        ``vertical`` and ``forward`` are the largest change on any sensor of the array, ``s3_x`` is an axis of a sensor.
    from_s, to_s : float or None
        Of the recording; None for its ends. [s]
    points : int
        Of each series at most.
    limits : TraceLimits
    """

    name: str
    file: SpooledFile
    declared: Mapping[str, Any]
    series: tuple[str, ...] = DEFAULT_SERIES
    from_s: float | None = None
    to_s: float | None = None
    points: int = 100_000
    limits: TraceLimits = field(default_factory=TraceLimits)


class VehicleTrackDocument(TypedDict):
    """The vehicle's own track beside a packet log; the heading is null where it is not known."""

    time_s: list[float]
    lon_deg: list[float]
    lat_deg: list[float]
    heading_deg: list[float | None]


class PacketsDocument(TypedDict):
    """Packets of a log in the order of their times, as columns; null where a value is not known.

    `time_s` are seconds since 1970-01-01 UTC. `verdict` is `accepted` for authentic packets and their repetitions, else
    the reason why a packet was refused; it is null where the decode does not list it, which has 500 refused packets at
    most. The position is that of the vehicle.
    """

    total: int
    entry: list[int]
    time_s: list[float | None]
    number: list[int | None]
    rssi_dbm: list[float | None]
    snr_db: list[float | None]
    verdict: list[str | None]
    reason: list[str | None]
    lon_deg: list[float | None]
    lat_deg: list[float | None]
    track: VehicleTrackDocument | None


@dataclass(frozen=True, slots=True)
class VideoFrameTask(Task[bytes]):
    """A frame of a video to draw its readings on.

    Attributes
    ----------
    file : VideoFile
    number : int
        Of the frame.
    outlines : tuple of Outline
    suffix : str
        ``png`` or ``jpg``.
    limits : VideoLimits
    rate_hz : float or None
        Frames a second of a stream without times. [Hz]
    """

    file: VideoFile
    number: int
    outlines: tuple[Outline, ...]
    suffix: Literal["png", "jpg"]
    limits: VideoLimits = field(default_factory=VideoLimits)
    rate_hz: float | None = None
    is_long: ClassVar[bool] = True
