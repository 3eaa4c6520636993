"""A veil of glare: told from shade and from spots of paint, and taken off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.decoders.plate.decode_symbols import DecodedSymbols
from app.decoders.plate.evidence import MAX_TENTATIVE_ERROR, MAX_VEILED_ERROR, TENTATIVE_CONFIDENCE, _tentative
from app.decoders.plate.fit import PlateFit, fit_plate, homography_from_points, project
from app.decoders.plate.light_field import DARK_SHARE, estimate_veil, uniform_haze, veil_log_odds
from app.decoders.plate.pose import marker_centroids
from app.decoders.plate.unit_likelihoods import code_units, unit_log_likelihoods, verify_units
from app.markers.plate import PlateGeometry, unit_index
from app.markers.reading import PlateOutcome, PlateReading
from app.simulation.camera import RenderedFrame
from app.simulation.plate_scene import Air, PlacedFace, PlateScene, Sensor
from tests.decoders.plate.scenes import AHEAD_M, PAPER, face_of, shoot

GEOMETRY = PlateGeometry()
CORNERS = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
DARK = code_units(PAPER)
ORDER = unit_index(8).reshape(-1)
ROWS, COLUMNS = (v[ORDER] for v in np.divmod(np.arange(64), 8))
COVARIANCE = np.eye(48) * 1e-5


def units_of(light: np.ndarray | float, veil: np.ndarray | float) -> np.ndarray:
    """Light of the units of a plate, with some noise."""
    wear = np.random.default_rng(2).normal(0, 0.01, 48)
    return 0.4 * (light * np.where(DARK, DARK_SHARE, 1.0) + veil + wear)


def glare(row: float, column: float, units: float) -> np.ndarray:
    return 0.5 * np.exp(-0.5 * ((ROWS - row) ** 2 + (COLUMNS - column) ** 2) / units**2)


def log_odds(values: np.ndarray) -> float:
    ranked = np.sort(values)
    haze = uniform_haze(float(ranked[:6].mean()), float(ranked[-6:].mean()), 8)
    _veil, dark = estimate_veil(values, COVARIANCE, float(ranked[-6:].mean() - ranked[:6].mean()), 8)
    return veil_log_odds(values, COVARIANCE, haze, [dark, DARK], 8)


@pytest.mark.parametrize(("row", "column"), [(2, 5), (4, 3), (7, 1)])
def test_glare_is_a_veil_and_comes_off(row: int, column: int) -> None:
    values = units_of(1.0, glare(row, column, 2.5))
    veil, dark = estimate_veil(values, COVARIANCE, float(np.ptp(values)), 8)
    assert (dark == DARK).all()
    assert log_odds(values) > 5
    rest = values - veil.light.reshape(-1)[ORDER]
    assert rest[DARK].max() < 0.5 * rest[~DARK].min()


def test_shade_is_no_veil() -> None:
    assert log_odds(units_of(np.where(ROWS + COLUMNS < 6, 0.4, 1.0), 0.0)) < 0


@pytest.mark.parametrize("tone", [0.3, 0.6])
def test_a_grey_unit_is_no_veil(tone: float) -> None:
    values = units_of(1.0, 0.0)
    for unit in (8, 20, 33):
        changed = values.copy()
        changed[unit] = 0.4 * tone
        assert log_odds(changed) < 0


def shot_in_glare(peak: float) -> tuple[RenderedFrame, PlateFit]:
    def change(scene: PlateScene) -> PlateScene:
        return replace(scene, air=Air(glare=peak, glare_at_m=(0.05, 0.05), glare_size_m=(0.06, 0.1)))

    shot = shoot(PlacedFace(face_of(), AHEAD_M), change=change, sensor=Sensor(gain=0.5))
    to_image = np.append(homography_from_points(CORNERS, shot.truths[0].corners_px), 1.0).reshape(3, 3)
    fit = fit_plate(shot.image, project(to_image, marker_centroids(GEOMETRY)), GEOMETRY)
    assert fit is not None
    return shot, fit


def test_a_plate_in_glare_is_as_it_looks() -> None:
    shot, fit = shot_in_glare(0.35)
    units = unit_log_likelihoods(fit)
    assert units is not None
    assert not units.veils[0].is_even
    assert (units.dark == DARK).all()
    found = verify_units(shot.image, fit, GEOMETRY, DARK, units)
    assert found is not None
    assert found.error_probability < MAX_VEILED_ERROR
    flipped = DARK.copy()
    flipped[20] = not flipped[20]
    wrong = verify_units(shot.image, fit, GEOMETRY, flipped, units)
    assert wrong is not None
    assert wrong.unit_errors[20] > 0.99


def test_a_thermal_frame_has_no_glare() -> None:
    _shot, fit = shot_in_glare(0.35)
    units = unit_log_likelihoods(fit, thermal=True)
    assert units is not None
    assert [veil.is_even for veil in units.veils] == [True]


def test_the_confidence_of_tentative_readings_falls_with_the_error() -> None:
    reading = PlateReading(PlateOutcome.UNSURE)
    shown = [
        _tentative(reading, DecodedSymbols(None, 1 - error, (1 - error,) * 12, likely=PAPER))
        for error in (2e-4, 0.01, 0.05, MAX_TENTATIVE_ERROR)
    ]
    assert all(one.likely_code == PAPER for one in shown)
    found = [one.confidence for one in shown]
    assert TENTATIVE_CONFIDENCE > found[0] > found[1] > found[2] > found[3] > 0.7
    refused = _tentative(reading, DecodedSymbols(None, 0.89, (0.89,) * 12, likely=PAPER))
    assert refused.likely_code is None
