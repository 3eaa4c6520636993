"""What decoder processes are asked to do for print grades, and what they return: plain values that can be pickled."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import ClassVar

from app.formats.images import ImageLimits
from app.formats.spooled_file import SpooledFile
from app.markers.plate import PlateCode, PlateGeometry
from app.planning.rules import CameraRules
from app.services.decoder_processes import Task
from app.services.markers.print_documents import PrintGradeDocument


@dataclass(frozen=True, slots=True)
class GradedPhoto:
    """The grade of a photo.

    Attributes
    ----------
    document : PrintGradeDocument
    pdf : bytes
        Empty unless it was asked for.
    """

    document: PrintGradeDocument
    pdf: bytes = b""


@dataclass(frozen=True, slots=True)
class PrintGradeTask(Task[GradedPhoto]):
    """A photo of a printed plate to grade.

    Attributes
    ----------
    photo : SpooledFile
        JPEG or PNG.
    at : datetime
        Of the request.
    code : PlateCode or None
        What the plate should be; None: what the photo shows.
    geometry : PlateGeometry or None
        Of the drawing.
    marker_id : str or None
        Where the code and the geometry are from.
    camera : CameraRules
    speed_kmh : float
        Design speed. [km/h]
    as_pdf : bool
    limits : ImageLimits
    """

    is_long: ClassVar[bool] = False

    photo: SpooledFile
    at: datetime
    code: PlateCode | None
    geometry: PlateGeometry | None
    marker_id: str | None
    camera: CameraRules
    speed_kmh: float
    as_pdf: bool = False
    limits: ImageLimits = field(default_factory=ImageLimits)
