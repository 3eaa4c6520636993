"""Strength of packets over distance -> log-distance path loss, though weak packets are never seen."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize
from scipy.special import log_expit, log_ndtr, ndtr
from scipy.stats import t as student

Floats = npt.NDArray[np.float64]

NEAR_M, NEAR_DBM = 50.0, -108.0
FAR_M, FAR_DBM = 340.0, -125.0
"""The two points of the CERPM paper, section 4.1. [m, dBm]"""
PAPER_EXPONENT = (NEAR_DBM - FAR_DBM) / (10 * math.log10(FAR_M / NEAR_M))
"""2.04."""
LEAST_PACKETS = 20
_LEAST_SPAN = 2.0
_SOFT_DB = 1.0
"""Scale of the step from hearing nothing to hearing all, about the sensitivity. [dB]"""
_STRAY, _STRAY_DENSITY = 0.02, 0.01
"""Share of packets that follow no law (reflections, wrong places), and their density. [1, 1/dB]"""
_EXPONENT_PRIOR = (2.3, 0.7)
_LOG_SPREAD_PRIOR = (math.log(4.5), 0.4)
_FLOOR_WIDTH_DB = 1.5
"""Middle and width of what is known beforehand; the sensitivity is near the weakest packets."""
_BLOCK = 6
_LEAST_GROUPS = 8
_MOST_FITTED = 12_000


@dataclass(frozen=True, slots=True)
class Estimate:
    """A figure with its interval of 95 %."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class PathLoss:
    """RSSI = level - 10 exponent log10(distance / 50 m), with a normal spread about it.

    Attributes
    ----------
    level_dbm : Estimate
        At 50 m. [dBm]
    exponent : Estimate
    spread_db : float
        Standard deviation of shadows and fading. [dB]
    sensitivity_dbm : float
        Half of the packets of this strength are heard; a guess where all were much stronger. [dBm]
    packets : int
    fitted_exponent : bool
        False where distances were too alike and the exponent is the paper's.
    """

    level_dbm: Estimate
    exponent: Estimate
    spread_db: float
    sensitivity_dbm: float
    packets: int
    fitted_exponent: bool

    @property
    def at_1m_dbm(self) -> float:
        """Of the line at 1 m, for drawing. [dBm]"""
        return self.level_dbm.value + 10 * self.exponent.value * math.log10(NEAR_M)

    def rssi_dbm(self, distance_m: npt.ArrayLike) -> Floats:
        """Of the line. [dBm]"""
        return self.level_dbm.value - self.exponent.value * _decades_db(np.asarray(distance_m, float))


def fit_path_loss(
    distance_m: npt.ArrayLike, rssi_dbm: npt.ArrayLike, group: npt.ArrayLike, sensitivity_dbm: float | None = None
) -> PathLoss | None:
    """Fit a path loss to packets that were heard; None where they are too few.

    Parameters
    ----------
    distance_m, rssi_dbm : array_like, shape (P,)
        Finite. [m, dBm]
    group : array_like of int, shape (P,)
        Packets of one marker, in the order they were heard: their shadows are alike.
    sensitivity_dbm : float, optional
        Of the receiver; fitted without. [dBm]

    Notes
    -----
    Maximum likelihood of what was heard, given that it was heard: a normal density about the line, cut by a soft step
    at the sensitivity, with a share of strays. Least squares would take the strong ones of the far packets for all and
    find a path loss that is too flat. Intervals are from the scores of groups (a sandwich), as packets of one pass are
    not independent; where there are few markers, from blocks of consecutive packets.
    """
    distance, rssi = np.asarray(distance_m, float), np.asarray(rssi_dbm, float)
    groups = np.asarray(group, int)
    if len(rssi) > _MOST_FITTED:
        kept = np.linspace(0, len(rssi) - 1, _MOST_FITTED).astype(int)
        distance, rssi, groups = distance[kept], rssi[kept], groups[kept]
    if len(rssi) < LEAST_PACKETS:
        return None
    far_db = _decades_db(distance)
    low, high = np.quantile(far_db, (0.05, 0.95))
    free = bool(high - low >= 10 * math.log10(_LEAST_SPAN))
    weights = _Likelihood(far_db, rssi, free, sensitivity_dbm)
    found = minimize(
        weights.cost, weights.start, method="Nelder-Mead", options={"maxiter": 2000, "xatol": 1e-3, "fatol": 1e-4}
    )
    best = np.asarray(found.x, float)
    deviation, degrees = _deviations(weights, best, groups)
    reach = student.ppf(0.975, degrees) * deviation
    exponent = best[1] if free else PAPER_EXPONENT
    wide = reach[1] if free else 0.0
    return PathLoss(
        Estimate(float(best[0]), float(best[0] - reach[0]), float(best[0] + reach[0])),
        Estimate(float(exponent), float(exponent - wide), float(exponent + wide)),
        float(math.exp(best[2])),
        float(best[3]) if sensitivity_dbm is None else sensitivity_dbm,
        len(np.asarray(rssi_dbm)),
        free,
    )


def fit_offset(
    line: PathLoss,
    distance_m: Floats,
    rssi_dbm: Floats,
    missed_m: Floats,
    heard_share: float,
    correlation: float,
) -> Estimate:
    """How far a marker's level is above a line, with the line's spread and sensitivity. [dB]

    Parameters
    ----------
    line : PathLoss
    distance_m, rssi_dbm : ndarray, shape (P,)
        Of packets that were heard; may be empty. [m, dBm]
    missed_m : ndarray, shape (Q,)
        Where the vehicle was at transmissions that were not heard; may be empty. [m]
    heard_share : float
        Of strong transmissions; the others are lost in collisions.
    correlation : float
        Of the residuals of consecutive packets, 0 to below 1: so much less do they tell.

    Notes
    -----
    Censored likelihood on a grid. A marker that is too weak shows in what is missing before it shows in what is heard.
    """
    grid = np.arange(-45.0, 30.01, 0.25)
    soft_db = math.hypot(line.spread_db, 1.702 * _SOFT_DB)
    level = line.rssi_dbm(distance_m)[:, None] + grid
    told = _log_density(rssi_dbm[:, None], level, line.spread_db, line.sensitivity_dbm)
    told = told + log_ndtr((level - line.sensitivity_dbm) / soft_db)
    audible = ndtr((line.rssi_dbm(missed_m)[:, None] + grid - line.sensitivity_dbm) / soft_db)
    silent = np.log1p(-np.minimum(heard_share, 0.98) * audible)
    total = told.sum(axis=0) + silent.sum(axis=0) - (grid / 20.0) ** 2 / 2
    best = int(total.argmax())
    widened = (1 + correlation) / (1 - correlation)
    count = (len(rssi_dbm) + len(missed_m)) / widened
    limit = float(student.ppf(0.975, max(count - 1, 1))) ** 2 * widened / 2
    within = grid[total >= total[best] - limit]
    line_db = (line.level_dbm.high - line.level_dbm.low) / 4
    low = grid[best] - math.hypot(grid[best] - within[0], 2 * line_db)
    high = grid[best] + math.hypot(within[-1] - grid[best], 2 * line_db)
    return Estimate(float(grid[best]), float(low), float(high))


def audible_share(line: PathLoss, distance_m: Floats) -> Floats:
    """Chance that a packet from this far is strong enough."""
    soft_db = math.hypot(line.spread_db, 1.702 * _SOFT_DB)
    return np.asarray(ndtr((line.rssi_dbm(distance_m) - line.sensitivity_dbm) / soft_db))


def residual_correlation(residual_db: Floats, group: npt.NDArray[np.int64]) -> float:
    """Of consecutive packets of the same marker, 0 to 0.9; a cautious 0.5 where there are few."""
    same = group[1:] == group[:-1]
    if same.sum() < 30:
        return 0.5
    residual = np.clip(residual_db - np.median(residual_db), -20, 20)
    first, second = residual[:-1][same], residual[1:][same]
    power = float(np.mean(residual**2))
    return float(np.clip(np.mean(first * second) / power, 0.0, 0.9)) if power > 0 else 0.5


class _Likelihood:
    """Of the parameters level, exponent, log spread, sensitivity."""

    def __init__(self, far_db: Floats, rssi_dbm: Floats, free: bool, sensitivity_dbm: float | None) -> None:
        self._far_db, self._rssi_dbm = far_db, rssi_dbm
        self._free, self._sensitivity_dbm = free, sensitivity_dbm
        floor_dbm = float(np.sort(rssi_dbm)[len(rssi_dbm) // 200])
        self.start = np.array([np.median(rssi_dbm + PAPER_EXPONENT * far_db), PAPER_EXPONENT, math.log(4.0), floor_dbm])
        self._priors = ((float(self.start[0]), 15.0), _EXPONENT_PRIOR, _LOG_SPREAD_PRIOR, (floor_dbm, _FLOOR_WIDTH_DB))

    @property
    def free(self) -> list[int]:
        """Parameters that are fitted and independent of each other."""
        return [0, *([1] if self._free else []), 2, *([3] if self._sensitivity_dbm is None else [])]

    def each(self, at: Floats) -> Floats:
        """Log density of each packet."""
        exponent = at[1] if self._free else PAPER_EXPONENT
        floor_dbm = self._priors[3][0]
        # far above what was heard the tails of the two steps are no longer alike
        fitted = min(max(at[3], floor_dbm - 4 * _FLOOR_WIDTH_DB), floor_dbm + 4 * _FLOOR_WIDTH_DB)
        sensitivity = fitted if self._sensitivity_dbm is None else self._sensitivity_dbm
        spread = math.exp(min(max(at[2], -1.0), 3.0))
        return _log_density(self._rssi_dbm, at[0] - exponent * self._far_db, spread, float(sensitivity))

    def cost(self, at: Floats) -> float:
        """Negative log likelihood with wide priors: what is cut off leaves a ridge towards weak, steep lines."""
        prior = sum(((at[k] - middle) / width) ** 2 / 2 for k, (middle, width) in enumerate(self._priors))
        total = float(prior - self.each(at).sum())
        return total if math.isfinite(total) else 1e300


def _decades_db(distance_m: Floats) -> Floats:
    return 10 * np.log10(np.maximum(distance_m, 1.0) / NEAR_M)


def _log_density(rssi_dbm: Floats, expected_dbm: Floats, spread_db: float, sensitivity_dbm: float) -> Floats:
    """Of strengths that were heard."""
    z = (rssi_dbm - expected_dbm) / spread_db
    normal = -(z**2) / 2 - math.log(spread_db * math.sqrt(2 * math.pi))
    audible = log_expit((rssi_dbm - sensitivity_dbm) / _SOFT_DB)
    # a logistic step is a normal one of 1.7 times its scale
    any_heard = log_ndtr((expected_dbm - sensitivity_dbm) / math.hypot(spread_db, 1.702 * _SOFT_DB))
    return np.asarray(
        np.logaddexp(normal + audible - any_heard + math.log1p(-_STRAY), math.log(_STRAY * _STRAY_DENSITY))
    )


def _deviations(weights: _Likelihood, best: Floats, groups: npt.NDArray[np.int64]) -> tuple[Floats, int]:
    """Standard deviations of the parameters, and degrees of freedom."""
    free = weights.free
    steps = np.array([0.05, 0.01, 0.01, 0.05])
    scores = np.empty((len(groups), len(free)))
    hessian = np.empty((len(free), len(free)))
    for i, a in enumerate(free):
        up, down = best.copy(), best.copy()
        up[a] += steps[a]
        down[a] -= steps[a]
        scores[:, i] = (weights.each(up) - weights.each(down)) / (2 * steps[a])
        for j, b in enumerate(free):
            total = 0.0
            for sign, base in ((1, up), (-1, down)):
                for way in (1, -1):
                    at = base.copy()
                    at[b] += way * steps[b]
                    total += sign * way * weights.cost(at)
            hessian[i, j] = total / (4 * steps[a] * steps[b])
    labels = _blocks(groups)
    sums = np.zeros((labels.max() + 1, len(free)))
    np.add.at(sums, labels, scores)
    count = len(sums)
    inverse = np.linalg.pinv((hessian + hessian.T) / 2)
    covariance = inverse @ (sums.T @ sums * count / max(count - 1, 1)) @ inverse
    deviations = np.zeros(4)
    # neither may be smaller: the sandwich of few groups is too thin at times
    deviations[free] = np.sqrt(np.maximum(np.diag(covariance), np.maximum(np.diag(inverse), 0)))
    return deviations, max(count - len(free), 1)


def _blocks(groups: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Labels of groups, or of blocks of consecutive packets where groups are few."""
    _names, labels = np.unique(groups, return_inverse=True)
    if labels.max() + 1 >= _LEAST_GROUPS:
        return np.asarray(labels, np.int64)
    counts = np.zeros(labels.max() + 1, int)
    place = np.empty(len(labels), int)
    for i, label in enumerate(labels):
        place[i] = counts[label]
        counts[label] += 1
    _names, blocks = np.unique(labels * (len(labels) + 1) + place // _BLOCK, return_inverse=True)
    return np.asarray(blocks, np.int64)
