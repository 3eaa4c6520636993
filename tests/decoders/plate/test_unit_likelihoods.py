"""What the units of a fit say, and when they say nothing."""

from __future__ import annotations

import numpy as np

from app.decoders.plate.decode_symbols import MAX_DAMAGE, decode_symbols
from app.decoders.plate.fit import PlateFit
from app.decoders.plate.pose import unit_edges, unit_shapes
from app.decoders.plate.synthesis import NORMAL_TABLE, PlateModel
from app.decoders.plate.unit_likelihoods import unit_log_likelihoods
from app.markers.plate import PlateCode, PlateGeometry
from tests.decoders.plate.scenes import PAPER

N, SIDE_PX, MIN_CONFIDENCE = 8, 40.0, 0.9995


def fit_of(
    units: np.ndarray, *, motion: float = 0.0, blur_px: float = 0.8, misfit: np.ndarray | None = None
) -> PlateFit:
    """A fit that found these units on a plate of five pixels a unit."""
    corner = np.zeros((N, N), dtype=bool)
    corner[np.ix_([0, 1, N - 2, N - 1], [0, 1, N - 2, N - 1])] = True
    order = np.flatnonzero(~corner.reshape(-1))
    return PlateFit(
        plate_from_image=np.diag([1 / SIDE_PX, 1 / SIDE_PX, 1.0]),
        units=np.where(corner, np.nan, units),
        units_covariance=1e-5 * np.eye(len(order)),
        unit_order=order,
        unit_misfit=np.full((N, N), 1e-4) if misfit is None else misfit,
        markers=np.full(5, 0.3),
        gap=0.1,
        road=0.2,
        corners_px=SIDE_PX * np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]),
        corners_covariance_px2=0.01 * np.eye(8),
        residual=0.01,
        explained=0.99,
        blur_px=blur_px,
        motion=motion,
        pixels=900,
        model=PlateModel(
            unit_edges(PlateGeometry(N)),
            unit_shapes(N),
            np.array([0.0, 0.0, 1.0]),
            np.zeros(10),
            np.zeros(61),
            NORMAL_TABLE,
        ),
    )


def levels(code: PlateCode) -> np.ndarray:
    """Light of a plate's units with a little wear."""
    return np.where(code.units, 0.1, 0.6) + 0.01 * np.random.default_rng(0).standard_normal((N, N))


def test_a_smear_over_more_than_a_unit_is_believed_less() -> None:
    short, long = (unit_log_likelihoods(fit_of(levels(PAPER), motion=motion)) for motion in (0.1, 0.2))
    assert short is not None
    assert long is not None
    np.testing.assert_allclose(long.cell_margin, short.cell_margin / (0.2 * N) ** 2)


def test_a_stain_counts_only_where_some_unit_is_an_outlier_as_well() -> None:
    values, misfit = levels(PAPER), np.full((N, N), 1e-4)
    row, column = np.argwhere(PAPER.units)[5]
    misfit[row, column] = 50e-4
    clean, edge = unit_log_likelihoods(fit_of(values)), unit_log_likelihoods(fit_of(values, misfit=misfit))
    values[tuple(np.argwhere(PAPER.units)[7])] += 0.05
    both = unit_log_likelihoods(fit_of(values, misfit=misfit))
    assert clean is not None
    assert edge is not None
    assert both is not None
    assert clean.damage < edge.damage < MAX_DAMAGE < both.damage
    assert decode_symbols(edge, N, (), MIN_CONFIDENCE).code == PAPER
    assert decode_symbols(both, N, (), MIN_CONFIDENCE).code is None
    assert decode_symbols(both, N, (PAPER,), MIN_CONFIDENCE).code == PAPER


def test_units_that_blur_into_each_other_have_less_weight_and_outliers_are_refused() -> None:
    short, long = (unit_log_likelihoods(fit_of(levels(PAPER), motion=motion)) for motion in (0.25, 0.3))
    values = levels(PAPER)
    values[tuple(np.argwhere(PAPER.units)[7])] += 0.14
    sharp, smeared = (
        unit_log_likelihoods(fit_of(values)),
        unit_log_likelihoods(fit_of(values, motion=0.135, blur_px=3.5)),
    )
    assert short is not None
    assert long is not None
    assert sharp is not None
    assert smeared is not None
    assert (long.cell_margin < short.cell_margin * (0.25 / 0.3) ** 3).all()  # twice for a smear, as much for the spread
    assert decode_symbols(sharp, N, (), MIN_CONFIDENCE).code == PAPER
    assert decode_symbols(smeared, N, (), MIN_CONFIDENCE).code is None
    assert decode_symbols(smeared, N, (PAPER,), MIN_CONFIDENCE).code == PAPER


def test_a_check_that_is_spent_on_a_correction_confirms_nothing_beside_a_stain() -> None:
    code = PlateCode.from_registry_number(0xDEADBEEF)
    misfit = np.full((N, N), 1e-4)
    misfit[tuple(np.argwhere(code.units)[5])] = 50e-4
    values = levels(code)
    values[tuple(np.argwhere(code.units)[7])] += 0.05
    whole = unit_log_likelihoods(fit_of(values, misfit=misfit))
    row, column = np.argwhere(code.units)[9]
    values[row, column] = 0.6
    wrong, clean = unit_log_likelihoods(fit_of(values, misfit=misfit)), unit_log_likelihoods(fit_of(values))
    assert whole is not None
    assert wrong is not None
    assert clean is not None
    assert min(whole.damage, wrong.damage) > MAX_DAMAGE
    assert decode_symbols(whole, N, (), MIN_CONFIDENCE).code == code
    assert decode_symbols(wrong, N, (), MIN_CONFIDENCE).code is None
    assert decode_symbols(clean, N, (), MIN_CONFIDENCE).corrected
    assert decode_symbols(wrong, N, (code,), MIN_CONFIDENCE).code == code
