"""Roads and plans in a decoder process: read, placed, written, packed and proved, and what is shown of them."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Literal, cast

import numpy as np
import numpy.typing as npt
import orjson

from app.families import get_family, rows_of_plan
from app.formats.alignments.geometry import AlignmentDeclaration, AlignmentFile
from app.formats.alignments.read import read_alignment
from app.formats.format import SpooledFile
from app.geodesy.systems import is_ellipsoidal
from app.markers.magnet_design import Codebook
from app.markers.plate import PlateGeometry
from app.markers.reading import MarkerRow, PlateReading, worst_verdict
from app.planning.alignment import Alignment, Lane, RoadEvent
from app.planning.outputs.bill import plan_bill
from app.planning.outputs.hd_lanelet2 import write_lanelet2
from app.planning.outputs.hd_map import map_of_road
from app.planning.outputs.hd_opendrive import write_opendrive
from app.planning.outputs.package import OutputOptions, Package, PackageOptions, PackagePart, write_plan_file
from app.planning.outputs.plan_document import lane_points_deg, read_plan, write_plan
from app.planning.placement.place import unused_numbers
from app.planning.plan import Plan, PlannedCerpm, PlannedLineMagnet, PlannedMarker
from app.planning.plan_checks import ExistingMarker
from app.planning.proof import ProofReport, ProofTerms, ProofUnit, UnitResult, summarize
from app.planning.proof.report import markers_csv
from app.planning.rules import RoadRules, check_rules
from app.plots.track import draw_trade_off
from app.registry.bulk_load import Columns
from app.registry.plan_features import OF_MARKER
from app.registry.plans import BuiltRow
from app.services.decoder_tasks import decoder_task
from app.services.documents import document_of
from app.services.plans.as_built import compare_as_built
from app.services.plans.documents import (
    AlignmentProfile,
    AsBuiltDocument,
    LaneProfile,
    LaneSummary,
    PlanSummary,
    ProfileEvent,
    ProofFigures,
    RoadSummary,
    WeakMarker,
)
from app.values import Floats

if TYPE_CHECKING:  # it loads numba
    from app.planning.proof.prove import Prover

# === Summaries of roads and plans, made where they are computed.


MAX_LISTED = 1000
"""Events, warnings and places left out that a summary lists; all are counted."""
MAX_WEAK = 100
"""Weak markers that the document of a plan lists; its report has all."""
_STRAIGHT_PER_M = 1e-5  # [1/m] below it a lane is straight; a radius of 100 km


def road_summary(road: Alignment, format_name: str = "") -> RoadSummary:
    """What a road has."""
    return {
        "format": format_name,
        "lanes": [_lane_summary(lane) for lane in road.lanes],
        "events": list(road.events[:MAX_LISTED]),
        "areas": len(road.areas),
        "lane_length_m": road.lane_length_m,
        "extent_deg": extent_deg(road),
        "crs": road.crs,
        "realization": road.realization,
        "surveyed": road.surveyed,
        "localization_grade": str(road.grade),
        "warnings": list(road.warnings[:MAX_LISTED]),
    }


def plan_summary(plan: Plan) -> PlanSummary:
    """What a plan has."""
    bill = plan_bill(plan)
    return {
        "counts": plan.counts,
        "lane_length_m": plan.alignment.lane_length_m,
        "verdict": worst_verdict(plan.findings),
        "findings": list(plan.findings),
        "left_out": list(plan.left_out[:MAX_LISTED]),
        "left_out_count": len(plan.left_out),
        "cost": bill.total,
        "cost_complete": bill.complete,
        "currency": bill.currency,
        "codebook_entries": len(plan.codebook.entries) if plan.codebook is not None else 0,
    }


def proof_figures(report: ProofReport, results: Sequence[UnitResult]) -> ProofFigures:
    """What the plan's document shows of a proof."""
    return {
        "passed": not report.wrong,
        "units": len(results),
        "rates": list(report.rates),
        "markers": len(report.markers),
        "weak": len(report.weak),
        "wrong": len(report.wrong),
        "weak_markers": [document_of(WeakMarker, marker) for marker in report.list_weak()[:MAX_WEAK]],
        "terms": cast("ProofTerms", report.terms.model_dump(mode="json")),  # as it is stored
    }


def extent_deg(road: Alignment) -> list[float]:
    """West, south, east, north of all lanes; the shorter way round the Earth. [deg]"""
    lon = np.concatenate([lane.lon_deg for lane in road.lanes])
    lat = np.concatenate([lane.lat_deg for lane in road.lanes])
    across = (lon - lon[0] + 180.0) % 360.0 - 180.0
    west, east = ((lon[0] + value + 180.0) % 360.0 - 180.0 for value in (across.min(), across.max()))
    return [float(west), float(lat.min()), float(east), float(lat.max())]


def _lane_summary(lane: Lane) -> LaneSummary:
    sharpest = float(np.abs(lane.curvature_per_m).max())
    speed = lane.design_speed_m_s * 3.6
    return {
        "name": lane.name,
        "road": lane.road,
        "length_m": lane.length_m,
        "width_m": [float(lane.width_m.min()), float(lane.width_m.max())],
        "design_speed_kmh": [float(speed.min()), float(speed.max())] if np.isfinite(speed).all() else None,
        "min_radius_m": 1 / sharpest if sharpest > _STRAIGHT_PER_M else None,
        "max_grade": float(np.abs(lane.grade).max()),
        "left_style": str(lane.left_style),
        "right_style": str(lane.right_style),
    }


# === Lanes of an alignment to draw: their lines, stations and curvature, with few enough samples for a web page.


MAX_SAMPLES = 5_000
"""Of one lane. More than a screen has columns."""
_MAX_ALL_SAMPLES = 100_000  # of all lanes together; 5 MB of JSON
_DECIMALS = 9  # of degrees, 0.1 mm; source: as maps of plans


def alignment_profile(road: Alignment, samples: int) -> AlignmentProfile:
    """The lanes of a road with at most so many samples each."""
    per_lane = max(2, min(samples, _MAX_ALL_SAMPLES // len(road.lanes)))
    return {
        "lanes": [_lane_profile(road, lane, per_lane) for lane in road.lanes],
        "events": [_event(road.lane(event.lane), event) for event in road.events],
        "areas": [{"kind": area.kind, "ring_deg": np.round(area.ring_deg, _DECIMALS).tolist()} for area in road.areas],
    }


def _lane_profile(road: Alignment, lane: Lane, samples: int) -> LaneProfile:
    at = np.unique(np.linspace(0, len(lane.chainage_m) - 1, min(samples, len(lane.chainage_m))).round().astype(int))
    speed = lane.design_speed_m_s[at] * 3.6
    return {
        "name": lane.name,
        "road": lane.road,
        "length_m": lane.length_m,
        "left_style": str(lane.left_style),
        "right_style": str(lane.right_style),
        "line": lane_points_deg(lane),
        "chainage_m": _rounded(lane.chainage_m[at], 3),
        "station_m": [round(station, 3) for station in road.stations_at(lane, lane.chainage_m[at])],
        "curvature_per_m": _rounded(_greatest_near(lane.curvature_per_m, at), 7),
        "grade": _rounded(lane.grade[at], 5),
        "design_speed_kmh": _rounded(speed, 2) if np.isfinite(speed).all() else None,
        "lon_deg": _rounded(lane.lon_deg[at], _DECIMALS),
        "lat_deg": _rounded(lane.lat_deg[at], _DECIMALS),
    }


def _greatest_near(values: Floats, at: np.ndarray[tuple[int], np.dtype[np.int_]]) -> Floats:
    """The value of the greatest size between the middles to the neighbours of each sample."""
    edges = np.concatenate([[0], (at[:-1] + at[1:] + 1) // 2])
    high, low = np.maximum.reduceat(values, edges), np.minimum.reduceat(values, edges)
    return np.asarray(np.where(high >= -low, high, low))


def _event(lane: Lane, event: RoadEvent) -> ProfileEvent:
    lon, lat = lane.position_at(event.chainage_m)
    return {
        "kind": event.kind,
        "lane": event.lane,
        "chainage_m": event.chainage_m,
        "value": event.value,
        "lon_deg": round(float(lon[0]), _DECIMALS),
        "lat_deg": round(float(lat[0]), _DECIMALS),
    }


def _rounded(values: Floats, digits: int) -> list[float]:
    return cast("list[float]", np.round(values, digits).tolist())


# === What GIS clients read of alignments and plans, made where these are computed.


LaneFeature = tuple[dict[str, object], list[list[float]]]
"""Properties of a lane, and its points [lon, lat]."""


def lane_features(road: Alignment) -> list[LaneFeature]:
    """The lanes of a road; one across the antimeridian is two lines (RFC 7946, section 3.1.9)."""
    found: list[LaneFeature] = []
    for lane, summary in zip(road.lanes, road_summary(road)["lanes"], strict=True):
        sharpest = summary["min_radius_m"]
        slowest, fastest = summary["design_speed_kmh"] or (None, None)
        properties = {
            "lane": summary["name"],
            "road": summary["road"],
            "length_m": round(summary["length_m"], 3),
            "min_width_m": round(summary["width_m"][0], 3),
            "max_width_m": round(summary["width_m"][1], 3),
            "min_speed_kmh": None if slowest is None else round(slowest, 3),
            "max_speed_kmh": None if fastest is None else round(fastest, 3),
            "min_radius_m": None if sharpest is None else round(sharpest, 3),
            "max_curvature_per_m": 0.0 if sharpest is None else round(1 / sharpest, 9),
            "max_grade": round(summary["max_grade"], 6),
            "left_style": summary["left_style"],
            "right_style": summary["right_style"],
            "localization_grade": str(road.grade),
        }
        found += ((properties, part) for part in _parts(lane_points_deg(lane)))
    return found


def _parts(points: list[list[float]]) -> Iterator[list[list[float]]]:
    """A line cut at the antimeridian."""
    part = points[:1]
    for (lon_a, lat_a), (lon, lat) in pairwise(points):
        if abs(lon - lon_a) > 180.0:
            edge = 180.0 if lon_a > 0 else -180.0
            ahead = lon + 2 * edge
            share = (edge - lon_a) / (ahead - lon_a) if ahead != lon_a else 0.0
            middle = lat_a + share * (lat - lat_a)
            yield [*part, [edge, middle]]
            part = [[-edge, middle]]
        part.append([lon, lat])
    yield part


def planned_columns(plan: Plan) -> Columns:
    """The markers of a plan as rows of `planned_markers`, without ids."""
    datum = plan.alignment.vertical_datum
    rows = [_row(marker, datum) for marker in plan.markers]
    lists = {name: [row[name] for row in rows] for name in rows[0]} if rows else {}
    return Columns.of(len(rows), {}, lists)


def _row(marker: PlannedMarker, datum: str | None) -> dict[str, object]:
    detail, height_m = marker.detail, marker.height_m
    values: dict[str, object] = {
        "number": marker.number,
        "family": marker.family,
        "code": marker.code,
        "purpose": marker.purpose.value,
        "lane": marker.lane,
        "side": detail.side.name.lower() if isinstance(detail, PlannedLineMagnet | PlannedCerpm) else None,
        "chainage_m": round(marker.chainage_m, 4),
        "station_m": round(marker.station_m, 4),
        "offset_m": round(marker.offset_m, 4),
        "heading_deg": round(marker.heading_deg, 4),
        "height_m": height_m,
        "vertical_datum": None if height_m is None else datum,
    }
    place = [marker.lon_deg, marker.lat_deg]
    if height_m is not None and is_ellipsoidal(datum):
        place.append(height_m)
    feature = {
        "geometry": {"type": "Point", "coordinates": place},
        "properties": {name: values[name] for name in OF_MARKER},
    }
    text = orjson.dumps(feature).decode()[1:-2]  # open at its end: what follows from the plan is added in queries
    at = {"lon_deg": marker.lon_deg, "lat_deg": marker.lat_deg}
    return {**values, **at, "feature": text}


# === Roads.


MapForm = Literal["osm", "xodr"]
"""Formats of HD maps by the ends of their files' names: lanelet2 and OpenDRIVE."""
_ROAD = ("road", "cut the road into sections")
_PLAN = ("plan", "cut the road into sections")


@dataclass(frozen=True, slots=True)
class RoadFile:
    """A file with a road, as it came, and what is declared of it."""

    file: SpooledFile
    file_name: str
    declaration: AlignmentDeclaration
    name: str
    accuracy_m: float


@dataclass(frozen=True, slots=True)
class SummarizedRoad:
    """A road that was read: its document, and its lanes for GIS clients."""

    summary: RoadSummary
    lanes: list[LaneFeature]


@decoder_task(*_ROAD)
def summarize_road(road: RoadFile) -> SummarizedRoad:
    """Read a road: its lanes, events, warnings and extent."""
    file = _read(road)
    alignment = _build(file, road, None)
    return SummarizedRoad(road_summary(alignment, file.format), lane_features(alignment))


@decoder_task(*_ROAD)
def profile_road(road: RoadFile, samples: int) -> AlignmentProfile:
    """Read a road to draw it: its lanes with at most so many samples each."""
    return alignment_profile(_build(_read(road), road, None), samples)


@decoder_task(*_ROAD)
def write_map(road: RoadFile, form: MapForm, markers: tuple[MarkerRow, ...], within_m: float) -> bytes:
    """Write a road as an HD map, with those of the markers that are near the centre line of a lane."""
    alignment = _build(_read(road), road, None)
    points = [point for row in markers for point in get_family(row.family).map_markers(row)]
    content = map_of_road(alignment, points, within_m=within_m)
    return write_lanelet2(content) if form == "osm" else write_opendrive(content, leave_out=True)


def _read(road: RoadFile) -> AlignmentFile:
    return read_alignment(road.file.read(), road.file_name, declaration=road.declaration)


def _build(file: AlignmentFile, road: RoadFile, rules: RoadRules | None) -> Alignment:
    """Without the rules of a plan, lanes whose speed the file does not state have none."""
    from app.planning.build_alignment import build_alignment

    return build_alignment(
        file, rules, road.declaration, name=road.name, accuracy_m=road.accuracy_m, needs_speed=rules is not None
    )


# === Plans.


@dataclass(frozen=True, slots=True)
class MadePlan:
    """A plan that was placed and checked."""

    document: bytes  # as `app.planning.outputs.plan_document.write_plan` writes it, compressed by zlib
    summary: PlanSummary  # what lists and the plan's page show
    numbers: tuple[tuple[str, str], ...]  # (family, code), which no other marker may have
    features: Columns  # the markers for GIS clients


@decoder_task(*_ROAD)
def make_plan(
    road: RoadFile,
    rules: dict[str, object],
    name: str,
    taken: frozenset[int] = frozenset(),
    existing: tuple[ExistingMarker, ...] = (),
    codebook: dict[str, object] | None = None,
) -> MadePlan:
    """Place and check a plan.

    Parameters
    ----------
    taken : frozenset of int
        Registry numbers that other markers have.
    existing : tuple of ExistingMarker
        Markers of the registry near the road.
    codebook : dict or None
        Document of the agency's codebook.
    """
    from app.planning import planner

    checked = check_rules(rules)
    alignment = _build(_read(road), road, checked.road)
    numbers = unused_numbers(taken, zlib.crc32(name.encode()))
    book = Codebook.from_document(codebook) if codebook is not None else None
    plan = planner.make_plan(alignment, checked, name=name, codebook=book, numbers=numbers, existing=existing)
    codes = tuple((marker.family, marker.code) for marker in plan.markers if marker.family != "magnet")
    return MadePlan(zlib.compress(write_plan(plan), 6), plan_summary(plan), codes, planned_columns(plan))


@decoder_task(*_PLAN)
def write_file_of_plan(document: bytes, name: str, options: OutputOptions | None = None) -> bytes:
    """Write a file of a plan."""
    return write_plan_file(_plan(document), name, options or OutputOptions(), draw_trade_off)


@decoder_task(*_PLAN)
def compare_plan(document: bytes, built: tuple[BuiltRow, ...], existing: tuple[ExistingMarker, ...]) -> AsBuiltDocument:
    """Compare a committed plan with the markers that it became, and with others of the registry near the road."""
    return compare_as_built(_plan(document), built, existing)


def _plan(document: bytes) -> Plan:
    return read_plan(zlib.decompress(document))


# === Packages of plans.


@decoder_task(*_PLAN)
def check_package(document: bytes, options: PackageOptions) -> None:
    """Check that the options of a package fit the plan."""
    _package(document, options).check()


@decoder_task(*_PLAN)
def list_package_parts(document: bytes, options: PackageOptions) -> list[PackagePart]:
    """Check a package, and divide it into parts."""
    package = _package(document, options)
    package.check()
    return package.parts()


@decoder_task(*_PLAN)
def write_package_part(document: bytes, options: PackageOptions, part: PackagePart) -> list[tuple[str, bytes]]:
    """Write a part of a package: names and contents of its files."""
    return _package(document, options).write(part, read_face)


@decoder_task(*_PLAN)
def write_package_manifest(document: bytes, options: PackageOptions, entries: list[dict[str, object]]) -> bytes:
    """Write the manifest of a package."""
    return _package(document, options).manifest(entries)


def read_face(image: npt.NDArray[np.uint8], geometry: PlateGeometry) -> Sequence[PlateReading]:
    """The plate decoder as the self-proof of artwork wants it."""
    from app.decoders.plate.reader import decode_plates

    return decode_plates(image, geometries=(geometry,))


@lru_cache(maxsize=1)
def _package(document: bytes, options: PackageOptions) -> Package:
    """A plan with what its parts share: one a process, kept until another plan is packed."""
    return Package(_plan(document), options, draw_trade_off)


# === Proofs of plans.


@dataclass(frozen=True, slots=True)
class WrittenProof:
    """A finished proof."""

    report: bytes  # JSON of the `ProofReport`, compressed by zlib
    table: bytes  # CSV with the markers that were driven over, compressed by zlib
    summary: ProofFigures  # what the plan's document shows


@decoder_task(*_PLAN)
def check_proof(document: bytes, terms: ProofTerms) -> None:
    """Check that a plan has something to prove, and not too much."""
    _prover(document, terms).check_size()


@decoder_task(*_PLAN)
def list_proof_units(document: bytes, terms: ProofTerms) -> list[ProofUnit]:
    """Check a proof, and divide it into units."""
    prover = _prover(document, terms)
    prover.check_size()
    return prover.list_units()


@decoder_task(*_PLAN)
def prove_unit(document: bytes, terms: ProofTerms, unit: ProofUnit) -> UnitResult:
    """Drive a unit of a proof."""
    return _prover(document, terms).prove_unit(unit)


@decoder_task(*_PLAN)
def write_proof(document: bytes, terms: ProofTerms, results: list[UnitResult]) -> WrittenProof:
    """Write the report of a proof from the results of all its units."""
    report = summarize(_prover(document, terms).plan, terms, results)
    text, table = report.write(), markers_csv(report).encode()
    return WrittenProof(zlib.compress(text, 6), zlib.compress(table, 6), proof_figures(report, results))


@lru_cache(maxsize=1)
def _prover(document: bytes, terms: ProofTerms) -> Prover:
    """A plan with what its units share: one a process, kept until another plan is proved."""
    from app.planning.proof.drives import START
    from app.planning.proof.prove import Prover

    plan = _plan(document)
    return Prover(plan, terms, rows_of_plan(plan, START))
