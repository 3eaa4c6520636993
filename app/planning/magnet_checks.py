"""What is checked before a layout is drilled, with figures, limits and their sources; costs and drilling sheet."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Annotated

import numpy as np
import scipy
from pydantic import Field, with_config

from app.encoders.magnet.layout import PAINT, Bill, CostRow, DrillingSheet, MagnetLayout, UnitCost
from app.errors import InvalidParameter
from app.geodesy import check_lon_lat
from app.inputs import INPUT, Number, Text
from app.markers.magnet import MAX_LINE_SPACING_M, MIN_GAP_M, InformationTag, LineTag, Orientation
from app.markers.magnet_design import check_name
from app.markers.reading import Check

# === Tables of figures that the papers give.


def read_figures(name: str) -> list[dict[str, str]]:
    """Lines of a table in `data`, by column."""
    text = (resources.files("app.planning") / "data" / name).read_text("utf-8")
    return list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))


# === Bill of materials of a layout, compared with what else could mark the road.


_MAGNET = "magnet with shell"
_RFID = "rugged RFID tag"


@lru_cache(maxsize=1)
def unit_costs() -> dict[str, UnitCost]:
    """Unit costs that the METRO paper gives, by item (section 8.1 and table 2)."""
    costs = (
        UnitCost(cost["item"], cost["unit"], float(cost["low"]), float(cost["high"]), cost["source"])
        for cost in read_figures("costs.csv")
    )
    return {cost.item: cost for cost in costs}


def bill_of_materials(layout: MagnetLayout) -> Bill:
    """What a layout costs in materials, beside paint of the same length."""
    costs = unit_costs()
    alternatives = [CostRow(costs[PAINT], round(layout.length_m, 2))]
    if isinstance(layout.tag, InformationTag):
        alternatives.append(CostRow(costs[_RFID], 1))
    return Bill((CostRow(costs[_MAGNET], len(layout.holes)),), tuple(alternatives))


# === What is checked before a layout is drilled: each check with its figure, its limit and where the limit comes from.


READABLE_CLEARANCE_M = 0.30
"""Clearance up to which tags are read. [m] Source: METRO section 7.3."""
HALF_BAR_M = 1.77 / 2
"""Half of METRO's sensor bar. [m] Source: METRO section 5.1."""
REACTION_S = 2.5
"""Brake reaction time. [s] Source: AASHTO Green Book (2018), section 3.2.2."""
DECELERATION_M_S2 = 3.4
"""Comfortable deceleration. [m/s2] Source: AASHTO Green Book (2018), section 3.2.2. By these two the 20 m before a stop
line of METRO section 6.3 serve up to 5.9 m/s."""
_SERVED = 0.95  # share of a kind of vehicle that must have a readable clearance
_WANDER_M = 0.5  # [m] a vehicle wanders in its lane
_TOLERANCE_M = 0.0005  # [m] rounding of positions


@dataclass(frozen=True, slots=True)
class Neighbour:
    """Another marker nearby."""

    name: str
    # `lon_deg`, `lat_deg`: [deg]
    lon_deg: float
    lat_deg: float
    orientation: Orientation = Orientation.FORWARD  # of its magnet; what is no magnet counts as lying

    def __post_init__(self) -> None:
        check_name("neighbours.name", self.name)
        check_lon_lat(self.lon_deg, self.lat_deg, "neighbours")


@with_config(INPUT)
@dataclass(frozen=True, slots=True)
class Site:
    """What the checks need to know of the road and its traffic."""

    design_speed_m_s: Annotated[Number | None, Field(description="Design speed, 0.5 to 70. [m/s]")] = None
    # on the same line; needs the design speed
    stop_line_chainage_m: Annotated[
        Number | None, Field(description="Of the stop line that the tag announces. [m]")
    ] = None
    vehicles: Annotated[
        tuple[Text, ...],
        Field(max_length=8, description="Vehicles to be served: sedan, utility, van, heavy truck."),
    ] = ("sedan", "utility")
    readable_clearance_m: Annotated[
        Number, Field(description="Clearance up to which vehicles read, 0.05 to 1. [m]")
    ] = READABLE_CLEARANCE_M
    reaction_s: Annotated[Number, Field(description="Reaction time of the driver or the system, 0 to 10. [s]")] = (
        REACTION_S
    )
    deceleration_m_s2: Annotated[Number, Field(description="Comfortable deceleration, 0.5 to 10. [m/s2]")] = (
        DECELERATION_M_S2
    )

    def __post_init__(self) -> None:
        """Raises InvalidParameter if a value is outside its limits, or a kind of vehicle is unknown."""
        _check_range("design_speed_m_s", self.design_speed_m_s, 0.5, 70.0, "m/s")
        _check_range("stop_line_chainage_m", self.stop_line_chainage_m, -1e5, 1e5, "m")
        _check_range("readable_clearance_m", self.readable_clearance_m, 0.05, 1.0, "m")
        _check_range("reaction_s", self.reaction_s, 0.0, 10.0, "s")
        _check_range("deceleration_m_s2", self.deceleration_m_s2, 0.5, 10.0, "m/s2")
        if self.stop_line_chainage_m is not None and self.design_speed_m_s is None:
            raise InvalidParameter(
                "the distance to a stop line is checked for the design speed, which is missing",
                field="design_speed_m_s",
                limit="0.5 to 70 m/s",
                cure="give the design speed",
            )
        known = vehicle_clearances()
        for name in self.vehicles:
            if name not in known:
                raise InvalidParameter(
                    f"{name[:40]!r} is no known kind of vehicle", field="vehicles", limit=", ".join(known)
                )


def _check_range(name: str, value: float | None, low: float, high: float, unit: str) -> None:
    if value is not None and not low <= value <= high:
        raise InvalidParameter(f"{name} is {value:g} {unit}", field=name, limit=f"{low:g} to {high:g} {unit}")


@lru_cache(maxsize=1)
def vehicle_clearances() -> dict[str, tuple[float, float]]:
    """Mean and standard deviation of the ground clearance by kind of vehicle (METRO figure 14a). [m]"""
    vehicles = read_figures("vehicle_ground_clearance.csv")
    return {kind["vehicle"]: (float(kind["mean_cm"]) / 100, float(kind["std_cm"]) / 100) for kind in vehicles}


def reaction_distance_m(
    speed_m_s: float, reaction_s: float = REACTION_S, deceleration: float = DECELERATION_M_S2
) -> float:
    """Distance in which a vehicle stops, v t + v^2 / 2 a: AASHTO's stopping sight distance on the level. [m]"""
    return speed_m_s * reaction_s + speed_m_s**2 / (2 * deceleration)


def check_layout(layout: MagnetLayout, site: Site, neighbours: Sequence[Neighbour] = ()) -> tuple[Check, ...]:
    """Check a layout against the road and its traffic, and the markers nearby: of other lanes, lines and tags.

    Returns
    -------
    tuple of Check
        Those that apply: to tags, to lines, to what is known of the site. None of them stops anything by itself.
    """
    checks = [_spacing(layout)]
    if isinstance(layout.tag, LineTag):
        checks.append(_line_spacing(layout))
    else:
        checks.append(_bend(layout))
        if site.stop_line_chainage_m is not None and site.design_speed_m_s is not None:
            checks.append(_reaction(layout, site.stop_line_chainage_m, site.design_speed_m_s, site))
    checks += [_clearance(name, site.readable_clearance_m) for name in site.vehicles]
    checks += _neighbours(layout, neighbours)
    return tuple(checks)


def _at_least(name: str, figure: float, limit: float, unit: str, source: str, note: str) -> Check:
    return Check(name, round(figure, 4), ">=", round(limit, 4), unit, source, figure >= limit - _TOLERANCE_M, note)


def _at_most(name: str, figure: float, limit: float, unit: str, source: str, note: str) -> Check:
    return Check(name, round(figure, 4), "<=", round(limit, 4), unit, source, figure <= limit + _TOLERANCE_M, note)


def _spacing(layout: MagnetLayout) -> Check:
    return _at_least(
        "magnet-spacing",
        float(layout.gaps_m.min()),
        MIN_GAP_M,
        "m",
        "METRO figure 17a",
        "nearest two magnets, in a straight line",
    )


def _line_spacing(layout: MagnetLayout) -> Check:
    along = np.diff([hole.along_m for hole in layout.holes])
    return _at_most(
        "line-spacing",
        float(along.max()),
        MAX_LINE_SPACING_M,
        "m",
        "METRO section 6.3",
        "farthest neighbours on the line",
    )


def _bend(layout: MagnetLayout) -> Check:
    offsets = [hole.offset_m for hole in layout.holes]
    return _at_most(
        "offset-on-bend",
        max(offsets) - min(offsets),
        HALF_BAR_M - _WANDER_M,
        "m",
        f"METRO section 5.1: half a sensor bar, less {_WANDER_M:g} m to wander",
        "how far the lane bends away from the straight tag",
    )


def _reaction(layout: MagnetLayout, stop_line_m: float, speed_m_s: float, site: Site) -> Check:
    return _at_least(
        "reaction-distance",
        stop_line_m - layout.holes[-1].chainage_m,
        reaction_distance_m(speed_m_s, site.reaction_s, site.deceleration_m_s2),
        "m",
        "AASHTO Green Book (2018), section 3.2.2",
        f"last magnet to stop line; v t + v²/2a of {speed_m_s:g} m/s, {site.reaction_s:g} s, "
        f"{site.deceleration_m_s2:g} m/s²",
    )


def _clearance(vehicle: str, readable_m: float) -> Check:
    mean_m, std_m = vehicle_clearances()[vehicle]
    share = float(scipy.special.ndtr((readable_m - mean_m) / std_m))
    return _at_most(
        f"clearance-{vehicle.replace(' ', '-')}",
        mean_m + float(scipy.special.ndtri(_SERVED)) * std_m,
        readable_m,
        "m",
        "METRO figure 14a, section 7.3",
        f"{_SERVED:.0%} of them have less; {share:.0%} can read the tag",
    )


def _neighbours(layout: MagnetLayout, neighbours: Sequence[Neighbour]) -> list[Check]:
    """The nearest neighbour of the same orientation, which could be read as part of the tag, and of the other."""
    points = np.array([hole.point_enu_m for hole in layout.holes])
    own = layout.holes[0].orientation
    nearest: dict[bool, tuple[float, str]] = {}
    for neighbour in neighbours:
        away = points - layout.lane.from_position(neighbour.lon_deg, neighbour.lat_deg)
        distance = float(np.linalg.norm(away[:, :2], axis=1).min())
        alike = neighbour.orientation is own and isinstance(layout.tag, InformationTag)
        nearest[alike] = min(nearest.get(alike, (math.inf, "")), (distance, neighbour.name))
    limits = {
        True: ("neighbour-tag", HALF_BAR_M + MIN_GAP_M, "METRO figure 17a, and half a sensor bar (section 5.1)"),
        False: ("neighbour-magnet", MIN_GAP_M, "METRO figure 17a"),
    }
    return [
        _at_least(limits[alike][0], distance, limits[alike][1], "m", limits[alike][2], f"nearest is {name}")
        for alike, (distance, name) in sorted(nearest.items(), reverse=True)
    ]


# === A layout with its checks and its bill of materials: what the writers of drilling sheets take.


def drilling_sheet(
    layout: MagnetLayout, site: Site | None = None, neighbours: Sequence[Neighbour] = ()
) -> DrillingSheet:
    """Check a layout and count its materials."""
    return DrillingSheet(layout, check_layout(layout, site or Site(), neighbours), bill_of_materials(layout))
