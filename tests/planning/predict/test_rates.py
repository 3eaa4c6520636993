"""Predicted read rates and path errors: what they depend on, their findings, and a proof of the same plan."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.formats.alignments.geometry import EventKind
from app.markers.plate import PlateGeometry
from app.markers.reading import Verdict
from app.planning.alignment import RoadEvent
from app.planning.placement import place_plan
from app.planning.plan import Plan, PlanFinding
from app.planning.plan_checks import check_plan
from app.planning.plan_checks.check import check_predictions
from app.planning.predict.rates import fitted_models, line_rates, path_errors_m, plate_rates, plate_read_rate, tag_rates
from app.planning.proof import ProofTerms, UnitKind
from app.planning.proof.drives import drive_cerpms
from app.planning.rules import CameraRules, PlanRules, PredictionRules, check_rules
from tests.planning.proof.conftest import prover_of
from tests.planning.roads import bend, road, straight

PLATE = PlateGeometry()
CAMERA = CameraRules(frames_per_s=15.0, exposure_s=0.002)


def rate(camera: CameraRules = CAMERA, condition: str = "day", speed_kmh: float = 70.0, left_m: float = 0.0) -> float:
    return plate_read_rate(PLATE, camera, condition, speed_kmh / 3.6, left_m)


def changed(**more: object) -> CameraRules:
    return CAMERA.model_copy(update=more)


def findings(**rules: Any) -> dict[str, PlanFinding]:
    lane = bend(200.0, speed_kmh=60.0)
    stop = RoadEvent(EventKind.STOP_LINE, "1", 300.0)
    plan = place_plan(road(lane, events=(stop,)), PlanRules.model_validate({"version": 1, **rules}), name="predicted")
    return {found.name: found for found in check_predictions(plan)}


def test_rates_fall_with_speed_blur_and_distance_and_rise_with_frames() -> None:
    middle = rate()
    assert 0.5 < middle < 1.0
    assert rate(speed_kmh=30) > middle > rate(speed_kmh=120)
    assert rate(changed(exposure_s=0.0005)) > middle > rate(changed(exposure_s=0.006))
    assert rate(changed(frames_per_s=60)) > middle > rate(changed(frames_per_s=2))
    assert rate(changed(width_px=640, height_px=360)) < middle
    assert rate(left_m=30.0) == 0.0


def test_no_condition_is_better_than_the_day_and_joined_ones_are_worse_than_each() -> None:
    slow = changed(frames_per_s=4.0, exposure_s=0.004)
    day = rate(slow)
    for one, other in (("night", "rain"), ("wear", "dirt"), ("shade", "rain")):
        both = rate(slow, f"{one}+{other}")
        assert both <= min(rate(slow, one), rate(slow, other)) + 1e-9
        assert both == rate(slow, f"{other}+day+{one}")
        assert both < day


def test_rates_of_many_plates_are_those_of_each() -> None:
    speeds, offsets = np.array([10.0, 30.0, 10.0, 20.0]), np.array([0.0, 0.0, 0.5, 0.0])
    found = plate_rates(offsets, speeds, PLATE, CAMERA, "day", PredictionRules())
    alone = [plate_read_rate(PLATE, CAMERA, "day", v, left) for v, left in zip(speeds, offsets, strict=True)]
    assert found == pytest.approx(alone)
    slower = plate_rates(offsets, speeds, PLATE, CAMERA, "day", PredictionRules(speed_share=0.5))
    assert (slower > found).all()


def test_tags_and_lines_are_read_less_often_from_higher_and_in_bends() -> None:
    lane = bend(30.0)
    places = np.array([10.0, 215.0])
    for rates in (lambda distance_m: tag_rates(lane, places, distance_m, 3), partial(line_rates, lane, places)):
        low, high = rates(0.12), rates(0.6)
        assert (low > high).all()
        assert low[0] >= low[1]
        assert low[0] > 0.98
        assert high[0] < 0.1
    assert tag_rates(lane, places, 0.4, 7)[0] < tag_rates(lane, places, 0.4, 3)[0]


def test_path_errors_grow_with_the_survey_the_spacing_and_missing_markers() -> None:
    lane = straight(1200)
    near, far = np.arange(0.0, 1200.1, 10.0), np.arange(0.0, 1200.1, 30.0)
    own = path_errors_m(lane, near, PredictionRules())[0]
    assert own.shape == (3,)
    assert (path_errors_m(lane, far, PredictionRules())[0] > own).all()
    assert (path_errors_m(lane, near, PredictionRules(survey_rmse_m=0.1))[0] > own).all()
    assert (path_errors_m(lane, near, PredictionRules(lost_share=0.5))[0] > own).all()
    rms, worst = path_errors_m(bend(30.0, turn_deg=90.0), np.arange(0.0, 440.0, 30.0), PredictionRules())
    assert worst > rms > path_errors_m(straight(440), np.arange(0.0, 440.0, 30.0), PredictionRules())[0]


def test_findings_have_value_limit_source_and_place() -> None:
    found = findings(
        plates={"spacing_m": 50}, lines={}, tags={}, cerpm={},
        predictions={"conditions": ["day", "night+rain"], "lost_share": 0.2},
    )  # fmt: skip
    assert found.keys() == {
        "predicted-read-rate plates camera day", "predicted-read-rate plates camera night+rain",
        "predicted-read-rate tags", "predicted-read-rate line", "predicted-path-error",
    }  # fmt: skip
    for one in found.values():
        assert one.lane == "1"
        assert one.lon_deg is not None
        assert "predictions.json" in one.source
    day, dark = (found[f"predicted-read-rate plates camera {name}"] for name in ("day", "night+rain"))
    assert (day.relation, day.limit, day.verdict) == (">=", 0.9, Verdict.WARN)
    assert 0.7 < day.figure <= 0.8
    assert dark.figure < day.figure
    assert found["predicted-path-error"].limit == 0.05
    assert "below 0.9" in dark.sentence


def test_all_checks_of_a_plan_have_the_predictions(plates: Plan) -> None:
    assert "predicted-read-rate plates camera day" in {found.name for found in check_plan(plates).findings}


@pytest.mark.parametrize("conditions", [["fog"], [], ["day+"], "day"])
def test_unknown_conditions_are_refused(conditions: object) -> None:
    with pytest.raises(InvalidParameter) as error:
        check_rules({"version": 1, "plates": {}, "predictions": {"conditions": conditions}})
    assert str(error.value.field).startswith("predictions.conditions")


def test_the_fitted_parameters_name_the_command_that_makes_them() -> None:
    models = fitted_models()
    assert models.source.startswith("python -m benchmarks.planning.fit --passes ")
    assert (Path(__file__).resolve().parents[3] / "benchmarks/planning/fit/__main__.py").exists()
    assert models.plates.keys() == {"day", "night", "rain", "shade", "wear", "dirt"}
    middle = models.path.rms_of(0.03, np.array([15.0]), np.array([15.0]), np.zeros(1), np.zeros(1))
    assert middle == pytest.approx([0.018], rel=0.2)


@pytest.mark.slow
def test_the_path_of_a_proof_is_as_far_off_as_predicted(cerpms: Plan) -> None:
    """Twelve drives of a road on which nothing was fitted; the benchmark has more roads and stricter limits."""
    prover = prover_of(cerpms, ProofTerms(drives=12, seed=5, max_sections_per_drive=10))
    found = [drive_cerpms(prover.lane_pass(u)) for u in prover.list_units() if u.kind is UnitKind.LANE]
    measured = math.sqrt(sum(one["square_sum_m2"] for one in found) / sum(one["covered"] for one in found))
    predicted = [
        path_errors_m(lane, np.array([m.chainage_m for m in cerpms.markers if m.lane == lane.name]), PredictionRules())
        for lane in cerpms.alignment.lanes
    ]
    rms = math.sqrt(np.mean([errors[0] ** 2 for errors in predicted]))
    assert rms == pytest.approx(measured, rel=0.3)
