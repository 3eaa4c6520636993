"""Classification of fitted dipoles as magnets, or the reason of their rejection."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from app.decoders.magnet.dipole_fit import UPRIGHT, MagnetPrior
from app.decoders.magnet.ferrous import BEYOND_M, POLE_ENERGY
from app.decoders.magnet.fit_window import MAX_MISFIT, Dipole
from app.decoders.magnet.magnet_odds import FEATURES, WEIGHTS, Floats, magnet_features, magnet_probability, own_log_odds
from app.decoders.magnet.magnet_state import MagnetState
from app.decoders.magnet.readings import NoiseKind
from app.markers.magnet import Orientation, Polarity

MIN_PROBABILITY = 0.9
"""Smallest probability of a magnet that is reported. Source: of the drives that nothing was learnt from
(`benchmarks.training.magnet_odds`) 98.8 % of the magnets have more, and 5 of 8,805 readings are wrong; with 0.8 it is
99.2 % and 9 of 8,848, one of them over iron without any magnet (`tests/decoders/magnet/test_matched.py`)."""
MIN_MARGIN = 4.0
"""Smallest margin of a dipole that shows the clearance: a likelihood ratio of exp(2) = 7. Source: chosen by hand."""
MAX_SHAPE_COST = 8.0
"""Largest prior cost without the clearance's share: moment and axis alone, for a dipole that shows the clearance.
Source: chosen by hand; the 95.4 % point of chi-squared with three degrees of freedom."""
MIN_MOMENT_RATIO, MAX_MOMENT_RATIO = 0.5, 1.7
"""Moment of a magnet over the expected one. Source: chosen by hand, no measurement kept."""
MAX_CONFIDENCE = 0.9999
"""Limit of a reported confidence. Source: chosen by hand."""
SKEW_DEG = 8.0
"""Angle that weighs as much as a standard deviation when the reason of a rejection is chosen. [deg] Source:
`YAW_SPREAD`."""
_CLEAR = np.array([8.0, 8.0, math.log(0.004), math.log1p(40.0), 0, 0, 0, 0, 0, 14.0, 0, 0, 0, -3.0, 0, 0])
"""Features of a clear magnet: the group of features that lowers the log odds most is the reason of a rejection."""
_REASONS = {
    "own": ("own", "own, above 0", "too deep", "like iron", "iron before"), "misfit": ("misfit",),
    "margin": ("margin",), "piece": ("piece of iron",), "rows": ("rows",),
    "pole": ("too near", "other kind", "unlike pole", "neighbour"),
}  # fmt: skip


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


def with_log_odds(dipoles: Sequence[Dipole], prior: MagnetPrior) -> list[Dipole]:
    """The dipoles in their order along the road, each with its own log odds."""
    return [replace(d, log_odds=own_log_odds(d, prior)) for d in sorted(dipoles, key=lambda d: float(d.params[0]))]


def classify_dipoles(
    dipoles: Sequence[Dipole], before: Sequence[Dipole], state: MagnetState, half_width_m: float
) -> list[Classification]:
    """Classify the dipoles of a region.

    Parameters
    ----------
    dipoles, before : sequence of Dipole
        Of the region, and of those before it, with their own log odds.
    state : MagnetState
        What the magnets of the road share.
    half_width_m : float
        Of the array. [m]

    Returns
    -------
    list of Accepted or Rejected
        One for each of the region's dipoles.
    """
    around = [*before, *dipoles]
    return [_classify(dipole, around, state, half_width_m) for dipole in dipoles]


def _classify(dipole: Dipole, around: Sequence[Dipole], state: MagnetState, half_width_m: float) -> Classification:
    y = float(dipole.params[1])
    if dipole.explained < POLE_ENERGY:
        return Rejected(NoiseKind.WEAK, f"explains {dipole.explained:.0f} of {POLE_ENERGY:.0f} noise variances")
    if abs(y) > half_width_m + BEYOND_M:
        return Rejected(NoiseKind.BESIDE, f"{100 * (abs(y) - half_width_m):.0f} cm beyond the bar")
    features = magnet_features(dipole, around, state, half_width_m)
    probability = magnet_probability(features)
    if probability < MIN_PROBABILITY:
        kind, reason = _rejection(dipole, features, state.prior)
        return Rejected(kind, f"{reason}; {probability:.0%} likely a magnet, {MIN_PROBABILITY:.0%} are needed")
    orientation = Orientation.UP if dipole.kind == UPRIGHT else Orientation.FORWARD
    polarity = Polarity.N if dipole.params[3 + dipole.kind] > 0 else Polarity.S
    return Accepted(orientation, polarity, min(probability, MAX_CONFIDENCE))


def _rejection(dipole: Dipole, features: Floats, prior: MagnetPrior) -> Rejected:
    """The group of features that lowers the log odds most, compared with a clear magnet."""
    change = dict(zip(FEATURES, WEIGHTS * (features - _CLEAR), strict=True))
    worst = min(_REASONS, key=lambda reason: sum(change[name] for name in _REASONS[reason]))
    match worst:
        case "misfit":
            return Rejected(NoiseKind.FERROUS, f"{dipole.misfit:.0%} of its field is not that of a dipole")
        case "margin":
            return Rejected(NoiseKind.SKEW, f"upright and forward fit alike: {dipole.margin:.1f} apart")
        case "piece":
            return Rejected(NoiseKind.FERROUS, "near poles that stand side by side, as those of a long piece of iron")
        case "rows":
            return Rejected(NoiseKind.FERROUS, "between rows of poles, where lines and tags have one at most")
        case "pole":
            return Rejected(NoiseKind.FERROUS, "beside another pole that no magnet has")
    return _unlike_magnet(dipole, prior)


def _unlike_magnet(dipole: Dipole, prior: MagnetPrior) -> Rejected:
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


def is_strong(dipole: Dipole, half_width_m: float) -> bool:
    """Whether a dipole is strong enough to be a magnet, and under the bar: what lies beside it may be a wheel."""
    return dipole.explained >= POLE_ENERGY and abs(float(dipole.params[1])) <= half_width_m + BEYOND_M


def shows_clearance(dipole: Dipole, prior: MagnetPrior, half_width_m: float) -> bool:
    """Whether a dipole looks like a magnet but for its depth, so that it shows the clearance."""
    size = float(np.linalg.norm(dipole.params[3:])) / prior.moment_am2
    shape_cost = dipole.prior_cost - ((float(dipole.params[2]) - prior.clearance_m) / prior.clearance_std_m) ** 2
    return (
        is_strong(dipole, half_width_m)
        and dipole.misfit < MAX_MISFIT
        and dipole.margin > MIN_MARGIN
        and shape_cost <= MAX_SHAPE_COST
        and MIN_MOMENT_RATIO < size < MAX_MOMENT_RATIO
    )
