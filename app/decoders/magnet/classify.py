"""Classification of fitted dipoles as magnets, or the reason of their rejection."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from app.decoders.magnet.dipole_fit import UPRIGHT, MagnetPrior
from app.decoders.magnet.fit_window import MAX_MISFIT, Dipole, magnet_prior
from app.decoders.magnet.identify import Identification, TagCandidates
from app.decoders.magnet.readings import LineCrossing, MagnetReading, NoiseKind, PlacedMagnet, Side, TagReading
from app.markers.magnet import MAX_LINE_SPACING_M, LineStyle, LineTag, Orientation, Polarity
from app.values import Floats

# === Poles of iron among fitted dipoles: iron seldom has one pole, and its poles do not stand in a row.


BESIDE_REACH_M = 2.0
"""Distance along the road in which poles stand beside a dipole. [m] Source: length of the covers, plates and pieces of
mesh in `app.simulation.magnetic.clutter`."""
BEYOND_M = 0.05
"""How far beyond the bar's outermost sensors a magnet is read. [m] A third of METRO's spacing."""
POLE_ENERGY, POLE_SHARE = 40.0, 0.05
"""Smallest explained energy of a pole, in noise variances and over that of the dipole beside it. Above the
detection threshold of 32: noise alone exceeds it with probability 2.5e-10 in a trial (chi-squared with one
degree of freedom); and what a model that errs leaves of a strong magnet must not count."""
ROW_GAP_M, BESIDE_M = 0.25, 0.3
"""Distance across the road between two rows of poles, and from a dipole to a row beside it. [m]"""
FERROUS_COUNT = 4
"""Fewest dipoles that can be examined for iron as a whole. Source: as in `app.decoders.magnet.detect_dipoles`."""
FORGET_M = 4.0
"""Dipoles further back than this do not count. [m] More than the length of a piece of iron."""


def rows_beside(dipole: Dipole, others: Sequence[Dipole], half_width_m: float, reach_m: float = BESIDE_REACH_M) -> int:
    """Rows of poles under the bar that pass a dipole on its left and right; a magnet of the road has one at most."""
    s, y = float(dipole.params[0]), float(dipole.params[1])
    min_energy = max(POLE_ENERGY, POLE_SHARE * dipole.explained)
    beside = sorted(
        float(o.params[1])
        for o in others
        if abs(o.params[0] - s) < reach_m
        and abs(o.params[1] - y) > BESIDE_M
        and abs(o.params[1]) < half_width_m + BEYOND_M
        and o.explained > min_energy
    )
    return sum(i == 0 or b - beside[i - 1] > ROW_GAP_M for i, b in enumerate(beside))


def is_ferrous(dipoles: Sequence[Dipole], half_width_m: float) -> bool:
    """Whether so many dipoles stand beside each other that further ones would only take time."""
    if len(dipoles) < FERROUS_COUNT:
        return False
    return 2 * sum(rows_beside(d, dipoles, half_width_m) > 1 for d in dipoles) >= len(dipoles)


# === What the magnets of a drive share, as an estimated state: the clearance of the bar above them, and their moment.
#
# Each fitted dipole that looks like a magnet shows how far below the bar it lies and how strong it is. Magnets of a
# road lie in its surface and are of one make, so these agree; iron fitted as a magnet lies anywhere and has any
# strength. The posterior of clearance, moment and share of iron is kept on a grid.
#
# Shapes: C clearances, M moments, I shares of iron.


CLEARANCES_M = np.arange(0.08, 0.651, 0.01)
"""Clearances of the grid. [m] Source: bars below bumpers, 15 to 35 cm (METRO section 7.3), trucks 40 cm, and room."""
MOMENT_RATIOS = np.arange(0.5, 1.51, 0.04)
"""Moments of the grid, over the nominal one. Source: aged and hot ferrite or NdFeB to the next grades."""
MOMENT_RATIO_STD = 0.15
"""Standard deviation of the shared moment before any dipole, over the nominal one. Source: remanence of the grades N35
to N52, 1.17 to 1.48 T, and 0.1 % per kelvin for NdFeB over 40 K; rounded up."""
LIKE_STD, OWN_MOMENT_STD = 0.06, 0.12
"""Standard deviation of a magnet's moment about the shared one: of those that show it, and of any. Source: 3 % between
magnets (`app.simulation.magnetic.road.Spread`) and gains of the sensors near it; tags fade by a quarter and more
(`app.services.health.traces`), which must be read, but show nothing of the others."""
IRON_SHARES = np.array([0.01, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95])
"""Shares of iron among the dipoles that look like magnets, each as likely. Source: town roads and roads with tags."""
SPRING_STD_M = 0.02
"""What springs move the bar by, while magnets are passed. [m] Source: `app.simulation.magnetic.drive.drive_course`, 0.4
cm on ordinary and 1.2 cm on rough roads and pitch under braking."""
MEMORY = 0.97
"""Weight of what was seen before each further dipole: a load changes the clearance. About thirty magnets."""
MIN_STD_M, KNOWN_STD_M = 0.025, 0.035
"""Standard deviation of the clearance at least, and that below which it is known. [m] Source: springs; 3 to 20
depths of iron, evenly spread, look like a clearance in 2 % of 400 trials, and three magnets do in 88 %."""
SURE_COUNT = 8
"""Dipoles from which on a known clearance is sure."""
MIN_INFORMATION = 0.1
"""Share of a depth's precision that must come from the field, not from what was expected."""
MIN_PRECISION = 0.02
"""Smallest precision of the data, over that of the prior: keeps covariances finite."""
CLEARANCE_M, CLEARANCE_STD_M = 0.24, 0.12
"""Clearance that is expected where none is declared. [m] Source: the middle of the 15 to 35 cm of METRO section 7.3;
it covers them within a standard deviation."""
DECLARED_STD_M, DECLARED_WRONG = 0.025, 0.02
"""Standard deviation of a declared clearance, and the probability that it is wrong altogether. [m, 1] Source: load and
springs, as `SPRING_STD_M`."""


class MagnetState:
    """What is known of the clearance and of the shared moment after some dipoles.

    Parameters
    ----------
    moment_am2 : float
        Nominal, of the magnets on the road. [A m2]
    declared_m : float, optional
        Clearance of the bar as it was declared. [m]

    Attributes
    ----------
    iron_before : float
        Number of the dipoles under the bar that resemble iron, of about the last thirty.
    """

    def __init__(self, moment_am2: float, declared_m: float | None = None) -> None:
        self._moment_am2 = moment_am2
        depth = _bell(CLEARANCES_M, CLEARANCE_M, CLEARANCE_STD_M)
        if declared_m is not None:
            depth = (1 - DECLARED_WRONG) * _bell(CLEARANCES_M, declared_m, DECLARED_STD_M) + DECLARED_WRONG * depth
        strength = _bell(MOMENT_RATIOS, 1.0, MOMENT_RATIO_STD)
        self._log = np.log(depth[:, None, None] * strength[:, None] * np.ones(IRON_SHARES.size))
        self._first = self._log.copy()
        self._learnt = 0
        self.iron_before = 0.0
        self._set_prior()

    @property
    def prior(self) -> MagnetPrior:
        """What the next magnet is expected to be like."""
        return self._prior

    @property
    def is_known(self) -> bool:
        """Whether magnets can be judged by their depth."""
        return self._prior.clearance_std_m < KNOWN_STD_M

    @property
    def is_sure(self) -> bool:
        """Whether it is known from so many dipoles that further ones hardly change it."""
        return self.is_known and self._learnt >= SURE_COUNT

    @property
    def iron_log_odds(self) -> float:
        """Log odds that a dipole of this road that looks like a magnet is iron."""
        return self._iron_log_odds

    def count_iron(self, dipole: Dipole) -> None:
        """Update `iron_before` with a dipole under the bar."""
        self.iron_before = MEMORY * self.iron_before + dipole.resembles_iron

    def learn(self, dipole: Dipole, expected: MagnetPrior) -> None:
        """Add a dipole that looks like a magnet, fitted under what was expected of it."""
        at = np.ix_((2, 3 + dipole.kind), (2, 3 + dipole.kind))
        std = np.array([expected.clearance_std_m, expected.moment_std_am2])
        middle = np.array([expected.clearance_m, expected.moment_am2])
        fitted = np.array([dipole.params[2], abs(dipole.params[3 + dipole.kind])])
        own = dipole.covariance[at] / np.outer(std, std)
        if not (np.isfinite(own).all() and 1 - own[0, 0] >= MIN_INFORMATION):
            return
        seen, covariance = without_prior(fitted / std, own, np.eye(2), (fitted - middle) / std)
        depth_m, moment = seen * std
        covariance *= np.outer(std, std)
        covariance += np.diag((SPRING_STD_M**2, (LIKE_STD * self._moment_am2) ** 2))
        off_m, off = CLEARANCES_M[:, None] - depth_m, self._moment_am2 * MOMENT_RATIOS - moment
        inverse = np.linalg.inv(covariance)
        chi2 = inverse[0, 0] * off_m**2 + 2 * inverse[0, 1] * off_m * off + inverse[1, 1] * off**2
        magnet = np.exp(-0.5 * chi2) / (2 * math.pi * math.sqrt(float(np.linalg.det(covariance))))
        iron = 1 / (float(np.ptp(CLEARANCES_M)) * self._moment_am2 * float(np.ptp(MOMENT_RATIOS)))
        self._learnt += 1
        self._log = self._first + MEMORY * (self._log - self._first)
        self._log += np.log((1 - IRON_SHARES) * magnet[:, :, None] + IRON_SHARES * iron)
        self._set_prior()

    def _set_prior(self) -> None:
        joint = np.exp(self._log - self._log.max())
        joint /= joint.sum()
        iron = float(joint.sum(axis=(0, 1)) @ IRON_SHARES)
        self._iron_log_odds = math.log(iron / (1 - iron))
        weight = joint.sum(axis=2)
        clearance_m, clearance_std_m = _moments(weight.sum(axis=1), CLEARANCES_M)
        ratio, ratio_std = _moments(weight.sum(axis=0), MOMENT_RATIOS)
        self._prior = magnet_prior(
            self._moment_am2 * ratio,
            math.hypot(ratio_std, OWN_MOMENT_STD) / ratio,
            clearance_m,
            max(clearance_std_m, MIN_STD_M),
        )


def without_prior(fitted: Floats, covariance: Floats, given: Floats, slope: Floats) -> tuple[Floats, Floats]:
    """Maximum likelihood estimate and covariance of fitted parameters, from their maximum a posteriori estimate.

    All are in standard deviations of the prior. At the maximum of the posterior, the gradients of both costs cancel.

    Parameters
    ----------
    fitted : ndarray, shape (P,)
        Maximum a posteriori estimate.
    covariance : ndarray, shape (P, P)
        Of the posterior.
    given : ndarray, shape (P, P)
        Precision of the prior.
    slope : ndarray, shape (P,)
        Gradient of half of the prior's cost at the estimate.

    Returns
    -------
    estimate : ndarray, shape (P,)
    covariance : ndarray, shape (P, P)
        Large in directions in which the data determine nothing.
    """
    sizes, axes = np.linalg.eigh(np.linalg.inv(covariance) - given)
    alone = (axes / np.maximum(sizes, MIN_PRECISION)) @ axes.T
    return fitted + alone @ slope, alone


def _bell(grid: Floats, mean: float, std: float) -> Floats:
    """Normal density on a grid, with a sum of 1."""
    density = np.exp(-0.5 * ((grid - mean) / std) ** 2) + 1e-300
    return np.asarray(density / density.sum())


def _moments(weight: Floats, grid: Floats) -> tuple[float, float]:
    """Mean and standard deviation over a grid with weights."""
    mean = float(weight @ grid)
    return mean, math.sqrt(float(weight @ (grid - mean) ** 2))


# === Probability that a fitted dipole is a magnet: a logistic model of the fit and of the dipoles around it.
#
# The fit enters as the log likelihood ratio of its depth and moment under two hypotheses: a magnet, which lies at the
# bar's clearance with the moment of the road's magnets along one of two axes; and iron, of any depth and moment.
# Dipoles around it enter because a long piece of iron has poles side by side. The weights are the likeliest on
# simulated drives (`benchmarks.training.magnet_odds`), so the probability is calibrated: of the readings with 0.95, 95
# % are right.


IRON_DEPTH_M, IRON_DEPTH_STD_M, IRON_MOMENT_STD = 0.05, 0.2, 1.2
"""Depth of iron below that of magnets, its standard deviation, and that of each component of its moment, in moments of
a magnet. [m, m, 1] Source: iron that is read as dipoles lies in or on the road and has up to three times the moment;
the regression weighs the ratio."""
MIN_LOG_ODDS, MAX_LOG_ODDS = -20.0, 14.0
"""Limits of `own_log_odds`. Source: beyond them a dipole is certainly iron, or a magnet."""
TOO_NEAR_M, OTHER_KIND_M, NEAR_M, NEAR_HEIGHTS, PIECE_M, ABREAST_M = 0.42, 0.9, 0.8, 3.0, 3.0, 1.2
"""Distances within which magnets have no neighbour, tags and lines keep apart, poles are of one object (in heights
too), and a long piece of iron has poles side by side. [m, m, m, 1, m, m] Source: `app.markers.magnet.MIN_GAP_M` less
the error of two places; lengths of the pieces of iron in `app.simulation.magnetic.clutter`."""
NEIGHBOUR_M = 1.0
"""[m] within which the neighbour that is least like a magnet is looked for."""
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


# === Classification of fitted dipoles as magnets, or the reason of their rejection.


MIN_PROBABILITY = 0.9
"""Smallest probability of a magnet that is reported. Source: of the drives that nothing was learnt from
(`benchmarks.training.magnet_odds`) 98.8 % of the magnets have more, and 5 of 8,805 readings are wrong; with 0.8 it is
99.2 % and 9 of 8,848, one of them over iron without any magnet (`tests/decoders/magnet/test_matched.py`)."""
MIN_MARGIN = 4.0
"""Smallest margin of a dipole that shows the clearance: a likelihood ratio of exp(2) = 7."""
MAX_SHAPE_COST = 8.0
"""Largest prior cost without the clearance's share: moment and axis alone, for a dipole that shows the clearance. The
95.4 % point of chi-squared with three degrees of freedom."""
MIN_MOMENT_RATIO, MAX_MOMENT_RATIO = 0.5, 1.7
"""Moment of a magnet over the expected one."""
MAX_CONFIDENCE = 0.9999
"""Limit of a reported confidence."""
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


# === Magnets in the order of the road, grouped to line crossings and information tags.


MAX_GAP_M = 6.5
"""Largest distance between two magnets of a tag where the candidates have none. [m] More than the 6 m of METRO section
6.3."""
_GAP_FACTOR, _GAP_SPARE_M = 1.05, 0.3  # a row ends after so many largest gaps, and metres more
_MIN_LENGTH_SHARE, _MIN_LENGTH_SPARE_M = 0.95, 0.1  # shortest row that no longer tag can still be
_SPEED_STD = 0.002  # share by which the speed may drift between two gaps of a tag; 0.2 %
_LINE_REACH = 1.5  # distance of two magnets of one line over the largest allowed one; one missed
_SAME_LINE_CM = 70.0  # [cm] lateral distance up to which magnets are of one line; a weaving vehicle


class TagAssembler:
    """Groups magnets as they come.

    Parameters
    ----------
    candidates : TagCandidates
        Tags that may be on the road; an empty one groups by gaps alone.
    """

    def __init__(self, candidates: TagCandidates) -> None:
        self._candidates = candidates
        self._row: list[PlacedMagnet] = []
        self._lines: list[MagnetReading] = []
        self._longest_m = candidates.longest_gap_m or MAX_GAP_M

    def add(self, magnet: PlacedMagnet) -> list[LineCrossing | TagReading]:
        """Findings that a further magnet completes."""
        if magnet.reading.phi_deg is Orientation.UP:
            return self._cross(magnet.reading)
        found = self.pass_by(magnet.reading.odometer_m)
        self._row.append(magnet)
        return [*found, *self._complete()]

    def pass_by(self, odometer_m: float) -> list[LineCrossing | TagReading]:
        """Findings that are complete because nothing came for a while."""
        if self._row and odometer_m - self._row[-1].reading.odometer_m > _GAP_FACTOR * self._longest_m + _GAP_SPARE_M:
            return self.finish()
        return []

    def finish(self) -> list[LineCrossing | TagReading]:
        """Findings of the magnets so far, which no further one joins."""
        found: list[LineCrossing | TagReading] = []
        while self._row:
            match = self._candidates.identify(self._row) if self._candidates else None
            if match is None:
                if len(self._row) > 1 and not found:
                    found.append(make_reading(self._row, None))
                self._row = []
            else:
                found.append(make_reading(self._row, match))
                self._row = self._row[match.members[-1] + 1 :]
        return found

    def _complete(self) -> list[LineCrossing | TagReading]:
        """A whole tag at the end of the row that cannot be the beginning of a longer one."""
        if not self._candidates or len(self._row) < 2:
            return []
        match = self._candidates.identify(self._row)
        if match is None or match.missing or match.members[-1] != len(self._row) - 1:
            return []
        length = math.dist(self._row[match.members[0]].place_m, self._row[-1].place_m)
        if length < _MIN_LENGTH_SHARE * self._candidates.longest_m - _MIN_LENGTH_SPARE_M:
            return []
        reading = make_reading(self._row, match)
        self._row = []
        return [reading]

    def _cross(self, magnet: MagnetReading) -> list[LineCrossing | TagReading]:
        """A line crossing, at the first magnet of a line."""
        reach = _LINE_REACH * MAX_LINE_SPACING_M
        self._lines = [m for m in self._lines if magnet.odometer_m - m.odometer_m < reach]
        known = [
            m
            for m in self._lines
            if m.polarity is magnet.polarity and abs(m.lateral_cm - magnet.lateral_cm) < _SAME_LINE_CM
        ]
        self._lines = [m for m in self._lines if m not in known] + [magnet]
        if known:
            return []
        style: LineStyle = LineTag(magnet.polarity).style
        side = Side.LEFT if magnet.lateral_cm >= 0 else Side.RIGHT
        return [LineCrossing(magnet.t_s, magnet.odometer_m, style, side, magnet.lateral_cm, magnet.confidence)]


def make_reading(row: Sequence[PlacedMagnet], match: Identification | None) -> TagReading:
    """The reading of a row of magnets, as the tag that was identified or without one."""
    members = [row[i] for i in match.members] if match else list(row)
    readings = tuple(m.reading for m in members)
    gaps = tuple(math.dist(a.place_m, b.place_m) for a, b in pairwise(members))
    std = tuple(
        math.hypot(a.relative_std_m, b.relative_std_m, _SPEED_STD * gap)
        for (a, b), gap in zip(pairwise(readings), gaps, strict=True)
    )
    ratios = tuple(g / gaps[0] for g in gaps[1:]) if gaps and gaps[0] > 0 else ()
    ratio_std = tuple(
        r * math.hypot(s / g, std[0] / gaps[0]) for r, g, s in zip(ratios, gaps[1:], std[1:], strict=True)
    )
    confidence = math.prod(r.confidence for r in readings)
    polarities: tuple[Polarity, ...] = tuple(r.polarity for r in readings)
    return TagReading(
        start_s=readings[0].t_s,
        end_s=readings[-1].t_s,
        polarities=polarities,
        gaps_m=gaps,
        gap_std_m=std,
        length_m=sum(gaps),
        ratios=ratios,
        ratio_std=ratio_std,
        lateral_cm=float(np.mean([r.lateral_cm for r in readings])),
        tag=match.tag if match else None,
        wrong_way=bool(match and match.wrong_way),
        missing=match.missing if match else 0,
        extra=match.extra if match else 0,
        confidence=confidence * (match.probability if match else 1.0),
        magnets=readings,
    )
