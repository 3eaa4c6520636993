"""The cheapest spacing and mix of families that has a required quality, or the best quality within a budget."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from app.errors import InvalidParameter
from app.markers.plate import PlateGeometry
from app.planning.alignment import Alignment, Lane, format_station
from app.planning.optimise.cover import (
    cheapest_cover,
    even_pairs,
    even_places,
    fewest_pairs,
    least_gain,
    middles,
    replace_every,
    uncovered_m,
)
from app.planning.outputs.bill import plan_quantities
from app.planning.placement import place_plan
from app.planning.placement.sites import AvoidedAreas, covered_by_tags_m, place_plates, place_tags
from app.planning.plan import PlannedMarker, PlannedPlate, PlannedTag, Purpose, TradeOffPoint
from app.planning.predict.rates import plate_fix_error_m, plate_rates, tag_fix_error_m, tag_fix_share, tag_rates
from app.planning.rules import PlanRules, Quality, marking_rules
from app.values import Floats

# === Costs of sites by the agency's unit costs.


def site_costs(rules: PlanRules) -> dict[str, float]:
    """Cost of one site of each family that the rules place, from the agency's unit costs: a tag with its magnets and
    their holes or shells, a pair of CERPMs; days by the rate.

    Raises
    ------
    InvalidParameter
        A family has no unit cost.
    """
    price = list_prices(rules)
    each = price["marker"] + (price["day"] / rules.costs.markers_per_day if rules.costs.markers_per_day else 0.0)
    costs = {}
    if rules.plates is not None:
        costs["plate"] = price["plate"] + each
    if rules.tags is not None:
        fixed_by = "shell" if rules.installation.on_surface else "hole"
        costs["magnet"] = price["tag"] + rules.tags.magnets * (price["magnet"] + price[fixed_by]) + each
    if rules.cerpm is not None:
        sides = 2 if rules.cerpm.sides == "both" else 1
        costs["cerpm"] = sides * (price["cerpm"] + each)
    for family, cost in costs.items():
        if cost <= 0:
            raise InvalidParameter(
                f"there is no unit cost for the family {family}",
                field="costs.items",
                limit="a positive cost of each family that the rules place",
                cure=f"add a price per {'magnet or tag' if family == 'magnet' else family}, or per marker",
            )
    return costs


def list_prices(rules: PlanRules) -> dict[str, float]:
    """Sum of the agency's prices by what they are per."""
    prices: defaultdict[str, float] = defaultdict(float)
    for item in rules.costs.items:
        prices[item.per] += item.price
    return prices


# === The cheapest spacing and mix of families that has a required quality, or the best quality within a budget.


FixModel = Callable[[Lane, Floats], tuple[Floats, Floats]]
"""Probability that a pass fixes the position at markers at chainages of a lane, and the standard error of the fix [m];
both of the shape of the chainages."""

_CANDIDATES_PER_WINDOW = 20  # where one marker is enough; a marker is at most 5 % early
_COUPLED_PER_WINDOW = 10  # where misses add up; source: as `cover._SECTION_WINDOWS`
_FINEST_M = 1.0  # [m] between candidates; as the samples of lanes
_NEAREST_FIXES_M = 5.0  # [m] of `fix_every_m` that a budget may buy; the least spacing of plates
_BISECTIONS = 12  # source: 5 m to 5,000 m in steps of 0.2 %
_FACTORS = (1.0, 0.5, 0.71, 1.41, 2.0)  # on the requirement, in the table
_ALMOST_SURE = 1 - 1e-9  # highest probability of a fix that counts; for a finite logarithm


@dataclass(frozen=True, slots=True)
class FamilyModel:
    """What one site of a family costs, and what it does for a vehicle."""

    family: str  # ``plate``, ``magnet`` (an information tag) or ``cerpm`` (a pair, one on each side)
    cost: float  # of a site, in the currency of the rules (see `site_costs`)
    # None: it fixes no position, and serves the path or an event only. Where no family fixes positions, only the path
    # is optimised.
    fix: FixModel | None
    # whether places may be chosen; if not, those ahead of events count as fixes, and no others are
    selectable: bool = True


@dataclass(frozen=True, slots=True)
class ChosenSite:
    """A chosen place; `purpose` is ``fix``, ``path`` or ``event``."""

    lane: str
    chainage_m: float
    family: str
    purpose: str


@dataclass(frozen=True, slots=True)
class OptimisedPlan:
    """Chosen places and what they cost."""

    quality: Quality  # as required; `fix_every_m` is the best that the budget buys, where there is one
    sites: tuple[ChosenSite, ...]  # by lane and chainage
    cost: float  # with what does not depend on the number of markers
    bound: float  # no plan with the same pairs along the path and the same markers ahead of events is cheaper
    table: tuple[TradeOffPoint, ...]  # other requirements; the required one among them
    sought: tuple[tuple[str, str], ...] = ()  # lanes and families whose places were sought

    @property
    def counts(self) -> dict[str, int]:
        """Sites by family."""
        return dict(sorted(Counter(site.family for site in self.sites).items()))

    @property
    def places(self) -> dict[tuple[str, str], tuple[float, ...]]:
        """Chainages by lane and family as `place_plan` takes them; it places what stands ahead of events itself. [m]

        Each family whose places were sought is among them, also where none was needed. Tags that were chosen as fixes
        are too, and `place_plan` refuses them: they have no event to announce.
        """
        found: defaultdict[tuple[str, str], list[float]] = defaultdict(list, {key: [] for key in self.sought})
        for site in self.sites:
            if site.purpose != "event":
                found[site.lane, site.family].append(site.chainage_m)
        return {key: tuple(chainages) for key, chainages in found.items()}


def optimise_plan(
    alignment: Alignment, rules: PlanRules, models: Sequence[FamilyModel], *, other_cost: float = 0.0
) -> OptimisedPlan:
    """The cheapest sites that have the quality of the rules, or the best ones within its budget.

    Parameters
    ----------
    rules : PlanRules
        With `quality`. Decision points and events keep their markers; their cost is included, and they count as fixes.
    models : sequence of FamilyModel
        Of the families that may be used, each at most once.
    other_cost : float
        Of markers that stand in any case, such as line magnets, in the currency of the rules.

    Returns
    -------
    OptimisedPlan

    Raises
    ------
    InvalidParameter
        The rules require no quality, or a path error without CERPMs; no markers have the quality somewhere; or the
        budget is below the cheapest plan.

    Notes
    -----
    Quality: in every stretch of `fix_every_m` of a lane, a pass fixes its position with `fix_probability` from markers
    whose error is at most `fix_error_m`. Misses are independent, so -ln(1 - p) adds up to at least -ln(1 - q).
    The pairs that `path_error_m` asks for are chosen first, as few as found; then the cheapest fixes are added
    (`cheapest_cover`), for which those pairs and the markers ahead of events count without further cost. Lanes are
    independent: a line between two lanes is paid for twice, which is too much rather than too little.
    """
    quality = rules.quality
    if quality is None:
        raise InvalidParameter(
            "the rules require no quality",
            field="quality",
            limit="needed to optimise",
            cure="add quality with fix_every_m, fix_probability and fix_error_m, or a budget",
        )
    optimiser = _Optimiser(alignment, rules, models, other_cost)
    optimiser.prepare(quality.path_error_m)
    if quality.budget is not None:
        quality = optimiser.best_within(quality, quality.budget)
    sites, cost, bound = optimiser.solve(quality)
    return OptimisedPlan(quality, tuple(sites), cost, bound, optimiser.table(quality), optimiser.sought(quality))


class _Optimiser:
    """Lanes with their candidates; results are kept, because the table and the budget ask for many requirements."""

    def __init__(
        self, alignment: Alignment, rules: PlanRules, models: Sequence[FamilyModel], other_cost: float
    ) -> None:
        wanted = set(rules.road.lanes or [lane.name for lane in alignment.lanes])
        self.lanes = [lane for lane in alignment.lanes if lane.name in wanted]
        self.rules = rules
        self.models = {model.family: model for model in models}
        self._alignment = alignment
        self._areas = AvoidedAreas(alignment, rules.avoid)
        self._found: defaultdict[str, list[tuple[float, list[float]]]] = defaultdict(list)
        self._impossible: dict[tuple[str, float], InvalidParameter] = {}
        price = list_prices(rules)
        lanes_m = sum(lane.length_m for lane in self.lanes)
        self.fixed_cost = price["plan"] + price["metre_of_lane"] * lanes_m + other_cost
        self._fixing = [model for model in models if model.fix is not None]

    def sought(self, quality: Quality) -> tuple[tuple[str, str], ...]:
        """Lanes and families whose places are sought for a quality."""
        families = {model.family for model in self._fixing if model.selectable}
        if quality.path_error_m is not None:
            families.add("cerpm")
        return tuple((lane.name, family) for lane in self.lanes for family in sorted(families))

    def solve(self, quality: Quality) -> tuple[list[ChosenSite], float, float]:
        """Sites of all lanes, their cost, and its bound."""
        sites: list[ChosenSite] = []
        bound = self.fixed_cost
        for lane in self.lanes:
            own, saved = self._solve_lane(lane, quality)
            sites += own
            bound += sum(self.models[site.family].cost for site in own) - saved
        cost = self.fixed_cost + sum(self.models[site.family].cost for site in sites)
        return sites, cost, bound

    def best_within(self, quality: Quality, budget: float) -> Quality:
        """The quality with the shortest distance between fixes that a budget buys."""
        high = math.log(max(lane.length_m for lane in self.lanes))
        widest = replace_every(quality, math.exp(high))
        least = self.solve(widest)[1]
        if least > budget:
            raise InvalidParameter(
                f"the cheapest plan costs {least:,.2f} {self.rules.costs.currency}",
                field="quality.budget",
                limit=f"at least {least:,.2f}",
                cure="raise the budget, or require less of the path, the events or the fixes",
            )
        best, low = widest, math.log(_NEAREST_FIXES_M)
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            tried = replace_every(quality, math.exp(middle))
            try:
                affordable = self.solve(tried)[1] <= budget
            except InvalidParameter:  # there are no such places on the road at any price
                affordable = False
            if affordable:
                best, high = tried, middle
            else:
                low = middle
        return best

    def table(self, quality: Quality) -> tuple[TradeOffPoint, ...]:
        """Costs of requirements around one, those that can be met."""
        wanted = [replace_every(quality, quality.fix_every_m * factor) for factor in _FACTORS]
        if quality.path_error_m is not None:
            paths = [quality.path_error_m * factor for factor in _FACTORS if factor != 1.0]
            wanted += [quality.model_copy(update={"path_error_m": error}) for error in paths]
        points = []
        for asked in wanted:
            try:
                sites, cost, bound = self.solve(asked)
            except InvalidParameter:
                continue
            counts = tuple(sorted(Counter(site.family for site in sites).items()))
            point = TradeOffPoint(asked.fix_every_m, asked.path_error_m, cost, bound, self.even_cost(asked), counts)
            points.append(point)
        return tuple(points)

    def even_cost(self, quality: Quality) -> float | None:
        """Cost of even spacing, in each lane of the family that is cheapest there; areas to avoid are not regarded."""
        total = self.fixed_cost
        for lane in self.lanes:
            cost = self._even_cost_of(lane, quality)
            if cost is None:
                return None
            total += cost
        return total

    def _solve_lane(self, lane: Lane, quality: Quality) -> tuple[list[ChosenSite], float]:
        """Sites of a lane by chainage, and by how much its cost is above the bound."""
        kept = self._kept(lane, quality)
        if not self._fixing:
            return sorted(kept, key=lambda site: site.chainage_m), 0.0
        need = -math.log1p(-quality.fix_probability)
        chainage, cost, gain, family = self._candidates(lane, quality, need, kept)
        missing = uncovered_m(chainage, gain, need, quality.fix_every_m, lane.length_m)
        if missing is not None:
            raise self._unreachable(lane, missing, quality)
        found = cheapest_cover(chainage, cost, gain, need=need, window_m=quality.fix_every_m, length_m=lane.length_m)
        chosen = [
            ChosenSite(lane.name, float(chainage[k]), family[k], "fix") for k in found.chosen.tolist() if cost[k] > 0
        ]
        spent = found.cost
        if not found.is_optimal and (even := self._cheaper_even(lane, quality, kept, spent)) is not None:
            chosen, spent = even
        return sorted([*kept, *chosen], key=lambda site: site.chainage_m), spent - found.bound

    def _cheaper_even(
        self, lane: Lane, quality: Quality, kept: Sequence[ChosenSite], below: float
    ) -> tuple[list[ChosenSite], float] | None:
        """Sites of one family at even distances and their cost, where they may stand and cost less than found."""
        best, rows = None, self._kept_rows(lane, kept, quality)
        for model in self._fixing:
            count = self._even_count(lane, model, quality, rows) if model.selectable else None
            if count is None or count * model.cost >= below - 1e-9:
                continue
            at = even_places(lane, count)
            if self._clear(lane, at, model.family).all():
                below = count * model.cost
                best = [ChosenSite(lane.name, x, model.family, "fix") for x in at.tolist()], below
        return best

    def _unreachable(self, lane: Lane, from_m: float, quality: Quality) -> InvalidParameter:
        """What is possible where the required quality is not."""
        to_m = min(from_m + quality.fix_every_m, lane.length_m)
        at = np.arange(from_m, to_m + 1e-9, _FINEST_M)
        possible = []
        for model in self._fixing:
            assert model.fix is not None
            chance, error = model.fix(lane, at)
            possible.append(f"a {model.family} fixes it with {chance.max():.4g} and an error of {error.min():.3f} m")
        return InvalidParameter(
            f"on lane {lane.name} no markers fix the position with {quality.fix_probability:.4g} between "
            f"{format_station(from_m)} and {format_station(to_m)}",
            field="quality",
            limit=f"an error of at most {quality.fix_error_m:g} m outside of avoided areas; there, at best "
            + "; ".join(possible),
            cure="require less there: a larger fix_error_m or fix_every_m, a lower fix_probability, or another family",
        )

    def _kept(self, lane: Lane, quality: Quality) -> list[ChosenSite]:
        """Sites that are needed for other reasons than fixes: pairs of the path, markers ahead of events."""
        sites = [ChosenSite(lane.name, at, "cerpm", "path") for at in self._pairs(lane, quality.path_error_m)]
        if self.rules.plates is not None and "plate" in self.models:
            plates, _ = place_plates(self._alignment, lane, self.rules)
            points = [site for site in plates if site.purpose is Purpose.DECISION_POINT]
            sites += [ChosenSite(lane.name, site.chainage_m, "plate", "event") for site in points]
        if self.rules.tags is not None and "magnet" in self.models:
            tags, _ = place_tags(self._alignment, lane, self.rules.tags)
            sites += [ChosenSite(lane.name, site.chainage_m, "magnet", "event") for site in tags]
        return sites

    def prepare(self, path_error_m: float | None) -> None:
        """Find pairs for all path errors of the table, because few pairs may be found for a stricter error first."""
        if path_error_m is None:
            return
        if self.rules.cerpm is None or "cerpm" not in self.models:
            raise InvalidParameter(
                "a path error is required, but no CERPMs may be placed",
                field="quality.path_error_m",
                limit="needs cerpm in the rules, and its costs",
                cure="add cerpm to the rules, or leave path_error_m out",
            )
        for lane in self.lanes:
            allowed = self._clear(lane, lane.chainage_m, "cerpm")
            for factor in _FACTORS:
                error_m = path_error_m * factor
                try:
                    found = fewest_pairs(lane, error_m, max_spacing_m=self._max_pairs_m(), allowed=allowed)
                except InvalidParameter as error:
                    self._impossible[lane.name, error_m] = error
                else:
                    self._found[lane.name].append((error_m, found.tolist()))

    def _pairs(self, lane: Lane, path_error_m: float | None) -> list[float]:
        """Chainages of the fewest pairs of a lane's path that stay within an error; none where none is required. [m]"""
        if path_error_m is None:
            return []
        enough = [pairs for error_m, pairs in self._found[lane.name] if error_m <= path_error_m]
        if not enough:
            raise self._impossible[lane.name, path_error_m]
        return min(enough, key=len)

    def _max_pairs_m(self) -> float:
        """Greatest distance between pairs: that of the rules on straights. [m]"""
        rules = self.rules.cerpm
        assert rules is not None
        return rules.straight * (rules.n_m or marking_rules(rules.marking_rules).cycle_m)

    def _candidates(
        self, lane: Lane, quality: Quality, need: float, kept: Sequence[ChosenSite]
    ) -> tuple[Floats, Floats, Floats, list[str]]:
        """Chainage, cost, gain and family of the candidates by chainage; kept sites cost nothing more."""
        step = max(quality.fix_every_m / _CANDIDATES_PER_WINDOW, _FINEST_M)
        gains = self._gains(lane, middles(lane, step), quality)
        if not all(np.all((gain == 0) | (gain >= need)) for gain in gains.values()):
            step = max(quality.fix_every_m / _COUPLED_PER_WINDOW, _FINEST_M)
        at = middles(lane, step)
        rows: list[tuple[float, float, float, str]] = []
        for family, gain in self._gains(lane, at, quality).items():
            if not self.models[family].selectable:
                continue
            usable = (gain > 0) & self._clear(lane, at, family)
            price = self.models[family].cost
            rows += [(x, price, g, family) for x, g in zip(at[usable].tolist(), gain[usable].tolist(), strict=True)]
        rows += self._kept_rows(lane, kept, quality)
        rows.sort(key=lambda row: (row[0], row[3], row[1]))
        values = np.array([row[:3] for row in rows], dtype=float).reshape(-1, 3)
        return values[:, 0], values[:, 1], values[:, 2], [row[3] for row in rows]

    def _kept_rows(
        self, lane: Lane, kept: Sequence[ChosenSite], quality: Quality
    ) -> list[tuple[float, float, float, str]]:
        rows: list[tuple[float, float, float, str]] = []
        for family in {site.family for site in kept}:
            at = np.array([site.chainage_m for site in kept if site.family == family])
            gain = self._gains(lane, at, quality).get(family, np.zeros(len(at)))
            rows += [(x, 0.0, g, family) for x, g in zip(at.tolist(), gain.tolist(), strict=True) if g > 0]
        return rows

    def _gains(self, lane: Lane, at: Floats, quality: Quality) -> Mapping[str, Floats]:
        """-ln(1 - p) of each family that fixes positions, 0 where its error is too large, each of shape (K,)."""
        gains = {}
        for family, model in self.models.items():
            if model.fix is None:
                continue
            probability, error = model.fix(lane, at)
            gain = -np.log1p(-np.clip(probability, 0.0, _ALMOST_SURE))
            gains[family] = np.where(error <= quality.fix_error_m, gain, 0.0)
        return gains

    def _clear(self, lane: Lane, at: Floats, family: str) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Whether a marker of a family may stand at chainages."""
        clear = np.ones(len(at), dtype=bool)
        half = lane.value_at(lane.width_m, at) / 2
        for offset in (half, -half) if family == "cerpm" else (np.zeros(len(at)),):
            clear &= self._areas.find(*lane.position_at(at, offset)) < 0
        if family == "plate" and self.rules.plates is not None:
            for first_m, last_m in covered_by_tags_m(self._alignment, lane, self.rules):
                clear &= (at <= first_m) | (at >= last_m)
            clear &= np.abs(lane.value_at(lane.grade, at)) <= self.rules.plates.max_grade
        return clear

    def _even_cost_of(self, lane: Lane, quality: Quality) -> float | None:
        kept = [site for site in self._kept(lane, quality) if site.purpose == "event"]
        if self._pairs(lane, quality.path_error_m):
            assert quality.path_error_m is not None
            try:
                pairs = even_pairs(lane, quality.path_error_m, max_spacing_m=self._max_pairs_m())
            except InvalidParameter:
                return None
            kept += [ChosenSite(lane.name, at, "cerpm", "path") for at in pairs.tolist()]
        base = sum(self.models[site.family].cost for site in kept)
        rows = self._kept_rows(lane, kept, quality)
        if not self._fixing:
            return base
        costs = [
            base + count * model.cost
            for model in self._fixing
            if model.selectable and (count := self._even_count(lane, model, quality, rows)) is not None
        ]
        return min(costs, default=None)

    def _even_count(
        self, lane: Lane, model: FamilyModel, quality: Quality, rows: Sequence[tuple[float, float, float, str]]
    ) -> int | None:
        """Fewest sites of one family at even distances, beside those of the rows; to half a percent."""
        need = -math.log1p(-quality.fix_probability)
        count, most = 0, int(lane.length_m / _FINEST_M)
        while count <= most:
            at = even_places(lane, count)
            chainage = np.concatenate([at, [row[0] for row in rows]])
            gain = np.concatenate([self._gains(lane, at, quality)[model.family], [row[2] for row in rows]])
            order = np.argsort(chainage, kind="stable")
            if least_gain(chainage[order], gain[order], quality.fix_every_m, lane.length_m) >= need - 1e-9:
                return count
            count += max(1, count // 200)
        return None


# === The families of rules as the optimiser takes them: costs of the agency, and fixes as the checks predict them.


_BY_NUMBER = ("magnet", "hole", "shell", "cerpm", "marker")  # units of the costs of markers whose places are not sought


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
    speeds = lane.value_at(lane.design_speed_m_s, at)
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
    assert rules.tags is not None
    terms = rules.predictions
    rate = tag_fix_share() * tag_rates(lane, at, rules.magnet_distance_m, rules.tags.magnets)
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
