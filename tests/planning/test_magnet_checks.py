"""Checks and bills, against the paper's figures and hand calculation."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from pyproj import Geod

from app.encoders.magnet import place_line, place_tag
from app.errors import InvalidParameter
from app.markers.magnet import HALF_HEIGHT_M, InformationTag, Installation, LineStyle, MagnetMounting, Orientation
from app.markers.reading import Check
from app.planning.magnet_checks import (
    ADHESIVE,
    PROVEN_RECALL,
    Neighbour,
    Site,
    bill_of_materials,
    check_layout,
    magnet_recall,
    reaction_distance_m,
    vehicle_clearances,
)
from app.roads.lane_line import LaneLine

STRAIGHT = LaneLine.from_lon_lat([(8.0, 49.0), (8.0, 49.003)])
TAG = InformationTag.from_gaps("NNN", 1.0, [1, 3])
ALL_VEHICLES = ("sedan", "utility", "van", "heavy truck")


def checks_of(
    tag: InformationTag,
    site: Site,
    lane: LaneLine = STRAIGHT,
    chainage_m: float = 50.0,
    near: tuple[Neighbour, ...] = (),
) -> dict[str, Check]:
    return {c.name: c for c in check_layout(place_tag(lane, tag, chainage_m, name="tag"), site, near)}


def test_every_check_has_figure_limit_and_source() -> None:
    checks = checks_of(TAG, Site(13.41, 120.0, ALL_VEHICLES), near=(Neighbour("x", 8.0001, 49.0005),))
    assert set(checks) == {
        "magnet-spacing", "offset-on-bend", "reaction-distance", "clearance-sedan", "clearance-utility",
        "clearance-van", "clearance-heavy-truck", "neighbour-tag",
    }  # fmt: skip
    for check in checks.values():
        assert math.isfinite(check.figure)
        assert check.source
        assert check.note
        assert check.passed == (check.figure >= check.limit if check.relation == ">=" else check.figure <= check.limit)


@pytest.mark.parametrize(
    ("steps", "figure", "passed"), [([10, 30], 1.0, True), ([5, 35], 0.5, True), ([4, 36], 0.4, False)]
)
def test_magnets_stand_half_a_metre_apart(steps: list[int], figure: float, passed: bool) -> None:
    check = checks_of(InformationTag.from_gaps("NNN", 0.1, steps), Site())["magnet-spacing"]
    assert (check.figure, check.limit, check.passed) == (pytest.approx(figure), 0.5, passed)


@pytest.mark.parametrize(("spacing_m", "passed"), [(6.0, True), (6.1, False)])
def test_lines_have_a_magnet_every_six_metres(spacing_m: float, passed: bool) -> None:
    layout = place_line(STRAIGHT, LineStyle.SOLID, name="line", to_m=10 * spacing_m, spacing_m=spacing_m)
    (check,) = (c for c in check_layout(layout, Site()) if c.name == "line-spacing")
    assert (check.figure, check.limit, check.passed) == (pytest.approx(spacing_m), 6.0, passed)


def test_the_reaction_distance_is_aashtos_stopping_sight_distance() -> None:
    # km/h and metres by AASHTO's 0.278 V t + 0.039 V^2 / a, whose rounded coefficients are 1.1 % larger
    for kmh, distance_m in [(20, 18.5), (30, 31.2), (50, 63.5), (80, 129.0), (100, 184.2), (130, 284.2)]:
        assert reaction_distance_m(kmh / 3.6) == pytest.approx(distance_m, rel=0.012)
    last = 54.0  # the tag's first magnet is at 50 m
    limit = reaction_distance_m(13.41)
    near, far = (checks_of(TAG, Site(13.41, last + limit + d))["reaction-distance"] for d in (-0.1, 0.1))
    assert (near.passed, far.passed) == (False, True)
    assert far.figure == pytest.approx(limit + 0.1, abs=1e-4)
    assert checks_of(TAG, Site(13.41, 10.0))["reaction-distance"].figure == pytest.approx(-44.0, abs=1e-4)
    assert checks_of(TAG, Site(5.9, last + 20.0))["reaction-distance"].passed  # the paper's 20 m
    assert checks_of(TAG, Site(13.41, last + 20.0, reaction_s=0.5, deceleration_m_s2=8.0))["reaction-distance"].passed


def test_vehicles_are_served_up_to_the_readable_clearance() -> None:
    assert vehicle_clearances() == {
        "sedan": pytest.approx((0.155, 0.01581)),
        "utility": pytest.approx((0.2108, 0.045)),
        "van": pytest.approx((0.288, 0.01939)),
        "heavy truck": pytest.approx((0.372, 0.02786)),
    }
    names = [f"clearance-{name.replace(' ', '-')}" for name in ALL_VEHICLES]
    further = checks_of(TAG, Site(vehicles=ALL_VEHICLES, readable_clearance_m=0.35))
    assert [further[name].passed for name in names] == [True, True, True, False]
    assert further["clearance-sedan"].figure == pytest.approx(0.155 + 1.645 * 0.01581 - HALF_HEIGHT_M, abs=1e-4)
    proven = checks_of(TAG, Site(vehicles=ALL_VEHICLES))
    assert {proven[name].limit for name in names} == {round(magnet_recall(Orientation.FORWARD).proven_m, 4)}
    line = place_line(STRAIGHT, LineStyle.SOLID, name="line", to_m=60.0)
    limits = {c.limit for c in check_layout(line, Site()) if c.name.startswith("clearance")}
    assert limits == {round(magnet_recall(Orientation.UP).proven_m, 4)}


def test_the_proven_range_is_where_the_measured_recall_ends() -> None:
    for orientation in Orientation:
        recall = magnet_recall(orientation)
        shares = [recall.share_at(d) for d in recall.distance_m.tolist()]
        assert shares == sorted(shares, reverse=True)
        assert (
            recall.share_at(recall.proven_m - 0.001) >= PROVEN_RECALL - 1e-6 >= recall.share_at(recall.proven_m + 0.001)
        )
        assert recall.share_at(0.05) == shares[0] > 0.99  # nearer than anything measured
        assert recall.share_at(1.0) < 0.06


ON_SURFACE = Installation(MagnetMounting.SURFACE)


def check_of(name: str, fixed: Installation = Installation()) -> Check:
    layout = place_tag(STRAIGHT, TAG, 50.0, name="tag", installation=fixed)
    return {c.name: c for c in check_layout(layout, Site(vehicles=("sedan",)))}[name]


def test_the_depth_of_magnets_adds_to_the_clearance() -> None:
    flush, deep = (check_of("clearance-sedan", Installation(hole_depth_mm=depth)) for depth in (30.0, 300.0))
    assert deep.figure - flush.figure == pytest.approx(0.27)
    assert (flush.passed, deep.passed) == (True, False)
    assert "29.5 cm deep" in deep.note
    assert check_of("clearance-sedan", ON_SURFACE).figure == check_of("clearance-sedan").figure < flush.figure


def test_shells_on_the_road_are_no_higher_than_raised_markers() -> None:
    assert check_of("shell-height", ON_SURFACE).passed
    assert check_of("shell-height", replace(ON_SURFACE, shell_height_mm=25.0)).passed
    assert not check_of("shell-height", replace(ON_SURFACE, shell_height_mm=30.0)).passed
    with pytest.raises(KeyError):
        check_of("shell-height")


@pytest.mark.parametrize(
    ("installation", "field"),
    [
        ({"mounting": "surface", "hole_depth_mm": 30.0}, "hole_depth_mm"),
        ({"mounting": "surface", "hole_diameter_mm": 30.0}, "hole_diameter_mm"),
        ({"shell_height_mm": 15.0}, "shell_height_mm"),
    ],
)
def test_a_size_of_the_other_mounting_is_refused(installation: dict[str, Any], field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        Installation(**installation)
    assert caught.value.field == field
    assert caught.value.limit
    assert caught.value.cure


@pytest.mark.parametrize(
    ("spacing_m", "passed"),
    [(0.8, True), (1.0, False), (1.4, True), (1.8, False), (2.0, False), (2.3, False), (2.5, True), (4.0, False),
     (5.0, True), (6.0, True)],
)  # fmt: skip
def test_lines_do_not_repeat_with_the_turns_of_wheels(spacing_m: float, passed: bool) -> None:
    line = place_line(STRAIGHT, LineStyle.SOLID, name="line", to_m=60 * spacing_m / 6, spacing_m=spacing_m)
    check = {c.name: c for c in check_layout(line, Site())}["wheel-turns"]
    assert check.passed == passed == ("choose" not in check.note)
    bus = check_layout(line, Site(wheel_circumference_m=(3.1, 3.2)))  # half 1.55, one 3.15, two 6.3
    assert {c.name: c.passed for c in bus}["wheel-turns"]


def beside(distance_m: float, orientation: Orientation = Orientation.FORWARD) -> Neighbour:
    """A marker so far to the left of the tag's second magnet."""
    hole = place_tag(STRAIGHT, TAG, 50.0, name="tag").holes[1]
    lon, lat, _ = Geod(ellps="WGS84").fwd(hole.lon_deg, hole.lat_deg, 270.0, distance_m)
    return Neighbour("next lane", lon, lat, orientation)


def test_neighbours_of_other_lanes_keep_their_distance() -> None:
    near = checks_of(TAG, Site(), near=(beside(1.3), beside(3.6)))["neighbour-tag"]
    assert (near.figure, near.limit, near.passed) == (pytest.approx(1.3, abs=1e-4), pytest.approx(1.385), False)
    assert checks_of(TAG, Site(), near=(beside(3.6),))["neighbour-tag"].passed
    line = beside(1.3, Orientation.UP)
    assert checks_of(TAG, Site(), near=(line,))["neighbour-magnet"].passed
    assert not checks_of(TAG, Site(), near=(beside(0.45, Orientation.UP),))["neighbour-magnet"].passed
    assert "neighbour-tag" not in checks_of(TAG, Site(), near=(line,))


def test_a_long_tag_on_a_sharp_bend_leaves_the_lane(bend: LaneLine) -> None:
    assert checks_of(TAG, Site(), bend, 70.0)["offset-on-bend"].passed
    long_tag = InformationTag.from_gaps("NNN", 1.0, [6, 6])
    check = checks_of(long_tag, Site(), bend, 68.0)["offset-on-bend"]
    assert not check.passed
    assert check.figure > 0.6


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"stop_line_chainage_m": 100.0}, "design_speed_m_s"),
        ({"design_speed_m_s": math.nan}, "design_speed_m_s"),
        ({"design_speed_m_s": 0.0}, "design_speed_m_s"),
        ({"design_speed_m_s": 10.0, "stop_line_chainage_m": math.inf}, "stop_line_chainage_m"),
        ({"vehicles": ("tank",)}, "vehicles"),
        ({"readable_clearance_m": 30.0}, "readable_clearance_m"),
        ({"reaction_s": -1.0}, "reaction_s"),
        ({"deceleration_m_s2": 0.0}, "deceleration_m_s2"),
        ({"wheel_circumference_m": (2.3, 1.8)}, "wheel_circumference_m"),
    ],
)
def test_a_site_outside_the_limits_is_refused_by_name(options: dict[str, object], field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        Site(**options)  # type: ignore[arg-type]
    assert caught.value.field == field
    assert caught.value.limit


# --- bill -------------------------------------------------------------------------------------------------------------


def test_a_tag_of_three_magnets_costs_three_dollars() -> None:
    bill = bill_of_materials(place_tag(STRAIGHT, TAG, 50.0, name="tag"))
    assert bill.total_usd == 3.0  # METRO section 8.1
    assert (bill.paint.low_usd, bill.paint.high_usd) == (0.84, 30.8)
    assert [row.cost.item for row in bill.alternatives] == ["paint or thermoplastic marking", "rugged RFID tag"]
    assert (bill.alternatives[1].low_usd, bill.alternatives[1].high_usd) == (8.0, 14.4)


def test_a_line_costs_less_than_the_cheapest_paint() -> None:
    layout = place_line(STRAIGHT, LineStyle.SOLID, name="line", to_m=300.0)
    bill = bill_of_materials(layout)
    assert bill.total_usd == 51.0
    assert bill.total_usd / 300 == pytest.approx(0.17, abs=0.001)  # METRO section 8.1
    assert (bill.paint.low_usd, bill.paint.high_usd) == (63.0, 2310.0)
    assert all(row.cost.source.startswith("METRO") for row in (*bill.materials, *bill.alternatives))


def test_magnets_on_the_surface_are_billed_with_shells_and_adhesive() -> None:
    layout = place_tag(STRAIGHT, TAG, 50.0, name="tag", installation=ON_SURFACE)
    bill = bill_of_materials(layout)
    assert bill.total_usd == 3.0  # METRO section 8.1: 1 USD each, of it 0.25 for the shell
    assert [(row.cost.item, row.quantity, row.high_usd) for row in bill.materials] == [
        ("magnet", 3, 2.25), ("protective shell", 3, 0.75),
    ]  # fmt: skip
    assert [(row.item, row.quantity) for row in bill.without_price] == [(ADHESIVE, 3)]
    assert bill_of_materials(place_tag(STRAIGHT, TAG, 50.0, name="tag")).without_price == ()
