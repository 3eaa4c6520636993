"""Installed markers of a lane: true and surveyed positions, and missing markers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.lanes.marker_place import MarkerPlace
from app.markers.cerpm import DEGREE_STEP, LaneSide, SpeedLimit
from app.simulation.radio.lanes import TrueLane

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

SURVEY_SD_M = 0.02  # [m] of a surveyed coordinate, each axis; source: Trimble Catalyst DA2, CERPM paper, section 2.2
_PLACING_SD_M = 0.01  # [m] of placing a marker, each axis; source: assumed, no measurement kept


@dataclass(frozen=True, slots=True, eq=False)
class InstalledMarkers:
    """Markers of a lane, by chainage.

    Attributes
    ----------
    number : ndarray of int, shape (N,)
        Within the agency.
    side : ndarray of int, shape (N,)
        True `LaneSide`, whatever the marker sends.
    chainage_m : ndarray, shape (N,)
        Along the lane's centre line. [m]
    point_m : ndarray, shape (N, 2)
        True position: east and north. [m]
    lon_deg, lat_deg : ndarray, shape (N,)
        Surveyed position, in steps of 1e-7 degrees. [deg]
    broadcast_side : ndarray of int, shape (N,)
        `LaneSide` that it is programmed with.
    speed_limit : SpeedLimit or None
    """

    number: Ints
    side: Ints
    chainage_m: Floats
    point_m: Floats
    lon_deg: Floats
    lat_deg: Floats
    broadcast_side: Ints
    speed_limit: SpeedLimit | None = None

    def __len__(self) -> int:
        return len(self.number)

    def chosen(self, which: npt.NDArray[np.bool_] | Ints) -> InstalledMarkers:
        """Some of them, by mask or index."""
        arrays = {f.name: getattr(self, f.name)[which] for f in fields(self) if f.name != "speed_limit"}
        return InstalledMarkers(**arrays, speed_limit=self.speed_limit)

    def without_sides(self) -> InstalledMarkers:
        """The same, programmed without their sides."""
        return replace(self, broadcast_side=np.full(len(self), int(LaneSide.UNKNOWN)))


def install_markers(
    lane: TrueLane,
    places: Sequence[MarkerPlace],
    rng: np.random.Generator,
    *,
    survey_sd_m: float = SURVEY_SD_M,
    first_number: int = 1,
    speed_limit: SpeedLimit | None = None,
) -> InstalledMarkers:
    """Install markers near places, within a centimetre, and survey them.

    Parameters
    ----------
    lane : TrueLane
    places : sequence of MarkerPlace
        In the lane's local frame, as `app.planning.cerpm_placement.place_markers` gives them.
    rng : numpy.random.Generator
        Draws positions, survey errors and the order of numbers.
    survey_sd_m : float
        Standard deviation of a surveyed coordinate, each axis. [m]
    first_number : int
        Lowest number; numbers are in random order along the road.
    speed_limit : SpeedLimit, optional
        That all of them broadcast.

    Raises
    ------
    InvalidParameter
        The survey's standard deviation is not from 0 to 100 m.
    """
    if not 0 <= survey_sd_m <= 100:
        raise InvalidParameter(f"a survey of {survey_sd_m:g} m", field="survey_sd_m", limit="0 to 100 m")
    count = len(places)
    point = np.array([place.point_m for place in places]).reshape(-1, 2) + rng.normal(0, _PLACING_SD_M, (count, 2))
    lon, lat = lane.wgs84_from_enu(point + rng.normal(0, 1, (count, 2)) * survey_sd_m)
    side = np.array([int(place.side) for place in places], int)
    return InstalledMarkers(
        number=first_number + rng.permutation(count),
        side=side,
        chainage_m=np.array([place.chainage_m for place in places], float),
        point_m=point,
        lon_deg=np.round(lon / DEGREE_STEP) * DEGREE_STEP,
        lat_deg=np.round(lat / DEGREE_STEP) * DEGREE_STEP,
        broadcast_side=side.copy(),
        speed_limit=speed_limit,
    )


def lose_share(markers: InstalledMarkers, share: float, rng: np.random.Generator) -> InstalledMarkers:
    """Markers without a share of them, drawn anywhere on both sides.

    Raises
    ------
    InvalidParameter
        The share is not from 0 to 1.
    """
    if not 0 <= share <= 1:
        raise InvalidParameter(f"a share of {share:g}", field="share", limit="0 to 1")
    keep = np.ones(len(markers), bool)
    keep[rng.choice(len(markers), round(share * len(markers)), replace=False)] = False
    return markers.chosen(keep)


def lose_row(
    markers: InstalledMarkers, count: int, rng: np.random.Generator, side: LaneSide | None = None
) -> InstalledMarkers:
    """Markers without some neighbours on one side; its first and last marker stay.

    Raises
    ------
    InvalidParameter
        The side has fewer than two markers more than are to be lost.
    """
    which = side if side is not None else LaneSide(int(rng.integers(1, 3)))
    row = np.flatnonzero(markers.side == which)
    if not 0 <= count <= len(row) - 2:
        raise InvalidParameter(
            f"{count} of {len(row)} markers on a side", field="count", limit="two less than the side has"
        )
    start = int(rng.integers(1, len(row) - count))
    keep = np.ones(len(markers), bool)
    keep[row[start : start + count]] = False
    return markers.chosen(keep)
