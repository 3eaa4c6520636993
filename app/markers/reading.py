"""Outcomes of reading a marker, with status, checks and localization warnings."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt
from pydantic import GetPydanticSchema

from app.geodesy import UNFIT_TEXT, LocalizationGrade, grade_accuracy, move_to_epoch, total_accuracy_m
from app.geodesy.place import Grade
from app.markers.plate import PlateCode, PlateGeometry

# === Arrays in results, which JSON has as lists.


Vector = Annotated[npt.NDArray[np.float64], GetPydanticSchema(lambda _, schema_of: schema_of(list[float]))]
Matrix = Annotated[npt.NDArray[np.float64], GetPydanticSchema(lambda _, schema_of: schema_of(list[list[float]]))]


# === Status of a marker: from the plan to the end of its use.


Status = Literal["planned", "built", "surveyed", "active", "suspect", "retired"]
STATUSES: tuple[Status, ...] = get_args(Status)


# === A marker as it is registered.


class MarkerRow(NamedTuple):
    """A marker of any family. `check_digits` to `thickness_mm` are of plates, and None in the rows of other families.

    `original` is the position as it was sent; `spec` is what else a family stores, in the shape that it declares.
    """

    id: str
    family: str
    status: Status
    scheme: str
    digits: str
    check_digits: int | None
    digits_match_position: bool | None
    n: int
    unit_mm: float
    gap_mm: float
    thickness_mm: float
    lon_deg: float
    lat_deg: float
    height_m: float | None
    heading_deg: float | None
    heading_rmse_deg: float | None
    crs: str
    realization: str | None
    epoch: float | None
    vertical_datum: str | None
    horizontal_rmse_m: float | None
    vertical_rmse_m: float | None
    survey_method: str | None
    check_points: int | None
    surveyor: str | None
    instrument: str | None
    survey_file_sha256: str | None
    transform_accuracy_m: float | None
    original: dict[str, object]
    localization_grade: Grade
    transform_note: str | None
    road: str | None
    measure_m: float | None
    offset_m: float | None
    spec: Any
    version: int
    created_at: datetime
    updated_at: datetime


def horizontal_rmse_m(row: MarkerRow) -> float | None:
    """What a marker's position is good to: its survey, and the stated bound of what brought it to WGS 84 / ITRF. [m]"""
    stated, bound_m = row.horizontal_rmse_m, row.transform_accuracy_m
    return None if stated is None else math.hypot(stated, bound_m or 0.0)


def marker_at(row: MarkerRow, epoch: float) -> MarkerRow:
    """The row with the position that its marker has at an epoch, by the motion of its plate.

    A position without an epoch stays: its accuracy already allows for the motion of ten years.

    Parameters
    ----------
    epoch : float
        [decimal year]
    """
    if row.epoch is None or row.transform_accuracy_m is None:
        return row
    moved = move_to_epoch(row.lon_deg, row.lat_deg, row.epoch, epoch)
    accuracy_m = math.hypot(row.transform_accuracy_m, float(moved.accuracy_m[0]))
    return row._replace(
        lon_deg=float(moved.lon_deg[0]), lat_deg=float(moved.lat_deg[0]), epoch=epoch, transform_accuracy_m=accuracy_m,
        localization_grade=grade_accuracy(total_accuracy_m(row.horizontal_rmse_m, accuracy_m)).value,
    )  # fmt: skip


# === Reasons why a marker's position is unfit for localization.


SURVEYED = ("surveyed", "active")


def position_warnings(what: str, *, grade: str, transform_note: str | None, status: str) -> list[str]:
    """Warnings about the position of a marker; none if it is fit for localization.

    Parameters
    ----------
    what : str
        What the marker is called: plate, tag.
    grade : str
        A `LocalizationGrade`.
    transform_note : str or None
        Note on the transformation of its position.
    """
    localization_warnings = []
    if grade == LocalizationGrade.UNFIT:
        localization_warnings.append(transform_note or f"the {what}'s position is {UNFIT_TEXT}")
    if status not in SURVEYED:
        localization_warnings.append(f"the {what} is {status}, its position is not surveyed")
    return localization_warnings


def row_warnings(row: MarkerRow, what: str) -> list[str]:
    """What makes the position of a plate or a tag unfit for localization."""
    return position_warnings(what, grade=row.localization_grade, transform_note=row.transform_note, status=row.status)


# === The result of one design check: its figure, the limit and the limit's source.


@dataclass(frozen=True, slots=True)
class ComparedFigure:
    """A figure beside its limit."""

    name: str  # which check, e.g. ``magnet-spacing`` or ``dwell-time``.
    figure: float  # what the layout or the plan has, in `unit`
    relation: Literal[">=", "<="]  # how the figure must compare with the limit
    limit: float
    unit: str
    source: str  # where the limit comes from


@dataclass(frozen=True, slots=True)
class Check(ComparedFigure):
    """One check of a magnet layout; `note` describes the figure for people."""

    passed: bool
    note: str


class Verdict(StrEnum):
    """How a check ended."""

    OK = "ok"
    WARN = "warn"
    FAIL = "fail"


@dataclass(frozen=True, slots=True)
class RadioFinding(ComparedFigure):
    """One check of a radio plan, which may end between passed and failed: its figure, the limit, and what follows."""

    verdict: Verdict
    sentence: str

    @property
    def passed(self) -> bool:
        """Whether nothing is wrong."""
        return self.verdict is Verdict.OK


def worst_verdict(findings: Iterable[RadioFinding]) -> Verdict:
    """The worst verdict of all findings."""
    found = {finding.verdict for finding in findings}
    return next((verdict for verdict in (Verdict.FAIL, Verdict.WARN) if verdict in found), Verdict.OK)


def at_most(
    name: str, figure: float, limit: float, unit: str, source: str, sentence: str, *, worst: Verdict = Verdict.FAIL
) -> RadioFinding:
    """A finding that is well where the figure is no more than the limit, else `worst`."""
    met = figure <= limit * (1 + 1e-9)
    return RadioFinding(name, figure, "<=", limit, unit, source, Verdict.OK if met else worst, sentence)


def at_least(
    name: str, figure: float, limit: float, unit: str, source: str, sentence: str, *, worst: Verdict = Verdict.FAIL
) -> RadioFinding:
    """A finding that is well where the figure is no less than the limit, else `worst`."""
    met = figure >= limit - 1e-9 * abs(limit)
    return RadioFinding(name, figure, ">=", limit, unit, source, Verdict.OK if met else worst, sentence)


# === Outcomes of reading a marker.


class PlateOutcome(StrEnum):
    """Outcome of a candidate plate. Only READ has digits.

    The first five after READ are the cases that the PolyU paper filters out (section II-D4).
    """

    READ = "read"
    GREEN_MARKER_MISSING = "green-marker-missing"
    RED_MARKER_MISSING = "red-marker-missing"
    FEWER_THAN_FOUR_VERTICES = "fewer-than-four-vertices"
    VERTICES_BEYOND_MARKERS = "vertices-beyond-markers"
    CELLS_UNDECODABLE = "cells-undecodable"
    UNSURE = "unsure"
    NOT_IN_REGISTRY = "not-in-registry"


class Certainty(StrEnum):
    """How sure digits are.

    Unchecked ones have neither checks nor a registered plate that confirms them: a unit that peeled off, or tape that
    covers just one, shows other digits in every frame. Tentative ones give no position, until another frame or the
    registry confirms them.
    """

    SURE = "sure"
    UNCHECKED = "unchecked"
    TENTATIVE = "tentative"


@dataclass(frozen=True, slots=True)
class PlatePose:
    """Pose of a marker in the camera frame; the covariance is of rotation vector [rad] and translation [m]."""

    # shape (3, 3): camera_from_plate; plate axes x right, y travel, z up out of the road; those of the camera are
    # OpenCV's: x right, y down, z forward
    rotation: Matrix
    translation_m: Vector  # shape (3,): [m] plate centre in the camera frame
    covariance: Matrix  # shape (6, 6): the rotation vector is about the camera's axes
    reprojection_rms_px: float  # [px] root mean square of the corners' residuals


@dataclass(frozen=True, slots=True)
class PlateGrade:
    """Waymark grade of a read plate, modelled on ISO/IEC 15415 (no conformance is claimed): 4 (A) to 0 (F).

    The overall grade is the lowest of its parts.
    """

    letter: str  # A, B, C, D or F
    overall: float
    contrast: float
    modulation: float
    fixed_pattern: float
    axial_nonuniformity: float
    grid_nonuniformity: float
    unused_correction: float


class SymbolEvidence(NamedTuple):
    """What a frame shows of the symbols of a plate: other frames of the plate are added to it."""

    scores: npt.NDArray[np.float64]  # shape (cells, 16): log of 16 times the probability of each symbol
    look_alikes: float  # share of the look-alikes that show as much of a plate's grid and markers


@dataclass(frozen=True, slots=True)
class PlateReading:
    """One candidate plate in a frame and what was read from it."""

    family: ClassVar[str] = "plate"
    outcome: PlateOutcome
    # shape (4, 2), or None: [px] outer corners, clockwise from the triangle's, pixel centres at integers
    corners_px: npt.NDArray[np.float64] | None = None
    # shape (8, 8), or None: [px2] covariance of the flattened corners
    corners_covariance_px2: npt.NDArray[np.float64] | None = None
    code: PlateCode | None = None  # the digits with their scheme; only when the outcome is READ
    # digits that are likely, but too unsure to be returned as read: a tentative reading. They give no position.
    likely_code: PlateCode | None = None
    doubtful_cells: tuple[int, ...] = ()  # of a tentative reading, the cells that may be wrong
    confidence: float = 0.0  # probability that all digits, or the likely ones, are right, 0 to 1
    cell_confidence: tuple[float, ...] = ()  # probability that each cell's symbol is right, in reading order
    corrected_cells: tuple[int, ...] = ()  # cells whose symbol came from error correction or from the codebook
    is_registered: bool = False  # a registered plate nearby has these digits
    # the codebook decided, or confirmed digits that the frame alone may have been too unsure to give
    from_codebook: bool = False
    geometry: PlateGeometry | None = None
    grade: PlateGrade | None = None
    pose: PlatePose | None = None  # with camera parameters only
    # `height_px`, `width_px`: [px] extent of the corners in the image
    height_px: float = 0.0
    width_px: float = 0.0
    reason: str = ""  # why it was refused, as a sentence
    # frames whose evidence the code rests on together; empty where this frame alone shows it
    frames: tuple[int, ...] = ()
    # shape (units, 5), or None: of the hypotheses on each unit under the digits, where the frame's pixels were
    # compared: other frames of the plate are added to them
    unit_log_likelihoods: npt.NDArray[np.float64] | None = None
    symbols: SymbolEvidence | None = None  # None where the units do not stand out of the noise, and of thermal frames

    @property
    def certainty(self) -> Certainty | None:
        """How sure the digits are; None where there are none."""
        if self.code is not None:
            return Certainty.SURE if self.is_registered or self.code.scheme.corrects else Certainty.UNCHECKED
        return Certainty.TENTATIVE if self.likely_code is not None else None

    def is_at(self, other: PlateReading) -> bool:
        """Whether the middle of this plate's image lies within the extent of the other's."""
        if self.corners_px is None or other.corners_px is None:
            return False
        middle, low, high = self.corners_px.mean(axis=0), other.corners_px.min(axis=0), other.corners_px.max(axis=0)
        return bool(((middle > low) & (middle < high)).all())

    @property
    def digits(self) -> str | None:
        """Digits as read, None unless the outcome is READ."""
        return self.code.digits if self.code else None
