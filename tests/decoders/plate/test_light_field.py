"""The light on a plate against the Gaussian process with its whole covariance."""

from __future__ import annotations

import numpy as np

from app.decoders.plate.hypotheses import PlatePixels
from app.decoders.plate.light_field import (
    EDGE_ERROR,
    LEVEL_VARIANCE,
    LIGHT_LENGTH_MM,
    MODEL_ERROR,
    NORMAL_SPREAD,
    fit_light,
)
from app.decoders.plate.linear import invert

SIDE_MM = 325.0


def test_a_factor_is_that_of_numpy() -> None:
    rng = np.random.default_rng(2)
    for size in (1, 3, 4, 7, 71):
        half = rng.normal(size=(size, size + 2))
        matrix = half @ half.T
        np.testing.assert_allclose(invert(matrix), np.linalg.inv(matrix), rtol=1e-6, atol=1e-9)
    assert invert(np.array([[1.0, 2.0], [2.0, 1.0]])).size == 0


def test_the_light_is_that_of_the_whole_covariance() -> None:
    rng = np.random.default_rng(5)
    count = 900
    places = rng.uniform(0, SIDE_MM, (count, 2))
    edge = 0.6 + 0.4 / (1 + np.exp(-(places[:, 0] + places[:, 1] - SIDE_MM) / 10))  # of a shadow
    dark = (rng.random(count) < 0.5).astype(float)
    level, albedo = 0.5, 0.15
    seen = np.where(dark > 0, albedo, 1.0)
    light = level * edge * seen + rng.normal(0, 0.004, count)
    pixels = PlatePixels(light, np.ones(count), np.zeros((count, 0)), np.zeros((count, 6)), places, level, 3.0)
    found = fit_light(pixels, 1 - dark, dark[:, None], np.array([albedo]), SIDE_MM)
    # the last round again, by the whole covariance of the light at the pixels
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    prior = level**2 * (found.spread**2 * np.exp(-apart / LIGHT_LENGTH_MM) + LEVEL_VARIANCE)
    shown = np.where(dark > 0, found.albedo[0], 1.0)
    errors = np.abs(light - shown * found.light)
    model = ((MODEL_ERROR * shown) ** 2 + EDGE_ERROR**2) * found.light**2
    noise = (NORMAL_SPREAD * np.median(errors)) ** 2 + model
    np.testing.assert_allclose(found.noise, noise, rtol=1e-6)
    gain = prior * shown @ np.linalg.inv(prior * np.outer(shown, shown) + np.diag(noise))
    expected = level + gain @ (light - shown * level)
    assert np.abs(found.light / expected - 1).max() < 0.05  # the light is linear between knots 20 mm apart
    assert np.abs(found.light / expected - 1).mean() < 0.008
    assert abs(found.albedo[0] - albedo) < 0.01
