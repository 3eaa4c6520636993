"""The light on a plate, as a Gaussian process that is linear between knots, and the reflectances of the plate's parts.

The edge of a shadow, leaves and glare are light, not damage. White is 1; light and reflectances are solved in turns.
The process conditions each knot on those near it among the knots before it (Vecchia 1988, doi:10.1111/j.2517-6161.1988.
tb01729.x), so that its inverse covariance is banded and a solution takes a tenth of a millisecond in place of two.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import kernel, loop, step
from app.decoders.plate import Array
from app.decoders.plate.hypotheses import PlatePixels
from app.decoders.plate.normal_equations import factorize, invert, solve_factorized, substitute
from app.decoders.plate.unit_patterns import minimize_pattern
from app.markers.plate import unit_index
from app.values import Floats, Ints

KNOT_MM = 20.0
"""[mm] distance of the knots between which the light is linear."""
LIGHT_LENGTH_MM, LEVEL_VARIANCE = 120.0, 0.25
"""[mm, 1] distance over which the correlation of the light falls to 1/e, and the variance of its mean, relative."""
LIGHT_SPREAD, SPREAD_FACTOR = (0.15, 0.45), 1.6
"""[1] least and greatest standard deviation of the light over a plate, relative, and the factor on that of the fitted
light."""
MODEL_ERROR = 0.04
"""[1] error of the model relative to the light. Source: trials; the squared residuals over the variance are then 0.4 to
1 in shade, and up to 1.6 under stains."""
EDGE_ERROR = 0.03
"""[white] error of the model where reflectances meet, whose blur is not known to less."""
FIRST_NOISE = 0.03
"""[light] noise that the first of the rounds assumes."""
ROUNDS = 3
"""Rounds of the light and the reflectances in turn."""
MIN_LIGHT = 0.02
"""[level] light on any pixel at least."""
MAX_ALBEDO = 1.4
"""[white] greatest reflectance of a part."""
NEAR_KNOTS = 3
"""[knots] rows and columns within which the knots before one are those near it. Source: the field then differs from
that of the whole covariance by less than 0.4 % of the light on 13 plates in shade."""
ROWS = 4
"""[rows] of a factor that are subtracted at a time. Source: trials with 4 and 8."""
NORMAL_SPREAD = 1.4826
"""[1] standard deviation of a normal distribution over the median of its absolute values."""
MIN_ERROR = 1e-4
"""[light] error of a pixel at least."""
ALBEDO_WEIGHT = 0.05
"""[pixels] that the first reflectances count as."""


class LightField(NamedTuple):
    """The light on a plate and what it was fitted with."""

    # `light`, `noise`: shape (P,): light on each pixel, and the variance of its error
    light: Array
    noise: Array
    albedo: Array  # shape (parts,): reflectances of the parts; white is 1
    spread: float  # standard deviation of the light, relative


class Knots(NamedTuple):
    """The knots of the light."""

    along: int  # knots along a side
    side_mm: float  # [mm] of the plate
    # shape (K, band + ROWS): inverse of the correlation of the light at all knots: row i holds the entries of the
    # columns i to i + band, and zeros
    precision: Floats


class _Field(NamedTuple):
    """What is fitted, changed in place: light and noise of each pixel, reflectance that it sees; those of the parts."""

    light: Floats
    noise: Floats
    seen: Floats
    albedo: Floats


def fit_light(pixels: PlatePixels, white: Array, parts: Array, albedo: Array, side_mm: float) -> LightField:
    """Light on each pixel and reflectances of the parts.

    Parameters
    ----------
    white : ndarray, shape (P,)
        Share of the white units in each pixel.
    parts : ndarray, shape (P, parts)
        Shares of the parts whose reflectance is fitted.
    albedo : ndarray, shape (parts,)
        Their reflectances to begin with.
    side_mm : float
        Side of the plate. [mm]
    """
    size = len(white)
    field = _Field(np.full(size, pixels.level), np.empty(size), np.empty(size), np.array(albedo, float))
    spread = _fit_field(pixels, white, np.ascontiguousarray(parts), _knots(side_mm), field)
    return LightField(field.light, field.noise, field.albedo, spread)


@lru_cache
def _knots(side_mm: float) -> Knots:
    """Knots over a plate, and the inverse correlation of the light at them."""
    count = math.ceil(side_mm / KNOT_MM) + 1
    along = np.linspace(0.0, side_mm, count)
    places = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    correlation = np.exp(-np.linalg.norm(places[:, None] - places[None], axis=2) / LIGHT_LENGTH_MM)
    band, size = NEAR_KNOTS * count + NEAR_KNOTS, count * count
    conditional = np.eye(size)  # rows: a knot less what is expected of it by those near it, over its deviation
    for i in range(size):
        before = np.arange(max(i - band, 0), i)
        near = before[
            (np.abs(before // count - i // count) <= NEAR_KNOTS) & (np.abs(before % count - i % count) <= NEAR_KNOTS)
        ]
        factors = np.linalg.solve(correlation[np.ix_(near, near)], correlation[near, i])
        conditional[i, near] = -factors
        conditional[i] /= math.sqrt(1.0 - float(factors @ correlation[near, i]))
    whole = conditional.T @ conditional
    precision = np.zeros((size, band + ROWS))
    for offset in range(band + 1):
        precision[: size - offset, offset] = np.diagonal(whole, offset)
    return Knots(count, side_mm, precision)


@step
def _set_seen(white: Floats, parts: Floats, field: _Field) -> None:
    """Set the reflectance that each pixel sees."""
    for p in range(white.size):
        total = white[p]
        for k in range(parts.shape[1]):
            total += parts[p, k] * field.albedo[k]
        field.seen[p] = total


@loop
def _set_noise(pixels: PlatePixels, sigma: float, field: _Field) -> None:
    """Set the variance of the error of each pixel."""
    for p in range(pixels.light.size):
        model = MODEL_ERROR * MODEL_ERROR * field.seen[p] * field.seen[p] + EDGE_ERROR * EDGE_ERROR
        field.noise[p] = sigma * sigma / pixels.weight[p] + model * field.light[p] * field.light[p]


@loop
def _factorize_band(matrix: Floats, band: int) -> None:
    """Replace the band of a symmetric matrix, stored as `Knots.precision`, by that of its transposed Cholesky factor.

    Rows are subtracted four at a time (`normal_equations.factorize`): the columns beyond the band are
    zeros, so that the four may reach to where the last one ends.
    """
    size, width = matrix.shape
    flat = matrix.reshape(-1)
    for i in range(size):
        row = np.uint64(i * width)
        j = max(i - band, 0)
        while j + ROWS <= i:
            p, q = np.uint64(j * width + i - j), np.uint64((j + 1) * width + i - j - 1)
            r, s = np.uint64((j + 2) * width + i - j - 2), np.uint64((j + 3) * width + i - j - 3)
            a, b, c, d = flat[p], flat[q], flat[r], flat[s]
            for column in range(j + band + ROWS - i):
                k = np.uint64(column)
                flat[row + k] -= a * flat[p + k] + b * flat[q + k] + c * flat[r + k] + d * flat[s + k]
            j += ROWS
        while j < i:
            p = np.uint64(j * width + i - j)
            a = flat[p]
            for column in range(j + band + 1 - i):
                k = np.uint64(column)
                flat[row + k] -= a * flat[p + k]
            j += 1
        scale = 1.0 / math.sqrt(max(flat[row], 1e-300))
        for column in range(band + 1):
            flat[row + np.uint64(column)] *= scale


@loop
def _solve_band(factor: Floats, band: int, values: Floats) -> None:
    """Replace the right side of a system by its solution."""
    size = factor.shape[0]
    for i in range(size):
        values[i] /= factor[i, 0]
        value = values[i]
        for k in range(1, min(band, size - 1 - i) + 1):
            values[np.uint64(i + k)] -= factor[i, np.uint64(k)] * value
    for i in range(size - 1, -1, -1):
        total = values[i]
        for k in range(1, min(band, size - 1 - i) + 1):
            total -= factor[i, np.uint64(k)] * values[np.uint64(i + k)]
        values[i] = total / factor[i, 0]


@step
def _fit_knots(pixels: PlatePixels, knots: Knots, spread: float, field: _Field) -> None:
    """Set the light for the present reflectances and noise.

    The shift of the knots from the mean light is that of their mean, m, and a field s. With the weights W of the knots
    in what the pixels see, A = W' N^-1 W and b = W' N^-1 r, and Q the inverse covariance of s:
    (Q + A) s + A 1 m = b, and 1' A s + (1' A 1 + 1 / var m) m = 1' b.
    """
    level = pixels.level
    size, band = knots.precision.shape[0], knots.precision.shape[1] - ROWS
    matrix = knots.precision / (level * level * spread * spread)
    shift = np.zeros(size)  # b, then s
    by_mean = np.zeros(size)  # A 1, then its solution
    near = np.empty(4, np.int64)
    weights = np.empty(4)
    for p in range(field.seen.size):
        _set_knots(pixels.places_mm, p, knots, near, weights)
        inverse = field.seen[p] / field.noise[p]
        residual = pixels.light[p] - field.seen[p] * level
        for a in range(4):
            i = near[a]
            weight = weights[a] * inverse
            shift[i] += weight * residual
            by_mean[i] += weight * field.seen[p]
            for b in range(a, 4):
                matrix[i, near[b] - i] += weight * weights[b] * field.seen[p]
    _factorize_band(matrix, band)
    information = by_mean.copy()
    moment = shift.sum()
    _solve_band(matrix, band, shift)
    _solve_band(matrix, band, by_mean)
    mean_weight = information.sum() + 1.0 / (level * level * LEVEL_VARIANCE)
    mean = (moment - np.dot(information, shift)) / (mean_weight - np.dot(information, by_mean))
    for p in range(field.light.size):
        _set_knots(pixels.places_mm, p, knots, near, weights)
        total = level + mean
        for a in range(4):
            total += weights[a] * (shift[near[a]] - mean * by_mean[near[a]])
        field.light[p] = max(total, MIN_LIGHT * level)


@loop
def _set_knots(places_mm: Floats, p: int, knots: Knots, near: Ints, weights: Floats) -> None:
    """Set the four knots around a pixel, in ascending order, and their weights."""
    count = knots.along
    x = min(max(places_mm[p, 0] / knots.side_mm, 0.0), 1.0) * (count - 1)
    y = min(max(places_mm[p, 1] / knots.side_mm, 0.0), 1.0) * (count - 1)
    column = min(int(x), count - 2)
    row = min(int(y), count - 2)
    right = x - column
    down = y - row
    first = row * count + column
    near[0], near[1], near[2], near[3] = first, first + 1, first + count, first + count + 1
    weights[0], weights[1] = (1.0 - right) * (1.0 - down), right * (1.0 - down)
    weights[2], weights[3] = (1.0 - right) * down, right * down


@step
def _fit_albedo(pixels: PlatePixels, white: Floats, parts: Floats, field: _Field) -> None:
    """Set the reflectances of the parts for the present light."""
    count = parts.shape[1]
    ridge = ALBEDO_WEIGHT * np.median(1.0 / field.noise) * pixels.level * pixels.level
    matrix = np.zeros((count, count))
    right = np.zeros(count)
    for k in range(count):
        matrix[k, k] = ridge
        right[k] = ridge * field.albedo[k]
    for p in range(white.size):
        light = field.light[p]
        scale = light / field.noise[p]
        residual = pixels.light[p] - white[p] * light
        for i in range(count):
            weight = parts[p, i] * scale
            right[i] += weight * residual
            for j in range(i + 1):
                matrix[i, j] += weight * light * parts[p, j]
    factor = factorize(matrix)
    if factor.shape[0] == count:
        solution = solve_factorized(factor, substitute(factor, right), -1e300)
        for k in range(count):
            field.albedo[k] = min(max(solution[k], 0.0), MAX_ALBEDO)


@kernel
def _fit_field(pixels: PlatePixels, white: Floats, parts: Floats, knots: Knots, field: _Field) -> float:
    """Fit light and reflectances in turns; returns the standard deviation of the light, relative."""
    spread = LIGHT_SPREAD[1]
    sigma = FIRST_NOISE * pixels.level
    errors = np.empty(white.size)
    _set_seen(white, parts, field)
    for _ in range(ROUNDS):
        _set_noise(pixels, sigma, field)
        _fit_knots(pixels, knots, spread, field)
        _fit_albedo(pixels, white, parts, field)
        _set_seen(white, parts, field)
        for p in range(white.size):
            errors[p] = abs(pixels.light[p] - field.seen[p] * field.light[p]) * math.sqrt(pixels.weight[p])
        sigma = max(NORMAL_SPREAD * np.median(errors), MIN_ERROR)
        spread = min(max(SPREAD_FACTOR * field.light.std() / field.light.mean(), LIGHT_SPREAD[0]), LIGHT_SPREAD[1])
    _set_noise(pixels, sigma, field)
    return spread


# === Light in the image of a plate that the plate does not send: haze over all of it, a veil of glare over a part.
#
# Shade divides the light of the units, glare adds to it. Both are Gaussian processes over the units, and so are the two
# explanations of a plate's units: uneven light and even haze, or a veil besides. Their marginal likelihoods say which
# holds. A veil is smooth over several units, so it is no explanation of a spot of paint.


DARK_SHARE = 0.12
"""[light level] light of dark units without haze: what they have beyond it is taken for haze. The simulated plates
(`simulation.plate_face.draw_look`) have 0.02 to 0.2."""
VEIL_LENGTH = 2.0
"""[units of 8] length over which a veil changes: 80 mm, several units, where spots of paint have 8 to 30 mm. Source:
the standard deviation of the simulated glare is 50 to 500 mm (`simulation.conditions`)."""
VEIL_SPREADS = (0.1, 0.3)
"""[light level] standard deviations of a veil, each as likely. Source: the simulated glare adds 0.05 to 0.35."""
LIGHT_SPREADS, LIGHT_LENGTH = (0.1, 0.25, 0.5), 4.0
"""[1, units of 8] standard deviations of uneven light, relative, each as likely, and distance over which its
correlation falls to 1/e. Source: fair light, shade and deep shade."""
LEVEL_SPREAD, HAZE_SPREAD = 0.5, 0.3
"""[1, light level] standard deviations of the light and of the haze over the whole plate, which leave both open."""
LIGHT_WEAR, DARK_WEAR = 0.09, 0.05
"""[light level] standard deviations of what light and dark units differ by themselves. Source: as
`unit_likelihoods.WHITE_SPREAD`."""
VEIL_PRIOR = 0.05
"""[probability] of a veil."""
SEARCH_SPREAD, SEARCH_WEAR = 0.3, 0.12
"""[span] standard deviations of the veil and of what units differ by themselves, while the pattern under a veil is
searched."""
CONTRAST, CONTRAST_SPREAD = 0.85, 0.25
"""[span] expected difference of light and dark units, and its standard deviation: glare adds to the light of the
lightest."""


class Veil(NamedTuple):
    """Light that the plate does not send."""

    light: Array  # shape (n, n): on each unit and marker. [linear, 1 = saturation]
    level: float  # light of light units without it. [linear, 1 = saturation]

    @property
    def is_even(self) -> bool:
        """Whether it is the same everywhere: haze, not glare."""
        return bool(np.ptp(self.light) == 0)


def uniform_haze(dark: float, light: float, n: int) -> Veil:
    """The veil that is the same everywhere, from the light of the darkest and the lightest units."""
    haze = max(0.0, (dark - DARK_SHARE * light) / (1 - DARK_SHARE))
    return Veil(np.full((n, n), haze), light - haze)


def estimate_veil(values: Array, covariance: Array, span: float, n: int) -> tuple[Veil, npt.NDArray[np.bool_]]:
    """The veil that changes over the plate, and the pattern of dark units under it.

    Parameters
    ----------
    values : ndarray, shape (units,)
        Light of the units in the order of the symbols' units.
    covariance : ndarray, shape (units, units)
        Of their errors.
    span : float
        Light of the lightest units above the darkest ones.
    n : int
        Units along a side.
    """
    order = unit_index(n).reshape(-1)
    by_grid = span**2 * (SEARCH_SPREAD**2 * _correlations(n).veil + 4.0)
    total = by_grid[order] + covariance
    total[np.diag_indices_from(total)] += (SEARCH_WEAR * span) ** 2
    mean = float(values.mean())
    # a unit is dark to begin with where it is darker than the units around it are on average
    around = total.copy()
    around[np.diag_indices_from(around)] += (CONTRAST * span / 2) ** 2
    dark = (values - mean < by_grid[order] @ np.linalg.solve(around, values - mean)).astype(float)
    weight = invert(total)
    residual, contrast = minimize_pattern(weight, values - mean, dark, CONTRAST * span, CONTRAST_SPREAD * span)
    level = contrast / (1 - DARK_SHARE)
    lightest = mean + by_grid @ (weight @ residual)
    return Veil(np.maximum(lightest - level, 0.0).reshape(n, n), level), dark > 0.5


def veil_log_odds(values: Array, covariance: Array, haze: Veil, patterns: list[Array], n: int) -> float:
    """Logarithm of the odds that there is a veil, by the marginal likelihoods of the units' light.

    Parameters
    ----------
    values, covariance : ndarray
        As in `estimate_veil`.
    haze : Veil
        The even one.
    patterns : list of ndarray of bool, shape (units,)
        Patterns of dark units that are likely under either explanation.
    n : int
        Units along a side.
    """
    order = unit_index(n).reshape(-1)
    even = [(light, 0.0) for light in LIGHT_SPREADS]
    veiled = [(LIGHT_SPREADS[0], veil) for veil in VEIL_SPREADS]
    found = _log_likelihoods(
        _UnitsLight(values, covariance, _correlations(n).light, _correlations(n).veil[order]),
        float(haze.light[0, 0]), haze.level, np.array(patterns, bool), np.array(even + veiled),
    )  # fmt: skip
    even_mean = np.logaddexp.reduce(found[:, : len(even)], axis=None) - math.log(len(even))
    veiled_mean = np.logaddexp.reduce(found[:, len(even) :], axis=None) - math.log(len(veiled))
    return float(veiled_mean - even_mean) + math.log(VEIL_PRIOR / (1 - VEIL_PRIOR))


class _UnitsLight(NamedTuple):
    """Light of the units, and what it varies by."""

    values: Floats  # shape (units,)
    covariance: Floats  # shape (units, units): of their errors
    light: Floats  # shape (units, units): correlation of the light
    veil: Floats  # shape (units, units): correlation of a veil


@kernel
def _log_likelihoods(
    units: _UnitsLight, haze: float, level: float, patterns: npt.NDArray[np.bool_], spreads: Floats
) -> Floats:
    """Of the units' light under each pattern of dark units, shape (patterns, spreads), without the constant.

    Parameters
    ----------
    haze, level : float
        Light that is the same everywhere, and that of light units above it.
    patterns : ndarray of bool, shape (patterns, units)
    spreads : ndarray, shape (S, 2)
        Standard deviations of the light, relative, and of the veil over the level.
    """
    size = units.values.size
    total = np.empty((size, size))
    residual = np.empty(size)
    found = np.empty((patterns.shape[0], spreads.shape[0]))
    level2 = level * level
    for p in range(patterns.shape[0]):
        dark = patterns[p]
        for s in range(spreads.shape[0]):
            light2, veil2 = spreads[s, 0] ** 2, spreads[s, 1] ** 2
            for i in range(size):
                seen = DARK_SHARE if dark[i] else 1.0
                residual[i] = units.values[i] - haze - level * seen
                for j in range(i + 1):
                    both = seen * (DARK_SHARE if dark[j] else 1.0)
                    varies = (light2 * units.light[i, j] + LEVEL_SPREAD**2) * both + HAZE_SPREAD**2
                    total[i, j] = level2 * (varies + veil2 * units.veil[i, j]) + units.covariance[i, j]
                wear = DARK_WEAR if dark[i] else LIGHT_WEAR
                total[i, i] += level2 * wear * wear
            factor = factorize(total)
            found[p, s] = -np.inf
            if factor.shape[0] == size:
                half = substitute(factor, residual)
                found[p, s] = -0.5 * np.dot(half, half)
                for i in range(size):
                    found[p, s] -= math.log(factor[i, i])
    return found


class _Correlations(NamedTuple):
    """Of the veil between all units and markers and the symbols' units, and of the light between the latter."""

    veil: Array
    light: Array


@lru_cache
def _correlations(n: int) -> _Correlations:
    grid = np.stack(np.divmod(np.arange(n * n), n), axis=1).astype(float) * (8 / n)
    units = grid[unit_index(n).reshape(-1)]
    apart = np.linalg.norm(grid[:, None] - units[None], axis=2)
    between = np.linalg.norm(units[:, None] - units[None], axis=2)
    return _Correlations(np.exp(-0.5 * (apart / VEIL_LENGTH) ** 2), np.exp(-between / LIGHT_LENGTH))
