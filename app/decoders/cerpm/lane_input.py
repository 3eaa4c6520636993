"""Markers as they came, put on one plane: what is no place, said twice or claimed twice is sorted out first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.decoders.cerpm.lane_frame import middle_of, plane_from_wgs84
from app.decoders.cerpm.lane_types import (
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

_USUAL_SIGMA_M, _LEAST_SIGMA_M = 0.02, 0.005


@dataclass(frozen=True, slots=True, eq=False)
class Stock:
    """Markers that a lane may be fitted through, one a number.

    Attributes
    ----------
    origin : tuple of float
        lon_deg, lat_deg of the plane.
    row : ndarray of int, shape (M,)
        First row of `LaneMarkers` that names it.
    number : ndarray of int, shape (M,)
    point_m : ndarray, shape (M, 2)
        East and north. [m]
    side : ndarray of int, shape (M,)
    sigma_m, speed_limit_km_h : ndarray, shape (M,)
    of_row : ndarray of int, shape (K,)
        Which of these each row of `LaneMarkers` is; -1 for none.
    """

    origin: tuple[float, float]
    row: Ints
    number: Ints
    point_m: Floats
    side: Ints
    sigma_m: Floats
    speed_limit_km_h: Floats
    of_row: Ints


def stock_from_markers(markers: LaneMarkers, rules: LaneRules, notes: Notes) -> Stock:
    """Merge rows that say the same, and name those that are no place or claim two."""
    lon, lat = markers.lon_deg, markers.lat_deg
    with np.errstate(invalid="ignore"):
        placed = np.isfinite(lon) & np.isfinite(lat) & (np.abs(lon) <= 180) & (np.abs(lat) <= 90)
    for row in np.flatnonzero(~placed):
        notes.left_out.append(LeftOut(int(row), int(markers.number[row]), LeftOutReason.NOT_A_PLACE, float("nan")))
    rows = np.flatnonzero(placed)
    origin = middle_of(lon[rows], lat[rows]) if len(rows) else (0.0, 0.0)
    point = plane_from_wgs84(lon[rows], lat[rows], origin) if len(rows) else np.empty((0, 2))
    _, first, which = np.unique(markers.number[rows], return_index=True, return_inverse=True)
    apart = np.hypot(*(point - point[first[which]]).T) if len(rows) else np.empty(0)
    spread = np.zeros(len(first))
    np.maximum.at(spread, which, apart)
    _name_double(markers, rows, which, spread, rules, notes)
    sigma = _sigmas(markers.sigma_m)[rows]
    good = spread <= rules.duplicate_m
    weight = np.bincount(which, minlength=len(first)).astype(float)
    mean = np.stack([np.bincount(which, point[:, k], len(first)) for k in range(2)], 1) / np.maximum(weight, 1)[:, None]
    side = _agreed_sides(markers.side[rows], which, len(first), notes)
    of_row = np.full(len(markers), -1, np.int64)
    new = np.where(good, np.cumsum(good) - 1, -1)
    of_row[rows] = new[which]
    chosen = rows[first]
    return Stock(
        origin, chosen[good], markers.number[chosen][good], mean[good], side[good], sigma[first][good],
        markers.speed_limit_km_h[chosen][good], of_row,
    )  # fmt: skip


def _name_double(markers: LaneMarkers, rows: Ints, which: Ints, spread: Floats, rules: LaneRules, notes: Notes) -> None:
    torn = spread[which] > rules.duplicate_m
    for row, apart in zip(rows[torn].tolist(), spread[which][torn].tolist(), strict=True):
        notes.left_out.append(LeftOut(row, int(markers.number[row]), LeftOutReason.TWO_PLACES, apart))
    if torn.any():
        notes.doubt("a number claims two places: its claims are left out")


def _sigmas(stated_m: Floats) -> Floats:
    with np.errstate(invalid="ignore"):
        good = np.isfinite(stated_m) & (stated_m > 0)
    return np.where(good, np.maximum(stated_m, _LEAST_SIGMA_M), _USUAL_SIGMA_M)


def _agreed_sides(side: Ints, which: Ints, count: int, notes: Notes) -> Ints:
    """One side a number: unknown where its rows do not agree."""
    least, most = np.full(count, 9), np.zeros(count, np.int64)
    np.minimum.at(least, which, np.where(side == UNKNOWN, 9, side))
    np.maximum.at(most, which, side)
    torn = (most > 0) & (least != most)
    if torn.any():
        notes.doubt("a marker names both sides of the lane: its side is found from where it lies")
    return np.where(torn | (most == 0), UNKNOWN, most)


def moving(point_m: Floats) -> Bools:
    """Which points lie apart from all before them: two numbers on one spot say nothing more than one, shape (M,)."""
    _, first = np.unique(np.round(point_m, 2), axis=0, return_index=True)
    kept = np.zeros(len(point_m), bool)
    kept[first] = True
    return kept
