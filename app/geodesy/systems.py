"""Coordinate reference systems: names in their usual forms, and areas of use."""

from __future__ import annotations

import math
import re
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from app.errors import InvalidParameter, ReferenceSystemError

WGS84 = "EPSG:4326"
_GLOBAL_DATUM = re.compile(
    r"World Geodetic System 1984( ensemble| \(G\d+\))?$|International Terrestrial Reference Frame "
)
_EPSG_FORMS = (
    re.compile(r"EPSG:(?P<code>[0-9]{4,6})", re.IGNORECASE),
    re.compile(r"urn:ogc:def:crs:EPSG:[0-9.]*:(?P<code>[0-9]{4,6})", re.IGNORECASE),
    re.compile(r"https?://www\.opengis\.net/def/crs/EPSG/0/(?P<code>[0-9]{4,6})", re.IGNORECASE),
)
_CRS84_FORMS = ("OGC:CRS84", "URN:OGC:DEF:CRS:OGC:1.3:CRS84", "URN:OGC:DEF:CRS:OGC::CRS84")
_CRS_RULE = "an EPSG code or OGC:CRS84"
_CRS_CURE = "write EPSG:4326, EPSG:6318, urn:ogc:def:crs:EPSG::2326, ...; without a CRS the position is WGS 84"
_OUTSIDE_DEG = 1.0  # [deg] margin about an area of use; source: by hand, 111 km


def normalize_crs(crs: str | None) -> str:
    """``EPSG:code`` or ``OGC:CRS84`` from the usual forms of a name.

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
    return named_system(normalize_crs(crs))


@lru_cache(maxsize=256)
def named_system(name: str) -> CRS:
    """The system with a name that `normalize_crs` wrote; raises as `reference_system`."""
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


def is_global(system: CRS) -> bool:
    """Whether coordinates in it are in WGS 84 or an ITRF, or projected from there."""
    datum = system.geodetic_crs.datum if system.geodetic_crs is not None else None
    return datum is not None and _GLOBAL_DATUM.match(datum.name) is not None


@lru_cache(maxsize=256)
def best_effort(name: str) -> Transformer:
    """To WGS 84 by the operation that PROJ prefers, with or without a stated accuracy."""
    return Transformer.from_crs(name, WGS84, always_xy=True)


@lru_cache(maxsize=256)
def geographic_from(name: str) -> Transformer | None:
    """From a projected system to longitudes and latitudes on its own datum, which is exact; None where it has these."""
    system = named_system(name)
    return Transformer.from_crs(name, system.geodetic_crs, always_xy=True) if system.is_projected else None


def wgs84_without_bound(name: str, first: float, second: float) -> tuple[float, float]:
    """Longitude and latitude of a place, without a stated accuracy. [deg]"""
    if named_system(name).is_geographic and is_global(named_system(name)):
        return first, second
    lon_deg, lat_deg = best_effort(name).transform(first, second)
    if not (math.isfinite(lon_deg) and math.isfinite(lat_deg)):
        raise _outside(name, named_system(name))
    return float(lon_deg), float(lat_deg)


def covers(
    area: Any, lon_deg: npt.NDArray[np.float64], lat_deg: npt.NDArray[np.float64], margin_deg: float = 0.0
) -> npt.NDArray[np.bool_]:
    """Which places lie in an area of use, or within a margin of it; without an area all do."""
    if area is None:
        return np.ones(np.shape(lon_deg), dtype=np.bool_)
    west, east = area.west - margin_deg, area.east + margin_deg
    across = (lon_deg >= west) & (lon_deg <= east) if area.west <= area.east else (lon_deg >= west) | (lon_deg <= east)
    return np.asarray(across & (lat_deg >= area.south - margin_deg) & (lat_deg <= area.north + margin_deg))


def check_area(system: CRS, name: str, lon_deg: float, lat_deg: float) -> None:
    """Check that a place is not far outside the system's area of use.

    Raises
    ------
    InvalidParameter
        It is.
    """
    if not covers(system.area_of_use, np.array([lon_deg]), np.array([lat_deg]), _OUTSIDE_DEG)[0]:
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


def many_wgs84(
    name: str, system: CRS, first: npt.NDArray[np.float64], second: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Longitudes and latitudes, not finite where there are none."""
    if system.is_geographic and is_global(system):
        return first, second
    lon, lat = best_effort(name).transform(first, second)
    return np.asarray(lon, dtype=np.float64), np.asarray(lat, dtype=np.float64)


def inside_area(
    system: CRS, lon_deg: npt.NDArray[np.float64], lat_deg: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """The positions, with NaN for those that are out of range or far outside the area of use."""
    inside = (np.abs(lon_deg) <= 180.0) & (np.abs(lat_deg) <= 90.0)
    inside &= covers(system.area_of_use, lon_deg, lat_deg, _OUTSIDE_DEG)
    return np.where(inside, lon_deg, np.nan), np.where(inside, lat_deg, np.nan)
