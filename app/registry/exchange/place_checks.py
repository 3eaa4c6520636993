"""What the declared area and the registered markers say against a survey."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from app.registry.exchange.declaration import ImportDeclaration
from app.registry.exchange.place import Alternative, PlacedSurvey, alternatives, local_m
from app.registry.exchange.read import warn
from app.registry.exchange.shape_checks import nearest_of
from app.registry.exchange.table import Fault, Floats

IsKnownPlace = Callable[[float, float], bool]
"""Whether markers are registered within some kilometres of a longitude and latitude."""

NEAR_M = 300.0
_BESIDE_M = 20.0
_THERE_M = 0.5
_HEIGHT_SHIFT_M = 3.0
_GRADE = 0.06


@dataclass(frozen=True, slots=True)
class Neighbours:
    """Registered markers around a survey.

    Attributes
    ----------
    lon_deg, lat_deg, height_m : ndarray, shape (M,)
        NaN where there is no height.
    vertical_datum : tuple of str or None
    """

    lon_deg: Floats
    lat_deg: Floats
    height_m: Floats
    vertical_datum: tuple[str | None, ...]


def check_place(
    survey: PlacedSurvey, declaration: ImportDeclaration, neighbours: Neighbours, is_known: IsKnownPlace
) -> Iterator[Fault]:
    """Faults that the declared area, the CRS and the registered markers show."""
    yield from _check_range(survey)
    outside = _outside(survey, declaration)
    for row in np.flatnonzero(outside):
        yield Fault(int(row) + 1, "position", "outside_area", "the row lies outside the declared area", _row_cure())
    yield from _check_whole(survey, declaration, outside, is_known, near=len(neighbours.lon_deg) > 0)
    yield from _check_height_range(survey, declaration)
    if survey.placed.placed.any():
        yield from _check_neighbours(survey, declaration, neighbours, is_known)


def _check_range(survey: PlacedSurvey) -> Iterator[Fault]:
    """Rows whose numbers are read and still lead nowhere."""
    table = survey.table
    lost = np.isfinite(table.first) & np.isfinite(table.second) & ~survey.placed.placed
    message = f"the coordinates lie outside the range or the area of use of {table.crs}"
    for row in np.flatnonzero(lost):
        yield Fault(int(row) + 1, "position", "outside_crs", message, _row_cure(table.first[row], table.second[row]))


def _row_cure(first: float = 0.0, second: float = 0.0) -> str:
    shown = f"{first:g}, {second:g}: " if first or second else ""
    return f"{shown}check the order of the axes, signs, decimals, unit and zone"


def _outside(survey: PlacedSurvey, declaration: ImportDeclaration) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    if declaration.area_deg is None:
        return np.zeros(survey.table.rows, dtype=bool)
    west, south, east, north = declaration.area_deg
    lon, lat = survey.placed.lon_deg, survey.placed.lat_deg
    with np.errstate(invalid="ignore"):
        inside = (lon >= west) & (lon <= east) & (lat >= south) & (lat <= north)
    return survey.placed.placed & ~inside


def _check_whole(
    survey: PlacedSurvey,
    declaration: ImportDeclaration,
    outside: np.ndarray[tuple[int], np.dtype[np.bool_]],
    is_known: IsKnownPlace,
    *,
    near: bool,
) -> list[Fault]:
    """One fault for the file where most of it is not where it should be, with what would put it there."""
    placed = survey.placed.placed
    if declaration.area_deg is not None:
        if placed.any() and outside.sum() <= 0.5 * placed.sum():
            return []
        west, south, east, north = declaration.area_deg
        hit = _first_hit(survey, declaration, lambda lon, lat: west <= lon <= east and south <= lat <= north)
        message = "most rows lie outside the declared area"
        return [_whole(hit, message, "outside_area", "declare the area the survey lies in, or correct the file")]
    if near or (placed.any() and is_known(*survey.origin_deg)):
        return [] if placed.mean() > 0.5 else [_nowhere(survey, declaration, is_known)]
    if not placed.any() or placed.mean() <= 0.5:
        return [_nowhere(survey, declaration, is_known)]
    hit = _first_hit(survey, declaration, is_known)
    if hit is not None:
        return [_whole(hit, "no registered marker is near, but read another way many are", hit.code, "")]
    return [
        warn(
            None, "position", "place_unchecked",
            "no area is declared and no marker is registered near: nothing tells whether this is the right place",
            "declare area_deg, the box that the survey lies in",
        )
    ]  # fmt: skip


def _nowhere(survey: PlacedSurvey, declaration: ImportDeclaration, is_known: IsKnownPlace) -> Fault:
    hit = _first_hit(survey, declaration, is_known) or _first_hit(survey, declaration, lambda _lon, _lat: True)
    return _whole(hit, f"most rows have no place in {survey.table.crs}", "outside_crs", "check the CRS")


def _first_hit(survey: PlacedSurvey, declaration: ImportDeclaration, fits: IsKnownPlace) -> Alternative | None:
    return next((a for a in alternatives(survey.table, declaration) if fits(a.lon_deg, a.lat_deg)), None)


def _whole(hit: Alternative | None, message: str, code: str, cure: str) -> Fault:
    if hit is None:
        return Fault(None, "position", code, message, cure)
    return Fault(None, "position", hit.code, message, f"{hit.proposal}; the survey then fits")


def _check_height_range(survey: PlacedSurvey, declaration: ImportDeclaration) -> Iterator[Fault]:
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
    survey: PlacedSurvey, declaration: ImportDeclaration, neighbours: Neighbours, is_known: IsKnownPlace
) -> Iterator[Fault]:
    rows = np.flatnonzero(survey.placed.placed)
    points = np.column_stack([survey.east_m[rows], survey.north_m[rows]])
    others = np.column_stack(local_m(neighbours.lon_deg, neighbours.lat_deg, survey.origin_deg))
    if not len(others):
        yield from _only_coarse(declaration, known=is_known(*survey.origin_deg))
        return
    k = min(3, len(others))
    distance, index = nearest_of(points, others, k)
    close = distance[:, 0] <= NEAR_M
    if close.mean() < 0.3:
        yield from _only_coarse(declaration, known=True)
        return
    if not declaration.compare:
        yield from _check_already_there(rows, distance[:, 0])
    yield from _check_beside(points[close], others[index[close]], distance[close])
    yield from _check_heights(survey, declaration, neighbours, rows[close], distance[close], index[close])


def _only_coarse(declaration: ImportDeclaration, *, known: bool) -> list[Fault]:
    """The caution that a sound survey of a new road gets too: what nothing here could show."""
    if declaration.compare or not (known or declaration.area_deg is not None):
        return []
    inside = "inside the declared area" if declaration.area_deg is not None else "within kilometres of others"
    return [
        warn(
            None, "position", "place_by_area_only",
            f"no marker is registered within {NEAR_M:g} m: that the survey lies {inside} is all that was checked; "
            "a shift of all rows, or heights above another datum, would not be seen",
            "check one row against the map; declare height_range_m where heights matter",
        )
    ]  # fmt: skip


def _check_already_there(rows: np.ndarray[tuple[int], np.dtype[np.intp]], distance_m: Floats) -> Iterator[Fault]:
    return (
        warn(
            int(rows[k]) + 1, "position", "marker_already_there",
            f"a registered marker lies {distance_m[k]:.2f} m from here",
            "declare compare if the survey measures registered markers",
        )
        for k in np.flatnonzero(distance_m <= _THERE_M)
    )  # fmt: skip


def _check_beside(points: Floats, nearest: Floats, distance_m: Floats) -> list[Fault]:
    """The survey runs beside the registered line: another datum, zone or scale shifts all rows alike."""
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
            None, "position", "beside_the_registered_line",
            f"the survey runs about {median:.0f} m beside the registered markers",
            "check the datum of the CRS, its zone, and whether distances are grid or ground",
        )
    ]  # fmt: skip


def _check_heights(
    survey: PlacedSurvey,
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
        return [warn(None, "height", "height_shift", message, _height_cure(survey, rows, nearest, neighbours))]
    if not comparable.sum() and foreign.sum() >= 3 and np.median(np.abs(rise[foreign])) < 1.0:
        message = "the heights agree with those of registered markers that are above another datum"
        return [warn(None, "height", "height_datum", message, "check vertical_datum (geoid or ellipsoid)")]
    return []


def _height_cure(
    survey: PlacedSurvey,
    rows: np.ndarray[tuple[int], np.dtype[np.intp]],
    nearest: np.ndarray[tuple[int], np.dtype[np.intp]],
    neighbours: Neighbours,
) -> str:
    ratio = float(np.nanmedian(survey.height_m[rows]) / np.nanmedian(neighbours.height_m[nearest]))
    for factor, unit in ((3.2808, "ft"), (0.3048, "m")):
        if abs(ratio / factor - 1) < 0.05:
            return f"the heights seem to be in {unit}: declare height_unit"
    return "check vertical_datum: heights above the geoid and above the ellipsoid differ by up to 100 m"
