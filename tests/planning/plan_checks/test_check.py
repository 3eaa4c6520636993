"""Checks of plans: figures against known ones, and a road for each that fails."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.formats.alignments.geometry import EventKind
from app.markers.plate import PlateGeometry
from app.markers.reading import Verdict
from app.planning.alignment import Alignment, RoadEvent
from app.planning.placement import place_plan
from app.planning.plan import Plan, PlanFinding, PlannedTag
from app.planning.plan_checks import ExistingMarker, check_plan
from app.planning.plan_checks.families import frames_per_pass, readable_zone_m
from app.planning.predict.rates import camera_of
from app.planning.rules import CameraRules, PlanRules
from tests.planning.roads import bend, opposite, road, straight

ALL = {"plates": {}, "decision_points": {}, "lines": {}, "tags": {"magnets": 4}, "cerpm": {}}


def checked(alignment: Alignment, existing: tuple[ExistingMarker, ...] = (), **rules: object) -> Plan:
    made = place_plan(alignment, PlanRules.model_validate({"version": 1, **rules}), name="test plan")
    return check_plan(made, existing)


def finding(plan: Plan, name: str) -> PlanFinding:
    [found] = [one for one in plan.findings if one.name == name]
    return found


def test_a_plan_of_all_families_passes_its_checks() -> None:
    events = (RoadEvent(EventKind.STOP_LINE, "1", 480.0), RoadEvent(EventKind.SPEED_LIMIT, "1", 300.0, 50.0))
    lane = straight(500, speed_kmh=50.0)
    plan = checked(road(lane, opposite(lane, "2"), events=events), **ALL)
    assert plan.counts.keys() == {"cerpm", "magnet", "plate"}
    failed = [f"{one.name}: {one.sentence}" for one in plan.findings if one.verdict is Verdict.FAIL]
    assert not failed
    assert {"frames-per-pass camera", "line-spacing", "codebook-room", "path-error", "overlaps"} <= {
        one.name for one in plan.findings
    }
    assert all(one.source and one.sentence for one in plan.findings)


def test_frames_per_pass_fall_with_speed_and_end_with_blur() -> None:
    camera, geometry = CameraRules(), PlateGeometry()
    slow, fast = (frames_per_pass(camera, geometry, speed / 3.6) for speed in (50.0, 100.0))
    assert slow == pytest.approx(2 * fast)
    assert frames_per_pass(camera.model_copy(update={"exposure_s": 0.004}), geometry, 100 / 3.6) == 0.0


def test_the_readable_zone_is_that_of_the_projected_plate() -> None:
    """A camera 1.5 m high that looks down steeply: the unit of 40 mm covers two rows up to where h f u / z^2 = 2."""
    rules = CameraRules(height_m=1.5, depression_deg=20.0)
    camera = camera_of(rules)
    zone = readable_zone_m(camera, PlateGeometry())
    fine = readable_zone_m(camera, PlateGeometry(unit_mm=50.0))
    assert 3.0 < zone < 8.0
    assert fine > zone


def test_few_frames_fail_with_the_place_and_the_cure() -> None:
    plan = checked(road(straight(500, speed_kmh=130.0)), plates={"min_frames": 30})
    found = finding(plan, "frames-per-pass camera")
    assert found.verdict is Verdict.FAIL
    assert found.figure < 30
    assert found.lane == "1"
    assert "larger units" in found.sentence


@pytest.mark.slow
def test_path_error_is_found_at_the_change_of_curvature() -> None:
    plan = checked(road(bend(62.5, 195, 90.0)), cerpm={"max_path_error_m": None, "straight": 2.5, "curve": 2.5})
    found = finding(plan, "path-error")
    # R 62.5 m without a spiral, 30.5 m apart: up to 0.030 x 30.5^2 / 62.5 = 0.45 m, by the phase of the markers
    assert 0.1 < found.figure < 0.47
    assert found.station_m is not None
    assert min(abs(found.station_m - 195), abs(found.station_m - 293)) < 40


def test_equal_codes_side_by_side_are_named() -> None:
    lane = straight(500, speed_kmh=50.0)
    lon, lat = lane.position_at(lane.chainage_m, 3.5)
    beside = replace(lane, name="2", lon_deg=lon, lat_deg=lat)
    events = tuple(RoadEvent(EventKind.STOP_LINE, name, 480.0) for name in ("1", "2"))
    plan = checked(road(lane, beside, events=events), tags={})
    found = finding(plan, "confusable-codes")
    assert found.figure == 1
    assert found.verdict is Verdict.WARN


def test_conflicts_with_existing_markers_are_named() -> None:
    alone = checked(road(straight(500)), plates={})
    first, second = alone.markers[0], alone.markers[1]
    existing = (
        ExistingMarker("here", "cerpm", "7", first.lon_deg, first.lat_deg, "active"),
        ExistingMarker("same", "plate", second.code, second.lon_deg + 0.01, second.lat_deg, "planned"),
    )
    plan = checked(road(straight(500)), existing, plates={})
    assert finding(plan, "existing-markers").figure == 1
    assert "here" in finding(plan, "existing-markers").sentence
    assert finding(plan, "existing-codes").figure == 1
    assert "same" in finding(plan, "existing-codes").sentence


def test_plates_keep_clear_of_tags() -> None:
    events = tuple(RoadEvent(EventKind.SPEED_LIMIT, "1", at, 30.0 + at / 100) for at in np.arange(100.0, 900.0, 25.0))
    plan = checked(road(straight(1000, speed_kmh=36.0), events=events), plates={"spacing_m": 10}, tags={"magnets": 5})
    assert finding(plan, "overlaps").figure == 0, finding(plan, "overlaps").sentence


def test_busy_radio_fails_at_the_busiest_place() -> None:
    plan = checked(
        road(straight(2000)),
        cerpm={"interval_s": 0.1, "spreading_factor": 7, "straight": 0.5, "max_path_error_m": None},
    )
    found = finding(plan, "radio collisions")
    assert found.verdict is Verdict.WARN
    assert found.station_m is not None
    assert 500 < found.station_m < 1500


@pytest.mark.slow
def test_the_law_of_the_place_is_named() -> None:
    lane = straight(400, speed_kmh=30.0)
    inside = road(lane)
    shift = np.array([-85.6 - lane.lon_deg[0], 42.3 - lane.lat_deg[0]])
    there = road(replace(lane, lon_deg=lane.lon_deg + shift[0], lat_deg=lane.lat_deg + shift[1]))
    nowhere = road(replace(lane, lon_deg=lane.lon_deg + 140.0, lat_deg=lane.lat_deg))
    undeclared = finding(checked(inside, cerpm={}), "radio law")
    assert undeclared.verdict is Verdict.WARN
    assert "EU868" in undeclared.sentence
    assert "no region is declared" in undeclared.sentence
    assert finding(checked(inside, cerpm={"region": "US915"}), "radio law").verdict is Verdict.WARN
    assert finding(checked(there, cerpm={}), "radio law").verdict is Verdict.OK
    unknown = finding(checked(nowhere, cerpm={}), "radio law")
    assert unknown.verdict is Verdict.WARN
    assert "unknown" in unknown.sentence
    assert "EU868" not in unknown.sentence
    lawful = checked(inside, cerpm={"region": "EU868"})
    names = (
        "radio law", "radio band", "radio polite-on-time", "radio polite-packet", "radio polite-pause", "radio power",
        "radio slots", "radio read-in-time",
    )  # fmt: skip
    assert {finding(lawful, name).verdict for name in names} == {Verdict.OK}
    assert lawful.radio is not None
    assert lawful.radio.slotted


def test_radio_settings_are_recommended_for_the_busiest_place() -> None:
    """On the straights pairs are far apart, and settings for the mean spacing lose most packets in the bend."""
    rules = {"max_path_error_m": 0.01}
    plan = checked(road(bend(60.0, 1500, 150.0, speed_kmh=40.0)), cerpm=rules)
    assert plan.radio is not None
    assert finding(plan, "radio read-in-time").verdict is Verdict.OK
    straight_one = checked(road(straight(3000, speed_kmh=40.0)), cerpm=rules).radio
    assert straight_one is not None
    assert straight_one.channels < plan.radio.channels
    fixed = {**rules, "spreading_factor": straight_one.spreading_factor, "interval_s": straight_one.interval_s}
    assert finding(checked(plan.alignment, cerpm=fixed), "radio read-in-time").verdict is Verdict.FAIL


@pytest.mark.slow
def test_the_path_beside_a_shared_line_is_that_of_the_lane() -> None:
    """Markers on the line between two lanes name no side."""
    lane = straight(500)
    lon, lat = lane.position_at(lane.chainage_m, 3.5)
    plan = checked(road(lane, replace(lane, name="2", lon_deg=lon, lat_deg=lat)), cerpm={})
    assert finding(plan, "path-error").figure < 0.001


# --- magnets: depth, mounting, wheels and the length of tags ----------------------------------------------------------


LIMIT = RoadEvent(EventKind.SPEED_LIMIT, "1", 300.0, 50.0)


def magnets_on(speed_kmh: float = 50.0, **rules: object) -> Plan:
    """A plan of tags and lines."""
    alignment = replace(road(straight(400, speed_kmh=speed_kmh)), events=(LIMIT,))
    return checked(alignment, **({"tags": {"at": ["speed_limit"]}, "lines": {}} | rules))


def test_the_depth_of_holes_counts_in_checks_and_predictions() -> None:
    flush, deep = (
        magnets_on(installation={"hole_depth_mm": depth}, predictions={"clearance_m": 0.25}) for depth in (30, 300)
    )
    for name in ("clearance utility", "clearance utility line"):
        near, far = finding(flush, name), finding(deep, name)
        assert far.figure - near.figure == pytest.approx(0.27)
        assert (near.verdict, far.verdict) == (Verdict.OK, Verdict.WARN)
        assert "hole_depth_mm" in far.sentence
    for name in ("predicted-read-rate tags", "predicted-read-rate line"):
        near, far = finding(flush, name), finding(deep, name)
        assert near.figure > 0.9 > far.figure
        assert (near.verdict, far.verdict) == (Verdict.OK, Verdict.WARN)
    assert finding(deep, "tag-resolution").limit > 3 * finding(flush, "tag-resolution").limit


def test_magnets_on_the_surface_are_nearer_than_drilled_ones() -> None:
    drilled, glued = magnets_on(installation={"hole_depth_mm": 60}), magnets_on(installation={"mounting": "surface"})
    assert finding(glued, "clearance utility").figure == pytest.approx(
        finding(drilled, "clearance utility").figure - 0.06
    )
    assert finding(glued, "shell-height").verdict is Verdict.OK
    assert not [found for found in drilled.findings if found.name == "shell-height"]
    high = magnets_on(installation={"mounting": "surface", "shell_height_mm": 40})
    assert finding(high, "shell-height").verdict is Verdict.WARN


def test_lines_keep_off_the_turns_of_wheels() -> None:
    plan = magnets_on(lines={"max_spacing_m": 2.3})  # one turn of a wheel; the nearest free spacing is below
    apart = np.diff([m.chainage_m for m in plan.markers if m.code == "N_90"])
    assert np.median(apart) == pytest.approx(1.74, abs=0.01)
    assert finding(plan, "wheel-turns").verdict is Verdict.OK
    usual = magnets_on()  # 6 m are three turns, which are read like any other spacing
    assert np.median(np.diff([m.chainage_m for m in usual.markers if m.code == "N_90"])) == pytest.approx(400 / 67)
    everything = magnets_on(vehicles={"wheel_circumference_m": [0.6, 5.0]})  # no spacing is free
    found = finding(everything, "wheel-turns")
    assert (found.verdict, found.figure) == (Verdict.WARN, 2)
    assert "lines.max_spacing_m" in found.sentence


def test_longer_tags_keep_their_codes_at_high_speed_above_deep_magnets() -> None:
    deep = {"hole_depth_mm": 200}
    short, long = (
        magnets_on(speed_kmh=130.0, installation=deep, tags={"at": ["speed_limit"]} | size)
        for size in ({}, {"size": "freeway"})
    )
    assert [tag.detail.tag.length_m for tag in long.markers if isinstance(tag.detail, PlannedTag)] == [12.0]
    assert finding(short, "tag-resolution").verdict is Verdict.WARN
    assert "tags.size: freeway" in finding(short, "tag-resolution").sentence
    assert finding(long, "tag-resolution").verdict is Verdict.OK
    assert "130 km/h" in finding(long, "codebook-room").sentence
    assert finding(long, "codebook-room").figure < finding(short, "codebook-room").figure


def test_plain_positions_are_not_for_vehicles_that_read_alone() -> None:
    alone = checked(road(straight(400)), plates={"scheme": "position"})
    found = finding(alone, "plate-check")
    assert (found.verdict, found.figure) == (Verdict.WARN, len(alone.markers))
    assert "position-robust" in found.sentence
    assert "vehicles.read_alone" in found.sentence
    with_registry = checked(road(straight(400)), plates={"scheme": "position"}, vehicles={"read_alone": False})
    assert finding(with_registry, "plate-check").verdict is Verdict.OK
    for scheme in ("id", "position-robust", "position-check"):
        assert finding(checked(road(straight(400)), plates={"scheme": scheme}), "plate-check").verdict is Verdict.OK
