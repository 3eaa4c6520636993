"""Log likelihoods of the pixels around each unit, under each hypothesis about it.

The light of pixel i is l a_i (1 + g_i) + v_i + e_i: the mean light l around the unit, the reflectance a_i that the
pixel sees, a Gaussian process g of the light, another one v of what is left of a veil of glare, and errors e of the
pixels and of the units' paint. All is normal, so the light is integrated out: the likelihood is that of a normal
distribution with mean l a and a full covariance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from app.compiled import kernel, routine, step
from app.decoders.plate.normal_equations import subtract_rows
from app.decoders.plate.synthesis import PlatePatch
from app.values import Floats, Floats32, Ints

# === The image around a plate, in linear light and averaged to about two or three pixels a unit.


Frame = npt.NDArray[np.uint8]
Array = npt.NDArray[np.float64]

GAMMA = 2.2
"""[1] exponent from encoded values to linear light. Source: close to sRGB, IEC 61966-2-1, without its linear toe."""
MIN_STEP_PX = 1.25
"""[px] below which pixels are not averaged. Resampling by so little costs more than it saves."""
PATCH_PAD = 0.15
"""[extent of the plate's image] cut out around it, so that the corners may move."""
MIN_PATCH_EXTENT_PX = 3.0
"""[px] least width and height of a plate's image."""
MAX_TURNED = 1.5
"""[1] factor by which a turned plate's bounding box is cut finer: root of its area over the plate's."""
MIN_PATCH_PX = 4
"""[px] least side of an averaged patch."""
MIN_WEIGHT_LEVEL = 0.18
"""[encoded level] below which noise in the dark, not the gamma, sets a pixel's weight."""
_LEVELS = np.linspace(0.0, 1.0, 256)
_LIGHT = (_LEVELS**GAMMA).astype(np.float32)
_LINEAR = _LEVELS.astype(np.float32)
# weight of a pixel's squared error by its light: noise is even in grey levels, so light errs by the slope of the gamma
_WEIGHTS = ((GAMMA * np.maximum(_LEVELS ** (1 / GAMMA), MIN_WEIGHT_LEVEL) ** (GAMMA - 1)) ** -2.0).astype(np.float32)


def cut_patch(image: Frame, corners_px: Array, wanted_px: float, linear: bool) -> PlatePatch | None:
    """The image around a plate, averaged down to about this many pixels along its sides; None outside the image."""
    low, high = corners_px.min(axis=0), corners_px.max(axis=0)
    extent = high - low
    if not (extent > MIN_PATCH_EXTENT_PX).all() or not (extent < 2 * max(image.shape)).all():
        return None
    turned = math.sqrt(float(extent.prod()) / max(cv2.contourArea(corners_px.astype(np.float32)), 1.0))
    step = extent / (wanted_px * min(turned, MAX_TURNED))
    pad = PATCH_PAD * extent + 2 * step
    x0, y0 = (int(v) for v in np.maximum(low - pad, 0))
    x1, y1 = (int(v) for v in np.minimum(high + pad + 1, [image.shape[1], image.shape[0]]))
    wide, tall = ((far - near if s < MIN_STEP_PX else round((far - near) / s))
                  for near, far, s in ((x0, x1, step[0]), (y0, y1, step[1])))  # fmt: skip
    if min(wide, tall) < MIN_PATCH_PX:
        return None
    step = np.array([(x1 - x0) / wide, (y1 - y0) / tall])
    patch = image[y0:y1, x0:x1]
    luma = cv2.cvtColor(patch, cv2.COLOR_BGR2GRAY) if patch.ndim == 3 else np.ascontiguousarray(patch)
    light: Floats32 = np.asarray(cv2.LUT(luma, _LINEAR if linear else _LIGHT), np.float32)
    if (tall, wide) != light.shape:
        light = np.asarray(cv2.resize(light, (wide, tall), interpolation=cv2.INTER_AREA), np.float32)
    weights: Floats32 = np.ones_like(light) if linear else _WEIGHTS[(light * 255 + 0.5).astype(np.uint8)]
    grid = np.array([x0 + (step[0] - 1) / 2, y0 + (step[1] - 1) / 2, step[0], step[1]])
    return PlatePatch(light, weights, grid)


# === What the hypotheses about a plate's units are compared on: pixels, pattern, light and spots of paint.


class PlatePixels(NamedTuple):
    """The pixels on a plate."""

    light: Floats  # shape (P,): without the haze. [linear, 1 = saturation]
    weight: Floats  # shape (P,): of the squared error, 1 on average
    units: Floats  # shape (P, units): share of each unit in each pixel, in the order of the symbols' units
    rest: Floats  # shape (P, 6): shares of the gaps, the triangle, the other half of its cell and the three squares
    places_mm: Floats  # shape (P, 2)
    level: float  # light of the lightest units without the haze
    blur_mm: float  # [mm] standard deviation of the blur on the plate


class PlatePattern(NamedTuple):
    """The pattern that is verified, and its units."""

    dark: Floats  # shape (units,): 1 for the dark units of the pattern, 0 for the light ones
    seen: Floats  # shape (P,): reflectance that each pixel sees of the pattern; white is 1
    dark_albedo: float  # reflectance of dark units
    # `white_spread`, `dark_spread`: [white] standard deviations of the reflectances of light and of dark units, each
    # unit's own
    white_spread: float
    dark_spread: float
    centres_mm: Floats  # shape (units, 2)
    # `reach_mm`, `inner_mm`: around a unit's centre, within which pixels are compared, and within which lies what
    # pixels see of it
    reach_mm: float
    inner_mm: float


class LightPrior(NamedTuple):
    """Light on the plate before the pixels around a unit are compared."""

    # `field`, `noise`: shape (P,): light on each pixel, and variance of its error
    field: Floats
    noise: Floats
    spread: float  # standard deviation of the light, relative
    # `length_mm`, `level_variance`: distance over which the correlation of the light falls to 1/e, and the variance of
    # its mean, relative
    length_mm: float
    level_variance: float
    # `veil_variance`, `veil_length_mm`: variance of the error of light that the plate does not send, and length over
    # which that changes
    veil_variance: float = 0.0
    veil_length_mm: float = 1.0


class Spots(NamedTuple):
    """Spots of paint that may hide a unit."""

    shapes: Floats32  # shape (6, spots): [mm] centre around the unit's, inverse shape xx, xy, yy, mean radius
    # `paints`, `opacities`: reflectances [white] and shares of the light that the paint hides
    paints: Floats
    opacities: Floats


# === Log likelihoods of the pixels around each unit, under each hypothesis about it.


STAIN_LENGTH_MM, STAIN_REACH_MM, STAIN_SPREAD = 12.0, 27.0, 0.45
"""[mm, mm, 1] length over which a smooth stain changes, how far around the unit's centre it reaches, and its standard
deviation relative to the light."""
MIN_PIXELS = 4
"""[pixels] around a unit below which nothing is compared: both of its values are as likely."""
MIN_UNIT_SHARE, MOST_UNITS = 0.003, 9
"""[1, units] share of a unit in a pixel below which it is left out, and units of a pixel at most."""
EDGE_SLOPE = 1.702
"""[1] slope of the logistic function that is nearest to the normal distribution's."""
MAX_DECAY = np.float32(40.0)
"""[1] exponent beyond which an exponential counts as that of this."""
MIN_PIVOT = 1e-7
"""[1] square of a diagonal entry of a factor at least, relative to the light. Source: rounding of single precision."""


class ShownUnits(NamedTuple):
    """The units that each pixel sees: their numbers, shape (P, 9), and how many they are, shape (P,)."""

    listed: Ints
    lengths: Ints


class Around(NamedTuple):
    """The pixels around one unit."""

    unit: int
    pixels: Ints  # shape (size,)
    light: float  # mean of the light on them
    change: float  # what its other value adds to the unit's reflectance
    own: float  # what its other value adds to the variance of the unit's reflectance


@routine
def _factorize(matrix: Floats32) -> float:
    """Replace the upper triangle of the first columns by the transposed Cholesky factor, the others by forward
    substitution; returns half the logarithm of the determinant.
    """
    rows, columns = matrix.shape
    flat = matrix.reshape(-1)
    total = 0.0
    for i in range(rows):
        subtract_rows(flat, i, columns)
        row = np.uint64(i * columns + i)
        pivot = max(np.float64(flat[row]), MIN_PIVOT)
        total += math.log(pivot)
        scale = np.float32(1.0 / math.sqrt(pivot))
        for column in range(columns - i):
            flat[row + np.uint64(column)] *= scale
    return 0.5 * total


@routine
def _column_square(matrix: Floats32, column: int) -> float:
    """Sum of the squares of a column."""
    total = 0.0
    for i in range(matrix.shape[0]):
        total += np.float64(matrix[i, column]) * matrix[i, column]
    return total


@routine
def _exp_down(x: np.float32) -> np.float32:
    """exp(-x) for x of 0 to 40 to a relative 3e-5, without branches: a series at x / 256, squared eight times."""
    y = min(x, MAX_DECAY) * np.float32(-1.0 / 256.0)
    series = np.float32(1.0 / 2.0) + y * (np.float32(1.0 / 6.0) + y * np.float32(1.0 / 24.0))
    value = np.float32(1.0) + y * (np.float32(1.0) + y * series)
    value *= value
    value *= value
    value *= value
    value *= value
    value *= value
    value *= value
    value *= value
    value *= value
    return value


@step
def _distance2(places_mm: Floats, p: int, x_mm: float, y_mm: float) -> float:
    right: float = places_mm[p, 0] - x_mm
    down: float = places_mm[p, 1] - y_mm
    return right * right + down * down


@routine
def _set_cover(spots: Floats32, x_mm: np.float32, y_mm: np.float32, by_blur: np.float32, cover: Floats32) -> None:
    """Set the share of a blurred point beside a unit's centre that each spot covers; `spots` has a row a property."""
    one, zero = np.float32(1.0), np.float32(0.0)
    for spot in range(cover.size):
        g = np.uint64(spot)
        x = x_mm - spots[0, g]
        y = y_mm - spots[1, g]
        radius2 = spots[2, g] * x * x + np.float32(2.0) * spots[3, g] * x * y + spots[4, g] * y * y
        inside = (one - math.sqrt(max(radius2, zero))) * spots[5, g] * by_blur
        away = one / (one + _exp_down(abs(inside)))
        cover[g] = away if inside > zero else one - away


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
    own = sign * (pattern.white_spread * pattern.white_spread - pattern.dark_spread * pattern.dark_spread)
    return Around(unit, near[:size].copy(), light / max(size, 1), sign * (1.0 - pattern.dark_albedo), own)


class Local(NamedTuple):
    """The pixels around one unit, their light and covariances relative to the mean light."""

    # `x_mm`, `y_mm`: shape (size,): from the unit's centre
    x_mm: Floats32
    y_mm: Floats32
    # `seen`, `flipped`, `share`: shape (size,): reflectance that each pixel sees of the pattern, and with the unit
    # flipped; share of the unit
    seen: Floats32
    flipped: Floats32
    share: Floats32
    reach: Floats32  # shape (size,): what the distance from the unit takes off a smooth stain
    noise: Floats32  # shape (size,)
    units: Floats32  # shape (units, size): shares of all units
    paint: Floats32  # shape (size,): memory for a row of the paints' covariance


@step
def _look_around(
    pixels: PlatePixels, pattern: PlatePattern, light: LightPrior, by_unit: Floats, around: Around
) -> Local:
    """Gather what is known of the pixels around a unit, so that what follows runs over neighbours in memory."""
    size, unit = around.pixels.size, around.unit
    lists = np.empty((8, size), np.float32)
    local = Local(
        lists[0], lists[1], lists[2], lists[3], lists[4], lists[5], lists[6],
        np.empty((by_unit.shape[0], size), np.float32), lists[7],
    )  # fmt: skip
    for i in range(size):
        p = around.pixels[i]
        local.x_mm[i] = pixels.places_mm[p, 0] - pattern.centres_mm[unit, 0]
        local.y_mm[i] = pixels.places_mm[p, 1] - pattern.centres_mm[unit, 1]
        from_unit2 = local.x_mm[i] * local.x_mm[i] + local.y_mm[i] * local.y_mm[i]
        local.reach[i] = STAIN_SPREAD * math.exp(-0.5 * from_unit2 / (STAIN_REACH_MM * STAIN_REACH_MM))
        local.share[i] = by_unit[unit, p]
        local.seen[i] = pattern.seen[p]
        local.flipped[i] = pattern.seen[p] + around.change * by_unit[unit, p]
        local.noise[i] = light.noise[p] / (around.light * around.light)
    for u in range(by_unit.shape[0]):
        for i in range(size):
            local.units[u, i] = by_unit[u, around.pixels[i]]
    return local


@routine
def _set_paint(pattern: PlatePattern, shown: Ints, units: Floats32, i: int, paint: Floats32) -> None:
    """Set a row of the covariance that the units' own reflectances give, from pixel i on."""
    size = paint.size - i
    for k in range(size):
        paint[np.uint64(i + k)] = np.float32(0.0)
    for other in shown:
        spread = pattern.dark_spread if pattern.dark[other] > 0.5 else pattern.white_spread
        weight = np.float32(spread * spread) * units[other, i]
        for k in range(size):
            paint[np.uint64(i + k)] += weight * units[other, np.uint64(i + k)]


@routine
def _add_veil(variance: float, length_mm: float, local: Local, i: int) -> None:
    """Add what is left of a veil of glare to a row of the paints' covariance, from pixel i on."""
    x0, y0 = local.x_mm[i], local.y_mm[i]
    by_length, scale = np.float32(0.5 / (length_mm * length_mm)), np.float32(variance)
    for k in range(local.x_mm.size - i):
        j = np.uint64(i + k)
        right = local.x_mm[j] - x0
        down = local.y_mm[j] - y0
        local.paint[j] += scale * _exp_down((right * right + down * down) * by_length)


@routine
def _set_row(light: LightPrior, local: Local, own: float, i: int, read: Floats32, others: Floats32) -> None:
    """Set row i of the covariances of the unit as read, and of it flipped and both under a smooth stain."""
    x_mm, y_mm, seen, flipped = local.x_mm, local.y_mm, local.seen, local.flipped
    share, reach, paint = local.share, local.reach, local.paint
    x0, y0, seen0, flipped0, reach0 = x_mm[i], y_mm[i], seen[i], flipped[i], reach[i]
    own0 = np.float32(own) * share[i]
    variance, level_variance = np.float32(light.spread * light.spread), np.float32(light.level_variance)
    by_length = np.float32(1.0 / light.length_mm)
    by_stain = np.float32(0.5 / (STAIN_LENGTH_MM * STAIN_LENGTH_MM))
    for k in range(x_mm.size - i):
        j = np.uint64(i + k)
        right = x_mm[j] - x0
        down = y_mm[j] - y0
        apart2 = right * right + down * down
        smooth = variance * _exp_down(math.sqrt(apart2) * by_length) + level_variance
        stain = reach0 * reach[j] * _exp_down(apart2 * by_stain)
        read_term = smooth * seen0 * seen[j] + paint[j]
        flip_term = smooth * flipped0 * flipped[j] + paint[j] + own0 * share[j]
        read[i, j] = read_term
        others[0, i, j] = flip_term
        others[1, i, j] = read_term + stain
        others[2, i, j] = flip_term + stain
    read[i, i] += local.noise[i]
    for h in range(3):
        others[h, i, i] += local.noise[i]


@routine
def _set_covered(
    pattern: PlatePattern, blur_mm: float, unit: int, local: Local, spots: Floats32, first: int, columns: Floats32
) -> None:
    """Set the light that each white spot would send to each pixel, then that of what it hides, a column a spot."""
    count = spots.shape[1]
    beside = np.empty(count, np.float32)
    on_unit = np.empty(count, np.float32)
    unit_albedo = np.float32(1.0 if pattern.dark[unit] > 0.5 else pattern.dark_albedo)  # of the unit flipped
    inner, by_blur, one = np.float32(pattern.inner_mm), np.float32(EDGE_SLOPE / blur_mm), np.float32(1.0)
    covered, hidden = np.uint64(first), np.uint64(first + count)
    for i in range(local.x_mm.size):
        own = local.share[i]
        x = local.x_mm[i]
        y = local.y_mm[i]
        # what a pixel beside the unit sees of it is the part that is nearest
        nearest_x = min(max(x, -inner), inner)
        nearest_y = min(max(y, -inner), inner)
        others = local.flipped[i] - own * unit_albedo
        _set_cover(spots, x, y, by_blur, beside)
        if own > MIN_UNIT_SHARE and (nearest_x != x or nearest_y != y):
            _set_cover(spots, nearest_x, nearest_y, by_blur, on_unit)
        else:
            on_unit[:] = beside
        for spot in range(count):
            g = np.uint64(spot)
            columns[i, covered + g] = (one - own) * beside[g] + own * on_unit[g]
            columns[i, hidden + g] = beside[g] * others + on_unit[g] * own * unit_albedo


@step
def _spot_likelihood(spots: Spots, matrix: Floats32, first: int) -> float:
    """Mean likelihood of the spots, as a logarithm without the determinant.

    `matrix` is factorized with the covariance of the unit as read: a spot that hides a unit looks like what was read,
    so its light varies alike. From column `first` on: residual of the unit flipped, covered, hidden.
    """
    count = spots.shapes.shape[1]
    sums = np.zeros((5, count), np.float32)
    square = 0.0
    for i in range(matrix.shape[0]):
        residual = matrix[i, first]
        square += np.float64(residual) * residual
        for spot in range(count):
            k = np.uint64(spot)
            covered = matrix[i, np.uint64(first + 1) + k]
            hidden = matrix[i, np.uint64(first + 1 + count) + k]
            sums[0, k] += residual * covered
            sums[1, k] += residual * hidden
            sums[2, k] += covered * covered
            sums[3, k] += covered * hidden
            sums[4, k] += hidden * hidden
    top = -1e300
    total = 0.0
    for g in range(count):
        by_cover, by_hidden = np.float64(sums[0, g]), np.float64(sums[1, g])
        cover2, both, hidden2 = np.float64(sums[2, g]), np.float64(sums[3, g]), np.float64(sums[4, g])
        for o in spots.opacities:
            for b in spots.paints:
                added = o * o * (b * b * cover2 - 2.0 * b * both + hidden2) - 2.0 * o * (b * by_cover - by_hidden)
                value = -0.5 * (square + added)
                if value > top:
                    total = total * math.exp(max(top - value, -700.0)) + 1.0
                    top = value
                elif value > top - MAX_DECAY:
                    total += math.exp(value - top)
    return top + math.log(total / (count * spots.paints.shape[0] * spots.opacities.shape[0]))


@step
def _compare_unit(
    pixels: PlatePixels, pattern: PlatePattern, light: LightPrior, spots: Spots, by_unit: Floats, shown: ShownUnits,
    around: Around, likelihoods: Floats,
) -> None:  # fmt: skip
    """Set the log likelihoods of the pixels around one unit. All light is relative to the mean around it."""
    size, count = around.pixels.size, spots.shapes.shape[1]
    local = _look_around(pixels, pattern, light, by_unit, around)
    as_read = np.empty((size, size + 2 + 2 * count), np.float32)
    others = np.empty((3, size, size + 1), np.float32)
    for i in range(size):
        p = around.pixels[i]
        _set_paint(pattern, shown.listed[p, : shown.lengths[p]], local.units, i, local.paint)
        if light.veil_variance > 0.0:
            _add_veil(light.veil_variance / (around.light * around.light), light.veil_length_mm, local, i)
        _set_row(light, local, around.own, i, as_read, others)
        level = pixels.light[p] / around.light
        as_read[i, size] = level - local.seen[i]
        as_read[i, size + 1] = level - local.flipped[i]
        others[0, i, size] = level - local.flipped[i]
        others[1, i, size] = level - local.seen[i]
        others[2, i, size] = level - local.flipped[i]
    _set_covered(pattern, pixels.blur_mm, around.unit, local, spots.shapes, size + 2, as_read)
    scale = size * math.log(around.light)
    half = _factorize(as_read) + scale
    likelihoods[0] = -0.5 * _column_square(as_read, size) - half
    likelihoods[4] = _spot_likelihood(spots, as_read, size + 1) - half
    for h in range(3):
        half = _factorize(others[h]) + scale
        likelihoods[h + 1] = -0.5 * _column_square(others[h], size) - half


@kernel
def set_unit_likelihoods(
    pixels: PlatePixels, pattern: PlatePattern, light: LightPrior, spots: Spots, likelihoods: Floats
) -> None:
    """Set the log likelihoods of the pixels around each unit, up to a constant.

    Parameters
    ----------
    likelihoods : ndarray, shape (units, 5)
        Set to those of the unit as in the pattern, flipped, the same two under a smooth stain, and flipped under a spot
        of paint, on average over the spots.
    """
    shown = _list_units(pixels.units)
    by_unit = pixels.units.T.copy()
    for u in range(pixels.units.shape[1]):
        around = _find_around(pixels, pattern, light.field, u)
        if around.pixels.size < MIN_PIXELS:
            likelihoods[u] = 0.0
        else:
            _compare_unit(pixels, pattern, light, spots, by_unit, shown, around, likelihoods[u])
