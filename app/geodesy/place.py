"""Positions in any reference system to WGS 84 / ITRF, with the transformation and its accuracy."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.geodesy.frames import check_lon_lat
from app.geodesy.operations import BoundedOperation, list_operations
from app.geodesy.systems import (
    check_area,
    geographic_from,
    inside_area,
    is_global,
    many_wgs84,
    named_system,
    normalize_crs,
    wgs84_without_bound,
)

_GLOBAL_REALIZATION = re.compile(r"(WGS ?84|ITRF|IGS|IGb)", re.IGNORECASE)


Grade = Literal["exact", "approximate, not for localization"]


class LocalizationGrade(StrEnum):
    """Whether a position may be used to localize a vehicle."""

    EXACT = "exact"
    APPROXIMATE = "approximate, not for localization"


@dataclass(frozen=True, slots=True)
class PlacedPosition:
    """A position in WGS 84 / ITRF, with its transformation.

    Attributes
    ----------
    lon_deg, lat_deg : float
        Longitude and latitude. [deg]
    height_m : float or None
        Above the ellipsoid if it was, else above the vertical datum it came with. [m]
    crs : str
        The original CRS, in the form ``EPSG:code`` or ``OGC:CRS84``.
    realization : str or None
        Frame of lon_deg, lat_deg: as stated, or the one it was transformed into.
    transform_accuracy_m : float or None
        Stated bound of the transformation; 0 without one, None if there is no bound. [m]
    grade : LocalizationGrade
    note : str or None
        Why it is only approximate, or which transformation was used.
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
    """Transform a submitted position to WGS 84 / ITRF, with the accuracy of the transformation.

    Parameters
    ----------
    first, second : float
        Longitude and latitude [deg], or easting and northing [m] where `projected`.
    height_m : float, optional
        Height in the original system. [m]
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
    PROJ transforms NAD83(2011) to EPSG:4326 by a null shift and assumes an epoch without a warning. So other systems
    are transformed to ITRF2014 only by operations that state an accuracy, within their area of use and, if they depend
    on time, with an epoch. All other positions are transformed without a bound and graded approximate.
    """
    name = normalize_crs(crs)
    system = named_system(name)
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
    lon_deg, lat_deg = wgs84_without_bound(name, first, second)
    check_area(system, name, lon_deg, lat_deg)
    if is_global(system):
        return _placed_globally(name, lon_deg, lat_deg, height_m, realization)
    height = height_m if ellipsoidal_height else None
    moved = _to_itrf2014(name, (lon_deg, lat_deg), (first, second, height), epoch, accuracy_m)
    if isinstance(moved, str):
        return PlacedPosition(
            lon_deg, lat_deg, height_m, name, None, None, LocalizationGrade.APPROXIMATE, f"from {name}: {moved}"
        )
    operation, lon_deg, lat_deg, moved_height = moved
    return PlacedPosition(
        lon_deg,
        lat_deg,
        moved_height if height is not None else height_m,
        name,
        "ITRF2014",
        operation.bound_m,
        LocalizationGrade.EXACT,
        _note(name, operation),
    )


@dataclass(frozen=True, slots=True)
class PlacedPositions:
    """Positions in WGS 84 / ITRF that came the same way; as `PlacedPosition`, with arrays of shape (N,).

    `placed` is False, and the position NaN, where a position is not finite, out of range, far outside the area of use,
    or outside the transformation's domain.
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
    """Transform many positions to WGS 84 / ITRF, each as `place_position` does.

    Parameters
    ----------
    first, second : ndarray, shape (N,)
        Longitude and latitude [deg], or easting and northing in the unit of the CRS.
    height_m : ndarray, shape (N,)
        Height in the original system; NaN where there is none. [m]
    crs, realization, epoch, ellipsoidal_height, accuracy_m
        As for `place_position`.

    Raises
    ------
    ReferenceSystemError
        As for `place_position`.
    """
    name = normalize_crs(crs)
    system = named_system(name)
    lon, lat = inside_area(system, *many_wgs84(name, system, first, second))
    known = np.isfinite(lon)
    heights = height_m if ellipsoidal_height else np.full_like(height_m, np.nan)
    if not known.any() or is_global(system):
        one = _placed_globally(name, 0.0, 0.0, None, realization)
        return PlacedPositions(
            lon, lat, height_m, known, name, one.realization, one.transform_accuracy_m, one.grade, one.note
        )
    has_height = bool(np.isfinite(heights[known]).all())
    middle = int(np.flatnonzero(known)[np.argsort(lon[known])[known.sum() // 2]])
    original = (float(first[middle]), float(second[middle]), float(heights[middle]) if has_height else None)
    moved = _to_itrf2014(name, (float(lon[middle]), float(lat[middle])), original, epoch, accuracy_m)
    if isinstance(moved, str):
        grade, note = LocalizationGrade.APPROXIMATE, f"from {name}: {moved}"
        return PlacedPositions(lon, lat, height_m, known, name, None, None, grade, note)
    operation = moved[0]
    unproject = geographic_from(name)
    if unproject is not None:
        first, second = unproject.transform(first, second)
    x, y, z, _ = operation.transformer.transform(
        first, second, np.where(np.isfinite(heights), heights, 0.0), np.zeros_like(first) + (epoch or 0.0)
    )
    reached = known & np.isfinite(x) & np.isfinite(y) & operation.covers(lon, lat)
    return PlacedPositions(
        np.where(reached, x, np.nan),
        np.where(reached, y, np.nan),
        np.where(reached, z, np.nan) if has_height else height_m,
        reached,
        name,
        "ITRF2014",
        operation.bound_m,
        LocalizationGrade.EXACT,
        _note(name, operation),
    )


def _to_itrf2014(
    name: str,
    place: tuple[float, float],
    original: tuple[float, float, float | None],
    epoch: float | None,
    accuracy_m: float,
) -> tuple[BoundedOperation, float, float, float] | str:
    """The first operation that transforms a place, with its result; or why there is none."""
    first, second, height_m = original
    operations = list_operations(name, *place, three_d=height_m is not None, epoch=epoch, accuracy_m=accuracy_m)
    if isinstance(operations, str):
        return operations
    unproject = geographic_from(name)
    if unproject is not None:
        first, second = unproject.transform(first, second)
    for operation in operations:
        lon, lat, height, _ = operation.transformer.transform(first, second, height_m or 0.0, epoch or 0.0)
        if all(math.isfinite(v) for v in (lon, lat, height)):
            return operation, float(lon), float(lat), float(height)
    return "the transformation does not reach this position"


def _note(name: str, operation: BoundedOperation) -> str:
    return f"transformed from {name} to ITRF2014, stated accuracy {operation.bound_m:g} m: {operation.name}"


def _placed_globally(
    name: str, lon_deg: float, lat_deg: float, height_m: float | None, realization: str | None
) -> PlacedPosition:
    if realization is not None and not _GLOBAL_REALIZATION.match(realization):
        note = f"the realization {realization} is not one of {name}; no transformation was made"
        return PlacedPosition(lon_deg, lat_deg, height_m, name, realization, None, LocalizationGrade.APPROXIMATE, note)
    return PlacedPosition(lon_deg, lat_deg, height_m, name, realization, 0.0, LocalizationGrade.EXACT)
