"""All checks of a plan."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from app.geodesy import LocalizationGrade
from app.geodesy.frames import ecef_from_wgs84
from app.markers.magnet import MIN_GAP_M
from app.markers.plate import PlateGeometry
from app.markers.reading import Verdict
from app.planning.alignment import Lane
from app.planning.optimise.cover import window_rows
from app.planning.optimise.plan import marker_fixes
from app.planning.outputs.bill import plan_bill
from app.planning.plan import (
    Plan,
    PlanFinding,
    PlannedCerpm,
    PlannedLineMagnet,
    PlannedMarker,
    PlannedPlate,
    PlannedTag,
)
from app.planning.plan_checks.families import check_cerpms, check_magnets, check_plates, compare, radio_settings
from app.planning.predict.rates import line_rates, path_errors_m, plate_rates, tag_rates
from app.values import Floats

# === Predicted read rates of each family and path errors, in the circumstances that the rules name.


SOURCE = "models fitted to simulated drives on other roads: app/planning/data/predictions.json"
RateOf = Callable[[Lane, Floats], Floats]
_MIN_PAIRS = 3  # of a lane whose path is predicted; source: a spline needs more than two places


def check_predictions(plan: Plan) -> Iterator[PlanFinding]:
    """One finding for each camera and condition, for tags, for line magnets, and for the path."""
    yield from _plates(plan)
    terms = plan.rules.predictions
    distance_m, magnets = plan.rules.magnet_distance_m, plan.rules.tags.magnets if plan.rules.tags else 0
    deep = f"{terms.clearance_m:g} m, {distance_m:.3f} m above the magnets"
    for kind, what, rate_of in (
        (PlannedTag, "tags", lambda lane, at: tag_rates(lane, at, distance_m, magnets)),
        (PlannedLineMagnet, "line", lambda lane, at: line_rates(lane, at, distance_m)),
    ):
        markers = [marker for marker in plan.markers if isinstance(marker.detail, kind)]
        if markers:
            sentence = f"of {what if what == 'tags' else 'magnets of a line under the bar'} at a clearance of "
            yield _rate(plan, f"predicted-read-rate {what}", markers, _by_lane(plan, markers, rate_of),
                        f"{sentence}{deep}")  # fmt: skip
    yield from _path(plan)


def _plates(plan: Plan) -> Iterator[PlanFinding]:
    rules, terms = plan.rules.plates, plan.rules.predictions
    markers = [marker for marker in plan.markers if isinstance(marker.detail, PlannedPlate)]
    if rules is None or not markers:
        return
    geometry = PlateGeometry(rules.n, rules.unit_mm, rules.gap_mm, rules.thickness_mm)
    speeds = _by_lane(plan, markers, lambda lane, at: lane.value_at(lane.design_speed_m_s, at))
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


# === The required quality of an optimised plan against what is predicted for the markers as they were placed.


_ALMOST_SURE = 1 - 1e-9  # highest probability that counts; source: as app/planning/optimise/plan.py
_ROUNDING = 1e-6  # of probabilities; source: chainages are rounded when markers are placed


def check_quality(plan: Plan) -> Iterator[PlanFinding]:
    """Fixes in every stretch of `fix_every_m`, and the budget."""
    if plan.rules.quality is None or plan.optimum is None:
        return
    required = plan.optimum.quality
    markers = [marker for marker in plan.markers if isinstance(marker.detail, PlannedPlate | PlannedTag)]
    if plan.rules.plates is not None or plan.rules.tags is not None:
        least, error, place = _least_probability(plan, markers, required.fix_every_m, required.fix_error_m)
        sentence = (
            f"predicted probability that a pass fixes its position within {required.fix_error_m:g} m in every "
            f"{required.fix_every_m:g} m, in the worst stretch, which begins near here"
        )
        yield compare(
            "fix-probability", least, ">=", required.fix_probability - _ROUNDING, "probability", SOURCE, sentence, place
        )
        yield compare(
            "fix-error", error, "<=", required.fix_error_m, "m", SOURCE,
            "predicted standard error of the fixes that count", place,
        )  # fmt: skip
    if required.budget is not None:
        currency = plan.rules.costs.currency
        yield compare(
            "budget", plan_bill(plan).total, "<=", required.budget, currency, "quality.budget of the rules",
            f"cost of the plan; a fix every {required.fix_every_m:.1f} m is what the budget buys",
        )  # fmt: skip


def _least_probability(
    plan: Plan, markers: list[PlannedMarker], every_m: float, error_m: float
) -> tuple[float, float, PlannedMarker | None]:
    """Least probability of a fix in any stretch of any lane, greatest error of what counts, and a marker near it."""
    wanted = plan.rules.road.lanes or [lane.name for lane in plan.alignment.lanes]
    least, worst_error, place = math.inf, 0.0, None
    for name in dict.fromkeys(wanted):
        lane = plan.alignment.lane(name)
        own = sorted((marker for marker in markers if marker.lane == name), key=lambda marker: marker.chainage_m)
        probability, error = marker_fixes(plan.rules, lane, own)
        counts = error <= error_m
        gain = np.where(counts, -np.log1p(-np.clip(probability, 0.0, _ALMOST_SURE)), 0.0)
        worst_error = max(worst_error, float(error[counts].max(initial=0.0)))
        at = np.array([marker.chainage_m for marker in own])
        first, last = window_rows(at, every_m, lane.length_m)
        total = np.concatenate([[0.0], np.cumsum(gain)])
        found = total[last] - total[first]
        k = int(found.argmin())
        chance = -math.expm1(-float(found[k]))
        if chance < least:
            least = chance
            place = own[max(int(first[k]) - 1, 0)] if own else None
    return least, worst_error, place


# === Conflicts between markers of a plan, and with markers that are installed or planned.


CONFUSION_M = 20.0
"""Distance within which equal codes of two markers are confused. [m] A receiver's position in a street of houses."""
_ROOM_M = {"cerpm": 0.1, "magnet": MIN_GAP_M / 2}  # [m] half of the free distance round a marker; source: its size


@dataclass(frozen=True, slots=True)
class ExistingMarker:
    """A marker of the registry near the plan."""

    marker_id: str
    family: str
    code: str
    lon_deg: float
    lat_deg: float
    status: str
    radius_m: float = 0.25


def check_conflicts(plan: Plan, existing: Sequence[ExistingMarker]) -> Iterator[PlanFinding]:
    """Overlaps and equal codes, within the plan and with existing markers; registry numbers used twice."""
    if not plan.markers:
        return
    places, owners, room = _footprints(plan.markers)
    yield _overlaps(places, owners, room)
    yield _equal_codes(plan.markers)
    numbers = [(marker.family, marker.code) for marker in plan.markers if marker.family != "magnet"]
    yield compare(
        "unique-codes", len(numbers) - len(set(numbers)), "<=", 0, "markers", "docs/architecture.md",
        "plates and CERPMs whose code another marker of the plan has",
    )  # fmt: skip
    if existing:
        yield _existing_overlaps(places, owners, room, existing)
        yield _existing_codes(plan.markers, existing)


def _footprints(markers: Sequence[PlannedMarker]) -> tuple[Floats, list[PlannedMarker], Floats]:
    """Centres, their markers, and radii in which nothing else may be; a tag has one for each magnet."""
    lon, lat, room, owners = [], [], [], []
    for marker in markers:
        detail = marker.detail
        if isinstance(detail, PlannedTag):
            for _, magnet_lon, magnet_lat in detail.magnets:
                lon.append(magnet_lon)
                lat.append(magnet_lat)
                room.append(_ROOM_M["magnet"])
                owners.append(marker)
            continue
        lon.append(marker.lon_deg)
        lat.append(marker.lat_deg)
        if isinstance(detail, PlannedPlate):
            room.append(detail.geometry.side_mm / 2000 * math.sqrt(2))  # half a diagonal
        else:
            room.append(_ROOM_M[marker.family])
        owners.append(marker)
    return ecef_from_wgs84(np.array(lon), np.array(lat)), owners, np.array(room)


def _overlaps(places: Floats, owners: list[PlannedMarker], room: Floats) -> PlanFinding:
    """Pairs of markers of one plan that stand in each other's place."""
    pairs = scipy.spatial.cKDTree(places).query_pairs(2 * float(room.max()), output_type="ndarray")
    apart = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
    near = pairs[apart < room[pairs[:, 0]] + room[pairs[:, 1]] - 0.001]
    found = [(a, b) for a, b in near.tolist() if owners[a] is not owners[b]]
    names = ", ".join(f"{owners[a].number} and {owners[b].number}" for a, b in found[:3])
    sentence = f"markers that overlap: {names}" if found else "markers that overlap"
    return compare(
        "overlaps", len(found), "<=", 0, "pairs", "sizes of the markers; METRO figure 17a for magnets", sentence,
        owners[found[0][0]] if found else None,
    )  # fmt: skip


def _equal_codes(markers: Sequence[PlannedMarker]) -> PlanFinding:
    """Tags and plates of equal codes so near to each other that a vehicle cannot know which it read."""
    coded = [marker for marker in markers if not isinstance(marker.detail, PlannedLineMagnet)]
    groups: dict[tuple[str, str], list[PlannedMarker]] = {}
    for marker in coded:
        groups.setdefault((marker.family, marker.code), []).append(marker)
    found: list[tuple[PlannedMarker, PlannedMarker]] = []
    for group in groups.values():
        if len(group) > 1:
            points = ecef_from_wgs84(np.array([m.lon_deg for m in group]), np.array([m.lat_deg for m in group]))
            found += [(group[a], group[b]) for a, b in sorted(scipy.spatial.cKDTree(points).query_pairs(CONFUSION_M))]
    names = ", ".join(f"{a.number} and {b.number}" for a, b in found[:3])
    sentence = f"pairs of equal codes within {CONFUSION_M:g} m of each other" + (f": {names}" if found else "")
    return compare(
        "confusable-codes", len(found), "<=", 0, "pairs", "position uncertainty without markers", sentence,
        found[0][0] if found else None, missed=Verdict.WARN,
    )  # fmt: skip


def _existing_overlaps(
    places: Floats, owners: list[PlannedMarker], room: Floats, existing: Sequence[ExistingMarker]
) -> PlanFinding:
    points = _points(existing)
    distance, nearest = (np.asarray(found) for found in scipy.spatial.cKDTree(points).query(places))
    radius = np.array([marker.radius_m for marker in existing])
    over = np.flatnonzero(distance < room + radius[nearest])
    sentence = "planned markers that stand in the place of an installed or planned one"
    if len(over):
        first = existing[int(nearest[over[0]])]
        sentence += f": number {owners[int(over[0])].number} and the {first.status} {first.family} {first.marker_id}"
    return compare(
        "existing-markers", len(over), "<=", 0, "markers", "the registry", sentence,
        owners[int(over[0])] if len(over) else None,
    )  # fmt: skip


def _existing_codes(markers: Sequence[PlannedMarker], existing: Sequence[ExistingMarker]) -> PlanFinding:
    known: dict[tuple[str, str], list[ExistingMarker]] = {}
    for stored in existing:
        known.setdefault((stored.family, stored.code), []).append(stored)
    found = []
    for marker in markers:
        if isinstance(marker.detail, PlannedLineMagnet):
            continue
        for other in known.get((marker.family, marker.code), ()):
            if marker.family != "magnet" or _apart_m(marker, other) < CONFUSION_M:
                found.append((marker, other))
    sentence = "planned markers with the code of an installed or planned one"
    if found:
        sentence += f": number {found[0][0].number} and {found[0][1].marker_id}"
    return compare(
        "existing-codes", len(found), "<=", 0, "markers", "the registry", sentence, found[0][0] if found else None
    )


def _apart_m(marker: PlannedMarker, other: ExistingMarker) -> float:
    a = ecef_from_wgs84(np.array([marker.lon_deg, other.lon_deg]), np.array([marker.lat_deg, other.lat_deg]))
    return float(np.linalg.norm(a[0] - a[1]))


def _points(existing: Sequence[ExistingMarker]) -> Floats:
    return ecef_from_wgs84(np.array([m.lon_deg for m in existing]), np.array([m.lat_deg for m in existing]))


# === All checks of a plan.


def check_plan(plan: Plan, existing: Sequence[ExistingMarker] = ()) -> Plan:
    """The plan with the findings of all checks that apply to it, and the radio settings of its CERPMs.

    Parameters
    ----------
    existing : sequence of ExistingMarker
        Markers of the registry near the road.
    """
    plan = replace(plan, radio=radio_settings(plan))
    return replace(plan, findings=tuple(_findings(plan, existing)))


def _findings(plan: Plan, existing: Sequence[ExistingMarker]) -> Iterator[PlanFinding]:
    yield from _places(plan)
    yield from check_plates(plan)
    yield from check_magnets(plan)
    yield from check_cerpms(plan)
    yield from check_predictions(plan)
    yield from check_quality(plan)
    yield from check_conflicts(plan, existing)


def _places(plan: Plan) -> Iterator[PlanFinding]:
    missing = [left for left in plan.left_out if left.moved_m is None]
    yield compare(
        "placed", len(missing), "<=", 0, "places", "the rules of the plan",
        "places that the rules ask for and that have no marker" + (f"; first: {missing[0].reason}" if missing else ""),
        missed=Verdict.WARN,
    )  # fmt: skip
    unfit = plan.alignment.grade is LocalizationGrade.UNFIT
    yield compare(
        "positions", float(unfit), "<=", 0, "roads", "docs/decisions/0003-positions.md",
        "the road is placed by an origin or without a stated accuracy: survey the markers before they localize"
        if unfit
        else "the road's reference system has a stated accuracy",
        missed=Verdict.WARN,
    )  # fmt: skip
