"""Coordinate reference systems, local frames and bearings."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import pymap3d
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError
from pyproj.transformer import TransformerGroup

from app.errors import InvalidParameter, ReferenceSystemError


def enu_from_wgs84(
    lon_deg: float, lat_deg: float, height_m: float, origin: tuple[float, float, float]
) -> npt.NDArray[np.float64]:
    """East, north, up from an origin (lon_deg, lat_deg, ellipsoidal height_m), shape (3,). [m]"""
    return np.array(pymap3d.geodetic2enu(lat_deg, lon_deg, height_m, origin[1], origin[0], origin[2]), dtype=float)


def wgs84_from_enu(
    position_enu_m: npt.NDArray[np.float64], origin: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Longitude [deg], latitude [deg], ellipsoidal height [m] of a point in a local east, north, up frame."""
    east, north, up = (float(v) for v in position_enu_m)
    lat, lon, height = pymap3d.enu2geodetic(east, north, up, origin[1], origin[0], origin[2])
    return (float(lon) + 180.0) % 360.0 - 180.0, float(lat), float(height)


def enu_from_heading(heading_deg: float) -> npt.NDArray[np.float64]:
    """Rotation from (right, forward, up) of something with this heading to (east, north, up), shape (3, 3)."""
    h = math.radians(heading_deg)
    return np.array([[math.cos(h), math.sin(h), 0], [-math.sin(h), math.cos(h), 0], [0, 0, 1.0]])


def check_lon_lat(lon_deg: float, lat_deg: float, field: str = "position") -> None:
    """Refuse a longitude or latitude that is out of range or not finite."""
    for name, value, bound in (("lon_deg", lon_deg, 180.0), ("lat_deg", lat_deg, 90.0)):
        if not math.isfinite(value) or not -bound <= value <= bound:
            raise InvalidParameter(
                f"{name} is {value}, outside -{bound:g} to {bound:g} degrees",
                field=f"{field}.{name}",
                limit=f"-{bound:g} to {bound:g} deg",
                cure="positions are longitude, latitude in degrees; check for swapped axes or another CRS",
            )


# --- positions as they are given ----------------------------------------------------------------------------------

WGS84 = "EPSG:4326"
_ITRF2014_2D, _ITRF2014_3D = "EPSG:9000", "EPSG:7912"
_GLOBAL_DATUM = re.compile(
    r"World Geodetic System 1984( ensemble| \(G\d+\))?$|International Terrestrial Reference Frame "
)
_GLOBAL_REALIZATION = re.compile(r"(WGS ?84|ITRF|IGS|IGb)", re.IGNORECASE)
_EPSG_FORMS = (
    re.compile(r"EPSG:(?P<code>[0-9]{4,6})", re.IGNORECASE),
    re.compile(r"urn:ogc:def:crs:EPSG:[0-9.]*:(?P<code>[0-9]{4,6})", re.IGNORECASE),
    re.compile(r"https?://www\.opengis\.net/def/crs/EPSG/0/(?P<code>[0-9]{4,6})", re.IGNORECASE),
)
_CRS84_FORMS = ("OGC:CRS84", "URN:OGC:DEF:CRS:OGC:1.3:CRS84", "URN:OGC:DEF:CRS:OGC::CRS84")
_CRS_RULE = "an EPSG code or OGC:CRS84"
_CRS_CURE = "write EPSG:4326, EPSG:6318, urn:ogc:def:crs:EPSG::2326, ...; without a CRS the position is WGS 84"
_OUTSIDE_DEG = 1.0


class LocalizationGrade(StrEnum):
    """Whether a position may be used to localize a vehicle."""

    EXACT = "exact"
    APPROXIMATE = "approximate, not for localization"


@dataclass(frozen=True, slots=True)
class PlacedPosition:
    """A position in WGS 84 / ITRF, with what is known of the way there.

    Attributes
    ----------
    lon_deg, lat_deg : float
        Longitude and latitude. [deg]
    height_m : float or None
        Above the ellipsoid if it was, else above the vertical datum it came with. [m]
    crs : str
        The CRS it was given in, in the form ``EPSG:code`` or ``OGC:CRS84``.
    realization : str or None
        Frame of lon_deg, lat_deg: as stated, or the one it was transformed into.
    transform_accuracy_m : float or None
        Stated bound of the transformation; 0 without one, None if there is no bound. [m]
    grade : LocalizationGrade
    note : str or None
        Why it is only approximate, or what was done.
    """

    lon_deg: float
    lat_deg: float
    height_m: float | None
    crs: str
    realization: str | None
    transform_accuracy_m: float | None
    grade: LocalizationGrade
    note: str | None = None


def place_position(
    first: float,
    second: float,
    height_m: float | None = None,
    *,
    crs: str | None = None,
    projected: bool = False,
    realization: str | None = None,
    epoch: float | None = None,
    ellipsoidal_height: bool = True,
    accuracy_m: float = 0.1,
) -> PlacedPosition:
    """Bring a position as it was given to WGS 84 / ITRF, and say how good that is.

    Parameters
    ----------
    first, second : float
        Longitude and latitude [deg], or easting and northing [m] where `projected`.
    height_m : float, optional
        Height as given. [m]
    crs : str, optional
        EPSG code, URN or URI; WGS 84 without.
    projected : bool
        The coordinates are easting and northing.
    realization : str, optional
        Frame as stated by the surveyor, e.g. ``ITRF2014``.
    epoch : float, optional
        Coordinate epoch. [decimal year]
    ellipsoidal_height : bool
        The height is above the ellipsoid and takes part in the transformation.
    accuracy_m : float
        Worst stated accuracy of a transformation whose result still counts as exact. [m]

    Raises
    ------
    ReferenceSystemError
        The CRS is unknown or of a kind that places nothing on a road.
    InvalidParameter
        The coordinates are not finite, out of range, or far outside the CRS's area of use.

    Notes
    -----
    PROJ takes NAD83(2011) to EPSG:4326 by a null shift and fills in an epoch without a word. So other systems are
    transformed to ITRF2014 by operations that state an accuracy and, where they depend on time, with a given epoch
    only. Whatever remains is placed as well as possible and graded approximate.
    """
    name = normalize_crs(crs)
    system = _system(name)
    if projected != bool(system.is_projected):
        wanted = "easting_m and northing_m" if system.is_projected else "lon_deg and lat_deg"
        raise InvalidParameter(
            f"{name} is a {'projected' if system.is_projected else 'geographic'} system: give {wanted}",
            field="position",
            limit=wanted,
            cure=f"send {wanted}, or the CRS that belongs to these coordinates",
        )
    if not projected:
        check_lon_lat(first, second)
    lon_deg, lat_deg = _wgs84_without_bound(name, first, second)
    _check_area(system, name, lon_deg, lat_deg)
    if _is_global(system):
        return _placed_globally(name, lon_deg, lat_deg, height_m, realization)
    height = height_m if ellipsoidal_height else None
    moved = _itrf2014(name, first, second, height, epoch, accuracy_m)
    if isinstance(moved, str):
        return PlacedPosition(
            lon_deg, lat_deg, height_m, name, None, None, LocalizationGrade.APPROXIMATE, f"from {name}: {moved}"
        )
    lon_deg, lat_deg, moved_height, bound_m = moved
    return PlacedPosition(
        lon_deg,
        lat_deg,
        moved_height if height is not None else height_m,
        name,
        "ITRF2014",
        bound_m,
        LocalizationGrade.EXACT,
        f"transformed from {name} to ITRF2014, stated accuracy {bound_m:g} m",
    )


@dataclass(frozen=True, slots=True)
class PlacedPositions:
    """Positions in WGS 84 / ITRF that came the same way; as `PlacedPosition`, with arrays of shape (N,).

    `placed` is False where a position is not finite, out of range, or far outside the area of use: NaN stands there.
    """

    lon_deg: npt.NDArray[np.float64]
    lat_deg: npt.NDArray[np.float64]
    height_m: npt.NDArray[np.float64]
    placed: npt.NDArray[np.bool_]
    crs: str
    realization: str | None
    transform_accuracy_m: float | None
    grade: LocalizationGrade
    note: str | None


def place_positions(
    first: npt.NDArray[np.float64],
    second: npt.NDArray[np.float64],
    height_m: npt.NDArray[np.float64],
    *,
    crs: str | None = None,
    realization: str | None = None,
    epoch: float | None = None,
    ellipsoidal_height: bool = True,
    accuracy_m: float = 0.1,
) -> PlacedPositions:
    """Bring many positions to WGS 84 / ITRF at once, each as `place_position` would.

    Parameters
    ----------
    first, second : ndarray, shape (N,)
        Longitude and latitude [deg], or easting and northing in the unit of the CRS.
    height_m : ndarray, shape (N,)
        Height as given; NaN where there is none. [m]
    crs, realization, epoch, ellipsoidal_height, accuracy_m
        As for `place_position`.

    Raises
    ------
    ReferenceSystemError
        As for `place_position`.
    """
    name = normalize_crs(crs)
    system = _system(name)
    lon, lat = _inside(system, *_many_wgs84(name, system, first, second))
    known = np.isfinite(lon)
    heights = height_m if ellipsoidal_height else np.full_like(height_m, np.nan)
    sample = int(np.argmax(known)) if known.any() else None
    if sample is None or _is_global(system):
        one = _placed_globally(name, 0.0, 0.0, None, realization)
        return PlacedPositions(
            lon, lat, height_m, known, name, one.realization, one.transform_accuracy_m, one.grade, one.note
        )
    has_height = bool(np.isfinite(heights[known]).all())
    moved = _itrf2014(
        name,
        float(first[sample]),
        float(second[sample]),
        float(heights[sample]) if has_height else None,
        epoch,
        accuracy_m,
    )
    if isinstance(moved, str):
        grade, note = LocalizationGrade.APPROXIMATE, f"from {name}: {moved}"
        return PlacedPositions(lon, lat, height_m, known, name, None, None, grade, note)
    operation = _bounded_operation(name, has_height)
    assert operation is not None
    zeros = np.zeros_like(first)
    x, y, z, _ = operation[0].transform(
        first, second, np.where(np.isfinite(heights), heights, 0.0), zeros + (epoch or 0.0)
    )
    reached = known & np.isfinite(x) & np.isfinite(y)
    return PlacedPositions(
        np.where(reached, x, np.nan),
        np.where(reached, y, np.nan),
        np.where(reached, z, np.nan) if has_height else height_m,
        reached,
        name,
        "ITRF2014",
        moved[3],
        LocalizationGrade.EXACT,
        f"transformed from {name} to ITRF2014, stated accuracy {moved[3]:g} m",
    )


def _many_wgs84(
    name: str, system: CRS, first: npt.NDArray[np.float64], second: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Longitudes and latitudes, not finite where there are none."""
    if system.is_geographic and _is_global(system):
        return first, second
    lon, lat = _best_effort(name).transform(first, second)
    return np.asarray(lon, dtype=np.float64), np.asarray(lat, dtype=np.float64)


def _inside(
    system: CRS, lon_deg: npt.NDArray[np.float64], lat_deg: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """The positions, with NaN for those that are out of range or far outside the area of use."""
    inside = (np.abs(lon_deg) <= 180.0) & (np.abs(lat_deg) <= 90.0)
    area = system.area_of_use
    if area is not None:
        west, east = area.west - _OUTSIDE_DEG, area.east + _OUTSIDE_DEG
        across = (
            (lon_deg >= west) & (lon_deg <= east) if area.west <= area.east else (lon_deg >= west) | (lon_deg <= east)
        )
        inside &= across & (lat_deg >= area.south - _OUTSIDE_DEG) & (lat_deg <= area.north + _OUTSIDE_DEG)
    return np.where(inside, lon_deg, np.nan), np.where(inside, lat_deg, np.nan)


def normalize_crs(crs: str | None) -> str:
    """``EPSG:code`` or ``OGC:CRS84`` from the forms that people and standards write.

    Raises
    ------
    ReferenceSystemError
        It has another form. WKT and PROJ strings are refused: they can name files.
    """
    if crs is None:
        return WGS84
    if crs.strip().upper() in _CRS84_FORMS or crs.strip() == "http://www.opengis.net/def/crs/OGC/1.3/CRS84":
        return "OGC:CRS84"
    for form in _EPSG_FORMS:
        if found := form.fullmatch(crs.strip()):
            return f"EPSG:{int(found['code'])}"
    raise ReferenceSystemError(
        f"{crs[:80]!r} is not a coordinate reference system that is known here",
        field="position.crs",
        limit=_CRS_RULE,
        cure=_CRS_CURE,
    )


def reference_system(crs: str | None) -> CRS:
    """The system behind a name in any of the forms of `normalize_crs`.

    Raises
    ------
    ReferenceSystemError
        It is unknown or of a kind that places nothing on a road.
    """
    return _system(normalize_crs(crs))


@lru_cache(maxsize=256)
def _system(name: str) -> CRS:
    try:
        system = CRS.from_user_input(name)
    except CRSError as error:
        raise ReferenceSystemError(
            f"{name} is not in the EPSG registry", field="position.crs", limit=_CRS_RULE, cure=_CRS_CURE
        ) from error
    usable = (system.is_geographic or system.is_projected) and not system.is_compound and not system.is_bound
    if not usable or system.geodetic_crs is None or system.geodetic_crs.datum is None:
        raise ReferenceSystemError(
            f"{name} ({system.name}) is a {system.type_name}; it does not place a marker by itself",
            field="position.crs",
            limit="geographic or projected",
            cure="give the horizontal system as crs and the height's system as vertical_datum",
        )
    return system


def _is_global(system: CRS) -> bool:
    datum = system.geodetic_crs.datum if system.geodetic_crs is not None else None
    return datum is not None and _GLOBAL_DATUM.match(datum.name) is not None


@lru_cache(maxsize=256)
def _best_effort(name: str) -> Transformer:
    return Transformer.from_crs(name, WGS84, always_xy=True)


def _wgs84_without_bound(name: str, first: float, second: float) -> tuple[float, float]:
    if _system(name).is_geographic and _is_global(_system(name)):
        return first, second
    lon_deg, lat_deg = _best_effort(name).transform(first, second)
    if not (math.isfinite(lon_deg) and math.isfinite(lat_deg)):
        raise _outside(name, _system(name))
    return float(lon_deg), float(lat_deg)


def _check_area(system: CRS, name: str, lon_deg: float, lat_deg: float) -> None:
    area = system.area_of_use
    if area is None:
        return
    west, east = area.west - _OUTSIDE_DEG, area.east + _OUTSIDE_DEG
    inside = west <= lon_deg <= east if area.west <= area.east else lon_deg >= west or lon_deg <= east
    if not inside or not area.south - _OUTSIDE_DEG <= lat_deg <= area.north + _OUTSIDE_DEG:
        raise _outside(name, system)


def _outside(name: str, system: CRS) -> InvalidParameter:
    area = system.area_of_use
    bounds = ", ".join(f"{v:g}" for v in area.bounds) if area is not None else "unknown"
    return InvalidParameter(
        f"the position lies outside the area of use of {name} ({system.name})",
        field="position",
        limit=f"west, south, east, north: {bounds} deg",
        cure="check the CRS and the order of the axes (longitude or easting first)",
    )


def _placed_globally(
    name: str, lon_deg: float, lat_deg: float, height_m: float | None, realization: str | None
) -> PlacedPosition:
    if realization is not None and not _GLOBAL_REALIZATION.match(realization):
        note = f"the realization {realization} is not one of {name}; no transformation was made"
        return PlacedPosition(lon_deg, lat_deg, height_m, name, realization, None, LocalizationGrade.APPROXIMATE, note)
    return PlacedPosition(lon_deg, lat_deg, height_m, name, realization, 0.0, LocalizationGrade.EXACT)


@lru_cache(maxsize=256)
def _bounded_operation(name: str, three_d: bool) -> tuple[Transformer, float] | None:
    """The operation to ITRF2014 with the best stated accuracy, if there is any."""
    target = _ITRF2014_3D if three_d else _ITRF2014_2D
    source = _system(name).to_3d() if three_d else _system(name).to_2d()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # it warns of missing grids, which only narrow the choice
        group = TransformerGroup(source, target, always_xy=True, allow_ballpark=False)
    stated = [transformer for transformer in group.transformers if transformer.accuracy >= 0]
    if not stated:
        return None
    best = min(stated, key=lambda transformer: transformer.accuracy)
    return best, float(best.accuracy)


def _itrf2014(
    name: str, first: float, second: float, height_m: float | None, epoch: float | None, accuracy_m: float
) -> tuple[float, float, float, float] | str:
    """Longitude, latitude, height and stated accuracy, or why there are none."""
    operation = _bounded_operation(name, height_m is not None)
    if operation is None:
        return "no transformation with a stated accuracy to WGS 84 / ITRF is available"
    transformer, bound_m = operation
    if bound_m > accuracy_m:
        return f"the best transformation states {bound_m:g} m, the limit is {accuracy_m:g} m"
    if "t_epoch" in transformer.definition and epoch is None:
        return "the transformation depends on time and no epoch was given"
    lon, lat, height, _ = transformer.transform(first, second, height_m or 0.0, epoch or 0.0)
    if not all(math.isfinite(v) for v in (lon, lat, height)):
        return "the transformation does not reach this position"
    return float(lon), float(lat), float(height), bound_m
