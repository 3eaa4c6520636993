"""Places the markers of a plan, family by family and lane by lane."""

from __future__ import annotations

import math
import zlib
from collections import defaultdict
from collections.abc import Callable, Collection, Container, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy
from pyproj import Geod

from app.encoders.magnet.codebook import CodebookFull, CodebookRules, allocate_codes
from app.errors import InvalidParameter
from app.formats.alignments.geometry import BoundaryStyle
from app.geodesy.frames import ecef_from_wgs84
from app.markers.cerpm import MAX_SPEED_LIMIT, LaneSide, SpeedLimit
from app.markers.magnet import InformationTag, LineTag, Polarity
from app.markers.magnet_design import Codebook, Meaning, TagDesign
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme
from app.planning.alignment import Alignment, Lane
from app.planning.magnet_checks import served_distance_m, vehicle_clearances
from app.planning.placement.sites import AvoidedAreas, Boundaries, Site, place_line_magnets, place_plates, place_tags
from app.planning.plan import (
    Detail,
    LeftOut,
    Plan,
    PlannedCerpm,
    PlannedLineMagnet,
    PlannedMarker,
    PlannedPlate,
    PlannedTag,
    Purpose,
)
from app.planning.rules import CerpmRules, PlanRules, PlateRules, TagRules, marking_rules
from app.values import Floats

# === Codes of a plan's markers: unused registry numbers, and tags of one codebook.


NumberSource = Callable[[int], Sequence[int]]
"""Returns as many unused registry numbers as are asked for, each only once."""
MAX_SPEED_M_S = 70.0
"""Highest speed of a codebook's conditions. [m/s] Source: `ReadingConditions`."""
_NUMBERS = 2**32  # source: four bytes of a CERPM's message and eight data symbols of an id plate


def unused_numbers(taken: Collection[int], seed: int) -> NumberSource:
    """A source of registry numbers from 1 to 2^32 - 1 that are not taken; the same seed gives the same numbers."""
    used = set(taken)
    rng = np.random.default_rng(seed)

    def draw(count: int) -> list[int]:
        numbers: list[int] = []
        while len(numbers) < count:
            for number in rng.integers(1, _NUMBERS, count - len(numbers)).tolist():
                if number not in used:
                    used.add(number)
                    numbers.append(number)
        return numbers

    return draw


def plate_codes(
    rules: PlateRules, lon_deg: Sequence[float], lat_deg: Sequence[float], numbers: NumberSource
) -> list[PlateCode]:
    """Codes of plates at positions: their decimals, or registry numbers."""
    if rules.scheme is PlateScheme.ID:
        return [PlateCode.from_registry_number(number, n=rules.n) for number in numbers(len(lon_deg))]
    return [
        PlateCode.from_position(lon, lat, n=rules.n, scheme=rules.scheme)
        for lon, lat in zip(lon_deg, lat_deg, strict=True)
    ]


def tag_codes(
    rules: TagRules, meanings: Sequence[Meaning], book: Codebook | None, name: str, reading: CodebookRules
) -> tuple[Codebook, dict[Meaning, InformationTag]]:
    """A codebook with all meanings, and the tag of each; codes that the book has stay as they are.

    Parameters
    ----------
    reading : CodebookRules
        Conditions in which the codes must be read, as `tag_conditions` has them.

    Raises
    ------
    InvalidParameter
        The codebook has another design than the rules, or the design has fewer codes than meanings.
    """
    design = TagDesign(rules.magnets, rules.length_m, rules.segment_m)
    if book is None:
        book = Codebook(name, design)
    elif book.design != design:
        raise InvalidParameter(
            f"the codebook {book.name!r} has tags of {book.design.magnets} magnets on {book.design.length_m:g} m",
            field="tags",
            limit=f"{design.magnets} magnets, {design.length_m:g} m, segments of {design.segment_m:g} m",
            cure="use the design of the codebook in the rules, or another codebook",
        )
    known = {meaning for _tag, meaning in book.entries}
    new = [meaning for meaning in dict.fromkeys(meanings) if meaning not in known]
    try:
        book = allocate_codes(book, new, reading)
    except CodebookFull as error:
        raise InvalidParameter(
            f"the tags of the plan have {len(known | set(meanings))} meanings: {error.message}",
            field="tags.magnets",
            limit=error.limit,
            cure="use more magnets or a longer tag (tags.size: freeway), or announce fewer kinds of events",
        ) from error
    return book, {meaning: tag for tag, meaning in book.entries}


def tag_conditions(rules: PlanRules, alignment: Alignment) -> CodebookRules:
    """Conditions in which the codes of tags must be read: highest design speed, and largest distance to the magnets.

    Not below those of METRO's tests, 30 mph and 30 cm. The distance is that of the kind of vehicle to be served, and of
    the predictions.
    """
    usual = CodebookRules()
    distance_m = usual.clearance_m + max(rules.installation.depth_m, 0.0)
    if rules.tags is not None and rules.tags.clearance_class in vehicle_clearances():
        distance_m = max(distance_m, served_distance_m(rules.tags.clearance_class, rules.installation))
    lanes = _chosen_lanes(alignment, rules)
    speed_m_s = max(usual.speed_m_s, *(float(lane.design_speed_m_s.max()) for lane in lanes))
    return replace(usual, speed_m_s=min(speed_m_s, MAX_SPEED_M_S), clearance_m=max(distance_m, rules.magnet_distance_m))


# === Places of CERPMs on the boundaries of a lane: by the cycle of the markings, closer where the path asks for it.


MIN_SPACING_M = 2.0
"""Least distance between pairs that the path error may ask for. [m] A sixth of a cycle."""
_ROUNDS = 6  # of halving the distances; source: from 36 m to below the least distance
_ROOM_M = 0.4  # [m] between a CERPM and a line magnet; source: half of a CERPM and half of METRO figure 17a's 0.5 m
_CLEAR_REACH_M = 2.0  # [m] within which another place is sought; a third of the magnets' 6 m
_ONE_PLACE_M = 1.0  # [m] between markers of a pair along the lane; source: half of `MIN_SPACING_M`
_BEND_REACH_M = 6.0  # [m] before and after a bend; source: half of N, as in app/planning/cerpm_placement.py
_TAPER = (
    0.01  # change of width over length from which it is a transition; source: a taper of W S feet at mph, MUTCD 2009
)
# (3B.09, 6C.08), is 1 in 75 at 75 mph


def place_cerpms(lane: Lane, rules: CerpmRules, cycle_m: float, curve_radius_m: float) -> Floats:
    """Chainages of a lane's pairs, both ends among them, shape (K,). [m]

    Notes
    -----
    Straights have `straight` cycles between pairs; bends, and transitions where the lane's width changes, `curve`
    cycles. Then pairs are added in the middle of every gap in which a cubic spline through the pairs leaves the lane by
    more than `max_path_error_m`.

    Positioning guides are 2 N apart, and N or less on sharp curves and on transitions that reduce lanes or shift
    traffic: MUTCD 2009, sections 3B.11 and 3B.12 (2023: 3B.14 and 3B.15).
    """
    chainages = _by_cycle(lane, rules, cycle_m, curve_radius_m)
    if rules.max_path_error_m is None:
        return chainages
    for _ in range(_ROUNDS):
        error = path_error_m(lane, chainages)
        gap = np.clip(np.searchsorted(chainages, lane.chainage_m, side="right") - 1, 0, len(chainages) - 2)
        worst = np.zeros(len(chainages) - 1)
        np.maximum.at(worst, gap, np.abs(error))
        split = (worst > rules.max_path_error_m) & (np.diff(chainages) >= 2 * MIN_SPACING_M)
        if not split.any():
            break
        middles = (chainages[:-1] + chainages[1:])[split] / 2
        chainages = np.sort(np.concatenate([chainages, middles]))
    return chainages


def path_error_m(lane: Lane, chainages_m: Floats, shifts_m: Floats | None = None) -> Floats:
    """Distance of a cubic spline through the lane's pairs from its centre line at the lane's samples, shape (N,). [m]

    Parameters
    ----------
    chainages_m : ndarray, shape (K,)
        Of all markers. [m]
    shifts_m : ndarray, shape (K,), optional
        How far each is left of its boundary; the mean of a pair moves the path. [m]

    Notes
    -----
    Source: exact markers and a cubic spline, as in the CERPM paper's section 2.3; the change of curvature and the ends
    decide. Two or three pairs are joined by a straight line or a parabola.
    """
    chainages_m, shift_m = one_of_each_pair(chainages_m, shifts_m)
    knots = ecef_from_wgs84(*lane.position_at(chainages_m, shift_m))
    truth = ecef_from_wgs84(lane.lon_deg, lane.lat_deg)
    origin = truth[0]
    if len(chainages_m) < 4:
        degree = len(chainages_m) - 1
        fits = [np.polyfit(chainages_m, (knots - origin)[:, k], degree) for k in range(3)]
        path = np.stack([np.polyval(fit, lane.chainage_m) for fit in fits], 1)
    else:
        path = scipy.interpolate.CubicSpline(chainages_m, knots - origin)(lane.chainage_m)
    away = path - (truth - origin)
    tangent = np.gradient(truth, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    across = away - np.einsum("ij,ij->i", away, tangent)[:, None] * tangent
    return np.asarray(np.linalg.norm(across, axis=1))


def beside_magnets(lane: Lane, cerpms: Sequence[Site], magnets: Sequence[Site]) -> list[Site]:
    """CERPMs moved along the lane where they would stand on a line magnet, so far that there is room for both.

    The markers of a pair move together: vehicles take the line across a pair as square to the lane, and one that is
    0.8 m ahead of the other doubled the path's error in simulated drives.
    """
    taken = {side: np.array([m.chainage_m for m in magnets if m.side is side]) for side in LaneSide}
    sides: dict[float, set[LaneSide]] = defaultdict(set)
    for site in cerpms:
        sides[site.chainage_m].add(site.side)
    places = {
        at: _clear_place(lane, at, np.concatenate([taken[side] for side in sorted(own)])) for at, own in sides.items()
    }
    return [replace(site, chainage_m=places[site.chainage_m]) for site in cerpms]


def _clear_place(lane: Lane, chainage_m: float, taken_m: Floats) -> float:
    """The nearest place along the lane that is far enough from all magnets; the same place if there is none. [m]"""
    near = taken_m[np.abs(taken_m - chainage_m) < _CLEAR_REACH_M]
    tried = np.concatenate([[chainage_m], near + _ROOM_M, near - _ROOM_M])
    room = np.abs(tried[:, None] - near).min(axis=1, initial=np.inf) >= _ROOM_M - 1e-9
    clear = tried[room & (tried >= 0.0) & (tried <= lane.length_m)]
    return float(clear[np.argmin(np.abs(clear - chainage_m))]) if len(clear) else chainage_m


def one_of_each_pair(chainages_m: Floats, shifts_m: Floats | None) -> tuple[Floats, Floats]:
    """Rising chainages without those that follow another one within a metre, and the mean shift at each.

    Both sides of a pair are one place.
    """
    order = np.argsort(chainages_m)
    rising = chainages_m[order]
    is_first = np.diff(rising, prepend=-np.inf) > _ONE_PLACE_M
    if shifts_m is None:
        return np.asarray(rising[is_first]), np.zeros(int(is_first.sum()))
    place = np.cumsum(is_first) - 1
    return np.asarray(rising[is_first]), np.asarray(np.bincount(place, shifts_m[order]) / np.bincount(place))


def _by_cycle(lane: Lane, rules: CerpmRules, cycle_m: float, curve_radius_m: float) -> Floats:
    """Chainages between which the integral of the density is one; stretched so that both ends have a pair."""
    straight_m, curve_m = rules.straight * cycle_m, rules.curve * cycle_m
    reach = max(round(_BEND_REACH_M / lane.step_m), 1)
    taper = np.abs(np.gradient(lane.width_m, lane.chainage_m)) > _TAPER
    bends = (np.abs(lane.curvature_per_m) > 1 / curve_radius_m) | taper
    close = scipy.ndimage.maximum_filter1d(bends.astype(np.int8), 2 * reach + 1, mode="constant") > 0
    density = np.where(close, 1 / min(curve_m, straight_m), 1 / straight_m)
    steps = np.diff(lane.chainage_m) * (density[1:] + density[:-1]) / 2
    count = np.concatenate([[0.0], np.cumsum(steps)])
    pairs = max(math.ceil(count[-1] - 1e-6), 1) + 1
    return np.asarray(np.interp(np.linspace(0.0, count[-1], pairs), count, lane.chainage_m))


# === Places the markers of a plan, family by family and lane by lane.


MAX_MARKERS = 500_000
"""Markers of one plan at most. Ten times those of 100 km with all families."""
ChosenPlaces = Mapping[tuple[str, str], Sequence[float]]
"""Chainages by the name of the lane and the family, increasing. [m]"""
_GEOD = Geod(ellps="WGS84")
_KMH = 3.6  # [km/h per m/s]


def place_plan(
    alignment: Alignment,
    rules: PlanRules,
    *,
    name: str,
    codebook: Codebook | None = None,
    numbers: NumberSource | None = None,
    chosen: ChosenPlaces | None = None,
) -> Plan:
    """Place the markers that rules ask for on an alignment, with their codes.

    Parameters
    ----------
    codebook : Codebook, optional
        Of the agency, whose codes stay; a new one without.
    numbers : NumberSource, optional
        Unused registry numbers; without, numbers drawn from the plan's name, the same ones every time.
    chosen : ChosenPlaces, optional
        Chainages of the plates and of the pairs of CERPMs on lanes, instead of the spacings of the rules; plates at
        decision points come on top. See `OptimisedPlan.places`.

    Returns
    -------
    Plan
        Without findings: `check_plan` adds them. The same input gives the same plan.

    Raises
    ------
    InvalidParameter
        The rules do not apply to the road, contradict each other, or the tags have more meanings than codes.
    """
    lanes = _chosen_lanes(alignment, rules)
    _check_applies(lanes, rules)
    if any(family not in ("plate", "cerpm") for _, family in chosen or ()):
        raise InvalidParameter(
            "places of information tags are chosen",
            field="chosen",
            limit="plates and CERPMs",
            cure="leave the tags out, because their codes are of the events that they are ahead of",
        )
    numbers = numbers or unused_numbers((), zlib.crc32(name.encode()))
    placer = _Placer(alignment, rules, numbers, chosen)
    for lane in lanes:
        placer.place(lane)
    markers, book = placer.finish(lanes, codebook, name)
    if len(markers) > MAX_MARKERS:
        raise InvalidParameter(
            f"the plan has {len(markers)} markers",
            field="rules",
            limit=f"{MAX_MARKERS} markers",
            cure="plan the road in sections, or with larger spacings",
        )
    by_name = {lane.name: lane for lane in lanes}
    left_out = tuple(
        replace(left, station_m=alignment.stations_at(by_name[left.lane], left.chainage_m)[0])
        for left in placer.left_out
    )
    return Plan(name, alignment, rules, markers, left_out, codebook=book)


def _chosen_lanes(alignment: Alignment, rules: PlanRules) -> list[Lane]:
    if rules.road.lanes is None:
        return list(alignment.lanes)
    known = {lane.name: lane for lane in alignment.lanes}
    for lane_name in rules.road.lanes:
        if lane_name not in known:
            raise InvalidParameter(
                f"the road has no lane {lane_name[:60]!r}",
                field="road.lanes",
                limit=", ".join(known)[:300],
                cure="name lanes of the road",
            )
    return [known[lane_name] for lane_name in dict.fromkeys(rules.road.lanes)]


def _check_applies(lanes: Sequence[Lane], rules: PlanRules) -> None:
    low, high = rules.applies.speed_kmh
    for lane in lanes:
        for speed, at in zip((lane.design_speed_m_s.min(), lane.design_speed_m_s.max()), ("low", "high"), strict=True):
            if not low - 1e-6 <= speed * _KMH <= high + 1e-6:
                raise InvalidParameter(
                    f"the design speed of lane {lane.name} is {speed * _KMH:.0f} km/h, too {at} for these rules",
                    field="applies.speed_kmh",
                    limit=f"{low:g} to {high:g} km/h",
                    cure="use rules for this speed, or correct the speed of the road",
                )


class _Placed(NamedTuple):
    """A marker before it has its number; `position` is station, longitude, latitude, height, heading."""

    family: str
    code: str
    lane: str
    site: Site
    position: tuple[float, float, float, float | None, float]
    detail: Detail


class _Placer:
    """Collects the markers of all lanes."""

    def __init__(
        self, alignment: Alignment, rules: PlanRules, numbers: NumberSource, chosen: ChosenPlaces | None
    ) -> None:
        self.alignment = alignment
        self.rules = rules
        self._chosen = chosen
        self.left_out: list[LeftOut] = []
        self._numbers = numbers
        self._areas = AvoidedAreas(alignment, rules.avoid)
        self._painted = Boundaries()
        self._marked = Boundaries()
        self._placed: list[_Placed] = []
        self._tags: list[tuple[Lane, list[Site]]] = []

    def place(self, lane: Lane) -> None:
        """Markers of one lane; those of tags follow in `finish`, when all meanings are known."""
        rules = self.rules
        tag_ranges: list[tuple[float, float]] = []
        lines: list[Site] = []
        if rules.tags is not None:
            tags, left_out = place_tags(self.alignment, lane, rules.tags)
            tags = self._clear(lane, "magnet", tags, left_out)
            tag_ranges = [(tag.chainage_m, tag.chainage_m + rules.tags.length_m) for tag in tags]
            self._tags.append((lane, tags))
        if rules.plates is not None:
            chosen_m = None if self._chosen is None else self._chosen.get((lane.name, "plate"))
            plates = place_plates(self.alignment, lane, rules, tag_ranges, chosen_m)
            self._add_plates(lane, self._clear(lane, "plate", *plates))
        if rules.lines is not None:
            circumference_m = rules.vehicles.wheel_circumference_m
            lines = self._clear(lane, "magnet", place_line_magnets(lane, rules.lines, self._painted, circumference_m))
            self._add_line_magnets(lane, lines)
        if rules.cerpm is not None:
            cerpms = beside_magnets(lane, self._cerpm_sites(lane, rules), lines)
            self._add_cerpms(lane, self._clear(lane, "cerpm", cerpms))

    def finish(
        self, lanes: Sequence[Lane], codebook: Codebook | None, name: str
    ) -> tuple[tuple[PlannedMarker, ...], Codebook | None]:
        """All markers by lane and chainage, numbered, and the codebook of the tags."""
        meanings = [site.meaning for _, sites in self._tags for site in sites if site.meaning is not None]
        if self.rules.tags is not None and meanings:
            reading = tag_conditions(self.rules, self.alignment)
            codebook, codes = tag_codes(self.rules.tags, meanings, codebook, name, reading)
            for lane, sites in self._tags:
                details = [_planned_tag(lane, site, codes) for site in sites]
                self._add(lane, "magnet", sites, details, [detail.tag.text for detail in details])
        order = {lane.name: number for number, lane in enumerate(lanes)}
        shared = self._marked.shared_as_other_side
        placed = sorted(self._placed, key=lambda made: (order[made.lane], made.site.chainage_m, -made.site.offset_m))
        markers = tuple(
            PlannedMarker(
                number, made.family, made.code, made.lane, made.site.chainage_m, made.site.offset_m, *made.position,
                made.site.purpose, _without_wrong_side(made.lane, made.detail, shared),
            )
            for number, made in enumerate(placed, 1)
        )  # fmt: skip
        return markers, codebook

    def _clear(self, lane: Lane, family: str, sites: list[Site], left_out: Sequence[LeftOut] = ()) -> list[Site]:
        kept, moved = self._areas.keep_clear(lane, family, sites)
        self.left_out += [*left_out, *moved]
        return kept

    def _add(
        self, lane: Lane, family: str, sites: Sequence[Site], details: Sequence[Detail], codes: Sequence[str]
    ) -> None:
        """Markers of one family on a lane."""
        if not sites:
            return
        chainage = np.array([site.chainage_m for site in sites])
        offset = np.array([site.offset_m for site in sites])
        lon, lat = (values.tolist() for values in lane.position_at(chainage, offset))
        station = self.alignment.stations_at(lane, chainage)
        heading = lane.heading_at(chainage).tolist()
        tilt = np.tan(lane.value_at(lane.superelevation_rad, chainage))
        height = (lane.value_at(lane.height_m, chainage) + offset * tilt).tolist()
        for k, site in enumerate(sites):
            known = height[k] if math.isfinite(height[k]) else None
            position = (station[k], lon[k], lat[k], known, heading[k])
            self._placed.append(_Placed(family, codes[k], lane.name, site, position, details[k]))

    def _add_plates(self, lane: Lane, sites: Sequence[Site]) -> None:
        rules = self.rules.plates
        assert rules is not None
        if not sites:
            return
        geometry = PlateGeometry(rules.n, rules.unit_mm, rules.gap_mm, rules.thickness_mm)
        places = lane.position_at([site.chainage_m for site in sites], [site.offset_m for site in sites])
        codes = plate_codes(rules, places[0].tolist(), places[1].tolist(), self._numbers)
        details = [PlannedPlate(code, geometry, site.event) for code, site in zip(codes, sites, strict=True)]
        self._add(lane, "plate", sites, details, [code.digits for code in codes])

    def _add_line_magnets(self, lane: Lane, sites: Sequence[Site]) -> None:
        rules = self.rules.lines
        assert rules is not None
        tags = {
            style: LineTag(Polarity(polarity))
            for style, polarity in (
                (BoundaryStyle.SOLID, rules.solid),
                (BoundaryStyle.UNKNOWN, rules.solid),
                (BoundaryStyle.DASHED, rules.dashed),
            )
            if polarity is not None
        }
        details = [PlannedLineMagnet(tags[site.style], site.side, site.style) for site in sites]
        self._add(lane, "magnet", sites, details, [detail.tag.text for detail in details])

    def _cerpm_sites(self, lane: Lane, rules: PlanRules) -> list[Site]:
        """Pairs across from each other; a boundary that another lane shares has its markers already."""
        assert rules.cerpm is not None
        cycle_m = rules.cerpm.n_m or marking_rules(rules.cerpm.marking_rules).cycle_m
        chosen_m = None if self._chosen is None else self._chosen.get((lane.name, "cerpm"))
        if chosen_m is None:
            chainages = place_cerpms(lane, rules.cerpm, cycle_m, rules.road.curve_radius_m)
        else:
            chainages = np.array(chosen_m, dtype=np.float64)
        sites = []
        for side in (LaneSide.LEFT, LaneSide.RIGHT):
            if rules.cerpm.sides not in ("both", side.name.lower()):
                continue
            for stretch in self._marked.add(lane, side):
                low, high = lane.chainage_m[stretch.first], lane.chainage_m[stretch.last]
                own = chainages[(chainages >= low - 1e-6) & (chainages <= high + 1e-6)]
                offsets = lane.value_at(stretch.offset_m, own)
                sites += [
                    Site(chainage, offset, Purpose.BOUNDARY, side=side)
                    for chainage, offset in zip(own.tolist(), offsets.tolist(), strict=True)
                ]
        return sites

    def _add_cerpms(self, lane: Lane, sites: Sequence[Site]) -> None:
        numbers = self._numbers(len(sites))
        details = [
            PlannedCerpm(number, site.side, _speed_limit(lane, site.chainage_m))
            for number, site in zip(numbers, sites, strict=True)
        ]
        self._add(lane, "cerpm", sites, details, [str(number) for number in numbers])


def _planned_tag(lane: Lane, site: Site, codes: Mapping[Meaning, InformationTag]) -> PlannedTag:
    """A straight tag with its first and its last magnet on the lane (METRO section 4.2, figure 4)."""
    assert site.meaning is not None
    assert site.event is not None
    tag = codes[site.meaning]
    (lon_a, lon_b), (lat_a, lat_b) = lane.position_at(
        [site.chainage_m, min(site.chainage_m + tag.length_m, lane.length_m)], site.offset_m
    )
    azimuth, _, _ = _GEOD.inv(lon_a, lat_a, lon_b, lat_b)
    along = np.array([magnet.along_m for magnet in tag.magnets])
    start = np.ones(len(along))
    lon, lat, _ = _GEOD.fwd(start * lon_a, start * lat_a, start * azimuth, along)
    magnets = zip((site.chainage_m + along).tolist(), np.asarray(lon).tolist(), np.asarray(lat).tolist(), strict=True)
    return PlannedTag(tag, site.meaning, site.event, tuple(magnets))


def _speed_limit(lane: Lane, chainage_m: float) -> SpeedLimit:
    speed_kmh = float(lane.value_at(lane.design_speed_m_s, chainage_m)) * _KMH
    return SpeedLimit(round(min(speed_kmh, MAX_SPEED_LIMIT)))


def _without_wrong_side(lane: str, detail: Detail, shared: Container[tuple[str, LaneSide]]) -> Detail:
    """A CERPM on a boundary that is the other side of another lane names no side."""
    if isinstance(detail, PlannedCerpm) and (lane, detail.side) in shared:
        return replace(detail, side=LaneSide.UNKNOWN)
    return detail
