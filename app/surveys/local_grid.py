"""Surveys in a local grid: a similarity transformation to the CRS by least squares, checked by its residuals."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from itertools import chain
from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field
from typing_extensions import TypedDict

from app.errors import InvalidParameter
from app.formats.surveys.declaration import METRES, ControlPoint, ImportDeclaration, LocalGrid
from app.formats.surveys.grids import crs_unit, unit_factor
from app.formats.surveys.table import Fault, SurveyTable, Texts, warn
from app.geodesy import reference_system

Complex = npt.NDArray[np.complex128]
_FIELD = "local_grid.control_points"
_MAX_SCALE_PPM = 1000.0
"""Scale of a local grid beyond which a warning is given. [1e-6] UTM has up to 400 ppm, a height of 2000 m 314 ppm."""
_REACH = 3.0  # [1] times the extent of the control points beyond which errors of them dominate; chosen by hand


class ControlResidual(TypedDict):
    """Transformed position minus declared position of a control point."""

    point: str
    east_m: float
    north_m: float


class LocalGridDocument(TypedDict):
    """The transformation of a local grid to the CRS."""

    scale: str
    scale_ppm: Annotated[float, Field(description="Scale minus 1, in millionths.")]
    rotation_deg: Annotated[float, Field(description="From the local east to the east of the CRS, counterclockwise.")]
    rmse_m: float
    max_m: float
    limit_m: float
    control_points: list[ControlResidual]


class Similarity(NamedTuple):
    """A similarity transformation of the plane, with points as complex numbers: east + i north.

    Attributes
    ----------
    factor : complex
        Scale and rotation.
    local_origin, origin : complex
        Centroids of the control points in both grids.
    """

    factor: complex
    local_origin: complex
    origin: complex

    def __call__(self, local: Complex) -> Complex:
        """Points of the local grid in the CRS."""
        return self.origin + self.factor * (local - self.local_origin)


def fit_similarity(local: Complex, known: Complex, scale: str) -> Similarity:
    """The similarity transformation with the least sum of squared residuals.

    Parameters
    ----------
    local, known : ndarray of complex, shape (N,)
        Control points in the local grid and in the CRS, in one unit.
    scale : str
        ``fixed``: 1, or ``free``.

    Raises
    ------
    InvalidParameter
        All control points are at one place.

    Notes
    -----
    With centred points z and w the factor is sum(conj(z) w) / sum(|z|^2); with scale 1 the same divided by its modulus:
    K. Kraus, Photogrammetry, volume 1, "plane similarity transformation".
    """
    local_origin, origin = complex(local.mean()), complex(known.mean())
    z, w = local - local_origin, known - origin
    product, squares = complex(np.sum(np.conj(z) * w)), float(np.sum(np.abs(z) ** 2))
    if squares == 0 or product == 0:
        raise InvalidParameter(
            "the control points are at one place", field=_FIELD, limit="points apart", cure="declare other points"
        )
    factor = product / squares if scale == "free" else product / abs(product)
    return Similarity(factor, local_origin, origin)


def apply_local_grid(
    table: SurveyTable, declaration: ImportDeclaration
) -> tuple[SurveyTable, LocalGridDocument | None]:
    """The survey in the CRS, and the report on the transformation; None where no local grid is declared.

    Raises
    ------
    InvalidParameter
        A residual exceeds the limit, or a control point is not in the file.
    """
    grid = declaration.local_grid
    if grid is None:
        return table, None
    system = reference_system(table.crs)
    factor, unit_m = unit_factor(table.unit, system), METRES[crs_unit(system)]
    at = _rows_of(table, grid)
    controls = grid.control_points
    local: Complex = np.array([_local(table, control, at[control.point]) * factor for control in controls])
    known: Complex = np.array([complex(control.easting, control.northing) for control in controls])
    fit = fit_similarity(local, known, grid.scale)
    residuals_m = (fit(local) - known) * unit_m
    _check_residuals(grid, residuals_m, local, known, unit_m)
    points = fit(np.asarray((table.first + 1j * table.second) * factor, dtype=np.complex128))
    first, second = points.real / factor, points.imag / factor
    table.faults.add(_warnings(table, grid, at, fit, local, points, known))
    document: LocalGridDocument = {
        "scale": grid.scale,
        "scale_ppm": round((abs(fit.factor) - 1) * 1e6, 3),
        "rotation_deg": round(math.degrees(cmath.phase(fit.factor)), 7),
        "rmse_m": round(float(np.sqrt(np.mean(np.abs(residuals_m) ** 2))), 4),
        "max_m": round(float(np.abs(residuals_m).max()), 4),
        "limit_m": grid.limit_m,
        "control_points": [
            {"point": control.point, "east_m": round(v.real, 4), "north_m": round(v.imag, 4)}
            for control, v in zip(grid.control_points, residuals_m.tolist(), strict=True)
        ],
    }
    return replace(table, first=first, second=second, written=(table.first, table.second)), document


def _rows_of(table: SurveyTable, grid: LocalGrid) -> dict[str, int | None]:
    """Index of the row with the number of each control point; None if there is none."""
    found: dict[str, list[int]] = {control.point: [] for control in grid.control_points}
    parts = table.texts.get("point", Texts()).parts()
    for row, text in enumerate(chain.from_iterable(parts)):
        if text in found:
            found[text].append(row)
    for control in grid.control_points:
        count = len(found[control.point])
        if count > 1 and control.local_easting is None:
            raise InvalidParameter(
                f"{count} rows have the number of the control point {control.point[:40]!r}", field=_FIELD,
                limit="one row", cure="declare local_easting and local_northing of the control point",
            )  # fmt: skip
    return {name: rows[0] if rows else None for name, rows in found.items()}


def _local(table: SurveyTable, control: ControlPoint, row: int | None) -> complex:
    """Place of a control point in the local grid: declared, or that of its row."""
    if control.local_easting is not None and control.local_northing is not None:
        return complex(control.local_easting, control.local_northing)
    if row is None or not np.isfinite(table.first[row] + table.second[row]):
        raise InvalidParameter(
            f"the control point {control.point[:40]!r} is not in the file", field=_FIELD,
            limit="a row with its number and coordinates",
            cure="declare its local_easting and local_northing, or the column of the point numbers",
        )  # fmt: skip
    return complex(table.first[row], table.second[row])


def _check_residuals(grid: LocalGrid, residuals_m: Complex, local: Complex, known: Complex, unit_m: float) -> None:
    worst = int(np.argmax(np.abs(residuals_m)))
    largest_m = float(np.abs(residuals_m[worst]))
    if largest_m <= grid.limit_m:
        return
    cure = "correct or leave out the worst point, declare scale free for grid and ground distances, or another limit_m"
    swapped = local.imag + 1j * local.real
    if np.abs((fit_similarity(swapped, known, grid.scale)(swapped) - known) * unit_m).max() <= grid.limit_m:
        cure = "swap easting and northing of the local grid; the control points then fit"
    shown = ", ".join(
        f"{control.point[:20]} {abs(v):.3f} m"
        for control, v in zip(grid.control_points[:10], residuals_m.tolist(), strict=False)
    )
    raise InvalidParameter(
        f"the control points do not fit each other: the residual of {grid.control_points[worst].point[:40]!r} is "
        f"{largest_m:.3f} m ({shown})",
        field=_FIELD,
        limit=f"residuals of {grid.limit_m:g} m",
        cure=cure,
    )


def _warnings(
    table: SurveyTable,
    grid: LocalGrid,
    at: dict[str, int | None],
    fit: Similarity,
    local: Complex,
    points: Complex,
    known: Complex,
) -> list[Fault]:
    faults = []
    for name, row in at.items():
        if row is not None:
            message = f"the row is the control point {name[:40]!r} and would become a marker"
            faults.append(warn(row + 1, "point", "control_point", message, "leave the row out"))
    if abs(abs(fit.factor) - 1) * 1e6 > _MAX_SCALE_PPM:
        message = f"the scale of the local grid is {abs(fit.factor):.6f}"
        faults.append(warn(None, "local_grid", "local_scale", message, "check unit, and the control points"))
    away = np.abs(points[np.isfinite(points)] - fit.origin)
    if len(away) and away.max() > _REACH * np.abs(known - fit.origin).max():
        times = away.max() / np.abs(known - fit.origin).max()
        message = f"rows lie up to {times:.0f} times as far out as the control points"
        cure = "take control points around the survey: their errors grow with the distance"
        faults.append(warn(None, "local_grid", "far_from_control", message, cure))
    return faults
