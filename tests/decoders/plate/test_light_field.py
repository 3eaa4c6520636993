"""The light on a plate against the Gaussian process with its whole covariance."""

from __future__ import annotations

import numpy as np
import pytest

from app.decoders.plate.hypotheses import PlatePixels
from app.decoders.plate.light_field import (
    ALBEDO_WEIGHT,
    EDGE_ERROR,
    FIRST_NOISE,
    KNOT_MM,
    LEVEL_VARIANCE,
    LIGHT_LENGTH_MM,
    LIGHT_SPREAD,
    MODEL_ERROR,
    NORMAL_SPREAD,
    ROUNDS,
    SPREAD_FACTOR,
    fit_light,
)
from app.decoders.plate.normal_equations import invert

SIDE_MM = 325.0


def test_an_inverse_is_that_of_numpy() -> None:
    rng = np.random.default_rng(2)
    for size in (1, 3, 4, 7, 71):
        half = rng.normal(size=(size, size + 2))
        matrix = half @ half.T
        np.testing.assert_allclose(invert(matrix), np.linalg.inv(matrix), rtol=1e-6, atol=1e-9)
    assert invert(np.array([[1.0, 2.0], [2.0, 1.0]])).size == 0


def whole_covariance_light(pixels: PlatePixels, white: np.ndarray, parts: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """The light of `fit_light`, by the covariance of all knots and dense systems."""
    count = int(np.ceil(SIDE_MM / KNOT_MM)) + 1
    along = np.linspace(0.0, SIDE_MM, count)
    knots = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    pitch = along[1]
    away = np.abs(pixels.places_mm[:, None] - knots[None]) / pitch
    weights = np.prod(np.maximum(1 - away, 0.0), axis=2)  # linear between knots
    correlation = np.exp(-np.linalg.norm(knots[:, None] - knots[None], axis=2) / LIGHT_LENGTH_MM)
    level, spread, sigma = pixels.level, LIGHT_SPREAD[1], FIRST_NOISE * pixels.level
    light = np.full(len(white), level)
    for _ in range(ROUNDS):
        seen = white + parts @ albedo
        noise = sigma**2 + ((MODEL_ERROR * seen) ** 2 + EDGE_ERROR**2) * light**2
        prior = level**2 * (spread**2 * correlation + LEVEL_VARIANCE)
        shown = seen[:, None] * weights
        gain = prior @ shown.T @ np.linalg.inv(shown @ prior @ shown.T + np.diag(noise))
        light = level + weights @ (gain @ (pixels.light - seen * level))
        lit = parts * light[:, None]
        ridge = np.eye(len(albedo)) * ALBEDO_WEIGHT * np.median(1 / noise) * level**2
        right = lit.T @ ((pixels.light - white * light) / noise) + ridge @ albedo
        albedo = np.linalg.solve(lit.T @ (lit / noise[:, None]) + ridge, right)
        sigma = NORMAL_SPREAD * float(np.median(np.abs(pixels.light - (white + parts @ albedo) * light)))
        spread = float(np.clip(SPREAD_FACTOR * light.std() / light.mean(), *LIGHT_SPREAD))
    return light


@pytest.mark.slow
def test_the_light_is_that_of_the_whole_covariance() -> None:
    rng = np.random.default_rng(5)
    count, level = 900, 0.5
    places = rng.uniform(0, SIDE_MM, (count, 2))
    edge = 0.6 + 0.4 / (1 + np.exp(-(places[:, 0] + places[:, 1] - SIDE_MM) / 10))  # of a shadow
    dark = (rng.random(count) < 0.5).astype(float)
    light = level * edge * np.where(dark > 0, 0.15, 1.0) + rng.normal(0, 0.004, count)
    pixels = PlatePixels(light, np.ones(count), np.zeros((count, 0)), np.zeros((count, 6)), places, level, 3.0)
    found = fit_light(pixels, 1 - dark, dark[:, None], np.array([0.2]), SIDE_MM)
    expected = whole_covariance_light(pixels, 1 - dark, dark[:, None], np.array([0.2]))
    np.testing.assert_allclose(found.light, expected, rtol=0.006)
    assert abs(found.albedo[0] - 0.15) < 0.01
