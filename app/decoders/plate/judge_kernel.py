"""Log likelihoods of the pixels around each unit, under each hypothesis about it.

The light of pixel i is l a_i (1 + g_i) + e_i: the mean light l around the unit, the reflectance a_i that the pixel
sees, a Gaussian process g of the light, and errors e of the pixels and of the units' paint. All is normal, so the light
is integrated out: the likelihood is that of a normal distribution with mean l a and a full covariance.
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
"""[pixels] around a unit below which it is not judged: both of its values are as likely. Source: chosen by hand."""
MIN_UNIT_SHARE, MOST_UNITS = 0.003, 9
"""[1, units] share of a unit in a pixel below which it is left out, and units of a pixel at most. Source: by hand."""
EDGE_SLOPE = 1.702
"""[1] slope of the logistic function that is nearest to the normal distribution's."""
MAX_EXPONENT = 40.0
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


class UnitHypotheses(NamedTuple):
    """What the pixels are compared with.

    Attributes
    ----------
    dark : ndarray, shape (units,)
        1 for the dark units of the pattern, 0 for the light ones.
    seen : ndarray, shape (P,)
        Reflectance that each pixel sees of the pattern; white is 1.
    dark_albedo : float
        Reflectance of dark units.
    field, noise : ndarray, shape (P,)
        Light on each pixel, and variance of its error.
    spread : float
        Standard deviation of the light, relative.
    centres_mm : ndarray, shape (units, 2)
    reach_mm, inner_mm : float
        Around a unit's centre, within which pixels are compared, and within which lies what pixels see of it.
    spots : ndarray, shape (spots, 6)
        Centre around the unit's, inverse shape xx, xy, yy, mean radius. [mm]
    paints, opacities : ndarray
    """

    dark: Floats
    seen: Floats
    dark_albedo: float
    field: Floats
    noise: Floats
    spread: float
    centres_mm: Floats
    reach_mm: float
    inner_mm: float
    spots: Floats
    paints: Floats
    opacities: Floats


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
    cover: float = 1.0 / (1.0 + math.exp(min(max(-inside, -MAX_EXPONENT), MAX_EXPONENT)))
    return cover


@step
def _list_units(units: Floats, listed: Ints, lengths: Ints) -> None:
    """The units that each pixel sees."""
    for p in range(units.shape[0]):
        lengths[p] = 0
        for u in range(units.shape[1]):
            if units[p, u] > MIN_UNIT_SHARE and lengths[p] < MOST_UNITS:
                listed[p, lengths[p]] = u
                lengths[p] += 1


@kernel
def set_unit_likelihoods(
    pixels: PlatePixels, given: UnitHypotheses, light_length_mm: float, level_variance: float, likelihoods: Floats
) -> None:
    """Set the log likelihoods of the pixels around each unit, up to a constant.

    Parameters
    ----------
    pixels : PlatePixels
    given : UnitHypotheses
    light_length_mm, level_variance : float
        Distance over which the correlation of the light falls to 1/e [mm], and the variance of its mean, relative.
    likelihoods : ndarray, shape (units, 5)
        Set to those of the unit as in the pattern, the other way round, the same two under a smooth stain, and the
        other way round under a spot of paint, on average over the spots.
    """
    units, places_mm = pixels.units, pixels.places_mm
    count = units.shape[1]
    listed = np.empty((units.shape[0], MOST_UNITS), np.int64)
    lengths = np.empty(units.shape[0], np.int64)
    _list_units(units, listed, lengths)
    near = np.empty(units.shape[0], np.int64)
    most = 0
    for u in range(count):
        size = 0
        for p in range(units.shape[0]):
            if _distance2(places_mm, p, given.centres_mm[u, 0], given.centres_mm[u, 1]) < given.reach_mm**2:
                size += 1
        most = max(most, size)
    covariance = np.empty((4, most, most))
    residual = np.empty((5, most))
    covered = np.empty(most)
    hidden = np.empty(most)
    for u in range(count):
        x_mm = given.centres_mm[u, 0]
        y_mm = given.centres_mm[u, 1]
        size = 0
        light = 0.0
        for p in range(units.shape[0]):
            if _distance2(places_mm, p, x_mm, y_mm) < given.reach_mm**2:
                near[size] = p
                light += given.field[p]
                size += 1
        if size < MIN_PIXELS:
            likelihoods[u] = 0.0
            continue
        light /= size
        is_dark = given.dark[u] > 0.5
        change = (1.0 - given.dark_albedo) if is_dark else (given.dark_albedo - 1.0)
        own = WHITE_SPREAD * WHITE_SPREAD - DARK_SPREAD * DARK_SPREAD
        if not is_dark:
            own = -own
        for i in range(size):
            p = near[i]
            as_read = given.seen[p]
            flipped = as_read + change * units[p, u]
            reach = math.exp(-_distance2(places_mm, p, x_mm, y_mm) / (2.0 * STAIN_REACH_MM * STAIN_REACH_MM))
            for j in range(i + 1):
                q = near[j]
                apart2 = _distance2(places_mm, p, places_mm[q, 0], places_mm[q, 1])
                smooth = given.spread * given.spread * math.exp(-math.sqrt(apart2) / light_length_mm) + level_variance
                paint = 0.0
                for k in range(lengths[p]):
                    other = listed[p, k]
                    spread = DARK_SPREAD if given.dark[other] > 0.5 else WHITE_SPREAD
                    paint += spread * spread * units[p, other] * units[q, other]
                stain = (
                    STAIN_SPREAD
                    * STAIN_SPREAD
                    * reach
                    * math.exp(
                        -apart2 / (2.0 * STAIN_LENGTH_MM * STAIN_LENGTH_MM)
                        - _distance2(places_mm, q, x_mm, y_mm) / (2.0 * STAIN_REACH_MM * STAIN_REACH_MM)
                    )
                )
                other_flipped = given.seen[q] + change * units[q, u]
                read_term = smooth * as_read * given.seen[q] + paint
                flip_term = smooth * flipped * other_flipped + paint + own * units[p, u] * units[q, u]
                scale = light * light
                covariance[0, i, j] = scale * read_term
                covariance[1, i, j] = scale * flip_term
                covariance[2, i, j] = scale * (read_term + stain)
                covariance[3, i, j] = scale * (flip_term + stain)
            for h in range(4):
                covariance[h, i, i] += given.noise[p]
            residual[0, i] = pixels.light[p] - light * as_read
            residual[1, i] = pixels.light[p] - light * flipped
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
        # a spot that hides a unit looks like what was read, so its light varies like that of the unit as read
        base = covariance[0]
        rest = residual[4]
        _substitute(base, rest, size)
        square = _dot(rest, rest, size)
        top = -1e300
        total = 0.0
        for g in range(given.spots.shape[0]):
            for i in range(size):
                p = near[i]
                share = units[p, u]
                x = places_mm[p, 0] - x_mm
                y = places_mm[p, 1] - y_mm
                around = _cover(given.spots[g], x, y, pixels.blur_mm)
                # what a pixel beside the unit sees of it is the part that is nearest
                inner = given.inner_mm
                on_unit = _cover(given.spots[g], min(max(x, -inner), inner), min(max(y, -inner), inner), pixels.blur_mm)
                unit_albedo = 1.0 if is_dark else given.dark_albedo
                others = given.seen[p] + change * share - share * unit_albedo
                covered[i] = light * ((1.0 - share) * around + share * on_unit)
                hidden[i] = light * (around * others + on_unit * share * unit_albedo)
            _substitute(base, covered, size)
            _substitute(base, hidden, size)
            by_cover = _dot(rest, covered, size)
            by_hidden = _dot(rest, hidden, size)
            cover2 = _dot(covered, covered, size)
            both = _dot(covered, hidden, size)
            hidden2 = _dot(hidden, hidden, size)
            for o in given.opacities:
                for b in given.paints:
                    left = (
                        square
                        + o * o * (b * b * cover2 - 2.0 * b * both + hidden2)
                        - 2.0 * o * (b * by_cover - by_hidden)
                    )
                    value = -0.5 * left
                    if value > top:
                        total = total * math.exp(max(top - value, -700.0)) + 1.0
                        top = value
                    else:
                        total += math.exp(max(value - top, -700.0))
        number = given.spots.shape[0] * given.paints.shape[0] * given.opacities.shape[0]
        likelihoods[u, 4] = top + math.log(total / number) - half_determinant
