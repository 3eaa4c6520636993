"""What goes to a decoder process and what comes back: plain values that survive pickling, and no database."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Protocol

from app.decoders.images import ImageHeader, ImageLimits
from app.markers.plate import PlateCode, PlateGeometry
from app.markers.reading import PlateReading
from app.sensors.camera import Camera
from app.services.packets import PacketDecoder
from app.services.traces import TraceDecoder


@dataclass(frozen=True, slots=True)
class FrameTask:
    """One frame to decode.

    Attributes
    ----------
    data : bytes
        JPEG or PNG.
    thermal : bool
    thermal_range : (float, float) or None
        Counts that become 0 and 255 in a 16-bit thermal frame. [counts]
    limits : ImageLimits
    """

    data: bytes
    thermal: bool = False
    thermal_range: tuple[float, float] | None = None
    limits: ImageLimits = field(default_factory=ImageLimits)


@dataclass(frozen=True, slots=True)
class PlateSearch:
    """What to look for in a frame.

    Attributes
    ----------
    camera : Camera or None
    codebook : tuple of PlateCode
        Plates that the registry knows near by.
    geometries : tuple of PlateGeometry
        Dimensions to look for; the decoder's own where there are none.
    """

    camera: Camera | None = None
    codebook: tuple[PlateCode, ...] = ()
    geometries: tuple[PlateGeometry, ...] = ()


@dataclass(frozen=True, slots=True)
class FrameResult:
    """What a decoder process found in a frame.

    Attributes
    ----------
    header : ImageHeader
    readings : tuple of PlateReading
    load_ms, decode_ms : float
        Time spent on the picture's codec and on the plates. [ms]
    """

    header: ImageHeader
    readings: tuple[PlateReading, ...]
    load_ms: float
    decode_ms: float


@dataclass(frozen=True, slots=True)
class Outline:
    """One reading to draw over its frame.

    Attributes
    ----------
    corners_px : tuple of (float, float)
        Clockwise from the triangle's corner; may be empty.
    outcome : str
    label : str
    """

    corners_px: tuple[tuple[float, float], ...]
    outcome: str
    label: str


@dataclass(frozen=True, slots=True)
class AnnotationTask:
    """A frame to draw its readings on.

    Attributes
    ----------
    suffix : str
        ``png`` or ``jpg``.
    """

    data: bytes
    outlines: tuple[Outline, ...]
    suffix: str
    thermal: bool = False
    thermal_range: tuple[float, float] | None = None
    limits: ImageLimits = field(default_factory=ImageLimits)


class PendingFrame(Protocol):
    """A frame on its way through a decoder process."""

    def result(self) -> FrameResult:
        """Wait for it.

        Raises
        ------
        UnreadableUpload
            The picture is refused, or it killed or outstayed the decoder process.
        Unavailable
            No decoder process could be had.
        """

    def cancel(self) -> None:
        """Stop it, also when it runs already. Every frame that is started ends in `result` or here."""


class FrameDecoder(TraceDecoder, PacketDecoder, Protocol):
    """Decoder processes, as the services see them."""

    def start(self, task: FrameTask, search: Future[PlateSearch], *, wait_s: float = 0.0) -> PendingFrame:
        """Hand a frame over and return, at once or as soon as there is a place for it within `wait_s`.

        The picture is loaded while the caller still finds out what to look for, and fills `search`.

        Raises
        ------
        Unavailable
            Too many frames are waiting already.
        """

    def annotate(self, task: AnnotationTask) -> bytes:
        """Picture with outlines, encoded."""


class Blobs(Protocol):
    """Store of uploads, as the services see it."""

    def put(self, key: str, data: bytes, *, durable: bool = False) -> None:
        """Write a blob once."""

    def get(self, key: str) -> bytes:
        """Content of a blob."""

    def delete(self, key: str) -> None:
        """Remove a blob."""


class JobQueue(Protocol):
    """Where long decodes wait, as the services see it."""

    def submit(self, job_id: str) -> None:
        """Have ``run_job(job_id)`` called, at least once."""


def distinct_geometries(geometries: Sequence[PlateGeometry]) -> tuple[PlateGeometry, ...]:
    """The geometries without repetitions; thickness does not show in a frame."""
    seen: dict[tuple[int, float, float], PlateGeometry] = {}
    for geometry in geometries:
        seen.setdefault((geometry.n, geometry.unit_mm, geometry.gap_mm), geometry)
    return tuple(seen.values())
