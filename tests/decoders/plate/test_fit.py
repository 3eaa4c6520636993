"""The fit's two stages."""

from __future__ import annotations

import numpy as np
import pytest

from app.decoders.plate.fit import finish_fit, fit_coarsely, fit_plate, project, refine_corners
from app.decoders.plate.pose import marker_centroids
from app.markers.plate import PlateGeometry
from app.simulation.plate_scene import PlacedFace
from tests.decoders.plate.scenes import face_of, shoot, shoot_plate

GEOMETRY = PlateGeometry()
UNIT_SQUARE = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])


def centroids_px(corners_px: np.ndarray) -> np.ndarray:
    """Where a plate's marker centroids are, roughly: sides taken as parallel."""
    u, v = marker_centroids(GEOMETRY).T[..., None]
    a, b, c, d = corners_px
    return (1 - u) * (1 - v) * a + u * (1 - v) * b + u * v * c + (1 - u) * v * d


def test_the_coarse_stage_finds_the_plate_and_the_second_one_explains_more() -> None:
    frame = shoot_plate(turn_deg=20.0)
    corners = frame.truths[0].corners_px
    coarse = fit_coarsely(frame.image, centroids_px(corners), GEOMETRY)
    assert coarse is not None
    np.testing.assert_allclose(project(coarse.plate_from_image, corners), UNIT_SQUARE, atol=0.05)
    assert coarse.explained > 0.9
    fit = finish_fit(frame.image, coarse, GEOMETRY)
    assert fit is not None
    np.testing.assert_allclose(project(fit.plate_from_image, corners), UNIT_SQUARE, atol=0.02)


def test_the_residual_stands_out_where_a_unit_is_stained() -> None:
    face = face_of()
    face.reflectance[130:160, 175:200] = 0.2  # on the edge between two units
    frame = shoot(PlacedFace(face, 2.0, 0.0, 20.0))
    fit = fit_plate(frame.image, centroids_px(frame.truths[0].corners_px), GEOMETRY)
    assert fit is not None
    row, column = np.unravel_index(np.argmax(fit.unit_misfit), (8, 8))
    assert row == 3
    assert column in (4, 5)
    assert fit.unit_misfit.max() > 4 * np.median(fit.unit_misfit)


@pytest.mark.parametrize("turn_deg", [-14.0, 8.0, 15.0])
def test_refined_corners_are_not_skewed_by_an_oblique_blur(turn_deg: float) -> None:
    coarse_px, refined_px = [], []
    for seed in range(4):
        frame = shoot(PlacedFace(face_of(), 4.6 + 0.2 * seed, 0.3, turn_deg), seed=seed)
        truth_px = frame.truths[0].corners_px
        fit = fit_plate(frame.image, centroids_px(truth_px), GEOMETRY)
        assert fit is not None
        before_px = fit.corners_px.copy()
        refined = refine_corners(frame.image, fit, GEOMETRY)
        assert refined is not None
        np.testing.assert_array_equal(fit.corners_px, before_px)
        coarse_px.append(before_px - truth_px)
        refined_px.append(refined[0] - truth_px)
        assert np.linalg.eigvalsh(refined[1]).min() > 0
    coarse, fine = (float(np.sqrt(np.mean(np.square(errors)))) for errors in (coarse_px, refined_px))
    assert fine < 0.75 * coarse
