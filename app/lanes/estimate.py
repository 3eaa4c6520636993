"""Verified markers to the lane's reference path."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Literal

import numpy as np
import scipy

from app.errors import InvalidParameter
from app.geodesy import check_lon_lat
from app.lanes.driven_lane import (
    NOTHING_PASSED,
    PASSING_M,
    CourseBeside,
    LaneCourse,
    Passing,
    choose_driven_lane,
    describe_tie,
)
from app.lanes.initial_line import (
    TRUSTED_TRACK_M,
    DrivenLine,
    driven_line_from_track,
    fit_initial_line,
    is_single_row,
    largest_group,
)
from app.lanes.lane_fit import LaneFit
from app.lanes.lane_path import path_from_fit, path_from_splines, refused_path
from app.lanes.observations import LaneObservations, distinct_places, observations_from_markers
from app.lanes.smooth_line import SmoothLine, boundaries_by_splines, plane_from_wgs84
from app.lanes.track_agreement import compare_with_track, find_departure, has_gaps, runs_apart
from app.lanes.types import (
    LEFT,
    RIGHT,
    UNKNOWN,
    Lane,
    LaneBeside,
    LaneMarkers,
    LaneRules,
    LaneStretch,
    LeftOut,
    LeftOutReason,
    Notes,
    PacketStrengths,
)
from app.sensors.pose_track import PoseTrack
from app.values import Bools, Floats, Ints

__all__ = ["Lane", "LaneMarkers", "LaneRules", "LeftOut", "LeftOutReason", "fit_lane", "preview_m"]

_TRACK_APART = (
    "the vehicle's track does not run beside the path, so that nothing shows that the path is in its place: check the "
    "datum and the survey of the markers, and of the receiver"
)
_TRACK_REVERSED = (
    "the markers were received in the opposite order to that in which the vehicle's track passes them: check the times "
    "and the order of the track's positions"
)
_SIDES_REVERSED = (
    "the sides sent by the markers are those of the other direction of travel: the path follows the order in which the "
    "markers were received"
)
_MIN_HEARD, _MIN_HEARD_M = 6, 60.0  # markers, and the length along which they are [m], whose order shows a direction
_SURE_ORDER = 0.6  # rank correlation of place and time
_BEYOND_TRACK_M = 15.0  # [m] further past its ends a track is not used; sensitivity 1.00, 1.00
_PRECISE_TRACK_M = 0.1  # [m] noise of a track that shows sides by itself; between RTK and other receivers
_NOT_ALONG = (
    "markers of several lanes were received, and the vehicle's track runs along none of them: the vehicle changes "
    "lane, or its receiver is less accurate than it states"
)
_STILL_CHANGING = (
    "the vehicle changes lane until the end of the log, so that nothing shows in which lane it is: send a longer log"
)
_CONTRADICTED = (
    "the positions of {} markers contradict the lines of the road that are registered for them: these are not used "
    "there; check the lines in the registry"
)
_MIN_CONTRADICTED = 2  # a single marker may have been moved
_MIN_FIXES = 10  # of the track in the lane to which the vehicle changed
_MAX_GAP_M = 25.0  # [m] without a marker of the driven lane, beside markers of others; two spacings
_MIN_COVERED_SHARE, _MIN_COVERED_M = 0.25, 100.0  # [1, m] of the drive past markers
"""A path that covers less than both is of a road that crosses."""
_MIN_OWN_SHARE = 0.15  # of the markers that were received; two of the eight lines of a motorway are a quarter
_MAX_ACROSS_M = 1.6  # [m] that an accurate track moves across its lane; half of a lane
_MAX_WITHIN = 2  # markers between the boundaries of a path: of a road that crosses, or spoofed
_WITHIN_MARGIN_M = 0.6  # [m] from a boundary; `LaneDeclaration.off_the_line_m`
_MIN_ROW = 4  # markers in each row of a double line
_ROWS_M = 0.08  # [m] between the rows of a double line, at least; four times the survey's 0.02 m
_ROW_SPREAD = 0.3  # of each row, in their distance; one row with normal errors has 0.38
_MAX_ROWS_SHIFT = 0.25  # between the middles of both rows, in their length; rows one after the other have 0.5
_MAX_BESIDE_TRACK_M = 4.0  # [m] such sides are of markers at most a lane's width away


def fit_lane(
    markers: LaneMarkers,
    track: PoseTrack | None = None,
    *,
    method: Literal["waymark", "paper"] = "waymark",
    rules: LaneRules | None = None,
    strengths: PacketStrengths | None = None,
) -> Lane:
    """Fit the reference path of a lane to its markers.

    Parameters
    ----------
    markers : LaneMarkers
        Shape (K,), in any order, with or without sides.
    track : PoseTrack, optional
        The vehicle's own positions: give the direction of travel and the approximate shape of the lane, not its place.
    method : {'waymark', 'paper'}
        'paper' is section 2.2 of the CERPM paper: a cubic spline a side, and midpoints.
    strengths : PacketStrengths, optional
        Of the markers' packets: of several lanes, they help to show which one the vehicle drives.

    Returns
    -------
    Lane
        With a `refusal` and without stations if the lane cannot be determined.

    Raises
    ------
    InvalidParameter
        The method is unknown.
    """
    if method not in ("waymark", "paper"):
        raise InvalidParameter(f"method is {method}", field="method", limit="waymark or paper")
    rules = rules or LaneRules()
    notes = Notes()
    observations = observations_from_markers(markers, rules, notes)
    taken = distinct_places(observations.point_m)
    if taken.sum() < 2:
        return refused_path(observations, notes, "there are no two markers in different places", method)
    drive = _driven_line(track, observations, notes)
    line, taken = _initial_line(observations, taken, drive, rules, notes)
    if method == "paper":
        return _fit_by_splines(observations, taken, line, notes)
    if line is None:
        reason = "the markers do not lie along a lane, or are one row without a known side"
        return refused_path(observations, notes, reason, "waymark")
    order = _order_heard(line if drive is None else drive.line, observations, taken, strengths)
    if drive is None and order < -_SURE_ORDER:
        line, observations = SmoothLine(line.points_m[::-1]), _with_sides_exchanged(observations, notes)
    alone = notes.copy()
    lane = _fit_by_least_squares(observations, taken, line, drive, rules, alone, is_directed=abs(order) > _SURE_ORDER)
    if lane is not None and lane.refusal is None and drive is not None:
        outer = _of_outer_rows(lane, observations)
        if outer.any():
            lane = _fit_own_markers(observations, taken, taken & ~outer, line, drive, rules, notes)
    if lane is None and drive is not None and track is not None and has_gaps(track.time_s):
        lane = _fit_past_gaps(observations, taken, drive, rules, notes)
    if lane is None and drive is not None and track is not None:
        lane = _fit_driven_lane(observations, taken, drive, strengths, track, rules, notes)
    if lane is None:
        reason = f"the markers share no line: {len(alone.left_out) - len(notes.left_out)} of them lie off it"
        return refused_path(observations, alone, reason, "waymark")
    if track is None:
        return lane
    lane = _compared_with_track(lane, _track_in_lane(lane, track), drive, observations)
    if drive is not None and lane.refusal is None and order < -_SURE_ORDER:
        warnings = (*lane.localization_warnings, _TRACK_REVERSED)
        return replace(lane, track_apart=True, localization_warnings=warnings)
    return lane


def preview_m(lane: Lane, lon_deg: float, lat_deg: float) -> float:
    """Length of the path ahead of a place beside it; 0 past its end or without a path. [m]"""
    check_lon_lat(lon_deg, lat_deg)
    if not len(lane.station_m):
        return 0.0
    origin = (lane.origin_lon_deg, lane.origin_lat_deg)
    here = plane_from_wgs84(np.array([lon_deg]), np.array([lat_deg]), origin)
    nearest = int(np.argmin(np.hypot(*(lane.position_enu_m - here).T)))
    return float(lane.station_m[-1] - lane.station_m[nearest])


# --- direction of travel ---------------------------------------------------------------------------------------------


def _order_heard(
    line: SmoothLine, observations: LaneObservations, taken: Bools, strengths: PacketStrengths | None
) -> float:
    """Rank correlation of where markers are along a line with when they were heard best; 0 where it is not clear.

    A log has it without a track, too.
    """
    if strengths is None or not len(strengths.time_s):
        return 0.0
    number, place = np.unique(observations.number[taken], return_index=True)
    row = np.searchsorted(number, strengths.number).clip(0, len(number) - 1)
    good = (number[row] == strengths.number) & np.isfinite(strengths.time_s)
    row, time_s, rssi_dbm = row[good], strengths.time_s[good], np.nan_to_num(strengths.rssi_dbm[good], nan=-100.0)
    heard, of_heard = np.unique(row, return_inverse=True)
    if len(heard) < _MIN_HEARD:
        return 0.0
    strongest = np.full(len(heard), -np.inf)
    np.maximum.at(strongest, of_heard, rssi_dbm)
    weight = 10.0 ** ((rssi_dbm - strongest[of_heard]) / 10.0)
    passed_s = np.bincount(of_heard, weight * (time_s - time_s.min())) / np.bincount(of_heard, weight)
    along_m, _ = line.project(observations.point_m[taken][place[heard]])
    if np.ptp(along_m) < _MIN_HEARD_M or np.ptp(passed_s) <= 0:
        return 0.0
    return float(np.corrcoef(np.argsort(np.argsort(along_m)), np.argsort(np.argsort(passed_s)))[0, 1])


def _with_sides_exchanged(observations: LaneObservations, notes: Notes) -> LaneObservations:
    """Markers of a lane that is driven against its sides."""
    side = observations.side
    if (side != UNKNOWN).any():
        notes.warn(_SIDES_REVERSED)
    return replace(observations, side=np.where(side == LEFT, RIGHT, np.where(side == RIGHT, LEFT, UNKNOWN)))


# --- initial line -------------------------------------------------------------------------------------------------


def _driven_line(track: PoseTrack | None, observations: LaneObservations, notes: Notes) -> DrivenLine | None:
    """The track near the markers; a warning if it cannot be used."""
    if track is None:
        return None
    drive = driven_line_from_track(track, observations.origin, observations.point_m)
    if drive is None:
        notes.warn("the vehicle's track is not beside the markers or does not move: it is not used")
    return drive


def _initial_line(
    observations: LaneObservations, taken: Bools, drive: DrivenLine | None, rules: LaneRules, notes: Notes
) -> tuple[SmoothLine | None, Bools]:
    """A line near the lane's centre in the direction of travel, and the markers that belong to it."""
    half = rules.usual_width_m / 2
    side = observations.side
    if drive is not None:
        station, left = drive.line.project_markers(observations.point_m, side, half)
        beyond = (station < -_BEYOND_TRACK_M) | (station > drive.line.length_m + _BEYOND_TRACK_M)
        if not (beyond & taken).any():
            return drive.line, taken
        if (side[taken] == UNKNOWN).all() and drive.sigma_m < _PRECISE_TRACK_M:
            beside = ~beyond & (np.abs(left) < _MAX_BESIDE_TRACK_M)
            side = np.where(beside, np.where(left > 0, LEFT, RIGHT), UNKNOWN)
    return _line_of_markers(observations, taken, side, drive, rules, notes)


def _line_of_markers(
    observations: LaneObservations,
    taken: Bools,
    side: Ints,
    drive: DrivenLine | None,
    rules: LaneRules,
    notes: Notes,
) -> tuple[SmoothLine | None, Bools]:
    """A line through the markers of the largest group, in the direction of the vehicle's track if there is one."""
    belongs = _connected_markers(observations, taken, rules, notes)
    if belongs.sum() < 2:
        return None, belongs
    line = fit_initial_line(observations.point_m[belongs], side[belongs], rules.usual_width_m / 2)
    if line is not None and drive is not None:
        at, _ = line.project(drive.line.points_m)
        if np.sum(np.diff(at)) < 0:
            line = SmoothLine(line.points_m[::-1])
    return line, belongs


def _connected_markers(observations: LaneObservations, taken: Bools, rules: LaneRules, notes: Notes) -> Bools:
    """The markers of the largest group; the others are left out."""
    belongs = np.zeros(len(taken), bool)
    belongs[np.flatnonzero(taken)[largest_group(observations.point_m[taken], rules.bridge_m)]] = True
    for k in np.flatnonzero(taken & ~belongs):
        row, number = int(observations.row[k]), int(observations.number[k])
        notes.left_out.append(LeftOut(row, number, LeftOutReason.APART, float("nan")))
    return belongs


# --- methods ------------------------------------------------------------------------------------------------------


def _fit_by_least_squares(
    observations: LaneObservations,
    taken: Bools,
    line: SmoothLine,
    drive: DrivenLine | None,
    rules: LaneRules,
    notes: Notes,
    *,
    is_directed: bool = False,
) -> Lane | None:
    """Waymark's method, with reasons to refuse a lane; None where the markers share no line.

    `is_directed`: the direction of travel is known without a track.
    """

    def refused(reason: str) -> Lane:
        return refused_path(observations, notes, reason, "waymark")

    fit = LaneFit(line, observations, taken, drive, rules, notes)
    try:
        found = fit.run()
        if found and (scatter := fit.scatter()) > 1:
            notes.warn(f"the markers lie about {scatter:.1f} times as far from smooth boundaries as was stated")
            observations = replace(observations, sigma_m=scatter * observations.sigma_m)
            fit = LaneFit(fit.line, observations, taken, drive, rules, notes)
            found = fit.run()
    except np.linalg.LinAlgError:  # weights too different for float64
        return refused("the accuracies of markers and track are too different to be combined")
    for k, (reason, off) in fit.left_out.items():
        notes.left_out.append(LeftOut(int(observations.row[k]), int(observations.number[k]), reason, off))
    if not found:
        return None
    if _is_row_of_unknown_side(fit, observations, taken, drive):
        return refused("one row of markers, and nothing shows on which side of the lane it is")
    _warn_of_guessed_sides(fit, observations, notes, is_guessed=drive is None and not is_directed)
    lane = path_from_fit(fit, observations, rules, notes)
    if not len(lane.sigma_m) or float(np.median(lane.sigma_m)) > rules.max_median_sigma_m:
        return refused("the markers are too few or too inaccurate to show where the lane runs")
    return lane


def _fit_past_gaps(
    observations: LaneObservations, taken: Bools, drive: DrivenLine, rules: LaneRules, notes: Notes
) -> Lane | None:
    """The lane by its markers alone, where the track was interrupted, as in a tunnel, and is inaccurate after that."""
    noted = notes.copy()
    line, belongs = _line_of_markers(observations, taken, observations.side, drive, rules, noted)
    if line is None:
        return None
    lane = _fit_by_least_squares(observations, belongs, line, None, rules, noted, is_directed=True)
    return lane if lane is not None and lane.refusal is None else None


def _compared_with_track(
    lane: Lane, track: PoseTrack, drive: DrivenLine | None, observations: LaneObservations
) -> Lane:
    """A lane with its agreement with the track, and with warnings where the path is elsewhere or has another shape."""
    jump_m = drive.jump_m if drive is not None else 0.0
    agreement = compare_with_track(lane, track, jump_m)
    if agreement is None:
        if drive is None or lane.refusal is not None or not runs_apart(lane, track):
            return lane
        warnings = (*lane.localization_warnings, _TRACK_APART)
        return replace(lane, track_apart=True, localization_warnings=warnings)
    off_line = [out.row for out in lane.left_out if out.reason is LeftOutReason.OFF_THE_LINE]
    of_row = observations.of_row[off_line]
    departure = find_departure(lane, track, observations.point_m[of_row[of_row >= 0]], jump_m)
    if departure is not None:
        warning = (
            f"{departure.station_m:.0f} m along it the path turns aside where the vehicle does not, by "
            f"{abs(departure.aside_m):.1f} m to the {'left' if departure.aside_m > 0 else 'right'}: check the datum "
            "and the survey of the markers there"
        )
        warnings = (*lane.localization_warnings, warning)
        return replace(lane, track_agreement=agreement, track_apart=True, localization_warnings=warnings)
    return replace(lane, track_agreement=agreement)


# --- the driven one of several lanes ------------------------------------------------------------------------------


def _passing(
    strengths: PacketStrengths | None,
    track: PoseTrack,
    observations: LaneObservations,
    taken: Bools,
    drive: DrivenLine,
) -> Passing:
    """Packets of markers that the vehicle passed; rows count the taken markers."""
    if strengths is None or not len(track.time_s):
        return NOTHING_PASSED
    number = observations.number[taken]
    order = np.argsort(number)
    row = order[np.searchsorted(number[order], strengths.number).clip(0, len(order) - 1)]
    inside = (strengths.time_s >= track.time_s[0]) & (strengths.time_s <= track.time_s[-1])
    good = inside & (number[row] == strengths.number) & np.isfinite(strengths.rssi_dbm)
    row, time_s, rssi_dbm = row[good], strengths.time_s[good], strengths.rssi_dbm[good]
    fixes = plane_from_wgs84(track.lon_deg, track.lat_deg, observations.origin)
    here = np.stack([np.interp(time_s, track.time_s, fixes[:, axis]) for axis in range(2)], 1)
    point = observations.point_m[taken][row]
    near = np.hypot(*(here - point).T) < 2 * PASSING_M
    if not near.any():
        return NOTHING_PASSED
    vehicle, _ = drive.line.project(here[near])
    marker, _ = drive.line.refine_stations(point[near], vehicle.copy())
    return Passing(row[near], marker - vehicle, rssi_dbm[near])


def _fit_driven_lane(
    observations: LaneObservations,
    taken: Bools,
    drive: DrivenLine,
    strengths: PacketStrengths | None,
    track: PoseTrack,
    rules: LaneRules,
    notes: Notes,
) -> Lane | None:
    """Fit the driven one of several lanes, or refuse it; None where the markers are of no more than one lane."""
    half = rules.usual_width_m / 2
    along, left = drive.line.project_markers(observations.point_m, observations.side, half)
    beyond = taken & ((along < -_BEYOND_TRACK_M) | (along > drive.line.length_m + _BEYOND_TRACK_M))
    notes, taken = notes.copy(), taken & ~beyond
    for k in np.flatnonzero(beyond):
        row, number = int(observations.row[k]), int(observations.number[k])
        notes.left_out.append(LeftOut(row, number, LeftOutReason.APART, float("nan")))
    if not taken.any():
        return None
    heard = _passing(strengths, track, observations, taken, drive)
    chosen = choose_driven_lane(
        along[taken], left[taken], observations.side[taken], drive, heard, observations.line[taken]
    )
    if chosen is None or (chosen.side != UNKNOWN).all():
        return None
    if chosen.contradicted >= _MIN_CONTRADICTED:
        notes.warn(_CONTRADICTED.format(chosen.contradicted))
    if chosen.others:
        return refused_path(observations, notes, describe_tie(chosen, drive), "waymark")
    course = chosen.course
    if drive.accuracy_m < TRUSTED_TRACK_M and _across_m(course) > _MAX_ACROSS_M:
        return refused_path(observations, notes, _NOT_ALONG, "waymark")
    line, stays = drive.line, drive
    if course.lane.any():
        line = _line_beside(drive, chosen.last_lane)
        first_m, last_m = course.last_stay_m
        station = drive.line.project(drive.fix_m)[0]
        stays = replace(drive, line=line, fix_m=drive.fix_m[(station >= first_m) & (station <= last_m)])
        if len(stays.fix_m) < _MIN_FIXES:
            return refused_path(observations, notes, _STILL_CHANGING, "waymark")
    side = np.zeros(len(taken), np.int64)
    side[taken] = chosen.side
    sided = replace(observations, side=side)
    lane = _fit_own_markers(sided, taken, side != UNKNOWN, line, stays, rules, notes)
    if lane is None or lane.refusal is not None:
        return lane
    inner = (side != UNKNOWN) & ~_of_outer_rows(lane, sided)
    if inner.sum() < (side != UNKNOWN).sum():
        lane = _fit_own_markers(sided, taken, inner, line, stays, rules, notes)
        if lane is None or lane.refusal is not None:
            return lane
    if _markers_within(lane, observations.point_m[taken], half) > _MAX_WITHIN:
        return refused_path(observations, notes, _NOT_ALONG, "waymark")
    if not drive.accuracy_m < TRUSTED_TRACK_M and _widest_gap_m(lane, observations) > _MAX_GAP_M:
        return refused_path(observations, notes, _NOT_ALONG, "waymark")
    crosses = float(np.ptp(lane.station_m)) < min(_MIN_COVERED_SHARE * float(np.ptp(along[taken])), _MIN_COVERED_M)
    if crosses or (lane.side != UNKNOWN).sum() < _MIN_OWN_SHARE * taken.sum():
        return refused_path(observations, notes, _NOT_ALONG, "waymark")
    stretches = _stretches(lane, course, drive) if course.lane.any() else ()
    beside = tuple(
        found
        for other in chosen.beside
        if (found := _fit_lane_beside(observations, taken, other, drive, rules)) is not None
    )
    return replace(lane, stretches=stretches, beside=beside)


def _across_m(course: LaneCourse) -> float:
    """How far a lane's centre moves beside the track, but for changes of lane. [m]"""
    return float(np.ptp(course.centre_m[~course.changing])) if not course.changing.all() else 0.0


def _line_beside(drive: DrivenLine, course: LaneCourse) -> SmoothLine:
    """The line of a course beside the track, where its markers are."""
    station = np.linspace(course.station_m[0], course.station_m[-1], 4 * len(course.station_m))
    return SmoothLine(drive.line.offset_points(station, np.interp(station, course.station_m, course.centre_m)))


def _fit_lane_beside(
    observations: LaneObservations, taken: Bools, other: CourseBeside, drive: DrivenLine, rules: LaneRules
) -> LaneBeside | None:
    """The path of another lane; None where its markers do not show one."""
    side = np.zeros(len(taken), np.int64)
    side[taken] = other.side
    line = _line_beside(drive, other.course)
    if other.oncoming:
        line = SmoothLine(line.points_m[::-1])
        side = np.where(side == LEFT, RIGHT, np.where(side == RIGHT, LEFT, UNKNOWN))
    lane = _fit_by_least_squares(replace(observations, side=side), side != UNKNOWN, line, None, rules, Notes())
    if lane is None or lane.refusal is not None:
        return None
    direction: dict[bool | None, Literal["same", "oncoming", "unknown"]] = {True: "oncoming", False: "same"}
    return LaneBeside(other.position, direction.get(other.oncoming, "unknown"), lane)


def _widest_gap_m(lane: Lane, observations: LaneObservations) -> float:
    """The longest stretch of a path without a marker of its own, where only the vehicle's track shows it. [m]"""
    known = observations.of_row >= 0
    used = observations.point_m[observations.of_row[known & (lane.side != UNKNOWN)]]
    at = lane.station_m[np.asarray(scipy.spatial.cKDTree(lane.position_enu_m).query(used)[1])]
    return float(np.diff(np.sort(at)).max(initial=0.0))


def _stretches(lane: Lane, course: LaneCourse, drive: DrivenLine) -> tuple[LaneStretch, ...]:
    """In which lane the vehicle was along the path."""
    at, _ = drive.line.project(lane.position_enu_m)
    which = np.rint(np.interp(at, course.station_m, np.arange(len(course.station_m)))).astype(int)
    state = np.stack([course.lane[which], course.changing[which]], 1)
    edges = [0, *(np.flatnonzero((np.diff(state, axis=0) != 0).any(1)) + 1).tolist(), len(which) - 1]
    return tuple(
        LaneStretch(float(lane.station_m[a]), float(lane.station_m[b]), int(state[a, 0]), bool(state[a, 1]))
        for a, b in itertools.pairwise(edges)
    )


def _track_in_lane(lane: Lane, track: PoseTrack) -> PoseTrack:
    """The part of a track on which the vehicle was in the path's lane."""
    if not lane.stretches:
        return track
    kept = [part for part in lane.stretches if part.lane == 0 and not part.changing]
    if not kept:
        return track
    fixes = plane_from_wgs84(track.lon_deg, track.lat_deg, (lane.origin_lon_deg, lane.origin_lat_deg))
    at = lane.station_m[np.asarray(scipy.spatial.cKDTree(lane.position_enu_m).query(fixes)[1])]
    inside = np.flatnonzero((at >= kept[-1].from_m) & (at <= kept[-1].to_m))
    first, last = (int(inside[0]), int(inside[-1]) + 1) if len(inside) else (0, len(at))
    columns = (track.time_s, track.lon_deg, track.lat_deg, track.heading_deg, track.accuracy_m)
    return PoseTrack(*(column[first:last] for column in columns))


def _markers_within(lane: Lane, point_m: Floats, half_width_m: float) -> int:
    """How many markers stand between the boundaries of a path, where there should be none."""
    away, at = (np.asarray(found) for found in scipy.spatial.cKDTree(lane.position_enu_m).query(point_m))
    half = lane.width_m[at] / 2
    return int(np.sum(away < np.where(np.isfinite(half), half, half_width_m) - _WITHIN_MARGIN_M))


def _fit_own_markers(
    observations: LaneObservations,
    taken: Bools,
    own: Bools,
    line: SmoothLine,
    drive: DrivenLine,
    rules: LaneRules,
    notes: Notes,
) -> Lane | None:
    """Fit the driven lane to its own markers; the others are left out as another lane's."""
    noted = notes.copy()
    for k in np.flatnonzero(taken & ~own):
        row, number = int(observations.row[k]), int(observations.number[k])
        noted.left_out.append(LeftOut(row, number, LeftOutReason.OTHER_LANE, float("nan")))
    return _fit_by_least_squares(observations, own, line, drive, rules, noted)


def _of_outer_rows(lane: Lane, observations: LaneObservations) -> Bools:
    """Markers of the outer row of a double line, which is the boundary of the lane beside."""
    known = observations.of_row >= 0
    of_row = observations.of_row[known]
    residual, side = np.full(len(observations.side), np.nan), np.zeros(len(observations.side), np.int64)
    residual[of_row], side[of_row] = lane.residual_m[known], lane.side[known]
    outer = np.zeros(len(residual), bool)
    for which, outwards in ((LEFT, 1.0), (RIGHT, -1.0)):
        rows = np.flatnonzero((side == which) & np.isfinite(residual))
        if len(rows) < 2 * _MIN_ROW:
            continue
        off = outwards * residual[rows]
        first, apart_m, spread_m = _split_in_two(np.sort(off))
        if apart_m > _ROWS_M and spread_m < _ROW_SPREAD * apart_m and _side_by_side(off >= first, rows, observations):
            outer[rows[off >= first]] = True
    return outer


def _side_by_side(outer: Bools, rows: Ints, observations: LaneObservations) -> bool:
    """Whether two rows of markers are beside each other rather than one after the other."""
    point = observations.point_m[rows]
    middle = point[outer].mean(0) - point[~outer].mean(0)
    return bool(math.hypot(*middle) < _MAX_ROWS_SHIFT * math.hypot(*np.ptp(point, axis=0)))


def _split_in_two(ranked_m: Floats) -> tuple[float, float, float]:
    """The two groups of ranked values that spread least: first value of the upper one, distance, and spread. [m]"""
    values = ranked_m - ranked_m.mean()
    low = np.arange(_MIN_ROW, len(values) - _MIN_ROW + 1)  # values of the lower group
    high = len(values) - low
    total, squares = np.cumsum(values), np.cumsum(values**2)
    low_mean, high_mean = total[low - 1] / low, (total[-1] - total[low - 1]) / high
    spread = np.sqrt(np.maximum(squares[-1] - low * low_mean**2 - high * high_mean**2, 0.0) / len(values))
    k = int(np.argmin(spread))
    return float(ranked_m[low[k]]), float(high_mean[k] - low_mean[k]), float(spread[k])


def _fit_by_splines(observations: LaneObservations, taken: Bools, line: SmoothLine | None, notes: Notes) -> Lane:
    """Section 2.2 of the CERPM paper, which gives no accuracy."""
    bounds = boundaries_by_splines(observations.point_m, observations.side, taken, line) if line is not None else None
    if bounds is None:
        return refused_path(observations, notes, "a side of the lane has no two markers", "paper")
    return path_from_splines(bounds, observations, taken, notes)


def _is_row_of_unknown_side(
    fit: LaneFit, observations: LaneObservations, taken: Bools, drive: DrivenLine | None
) -> bool:
    """Whether the markers are one row, and neither a message nor an accurate track shows its side."""
    accurate = drive is not None and drive.accuracy_m < TRUSTED_TRACK_M
    if accurate or bool((observations.side[fit.used] != UNKNOWN).any()):
        return False
    return len(_sides_found(fit)) == 1 or is_single_row(observations.point_m[taken], fit.station_m[taken])


def _warn_of_guessed_sides(fit: LaneFit, observations: LaneObservations, notes: Notes, *, is_guessed: bool) -> None:
    if len(_sides_found(fit)) == 1:
        notes.warn("only one side of the lane was received: the path is half the usual width beside it")
    if is_guessed and not (observations.side[fit.used] != UNKNOWN).any():
        notes.warn(
            "neither a track nor a marker shows a side: sides are guessed, and the direction of travel may be the "
            "opposite one"
        )


def _sides_found(fit: LaneFit) -> Ints:
    return np.unique(fit.side[fit.used])
