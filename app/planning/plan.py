"""A plan: the markers placed on an alignment by rules, and the findings of its checks."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum

from app.formats.alignments.geometry import BoundaryStyle
from app.markers.cerpm import LaneSide, SpeedLimit
from app.markers.checks import ComparedFigure, Verdict
from app.markers.magnet import InformationTag, LineTag
from app.markers.magnet_codebook import Codebook, Meaning
from app.markers.plate import PlateCode, PlateGeometry
from app.planning.alignment import Alignment, RoadEvent
from app.planning.rules import PlanRules
from app.planning.trade_off import Optimum
from app.radio.settings import RadioSettings


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
    """One marker of a plan.

    Attributes
    ----------
    number : int
        In the plan, from 1, by lane and chainage.
    family : str
        ``plate``, ``magnet`` or ``cerpm``.
    code : str
        Digits of a plate, text of a tag, registry number of a CERPM.
    lane : str
    chainage_m, offset_m : float
        Along the lane's centre line, and from it, left positive; of a tag its first magnet. [m]
    station_m : float
        True distance along the road's reference line. [m]
    lon_deg, lat_deg : float
        WGS 84. [deg]
    height_m : float or None
        Of the road surface, in the datum of the alignment. [m]
    heading_deg : float
        Direction of travel, clockwise from true north. [deg]
    purpose : Purpose
    detail : Detail
        What distinguishes the family.
    """

    number: int
    family: str
    code: str
    lane: str
    chainage_m: float
    offset_m: float
    station_m: float
    lon_deg: float
    lat_deg: float
    height_m: float | None
    heading_deg: float
    purpose: Purpose
    detail: Detail


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A place that the rules ask for and that got no marker, or a moved one.

    Attributes
    ----------
    family, lane, chainage_m
    reason : str
        A sentence for people.
    moved_m : float or None
        How far it was moved along the lane; None: left out. [m]
    """

    family: str
    lane: str
    chainage_m: float
    reason: str
    moved_m: float | None = None


@dataclass(frozen=True, slots=True)
class PlanFinding(ComparedFigure):
    """One check of a plan, at its worst place.

    Attributes
    ----------
    verdict : Verdict
    sentence : str
        The result for people, with the cure if it is not met.
    lane, station_m, lon_deg, lat_deg
        Where the figure was found; None for figures of the whole plan.
    """

    verdict: Verdict
    sentence: str
    lane: str | None = None
    station_m: float | None = None
    lon_deg: float | None = None
    lat_deg: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Markers placed on an alignment.

    Attributes
    ----------
    name : str
    alignment : Alignment
    rules : PlanRules
    markers : tuple of PlannedMarker
        By number.
    left_out : tuple of LeftOut
    findings : tuple of PlanFinding
        Empty until `check_plan` ran.
    codebook : Codebook or None
        Of the tags.
    radio : RadioSettings or None
        Of the CERPMs; None until `check_plan` ran, and without CERPMs.
    optimum : Optimum or None
        Of rules with a `quality`.
    """

    name: str
    alignment: Alignment
    rules: PlanRules
    markers: tuple[PlannedMarker, ...]
    left_out: tuple[LeftOut, ...] = ()
    findings: tuple[PlanFinding, ...] = ()
    codebook: Codebook | None = None
    radio: RadioSettings | None = None
    optimum: Optimum | None = None

    @property
    def counts(self) -> dict[str, int]:
        """Markers by family."""
        return dict(sorted(Counter(marker.family for marker in self.markers).items()))
