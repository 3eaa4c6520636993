"""Which fitted dipoles are magnets of ours, and why the others are not; the vehicle's clearance is learnt on the way."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.readings import MagnetReading, NoiseFinding, NoiseKind
from app.decoders.magnet.region import MOMENT_SPREAD, Dipole, Expectation
from app.markers.magnet import Orientation, Polarity

Floats = npt.NDArray[np.float64]

LEAST_ENERGY = 40.0
"""chi-squared that a magnet explains; noise alone reaches it less than once in 1000 km."""
_MISFIT = 0.12
_PRIOR_COST = 18.0
_LEAST_MARGIN = 5.0
_NEAREST_M = 0.25
_BEYOND_M = 0.10


class ClearanceTracker:
    """Median clearance of the surest magnets so far: it is common to a vehicle, but for its springs."""

    def __init__(self, moment_am2: float) -> None:
        self._moment = moment_am2
        self._seen: deque[float] = deque(maxlen=25)

    @property
    def expected(self) -> Expectation:
        """What the next magnet is expected to be like."""
        if len(self._seen) < 3:
            return Expectation(self._moment)
        clearance = float(np.median(self._seen))
        return Expectation(self._moment, clearance, 0.025 if len(self._seen) >= 6 else 0.04)

    def learn(self, dipole: Dipole) -> None:
        """Take a sure magnet into account."""
        self._seen.append(float(dipole.params[2]))


def judge_dipole(
    dipole: Dipole, neighbours: list[Dipole], expected: Expectation, half_width_m: float, residual: float
) -> tuple[Orientation, Polarity, float] | tuple[NoiseKind, str]:
    """Orientation, polarity and confidence of a magnet, or why it is none.

    Parameters
    ----------
    dipole : Dipole
    neighbours : list of Dipole
        The others of its region.
    expected : Expectation
    half_width_m : float
        Of the array. [m]
    residual : float
        Largest statistic left in the region.
    """
    s, y, h = dipole.params[:3]
    moment = dipole.params[3:]
    size = float(np.linalg.norm(moment))
    snr = math.sqrt(max(dipole.explained, 0.0))
    if dipole.explained < LEAST_ENERGY:
        return NoiseKind.WEAK, f"explains {dipole.explained:.0f} of {LEAST_ENERGY:.0f} noise variances"
    if abs(y) > half_width_m + _BEYOND_M:
        return NoiseKind.BESIDE, f"{100 * (abs(y) - half_width_m):.0f} cm beyond the bar"
    if dipole.misfit > _MISFIT:
        return NoiseKind.FERROUS, f"{dipole.misfit:.0%} of its field is not that of a dipole, {_MISFIT:.0%} may be"
    crowd = [d for d in neighbours if d is not dipole and math.hypot(d.params[0] - s, d.params[1] - y) < _NEAREST_M]
    if crowd:
        return NoiseKind.FERROUS, f"{len(crowd) + 1} poles within {100 * _NEAREST_M:.0f} cm"
    if dipole.prior_cost > _PRIOR_COST or not 0.5 < size / expected.moment_am2 < 1.7:
        return _why_unlike(dipole, expected)
    orientation = Orientation.UP if dipole.kind == 2 else Orientation.FORWARD
    polarity = Polarity.N if moment[dipole.kind] > 0 else Polarity.S
    if dipole.margin < _LEAST_MARGIN:
        return NoiseKind.SKEW, f"upright and forward fit alike: {dipole.margin:.1f} apart, {_LEAST_MARGIN:g} are needed"
    doubt = math.exp(-dipole.margin / 2) + math.exp(-0.5 * max(snr - 4.5, 0.0))
    doubt += 0.02 * dipole.prior_cost / _PRIOR_COST + 0.2 * dipole.misfit
    return orientation, polarity, float(min(max(1 - doubt, 0.05), 0.9999))


def _why_unlike(dipole: Dipole, expected: Expectation) -> tuple[NoiseKind, str]:
    """Which of its priors a dipole strains most."""
    h, moment = float(dipole.params[2]), dipole.params[3:]
    size = float(np.linalg.norm(moment))
    off_moment = abs(size - expected.moment_am2) / (MOMENT_SPREAD * expected.moment_am2)
    off_height = abs(h - expected.clearance_m) / expected.clearance_std_m
    skew = math.degrees(math.acos(min(abs(moment[dipole.kind]) / size, 1.0)))
    if skew / 8 > max(off_moment, off_height):
        return NoiseKind.SKEW, f"axis {skew:.0f} degrees off upright or forward"
    if off_moment > off_height:
        return NoiseKind.WRONG_MOMENT, f"moment of {size:.2f} A m2, magnets have {expected.moment_am2:.2f}"
    return NoiseKind.WRONG_HEIGHT, f"{100 * h:.0f} cm below the bar, the road is at {100 * expected.clearance_m:.0f}"


def is_sure(dipole: Dipole, expected: Expectation) -> bool:
    """Whether the clearance may be learnt from it."""
    size = float(np.linalg.norm(dipole.params[3:]))
    return dipole.explained > 150 and dipole.misfit < 0.06 and abs(size / expected.moment_am2 - 1) < 0.3


Judged = MagnetReading | NoiseFinding
