"""Models of read rates and path errors, and their fitted parameters of app/planning/data/predictions.json."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources

import numpy as np
import numpy.typing as npt
import scipy

from app.planning.alignment import Floats

DAY = "day"
"""The condition that the others are added to."""
PLACING_SD_M = 0.01
"""[m] of placing a marker, each axis. Source: `PLACING_SD_M` of app/planning/proof/cerpms.py."""
_NODES, _WEIGHTS = (np.asarray(part) for part in np.polynomial.hermite_e.hermegauss(15))
_SPACING_UNIT_M, _SPEED_UNIT_MPS = 15.0, 15.0  # units of the powers; source: near the middle of the fitted drives


def normal_quadrature() -> tuple[Floats, Floats]:
    """Nodes and weights of a standard normal variable, each of shape (15,)."""
    return _NODES, _WEIGHTS / _WEIGHTS.sum()


@dataclass(frozen=True, slots=True)
class PlateModel:
    """Read rate of plates in frames of one pass.

    Attributes
    ----------
    slope, unit_px : float
        Log-odds of reading a frame rise by the slope with the logarithm of a unit's height; they are 0 at this height
        without blur. [1, px]
    blur_slope : float
        By how much the logarithm of that height rises with each unit of motion blur.
    spread : float
        Standard deviation of the log-odds between passes: light, sensor, state of the plate.
    sharp, blur_limit : float
        Log-odds that a pass can be read at all, without blur, and by how much a unit of blur lowers them.
    fix_rms_m : float
        Error of a vehicle's position from the nearest frame, horizontal, with an exact survey. [m]
    exposures_s : tuple of float
        The camera exposes at least for one of these, all equally likely; empty: as its rules state. [s]
    """

    slope: float
    unit_px: float
    blur_slope: float
    spread: float
    sharp: float
    blur_limit: float
    fix_rms_m: float
    exposures_s: tuple[float, ...] = ()

    def pass_log_odds(self, unit_px: Floats, blur_units: npt.ArrayLike) -> Floats:
        """Mean log-odds of reading frames, of the shape of the unit heights."""
        shifted = math.log(self.unit_px) + self.blur_slope * np.asarray(blur_units)
        return np.asarray(self.slope * (np.log(np.maximum(unit_px, 1e-6)) - shifted))

    def readable_share(self, blur_units: npt.ArrayLike) -> Floats:
        """Share of passes that can be read at all."""
        return np.asarray(scipy.special.expit(self.sharp - self.blur_limit * np.asarray(blur_units)))


@dataclass(frozen=True, slots=True)
class MagnetModel:
    """Read rate of a tag or of a line's magnet: log-odds linear in clearance and curvature.

    Attributes
    ----------
    at_16_cm, per_metre, per_curvature : float
        Log-odds at a clearance of 0.16 m, and by how much they change with clearance [1/m] and curvature [m].
    fix_share, fix_rms_m : float
        Share of read tags that fix the position, and its error with an exact survey, horizontal. [1, m]
    """

    at_16_cm: float
    per_metre: float
    per_curvature: float
    fix_share: float = 0.0
    fix_rms_m: float = 0.0

    def read_rate(self, clearance_m: float, curvature_1pm: npt.ArrayLike) -> Floats:
        """Of the shape of the curvatures."""
        bend = np.abs(np.asarray(curvature_1pm, dtype=np.float64))
        return np.asarray(
            scipy.special.expit(self.at_16_cm + self.per_metre * (clearance_m - 0.16) + self.per_curvature * bend)
        )


@dataclass(frozen=True, slots=True)
class PathModel:
    """Root mean square distance of the path from the lane's centre line, of drives with an RTK receiver.

    Attributes
    ----------
    exact_markers_m : float
        With markers that are exactly surveyed, 15 m apart, at 15 m/s. [m]
    marker_gain : float
        What markers that are off by a distance on each axis add in square, as a share of that distance, there.
    spacing_power, speed_power : float
        Exponents of these two.
    exact_share : float
        Share of the squared error of the spline through exact markers that remains.
    end_gain_m : float
        Length of lane at each of its ends that would double the squared error there. [m]
    worst_share : float
        Mean greatest distance along 500 m, over the root mean square.
    """

    exact_markers_m: float
    marker_gain: float
    spacing_power: float
    speed_power: float
    exact_share: float
    end_gain_m: float
    worst_share: float

    def rms_of(
        self, survey_rmse_m: float, spacing_m: Floats, speed_mps: Floats, exact_rms_m: Floats, ends_per_m: Floats
    ) -> Floats:
        """Of stretches, shape (K,); see `app.planning.predict.rates.Stretches`. [m]"""
        sigma = math.hypot(survey_rmse_m / math.sqrt(2), PLACING_SD_M)
        own = (
            math.hypot(self.exact_markers_m, self.marker_gain * sigma)
            * (spacing_m / _SPACING_UNIT_M) ** self.spacing_power
            * (np.maximum(speed_mps, 1.0) / _SPEED_UNIT_MPS) ** self.speed_power
        )  # fmt: skip
        return np.asarray(np.sqrt(own**2 * (1.0 + self.end_gain_m * ends_per_m) + self.exact_share * exact_rms_m**2))


@dataclass(frozen=True, slots=True)
class Models:
    """All models; plates by condition."""

    plates: Mapping[str, PlateModel]
    tags: MagnetModel
    lines: MagnetModel
    path: PathModel
    source: str

    def plate_model(self, condition: str) -> PlateModel:
        """Of a condition, also of several joined with ``+``.

        Notes
        -----
        Of joined conditions each adds its difference from the day: to the logarithm of the height, to the variance
        between passes, and to the odds against reading. The proof of ``night+rain`` and others may differ more.
        """
        day = self.plates[DAY]
        parts = [self.plates[part] for part in sorted({part.strip() for part in condition.split("+")} - {DAY})]
        if len(parts) < 2:
            return parts[0] if parts else day
        variance = day.spread**2 + sum(part.spread**2 - day.spread**2 for part in parts)
        return PlateModel(
            slope=min(part.slope for part in parts),
            unit_px=day.unit_px * math.prod(max(part.unit_px / day.unit_px, 1.0) for part in parts),
            blur_slope=max(part.blur_slope for part in parts),
            spread=math.sqrt(max(variance, day.spread**2)),
            sharp=day.sharp + sum(min(part.sharp - day.sharp, 0.0) for part in parts),
            blur_limit=max(part.blur_limit for part in parts),
            fix_rms_m=math.sqrt(sum(part.fix_rms_m**2 for part in parts)),
            exposures_s=next((part.exposures_s for part in parts if part.exposures_s), ()),
        )


@lru_cache(maxsize=1)
def fitted_models() -> Models:
    """The models with the parameters of app/planning/data/predictions.json."""
    text = (resources.files("app.planning") / "data" / "predictions.json").read_text("utf-8")
    found = json.loads(text)
    plates = {
        name: PlateModel(**{**values, "exposures_s": tuple(values["exposures_s"])})
        for name, values in found["plates"].items()
    }
    return Models(
        plates, MagnetModel(**found["tags"]), MagnetModel(**found["lines"]), PathModel(**found["path"]), found["source"]
    )
