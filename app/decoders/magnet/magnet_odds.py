"""Probability that a fitted dipole is a magnet: a logistic model of the fit and of the dipoles around it.

The fit enters as the log likelihood ratio of its depth and moment under two hypotheses: a magnet, which lies at the
bar's clearance with the moment of the road's magnets along one of two axes; and iron, of any depth and moment. Dipoles
around it enter because a long piece of iron has poles side by side. The weights are the likeliest on simulated drives
(`benchmarks.training.magnet_odds`), so the probability is calibrated: of the readings with 0.95, 95 % are right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.dipole_fit import UPRIGHT, MagnetPrior
from app.decoders.magnet.ferrous import BEYOND_M, POLE_ENERGY, POLE_SHARE, rows_beside
from app.decoders.magnet.fit_window import Dipole
from app.decoders.magnet.magnet_state import MagnetState, without_prior

Floats = npt.NDArray[np.float64]

IRON_DEPTH_M, IRON_DEPTH_STD_M, IRON_MOMENT_STD = 0.05, 0.2, 1.2
"""Depth of iron below that of magnets, its standard deviation, and that of each component of its moment, in moments of
a magnet. [m, m, 1] Source: iron that is read as dipoles lies in or on the road and has up to three times the moment;
chosen by hand, the regression weighs the ratio."""
MIN_LOG_ODDS, MAX_LOG_ODDS = -20.0, 14.0
"""Limits of `own_log_odds`. Source: beyond them a dipole is certainly iron, or a magnet."""
TOO_NEAR_M, OTHER_KIND_M, NEAR_M, NEAR_HEIGHTS, PIECE_M, ABREAST_M = 0.42, 0.9, 0.8, 3.0, 3.0, 1.2
"""Distances within which magnets have no neighbour, tags and lines keep apart, poles are of one object (in heights
too), and a long piece of iron has poles side by side. [m, m, m, 1, m, m] Source: `app.markers.magnet.MIN_GAP_M` less
the error of two places; lengths of the pieces of iron in `app.simulation.magnetic.clutter`."""
NEIGHBOUR_M = 1.0
"""[m] within which the neighbour that is least like a magnet is looked for. Source: by hand."""
ROW_M, ROW_WIDTH_M, ROW_LOG_ODDS, MAX_IN_ROW = 4.3, 0.12, 2.0, 3
"""Magnets of the same kind in a row with a dipole, as those of a tag: length and half width of the row, their own log
odds at least, and how many count. [m, m, 1, 1] Source: tags of 4 m, and a vehicle that heads 2 degrees off."""
MIN_TOO_DEEP = -1.0
"""Smallest value of the feature "too deep": what lies far above the road is no likelier a magnet for that. Source: with
-1, iron of 5 to 20 A m2 20 cm above the road is never read in 96 scenes, in place of up to 14 of 24 times; as many
magnets are read."""
FEATURES = (
    "own", "own, above 0", "misfit", "margin", "too near", "other kind", "unlike pole", "magnets around",
    "piece of iron", "neighbour", "rows", "upright", "too deep", "like iron", "iron before", "in a row",
)  # fmt: skip
"""Names of the features that `magnet_features` returns."""
WEIGHTS = np.array([
    0.14,  # own
    1.16,  # own, above 0
    -0.49,  # misfit
    -0.16,  # margin
    -3.83,  # too near
    0.92,  # other kind
    0.27,  # unlike pole
    -1.26,  # magnets around
    -2.30,  # piece of iron
    0.09,  # neighbour
    -1.30,  # rows
    2.38,  # upright
    -1.00,  # too deep
    -0.19,  # like iron
    -1.82,  # iron before
    0.96,  # in a row
])  # fmt: skip
BIAS = -5.24
"""Weights of the features, and the intercept. Source: `python -m benchmarks.training.magnet_odds --seed
62000 --scenes 720`, two thirds of its drives; of the others it prints how well they hold."""


def own_log_odds(dipole: Dipole, prior: MagnetPrior) -> float:
    """Log ratio of the likelihoods of a dipole's depth and moment, of a magnet to iron.

    The prior is removed from the fit first (`without_prior`): a fit to a weak signal stays at the prior, and its ratio
    is then near 0. A fit without a finite covariance is not a magnet's.
    """
    if not np.isfinite(dipole.covariance).all():
        return MIN_LOG_ODDS
    own, moment = dipole.kind, prior.moment_am2
    beside = [axis for axis in range(3) if axis != own]
    order = [2, 3 + own, *(3 + axis for axis in beside)]
    std = np.array(
        [prior.clearance_std_m, prior.moment_std_am2]
        + [prior.yaw_std_am2 if own != UPRIGHT and axis == 1 else prior.tilt_std_am2 for axis in beside]
    )  # all below is in these units
    size = float(np.linalg.norm(dipole.params[3:]))
    along = np.array([0.0, *dipole.params[order[1:]] / size * std[1:] / prior.moment_std_am2])
    expected = np.array([prior.clearance_m, math.copysign(moment, dipole.params[3 + own]), 0.0, 0.0]) / std
    fitted = dipole.params[order] / std
    slope = along * (size - moment) / prior.moment_std_am2 + (fitted - expected) * (1, 0, 1, 1)
    given = np.outer(along, along) + np.diag((1.0, 0.0, 1.0, 1.0))
    seen, covariance = without_prior(fitted, dipole.covariance[np.ix_(order, order)] / np.outer(std, std), given, slope)
    iron = np.array([IRON_DEPTH_STD_M, *3 * [IRON_MOMENT_STD * moment]]) / std
    nowhere = np.array([prior.clearance_m + IRON_DEPTH_M, 0.0, 0.0, 0.0]) / std
    odds = _log_density(seen - expected, covariance + np.eye(4)) - _log_density(
        seen - nowhere, covariance + np.diag(iron**2)
    )
    return min(max(odds, MIN_LOG_ODDS), MAX_LOG_ODDS)


def _log_density(off: Floats, covariance: Floats) -> float:
    """Log of a normal density, but for a constant."""
    return -0.5 * float(off @ np.linalg.solve(covariance, off)) - 0.5 * float(np.linalg.slogdet(covariance)[1])


def magnet_features(dipole: Dipole, around: Sequence[Dipole], state: MagnetState, half_width_m: float) -> Floats:
    """Features of the logistic model, in the order of `FEATURES`.

    Parameters
    ----------
    dipole : Dipole
    around : sequence of Dipole
        Those near it, itself included, with their own log odds.
    state : MagnetState
        What the magnets of the road share.
    half_width_m : float
        Of the array. [m]
    """
    prior = state.prior
    s, y, h = (float(p) for p in dipole.params[:3])
    too_near = other_kind = unlike = piece = 0.0
    neighbour, magnets, in_row = MAX_LOG_ODDS, 0, 0
    for other in around:
        if other is dipole or other.explained < max(POLE_ENERGY, POLE_SHARE * dipole.explained):
            continue
        along, apart = abs(other.params[0] - s), math.hypot(other.params[0] - s, other.params[1] - y)
        too_near = max(too_near, float(apart < TOO_NEAR_M))
        other_kind = max(other_kind, float(other.kind != dipole.kind and apart < OTHER_KIND_M))
        unlike = max(unlike, float(other.resembles_iron and apart < max(NEAR_M, NEAR_HEIGHTS * h)))
        is_magnet = other.log_odds > ROW_LOG_ODDS and not other.resembles_iron and other.kind == dipole.kind
        in_row += is_magnet and TOO_NEAR_M < along < ROW_M and abs(other.params[1] - y) < ROW_WIDTH_M
        if apart < NEIGHBOUR_M:
            neighbour = min(neighbour, other.log_odds)
        if along < PIECE_M and abs(other.params[1]) < half_width_m + BEYOND_M:
            magnets += not other.resembles_iron
            if not piece and rows_beside(other, around, half_width_m, ABREAST_M) > 1:
                piece = 1.0
    rows = min(max(0, rows_beside(dipole, around, half_width_m) - 1), 2)
    too_deep = (h - prior.clearance_m) / prior.clearance_std_m
    return np.array([
        dipole.log_odds, max(dipole.log_odds, 0.0), math.log(max(dipole.misfit, 0.004)),
        math.log1p(min(dipole.margin, 40.0)), too_near, other_kind, unlike, math.log1p(magnets), piece, neighbour, rows,
        float(dipole.kind == UPRIGHT), max(too_deep, MIN_TOO_DEEP), state.iron_log_odds,
        math.log1p(state.iron_before), min(in_row, MAX_IN_ROW),
    ])  # fmt: skip


def magnet_probability(features: Floats) -> float:
    """Probability that a dipole is a magnet, of the kind and polarity with which it was fitted."""
    return float(1 / (1 + np.exp(-(features @ WEIGHTS + BIAS))) * kind_probability(features))


def kind_probability(features: Floats) -> Floats:
    """Probability that magnets are of the kind with which they were fitted, of features (..., F).

    The margin is twice the log ratio of the likelihoods of both kinds.
    """
    margin = np.expm1(features[..., FEATURES.index("margin")])
    return np.asarray(1 / (1 + np.exp(-margin / 2)))
