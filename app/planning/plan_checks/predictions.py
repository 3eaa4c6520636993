"""Predicted read rates of each family and path errors, in the circumstances that the rules name."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from app.markers.checks import Verdict
from app.markers.plate import PlateGeometry
from app.planning.alignment import Floats, Lane
from app.planning.plan import (
    Plan,
    PlanFinding,
    PlannedCerpm,
    PlannedLineMagnet,
    PlannedMarker,
    PlannedPlate,
    PlannedTag,
)
from app.planning.plan_checks.finding import compare
from app.planning.predict.rates import line_rates, path_errors_m, plate_rates, tag_rates

SOURCE = "models fitted to simulated drives on other roads: app/planning/data/predictions.json"
RateOf = Callable[[Lane, Floats], Floats]
_MIN_PAIRS = 3  # of a lane whose path is predicted; source: a spline needs more than two places


def check_predictions(plan: Plan) -> Iterator[PlanFinding]:
    """One finding for each camera and condition, for tags, for line magnets, and for the path."""
    yield from _plates(plan)
    terms = plan.rules.predictions
    clearance = terms.clearance_m
    for kind, what, rate_of in (
        (PlannedTag, "tags", lambda lane, at: tag_rates(lane, at, clearance)),
        (PlannedLineMagnet, "line", lambda lane, at: line_rates(lane, at, clearance)),
    ):
        markers = [marker for marker in plan.markers if isinstance(marker.detail, kind)]
        if markers:
            sentence = f"of {what if what == 'tags' else 'magnets of a line under the bar'} at a clearance of "
            yield _rate(plan, f"predicted-read-rate {what}", markers, _by_lane(plan, markers, rate_of),
                        f"{sentence}{clearance:g} m")  # fmt: skip
    yield from _path(plan)


def _plates(plan: Plan) -> Iterator[PlanFinding]:
    rules, terms = plan.rules.plates, plan.rules.predictions
    markers = [marker for marker in plan.markers if isinstance(marker.detail, PlannedPlate)]
    if rules is None or not markers:
        return
    geometry = PlateGeometry(rules.n, rules.unit_mm, rules.gap_mm, rules.thickness_mm)
    speeds = _by_lane(plan, markers, lambda lane, at: lane.value_at(lane.design_speed_mps, at))
    offsets = np.array([marker.offset_m for marker in markers])
    for camera in plan.rules.cameras:
        for condition in terms.conditions:
            rates = plate_rates(offsets, speeds, geometry, camera, condition, terms)
            name = f"predicted-read-rate plates {camera.name} {condition}"
            yield _rate(plan, name, markers, rates, f"of plates by {camera.name} in {condition}")


def _rate(plan: Plan, name: str, markers: Sequence[PlannedMarker], rates: Floats, sentence: str) -> PlanFinding:
    """Mean of the rates, missing markers included, at the marker that is read least."""
    terms = plan.rules.predictions
    there = 1.0 - terms.lost_share
    worst = int(rates.argmin())
    weak = int(np.count_nonzero(rates < terms.min_read_rate))
    sentence = f"predicted read rate {sentence}; lowest here, {there * float(rates[worst]):.3f}"
    if weak:
        sentence += f"; {weak} of {len(markers)} markers are below {terms.min_read_rate:g}"
    return compare(
        name, there * float(rates.mean()), ">=", terms.min_read_rate, "share", SOURCE, sentence, markers[worst],
        missed=Verdict.WARN,
    )  # fmt: skip


def _by_lane(plan: Plan, markers: Sequence[PlannedMarker], values_at: RateOf) -> Floats:
    """Values at the markers' chainages, in their order."""
    found = np.empty(len(markers))
    lanes = np.array([marker.lane for marker in markers])
    at = np.array([marker.chainage_m for marker in markers])
    for name in dict.fromkeys(lanes.tolist()):
        own = lanes == name
        found[own] = values_at(plan.alignment.lane(name), at[own])
    return found


def _path(plan: Plan) -> Iterator[PlanFinding]:
    """The worst stretch of all lanes; its root mean square over drives."""
    rules, terms = plan.rules.cerpm, plan.rules.predictions
    cerpms = [marker for marker in plan.markers if isinstance(marker.detail, PlannedCerpm)]
    worst: tuple[float, float, PlannedMarker] | None = None
    for name in dict.fromkeys(marker.lane for marker in cerpms):
        lane = plan.alignment.lane(name)
        own = [marker for marker in cerpms if marker.lane == name]
        at = np.array([marker.chainage_m for marker in own])
        if len(np.unique(at)) < _MIN_PAIRS or np.ptp(at) < lane.length_m / 2:
            continue
        rms, greatest = path_errors_m(lane, at, terms)
        k = int(rms.argmax())
        if worst is None or rms[k] > worst[0]:
            middle = (k + 0.5) * lane.length_m / len(rms)
            nearest = min(own, key=lambda marker: abs(marker.chainage_m - middle))
            worst = (float(rms[k]), float(greatest[k]), nearest)
    if worst is None or rules is None:
        return
    required = plan.rules.quality.path_error_m if plan.rules.quality is not None else None
    limit = required if required is not None else rules.max_path_error_m
    limit = limit if limit is not None else worst[0]
    yield compare(
        "predicted-path-error", worst[0], "<=", limit, "m", SOURCE,
        f"root mean square distance of the path from the centre line along the worst stretch, with a survey of "
        f"{terms.survey_rmse_m:g} m; {worst[1]:.3f} m at its worst place", worst[2], missed=Verdict.WARN,
    )  # fmt: skip
