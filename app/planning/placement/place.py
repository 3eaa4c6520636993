"""Places the markers of a plan, family by family and lane by lane."""

from __future__ import annotations

import math
import zlib
from collections.abc import Container, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pyproj import Geod

from app.errors import InvalidParameter
from app.formats.alignments.geometry import BoundaryStyle
from app.markers.cerpm import MAX_SPEED_LIMIT, LaneSide, SpeedLimit
from app.markers.magnet import InformationTag, LineTag, Polarity
from app.markers.magnet_codebook import Codebook, Meaning
from app.markers.plate import PlateGeometry
from app.planning.alignment import Alignment, Lane
from app.planning.marking_rules import marking_rules
from app.planning.placement.avoid import AvoidedAreas
from app.planning.placement.boundaries import Boundaries
from app.planning.placement.cerpms import beside_magnets, place_cerpms
from app.planning.placement.codes import NumberSource, plate_codes, tag_codes, unused_numbers
from app.planning.placement.lines import place_line_magnets
from app.planning.placement.plates import place_plates
from app.planning.placement.site import Site
from app.planning.placement.tags import place_tags
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
from app.planning.rules import PlanRules

MAX_MARKERS = 500_000
"""Markers of one plan at most. Source: chosen by hand, ten times those of 100 km with all families."""
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
    alignment : Alignment
    rules : PlanRules
    name : str
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
    return Plan(name, alignment, rules, markers, tuple(placer.left_out), codebook=book)


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
        for speed, at in zip((lane.design_speed_mps.min(), lane.design_speed_mps.max()), ("low", "high"), strict=True):
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
            lines = self._clear(lane, "magnet", place_line_magnets(lane, rules.lines, self._painted))
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
            codebook, codes = tag_codes(self.rules.tags, meanings, codebook, name)
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
        station = lane.value_at(lane.station_m, chainage).tolist()
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
    speed_kmh = float(lane.value_at(lane.design_speed_mps, chainage_m)) * _KMH
    return SpeedLimit(round(min(speed_kmh, MAX_SPEED_LIMIT)))


def _without_wrong_side(lane: str, detail: Detail, shared: Container[tuple[str, LaneSide]]) -> Detail:
    """A CERPM on a boundary that is the other side of another lane names no side."""
    if isinstance(detail, PlannedCerpm) and (lane, detail.side) in shared:
        return replace(detail, side=LaneSide.UNKNOWN)
    return detail
