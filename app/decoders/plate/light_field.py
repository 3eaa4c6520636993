"""The light on a plate, as a Gaussian process that is linear between knots, and the reflectances of the plate's parts.

The edge of a shadow, leaves and glare are light, not damage. White is 1; light and reflectances are solved in turns.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from app.decoders.compiled import kernel
from app.decoders.plate.hypotheses import PlatePixels
from app.decoders.plate.profiles import Floats, Ints

Array = npt.NDArray[Any]

KNOT_MM = 20.0
"""[mm] distance of the knots between which the light is linear. Source: chosen by hand."""
LIGHT_LENGTH_MM, LEVEL_VARIANCE = 120.0, 0.25
"""[mm, 1] distance over which the correlation of the light falls to 1/e, and the variance of its mean, relative.
Source: chosen by hand."""
LIGHT_SPREAD, SPREAD_FACTOR = (0.15, 0.45), 1.6
"""[1] least and greatest standard deviation of the light over a plate, relative, and the factor on that of the fitted
light. Source: chosen by hand."""
MODEL_ERROR = 0.04
"""[1] error of the model relative to the light. Source: trials; the squared residuals over the variance are then 0.4 to
1 in shade, and up to 1.6 under stains."""
EDGE_ERROR = 0.03
"""[white] error of the model where reflectances meet, whose blur is not known to less. Source: chosen by hand."""
FIRST_NOISE = 0.03
"""[light] noise that the first of the rounds assumes. Source: chosen by hand."""
ROUNDS = 3
"""Rounds of the light and the reflectances in turn. Source: chosen by hand."""
MIN_LIGHT = 0.02
"""[level] light on any pixel at least. Source: chosen by hand."""
MAX_ALBEDO = 1.4
"""[white] greatest reflectance of a part. Source: chosen by hand."""
ALBEDO_WEIGHT = 0.05
"""[pixels] that the first reflectances count as. Source: chosen by hand."""


class LightField(NamedTuple):
    """The light on a plate and what it was fitted with.

    Attributes
    ----------
    light, noise : ndarray, shape (P,)
        Light on each pixel, and the variance of its error.
    albedo : ndarray, shape (parts,)
        Reflectances of the parts; white is 1.
    spread : float
        Standard deviation of the light, relative.
    """

    light: Array
    noise: Array
    albedo: Array
    spread: float


class Knots(NamedTuple):
    """The four knots around each pixel, shape (P, 4), their weights, and the correlation of the light at all knots."""

    near: Ints
    weights: Floats
    correlation: Floats


def fit_light(pixels: PlatePixels, white: Array, parts: Array, albedo: Array, side_mm: float) -> LightField:
    """Light on each pixel and reflectances of the parts.

    Parameters
    ----------
    pixels : PlatePixels
    white : ndarray, shape (P,)
        Share of the white units in each pixel.
    parts : ndarray, shape (P, parts)
        Shares of the parts whose reflectance is fitted.
    albedo : ndarray, shape (parts,)
        Their reflectances to begin with.
    side_mm : float
        Side of the plate. [mm]
    """
    knots, level = _knots_around(pixels.places_mm, side_mm), pixels.level
    spread, sigma, light = LIGHT_SPREAD[1], FIRST_NOISE * level, np.full(len(white), level)
    noise = np.empty_like(light)
    for _ in range(ROUNDS):
        seen = white + parts @ albedo
        prior = level**2 * (spread**2 * knots.correlation + LEVEL_VARIANCE)
        noise = _noise(pixels, sigma, seen, light)
        system, right = np.empty_like(prior), np.empty(len(prior))
        set_light_equations(knots, prior, seen, noise, pixels.light - seen * level, system, right)
        shift = prior @ np.linalg.solve(system, right)
        light = np.maximum(level + (knots.weights * shift[knots.near]).sum(axis=1), MIN_LIGHT * level)
        lit = parts * light[:, None]
        ridge = np.eye(len(albedo)) * ALBEDO_WEIGHT * float(np.median(1 / noise)) * level**2
        matrix = lit.T @ (lit / noise[:, None]) + ridge
        albedo = np.linalg.solve(matrix, lit.T @ ((pixels.light - white * light) / noise) + ridge @ albedo)
        albedo = np.clip(albedo, 0.0, MAX_ALBEDO)
        residual = pixels.light - (white + parts @ albedo) * light
        sigma = max(1.4826 * float(np.median(np.abs(residual) * np.sqrt(pixels.weight))), 1e-4)
        spread = float(np.clip(SPREAD_FACTOR * light.std() / light.mean(), *LIGHT_SPREAD))
    return LightField(light, _noise(pixels, sigma, white + parts @ albedo, light), albedo, spread)


def _noise(pixels: PlatePixels, sigma: float, seen: Array, light: Array) -> Array:
    """Variance of the error of each pixel."""
    variance: Array = sigma**2 / pixels.weight + ((MODEL_ERROR * seen) ** 2 + EDGE_ERROR**2) * light**2
    return variance


@kernel
def set_light_equations(
    knots: Knots, prior: Floats, seen: Floats, noise: Floats, residual: Floats, system: Floats, right: Floats
) -> None:
    """Set the equations (1 + A prior) x = b of the light, A = W' N^-1 W: the shift of the knots is prior x.

    Parameters
    ----------
    knots : Knots
        With their weights W in what pixels see.
    prior : ndarray, shape (K, K)
        Covariance of the light at the knots.
    seen, noise, residual : ndarray, shape (P,)
        Reflectance that each pixel sees, the variance N of its error, and its light beyond the mean light.
    system, right : ndarray, shapes (K, K) and (K,)
        Set to 1 + A prior and to b.
    """
    size = prior.shape[0]
    information = np.zeros((size, size))
    right[:] = 0.0
    for p in range(seen.size):
        for a in range(4):
            i = knots.near[p, a]
            weight = knots.weights[p, a] * seen[p] / noise[p]
            right[i] += weight * residual[p]
            for b in range(4):
                information[i, knots.near[p, b]] += weight * knots.weights[p, b] * seen[p]
    for i in range(size):
        system[i] = 0.0
        system[i, i] = 1.0
        for j in range(size):
            if information[i, j] != 0.0:  # a knot shares pixels with the eight around it only
                for k in range(size):
                    system[i, k] += information[i, j] * prior[j, k]


def _knots_around(places_mm: Array, side_mm: float) -> Knots:
    count, correlation = _correlation(side_mm)
    along = np.clip(places_mm / side_mm, 0, 1) * (count - 1)
    low = np.minimum(along.astype(np.int64), count - 2)
    right, down = (along - low).T
    first = low[:, 1] * count + low[:, 0]
    near = np.stack([first, first + 1, first + count, first + count + 1], axis=1)
    weights = np.stack([(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down], axis=1)
    return Knots(near, weights, correlation)


@lru_cache
def _correlation(side_mm: float) -> tuple[int, Array]:
    """Knots along a side, and the correlation of the light between all of them."""
    count = math.ceil(side_mm / KNOT_MM) + 1
    along = np.linspace(0.0, side_mm, count)
    places = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    return count, np.exp(-np.linalg.norm(places[:, None] - places[None], axis=2) / LIGHT_LENGTH_MM)
