"""What goes into the fit of a lane and what comes out of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.markers.cerpm import LaneSide

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]
UNKNOWN, LEFT, RIGHT = (int(side) for side in (LaneSide.UNKNOWN, LaneSide.LEFT, LaneSide.RIGHT))


@dataclass(frozen=True, slots=True, eq=False)
class LaneMarkers:
    """Verified markers of one lane, one row for each place that a number claims.

    Parameters
    ----------
    number : array_like of int, shape (K,)
    lon_deg, lat_deg : array_like, shape (K,)
        WGS 84 / ITRF; a row that is not a place on Earth is left out and named. [deg]
    side : array_like of int, shape (K,)
        `LaneSide` values.
    sigma_m : array_like, shape (K,)
        Standard deviation of the survey on each axis; 0.02 m where it is not known. [m]
    speed_limit_km_h : array_like, shape (K,)
        NaN where none is posted. [km/h]

    Raises
    ------
    InvalidParameter
        Lengths differ, or a side is none of the three.
    """

    number: Ints
    lon_deg: Floats
    lat_deg: Floats
    side: Ints
    sigma_m: Floats
    speed_limit_km_h: Floats

    def __post_init__(self) -> None:
        lengths = set()
        for name in self.__slots__:
            kind = np.int64 if name in ("number", "side") else np.float64
            try:
                values = np.asarray(getattr(self, name))
                if kind is np.int64 and values.size and not np.issubdtype(values.dtype, np.integer):
                    raise TypeError("not whole numbers")
                values = np.atleast_1d(values.astype(kind))
            except (TypeError, ValueError) as error:
                raise InvalidParameter(f"{name} of the markers is not numeric", field=f"markers.{name}") from error
            lengths.add(values.shape)
            object.__setattr__(self, name, values)
        if len(lengths) != 1 or self.number.ndim != 1:
            raise InvalidParameter("markers have one value of each kind per row", field="markers")
        if ((self.side < UNKNOWN) | (self.side > RIGHT)).any():
            raise InvalidParameter("a marker's side is none of the three", field="markers.side", limit="0, 1 or 2")

    def __len__(self) -> int:
        return len(self.number)


@dataclass(frozen=True, slots=True)
class LaneRules:
    """What a lane may look like. Lengths are checked to be positive and finite.

    Attributes
    ----------
    usual_width_m : float
        Width where only one side is known. [m]
    off_the_line_m : float
        A marker must stray at least this far from where its neighbours put it before it is left out. [m]
    off_the_line_z : float
        And at least this many standard deviations.
    duplicate_m : float
        Two claims of one number further apart than this are two places. [m]
    reach_m : float
        How far past the outermost markers the vehicle's track carries the path. [m]
    worst_sigma_m : float
        The path ends where past the outermost markers its standard deviation grows above this. [m]
    bridge_m : float
        Without a track, the widest stretch without a marker that is bridged. [m]
    hopeless_sigma_m : float
        There is no path where at half of its stations its standard deviation is above this. [m]
    most_strays : float
        There is no path where more than this share of the markers lies off it.
    tolerance_m : float
        Confidence is the probability that the path is within this of the centre. [m]
    """

    usual_width_m: float = 3.3
    off_the_line_m: float = 0.6
    off_the_line_z: float = 5.0
    duplicate_m: float = 0.3
    reach_m: float = 25.0
    worst_sigma_m: float = 0.5
    bridge_m: float = 150.0
    hopeless_sigma_m: float = 1.0
    most_strays: float = 0.25
    tolerance_m: float = 0.25

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InvalidParameter(f"{name} is {value}", field=f"rules.{name}", limit="positive and finite")


class LeftOutReason(StrEnum):
    """Why a marker took no part in the path."""

    NOT_A_PLACE = "not_a_place"
    """Its position is not finite or not on Earth."""
    TWO_PLACES = "two_places"
    """Its number claims two places."""
    OFF_THE_LINE = "off_the_line"
    """It claims a place off its neighbours' line: spoofed, moved or wrongly programmed."""
    WRONG_SIDE = "wrong_side"
    """It lies on one boundary and says that it stands on the other."""
    APART = "apart"
    """It is too far from the rest to belong to the same stretch of lane."""


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A marker that was left out.

    Attributes
    ----------
    row : int
        Of `LaneMarkers`.
    number : int
    reason : LeftOutReason
    off_m : float
        How far its place is from the one that the rest gives it; NaN where that cannot be said. [m]
    """

    row: int
    number: int
    reason: LeftOutReason
    off_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """The reference path of a lane, at stations along it in the direction of travel; none where it was refused.

    Attributes
    ----------
    origin_lon_deg, origin_lat_deg : float
        Of the local frames, on the ellipsoid. [deg]
    station_m : ndarray, shape (S,)
        Along the path. [m]
    position_enu_m, left_enu_m, right_enu_m : ndarray, shape (S, 2)
        Path and boundaries, east and north of the origin; boundaries are NaN where no marker tells of them. [m]
    lon_deg, lat_deg : ndarray, shape (S,)
        The path. [deg]
    heading_deg : ndarray, shape (S,)
        In the direction of travel, clockwise from true north there. [deg]
    curvature_1pm : ndarray, shape (S,)
        Positive to the left. [1/m]
    width_m : ndarray, shape (S,)
        NaN where only the usual width is known. [m]
    speed_limit_km_h : ndarray, shape (S,)
        Of the marker passed last; NaN where none is posted. [km/h]
    sigma_m : ndarray, shape (S,)
        Standard deviation of the path across its direction. [m]
    confidence : ndarray, shape (S,)
        Probability that the path is within `LaneRules.tolerance_m` of the centre: erf(tolerance / (sqrt(2) sigma)).
    side : ndarray of int, shape (K,)
        Boundary that each marker was found to stand on; 0 where it took no part.
    residual_m : ndarray, shape (K,)
        How far each marker lies off its boundary, left positive; NaN where it took no part. [m]
    left_out : tuple of LeftOut
    doubts : tuple of str
        What a reader should know before trusting the path.
    refusal : str or None
        Why there is no path.
    method : str
    """

    origin_lon_deg: float
    origin_lat_deg: float
    station_m: Floats
    position_enu_m: Floats
    left_enu_m: Floats
    right_enu_m: Floats
    lon_deg: Floats
    lat_deg: Floats
    heading_deg: Floats
    curvature_1pm: Floats
    width_m: Floats
    speed_limit_km_h: Floats
    sigma_m: Floats
    confidence: Floats
    side: Ints
    residual_m: Floats
    left_out: tuple[LeftOut, ...] = ()
    doubts: tuple[str, ...] = ()
    refusal: str | None = None
    method: str = "waymark"

    @property
    def east_m(self) -> Floats:
        """East of the origin, shape (S,). [m]"""
        return self.position_enu_m[:, 0]

    @property
    def north_m(self) -> Floats:
        """North of the origin, shape (S,). [m]"""
        return self.position_enu_m[:, 1]

    @property
    def down_m(self) -> Floats:
        """Below the origin's plane: 0, the path is flat. Shape (S,). [m]"""
        return np.zeros(len(self.station_m))


@dataclass(slots=True)
class Notes:
    """What was left out and doubted on the way to a lane."""

    left_out: list[LeftOut] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)

    def doubt(self, text: str) -> None:
        """Say it once."""
        if text not in self.doubts:
            self.doubts.append(text)
