"""Roads and plans, inside a decoder process."""

from __future__ import annotations

import zlib

from app.families import get_family
from app.formats.alignments.geometry import AlignmentFile
from app.formats.alignments.read import read_alignment
from app.jobs.memory_limit import memory_is_the_limit
from app.markers.magnet_codebook import Codebook
from app.planning import planner
from app.planning.alignment import Alignment
from app.planning.build_alignment import build_alignment
from app.planning.outputs.files import OutputOptions, write_plan_file
from app.planning.outputs.hd_lanelet2 import write_lanelet2
from app.planning.outputs.hd_map import map_of_road
from app.planning.outputs.hd_opendrive import write_opendrive
from app.planning.outputs.plan_document import read_plan, write_plan
from app.planning.placement.codes import unused_numbers
from app.planning.read_rules import check_rules
from app.planning.rules import RoadRules
from app.plots.trade_off import draw_trade_off
from app.services.plans.as_built import compare_as_built
from app.services.plans.documents import AlignmentProfile, AsBuiltDocument
from app.services.plans.features import lane_features, planned_columns
from app.services.plans.profiles import alignment_profile
from app.services.plans.summaries import plan_summary, road_summary
from app.services.plans.tasks import (
    CompareTask,
    MadePlan,
    MakePlanTask,
    ProfileRoadTask,
    RoadFile,
    SummarizedRoad,
    SummarizeRoadTask,
    WriteMapTask,
    WritePlanFileTask,
)

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
