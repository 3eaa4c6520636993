"""What a trace says: magnets, line crossings, tags, and what was noise."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from app.markers.magnet import InformationTag, LineStyle, Orientation, Polarity
from app.sensors.magnetometer_bar import MagnetTrace
from app.values import Floats


class Side(StrEnum):
    """Side of the vehicle on which a line lies: the side to which it leaves its lane."""

    LEFT = "left"
    RIGHT = "right"


class NoiseKind(StrEnum):
    """Why something in the trace is no magnet."""

    FERROUS = "ferrous-object"
    WRONG_MOMENT = "moment-unlike-a-magnet"
    WRONG_HEIGHT = "not-on-the-road-surface"
    UNKNOWN_CLEARANCE = "clearance-not-known"
    SKEW = "neither-upright-nor-forward"
    WEAK = "too-weak-to-be-sure"
    BESIDE = "beside-the-bar"
    GAP = "gap-in-the-trace"
    SENSOR = "sensor-fault"


@dataclass(frozen=True, slots=True)
class MagnetReading:
    """A magnet that was passed."""

    t_s: float  # [s] when the bar was over it
    odometer_m: float  # [m] distance driven since the trace began, by the vehicle's speed
    lateral_cm: float  # [cm] on the bar, from its middle, left positive
    polarity: Polarity  # as driven over: of a forward magnet (phi = 0) the other one if the vehicle is on the wrong way
    phi_deg: Orientation
    confidence: float  # probability that polarity and orientation are right, 0 to 1
    clearance_cm: float = 0.0  # [cm] of the bar above the magnet
    moment_am2: tuple[float, float, float] = (0.0, 0.0, 0.0)  # [A m2] fitted moment in vehicle axes
    along_std_m: float | None = None  # [m] standard error of its place along the drive; the paper's method has none
    # [m] the same against magnets near it, with which it shares the error of the time stamps
    relative_std_m: float = 0.0
    snr: float = 0.0  # root of the energy that the magnet explains, in standard deviations of the noise


@dataclass(frozen=True, slots=True, eq=False)
class PlacedMagnet:
    """A magnet's reading and its position on the plane of the vehicle's path, shape (2,). [m]"""

    reading: MagnetReading
    place_m: npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LineCrossing:
    """The bar came over a line: a lane departure unless it was meant."""

    # `t_s`, `odometer_m`: when and where the first magnet of the line was passed. [s, m]
    t_s: float
    odometer_m: float
    style: LineStyle  # solid or dashed
    side: Side  # side on which the line lies
    lateral_cm: float  # [cm] of the first magnet, left positive
    confidence: float  # of the first magnet


@dataclass(frozen=True, slots=True)
class TagReading:
    """An information tag that was passed."""

    # `start_s`, `end_s`: [s] when its first and last magnet were passed
    start_s: float
    end_s: float
    polarities: tuple[Polarity, ...]  # as met
    gaps_m: tuple[float, ...]  # [m] distances from each magnet to the next, as measured
    gap_std_m: tuple[float, ...]  # [m] their standard errors
    length_m: float  # [m] first magnet to last, as measured
    # `ratios`, `ratio_std`: d_2/d_1 .. d_(M-1)/d_1 and their standard errors.
    ratios: tuple[float, ...]
    ratio_std: tuple[float, ...]
    lateral_cm: float  # [cm] mean place on the bar, left positive
    tag: InformationTag | None  # the tag that it is, where registered tags or a format are known
    wrong_way: bool  # it is that tag met from behind: the vehicle drives against the legal direction
    # `missing`, `extra`: magnets of the tag that were not seen, and seen magnets that are not of it
    missing: int
    extra: int
    confidence: float  # probability that it is that tag (without candidates: that all polarities are right)
    magnets: tuple[MagnetReading, ...]


@dataclass(frozen=True, slots=True)
class NoiseFinding:
    """Something that stood out and is not taken for a magnet, or a part of the trace that could not be used."""

    # `t_s`, `odometer_m`: when and where. [s, m]
    t_s: float
    odometer_m: float
    lateral_cm: float  # [cm] on the bar, left positive
    kind: NoiseKind
    reason: str  # for people, with the figures


Finding = MagnetReading | LineCrossing | TagReading | NoiseFinding


@dataclass(frozen=True, slots=True)
class LikelyMistake:
    """A declaration that the recording contradicts."""

    field: str  # of the declaration
    reason: str  # what does not fit, with figures
    cure: str  # what to declare

    @property
    def text(self) -> str:
        """Reason and cure in one sentence."""
        return f"{self.reason}: {self.cure}"


@dataclass(frozen=True, slots=True, eq=False)
class CheckedRecording:
    """A recording that was decoded as its bar is mounted."""

    findings: list[Finding]
    faults: tuple[LikelyMistake, ...]  # of the bar: none where it is as declared
    trace: MagnetTrace  # as the declared bar would have recorded it
    is_refused: bool = False  # the bar is not as declared, and how it is cannot be decided


# === Where magnets lie on the plane: speed integrated along the heading, and the place on the bar (equation 1).


class VehiclePath:
    """The path of the vehicle's origin by odometer and heading; straight ahead where there is no heading.

    Parameters
    ----------
    forward_m : float
        Of the bar, ahead of the point that moves along the heading. [m]
    """

    def __init__(self, forward_m: float) -> None:
        self._forward_m = forward_m
        self._rows = np.empty((0, 4))  # odometer, yaw, x, y

    @property
    def reach_m(self) -> float:
        """Odometer up to which it is known."""
        return float(self._rows[-1, 0]) if len(self._rows) else -1.0

    def append(self, s: Floats, yaw: Floats) -> None:
        """Add blocks: odometer and yaw (anticlockwise, unwrapped). [m, rad]"""
        if not s.size:
            return
        last = self._rows[-1] if len(self._rows) else np.array([s[0], yaw[0], 0.0, 0.0])
        step = np.diff(np.concatenate(([last[0]], s)))
        middle = (yaw + np.concatenate(([last[1]], yaw[:-1]))) / 2
        x = np.cumsum(np.concatenate(([last[2]], step * np.cos(middle))))[1:]
        y = np.cumsum(np.concatenate(([last[3]], step * np.sin(middle))))[1:]
        self._rows = np.concatenate((self._rows, np.stack([s, yaw, x, y], 1)))

    def forget(self, before_m: float) -> None:
        """Drop what lies before a distance, in large pieces."""
        n = int(np.searchsorted(self._rows[:, 0], before_m))
        if n > 1000:
            self._rows = self._rows[n:].copy()

    def position_m(self, odometer_m: float, lateral_m: float) -> Floats:
        """Position of a magnet that the bar passed at an odometer, so far to the left of its middle, shape (2,). [m]"""
        s = self._rows[:, 0]
        yaw, x, y = (np.interp(odometer_m, s, self._rows[:, k]) for k in (1, 2, 3))
        c, n = np.cos(yaw), np.sin(yaw)
        return np.array([x + self._forward_m * c - lateral_m * n, y + self._forward_m * n + lateral_m * c])
