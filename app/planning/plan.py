"""A plan: the markers placed on an alignment by rules, the findings of its checks, its markers as built, its costs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from pyproj import Geod

from app.formats.alignments.geometry import BoundaryStyle
from app.markers.cerpm import LaneSide, SpeedLimit
from app.markers.magnet import InformationTag, LineTag
from app.markers.magnet_design import Codebook, Meaning
from app.markers.plate import PlateCode, PlateGeometry
from app.markers.reading import RadioFinding
from app.planning.alignment import Alignment, RoadEvent
from app.planning.rules import PlanRules, Quality
from app.radio.settings import RadioSettings

# === Cost against quality: a table of requirements, with what they cost and what even spacing costs.


@dataclass(frozen=True, slots=True)
class TradeOffPoint:
    """One requirement and the cheapest plan found for it."""

    fix_every_m: float
    path_error_m: float | None  # [m] greatest path error; None where none is required
    cost: float  # of the whole plan, in the currency of the rules
    bound: float  # no plan that has the same pairs along the path is cheaper
    even_cost: float | None  # with even spacing at equal quality; None where no even spacing has it
    counts: tuple[tuple[str, int], ...]  # markers by family

    def is_better(self, other: TradeOffPoint) -> bool:
        """Whether it is at least as good in all and better in one of cost, fixes and path error."""
        mine, others = (self._figures(), other._figures())
        return all(a <= b for a, b in zip(mine, others, strict=True)) and mine != others

    def _figures(self) -> tuple[float, float, float]:
        return self.cost, self.fix_every_m, self.path_error_m or 0.0


@dataclass(frozen=True, slots=True)
class Optimum:
    """How a plan was optimised."""

    quality: Quality  # as required; `fix_every_m` is the best that the budget buys, where there is one
    cost: float  # of the whole plan, in the currency of the rules; working days are not rounded, and there is one more
    bound: float  # no plan with the same pairs along the path and the same markers ahead of events is cheaper
    table: tuple[TradeOffPoint, ...]  # the required quality first


def pareto_points(points: Sequence[TradeOffPoint]) -> tuple[TradeOffPoint, ...]:
    """Points that no other point is better than, by cost."""
    best = [point for point in points if not any(other.is_better(point) for other in points)]
    return tuple(sorted(best, key=lambda point: point.cost))


# === A plan: the markers placed on an alignment by rules, and the findings of its checks.


class Purpose(StrEnum):
    """Why a marker is where it is."""

    SPACING = "spacing"
    DECISION_POINT = "decision point"
    PAINTED_LINE = "painted line"
    INFORMATION = "information"
    BOUNDARY = "boundary"


@dataclass(frozen=True, slots=True)
class PlannedPlate:
    """A plate; `event` is what it stands ahead of."""

    code: PlateCode
    geometry: PlateGeometry
    event: RoadEvent | None = None


@dataclass(frozen=True, slots=True)
class PlannedTag:
    """An information tag: magnets, as (chainage_m, lon_deg, lat_deg) in the direction of travel, and its meaning."""

    tag: InformationTag
    meaning: Meaning
    event: RoadEvent
    magnets: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True, slots=True)
class PlannedLineMagnet:
    """One magnet of a painted line."""

    tag: LineTag
    side: LaneSide
    style: BoundaryStyle


@dataclass(frozen=True, slots=True)
class PlannedCerpm:
    """A raised marker on a boundary of the lane."""

    number: int
    side: LaneSide
    speed_limit: SpeedLimit | None = None


Detail = PlannedPlate | PlannedTag | PlannedLineMagnet | PlannedCerpm


@dataclass(frozen=True, slots=True)
class PlannedMarker:
    """One marker of a plan."""

    number: int  # in the plan, from 1, by lane and chainage
    family: str  # ``plate``, ``magnet`` or ``cerpm``
    code: str  # digits of a plate, text of a tag, registry number of a CERPM
    lane: str
    # `chainage_m`, `offset_m`: [m] along the lane's centre line, and from it, left positive; of a tag its first magnet
    chainage_m: float
    offset_m: float
    station_m: float  # [m] as signs and drawings show it; of two places with the same station, chainages differ
    # `lon_deg`, `lat_deg`: [deg] WGS 84
    lon_deg: float
    lat_deg: float
    height_m: float | None  # [m] of the road surface, in the datum of the alignment
    heading_deg: float  # [deg] direction of travel, clockwise from true north
    purpose: Purpose
    detail: Detail  # what distinguishes the family


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A place that the rules ask for and that got no marker, or a moved one."""

    family: str
    lane: str
    chainage_m: float
    reason: str  # a sentence for people
    moved_m: float | None = None  # [m] how far it was moved along the lane; None: left out
    station_m: float | None = None  # [m] as signs and drawings show it; None in plans that were made without it


@dataclass(frozen=True, slots=True)
class PlanFinding(RadioFinding):
    """One check of a plan, at its worst place; `sentence` has the cure if it is not met."""

    # `lane`, `station_m`, `lon_deg`, `lat_deg`: where the figure was found, the station as signs and drawings show it;
    # None for figures of the whole plan
    lane: str | None = None
    station_m: float | None = None
    lon_deg: float | None = None
    lat_deg: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Markers placed on an alignment."""

    name: str
    alignment: Alignment
    rules: PlanRules
    markers: tuple[PlannedMarker, ...]  # by number
    left_out: tuple[LeftOut, ...] = ()
    findings: tuple[PlanFinding, ...] = ()  # empty until `check_plan` ran
    codebook: Codebook | None = None  # of the tags
    radio: RadioSettings | None = None  # of the CERPMs; None until `check_plan` ran, and without CERPMs
    optimum: Optimum | None = None  # of rules with a `quality`

    @property
    def counts(self) -> dict[str, int]:
        """Markers by family."""
        return dict(sorted(Counter(marker.family for marker in self.markers).items()))


# === A plan with its markers where they were surveyed, to check it again.


_OFFSET_STEP_M = 0.01  # [m] of a plate's offset, because cameras are computed for each offset; source: a survey's error
_GEOD = Geod(ellps="WGS84")


class SurveyedPlace(NamedTuple):
    """Where a marker of a plan was surveyed; `heading_deg` is None where it was not."""

    lon_deg: float
    lat_deg: float
    heading_deg: float | None = None


class Residual(NamedTuple):
    """A surveyed marker against its planned place. [m, deg]"""

    along_m: float  # ahead of its planned place in the direction of travel
    across_m: float  # to the left of it
    heading_deg: float | None  # clockwise of the planned heading, -180 to 180


def residual_of(marker: PlannedMarker, surveyed: SurveyedPlace) -> Residual:
    """Residual of a surveyed marker along and across the direction of travel."""
    azimuth, _, distance = _GEOD.inv(marker.lon_deg, marker.lat_deg, surveyed.lon_deg, surveyed.lat_deg)
    angle = np.radians(azimuth - marker.heading_deg)
    turned = None
    if surveyed.heading_deg is not None:
        turned = (surveyed.heading_deg - marker.heading_deg + 180.0) % 360.0 - 180.0
    return Residual(float(distance * np.cos(angle)), float(-distance * np.sin(angle)), turned)


def plan_as_built(plan: Plan, surveyed: Mapping[int, SurveyedPlace]) -> Plan:
    """The plan with surveyed positions in place of planned ones, without findings.

    Parameters
    ----------
    surveyed : mapping of int to SurveyedPlace
        By the markers' numbers; markers that are not in it stay where they are planned.

    Notes
    -----
    Chainage and offset change by the residual along and across. The magnets of a tag move with the first one. A line of
    magnets has no single place that could be surveyed, so its magnets stay.
    """
    markers = [
        _moved(plan, marker, surveyed[marker.number])
        if marker.number in surveyed and not isinstance(marker.detail, PlannedLineMagnet)
        else marker
        for marker in plan.markers
    ]
    return replace(plan, markers=tuple(markers), findings=())


def _moved(plan: Plan, marker: PlannedMarker, surveyed: SurveyedPlace) -> PlannedMarker:
    lane = plan.alignment.lane(marker.lane)
    residual = residual_of(marker, surveyed)
    offset_m = marker.offset_m + residual.across_m
    detail = marker.detail
    if isinstance(detail, PlannedPlate):
        offset_m = round(offset_m / _OFFSET_STEP_M) * _OFFSET_STEP_M
    if isinstance(detail, PlannedTag):
        chainages = np.array([chainage for chainage, _, _ in detail.magnets]) + residual.along_m
        lon, lat = lane.position_at(chainages, offset_m)
        detail = replace(detail, magnets=tuple(zip(chainages.tolist(), lon.tolist(), lat.tolist(), strict=True)))
    chainage = min(max(marker.chainage_m + residual.along_m, 0.0), lane.length_m)
    return replace(
        marker,
        lon_deg=surveyed.lon_deg,
        lat_deg=surveyed.lat_deg,
        heading_deg=marker.heading_deg if surveyed.heading_deg is None else surveyed.heading_deg,
        chainage_m=chainage,
        station_m=plan.alignment.stations_at(lane, chainage)[0],
        offset_m=offset_m,
        detail=detail,
    )
