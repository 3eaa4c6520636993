"""All that is known of a drive as measurements at the nodes of the time base."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from app.geodesy.frames import ecef_from_wgs84, metres_per_radian
from app.tracks.kernel import FIX, HEADING_SAMPLE, PATH, Measurements
from app.tracks.time_base import TimeBase
from app.tracks.types import HEADING, NORTH, SPEED, YAW_RATE, LanePath, PositionFix, ReceiverResult, Samples, TrackRules
from app.values import Bools, Floats, Ints

if TYPE_CHECKING:
    from app.tracks.estimate import Smoothed


# === Markers that were left out one after another: there the track may have lost its way, not the markers.


MIN_PASSAGES = 3
"""Markers in a row. Where one in ten is wrong, three in a row are so once in 1000."""


def stretches_left_out(used: Bools, markers: Bools, passage: Ints) -> list[Ints]:
    """Rows of the fixes of each stretch in which `MIN_PASSAGES` markers or more were left out and none was used.

    Parameters
    ----------
    used, markers : ndarray of bool, shape (K,)
        In the order of the times.
    passage : ndarray of int, shape (K,)
    """
    rows = np.flatnonzero(markers)
    left = ~used[rows]
    edges = np.flatnonzero(np.diff(np.r_[False, left, False].astype(np.int8)))
    runs = [rows[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return [run for run in runs if np.unique(passage[run]).size >= MIN_PASSAGES]


def count_passages(used: Bools, passage: Ints) -> int:
    """Passes of markers that are used: the frames of one pass are one witness."""
    return int(np.unique(passage[used]).size)


def times_lost(time_s: Floats, used: Bools, markers: Bools, passage: Ints) -> list[tuple[float, float]]:
    """Stretches of time around such stretches, from the marker used before to the one used after. [s]"""
    kept = np.sort(time_s[used & markers])
    found = []
    for run in stretches_left_out(used, markers, passage):
        first, last = float(time_s[run].min()), float(time_s[run].max())
        before, after = kept[kept < first], kept[kept > last]
        found.append((float(before[-1]) if before.size else -np.inf, float(after[0]) if after.size else np.inf))
    return found


# === All that is known of a drive as measurements at the nodes of the time base.


COMMON_POSE_SHARE = 0.1
"""Part of the variance of a pose that all frames past one marker share: calibration and mount of the camera."""
_PASS_S = 30.0  # [s] fixes by a marker within this are one pass
_RECEIVER_S = 60.0  # [s] in which the error of a receiver stays; reflections beside one street
_RATE_OVER_S = 3.0  # [s] braking takes longer
_NO_HEADING = 1e6  # [rad2] variance of a heading that is not known
_MIN_SIGMA_M = 1e-3  # [m] no fix is better; a tenth of the best survey
_PATH_STEP_M = 10.0  # [m] between places where the lane's path counts; a tenth of the wander's length
_PATH_NEAR_M = 8.0  # [m] further from the path it is not driven; two lanes
_PATH_SPACING_M = 1.0  # [m] between points of a path that is searched
_PATH_SIGMAS = 3.0  # beyond it the vehicle has left the lane
_SAME_WAY = 0.87  # cosine of the angle between vehicle and lane; 30 deg
_MIN_PATH_SIGMA_M = 0.02  # [m] source: app/lanes/initial_line.py


@dataclass(frozen=True, slots=True, eq=False)
class FixArrays:
    """Fixes in the order of time, K of them."""

    time_s: Floats  # shape (K,): [s] on the sensors' own clocks
    # `lon_rad`, `lat_rad`, `heading_rad`: shape (K,)
    lon_rad: Floats
    lat_rad: Floats
    heading_rad: Floats
    cov_m2: Floats  # shape (K, 3)
    heading_var: Floats  # shape (K,): [rad2] `_NO_HEADING` where there is none
    cross_m_rad: Floats  # shape (K, 2)
    common_m2: Floats  # shape (K,)
    # shape (K,): the same for fixes by one marker in one pass, and for positions of a receiver in one minute
    passage: Ints

    @property
    def sigma_m(self) -> Floats:
        """The larger standard deviation of each. [m]"""
        east, cross, north = self.cov_m2.T
        larger = (east + north) / 2 + np.sqrt(((east - north) / 2) ** 2 + cross**2)
        return np.asarray(np.sqrt(larger))


def fix_arrays(fixes: tuple[PositionFix, ...]) -> FixArrays:
    """Columns of fixes."""
    cov = np.array([fix.covariance_m2 for fix in fixes], float).reshape(-1, 3)
    cov[:, [0, 2]] = np.maximum(cov[:, [0, 2]], _MIN_SIGMA_M**2)
    heading = np.radians(np.array([fix.heading_deg for fix in fixes], float))
    sigma = np.radians(np.array([fix.heading_sigma_deg for fix in fixes], float))
    known = np.isfinite(heading) & np.isfinite(sigma) & (sigma > 0)
    cross = np.array([fix.heading_cross_m_rad for fix in fixes], float).reshape(-1, 2)
    time = np.array([fix.time_s for fix in fixes], float)
    passage, open_passes = np.zeros(len(fixes), np.int64), dict[tuple[str, str | None], tuple[int, float]]()
    for k, fix in enumerate(fixes):
        whose = (fix.clock, fix.marker_id)
        number, until = open_passes.get(whose, (k, -math.inf))
        number, until = (number, until) if fix.time_s <= until else (k, fix.time_s + _RECEIVER_S)
        passage[k] = number
        open_passes[whose] = number, until if fix.marker_id is None else fix.time_s + _PASS_S
    return FixArrays(
        time,
        np.radians(np.array([fix.lon_deg for fix in fixes], float)),
        np.radians(np.array([fix.lat_deg for fix in fixes], float)),
        np.where(known, heading, np.nan),
        cov,
        np.where(known, np.maximum(sigma, 1e-5) ** 2, _NO_HEADING),
        _possible(cross, cov, known, sigma),
        np.array([fix.common_m2 for fix in fixes], float),
        passage,
    )


def _possible(cross: Floats, cov: Floats, known: Bools, sigma: Floats) -> Floats:
    """Covariances of the heading; 0 where there is no heading, or where they contradict the variances."""
    limit = 0.95 * np.where(known, sigma, 0.0)[:, None] * np.sqrt(cov[:, [0, 2]])
    share = np.abs(cross) / np.maximum(limit, 1e-12)
    fits = known & np.isfinite(cross).all(1) & ((share**2).sum(1) < 1.0)
    return np.where(fits[:, None], cross, 0.0)


def fix_rows(
    base: TimeBase, fixes: FixArrays, place: Ints, offset_s: Floats, used: Bools, rates: Floats | None
) -> Measurements:
    """Measurements of fixes.

    Notes
    -----
    Fixes by one marker in one pass share the error of its survey S. n of them with own errors N have together the
    covariance N / n + S; with N + n S for each, the filter, which takes them as independent, comes to the same.
    """
    count = len(fixes.time_s)
    node, after = base.nearest(fixes.time_s + offset_s)
    together = np.maximum(np.bincount(fixes.passage[used], minlength=max(count, 1))[fixes.passage], 1)
    trace = (fixes.cov_m2[:, 0] + fixes.cov_m2[:, 2]) / 2
    common = np.minimum(fixes.common_m2, 0.95 * trace)
    shared = common + COMMON_POSE_SHARE * (trace - common)
    more = (together - 1) * shared
    noise = np.zeros((count, 6))
    noise[:, 0], noise[:, 1], noise[:, 3] = fixes.cov_m2[:, 0] + more, fixes.cov_m2[:, 1], fixes.cov_m2[:, 2] + more
    noise[:, [2, 4]] = fixes.cross_m_rad
    noise[:, 5] = fixes.heading_var * np.where(fixes.heading_var < _NO_HEADING, together, 1.0)
    value = np.column_stack([fixes.lon_rad, fixes.lat_rad, fixes.heading_rad])
    rate = np.full((count, 3), np.nan) if rates is None else rates[node][:, [0, 1, 3]]
    return Measurements(node, np.full(count, FIX), place, after, offset_s.copy(), value, noise, rate, used.copy())


def averaged_rates(base: TimeBase, states: Floats) -> Floats:
    """Velocity east and north [m/s], acceleration [m/s2] and yaw rate [rad/s] at the nodes, averaged, shape (N, 4)."""
    size = max(round(_RATE_OVER_S / base.step_s), 1)
    v, psi = states[:, SPEED], states[:, HEADING]
    change = np.gradient(v, base.step_s) if len(v) > 1 else np.zeros(len(v))
    columns = np.column_stack([v * np.sin(psi), v * np.cos(psi), change, states[:, YAW_RATE]])
    return np.asarray(scipy.ndimage.uniform_filter1d(columns, size, axis=0, mode="nearest"))


def sample_rows(
    base: TimeBase, series: Samples, kind: int, place: int, offset_s: float, rates: Floats | None
) -> Measurements:
    """Measurements of speeds or headings: their means in each step."""
    node, after = base.nearest(series.time_s + offset_s)
    inside = np.abs(after) <= base.step_s
    radians = kind == HEADING_SAMPLE
    values = np.radians(np.unwrap(series.value, period=360.0)) if radians else series.value
    nodes, which, counts = np.unique(node[inside], return_inverse=True, return_counts=True)
    mean = np.bincount(which, values[inside], minlength=len(nodes)) / counts
    mean_after = np.bincount(which, after[inside], minlength=len(nodes)) / counts
    rate = np.zeros((len(nodes), 3))
    if rates is not None:
        rate[:, 0] = rates[nodes, 3 if radians else 2]
    noise = np.zeros((len(nodes), 6))
    noise[:, 0] = (np.radians(series.sigma) if radians else series.sigma) ** 2
    value = np.zeros((len(nodes), 3))
    value[:, 0] = mean
    ones = np.ones(len(nodes), np.int64)
    return Measurements(
        nodes, kind * ones, place * ones, mean_after, offset_s * np.ones(len(nodes)), value, noise, rate,
        np.ones(len(nodes), bool),
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class PathIndex:
    """Points of a lane's path with their headings, and a tree to find the nearest by."""

    lon_rad: Floats
    lat_rad: Floats
    heading_rad: Floats
    sigma_m: float
    tree: scipy.spatial.cKDTree


def path_index(path: LanePath) -> PathIndex | None:
    """None for a path of fewer than two points."""
    lon, lat = np.radians(np.unwrap(path.lon_deg, period=360.0)), np.radians(path.lat_deg)
    kept = np.isfinite(lon) & np.isfinite(lat)
    lon, lat = lon[kept], lat[kept]
    if len(lon) < 2:
        return None
    east, north = metres_per_radian(lat)
    steps = np.hypot(np.diff(lon) * east[1:], np.diff(lat) * north[1:])
    along = np.concatenate([[0.0], np.cumsum(steps)])
    moved = np.r_[True, steps > 1e-6]
    along, lon, lat = along[moved], lon[moved], lat[moved]
    if len(lon) < 2:
        return None
    at = np.linspace(0.0, along[-1], max(math.ceil(along[-1] / _PATH_SPACING_M), 1) + 1)
    lon, lat = np.interp(at, along, lon), np.interp(at, along, lat)
    east, north = metres_per_radian(lat)
    heading = np.arctan2(np.gradient(lon) * east, np.gradient(lat) * north)
    tree = scipy.spatial.cKDTree(ecef_from_wgs84(np.degrees(lon), np.degrees(lat)))
    return PathIndex(lon, lat, heading, max(path.sigma_m, _MIN_PATH_SIGMA_M), tree)


def path_rows(base: TimeBase, path: PathIndex, states: Floats, position_m2: Floats, rules: TrackRules) -> Measurements:
    """The lane's path where the vehicle drives along it, every ten metres."""
    east, north = metres_per_radian(states[:, NORTH])
    driven = np.concatenate([[0.0], np.cumsum(np.abs(states[1:, SPEED]) * base.step_s)])
    steps = np.unique(np.floor(driven / _PATH_STEP_M), return_index=True)[1]
    places = ecef_from_wgs84(np.degrees(states[steps, 0]), np.degrees(states[steps, 1]))
    found_at = path.tree.query(places, distance_upper_bound=_PATH_NEAR_M)
    away, near = np.asarray(found_at[0]), np.asarray(found_at[1])
    found = np.isfinite(away)
    nodes, near = steps[found], near[found]
    inner = (near > 0) & (near < len(path.lon_rad) - 1)
    nodes, near = nodes[inner], near[inner]
    heading = path.heading_rad[near]
    way = np.cos(states[nodes, HEADING] - heading)
    left = np.column_stack([-np.cos(heading), np.sin(heading)])
    off = np.column_stack([
        ((states[nodes, 0] - path.lon_rad[near] + np.pi) % (2 * np.pi) - np.pi) * east[nodes],
        (states[nodes, NORTH] - path.lat_rad[near]) * north[nodes],
    ])  # fmt: skip
    across = (off * left).sum(1)
    products = np.column_stack([left[:, 0] ** 2, 2 * left[:, 0] * left[:, 1], left[:, 1] ** 2])
    spread = (position_m2[nodes] * products).sum(1) + rules.wander_m**2 + path.sigma_m**2
    kept = (np.abs(way) > _SAME_WAY) & (np.abs(across) <= _PATH_SIGMAS * np.sqrt(spread))
    nodes, near, heading = nodes[kept], near[kept], heading[kept]
    count = len(nodes)
    noise = np.zeros((count, 6))
    noise[:, 0], noise[:, 1] = path.sigma_m**2, heading
    value = np.column_stack([np.zeros(count), path.lon_rad[near], path.lat_rad[near]])
    empty = np.zeros(count)
    return Measurements(
        nodes.astype(np.int64), np.full(count, PATH), np.full(count, -1), empty, empty, value, noise,
        np.zeros((count, 3)), np.ones(count, bool),
    )  # fmt: skip


def in_order(parts: list[Measurements]) -> tuple[Measurements, Ints]:
    """All measurements in the order of their nodes, and where those of the first part are in it."""
    joined = Measurements(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    order = np.argsort(joined.node, kind="stable")
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    ordered = Measurements(*(np.ascontiguousarray(column[order]) for column in joined))  # type: ignore[arg-type]
    return ordered, place[: len(parts[0].node)]


def passage_distances(
    fixes: FixArrays, used: Bools, square: Floats, noise: Floats, residual: Floats, spread: Floats
) -> Floats:
    """Squared distances (K,) in which all fixes by one marker in one pass are left out together.

    A wrong marker is wrong in all frames of a pass: any two of them agree with the third. Their mean residual is that
    of one fix with the noise of all.

    Parameters
    ----------
    used : ndarray of bool, shape (K,)
    square : ndarray, shape (K,)
        With each fix left out alone.
    noise : ndarray, shape (K, 6)
        As in `Measurements`.
    residual, spread : ndarray, shape (K, 3) and (K, 3, 3)
        From the track, and the track's covariance there.
    """
    result = square.copy()
    numbers, counts = np.unique(fixes.passage[used], return_counts=True)
    upper = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
    for number in numbers[counts > 1]:
        members = used & (fixes.passage == number)
        own = noise[members].mean(axis=0)[upper] / members.sum()
        without = own - spread[members].mean(axis=0)
        values, vectors = np.linalg.eigh(without / np.sqrt(np.outer(np.diag(own), np.diag(own))))
        off = vectors.T @ (residual[members].mean(axis=0) / np.sqrt(np.diag(own)))
        result[members] = np.maximum(result[members], float((off**2 / np.maximum(values, 1e-3)).sum()))
    return result


# === Positions of the vehicle's own receiver beside markers.
#
# Markers are surveyed and a receiver is not: positions of a receiver never decide which markers are used. The drive is
# estimated by its markers first; where that track shows that positions are further off than their stated accuracy, the
# accuracy is enlarged until they fit. Only then the positions take part, each gated by its distance from the track.
#
# A receiver's error changes slowly: all positions of a minute share it, as frames of one marker share that of its
# survey.


_MAX_DOUBLINGS = 60  # of the variance; any position on earth fits then
_NEAREST_SHARE = 0.5  # of the positions, where the track by markers is best, show how good they are


def is_receiver(fixes: tuple[PositionFix, ...]) -> Bools:
    """Which fixes are positions of a receiver, shape (K,)."""
    return np.array([fix.marker_id is None for fix in fixes], bool)


def with_estimated_accuracy(
    fixes: tuple[PositionFix, ...], arrays: FixArrays, by_markers: Smoothed
) -> tuple[FixArrays, Floats]:
    """Fixes with the covariance of the receivers' positions enlarged to what markers show, and the factors (K,).

    Notes
    -----
    For each source, the least power of two by which its covariances R are to be multiplied so that the median of
    r' (S + f R)^-1 r does not exceed that of the chi-square distribution with two degrees of freedom. r is the distance
    from the track by markers and S the covariance of that track, of the receiver's clock with it.
    """
    factor = np.ones(len(fixes))
    limit = float(scipy.stats.chi2.ppf(0.5, 2))
    upper = np.array([[0, 1], [1, 2]])
    own = arrays.cov_m2[:, upper]
    off, spread = by_markers.offset_m[:, :2], by_markers.spread[:, :2, :2]
    sources = np.array([fix.decode_id if fix.marker_id is None else "" for fix in fixes])
    receiver = is_receiver(fixes)
    for source in dict.fromkeys(sources[receiver].tolist()):
        members = np.flatnonzero(receiver & (sources == source))
        size = np.linalg.det(spread[members])
        near = members[size <= np.quantile(size, _NEAREST_SHARE)]
        for doubling in range(_MAX_DOUBLINGS):
            factor[members] = 2.0**doubling
            whole = spread[near] + factor[near, None, None] * own[near]
            if np.median(np.einsum("ki,ki->k", off[near], np.linalg.solve(whole, off[near, :, None])[..., 0])) <= limit:
                break
    cov = arrays.cov_m2 * factor[:, None]
    common = np.where(receiver, (cov[:, 0] + cov[:, 2]) / 2, arrays.common_m2)
    return replace(arrays, cov_m2=cov, common_m2=common), factor


def receiver_results(fixes: tuple[PositionFix, ...], factor: Floats, used: Bools) -> tuple[ReceiverResult, ...]:
    """What became of the positions of each source."""
    found = []
    for source in dict.fromkeys(fix.decode_id for fix in fixes if fix.marker_id is None):
        members = [k for k, fix in enumerate(fixes) if fix.marker_id is None and fix.decode_id == source]
        stated = float(np.median([math.sqrt(fixes[k].covariance_m2[0] + fixes[k].covariance_m2[2]) for k in members]))
        count = int(used[members].sum())
        widened = math.sqrt(float(factor[members[0]]))
        found.append(
            ReceiverResult(source, fixes[members[0]].clock, count, len(members) - count, stated, stated * widened)
        )
    return tuple(found)
