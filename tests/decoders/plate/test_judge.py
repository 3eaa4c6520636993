"""The pixels as judges of units: shade is no damage, and a spot of paint that hides a unit is seen."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import scipy

import app.decoders.plate.reader as reader
from app.decoders.plate.evidence import MAX_WRONG_REFUSED
from app.decoders.plate.judge import Judgement, judge_units
from app.decoders.plate.judge_kernel import (
    DARK_SPREAD,
    WHITE_SPREAD,
    PlatePixels,
    UnitHypotheses,
    set_unit_likelihoods,
)
from app.decoders.plate.unit_likelihoods import code_units
from app.markers.plate import PlateGeometry, unit_index
from app.simulation.plate_face import Face
from app.simulation.plate_scene import PlacedFace, PlateScene, Shadow
from tests.decoders.plate.scenes import AHEAD_M, CAMERA, PAPER, face_of, shoot

GEOMETRY = PlateGeometry()
DARK = code_units(PAPER)


def judged(face: Face, monkeypatch: pytest.MonkeyPatch, pattern: np.ndarray = DARK, **options: Any) -> Judgement:
    """The judgement of a pattern on the best fit of a frame."""
    image = shoot(PlacedFace(face, AHEAD_M), **options).image
    fits = []
    read_fit = reader._read_fit

    def keep(task: Any, fit: Any, *rest: Any) -> Any:
        fits.append(fit)
        return read_fit(task, fit, *rest)

    monkeypatch.setattr(reader, "_read_fit", keep)
    reader.decode_plates(image, camera=CAMERA)
    found = judge_units(image, max(fits, key=lambda fit: fit.explained), GEOMETRY, pattern)
    assert found is not None
    return found


def in_shade(scene: PlateScene) -> PlateScene:
    return replace(scene, shadow=Shadow(edge_light=0.35, edge_angle_deg=50.0, edge_offset_m=0.02, penumbra_m=0.03))


def spotted(row: int, column: int, reflectance: float) -> Face:
    """A face with a round spot of paint, 44 mm wide, over a unit."""
    face = face_of()
    spot = face.reflectance.copy()
    centre = [round(GEOMETRY.gap_mm + (k + 0.45) * GEOMETRY.pitch_mm) for k in (column, row)]
    cv2.circle(spot, (centre[0], centre[1]), 22, (reflectance,) * 3, -1, cv2.LINE_AA)
    return replace(face, reflectance=spot)


def test_a_plate_under_the_edge_of_a_shadow_is_as_it_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    assert judged(face_of(), monkeypatch, change=in_shade).wrong < MAX_WRONG_REFUSED


@pytest.mark.parametrize("unit", [0, 17, 30, 47])
def test_a_unit_that_is_the_other_way_round_stands_out(unit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    pattern = DARK.copy()
    pattern[unit] = not pattern[unit]
    found = judged(face_of(), monkeypatch, pattern, change=in_shade)
    assert found.unit_wrong[unit] > 0.99


@pytest.mark.parametrize("reflectance", [0.25, 0.3, 0.35])
def test_a_spot_of_paint_over_a_unit_leaves_a_doubt(reflectance: float, monkeypatch: pytest.MonkeyPatch) -> None:
    row, column = next((int(r), int(c)) for r, c in np.argwhere(PAPER.units == 0) if 2 <= r <= 5 and 2 <= c <= 5)
    covered = spotted(row, column, reflectance)
    pattern = DARK | (unit_index(8).reshape(-1) == 8 * row + column)  # what the spot makes of it
    assert judged(covered, monkeypatch, pattern).wrong > MAX_WRONG_REFUSED


def test_the_likelihoods_are_those_of_normal_distributions() -> None:
    rng = np.random.default_rng(4)
    count = 30
    places = rng.uniform(0, 30, (count, 2))
    units = rng.uniform(0, 0.5, (count, 2))
    pixels = PlatePixels(
        rng.uniform(0.1, 0.6, count), np.ones(count), units, np.zeros((count, 6)), places, 0.6, 3.0
    )  # fmt: skip
    dark, albedo, spread, length_mm, level = np.array([1.0, 0.0]), 0.15, 0.3, 120.0, 0.25
    seen, light = rng.uniform(0.2, 1.0, count), np.full(count, 0.5)
    noise = rng.uniform(1e-4, 4e-4, count)
    given = UnitHypotheses(
        dark, seen, albedo, light, noise, spread, np.array([[15.0, 15.0]] * 2), 100.0, 5.0,
        np.array([[0, 0, 1, 0, 1, 1.0]]),
        np.array([0.5]), np.array([0.0]),
    )  # fmt: skip
    found = np.empty((2, 5))
    set_unit_likelihoods(pixels, given, length_mm, level, found)
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    smooth = spread**2 * np.exp(-apart / length_mm) + level
    constant = 0.5 * count * math.log(2 * math.pi)
    for unit, (change, spreads) in enumerate(
        [(1 - albedo, (WHITE_SPREAD, WHITE_SPREAD)), (albedo - 1, (DARK_SPREAD, DARK_SPREAD))]
    ):
        for column, (mean, own) in enumerate(
            [(seen, (DARK_SPREAD, WHITE_SPREAD)), (seen + change * units[:, unit], spreads)]
        ):
            paint = (units * np.square(own)) @ units.T
            covariance = 0.25 * (smooth * np.outer(mean, mean) + paint) + np.diag(noise)
            expected = scipy.stats.multivariate_normal(0.5 * mean, covariance).logpdf(pixels.light)
            assert found[unit, column] == pytest.approx(expected + constant, abs=1e-6)
    # a spot without opacity is no spot: the unit the other way round, under the covariance of the unit as read
    residual = pixels.light - 0.5 * (seen + (1 - albedo) * units[:, 0])
    paint = (units * np.square((DARK_SPREAD, WHITE_SPREAD))) @ units.T
    covariance = 0.25 * (smooth * np.outer(seen, seen) + paint) + np.diag(noise)
    expected = scipy.stats.multivariate_normal(np.zeros(count), covariance).logpdf(residual)
    assert found[0, 4] == pytest.approx(expected + constant, abs=1e-6)
