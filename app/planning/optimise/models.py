"""The families of rules as the optimiser takes them: costs of the agency, and fixes as the checks predict them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from app.errors import InvalidParameter
from app.markers.plate import PlateGeometry
from app.planning.alignment import Alignment, Floats, Lane
from app.planning.optimise.costs import list_prices, site_costs
from app.planning.optimise.plan import FamilyModel, OptimisedPlan, optimise_plan
from app.planning.outputs.bill import plan_quantities
from app.planning.placement import place_plan
from app.planning.plan import PlannedMarker, PlannedPlate, PlannedTag
from app.planning.predict.rates import plate_fix_error_m, plate_rates, tag_fix_error_m, tag_fix_share, tag_rates
from app.planning.rules import PlanRules

_BY_NUMBER = ("magnet", "hole", "cerpm", "marker")  # units of the costs of markers whose places are not sought


def optimise_by_prediction(alignment: Alignment, rules: PlanRules) -> OptimisedPlan:
    """The cheapest plates and pairs of CERPMs with which the predicted fixes and path have the quality of the rules.

    Tags ahead of events and plates at decision points stand in any case and count as fixes; line magnets, and CERPMs
    where no path error is required, stand as the rules have them. All are part of the cost.

    Raises
    ------
    InvalidParameter
        As `optimise_plan`; or no family of the rules fixes positions or serves the path.
    """
    assert rules.quality is not None
    path = rules.cerpm is not None and rules.quality.path_error_m is not None
    if rules.plates is None and rules.tags is None and not path:
        raise InvalidParameter(
            "a quality is required, but no marker of the rules fixes a position",
            field="quality",
            limit="plates or tags for fixes; cerpm with quality.path_error_m for the path",
            cure="add plates to the rules, or leave quality out",
        )
    costs = site_costs(rules if path else rules.model_copy(update={"cerpm": None}))
    models = []
    if rules.plates is not None:
        models.append(FamilyModel("plate", costs["plate"], lambda lane, at: plate_fixes(rules, lane, at)))
    if rules.tags is not None:
        models.append(
            FamilyModel("magnet", costs["magnet"], lambda lane, at: tag_fixes(rules, lane, at), selectable=False)
        )
    if path:
        models.append(FamilyModel("cerpm", costs["cerpm"], None))
    return optimise_plan(alignment, rules, models, other_cost=_other_cost(alignment, rules, path=path))


def plate_fixes(rules: PlanRules, lane: Lane, at: Floats) -> tuple[Floats, Floats]:
    """Probability of a fix by plates at chainages of a lane, for the worst camera and condition, and its error [m]."""
    assert rules.plates is not None
    size, terms = rules.plates, rules.predictions
    geometry = PlateGeometry(size.n, size.unit_mm, size.gap_mm, size.thickness_mm)
    speeds = lane.value_at(lane.design_speed_mps, at)
    offsets = np.full(len(at), size.offset_from_centre_m)
    rates = [
        plate_rates(offsets, speeds, geometry, camera, condition, terms)
        for camera in rules.cameras
        for condition in terms.conditions
    ]
    error = max(plate_fix_error_m(condition, terms.survey_rmse_m) for condition in terms.conditions)
    return (1.0 - terms.lost_share) * np.min(rates, axis=0), np.full(len(at), error)


def tag_fixes(rules: PlanRules, lane: Lane, at: Floats) -> tuple[Floats, Floats]:
    """Probability of a fix by tags at chainages of a lane, and its error [m]."""
    terms = rules.predictions
    rate = tag_fix_share() * tag_rates(lane, at, terms.clearance_m)
    return (1.0 - terms.lost_share) * rate, np.full(len(at), tag_fix_error_m(terms.survey_rmse_m))


def marker_fixes(rules: PlanRules, lane: Lane, markers: Sequence[PlannedMarker]) -> tuple[Floats, Floats]:
    """Probability of a fix by each of a lane's plates and tags, and its error [m]; 0 for other markers."""
    probability, error = np.zeros(len(markers)), np.full(len(markers), np.inf)
    at = np.array([marker.chainage_m for marker in markers])
    for kind, fixes in ((PlannedPlate, plate_fixes), (PlannedTag, tag_fixes)):
        own = np.array([isinstance(marker.detail, kind) for marker in markers], dtype=bool)
        if own.any():
            probability[own], error[own] = fixes(rules, lane, at[own])
    return probability, error


def _other_cost(alignment: Alignment, rules: PlanRules, *, path: bool) -> float:
    """Cost of the markers whose places are not sought, and of the day that whole days may take more."""
    price, rate = list_prices(rules), rules.costs.markers_per_day
    cost = price["day"] if rate else 0.0
    others = {"plates": None, "decision_points": None, "tags": None, **({"cerpm": None} if path else {})}
    left = rules.model_copy(update=others)
    if left.lines is None and left.cerpm is None:
        return cost
    count = plan_quantities(place_plan(alignment, left, name="costs"))
    cost += sum(price[unit] * (count[unit] or 0.0) for unit in _BY_NUMBER)
    return cost + (price["day"] * (count["marker"] or 0.0) / rate if rate else 0.0)
