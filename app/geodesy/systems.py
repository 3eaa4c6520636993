"""Coordinate reference systems: names in their usual forms, areas of use, realizations and vertical parts."""

from __future__ import annotations

import math
import re
from functools import lru_cache
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, Field
from pyproj import CRS, Transformer
from pyproj.crs import GeographicCRS
from pyproj.crs.coordinate_system import Ellipsoidal2DCS
from pyproj.crs.enums import Ellipsoidal2DCSAxis
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import CRSError

from app.errors import InvalidParameter, ReferenceSystemError
from app.inputs import Text

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
_OUTSIDE_DEG = 1.0  # [deg] margin about an area of use; 111 km


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


_UNKNOWN_TO_PROJ = (
    "Lambert Conic Conformal (West Orientated)",
    "Bonne (South Orientated)",
    "Polar Stereographic (variant C)",
    "Tunisia Mining Grid",
    "Lambert Conic Near-Conformal",
    "Transverse Mercator Zoned Grid System",
)
"""Projections that PROJ does not compute: 23 of the systems of the registry have one of them."""


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
    operation = system.coordinate_operation if system.is_projected else None
    if operation is not None and operation.method_name in _UNKNOWN_TO_PROJ:
        raise ReferenceSystemError(
            f"{name} ({system.name}) is in a projection that is not computed here",
            field="position.crs",
            limit=f"others than {', '.join(_UNKNOWN_TO_PROJ)}",
            cure=_CRS_CURE,
        )
    return system


@lru_cache(maxsize=64)
def system_of_wkt(wkt: str) -> tuple[CRS, str]:
    """A projected system that the EPSG registry does not list, such as a county's grid, and what it projects from.

    Returns
    -------
    CRS
        The projected system.
    str
        ``EPSG:code`` of the geographic system with the same datum: the way from one to the other is exact.

    Raises
    ------
    ReferenceSystemError
        It is not projected, refers to files, or its datum is not in the registry.
    """
    try:
        system = CRS.from_wkt(wkt)
    except CRSError as error:
        raise _unusable_wkt("the file states a coordinate reference system that cannot be read") from error
    shown = f"the file is in {system.name[:60]!r}, which has no EPSG code,"
    base = system.geodetic_crs
    if not system.is_projected or system.is_compound or system.is_bound or base is None or "EXTENSION[" in wkt.upper():
        raise _unusable_wkt(f"{shown} and is not a plain projected system")
    code = geographic_code(base)
    if code is None:
        raise _unusable_wkt(f"{shown} and its datum {base.name[:60]!r} is not in the EPSG registry either")
    return system, code


def geographic_code(base: CRS) -> str | None:
    """``EPSG:code`` of the geographic system with two axes on the datum of another one, by the datum's name.

    It has the same meridian and unit; the order of the axes may differ.
    """
    if base.datum is None or base.prime_meridian is None:
        return None
    datum, unit = _datum_name(base), base.axis_info[0].unit_conversion_factor
    flat = base
    if abs(unit - math.radians(1.0)) < 1e-12:  # systems with three axes, or with the longitude first, are not listed
        order = Ellipsoidal2DCS(axis=Ellipsoidal2DCSAxis.LATITUDE_LONGITUDE)
        flat = GeographicCRS(name=base.name, datum=base.datum, ellipsoidal_cs=order)
    for listed in flat.list_authority("EPSG", min_confidence=25):
        known = CRS.from_epsg(int(listed.code))  # the geocentric system of the datum is among them
        if known.is_geographic and len(known.axis_info) == 2 and _datum_name(known) == datum:
            meridian, own = base.prime_meridian, known.prime_meridian
            is_same = own is not None and meridian.longitude == own.longitude
            if is_same and abs(known.axis_info[0].unit_conversion_factor - unit) < 1e-12:
                return f"EPSG:{listed.code}"
    return None


def _datum_name(system: CRS) -> str:
    """Name of a datum; files that were written before there were ensembles have it without that word."""
    assert system.datum is not None
    return system.datum.name.removesuffix(" ensemble")


def _unusable_wkt(message: str) -> ReferenceSystemError:
    return ReferenceSystemError(
        message,
        field="crs",
        limit="an EPSG code, or a projected system on a datum of the EPSG registry",
        cure="declare crs if the coordinates are in a system with an EPSG code; otherwise transform the file to one",
    )


def have_same_places(name: str, other: str) -> bool:
    """Whether two geographic systems differ only in the order of their axes, or in the axis of heights."""
    one, two = named_system(name), named_system(other)
    return bool(
        one.is_geographic
        and two.is_geographic
        and one.datum == two.datum
        and one.prime_meridian == two.prime_meridian
        and one.axis_info[0].unit_conversion_factor == two.axis_info[0].unit_conversion_factor
    )


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


@lru_cache(maxsize=1)
def listed_systems() -> frozenset[int]:
    """EPSG codes of all geographic and projected systems of the registry that PROJ computes, also of replaced ones."""
    kinds = [PJType.GEOGRAPHIC_2D_CRS, PJType.PROJECTED_CRS]
    found = query_crs_info("EPSG", kinds, allow_deprecated=True)
    return frozenset(int(one.code) for one in found if one.projection_method_name not in _UNKNOWN_TO_PROJ)


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


# === Realizations of reference systems: which one is stated, and how far apart those of a system are.


TARGET = "ITRF2014"
WGS84_ENSEMBLE_M = 2.0
"""Accuracy of WGS 84 without a realization. [m] Source: EPSG registry, datum ensemble 6326."""
_RECENT_M, _OLD_M = 0.01, 0.2
"""Horizontal distance of a realization from ITRF2014: since ITRF2005, IGS05 and WGS 84 (G1674), and before. [m]
Source: parameters from ITRF2014 to past ITRFs (itrf.ign.fr), at most 3 mm and 1 ppb back to ITRF2005 and 155 mm and 11
ppb back to ITRF88."""
_RECENT_YEAR, _RECENT_WEEK = 2005, 1674
_ITRF = re.compile(r"(?:ITRF|IGS|IGB)(?P<year>\d{4}|\d{2})(?:@.*)?")
_WGS84 = re.compile(r"(?:WGS84)?\(?G(?P<week>\d{3,4})\)?")
_UNSTATED = ("WGS84", "ITRF", "ITRS", "WGS1984")


def accuracy_of_global(realization: str | None) -> float | None:
    """Distance of a realization of WGS 84 or the ITRS from ITRF2014; None if it is not one of these. [m]

    Without a realization, it is that of WGS 84 with all its realizations.
    """
    name = _plain(realization or "WGS84")
    if name in _UNSTATED:
        return WGS84_ENSEMBLE_M
    if name == TARGET:
        return 0.0
    if found := _ITRF.fullmatch(name):
        year = int(found["year"])
        if year < 100:
            year += 1900 if year > 80 else 2000
        return _RECENT_M if year >= _RECENT_YEAR else _OLD_M
    if found := _WGS84.fullmatch(name):
        return _RECENT_M if int(found["week"]) >= _RECENT_WEEK else _OLD_M
    return None


def is_stated(realization: str | None) -> bool:
    """Whether it names more than the system."""
    return realization is not None and _plain(realization) not in _UNSTATED


def realization_of_system(name: str) -> str | None:
    """Realization that a global system is by itself, such as that of EPSG:7912; None of WGS 84."""
    geodetic = named_system(name).geodetic_crs
    if geodetic is None or geodetic.datum is None or geodetic.datum.type_name == "Datum Ensemble":
        return None
    return str(geodetic.name)


def has_realizations(name: str) -> bool:
    """Whether a system is a datum ensemble, such as ETRS89: its realizations differ, and coordinates may be in any."""
    geodetic = named_system(name).geodetic_crs
    return geodetic is not None and geodetic.datum is not None and geodetic.datum.type_name == "Datum Ensemble"


def system_of_realization(name: str, realization: str | None) -> str | None:
    """Geographic system of a realization of a regional system: EPSG:9067 of ETRS89 and ``ETRF2000``.

    Returns
    -------
    str or None
        ``EPSG:code``; None if there is no such realization of this system.
    """
    if realization is None or is_global(named_system(name)):
        return None
    geodetic = named_system(name).geodetic_crs
    found = _geographic_systems().get(_plain(realization))
    if geodetic is None or geodetic.datum is None or found is None:
        return None
    own = _plain(geodetic.name)
    if _plain(realization).startswith((f"{own}/", f"{own}(")) or _plain(realization) == own:
        return found
    members = {member["name"] for member in geodetic.datum.to_json_dict().get("members", ())}
    datum = named_system(found).datum
    return found if datum is not None and datum.name in members else None


@lru_cache(maxsize=1)
def _geographic_systems() -> dict[str, str]:
    systems = query_crs_info("EPSG", PJType.GEOGRAPHIC_2D_CRS)
    return {_plain(info.name): f"EPSG:{info.code}" for info in systems}


def _plain(name: str) -> str:
    return re.sub(r"[\s_-]", "", name).upper()


# === Vertical datums: what a height is above.


ELLIPSOID = "ellipsoid"
VERTICAL_RULE = "ellipsoid, or a vertical CRS of the EPSG registry in metres upwards, by code or name"
_CODE = re.compile(r"(?:EPSG:|urn:ogc:def:crs:EPSG:[0-9.]*:)(?P<code>[0-9]{4,6})", re.IGNORECASE)


def is_ellipsoidal(vertical_datum: str | None) -> bool:
    """Whether heights above a datum, as markers keep it, are ellipsoidal; without a datum they are."""
    return vertical_datum in (None, ELLIPSOID)


def normalize_vertical_datum(text: str) -> str:
    """``ellipsoid``, or ``EPSG:code`` of a vertical CRS, from the usual forms of its name.

    Raises
    ------
    ReferenceSystemError
        It is none of these: other names, depths, feet.
    """
    plain = _plain(text)
    if plain == _plain(ELLIPSOID):
        return ELLIPSOID
    found = _CODE.fullmatch(text.strip())
    code = found["code"] if found else _codes().get(plain)
    if code is None or not _is_height_in_metres(int(code)):
        raise ReferenceSystemError(
            f"{text[:64]!r} is not a vertical datum that is known here",
            field="vertical_datum",
            limit=VERTICAL_RULE,
            cure="send ellipsoid, EPSG:5703 (NAVD88), EPSG:7837 (DHHN2016), EPSG:3855 (EGM2008), ...",
        )
    return f"EPSG:{int(code)}"


def _vertical_datum(text: str) -> str:
    try:
        return normalize_vertical_datum(text)
    except ReferenceSystemError as error:
        error.field = None  # the place in the request is
        raise


VerticalDatum = Annotated[Text, Field(min_length=1, max_length=64), AfterValidator(_vertical_datum)]


@lru_cache(maxsize=256)
def _is_height_in_metres(code: int) -> bool:
    try:
        system = CRS.from_epsg(code)
    except CRSError:
        return False
    if not system.is_vertical or system.is_compound or len(system.axis_info) != 1:
        return False
    axis = system.axis_info[0]
    return axis.direction == "up" and axis.unit_conversion_factor == 1.0


@lru_cache(maxsize=1)
def _codes() -> dict[str, str]:
    """Codes of vertical systems by name, with and without the word height."""
    codes: dict[str, str] = {}
    for info in query_crs_info("EPSG", PJType.VERTICAL_CRS):
        codes[_plain(info.name)] = codes[_plain(info.name.removesuffix(" height"))] = info.code
    return codes


class HeightSystem(NamedTuple):
    """What the heights of a compound system, or of a geographic system with three axes, are above."""

    name: str  # for people
    datum: str | None  # as `normalize_vertical_datum` writes it; None if that knows no such datum
    unit_m: float  # [m] unit of the heights
    is_depth: bool = False  # they are counted downwards


def split_heights(crs: str) -> tuple[str, HeightSystem | None]:
    """The horizontal part of a system, and what it states about heights; the system as it is if it states nothing.

    Parameters
    ----------
    crs : str
        As `normalize_crs` takes it, or WKT.

    Raises
    ------
    ReferenceSystemError
        It has a form that is not known here.
    """
    name = crs if "[" in crs else normalize_crs(crs)
    try:
        system = CRS.from_user_input(name)
    except CRSError:
        return name, None  # refused where it is used
    if system.is_geographic and not system.is_compound and len(system.axis_info) == 3:
        return name, HeightSystem(system.name, ELLIPSOID, system.axis_info[2].unit_conversion_factor)
    if not system.is_compound or len(system.sub_crs_list) != 2:
        return name, None
    horizontal, vertical = (part.source_crs or part if part.is_bound else part for part in system.sub_crs_list)
    return name_system(horizontal) or horizontal.to_wkt(), _height_system(vertical)


_NO_DATUM = re.compile(r"unknown|unnamed|undefined|not[ _]specified|.*based on", re.IGNORECASE)
_GEOCENTRIC_ELLIPSOIDS = ("GRS 1980", "WGS 84")
"""Ellipsoids whose datums lie within 2 m of each other; those of the others lie a hundred metres apart."""


def has_datum(system: CRS) -> bool:
    """Whether a system states a datum, not only an ellipsoid that several datums of a continent have."""
    geodetic = system.geodetic_crs
    if geodetic is None or geodetic.datum is None or geodetic.ellipsoid is None:
        return False
    return geodetic.ellipsoid.name in _GEOCENTRIC_ELLIPSOIDS or _NO_DATUM.match(geodetic.datum.name) is None


def name_system(system: CRS) -> str | None:
    """``EPSG:code`` of a system that was read as WKT; None if the EPSG registry does not list it."""
    code = system.to_epsg(min_confidence=70) if has_datum(system) else None
    if code is not None:
        return f"EPSG:{code}"
    is_plain = system.is_geographic and not system.is_compound and not system.is_bound
    return geographic_code(system) if is_plain else None


def _height_system(vertical: CRS) -> HeightSystem:
    """A datum whose system in metres is listed beside this one, such as NAVD88 beside NAVD88 in feet, is that datum."""
    axis = vertical.axis_info[0]
    code = vertical.to_epsg(min_confidence=70)
    named = _codes().get(_plain(vertical.name.partition(" (")[0]))
    for known in (code, named):
        if known is None or axis.direction != "up" or not _is_height_in_metres(int(known)):
            continue
        if known == code or CRS.from_epsg(int(known)).datum == vertical.datum:
            return HeightSystem(vertical.name, f"EPSG:{int(known)}", axis.unit_conversion_factor)
    return HeightSystem(vertical.name, None, axis.unit_conversion_factor, is_depth=axis.direction == "down")
