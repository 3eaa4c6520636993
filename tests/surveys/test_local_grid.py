"""Local grids: the similarity transformation, its residuals, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.formats.surveys.declaration import ControlPoint, ImportDeclaration, LocalGrid
from app.formats.surveys.read import read_survey
from app.formats.surveys.table import SurveyTable
from app.surveys.georeference import LocalGridDocument, apply_local_grid, fit_similarity

# A triangle of 300, 400 and 500 m, turned by the angle whose cosine is 0.8 and sine 0.6, and shifted: by hand
CONTROL = (("C1", 457000.0, 5428000.0), ("C2", 457240.0, 5428180.0), ("C3", 456760.0, 5428320.0))
LOCAL = {"C1": (1000.0, 2000.0), "C2": (1300.0, 2000.0), "C3": (1000.0, 2400.0)}
ROWS = "point,easting,northing\nM1,1100.0,2000.0\nM2,1100.0,2100.0\n"


def _apply(
    text: str = ROWS,
    *,
    moved: dict[str, tuple[float, float]] | None = None,
    declared_local: bool = True,
    unit: str | None = None,
    **grid: Any,
) -> tuple[SurveyTable, LocalGridDocument]:
    places = {**LOCAL, **(moved or {})}
    points = tuple(
        ControlPoint(name, east, north, *(places[name] if declared_local else ())) for name, east, north in CONTROL
    )
    declaration = ImportDeclaration(
        crs="EPSG:25832", layout="named", unit=unit, local_grid=LocalGrid(**{"control_points": points, **grid})
    )
    table, document = apply_local_grid(read_survey(text.encode(), declaration), declaration)
    assert document is not None
    return table, document


def test_points_of_a_local_grid() -> None:
    table, document = _apply()
    # M1: 100 m along C1-C2: (80, 60); M2: further 100 m to the left of it: (-60, 80)
    assert table.first == pytest.approx([457080.0, 457020.0], abs=1e-6)
    assert table.second == pytest.approx([5428060.0, 5428140.0], abs=1e-6)
    assert table.written is not None
    assert table.written[0].tolist() == [1100.0, 1100.0]
    assert document["rotation_deg"] == pytest.approx(36.8698976, abs=1e-6)  # atan2(3, 4)
    assert (document["scale_ppm"], document["max_m"]) == (0.0, 0.0)
    assert [point["point"] for point in document["control_points"]] == ["C1", "C2", "C3"]
    assert not table.faults.counts


def test_a_free_scale() -> None:
    longer = {name: (x * 1.0004, y * 1.0004) for name, (x, y) in LOCAL.items()}
    with pytest.raises(InvalidParameter, match="do not fit each other"):
        _apply(moved=longer)
    _table, document = _apply(moved=longer, scale="free")
    assert document["scale_ppm"] == pytest.approx(-399.84, abs=0.01)  # 1 / 1.0004 - 1
    assert document["max_m"] == 0.0


def test_residuals_are_reported_and_limited() -> None:
    moved = {"C2": (1300.0, 2000.06)}
    _table, document = _apply(moved=moved)
    assert 0.01 < document["max_m"] <= 0.05
    squares = [point["east_m"] ** 2 + point["north_m"] ** 2 for point in document["control_points"]]
    assert document["rmse_m"] == pytest.approx(np.sqrt(np.mean(squares)), abs=1e-4)
    with pytest.raises(InvalidParameter, match=r"residual of 'C\d' is 0\.\d+ m") as caught:
        _apply(moved=moved, limit_m=0.005)
    assert caught.value.limit == "residuals of 0.005 m"


def test_swapped_local_axes_are_recognised() -> None:
    with pytest.raises(InvalidParameter) as caught:
        _apply(moved={name: (y, x) for name, (x, y) in LOCAL.items()})
    assert "swap easting and northing" in str(caught.value.cure)


def test_control_points_of_the_file() -> None:
    rows = "".join(f"{name},{x},{y}\n" for name, (x, y) in LOCAL.items())
    table, document = _apply(ROWS + rows, declared_local=False)
    assert table.first == pytest.approx([457080.0, 457020.0, 457000.0, 457240.0, 456760.0], abs=1e-6)
    assert document["max_m"] == 0.0
    assert table.faults.counts == {"control_point": 3}
    with pytest.raises(InvalidParameter, match="'C1' is not in the file"):
        _apply(ROWS, declared_local=False)
    with pytest.raises(InvalidParameter, match="2 rows have the number"):
        _apply(ROWS + rows + rows, declared_local=False)


def test_a_local_grid_in_feet() -> None:
    feet = {name: (x / 0.3048, y / 0.3048) for name, (x, y) in LOCAL.items()}
    text = f"point,easting,northing\nM1,{1100 / 0.3048:.6f},{2000 / 0.3048:.6f}\nM2,{1100 / 0.3048},{2100 / 0.3048}\n"
    table, document = _apply(text, moved=feet, unit="ft-intl")
    assert table.first * 0.3048 == pytest.approx([457080.0, 457020.0], abs=1e-5)
    assert document["max_m"] == pytest.approx(0.0, abs=1e-6)


def test_far_rows_and_odd_scales_are_warned_of() -> None:
    far = ROWS + "M3,9000.0,2000.0\n"
    assert _apply(far)[0].faults.counts == {"far_from_control": 1}
    half = {name: (x / 2, y / 2) for name, (x, y) in LOCAL.items()}
    assert _apply(moved=half, scale="free")[0].faults.counts["local_scale"] == 1


def test_too_few_or_equal_control_points() -> None:
    for scale, count in (("fixed", 1), ("free", 2)):
        with pytest.raises(InvalidParameter, match="leave no residuals"):
            LocalGrid(tuple(ControlPoint(f"C{k}", 0, 0) for k in range(count)), scale)
    with pytest.raises(InvalidParameter, match="declared twice"):
        LocalGrid((ControlPoint("C", 0, 0), ControlPoint("C", 1, 1)))
    with pytest.raises(InvalidParameter, match="at one place"):
        fit_similarity(np.array([1j, 1j]), np.array([0j, 1j]), "fixed")


def test_least_squares_agrees_with_a_general_solver() -> None:
    """The closed form has the residuals of numpy's least squares with the four parameters."""
    rng = np.random.default_rng(3)
    local = rng.uniform(0, 500, 6) + 1j * rng.uniform(0, 500, 6)
    known = (0.8 + 0.6j) * 1.0003 * local + 457000 + 5428000j + rng.normal(0, 0.02, 6) + 1j * rng.normal(0, 0.02, 6)
    design = np.zeros((12, 4))
    design[:6] = np.column_stack([local.real, -local.imag, np.ones(6), np.zeros(6)])
    design[6:] = np.column_stack([local.imag, local.real, np.zeros(6), np.ones(6)])
    solved, *_ = np.linalg.lstsq(design, np.concatenate([known.real, known.imag]), rcond=None)
    fit = fit_similarity(local, known, "free")
    assert (fit.factor.real, fit.factor.imag) == pytest.approx(solved[:2], abs=1e-7)
    expected = design @ solved
    assert fit(local).real == pytest.approx(expected[:6], abs=1e-4)
    assert fit(local).imag == pytest.approx(expected[6:], abs=1e-4)
