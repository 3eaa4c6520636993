"""Inputs and results of estimating a lane, and the places of markers on it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from app.errors import InvalidParameter
from app.inputs import Declaration
from app.markers.cerpm import LaneSide
from app.values import Floats, Ints

# === The planned place of a marker on a boundary of a lane.


@dataclass(frozen=True, slots=True)
class MarkerPlace:
    """The place of one marker."""

    side: LaneSide  # LEFT or RIGHT
    chainage_m: float  # [m] along the lane's centre line; the same for both of a pair
    point_m: tuple[float, float]  # [m] east and north in the frame of the boundaries, on the boundary
    heading_deg: float  # [deg] direction of travel there, clockwise from north of the frame


# === Inputs and results of estimating a lane.


MAX_TRACK_SIGNIFICANCE = 4.5  # standard deviations above which path and track disagree; 1 in 150,000
MIN_TRACK_EFFECT_M = 0.4  # [m] smaller disagreements are not reported; a lane leaves as much room
UNKNOWN, LEFT, RIGHT = (int(side) for side in (LaneSide.UNKNOWN, LaneSide.LEFT, LaneSide.RIGHT))
NO_LINE = -1  # of a marker whose line is not registered


@dataclass(frozen=True, slots=True, eq=False)
class LaneMarkers:
    """Verified markers of one lane, one row for each position that a marker number has sent.

    Raises
    ------
    InvalidParameter
        Lengths differ, or a side is not a `LaneSide`.
    """

    number: Ints  # shape (K,)
    # `lon_deg`, `lat_deg`: shape (K,): [deg] WGS 84 / ITRF; a row that is not a position on Earth is left out and
    # reported
    lon_deg: Floats
    lat_deg: Floats
    side: Ints  # shape (K,): `LaneSide` values
    sigma_m: Floats  # shape (K,): [m] standard deviation of the survey on each axis; 0.02 m where it is not known
    speed_limit_kmh: Floats  # shape (K,): [km/h] NaN where none is posted
    # shape (K,): registered line of the road on which each stands; NO_LINE where none is registered, as without a value
    line: Ints = field(default_factory=lambda: np.empty(0, np.int64))

    def __post_init__(self) -> None:
        if not np.size(self.line):
            object.__setattr__(self, "line", np.full(np.size(self.number), NO_LINE))
        lengths = set()
        for name in self.__slots__:
            kind = np.int64 if name in ("number", "side", "line") else np.float64
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
            raise InvalidParameter("a marker's side is not a known side", field="markers.side", limit="0, 1 or 2")

    def __len__(self) -> int:
        return len(self.number)


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class LaneDeclaration(Declaration):
    """Rules for the lane's estimation."""

    # 11 ft; lanes are 9 to 12 ft wide (AASHTO Green Book, 4.3)
    usual_width_m: Positive = Field(3.3, description="Width where only one side is known. [m]")
    # with `off_the_line_z` of `LaneRules`; sensitivity 1.00, 0.99
    off_the_line_m: Positive = Field(
        0.6, description="A marker that is farther from its neighbours' line is left out. [m]"
    )
    # sensitivity 1.00, 1.00
    bridge_m: Positive = Field(150.0, description="Without a track, the widest stretch without a marker. [m]")


class LaneRules(LaneDeclaration):
    """Limits of the lane estimate."""

    # a marker is left out if it is also this many standard deviations off its neighbours' line
    off_the_line_z: Positive = 5.0  # sensitivity 1.00, 0.99
    # [m] two positions of one marker number further apart than this are two places
    same_place_m: Positive = 0.3  # [m] a survey of 0.1 m at three sigma
    # [m] how far past the outermost markers the path follows the vehicle's track
    reach_m: Positive = 25.0  # [m] two spacings of the paper's 12.2 m
    # [m] past the outermost markers, the path ends where its standard deviation exceeds this
    max_end_sigma_m: Positive = 0.5  # [m] sensitivity 1.00, 1.00
    # [m] the lane is refused if the median standard deviation of its stations exceeds this
    max_median_sigma_m: Positive = 1.0  # [m] sensitivity 1.00, 1.00
    # the lane is refused if more than this share of the markers lies off the line
    max_outlier_ratio: Positive = 0.25  # sensitivity 1.00, 1.00
    # [m] Confidence is the probability that the path is within this distance of the lane's centre
    tolerance_m: Positive = 0.25  # [m] source: the definition of confidence (docs/nomenclature.md)


class PacketStrengths(NamedTuple):
    """How strongly packets of markers were received, each of shape (P,)."""

    number: Ints
    time_s: Floats  # [s] on the clock of the vehicle's track
    rssi_dbm: Floats


class LeftOutReason(StrEnum):
    """Why a marker was not used for the path."""

    NOT_A_PLACE = "not_a_place"
    """Its position is not finite or not on Earth."""
    TWO_PLACES = "two_places"
    """Its number was received with two positions."""
    OFF_THE_LINE = "off_the_line"
    """Its position is off the line of its neighbours: spoofed, moved or wrongly programmed."""
    WRONG_SIDE = "wrong_side"
    """Its position is on one boundary, its message names the other."""
    APART = "apart"
    """It is too far from the rest to belong to the same stretch of lane."""
    OTHER_LANE = "other_lane"
    """It is another lane's marker: it is on no boundary of the driven lane."""

    @property
    def text(self) -> str:
        """For people."""
        return self.value.replace("_", " ")


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A marker that was left out."""

    row: int  # row of `LaneMarkers`
    number: int
    reason: LeftOutReason
    off_m: float  # [m] distance from the position that the other markers predict; NaN where there is no prediction


@dataclass(frozen=True, slots=True)
class TrackAgreement:
    """How the path lies against the vehicle's track, beyond what driver and receiver explain where it disagrees.

    It is the transformation that brings the track onto the path.
    """

    # `east_m`, `north_m`: [m] shift of the markers' path against the track
    east_m: float
    north_m: float
    shift_sigma_m: float  # [m] of the shift in its own direction: driver, receiver and geometry
    # `turn_deg`, `turn_sigma_deg`: [deg] turn about the middle of the track, anticlockwise
    turn_deg: float
    turn_sigma_deg: float
    # `scale_ppm`, `scale_sigma_ppm`: [ppm] the path is longer than the track by this
    scale_ppm: float
    scale_sigma_ppm: float
    # of shift, turn and scale, together or of one of them alone, whichever is larger. In standard deviations.
    significance: float
    effect_m: float  # [m] how far the transformation moves the track, across the path, RMS
    disagrees: bool  # the path may not be trusted

    @property
    def reason(self) -> str:
        """What disagrees, for people."""
        parts = [f"shifted by {self.east_m:+.2f} m east and {self.north_m:+.2f} m north"]
        if abs(self.turn_deg) > MAX_TRACK_SIGNIFICANCE * self.turn_sigma_deg:
            parts.append(f"turned by {self.turn_deg:+.2f} degrees")
        if abs(self.scale_ppm) > MAX_TRACK_SIGNIFICANCE * self.scale_sigma_ppm:
            parts.append(f"scaled by {self.scale_ppm:+.0f} ppm")
        return (
            f"all markers are {', '.join(parts)} against the vehicle's track ({self.significance:.0f} standard "
            "deviations): check the datum and the survey of the markers, and of the receiver"
        )


@dataclass(frozen=True, slots=True)
class LaneStretch:
    """A stretch of the path, and the lane in which the vehicle was beside it."""

    # `from_m`, `to_m`: [m] stations of the path
    from_m: float
    to_m: float
    lane: int  # lanes to the left of the path's: 0 in it, 1 in the next lane on the left, -1 in the next on the right
    changing: bool  # the vehicle changed lane there


@dataclass(frozen=True, slots=True, eq=False)
class LaneBeside:
    """Another lane whose markers were received."""

    position: int  # lanes to the left of the path's: 1 for the next one on the left, -1 for the next on the right
    direction: Literal["same", "oncoming", "unknown"]  # of travel, as the sides that its markers send show it
    lane: Lane  # in its direction of travel, where that is known


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """The reference path of a lane, at stations in the direction of travel; without stations if it was refused."""

    # `origin_lon_deg`, `origin_lat_deg`: [deg] origin of the local frames, on the ellipsoid
    origin_lon_deg: float
    origin_lat_deg: float
    station_m: Floats  # shape (S,): [m] distance along the path
    # `position_enu_m`, `left_enu_m`, `right_enu_m`: shape (S, 2): [m] path and boundaries, east and north of the
    # origin; boundaries are NaN where no marker determines them
    position_enu_m: Floats
    left_enu_m: Floats
    right_enu_m: Floats
    # `lon_deg`, `lat_deg`: shape (S,): [deg] of the path
    lon_deg: Floats
    lat_deg: Floats
    heading_deg: Floats  # shape (S,): [deg] in the direction of travel, clockwise from true north there
    curvature_per_m: Floats  # shape (S,): [1/m] positive to the left
    width_m: Floats  # shape (S,): [m] NaN where only the usual width is known
    speed_limit_kmh: Floats  # shape (S,): [km/h] sent by the marker passed last; NaN where none is posted
    sigma_m: Floats  # shape (S,): [m] standard deviation of the path across its direction
    confidence: Floats  # shape (S,): probability that the path is within `LaneRules.tolerance_m` of the centre
    side: Ints  # shape (K,): boundary that each marker was assigned to; 0 for markers that were not used
    # shape (K,): [m] distance of each marker from its boundary, left positive; NaN for markers that were not used
    residual_m: Floats
    left_out: tuple[LeftOut, ...] = ()
    localization_warnings: tuple[str, ...] = ()  # why the path may be wrong or less accurate than usual, for people
    refusal: str | None = None  # why there is no path
    method: str = "waymark"
    track_agreement: TrackAgreement | None = None  # with the vehicle's track; None without a track beside the path
    # the vehicle's track was used, but does not run beside the path: the path may be anywhere
    track_apart: bool = False
    stretches: tuple[LaneStretch, ...] = ()  # in which lane the vehicle was; none where it stayed in the path's
    beside: tuple[LaneBeside, ...] = ()  # other lanes, the nearest first on each side

    @property
    def of_other_lanes(self) -> frozenset[int]:
        """Numbers of markers that are on no boundary of this lane, but of another one."""
        return frozenset(out.number for out in self.left_out if out.reason is LeftOutReason.OTHER_LANE)

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
    """Markers left out and warnings collected while a lane is estimated."""

    left_out: list[LeftOut] = field(default_factory=list)
    localization_warnings: list[str] = field(default_factory=list)

    def copy(self) -> Notes:
        """The same so far."""
        return Notes(list(self.left_out), list(self.localization_warnings))

    def warn(self, text: str) -> None:
        """Add a warning, once."""
        if text not in self.localization_warnings:
            self.localization_warnings.append(text)
