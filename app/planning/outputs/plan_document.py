"""A plan as one JSON document, and back: everything that checks, proof and outputs need, without the source files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Final, Literal

import numpy as np
import orjson
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, ValidationError, model_validator
from shapely import LineString, get_coordinates, simplify

from app.encoders.cerpm import MAX_PROGRAMS, MarkerProgram, write_programs_csv
from app.errors import InvalidParameter, UnreadableUpload
from app.formats.alignments.geometry import BoundaryStyle, StationEquation, Stationing
from app.markers.cerpm import HEIGHT_M, KEY_BYTES, CerpmMessage, LaneSide
from app.markers.magnet_design import Codebook
from app.planning.alignment import Alignment, AvoidedArea, Lane, RoadEvent, format_station
from app.planning.plan import (
    Detail,
    LeftOut,
    Optimum,
    Plan,
    PlanFinding,
    PlannedCerpm,
    PlannedLineMagnet,
    PlannedMarker,
    PlannedPlate,
    PlannedTag,
)
from app.planning.plan_checks.families import radio_settings
from app.planning.rules import PlanRules
from app.radio.settings import RadioSettings
from app.values import Floats, JsonObject

PLAN_FORMAT = "waymark-plan/2"
MAX_PLAN_BYTES = 500_000_000
"""Longest document. [bytes] Several times that of 500,000 markers."""
_MAX_SAMPLES = 5_000_000  # of one array; 5,000 km of lane


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
    "width_m", "design_speed_m_s", "station_m",
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


_FORMER = ("start_station_m", "station_equations")


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
    stationing: dict[str, Stationing] = {}
    start_station_m: float = Field(0.0, exclude=True)  # of plans of the first format
    station_equations: tuple[StationEquation, ...] = Field((), exclude=True)
    warnings: tuple[str, ...]

    @classmethod
    def of(cls, road: Alignment) -> AlignmentDocument:
        """The document of an alignment."""
        same = {name: getattr(road, name) for name in cls.model_fields if name not in ("lanes", "areas", *_FORMER)}
        areas = [
            AreaDocument(kind=area.kind, ring_deg=[(lon, lat) for lon, lat in area.ring_deg.tolist()])
            for area in road.areas
        ]
        return cls(lanes=[LaneDocument.of(lane) for lane in road.lanes], areas=areas, **same)

    def alignment(self) -> Alignment:
        """The alignment of the document."""
        own = ("lanes", "areas", "grade", *_FORMER)
        same = {name: getattr(self, name) for name in type(self).model_fields if name not in own}
        areas = tuple(AvoidedArea(area.kind, np.array(area.ring_deg).reshape(-1, 2)) for area in self.areas)
        return Alignment(lanes=tuple(lane.lane() for lane in self.lanes), areas=areas, **same)


class PlanDocument(_Part):
    """A plan; `counts` is a summary that is not read back."""

    format: Literal["waymark-plan/1", "waymark-plan/2"]  # stations of the first are true distances
    name: str
    counts: dict[str, int]
    rules: PlanRules
    alignment: AlignmentDocument
    markers: tuple[PlannedMarker, ...]
    left_out: tuple[LeftOut, ...]
    findings: tuple[PlanFinding, ...]
    codebook: dict[str, object] | None
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


_FORMER_NAMES: Final = {  # of plans that earlier releases wrote
    b'"design_speed_mps"': b'"design_speed_m_s"',
    b'"deceleration_mps2"': b'"deceleration_m_s2"',
    b'"speed_mps"': b'"speed_m_s"',
    b'"quantum_mps"': b'"quantum_m_s"',
}


def read_plan(data: bytes) -> Plan:
    """The plan of a document that `write_plan` wrote.

    Raises
    ------
    UnreadableUpload
        It is no such document, or of another version; `field` is the place.
    """
    if len(data) > MAX_PLAN_BYTES:
        raise _unreadable(f"the plan has {len(data)} bytes", "plan", f"{MAX_PLAN_BYTES} bytes")
    for old, new in _FORMER_NAMES.items():
        data = data.replace(old, new)
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
    road, markers, findings = document.alignment.alignment(), document.markers, document.findings
    if document.format != PLAN_FORMAT:
        former = Stationing(document.alignment.start_station_m, document.alignment.station_equations)
        road = replace(road, stationing={lane.road: former for lane in road.lanes})
        markers = tuple(replace(one, station_m=former.displayed_m(one.station_m)) for one in markers)
        findings = tuple(
            one if one.station_m is None else replace(one, station_m=former.displayed_m(one.station_m))
            for one in findings
        )
    return Plan(
        document.name, road, document.rules, markers, document.left_out, findings, codebook, document.radio,
        document.optimum,
    )  # fmt: skip


def _unreadable(message: str, field: str, limit: str) -> UnreadableUpload:
    return UnreadableUpload(message, field=field, limit=limit, cure="make the plan again with waymark plan")


# === A plan as GeoJSON (RFC 7946): markers, lanes, events and areas to avoid, for any map.


_DECIMALS = 9  # of degrees, 0.1 mm; source: as drilling sheets
_LANE_TOLERANCE_M = 0.02  # [m] of a lane's line on the map; below what a map shows
_M_PER_DEG = 111_195.0  # [m/deg] on a sphere of 6371 km, the Earth's mean radius


def write_plan_geojson(plan: Plan) -> bytes:
    """A FeatureCollection in WGS 84; each feature has a property `kind`: marker, lane, event, area."""
    road = plan.alignment
    features = [marker_feature(plan, marker) for marker in plan.markers]
    features += [_feature(_line(lane), {"kind": "lane", "name": lane.name, "road": lane.road}) for lane in road.lanes]
    for event in road.events:
        lon, lat = road.lane(event.lane).position_at(event.chainage_m)
        properties = {"event": event.kind.value, "lane": event.lane, "value": event.value}
        features.append(_feature(_point(float(lon[0]), float(lat[0])), {"kind": "event", **properties}))
    for area in road.areas:
        rings = [np.round(area.ring_deg, _DECIMALS).tolist()]
        features.append(_feature({"type": "Polygon", "coordinates": rings}, {"kind": "area", "area": area.kind}))
    document = {"type": "FeatureCollection", "name": plan.name, "surveyed": road.surveyed, "features": features}
    return orjson.dumps(document)


def marker_feature(plan: Plan, marker: PlannedMarker) -> JsonObject:
    """One marker as a GeoJSON feature."""
    road = plan.alignment
    height = marker.height_m if road.vertical_datum == "ellipsoid" else None  # RFC 7946, section 3.1.1
    properties = {
        "kind": "marker",
        "number": marker.number,
        "family": marker.family,
        "code": marker.code,
        "purpose": marker.purpose.value,
        "lane": marker.lane,
        "station": format_station(marker.station_m),
        "chainage_m": round(marker.chainage_m, 4),
        "offset_m": round(marker.offset_m, 4),
        "heading_deg": round(marker.heading_deg, 4),
        "height_m": marker.height_m,
        **_details(marker.detail),
    }
    if marker.family == "magnet":
        fixed = plan.rules.installation
        properties |= {"mounting": fixed.mounting.value, "depth_m": round(fixed.depth_m, 4)}
    return {**_feature(_point(marker.lon_deg, marker.lat_deg, height), properties), "id": marker.number}


def _details(detail: Detail) -> dict[str, object]:
    match detail:
        case PlannedPlate():
            return {"scheme": detail.code.scheme.value, "side_mm": detail.geometry.side_mm}
        case PlannedTag():
            return {"meaning": detail.meaning.text, "magnets": detail.tag.magnet_count}
        case PlannedLineMagnet():
            return {"side": _side(detail.side), "line": detail.style.value}
        case PlannedCerpm():
            limit = detail.speed_limit
            return {"side": _side(detail.side), "speed_limit": None if limit is None else f"{limit.value} {limit.unit}"}


def _side(side: LaneSide) -> str:
    return side.name.lower()


def _feature(geometry: dict[str, object], properties: dict[str, object]) -> dict[str, object]:
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _point(lon_deg: float, lat_deg: float, height_m: float | None = None) -> dict[str, object]:
    place = [round(lon_deg, _DECIMALS), round(lat_deg, _DECIMALS)]
    return {"type": "Point", "coordinates": place if height_m is None else [*place, round(height_m, 4)]}


def _line(lane: Lane) -> dict[str, object]:
    return {"type": "LineString", "coordinates": lane_points_deg(lane)}


def lane_points_deg(lane: Lane) -> list[list[float]]:
    """The centre line as [lon, lat], with the points that it needs to be drawn within 2 cm."""
    line = LineString(np.column_stack([lane.lon_deg, lane.lat_deg]))
    points = get_coordinates(simplify(line, _LANE_TOLERANCE_M / _M_PER_DEG, preserve_topology=False))
    return [[lon, lat] for lon, lat in np.round(points, _DECIMALS).tolist()]


# === What the CERPMs of a plan are programmed with, without keys: those are derived on the server when markers exist.


_NO_KEY = bytes(KEY_BYTES)  # stands for the marker's own, which is never written here
PROGRAMS_FORMAT = "waymark-cerpm-programs/1"


def plan_programs(plan: Plan) -> tuple[MarkerProgram, ...]:
    """Programs of all CERPMs of a plan, with the first message of each; empty without CERPMs.

    Raises
    ------
    InvalidParameter
        There are more than 100,000.
    """
    cerpms = [marker for marker in plan.markers if isinstance(marker.detail, PlannedCerpm)]
    if not cerpms or plan.rules.cerpm is None:
        return ()
    if len(cerpms) > MAX_PROGRAMS:
        raise InvalidParameter(
            f"the plan has {len(cerpms)} CERPMs",
            field="plan",
            limit=f"{MAX_PROGRAMS} in one list",
            cure="plan the road in sections",
        )
    radio = plan.radio or radio_settings(plan) or RadioSettings()
    datum = plan.alignment.vertical_datum
    return tuple(MarkerProgram(_message(marker, datum), _NO_KEY, radio) for marker in cerpms)


def _message(marker: PlannedMarker, vertical_datum: str | None) -> CerpmMessage:
    """A message holds heights above the ellipsoid only."""
    detail = marker.detail
    assert isinstance(detail, PlannedCerpm)
    height = marker.height_m if vertical_datum == "ellipsoid" else None
    if height is not None and not HEIGHT_M[0] <= height <= HEIGHT_M[1]:
        height = None
    return CerpmMessage(
        detail.number, marker.lon_deg, marker.lat_deg, height, detail.side, detail.speed_limit, sequence=0
    )


def write_plan_programs_csv(programs: Sequence[MarkerProgram]) -> bytes:
    """The programming list as CSV in UTF-8, without keys."""
    return write_programs_csv(programs).encode()


def write_plan_programs_json(plan: Plan, programs: Sequence[MarkerProgram]) -> bytes:
    """The programming list as JSON, without keys: the radio's settings once, and number and message of each marker."""
    document: dict[str, object] = {
        "format": PROGRAMS_FORMAT,
        "plan": plan.name,
        "keys": "not included: the server derives each marker's key when the plan is committed",
        "radio": programs[0].radio if programs else None,
        "markers": [
            {
                "number": program.message.number,
                "side": program.message.side.name.lower(),
                "lon_deg": program.message.lon_deg,
                "lat_deg": program.message.lat_deg,
                "height_m": program.message.height_m,
                "body_hex": program.body.hex(),
                "sequence_start": program.message.sequence,
            }
            for program in programs
        ],
    }
    return orjson.dumps(document, option=orjson.OPT_INDENT_2)
