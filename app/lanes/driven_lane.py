"""The driven lane among several marked lanes, and the lanes beside it.

A vehicle hears the markers of all lanes within radio range. Along its track the centre and the width of a lane are
followed by dynamic programming. At a station a lane costs little where there are markers on both of its boundaries,
none within, and its centre is as near to the track as the receiver's error and the driver's habits explain. A vehicle
that changes lane crosses a boundary: its lane is then the next one. How many markers a line has is no evidence, and the
sides that markers send decide only which lanes are oncoming ones: a line that two lanes share is left of one and right
of the other. How strongly markers were received while the vehicle passed them shows which of them are near.

Where the registry knows on which line of the road markers stand, that line runs between them, also where others were
not received. Registered lines are evidence beside the markers themselves: where they contradict the markers' places,
they are not used.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from app.compiled import ieee_kernel
from app.lanes.initial_line import TRUSTED_TRACK_M, DrivenLine
from app.lanes.types import LEFT, NO_LINE, RIGHT, UNKNOWN
from app.sensors.pose_track import UNKNOWN_ACCURACY_M
from app.values import Bools, Floats, Ints

_STEP_M = 12.5  # [m] between stations; about the paper's spacing of 12.2 m
_GRID_M, _HALF_GRID_M = 0.2, 8.0  # [m] step and largest offset of a centre from the track
_WIDTHS_M: Floats = np.arange(2.6, 5.5, 0.2)  # [m] 8.5 ft to the 18 ft of a ramp
_USUAL_WIDTHS_M = (2.7, 4.3)  # [m] others cost something
_LINE_SIGMA_M, _SPREAD = 0.25, 0.015  # [m, m/m] of a marker about a boundary, and how it grows with distance along it
_LINE_REACH_M = 40.0  # [m] along the track within which a marker shows a line; three spacings
_NO_LINE_COST = 4.0  # squared sigmas, where no marker is on a boundary
_WITHIN_COST, _WITHIN_MARGIN_M, _WITHIN_REACH_M = 6.0, 0.7, 10.0  # [1, m, m] of a marker between the boundaries
_MAX_WITHIN = 2  # such markers that count at a station: one or two may be spoofed
_DRIVER_M = 0.4  # [m] of a vehicle from its lane's centre: wander, habit, and bends that are cut
_MAX_PRIOR = 25.0  # squared sigmas
_PRECISE_LENGTH_M, _SLOW_TIME_S = 30.0, 30.0  # [m, s] after which an offset is another one: a driver's, a receiver's
_MOVE_M, _SLOW_MOVE_M = 0.25, 0.4  # [m] of the centre, beside the track, from station to station
_ALONG_LINE_M = 0.18  # [m] of the centre, beside the direction of the lines, from station to station
_MAX_MOVE = 5  # grid steps from station to station
_WIDTH_COST = 2.0  # of a width that changes by a step of 0.2 m
_CHANGE_COST, _CHANGING_COST = 8.0, 2.0  # squared sigmas for a change of lane, and for each station while it lasts
_CROSSING_M = 0.8  # [m] of a vehicle from the line that it crosses, at the nearest station
_MAX_CHANGE_MOVE_COST = 12.0  # squared sigmas, of lines that leave their direction while the vehicle changes lane
_SLOPE_REACH_M, _PAIR_M, _WIDE_PAIR_M = 20.0, (5.0, 20.0), (5.0, 32.0)  # [m] from a station, and between two markers
_MAX_UNKNOWN, _MAX_GAP = 0.5, 6  # share of unknown directions, and stations, through which a direction is interpolated
_MAX_SLOPE, _SLOPE_STEP, _SLOPE_ACROSS_M = 0.24, 0.01, 2.5  # [m/m, m/m, m] of directions that are compared
_PAIR_ACROSS_M = 2.4  # [m] between such markers; those of neighbouring lines are farther apart
_MIN_PAIRS, _MIN_STEEP_PAIRS, _STEEP = 0.8, 1.5, 0.04  # that agree; of lines that the vehicle crosses [m/m], more
_ANOTHER_M = 1.3  # [m] centres further apart are of two lanes; half of the narrowest
_TIE = 14.0  # squared sigmas; odds of 1 to 1,100
_ENDS, _LONG = 2, 8  # stations at each end of longer courses, where few markers are around the vehicle
_BOTH_LANES, _BOTH_SHARE = 3, 0.5  # stations before and after a line is crossed, and their share with both lanes
_MAX_CHANGE_TURN = 0.5  # [rad] of the track while it changes lane; beyond, an inaccurate receiver shows none
_CROSSED_M = 60.0  # [m] between the end of a lane on one side and the start of one on the other
_TRACE_M = 1.1  # [m] of a lane's centre from where it was expected
_NEARER_COST = 0.05  # [1/m] squared sigmas at each station, so that the next lane comes before the one after it
_MIN_STRETCH, _MAX_BESIDE = 5, 2  # stations of a lane that is named, and such lanes on each side
_COARSE_CHANGE_TIE = 35.0  # squared sigmas; an inaccurate receiver's slow errors look like changes of lane
# with registered lines, courses differ less by chance: `benchmarks.cerpm lanes`, chosen with seed 201
_REGISTERED_TIE, _REGISTERED_COARSE_CHANGE_TIE = 10.0, 20.0  # squared sigmas
_REGISTERED_SHARE = 0.9  # of the markers beside the track whose registered line can be used
_MAX_CONTRADICTED = 0.2  # of the markers with registered lines; beyond, none of these is used
_REGISTERED_GAP_M = 60.0  # [m] between markers of a line that runs between them; five spacings
_LINES_APART_M = 1.0  # [m] between two registered lines, or of a marker from its own; less than half of a lane
_MAX_RIVALS = 4  # lanes that are compared with the driven one
_ONCOMING_COST = 30.0  # squared sigmas for a lane whose both boundaries send the other side
_ONCOMING_SHARE = 0.7  # of the markers on each boundary that send the other side
_FORBIDDEN = 1e6  # cost of a state that a course may not have; above every course
_ON_BOUNDARY_M = 0.9  # [m] of a marker from a boundary of its lane
PASSING_M = 25.0  # [m] from the vehicle along and across; farther markers do not show in which lane it is
_MIN_PASSING = 10  # packets of markers that are passed
_ANTENNA_M = 1.5  # [m] of the vehicle's antenna above the markers
_EXPONENT, _EXPONENT_SD, _LEVEL_SD_DB = 2.0, 0.5, 1000.0  # of free space, with what roads and antennas change
_SIDES_SD_DB = 1.5  # [dB] of half the difference between the sides of the vehicle
_STRENGTH_SD_DB = 5.0  # [dB] of one marker: shadows and fading
_MAX_STRENGTH_COST = 60.0  # squared sigmas
_KEEPING, _LEFT_BEFORE, _LEFT_AFTER, _RIGHT_BEFORE, _RIGHT_AFTER = range(5)  # before and after the line is crossed
_REVERSED = np.array([_KEEPING, _RIGHT_AFTER, _RIGHT_BEFORE, _LEFT_AFTER, _LEFT_BEFORE])  # in a drive run backwards


class LaneCourse(NamedTuple):
    """The lane of the vehicle beside the track; from where it changes lane, the next one."""

    station_m: Floats  # shape (B,)
    centre_m: Floats  # shape (B,): [m] left of the track
    width_m: Floats  # shape (B,)
    lane: Ints  # shape (B,): lanes left of the last one in which the vehicle is known to be
    doing: Ints  # shape (B,): whether the vehicle keeps its lane, or changes it

    @property
    def changing(self) -> Bools:
        """Where the vehicle changes lane, shape (B,)."""
        return np.asarray(self.doing != _KEEPING)

    @property
    def last_stay_m(self) -> tuple[float, float]:
        """From where to where the vehicle keeps the last lane. [m]"""
        kept = (self.lane == 0) & ~self.changing
        at = np.flatnonzero(kept[: _last_known(len(kept)) + 1])
        if not len(at):
            return float(self.station_m[-1]), float(self.station_m[-1])
        first, last = int(at[-1]), int(at[-1])
        while first > 0 and kept[first - 1]:
            first -= 1
        while last < len(kept) - 1 and kept[last + 1]:
            last += 1
        return float(self.station_m[first]), float(self.station_m[last])

    @property
    def vehicle_m(self) -> Floats:
        """Place of the vehicle, left of the track, shape (B,): its lane's centre, but where it changes lane. [m]"""
        out = self.centre_m.copy()
        edges = [0, *(np.flatnonzero(np.diff(self.doing)) + 1).tolist(), len(out)]
        for start, end in itertools.pairwise(edges):
            doing = int(self.doing[start])
            if doing != _KEEPING:
                to_left = 1.0 if doing in (_LEFT_BEFORE, _LEFT_AFTER) else -1.0
                share = (np.arange(end - start) + 0.5) / (end - start)
                share = share if doing in (_LEFT_BEFORE, _RIGHT_BEFORE) else share - 1.0
                out[start:end] += to_left * share * self.width_m[start:end] / 2
        return out


class Passing(NamedTuple):
    """Packets of markers that the vehicle passed, each of shape (P,)."""

    row: Ints  # of the marker
    along_m: Floats  # [m] of the marker ahead of the vehicle
    rssi_dbm: Floats


NOTHING_PASSED = Passing(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))


class CourseBeside(NamedTuple):
    """A lane beside the driven one."""

    position: int  # lanes to the left of the driven one
    oncoming: bool | None  # None where the sides that its markers send do not show it
    course: LaneCourse
    side: Ints  # shape (K,): boundary that each marker is on; UNKNOWN for those of other lanes


@dataclass(frozen=True, slots=True, eq=False)
class DrivenLane:
    """The driven lane, and lanes that are equally likely."""

    side: Ints  # shape (K,): boundary that each marker is on; UNKNOWN for those of other lanes
    course: LaneCourse
    others: tuple[LaneCourse, ...]  # equally likely lanes; none where the driven one is certain
    last_lane: LaneCourse  # the lane in which the vehicle is at the end, along the whole track
    beside: tuple[CourseBeside, ...]  # other lanes
    contradicted: int = 0  # markers whose places contradict the lines that are registered for them


def choose_driven_lane(
    station_m: Floats,
    left_m: Floats,
    named: Ints,
    drive: DrivenLine,
    passing: Passing = NOTHING_PASSED,
    line: Ints | None = None,
) -> DrivenLane | None:
    """Find the driven lane among all markers beside a track; None where no lane contains the track.

    Parameters
    ----------
    station_m, left_m : ndarray, shape (K,)
        Of the markers, along and left of the track. [m]
    named : ndarray of int, shape (K,)
        `LaneSide` that each marker sends.
    passing : Passing
        How strongly markers were received that the vehicle passed.
    line : ndarray of int, shape (K,), optional
        Registered line of each marker; NO_LINE where none is registered.
    """
    beside = np.abs(left_m) < _HALF_GRID_M + _WIDTHS_M[-1]
    if beside.sum() < 2:
        return None
    stage = _stages(station_m[beside])
    lines = find_registered_lines(station_m[beside], left_m[beside], None if line is None else line[beside])
    along, across = lines.points(stage)
    model = _Model.of(stage, np.append(station_m[beside], along), np.append(left_m[beside], across), drive)
    found = [*model.likely(with_changes=False), *model.likely(with_changes=True)]
    weak = _unexpected_strength([course for _, course in found], station_m, left_m, passing)
    lanes = sorted(
        (
            (total + _ONCOMING_COST * _is_oncoming(course, station_m, left_m, named) + weak[k], k, course)
            for k, (total, course) in enumerate(found)
            if total < _FORBIDDEN and _has_lines(course, station_m, left_m)
        ),
        key=lambda lane: lane[:2],
    )
    if not lanes:
        return None
    (least, _, course), *rivals = lanes
    tie, change_tie = _TIE, _COARSE_CHANGE_TIE
    if lines.known_share >= _REGISTERED_SHARE:
        tie, change_tie = _REGISTERED_TIE, _REGISTERED_COARSE_CHANGE_TIE
    if course.lane.any():
        tie = math.inf if not model.has_both_lanes(course) else tie if model.precise else change_tie
    others = [rival for total, _, rival in rivals if total < least + tie and _farthest(course, rival)[1] >= _ANOTHER_M]
    last = model.trace(_last_lane_m(course)) if course.lane.any() else course
    side = _sides_of(last, station_m, left_m)
    beside = _lanes_beside(model, last, station_m, left_m, named)
    if _is_crossed(beside) or (not model.precise and _turn_while_changing(course, drive) > _MAX_CHANGE_TURN):
        others.append(course)
    return DrivenLane(side, course, tuple(others), last, tuple(beside), lines.contradicted)


def describe_tie(chosen: DrivenLane, drive: DrivenLine) -> str:
    """Why the driven lane is unknown, for people."""
    at, _ = _farthest(chosen.course, chosen.others[0])
    centres = sorted({float(course.centre_m[at]) for course in (chosen.course, *chosen.others)})
    places = " and ".join(f"{abs(centre):.1f} m {'left' if centre > 0 else 'right'}" for centre in centres)
    good = f"is accurate to {drive.accuracy_m:.1f} m" if np.isfinite(drive.accuracy_m) else "is of unknown accuracy"
    if drive.jump_m > drive.accuracy_m:
        good = f"jumps by {drive.jump_m:.1f} m"
    cure = "send the track of a receiver with RTK corrections"
    if len(centres) == 1:
        return f"it is equally likely that the vehicle changes lane and that it does not: its track {good}; {cure}"
    return f"several lanes are equally likely: their centres are {places} of the vehicle's track, which {good}; {cure}"


def _last_known(count: int) -> int:
    """The last station at which enough markers are around the vehicle to show its lane."""
    return count - 1 - (_ENDS if count > _LONG else 0)


def _farthest(course: LaneCourse, other: LaneCourse) -> tuple[int, float]:
    """The station where two courses, or their last lanes, are farthest apart, and how far; not at the ends. [m]"""
    apart = np.abs(course.centre_m - other.centre_m)
    apart = np.maximum(apart, np.abs(_last_lane_m(course) - _last_lane_m(other)))
    apart *= ~(course.changing | other.changing)
    last = _last_known(len(apart))
    apart[last + 1 :] = apart[: len(apart) - 1 - last] = 0.0
    return int(np.argmax(apart)), float(apart.max())


def _stages(station_m: Floats) -> Floats:
    first, last = float(station_m.min()), float(station_m.max())
    return np.linspace(first, last, max(math.ceil((last - first) / _STEP_M), 1) + 1)


class RegisteredLines(NamedTuple):
    """Where registered lines run: links between neighbouring markers of one line."""

    start: Floats  # shape (N, 2): [m] along and left of the track
    end: Floats  # shape (N, 2), farther along
    known_share: float  # of all markers
    contradicted: int  # markers whose places contradict the lines that are registered for them

    def points(self, stage_m: Floats) -> tuple[Floats, Floats]:
        """Where the lines pass the stations, along and left of the track, shape (P,) each. [m]"""
        link, at = np.nonzero((self.start[:, :1] < stage_m) & (stage_m < self.end[:, :1]))
        share = (stage_m[at] - self.start[link, 0]) / (self.end[link, 0] - self.start[link, 0])
        return stage_m[at], self.start[link, 1] + share * (self.end[link, 1] - self.start[link, 1])


def find_registered_lines(station_m: Floats, left_m: Floats, line: Ints | None) -> RegisteredLines:
    """Lines that are registered and that the places of their markers do not contradict.

    A marker contradicts its line if it is farther from both of its neighbours on it, to the same side, than lines are
    apart. Two lines contradict each other where they cross, at angles at which roads do not. Where many markers do, no
    line is used.

    Parameters
    ----------
    station_m, left_m : ndarray, shape (K,)
        Of the markers, along and left of the track. [m]
    line : ndarray of int, shape (K,), or None
        NO_LINE where none is registered.
    """
    point = np.stack([station_m, left_m], 1)
    starts, ends, known, contradicted = [np.empty((0, 2))], [np.empty((0, 2))], 0, 0
    for which in np.unique(line[line != NO_LINE]) if line is not None else ():
        row = point[line == which]
        row = row[np.argsort(row[:, 0])]
        before, after = row[1:-1, 1] - row[:-2, 1], row[1:-1, 1] - row[2:, 1]
        off = np.zeros(len(row), bool)
        off[1:-1] = (before * after > 0) & (np.minimum(np.abs(before), np.abs(after)) > _LINES_APART_M)
        row, contradicted = row[~off], contradicted + int(off.sum())
        length, across = np.diff(row, axis=0).T
        linked = (length > 0) & (length < _REGISTERED_GAP_M) & (np.abs(across) <= _MAX_SLOPE * length)
        starts.append(row[:-1][linked])
        ends.append(row[1:][linked])
        known += len(row)
    start, end = np.concatenate(starts), np.concatenate(ends)
    crossed = _crossing(start, end)
    known, contradicted = known - int(crossed.sum()), contradicted + int(crossed.sum())
    if contradicted > _MAX_CONTRADICTED * (known + contradicted):
        return RegisteredLines(start[:0], end[:0], 0.0, contradicted)
    return RegisteredLines(start[~crossed], end[~crossed], known / len(point), contradicted)


def _crossing(start: Floats, end: Floats) -> Bools:
    """Which of the links between markers cross another one, shape (N,)."""
    low, high = np.maximum(start[:, None, 0], start[:, 0]), np.minimum(end[:, None, 0], end[:, 0])
    slope = (end[:, 1] - start[:, 1]) / (end[:, 0] - start[:, 0])
    first, last = (start[:, None, 1] + slope[:, None] * (at - start[:, None, 0]) for at in (low, high))
    first, last = first - first.T, last - last.T
    apart = np.minimum(np.abs(first), np.abs(last)) > _LINES_APART_M / 2
    return np.asarray(((low < high) & (first * last < 0) & apart).any(1))


@dataclass(frozen=True, slots=True, eq=False)
class _Model:
    """Costs of the states of a course: offset and width of the lane, and what the vehicle does."""

    stage_m: Floats  # shape (B,)
    grid: Floats  # shape (G,): [m] of the centre, left of the track
    line: Floats  # shape (B, W, G): cost of markers
    prior: Floats  # shape (G,): cost of the centre's offset from the vehicle at each station
    slope: Floats  # shape (B, G): of lines there, to the left of the track; grid steps from the station before
    sigma_m: float  # [m] of the vehicle's track beside its lane's centre
    precise: bool  # the receiver is accurate enough to show the lane

    @classmethod
    def of(cls, stage_m: Floats, station_m: Floats, left_m: Floats, drive: DrivenLine) -> _Model:
        """The model of a drive."""
        grid: Floats = np.arange(-_HALF_GRID_M, _HALF_GRID_M + _GRID_M / 2, _GRID_M)
        accuracy = max(drive.accuracy_m if np.isfinite(drive.accuracy_m) else UNKNOWN_ACCURACY_M, drive.jump_m)
        precise = accuracy < TRUSTED_TRACK_M
        length_m = _PRECISE_LENGTH_M if precise else max(_SLOW_TIME_S * drive.speed_m_s, _PRECISE_LENGTH_M)
        share, sigma = _STEP_M / length_m, math.hypot(accuracy, _DRIVER_M)
        line = _line_costs(stage_m, station_m, left_m, grid)
        prior = np.minimum((grid / sigma) ** 2, _MAX_PRIOR) * share
        slope = _slopes(stage_m, station_m, left_m, grid, _PAIR_M)
        if np.isnan(slope).mean() > _MAX_UNKNOWN:  # markers far apart
            slope = _slopes(stage_m, station_m, left_m, grid, _WIDE_PAIR_M)
        slope = _through_gaps(slope, stage_m, drive) * (stage_m[1] - stage_m[0]) / _GRID_M
        return cls(stage_m, grid, line, prior, slope, sigma, precise)

    def cheapest(self, allowed: Bools | None = None, *, with_changes: bool = True) -> tuple[float, LaneCourse]:
        """The cheapest course (Viterbi algorithm), after what it costs; `allowed` offsets have shape (B, G)."""
        cost = self._costs(allowed, with_changes)
        total, came = _follow(cost, self.slope, *self._changes(), self._prices())
        last = int(np.argmin(total[-1]))
        least = float(total[-1].flat[last])
        states = [last]
        for b in range(len(self.stage_m) - 1, 0, -1):
            states.append(int(came[b].flat[states[-1]]))
        mode, width, offset = np.unravel_index(states[::-1], total.shape[1:])
        to_left = (mode[:-1] == _LEFT_BEFORE) & (mode[1:] == _LEFT_AFTER)
        to_right = (mode[:-1] == _RIGHT_BEFORE) & (mode[1:] == _RIGHT_AFTER)
        lane = np.concatenate([[0], np.cumsum(to_left.astype(int) - to_right)])
        lane -= lane[_last_known(len(lane))]
        return least, LaneCourse(self.stage_m, self.grid[offset], _WIDTHS_M[width], lane, mode)

    def likely(self, *, with_changes: bool) -> list[tuple[float, LaneCourse]]:
        """The cheapest course, the cheapest of other lanes, and the cheapest one that is elsewhere in one place."""
        first = self.cheapest(with_changes=with_changes)
        found = [first]
        while len(found) <= _MAX_RIVALS:
            apart = np.all([_apart(course, self.grid) for _, course in found], 0)
            total, course = self.cheapest(apart, with_changes=with_changes)
            if total > first[0] + _TIE + _ONCOMING_COST + _MAX_STRENGTH_COST:
                break
            found.append((total, course))
        if (elsewhere := self._unsure(first[1], with_changes)) is not None:
            found.append(self.cheapest(elsewhere, with_changes=with_changes))
        return found

    def has_both_lanes(self, course: LaneCourse) -> bool:
        """Whether the lanes between which the vehicle changes are marked beside each other."""
        for k in np.flatnonzero(np.diff(course.lane)):
            apart_m = np.sign(course.lane[k + 1] - course.lane[k]) * (course.width_m[k] + course.width_m[k + 1]) / 2
            before, after = slice(max(k - _BOTH_LANES, 0), k + 1), slice(k + 1, k + 2 + _BOTH_LANES)
            new_m, old_m = course.centre_m[before] + apart_m, course.centre_m[after] - apart_m
            for at, centre_m in ((before, new_m), (after, old_m)):
                near = np.abs(self.grid - centre_m[:, None]) < _TRACE_M
                least = np.where(near[:, None], self.line[at], np.inf).min((1, 2))
                if np.mean(least <= _NO_LINE_COST) < _BOTH_SHARE:
                    return False
        return True

    def trace(self, centre_m: Floats) -> LaneCourse:
        """A lane whose centre is known within a metre, wherever the vehicle is."""
        near = np.abs(self.grid - centre_m[:, None]) < _TRACE_M
        return replace(self, prior=np.zeros(len(self.grid))).cheapest(near, with_changes=False)[1]

    def beyond(self, course: LaneCourse, sign: int) -> LaneCourse | None:
        """The next lane on the left (1) or on the right (-1), where it has markers on both boundaries."""
        away = sign * (self.grid - course.centre_m[:, None])
        if not (away > _ANOTHER_M).any(1).all():
            return None
        model = replace(self, prior=_NEARER_COST * np.abs(self.grid))
        _, found = model.cheapest(away > course.width_m[:, None] / 2 + _WIDTHS_M[0] / 2 - _GRID_M, with_changes=False)
        offset = np.rint((found.centre_m - self.grid[0]) / _GRID_M).astype(int)
        width = np.rint((found.width_m - _WIDTHS_M[0]) / (_WIDTHS_M[1] - _WIDTHS_M[0])).astype(int)
        marked = self.line[np.arange(len(offset)), width, offset] < _NO_LINE_COST
        edges = np.flatnonzero(np.diff(np.r_[0, marked.astype(np.int8), 0]))
        start, end = max(zip(edges[::2], edges[1::2], strict=True), key=lambda run: run[1] - run[0], default=(0, 0))
        if end - start < _MIN_STRETCH:
            return None
        at = slice(start, end)
        return LaneCourse(found.station_m[at], found.centre_m[at], found.width_m[at], found.lane[at], found.doing[at])

    def _unsure(self, course: LaneCourse, with_changes: bool) -> Bools | None:
        """Offsets of courses that are in another lane at the station where that costs least, shape (B, G)."""
        cost = self._costs(None, with_changes)
        modes = _REVERSED[: cost.shape[1]]
        changes, price = self._changes(), self._prices()
        before, _ = _follow(cost, self.slope, *changes, price)
        back = -np.vstack([self.slope[:1], self.slope[:0:-1]])
        after, _ = _follow(np.ascontiguousarray(cost[::-1][:, modes]), back, *changes, price)
        through = (before + after[::-1][:, modes] - cost).min((1, 2))
        apart = _apart(course, self.grid) & ~course.changing[:, None]
        if not apart.any():
            return None
        at = int(np.argmin(np.where(apart, through, np.inf).min(1)))
        return np.asarray(apart | (np.arange(len(apart)) != at)[:, None])

    def _costs(self, allowed: Bools | None, with_changes: bool) -> Floats:
        """Of all states, shape (B, M, W, G) with M of 5, or 1 without changes of lane."""
        cost = np.repeat(self.line[:, None], 5 if with_changes else 1, 1)
        cost[:, _KEEPING] += self.prior
        outside = np.maximum(np.abs(self.grid) - _WIDTHS_M[:, None] / 2, 0.0)
        cost[:, 1:] += np.minimum((outside / self.sigma_m) ** 2, _MAX_PRIOR) + _CHANGING_COST
        if allowed is not None:
            cost += np.where(allowed, 0.0, _FORBIDDEN)[:, None, None]
        return cost

    def _prices(self) -> tuple[float, float]:
        """Of a centre that leaves the direction of the lines, and of one that moves beside the track, by grid step."""
        return (_GRID_M / _ALONG_LINE_M) ** 2, (_GRID_M / (_MOVE_M if self.precise else _SLOW_MOVE_M)) ** 2

    def _changes(self) -> tuple[Floats, Ints]:
        """Cost of crossing the left boundary by width and offset, and grid steps between two lanes by their widths."""
        off = (self.grid + _WIDTHS_M[:, None] / 2) / math.hypot(self.sigma_m, _CROSSING_M)
        steps = np.rint((_WIDTHS_M[:, None] + _WIDTHS_M) / 2 / _GRID_M).astype(np.int64)
        return np.minimum(off**2, _MAX_PRIOR), steps


@ieee_kernel
def _follow(
    cost: Floats, slope: Floats, crossing: Floats, apart: Ints, price: tuple[float, float]
) -> tuple[Floats, Ints]:
    """Least cost up to each station and state, and the state before, shape (B, 5, W, G) each."""
    count, modes, widths, size = cost.shape
    total, came = cost.copy(), np.zeros(cost.shape, np.int64)
    moved, source = np.empty((modes, widths, size)), np.empty((modes, widths, size), np.int64)
    switched, origin = np.empty((modes, widths, size)), np.empty((modes, widths, size), np.int64)
    if modes > 1:
        total[0, 1:] += _CHANGE_COST
    for b in range(1, count):
        for m in range(modes):
            most = np.inf if m == _KEEPING else _MAX_CHANGE_MOVE_COST
            for w in range(widths):
                for g in range(size):
                    best, at = np.inf, g
                    known = not math.isnan(slope[b, g])
                    middle = g - round(slope[b, g]) if known else g
                    for h in range(max(middle - _MAX_MOVE, 0), min(middle + _MAX_MOVE + 1, size)):
                        value = total[b - 1, m, w, h]
                        if known:
                            value += min(price[0] * (g - h - slope[b, g]) ** 2, most)
                        if m == _KEEPING:
                            value += price[1] * (g - h) * (g - h)
                        if value < best:
                            best, at = value, h
                    moved[m, w, g], source[m, w, g] = best, (m * widths + w) * size + at
        for w in range(widths):
            for g in range(size):
                for m in range(modes):
                    switched[m, w, g], origin[m, w, g] = moved[m, w, g], source[m, w, g]
                if modes == 1:
                    continue
                for m in (_LEFT_AFTER, _RIGHT_AFTER):
                    if moved[m, w, g] < switched[_KEEPING, w, g]:
                        switched[_KEEPING, w, g], origin[_KEEPING, w, g] = moved[m, w, g], source[m, w, g]
                for m in (_LEFT_BEFORE, _RIGHT_BEFORE):
                    value = moved[_KEEPING, w, g] + _CHANGE_COST
                    if value < switched[m, w, g]:
                        switched[m, w, g], origin[m, w, g] = value, source[_KEEPING, w, g]
        if modes > 1:
            for sign in (1, -1):
                old = _LEFT_BEFORE if sign == 1 else _RIGHT_BEFORE
                for v in range(widths):
                    for w in range(widths):
                        step = sign * apart[v, w]
                        for g in range(max(0, -step), min(size, size - step)):
                            value = moved[old, v, g] + crossing[v, g if sign == 1 else size - 1 - g]
                            if value < switched[old + 1, w, g + step]:
                                switched[old + 1, w, g + step] = value
                                origin[old + 1, w, g + step] = source[old, v, g]
        for m in range(modes):
            for w in range(widths):
                for g in range(size):
                    best, at = switched[m, w, g], origin[m, w, g]
                    for v in range(max(w - 1, 0), min(w + 2, widths)):
                        value = switched[m, v, g] + (_WIDTH_COST if v != w else 0.0)
                        if value < best:
                            best, at = value, origin[m, v, g]
                    total[b, m, w, g] += best
                    came[b, m, w, g] = at
    return total, came


def _line_costs(stage_m: Floats, station_m: Floats, left_m: Floats, grid: Floats) -> Floats:
    """Cost of a lane at each station by width and offset, shape (B, W, G): lines at its boundaries, none within."""
    along = np.abs(stage_m[:, None] - station_m)
    sigma = _LINE_SIGMA_M + _SPREAD * along
    fine: Floats = np.arange(grid[0] - _WIDTHS_M[-1], grid[-1] + _WIDTHS_M[-1], _GRID_M / 2)
    line = np.full((len(stage_m), len(fine)), _NO_LINE_COST)
    within = np.zeros((len(stage_m), len(fine)))
    for b in range(len(stage_m)):
        near = np.flatnonzero(along[b] < _LINE_REACH_M)
        if len(near):
            off = (left_m[near, None] - fine) / sigma[b, near, None]
            line[b] = np.minimum((off**2 + (2 * along[b, near, None] / _LINE_REACH_M) ** 2).min(0), _NO_LINE_COST)
        here = left_m[along[b] < _WITHIN_REACH_M]
        within[b] = np.searchsorted(np.sort(here), fine)
    out = np.empty((len(stage_m), len(_WIDTHS_M), len(grid)))
    for w, width in enumerate(_WIDTHS_M):
        left, right = (np.rint((grid + sign * width / 2 - fine[0]) / (_GRID_M / 2)).astype(int) for sign in (1, -1))
        margin = round(_WITHIN_MARGIN_M / (_GRID_M / 2))
        inside = np.minimum(within[:, left - margin] - within[:, right + margin], _MAX_WITHIN)
        unusual = (width - min(max(width, _USUAL_WIDTHS_M[0]), _USUAL_WIDTHS_M[1])) / 0.4
        out[:, w] = line[:, left] + line[:, right] + _WITHIN_COST * inside + 0.5 * unusual**2
    return out


def _slopes(stage_m: Floats, station_m: Floats, left_m: Floats, grid: Floats, pair_m: tuple[float, float]) -> Floats:
    """Direction of the lines beside the track at each station, shape (B, G); NaN where markers show none.

    It is the one in which most pairs of neighbouring markers lie. A vehicle that changes lane crosses the lines.
    """
    tried: Floats = np.arange(-_MAX_SLOPE, _MAX_SLOPE + _SLOPE_STEP / 2, _SLOPE_STEP)
    coarse: Floats = np.linspace(grid[0], grid[-1], 9)
    out = np.empty((len(stage_m), len(grid)))
    nearest = np.rint(np.interp(grid, coarse, np.arange(len(coarse)))).astype(int)
    order = np.argsort(station_m)
    ranked, left = station_m[order], left_m[order]
    ends = np.searchsorted(ranked, ranked + pair_m[1], side="right")
    first = np.repeat(np.arange(len(ranked)), ends - np.arange(len(ranked)))
    second = np.concatenate([np.arange(k, end) for k, end in enumerate(ends)])
    apart = ranked[second] - ranked[first]
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = (left[second] - left[first]) / apart
    kept = (apart > pair_m[0]) & (np.abs(slope) <= _MAX_SLOPE) & (np.abs(left[second] - left[first]) < _PAIR_ACROSS_M)
    middle_m, across, slope = ((ranked[second] + ranked[first]) / 2)[kept], left[first][kept], slope[kept]
    agree = np.exp(-(((slope[:, None] - tried) / (2.5 * _SLOPE_STEP)) ** 2) / 2)
    for b, at in enumerate(stage_m):
        near = np.abs(middle_m - at + (stage_m[1] - stage_m[0]) / 2) < _SLOPE_REACH_M / 2
        here = across[near] + slope[near] * (at - middle_m[near])
        weight = np.exp(-(((here - coarse[:, None]) / _SLOPE_ACROSS_M) ** 2) / 2) @ agree[near]
        best = tried[np.argmax(weight, 1)]
        wanted = np.where(np.abs(best) > _STEEP, _MIN_STEEP_PAIRS, _MIN_PAIRS)
        out[b] = np.where(weight.max(1) >= wanted, best, np.nan)[nearest]
    return out


def _through_gaps(slope: Floats, stage_m: Floats, drive: DrivenLine) -> Floats:
    """Directions where markers are missing: lines bend evenly there, in the plane rather than beside the track."""
    _, tangent = drive.line.points_at((stage_m + np.concatenate([stage_m[:1], stage_m[:-1]])) / 2)
    yaw = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    out = slope.copy()
    for g in range(slope.shape[1]):
        known = np.flatnonzero(~np.isnan(slope[:, g]))
        for first, last in itertools.pairwise(known.tolist()):
            if 1 < last - first <= _MAX_GAP:
                inner = np.arange(first + 1, last)
                line = np.interp(inner, (first, last), (slope[[first, last], g] + yaw[[first, last]]))
                out[inner, g] = np.clip(line - yaw[inner], -_MAX_SLOPE, _MAX_SLOPE)
    return out


def _apart(course: LaneCourse, grid: Floats) -> Bools:
    """States of other lanes, shape (B, G)."""
    return np.asarray(np.abs(grid - course.centre_m[:, None]) >= _ANOTHER_M)


def _unexpected_strength(courses: list[LaneCourse], station_m: Floats, left_m: Floats, passing: Passing) -> list[float]:
    """How badly each lane explains the strength of markers that were passed, in squared sigmas.

    Strength falls with the logarithm of distance, and differs between the sides of the vehicle. Its level, slope and
    difference are fitted for each lane; a marker counts once, however often it was received.
    """
    misfit_db2, count = [], 0.0
    for course in courses:
        at = station_m[passing.row] - passing.along_m
        across = left_m[passing.row] - np.interp(at, course.station_m, course.vehicle_m)
        near = np.abs(passing.along_m) < PASSING_M
        if near.sum() < _MIN_PASSING:
            return [0.0] * len(courses)
        row, along, side = passing.row[near], passing.along_m[near], np.sign(across[near])
        fallen_db = 10 * np.log10(np.sqrt(along**2 + across[near] ** 2 + _ANTENNA_M**2))
        weight = np.sqrt(1 / np.bincount(row)[row])
        count = float((weight**2).sum())
        terms = np.stack([np.ones(len(row)), -fallen_db, side], 1)
        known = np.array([0.0, _EXPONENT, 0.0]), np.array([_LEVEL_SD_DB, _EXPONENT_SD, _SIDES_SD_DB])
        matrix = np.vstack([terms * weight[:, None], np.diag(_STRENGTH_SD_DB / known[1])])
        right = np.concatenate([passing.rssi_dbm[near] * weight, known[0] * _STRENGTH_SD_DB / known[1]])
        fitted = np.linalg.lstsq(matrix, right, rcond=None)[0]
        misfit_db2.append(float(((matrix @ fitted - right) ** 2).sum()))
    sd_db2 = max(min(misfit_db2) / count, _STRENGTH_SD_DB**2)
    return [min((one - min(misfit_db2)) / sd_db2, _MAX_STRENGTH_COST) for one in misfit_db2]


def _last_lane_m(course: LaneCourse) -> Floats:
    """Centre of the lane in which the vehicle is at the end, left of the track, shape (B,). [m]"""
    centre = course.centre_m.copy()
    for k in np.flatnonzero(np.diff(course.lane)):
        to_left = np.sign(course.lane[k + 1] - course.lane[k])
        apart_m = to_left * (course.width_m[k] + course.width_m[k + 1]) / 2
        if k < _last_known(len(centre)):
            centre[: k + 1] += apart_m
        else:
            centre[k + 1 :] -= apart_m
    return centre


def _lanes_beside(
    model: _Model, last: LaneCourse, station_m: Floats, left_m: Floats, named: Ints
) -> list[CourseBeside]:
    """Other lanes, the nearest first on each side."""
    found = []
    for sign in (1, -1):
        course: LaneCourse | None = last
        for position in range(1, _MAX_BESIDE + 1):
            if course is None or len(course.station_m) < len(last.station_m):
                break
            course = model.beyond(course, sign)
            if course is None or not _has_lines(course, station_m, left_m):
                break
            side = _sides_of(course, station_m, left_m)
            inside = (station_m > course.station_m[0] - _STEP_M) & (station_m < course.station_m[-1] + _STEP_M)
            side = np.where(inside, side, UNKNOWN)
            found.append(CourseBeside(sign * position, _direction(side, named), course, side))
    return found


def _turn_while_changing(course: LaneCourse, drive: DrivenLine) -> float:
    """How far the track turns during a change of lane, at most; 0 without one. [rad]"""
    _, tangent = drive.line.points_at(course.station_m)
    yaw = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], course.changing.astype(np.int8), [0]])))
    return max(
        (float(np.ptp(yaw[max(a - 1, 0) : b + 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)), default=0.0
    )


def _is_crossed(beside: list[CourseBeside]) -> bool:
    """Whether a lane on one side ends where one on the other side begins, as if the path ran from lane to lane."""
    left, right = ([lane.course.station_m for lane in beside if lane.position == sign] for sign in (1, -1))
    return any(
        abs(before[-1] - after[0]) < _CROSSED_M and before[0] < after[0] and before[-1] < after[-1]
        for one in left
        for other in right
        for before, after in ((one, other), (other, one))
    )


def _direction(side: Ints, named: Ints) -> bool | None:
    """Whether a lane is an oncoming one by the sides that its markers send; None where they do not show it."""
    differ = []
    for which in (LEFT, RIGHT):
        sent = named[(side == which) & (named != UNKNOWN)]
        differ.append(float(np.mean(sent != which)) if len(sent) else math.nan)
    if np.isnan(differ).any():
        return None
    if min(differ) >= _ONCOMING_SHARE:
        return True
    return False if max(differ) <= 1 - _ONCOMING_SHARE else None


def _off_boundaries(course: LaneCourse, station_m: Floats, left_m: Floats) -> tuple[Floats, Floats]:
    """Distance left of the left and of the right boundary. [m]"""
    centre = np.interp(station_m, course.station_m, course.centre_m)
    half = np.interp(station_m, course.station_m, course.width_m) / 2
    return left_m - centre - half, left_m - centre + half


def _sides_of(course: LaneCourse, station_m: Floats, left_m: Floats) -> Ints:
    """The boundary that each marker is on; UNKNOWN for other markers."""
    left, right = (np.abs(off) for off in _off_boundaries(course, station_m, left_m))
    side = np.where(left < right, LEFT, RIGHT)
    return np.where(np.minimum(left, right) < _ON_BOUNDARY_M, side, UNKNOWN)


def _is_oncoming(course: LaneCourse, station_m: Floats, left_m: Floats, named: Ints) -> bool:
    """Whether the markers on both boundaries send the other side."""
    return _direction(_sides_of(course, station_m, left_m), named) is True


def _has_lines(course: LaneCourse, station_m: Floats, left_m: Floats) -> bool:
    """Whether there are markers on both boundaries."""
    side = _sides_of(course, station_m, left_m)
    return bool((side == LEFT).sum() >= 2 and (side == RIGHT).sum() >= 2)
