"""What a file with a road contains, in the coordinates of the file: lines, events, areas; and what is declared of it.

Every reader returns an `AlignmentFile`. `app.planning.build_alignment` turns it into lanes in WGS 84.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

from pydantic import Field, with_config
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from app.errors import InvalidParameter
from app.formats.surveys.declaration import FEET, METRES, Unit, choose_foot
from app.geodesy import check_lon_lat, normalize_crs, reference_system
from app.geodesy.systems import VerticalDatum
from app.inputs import INPUT, Flag, Number, Text
from app.values import Floats

MAX_VERTICES = 2_000_000
"""Vertices of all lines of a file at most. 1,000 km at 0.5 m."""
CHORD_ERROR_M = 0.001
"""Greatest distance of arcs, spirals and polynomials from the chords that they are sampled by. [m] A tenth of the best
survey's accuracy."""

MAX_COORDINATE = 1e12
"""Largest coordinate or height. Source: app/formats/surveys/read.py, far beyond every projection."""


class BoundaryStyle(StrEnum):
    """How a boundary of a lane is painted."""

    SOLID = "solid"
    DASHED = "dashed"
    NONE = "none"
    UNKNOWN = "unknown"


class EventKind(StrEnum):
    """Events on the road of which a vehicle is informed in advance."""

    STOP_LINE = "stop_line"
    JUNCTION = "junction"
    CROSSING = "crossing"
    ARROW = "arrow"
    SPEED_LIMIT = "speed_limit"
    CURVE = "curve"


@dataclass(frozen=True, slots=True, eq=False)
class LaneGeometry:
    """One lane in its direction of travel, by its centre line or by both boundaries.

    Arrays of values belong to the vertices of `centre`, or of `left` where there is no centre line.
    """

    name: str  # unique in the file
    # `centre`, `left`, `right`: shape (N, 3), or None: longitude, latitude [deg] or easting, northing [unit of the
    # file], and height; height is NaN where the file has none. Either `centre` or both `left` and `right` are given.
    # Curves are sampled within 1 mm.
    centre: Floats | None = None
    left: Floats | None = None
    right: Floats | None = None
    # shape (N,), or None: [1/m] left positive, where the file defines it (arcs, spirals, polynomials). Where it jumps,
    # the vertex stands twice, with the value before and the value after.
    curvature_per_m: Floats | None = None
    # shape (N,), or None: [rad] positive falls to the right in the direction of travel
    superelevation_rad: Floats | None = None
    width_m: Floats | None = None  # shape (N,), or None [m]
    speed_limit_m_s: Floats | None = None  # shape (N,), or None: [m/s] NaN where none is given
    # shape (N,), or None: [m] along the road's reference line, in its direction; decreases along a lane of the opposite
    # direction
    station_m: Floats | None = None
    left_style: BoundaryStyle = BoundaryStyle.UNKNOWN
    right_style: BoundaryStyle = BoundaryStyle.UNKNOWN
    road: str | None = None  # name of the road in the file


@dataclass(frozen=True, slots=True)
class EventGeometry:
    """Something on the road that decides what vehicles must know."""

    kind: EventKind
    point: tuple[float, float]  # in the coordinates of the file
    lane: str | None = None  # name of the lane; None: the nearest one
    # speed limit [km/h], direction of an arrow (`app.markers.magnet_design.Arrow`); None for the others
    value: float | str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class AreaGeometry:
    """An area in which nothing may be installed: joint, manhole, crossing, bridge."""

    kind: str
    ring: Floats  # shape (N, 2): closed outer ring in the coordinates of the file


@dataclass(frozen=True, slots=True)
class StationEquation:
    """Where the displayed station jumps; the geometry stays in true distance."""

    distance_m: float  # [m] True distance from the start of the reference line
    # `back_m`, `ahead_m`: [m] displayed stations before and after
    back_m: float
    ahead_m: float
    rate: float = 1.0  # [1] displayed metres in a metre from there on; negative where stations fall


@dataclass(frozen=True, slots=True)
class Stationing:
    """Stations along a road as signs and drawings show them."""

    start_m: float = 0.0  # [m] of the start of the reference line
    equations: tuple[StationEquation, ...] = ()

    def displayed_m(self, distance_m: float) -> float:
        """Station at a true distance along the reference line. [m]"""
        number = bisect_right([equation.distance_m for equation in self.equations], distance_m)
        if number == 0:
            return self.start_m + distance_m
        last = self.equations[number - 1]
        return last.ahead_m + last.rate * (distance_m - last.distance_m)


@dataclass(frozen=True, slots=True)
class EarlierTransformation:
    """Coordinates that were transformed into the file's CRS before."""

    # whether a transformation with a stated accuracy did it; otherwise positions are unfit for localization
    exact: bool
    note: str | None  # how, for people
    accuracy_m: float | None = None  # [m] its accuracy; None in documents that were written without it


@dataclass(frozen=True, slots=True)
class AlignmentFile:
    """Content of a file with a road."""

    format: str  # name of the format, as in `app.formats.alignments.read`
    lanes: tuple[LaneGeometry, ...]
    # as the file states it: ``EPSG:code``, WKT or a PROJ string; None if it states none that places it on Earth
    crs: str | None = None
    crs_problem: str | None = None  # why the stated reference cannot be used, for people; with it, `crs` is None
    # [m] length of the file's unit of easting, northing and height; None: the unit of its CRS, or metres without one
    unit_m: float | None = 1.0
    events: tuple[EventGeometry, ...] = ()
    areas: tuple[AreaGeometry, ...] = ()
    stationing: Mapping[str, Stationing] = field(default_factory=dict)  # by road; without, true distances from 0
    warnings: tuple[str, ...] = ()  # what was left out or repaired, in sentences for people
    earlier: EarlierTransformation | None = None  # of all coordinates, before they came into the file


# === What is declared of a file with a road, as for surveys: CRS, realization, epoch, heights, units, or an origin.


MAX_EPOCH = (1900.0, 2100.0)
"""Plausible coordinate epochs. [decimal year]"""


@with_config(INPUT)
@dataclass(frozen=True, slots=True)
class AlignmentDeclaration:
    """What is declared of a file with a road; what the file states may be left out."""

    # one that contradicts the file is an error
    crs: Annotated[Text | None, Field(max_length=64, examples=["EPSG:25832"])] = None
    realization: Annotated[Text | None, Field(max_length=64, examples=["ITRF2014"])] = None
    epoch: Annotated[Number | None, Field(ge=MAX_EPOCH[0], le=MAX_EPOCH[1], description="Decimal year.")] = None
    vertical_datum: Annotated[
        VerticalDatum | None,
        Field(
            examples=["ellipsoid"],
            description="`ellipsoid`, or the datum of the heights; needed where a file with a CRS has heights.",
        ),
    ] = None
    # `unit`, `height_unit`: those of the file or of its CRS without
    unit: Unit | None = None
    height_unit: Unit | None = None
    ignore_heights: Flag = False
    origin: Annotated[
        tuple[Number, Number] | None,
        Field(description="Longitude and latitude of the origin of local coordinates. Such a road is not surveyed."),
    ] = None
    bearing_deg: Annotated[
        Number, Field(ge=-360, le=360, description="Direction of the local y axis; only with `origin`. [deg]")
    ] = 0.0

    def __post_init__(self) -> None:
        for name, value in (("unit", self.unit), ("height_unit", self.height_unit)):
            if value not in (None, *METRES):
                raise InvalidParameter(
                    f"there is no unit {str(value)[:40]!r}",
                    field=name,
                    limit=", ".join(METRES),
                    cure="declare another",
                )
        if self.epoch is not None and not MAX_EPOCH[0] <= self.epoch <= MAX_EPOCH[1]:
            raise InvalidParameter(
                f"the epoch is {self.epoch}",
                field="epoch",
                limit=f"{MAX_EPOCH[0]:g} to {MAX_EPOCH[1]:g}",
                cure="declare the epoch as a decimal year, e.g. 2010.0",
            )
        if not math.isfinite(self.bearing_deg) or abs(self.bearing_deg) > 360:
            raise InvalidParameter(
                f"the bearing is {self.bearing_deg}",
                field="bearing_deg",
                limit="-360 to 360 deg",
                cure="declare another",
            )
        if self.origin is not None:
            check_lon_lat(*self.origin, field="origin")
        if self.origin is not None and self.crs is not None:
            raise InvalidParameter(
                "both a CRS and an origin are declared",
                field="origin",
                limit="one of the two",
                cure="declare crs for coordinates on Earth, origin for local ones",
            )
        if self.origin is None and self.bearing_deg:
            raise InvalidParameter(
                "a bearing is declared without an origin",
                field="bearing_deg",
                limit="only with origin",
                cure="declare the origin that the road is turned about",
            )


def unit_length_m(
    unit: tuple[str, float], declaration: AlignmentDeclaration, crs: str | None
) -> tuple[float, list[str]]:
    """Length of a unit that a file states, and a note if it is a foot of which the file does not state which. [m]

    Parameters
    ----------
    unit : tuple
        One of `METRES` or `FEET`, and how many of it the unit is.
    crs : str or None
        That of the file.
    """
    name, count = unit
    if name != FEET:
        return METRES[name] * count, []
    stated = crs or declaration.crs
    system = reference_system(normalize_crs(stated)) if stated is not None and declaration.origin is None else None
    is_projected = system is not None and system.is_projected
    own_m = float(system.axis_info[0].unit_conversion_factor) if system is not None and is_projected else 1.0
    foot, of_crs = choose_foot(declaration.unit, own_m)
    why = f"the unit of {system.name}" if system is not None and of_crs else "because the CRS is not in feet"
    note = (
        f"The file is in feet without stating which; they were read as {foot}, {why}. If this is wrong, declare unit "
        "ft-us or ft-intl; they differ by 2 ppm, a metre in 500 km."
    )
    return METRES[foot] * count, [note] if foot != declaration.unit else []


# === Whether what a file states as its reference system places its coordinates on Earth.


CURE = "give the origin of its local coordinates (--origin LON,LAT), or state a complete reference system"
_MAX_TEXT = 8192
"""Characters. A WKT of a compound system has 4,000."""
_FILES = re.compile(r"\+(?P<key>geoidgrids|nadgrids|grids)\s*=\s*(?P<name>[^\s+]+)|\+init\s*=|proj\s*=\s*pipeline")
_LAT_LON = re.compile(r"\+(?P<key>lat_0|lon_0)\s*=\s*(?P<value>[-+.\deE]+)")
_FALSE_EASTING_M = 100_000.0
"""A system with a false easting above this has its origin far from where it is used. [m] Source: UTM has 500 km."""
_NEAR_ORIGIN_M = 20_000.0
"""Coordinates this near to 0, 0 of such a system are local ones. [m] The strip of a UTM zone begins 166 km from its
false origin at the equator."""
_NULL_DEG = 0.2
"""Nearer to 0 E, 0 N there is no road, but the origin of projections without lat_0 and lon_0. [deg]"""
_AREA_MARGIN_DEG = 1.0
"""About an area of use. [deg] Source: as for positions in `app.geodesy`."""


def usable_crs(text: str | None, x: float, y: float) -> tuple[str | None, str | None]:
    """The reference system of a file in metres, if it places the file on Earth.

    Parameters
    ----------
    text : str or None
        EPSG code, WKT or PROJ string as the file states it.
    x, y : float
        A place of the file in that system. [m]

    Returns
    -------
    crs : str or None
        ``EPSG:code`` where the registry has the system, otherwise its WKT.
    problem : str or None
        Why it cannot be used, with the cure; None with a `crs`.
    """
    if text is None:
        return None, f"The file states no reference system (geoReference); {CURE}."
    text = text.strip()
    if not text:
        return None, f"The geoReference is empty; {CURE}."
    if len(text) > _MAX_TEXT:
        return None, f"The geoReference has {len(text)} characters, more than {_MAX_TEXT}; {CURE}."
    if found := _FILES.search(text):
        part = f"+{found['key']}={found['name'][:60]}" if found["key"] else found[0]
        return None, (
            f"The geoReference refers to a file that is not at hand ({part}); leave this part out of geoReference "
            f"if it concerns heights alone, or {CURE}."
        )
    try:
        system = CRS.from_user_input(text)
    except CRSError:
        given = {match["key"]: match["value"] for match in _LAT_LON.finditer(text)}
        if "+proj" not in text and len(given) == 2:
            return None, (
                "The geoReference has lat_0 and lon_0 without a projection; give them as the origin of its local "
                f"coordinates (--origin {given['lon_0'][:20]},{given['lat_0'][:20]})."
            )
        return None, f"The geoReference {text[:80]!r} is not a reference system; {CURE}."
    return _placed(system, x, y)


def _placed(system: CRS, x: float, y: float) -> tuple[str | None, str | None]:
    if system.is_compound and system.sub_crs_list:
        system = system.sub_crs_list[0]
    if system.is_bound and system.source_crs is not None:
        system = system.source_crs
    system = system.to_2d()
    if not system.is_projected or system.geodetic_crs is None or system.coordinate_operation is None:
        return None, f"The geoReference is a {system.type_name}, and the coordinates are metres on a plane; {CURE}."
    if any(axis.unit_conversion_factor != 1.0 for axis in system.axis_info[:2]):
        return None, f"The geoReference is not in metres, and OpenDRIVE's coordinates are; {CURE}."
    shift = max(
        (
            abs(float(p.value)) * p.unit_conversion_factor
            for p in system.coordinate_operation.params
            if "easting" in p.name
        ),
        default=0.0,
    )
    if shift > _FALSE_EASTING_M and math.hypot(x, y) < _NEAR_ORIGIN_M:
        return None, _lands_outside(system, x, y)
    try:
        lon, lat = Transformer.from_crs(system, system.geodetic_crs, always_xy=True).transform(x, y)
    except ProjError:
        lon = lat = math.inf
    area = system.area_of_use
    inside = math.isfinite(lon) and math.isfinite(lat)
    if inside and area is not None:
        across = (lon - area.west + _AREA_MARGIN_DEG) % 360.0
        inside = across <= ((area.east - area.west) % 360.0 or 360.0) + 2 * _AREA_MARGIN_DEG
        inside &= area.south - _AREA_MARGIN_DEG <= lat <= area.north + _AREA_MARGIN_DEG
    if not inside or max(abs(lon), abs(lat)) < _NULL_DEG:
        return None, _lands_outside(system, x, y)
    datum = system.geodetic_crs.datum
    known = datum is not None and not datum.name.startswith("Unknown")  # PROJ takes any datum on its ellipsoid
    code = system.to_epsg() if known else None
    return (f"EPSG:{code}" if code else system.to_wkt()), None


def _lands_outside(system: CRS, x: float, y: float) -> str:
    return (
        f"The coordinates (near {x:.9g}, {y:.9g}) are local ones: in the stated geoReference ({system.name[:60]}) they "
        f"lie outside its area; {CURE}."
    )
