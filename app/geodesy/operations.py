"""Transformations to ITRF2014 with a stated accuracy, and their grids."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
from pyproj import Transformer, datadir, network
from pyproj.transformer import TransformerGroup

from app.geodesy.systems import best_effort, covers, named_system

_ITRF2014_2D, _ITRF2014_3D = "EPSG:9000", "EPSG:7912"
_TIMELY = ("t_epoch", "defmodel")
_MAX_NAME = 200  # characters; source: by hand, a note has 500


@dataclass(frozen=True, slots=True)
class BoundedOperation:
    """A transformation to ITRF2014.

    Attributes
    ----------
    transformer : Transformer
    bound_m : float
        Its stated accuracy. [m]
    name : str
        Its name in PROJ.
    needs_epoch : bool
        Whether it depends on time: PROJ assumes an epoch if there is none.
    """

    transformer: Transformer
    bound_m: float
    name: str
    needs_epoch: bool

    def covers(self, lon_deg: npt.NDArray[np.float64], lat_deg: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        """Which places are in its area of use, where its stated accuracy holds."""
        return covers(self.transformer.area_of_use, lon_deg, lat_deg)


@lru_cache(maxsize=256)
def bounded_operations(name: str, three_d: bool) -> tuple[BoundedOperation, ...]:
    """Operations from a system's longitudes and latitudes to ITRF2014 that can be run here and state an accuracy.

    The most accurate comes first. From a projected system PROJ does not find operations with an intermediate system: it
    finds none from ETRS89 / UTM zone 32N, but four from ETRS89.
    """
    target = _ITRF2014_3D if three_d else _ITRF2014_2D
    geographic = named_system(name).geodetic_crs
    assert geographic is not None
    source = geographic.to_3d() if three_d else geographic.to_2d()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # missing grids only reduce the choice
        try:
            group = TransformerGroup(source, target, always_xy=True, allow_ballpark=False)
        except IndexError:  # pyproj raises it if PROJ knows no operation
            return ()
    stated = [
        BoundedOperation(
            transformer,
            float(transformer.accuracy),
            str(transformer.description)[:_MAX_NAME],
            any(word in transformer.definition for word in _TIMELY),
        )
        for transformer in group.transformers
        if transformer.accuracy >= 0
    ]
    return tuple(sorted(stated, key=lambda operation: operation.bound_m))


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
        return "no transformation with a stated accuracy to WGS 84 / ITRF is available"
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
    best_effort.cache_clear()


@lru_cache(maxsize=1)
def _own_folders() -> str:
    return datadir.get_data_dir()
