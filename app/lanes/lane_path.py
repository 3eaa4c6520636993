"""Results of a fit as a reference path: stations, boundaries, speed limits, accuracy."""

from __future__ import annotations

import numpy as np
import scipy

from app.lanes.lane_fit import LaneFit
from app.lanes.observations import LaneObservations
from app.lanes.smooth_line import (
    SmoothLine,
    SplineBoundaries,
    headings_deg,
    left_normals,
    lengths_along,
    wgs84_from_plane,
)
from app.lanes.types import (
    UNKNOWN,
    Lane,
    LaneRules,
    LeftOutReason,
    Notes,
)
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
