"""Tasks of decoder processes about frames, and their results: plain values that can be pickled."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import ClassVar

from app.errors import WaymarkError
from app.families.frames import FrameReading
from app.formats.images import ImageHeader, ImageLimits
from app.formats.spooled_file import SpooledFile
from app.plots.annotated_frame import Outline
from app.services.decoder_processes import Task


@dataclass(frozen=True, slots=True)
class FramePicture:
    """One frame to load.

    Attributes
    ----------
    file : SpooledFile
        JPEG or PNG.
    thermal : bool
    thermal_range : (float, float) or None
        Counts that become 0 and 255 in a 16-bit thermal frame. [counts]
    limits : ImageLimits
    """

    file: SpooledFile
    thermal: bool = False
    thermal_range: tuple[float, float] | None = None
    limits: ImageLimits = field(default_factory=ImageLimits)


@dataclass(frozen=True, slots=True)
class FrameSearch:
    """What to look for in a frame: what each family's `FrameReader.search` returns, by the family's name."""

    by_family: Mapping[str, object]


@dataclass(frozen=True, slots=True)
class FrameResult:
    """What a decoder process found in a frame.

    Attributes
    ----------
    header : ImageHeader
    readings : tuple of FrameReading
    load_ms, decode_ms : float
        Time spent on the picture's codec and on the markers. [ms]
    """

    header: ImageHeader
    readings: tuple[FrameReading, ...]
    load_ms: float
    decode_ms: float


@dataclass(frozen=True, slots=True)
class FrameTask(Task[FrameResult]):
    """One frame to decode, in two steps: the picture is loaded while the caller still finds out what to look for.

    Attributes
    ----------
    picture : FramePicture
    search : Future of FrameSearch
        The caller sets it.
    """

    is_long: ClassVar[bool] = False

    picture: FramePicture
    search: Future[FrameSearch] = field(default_factory=Future)

    def steps(self) -> tuple[object, ...]:
        """The picture, then the search."""
        return (self.picture, self.search)


@dataclass(frozen=True, slots=True)
class FrameRunTask(Task[tuple[FrameResult | WaymarkError, ...]]):
    """Several frames to decode one after the other, so that their processes are handed work less often.

    The result has the error of each frame that cannot be read. A frame that stops the process stops the whole run.

    Attributes
    ----------
    frames : tuple of (FramePicture, FrameSearch)
    """

    is_long: ClassVar[bool] = False

    frames: tuple[tuple[FramePicture, FrameSearch], ...]


@dataclass(frozen=True, slots=True)
class AnnotationTask(Task[bytes]):
    """A frame to draw its readings on.

    Attributes
    ----------
    suffix : str
        ``png`` or ``jpg``.
    """

    is_long: ClassVar[bool] = False

    file: SpooledFile
    outlines: tuple[Outline, ...]
    suffix: str
    thermal: bool = False
    thermal_range: tuple[float, float] | None = None
    limits: ImageLimits = field(default_factory=ImageLimits)
