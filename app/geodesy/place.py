"""Positions in any reference system to WGS 84 / ITRF, with the transformation and its accuracy."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS
from pyproj.enums import TransformDirection
from pyproj.exceptions import ProjError
from pyproj.transformer import TransformerGroup

from app.errors import InvalidParameter, ReferenceSystemError
from app.geodesy.frames import check_lon_lat
from app.geodesy.operations import (
    BoundedOperation,
    bounded_operations,
    list_operations,
    missing_operation,
    move_to_epoch,
    plate_motion,
)
from app.geodesy.systems import (
    ELLIPSOID,
    TARGET,
    accuracy_of_global,
    best_effort,
    check_area,
    covers,
    geographic_from,
    has_realizations,
    inside_area,
    is_global,
    is_stated,
    many_wgs84,
    named_system,
    normalize_crs,
    realization_of_system,
    system_of_realization,
    wgs84_without_bound,
)
from app.values import Floats

# === What a position is good enough for, by its accuracy (docs/positions.md).


Grade = Literal["cm", "dm", "m", "unfit"]


class LocalizationGrade(StrEnum):
    """Order of magnitude of a position's horizontal accuracy; UNFIT may not be used to localize a vehicle."""

    CM = "cm"
    DM = "dm"
    M = "m"
    UNFIT = "unfit"


UNFIT_TEXT = "not for localization"
"""What people read where a position is UNFIT."""
GRADE_LIMITS_M = {LocalizationGrade.CM: 0.1, LocalizationGrade.DM: 1.0, LocalizationGrade.M: 10.0}
"""RMSE below which a position has a grade. [m] Source: the unit in which the RMSE is written with one digit before the
point."""


def total_accuracy_m(horizontal_rmse_m: float | None, transform_accuracy_m: float | None) -> float | None:
    """Horizontal RMSE of a position in the ITRF, by its survey and its reference frame; None if one is unknown. [m]"""
    if horizontal_rmse_m is None or transform_accuracy_m is None:
        return None
    return math.hypot(horizontal_rmse_m, transform_accuracy_m)


def grade_accuracy(rmse_m: float | None) -> LocalizationGrade:
    """Grade of a position with a horizontal RMSE in the ITRF; None is unknown. [m]"""
    if rmse_m is None:
        return LocalizationGrade.UNFIT
    found = (grade for grade, limit_m in GRADE_LIMITS_M.items() if rmse_m < limit_m)
    return next(found, LocalizationGrade.UNFIT)


def worst_grade(grades: Iterable[LocalizationGrade]) -> LocalizationGrade:
    """The least accurate of at least one grade."""
    return max(grades, key=list(LocalizationGrade).index)


# === Positions in any reference system to WGS 84 / ITRF, with the transformation and its accuracy.


PLATE_FIXED_EPOCH = 2020.0
"""Epoch in the ITRF for which plate-fixed coordinates without an epoch are transformed. [decimal year]

Any would do, because they do not change and the position is moved to the epoch of its use.
"""
UNSTATED_YEARS = 10.0
"""Age that coordinates without an epoch may have. [year] ITRF2014 came out in 2016."""


@dataclass(frozen=True, slots=True)
class PlacedPosition:
    """A position in WGS 84 / ITRF, with its transformation."""

    # `lon_deg`, `lat_deg`: [deg] longitude and latitude
    lon_deg: float
    lat_deg: float
    height_m: float | None  # [m] above the ellipsoid if it was, else above the vertical datum it came with
    crs: str  # the original CRS, in the form ``EPSG:code`` or ``OGC:CRS84``
    realization: str | None  # frame of lon_deg, lat_deg: as stated, or the one it was transformed into
    epoch: float | None  # [decimal year] of lon_deg, lat_deg in this frame
    # [m] horizontal accuracy of the transformation, the realization and the epoch together; None if it is unknown
    transform_accuracy_m: float | None
    # which transformation was used, and which declaration would make the position more accurate
    note: str | None = None

    @property
    def grade(self) -> LocalizationGrade:
        """Best grade that a survey in this frame can have."""
        return grade_accuracy(self.transform_accuracy_m)


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
        Frame as stated by the surveyor, e.g. ``ITRF2014``, ``WGS 84 (G2139)``, or ``ETRF2000`` of ETRS89.
    epoch : float, optional
        Coordinate epoch. [decimal year]
    ellipsoidal_height : bool
        The height is above the ellipsoid and takes part in the transformation.
    accuracy_m : float
        Worst stated accuracy of a transformation that is used. [m]

    Raises
    ------
    ReferenceSystemError
        The CRS is unknown or of a kind that places nothing on a road.
    InvalidParameter
        The coordinates are not finite, out of range, or far outside the CRS's area of use.

    Notes
    -----
    PROJ transforms NAD83(2011) to EPSG:4326 by a null shift and assumes an epoch without a warning. So other systems
    are transformed to ITRF2014 only by operations that state an accuracy, within their area of use. If these depend on
    time, a plate-fixed frame without an epoch is transformed for `PLATE_FIXED_EPOCH`. All other positions are
    transformed without a bound: they are unfit for localization.
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
        frame = _global_frame(name, (lon_deg, lat_deg), realization, epoch)
        return PlacedPosition(lon_deg, lat_deg, height_m, name, *frame)
    height = height_m if ellipsoidal_height else None
    moved = _to_itrf2014(name, (lon_deg, lat_deg), (first, second, height), realization, epoch, accuracy_m)
    if isinstance(moved, str):
        return PlacedPosition(lon_deg, lat_deg, height_m, name, None, None, None, f"from {name}: {moved}")
    operation, lon_deg, lat_deg, moved_height = moved
    return PlacedPosition(
        lon_deg,
        lat_deg,
        moved_height if height is not None else height_m,
        name,
        *_transformed_frame(name, (lon_deg, lat_deg), operation, realization, epoch),
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
    epoch: float | None
    transform_accuracy_m: float | None
    note: str | None

    @property
    def grade(self) -> LocalizationGrade:
        """Best grade that a survey in this frame can have."""
        return grade_accuracy(self.transform_accuracy_m)


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
        middle_deg = _middle(lon[known], lat[known]) if known.any() else (0.0, 0.0)
        frame = _global_frame(name, middle_deg, realization, epoch)
        return PlacedPositions(lon, lat, height_m, known, name, *frame)
    has_height = bool(np.isfinite(heights[known]).any())  # positions without one are transformed with the height 0
    middle = int(np.flatnonzero(known)[np.argsort(lon[known])[known.sum() // 2]])
    up = np.where(np.isfinite(heights), heights, 0.0)
    original = (float(first[middle]), float(second[middle]), float(up[middle]) if has_height else None)
    place_deg = (float(lon[middle]), float(lat[middle]))
    moved = _to_itrf2014(name, place_deg, original, realization, epoch, accuracy_m)
    if isinstance(moved, str):
        return PlacedPositions(lon, lat, height_m, known, name, None, None, None, f"from {name}: {moved}")
    operation = moved[0]
    unproject = geographic_from(name)
    if unproject is not None:
        first, second = unproject.transform(first, second)
    times = np.full_like(first, _epoch_of(operation, epoch))
    x, y, z, _ = operation.transformer.transform(first, second, up, times)
    reached = known & np.isfinite(x) & np.isfinite(y) & operation.covers(lon, lat)
    return PlacedPositions(
        np.where(reached, x, np.nan),
        np.where(reached, y, np.nan),
        np.where(reached & np.isfinite(heights), z, np.nan) if has_height else height_m,
        reached,
        name,
        *_transformed_frame(name, place_deg, operation, realization, epoch),
    )


def _middle(lon_deg: npt.NDArray[np.float64], lat_deg: npt.NDArray[np.float64]) -> tuple[float, float]:
    k = int(np.argsort(lon_deg)[len(lon_deg) // 2])
    return float(lon_deg[k]), float(lat_deg[k])


def _to_itrf2014(
    name: str,
    place: tuple[float, float],
    original: tuple[float, float, float | None],
    realization: str | None,
    epoch: float | None,
    accuracy_m: float,
) -> tuple[BoundedOperation, float, float, float] | str:
    """The first operation that transforms a place, with its result; or why there is none."""
    first, second, height_m = original
    source = system_of_realization(name, realization) or name
    operations = list_operations(source, *place, three_d=height_m is not None, accuracy_m=accuracy_m)
    if isinstance(operations, str):
        return operations
    unproject = geographic_from(name)
    if unproject is not None:
        first, second = unproject.transform(first, second)
    for operation in operations:
        at = _epoch_of(operation, epoch)
        lon, lat, height, _ = operation.transformer.transform(first, second, height_m or 0.0, at)
        if all(math.isfinite(v) for v in (lon, lat, height)):
            return operation, float(lon), float(lat), float(height)
    return "the transformation does not reach this position"


def _epoch_of(operation: BoundedOperation, epoch: float | None) -> float:
    """Epoch for which an operation is run."""
    return (epoch or PLATE_FIXED_EPOCH) if operation.needs_epoch else 0.0


_Frame = tuple[str | None, float | None, float | None, str | None]
"""Realization, epoch, accuracy [m] and note of a position."""


def _transformed_frame(
    name: str, place_deg: tuple[float, float], operation: BoundedOperation, realization: str | None, epoch: float | None
) -> _Frame:
    """Frame of positions that an operation brought to ITRF2014."""
    motion = plate_motion(*place_deg)
    parts_m, notes = [operation.bound_m], [_note(name, operation)]
    if system_of_realization(name, realization) is None:
        if realization is not None:
            notes.append(f"the realization {realization} is not one of {name}, it was ignored")
        elif has_realizations(name):
            notes.append("state the realization, such as ETRF2000, for a better accuracy")
    if not operation.needs_epoch:
        parts_m.append(UNSTATED_YEARS * float((motion.speed_m + motion.accuracy_m)[0]))
        return TARGET, None, math.hypot(*parts_m), "; ".join(notes)
    if epoch is None:
        parts_m.append(UNSTATED_YEARS * float(motion.accuracy_m[0]))
        notes.append(f"no epoch is stated: motion within the plate may add {parts_m[-1]:.2g} m; state the epoch")
    return TARGET, epoch or PLATE_FIXED_EPOCH, math.hypot(*parts_m), "; ".join(notes)


def stored_frame(
    crs: str, place_deg: tuple[float, float], realization: str | None, epoch: float | None, accuracy_m: float | None
) -> tuple[float | None, str | None]:
    """Accuracy [m] of a stored position's frame, which may be of before realization and epoch counted, and what to add
    to its note.

    Parameters
    ----------
    crs, realization, epoch, accuracy_m
        As they are stored.
    place_deg : (float, float)
        Longitude and latitude. [deg]
    """
    try:
        is_kept = is_global(named_system(normalize_crs(crs)))
    except ReferenceSystemError:
        is_kept = False
    if accuracy_m is None or not is_kept:
        return accuracy_m, None
    return _global_frame(crs, place_deg, realization, epoch)[2:]


def _note(name: str, operation: BoundedOperation) -> str:
    return f"transformed from {name} to ITRF2014, stated accuracy {operation.bound_m:g} m: {operation.name}"


def _global_frame(name: str, place_deg: tuple[float, float], realization: str | None, epoch: float | None) -> _Frame:
    """Frame of positions in WGS 84 or an ITRF, which are kept as they are."""
    stated = realization if is_stated(realization) else realization_of_system(name)
    accuracy_m = accuracy_of_global(stated)
    if accuracy_m is None:
        note = f"the realization {realization} is not one of {name}; no transformation was made"
        return realization, epoch, None, note
    parts_m, notes = [accuracy_m], []
    if stated is None:
        notes.append(
            f"the realization of WGS 84 is not stated, they differ by up to {accuracy_m:g} m: state the realization, "
            "such as ITRF2020 or WGS 84 (G2296)"
        )
    if epoch is None:
        motion = plate_motion(*place_deg)
        parts_m.append(UNSTATED_YEARS * float((motion.speed_m + motion.accuracy_m)[0]))
        moved_m, error_m = (UNSTATED_YEARS * float(value[0]) for value in (motion.speed_m, motion.accuracy_m))
        notes.append(
            f"no epoch is stated, the plate moves by {moved_m:.2f} m in {UNSTATED_YEARS:g} years, by a model with an "
            f"error of {error_m:.2f} m: state the epoch"
        )
    return stated, epoch, math.hypot(*parts_m), "; ".join(notes) or None


# === Positions in WGS 84 / ITRF to any reference system, with the accuracy of the transformation.


_INVERSE = TransformDirection.INVERSE
_OUTSIDE_DEG = 1.0  # [deg] margin about an area of use; source: as for positions that come in


@dataclass(frozen=True, slots=True)
class Origin:
    """How positions came to WGS 84 / ITRF."""

    crs: str  # system that they were submitted in
    stated: bool  # transformed with a stated accuracy, or global from the start
    epoch: float | None  # [decimal year] of the positions
    ellipsoidal_height: bool  # heights are above the ellipsoid
    realization: str | None = None  # realization of `crs` that they were submitted in, as it was stated


@dataclass(frozen=True, slots=True)
class SystemPositions:
    """Positions in a reference system."""

    # `first`, `second`: shape (N,): longitude and latitude [deg], or easting and northing in the unit of the system
    first: Floats
    second: Floats
    height_m: Floats  # shape (N,): [m] NaN where unknown
    accuracy_m: float  # [m] stated accuracy of the transformation; 0 without one
    note: str  # the transformation, for people


def positions_in_system(
    lon_deg: Floats,
    lat_deg: Floats,
    height_m: Floats,
    crs: str,
    *,
    origin: Origin,
    realization: str | None = None,
    epoch: float | None = None,
) -> SystemPositions:
    """Transform positions in WGS 84 / ITRF to a reference system.

    Parameters
    ----------
    lon_deg, lat_deg, height_m : ndarray, shape (N,)
        Height is NaN where unknown.
    crs : str
        Of the result, in any form of `normalize_crs`.
    realization : str, optional
        Of that system. Without, the one in which the positions came, if they came in this system.
    epoch : float, optional
        Of the result; without, that of the positions. [decimal year]

    Raises
    ------
    ReferenceSystemError
        The system is unknown, not made for this place, has no such realization, or has no transformation with a stated
        accuracy; or positions without an epoch are to be moved to one.

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
    _check_realization(name, realization)
    if epoch is not None and epoch != origin.epoch:
        lon_deg, lat_deg, origin = _at_epoch(lon_deg, lat_deg, epoch, origin)
    if is_global(system):
        first, second = _projected(name, lon_deg, lat_deg)
        return SystemPositions(first, second, height_m, 0.0, f"{name} is on a global datum: no datum transformation")
    returns = _same_datum(name, origin.crs) and realization in (None, origin.realization)
    origin = origin if returns else replace(origin, realization=realization)
    if returns and not origin.stated:
        first, second, *_ = _undone(best_effort(name), lon_deg, lat_deg)
        note = f"the road came in {origin.crs} without a stated accuracy, which is undone: exact in its own datum"
        return SystemPositions(np.asarray(first), np.asarray(second), height_m, 0.0, note)
    return _transformed(name, lon_deg, lat_deg, height_m, origin, returns)


def _check_realization(name: str, realization: str | None) -> None:
    system = named_system(name)
    is_known = accuracy_of_global(realization) if is_global(system) else system_of_realization(name, realization)
    if realization is not None and is_known is None:
        raise ReferenceSystemError(
            f"{realization[:40]!r} is not a realization of {name} ({system.name})",
            field="realization",
            limit="a realization of the system in the EPSG registry, such as ETRF2000 of ETRS89",
            cure="correct it, or leave it out",
        )


def _at_epoch(lon_deg: Floats, lat_deg: Floats, epoch: float, origin: Origin) -> tuple[Floats, Floats, Origin]:
    if origin.epoch is None:
        raise ReferenceSystemError(
            "the epoch of the positions is not known, so that they cannot be moved to another one",
            field="epoch",
            limit="positions with an epoch",
            cure="leave the epoch out, or state that of the positions in the registry",
        )
    moved = move_to_epoch(lon_deg, lat_deg, origin.epoch, epoch)
    return moved.lon_deg, moved.lat_deg, replace(origin, epoch=epoch)


def heights_above(
    lon_deg: Floats, lat_deg: Floats, height_m: Floats, crs: str, from_datum: str, to_datum: str
) -> Floats:
    """Heights above another datum.

    Parameters
    ----------
    lon_deg, lat_deg : ndarray, shape (N,)
        [deg]
    height_m : ndarray, shape (N,)
        NaN where unknown. [m]
    crs : str
        On whose ellipsoid ellipsoidal heights are.
    from_datum, to_datum : str
        As `normalize_vertical_datum` writes them.

    Raises
    ------
    ReferenceSystemError
        There is no transformation with a stated accuracy, or its grid is not installed: the message names it.
    """
    if from_datum == to_datum:
        return height_m
    base = named_system(normalize_crs(crs)).geodetic_crs
    assert base is not None
    for datum, direction in ((from_datum, TransformDirection.INVERSE), (to_datum, TransformDirection.FORWARD)):
        if datum != ELLIPSOID:
            transformer = _height_transformer(base.to_wkt(), datum)
            height_m = np.asarray(transformer.transform(lon_deg, lat_deg, height_m, direction=direction)[2])
            height_m = np.where(np.isfinite(height_m), height_m, np.nan)
    return height_m


@lru_cache(maxsize=64)
def _height_transformer(base_wkt: str, datum: str) -> Transformer:
    """From ellipsoidal heights to heights above a datum."""
    base, vertical = CRS.from_wkt(base_wkt), CRS.from_user_input(datum)
    target = CompoundCRS("heights", [base.to_2d(), vertical])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # missing grids are named below
        try:
            group = TransformerGroup(base.to_3d(), target, always_xy=True, allow_ballpark=False)
        except ProjError as error:
            raise ReferenceSystemError(
                f"a grid for heights above {datum} ({vertical.name}) is installed, but cannot be read: {error}"[:300],
                field="vertical_datum",
                limit="grids of cdn.proj.org",
                cure="install it again with projsync in $WAYMARK_PROJ_GRIDS_DIR, and restart the server",
            ) from error
    stated = [one for one in group.transformers if one.accuracy >= 0]
    if stated:
        return min(stated, key=lambda one: one.accuracy)
    grids = dict.fromkeys(g.short_name for one in group.unavailable_operations for g in one.grids if not g.available)
    names = " or ".join(list(grids)[:4])
    raise ReferenceSystemError(
        f"heights above {datum} ({vertical.name}) "
        + (f"need the grid {names}, which is not installed" if grids else f"are not related to {base.name} in PROJ"),
        field="vertical_datum",
        limit="ellipsoid, or a datum with its grid",
        cure=f"projsync --file {next(iter(grids))} --target-dir $WAYMARK_PROJ_GRIDS_DIR, and restart the server"
        if grids
        else "ask for the datum of the heights in the registry",
    )


def _transformed(
    name: str, lon_deg: Floats, lat_deg: Floats, height_m: Floats, origin: Origin, returns: bool
) -> SystemPositions:
    """By an operation with a stated accuracy, backwards."""
    three_d = origin.ellipsoidal_height and bool(np.isfinite(height_m).any())
    middle = int(np.argsort(lon_deg)[len(lon_deg) // 2])
    place = float(lon_deg[middle]), float(lat_deg[middle])
    source = system_of_realization(name, origin.realization) or name
    operations = list_operations(source, *place, three_d=three_d, accuracy_m=np.inf)
    if not isinstance(operations, str) and origin.epoch is None:
        known = [operation for operation in operations if not operation.needs_epoch]
        operations = known or "the transformation depends on time, and the epoch of the positions is not known"
    if isinstance(operations, str):
        grid = None if bounded_operations(source, three_d) else missing_operation(source, *place).grid
        install = (
            f"projsync --file {grid} --target-dir $WAYMARK_PROJ_GRIDS_DIR, and restart the server; or " if grid else ""
        )
        raise ReferenceSystemError(
            f"positions cannot be transformed to {name}: {operations}",
            field="crs",
            limit="a transformation with a stated accuracy",
            cure=f"{install}choose a system on WGS 84 or ETRS89, or that in which they came; declare the epoch",
        )
    heights = np.where(np.isfinite(height_m), height_m, 0.0) if three_d else np.zeros_like(lon_deg)
    epochs = np.full_like(lon_deg, origin.epoch or 0.0)
    for operation in operations:
        x, y, z = _undone(operation.transformer, lon_deg, lat_deg, heights, epochs)
        if np.isfinite(x).all() and np.isfinite(y).all():
            first, second = _projected(name, np.asarray(x), np.asarray(y))
            up = np.where(np.isfinite(height_m), z, np.nan) if three_d else height_m
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


def _undone(transformer: Any, lon_deg: Floats, lat_deg: Floats, *more: Floats) -> tuple[Floats, ...]:
    """What a transformer turns into these positions: longitude, latitude, and the height where one comes in.

    PROJ's own inverse of a transformation without heights is off by a millimetre, because the height that such a
    transformation gives is dropped. The rest after one step back and forth is below a micrometre.
    """
    start = transformer.transform(lon_deg, lat_deg, *more, direction=_INVERSE)
    again = transformer.transform(*start)
    aim = [
        2 * np.asarray(goal) - np.asarray(met) for goal, met in zip((lon_deg, lat_deg, *more[:1]), again, strict=False)
    ]
    return tuple(np.asarray(v) for v in transformer.transform(*aim, *more[1:], direction=_INVERSE)[:3])


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
