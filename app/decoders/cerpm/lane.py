"""Verified markers -> the lane's reference path."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import erf

from app.decoders.cerpm.lane_fit import Fit
from app.decoders.cerpm.lane_frame import heading_of, plane_from_wgs84, wgs84_from_plane
from app.decoders.cerpm.lane_input import Stock, moving, stock_from_markers
from app.decoders.cerpm.lane_line import Line, lengths_along
from app.decoders.cerpm.lane_order import connected, line_through
from app.decoders.cerpm.lane_track import Drive, drive_from_track
from app.decoders.cerpm.lane_types import (
    LEFT,
    RIGHT,
    UNKNOWN,
    Bools,
    Floats,
    Ints,
    Lane,
    LaneMarkers,
    LaneRules,
    LeftOut,
    LeftOutReason,
    Notes,
)  # fmt: skip
from app.decoders.cerpm.paper import boundaries_by_splines
from app.errors import InvalidParameter
from app.geodesy import check_lon_lat
from app.sensors.pose_track import PoseTrack

__all__ = ["Lane", "LaneMarkers", "LaneRules", "LeftOut", "LeftOutReason", "fit_lane", "preview_m"]

_KNOWN_WIDTH_M, _KNOWN_SIDE_M = 0.3, 0.4
_BEYOND_M = 15.0
_SURE_TRACK_M = 0.5
_SAME_PLACE_M = 3.0
_OTHER_ROW, _OTHER_ROW_SHARE = 3, 0.08
"""So many markers off the line, and such a share of all, may be a row that the path should have followed."""
_OTHER_ROW_SIGMA_M = 0.6
_LEAST_CHANGES = 0.35


def fit_lane(
    markers: LaneMarkers,
    track: PoseTrack | None = None,
    *,
    method: Literal["waymark", "paper"] = "waymark",
    rules: LaneRules | None = None,
) -> Lane:
    """Fit the reference path of a lane through its markers.

    Parameters
    ----------
    markers : LaneMarkers
        Shape (K,), in any order, with or without sides.
    track : PoseTrack, optional
        Where the vehicle was: gives the direction of travel and a hint of the lane's shape, never its place.
    method : {'waymark', 'paper'}
        'paper' is section 2.2 of the CERPM paper: a cubic spline a side, and midpoints.
    rules : LaneRules, optional

    Returns
    -------
    Lane
        Without stations, and with a `refusal`, where the lane cannot be told.

    Raises
    ------
    InvalidParameter
        The method is none of the two.
    """
    if method not in ("waymark", "paper"):
        raise InvalidParameter(f"method is {method}", field="method", limit="waymark or paper")
    rules = rules or LaneRules()
    notes = Notes()
    stock = stock_from_markers(markers, rules, notes)
    taken = moving(stock.point_m)
    if taken.sum() < 2:
        return _refused(stock, notes, "there are no two markers in different places", method)
    drive = _drive(track, stock, notes)
    if method == "paper":
        return _paper(stock, taken, drive, rules, notes)
    return _fit(stock, taken, drive, rules, notes)


def preview_m(lane: Lane, lon_deg: float, lat_deg: float) -> float:
    """How far the path reaches ahead of a place beside it; 0 past its end or without a path. [m]"""
    check_lon_lat(lon_deg, lat_deg)
    if not len(lane.station_m):
        return 0.0
    origin = (lane.origin_lon_deg, lane.origin_lat_deg)
    here = plane_from_wgs84(np.array([lon_deg]), np.array([lat_deg]), origin)
    nearest = int(np.argmin(np.hypot(*(lane.position_enu_m - here).T)))
    return float(lane.station_m[-1] - lane.station_m[nearest])


def _drive(track: PoseTrack | None, stock: Stock, notes: Notes) -> Drive | None:
    if track is None:
        return None
    drive = drive_from_track(track, stock.origin, stock.point_m)
    if drive is None:
        notes.doubt("the vehicle's track is not beside the markers or does not move: it is not used")
    return drive


def _fit(stock: Stock, taken: Bools, drive: Drive | None, rules: LaneRules, notes: Notes) -> Lane:
    line, taken = _first_line(stock, taken, drive, rules, notes)
    if line is None:
        return _refused(
            stock, notes, "the markers do not lie along a lane, or are one row that tells no side", "waymark"
        )
    fit = Fit(line, stock, taken, drive, rules, notes)
    try:
        whole = fit.run()
    except np.linalg.LinAlgError:  # accuracies too unlike for the digits of a float
        return _refused(stock, notes, "the accuracies of markers and track are too unlike to be weighed", "waymark")
    for k, (reason, off) in fit.left_out.items():
        notes.left_out.append(LeftOut(int(stock.row[k]), int(stock.number[k]), reason, off))
    if not whole:
        return _refused(stock, notes, f"the markers share no line: {len(fit.left_out)} of them lie off it", "waymark")
    found = set(np.unique(fit.side[fit.used]).tolist())
    sure = drive is not None and drive.accuracy_m < _SURE_TRACK_M
    told = sure or bool((stock.side[fit.used] != UNKNOWN).any())
    if not told and (len(found) == 1 or _is_one_row(fit)):
        return _refused(stock, notes, "one row of markers, and nothing tells on which side of the lane", "waymark")
    if len(found) == 1:
        notes.doubt("only one side of the lane was heard: the path lies half the usual width off it")
    if drive is None and not (stock.side[fit.used] != UNKNOWN).any():
        notes.doubt(
            "neither a track nor a marker tells a side: sides are guessed, and the direction of travel may be the other"
        )
    lane = _lane(fit, stock, rules, notes)
    if not len(lane.sigma_m) or float(np.median(lane.sigma_m)) > rules.hopeless_sigma_m:
        return _refused(stock, notes, "the markers are too few or too coarse to tell where the lane runs", "waymark")
    return lane


def _is_one_row(fit: Fit) -> bool:
    """Whether sides hardly ever change from marker to marker: a row that a coarse track has cut into two sides."""
    side = fit.side[fit.used][np.argsort(fit.station_m[fit.used], kind="stable")]
    return float(np.mean(side[1:] != side[:-1])) < _LEAST_CHANGES


def _first_line(
    stock: Stock, taken: Bools, drive: Drive | None, rules: LaneRules, notes: Notes
) -> tuple[Line | None, Bools]:
    """A line nearly along the lane in the direction of travel, and the markers that belong to it."""
    half = rules.usual_width_m / 2
    side = stock.side
    if drive is not None:
        station, left = drive.line.find(stock.point_m, side, half)
        beyond = (station < -_BEYOND_M) | (station > drive.line.length_m + _BEYOND_M)
        if not (beyond & taken).any():
            return drive.line, taken
        if (side[taken] == UNKNOWN).all() and drive.sigma_m < 0.1:
            beside = ~beyond & (np.abs(left) < 4)
            side = np.where(beside, np.where(left > 0, LEFT, RIGHT), UNKNOWN)
    belongs = np.zeros(len(taken), bool)
    belongs[np.flatnonzero(taken)[connected(stock.point_m[taken], rules.bridge_m)]] = True
    for k in np.flatnonzero(taken & ~belongs):
        notes.left_out.append(LeftOut(int(stock.row[k]), int(stock.number[k]), LeftOutReason.APART, float("nan")))
    if belongs.sum() < 2:
        return None, belongs
    line = line_through(stock.point_m[belongs], side[belongs], half)
    if line is not None and drive is not None:
        at, _ = line.nearest(drive.line.points_m)
        if np.sum(np.diff(at)) < 0:
            line = Line(line.points_m[::-1])
    return line, belongs


def _paper(stock: Stock, taken: Bools, drive: Drive | None, rules: LaneRules, notes: Notes) -> Lane:
    """Section 2.2 of the paper, which says nothing of how sure it is."""
    line, taken = _first_line(stock, taken, drive, rules, notes)
    bounds = boundaries_by_splines(stock.point_m, stock.side, taken, line) if line is not None else None
    if bounds is None:
        return _refused(stock, notes, "a side of the lane has no two markers", "paper")
    left, right, side = bounds
    middle = (left + right) / 2
    moved = np.concatenate([[True], np.hypot(*np.diff(middle, axis=0).T) > 1e-6])
    left, right, middle = left[moved], right[moved], middle[moved]
    if len(middle) < 3:
        return _refused(stock, notes, "the markers have no length", "paper")
    at = lengths_along(middle)
    lon, lat = wgs84_from_plane(middle, stock.origin)
    nothing = np.full(len(at), np.nan)
    slope = np.gradient(middle, at, axis=0)
    bend = np.gradient(slope, at, axis=0)
    curvature = (slope[:, 0] * bend[:, 1] - slope[:, 1] * bend[:, 0]) / np.maximum(np.hypot(*slope.T), 1e-9) ** 3
    place = at[cKDTree(middle).query(stock.point_m)[1]]
    limit = _speed_limits(at, place[taken], stock.speed_limit_km_h[taken], notes)
    known = stock.of_row >= 0
    row_side = np.where(known, side[stock.of_row], UNKNOWN)
    return Lane(
        *stock.origin, at, middle, left, right, lon, lat, heading_of(lon, lat), curvature, np.hypot(*(left - right).T),
        limit, nothing, nothing, row_side, np.full(len(known), np.nan), tuple(notes.left_out), tuple(notes.doubts),
        None, "paper",
    )  # fmt: skip


def _lane(fit: Fit, stock: Stock, rules: LaneRules, notes: Notes) -> Lane:
    """The fit at stations of its path."""
    problem, solution = fit.problem, fit.solution
    knots_m = fit.line.offset(problem.station_m, solution.centre_m)
    path = Line(knots_m)
    along = lengths_along(knots_m)
    along *= path.length_m / along[-1]
    at = path.station_m
    probes, *deviations = solution.sigmas()
    probes = np.interp(probes, problem.station_m, along)
    sigma, sigma_left, sigma_right, sigma_width = (np.interp(at, probes, values) for values in deviations)
    width = np.interp(at, along, solution.width_m)
    markers_at = np.interp(fit.station_m, problem.station_m, along)
    inner = markers_at[fit.used]
    keep = _kept(at, sigma, inner.min(), inner.max(), rules.worst_sigma_m)
    if len(fit.left_out) >= _OTHER_ROW and fit.strays > _OTHER_ROW_SHARE:
        out, all_told = len(fit.left_out), len(fit.left_out) + int(fit.used.sum())
        notes.doubt(
            f"{out} of {all_told} markers lie off the line: another lane's row, or a lane that merges or splits"
        )
        sigma = np.hypot(sigma, _OTHER_ROW_SIGMA_M)
    normal = np.stack([-path.tangent[:, 1], path.tangent[:, 0]], 1)
    bounds = [
        np.where((known < _KNOWN_SIDE_M)[:, None], path.points_m + s * normal * width[:, None] / 2, np.nan)
        for s, known in ((1, sigma_left), (-1, sigma_right))
    ]
    lon, lat = wgs84_from_plane(path.points_m, stock.origin)
    limit = _speed_limits(at, markers_at[fit.used], stock.speed_limit_km_h[fit.used], notes)
    row_side, row_residual = _by_row(fit, stock)
    if len(at[keep]) and float(np.max(sigma[keep])) > rules.worst_sigma_m:
        notes.doubt(f"the path is unsure in places: up to {float(np.max(sigma[keep])):.2f} m")
    known_width = np.where(sigma_width < _KNOWN_WIDTH_M, width, np.nan)
    return Lane(
        *stock.origin, at[keep] - at[keep][0], path.points_m[keep], bounds[0][keep], bounds[1][keep],
        lon[keep], lat[keep], heading_of(lon, lat)[keep], path.curvature_1pm[keep], known_width[keep], limit[keep],
        sigma[keep], erf(rules.tolerance_m / (np.sqrt(2) * np.maximum(sigma[keep], 1e-6))), row_side, row_residual,
        tuple(notes.left_out), tuple(notes.doubts),
    )  # fmt: skip


def _kept(at: Floats, sigma: Floats, first: float, last: float, worst: float) -> slice:
    """Stations from the first to the last marker, and past them as far as the path is sure."""
    bad = sigma > worst
    low = np.flatnonzero(bad & (at < first))
    high = np.flatnonzero(bad & (at > last))
    return slice(int(low[-1]) + 1 if len(low) else 0, int(high[0]) if len(high) else len(at))


def _speed_limits(at: Floats, station: Floats, limit: Floats, notes: Notes) -> Floats:
    """Limit of the marker passed last; the lower one where two abreast differ."""
    posted = np.isfinite(limit) & (limit > 0)
    if not posted.any():
        return np.full(len(at), np.nan)
    order = np.argsort(station[posted], kind="stable")
    place, value = station[posted][order], limit[posted][order]
    abreast = np.diff(place) < _SAME_PLACE_M
    if (abreast & (np.diff(value) != 0)).any():
        notes.doubt("markers abreast name different speed limits: the lower one holds")
        lower = np.minimum(value[1:], value[:-1])
        value[1:] = np.where(abreast, lower, value[1:])
        value[:-1] = np.where(abreast, lower, value[:-1])
    return value[np.maximum(np.searchsorted(place, at, side="right") - 1, 0)]


def _by_row(fit: Fit, stock: Stock) -> tuple[Ints, Floats]:
    known = stock.of_row >= 0
    side, residual = np.zeros(len(known), np.int64), np.full(len(known), np.nan)
    side[known] = np.where(fit.used, fit.side, UNKNOWN)[stock.of_row[known]]
    residual[known] = np.where(fit.used, fit.residual_m, np.nan)[stock.of_row[known]]
    return side, residual


def _refused(stock: Stock, notes: Notes, why: str, method: str) -> Lane:
    none, points = np.empty(0), np.empty((0, 2))
    rows = len(stock.of_row)
    return Lane(
        *stock.origin, none, points, points, points, none, none, none, none, none, none, none, none,
        np.zeros(rows, np.int64), np.full(rows, np.nan), tuple(notes.left_out), tuple(notes.doubts), why, method,
    )  # fmt: skip
