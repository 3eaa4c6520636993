"""Strength of a marker at a distance, and sensitivity of a receiver."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
import scipy
from pydantic import Field

from app.inputs import Number
from app.radio.settings import check_between, check_modulation
from app.values import Floats

NEAR_M, NEAR_DBM = 50.0, -108.0  # [m, dBm] source: CERPM paper, section 4.1
FAR_M, FAR_DBM = 340.0, -125.0  # [m, dBm] source: CERPM paper, section 4.1
EXPONENT = (NEAR_DBM - FAR_DBM) / (10 * math.log10(FAR_M / NEAR_M))  # 2.04; source: the line through both points
PAPER_POWER_DBM = 20.0  # [dBm] not given by the paper; source: the SX1276's maximum, so that ranges are not too long
FADING_DB = 4.0  # [dB] not given by the paper
MIN_DISTANCE_M = 1.0  # [m] below it the model is meaningless
_QUANTILES = (np.arange(6) + 0.5) / 6  # six equally likely levels
SENSITIVITY_DBM: dict[int, tuple[float, ...]] = {
    125_000: (-118.0, -123.0, -126.0, -129.0, -132.0, -133.0, -136.0),
    250_000: (-115.0, -120.0, -123.0, -125.0, -128.0, -130.0, -133.0),
    500_000: (-111.0, -116.0, -119.0, -122.0, -125.0, -128.0, -130.0),
}
"""Of the SX1276 in its highest band, for spreading factors 6 to 12, by bandwidth. Semtech SX1276/77/78/79 data sheet,
revision 7, table 10. [dBm]"""


def sensitivity_dbm(spreading_factor: int, bandwidth_hz: int) -> float:
    """The weakest packet that an SX1276 reads.

    Raises
    ------
    InvalidParameter
        The radio has no such spreading factor or bandwidth.
    """
    check_modulation(spreading_factor, bandwidth_hz, explicit_header=False)
    return SENSITIVITY_DBM[bandwidth_hz][spreading_factor - 6]


@dataclass(frozen=True, slots=True)
class LinkModel:
    """Path loss over the logarithm of distance: by default the line through the CERPM paper's two points, and 4 dB of
    fading, which the paper does not give."""

    near_m: Annotated[Number, Field(description="A distance, 1 to 10,000. [m]")] = NEAR_M
    near_dbm: Annotated[Number, Field(description="The mean level there, -150 to 0. [dBm]")] = NEAR_DBM
    exponent: Annotated[Number, Field(description="1 to 6.")] = EXPONENT
    at_power_dbm: Annotated[Number, Field(description="The power that was sent then, -20 to 30. [dBm]")] = (
        PAPER_POWER_DBM
    )
    fading_db: Annotated[
        Number, Field(description="Standard deviation of a packet's level, 0 to 15; each fades by itself. [dB]")
    ] = FADING_DB

    def __post_init__(self) -> None:
        check_between("link.near_m", self.near_m, 1.0, 10_000.0, "m")
        check_between("link.near_dbm", self.near_dbm, -150.0, 0.0, "dBm")
        check_between("link.exponent", self.exponent, 1.0, 6.0, "")
        check_between("link.at_power_dbm", self.at_power_dbm, -20.0, 30.0, "dBm")
        check_between("link.fading_db", self.fading_db, 0.0, 15.0, "dB")

    def level_dbm(self, distance_m: npt.ArrayLike, power_dbm: float = PAPER_POWER_DBM) -> Floats:
        """Mean level at distances, of any shape; below 1 m as at 1 m. [dBm]"""
        distance = np.maximum(np.asarray(distance_m, float), MIN_DISTANCE_M)
        fallen_db = 10 * self.exponent * np.log10(distance / self.near_m)
        return np.asarray(self.near_dbm + power_dbm - self.at_power_dbm - fallen_db)

    def range_m(self, threshold_dbm: float, power_dbm: float = PAPER_POWER_DBM) -> float:
        """Distance at which the mean level has fallen to a threshold. [m]"""
        spare_db = self.near_dbm + power_dbm - self.at_power_dbm - threshold_dbm
        return float(self.near_m * 10 ** (spare_db / (10 * self.exponent)))

    def share_above(self, level_dbm: npt.ArrayLike, threshold_dbm: npt.ArrayLike) -> Floats:
        """Share of packets above a threshold where the mean is a level."""
        spare_db = np.asarray(level_dbm, float) - np.asarray(threshold_dbm, float)
        if self.fading_db == 0.0:
            return np.asarray(spare_db >= 0.0, float)
        return np.asarray(scipy.special.ndtr(spare_db / self.fading_db))

    def read_levels_dbm(self, level_dbm: npt.ArrayLike, threshold_dbm: float) -> Floats:
        """Equally likely levels of those packets that are above a threshold, shape (...) to (..., Q). [dBm]"""
        level = np.asarray(level_dbm, float)[..., None]
        if self.fading_db == 0.0:
            return level
        above = scipy.special.ndtr((level - threshold_dbm) / self.fading_db)
        return np.asarray(level - self.fading_db * scipy.special.ndtri(above * _QUANTILES))


# === Strength of packets over distance to log-distance path loss, although weak packets are never received.


MIN_PACKETS = 20  # for a fit of four parameters
_MIN_SPAN = 2.0  # ratio of distances to fit an exponent; one octave
_SOFT_DB = 1.0  # [dB] scale of the step from no reception to full reception
_OUTLIER_SHARE = 0.02  # of packets with reflections or wrong positions
_OUTLIER_DENSITY = 0.01  # [1/dB] of their strength; source: uniform over 100 dB
_EXPONENT_PRIOR = (2.3, 0.7)  # mean, deviation; between free space (2) and roadside clutter (3)
_LOG_SPREAD_PRIOR = (math.log(4.5), 0.4)  # of the spread [dB]; source: `simulation.radio.link.Radio`, 4 and 2 dB
_LEVEL_PRIOR_DB = 15.0  # [dB] deviation of the level at 50 m from its start; weak
_FLOOR_SIGMA_DB = 1.5  # [dB] of the sensitivity about the weakest packets
_BLOCK = 6  # consecutive packets with common shadows
_MIN_GROUPS = 8  # markers for a sandwich estimate
_MAX_FITTED = 12_000  # packets; bounds the time of a fit
_LOGISTIC_TO_NORMAL = 1.702  # source: Camilli, J. Educ. Behav. Stat. 19 (1994), 293: closest normal to a logistic
_OFFSETS_DB = (-45.0, 30.0, 0.25)  # [dB] grid of a marker's level: lowest, highest, step
_OFFSET_PRIOR_DB = 20.0  # [dB] deviation of a marker's level from the fleet's; weak
_MIN_CORRELATED = 30  # pairs of packets to estimate their correlation


@dataclass(frozen=True, slots=True)
class Estimate:
    """An estimate with its interval of 95 %."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class PathLoss:
    """The fitted path loss: RSSI = level - 10 exponent log10(distance / 50 m), with a normal spread about it."""

    level_at_50m_dbm: Estimate
    exponent: Estimate
    spread_db: float  # [dB] standard deviation of shadows and fading
    sensitivity_dbm: float  # [dBm] half of the packets of this strength are received; a guess if all were much stronger
    packets: int
    fitted_exponent: bool  # False if distances were too similar and the exponent is the paper's

    @property
    def at_1m_dbm(self) -> float:
        """Of the line at 1 m, for drawing. [dBm]"""
        return self.level_at_50m_dbm.value + 10 * self.exponent.value * math.log10(NEAR_M)

    def rssi_dbm(self, distance_m: npt.ArrayLike) -> Floats:
        """Of the line. [dBm]"""
        return self.level_at_50m_dbm.value - self.exponent.value * _decades_db(np.asarray(distance_m, float))


def fit_path_loss(
    distance_m: npt.ArrayLike, rssi_dbm: npt.ArrayLike, group: npt.ArrayLike, sensitivity_dbm: float | None = None
) -> PathLoss | None:
    """Fit a path loss to received packets; None if they are too few.

    Parameters
    ----------
    distance_m, rssi_dbm : array_like, shape (P,)
        Finite. [m, dBm]
    group : array_like of int, shape (P,)
        Packets of one marker, in the order received: their shadows are correlated.
    sensitivity_dbm : float, optional
        Of the receiver; fitted if None. [dBm]

    Notes
    -----
    Maximum likelihood of the strengths, given that the packets were received: a normal density about the line,
    truncated by a soft step at the sensitivity, with a share of outliers. Least squares would only see the strong ones
    among far packets and find a path loss that is too flat. Intervals are from the scores of groups (sandwich
    estimator), as packets of one pass are not independent; with few markers, from blocks of consecutive packets.
    """
    distance, rssi = np.asarray(distance_m, float), np.asarray(rssi_dbm, float)
    groups = np.asarray(group, int)
    if len(rssi) > _MAX_FITTED:
        kept = np.linspace(0, len(rssi) - 1, _MAX_FITTED).astype(int)
        distance, rssi, groups = distance[kept], rssi[kept], groups[kept]
    if len(rssi) < MIN_PACKETS:
        return None
    far_db = _decades_db(distance)
    low, high = np.quantile(far_db, (0.05, 0.95))
    free = bool(high - low >= 10 * math.log10(_MIN_SPAN))
    weights = _Likelihood(far_db, rssi, free, sensitivity_dbm)
    found = scipy.optimize.minimize(
        weights.cost, weights.start, method="Nelder-Mead", options={"maxiter": 2000, "xatol": 1e-3, "fatol": 1e-4}
    )
    best = np.asarray(found.x, float)
    deviation, degrees = _deviations(weights, best, groups)
    reach = scipy.special.stdtrit(degrees, 0.975) * deviation
    exponent = best[1] if free else EXPONENT
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
    received_share: float,
    correlation: float,
) -> Estimate:
    """Level of a marker above a line, with the line's spread and sensitivity. [dB]

    Parameters
    ----------
    distance_m, rssi_dbm : ndarray, shape (P,)
        Of received packets; may be empty. [m, dBm]
    missed_m : ndarray, shape (Q,)
        Distance of transmissions that were not received; may be empty. [m]
    received_share : float
        Share of strong transmissions that are received; the others are lost in collisions.
    correlation : float
        Of the residuals of consecutive packets, 0 to below 1: reduces their information.

    Notes
    -----
    Censored likelihood on a grid. A weak marker shows by missing packets before it shows by weak ones.
    """
    grid = np.arange(_OFFSETS_DB[0], _OFFSETS_DB[1] + 0.01, _OFFSETS_DB[2])
    soft_db = math.hypot(line.spread_db, _LOGISTIC_TO_NORMAL * _SOFT_DB)
    level = line.rssi_dbm(distance_m)[:, None] + grid
    received = _log_density(rssi_dbm[:, None], level, line.spread_db, line.sensitivity_dbm)
    received = received + scipy.special.log_ndtr((level - line.sensitivity_dbm) / soft_db)
    audible = scipy.special.ndtr((line.rssi_dbm(missed_m)[:, None] + grid - line.sensitivity_dbm) / soft_db)
    silent = np.log1p(-np.minimum(received_share, 0.98) * audible)
    total = received.sum(axis=0) + silent.sum(axis=0) - (grid / _OFFSET_PRIOR_DB) ** 2 / 2
    best = int(total.argmax())
    widened = (1 + correlation) / (1 - correlation)
    count = (len(rssi_dbm) + len(missed_m)) / widened
    limit = float(scipy.special.stdtrit(max(count - 1, 1), 0.975)) ** 2 * widened / 2
    within = grid[total >= total[best] - limit]
    line_db = (line.level_at_50m_dbm.high - line.level_at_50m_dbm.low) / 4
    low = grid[best] - math.hypot(grid[best] - within[0], 2 * line_db)
    high = grid[best] + math.hypot(within[-1] - grid[best], 2 * line_db)
    return Estimate(float(grid[best]), float(low), float(high))


def audible_share(line: PathLoss, distance_m: Floats) -> Floats:
    """Probability that a packet from this distance is strong enough."""
    soft_db = math.hypot(line.spread_db, _LOGISTIC_TO_NORMAL * _SOFT_DB)
    return np.asarray(scipy.special.ndtr((line.rssi_dbm(distance_m) - line.sensitivity_dbm) / soft_db))


def residual_correlation(residual_db: Floats, group: npt.NDArray[np.int64]) -> float:
    """Correlation of consecutive packets of the same marker, 0 to 0.9; a cautious 0.5 if there are few."""
    same = group[1:] == group[:-1]
    if same.sum() < _MIN_CORRELATED:
        return 0.5
    residual = np.clip(residual_db - np.median(residual_db), -20, 20)
    first, second = residual[:-1][same], residual[1:][same]
    power = float(np.mean(residual**2))
    return float(np.clip(np.mean(first * second) / power, 0.0, 0.9)) if power > 0 else 0.5


class _Likelihood:
    """Likelihood of the parameters level, exponent, log spread, sensitivity."""

    def __init__(self, far_db: Floats, rssi_dbm: Floats, free: bool, sensitivity_dbm: float | None) -> None:
        self._far_db, self._rssi_dbm = far_db, rssi_dbm
        self._free, self._sensitivity_dbm = free, sensitivity_dbm
        floor_dbm = float(np.sort(rssi_dbm)[len(rssi_dbm) // 200])
        self.start = np.array([np.median(rssi_dbm + EXPONENT * far_db), EXPONENT, math.log(4.0), floor_dbm])
        self._priors = (
            (float(self.start[0]), _LEVEL_PRIOR_DB),
            _EXPONENT_PRIOR,
            _LOG_SPREAD_PRIOR,
            (floor_dbm, _FLOOR_SIGMA_DB),
        )

    @property
    def free(self) -> list[int]:
        """Parameters that are fitted and independent of each other."""
        return [0, *([1] if self._free else []), 2, *([3] if self._sensitivity_dbm is None else [])]

    def each(self, at: Floats) -> Floats:
        """Log density of each packet."""
        exponent = at[1] if self._free else EXPONENT
        floor_dbm = self._priors[3][0]
        # far above the weakest packets the tails of the two steps differ
        fitted = min(max(at[3], floor_dbm - 4 * _FLOOR_SIGMA_DB), floor_dbm + 4 * _FLOOR_SIGMA_DB)
        sensitivity = fitted if self._sensitivity_dbm is None else self._sensitivity_dbm
        spread = math.exp(min(max(at[2], -1.0), 3.0))
        return _log_density(self._rssi_dbm, at[0] - exponent * self._far_db, spread, float(sensitivity))

    def cost(self, at: Floats) -> float:
        """Negative log likelihood with weak priors: truncation leaves a ridge towards weak, steep lines."""
        prior = sum(((at[k] - middle) / width) ** 2 / 2 for k, (middle, width) in enumerate(self._priors))
        total = float(prior - self.each(at).sum())
        return total if math.isfinite(total) else 1e300


def _decades_db(distance_m: Floats) -> Floats:
    """Ten times the logarithm of the distance over 50 m."""
    return 10 * np.log10(np.maximum(distance_m, 1.0) / NEAR_M)


def _log_density(rssi_dbm: Floats, expected_dbm: Floats, spread_db: float, sensitivity_dbm: float) -> Floats:
    """Log density of received strengths, given that they were received."""
    z = (rssi_dbm - expected_dbm) / spread_db
    normal = -(z**2) / 2 - math.log(spread_db * math.sqrt(2 * math.pi))
    audible = scipy.special.log_expit((rssi_dbm - sensitivity_dbm) / _SOFT_DB)
    # a logistic step is a normal one of 1.7 times its scale
    any_received = scipy.special.log_ndtr(
        (expected_dbm - sensitivity_dbm) / math.hypot(spread_db, _LOGISTIC_TO_NORMAL * _SOFT_DB)
    )
    return np.asarray(
        np.logaddexp(
            normal + audible - any_received + math.log1p(-_OUTLIER_SHARE), math.log(_OUTLIER_SHARE * _OUTLIER_DENSITY)
        )
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
    # the larger of both: the sandwich estimate of few groups can be too small
    deviations[free] = np.sqrt(np.maximum(np.diag(covariance), np.maximum(np.diag(inverse), 0)))
    return deviations, max(count - len(free), 1)


def _blocks(groups: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Labels of groups, or of blocks of consecutive packets where groups are few."""
    _names, labels = np.unique(groups, return_inverse=True)
    if labels.max() + 1 >= _MIN_GROUPS:
        return np.asarray(labels, np.int64)
    counts = np.zeros(labels.max() + 1, int)
    place = np.empty(len(labels), int)
    for i, label in enumerate(labels):
        place[i] = counts[label]
        counts[label] += 1
    _names, blocks = np.unique(labels * (len(labels) + 1) + place // _BLOCK, return_inverse=True)
    return np.asarray(blocks, np.int64)
