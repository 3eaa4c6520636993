"""What decoder processes are asked to do for artwork, print grades and camera views: plain values."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, ClassVar

from app.encoders.plate import BundleOptions
from app.encoders.plate.face import PlateOrder
from app.formats.format import SpooledFile
from app.formats.images import ImageLimits
from app.markers.plate import PlateCode, PlateGeometry
from app.planning.predict.rates import CameraView
from app.planning.proof.report import Condition
from app.planning.rules import CameraRules
from app.services.markers.print_documents import PrintGradeDocument
from app.services.ports import Task

# === What decoder processes are asked to do for artwork of many plates.


Files = list[tuple[str, bytes]]


@dataclass(frozen=True, slots=True)
class DrawPlateTask(Task[tuple[Files, dict[str, Any]]]):
    """A plate to draw, to prove and to write: its files, and its entry in the manifest."""

    order: PlateOrder
    name: str  # of the files, without extension
    options: BundleOptions


@dataclass(frozen=True, slots=True)
class WriteSheetsTask(Task[Files]):
    """Sheets to nest plates on, and the quality sheets."""

    orders: tuple[PlateOrder, ...]
    options: BundleOptions


# === What decoder processes are asked to do for print grades, and what they return: plain values that can be pickled.


@dataclass(frozen=True, slots=True)
class GradedPhoto:
    """The grade of a photo."""

    document: PrintGradeDocument
    pdf: bytes = b""  # empty unless it was asked for


@dataclass(frozen=True, slots=True)
class PrintGradeTask(Task[GradedPhoto]):
    """A photo of a printed plate to grade."""

    is_long: ClassVar[bool] = False

    photo: SpooledFile  # JPEG or PNG
    at: datetime  # of the request
    code: PlateCode | None  # what the plate should be; None: what the photo shows
    geometry: PlateGeometry | None  # of the drawing
    marker_id: str | None  # where the code and the geometry are from
    camera: CameraRules
    speed_kmh: float  # [km/h] design speed
    as_pdf: bool = False
    limits: ImageLimits = field(default_factory=ImageLimits)


# === What decoder processes are asked to do for pictures of what a camera sees: plain values that can be pickled.


@dataclass(frozen=True, slots=True)
class CameraViewTask(Task[CameraView]):
    """A plate to render as a camera sees it, and to decode."""

    is_long: ClassVar[bool] = False

    code: PlateCode
    geometry: PlateGeometry
    camera: CameraRules
    speed_mps: float
    # `ahead_m`, `left_m`: [m] the plate's centre from the camera
    ahead_m: float
    left_m: float
    condition: Condition
