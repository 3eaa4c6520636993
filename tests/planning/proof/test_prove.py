"""Units of a proof: what is read, whatever the order, and with the same seed the same."""

from __future__ import annotations

import json
import math

import pytest
from pydantic import ValidationError

from app.errors import InvalidParameter
from app.planning.plan import Plan, PlannedCerpm
from app.planning.proof import ProofTerms, UnitKind, summarize
from tests.planning.proof.conftest import plan_on, prove, prover_of
from tests.planning.roads import bend, straight

pytestmark = pytest.mark.slow


def test_plates_of_a_slow_road_are_all_read_and_give_positions_within_the_survey(plates: Plan) -> None:
    report = prove(plates, ProofTerms(drives=2, conditions=("day", "night+rain"), survey_rmse_m=0.02))
    (rate, *by_condition) = report.rates
    assert (rate.kind, rate.condition, rate.passes, rate.read) == ("plates", "all", 4, 4)
    assert [one.condition for one in by_condition] == ["day", "night+rain"]
    assert report.wrong == ()
    assert report.weak == ()
    for drive in report.drives:
        assert drive.fixes == 2
        assert 0 < drive.fix_worst_m < 0.15
        assert drive.longest_gap_m == pytest.approx(100, abs=1)
        assert not drive.gap_estimated


def test_units_give_the_same_in_any_order_and_after_json(plates: Plan) -> None:
    terms = ProofTerms(drives=2, seed=7, lost_share=0.3)
    units = prover_of(plates, terms).list_units()
    assert len({unit.key for unit in units}) == len(units) == 2
    forward = [prover_of(plates, terms).prove_unit(unit) for unit in units]
    prover = prover_of(plates, terms)
    backward = [json.loads(json.dumps(prover.prove_unit(unit))) for unit in reversed(units)]
    assert backward[::-1] == forward
    assert summarize(plates, terms, backward) == summarize(plates, terms, forward)
    other = prove(plates, ProofTerms(drives=2, seed=8, lost_share=0.3))
    assert other.markers != summarize(plates, terms, forward).markers


def test_missing_plates_are_lost_and_nothing_is_read_of_them(plates: Plan) -> None:
    report = prove(plates, ProofTerms(drives=4, lost_share=0.5, seed=3))
    rate = report.rates[0]
    assert 0 < rate.lost < rate.passes == 8
    assert rate.read == rate.passes - rate.lost
    for marker in report.markers:
        assert marker.lost == 0 or marker.cause == "lost" or marker.read == marker.passes - marker.lost


def test_a_slow_camera_misses_plates_for_want_of_frames() -> None:
    plan = plan_on(
        straight(200, speed_kmh=60.0), plates={"spacing_m": 100}, cameras=[{"name": "slow", "frames_per_s": 1.0}]
    )
    report = prove(plan, ProofTerms(drives=3))
    assert 0 < report.rates[0].read < 6
    assert {marker.cause for marker in report.list_weak()} == {"few frames at this speed"}


def test_a_plate_right_behind_a_sharp_bend_is_missed_because_of_the_bend() -> None:
    narrow = {"name": "narrow", "horizontal_fov_deg": 14.0, "depression_deg": 12.0, "width_px": 960, "height_px": 540}
    plan = plan_on(bend(12.0, 20, 90.0, speed_kmh=20.0), plates={"spacing_m": 20}, cameras=[narrow])
    report = prove(plan, ProofTerms(drives=1))
    in_bend = [marker for marker in report.markers if 24 < marker.chainage_m < 36]
    assert in_bend
    assert {marker.cause for marker in in_bend} == {"bend"}


def test_a_tag_is_read_with_a_position_and_line_magnets_where_the_bar_is_over_them(magnets: Plan) -> None:
    report = prove(magnets, ProofTerms(drives=1, max_sections_per_drive=1))
    rates = {rate.kind: rate for rate in report.rates if rate.condition == "all"}
    assert rates["tags"].read == rates["tags"].passes == 1
    assert rates["line"].passes >= 4
    assert rates["line"].read == rates["line"].passes
    assert report.wrong == ()
    (tag,) = (marker for marker in report.markers if marker.kind == "tags")
    assert 0 < tag.fix_rms_m < 0.15


def test_a_bar_too_high_misses_magnets(magnets: Plan) -> None:
    report = prove(magnets, ProofTerms(drives=1, max_sections_per_drive=1, clearance_m=0.6))
    (tag,) = (marker for marker in report.markers if marker.kind == "tags")
    assert (tag.read, tag.weak, tag.cause) == (0, True, "clearance")


def test_the_path_past_cerpms_follows_each_lane_of_a_road(cerpms: Plan) -> None:
    report = prove(cerpms, ProofTerms(drives=1))
    assert [drive.lane for drive in report.drives] == ["1", "2"]
    for drive in report.drives:
        assert drive.refusals == ()
        assert drive.path_coverage == 1.0
        assert 0 < drive.path_rms_m < 0.05
        assert drive.path_rms_m < drive.path_worst_m < 0.2


def test_lost_cerpms_are_not_heard(cerpms: Plan) -> None:
    terms = ProofTerms(drives=1, lost_share=0.4)
    prover = prover_of(cerpms, terms)
    unit = next(unit for unit in prover.list_units() if unit.kind is UnitKind.LANE)
    path = prover.prove_unit(unit)["path"]
    assert path is not None
    own = [m for m in cerpms.markers if isinstance(m.detail, PlannedCerpm) and m.lane == unit.lane]
    assert 0 < path["received"] <= path["markers"] < len(own)


def test_a_long_road_is_sampled_by_strata_and_gaps_are_estimated() -> None:
    plan = plan_on(straight(3000, speed_kmh=80.0), plates={"spacing_m": 50})
    prover = prover_of(plan, ProofTerms(drives=2, max_markers_per_drive=10))
    units = prover.list_units()
    first, second = ({n for u in units if u.drive == d for n in u.markers} for d in (0, 1))
    assert len(first) == len(second) == 10
    assert first != second
    assert sum(weight for u in units if u.drive == 0 for weight in u.weight) == pytest.approx(60)
    result = prover.prove_unit(units[0])
    report = summarize(plan, prover.terms, [result], complete=False)
    assert report.drives[0].gap_estimated
    assert math.isfinite(report.drives[0].longest_gap_m)


def test_unknown_cameras_and_conditions_are_refused(plates: Plan) -> None:
    with pytest.raises(ValidationError, match="fog"):
        ProofTerms(conditions=("day+fog",))
    with pytest.raises(InvalidParameter) as refused:
        prove(plates, ProofTerms(drives=1, cameras=("front",)))
    assert (refused.value.field, refused.value.limit) == ("cameras", "camera")
