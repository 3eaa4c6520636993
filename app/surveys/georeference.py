"""Positions of a survey's rows in WGS 84, and the positions that other readings of the same numbers would give."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from app.errors import WaymarkError
from app.formats.surveys.declaration import METRES, ImportDeclaration
from app.formats.surveys.grids import unit_factor, without_zone
from app.formats.surveys.table import Change, Floats, SurveyTable
from app.geodesy import PlacedPositions, place_positions, reference_system

_M_PER_DEG = 111_195.0  # [m/deg] on a sphere of 6371 km, the Earth's mean radius
_SAMPLE = 40  # rows that other readings are tried on; chosen by hand
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
    """A survey with the positions of its rows.

    Attributes
    ----------
    table : SurveyTable
    placed : PlacedPositions
    east_m, north_m : ndarray, shape (N,)
        From the median position; good for distances of a few kilometres; NaN where a row has no position. [m]
    height_m : ndarray, shape (N,)
        Above the vertical datum of the declaration; NaN where there is none. [m]
    """

    table: SurveyTable
    placed: PlacedPositions
    east_m: Floats
    north_m: Floats
    height_m: Floats

    @property
    def origin_deg(self) -> tuple[float, float]:
        """Median longitude and latitude. [deg]"""
        return median_deg(self.placed)


@dataclass(frozen=True, slots=True)
class Alternative:
    """Another reading of the coordinates, and the median position that it gives."""

    code: str
    proposal: str
    changes: tuple[Change, ...]
    lon_deg: float
    lat_deg: float


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
    return GeoreferencedSurvey(table, placed, east, north, height)


def without_rows(table: SurveyTable, rows: Sequence[int]) -> SurveyTable:
    """A table whose rows of these numbers, counted from 1, have no coordinates and no faults."""
    if not rows:
        return table
    table.faults.leave_out(rows)
    indices = [row - 1 for row in rows if row <= table.rows]
    height = None if table.height is None else _without(table.height, indices)
    return replace(
        table, first=_without(table.first, indices), second=_without(table.second, indices), height=height
    )  # fmt: skip


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
    found = []
    for code, proposal, first, second, crs in _readings(table, table.first[rows], table.second[rows]):
        changes = _changes_of(code, proposal, crs, table, declaration)
        try:
            placed = place_positions(
                first, second, np.full(len(rows), np.nan), crs=crs, realization=declaration.realization
            )
        except WaymarkError:
            continue
        if len(rows) and placed.placed.mean() > 0.5:
            found.append(Alternative(code, proposal, changes, *median_deg(placed)))
    return found


def _changes_of(
    code: str, proposal: str, crs: str, table: SurveyTable, declaration: ImportDeclaration
) -> tuple[Change, ...]:
    """What has to be declared for another reading; nothing where the file has to be changed."""
    if code == "swapped_axes":
        return _swapped(table, declaration)
    if code == "wrong_zone":
        return (Change("crs", crs),)
    unit = proposal.removeprefix(_DECLARE_UNIT)
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


def _readings(table: SurveyTable, first: Floats, second: Floats) -> Iterator[tuple[str, str, Floats, Floats, str]]:
    """Code, proposal, and the coordinates with the CRS of each other reading."""
    crs = table.crs
    factor = unit_factor(table.unit, reference_system(crs))
    first, second = first * factor, second * factor
    names = ("easting", "northing") if table.projected else ("lon_deg", "lat_deg")
    swapped = _without_zone(second, crs)
    yield "swapped_axes", f"swap the columns of {names[0]} and {names[1]}", swapped, first, crs
    yield "wrong_sign", f"give {names[0]} the other sign", -first, second, crs
    yield "wrong_sign", f"give {names[1]} the other sign", first, -second, crs
    yield "wrong_sign", "give both coordinates the other sign", -first, -second, crs
    if not table.projected:
        yield "degrees_minutes", "write ddmm.mmmm as decimal degrees", _from_dm(first), _from_dm(second), crs
        yield "degrees_minutes", "write D.MMSS as decimal degrees", _from_dms(first), _from_dms(second), crs
        for power in (6, 7):
            proposal = f"divide the coordinates by 10^{power}"
            yield "wrong_unit", proposal, first / 10**power, second / 10**power, crs
        return
    for factor, proposal in _THOUSANDS:
        yield "wrong_unit", proposal, first * factor, second * factor, crs
    for unit in METRES:
        if unit != table.unit:
            change = METRES[unit] / METRES[table.unit]
            yield "wrong_unit", f"{_DECLARE_UNIT}{unit}", first * change, second * change, crs
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
