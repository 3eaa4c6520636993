"""Strength of a marker at a distance, and sensitivity of a receiver."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from app.radio.airtime import check_between, check_modulation

Floats = npt.NDArray[np.float64]

NEAR_M, NEAR_DBM = 50.0, -108.0  # [m, dBm] source: CERPM paper, section 4.1
FAR_M, FAR_DBM = 340.0, -125.0  # [m, dBm] source: CERPM paper, section 4.1
EXPONENT = (NEAR_DBM - FAR_DBM) / (10 * math.log10(FAR_M / NEAR_M))  # 2.04; source: the line through both points
PAPER_POWER_DBM = 20.0  # [dBm] not given by the paper; source: the SX1276's maximum, so that ranges are not too long
FADING_DB = 4.0  # [dB] not given by the paper; source: by hand, no measurement kept
MIN_DISTANCE_M = 1.0  # [m] source: by hand, below it the model is meaningless
_QUANTILES = (np.arange(6) + 0.5) / 6  # source: by hand, six equally likely levels
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
    """Path loss over the logarithm of distance.

    Parameters
    ----------
    near_m, near_dbm : float
        A distance and the mean level there. [m], [dBm]
    exponent : float
        1 to 6.
    at_power_dbm : float
        The power that was sent then. [dBm]
    fading_db : float
        Standard deviation of a packet's level about the mean, 0 to 15; each packet fades by itself. [dB]

    Raises
    ------
    InvalidParameter
        A value is outside its limits.

    Notes
    -----
    By default the line through the CERPM paper's two points, with a fading of 4 dB, which the paper does not give.
    """

    near_m: float = NEAR_M
    near_dbm: float = NEAR_DBM
    exponent: float = EXPONENT
    at_power_dbm: float = PAPER_POWER_DBM
    fading_db: float = FADING_DB

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
