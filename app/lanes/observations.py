"""Markers in the local plane, one row a number, without invalid ones; their pairs and even spacings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from app.lanes.smooth_line import SmoothLine, median_place, plane_from_wgs84
from app.lanes.types import LEFT, RIGHT, UNKNOWN, LaneMarkers, LaneRules, LeftOut, LeftOutReason, Notes
from app.values import Bools, Floats, Ints

_USUAL_SIGMA_M = 0.02  # [m] source: the survey of the CERPM paper, section 2.2
_MIN_SIGMA_M = 0.005  # [m] source: half the 1.1 cm steps of a message's degrees (`markers.cerpm.DEGREE_STEP`)
_PLACING_SD_M = 0.01  # [m] of a marker about its boundary; as `simulation.radio.markers`
_SAME_POINT_DECIMALS = 2  # source: a centimetre, the steps of a message's degrees
_NO_SIDE = 9  # source: above every `LaneSide`


@dataclass(frozen=True, slots=True, eq=False)
class LaneObservations:
    """Markers that a lane may be fitted to, one row a number."""

    origin: tuple[float, float]  # lon_deg, lat_deg of the plane
    row: Ints  # shape (M,): first row of `LaneMarkers` with this number
    number: Ints  # shape (M,)
    point_m: Floats  # shape (M, 2): [m] east and north
    side: Ints  # shape (M,)
    # `sigma_m`, `speed_limit_kmh`: shape (M,)
    sigma_m: Floats
    speed_limit_kmh: Floats
    line: Ints  # shape (M,): registered line of the road; NO_LINE where none is registered
    of_row: Ints  # shape (K,): row of these for each row of `LaneMarkers`; -1 for none


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
        speed_limit_kmh=markers.speed_limit_kmh[chosen][good],
        line=markers.line[chosen][good],
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


# === Pairs of markers across from each other: each pair shows the direction of the lane.
#
# Source: the CERPM paper, section 3.2, places markers in pairs, as raised markers usually are. Whether these markers
# are placed in pairs is found from their positions; nothing is concluded from a single pair. A marker that was set a
# metre along its own line lies on its boundary and is no outlier, but makes the pair oblique. Such a pair shows no
# direction; it is recognised by the pairs beside it, and by the lane that the other markers show (`LaneFit`).


class Pairs(NamedTuple):
    """Pairs of markers along a line, each shape (P,)."""

    station_m: Floats
    slope: Floats  # of the lane's centre against the line
    sigma: Floats  # its standard deviation, if the pair was set as carefully as most are
    # larger where the slope differs from those of the pairs beside it: the lane bends there, or the pair is oblique
    cautious_sigma: Floats


_MIN_PAIRS = 4  # sensitivity 1.00, 1.00
_MIN_PAIRED_SHARE = 0.7  # of mutual neighbours that stand close together; sensitivity 1.00, 3.17
_MAX_STAGGER_SHARE = 0.12  # of the spacing; source: by chance 2 x 0.12, one in four, are as close
_PLACING_SIGMA_M = 0.012  # [m] of placing by hand; source: `simulation.radio.markers._PLACING_SD_M` on two axes
_MAX_STAGGER_M = 4.0  # [m] source: a third of the paper's spacing of 12.2 m (40 ft)
_MIN_ROW_STAGGER_M = 0.1  # [m] of one row ahead of the other; sensitivity 1.00, 1.00
_ROW_STAGGER_Z = 3.0  # and by this many standard errors; source: three sigma, one false alarm in 370
_MAD_TO_SIGMA = 1.4826  # source: normal distribution, 1 / 0.6745
_NEIGHBOURS = 5  # pairs that a pair is compared with, itself included; source: two of five may be wrong
_NEIGHBOURS_WITHIN_M = 120.0  # [m] further apart, the lane bends between them; source: decision 0016, five at 24.4 m
_OUTLIER_SIGMAS = 3.0  # from which on a pair counts less; source: three sigma, one false alarm in 370


def find_pairs(station_m: Floats, left_m: Floats, side: Ints, sigma_m: Floats) -> Pairs:
    """The pairs among markers beside a line; none where the markers do not stand in pairs.

    Parameters
    ----------
    station_m, left_m : ndarray, shape (M,)
        [m]
    side : ndarray of int, shape (M,)
        `LaneSide`; markers of unknown side are not used.
    sigma_m : ndarray, shape (M,)
        Of the survey. [m]
    """
    none = Pairs(np.empty(0), np.empty(0), np.empty(0), np.empty(0))
    left, right = (np.flatnonzero(side == which) for which in (LEFT, RIGHT))
    if min(len(left), len(right)) < 2:
        return none
    left, right = left[np.argsort(station_m[left])], right[np.argsort(station_m[right])]
    across = right[nearest_sorted(station_m[right], station_m[left])]
    back = left[nearest_sorted(station_m[left], station_m[across])]
    mutual = back == left
    spacing = min(float(np.median(np.diff(station_m[chain]))) for chain in (left, right))
    ahead = station_m[left] - station_m[across]
    close = mutual & (np.abs(ahead) < min(_MAX_STAGGER_SHARE * spacing, _MAX_STAGGER_M))
    if close.sum() < max(_MIN_PAIRS, _MIN_PAIRED_SHARE * mutual.sum()) or _is_staggered(ahead[close]):
        return none
    a, b = left[close], across[close]
    width = np.maximum(left_m[a] - left_m[b], 1.0)
    placing_m = max(np.sqrt(2) * _PLACING_SIGMA_M, _spread_m(ahead[close]))
    sigma = np.sqrt(sigma_m[a] ** 2 + sigma_m[b] ** 2 + placing_m**2) / width
    middle, slope = (station_m[a] + station_m[b]) / 2, -ahead[close] / width
    return Pairs(middle, slope, sigma, _cautious_sigma(middle, slope, sigma))


def _cautious_sigma(station_m: Floats, slope: Floats, sigma: Floats) -> Floats:
    """Standard deviations, as large as the difference of each pair that differs from the median of those beside it."""
    order = np.argsort(station_m)
    size = min(_NEIGHBOURS, len(order))
    first = np.clip(np.arange(len(order)) - size // 2, 0, len(order) - size)
    usual = np.empty(len(order))
    usual[order] = np.median(slope[order][first[:, None] + np.arange(size)], axis=1)
    near = np.empty(len(order), bool)
    near[order] = station_m[order][first + size - 1] - station_m[order][first] < _NEIGHBOURS_WITHIN_M
    off = np.abs(slope - usual)
    return np.where(near & (off > _OUTLIER_SIGMAS * sigma), np.hypot(sigma, off), sigma)


def _is_staggered(ahead_m: Floats) -> bool:
    """Whether one row as a whole is ahead of the other: then the line across a pair is not square to the lane."""
    error_m = 1.25 * _spread_m(ahead_m) / np.sqrt(len(ahead_m))  # the median's error is 1.25 times the mean's
    return abs(float(np.median(ahead_m))) > max(_MIN_ROW_STAGGER_M, float(_ROW_STAGGER_Z * error_m))


def _spread_m(ahead_m: Floats) -> float:
    """Robust standard deviation of how far one marker of a pair is ahead of the other. [m]"""
    return _MAD_TO_SIGMA * float(np.median(np.abs(ahead_m - np.median(ahead_m))))


def nearest_sorted(sorted_m: Floats, wanted_m: Floats) -> Ints:
    """Index of the nearest of sorted values, at least two, for each wanted one."""
    above = np.clip(np.searchsorted(sorted_m, wanted_m), 1, len(sorted_m) - 1)
    return np.where(wanted_m - sorted_m[above - 1] <= sorted_m[above] - wanted_m, above - 1, above)


# === Markers at even distances: the length between two markers shows how a bend runs between them.
#
# Crews place markers at even distances along the lane's centre or one of its boundaries. Whether they did is found from
# the markers' positions, mainly on stretches that hardly turn; in a bend, the length between two markers then shows how
# far the lane swings out. A pair of markers that was set a metre too early or too late makes one stretch too short and
# the next one too long by as much: their lengths are not used.


_SAME_STATION_M = 1.5  # [m] markers closer along the lane count once; sensitivity 1.00, 1.00
_MIN_SPACING_M = 20.0  # [m] closer markers show the bend by their positions; sensitivity 1.00, 1.02
_TURN_SIGMA_M = 0.5  # [m/rad^2] error of a bend's length; sensitivity 1.02, 0.97
_MIN_LENGTHS = 3  # sensitivity 1.00, 1.00
_MIN_EVEN_SHARE = 0.8  # of the lengths; sensitivity 1.29, 1.29
_EVEN_M = 0.2  # [m] a length this close to a multiple is even; sensitivity 0.98, 1.02
_LENGTH_SIGMA_M = 0.03  # [m] of a known length; source: survey of 0.02 m and placing of 0.01 m at both ends
_MAX_SPACINGS = 4  # between two markers: three missing in between; sensitivity 1.00, 1.00
_MAX_EXCESS_SHARE = 0.1  # of the distance; sensitivity 1.00, 1.00
_MOVED_M = (
    0.1  # [m] opposite errors of neighbouring lengths above this show a moved pair; source: 3 x `_LENGTH_SIGMA_M`
)
_SHORT_M = 40.0  # [m] on longer stretches bends make opposite errors too; source: decision 0016, rows of ten a side
_CANCEL_SHARE = 0.3  # of the errors, which their sum must be below on longer stretches; source: as above
_CLEARLY_BETTER = 0.5  # of the squared misfit along the second best line; sensitivity 0.93, 1.28


@dataclass(frozen=True, slots=True, eq=False)
class KnownLengths:
    """Stretches between markers, each shape (T,), and how much longer the lane's centre is there than the line. [m]"""

    start_m: Floats
    end_m: Floats
    excess_m: Floats
    sigma_m: Floats


NO_KNOWN_LENGTHS = KnownLengths(np.empty(0), np.empty(0), np.empty(0), np.empty(0))


def find_known_lengths(line: SmoothLine, station_m: Floats, used: Bools, width_m: float) -> KnownLengths:
    """Stretches whose length is known because markers stand at even distances; none where they do not.

    Parameters
    ----------
    line : SmoothLine
        Current estimate of the lane's centre.
    station_m : ndarray, shape (M,)
        Of the markers. [m]
    used : ndarray of bool, shape (M,)
    width_m : float
        Of the lane. [m]
    """
    place = np.sort(station_m[used])
    if len(place) < 2 * _MIN_LENGTHS:
        return NO_KNOWN_LENGTHS
    group = np.concatenate([[0], np.cumsum(np.diff(place) > _SAME_STATION_M)])
    place = np.bincount(group, place) / np.bincount(group)
    length = np.diff(place)
    if len(length) < _MIN_LENGTHS + 1 or np.median(length) < _MIN_SPACING_M:
        return NO_KNOWN_LENGTHS
    _, tangent = line.points_at(place)
    turn = np.diff(np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0])))
    even = _even_distance(length, turn)
    if even is None:
        return NO_KNOWN_LENGTHS
    times = np.maximum(np.round(length / even), 1)
    excess = times * even - length
    good = (np.abs(excess) < _MAX_EXCESS_SHARE * even) & (times <= _MAX_SPACINGS)
    found = _placed_along(excess, turn, good, width_m)
    if found is None:
        return NO_KNOWN_LENGTHS
    good &= ~_beside_moved_pairs(found, good, length)
    return KnownLengths(place[:-1][good], place[1:][good], found[good], np.full(int(good.sum()), _LENGTH_SIGMA_M))


def _beside_moved_pairs(excess_m: Floats, good: Bools, length_m: Floats) -> Bools:
    """Stretches that begin or end where markers stand before or behind their even place."""
    first, second = excess_m[:-1], excess_m[1:]
    size = np.minimum(np.abs(first), np.abs(second))
    cancel = np.abs(first + second) < np.maximum(_MOVED_M, _CANCEL_SHARE * np.maximum(np.abs(first), np.abs(second)))
    short = np.maximum(length_m[:-1], length_m[1:]) < _SHORT_M
    moved = good[:-1] & good[1:] & (first * second < 0) & (size > _MOVED_M) & (short | cancel)
    return np.asarray(np.append(moved, False) | np.append(False, moved), bool)


def _placed_along(excess_m: Floats, turn_rad: Floats, good: Bools, width_m: float) -> Floats | None:
    """Excess lengths of the centre, if it is clear along which of centre, left or right boundary distances are even.

    In a left bend the centre is longer than the left boundary by half the width times the turn.
    """
    if not good.any():
        return None
    candidates = [excess_m + k * turn_rad * width_m / 2 for k in (0.0, 1.0, -1.0)]
    misfit = [float(np.sum(value[good] ** 2)) for value in candidates]
    best = int(np.argmin(misfit))
    differs = max(misfit) > 4 * good.sum() * _LENGTH_SIGMA_M**2
    if differs and misfit[best] > _CLEARLY_BETTER * sorted(misfit)[1]:
        return None
    return candidates[best]


def _even_distance(length_m: Floats, turn_rad: Floats) -> float | None:
    """The greatest distance of which nearly all lengths are multiples; lengths of bends have less weight. [m]"""
    sigma = _LENGTH_SIGMA_M + _TURN_SIGMA_M * turn_rad**2
    for tried in np.sort(length_m)[::-1]:
        times = np.round(length_m / tried)
        near = (times >= 1) & (np.abs(length_m - times * tried) < _EVEN_M * np.maximum(times, 1) + 2 * sigma)
        if near.sum() >= max(_MIN_LENGTHS, _MIN_EVEN_SHARE * len(length_m)):
            weight = sigma[near] ** -2.0
            return float(np.sum(weight * length_m[near] * times[near]) / np.sum(weight * times[near] ** 2))
    return None
