"""Whether a path agrees with the track of the vehicle that drove it: by its place, and by its shape."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy

from app.lanes.smooth_line import lengths_along, mean_fixes, plane_from_wgs84, without_wild_fixes
from app.lanes.types import MAX_TRACK_SIGNIFICANCE, MIN_TRACK_EFFECT_M, Lane, LaneRules, TrackAgreement
from app.sensors.pose_track import (
    DRIVER_OFFSET_SD_M,
    RECEIVER_OPTIMISM,
    SLOW_SHARE,
    WANDER_LENGTH_M,
    WANDER_SD_M,
    PoseTrack,
)
from app.values import Bools, Floats, Ints

# === Whether a path agrees with the vehicle's track: their common shift, turn and scale.
#
# Markers that are all shifted alike, as by a survey in another datum, make a perfect path in the wrong place. The track
# shows it: a driver keeps within the lane, so the track transformed by a shift, a turn and a scale must lie along the
# path. What a driver's habits, short cuts in bends and the receiver's own error explain is not significant.


_SPACING_M = 3.0  # [m] between fixes that are compared; source: `initial_line._POINT_SPACING_M`
_MAX_STEPS = 5000  # of the track, longer steps on tracks above 15 km; bounds the time
_MIN_FIXES, _MIN_LENGTH_M = 10, 30.0  # fixes, and the length of track, without which nothing is compared
_MAX_BESIDE_M = 500.0  # [m] fixes further from the path are of another road; above a datum's shift
_APART_M = (
    20.0  # [m] short tracks with a fix closer than this are beside the path; source: four times a poor receiver's 5 m
)
_CUT_M2 = 2.0  # [m2] offset towards the inside of bends, per curvature; source: twice `Driver.cut_m2` of radio drives
_SHIFT_SD_M, _TURN_SD, _SCALE_SD = 300.0, 0.2, 0.1  # [m, rad, 1] above any mistake that is searched
_ROUNDS = 12  # of finding the nearest places on the path; converged to a millimetre
_CONVERGED_M = 1e-3  # [m]
_OUTLIER_SIGMAS = 3.0  # from which on a fix counts less (Huber)
_GAP_S, _CONVERGING_S = 3.0, 15.0  # [s] without a fix, as in a tunnel, and how long positions are inaccurate after it
_MIN_CONVERGED = 0.5  # share of fixes, below which inaccurate ones are used, too
_PRECISE_M = 0.3  # [m] of a receiver that shows whether a vehicle is in its lane
_PARALLEL_SINE = 0.26  # of 15 degrees, the largest angle to the path of fixes that count as parallel
_MAX_PARALLEL_SHARE = 0.1  # of the fixes; three or more of a usual drive
_BESIDE_LANE_M = 0.5  # [m] from a boundary
_BODY_M = 1.0  # [m] half of a car with its mirrors; its driver keeps it between the boundaries
_MIN_LEAVES_M, _MIN_LEAVES_SIGNIFICANCE = 0.65, 2.5  # [m, 1] a path so far from a vehicle is not that of its lane


class _Compared(NamedTuple):
    """Fixes and the places of the path next to them."""

    fix_m: Floats
    place_m: Floats
    normal: Floats
    curvature_per_m: Floats


def compare_with_track(lane: Lane, track: PoseTrack, jump_m: float = 0.0) -> TrackAgreement | None:
    """Compare a path with the track of the vehicle that drove it.

    Parameters
    ----------
    lane : Lane
        With stations.
    jump_m : float
        Largest step of the track that no vehicle makes: its receiver is not more accurate. [m]

    Returns
    -------
    TrackAgreement or None
        None where less than 30 m of the track are beside the path; see `runs_apart`.

    Notes
    -----
    A fix q and the place p of the path next to it, with the normal n and curvature k there, give
    n . (q + shift + turn x (q - c) + scale (q - c) - p) = offset - cut k + noise, solved for all six unknowns with
    priors, and repeated until the places do not move. Wander is correlated over 30 m, so fixes count less. The
    receiver's accuracy, which a slow error takes up whole, is added to what the geometry leaves open.
    """
    if not len(lane.station_m) or np.isnan(lane.curvature_per_m).any() or (np.abs(track.lat_deg) > 90).any():
        return None
    fixes, spacing_m = _thinned(_fixes(lane, track)[_converged(track.time_s)])
    accuracy = max(RECEIVER_OPTIMISM * track.usual_accuracy_m, jump_m)
    wander = math.hypot(WANDER_SD_M, SLOW_SHARE * accuracy) * math.sqrt(max(2 * WANDER_LENGTH_M / spacing_m, 1.0))
    tree, half_width_m = scipy.spatial.cKDTree(lane.position_enu_m), _half_width_m(lane)
    fixes = fixes[np.asarray(tree.query(fixes)[0]) < _MAX_BESIDE_M]
    if accuracy < _PRECISE_M:
        fixes = fixes[_in_lane(lane, tree, fixes, half_width_m)]
    if len(fixes) < _MIN_FIXES:
        return None
    middle, values = fixes.mean(0), np.zeros(6)
    for _ in range(_ROUNDS):
        moved = _transformed(fixes, middle, values)
        compared = _beside(lane, tree, fixes, moved)
        if len(compared.fix_m) < _MIN_FIXES or lengths_along(compared.fix_m)[-1] < _MIN_LENGTH_M:
            return None
        values, covariance = _solve(compared, middle, values, wander)
        if np.abs(_transformed(fixes, middle, values) - moved).max() < _CONVERGED_M:
            break
    return _agreement(compared, middle, values, covariance, accuracy, half_width_m)


def runs_apart(lane: Lane, track: PoseTrack) -> bool:
    """Whether a track that could not be compared with a path is elsewhere, rather than beside it but too short.

    Parameters
    ----------
    lane : Lane
        With stations.
    track : PoseTrack
        For which `compare_with_track` returned None.
    """
    origin = (lane.origin_lon_deg, lane.origin_lat_deg)
    fixes = plane_from_wgs84(track.lon_deg, track.lat_deg, origin)
    fixes = fixes[np.isfinite(fixes).all(1)]
    if not len(fixes):
        return False
    nearest_m = float(np.min(scipy.spatial.cKDTree(lane.position_enu_m).query(fixes)[0]))
    moved_m = math.hypot(*np.ptp(fixes, axis=0))
    return nearest_m > _APART_M or min(moved_m, float(lane.station_m[-1])) > _MIN_LENGTH_M


def _fixes(lane: Lane, track: PoseTrack) -> Floats:
    """Fixes in the plane of a path, shape (T, 2). [m]"""
    origin = (lane.origin_lon_deg, lane.origin_lat_deg)
    return without_wild_fixes(track.time_s, plane_from_wgs84(track.lon_deg, track.lat_deg, origin))


def _in_lane(lane: Lane, tree: scipy.spatial.cKDTree, fixes_m: Floats, half_width_m: float) -> Bools:
    """Fixes of a vehicle that has not left its lane, as for overtaking; all of them, if it was hardly in one.

    Also all of them, where more than a tenth run parallel to the path, farther away than a vehicle that overtakes: the
    path is then in the wrong place. A vehicle that turns off does not run parallel.
    """
    if len(fixes_m) < 2:
        return np.ones(len(fixes_m), bool)
    at = np.asarray(tree.query(fixes_m)[1])
    off = np.sum(_normals(lane, at) * (fixes_m - lane.position_enu_m[at]), 1)
    away_m = np.abs(off - np.median(off))
    inside = away_m < half_width_m + _BESIDE_LANE_M
    ahead = np.gradient(fixes_m, axis=0)
    across = np.abs(np.sum(_normals(lane, at) * ahead, 1)) / np.maximum(np.hypot(*ahead.T), 1e-9)
    if np.mean((away_m > 3 * half_width_m + _BESIDE_LANE_M) & (across < _PARALLEL_SINE)) > _MAX_PARALLEL_SHARE:
        return np.ones(len(inside), bool)
    return inside if inside.mean() >= _MIN_CONVERGED else np.ones(len(inside), bool)


def _normals(lane: Lane, at: Ints) -> Floats:
    """Unit vectors to the left of a path at some of its stations, shape (N, 2)."""
    yaw = np.radians(90.0 - lane.heading_deg[at])
    return np.stack([-np.sin(yaw), np.cos(yaw)], 1)


def _half_width_m(lane: Lane) -> float:
    """Half of a lane's width, or of a usual one. [m]"""
    known = lane.width_m[np.isfinite(lane.width_m)]
    return float(np.median(known)) / 2 if len(known) else LaneRules().usual_width_m / 2


def has_gaps(time_s: Floats) -> bool:
    """Whether a track was interrupted, as in a tunnel. Times in seconds, rising."""
    return bool((np.diff(time_s) > _GAP_S).any())


def _converged(time_s: Floats) -> Bools:
    """Fixes that are not just after a gap; all of them, if too few are left."""
    ends = time_s[1:][np.diff(time_s) > _GAP_S]
    if not len(ends):
        return np.ones(len(time_s), bool)
    last = np.searchsorted(ends, time_s, side="right") - 1
    good = (last < 0) | (time_s - ends[np.maximum(last, 0)] > _CONVERGING_S)
    return good if good.mean() >= _MIN_CONVERGED else np.ones(len(time_s), bool)


def _thinned(fixes_m: Floats) -> tuple[Floats, float]:
    """Mean fixes of steps along the track, and the length of a step. [m]"""
    fixes = fixes_m[np.isfinite(fixes_m).all(1)]
    length_m = float(lengths_along(fixes)[-1]) if len(fixes) else 0.0
    spacing_m = max(_SPACING_M, length_m / _MAX_STEPS)
    return mean_fixes(fixes, spacing_m), spacing_m


def _transformed(fixes_m: Floats, middle_m: Floats, values: Floats) -> Floats:
    from_middle = fixes_m - middle_m
    turned = np.stack([-from_middle[:, 1], from_middle[:, 0]], 1)
    return np.asarray(fixes_m + values[:2] + values[2] * turned + values[3] * from_middle)


def _beside(lane: Lane, tree: scipy.spatial.cKDTree, fixes_m: Floats, moved_m: Floats) -> _Compared:
    """The fixes that lie beside the path once they are moved, rather than beyond its ends."""
    far, index = (np.asarray(found) for found in tree.query(moved_m))
    keep = (index > 0) & (index < len(lane.station_m) - 1) & (far < _MAX_BESIDE_M)
    at = index[keep]
    return _Compared(fixes_m[keep], lane.position_enu_m[at], _normals(lane, at), lane.curvature_per_m[at])


def _solve(compared: _Compared, middle_m: Floats, values: Floats, noise_m: float) -> tuple[Floats, Floats]:
    """The six unknowns and their covariance: shift, turn, scale, the driver's offset, cut of bends.

    The noise is that of a fix as if fixes were independent.
    """
    q, p, n, bend = compared
    from_middle = q - middle_m
    turned = np.stack([-from_middle[:, 1], from_middle[:, 0]], 1)
    rows = np.column_stack([n, np.sum(n * turned, 1), np.sum(n * from_middle, 1), -np.ones(len(q)), -bend])
    wanted = np.sum(n * (p - q), 1)
    residual = np.abs(wanted - rows @ values)
    spread = max(WANDER_SD_M, 1.4826 * float(np.median(residual)))
    weight = np.minimum(1.0, _OUTLIER_SIGMAS * spread / np.maximum(residual, 1e-9)) / noise_m**2
    prior = np.array([_SHIFT_SD_M, _SHIFT_SD_M, _TURN_SD, _SCALE_SD, DRIVER_OFFSET_SD_M, _CUT_M2]) ** -2.0
    covariance = np.linalg.inv(rows.T @ (weight[:, None] * rows) + np.diag(prior))
    return covariance @ (rows.T @ (weight * wanted)), covariance


def _agreement(
    compared: _Compared,
    middle_m: Floats,
    values: Floats,
    covariance: Floats,
    accuracy_m: float,
    half_width_m: float,
) -> TrackAgreement:
    shift, turn, scale = values[:2], float(values[2]), float(values[3])
    reach_m = math.sqrt(float(np.mean(np.sum((compared.fix_m - middle_m) ** 2, 1))))
    slow = accuracy_m / reach_m  # a receiver's error that changes by itself along the track
    receiver = np.diag([accuracy_m, accuracy_m, slow, slow]) ** 2
    total = covariance[:2, :2] + accuracy_m**2 * np.eye(2)
    shift_z = math.sqrt(float(shift @ np.linalg.solve(total, shift)))
    turn_sigma, scale_sigma = (math.hypot(math.sqrt(float(covariance[k, k])), slow) for k in (2, 3))
    moved = _transformed(compared.fix_m, middle_m, values) - compared.fix_m
    across = np.sum(moved * compared.normal, 1)
    alone = max(shift_z, abs(turn) / turn_sigma, abs(scale) / scale_sigma)
    significance = max(alone, _joint_significance(values[:4], covariance[:4, :4] + receiver))
    effect_m = float(np.sqrt(np.mean(across**2)))
    leaves_m = max(_MIN_LEAVES_M, half_width_m - _BODY_M)
    disagrees = significance > MAX_TRACK_SIGNIFICANCE and effect_m > MIN_TRACK_EFFECT_M
    disagrees |= significance > _MIN_LEAVES_SIGNIFICANCE and effect_m > leaves_m and accuracy_m < _PRECISE_M
    return TrackAgreement(
        east_m=float(shift[0]),
        north_m=float(shift[1]),
        shift_sigma_m=float(np.hypot(*shift)) / max(shift_z, 1e-9),
        turn_deg=math.degrees(turn),
        turn_sigma_deg=math.degrees(turn_sigma),
        scale_ppm=1e6 * scale,
        scale_sigma_ppm=1e6 * scale_sigma,
        significance=significance,
        effect_m=effect_m,
        disagrees=disagrees,
    )


def _joint_significance(values: Floats, covariance: Floats) -> float:
    """Significance of four values together, in standard deviations of a normal distribution with the same probability.

    A shift, a turn and a scale that can replace each other are uncertain one by one, but not together.

    Notes
    -----
    The chance of a larger chi-squared x of four degrees of freedom is exp(-x / 2) (1 + x / 2).
    """
    squared = float(values @ np.linalg.solve(covariance, values))
    log_chance = -squared / 2 + math.log1p(squared / 2)
    return float(-scipy.special.ndtri_exp(log_chance - math.log(2.0)))


# === Whether a path turns aside where the vehicle drives on.
#
# Within a few tens of metres a driver hardly moves across the lane. Where the path does, the markers from there on are
# surveyed in another datum, or the path cuts a corner because true markers were left out. Headings show it best: they
# do not step or drift as positions do. What a constant error of the heading explains, or one of the positions, which
# compares a bend with the wrong place of it, is no departure; nor is one of the vehicle, whose own heading turns aside.


_SPANS_M = (24.0, 48.0)  # [m] within which a path moves across; two and four spacings of the paper
_AROUND_M = 60.0  # [m] before and after, where constant errors are learnt
_MIN_AROUND, _MAX_STEP_M = 8, 6.0  # steps of the track there, and their length [m], beyond which nothing shows
_MIN_ASIDE_M, _ASIDE_SIGMAS, _CLEAR_SIGMAS = 0.5, 5.0, 3.0  # [m, 1, 1] that is reported; where the path clearly turns
_BUMP_SHARE = 1.08  # of the vehicle's turn, which places beside each other in a bend may differ by
_BUMP_PER_M, _CLEAR_BUMP = 0.02, 0.03  # [rad/m, rad] by which the path turns aside and back more than the vehicle
_SLOW_DRIFT = 0.2  # share of a receiver's accuracy by which its error changes in between
_HEADING_SD = 0.03  # [rad] of a step's heading
_MAX_GAP_M = 45.0  # [m] between two fixes of a receiver of 1 Hz on a motorway
_HEADING_OFF = 0.35  # [rad] headings that differ more from the path are not the vehicle's
_DOUBTFUL_REACH_M = 30.0  # [m] from a marker that was left out, where the path may be at fault


class Departure(NamedTuple):
    """Where a path turns aside and the vehicle does not."""

    station_m: float  # [m] of the path
    aside_m: float  # [m] to the left of the vehicle's course


def find_departure(lane: Lane, track: PoseTrack, doubtful_m: Floats, jump_m: float = 0.0) -> Departure | None:
    """Where a path departs most from the shape of the vehicle's track; None if it does not, or too little is beside it,
    or the track is longer than 30 km.

    Parameters
    ----------
    doubtful_m : ndarray, shape (N, 2)
        Markers that were left out because they are off the line, in the lane's frame. [m]
    jump_m : float
        As of `compare_with_track`. [m]

    Notes
    -----
    Beside the path, the vehicle's direction less the path's is b + e k + noise, with a constant error b of headings, a
    constant error e of positions along the path, and the path's curvature k. Both are estimated before and after a
    stretch; what is left within it, summed over its length, is how far the path moves across.
    """
    if not len(lane.station_m) or np.isnan(lane.curvature_per_m).any() or (np.abs(track.lat_deg) > 90).any():
        return None
    steps = _steps_beside(lane, track)
    if len(steps.at) < 2 * _MIN_AROUND or steps.length_m > _MAX_STEP_M:
        return None
    accuracy_m = max(track.usual_accuracy_m, jump_m)
    doubtful = np.zeros(len(steps.at), bool)
    if len(doubtful_m):
        near, _ = scipy.spatial.cKDTree(doubtful_m).query(lane.position_enu_m[steps.at])
        doubtful = np.asarray(near) < _DOUBTFUL_REACH_M
    shortest = max(round(_SPANS_M[0] / steps.length_m / 2), 1)
    turns_aside = _bump(steps.path_yaw, shortest) - _BUMP_SHARE * _bump(steps.track_yaw, shortest)
    worst: tuple[float, Departure | None] = (1.0, None)
    for span_m in _SPANS_M:
        half = max(round(span_m / steps.length_m / 2), 1)
        aside_m, seeming_m = _aside(steps, half, accuracy_m)
        seen = np.isfinite(aside_m)
        if not seen.any():
            continue
        spread_m = 1.4826 * float(np.median(np.abs(aside_m[seen])))
        bump = np.asarray(scipy.ndimage.maximum_filter1d(turns_aside, 2 * (half - shortest) + 1, mode="nearest"))
        ratio = np.zeros(len(steps.at))
        bump -= _BUMP_PER_M * np.abs(np.nan_to_num(aside_m))
        for sigmas, of_path in ((_ASIDE_SIGMAS, (bump > 0) | doubtful), (_CLEAR_SIGMAS, bump > _CLEAR_BUMP)):
            limit_m = np.maximum(_MIN_ASIDE_M, sigmas * spread_m) + sigmas * seeming_m
            ratio = np.maximum(ratio, np.where(seen & of_path, np.abs(aside_m) / limit_m, 0.0))
        k = int(np.argmax(ratio))
        if ratio[k] > worst[0]:
            worst = float(ratio[k]), Departure(float(lane.station_m[steps.at[k]]), -float(aside_m[k]))
    return worst[1]


class _Steps(NamedTuple):
    """Even steps of a track beside a path, each shape (T,)."""

    at: Ints  # station of the path beside it
    path_yaw: Floats  # [rad] anticlockwise from east, unwrapped
    track_yaw: Floats  # [rad] likewise
    curvature_per_m: Floats  # of the path
    seen: Bools  # fixes show it, rather than those before and after a gap
    length_m: float  # of a step


def _steps_beside(lane: Lane, track: PoseTrack) -> _Steps:
    """Positions and headings of a track at even steps, where it is beside a path."""
    plane = _fixes(lane, track)
    along, good = lengths_along(plane), _converged(track.time_s)
    length_m = max(_SPACING_M, float(along[-1]) / _MAX_STEPS)
    first, which, count = np.unique((along[good] / length_m).astype(np.int64), return_inverse=True, return_counts=True)
    step = np.arange(first[0], first[-1] + 1)

    def even(values: Floats) -> Floats:
        return np.interp(step, first, np.bincount(which, values[good]) / count)

    fixes = np.stack([even(plane[:, 0]), even(plane[:, 1])], 1)
    yaw = np.radians(90.0 - track.heading_deg)
    headings = np.arctan2(even(np.sin(yaw)), even(np.cos(yaw)))  # NaN where one is not known
    far, index = (np.asarray(found) for found in scipy.spatial.cKDTree(lane.position_enu_m).query(fixes))
    kept = np.flatnonzero((index > 0) & (index < len(lane.station_m) - 1) & (far < _MAX_BESIDE_M))
    index, fixes = index[kept], fixes[kept]
    path = np.unwrap(np.radians(90.0 - lane.heading_deg))
    ahead = np.stack([np.cos(path[index]), np.sin(path[index])], 1)
    station_m = lane.station_m[index] + np.sum(ahead * (fixes - lane.position_enu_m[index]), 1)
    path_yaw = np.interp(station_m, lane.station_m, path)
    off = np.angle(np.exp(1j * (headings[kept] - path_yaw)))
    if not np.isfinite(off).all() or (len(off) and np.median(np.abs(off)) > _HEADING_OFF):
        course = np.gradient(fixes, axis=0) if len(fixes) > 1 else np.zeros_like(fixes)
        off = np.angle(np.exp(1j * (np.arctan2(course[:, 1], course[:, 0]) - path_yaw)))
    gap = np.searchsorted(first, step[kept])
    seen = (first[gap] - first[np.maximum(gap - 1, 0)]) * length_m <= max(_MAX_GAP_M, length_m)
    seen |= first[gap] == step[kept]
    return _Steps(index, path_yaw, path_yaw + off, lane.curvature_per_m[index], seen, length_m)


def _aside(steps: _Steps, half: int, accuracy_m: float) -> tuple[Floats, Floats]:
    """How far the vehicle moves to the left of the path within so many steps before and after each one, NaN where that
    is not known; and what it seems to (1 sigma), because it is compared with the wrong place of a bend. [m, m]
    """
    count, around = len(steps.at), half + round(_AROUND_M / steps.length_m)
    off, bend = steps.track_yaw - steps.path_yaw, steps.curvature_per_m
    terms = np.where(steps.seen[:, None], np.stack([np.ones(count), bend, bend * bend, off, bend * off], 1), 0.0)
    total = np.concatenate([np.zeros((1, terms.shape[1])), np.cumsum(terms, axis=0)])
    place = np.arange(count)

    def within(reach: int) -> Floats:
        return np.asarray(total[np.minimum(place + reach + 1, count)] - total[np.maximum(place - reach, 0)])

    inner = within(half)
    n, k, kk, d, kd = (within(around) - inner).T
    prior_m = 2 * accuracy_m + _MIN_ASIDE_M  # of the position's error
    kk = kk + (_HEADING_SD / prior_m) ** 2
    determinant = np.maximum(n * kk - k * k, 1e-12)
    constant, along_m = (kk * d - k * kd) / determinant, (n * kd - k * d) / determinant
    aside_m = steps.length_m * (inner[:, 3] - constant * inner[:, 0] - along_m * inner[:, 1])
    sigma_m = np.hypot(_HEADING_SD * np.sqrt(n / determinant), _SLOW_DRIFT * accuracy_m)
    whole = (inner[:, 0] == 2 * half + 1) & (n >= _MIN_AROUND)
    return np.where(whole, aside_m, np.nan), sigma_m * np.abs(steps.length_m * inner[:, 1])


def _bump(yaw: Floats, half: int) -> Floats:
    """How much a direction turns aside and back again around each step. [rad]"""
    smooth = scipy.ndimage.uniform_filter1d(yaw, max(half // 2, 1), mode="nearest")
    second = np.zeros(len(yaw))
    if len(yaw) > 2 * half:
        second[half:-half] = np.abs(smooth[2 * half :] - 2 * smooth[half:-half] + smooth[: -2 * half])
    return np.asarray(scipy.ndimage.maximum_filter1d(second, 2 * half + 1, mode="nearest"))
