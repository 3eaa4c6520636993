"""Markers as they lie on a lane, as they were surveyed, and which of them are missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from app.encoders.cerpm.placement import MarkerPlace, place_markers
from app.errors import InvalidParameter
from app.markers.cerpm import DEGREE_STEP, LaneSide, SpeedLimit
from app.simulation.radio.lanes import TrueLane

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

SURVEY_SD_M = 0.02
"""Of a surveyed coordinate, each axis: the paper's Trimble Catalyst DA2, section 2.2. [m]"""
_LAYING_SD_M = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class LaidMarkers:
    """Markers of a lane, by chainage.

    Attributes
    ----------
    number : ndarray of int, shape (N,)
        Within the agency.
    side : ndarray of int, shape (N,)
        True `LaneSide`, whatever the marker says.
    chainage_m : ndarray, shape (N,)
        Along the lane's centre line. [m]
    point_m : ndarray, shape (N, 2)
        Where it lies: east and north. [m]
    lon_deg, lat_deg : ndarray, shape (N,)
        Where its survey puts it, in steps of 1e-7 degrees. [deg]
    told_side : ndarray of int, shape (N,)
        `LaneSide` that it was programmed with.
    speed_limit : SpeedLimit or None
    """

    number: Ints
    side: Ints
    chainage_m: Floats
    point_m: Floats
    lon_deg: Floats
    lat_deg: Floats
    told_side: Ints
    speed_limit: SpeedLimit | None = None

    def __len__(self) -> int:
        return len(self.number)

    def chosen(self, which: npt.NDArray[np.bool_] | Ints) -> LaidMarkers:
        """Some of them, by mask or place."""
        arrays = {f.name: getattr(self, f.name)[which] for f in fields(self) if f.name != "speed_limit"}
        return LaidMarkers(**arrays, speed_limit=self.speed_limit)

    def without_sides(self) -> LaidMarkers:
        """The same, programmed without their sides."""
        return replace(self, told_side=np.full(len(self), int(LaneSide.UNKNOWN)))


def lay_markers(
    lane: TrueLane,
    rng: np.random.Generator,
    *,
    spacing_m: float = 12.192,
    closer_in_bends: bool = True,
    markers_per_side: int | None = None,
    survey_sd_m: float = SURVEY_SD_M,
    first_number: int = 1,
    speed_limit: SpeedLimit | None = None,
) -> LaidMarkers:
    """Place markers on a lane's boundaries, lay them a centimetre off, and survey them.

    Parameters
    ----------
    lane : TrueLane
    rng : numpy.random.Generator
        Draws where they lie, how they are surveyed, and in what order they are numbered.
    spacing_m, closer_in_bends, markers_per_side
        See `place_markers`.
    survey_sd_m : float
        Standard deviation of a surveyed coordinate, each axis. [m]
    first_number : int
        Numbers go up from it, in no order of the road.
    speed_limit : SpeedLimit, optional
        That all of them tell.
    """
    places = place_markers(
        lane.left_m,
        lane.right_m,
        spacing_m=spacing_m,
        closer_in_bends=closer_in_bends,
        markers_per_side=markers_per_side,
    )
    return survey_places(lane, places, rng, survey_sd_m=survey_sd_m, first_number=first_number, speed_limit=speed_limit)


def survey_places(
    lane: TrueLane,
    places: Sequence[MarkerPlace],
    rng: np.random.Generator,
    *,
    survey_sd_m: float = SURVEY_SD_M,
    first_number: int = 1,
    speed_limit: SpeedLimit | None = None,
) -> LaidMarkers:
    """Lay markers at places, a centimetre off, and survey them: see `lay_markers`."""
    if not 0 <= survey_sd_m <= 100:
        raise InvalidParameter(f"a survey of {survey_sd_m:g} m", field="survey_sd_m", limit="0 to 100 m")
    count = len(places)
    point = np.array([place.point_m for place in places]).reshape(-1, 2) + rng.normal(0, _LAYING_SD_M, (count, 2))
    lon, lat = lane.wgs84_from_enu(point + rng.normal(0, 1, (count, 2)) * survey_sd_m)
    side = np.array([int(place.side) for place in places], int)
    return LaidMarkers(
        number=first_number + rng.permutation(count),
        side=side,
        chainage_m=np.array([place.chainage_m for place in places], float),
        point_m=point,
        lon_deg=np.round(lon / DEGREE_STEP) * DEGREE_STEP,
        lat_deg=np.round(lat / DEGREE_STEP) * DEGREE_STEP,
        told_side=side.copy(),
        speed_limit=speed_limit,
    )


def lose_share(markers: LaidMarkers, share: float, rng: np.random.Generator) -> LaidMarkers:
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


def lose_row(markers: LaidMarkers, count: int, rng: np.random.Generator, side: LaneSide | None = None) -> LaidMarkers:
    """Markers without some neighbours on one side; its first and last marker stay.

    Raises
    ------
    InvalidParameter
        The side has not two markers more than are to be missing.
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
