"""Unit values -> evidence: which units are dark, what each symbol of a cell would cost, and what looks damaged.

The logarithm of a unit's light is a smooth illumination, minus one contrast where the unit is dark, plus noise whose
covariance the fit gives: neighbours that share pixels share their error. Illumination is a Gaussian process, so the
cost of any pattern of units is a quadratic form, and margins come from exact differences of it.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numba as nb
import numpy as np
import numpy.typing as npt

from app.decoders.plate.fit import PlateFit
from app.decoders.plate.linear import invert
from app.markers.plate import PlateCode, unit_index

Array = npt.NDArray[Any]

CONTRAST = 2.0  # of the logarithm after haze is taken off; its spread:
CONTRAST_SPREAD = 0.4
LIGHT_SPREAD = 0.45  # of the illumination's logarithm, over a few units
LIGHT_LENGTH = 4.0  # units
WEAR = 0.16  # what units differ by themselves
EVEN_SPREAD, EVEN_WEAR = 0.1, 0.1  # the same two of the light that has been evened out, as shares of it
FLOOR = 0.05  # of the light level
SCATTER_PRIOR = (8.0, 0.6)  # weight in units, expected scatter against the model
USUAL_BLUR_PX = 1.0
FULL_TRUST_PX = 1.4  # size of a unit in the image from which it is not believed less
MOST_SPREAD = 0.6  # standard deviation of lens and motion blur together [units], the same
FLAT_LIGHT = (0.65, 1.5)  # light on a cell of one level against that around, beyond which it may be a stain
STRAY = 0.23  # share of the contrast from which a unit is no sure reading, worn or stained
STRAY_CLEAR, CLEAR_UNIT_PX = 0.16, 3.0  # the same where a unit is so large that its own noise strays less
STRAY_SPREAD = 0.12  # stray times that spread [units], from which a unit is no sure reading
STAIN_UNIT_PX = 2.0  # damage counts less on units of fewer pixels, which say less
STAIN_DARK, STAIN_LIGHT = 0.07, 0.105  # share of the contrast from which a unit's residual may be a stain
LEAST_OF_A_LEVEL = 6  # light or dark units that say what is usual among them
_DARK_SHARE = 0.12


@dataclass(frozen=True, slots=True)
class UnitEvidence:
    """What a fit says about the symbols.

    Attributes
    ----------
    cell_costs : ndarray, shape (cells, 16)
        Cost of each symbol above the best pattern of all units, the other cells as in that pattern.
    best : ndarray of int, shape (cells,)
        Most likely symbols, any of sixteen.
    dark : ndarray of bool, shape (units,)
        The best pattern, in the order of the symbols' units.
    weight, residual : ndarray
        Quadratic form of the costs and its vector at the best pattern, for other patterns.
    contrast : float
        Between light and dark units, the light level being about 1.
    disputed : ndarray of bool, shape (cells,)
        Where the two classifiers differ.
    stray : ndarray, shape (cells,)
        Distance of each cell's worst unit from the level that it was given, as a share of the contrast; more counts
        on plates whose units are large, or so blurred that they run into each other.
    damage : float
        The largest stray times how far the residual of some unit's pixels stands out of the others'. A stain that
        turns a light unit dark ends beside it, on gaps and neighbours, and the plate has others that stop half way.
    scatter : float
        Mean cost of a unit's distance from its level; about 1 or less on a plate that follows the model.
    span : float
        Light of the light units above the dark ones. [linear, 1 = saturation]
    """

    cell_costs: Array
    best: npt.NDArray[np.intp]
    dark: npt.NDArray[np.bool_]
    disputed: npt.NDArray[np.bool_]
    stray: Array
    damage: float
    weight: Array
    residual: Array
    contrast: float
    scatter: float
    span: float

    @property
    def cell_margin(self) -> Array:
        """Cost of the second best symbol of each cell, shape (cells,)."""
        margin: Array = np.partition(self.cell_costs, 1, axis=1)[:, 1]
        return margin


@lru_cache
def _smooth(n: int, spread: float) -> Array:
    """Covariance of a smooth field between units, in symbol order; its mean is left open."""
    flat = unit_index(n).reshape(-1)
    position = np.stack([flat // n, flat % n], axis=1).astype(float)
    distance = np.linalg.norm(position[:, None] - position[None], axis=2)
    covariance: Array = spread**2 * np.exp(-distance / (LIGHT_LENGTH * n / 8)) + 4.0
    return covariance


@lru_cache
def _slot_order(n: int) -> npt.NDArray[np.intp]:
    """Where each symbol's units stand among the fitted units."""
    corner = np.zeros((n, n), dtype=bool)
    corner[np.ix_([0, 1, n - 2, n - 1], [0, 1, n - 2, n - 1])] = True
    slot = np.cumsum(~corner.reshape(-1)) - 1
    return slot[unit_index(n).reshape(-1)]


_PATTERNS = np.array(list(itertools.product((0, 1), repeat=4)), dtype=float)  # row k holds the bits of k


def weigh_units(fit: PlateFit) -> UnitEvidence | None:
    """Costs of all symbols; None when the units do not differ by more than their noise, or show one level only.

    Two classifiers in turn: the first on logarithms, where any illumination is a sum, gives the light that falls on
    each unit; the second on the light so evened out, where the noise is even.
    """
    n = fit.units.shape[0]
    order = _slot_order(n)
    values = fit.units.reshape(-1)[unit_index(n).reshape(-1)]
    covariance = fit.units_covariance[np.ix_(order, order)]
    ranked = np.sort(values)
    tail = max(len(values) // 8, 1)
    dark_level, light_level = float(ranked[:tail].mean()), float(ranked[-tail:].mean())
    noise = math.sqrt(float(np.median(np.diag(covariance))))
    if light_level - dark_level < 4 * noise or light_level < 1e-4:
        return None
    haze = max(0.0, (dark_level - _DARK_SHARE * light_level) / (1 - _DARK_SHARE))
    light, first = _even_light(values - haze, covariance, light_level - haze, n)
    even = (values - haze) / light
    total = _smooth(n, EVEN_SPREAD) + covariance / np.outer(light, light)
    total[np.diag_indices_from(total)] += EVEN_WEAR**2
    weight = invert(total)
    dark = first.copy()
    step = _levels_apart(even, dark)
    residual, contrast = _settle(weight, even - even.mean(), dark, step, 0.3 * step)
    if dark.all() or not dark.any():
        return None  # with one level only, what looks like it may be anything even; all zeros would satisfy any check
    # how well this plate follows the model scales what a difference means
    scatter = float(residual @ weight @ residual)
    weight /= (scatter + SCATTER_PRIOR[0] * SCATTER_PRIOR[1]) / (len(residual) + SCATTER_PRIOR[0])
    resolved_px = fit.unit_px / max(fit.blur_px, USUAL_BLUR_PX) * USUAL_BLUR_PX
    weight *= min(1.0, (resolved_px / FULL_TRUST_PX) ** 4) * min(1.0, (2 * USUAL_BLUR_PX / fit.blur_px) ** 2)
    weight *= min(1.0, 1 / max(fit.motion * n, 1e-9)) ** 2  # smeared over more than a unit: the smear's form matters
    spread = math.hypot(fit.blur_px / fit.unit_px, fit.motion * n / math.sqrt(12))
    weight *= min(1.0, MOST_SPREAD / spread) ** 2  # units seen through each other: errors of the blur pass for units
    costs = _cell_costs(weight, residual, dark, contrast, _PATTERNS)
    best = np.argmin(costs, axis=1)
    disputed = (first != dark).reshape(-1, 4).any(axis=1)
    stray = _level_distance(even, dark, contrast).reshape(-1, 4).max(axis=1)
    if fit.unit_px >= CLEAR_UNIT_PX:
        stray *= STRAY / STRAY_CLEAR
    misfit = np.sqrt(fit.unit_misfit.reshape(-1)[unit_index(n).reshape(-1)])
    damage = float(stray.max()) * _worst_misfit(misfit, values, dark)
    damage *= min(1.0, fit.unit_px / STAIN_UNIT_PX)
    stray *= max(1.0, spread * STRAY / STRAY_SPREAD)
    stray = np.where(_flat_patches(light, dark, n), 1.0, stray)
    return UnitEvidence(
        costs - costs.min(axis=1, keepdims=True), best, dark > 0.5, disputed, stray, damage, weight, residual, contrast,
        scatter / len(residual), light_level - dark_level,
    )  # fmt: skip


def _worst_misfit(misfit: Array, values: Array, dark: Array) -> float:
    """Largest residual of a unit's pixels, as a multiple of what units of its level usually have.

    Residuals that are small against the contrast do not count; on light units less, as stains make dark ones.
    """
    light = dark < 0.5
    if min(light.sum(), len(dark) - light.sum()) < LEAST_OF_A_LEVEL:
        return float(misfit.max() / max(float(np.median(misfit)), 1e-9))
    usual = np.where(light, np.median(misfit[light]), np.median(misfit[~light]))
    contrast = float(np.median(values[light]) - np.median(values[~light]))
    counts = misfit > np.where(light, STAIN_LIGHT, STAIN_DARK) * contrast
    return float((misfit / np.maximum(usual, 1e-9))[counts].max(initial=0.0))


def _flat_patches(light: Array, dark: Array, n: int) -> npt.NDArray[np.bool_]:
    """Cells of one level whose light differs from that around: a stain over a whole cell looks like a shadow."""
    flat = unit_index(n)
    position = np.stack([flat.reshape(-1) // n, flat.reshape(-1) % n], axis=1)
    patches = np.zeros(len(flat), dtype=bool)
    for cell in range(len(flat)):
        own = slice(4 * cell, 4 * cell + 4)
        if 0 < dark[own].sum() < 4:
            continue
        away = np.abs(position - position[own].mean(axis=0)).max(axis=1)
        around = (away > 1) & (away < 4)
        ratio = float(np.median(light[own]) / np.median(light[around]))
        patches[cell] = not FLAT_LIGHT[0] < ratio < FLAT_LIGHT[1]
    return patches


def _level_distance(even: Array, dark: Array, contrast: float) -> Array:
    """How far units are from the middle of their level towards the other one, as a share of the contrast."""
    distance = np.zeros(len(even))
    for level, towards in ((dark < 0.5, -1.0), (dark > 0.5, 1.0)):
        if level.any():
            distance[level] = towards * (even[level] - np.median(even[level])) / contrast
    return distance


def _even_light(values: Array, covariance: Array, light_level: float, n: int) -> tuple[Array, Array]:
    """Light on each unit relative to the brightest level, and which units are dark, from the values' logarithms."""
    floor = FLOOR * light_level
    lifted = np.maximum(values, -0.6 * floor) + floor
    logs = np.log(lifted)
    slope = 1 / np.maximum(lifted, 2 * floor)
    smooth = _smooth(n, LIGHT_SPREAD)
    total = smooth + covariance * np.outer(slope, slope)
    total[np.diag_indices_from(total)] += WEAR**2
    weight = invert(total)
    dark = (lifted < 0.6 * 0.5 * (light_level + 2 * floor)).astype(float)
    residual, _ = _settle(weight, logs - logs.mean(), dark, CONTRAST, CONTRAST_SPREAD)
    illumination: Array = np.exp(smooth @ (weight @ residual) + logs.mean())
    return illumination, dark


def _levels_apart(values: Array, dark: Array) -> float:
    """Distance between the levels of light and dark units; 0.8 of the light level when one of them is missing."""
    if 0 < dark.sum() < len(dark):
        return max(float(values[dark < 0.5].mean() - values[dark > 0.5].mean()), 0.1)
    return 0.8


@nb.njit(cache=True, nogil=True)
def _best_flip(weight, slope, dark, contrast):  # type: ignore[no-untyped-def]
    """The unit whose flip lowers the cost most, or, when none does, the pair; -1 for none."""
    m = dark.shape[0]
    single = np.empty(m)
    best = -1e-9
    bi = -1
    bj = -1
    for i in range(m):
        d = contrast * (1.0 - 2.0 * dark[i])
        single[i] = 2.0 * d * slope[i] + d * d * weight[i, i]
        if single[i] < best:
            best = single[i]
            bi = i
    if bi >= 0:
        return bi, bj
    for i in range(m):
        if single[i] > 60.0:
            continue
        di = contrast * (1.0 - 2.0 * dark[i])
        for j in range(i):
            dj = contrast * (1.0 - 2.0 * dark[j])
            cost = single[i] + single[j] + 2.0 * di * dj * weight[i, j]
            if cost < best:
                best = cost
                bi = i
                bj = j
    return bi, bj


@nb.njit(cache=True, nogil=True)
def _settle(weight, logs, dark, prior, spread):  # type: ignore[no-untyped-def]
    """Flip units, alone and in pairs, while that lowers the cost; the contrast follows. `dark` changes in place."""
    m = logs.shape[0]
    contrast = prior
    residual = logs + contrast * dark
    for _ in range(12):
        wd = weight @ dark
        wl = weight @ logs
        down = 1.0 / (spread * spread)
        contrast = (prior * down - dark @ wl) / (down + dark @ wd)
        contrast = max(contrast, 0.25 * prior)
        residual = logs + contrast * dark
        slope = weight @ residual
        changed = False
        for _flip in range(2 * m):
            bi, bj = _best_flip(weight, slope, dark, contrast)
            if bi < 0:
                break
            changed = True
            for k in (bi, bj):
                if k < 0:
                    continue
                d = contrast * (1.0 - 2.0 * dark[k])
                dark[k] = 1.0 - dark[k]
                residual[k] += d
                slope += d * weight[:, k]
        if not changed:
            break
    return residual, contrast


@nb.njit(cache=True, nogil=True)
def _cell_costs(weight, residual, dark, contrast, patterns):  # type: ignore[no-untyped-def]
    cells = dark.shape[0] // 4
    costs = np.empty((cells, 16))
    slope = weight @ residual
    delta = np.empty(4)
    for c in range(cells):
        for p in range(16):
            total = 0.0
            for i in range(4):
                delta[i] = contrast * (patterns[p, i] - dark[4 * c + i])
                total += 2.0 * delta[i] * slope[4 * c + i]
            for i in range(4):
                for j in range(4):
                    total += delta[i] * delta[j] * weight[4 * c + i, 4 * c + j]
            costs[c, p] = total
    return costs


def pattern_cost(evidence: UnitEvidence, code: PlateCode) -> float:
    """Cost of a code above the best pattern of all units."""
    dark = code.units.reshape(-1)[unit_index(code.n).reshape(-1)].astype(float)
    delta = evidence.contrast * (dark - evidence.dark)
    return float(delta @ evidence.weight @ (2 * evidence.residual + delta))
