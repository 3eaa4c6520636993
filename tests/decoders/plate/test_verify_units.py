"""Units verified by pixels: shade is no damage, and a spot of paint that hides a unit is seen."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import scipy

from app.decoders.plate import reader
from app.decoders.plate.confirm import UnitVerification
from app.decoders.plate.detect_blobs import half_planes
from app.decoders.plate.evidence import MAX_ERROR
from app.decoders.plate.find_candidates import find_candidates
from app.decoders.plate.fit import fit_plate, homography_from_points, project
from app.decoders.plate.hypotheses import LightPrior, PlatePattern, PlatePixels, Spots, set_unit_likelihoods
from app.decoders.plate.pose import marker_centroids
from app.decoders.plate.reader import DEFAULT_GEOMETRIES, decode_plates
from app.decoders.plate.unit_likelihoods import code_units, unit_log_likelihoods, verify_units
from app.markers.plate import PlateCode, PlateGeometry, unit_index
from app.simulation.plate_face import Face
from app.simulation.plate_scene import PlacedFace, PlateScene, Shadow
from tests.decoders.plate.scenes import AHEAD_M, PAPER, face_of, shoot

GEOMETRY = PlateGeometry()
CORNERS = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
DARK = code_units(PAPER)
WHITE_SPREAD, DARK_SPREAD = 0.09, 0.05
FAR_AHEAD_M = 5.2  # units of 1.8 px
SMALL_SPOTTED = [
    ("359902935234", 2, 4, 0.1), ("980261340179", 5, 1, 0.85), ("357408481825", 1, 3, 0.85),
    ("258063891625", 3, 3, 0.1), ("518752852870", 4, 5, 0.1),
]  # fmt: skip


def verified(face: Face, pattern: np.ndarray = DARK, **options: Any) -> UnitVerification:
    """The pixels of a frame compared with a pattern, at the frame's true corners."""
    shot = shoot(PlacedFace(face, AHEAD_M), **options)
    to_image = np.append(homography_from_points(CORNERS, shot.truths[0].corners_px), 1.0).reshape(3, 3)
    fit = fit_plate(shot.image, project(to_image, marker_centroids(GEOMETRY)), GEOMETRY)
    assert fit is not None
    units = unit_log_likelihoods(fit)
    assert units is not None
    found = verify_units(shot.image, fit, GEOMETRY, pattern, units)
    assert found is not None
    return found


def in_shade(scene: PlateScene) -> PlateScene:
    return replace(scene, shadow=Shadow(edge_light=0.35, edge_angle_deg=50.0, edge_offset_m=0.02, penumbra_m=0.03))


def spotted(row: int, column: int, reflectance: float, code: PlateCode = PAPER, radius_mm: int = 22) -> Face:
    """A face with a round spot of paint over a unit."""
    face = face_of(code)
    spot = face.reflectance.copy()
    centre = [round(GEOMETRY.gap_mm + (k + 0.45) * GEOMETRY.pitch_mm) for k in (column, row)]
    cv2.circle(spot, (centre[0], centre[1]), radius_mm, (reflectance,) * 3, -1, cv2.LINE_AA)
    return replace(face, reflectance=spot)


def test_a_plate_under_the_edge_of_a_shadow_is_as_it_looks() -> None:
    assert verified(face_of(), change=in_shade).error_probability < MAX_ERROR


@pytest.mark.parametrize("unit", [0, 17, 30, 47])
def test_a_flipped_unit_stands_out(unit: int) -> None:
    pattern = DARK.copy()
    pattern[unit] = not pattern[unit]
    found = verified(face_of(), pattern, change=in_shade)
    assert found.unit_errors[unit] > 0.99


@pytest.mark.parametrize("reflectance", [0.25, 0.3, 0.35])
def test_a_spot_of_paint_over_a_unit_makes_it_unsure(reflectance: float) -> None:
    row, column = next((int(r), int(c)) for r, c in np.argwhere(PAPER.units == 0) if 2 <= r <= 5 and 2 <= c <= 5)
    covered = spotted(row, column, reflectance)
    pattern = DARK | (unit_index(8).reshape(-1) == 8 * row + column)  # what the spot makes of it
    assert verified(covered, pattern).error_probability > MAX_ERROR


@pytest.mark.parametrize(("digits", "row", "column", "reflectance"), SMALL_SPOTTED)
def test_small_digits_without_a_check_are_compared_by_their_pixels(
    digits: str, row: int, column: int, reflectance: float
) -> None:
    code = PlateCode(digits)
    covered = spotted(row, column, reflectance, code, radius_mm=18)
    (reading,) = decode_plates(shoot(PlacedFace(covered, FAR_AHEAD_M)).image)
    assert reading.code is None
    assert "a stain may hide units" in reading.reason


def test_a_plate_that_is_seen_clearly_ends_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    row, column = next((int(r), int(c)) for r, c in np.argwhere(PAPER.units == 0) if 2 <= r <= 5 and 2 <= c <= 5)
    frame = shoot(PlacedFace(spotted(row, column, 0.3), AHEAD_M)).image
    candidates = list(find_candidates(half_planes(frame), DEFAULT_GEOMETRIES))
    assert sum(bool(found) for _signal, found in candidates) > 1  # other signals show the plate too
    left = iter(candidates)
    monkeypatch.setattr(reader, "find_candidates", lambda planes, geometries: left)
    (reading,) = decode_plates(frame)
    assert reading.code is None  # a spot hides a unit, and no other signal shows what is under it
    assert len(list(left)) == len(candidates) - 1


@pytest.mark.slow
@pytest.mark.parametrize("veil", [0.0, 0.004])
def test_the_likelihoods_are_those_of_normal_distributions(veil: float) -> None:
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
    pattern = PlatePattern(dark, seen, albedo, WHITE_SPREAD, DARK_SPREAD, np.array([[15.0, 15.0]] * 2), 100.0, 5.0)
    prior = LightPrior(light, noise, spread, length_mm, level, veil, 80.0)
    spots = Spots(np.array([[0, 0, 1, 0, 1, 1]], np.float32).T.copy(), np.array([0.5]), np.array([0.0]))
    found = np.empty((2, 5))
    set_unit_likelihoods(pixels, pattern, prior, spots, found)
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    smooth = spread**2 * np.exp(-apart / length_mm) + level
    added = veil * np.exp(-0.5 * (apart / 80.0) ** 2) + np.diag(noise)
    constant = 0.5 * count * math.log(2 * math.pi)
    for unit, (change, spreads) in enumerate(
        [(1 - albedo, (WHITE_SPREAD, WHITE_SPREAD)), (albedo - 1, (DARK_SPREAD, DARK_SPREAD))]
    ):
        for column, (mean, own) in enumerate(
            [(seen, (DARK_SPREAD, WHITE_SPREAD)), (seen + change * units[:, unit], spreads)]
        ):
            paint = (units * np.square(own)) @ units.T
            covariance = 0.25 * (smooth * np.outer(mean, mean) + paint) + added
            expected = scipy.stats.multivariate_normal(0.5 * mean, covariance).logpdf(pixels.light)
            assert found[unit, column] == pytest.approx(expected + constant, rel=3e-4, abs=0.01)
    # a spot without opacity is no spot: the flipped unit, under the covariance of the unit as read
    residual = pixels.light - 0.5 * (seen + (1 - albedo) * units[:, 0])
    paint = (units * np.square((DARK_SPREAD, WHITE_SPREAD))) @ units.T
    covariance = 0.25 * (smooth * np.outer(seen, seen) + paint) + added
    expected = scipy.stats.multivariate_normal(np.zeros(count), covariance).logpdf(residual)
    assert found[0, 4] == pytest.approx(expected + constant, rel=3e-4, abs=0.01)  # single precision
