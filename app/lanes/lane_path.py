"""Results of a fit as a reference path: stations, boundaries, speed limits, accuracy, agreement with the track."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy

from app.lanes.initial_line import UNKNOWN_ACCURACY_M
from app.lanes.lane_fit import LaneFit
from app.lanes.observations import LaneObservations
from app.lanes.smooth_line import (
    SmoothLine,
    SplineBoundaries,
    headings_deg,
    left_normals,
    lengths_along,
    plane_from_wgs84,
    wgs84_from_plane,
)
from app.lanes.types import (
    MAX_TRACK_SIGNIFICANCE,
    MIN_TRACK_EFFECT_M,
    UNKNOWN,
    Lane,
    LaneRules,
    LeftOutReason,
    Notes,
    TrackAgreement,
)
from app.sensors.pose_track import PoseTrack
from app.values import Bools, Floats, Ints

_MAX_WIDTH_SIGMA_M = 0.3  # [m] a width that is less certain is not published; an eighth of narrow lanes
_MAX_BOUNDARY_SIGMA_M = 0.4  # [m] a boundary that is less certain is not published
_SAME_STATION_M = 3.0  # [m] speed limits closer along the path must agree; a quarter of the paper's 12.2 m
_MIN_OTHER_ROW = 3  # outliers that may be a row that the path should follow; two may be chance
_OTHER_ROW_REACH_M, _OTHER_ROW_SPACINGS = 40.0, 3.0  # [m, 1] within which so many are close together
_OTHER_ROW_SIGMA_M = 0.6  # [m] added then; the path's confidence falls below one half
_MIN_SIGMA_M = 1e-6  # [m] keeps the confidence finite; source: below every survey, above rounding
_TAIL_FREEDOM, _TAIL_SCALE = 2.4, 0.61
"""Degrees of freedom and scale, in standard deviations, of the distribution of errors. Source: maximum likelihood of
which of 33,203 places on 4,240 paths of the scene hunter (seeds 160000 to 165000) are within the tolerance."""


def path_from_fit(fit: LaneFit, observations: LaneObservations, rules: LaneRules, notes: Notes) -> Lane:
    """The fit at stations of its path, from the first marker to the last and beyond while the path is accurate."""
    problem, solution = fit.problem, fit.solution
    knots_m = fit.line.offset_points(problem.station_m, solution.centre_m)
    path = SmoothLine(knots_m)
    along = lengths_along(knots_m)
    along *= path.length_m / along[-1]
    at = path.station_m
    probes, *deviations = solution.sigmas()
    probes = np.interp(probes, problem.station_m, along)
    sigma, sigma_left, sigma_right, sigma_width = (np.interp(at, probes, values) for values in deviations)
    width = np.interp(at, along, solution.width_m)
    markers_at = np.interp(fit.station_m, problem.station_m, along)
    inner = markers_at[fit.used]
    keep = _accurate_stations(at, sigma, inner.min(), inner.max(), rules.max_end_sigma_m)
    sigma = _sigma_with_other_row(sigma, at, markers_at, fit, notes)
    left, right = (
        np.where(
            (known < _MAX_BOUNDARY_SIGMA_M)[:, None],
            path.points_m + sign * left_normals(path.tangent) * width[:, None] / 2,
            np.nan,
        )
        for sign, known in ((1, sigma_left), (-1, sigma_right))
    )
    lon, lat = wgs84_from_plane(path.points_m, observations.origin)
    limit = _speed_limits(at, inner, observations.speed_limit_kmh[fit.used], notes)
    row_side, row_residual = _by_row(fit, observations)
    if len(at[keep]) and float(np.max(sigma[keep])) > rules.max_end_sigma_m:
        notes.warn(f"the path is inaccurate in places: up to {float(np.max(sigma[keep])):.2f} m")
    return Lane(
        origin_lon_deg=observations.origin[0],
        origin_lat_deg=observations.origin[1],
        station_m=at[keep] - at[keep][0],
        position_enu_m=path.points_m[keep],
        left_enu_m=left[keep],
        right_enu_m=right[keep],
        lon_deg=lon[keep],
        lat_deg=lat[keep],
        heading_deg=headings_deg(lon, lat)[keep],
        curvature_per_m=path.curvature_per_m[keep],
        width_m=np.where(sigma_width < _MAX_WIDTH_SIGMA_M, width, np.nan)[keep],
        speed_limit_kmh=limit[keep],
        sigma_m=sigma[keep],
        confidence=_confidence(sigma[keep], rules.tolerance_m),
        side=row_side,
        residual_m=row_residual,
        left_out=tuple(notes.left_out),
        localization_warnings=tuple(notes.localization_warnings),
    )


def _confidence(sigma_m: Floats, tolerance_m: float) -> Floats:
    """Probability that errors of these standard deviations are within the tolerance.

    Student's t distribution: most errors are smaller than the standard deviations, but a marker that is taken for an
    honest one, or for one of the other side, gives more large errors than a normal distribution has.
    """
    z = tolerance_m / np.maximum(sigma_m, _MIN_SIGMA_M)
    return np.asarray(2 * scipy.special.stdtr(_TAIL_FREEDOM, z / _TAIL_SCALE) - 1, float)


def path_from_splines(bounds: SplineBoundaries, observations: LaneObservations, taken: Bools, notes: Notes) -> Lane:
    """Midpoints between the splines of both sides, without accuracy."""
    left, right = bounds.left_m, bounds.right_m
    middle = (left + right) / 2
    moved = np.concatenate([[True], np.hypot(*np.diff(middle, axis=0).T) > 1e-6])
    left, right, middle = left[moved], right[moved], middle[moved]
    if len(middle) < 3:
        return refused_path(observations, notes, "the markers have no length", "paper")
    at = lengths_along(middle)
    lon, lat = wgs84_from_plane(middle, observations.origin)
    none = np.full(len(at), np.nan)
    slope = np.gradient(middle, at, axis=0)
    bend = np.gradient(slope, at, axis=0)
    curvature = (slope[:, 0] * bend[:, 1] - slope[:, 1] * bend[:, 0]) / np.maximum(np.hypot(*slope.T), 1e-9) ** 3
    markers_at = at[scipy.spatial.cKDTree(middle).query(observations.point_m)[1]]
    known = observations.of_row >= 0
    return Lane(
        origin_lon_deg=observations.origin[0],
        origin_lat_deg=observations.origin[1],
        station_m=at,
        position_enu_m=middle,
        left_enu_m=left,
        right_enu_m=right,
        lon_deg=lon,
        lat_deg=lat,
        heading_deg=headings_deg(lon, lat),
        curvature_per_m=curvature,
        width_m=np.hypot(*(left - right).T),
        speed_limit_kmh=_speed_limits(at, markers_at[taken], observations.speed_limit_kmh[taken], notes),
        sigma_m=none,
        confidence=none,
        side=np.where(known, bounds.side[observations.of_row], UNKNOWN),
        residual_m=np.full(len(known), np.nan),
        left_out=tuple(notes.left_out),
        localization_warnings=tuple(notes.localization_warnings),
        method="paper",
    )


def refused_path(observations: LaneObservations, notes: Notes, reason: str, method: str) -> Lane:
    """A lane without stations, with the reason."""
    none, points = np.empty(0), np.empty((0, 2))
    rows = len(observations.of_row)
    return Lane(
        origin_lon_deg=observations.origin[0],
        origin_lat_deg=observations.origin[1],
        station_m=none,
        position_enu_m=points,
        left_enu_m=points,
        right_enu_m=points,
        lon_deg=none,
        lat_deg=none,
        heading_deg=none,
        curvature_per_m=none,
        width_m=none,
        speed_limit_kmh=none,
        sigma_m=none,
        confidence=none,
        side=np.zeros(rows, np.int64),
        residual_m=np.full(rows, np.nan),
        left_out=tuple(notes.left_out),
        localization_warnings=tuple(notes.localization_warnings),
        refusal=reason,
        method=method,
    )


def _accurate_stations(at: Floats, sigma: Floats, first: float, last: float, max_sigma_m: float) -> slice:
    """Stations from the first to the last marker, and beyond while the standard deviation is small enough."""
    bad = sigma > max_sigma_m
    low = np.flatnonzero(bad & (at < first))
    high = np.flatnonzero(bad & (at > last))
    return slice(int(low[-1]) + 1 if len(low) else 0, int(high[0]) if len(high) else len(at))


def _sigma_with_other_row(sigma: Floats, at: Floats, markers_at: Floats, fit: LaneFit, notes: Notes) -> Floats:
    """Standard deviations, larger where outliers may be a row of markers that the path should follow.

    A row is so many outliers close together, all to the same side; markers that only name the wrong side lie on the
    boundaries that the path has.
    """
    rows = [k for k, (reason, _) in fit.left_out.items() if reason is LeftOutReason.OFF_THE_LINE]
    place, off = markers_at[rows], np.array([fit.left_out[k][1] for k in rows])
    count = len(fit.left_out) + int(fit.used.sum())
    reach = max(_OTHER_ROW_REACH_M, _OTHER_ROW_SPACINGS * 2 * float(np.ptp(markers_at[fit.used])) / count)
    doubtful = np.zeros(len(at), bool)
    for here in place:
        near = np.abs(place - here) <= reach
        if max((near & (off > 0)).sum(), (near & (off < 0)).sum()) >= _MIN_OTHER_ROW:
            doubtful |= np.abs(at - here) <= reach
    if not doubtful.any():
        return sigma
    notes.warn(
        f"{len(rows)} of {count} markers lie off the line, close together: another lane's row, or a lane that merges "
        "or splits"
    )
    return np.where(doubtful, np.hypot(sigma, _OTHER_ROW_SIGMA_M), sigma)


def _speed_limits(at: Floats, station: Floats, limit: Floats, notes: Notes) -> Floats:
    """Speed limit of the marker passed last; the lower one where two markers side by side differ."""
    posted = np.isfinite(limit) & (limit > 0)
    if not posted.any():
        return np.full(len(at), np.nan)
    order = np.argsort(station[posted], kind="stable")
    place, value = station[posted][order], limit[posted][order]
    side_by_side = np.diff(place) < _SAME_STATION_M
    if (side_by_side & (np.diff(value) != 0)).any():
        notes.warn("markers side by side have different speed limits: the lower one is used")
        lower = np.minimum(value[1:], value[:-1])
        value[1:] = np.where(side_by_side, lower, value[1:])
        value[:-1] = np.where(side_by_side, lower, value[:-1])
    return value[np.maximum(np.searchsorted(place, at, side="right") - 1, 0)]


def _by_row(fit: LaneFit, observations: LaneObservations) -> tuple[Ints, Floats]:
    """Side and residual of each row of the markers."""
    known = observations.of_row >= 0
    side, residual = np.zeros(len(known), np.int64), np.full(len(known), np.nan)
    side[known] = np.where(fit.used, fit.side, UNKNOWN)[observations.of_row[known]]
    residual[known] = np.where(fit.used, fit.residual_m, np.nan)[observations.of_row[known]]
    return side, residual


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
_OFFSET_SD_M = 0.25  # [m] of a driver's usual offset; the upper bound of `benchmarks.hunt.cerpm`
_WANDER_SD_M, _WANDER_LENGTH_M = 0.25, 30.0  # [m, m] source: as above, and `least_squares.OFFSET_MODELS`
_CUT_M2 = 2.0  # [m2] offset towards the inside of bends, per curvature; source: twice `Driver.cut_m2` of radio drives
_SHIFT_SD_M, _TURN_SD, _SCALE_SD = 300.0, 0.2, 0.1  # [m, rad, 1] above any mistake that is searched
_OPTIMISM = 1.5  # true error of a receiver over the accuracy that it reports
_SLOW_SHARE = 0.3  # of a receiver's error that changes along the track like wander
_ROUNDS = 12  # of finding the nearest places on the path; converged to a millimetre
_CONVERGED_M = 1e-3  # [m]
_OUTLIER_SIGMAS = 3.0  # from which on a fix counts less (Huber)
_STEP_FIXES, _MAX_STEP_INTERVAL_S = 3, 0.25  # [1, s] fixes before and after a step, and the longest time between fixes
_MIN_STEP_M, _STEP_SPREADS = 0.25, 10.0  # [m, 1] that is one, and its size in the median of all
_GAP_S, _CONVERGING_S = 3.0, 15.0  # [s] without a fix, as in a tunnel, and how long positions are inaccurate after it
_MIN_CONVERGED = 0.5  # share of fixes, below which inaccurate ones are used, too
_PRECISE_M = 0.3  # [m] of a receiver that shows whether a vehicle is in its lane
_BESIDE_LANE_M = 0.5  # [m] from a boundary
_BODY_M = 1.0  # [m] half of a car with its mirrors; its driver keeps it between the boundaries
_MIN_LEAVES_M, _MIN_LEAVES_SIGNIFICANCE = 0.65, 2.5  # [m, 1] a path so far from a vehicle is not that of its lane


class _Compared(NamedTuple):
    """Fixes and the places of the path next to them."""

    fix_m: Floats
    place_m: Floats
    normal: Floats
    curvature_per_m: Floats


def compare_with_track(lane: Lane, track: PoseTrack) -> TrackAgreement | None:
    """Compare a path with the track of the vehicle that drove it.

    Parameters
    ----------
    lane : Lane
        With stations.

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
    plane = plane_from_wgs84(track.lon_deg, track.lat_deg, (lane.origin_lon_deg, lane.origin_lat_deg))
    fixes, spacing_m = _thinned(plane[_converged(track.time_s)])
    accuracy = _accuracy_m(track, plane, _OPTIMISM)
    wander = math.hypot(_WANDER_SD_M, _SLOW_SHARE * accuracy) * math.sqrt(max(2 * _WANDER_LENGTH_M / spacing_m, 1.0))
    tree = scipy.spatial.cKDTree(lane.position_enu_m)
    fixes = fixes[np.asarray(tree.query(fixes)[0]) < _MAX_BESIDE_M]
    if accuracy < _PRECISE_M:
        fixes = fixes[_in_lane(lane, tree, fixes)]
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
    return _agreement(compared, middle, values, covariance, accuracy, _half_width_m(lane))


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


def _accuracy_m(track: PoseTrack, fixes_m: Floats, optimism: float = 1.0) -> float:
    """Accuracy of a track's receiver: what it states times a factor, or that of one without corrections. [m]

    A receiver that steps is not more accurate than its largest step.
    """
    stated = track.accuracy_m[np.isfinite(track.accuracy_m)]
    accuracy_m = optimism * max(float(np.median(stated)), 0.0) if len(stated) else UNKNOWN_ACCURACY_M
    return max(accuracy_m, _largest_step_m(track.time_s, fixes_m))


def _in_lane(lane: Lane, tree: scipy.spatial.cKDTree, fixes_m: Floats) -> Bools:
    """Fixes of a vehicle that has not left its lane, as for overtaking; all of them, if it was hardly in one."""
    if not len(fixes_m):
        return np.ones(0, bool)
    at = np.asarray(tree.query(fixes_m)[1])
    yaw = np.radians(90.0 - lane.heading_deg[at])
    off = np.sum(np.stack([-np.sin(yaw), np.cos(yaw)], 1) * (fixes_m - lane.position_enu_m[at]), 1)
    inside = np.abs(off - np.median(off)) < _half_width_m(lane) + _BESIDE_LANE_M
    return inside if inside.mean() >= _MIN_CONVERGED else np.ones(len(inside), bool)


def _half_width_m(lane: Lane) -> float:
    """Half of a lane's width, or of a usual one. [m]"""
    known = lane.width_m[np.isfinite(lane.width_m)]
    return float(np.median(known)) / 2 if len(known) else LaneRules().usual_width_m / 2


def _largest_step_m(time_s: Floats, fixes_m: Floats) -> float:
    """How far positions step, from a few fixes to the next few, beyond how the vehicle moves; 0 if they do not. [m]"""
    few = _STEP_FIXES
    if len(time_s) < 4 * few or np.median(np.diff(time_s)) > _MAX_STEP_INTERVAL_S:
        return 0.0
    if np.abs(fixes_m[2:] - 2 * fixes_m[1:-1] + fixes_m[:-2]).max() < _MIN_STEP_M / 2:
        return 0.0  # as of nearly all accurate receivers
    windows = np.lib.stride_tricks.sliding_window_view(fixes_m, 2 * few, axis=0)
    times = np.lib.stride_tricks.sliding_window_view(time_s, 2 * few)
    speed = np.median(np.diff(windows, axis=2) / np.diff(times)[:, None], axis=2)
    moved = np.median(windows[:, :, few:], 2) - np.median(windows[:, :, :few], 2)
    lapse = np.median(times[:, few:], 1) - np.median(times[:, :few], 1)
    step_m = np.hypot(*(moved - speed * lapse[:, None]).T)
    dense = times[:, -1] - times[:, 0] < 3 * few * _MAX_STEP_INTERVAL_S
    largest_m = float(step_m[dense].max(initial=0.0))
    return largest_m if largest_m > max(_MIN_STEP_M, _STEP_SPREADS * float(np.median(step_m))) else 0.0


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
    """Mean fixes of steps along the track, so that a vehicle that stands counts once; and the length of a step. [m]"""
    fixes = fixes_m[np.isfinite(fixes_m).all(1)]
    if len(fixes) < 2:
        return fixes, _SPACING_M
    along = lengths_along(fixes)
    spacing_m = max(_SPACING_M, float(along[-1]) / _MAX_STEPS)
    _, which, count = np.unique((along / spacing_m).astype(np.int64), return_inverse=True, return_counts=True)
    return np.stack([np.bincount(which, fixes[:, k]) / count for k in range(2)], 1), spacing_m


def _transformed(fixes_m: Floats, middle_m: Floats, values: Floats) -> Floats:
    from_middle = fixes_m - middle_m
    turned = np.stack([-from_middle[:, 1], from_middle[:, 0]], 1)
    return np.asarray(fixes_m + values[:2] + values[2] * turned + values[3] * from_middle)


def _beside(lane: Lane, tree: scipy.spatial.cKDTree, fixes_m: Floats, moved_m: Floats) -> _Compared:
    """The fixes that lie beside the path once they are moved, rather than beyond its ends."""
    far, index = (np.asarray(found) for found in tree.query(moved_m))
    keep = (index > 0) & (index < len(lane.station_m) - 1) & (far < _MAX_BESIDE_M)
    at = index[keep]
    yaw = np.radians(90.0 - lane.heading_deg[at])
    normal = np.stack([-np.sin(yaw), np.cos(yaw)], 1)
    return _Compared(fixes_m[keep], lane.position_enu_m[at], normal, lane.curvature_per_m[at])


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
    spread = max(_WANDER_SD_M, 1.4826 * float(np.median(residual)))
    weight = np.minimum(1.0, _OUTLIER_SIGMAS * spread / np.maximum(residual, 1e-9)) / noise_m**2
    prior = np.array([_SHIFT_SD_M, _SHIFT_SD_M, _TURN_SD, _SCALE_SD, _OFFSET_SD_M, _CUT_M2]) ** -2.0
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
_MIN_AROUND = 8  # steps of the track there
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


def find_departure(lane: Lane, track: PoseTrack, doubtful_m: Floats) -> Departure | None:
    """Where a path departs most from the shape of the vehicle's track; None if it does not, or too little is beside it.

    Parameters
    ----------
    doubtful_m : ndarray, shape (N, 2)
        Markers that were left out because they are off the line, in the lane's frame. [m]

    Notes
    -----
    Beside the path, the vehicle's direction less the path's is b + e k + noise, with a constant error b of headings, a
    constant error e of positions along the path, and the path's curvature k. Both are estimated before and after a
    stretch; what is left within it, summed over its length, is how far the path moves across.
    """
    if not len(lane.station_m) or np.isnan(lane.curvature_per_m).any() or (np.abs(track.lat_deg) > 90).any():
        return None
    steps = _steps_beside(lane, track)
    if len(steps.at) < 2 * _MIN_AROUND:
        return None
    plane = plane_from_wgs84(track.lon_deg, track.lat_deg, (lane.origin_lon_deg, lane.origin_lat_deg))
    accuracy_m = _accuracy_m(track, plane)
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
    plane = plane_from_wgs84(track.lon_deg, track.lat_deg, (lane.origin_lon_deg, lane.origin_lat_deg))
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
