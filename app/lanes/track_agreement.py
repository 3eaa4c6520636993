"""Whether a path agrees with the vehicle's track: their common shift, turn and scale.

Markers that are all shifted alike, as by a survey in another datum, make a perfect path in the wrong place. The track
shows it: a driver keeps within the lane, so the track transformed by a shift, a turn and a scale must lie along the
path. What a driver's habits, short cuts in bends and the receiver's own error explain is not significant.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy

from app.lanes.local_plane import plane_from_wgs84
from app.lanes.smooth_line import lengths_along
from app.lanes.types import Floats, Lane, TrackAgreement
from app.sensors.pose_track import PoseTrack

_SPACING_M = 3.0  # [m] between fixes that are compared; source: `driven_line._POINT_SPACING_M`
_MAX_STEPS = 5000  # of the track, longer steps on tracks above 15 km; source: by hand, bounds the time
_MIN_FIXES, _MIN_LENGTH_M = 10, 30.0  # fixes, and the length of track, without which nothing is compared; by hand
_MAX_BESIDE_M = 500.0  # [m] fixes further from the path are of another road; source: by hand, above a datum's shift
_APART_M = (
    20.0  # [m] short tracks with a fix closer than this are beside the path; source: four times a poor receiver's 5 m
)
_OFFSET_SD_M = 0.25  # [m] of a driver's usual offset; source: by hand, the upper bound of `benchmarks.hunt.cerpm`
_WANDER_SD_M, _WANDER_LENGTH_M = 0.25, 30.0  # [m, m] source: as above, and `least_squares.OFFSET_MODELS`
_CUT_M2 = 2.0  # [m2] offset towards the inside of bends, per curvature; source: twice `driving.Driver.cut_m2`
_SHIFT_SD_M, _TURN_SD, _SCALE_SD = 300.0, 0.2, 0.1  # [m, rad, 1] source: by hand, above any mistake that is searched
_UNKNOWN_ACCURACY_M = 3.0  # [m] of a receiver that reports none; source: `lane_fit._UNKNOWN_ACCURACY_M`
_OPTIMISM = 1.5  # true error of a receiver over the accuracy that it reports; source: by hand
_SLOW_SHARE = 0.3  # of a receiver's error that changes along the track like wander; source: by hand
_ROUNDS = 12  # of finding the nearest places on the path; source: by hand, converged to a millimetre
_CONVERGED_M = 1e-3  # [m]
_OUTLIER_SIGMAS = 3.0  # from which on a fix counts less (Huber); source: by hand


class _Compared(NamedTuple):
    """Fixes and the places of the path next to them."""

    fix_m: Floats
    place_m: Floats
    normal: Floats
    curvature_1pm: Floats


def compare_with_track(lane: Lane, track: PoseTrack) -> TrackAgreement | None:
    """Compare a path with the track of the vehicle that drove it.

    Parameters
    ----------
    lane : Lane
        With stations.
    track : PoseTrack

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
    if not len(lane.station_m) or np.isnan(lane.curvature_1pm).any() or (np.abs(track.lat_deg) > 90).any():
        return None
    fixes, spacing_m = _thinned(
        plane_from_wgs84(track.lon_deg, track.lat_deg, (lane.origin_lon_deg, lane.origin_lat_deg))
    )
    stated = track.accuracy_m[np.isfinite(track.accuracy_m)]
    accuracy = _OPTIMISM * max(float(np.median(stated)), 0.0) if len(stated) else _UNKNOWN_ACCURACY_M
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
    return _Compared(fixes_m[keep], lane.position_enu_m[at], normal, lane.curvature_1pm[at])


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
    return TrackAgreement(
        east_m=float(shift[0]),
        north_m=float(shift[1]),
        shift_sigma_m=float(np.hypot(*shift)) / max(shift_z, 1e-9),
        turn_deg=math.degrees(turn),
        turn_sigma_deg=math.degrees(turn_sigma),
        scale_ppm=1e6 * scale,
        scale_sigma_ppm=1e6 * scale_sigma,
        significance=max(alone, _joint_significance(values[:4], covariance[:4, :4] + receiver)),
        effect_m=float(np.sqrt(np.mean(across**2))),
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
