"""Transformations to ITRF2014 with a stated accuracy, their grids, and the motion of plates."""

from __future__ import annotations

import math
import os
import re
import warnings
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from importlib import resources
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from pyproj import Transformer, datadir, network
from pyproj.transformer import TransformerGroup

from app.geodesy.frames import ecef_from_wgs84, metres_per_radian
from app.geodesy.systems import best_effort, covers, named_system
from app.values import Floats

_ITRF2014_2D, _ITRF2014_3D = "EPSG:9000", "EPSG:7912"
_ETRS89_2D, _ETRS89_3D = "EPSG:4258", "EPSG:4937"
MAX_BY_ETRS89_M = 0.2
"""Worst accuracy of a transformation by way of ETRS89: 0.1 m of ETRS89 without a realization and at most 0.17 m of the
national system. [m] The seven parameters of a country state 0.5 m to 2 m."""
_TIMELY = ("t_epoch", "defmodel")
_MAX_NAME = 200  # characters; a note has 500


@dataclass(frozen=True, slots=True)
class BoundedOperation:
    """A transformation to ITRF2014."""

    transformer: Transformer
    bound_m: float  # [m] its stated accuracy
    name: str  # its name in PROJ
    needs_epoch: bool  # whether it depends on time: PROJ assumes an epoch if there is none
    areas: tuple[Any, ...]  # areas of use of its steps

    def covers(self, lon_deg: npt.NDArray[np.float64], lat_deg: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        """Which places are in its area of use, where its stated accuracy holds."""
        return np.asarray(np.all([covers(area, lon_deg, lat_deg) for area in self.areas], axis=0))


@lru_cache(maxsize=256)
def bounded_operations(name: str, three_d: bool) -> tuple[BoundedOperation, ...]:
    """Operations from a system's longitudes and latitudes to ITRF2014 that can be run here and state an accuracy.

    The most accurate comes first. From a projected system PROJ does not find operations with an intermediate system: it
    finds none from ETRS89 / UTM zone 32N, but four from ETRS89. National systems that it relates to ETRS89 alone, such
    as CH1903+, are transformed by way of ETRS89, with the root of the sum of the squares of both accuracies, if that is
    at most `MAX_BY_ETRS89_M`.
    """
    found = _operations_between(name, _ITRF2014_3D if three_d else _ITRF2014_2D, three_d)
    if not found and named_system(name).geodetic_crs != named_system(_ETRS89_2D):
        found = [
            _chained(first, second)
            for first in _operations_between(name, _ETRS89_3D if three_d else _ETRS89_2D, three_d)
            for second in bounded_operations(_ETRS89_2D, three_d)
            if math.hypot(first.bound_m, second.bound_m) <= MAX_BY_ETRS89_M
        ]
    return tuple(sorted(found, key=lambda operation: operation.bound_m))


def _operations_between(name: str, target: str, three_d: bool) -> list[BoundedOperation]:
    group = _group(name, target, three_d)
    return [
        BoundedOperation(
            transformer,
            float(transformer.accuracy),
            str(transformer.description)[:_MAX_NAME],
            any(word in transformer.definition for word in _TIMELY),
            (transformer.area_of_use,),
        )
        for transformer in (() if group is None else group.transformers)
        if transformer.accuracy >= 0
    ]


def _group(name: str, target: str, three_d: bool) -> TransformerGroup | None:
    geographic = named_system(name).geodetic_crs
    assert geographic is not None
    source = geographic.to_3d() if three_d else geographic.to_2d()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # missing grids only reduce the choice
        try:
            return TransformerGroup(source, target, always_xy=True, allow_ballpark=False)
        except IndexError:  # pyproj raises it if PROJ knows no operation
            return None


def _chained(first: BoundedOperation, second: BoundedOperation) -> BoundedOperation:
    steps = [
        one.transformer.definition.removeprefix("proj=pipeline ")
        if one.transformer.definition.startswith("proj=pipeline ")
        else f"step {one.transformer.definition}"
        for one in (first, second)
    ]
    return BoundedOperation(
        Transformer.from_pipeline(f"proj=pipeline {' '.join(steps)}"),
        round(math.hypot(first.bound_m, second.bound_m), 3),
        f"{first.name} + {second.name}"[:_MAX_NAME],
        first.needs_epoch or second.needs_epoch,
        (*first.areas, *second.areas),
    )


class MissingOperation(NamedTuple):
    """Why positions cannot be transformed to ITRF2014, and what helps."""

    reason: str
    grid: str | None = None  # name of a grid in PROJ that is not installed, with which it would be possible


def missing_operation(name: str, lon_deg: float, lat_deg: float) -> MissingOperation:
    """Why `bounded_operations` has none: the most accurate operation at a place, and the grid of a better one.

    Parameters
    ----------
    name : str
        Of the system, as `normalize_crs` writes it.
    lon_deg, lat_deg : float
        Approximate position. [deg]
    """
    return _missing(name, round(lon_deg), round(lat_deg))


@lru_cache(maxsize=256)
def _missing(name: str, lon_deg: int, lat_deg: int) -> MissingOperation:
    at = np.array([float(lon_deg)]), np.array([float(lat_deg)])
    reason = f"no transformation with a stated accuracy of at most {MAX_BY_ETRS89_M:g} m to ITRF2014 is available"
    here = (
        [one for one in _operations_between(name, target, False) if covers(one.areas[0], *at, 0.5)[0]]
        for target in (_ETRS89_2D, "EPSG:4326")
    )
    if nearest := min(chain.from_iterable(here), key=lambda one: one.bound_m, default=None):
        plain = nearest.name.replace("axis order change (2D) + ", "").replace(" + axis order change (2D)", "")
        step = " for one step of it" if nearest.bound_m <= MAX_BY_ETRS89_M else ""
        reason += f": {plain[:80]!r} states {nearest.bound_m:g} m{step}"
    best_m, grid = MAX_BY_ETRS89_M, None
    group = _group(name, _ETRS89_2D, three_d=False)
    for one in () if group is None else group.unavailable_operations:
        missing = [part.short_name for part in one.grids if not part.available]
        if missing and 0 <= one.accuracy < best_m and covers(one.area_of_use, *at, 0.5)[0]:
            best_m, grid = one.accuracy, str(missing[0])
    if grid is not None:
        reason += f"; with the grid {grid} that step would have {best_m:g} m"
    return MissingOperation(reason, grid)


def list_operations(
    name: str, lon_deg: float, lat_deg: float, *, three_d: bool, accuracy_m: float
) -> list[BoundedOperation] | str:
    """Operations that transform a place to ITRF2014 with the required accuracy, best first; or why there are none.

    Parameters
    ----------
    name : str
        Of the system, as `normalize_crs` writes it.
    lon_deg, lat_deg : float
        Approximate position. [deg]
    three_d : bool
        With an ellipsoidal height.
    accuracy_m : float
        Worst stated accuracy. [m]
    """
    known = bounded_operations(name, three_d)
    if not known:
        return missing_operation(name, lon_deg, lat_deg).reason
    here = [one for one in known if one.covers(np.array([lon_deg]), np.array([lat_deg]))[0]]
    if not here:
        return "no transformation with a stated accuracy is made for this place"
    good = [one for one in here if one.bound_m <= accuracy_m]
    if not good:
        return f"the best transformation states {here[0].bound_m:g} m, the limit is {accuracy_m:g} m"
    return good


def use_grids(folder: Path | None) -> None:
    """Add an operator's folder of grids to PROJ's own data; None removes it.

    Call it before positions are transformed. Nothing is downloaded.
    """
    network.set_network_enabled(False)  # type: ignore[attr-defined]
    own = _own_folders()
    datadir.set_data_dir(own if folder is None else f"{own}{os.pathsep}{folder}")
    bounded_operations.cache_clear()
    _missing.cache_clear()
    best_effort.cache_clear()


@lru_cache(maxsize=1)
def _own_folders() -> str:
    return datadir.get_data_dir()


# === Motion of the ground in the ITRF by a plate motion model, and positions moved from one epoch to another.
#
# Velocities are those of the ITRF2014 plate motion model (Altamimi, Metivier, Rebischung, Rouby, Collilieux: ITRF2014
# plate motion model, Geophysical Journal International 209, 2017, table 1). Which plate a place is on is from the
# plates and orogens of PB2002 (Bird: An updated digital model of plate boundaries, Geochemistry Geophysics Geosystems
# 4, 2003), in cells of one degree: `data/plates.txt` (made from github.com/fraxen/tectonicplates, ODC-By 1.0).


ANGULAR_VELOCITY_MAS = {
    "ANTA": (-0.248, -0.324, 0.675), "ARAB": (1.154, -0.136, 1.444), "AUST": (1.510, 1.182, 1.215),
    "EURA": (-0.085, -0.531, 0.770), "INDI": (1.154, -0.005, 1.454), "NAZC": (-0.333, -1.544, 1.623),
    "NOAM": (0.024, -0.694, -0.063), "NUBI": (0.099, -0.614, 0.733), "PCFC": (-0.409, 1.047, -2.169),
    "SOAM": (-0.270, -0.301, -0.140), "SOMA": (-0.121, -0.794, 0.884),
}  # fmt: skip
"""About the axes X, Y, Z of the ITRF. [mas/year] Source: Altamimi et al. 2017, table 1."""
RATE_ACCURACY_M = (0.002, 0.010, 0.030)
"""RMSE of a predicted velocity by the class of the cell. [m/year]

0: inside a plate. The model fits its stations to 0.3 mm/year (Altamimi et al. 2017); intraplate motion, and rates of
plate-fixed frames that differ from those of their plate, such as NAD83(2011), stay below 2 mm/year.
1: the Alps orogen, the plates Amur, Okhotsk, Sunda and Yangtze, which the model lacks and which move at up to 10 mm a
year against the plate beside them (Bird 2003, table 1), and 300 km to both sides of a boundary that slips as slowly.
2: other orogens, other plates that the model lacks (the Aegean moves at 30 mm/year against Eurasia: McClusky et al.
2000), and 300 km to both sides of faster boundaries.
"""
_RADIANS_PER_MAS = np.pi / (180 * 3600 * 1000)
_CELLS = re.compile(r"([A-Z]{4})([012])x([0-9]+)")


class PlateMotion(NamedTuple):
    """Horizontal velocity of places in the ITRF, each of shape (N,).

    east_m, north_m: velocity [m/year]; accuracy_m: its RMSE [m/year].
    """

    east_m: Floats
    north_m: Floats
    accuracy_m: Floats

    @property
    def speed_m(self) -> Floats:
        """[m/year]"""
        return np.hypot(self.east_m, self.north_m)


@dataclass(frozen=True, slots=True)
class MovedPositions:
    """Positions at another epoch, each of shape (N,)."""

    lon_deg: Floats
    lat_deg: Floats
    accuracy_m: Floats  # [m] RMSE that the move adds


def plate_motion(lon_deg: npt.ArrayLike, lat_deg: npt.ArrayLike) -> PlateMotion:
    """Velocity of the ground in the ITRF.

    Parameters
    ----------
    lon_deg, lat_deg : array_like, shape (N,)
        [deg]

    Notes
    -----
    v = omega x r with the plate's angular velocity. The radial part, which comes of the ellipsoid, is left out.
    """
    lon, lat = (np.atleast_1d(np.asarray(values, dtype=np.float64)) for values in (lon_deg, lat_deg))
    plates, classes = _grid()
    row = np.clip(np.floor(90.0 - np.nan_to_num(lat)), 0, 179).astype(np.intp)
    column = np.floor(np.nan_to_num(lon) + 180.0).astype(np.intp) % 360
    omega = np.array(list(ANGULAR_VELOCITY_MAS.values())) * _RADIANS_PER_MAS
    lon_rad, lat_rad = np.radians(lon), np.radians(lat)
    velocity = np.cross(omega[plates[row, column]], ecef_from_wgs84(lon, lat))
    east = np.stack([-np.sin(lon_rad), np.cos(lon_rad), np.zeros_like(lon_rad)], axis=-1)
    south_parts = [np.sin(lat_rad) * np.cos(lon_rad), np.sin(lat_rad) * np.sin(lon_rad), -np.cos(lat_rad)]
    north = -np.stack(south_parts, axis=-1)
    accuracy = np.array(RATE_ACCURACY_M)[classes[row, column]]
    return PlateMotion((velocity * east).sum(axis=-1), (velocity * north).sum(axis=-1), accuracy)


def move_to_epoch(
    lon_deg: npt.ArrayLike, lat_deg: npt.ArrayLike, from_epoch: npt.ArrayLike, to_epoch: float
) -> MovedPositions:
    """Positions in the ITRF at another epoch, by the motion of their plates; heights do not change.

    Parameters
    ----------
    lon_deg, lat_deg : array_like, shape (N,)
        [deg]
    from_epoch : array_like, shape (N,) or ()
        Epoch of the positions. [decimal year]
    to_epoch : float
        [decimal year]
    """
    lon, lat = (np.atleast_1d(np.asarray(values, dtype=np.float64)) for values in (lon_deg, lat_deg))
    years = to_epoch - np.asarray(from_epoch, dtype=np.float64)
    motion = plate_motion(lon, lat)
    east_m, north_m = metres_per_radian(np.radians(lat))
    moved_lon = lon + np.degrees(motion.east_m * years / np.maximum(east_m, 1.0))
    moved_lat = lat + np.degrees(motion.north_m * years / north_m)
    return MovedPositions((moved_lon + 180.0) % 360.0 - 180.0, moved_lat, np.abs(years) * motion.accuracy_m)


def decimal_year(at: datetime) -> float:
    """The epoch of a time, as coordinate epochs are written."""
    utc = at.astimezone(UTC)
    start = datetime(utc.year, 1, 1, tzinfo=UTC)
    return utc.year + (utc - start) / (datetime(utc.year + 1, 1, 1, tzinfo=UTC) - start)


@lru_cache(maxsize=1)
def _grid() -> tuple[npt.NDArray[np.int8], npt.NDArray[np.int8]]:
    """Plate and class of each cell, shape (180, 360): from north to south and from -180 degrees eastwards."""
    text = resources.files("app.geodesy").joinpath("data", "plates.txt").read_text("ascii")
    names = {name: number for number, name in enumerate(ANGULAR_VELOCITY_MAS)}
    rows = [_CELLS.findall(line) for line in text.splitlines()]
    plates = [np.repeat([names[name] for name, _, _ in row], [int(count) for _, _, count in row]) for row in rows]
    classes = [np.repeat([int(grade) for _, grade, _ in row], [int(count) for _, _, count in row]) for row in rows]
    return np.array(plates, dtype=np.int8), np.array(classes, dtype=np.int8)
