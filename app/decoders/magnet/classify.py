"""Classification of fitted dipoles as magnets, or the reason of their rejection."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.dipole_fit import UPRIGHT, MagnetPrior
from app.decoders.magnet.ferrous import BEYOND_M, ferrous_reason
from app.decoders.magnet.fit_window import MAX_MISFIT, Dipole
from app.decoders.magnet.readings import NoiseKind
from app.markers.magnet import Orientation, Polarity

Floats = npt.NDArray[np.float64]

MIN_ENERGY = 40.0
"""Smallest explained energy of a magnet. [noise variances] Source: chosen by hand above the detection threshold of 32;
noise alone exceeds it with probability 2.5e-10 in a trial (chi-squared with one degree of freedom)."""
MIN_MARGIN = 4.0
"""Smallest margin of an orientation: a likelihood ratio of exp(2) = 7. Source: chosen by hand, no measurement kept."""
MAX_PRIOR_COST = 12.0
"""Largest prior cost of a magnet. Source: chosen by hand; the 98.3 % point of chi-squared with four degrees of
freedom."""
MAX_PRIOR_COST_DEEP = 7.5
"""The same below the expected clearance, where iron too weak for its place is fitted. Source: chosen by hand ("what
lies deeper than the road is iron sooner"), no measurement kept; the 89 % point."""
MAX_SHAPE_COST = 8.0
"""The same without the clearance's share: moment and axis alone. Source: chosen by hand; the 95.4 % point of
chi-squared with three degrees of freedom."""
MIN_MOMENT_RATIO, MAX_MOMENT_RATIO = 0.5, 1.7
"""Moment of a magnet over the expected one. Source: chosen by hand, no measurement kept."""
CONFIDENT_SNR, PRIOR_ERROR, MISFIT_ERROR = 4.5, 0.02, 0.2
"""Terms of the probability of error: the snr up to which it is 1, and what a prior cost at its limit and a misfit of 1
add. Source: chosen by hand, no measurement kept."""
MIN_CONFIDENCE, MAX_CONFIDENCE = 0.05, 0.9999
"""Limits of a reported confidence. Source: chosen by hand."""
SKEW_DEG = 8.0
"""Angle that weighs as much as a standard deviation when the reason of a rejection is chosen. [deg] Source:
`YAW_SPREAD`."""


class Accepted(NamedTuple):
    """The dipole is a magnet: its orientation, polarity and the probability that both are right."""

    orientation: Orientation
    polarity: Polarity
    confidence: float


class Rejected(NamedTuple):
    """The dipole is no magnet: what it is instead, and the reason with its figures."""

    kind: NoiseKind
    reason: str


Classification = Accepted | Rejected


def classify_dipoles(
    dipoles: Sequence[Dipole], before: Sequence[Dipole], prior: MagnetPrior, half_width_m: float
) -> list[Classification]:
    """Classify the dipoles of a region.

    Parameters
    ----------
    dipoles, before : sequence of Dipole
        Of the region, and of those before it.
    prior : MagnetPrior
    half_width_m : float
        Of the array. [m]

    Returns
    -------
    list of Accepted or Rejected
        One for each of the region's dipoles.
    """
    around = [*before, *dipoles]
    found: list[Classification] = []
    for dipole in dipoles:
        ferrous = ferrous_reason(dipole, around, half_width_m)
        found.append(Rejected(NoiseKind.FERROUS, ferrous) if ferrous else _classify(dipole, prior, half_width_m))
    return found


def _classify(dipole: Dipole, prior: MagnetPrior, half_width_m: float) -> Classification:
    y, moment = float(dipole.params[1]), dipole.params[3:]
    snr = math.sqrt(max(dipole.explained, 0.0))
    if dipole.explained < MIN_ENERGY:
        return Rejected(NoiseKind.WEAK, f"explains {dipole.explained:.0f} of {MIN_ENERGY:.0f} noise variances")
    if abs(y) > half_width_m + BEYOND_M:
        return Rejected(NoiseKind.BESIDE, f"{100 * (abs(y) - half_width_m):.0f} cm beyond the bar")
    if dipole.misfit > MAX_MISFIT:
        return Rejected(
            NoiseKind.FERROUS,
            f"{dipole.misfit:.0%} of its field is not that of a dipole, {MAX_MISFIT:.0%} is allowed",
        )
    if _is_unlike(dipole, prior):
        return _rejection(dipole, prior)
    orientation = Orientation.UP if dipole.kind == UPRIGHT else Orientation.FORWARD
    polarity = Polarity.N if moment[dipole.kind] > 0 else Polarity.S
    if dipole.margin < MIN_MARGIN:
        return Rejected(
            NoiseKind.SKEW, f"upright and forward fit alike: {dipole.margin:.1f} apart, {MIN_MARGIN:g} are needed"
        )
    error = math.exp(-dipole.margin / 2) + math.exp(-0.5 * max(snr - CONFIDENT_SNR, 0.0))
    error += PRIOR_ERROR * dipole.prior_cost / MAX_PRIOR_COST + MISFIT_ERROR * dipole.misfit
    return Accepted(orientation, polarity, float(min(max(1 - error, MIN_CONFIDENCE), MAX_CONFIDENCE)))


def _is_unlike(dipole: Dipole, prior: MagnetPrior) -> bool:
    max_cost = MAX_PRIOR_COST_DEEP if _off_height(dipole, prior) > 0 else MAX_PRIOR_COST
    return dipole.prior_cost > max_cost or not _has_moment(dipole, prior)


def _off_height(dipole: Dipole, prior: MagnetPrior) -> float:
    """Depth below the expected one, in standard deviations."""
    return (float(dipole.params[2]) - prior.clearance_m) / prior.clearance_std_m


def _has_moment(dipole: Dipole, prior: MagnetPrior) -> bool:
    """Whether the size and the axis of the moment are a magnet's, whatever the depth."""
    size = float(np.linalg.norm(dipole.params[3:])) / prior.moment_am2
    shape_cost = dipole.prior_cost - _off_height(dipole, prior) ** 2
    return shape_cost <= MAX_SHAPE_COST and MIN_MOMENT_RATIO < size < MAX_MOMENT_RATIO


def _rejection(dipole: Dipole, prior: MagnetPrior) -> Rejected:
    """The property in which a dipole differs most from a magnet."""
    h, moment = float(dipole.params[2]), dipole.params[3:]
    size = float(np.linalg.norm(moment))
    off_moment = abs(size - prior.moment_am2) / prior.moment_std_am2
    off_height = abs(h - prior.clearance_m) / prior.clearance_std_m
    skew = math.degrees(math.acos(min(abs(moment[dipole.kind]) / size, 1.0)))
    if skew / SKEW_DEG > max(off_moment, off_height):
        return Rejected(NoiseKind.SKEW, f"axis {skew:.0f} degrees off upright or forward")
    if off_moment > off_height:
        return Rejected(NoiseKind.WRONG_MOMENT, f"moment of {size:.2f} A m2, magnets have {prior.moment_am2:.2f}")
    return Rejected(
        NoiseKind.WRONG_HEIGHT, f"{100 * h:.0f} cm below the bar, the road is at {100 * prior.clearance_m:.0f}"
    )


def shows_clearance(dipole: Dipole, prior: MagnetPrior, half_width_m: float) -> bool:
    """Whether a dipole looks like a magnet but for its depth, so that it shows the clearance."""
    return (
        dipole.explained > MIN_ENERGY
        and abs(float(dipole.params[1])) < half_width_m + BEYOND_M  # what lies beside the bar may be a wheel
        and dipole.misfit < MAX_MISFIT
        and dipole.margin > MIN_MARGIN
        and _has_moment(dipole, prior)
    )
