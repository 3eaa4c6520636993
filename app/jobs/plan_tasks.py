"""Roads, plans, packages, proofs and surveys, inside a decoder process."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import orjson

from app.decoders.plate.reader import decode_plates
from app.families import get_family
from app.formats.alignments.geometry import AlignmentFile
from app.formats.alignments.read import read_alignment
from app.formats.surveys.read import read_survey
from app.formats.surveys.table import SurveyTable
from app.jobs.frame_tasks import memory_is_the_limit
from app.markers.magnet_design import Codebook
from app.markers.plate import PlateGeometry
from app.markers.reading import PlateReading
from app.planning import planner
from app.planning.alignment import Alignment
from app.planning.build_alignment import build_alignment
from app.planning.outputs.hd_lanelet2 import write_lanelet2
from app.planning.outputs.hd_map import map_of_road
from app.planning.outputs.hd_opendrive import write_opendrive
from app.planning.outputs.package import OutputOptions, Package, PackageOptions, PackagePart, write_plan_file
from app.planning.outputs.plan_document import read_plan, write_plan
from app.planning.placement.place import unused_numbers
from app.planning.proof import ProofTerms, ProofUnit, UnitResult, summarize
from app.planning.proof.prove import Prover
from app.planning.proof.report import markers_csv, report_document
from app.planning.rules import RoadRules, check_rules
from app.plots.track import draw_trade_off
from app.services.plans.as_built import compare_as_built
from app.services.plans.documents import AlignmentProfile, AsBuiltDocument
from app.services.plans.tasks import (
    CompareTask,
    ListPartsTask,
    ListUnitsTask,
    MadePlan,
    MakePlanTask,
    ProfileRoadTask,
    ProveUnitTask,
    RoadFile,
    SummarizedRoad,
    SummarizeRoadTask,
    WriteManifestTask,
    WriteMapTask,
    WritePartTask,
    WritePlanFileTask,
    WriteProofTask,
    WrittenProof,
    alignment_profile,
    lane_features,
    plan_summary,
    planned_columns,
    proof_figures,
    road_summary,
)
from app.services.surveys.imports import SurveyTask

_CURE = "cut the road into sections"


def summarize_road(task: SummarizeRoadTask, _before: None) -> SummarizedRoad:
    """Read a road and describe it."""
    with memory_is_the_limit("road", _CURE):
        file = read_alignment(task.road.file.read(), task.road.file_name)
        road = _build(file, task.road, None)
        return SummarizedRoad(dict(road_summary(road, file.format)), lane_features(road))


def profile_road(task: ProfileRoadTask, _before: None) -> AlignmentProfile:
    """Read a road to draw it."""
    with memory_is_the_limit("road", _CURE):
        file = read_alignment(task.road.file.read(), task.road.file_name)
        return alignment_profile(_build(file, task.road, None), task.samples)


def make_plan(task: MakePlanTask, _before: None) -> MadePlan:
    """Place and check a plan."""
    with memory_is_the_limit("road", _CURE):
        rules = check_rules(task.rules)
        file = read_alignment(task.road.file.read(), task.road.file_name)
        alignment = _build(file, task.road, rules.road)
        numbers = unused_numbers(task.taken, zlib.crc32(task.name.encode()))
        book = Codebook.from_document(task.codebook) if task.codebook is not None else None
        plan = planner.make_plan(
            alignment, rules, name=task.name, codebook=book, numbers=numbers, existing=task.existing
        )
        codes = tuple((marker.family, marker.code) for marker in plan.markers if marker.family != "magnet")
        return MadePlan(zlib.compress(write_plan(plan), 6), plan_summary(plan), codes, planned_columns(plan))


def write_file_of_plan(task: WritePlanFileTask, _before: None) -> bytes:
    """Write a file of a plan."""
    with memory_is_the_limit("plan", _CURE):
        return write_plan_file(
            read_plan(zlib.decompress(task.document)),
            task.name,
            OutputOptions(task.crs, task.unit, draw_trade_off=draw_trade_off),
        )


def write_map(task: WriteMapTask, _before: None) -> bytes:
    """Write a road and the markers near it as an HD map."""
    with memory_is_the_limit("road", _CURE):
        road = _build(read_alignment(task.road.file.read(), task.road.file_name), task.road, None)
        markers = [point for row in task.markers for point in get_family(row.family).map_markers(row)]
        content = map_of_road(road, markers, within_m=task.within_m)
        return write_lanelet2(content) if task.form == "osm" else write_opendrive(content, leave_out=True)


def compare_plan(task: CompareTask, _before: None) -> AsBuiltDocument:
    """Compare a plan with what was built."""
    with memory_is_the_limit("plan", _CURE):
        return compare_as_built(read_plan(zlib.decompress(task.document)), task.built, task.existing)


def _build(file: AlignmentFile, road: RoadFile, rules: RoadRules | None) -> Alignment:
    """Without the rules of a plan, lanes whose speed the file does not state have none."""
    return build_alignment(
        file, rules, road.declaration, name=road.name, accuracy_m=road.accuracy_m, needs_speed=rules is not None
    )


# === Packages of plans, inside a decoder process.


def list_package_parts(task: ListPartsTask, _before: None) -> list[PackagePart]:
    """Divide a package into parts."""
    with memory_is_the_limit("plan", _CURE):
        package = _package(task.document, task.options)
        package.check()
        return [] if task.only_check else package.parts()


def write_package_part(task: WritePartTask, _before: None) -> list[tuple[str, bytes]]:
    """Write a part of a package."""
    with memory_is_the_limit("plan", _CURE):
        return _package(task.document, task.options).write(task.part, read_face)


def write_package_manifest(task: WriteManifestTask, _before: None) -> bytes:
    """Write the manifest of a package."""
    return _package(task.document, task.options).manifest(task.entries)


def read_face(image: npt.NDArray[np.uint8], geometry: PlateGeometry) -> Sequence[PlateReading]:
    """The plate decoder as the self-proof of artwork wants it."""
    return decode_plates(image, geometries=(geometry,))


@lru_cache(maxsize=1)
def _package(document: bytes, options: PackageOptions) -> Package:
    """A plan with what its parts share: one a process, kept until another plan is packed."""
    return Package(read_plan(zlib.decompress(document)), options)


# === Proofs of plans, inside a decoder process.


def list_proof_units(task: ListUnitsTask, _before: None) -> list[ProofUnit]:
    """Divide a proof into units."""
    with memory_is_the_limit("plan", _CURE):
        prover = _prover(task.document, task.terms)
        prover.check_size()
        return [] if task.only_check else prover.list_units()


def prove_unit(task: ProveUnitTask, _before: None) -> UnitResult:
    """Drive a unit of a proof."""
    with memory_is_the_limit("plan", _CURE):
        return _prover(task.document, task.terms).prove_unit(task.unit)


def write_proof(task: WriteProofTask, _before: None) -> WrittenProof:
    """Write the report of a proof."""
    with memory_is_the_limit("plan", _CURE):
        report = summarize(_prover(task.document, task.terms).plan, task.terms, task.results)
        document = orjson.dumps(report_document(report), option=orjson.OPT_SERIALIZE_NUMPY)
        table = markers_csv(report).encode()
        return WrittenProof(zlib.compress(document, 6), zlib.compress(table, 6), proof_figures(report, task.results))


@lru_cache(maxsize=1)
def _prover(document: bytes, terms: ProofTerms) -> Prover:
    """A plan with what its units share: one a process, kept until another plan is proved."""
    return Prover(read_plan(zlib.decompress(document)), terms)


# === A survey, read inside a decoder process.


def read_survey_file(task: SurveyTask, _before: None) -> SurveyTable:
    """Read the rows of a survey."""
    with memory_is_the_limit("survey", "cut the survey into smaller ones"):
        return read_survey(task.file.read(), task.declaration, task.code_form)
