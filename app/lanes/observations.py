"""Markers in the local plane, one row a number: invalid positions and numbers with two positions are left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.lanes.local_plane import median_place, plane_from_wgs84
from app.lanes.types import (
    UNKNOWN,
    Bools,
    Floats,
    Ints,
    LaneMarkers,
    LaneRules,
    LeftOut,
    LeftOutReason,
    Notes,
)

_USUAL_SIGMA_M = 0.02  # [m] source: the survey of the CERPM paper, section 2.2
_MIN_SIGMA_M = 0.005  # [m] source: half the 1.1 cm steps of a message's degrees (`markers.cerpm.DEGREE_STEP`)
_PLACING_SD_M = 0.01  # [m] of a marker about its boundary; source: by hand, as `simulation.radio.markers`
_SAME_POINT_DECIMALS = 2  # source: a centimetre, the steps of a message's degrees
_NO_SIDE = 9  # source: above every `LaneSide`


@dataclass(frozen=True, slots=True, eq=False)
class LaneObservations:
    """Markers that a lane may be fitted to, one row a number.

    Attributes
    ----------
    origin : tuple of float
        lon_deg, lat_deg of the plane.
    row : ndarray of int, shape (M,)
        First row of `LaneMarkers` with this number.
    number : ndarray of int, shape (M,)
    point_m : ndarray, shape (M, 2)
        East and north. [m]
    side : ndarray of int, shape (M,)
    sigma_m, speed_limit_km_h : ndarray, shape (M,)
    of_row : ndarray of int, shape (K,)
        Row of these for each row of `LaneMarkers`; -1 for none.
    """

    origin: tuple[float, float]
    row: Ints
    number: Ints
    point_m: Floats
    side: Ints
    sigma_m: Floats
    speed_limit_km_h: Floats
    of_row: Ints


def observations_from_markers(markers: LaneMarkers, rules: LaneRules, notes: Notes) -> LaneObservations:
    """Average the rows of each number; leave out invalid positions and numbers with two positions."""
    lon, lat = markers.lon_deg, markers.lat_deg
    with np.errstate(invalid="ignore"):
        placed = np.isfinite(lon) & np.isfinite(lat) & (np.abs(lon) <= 180) & (np.abs(lat) <= 90)
    for row in np.flatnonzero(~placed):
        notes.left_out.append(LeftOut(int(row), int(markers.number[row]), LeftOutReason.NOT_A_PLACE, float("nan")))
    rows = np.flatnonzero(placed)
    origin = median_place(lon[rows], lat[rows]) if len(rows) else (0.0, 0.0)
    point = plane_from_wgs84(lon[rows], lat[rows], origin) if len(rows) else np.empty((0, 2))
    _, first, which = np.unique(markers.number[rows], return_index=True, return_inverse=True)
    apart = np.hypot(*(point - point[first[which]]).T) if len(rows) else np.empty(0)
    spread = np.zeros(len(first))
    np.maximum.at(spread, which, apart)
    _report_two_places(markers, rows, which, spread, rules, notes)
    sigma = _valid_sigmas(markers.sigma_m)[rows]
    good = spread <= rules.same_place_m
    count = np.bincount(which, minlength=len(first)).astype(float)
    mean = np.stack([np.bincount(which, point[:, k], len(first)) for k in range(2)], 1) / np.maximum(count, 1)[:, None]
    side = _common_sides(markers.side[rows], which, len(first), notes)
    of_row = np.full(len(markers), -1, np.int64)
    new = np.where(good, np.cumsum(good) - 1, -1)
    of_row[rows] = new[which]
    chosen = rows[first]
    return LaneObservations(
        origin=origin,
        row=chosen[good],
        number=markers.number[chosen][good],
        point_m=mean[good],
        side=side[good],
        sigma_m=sigma[first][good],
        speed_limit_km_h=markers.speed_limit_km_h[chosen][good],
        of_row=of_row,
    )


def distinct_places(point_m: Floats) -> Bools:
    """Which points differ from all before them: two numbers at one place measure no more than one, shape (M,)."""
    _, first = np.unique(np.round(point_m, _SAME_POINT_DECIMALS), axis=0, return_index=True)
    kept = np.zeros(len(point_m), bool)
    kept[first] = True
    return kept


def _report_two_places(
    markers: LaneMarkers, rows: Ints, which: Ints, spread: Floats, rules: LaneRules, notes: Notes
) -> None:
    """Leave out numbers whose rows are too far apart."""
    two = spread[which] > rules.same_place_m
    for row, apart in zip(rows[two].tolist(), spread[which][two].tolist(), strict=True):
        notes.left_out.append(LeftOut(row, int(markers.number[row]), LeftOutReason.TWO_PLACES, apart))
    if two.any():
        notes.warn("a marker number was received with two positions: it is left out")


def _valid_sigmas(stated_m: Floats) -> Floats:
    """Standard deviations of markers about their boundary: of the survey, stated or usual, and of placing. [m]"""
    with np.errstate(invalid="ignore"):
        good = np.isfinite(stated_m) & (stated_m > 0)
    return np.hypot(np.where(good, np.maximum(stated_m, _MIN_SIGMA_M), _USUAL_SIGMA_M), _PLACING_SD_M)


def _common_sides(side: Ints, which: Ints, count: int, notes: Notes) -> Ints:
    """One side a number; UNKNOWN where its rows have different sides."""
    lowest, highest = np.full(count, _NO_SIDE), np.zeros(count, np.int64)
    np.minimum.at(lowest, which, np.where(side == UNKNOWN, _NO_SIDE, side))
    np.maximum.at(highest, which, side)
    differ = (highest > 0) & (lowest != highest)
    if differ.any():
        notes.warn("a marker was received with both sides of the lane: its side is found from its position")
    return np.where(differ | (highest == 0), UNKNOWN, highest)
