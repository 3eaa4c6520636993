"""Which fitted dipoles are magnets of ours, and why the others are not; the clearance is learnt on the way."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.iron import BEYOND_M, why_iron
from app.decoders.magnet.readings import NoiseKind
from app.decoders.magnet.window import LIMIT_MISFIT, MOMENT_SPREAD, Dipole, Expectation
from app.markers.magnet import Orientation, Polarity

Floats = npt.NDArray[np.float64]

LEAST_ENERGY = 40.0
"""chi-squared that a magnet explains; noise alone reaches it less than once in 1000 km."""
_LEAST_MARGIN = 4.0
_LIMIT_UNLIKE, _LIMIT_DEEP, _LIMIT_SHAPE = 12.0, 7.5, 8.0
"""How unlike a magnet's its clearance, moment and axis may be; where it lies deeper than the road, as iron that is too
weak does; and its moment and axis alone."""


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
        if len(self._seen) < 6:
            return Expectation(self._moment, clearance, 0.04)
        spread = 1.5 * float(np.median(np.abs(np.array(self._seen) - clearance))) / 0.6745
        return Expectation(self._moment, clearance, min(max(spread, 0.025), 0.04))

    def learn(self, dipole: Dipole) -> None:
        """Take a sure magnet into account."""
        self._seen.append(float(dipole.params[2]))


Verdict = tuple[Orientation, Polarity, float] | tuple[NoiseKind, str]


def judge_region(
    dipoles: Sequence[Dipole], before: Sequence[Dipole], expected: Expectation, half_width_m: float
) -> list[Verdict]:
    """Orientation, polarity and confidence of each dipole of a region that is a magnet, or why it is none.

    Parameters
    ----------
    dipoles, before : sequence of Dipole
        Of the region, and of those before it.
    expected : Expectation
    half_width_m : float
        Of the array. [m]
    """
    around = [*before, *dipoles]
    verdicts: list[Verdict] = []
    for dipole in dipoles:
        iron = why_iron(dipole, around, half_width_m)
        verdicts.append((NoiseKind.FERROUS, iron) if iron else _judge(dipole, expected, half_width_m))
    return verdicts


def _judge(dipole: Dipole, expected: Expectation, half_width_m: float) -> Verdict:
    y, moment = float(dipole.params[1]), dipole.params[3:]
    snr = math.sqrt(max(dipole.explained, 0.0))
    if dipole.explained < LEAST_ENERGY:
        return NoiseKind.WEAK, f"explains {dipole.explained:.0f} of {LEAST_ENERGY:.0f} noise variances"
    if abs(y) > half_width_m + BEYOND_M:
        return NoiseKind.BESIDE, f"{100 * (abs(y) - half_width_m):.0f} cm beyond the bar"
    if dipole.misfit > LIMIT_MISFIT:
        return NoiseKind.FERROUS, f"{dipole.misfit:.0%} of its field is not that of a dipole, {LIMIT_MISFIT:.0%} may be"
    if _is_unlike(dipole, expected):
        return _why_unlike(dipole, expected)
    orientation = Orientation.UP if dipole.kind == 2 else Orientation.FORWARD
    polarity = Polarity.N if moment[dipole.kind] > 0 else Polarity.S
    if dipole.margin < _LEAST_MARGIN:
        return NoiseKind.SKEW, f"upright and forward fit alike: {dipole.margin:.1f} apart, {_LEAST_MARGIN:g} are needed"
    doubt = math.exp(-dipole.margin / 2) + math.exp(-0.5 * max(snr - 4.5, 0.0))
    doubt += 0.02 * dipole.prior_cost / _LIMIT_UNLIKE + 0.2 * dipole.misfit
    return orientation, polarity, float(min(max(1 - doubt, 0.05), 0.9999))


def _is_unlike(dipole: Dipole, expected: Expectation) -> bool:
    off_height = (float(dipole.params[2]) - expected.clearance_m) / expected.clearance_std_m
    if dipole.prior_cost > (_LIMIT_DEEP if off_height > 0 else _LIMIT_UNLIKE):
        return True
    size = float(np.linalg.norm(dipole.params[3:])) / expected.moment_am2
    return dipole.prior_cost - off_height**2 > _LIMIT_SHAPE or not 0.5 < size < 1.7


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
