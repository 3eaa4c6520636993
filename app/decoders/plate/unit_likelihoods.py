"""Unit values to evidence: which units are dark, the cost of each symbol of a cell, and which units look damaged.

The logarithm of a unit's light is a smooth illumination, minus one contrast where the unit is dark, plus noise whose
covariance the fit gives: neighbours that share pixels share their error. Illumination is a Gaussian process, so the
cost of any pattern of units is a quadratic form, and margins come from exact differences of it.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.plate import Array
from app.decoders.plate.confirm import UnitVerification
from app.decoders.plate.fit import PlateFit
from app.decoders.plate.hypotheses import (
    MIN_PIXELS,
    LightPrior,
    PlatePattern,
    PlatePixels,
    Spots,
    cut_patch,
    set_unit_likelihoods,
)
from app.decoders.plate.light_field import (
    DARK_SHARE,
    LEVEL_VARIANCE,
    LIGHT_LENGTH_MM,
    VEIL_LENGTH,
    Veil,
    estimate_veil,
    fit_light,
    uniform_haze,
    veil_log_odds,
)
from app.decoders.plate.normal_equations import invert
from app.decoders.plate.pose import unit_edges, unit_shapes
from app.decoders.plate.synthesis import FIRST_GAP, gather_shares, set_pixel_shares
from app.decoders.plate.unit_patterns import cell_costs, minimize_pattern
from app.markers.plate import PlateCode, PlateGeometry, unit_index
from app.values import Floats32

CONTRAST = 2.0
"""[log light] expected difference of light and dark units once haze is taken off. Near ln(1 / light_field.DARK_SHARE) =
2.1."""
CONTRAST_SPREAD = 0.4
"""[log light] standard deviation of that difference."""
LIGHT_SPREAD = 0.45
"""[log light] standard deviation of the illumination over a few units."""
LIGHT_LENGTH = 4.0
"""[units of 8] distance over which the illumination's correlation falls to 1/e."""
MEAN_VARIANCE = 4.0
"""[1] variance of the illumination's mean, which leaves it open."""
WEAR = 0.16
"""[log light] standard deviation of what units differ by themselves."""
LEVELLED_LIGHT_SPREAD, LEVELLED_WEAR = 0.1, 0.1
"""[light level] the same two on light whose illumination has been divided out."""
LEVELLED_CONTRAST_SPREAD = 0.3
"""[contrast] standard deviation of the levelled contrast."""
LOG_FLOOR = 0.05
"""[light level] added before the logarithm, so that noise around black stays small."""
MAX_LOG_ODDS = 7.0
"""[log odds] of a veil against even haze, or the reverse, beyond which the other one does not count. Source: a weight
of 1e-3; of 112 plates that the likelier one finds sure the other one refuses none (decision record 0011)."""
MAX_FIRST_ERROR = 0.2
"""[probability] of an error under the likelier explanation beyond which the other one is not compared: it has at most
half of the weight, and what errs with a tenth is refused. For speed."""
MIN_VEILED_RESIDUAL = 0.08
"""[contrast] level residual under even haze from which on a veil of glare is compared. For speed, as
`evidence.PLAIN_RESIDUAL`."""
RESIDUAL_TO_SPREAD = 1.4826
"""[1] standard deviation of a normal distribution over the median of its absolute values."""
MIN_LEVEL_NOISE_RATIO = 4.0
"""[standard deviations] by which the lightest units must stand above the darkest."""
MIN_LIGHT = 1e-4
"""[1 = saturation] below which there is no light to decode. Source: four grey levels of 255 at a gamma of 2.2."""
SCATTER_PRIOR = (8.0, 0.6)
"""[units, 1] weight and value of the scatter that is expected against the model."""
USUAL_BLUR_PX = 1.0
"""[px] lens blur of a sharp camera. `simulation.conditions.draw_daylight` has 0.4 to 0.9."""
FULL_WEIGHT_PX = 1.4
"""[px] size of a unit in the image, in its usual blur, from which on its likelihood has full weight. Effect: `python -m
benchmarks.plates.thresholds`."""
MAX_BLUR_UNITS = 0.6
"""[units] standard deviation of lens and motion blur together up to which likelihoods have full weight. Source: `python
-m benchmarks.plates.thresholds`."""
CELL_LIGHT_RANGE = (0.65, 1.5)
"""[1] light on a cell of one level over that around it, beyond which it may be a stain. Effect: `python -m
benchmarks.plates.thresholds`."""
MAX_LEVEL_RESIDUAL = 0.23
"""[contrast] distance of a unit from its level from which on it is an outlier, worn or stained. Effect: `python -m
benchmarks.plates.thresholds`."""
MAX_LARGE_RESIDUAL, LARGE_UNIT_PX = 0.16, 3.0
"""[contrast, px] the same on units of at least this size, whose own noise is smaller. Effect: `python -m
benchmarks.plates.thresholds`."""
MAX_RESIDUAL_SPREAD = 0.12
"""[contrast x units] distance from the level times standard deviation of the blur, the same. Effect: `python -m
benchmarks.plates.thresholds`."""
STAIN_UNIT_PX = 2.0
"""[px] size of a unit from which on damage counts fully: smaller ones show less. Effect: `python -m
benchmarks.plates.thresholds`."""
STAIN_DARK, STAIN_LIGHT = 0.07, 0.105
"""[contrast] residual of a dark or light unit's pixels from which on it may be a stain."""
MIN_OF_A_LEVEL = 6
"""[units] light or dark ones from which on their median is the usual residual."""
RISK_CONSTANT, RISK_OF_LEVEL, RISK_OF_MISFIT, RISK_BESIDE_HIDDEN = -0.765, 1.98, 1.877, 2.289
"""[log odds] that a cell shows another symbol than was built: alone, for the logarithms of its level residual and of
its pixels' misfit, and beside a marker that is hidden. Source: `python -m benchmarks.training.cell_risk`, 9,570 cells
(decision record 0008)."""
RISK_FLOOR = 0.05
"""[contrast] added to a level residual before its logarithm."""
HIDDEN_TINT, HIDDEN_TINT_SPREAD = 0.3, 0.08
"""[1] tint of a marker that is hidden or not with even odds, and the scale of the logistic function around it."""
TAIL_SHARE = 1 / 8
"""[1] share of the units whose mean is the lightest and the darkest level."""
MIN_LEVEL_DIFFERENCE, ONE_LEVEL_DIFFERENCE = 0.1, 0.8
"""[light level] least difference of the levels, and that which is assumed while one is missing."""


@dataclass(frozen=True, slots=True)
class UnitEvidence:
    """Evidence of a fit about the symbols."""

    # shape (cells, 16): cost of each symbol above the best pattern of all units, the other cells as in that pattern
    cell_costs: Array
    best: npt.NDArray[np.intp]  # shape (cells,): most likely symbols, any of sixteen
    dark: npt.NDArray[np.bool_]  # shape (units,): the best pattern, in the order of the symbols' units
    disputed: npt.NDArray[np.bool_]  # shape (cells,): where the two classifiers differ
    # shape (cells,): distance of each cell's worst unit from its level towards the other level, as a share of the
    # contrast; scaled up on plates whose units are large, or so blurred that they run into each other
    level_residual: Array
    # largest level residual times the outlier ratio of some unit's pixels: their residual over what is usual. A stain
    # that turns a light unit dark ends beside it, on gaps and neighbours, and the plate has others that end half way.
    damage: float
    outlier_ratio: float  # of the worst unit's pixels, as in `damage`
    # `weight`, `residual`: quadratic form of the costs and its vector at the best pattern, for other patterns
    weight: Array
    residual: Array
    contrast: float  # between light and dark units, the light level being about 1
    scatter: float  # mean cost of a unit's distance from its level; about 1 or less on a plate that follows the model
    gap: float  # light of the gaps between units over that of the light units, the haze taken off
    span: float  # light of the light units above the dark ones. [linear, 1 = saturation]
    # light that the plate does not send: what was taken off, and the other explanation if it is not much less likely
    veils: tuple[Veil, ...]
    risk_log_odds: Array  # shape (cells,): that something hides what was built in a cell
    veil_log_odds: float = math.inf  # of the first against the other

    @property
    def cell_margin(self) -> Array:
        """Cost of the second best symbol of each cell, shape (cells,)."""
        margin: Array = np.partition(self.cell_costs, 1, axis=1)[:, 1]
        return margin

    @property
    def spread(self) -> float:
        """Standard deviation of what units differ by on this plate, by the median of the cells. [contrast]"""
        return RESIDUAL_TO_SPREAD * float(np.median(np.abs(self.level_residual)))


@lru_cache
def _smooth(n: int, spread: float) -> Array:
    """Covariance of a smooth field between units, in symbol order; its mean is left open."""
    flat = unit_index(n).reshape(-1)
    position = np.stack([flat // n, flat % n], axis=1).astype(float)
    distance = np.linalg.norm(position[:, None] - position[None], axis=2)
    covariance: Array = spread**2 * np.exp(-distance / (LIGHT_LENGTH * n / 8)) + MEAN_VARIANCE
    return covariance


@lru_cache
def _shape_order(n: int) -> npt.NDArray[np.intp]:
    """Numbers of the fitted shapes of each symbol's units, in symbol order."""
    shapes: npt.NDArray[np.intp] = unit_shapes(n).reshape(-1)[unit_index(n).reshape(-1)]
    return shapes


PATTERNS = np.array(list(itertools.product((0, 1), repeat=4)), dtype=float)
"""Dark units of each symbol of a cell, shape (16, 4): row k holds the bits of k."""


class LightLevels(NamedTuple):
    """The units' light in symbol order, their covariance, and the light of the darkest and the lightest."""

    values: Array
    covariance: Array
    dark: float
    light: float


def unit_log_likelihoods(fit: PlateFit, *, thermal: bool = False) -> UnitEvidence | None:
    """Costs of all symbols; None when the units do not differ by more than their noise, or show one level only.

    Under even haze, or under a veil of glare where that is the likelier explanation of the units' light; a thermal
    frame has no glare.
    """
    levels = light_levels(fit)
    if levels is None:
        return None
    n = fit.units.shape[0]
    haze = uniform_haze(levels.dark, levels.light, n)
    hazy = _under_veil(fit, levels, haze)
    if thermal or (hazy is not None and hazy.level_residual.max() < MIN_VEILED_RESIDUAL):
        return hazy
    veil, dark = estimate_veil(levels.values, levels.covariance, levels.light - levels.dark, n)
    patterns = [dark] if hazy is None or (hazy.dark == dark).all() else [dark, hazy.dark]
    log_odds = veil_log_odds(levels.values, levels.covariance, haze, patterns, n)
    veiled = _under_veil(fit, levels, veil) if log_odds > 0 or hazy is None else None
    found, veils = (hazy, (haze, veil)) if veiled is None else (veiled, (veil, haze))
    if found is None or abs(log_odds) > MAX_LOG_ODDS:
        return found
    return replace(found, veils=veils, veil_log_odds=log_odds if found is veiled else -log_odds)


def _under_veil(fit: PlateFit, levels: LightLevels, veil: Veil) -> UnitEvidence | None:
    """Costs of all symbols once a veil is taken off.

    Two classifiers in turn: the first on logarithms, where any illumination is a sum, gives the light that falls on
    each unit; the second on the light divided by that, where the noise is even.
    """
    n = fit.units.shape[0]
    values = levels.values - veil.light.reshape(-1)[unit_index(n).reshape(-1)]
    light, first = _estimate_illumination(values, levels.covariance, veil.level, n)
    levelled = values / light
    total = _smooth(n, LEVELLED_LIGHT_SPREAD) + levels.covariance / np.outer(light, light)
    total[np.diag_indices_from(total)] += LEVELLED_WEAR**2
    weight = invert(total)
    dark = first.copy()
    difference = _level_difference(levelled, dark)
    residual, contrast = minimize_pattern(
        weight, levelled - levelled.mean(), dark, difference, LEVELLED_CONTRAST_SPREAD * difference
    )
    if dark.all() or not dark.any():
        return None  # one level only may be anything; all zeros would satisfy any check
    # how well this plate follows the model scales what a difference means
    scatter = float(residual @ weight @ residual)
    weight /= (scatter + SCATTER_PRIOR[0] * SCATTER_PRIOR[1]) / (len(residual) + SCATTER_PRIOR[0])
    weight *= _resolution_weight(fit)
    costs = cell_costs(weight, residual, dark, contrast, PATTERNS)
    level_residual = level_residuals(levelled, dark, contrast).reshape(-1, 4).max(axis=1)
    if fit.unit_px >= LARGE_UNIT_PX:
        level_residual *= MAX_LEVEL_RESIDUAL / MAX_LARGE_RESIDUAL
    misfit = np.sqrt(fit.unit_misfit.reshape(-1)[unit_index(n).reshape(-1)])
    outlier_ratio = _worst_misfit(misfit, levels.values, dark) * min(1.0, fit.unit_px / STAIN_UNIT_PX)
    damage = float(level_residual.max()) * outlier_ratio
    level_residual *= max(1.0, _blur_units(fit) * MAX_LEVEL_RESIDUAL / MAX_RESIDUAL_SPREAD)
    return UnitEvidence(
        cell_costs=costs - costs.min(axis=1, keepdims=True),
        best=np.argmin(costs, axis=1),
        dark=dark > 0.5,
        disputed=(first != dark).reshape(-1, 4).any(axis=1),
        level_residual=np.where(_odd_light_cells(light, dark, n), 1.0, level_residual),
        damage=damage,
        outlier_ratio=outlier_ratio,
        weight=weight,
        residual=residual,
        contrast=contrast,
        scatter=scatter / len(residual),
        gap=(fit.gap - float(veil.light.mean())) / veil.level,
        span=levels.light - levels.dark,
        veils=(veil,),
        risk_log_odds=_risk_log_odds(level_residual, cell_misfits(fit)),
    )


def cell_misfits(fit: PlateFit) -> Array:
    """Residual of the pixels of each cell's worst unit over the median of all units, shape (cells,)."""
    misfit = np.sqrt(fit.unit_misfit.reshape(-1)[unit_index(fit.units.shape[0]).reshape(-1)])
    worst: Array = (misfit / max(_median(misfit), 1e-9)).reshape(-1, 4).max(axis=1)
    return worst


def _risk_log_odds(level_residual: Array, misfit_ratio: Array) -> Array:
    """Log odds that damage or a cover hides what was built in each cell, shape (cells,).

    Parameters
    ----------
    level_residual, misfit_ratio : ndarray, shape (cells,)
        As of `UnitEvidence`, and as `cell_misfits`.
    """
    by_level = RISK_OF_LEVEL * np.log(np.abs(level_residual) + RISK_FLOOR)
    risk: Array = RISK_CONSTANT + by_level + RISK_OF_MISFIT * np.log(np.maximum(misfit_ratio, 1.0))
    return risk


def with_hidden_markers(evidence: UnitEvidence, tints: Array, n: int) -> UnitEvidence:
    """Evidence in which cells beside a marker without its colour are likely to be covered too.

    Parameters
    ----------
    tints : ndarray, shape (4,)
        As of `MarkerColours`.
    n : int
        Units along a side.
    """
    risk = evidence.risk_log_odds + RISK_BESIDE_HIDDEN * hidden_beside(tints, n)
    return replace(evidence, risk_log_odds=risk)


def hidden_beside(tints: Array, n: int) -> Array:
    """Probability that each cell lies beside a marker that is hidden, shape (cells,); arguments as above."""
    hidden = 1 / (1 + np.exp(np.clip((tints - HIDDEN_TINT) / HIDDEN_TINT_SPREAD, -30, 30)))
    beside: Array = (hidden * _beside_markers(n)).max(axis=1)
    return beside


@lru_cache
def _beside_markers(n: int) -> npt.NDArray[np.bool_]:
    """Whether each cell has a side in common with each marker, shape (cells, 4), markers clockwise."""
    flat = unit_index(n).reshape(-1)
    middles = np.stack([flat % n, flat // n], axis=1).reshape(-1, 4, 2).mean(axis=1)
    markers = np.array([(0.5, 0.5), (n - 1.5, 0.5), (n - 1.5, n - 1.5), (0.5, n - 1.5)])
    found: npt.NDArray[np.bool_] = np.abs(middles[:, None] - markers[None]).sum(axis=2) < 2.5
    return found


def light_levels(fit: PlateFit) -> LightLevels | None:
    """Light of the units and of the darkest and lightest of them; None when these differ by little more than noise."""
    n = fit.units.shape[0]
    order = _shape_order(n)
    values = fit.units.reshape(-1)[unit_index(n).reshape(-1)]
    covariance = fit.units_covariance[np.ix_(order, order)]
    ranked = np.sort(values)
    tail = max(int(len(values) * TAIL_SHARE), 1)
    dark, light = float(ranked[:tail].mean()), float(ranked[-tail:].mean())
    noise = math.sqrt(_median(np.diag(covariance)))
    if light - dark < MIN_LEVEL_NOISE_RATIO * noise or light < MIN_LIGHT:
        return None
    return LightLevels(values, covariance, dark, light)


def _blur_units(fit: PlateFit) -> float:
    """Standard deviation of lens and motion blur together. [units]"""
    return math.hypot(fit.blur_px / fit.unit_px, fit.motion * len(fit.units) / math.sqrt(12))


def _resolution_weight(fit: PlateFit) -> float:
    """Factor on the likelihoods of units that are small or blurred, where the blur's form, which is not known, matters.

    Units of few pixels, a lens out of focus, motion over more than a unit, units seen through each other.
    """
    sharp_px = fit.unit_px / max(fit.blur_px, USUAL_BLUR_PX) * USUAL_BLUR_PX
    weight = min(1.0, (sharp_px / FULL_WEIGHT_PX) ** 4) * min(1.0, (2 * USUAL_BLUR_PX / fit.blur_px) ** 2)
    weight *= min(1.0, 1 / max(fit.motion * len(fit.units), 1e-9)) ** 2
    return weight * min(1.0, MAX_BLUR_UNITS / _blur_units(fit)) ** 2


def _worst_misfit(misfit: Array, values: Array, dark: Array) -> float:
    """Largest residual of a unit's pixels over the median residual of its level.

    Residuals that are small against the contrast do not count; on light units less, as stains make dark ones.
    """
    light = dark < 0.5
    if min(light.sum(), len(dark) - light.sum()) < MIN_OF_A_LEVEL:
        return float(misfit.max() / max(_median(misfit), 1e-9))
    usual = np.where(light, _median(misfit[light]), _median(misfit[~light]))
    contrast = _median(values[light]) - _median(values[~light])
    counts = misfit > np.where(light, STAIN_LIGHT, STAIN_DARK) * contrast
    return float((misfit / np.maximum(usual, 1e-9))[counts].max(initial=0.0))


def _odd_light_cells(light: Array, dark: Array, n: int) -> npt.NDArray[np.bool_]:
    """Cells of one level whose light differs from that around: a stain over a whole cell looks like a shadow."""
    around = _units_around(n)
    patches = np.zeros(len(around), dtype=bool)
    in_cell = dark.reshape(-1, 4).sum(axis=1)
    for cell in np.flatnonzero((in_cell == 0) | (in_cell == 4)):
        ratio = _median(light[4 * cell : 4 * cell + 4]) / _median(light[around[cell]])
        patches[cell] = not CELL_LIGHT_RANGE[0] < ratio < CELL_LIGHT_RANGE[1]
    return patches


@lru_cache
def _units_around(n: int) -> npt.NDArray[np.bool_]:
    """Units around each cell, in symbol order, shape (cells, units)."""
    flat = unit_index(n).reshape(-1)
    position = np.stack([flat // n, flat % n], axis=1)
    middles = position.reshape(-1, 4, 2).mean(axis=1)
    away = np.abs(position[None] - middles[:, None]).max(axis=2)
    found: npt.NDArray[np.bool_] = (away > 1) & (away < 4)
    return found


def _median(values: Array) -> float:
    """Median of a few values: `np.median` takes ten times as long for them."""
    ranked = np.sort(values)
    middle = len(ranked) // 2
    return float(ranked[middle]) if len(ranked) % 2 else float(ranked[middle - 1] + ranked[middle]) / 2


def level_residuals(levelled: Array, dark: Array, contrast: float) -> Array:
    """Distance of units from the median of their level towards the other one, as a share of the contrast."""
    distance = np.zeros(len(levelled))
    for level, towards in ((dark < 0.5, -1.0), (dark > 0.5, 1.0)):
        if level.any():
            distance[level] = towards * (levelled[level] - _median(levelled[level])) / contrast
    return distance


def _estimate_illumination(values: Array, covariance: Array, light_level: float, n: int) -> tuple[Array, Array]:
    """Light on each unit relative to the brightest level, and which units are dark, from the values' logarithms."""
    floor = LOG_FLOOR * light_level
    lifted = np.maximum(values, -0.6 * floor) + floor
    logs = np.log(lifted)
    slope = 1 / np.maximum(lifted, 2 * floor)
    smooth = _smooth(n, LIGHT_SPREAD)
    total = smooth + covariance * np.outer(slope, slope)
    total[np.diag_indices_from(total)] += WEAR**2
    weight = invert(total)
    dark = (lifted < 0.6 * 0.5 * (light_level + 2 * floor)).astype(float)
    residual, _ = minimize_pattern(weight, logs - logs.mean(), dark, CONTRAST, CONTRAST_SPREAD)
    illumination: Array = np.exp(smooth @ (weight @ residual) + logs.mean())
    return illumination, dark


def _level_difference(values: Array, dark: Array) -> float:
    """Difference of the levels of light and dark units; an assumed one while one of them is missing."""
    if 0 < dark.sum() < len(dark):
        return max(float(values[dark < 0.5].mean() - values[dark > 0.5].mean()), MIN_LEVEL_DIFFERENCE)
    return ONE_LEVEL_DIFFERENCE


def code_units(code: PlateCode) -> npt.NDArray[np.bool_]:
    """Dark units of a code in the order of the symbols' units, shape (units,)."""
    dark: npt.NDArray[np.bool_] = code.units.reshape(-1)[unit_index(code.n).reshape(-1)] > 0
    return dark


def pattern_cost(evidence: UnitEvidence, code: PlateCode) -> float:
    """Cost of a code above the best pattern of all units."""
    dark = code_units(code).astype(float)
    delta = evidence.contrast * (dark - evidence.dark)
    return float(delta @ evidence.weight @ (2 * evidence.residual + delta))


# === The units of a fitted plate verified by its pixels: light, paint and stains as competing explanations.
#
# The light on the plate is a Gaussian process, so that the edge of a shadow is no damage. For each unit the pixels
# around it are compared under these hypotheses, with the light integrated out: the unit as it was read, or flipped,
# that is dark instead of light or light instead of dark; clean, under a smooth stain, or flipped under a spot of paint
# that hides it. Whether the plate has stains at all follows from all of its units.


UNIT_PX = 4.5
"""[px] size of a unit in the patch, where the image has more. Source: trials with 3.0, which has more wrong readings of
stained plates."""
REACH_PITCHES = 1.25
"""[pitches] from a unit's centre within which its pixels are compared: the unit, the gaps around it and half of its
neighbours. For speed."""
INNER_SHARE = 0.7
"""[unit] part of a unit's half side within which lies what the pixels around it see of it."""
MAX_ROAD_SHARE, MIN_SHARE = 0.05, 0.9
"""[1] share of the road in a pixel up to which it is compared, and of all shapes from which on."""
ALBEDO = (0.01, 1.3)
"""[white] least and greatest reflectance of a part to begin with."""
MIN_BLUR_MM = 2.0
"""[mm] width of the edge of a spot of paint at least."""
NODES = 4
"""Quadrature nodes on each side of the middle at most, as the fit has."""
WHITE_SPREAD, SPREAD_FACTOR, DARK_SHARE_OF_SPREAD = (0.03, 0.09), 2.0, 0.55
"""[white, 1, 1] least and greatest standard deviation of light units' own reflectances, the same over
`UnitEvidence.spread`, and that of dark units over it: where units are even, a spot of paint stands out. Source: plates
under painted stains (decision record 0011)."""
VEIL_ERROR = 0.05
"""[light level] standard deviation of the error of a veil of glare. With none, 51 of 100 frames in glare are read in
place of 52 (decision record 0011)."""
SPOTS_MM = ((17, 17, 0), (22, 22, 0), (30, 30, 0), (26, 17, 0), (17, 26, 0), (28, 20, 45), (28, 20, 135))
"""[mm, mm, deg] half axes and turns of the spots of paint; each lies at nine places around the unit's centre. Smaller
ones leave a part of the unit in view."""
PAINTS, OPACITIES = np.array([0.03, 0.1, 0.2, 0.35, 0.6, 0.85, 1.0, 1.15]), np.array([1.0, 0.8])
"""[white, 1] reflectances and opacities of the spots."""


def verify_units(
    image: npt.NDArray[np.uint8],
    fit: PlateFit,
    geometry: PlateGeometry,
    dark: npt.NDArray[np.bool_],
    units: UnitEvidence,
) -> UnitVerification | None:
    """Verify a pattern of units by the pixels.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3)
        The frame.
    fit : PlateFit
        Of the plate in it.
    dark : ndarray of bool, shape (units,)
        The pattern, in the order of the symbols' units.
    units : UnitEvidence
        Of the fit: the explanations of its light, and how much its units differ.

    Returns
    -------
    UnitVerification or None
        None where the plate has too few pixels.
    """
    pixels = _cut(image, fit, geometry)
    if pixels is None:
        return None
    first = _likelihoods(pixels, fit, geometry, dark, units.veils[0], units.spread)
    found, log_odds = UnitVerification(first), units.veil_log_odds
    if len(units.veils) == 1 or found.error_probability > MAX_FIRST_ERROR:
        return found
    other = _likelihoods(pixels, fit, geometry, dark, units.veils[1], units.spread)
    return UnitVerification(np.logaddexp(first - np.logaddexp(0.0, -log_odds), other - np.logaddexp(0.0, log_odds)))


def _likelihoods(
    seen: PlatePixels,
    fit: PlateFit,
    geometry: PlateGeometry,
    dark: npt.NDArray[np.bool_],
    veil: Veil,
    unit_spread: float,
) -> Array:
    """Log likelihoods of the hypotheses about each unit under a veil, shape (units, 5)."""
    pixels, paints = _unveiled(seen, fit, geometry, veil)
    pattern = dark.astype(float)
    parts = np.column_stack([pixels.units @ pattern, pixels.rest])
    white = pixels.units @ (1 - pattern)
    field = fit_light(pixels, white, parts, paints, geometry.side_mm)
    likelihoods = np.empty((len(dark), 5))
    white_spread = min(max(SPREAD_FACTOR * unit_spread, WHITE_SPREAD[0]), WHITE_SPREAD[1])
    set_unit_likelihoods(
        pixels,
        PlatePattern(
            pattern, white + parts @ field.albedo, float(field.albedo[0]),
            white_spread, DARK_SHARE_OF_SPREAD * white_spread, _centres_mm(geometry),
            REACH_PITCHES * geometry.pitch_mm, INNER_SHARE * geometry.unit_mm / 2,
        ),
        LightPrior(
            field.light, field.noise, field.spread, LIGHT_LENGTH_MM, LEVEL_VARIANCE,
            0.0 if veil.is_even else (VEIL_ERROR * veil.level) ** 2, VEIL_LENGTH * geometry.side_mm / 8,
        ),
        Spots(_spot_shapes(geometry.pitch_mm), PAINTS, OPACITIES),
        likelihoods,
    )  # fmt: skip
    return likelihoods


def _cut(image: npt.NDArray[np.uint8], fit: PlateFit, geometry: PlateGeometry) -> PlatePixels | None:
    """The pixels on the plate as the camera sees them; None where it has too few."""
    n, side_mm = geometry.n, geometry.side_mm
    patch = cut_patch(image, fit.corners_px, n * UNIT_PX, linear=False)
    if patch is None:
        return None
    shapes = len(fit.model.values)
    shares, places = np.empty((*patch.light.shape, shapes)), np.empty((*patch.light.shape, 2))
    set_pixel_shares(patch, fit.model, NODES, shares, places)
    in_symbols, size = unit_shapes(n).reshape(-1)[unit_index(n).reshape(-1)], patch.light.size
    listed, units, rest = np.empty(size, np.int64), np.empty((size, len(in_symbols))), np.empty((size, 1 + FIRST_GAP))
    count = gather_shares(shares.reshape(size, -1), in_symbols, MIN_SHARE, MAX_ROAD_SHARE, listed, units, rest)
    if count < MIN_PIXELS * n:
        return None
    used = listed[:count]
    weights: Array = patch.weights.reshape(-1)[used]
    right, down = np.diff(fit.corners_px[:3], axis=0)
    mm_per_px = side_mm / math.sqrt(max(abs(float(right[0] * down[1] - right[1] * down[0])), 1.0))
    blur_px = math.sqrt(fit.blur_px**2 + patch.grid[2] * patch.grid[3] / 12)
    return PlatePixels(
        patch.light.reshape(-1)[used].astype(float),
        weights / float(weights.mean()),
        units[:count],
        rest[:count],
        places.reshape(size, 2)[used] * side_mm,
        math.nan,  # known once a veil is taken off
        max(mm_per_px * blur_px, MIN_BLUR_MM),
    )


def _unveiled(seen: PlatePixels, fit: PlateFit, geometry: PlateGeometry, veil: Veil) -> tuple[PlatePixels, Array]:
    """The pixels without a veil, and the reflectances of the plate's parts to begin with."""
    n = geometry.n
    across, along = (seen.places_mm.T / geometry.side_mm * n - 0.5).astype(np.float32)
    veiled = cv2.remap(veil.light.astype(np.float32), across, along, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    pixels = seen._replace(light=seen.light - np.asarray(veiled, float).reshape(-1), level=veil.level)
    at_cells = veil.light.reshape(n // 2, 2, n // 2, 2).mean(axis=(1, 3))
    markers = fit.markers - at_cells[[0, 0, 0, -1, -1], [0, 0, -1, -1, 0]]
    first = np.array([DARK_SHARE * veil.level, fit.gap - float(veil.light.mean()), *markers])
    return pixels, np.clip(first / veil.level, *ALBEDO)


@lru_cache
def _centres_mm(geometry: PlateGeometry) -> Array:
    """Centres of the units, in the order of the symbols' units, shape (units, 2). [mm]"""
    middle = unit_edges(geometry).mean(axis=1) * geometry.side_mm
    flat = unit_index(geometry.n).reshape(-1)
    return np.stack([middle[flat % geometry.n], middle[flat // geometry.n]], axis=1)


@lru_cache
def _spot_shapes(pitch_mm: float) -> Floats32:
    """Centre [mm], inverse shape xx, xy, yy [1/mm2] and mean radius [mm] of the spots, shape (6, spots)."""
    found = []
    for long_mm, short_mm, turn_deg in SPOTS_MM:
        cosine, sine = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
        axes = np.array([[cosine, sine], [-sine, cosine]])
        form = axes.T @ np.diag([long_mm**-2, short_mm**-2]) @ axes
        radius_mm = math.sqrt(long_mm * short_mm)
        for x in (-pitch_mm / 3, 0.0, pitch_mm / 3):
            for y in (-pitch_mm / 3, 0.0, pitch_mm / 3):
                found.append((x, y, form[0, 0], form[0, 1], form[1, 1], radius_mm))
    return np.ascontiguousarray(np.array(found, np.float32).T)
