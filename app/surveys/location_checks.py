"""Checks of a survey against the declared area, the CRS's area of use and the registered markers around it.

Thresholds without another source were chosen by hand and are checked by `python -m benchmarks.imports`: planted faults
must be found, clean surveys must not be refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.table import Change, Fault, Severity, warn
from app.geodesy import reference_system
from app.surveys.consistency_checks import check_height, nearest_of, zero_coordinate
from app.surveys.georeference import (
    Alternative,
    GeoreferencedSurvey,
    east_north_m,
    list_alternatives,
    list_readings,
)
from app.values import Floats

HasMarkersNear = Callable[[float, float], bool]
"""Whether markers are registered within some kilometres of a longitude and latitude."""

KNOWN_M = 5_000.0
"""Registered markers within this distance confirm that a place is the agency's. [m]"""
NEAR_M = 300.0
"""Registered markers within this distance of a row are compared with it. [m]"""
_MIN_NEAR_SHARE = 0.3  # [1] of rows with a registered marker near, below which the area alone is checked
_BESIDE_M = 20.0  # [m] a survey whose median offset from the registered line is larger runs beside it
_ALREADY_THERE_M = 0.5  # [m] a row within this distance of a registered marker is probably that marker
_HEIGHT_SHIFT_M = 3.0  # [m] difference of heights that is allowed where markers are at the same place
_GRADE = 0.06  # [m/m] grade of the road that is allowed for between a row and a registered marker


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Registered markers around a survey."""

    # `lon_deg`, `lat_deg`, `height_m`: shape (M,): NaN where there is no height
    lon_deg: Floats
    lat_deg: Floats
    height_m: Floats
    vertical_datum: tuple[str | None, ...]


def check_location(
    survey: GeoreferencedSurvey, declaration: ImportDeclaration, neighbours: Neighbours, is_known: HasMarkersNear
) -> Iterator[Fault]:
    """Faults that the declared area, the CRS and the registered markers reveal."""
    yield from _check_range(survey)
    outside = _outside(survey, declaration)
    for row in np.flatnonzero(outside):
        yield Fault(int(row) + 1, "position", "outside_area", "the row lies outside the declared area", _row_cure())
    yield from _check_whole(survey, declaration, outside, is_known, near=len(neighbours.lon_deg) > 0)
    yield from _check_height_range(survey, declaration)
    if survey.placed.placed.any():
        yield from _check_neighbours(survey, declaration, neighbours, is_known)


def _check_range(survey: GeoreferencedSurvey) -> Iterator[Fault]:
    """Rows whose coordinates are numbers and still have no position."""
    table = survey.table
    lost = np.isfinite(table.first) & np.isfinite(table.second) & ~survey.placed.placed
    message = f"the coordinates lie outside the range or the area of use of {table.crs}"
    for row in np.flatnonzero(lost):
        yield Fault(int(row) + 1, "position", "outside_crs", message, _row_cure(table.first[row], table.second[row]))


def _row_cure(first: float = 0.0, second: float = 0.0) -> str:
    shown = f"{first:g}, {second:g}: " if first or second else ""
    return f"{shown}check the order of the axes, signs, decimals, unit and zone"


def _outside(survey: GeoreferencedSurvey, declaration: ImportDeclaration) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    if declaration.area_deg is None:
        return np.zeros(survey.table.rows, dtype=bool)
    west, south, east, north = declaration.area_deg
    lon, lat = survey.placed.lon_deg, survey.placed.lat_deg
    with np.errstate(invalid="ignore"):
        inside = (lon >= west) & (lon <= east) & (lat >= south) & (lat <= north)
    return survey.placed.placed & ~inside


def _check_whole(
    survey: GeoreferencedSurvey,
    declaration: ImportDeclaration,
    outside: np.ndarray[tuple[int], np.dtype[np.bool_]],
    is_known: HasMarkersNear,
    *,
    near: bool,
) -> list[Fault]:
    """One fault for the file if most rows are in the wrong place, with the reading that would correct it."""
    placed = survey.placed.placed
    finite = np.isfinite(survey.table.first) & np.isfinite(survey.table.second)  # of the rows that are not left out
    kept = max(int(finite.sum()), 1)
    if declaration.area_deg is not None:
        if placed.any() and outside.sum() <= 0.5 * placed.sum():
            return []
        west, south, east, north = declaration.area_deg
        hit = _first_hit(survey, declaration, lambda lon, lat: west <= lon <= east and south <= lat <= north)
        message = "most rows lie outside the declared area"
        return [_whole(hit, message, "outside_area", "declare the area the survey lies in, or correct the file")]
    if near or (placed.any() and is_known(*survey.origin_deg)):
        return [] if placed.sum() > 0.5 * kept else [_no_position(survey, declaration, is_known)]
    if not placed.any() or placed.sum() <= 0.5 * kept:
        return [_no_position(survey, declaration, is_known)]
    hit = _first_hit(survey, declaration, is_known)
    if hit is not None:
        return [_elsewhere(hit, _NEAR_OTHERWISE)]
    return [
        warn(
            None,
            "position",
            "place_unchecked",
            "no area is declared and no marker is registered near: the location cannot be checked",
            "declare area_deg, the box that the survey lies in",
        )
    ]


def _no_position(survey: GeoreferencedSurvey, declaration: ImportDeclaration, is_known: HasMarkersNear) -> Fault:
    hit = _first_hit(survey, declaration, is_known) or _first_hit(survey, declaration, lambda _lon, _lat: True)
    return _whole(hit, f"most rows have no position in {survey.table.crs}", "outside_crs", "check the CRS")


def _first_hit(survey: GeoreferencedSurvey, declaration: ImportDeclaration, fits: HasMarkersNear) -> Alternative | None:
    return next((a for a in list_alternatives(survey.table, declaration) if fits(a.lon_deg, a.lat_deg)), None)


def _whole(hit: Alternative | None, message: str, code: str, cure: str) -> Fault:
    return Fault(None, "position", code, message, cure) if hit is None else _elsewhere(hit, message)


_NEAR_OTHERWISE = "no registered marker is near, but another reading of the coordinates is near many"


def _elsewhere(hit: Alternative, message: str) -> Fault:
    """Coordinates that fit when they are read in another way."""
    proposal = f"{hit.proposal}; the survey then fits"
    return Fault(None, "position", hit.code, message, proposal, Severity.REFUSED, hit.changes)


def _check_height_range(survey: GeoreferencedSurvey, declaration: ImportDeclaration) -> Iterator[Fault]:
    if declaration.height_range_m is None:
        return
    low, high = declaration.height_range_m
    with np.errstate(invalid="ignore"):
        outside = np.flatnonzero((survey.height_m < low) | (survey.height_m > high))
    cure = "check the unit of the heights and what they are above (geoid or ellipsoid)"
    for row in outside:
        message = f"the height {survey.height_m[row]:.2f} m is outside {low:g} to {high:g} m"
        yield Fault(int(row) + 1, "height", "height_out_of_range", message, cure)


def _check_neighbours(
    survey: GeoreferencedSurvey, declaration: ImportDeclaration, neighbours: Neighbours, is_known: HasMarkersNear
) -> Iterator[Fault]:
    rows = np.flatnonzero(survey.placed.placed)
    points = np.column_stack([survey.east_m[rows], survey.north_m[rows]])
    others = np.column_stack(east_north_m(neighbours.lon_deg, neighbours.lat_deg, survey.origin_deg))
    if not len(others):
        yield from _area_only(declaration, known=is_known(*survey.origin_deg))
        return
    k = min(3, len(others))
    distance, index = nearest_of(points, others, k)
    close = distance[:, 0] <= NEAR_M
    if close.mean() < _MIN_NEAR_SHARE:
        yield from _area_only(declaration, known=True)
        return
    if not declaration.compare:
        yield from _check_already_there(rows, distance[:, 0], measured_changes(survey))
    yield from _check_beside(points[close], others[index[close]], distance[close])
    yield from _check_heights(survey, declaration, neighbours, rows[close], distance[close], index[close])


def _area_only(declaration: ImportDeclaration, *, known: bool) -> list[Fault]:
    """The warning that even a correct survey of a new road gets: only its area could be checked."""
    if declaration.compare or not (known or declaration.area_deg is not None):
        return []
    inside = "inside the declared area" if declaration.area_deg is not None else "within kilometres of others"
    return [
        warn(
            None,
            "position",
            "place_by_area_only",
            f"no marker is registered within {NEAR_M:g} m: it was only checked that the survey lies {inside}; "
            "a shift of all rows, or heights above another datum, would not be noticed",
            "check one row against the map; declare height_range_m where heights matter",
        )
    ]


def measured_changes(survey: GeoreferencedSurvey) -> tuple[Change, ...]:
    """What has to be declared of a survey that measures registered markers."""
    match = "code" if "code" in survey.table.texts else "nearest"
    return Change("compare", True), Change("match", match)


def _check_already_there(
    rows: np.ndarray[tuple[int], np.dtype[np.intp]], distance_m: Floats, changes: tuple[Change, ...]
) -> Iterator[Fault]:
    already_there = np.flatnonzero(distance_m <= _ALREADY_THERE_M)
    return (_already_there(int(rows[k]) + 1, distance_m[k], changes) for k in already_there)


def _already_there(row: int | None, distance_m: float, changes: tuple[Change, ...] = ()) -> Fault:
    message = f"a registered marker lies {distance_m:.2f} m from here"
    proposal = "declare compare if the survey measures registered markers"
    return warn(row, "position", "marker_already_there", message, proposal, changes)


def _check_beside(points: Floats, nearest: Floats, distance_m: Floats) -> list[Fault]:
    """The survey runs beside the registered line: a wrong datum, zone or scale shifts all rows alike."""
    offsets = distance_m[:, 0]
    if nearest.shape[1] >= 2:
        chord = nearest[:, 1] - nearest[:, 0]
        length = np.hypot(chord[:, 0], chord[:, 1])
        away = points - nearest[:, 0]
        across = np.abs(chord[:, 0] * away[:, 1] - chord[:, 1] * away[:, 0]) / np.maximum(length, 1e-6)
        offsets = np.where(length > 1.0, np.minimum(across, offsets), offsets)
    median = float(np.median(offsets))
    if median <= _BESIDE_M:
        return []
    return [
        warn(
            None,
            "position",
            "beside_the_registered_line",
            f"the survey runs about {median:.0f} m beside the registered markers",
            "check the datum of the CRS, its zone, and whether distances are grid or ground",
        )
    ]


def _check_heights(
    survey: GeoreferencedSurvey,
    declaration: ImportDeclaration,
    neighbours: Neighbours,
    rows: np.ndarray[tuple[int], np.dtype[np.intp]],
    distance_m: Floats,
    index: np.ndarray[tuple[int, int], np.dtype[np.intp]],
) -> list[Fault]:
    if survey.table.height is None:
        return []
    datum = declaration.vertical_datum or "ellipsoid"
    nearest = index[:, 0]
    same = np.array([(neighbours.vertical_datum[k] or "ellipsoid") == datum for k in nearest])
    rise = survey.height_m[rows] - neighbours.height_m[nearest]
    allowed = _HEIGHT_SHIFT_M + _GRADE * distance_m[:, 0]
    comparable, foreign = same & np.isfinite(rise), ~same & np.isfinite(rise)
    if comparable.sum() >= 3 and np.mean(np.abs(rise[comparable]) > allowed[comparable]) > 0.5:
        shift = float(np.median(rise[comparable]))
        message = f"the heights differ by {shift:+.1f} m from those of the registered markers beside them"
        return [warn(None, "height", "height_shift", message, *_height_cure(survey, rows, nearest, neighbours))]
    if not comparable.sum() and foreign.sum() >= 3 and np.median(np.abs(rise[foreign])) < 1.0:
        message = "the heights agree with those of registered markers whose heights are above another datum"
        return [warn(None, "height", "height_datum", message, "check vertical_datum (geoid or ellipsoid)")]
    return []


def _height_cure(
    survey: GeoreferencedSurvey,
    rows: np.ndarray[tuple[int], np.dtype[np.intp]],
    nearest: np.ndarray[tuple[int], np.dtype[np.intp]],
    neighbours: Neighbours,
) -> tuple[str, tuple[Change, ...]]:
    ratio = float(np.nanmedian(survey.height_m[rows]) / np.nanmedian(neighbours.height_m[nearest]))
    for factor, unit, declared in ((3.2808, "ft", "ft-intl"), (0.3048, "m", "m")):
        if abs(ratio / factor - 1) < 0.05:
            return f"the heights seem to be in {unit}: declare height_unit", (Change("height_unit", declared),)
    return "check vertical_datum: heights above the geoid and above the ellipsoid differ by up to 100 m", ()


# === The position of a single marker, which is registered without a survey.


@dataclass(frozen=True, slots=True)
class SinglePosition:
    """A position, and the coordinates that it was computed from."""

    lon_deg: float
    lat_deg: float
    first: float  # longitude [deg] or easting [m] in `crs`
    second: float  # latitude [deg] or northing [m]
    height_m: float | None
    crs: str
    realization: str | None


def check_single_position(
    position: SinglePosition, lon_deg: Floats, lat_deg: Floats, is_known: HasMarkersNear
) -> Iterator[Fault]:
    """Faults of a position: what the checks of surveys can find in one row alone.

    Parameters
    ----------
    lon_deg, lat_deg : ndarray, shape (M,)
        Registered markers around it. [deg]
    """
    if position.first == 0 or position.second == 0:
        yield zero_coordinate(None)
    if position.height_m is not None:
        yield from check_height(position.height_m)
    here = position.lon_deg, position.lat_deg
    if len(lon_deg):
        nearest_m = float(np.hypot(*east_north_m(lon_deg, lat_deg, here)).min())
        if nearest_m <= _ALREADY_THERE_M:
            yield _already_there(None, nearest_m)
    elif not is_known(*here):
        first, second = np.array([position.first], dtype=np.float64), np.array([position.second], dtype=np.float64)
        unit = "m" if reference_system(position.crs).is_projected else "deg"
        readings = list_readings(first, second, position.crs, unit, position.realization)
        hit = next((reading for reading in readings if is_known(reading.lon_deg, reading.lat_deg)), None)
        if hit is not None:
            yield _elsewhere(hit, _NEAR_OTHERWISE)
