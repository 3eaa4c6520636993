"""A plan as one JSON document, and back: everything that checks, proof and outputs need, without the source files."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer, ValidationError, model_validator

from app.errors import InvalidParameter, UnreadableUpload
from app.formats.alignments.geometry import BoundaryStyle, StationEquation
from app.markers.magnet_codebook import Codebook
from app.planning.alignment import Alignment, AvoidedArea, Floats, Lane, RoadEvent
from app.planning.plan import LeftOut, Plan, PlanFinding, PlannedMarker
from app.planning.rules import PlanRules
from app.planning.trade_off import Optimum
from app.radio.settings import RadioSettings

PLAN_FORMAT = "waymark-plan/1"
MAX_PLAN_BYTES = 500_000_000
"""Longest document. [bytes] Source: chosen by hand, several times that of 500,000 markers."""
_MAX_SAMPLES = 5_000_000  # of one array; source: chosen by hand, 5,000 km of lane


def _read_array(value: object) -> Floats:
    """A list of numbers, with null for NaN."""
    if isinstance(value, np.ndarray):
        return value
    if not isinstance(value, list) or not 0 < len(value) <= _MAX_SAMPLES:
        raise ValueError("a list of numbers is expected")
    if not all(item is None or type(item) in (float, int) for item in value):
        raise ValueError("a list of numbers is expected")
    return np.array(value, dtype=np.float64)


def _write_array(values: Floats) -> list[float | None]:
    return [None if value != value else value for value in values.tolist()]


_Array = Annotated[Any, BeforeValidator(_read_array), PlainSerializer(_write_array)]
"""An array of float64, shape (N,)."""
_LANE_ARRAYS = (
    "chainage_m", "lon_deg", "lat_deg", "height_m", "heading_deg", "curvature_per_m", "grade", "superelevation_rad",
    "width_m", "design_speed_mps", "station_m",
)  # fmt: skip


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", arbitrary_types_allowed=True)


class LaneDocument(_Part):
    """A lane with its summary; an array of equal values is one number."""

    name: str
    road: str
    length_m: float
    samples: int
    left_style: BoundaryStyle
    right_style: BoundaryStyle
    arrays: dict[str, _Array | float | None]

    @model_validator(mode="after")
    def _complete(self) -> LaneDocument:
        if set(self.arrays) != set(_LANE_ARRAYS):
            raise ValueError(f"arrays are {', '.join(_LANE_ARRAYS)}")
        for name, values in self.arrays.items():
            if isinstance(values, np.ndarray) and values.shape != (self.samples,):
                raise ValueError(f"arrays.{name} has {values.size} values, the lane {self.samples} samples")
        if self.samples < 2:
            raise ValueError("a lane has at least two samples")
        return self

    @classmethod
    def of(cls, lane: Lane) -> LaneDocument:
        """The document of a lane."""
        arrays = {name: _packed(getattr(lane, name)) for name in _LANE_ARRAYS}
        return cls(
            name=lane.name, road=lane.road, length_m=lane.length_m, samples=len(lane.chainage_m),
            left_style=lane.left_style, right_style=lane.right_style, arrays=arrays,
        )  # fmt: skip

    def lane(self) -> Lane:
        """The lane of the document."""
        arrays = {name: self._unpacked(values) for name, values in self.arrays.items()}
        return Lane(self.name, self.road, **arrays, left_style=self.left_style, right_style=self.right_style)

    def _unpacked(self, values: float | Floats | None) -> Floats:
        if isinstance(values, np.ndarray):
            return values
        return np.full(self.samples, np.nan if values is None else values, dtype=np.float64)


def _packed(values: Floats) -> float | Floats | None:
    if np.isnan(values).all():
        return None
    return float(values[0]) if (values == values[0]).all() else values


class AreaDocument(_Part):
    """An area to avoid: a closed ring of [lon, lat]."""

    kind: str
    ring_deg: list[tuple[float, float]]


class AlignmentDocument(_Part):
    """The road of a plan."""

    name: str
    lanes: list[LaneDocument]
    events: tuple[RoadEvent, ...]
    areas: list[AreaDocument]
    grade: str = ""  # not read back: it follows from the accuracy
    surveyed: bool
    crs: str
    realization: str | None
    epoch: float | None
    vertical_datum: str | None
    transform_accuracy_m: float | None
    declared_realization: str | None = None
    start_station_m: float
    station_equations: tuple[StationEquation, ...]
    warnings: tuple[str, ...]

    @classmethod
    def of(cls, road: Alignment) -> AlignmentDocument:
        """The document of an alignment."""
        same = {name: getattr(road, name) for name in cls.model_fields if name not in ("lanes", "areas")}
        areas = [
            AreaDocument(kind=area.kind, ring_deg=[(lon, lat) for lon, lat in area.ring_deg.tolist()])
            for area in road.areas
        ]
        return cls(lanes=[LaneDocument.of(lane) for lane in road.lanes], areas=areas, **same)

    def alignment(self) -> Alignment:
        """The alignment of the document."""
        own = ("lanes", "areas", "grade")
        same = {name: getattr(self, name) for name in type(self).model_fields if name not in own}
        areas = tuple(AvoidedArea(area.kind, np.array(area.ring_deg).reshape(-1, 2)) for area in self.areas)
        return Alignment(lanes=tuple(lane.lane() for lane in self.lanes), areas=areas, **same)


class PlanDocument(_Part):
    """A plan; `counts` is a summary that is not read back."""

    format: Literal["waymark-plan/1"]
    name: str
    counts: dict[str, int]
    rules: PlanRules
    alignment: AlignmentDocument
    markers: tuple[PlannedMarker, ...]
    left_out: tuple[LeftOut, ...]
    findings: tuple[PlanFinding, ...]
    codebook: dict[str, Any] | None
    radio: RadioSettings | None
    optimum: Optimum | None = None


def write_plan(plan: Plan) -> bytes:
    """The document of a plan as JSON in UTF-8; the same plan always gives the same bytes."""
    document = PlanDocument(
        format=PLAN_FORMAT,
        name=plan.name,
        counts=plan.counts,
        rules=plan.rules,
        alignment=AlignmentDocument.of(plan.alignment),
        markers=plan.markers,
        left_out=plan.left_out,
        findings=plan.findings,
        codebook=None if plan.codebook is None else plan.codebook.to_document(),
        radio=plan.radio,
        optimum=plan.optimum,
    )
    return document.model_dump_json(by_alias=True).encode()


def read_plan(data: bytes) -> Plan:
    """The plan of a document that `write_plan` wrote.

    Raises
    ------
    UnreadableUpload
        It is no such document, or of another version; `field` is the place.
    """
    if len(data) > MAX_PLAN_BYTES:
        raise _unreadable(f"the plan has {len(data)} bytes", "plan", f"{MAX_PLAN_BYTES} bytes")
    try:
        document = PlanDocument.model_validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(str(part) for part in first["loc"]) or "plan"
        raise _unreadable(f"this is no document of a plan: {first['msg']}", place, PLAN_FORMAT) from None
    except InvalidParameter as error:
        raise _unreadable(f"the radio of the plan is damaged: {error.message}", "radio", PLAN_FORMAT) from error
    try:
        codebook = None if document.codebook is None else Codebook.from_document(document.codebook)
    except InvalidParameter as error:
        raise _unreadable(f"the codebook of the plan is damaged: {error.message}", "codebook", PLAN_FORMAT) from error
    return Plan(
        document.name, document.alignment.alignment(), document.rules, document.markers, document.left_out,
        document.findings, codebook, document.radio, document.optimum,
    )  # fmt: skip


def _unreadable(message: str, field: str, limit: str) -> UnreadableUpload:
    return UnreadableUpload(message, field=field, limit=limit, cure="make the plan again with waymark plan")
