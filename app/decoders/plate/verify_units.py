"""The units of a fitted plate verified by its pixels: light, paint and stains as competing explanations.

The light on the plate is a Gaussian process, so that the edge of a shadow is no damage. For each unit the pixels around
it are compared under these hypotheses, with the light integrated out: the unit as it was read, or flipped, that is dark
instead of light or light instead of dark; clean, under a smooth stain, or flipped under a spot of paint that hides it.
Whether the plate has stains at all follows from all of its units.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from app.decoders.plate.fit import PlateFit
from app.decoders.plate.hypotheses import (
    MIN_PIXELS,
    LightPrior,
    PlatePattern,
    PlatePixels,
    Spots,
    set_unit_likelihoods,
)
from app.decoders.plate.layout import unit_edges, unit_shapes
from app.decoders.plate.patch import cut_patch
from app.decoders.plate.pixel_shares import set_pixel_shares
from app.decoders.plate.synthesis import FIRST_GAP, FIRST_ROAD, SINGLES
from app.decoders.plate.unit_likelihoods import light_levels
from app.decoders.plate.unit_verification import UnitVerification
from app.markers.plate import PlateGeometry, unit_index

Array = npt.NDArray[Any]

UNIT_PX = 4.5
"""[px] size of a unit in the patch, where the image has more. Source: trials with 3.0, which has more wrong readings of
stained plates."""
REACH_PITCHES = 1.25
"""[pitches] from a unit's centre within which its pixels are compared: the unit, the gaps around it and half of its
neighbours. Source: chosen by hand, for speed."""
INNER_SHARE = 0.7
"""[unit] part of a unit's half side within which lies what the pixels around it see of it. Source: chosen by hand."""
KNOT_MM = 20.0
"""[mm] distance of the knots between which the light is linear. Source: chosen by hand."""
LIGHT_LENGTH_MM, LEVEL_VARIANCE = 120.0, 0.25
"""[mm, 1] distance over which the correlation of the light falls to 1/e, and the variance of its mean, relative.
Source: chosen by hand."""
LIGHT_SPREAD, SPREAD_FACTOR = (0.15, 0.45), 1.6
"""[1] least and greatest standard deviation of the light over a plate, relative, and the factor on that of the fitted
light. Source: chosen by hand."""
MODEL_ERROR, NOISE_FACTOR = 0.04, 1.0
"""[1] error of the model relative to the light, and factor on the pixels' noise. Source: trials; the squared residuals
over the variance are then 0.4 to 1 in shade, and up to 1.6 under stains."""
EDGE_ERROR = 0.03
"""[white] error of the model where reflectances meet, whose blur is not known to less. Source: chosen by hand."""
FIRST_NOISE = 0.03
"""[light] noise that the first of the rounds assumes. Source: chosen by hand."""
ROUNDS = 3
"""Rounds of the light and the paints in turn. Source: chosen by hand."""
MAX_ROAD_SHARE, MIN_SHARE = 0.05, 0.9
"""[1] share of the road in a pixel up to which it is compared, and of all shapes from which on. Source: by hand."""
ALBEDO = (0.01, 1.3)
"""[white] least and greatest reflectance of a part to begin with. Source: chosen by hand."""
MIN_BLUR_MM = 2.0
"""[mm] width of the edge of a spot of paint at least. Source: chosen by hand."""
NODES = 4
"""Quadrature nodes on each side of the middle at most, as the fit has."""
SPOTS_MM = ((17, 17, 0), (22, 22, 0), (30, 30, 0), (26, 17, 0), (17, 26, 0), (28, 20, 45), (28, 20, 135))
"""[mm, mm, deg] half axes and turns of the spots of paint; each lies at nine places around the unit's centre. Source:
chosen by hand; smaller ones leave a part of the unit in view."""
PAINTS, OPACITIES = np.array([0.03, 0.1, 0.2, 0.35, 0.6, 0.85, 1.0, 1.15]), np.array([1.0, 0.8])
"""[white, 1] reflectances and opacities of the spots. Source: chosen by hand."""


def verify_units(
    image: npt.NDArray[np.uint8], fit: PlateFit, geometry: PlateGeometry, dark: npt.NDArray[np.bool_]
) -> UnitVerification | None:
    """Verify a pattern of units by the pixels.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3)
        The frame.
    fit : PlateFit
        Of the plate in it.
    geometry : PlateGeometry
    dark : ndarray of bool, shape (units,)
        The pattern, in the order of the symbols' units.

    Returns
    -------
    UnitVerification or None
        None where the plate has too few pixels.
    """
    cut = _cut(image, fit, geometry)
    if cut is None:
        return None
    pixels, knots, paints = cut
    pattern = dark.astype(float)
    parts = np.column_stack([pixels.units @ pattern, pixels.rest])
    white = pixels.units @ (1 - pattern)
    light, albedo, noise, spread = _fit_light(pixels, knots, white, parts, paints, geometry)
    likelihoods = np.empty((len(dark), 5))
    set_unit_likelihoods(
        pixels,
        PlatePattern(
            pattern, white + parts @ albedo, float(albedo[0]), _centres_mm(geometry),
            REACH_PITCHES * geometry.pitch_mm, INNER_SHARE * geometry.unit_mm / 2,
        ),
        LightPrior(light, noise, spread, LIGHT_LENGTH_MM, LEVEL_VARIANCE),
        Spots(_spot_shapes(geometry.pitch_mm), PAINTS, OPACITIES),
        likelihoods,
    )  # fmt: skip
    return UnitVerification(likelihoods)


def _cut(
    image: npt.NDArray[np.uint8], fit: PlateFit, geometry: PlateGeometry
) -> tuple[PlatePixels, Array, Array] | None:
    """The pixels on the plate, their weights of the light's knots, and the first reflectances of the parts."""
    n, side_mm = geometry.n, geometry.side_mm
    patch = cut_patch(image, fit.corners_px, n * UNIT_PX, linear=False)
    levels = light_levels(fit)
    if patch is None or levels is None:
        return None
    shapes = len(fit.model.values)
    shares, places = np.empty((*patch.light.shape, shapes)), np.empty((*patch.light.shape, 2))
    set_pixel_shares(patch, fit.model, NODES, shares, places)
    singles = shares[..., shapes - SINGLES :]
    road = singles[..., FIRST_ROAD:].sum(axis=-1)
    used = (shares.sum(axis=-1) > MIN_SHARE) & (road < MAX_ROAD_SHARE)
    if used.sum() < MIN_PIXELS * n:
        return None
    in_symbols = unit_shapes(n).reshape(-1)[unit_index(n).reshape(-1)]
    gap = singles[used][:, FIRST_GAP:FIRST_ROAD].sum(axis=1) + road[used]
    right, down = np.diff(fit.corners_px[:3], axis=0)
    mm_per_px = side_mm / math.sqrt(max(abs(float(right[0] * down[1] - right[1] * down[0])), 1.0))
    blur_px = math.sqrt(fit.blur_px**2 + patch.grid[2] * patch.grid[3] / 12)
    level = levels.light - levels.haze
    pixels = PlatePixels(
        patch.light[used].astype(float) - levels.haze,
        patch.weights[used] / float(patch.weights[used].mean()),
        np.ascontiguousarray(shares[used][:, in_symbols]),
        np.column_stack([gap, singles[used][:, :FIRST_GAP]]),
        places[used] * side_mm,
        level,
        max(mm_per_px * blur_px, MIN_BLUR_MM),
    )
    first = np.array([levels.dark, fit.gap, *fit.markers]) - levels.haze
    return pixels, _knot_weights(places[used], _knots(side_mm)[0]), np.clip(first / level, *ALBEDO)


def _fit_light(
    pixels: PlatePixels, knots: Array, white: Array, parts: Array, albedo: Array, geometry: PlateGeometry
) -> tuple[Array, Array, Array, float]:
    """Light on each pixel, reflectances of the parts, noise variance of each pixel, and the light's spread.

    White is 1; light and reflectances are solved in turns.
    """
    level, kernel, spread = pixels.level, _knots(geometry.side_mm)[1], LIGHT_SPREAD[1]
    sigma, light = FIRST_NOISE * level, np.full(len(white), level)
    for _ in range(ROUNDS):
        seen = white + parts @ albedo
        prior = level**2 * (spread**2 * kernel + LEVEL_VARIANCE)
        noise = (NOISE_FACTOR * sigma) ** 2 / pixels.weight + ((MODEL_ERROR * seen) ** 2 + EDGE_ERROR**2) * light**2
        design = knots * seen[:, None]
        weighted = design / noise[:, None]
        # (1 / prior + design' / noise design) ^ -1, without the inverse of the prior
        system = weighted.T @ design @ prior + np.eye(len(prior))
        shift = prior @ np.linalg.solve(system, weighted.T @ (pixels.light - seen * level))
        light = np.maximum(level + knots @ shift, 0.02 * level)
        lit = parts * light[:, None]
        ridge = np.eye(len(albedo)) * 0.05 * float(np.median(1 / noise)) * level**2
        matrix = lit.T @ (lit / noise[:, None]) + ridge
        albedo = np.linalg.solve(matrix, lit.T @ ((pixels.light - white * light) / noise) + ridge @ albedo)
        albedo = np.clip(albedo, 0.0, 1.4)
        residual = pixels.light - (white + parts @ albedo) * light
        sigma = max(1.4826 * float(np.median(np.abs(residual) * np.sqrt(pixels.weight))), 1e-4)
        spread = float(np.clip(SPREAD_FACTOR * light.std() / light.mean(), *LIGHT_SPREAD))
    seen = white + parts @ albedo
    noise = (NOISE_FACTOR * sigma) ** 2 / pixels.weight + ((MODEL_ERROR * seen) ** 2 + EDGE_ERROR**2) * light**2
    return light, albedo, noise, spread


@lru_cache
def _knots(side_mm: float) -> tuple[int, Array]:
    """Knots along a side, and the correlation of the light between all of them."""
    count = math.ceil(side_mm / KNOT_MM) + 1
    along = np.linspace(0.0, side_mm, count)
    places = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    return count, np.exp(-np.linalg.norm(places[:, None] - places[None], axis=2) / LIGHT_LENGTH_MM)


def _knot_weights(places: Array, count: int) -> Array:
    """Weights of the knots at each place, bilinear, shape (P, count * count)."""
    along = np.clip(places, 0, 1) * (count - 1)
    low = np.minimum(along.astype(int), count - 2)
    part = along - low
    weights = np.zeros((len(places), count * count))
    rows = np.arange(len(places))
    for down in (0, 1):
        for right in (0, 1):
            across = part[:, 0] if right else 1 - part[:, 0]
            weights[rows, (low[:, 1] + down) * count + low[:, 0] + right] += across * (
                part[:, 1] if down else 1 - part[:, 1]
            )
    return weights


@lru_cache
def _centres_mm(geometry: PlateGeometry) -> Array:
    """Centres of the units, in the order of the symbols' units, shape (units, 2). [mm]"""
    middle = unit_edges(geometry).mean(axis=1) * geometry.side_mm
    flat = unit_index(geometry.n).reshape(-1)
    return np.stack([middle[flat % geometry.n], middle[flat // geometry.n]], axis=1)


@lru_cache
def _spot_shapes(pitch_mm: float) -> Array:
    """Centre [mm], inverse shape xx, xy, yy [1/mm2] and mean radius [mm] of the spots, shape (spots, 6)."""
    found = []
    for long_mm, short_mm, turn_deg in SPOTS_MM:
        cosine, sine = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
        axes = np.array([[cosine, sine], [-sine, cosine]])
        form = axes.T @ np.diag([long_mm**-2, short_mm**-2]) @ axes
        radius_mm = math.sqrt(long_mm * short_mm)
        for x in (-pitch_mm / 3, 0.0, pitch_mm / 3):
            for y in (-pitch_mm / 3, 0.0, pitch_mm / 3):
                found.append((x, y, form[0, 0], form[0, 1], form[1, 1], radius_mm))
    return np.array(found)
