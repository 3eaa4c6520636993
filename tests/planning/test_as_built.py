"""Plans with surveyed positions in place of planned ones."""

from __future__ import annotations

import pytest

from app.markers.reading import Verdict
from app.planning.plan import (
    Plan,
    PlannedCerpm,
    PlannedLineMagnet,
    PlannedMarker,
    PlannedPlate,
    PlannedTag,
    SurveyedPlace,
    plan_as_built,
    residual_of,
)
from app.planning.plan_checks import check_plan
from tests.planning.outputs.made import plan_of
from tests.planning.roads import GEOD, bend, road

ALONG_M, ACROSS_M = 0.4, 0.3


@pytest.fixture(scope="module")
def plan() -> Plan:
    """All families on a bend."""
    lane = bend(150, name="1")
    cerpm = {"spreading_factor": 7, "interval_s": 1, "max_path_error_m": 0.05}
    return check_plan(plan_of(road(lane), plates={}, lines={}, tags={"magnets": 4}, cerpm=cerpm))


def moved(marker: PlannedMarker, along_m: float, across_m: float) -> SurveyedPlace:
    """A place ahead and to the left of a marker."""
    lon, lat, _ = GEOD.fwd(marker.lon_deg, marker.lat_deg, marker.heading_deg, along_m)
    lon, lat, _ = GEOD.fwd(lon, lat, marker.heading_deg - 90.0, across_m)
    return SurveyedPlace(lon, lat, (marker.heading_deg + 1.0) % 360.0)


def of(plan: Plan, kind: type) -> list[PlannedMarker]:
    return [marker for marker in plan.markers if isinstance(marker.detail, kind)]


def test_residuals_are_ahead_and_to_the_left(plan: Plan) -> None:
    for marker in plan.markers[:: len(plan.markers) // 7]:
        found = residual_of(marker, moved(marker, ALONG_M, ACROSS_M))
        assert found == pytest.approx((ALONG_M, ACROSS_M, 1.0), abs=1e-4)


def test_a_survey_at_the_planned_places_changes_no_check(plan: Plan) -> None:
    surveyed = {marker.number: SurveyedPlace(marker.lon_deg, marker.lat_deg, None) for marker in plan.markers}
    again = check_plan(plan_as_built(plan, surveyed))
    assert [finding.name for finding in again.findings] == [finding.name for finding in plan.findings]
    for one, other in zip(again.findings, plan.findings, strict=True):
        assert one.figure == pytest.approx(other.figure, rel=1e-4, abs=1e-4), one.name
        assert one.verdict is other.verdict, one.name


def test_markers_move_with_their_magnets_and_lines_stay(plan: Plan) -> None:
    surveyed = {marker.number: moved(marker, ALONG_M, ACROSS_M) for marker in plan.markers}
    built = plan_as_built(plan, surveyed)
    assert built.findings == ()
    for before, after in zip(plan.markers, built.markers, strict=True):
        if isinstance(before.detail, PlannedLineMagnet):
            assert after == before
            continue
        assert (after.lon_deg, after.lat_deg) == surveyed[before.number][:2]
        assert after.chainage_m - before.chainage_m == pytest.approx(ALONG_M, abs=1e-3)
        assert after.offset_m - before.offset_m == pytest.approx(ACROSS_M, abs=0.006)
        if isinstance(after.detail, PlannedTag):
            assert isinstance(before.detail, PlannedTag)
            for (_, lon, lat), (_, old_lon, old_lat) in zip(after.detail.magnets, before.detail.magnets, strict=True):
                away = GEOD.inv(lon, lat, old_lon, old_lat)[2]
                assert away == pytest.approx((ALONG_M**2 + ACROSS_M**2) ** 0.5, abs=0.01)


def test_a_pair_beside_its_boundary_bends_the_path(plan: Plan) -> None:
    cerpms = of(plan, PlannedCerpm)
    middle = cerpms[len(cerpms) // 2].chainage_m
    pair = [marker for marker in cerpms if abs(marker.chainage_m - middle) < 1.0]
    assert len(pair) == 2
    figures = []
    for chosen in ([], pair[:1], pair):
        built = check_plan(plan_as_built(plan, {m.number: moved(m, 0.0, ACROSS_M) for m in chosen}))
        figures.append(next(finding for finding in built.findings if finding.name == "path-error"))
    assert figures[0].verdict is Verdict.OK
    assert figures[1].figure == pytest.approx(ACROSS_M / 2, abs=0.05)
    assert figures[2].figure == pytest.approx(ACROSS_M, abs=0.05)
    assert figures[2].verdict is Verdict.FAIL


def test_a_plate_beside_the_lane_is_seen_for_less_long(plan: Plan) -> None:
    first = of(plan, PlannedPlate)[0]
    built = check_plan(plan_as_built(plan, {first.number: moved(first, 0.0, 1.6)}))
    for finding in plan.findings:
        if finding.name.startswith("frames-per-pass"):
            after = next(found for found in built.findings if found.name == finding.name)
            assert after.figure < finding.figure
            break
    else:
        pytest.fail("no camera was checked")
