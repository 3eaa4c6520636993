"""What a trace says: magnets, line crossings, tags, and what was noise."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from app.markers.magnet import InformationTag, LineStyle, Orientation, Polarity


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
    """A magnet that was passed.

    Attributes
    ----------
    t_s : float
        When the bar was over it. [s]
    odometer_m : float
        Distance driven since the trace began, by the vehicle's speed. [m]
    lateral_cm : float
        On the bar, from its middle, left positive. [cm]
    polarity : Polarity
        As driven over: of a forward magnet (phi = 0) the other one if the vehicle is on the wrong way.
    orientation : Orientation
    confidence : float
        Probability that polarity and orientation are right, 0 to 1.
    clearance_cm : float
        Of the bar above the magnet. [cm]
    moment_am2 : tuple of float
        Fitted moment in vehicle axes. [A m2]
    along_std_m : float
        Standard error of its place along the drive. [m]
    relative_std_m : float
        The same against magnets near it, with which it shares the error of the time stamps. [m]
    snr : float
        Root of the energy that the magnet explains, in standard deviations of the noise.
    """

    t_s: float
    odometer_m: float
    lateral_cm: float
    polarity: Polarity
    orientation: Orientation
    confidence: float
    clearance_cm: float = 0.0
    moment_am2: tuple[float, float, float] = (0.0, 0.0, 0.0)
    along_std_m: float = 0.0
    relative_std_m: float = 0.0
    snr: float = 0.0

    @property
    def phi_deg(self) -> int:
        """Angle between the magnet's axis and the road, 0 or 90. [deg]"""
        return int(self.orientation)


@dataclass(frozen=True, slots=True, eq=False)
class PlacedMagnet:
    """A magnet's reading and its position on the plane of the vehicle's path, shape (2,). [m]"""

    reading: MagnetReading
    place_m: npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LineCrossing:
    """The bar came over a line: a lane departure unless it was meant.

    Attributes
    ----------
    t_s, odometer_m : float
        When and where the first magnet of the line was passed. [s, m]
    style : LineStyle
        Solid or dashed.
    side : Side
        Side on which the line lies.
    lateral_cm : float
        Of the first magnet, left positive. [cm]
    confidence : float
        Of the first magnet.
    """

    t_s: float
    odometer_m: float
    style: LineStyle
    side: Side
    lateral_cm: float
    confidence: float


@dataclass(frozen=True, slots=True)
class TagReading:
    """An information tag that was passed.

    Attributes
    ----------
    start_s, end_s : float
        When its first and last magnet were passed. [s]
    polarities : tuple of Polarity
        As met.
    gaps_m : tuple of float
        Distances from each magnet to the next, as measured. [m]
    gap_std_m : tuple of float
        Their standard errors. [m]
    length_m : float
        First magnet to last, as measured. [m]
    ratios, ratio_std : tuple of float
        d_2/d_1 .. d_(M-1)/d_1 and their standard errors.
    lateral_cm : float
        Mean place on the bar, left positive. [cm]
    tag : InformationTag or None
        The tag that it is, where registered tags or a format are known.
    wrong_way : bool
        It is that tag met from behind: the vehicle drives against the legal direction.
    missing, extra : int
        Magnets of the tag that were not seen, and seen magnets that are not of it.
    confidence : float
        Probability that it is that tag (without candidates: that all polarities are right).
    magnets : tuple of MagnetReading
    """

    start_s: float
    end_s: float
    polarities: tuple[Polarity, ...]
    gaps_m: tuple[float, ...]
    gap_std_m: tuple[float, ...]
    length_m: float
    ratios: tuple[float, ...]
    ratio_std: tuple[float, ...]
    lateral_cm: float
    tag: InformationTag | None
    wrong_way: bool
    missing: int
    extra: int
    confidence: float
    magnets: tuple[MagnetReading, ...]


@dataclass(frozen=True, slots=True)
class NoiseFinding:
    """Something that stood out and is not taken for a magnet, or a part of the trace that could not be used.

    Attributes
    ----------
    t_s, odometer_m : float
        When and where. [s, m]
    lateral_cm : float
        On the bar, left positive. [cm]
    kind : NoiseKind
    reason : str
        For people, with the figures.
    """

    t_s: float
    odometer_m: float
    lateral_cm: float
    kind: NoiseKind
    reason: str


Finding = MagnetReading | LineCrossing | TagReading | NoiseFinding


# === Where magnets lie on the plane: speed integrated along the heading, and the place on the bar (equation 1).


Floats = npt.NDArray[np.float64]


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
