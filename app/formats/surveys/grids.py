"""Grids of projected systems: their unit, and eastings that begin with the number of the zone."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pyproj import CRS

from app.errors import InvalidParameter
from app.formats.surveys.declaration import METRES
from app.formats.surveys.table import Floats

_ZONE_M = 1e6  # [m] one zone number; eastings with the number of the zone are this times the number greater
_MAX_ZONE = 60
_NARROW_ZONES = 9  # greatest number that eastings in feet without a zone could begin with; chosen by hand
_HALF_WIDTH_M = 450_000.0  # greatest distance from the meridian of a zone of 6 degrees; 3 degrees are 334 km at 0 deg
_FALSE_EASTING_M = 500_000.0  # of zones of transverse Mercator grids, EPSG guidance note 7-2, table of zoned grids


def crs_unit(system: CRS) -> str:
    """Unit of the axes of a CRS: one of `METRES`, or ``deg``.

    Raises
    ------
    InvalidParameter
        The CRS has another unit.
    """
    if not system.is_projected:
        return "deg"
    factor = system.axis_info[0].unit_conversion_factor
    for name, metres in METRES.items():
        if abs(factor / metres - 1) < 1e-9:
            return name
    raise InvalidParameter(
        f"{system.name} is in {system.axis_info[0].unit_name}",
        field="crs",
        limit=", ".join(METRES),
        cure="transform it",
    )


def unit_factor(unit: str | None, system: CRS) -> float:
    """Units of the CRS in one unit of the coordinates. [1]"""
    own = crs_unit(system)
    return 1.0 if unit is None or unit in (own, "deg") or own == "deg" else METRES[unit] / METRES[own]


def zone_numbers(system: CRS) -> tuple[int, ...]:
    """Numbers that the zone of a transverse Mercator grid has: of 6 degrees (UTM), and of 3 degrees (Gauss-Krueger).

    Empty where the CRS has no such zone, or its eastings contain the number already.
    """
    if not system.is_projected or crs_unit(system) != "m" or system.coordinate_operation is None:
        return ()
    values: dict[str, Any] = {parameter.name: parameter.value for parameter in system.coordinate_operation.params}
    if "Transverse Mercator" not in system.coordinate_operation.method_name:
        return ()
    if values.get("False easting") != _FALSE_EASTING_M:
        return ()
    meridian_deg = float(values.get("Longitude of natural origin", math.nan))
    utm, narrow = (meridian_deg + 183.0) / 6.0, meridian_deg / 3.0
    return tuple(round(zone) for zone in (utm, narrow) if zone == round(zone) and 1 <= zone <= _MAX_ZONE)


def without_zone(easting: Floats, system: CRS) -> tuple[Floats, int | None]:
    """Eastings without the number of the zone, and the number; None where they do not begin with it.

    Parameters
    ----------
    easting : ndarray, shape (N,)
        In the unit of the CRS.
    system : CRS

    Raises
    ------
    InvalidParameter
        The eastings begin with the number of another zone.
    """
    finite = easting[np.isfinite(easting)]
    own = zone_numbers(system) if len(finite) else ()
    zone = int(np.median(np.floor(finite / _ZONE_M))) if own else 0
    if zone in own:
        return np.where(np.floor(easting / _ZONE_M) == zone, easting - zone * _ZONE_M, easting), zone
    if _NARROW_ZONES < zone <= _MAX_ZONE and np.all(np.abs(finite % _ZONE_M - _FALSE_EASTING_M) < _HALF_WIDTH_M):
        raise InvalidParameter(
            f"the eastings begin with the number of zone {zone}, {system.name} has zone {own[0]}",
            field="crs",
            limit=f"zone {own[0]}",
            cure="declare the CRS of the zone that the eastings begin with",
        )
    return easting, None
