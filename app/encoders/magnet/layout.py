"""A tag on a lane -> holes to drill or shells to glue: where magnets go, and which way their north poles point.

A tag is laid out straight, its first and its last magnet on the lane's line and the others between them: the distances
that carry the code are those of equation 1 in the direction of the tag, on a bend as on a straight (METRO section 4.2,
figure 4). A line of magnets follows the painted line.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
import scipy

from app.errors import InvalidParameter
from app.markers.magnet import (
    MAX_LINE_SPACING_M,
    InformationTag,
    Installation,
    LineStyle,
    LineTag,
    Orientation,
    Polarity,
    Tag,
)
from app.markers.magnet_design import Meaning, check_name
from app.markers.reading import Check
from app.roads.lane_line import LaneLine, bearing_deg, left_of
from app.values import Floats

MAX_HOLES = 10_000
"""Magnets of a line at most. 60 km at 6 m."""
MAX_OFFSET_M = 50.0
"""Largest offset of a tag from the lane's line. [m] Wider than any carriageway."""


@dataclass(frozen=True, slots=True)
class Hole:
    """One magnet to be set."""

    number: int  # from 1, in the direction of travel
    along_m: float  # [m] from the first magnet: along the tag, or along the line for line tags
    # `chainage_m`, `offset_m`: [m] along the lane's line, and from it, left positive
    chainage_m: float
    offset_m: float
    # `lon_deg`, `lat_deg`: [deg] WGS 84
    lon_deg: float
    lat_deg: float
    # `east_m`, `north_m`, `up_m`: [m] in the lane's local frame
    east_m: float
    north_m: float
    up_m: float
    polarity: Polarity
    orientation: Orientation
    north_pole_bearing_deg: float | None  # [deg] clockwise from true north; None for upright magnets

    @property
    def north_pole(self) -> str:
        """Where the north pole points, for the crew: up, down, forward or backward."""
        ways = ("up", "down") if self.orientation is Orientation.UP else ("forward", "backward")
        return ways[self.polarity is Polarity.S]

    @property
    def point_enu_m(self) -> Floats:
        """Place in the lane's local frame, shape (3,). [m]"""
        return np.array([self.east_m, self.north_m, self.up_m])


@dataclass(frozen=True, slots=True, eq=False)
class MagnetLayout:
    """The holes of one tag, or of one line of tags."""

    name: str  # the agency's name for it
    tag: Tag
    lane: LaneLine
    holes: tuple[Hole, ...]  # in the direction of travel
    bearing_deg: float  # [deg] of the tag, or of the line at its first magnet; clockwise from true north
    meaning: Meaning | None = None
    installation: Installation = field(default_factory=Installation)

    @property
    def length_m(self) -> float:
        """From the first hole to the last. [m]"""
        return self.holes[-1].along_m

    @property
    def gaps_m(self) -> Floats:
        """Straight distances between neighbours, shape (holes - 1,). [m]"""
        points = np.array([hole.point_enu_m for hole in self.holes]).reshape(-1, 3)
        return np.asarray(np.linalg.norm(np.diff(points, axis=0), axis=1), dtype=np.float64)


def place_tag(
    lane: LaneLine,
    tag: InformationTag,
    chainage_m: float,
    *,
    name: str,
    offset_m: float = 0.0,
    meaning: Meaning | None = None,
    installation: Installation = Installation(),
) -> MagnetLayout:
    """Lay out an information tag.

    Parameters
    ----------
    lane : LaneLine
        The lane's centre line, in the direction of legal travel.
    chainage_m : float
        Of the first magnet. [m]
    offset_m : float
        Of the whole tag from the line, left positive. [m]

    Raises
    ------
    InvalidParameter
        The tag does not lie on the lane.
    """
    check_name("name", name)
    _check_chainage("chainage_m", chainage_m, lane)
    if not abs(offset_m) <= MAX_OFFSET_M:
        raise InvalidParameter(f"offset_m is {offset_m}", field="offset_m", limit=f"within {MAX_OFFSET_M:g} m")
    first, last = lane.at(chainage_m), _point_ahead(lane, chainage_m, tag.length_m)
    direction = (last - first) / float(np.linalg.norm(last - first))
    start = first + offset_m * left_of(direction)
    bearing = bearing_deg(direction)
    along_m = np.array([magnet.along_m for magnet in tag.magnets])
    points = start + along_m[:, None] * direction
    located = np.array([lane.locate(point) for point in points])
    polarities = [magnet.polarity for magnet in tag.magnets]
    holes = _holes(lane, along_m, located, points, polarities, bearing)
    return MagnetLayout(name, tag, lane, holes, bearing, meaning, installation)


def place_line(
    line: LaneLine,
    style: LineStyle,
    *,
    name: str,
    from_m: float = 0.0,
    to_m: float | None = None,
    spacing_m: float = MAX_LINE_SPACING_M,
    installation: Installation = Installation(),
) -> MagnetLayout:
    """Lay out line tags along a painted line, at equal distances along it.

    Parameters
    ----------
    line : LaneLine
        The painted line.
    from_m, to_m : float
        Chainages of the first and the last magnet; to the end of the line without. [m]
    spacing_m : float
        Largest distance between neighbours; it is shortened so that the last magnet falls on `to_m`. [m]

    Raises
    ------
    InvalidParameter
        The section does not lie on the line, the spacing is not positive, or there would be more than 10,000 holes.
    """
    check_name("name", name)
    end_m = line.length_m if to_m is None else to_m
    _check_chainage("from_m", from_m, line)
    _check_chainage("to_m", end_m, line)
    if not (0 < spacing_m < math.inf and from_m < end_m):
        raise InvalidParameter(
            f"no line of magnets goes from {from_m:g} m to {end_m:g} m in steps of {spacing_m:g} m",
            field="spacing_m" if from_m < end_m else "to_m",
            limit="a spacing above 0, and an end behind the beginning",
        )
    steps = max(math.ceil((end_m - from_m) / spacing_m - 1e-9), 1)
    if steps + 1 > MAX_HOLES:
        raise InvalidParameter(
            f"the line takes {steps + 1} magnets",
            field="spacing_m",
            limit=f"{MAX_HOLES} magnets",
            cure="lay it out in sections",
        )
    tag = LineTag.of_style(style)
    along_m = np.linspace(0.0, end_m - from_m, steps + 1)
    points = line.at(from_m + along_m)
    on_line = np.stack([from_m + along_m, np.zeros(len(along_m))], axis=1)
    holes = _holes(line, along_m, on_line, points, [tag.polarity] * len(points), None)
    return MagnetLayout(name, tag, line, holes, bearing_deg(line.direction_at(from_m)), installation=installation)


def _check_chainage(field: str, chainage_m: float, lane: LaneLine) -> None:
    if not 0 <= chainage_m <= lane.length_m:
        raise InvalidParameter(
            f"{field} is {chainage_m:g} m, the line is {lane.length_m:.2f} m long",
            field=field,
            limit=f"0 to {lane.length_m:.2f} m",
            cure="choose a chainage on the line",
        )


def _point_ahead(lane: LaneLine, chainage_m: float, length_m: float) -> Floats:
    """The place on the lane that is `length_m` away in a straight line, shape (3,). [m]"""
    start = lane.at(chainage_m)
    room_m = lane.length_m - chainage_m

    def beyond(arc_m: float) -> float:
        return float(np.linalg.norm(lane.at(chainage_m + arc_m) - start)) - length_m

    reach_m = length_m  # the chord is never longer than the arc, so the place lies behind this
    while beyond(min(reach_m, room_m)) < -1e-9:
        if reach_m >= room_m or reach_m > 2 * length_m:
            raise InvalidParameter(
                f"a tag of {length_m:g} m at chainage {chainage_m:g} m leaves the line of {lane.length_m:.2f} m",
                field="chainage_m",
                limit=f"at most {max(lane.length_m - length_m, 0):.2f} m, where the line does not turn back",
                cure="choose a smaller chainage or a shorter tag",
            )
        reach_m *= 1.05
    reach_m = min(reach_m, room_m)
    arc_m = scipy.optimize.brentq(beyond, 0.0, reach_m, xtol=1e-10) if beyond(reach_m) > 0 else reach_m
    return lane.at(chainage_m + arc_m)


def _holes(
    lane: LaneLine,
    along_m: Floats,
    located_m: Floats,
    points: Floats,
    polarities: Sequence[Polarity],
    forward_deg: float | None,
) -> tuple[Hole, ...]:
    """Holes at points, shape (K, 3), with chainages and offsets, shape (K, 2); upright without the tag's bearing."""
    lon_deg, lat_deg = lane.lon_lat(points)
    orientation = Orientation.UP if forward_deg is None else Orientation.FORWARD
    turned_deg = {Polarity.N: 0.0, Polarity.S: 180.0}
    rows = np.column_stack([along_m, located_m, lon_deg, lat_deg, points]).tolist()
    return tuple(
        Hole(
            number=number,
            along_m=along,
            chainage_m=chainage,
            offset_m=offset,
            lon_deg=lon,
            lat_deg=lat,
            east_m=east,
            north_m=north,
            up_m=up,
            polarity=polarity,
            orientation=orientation,
            north_pole_bearing_deg=None if forward_deg is None else (forward_deg + turned_deg[polarity]) % 360.0,
        )
        for number, ((along, chainage, offset, lon, lat, east, north, up), polarity) in enumerate(
            zip(rows, polarities, strict=True), start=1
        )
    )


# === Bill of materials of a layout: quantities, unit costs and totals.


PAINT = "paint or thermoplastic marking"


@dataclass(frozen=True, slots=True)
class UnitCost:
    """What one of something costs, from the cheapest to the dearest. [USD]"""

    item: str
    unit: str
    low_usd: float
    high_usd: float
    source: str


@dataclass(frozen=True, slots=True)
class CostRow:
    """A quantity of something and what it costs. [USD]"""

    cost: UnitCost
    quantity: float

    @property
    def low_usd(self) -> float:
        """At the lowest price. [USD]"""
        return round(self.quantity * self.cost.low_usd, 2)

    @property
    def high_usd(self) -> float:
        """At the highest price. [USD]"""
        return round(self.quantity * self.cost.high_usd, 2)


@dataclass(frozen=True, slots=True)
class UnpricedRow:
    """A quantity of something that nobody publishes a price of."""

    item: str
    quantity: float
    unit: str


@dataclass(frozen=True, slots=True)
class Bill:
    """Materials of a layout and their alternatives."""

    materials: tuple[CostRow, ...]  # what is bought: magnets and shells
    alternatives: tuple[CostRow, ...]  # paint along the same length; for an information tag also one rugged RFID tag
    without_price: tuple[UnpricedRow, ...] = ()  # what is bought and is no part of the total

    @property
    def total_usd(self) -> float:
        """Materials, at the highest price. [USD]"""
        return round(sum(row.high_usd for row in self.materials), 2)

    @property
    def paint(self) -> CostRow:
        """Paint or thermoplastic over the same length."""
        return next(row for row in self.alternatives if row.cost.item == PAINT)


# === The sheet for the crew: a layout with its checks and its costs, for the writers.


class SheetFormat(StrEnum):
    """What a sheet can be written as; the value is the file's extension."""

    PDF = "pdf"
    CSV = "csv"
    GEOJSON = "geojson"

    @property
    def media_type(self) -> str:
        """For HTTP's Content-Type."""
        return {"pdf": "application/pdf", "csv": "text/csv; charset=utf-8", "geojson": "application/geo+json"}[self]


@dataclass(frozen=True, slots=True, eq=False)
class DrillingSheet:
    """What the crew, the planner and the buyer need of one layout, drilled or glued onto the road."""

    layout: MagnetLayout
    checks: tuple[Check, ...]
    bill: Bill

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)
