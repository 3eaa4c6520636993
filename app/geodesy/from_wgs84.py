"""Positions in WGS 84 / ITRF to any reference system, with the accuracy of the transformation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pyproj.enums import TransformDirection

from app.errors import ReferenceSystemError
from app.geodesy.operations import list_operations
from app.geodesy.realizations import system_of_realization
from app.geodesy.systems import best_effort, covers, geographic_from, is_global, named_system, normalize_crs

Floats = npt.NDArray[np.float64]

_INVERSE = TransformDirection.INVERSE
_OUTSIDE_DEG = 1.0  # [deg] margin about an area of use; source: as for positions that come in


@dataclass(frozen=True, slots=True)
class Origin:
    """How positions came to WGS 84 / ITRF.

    Attributes
    ----------
    crs : str
        System that they were submitted in.
    stated : bool
        Transformed with a stated accuracy, or global from the start.
    epoch : float or None
        Of the positions. [decimal year]
    ellipsoidal_height : bool
        Heights are above the ellipsoid.
    realization : str or None
        Realization of `crs` that they were submitted in, as it was stated.
    """

    crs: str
    stated: bool
    epoch: float | None
    ellipsoidal_height: bool
    realization: str | None = None


@dataclass(frozen=True, slots=True)
class SystemPositions:
    """Positions in a reference system.

    Attributes
    ----------
    first, second : ndarray, shape (N,)
        Longitude and latitude [deg], or easting and northing in the unit of the system.
    height_m : ndarray, shape (N,)
        NaN where unknown. [m]
    accuracy_m : float
        Stated accuracy of the transformation; 0 without one. [m]
    note : str
        The transformation, for people.
    """

    first: Floats
    second: Floats
    height_m: Floats
    accuracy_m: float
    note: str


def positions_in_system(
    lon_deg: Floats, lat_deg: Floats, height_m: Floats, crs: str, *, origin: Origin
) -> SystemPositions:
    """Transform positions in WGS 84 / ITRF to a reference system.

    Parameters
    ----------
    lon_deg, lat_deg, height_m : ndarray, shape (N,)
        Height is NaN where unknown.
    crs : str
        Of the result, in any form of `normalize_crs`.
    origin : Origin

    Raises
    ------
    ReferenceSystemError
        The system is unknown, not made for this place, or has no transformation with a stated accuracy.

    Notes
    -----
    A system on a global datum is reached by a projection alone. Into the datum that the positions came in, the
    transformation by which they came is undone. Any other datum is reached by the most accurate operation that states
    its accuracy there.
    """
    name = normalize_crs(crs)
    system = named_system(name)
    if not covers(system.area_of_use, lon_deg, lat_deg, _OUTSIDE_DEG).all():
        area = system.area_of_use
        raise ReferenceSystemError(
            f"the road lies outside the area of use of {name} ({system.name})",
            field="crs",
            limit=f"west, south, east, north: {', '.join(f'{v:g}' for v in area.bounds)} deg" if area else None,
            cure="choose a system of this place",
        )
    if is_global(system):
        first, second = _projected(name, lon_deg, lat_deg)
        return SystemPositions(first, second, height_m, 0.0, f"{name} is on a global datum: no datum transformation")
    returns = _same_datum(name, origin.crs)
    if returns and not origin.stated:
        first, second = best_effort(name).transform(lon_deg, lat_deg, direction=_INVERSE)
        note = f"the road came in {origin.crs} without a stated accuracy, which is undone: exact in its own datum"
        return SystemPositions(np.asarray(first), np.asarray(second), height_m, 0.0, note)
    return _transformed(name, lon_deg, lat_deg, height_m, origin, returns)


def _transformed(
    name: str, lon_deg: Floats, lat_deg: Floats, height_m: Floats, origin: Origin, returns: bool
) -> SystemPositions:
    """By an operation with a stated accuracy, backwards."""
    three_d = origin.ellipsoidal_height and bool(np.isfinite(height_m).all())
    middle = int(np.argsort(lon_deg)[len(lon_deg) // 2])
    place = float(lon_deg[middle]), float(lat_deg[middle])
    source = (system_of_realization(name, origin.realization) if returns else None) or name
    operations = list_operations(source, *place, three_d=three_d, accuracy_m=np.inf)
    if not isinstance(operations, str) and origin.epoch is None:
        known = [operation for operation in operations if not operation.needs_epoch]
        operations = known or "the transformation depends on time, and the epoch of the positions is not known"
    if isinstance(operations, str):
        raise ReferenceSystemError(
            f"positions cannot be staked in {name}: {operations}",
            field="crs",
            limit="a transformation with a stated accuracy",
            cure="choose a system on WGS 84 or on the road's own datum, declare the epoch, or add the grids",
        )
    heights = np.where(np.isfinite(height_m), height_m, 0.0) if three_d else np.zeros_like(lon_deg)
    epochs = np.full_like(lon_deg, origin.epoch or 0.0)
    for operation in operations:
        x, y, z, _ = operation.transformer.transform(lon_deg, lat_deg, heights, epochs, direction=_INVERSE)
        if np.isfinite(x).all() and np.isfinite(y).all():
            first, second = _projected(name, np.asarray(x), np.asarray(y))
            up = np.asarray(z) if three_d else height_m
            note = f"transformed to {name}, stated accuracy {operation.bound_m:g} m: {operation.name}"
            if returns:
                note += "; it undoes the transformation of the road"
            return SystemPositions(first, second, up, 0.0 if returns else operation.bound_m, note)
    raise ReferenceSystemError(
        f"no transformation to {name} reaches all positions",
        field="crs",
        limit="a transformation that covers the road",
        cure="choose another system",
    )


def _projected(name: str, lon_deg: Floats, lat_deg: Floats) -> tuple[Floats, Floats]:
    unproject = geographic_from(name)
    if unproject is None:
        return lon_deg, lat_deg
    first, second = unproject.transform(lon_deg, lat_deg, direction=_INVERSE)
    return np.asarray(first), np.asarray(second)


def _same_datum(name: str, other: str) -> bool:
    try:
        one, two = named_system(name).geodetic_crs, named_system(normalize_crs(other)).geodetic_crs
    except ReferenceSystemError:
        return False
    return one is not None and two is not None and one.datum == two.datum
