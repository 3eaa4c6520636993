"""What is checked before a layout is installed, with figures, limits and their sources; costs and the crew's sheet."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Annotated, NamedTuple

import numpy as np
import scipy
from pydantic import Field, with_config

from app.encoders.magnet.layout import PAINT, Bill, CostRow, DrillingSheet, MagnetLayout, UnitCost, UnpricedRow
from app.errors import InvalidParameter
from app.geodesy import check_lon_lat
from app.inputs import INPUT, Number, Text
from app.markers.magnet import (
    MAX_LINE_SPACING_M,
    MIN_GAP_M,
    InformationTag,
    Installation,
    LineTag,
    Orientation,
)
from app.markers.magnet_design import check_name
from app.markers.reading import Check
from app.values import Floats

# === Tables of figures that the papers give.


def read_figures(name: str) -> list[dict[str, str]]:
    """Lines of a table in `data`, by column."""
    text = (resources.files("app.planning") / "data" / name).read_text("utf-8")
    return list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))


# === Bill of materials of a layout, compared with what else could mark the road.


_IN_HOLE, _ON_SURFACE = ("magnet with shell",), ("magnet", "protective shell")
ADHESIVE = "bed of epoxy adhesive"
"""What holds a shell on the road (METRO section 8.2); there is no published price."""
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
    costs, count = unit_costs(), len(layout.holes)
    on_surface = layout.installation.on_surface
    alternatives = [CostRow(costs[PAINT], round(layout.length_m, 2))]
    if isinstance(layout.tag, InformationTag):
        alternatives.append(CostRow(costs[_RFID], 1))
    materials = tuple(CostRow(costs[item], count) for item in (_ON_SURFACE if on_surface else _IN_HOLE))
    return Bill(materials, tuple(alternatives), (UnpricedRow(ADHESIVE, count, "each"),) if on_surface else ())


# === How far the decoder reads: the proven range, from the measured share of magnets that are read.


PROVEN_RECALL = 0.95
"""[1] least share of the magnets of a kind that must be read at a distance that counts as proven. Source: by hand;
METRO calls 30 cm reliable with 0.87 and 0.93 (section 7.3)."""
RECALL_SOURCE = "docs/benchmarks.md (recall)"
"""Of app/planning/data/magnet_recall.csv."""


class MagnetRecall(NamedTuple):
    """Log-odds with which a magnet of a kind is read, by distance from the sensors to its centre."""

    distance_m: Floats
    log_odds: Floats

    def share_at(self, distance_m: float) -> float:
        """Share of the magnets that are read; linear in the log-odds between the measured distances."""
        return float(scipy.special.expit(np.interp(distance_m, self.distance_m, self.log_odds)))

    @property
    def proven_m(self) -> float:
        """Largest distance up to which `PROVEN_RECALL` is read. [m]"""
        falling = -np.minimum.accumulate(self.log_odds)
        return float(np.interp(-scipy.special.logit(PROVEN_RECALL), falling, self.distance_m))


@lru_cache(maxsize=2)
def magnet_recall(orientation: Orientation) -> MagnetRecall:
    """The measured table of a kind of magnet."""
    rows = read_figures("magnet_recall.csv")
    kind = "upright" if orientation is Orientation.UP else "lying"
    read, magnets, distance_m = (_column(rows, name) for name in (kind, "magnets", "distance_m"))
    count = magnets / 2
    log_odds: Floats = scipy.special.logit((read * count + 0.5) / (count + 1))  # Jeffreys' prior: none is sure
    return MagnetRecall(distance_m, log_odds)


def _column(rows: Sequence[dict[str, str]], name: str) -> Floats:
    return np.array([float(row[name]) for row in rows])


# === What is checked before a layout is installed: each check with its figure, limit and where the limit comes from.


HALF_BAR_M = 1.77 / 2
"""Half of METRO's sensor bar. [m] Source: METRO section 5.1."""
REACTION_S = 2.5
"""Brake reaction time. [s] Source: AASHTO Green Book (2018), section 3.2.2."""
DECELERATION_M_S2 = 3.4
"""Comfortable deceleration. [m/s2] Source: AASHTO Green Book (2018), section 3.2.2. By these two the 20 m before a stop
line of METRO section 6.3 serve up to 5.9 m/s."""
WHEEL_CIRCUMFERENCE_M = (1.8, 2.3)
"""Rolling circumference of the wheels of passenger cars and vans, smallest and largest. [m] Source: tyres of 0.29 to
0.37 m, as `WHEEL_RADII_M` of benchmarks/magnets/drawn_scenes.py."""
TURNS = (0.5, 1.0, 2.0)
"""Turns of a wheel between the magnets of a line at which its field looks like the wheel's own. Source: at 33 cm,
`matched-7` reads 0.82, 0.78 and 0.98 of the magnets of lines 0.5, 1 and 2 turns apart, 1.00 of those 2.5 and 3
turns apart (10 drives each of `draw_line_per_turn`, seed 7001), and 1.00 of tags with gaps of 1, 2 and 3 turns."""
TURN_SLACK = 0.03
"""Share of a turn by which a spacing must differ. Source: as `TURNS`, 0.97 and 1.03 turns are read like other lines."""
MAX_SHELL_MM = 25.4
"""Height of what stands on the road. [mm] Source: MUTCD (2009), section 3B.11: permanent raised markers are about an
inch high at most."""
SHELL_NOTE = "height of the shells on the road; snow ploughs take off what stands on it"
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
        Number | None,
        Field(
            description="Distance from the sensors down to the magnets up to which vehicles read, 0.05 to 1; without, "
            "the decoder's proven range. [m]"
        ),
    ] = None
    wheel_circumference_m: Annotated[
        tuple[Number, Number],
        Field(description="Smallest and largest rolling circumference of the vehicles' wheels, 0.5 to 5. [m]"),
    ] = WHEEL_CIRCUMFERENCE_M
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
        check_circumference(self.wheel_circumference_m, "wheel_circumference_m")
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


def check_circumference(range_m: tuple[float, float], field: str) -> None:
    """Refuse a range of circumferences that no wheels have."""
    low, high = range_m
    if not 0.5 <= low <= high <= 5.0:
        raise InvalidParameter(
            f"the circumferences are {low:g} to {high:g} m",
            field=field,
            limit="smallest and largest, 0.5 to 5 m",
            cure=f"passenger cars and vans have {WHEEL_CIRCUMFERENCE_M[0]:g} to {WHEEL_CIRCUMFERENCE_M[1]:g} m",
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
        checks.append(_wheel_turns(layout, site))
    else:
        checks.append(_bend(layout))
        if site.stop_line_chainage_m is not None and site.design_speed_m_s is not None:
            checks.append(_reaction(layout, site.stop_line_chainage_m, site.design_speed_m_s, site))
    checks += [_clearance(name, layout, site.readable_clearance_m) for name in site.vehicles]
    if layout.installation.on_surface:
        checks.append(_shell(layout.installation))
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


def served_distance_m(vehicle: str, installation: Installation) -> float:
    """Distance from the sensors to the magnets that 95 % of a kind of vehicle are within. [m]"""
    mean_m, std_m = vehicle_clearances()[vehicle]
    return installation.distance_m(mean_m + float(scipy.special.ndtri(_SERVED)) * std_m)


def served_sentence(vehicle: str, installation: Installation, readable_m: float) -> str:
    """Which share of a kind of vehicle is within a readable distance, and how the distance comes about."""
    mean_m, std_m = vehicle_clearances()[vehicle]
    share = float(scipy.special.ndtr((readable_m - installation.distance_m(mean_m)) / std_m))
    depth = f"magnets {100 * installation.depth_m:.1f} cm deep"
    if installation.depth_m < 0:
        depth = "magnets on the road" if installation.on_surface else "magnets on the road, as no depth is stated"
    return f"ground clearance of {_SERVED:.0%} of them, and {depth}; {share:.0%} are within reach"


def readable_m_of(layout: MagnetLayout) -> float:
    """Proven range of the decoder for the magnets of a layout. [m]"""
    return magnet_recall(layout.holes[0].orientation).proven_m


def _clearance(vehicle: str, layout: MagnetLayout, stated_m: float | None) -> Check:
    readable_m = readable_m_of(layout) if stated_m is None else stated_m
    source = RECALL_SOURCE if stated_m is None else "readable_clearance_m of the site"
    return _at_most(
        f"clearance-{vehicle.replace(' ', '-')}",
        served_distance_m(vehicle, layout.installation),
        readable_m,
        "m",
        f"METRO figure 14a; {source}",
        served_sentence(vehicle, layout.installation, readable_m),
    )


def _shell(installation: Installation) -> Check:
    return _at_most(
        "shell-height",
        installation.height_mm,
        MAX_SHELL_MM,
        "mm",
        "MUTCD (2009), section 3B.11",
        SHELL_NOTE,
    )


# === Spacings of lines at which the magnets repeat with the turns of a wheel, as its own field does.


def turn_bands_m(circumference_m: tuple[float, float]) -> tuple[tuple[float, float], ...]:
    """Spacings of lines to avoid, in rising order: smallest and largest of each band. [m]"""
    low, high = circumference_m
    return tuple((turns * low * (1 - TURN_SLACK), turns * high * (1 + TURN_SLACK)) for turns in TURNS)


def turn_margin_m(spacing_m: float, circumference_m: tuple[float, float]) -> float:
    """How far a spacing is outside of the bands to avoid; negative inside one. [m]"""
    return min(max(low - spacing_m, spacing_m - high) for low, high in turn_bands_m(circumference_m))


def turn_cure(circumference_m: tuple[float, float]) -> str:
    """Spacings that are left, for people."""
    edges = [0.0, *(edge for band in turn_bands_m(circumference_m) for edge in band), MAX_LINE_SPACING_M]
    free = [(max(a, MIN_GAP_M), b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > max(a, MIN_GAP_M)]
    return "choose " + ", ".join(f"{a:.2f} to {b:.2f}" for a, b in free) + " m"


def _wheel_turns(layout: MagnetLayout, site: Site) -> Check:
    spacing_m = float(np.median(np.diff([hole.along_m for hole in layout.holes])))
    low, high = site.wheel_circumference_m
    margin_m = turn_margin_m(spacing_m, site.wheel_circumference_m)
    note = f"{spacing_m:.2f} m from half, one or two turns of wheels of {low:g} to {high:g} m"
    if margin_m < 0:
        note = f"{spacing_m:.2f} m repeats with wheels; {turn_cure(site.wheel_circumference_m)}"
    return _at_least("wheel-turns", margin_m, 0.0, "m", "docs/benchmarks.md: lines of magnets", note)


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


# === A layout with its checks and its bill of materials: what the writers of sheets take.


def drilling_sheet(
    layout: MagnetLayout, site: Site | None = None, neighbours: Sequence[Neighbour] = ()
) -> DrillingSheet:
    """Check a layout and count its materials."""
    return DrillingSheet(layout, check_layout(layout, site or Site(), neighbours), bill_of_materials(layout))
