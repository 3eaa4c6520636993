"""Positions of a survey's rows in WGS 84, and the positions that other readings of the same numbers would give."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field
from typing_extensions import TypedDict

from app.errors import InvalidParameter, WaymarkError
from app.formats.surveys.coordinates import crs_unit, unit_factor, without_zone
from app.formats.surveys.declaration import METRES, ControlPoint, ImportDeclaration, LocalGrid
from app.formats.surveys.table import Change, Fault, SurveyTable, Texts, warn
from app.geodesy import PlacedPositions, place_positions, reference_system
from app.values import Floats

# === Surveys in a local grid: a similarity transformation to the CRS by least squares, checked by its residuals.


Complex = npt.NDArray[np.complex128]
_FIELD = "local_grid.control_points"
_MAX_SCALE_PPM = 1000.0
"""Scale of a local grid beyond which a warning is given. [1e-6] UTM has up to 400 ppm, a height of 2000 m 314 ppm."""
_REACH = 3.0  # [1] times the extent of the control points beyond which errors of them dominate


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
    """A similarity transformation of the plane, with points as complex numbers: east + i north."""

    factor: complex  # scale and rotation
    # `local_origin`, `origin`: centroids of the control points in both grids
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
                f"{count} rows have the number of the control point {control.point[:40]!r}",
                field=_FIELD,
                limit="one row",
                cure="declare local_easting and local_northing of the control point",
            )
    return {name: rows[0] if rows else None for name, rows in found.items()}


def _local(table: SurveyTable, control: ControlPoint, row: int | None) -> complex:
    """Place of a control point in the local grid: declared, or that of its row."""
    if control.local_easting is not None and control.local_northing is not None:
        return complex(control.local_easting, control.local_northing)
    if row is None or not np.isfinite(table.first[row] + table.second[row]):
        raise InvalidParameter(
            f"the control point {control.point[:40]!r} is not in the file",
            field=_FIELD,
            limit="a row with its number and coordinates",
            cure="declare its local_easting and local_northing, or the column of the point numbers",
        )
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


# === Positions of a survey's rows in WGS 84, and the positions that other readings of the same numbers would give.


_M_PER_DEG = 111_195.0  # [m/deg] on a sphere of 6371 km, the Earth's mean radius
_SAMPLE = 40  # rows that other readings are tried on
_THOUSANDS = (
    (1000.0, "multiply the coordinates by 1000; in a drawing whose $INSUNITS is not their unit declare unit"),
    (0.001, "divide the coordinates by 1000: they seem to be millimetres"),
)
_DECLARE_UNIT = "declare unit "
_OTHER_ORDER = {"pnezd": "penzd", "penzd": "pnezd", "nezd": "enzd", "enzd": "nezd"}
_ZONES = (  # first and last EPSG code of the zones of a grid, and its name; source: EPSG registry
    (32601, 32660, "WGS 84 / UTM north"),
    (32701, 32760, "WGS 84 / UTM south"),
    (25828, 25838, "ETRS89 / UTM"),
    (26901, 26923, "NAD83 / UTM"),
    (26701, 26722, "NAD27 / UTM"),
    (6330, 6348, "NAD83(2011) / UTM"),
    (31466, 31469, "DHDN / Gauss-Kruger"),
)


@dataclass(frozen=True, slots=True)
class GeoreferencedSurvey:
    """A survey with the positions of its rows."""

    table: SurveyTable
    placed: PlacedPositions
    # `east_m`, `north_m`: shape (N,): [m] from the median position; good for distances of a few kilometres; NaN where a
    # row has no position
    east_m: Floats
    north_m: Floats
    # shape (N,): [m] above the vertical datum of the declaration; ellipsoidal ones in WGS 84 / ITRF, as the positions;
    # NaN where there is none
    height_m: Floats

    @property
    def origin_deg(self) -> tuple[float, float]:
        """Median longitude and latitude. [deg]"""
        return median_deg(self.placed)


@dataclass(frozen=True, slots=True)
class Alternative:
    """Another reading of coordinates, and the median position that it gives."""

    code: str
    proposal: str
    crs: str
    lon_deg: float
    lat_deg: float
    changes: tuple[Change, ...] = ()  # what has to be declared for it; nothing where the file has to be changed


def georeference_survey(table: SurveyTable, declaration: ImportDeclaration, accuracy_m: float) -> GeoreferencedSurvey:
    """Positions of all rows; NaN for a row whose coordinates cannot be transformed.

    Raises
    ------
    ReferenceSystemError
        The CRS or its transformation cannot be used.
    """
    height = np.full(table.rows, np.nan) if table.height is None else table.height * METRES[table.height_unit]
    factor = unit_factor(table.unit, reference_system(table.crs))
    placed = place_positions(
        table.first * factor,
        table.second * factor,
        height,
        crs=table.crs,
        realization=declaration.realization,
        epoch=declaration.epoch,
        ellipsoidal_height=declaration.vertical_datum == "ellipsoid",
        accuracy_m=accuracy_m,
    )
    east, north = east_north_m(placed.lon_deg, placed.lat_deg, median_deg(placed))
    return GeoreferencedSurvey(table, placed, east, north, np.where(placed.placed, placed.height_m, height))


def without_rows(table: SurveyTable, rows: Sequence[int]) -> SurveyTable:
    """A table whose rows of these numbers, counted from 1, have no coordinates and no faults."""
    if not rows:
        return table
    table.faults.leave_out(rows)
    indices = [row - 1 for row in rows if row <= table.rows]
    height = None if table.height is None else _without(table.height, indices)
    return replace(table, first=_without(table.first, indices), second=_without(table.second, indices), height=height)


def _without(values: Floats, indices: Sequence[int]) -> Floats:
    kept = values.copy()
    kept[indices] = np.nan
    return kept


def median_deg(placed: PlacedPositions) -> tuple[float, float]:
    """Median longitude and latitude of the rows that have a position; NaN without any. [deg]"""
    if not placed.placed.any():
        return float("nan"), float("nan")
    return float(np.median(placed.lon_deg[placed.placed])), float(np.median(placed.lat_deg[placed.placed]))


def east_north_m(lon_deg: Floats, lat_deg: Floats, origin_deg: tuple[float, float]) -> tuple[Floats, Floats]:
    """East and north of an origin on a sphere. [m]"""
    across = (lon_deg - origin_deg[0] + 180.0) % 360.0 - 180.0
    return across * _M_PER_DEG * np.cos(np.radians(origin_deg[1])), (lat_deg - origin_deg[1]) * _M_PER_DEG


def list_alternatives(table: SurveyTable, declaration: ImportDeclaration) -> list[Alternative]:
    """Readings of the same numbers that differ from the declaration in one respect: axes, sign, unit, zone."""
    finite = np.flatnonzero(np.isfinite(table.first) & np.isfinite(table.second))
    rows = finite[:: max(len(finite) // _SAMPLE, 1)]
    readings = list_readings(table.first[rows], table.second[rows], table.crs, table.unit, declaration.realization)
    return [replace(reading, changes=_changes_of(reading, table, declaration)) for reading in readings]


def list_readings(first: Floats, second: Floats, crs: str, unit: str, realization: str | None) -> Iterator[Alternative]:
    """Readings of coordinates in a CRS and a unit that differ in one respect: axes, sign, unit, zone."""
    no_heights = np.full(len(first), np.nan)
    for code, proposal, other_first, other_second, other_crs in _readings(first, second, crs, unit):
        try:
            placed = place_positions(other_first, other_second, no_heights, crs=other_crs, realization=realization)
        except WaymarkError:
            continue
        if len(first) and placed.placed.mean() > 0.5:
            yield Alternative(code, proposal, other_crs, *median_deg(placed))


def _changes_of(reading: Alternative, table: SurveyTable, declaration: ImportDeclaration) -> tuple[Change, ...]:
    if reading.code == "swapped_axes":
        return _swapped(table, declaration)
    if reading.code == "wrong_zone":
        return (Change("crs", reading.crs),)
    unit = reading.proposal.removeprefix(_DECLARE_UNIT)
    return (Change("unit", unit),) if unit in METRES else ()


def _swapped(table: SurveyTable, declaration: ImportDeclaration) -> tuple[Change, ...]:
    """The layout or the columns with the axes in the other order, as far as they are known by their names."""
    found = {detected.what: detected.value for detected in table.detected}
    layout = declaration.layout or found.get("layout")
    if layout in _OTHER_ORDER:
        return (Change("layout", _OTHER_ORDER[layout]),)
    roles = ("easting", "northing") if table.projected else ("lon_deg", "lat_deg")
    columns = [declaration.columns.get(role) or found.get(f"column of {role}") for role in roles]
    if None in columns:
        return ()
    return Change(f"columns.{roles[0]}", columns[1]), Change(f"columns.{roles[1]}", columns[0])


def _readings(first: Floats, second: Floats, crs: str, unit: str) -> Iterator[tuple[str, str, Floats, Floats, str]]:
    """Code, proposal, and the coordinates with the CRS of each other reading."""
    system = reference_system(crs)
    factor = unit_factor(unit, system)
    first, second = first * factor, second * factor
    names = ("easting", "northing") if system.is_projected else ("lon_deg", "lat_deg")
    swapped = _without_zone(second, crs)
    yield "swapped_axes", f"swap the columns of {names[0]} and {names[1]}", swapped, first, crs
    yield "wrong_sign", f"give {names[0]} the other sign", -first, second, crs
    yield "wrong_sign", f"give {names[1]} the other sign", first, -second, crs
    yield "wrong_sign", "give both coordinates the other sign", -first, -second, crs
    if not system.is_projected:
        yield "degrees_minutes", "write ddmm.mmmm as decimal degrees", _from_dm(first), _from_dm(second), crs
        yield "degrees_minutes", "write D.MMSS as decimal degrees", _from_dms(first), _from_dms(second), crs
        for power in (6, 7):
            proposal = f"divide the coordinates by 10^{power}"
            yield "wrong_unit", proposal, first / 10**power, second / 10**power, crs
        return
    for factor, proposal in _THOUSANDS:
        yield "wrong_unit", proposal, first * factor, second * factor, crs
    for other_unit in METRES:
        if other_unit != unit:
            change = METRES[other_unit] / METRES[unit]
            yield "wrong_unit", f"{_DECLARE_UNIT}{other_unit}", first * change, second * change, crs
    yield from ((code, proposal, first, second, other) for code, proposal, other in _sibling_zones(crs))


def _without_zone(easting: Floats, crs: str) -> Floats:
    """Eastings without the number of the zone; as they are where it is that of another zone."""
    try:
        return without_zone(easting, reference_system(crs))[0]
    except WaymarkError:
        return easting


def _sibling_zones(crs: str) -> Iterator[tuple[str, str, str]]:
    """The other zones of the grid, nearest first, and the same zone of other grids."""
    if not crs.startswith("EPSG:"):
        return
    code = int(crs[5:])
    for first, last, name in _ZONES:
        if first <= code <= last:
            for step in (-1, 1, -2, 2, -3, 3):
                if first <= code + step <= last:
                    yield "wrong_zone", f"declare crs EPSG:{code + step} ({name})", f"EPSG:{code + step}"
            if first in (32601, 32701):
                other = code + (100 if first == 32601 else -100)
                yield "wrong_zone", f"declare crs EPSG:{other} (the other hemisphere)", f"EPSG:{other}"


def _from_dm(value: Floats) -> Floats:
    magnitude = np.abs(value)
    degrees = np.floor(magnitude / 100)
    decimal: Floats = np.sign(value) * (degrees + (magnitude - 100 * degrees) / 60)
    return decimal


def _from_dms(value: Floats) -> Floats:
    magnitude = np.abs(value)
    degrees = np.floor(magnitude)
    minutes = np.floor((magnitude - degrees) * 100)
    seconds = ((magnitude - degrees) * 100 - minutes) * 100
    decimal: Floats = np.sign(value) * (degrees + minutes / 60 + seconds / 3600)
    return decimal
