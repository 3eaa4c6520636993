"""Points that a crew stakes: one a marker, one a magnet of a tag, in the crew's reference system and unit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pyproj import Geod

from app.errors import InvalidParameter
from app.formats.surveys.declaration import METRES
from app.formats.surveys.grids import crs_unit
from app.geodesy import normalize_crs, reference_system
from app.geodesy.from_wgs84 import Floats, Origin, SystemPositions, positions_in_system
from app.planning.alignment import format_station
from app.planning.plan import Plan, PlannedCerpm, PlannedLineMagnet, PlannedMarker, PlannedPlate, PlannedTag

CODES = {"plate": "PLATE", "line": "MAGL", "tag": "MAGT", "cerpm": "CERPM"}
"""Feature codes of the points and layers of the DXF."""
_ZONES = 60  # of UTM; source: DMA TM 8358.2
_GEOD = Geod(ellps="WGS84")
_AHEAD_M = 10.0  # [m] to the second point of a bearing; source: chosen by hand, 0.1 mm of it are 0.0006 degrees
_MAX_LON_SPAN_DEG = 6.0  # of a road in one zone; source: as for exports, a zone's width


@dataclass(frozen=True, slots=True)
class StakePoint:
    """One point.

    Attributes
    ----------
    name : str
        Number of the marker; of a tag's magnets with a letter, e.g. ``12A``.
    kind : str
        Key in `CODES`.
    marker : PlannedMarker
    lon_deg, lat_deg : float
        WGS 84. [deg]
    east, north : float
        In the crew's system and unit.
    height : float or None
        In the crew's unit.
    bearing_deg : float or None
        In which a plate's upper edge and a lying magnet's north pole point, clockwise from grid north; None without
        one. [deg]
    detail : str
        What is set there, without commas.
    station : str
        Displayed station.
    """

    name: str
    kind: str
    marker: PlannedMarker
    lon_deg: float
    lat_deg: float
    east: float
    north: float
    height: float | None
    bearing_deg: float | None
    detail: str
    station: str

    @property
    def code(self) -> str:
        """Feature code."""
        return CODES[self.kind]

    @property
    def description(self) -> str:
        """For the D of PNEZD: code, what it is, lane, station, bearing; without commas."""
        bearing = "" if self.bearing_deg is None else f" BRG {self.bearing_deg % 360.0:.2f}"
        lane = "".join(c if c.isprintable() and c not in ',;"' else " " for c in self.marker.lane)[:40]
        return f"{self.code} {self.detail} LANE {lane} STA {self.station}{bearing}"


@dataclass(frozen=True, slots=True)
class Stakeout:
    """All points of a plan.

    Attributes
    ----------
    plan : Plan
    crs : str
        ``EPSG:code``.
    crs_name : str
    unit : str
        Of coordinates and heights: ``m``, ``ft-intl`` or ``ft-us``.
    accuracy_m : float
        Stated accuracy of the transformation from WGS 84. [m]
    note : str
        The transformation.
    points : tuple of StakePoint
    """

    plan: Plan
    crs: str
    crs_name: str
    unit: str
    accuracy_m: float
    note: str
    points: tuple[StakePoint, ...]


def plan_stakeout(plan: Plan, crs: str | None = None, unit: str | None = None) -> Stakeout:
    """Points of a plan in the crew's reference system and unit.

    Parameters
    ----------
    plan : Plan
    crs : str, optional
        A projected system; without, that of the road, or the UTM zone of WGS 84 that it lies in.
    unit : str, optional
        ``m``, ``ft-intl`` or ``ft-us``; without, the unit of the system.

    Raises
    ------
    ReferenceSystemError
        The system is unknown, not made for this place, or has no transformation with a stated accuracy.
    InvalidParameter
        The system is not projected, there is no such unit, or the plan has no markers.
    """
    if not plan.markers:
        raise InvalidParameter("the plan has no markers", field="plan", limit="at least one", cure="check the rules")
    name = normalize_crs(crs) if crs is not None else _default_system(plan)
    system = reference_system(name)
    if not system.is_projected:
        raise InvalidParameter(
            f"{name} ({system.name}) is geographic, and stakeout takes northing and easting",
            field="crs",
            limit="a projected system",
            cure="choose a projected system, e.g. the UTM zone or the state plane zone of the road",
        )
    own = crs_unit(system)
    unit = unit or own
    if unit not in METRES:
        raise InvalidParameter(
            f"there is no unit {unit[:40]!r}", field="unit", limit=", ".join(METRES), cure="choose one of these"
        )
    places = _places(plan)
    lon, lat, height = (np.array([place[k] for place in places], dtype=np.float64) for k in (2, 3, 4))
    road = plan.alignment
    origin = Origin(
        road.crs,
        road.transform_accuracy_m is not None,
        road.epoch,
        road.vertical_datum == "ellipsoid",
        road.declared_realization,
    )
    found = positions_in_system(lon, lat, height, name, origin=origin)
    scale, up = METRES[own] / METRES[unit], 1.0 / METRES[unit]
    east, north, high = (found.first * scale).tolist(), (found.second * scale).tolist(), (found.height_m * up).tolist()
    bearings = np.array([np.nan if place[6] is None else place[6] for place in places])
    grid = _grid_bearings(lon, lat, height, bearings, found, name, origin).tolist()
    points = tuple(
        StakePoint(
            point, kind, marker, lon_deg, lat_deg, east[k], north[k], high[k] if math.isfinite(high[k]) else None,
            grid[k] if math.isfinite(grid[k]) else None, detail, station,
        )
        for k, (point, marker, lon_deg, lat_deg, _, kind, _, detail, station) in enumerate(places)
    )  # fmt: skip
    return Stakeout(plan, name, str(system.name), unit, found.accuracy_m, found.note, points)


def _grid_bearings(
    lon: Floats, lat: Floats, height: Floats, bearings: Floats, found: SystemPositions, name: str, origin: Origin
) -> Floats:
    """Bearings from grid north of bearings from true north, shape (N,); NaN stays. [deg]"""
    grid = np.full(len(lon), np.nan)
    k = np.flatnonzero(np.isfinite(bearings))
    if len(k):
        ahead_lon, ahead_lat, _ = _GEOD.fwd(lon[k], lat[k], bearings[k], np.full(len(k), _AHEAD_M))
        ahead = positions_in_system(np.asarray(ahead_lon), np.asarray(ahead_lat), height[k], name, origin=origin)
        grid[k] = np.degrees(np.arctan2(ahead.first - found.first[k], ahead.second - found.second[k])) % 360.0
    return grid


_Place = tuple[str, PlannedMarker, float, float, float, str, float | None, str, str]
"""Name, marker, lon, lat, height, kind, bearing, detail, station."""


def _places(plan: Plan) -> list[_Place]:
    road = plan.alignment
    lanes = {lane.name: lane for lane in road.lanes}
    places: list[_Place] = []
    for marker in plan.markers:
        detail = marker.detail
        height = math.nan if marker.height_m is None else marker.height_m
        station = format_station(road.displayed_station_m(marker.station_m))
        here = (marker.lon_deg, marker.lat_deg, height)
        name = str(marker.number)
        match detail:
            case PlannedPlate():
                places.append((name, marker, *here, "plate", marker.heading_deg, detail.code.digits, station))
            case PlannedLineMagnet():
                way = "UP" if detail.tag.polarity.value == "N" else "DOWN"
                side = detail.side.name
                places.append((name, marker, *here, "line", None, f"{side} LINE NORTH POLE {way}", station))
            case PlannedCerpm():
                places.append((name, marker, *here, "cerpm", None, f"{detail.number} {detail.side.name}", station))
            case PlannedTag():
                lane = lanes[marker.lane]
                rise = lane.value_at(lane.height_m, [c for c, _, _ in detail.magnets]) - float(
                    lane.value_at(lane.height_m, marker.chainage_m)
                )
                bearing = tag_bearing_deg(detail)
                for k, ((_, lon, lat), polarity) in enumerate(zip(detail.magnets, detail.tag.polarities, strict=True)):
                    pole = (bearing + (0.0 if polarity.value == "N" else 180.0)) % 360.0
                    text = f"{detail.tag.text} MAGNET {k + 1} NORTH POLE {'FWD' if polarity.value == 'N' else 'BACK'}"
                    letter = chr(ord("A") + k)
                    places.append(
                        (f"{name}{letter}", marker, lon, lat, height + float(rise[k]), "tag", pole, text, station)
                    )
    return places


def tag_bearing_deg(tag: PlannedTag) -> float:
    """Direction from the first magnet of a tag to the last, clockwise from true north. [deg]"""
    (_, lon_a, lat_a), (_, lon_b, lat_b) = tag.magnets[0], tag.magnets[-1]
    return float(_GEOD.inv(lon_a, lat_a, lon_b, lat_b)[0]) % 360.0


def _default_system(plan: Plan) -> str:
    """The road's own system where it is projected, else its UTM zone of WGS 84."""
    road = plan.alignment
    if road.surveyed:
        try:
            name = normalize_crs(road.crs)
            if reference_system(name).is_projected:
                return name
        except InvalidParameter:
            pass  # a system without a code
    lon = np.array([marker.lon_deg for marker in plan.markers])
    if float(np.ptp(lon)) > _MAX_LON_SPAN_DEG:
        raise InvalidParameter(
            "the road is too long for one UTM zone",
            field="crs",
            limit=f"{_MAX_LON_SPAN_DEG:g} degrees of longitude",
            cure="name a projected system that covers the road",
        )
    zone = min(int((float(np.median(lon)) + 180.0) // 6.0) + 1, _ZONES)
    return f"EPSG:{(32600 if plan.markers[0].lat_deg >= 0 else 32700) + zone}"
