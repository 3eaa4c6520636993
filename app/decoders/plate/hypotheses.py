"""Log likelihoods of the pixels around each unit, under each hypothesis about it.

The light of pixel i is l a_i (1 + g_i) + v_i + e_i: the mean light l around the unit, the reflectance a_i that the
pixel sees, a Gaussian process g of the light, another one v of what is left of a veil of glare, and errors e of the
pixels and of the units' paint. All is normal, so the light is integrated out: the likelihood is that of a normal
distribution with mean l a and a full covariance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from app.decoders.compiled import kernel, routine, step
from app.decoders.plate.profiles import Floats, Ints

WHITE_SPREAD, DARK_SPREAD = 0.09, 0.05
"""[white] standard deviations of the reflectances of light and of dark units, each unit's own. Source: by hand."""
STAIN_LENGTH_MM, STAIN_REACH_MM, STAIN_SPREAD = 12.0, 27.0, 0.45
"""[mm, mm, 1] length over which a smooth stain changes, how far around the unit's centre it reaches, and its standard
deviation relative to the light. Source: chosen by hand."""
MIN_PIXELS = 4
"""[pixels] around a unit below which nothing is compared: both of its values are as likely. Source: chosen by hand."""
MIN_UNIT_SHARE, MOST_UNITS = 0.003, 9
"""[1, units] share of a unit in a pixel below which it is left out, and units of a pixel at most. Source: by hand."""
EDGE_SLOPE = 1.702
"""[1] slope of the logistic function that is nearest to the normal distribution's."""
MAX_EXPONENT = 15.0
"""[1] beyond which a logistic function is 0 or 1. Source: chosen by hand."""


class PlatePixels(NamedTuple):
    """The pixels on a plate.

    Attributes
    ----------
    light : ndarray, shape (P,)
        Without the haze. [linear, 1 = saturation]
    weight : ndarray, shape (P,)
        Of the squared error, 1 on average.
    units : ndarray, shape (P, units)
        Share of each unit in each pixel, in the order of the symbols' units.
    rest : ndarray, shape (P, 6)
        Shares of the gaps, the triangle, the other half of its cell and the three squares.
    places_mm : ndarray, shape (P, 2)
    level : float
        Light of the lightest units without the haze.
    blur_mm : float
        Standard deviation of the blur on the plate. [mm]
    """

    light: Floats
    weight: Floats
    units: Floats
    rest: Floats
    places_mm: Floats
    level: float
    blur_mm: float


class PlatePattern(NamedTuple):
    """The pattern that is verified, and its units.

    Attributes
    ----------
    dark : ndarray, shape (units,)
        1 for the dark units of the pattern, 0 for the light ones.
    seen : ndarray, shape (P,)
        Reflectance that each pixel sees of the pattern; white is 1.
    dark_albedo : float
        Reflectance of dark units.
    centres_mm : ndarray, shape (units, 2)
    reach_mm, inner_mm : float
        Around a unit's centre, within which pixels are compared, and within which lies what pixels see of it.
    """

    dark: Floats
    seen: Floats
    dark_albedo: float
    centres_mm: Floats
    reach_mm: float
    inner_mm: float


class LightPrior(NamedTuple):
    """Light on the plate before the pixels around a unit are compared.

    Attributes
    ----------
    field, noise : ndarray, shape (P,)
        Light on each pixel, and variance of its error.
    spread : float
        Standard deviation of the light, relative.
    length_mm, level_variance : float
        Distance over which the correlation of the light falls to 1/e, and the variance of its mean, relative.
    veil_variance, veil_length_mm : float
        Variance of the error of light that the plate does not send, and length over which that changes.
    """

    field: Floats
    noise: Floats
    spread: float
    length_mm: float
    level_variance: float
    veil_variance: float = 0.0
    veil_length_mm: float = 1.0


class Spots(NamedTuple):
    """Spots of paint that may hide a unit.

    Attributes
    ----------
    shapes : ndarray, shape (spots, 6)
        Centre around the unit's, inverse shape xx, xy, yy, mean radius. [mm]
    paints, opacities : ndarray
        Reflectances [white] and shares of the light that the paint hides.
    """

    shapes: Floats
    paints: Floats
    opacities: Floats


class ShownUnits(NamedTuple):
    """The units that each pixel sees: their numbers, shape (P, 9), and how many they are, shape (P,)."""

    listed: Ints
    lengths: Ints


class Around(NamedTuple):
    """The pixels around one unit.

    Attributes
    ----------
    unit : int
    pixels : ndarray of int, shape (size,)
    light : float
        Mean of the light on them.
    change : float
        What its other value adds to the unit's reflectance.
    own : float
        What its other value adds to the variance of the unit's reflectance.
    """

    unit: int
    pixels: Ints
    light: float
    change: float
    own: float


@routine
def _dot(x: Floats, y: Floats, size: int) -> float:
    total = 0.0
    for k in range(size):
        total += x[k] * y[k]
    return total


@routine
def _factorize(matrix: Floats, size: int) -> float:
    """Replace the lower triangle by its Cholesky factor; returns half the logarithm of the determinant."""
    total = 0.0
    for i in range(size):
        for j in range(i):
            matrix[i, j] = (matrix[i, j] - _dot(matrix[i], matrix[j], j)) / matrix[j, j]
        matrix[i, i] = math.sqrt(max(matrix[i, i] - _dot(matrix[i], matrix[i], i), 1e-12))
        total += math.log(matrix[i, i])
    return total


@routine
def _substitute(factor: Floats, values: Floats, size: int) -> None:
    """Forward substitution in place."""
    for i in range(size):
        values[i] = (values[i] - _dot(factor[i], values, i)) / factor[i, i]


@step
def _distance2(places_mm: Floats, p: int, x_mm: float, y_mm: float) -> float:
    right: float = places_mm[p, 0] - x_mm
    down: float = places_mm[p, 1] - y_mm
    return right * right + down * down


@step
def _cover(spot: Floats, x_mm: float, y_mm: float, blur_mm: float) -> float:
    """Share of a blurred point beside a unit's centre that a spot covers."""
    x = x_mm - spot[0]
    y = y_mm - spot[1]
    radius = math.sqrt(spot[2] * x * x + 2.0 * spot[3] * x * y + spot[4] * y * y)
    inside = EDGE_SLOPE * (1.0 - radius) * spot[5] / blur_mm
    cover = 1.0 if inside > 0.0 else 0.0
    if abs(inside) < MAX_EXPONENT:
        cover = 1.0 / (1.0 + math.exp(-inside))
    return cover


@step
def _list_units(units: Floats) -> ShownUnits:
    """The units that each pixel sees."""
    shown = ShownUnits(np.empty((units.shape[0], MOST_UNITS), np.int64), np.zeros(units.shape[0], np.int64))
    for p in range(units.shape[0]):
        for u in range(units.shape[1]):
            if units[p, u] > MIN_UNIT_SHARE and shown.lengths[p] < MOST_UNITS:
                shown.listed[p, shown.lengths[p]] = u
                shown.lengths[p] += 1
    return shown


@routine
def _find_around(pixels: PlatePixels, pattern: PlatePattern, field: Floats, unit: int) -> Around:
    x_mm, y_mm = pattern.centres_mm[unit, 0], pattern.centres_mm[unit, 1]
    near = np.empty(pixels.places_mm.shape[0], np.int64)
    size = 0
    light = 0.0
    for p in range(pixels.places_mm.shape[0]):
        if _distance2(pixels.places_mm, p, x_mm, y_mm) < pattern.reach_mm**2:
            near[size] = p
            light += field[p]
            size += 1
    sign = 1.0 if pattern.dark[unit] > 0.5 else -1.0
    own = sign * (WHITE_SPREAD * WHITE_SPREAD - DARK_SPREAD * DARK_SPREAD)
    return Around(unit, near[:size].copy(), light / max(size, 1), sign * (1.0 - pattern.dark_albedo), own)


@step
def _set_covariances(
    pixels: PlatePixels, pattern: PlatePattern, light: LightPrior, shown: ShownUnits, around: Around, covariance: Floats
) -> None:
    """Set the lower triangles of the covariances of the unit as read, flipped, and the two under a smooth stain."""
    units, places_mm, unit = pixels.units, pixels.places_mm, around.unit
    x_mm, y_mm = pattern.centres_mm[unit, 0], pattern.centres_mm[unit, 1]
    scale = around.light * around.light
    for i in range(around.pixels.size):
        p = around.pixels[i]
        as_read = pattern.seen[p]
        flipped = as_read + around.change * units[p, unit]
        from_unit2 = _distance2(places_mm, p, x_mm, y_mm)
        for j in range(i + 1):
            q = around.pixels[j]
            apart2 = _distance2(places_mm, p, places_mm[q, 0], places_mm[q, 1])
            smooth = light.spread * light.spread * math.exp(-math.sqrt(apart2) / light.length_mm) + light.level_variance
            paint = 0.0
            veil = 0.0
            if light.veil_variance > 0.0:
                veil = light.veil_variance * math.exp(-0.5 * apart2 / (light.veil_length_mm * light.veil_length_mm))
            for k in range(shown.lengths[p]):
                other = shown.listed[p, k]
                spread = DARK_SPREAD if pattern.dark[other] > 0.5 else WHITE_SPREAD
                paint += spread * spread * units[p, other] * units[q, other]
            reach2 = (from_unit2 + _distance2(places_mm, q, x_mm, y_mm)) / (STAIN_REACH_MM * STAIN_REACH_MM)
            length2 = apart2 / (STAIN_LENGTH_MM * STAIN_LENGTH_MM)
            stain = STAIN_SPREAD * STAIN_SPREAD * math.exp(-0.5 * (reach2 + length2))
            other_flipped = pattern.seen[q] + around.change * units[q, unit]
            read_term = smooth * as_read * pattern.seen[q] + paint
            flip_term = smooth * flipped * other_flipped + paint + around.own * units[p, unit] * units[q, unit]
            covariance[0, i, j] = scale * read_term + veil
            covariance[1, i, j] = scale * flip_term + veil
            covariance[2, i, j] = scale * (read_term + stain) + veil
            covariance[3, i, j] = scale * (flip_term + stain) + veil
        for h in range(4):
            covariance[h, i, i] += light.noise[p]


@routine
def _set_covered(
    pixels: PlatePixels, pattern: PlatePattern, around: Around, spots: Floats, covered: Floats, hidden: Floats
) -> None:
    """Set the light that each white spot would send to each pixel, and the light of what it hides, a column a spot."""
    unit = around.unit
    unit_albedo = 1.0 if pattern.dark[unit] > 0.5 else pattern.dark_albedo  # of the unit flipped
    inner = pattern.inner_mm
    for i in range(around.pixels.size):
        p = around.pixels[i]
        share = pixels.units[p, unit]
        x = pixels.places_mm[p, 0] - pattern.centres_mm[unit, 0]
        y = pixels.places_mm[p, 1] - pattern.centres_mm[unit, 1]
        # what a pixel beside the unit sees of it is the part that is nearest
        nearest_x = min(max(x, -inner), inner)
        nearest_y = min(max(y, -inner), inner)
        shows_elsewhere = share > MIN_UNIT_SHARE and (nearest_x != x or nearest_y != y)
        others = pattern.seen[p] + around.change * share - share * unit_albedo
        for g in range(spots.shape[0]):
            beside = _cover(spots[g], x, y, pixels.blur_mm)
            on_unit = beside
            if shows_elsewhere:
                on_unit = _cover(spots[g], nearest_x, nearest_y, pixels.blur_mm)
            covered[i, g] = around.light * ((1.0 - share) * beside + share * on_unit)
            hidden[i, g] = around.light * (beside * others + on_unit * share * unit_albedo)


@routine
def _substitute_columns(factor: Floats, columns: Floats, size: int) -> None:
    """Forward substitution of all columns in place."""
    for i in range(size):
        row = columns[i]
        j = 0
        while j + 4 <= i:  # four rows at a time, so that the row is loaded and stored a fourth as often
            a, b, c, d = factor[i, j], factor[i, j + 1], factor[i, j + 2], factor[i, j + 3]
            for k in range(row.size):
                row[k] -= a * columns[j, k] + b * columns[j + 1, k] + c * columns[j + 2, k] + d * columns[j + 3, k]
            j += 4
        while j < i:
            for k in range(row.size):
                row[k] -= factor[i, j] * columns[j, k]
            j += 1
        scale = 1.0 / factor[i, i]
        for k in range(row.size):
            row[k] *= scale


@step
def _spot_likelihood(
    pixels: PlatePixels, pattern: PlatePattern, around: Around, spots: Spots, factor: Floats, residual: Floats
) -> float:
    """Mean likelihood of the spots, as a logarithm without the determinant.

    `factor` is that of the unit as read: a spot that hides a unit looks like what was read, so its light varies alike.
    """
    size, count = around.pixels.size, spots.shapes.shape[0]
    covered = np.empty((size, count))
    hidden = np.empty((size, count))
    _substitute(factor, residual, size)
    square = _dot(residual, residual, size)
    _set_covered(pixels, pattern, around, spots.shapes, covered, hidden)
    _substitute_columns(factor, covered, size)
    _substitute_columns(factor, hidden, size)
    sums = np.zeros((5, count))
    for i in range(size):
        for g in range(count):
            sums[0, g] += residual[i] * covered[i, g]
            sums[1, g] += residual[i] * hidden[i, g]
            sums[2, g] += covered[i, g] * covered[i, g]
            sums[3, g] += covered[i, g] * hidden[i, g]
            sums[4, g] += hidden[i, g] * hidden[i, g]
    top = -1e300
    total = 0.0
    for g in range(count):
        by_cover, by_hidden, cover2, both, hidden2 = sums[0, g], sums[1, g], sums[2, g], sums[3, g], sums[4, g]
        for o in spots.opacities:
            for b in spots.paints:
                added = o * o * (b * b * cover2 - 2.0 * b * both + hidden2) - 2.0 * o * (b * by_cover - by_hidden)
                value = -0.5 * (square + added)
                if value > top:
                    total = total * math.exp(max(top - value, -700.0)) + 1.0
                    top = value
                else:
                    total += math.exp(max(value - top, -700.0))
    return top + math.log(total / (count * spots.paints.shape[0] * spots.opacities.shape[0]))


@kernel
def set_unit_likelihoods(
    pixels: PlatePixels, pattern: PlatePattern, light: LightPrior, spots: Spots, likelihoods: Floats
) -> None:
    """Set the log likelihoods of the pixels around each unit, up to a constant.

    Parameters
    ----------
    pixels : PlatePixels
    pattern : PlatePattern
    light : LightPrior
    spots : Spots
    likelihoods : ndarray, shape (units, 5)
        Set to those of the unit as in the pattern, flipped, the same two under a smooth stain, and flipped under a spot
        of paint, on average over the spots.
    """
    shown = _list_units(pixels.units)
    for u in range(pixels.units.shape[1]):
        around = _find_around(pixels, pattern, light.field, u)
        size = around.pixels.size
        if size < MIN_PIXELS:
            likelihoods[u] = 0.0
            continue
        covariance = np.empty((4, size, size))
        _set_covariances(pixels, pattern, light, shown, around, covariance)
        residual = np.empty((5, size))
        for i in range(size):
            p = around.pixels[i]
            residual[0, i] = pixels.light[p] - around.light * pattern.seen[p]
            residual[1, i] = residual[0, i] - around.light * around.change * pixels.units[p, u]
            residual[2, i] = residual[0, i]
            residual[3, i] = residual[1, i]
            residual[4, i] = residual[1, i]
        half_determinant = 0.0
        for h in range(4):
            half = _factorize(covariance[h], size)
            _substitute(covariance[h], residual[h], size)
            likelihoods[u, h] = -0.5 * _dot(residual[h], residual[h], size) - half
            if h == 0:
                half_determinant = half
        spotted = _spot_likelihood(pixels, pattern, around, spots, covariance[0], residual[4])
        likelihoods[u, 4] = spotted - half_determinant
