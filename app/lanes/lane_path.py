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
    fixes, spacing_m = _thinned(
        plane_from_wgs84(track.lon_deg, track.lat_deg, (lane.origin_lon_deg, lane.origin_lat_deg))
    )
    accuracy = _accuracy_m(track, _OPTIMISM)
    wander = math.hypot(_WANDER_SD_M, _SLOW_SHARE * accuracy) * math.sqrt(max(2 * _WANDER_LENGTH_M / spacing_m, 1.0))
    tree = scipy.spatial.cKDTree(lane.position_enu_m)
    fixes = fixes[np.asarray(tree.query(fixes)[0]) < _MAX_BESIDE_M]
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
    return _agreement(compared, middle, values, covariance, accuracy)


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


def _accuracy_m(track: PoseTrack, optimism: float = 1.0) -> float:
    """Accuracy of a track's receiver: what it states times a factor, or that of one without corrections. [m]"""
    stated = track.accuracy_m[np.isfinite(track.accuracy_m)]
    return optimism * max(float(np.median(stated)), 0.0) if len(stated) else UNKNOWN_ACCURACY_M


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
    compared: _Compared, middle_m: Floats, values: Floats, covariance: Floats, accuracy_m: float
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
        disagrees=significance > MAX_TRACK_SIGNIFICANCE and effect_m > MIN_TRACK_EFFECT_M,
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
# Within a few tens of metres neither a driver nor a receiver's slow error moves far across the lane. Where the path
# does, markers of one stretch are surveyed in another datum, or the path cuts a corner because true markers were left
# out. What a constant error of the receiver explains, in its own direction, is no departure.


_WINDOW_M = 36.0  # [m] three spacings of the paper
_MIN_IN_WINDOW = 8  # steps of the track
_MIN_DEPARTURE_M, _DEPARTURE_SHARE = 0.4, 0.5  # [m, 1] that is reported; share of the receiver's accuracy
_SLOW_ERROR_M = 10.0  # [m] of a receiver, on each axis; it is the same within a window


class Departure(NamedTuple):
    """Where a path departs most from the vehicle's track, but for a constant error of the receiver."""

    station_m: float  # [m] of the path
    rms_m: float  # [m] within a window, across the path


def find_departure(lane: Lane, track: PoseTrack) -> Departure | None:
    """Where a path departs from the shape of the vehicle's track; None if it does not, or too little is beside it."""
    if not len(lane.station_m) or np.isnan(lane.curvature_per_m).any() or (np.abs(track.lat_deg) > 90).any():
        return None
    fixes, spacing_m = _thinned(
        plane_from_wgs84(track.lon_deg, track.lat_deg, (lane.origin_lon_deg, lane.origin_lat_deg))
    )
    if len(fixes) < 2:
        return None
    far, index = (np.asarray(found) for found in scipy.spatial.cKDTree(lane.position_enu_m).query(fixes))
    keep = (index > 0) & (index < len(lane.station_m) - 1) & (far < _MAX_BESIDE_M)
    at, fixes = index[keep], fixes[keep]
    width = round(_WINDOW_M / spacing_m)
    if len(at) < max(width, _MIN_IN_WINDOW):
        return None
    yaw = np.radians(90.0 - lane.heading_deg[at])
    normal = np.stack([-np.sin(yaw), np.cos(yaw)], 1)
    off = np.sum(normal * (fixes - lane.position_enu_m[at]), 1)

    def windows(values: Floats) -> Floats:
        total = np.cumsum(np.concatenate([np.zeros((1, *values.shape[1:])), values]), axis=0)
        return np.asarray(total[width:] - total[:-width])

    squares = windows(normal[:, :, None] * normal[:, None, :]) + np.eye(2) / _SLOW_ERROR_M**2
    mixed = windows(normal * off[:, None])
    explained = np.einsum("wi,wi->w", mixed, np.linalg.solve(squares, mixed[:, :, None])[:, :, 0])
    rms = np.sqrt(np.maximum(windows(off**2) - explained, 0.0) / width)
    worst = int(np.argmax(rms))
    if rms[worst] < max(_MIN_DEPARTURE_M, _DEPARTURE_SHARE * _accuracy_m(track)):
        return None
    return Departure(float(lane.station_m[at[worst + width // 2]]), float(rms[worst]))
