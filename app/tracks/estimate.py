"""One track from all that is known of a drive."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
import scipy

from app.errors import InvalidParameter
from app.tracks import kernel
from app.tracks.kernel import HEADING_SAMPLE, SPEED_SAMPLE, Motion
from app.tracks.measure import (
    FixArrays,
    PathIndex,
    averaged_rates,
    count_passages,
    fix_arrays,
    fix_rows,
    in_order,
    is_receiver,
    passage_distances,
    path_index,
    path_rows,
    receiver_results,
    sample_rows,
    stretches_left_out,
    with_estimated_accuracy,
)
from app.tracks.results import collect_track
from app.tracks.start import DeadReckoning, dead_reckon, start_set, start_state
from app.tracks.time_base import TimeBase, align_clocks, checked_clocks, find_jump, split_where_time_falls, time_base
from app.tracks.types import CLOCKS, HEADING, NORTH, Clock, PositionFix, Track, TrackInput, TrackRules
from app.values import Bools, Floats, Ints

MAX_ROUNDS = 40
"""Rounds of smoothing and gating at most. Source: `python -m benchmarks.track`: 4 to 8 are needed, rarely 30."""
_MOVED_M, _MOVED_S = 0.01, 1e-3  # [m, s] changes that end the rounds; below all noise
_READMIT = 0.8  # of the gate: no fix goes in and out in turn
_NEIGHBOURS_S = 20.0  # [s] one outlier at a time is left out of this; it spoils what is near
MAX_JUMPS = 4
"""Steps of clocks at most."""
_MIN_LEFT_OUT = 3  # fixes, from which on a step of a clock may be the cause; source: app/tracks/time_base.py
_EXPLORED_S = 0.02  # [s2/s] by which offsets may change while steps are looked for; 0.5 s in 12 s
_EXPLORING_ROUNDS = 3
_MOTION = Motion(
    position_m2_s=2e-5,  # [m2/s] slip of a car in bends, 5 mm in a second
    speed_m2_s3=1.0,  # [m2/s3] a change of 1 m/s within a second
    heading_rad2_s=1e-8,
    turning_m_s2=0.7,  # [m/s2] standard deviation of the lateral acceleration; comfortable bends
    scale_1_s=3e-7,  # [1/s] 0.4 % in a minute: slip, grades, tyres
    bias_rad2_s=2.5e-6,  # [rad2/s] 0.7 deg in a minute: a compass beside steel, the drift of a gyro
    clock_s=0.0,
    wander_m=0.4,
    wander_length_m=100.0,
)


@dataclass(slots=True, eq=False)
class Segment:
    """A stretch of a sensor's time with one offset; `place` is that of the offset in the state, -1: it has none."""

    clock: Clock
    place: int
    is_reference: bool = False
    jumped: bool = False


@dataclass(slots=True, eq=False)
class Smoothed:
    """The drive after the last round."""

    states: Floats  # shape (N, n)
    position_m2: Floats  # shape (N, 3): East-east, east-north, north-north
    heading_rad2: Floats  # shape (N,)
    ends: Floats  # shape (2, n): variances of the first and of the last state
    used: Bools  # shape (K,)
    square: Floats  # shape (K,): squared distances of the fixes from the track by all others
    residual_m: Floats  # shape (K, 3): from the track by all others
    # `offset_m`, `spread`: shape (K, 3) and (K, 3, 3): from the track, and its covariance there
    offset_m: Floats
    spread: Floats
    rounds: int
    path_points: int


@dataclass(slots=True, eq=False)
class DriveData:
    """What stays the same from round to round; `markers` are the fixes that the drive is placed by first."""

    given: TrackInput
    rules: TrackRules
    base: TimeBase
    fixes: tuple[PositionFix, ...]
    arrays: FixArrays
    segments: list[Segment]
    segment_of: Ints
    driven: DeadReckoning
    markers: Bools
    paths: list[PathIndex] = field(default_factory=list)

    def offsets(self, states: Floats | None) -> Floats:
        """Offset of each segment. [s]"""
        return np.array([
            float(states[0, entry.place]) if states is not None and entry.place >= 0 else entry.clock.offset_s
            for entry in self.segments
        ])  # fmt: skip


def estimate_track(given: TrackInput, rules: TrackRules | None = None) -> Track:
    """Fuse fixes, speeds, headings and paths.

    Parameters
    ----------
    given : TrackInput
        In any order.

    Returns
    -------
    Track

    Raises
    ------
    InvalidParameter
        There is no fix, a clock is not declared, or the sensors do not overlap in time.
    """
    rules = rules or TrackRules()
    given = align_clocks(given, checked_clocks(given))
    clocks = {clock.name: clock for clock in given.clocks}
    fixes, warnings = _in_time_order(given, clocks), list[str]()
    if not fixes:
        raise InvalidParameter(
            "there is no fix to place the drive by",
            field="decodes",
            limit="one or more registered markers with a position grade, and the time of their reading",
            cure="decode with coarse_position and captured_at, and register the markers with their accuracy",
        )
    base, pauses = time_base(given, clocks)
    reference = _reference(given, fixes)
    segments = [Segment(clock, -1, is_reference=clock.name == reference) for clock in clocks.values()]
    names = [entry.clock.name for entry in segments]
    segment_of = np.array([names.index(fix.clock) for fix in fixes])
    segment_of, fallen = split_where_time_falls(fixes, segment_of, segments)
    driven = dead_reckon(base, given.speeds, given.headings, {name: clock.offset_s for name, clock in clocks.items()})
    paths = [index for path in given.paths if (index := path_index(path)) is not None]
    receiver = is_receiver(fixes)
    markers = np.ones_like(receiver) if receiver.all() else ~receiver
    drive = DriveData(given, rules, base, fixes, fix_arrays(fixes), segments, segment_of, driven, markers, paths)
    smoothed = _with_jumps(drive, _with_stretches(drive, _smooth(drive)))
    factor = np.ones(len(fixes))
    if not markers.all():
        drive.arrays, factor = with_estimated_accuracy(fixes, drive.arrays, smoothed)
        smoothed = _smooth(drive, known=smoothed)
    if fallen:
        warnings.append("times of a sensor run backwards: its clock was set; each part has an offset of its own")
    track = collect_track(
        rules,
        base,
        fixes,
        drive.segments,
        drive.segment_of,
        given.clocks,
        smoothed,
        drive.arrays.passage,
        pauses,
        tuple(warnings),
    )
    return replace(track, receivers=receiver_results(fixes, factor, smoothed.used))


def _in_time_order(given: TrackInput, clocks: dict[str, Clock]) -> tuple[PositionFix, ...]:
    """Fixes by their time; of those at the same time, by all that they hold: the order they came in has no effect."""
    return tuple(
        sorted(
            given.fixes,
            key=lambda fix: (
                fix.time_s + clocks[fix.clock].offset_s, fix.clock, fix.decode_id, fix.place, fix.marker_id or "",
                fix.lon_deg, fix.lat_deg,
            ),
        )
    )  # fmt: skip


def _reference(given: TrackInput, fixes: tuple[PositionFix, ...]) -> str:
    """The clock that all others are compared with: of most speeds, else of most fixes by markers."""
    weight: Counter[str] = Counter({clock.name: 0 for clock in given.clocks})
    for series in given.speeds:
        weight[series.clock] += 1_000_000 * series.time_s.size
    for fix in fixes:
        weight[fix.clock] += 1 if fix.marker_id is None else 1000
    return min(weight, key=lambda name: (-weight[name], name))


# --- smoothing --------------------------------------------------------------------------------------------------------


def _places(segments: list[Segment]) -> list[int]:
    """Places of the offsets in the state; -1: known, or the reference."""
    unknown = [not entry.is_reference and entry.clock.sigma_s > 0 for entry in segments]
    return [CLOCKS + sum(unknown[:k]) if unknown[k] else -1 for k in range(len(segments))]


def _smooth(
    drive: DriveData, *, clock_s: float = 0.0, known: Smoothed | None = None, tried: Bools | None = None
) -> Smoothed:
    """Rounds of filter, smoother and gate until nothing changes; `clock_s` lets offsets of clocks change.

    `known` is the drive by its markers alone, which positions of a receiver are added to; `tried` are the fixes that
    are used at first instead of a consistent chain.
    """
    places = _places(drive.segments)
    for entry, own in zip(drive.segments, places, strict=True):
        entry.place = own
    place = max(CLOCKS, max(places) + 1)
    chain, turn, scale = start_set(drive)
    start, start_cov = start_state(drive, chain, turn, scale, place)
    used, decided = (chain, drive.markers) if known is None else (known.used, ~drive.markers)
    used = used if tried is None else tried
    motion = _MOTION._replace(
        wander_m=drive.rules.wander_m, wander_length_m=drive.rules.wander_length_m, clock_s=clock_s
    )
    gate2, gate3 = (float(scipy.stats.chi2.isf(drive.rules.outlier_probability, dof)) for dof in (2, 3))
    gate = np.where(np.isfinite(drive.arrays.heading_rad), gate3, gate2)
    states, position = (None, None) if known is None else (known.states, known.position_m2)
    around = np.full((drive.base.count, place), np.nan) if known is None else known.states
    rounds, path_points = 0, 0
    for rounds in range(1, MAX_ROUNDS + 1):
        measurements, where, path_points = _measurements(drive, states, position, used)
        new_states, covs = kernel.filter_track(drive.base.step_s, start, start_cov, around, measurements, motion)
        kernel.smooth_track(drive.base.step_s, new_states, covs, around, motion)
        if tried is not None and not np.isfinite(new_states).all():
            raise FloatingPointError("the fixes that were tried contradict each other")
        square, residual, smoothed, spread = kernel.fix_distances(measurements, where, new_states, covs)
        position, heading = covs[:, [0, 0, 1], [0, 1, 1]], covs[:, HEADING, HEADING].copy()
        ends = np.array([np.diag(covs[0]), np.diag(covs[-1])])
        del covs  # the largest array by far: not two of them at once
        square = passage_distances(drive.arrays, used, square, measurements.noise[where], smoothed, spread)
        moved = _moved(states, new_states)
        states, around = new_states, new_states
        if rounds < 2 and known is None:
            continue
        changed = used if clock_s > 0 else _gate(drive, used, decided, square, gate)
        if ((changed == used).all() and moved) or (clock_s > 0 and rounds == _EXPLORING_ROUNDS):
            break
        if rounds < MAX_ROUNDS:
            used = changed
    assert states is not None
    assert position is not None
    return Smoothed(states, position, heading, ends, used, square, residual, smoothed, spread, rounds, path_points)


def _moved(before: Floats | None, after: Floats) -> bool:
    """Whether a round has changed nothing any more."""
    if before is None:
        return False
    far = np.abs(after[:, NORTH] - before[:, NORTH]).max() * 6.4e6 < _MOVED_M
    far &= (np.abs(after[:, 0] - before[:, 0]) * np.cos(after[:, NORTH])).max() * 6.4e6 < _MOVED_M
    return bool(far and np.abs(after[0, CLOCKS:] - before[0, CLOCKS:]).max(initial=0.0) < _MOVED_S)


def _measurements(
    drive: DriveData, states: Floats | None, position_m2: Floats | None, used: Bools
) -> tuple[kernel.Measurements, Ints, int]:
    offsets = drive.offsets(states)
    names = {entry.clock.name: k for k, entry in reversed(list(enumerate(drive.segments)))}
    places = np.array([entry.place for entry in drive.segments])
    own = drive.segment_of
    rates = None if states is None else averaged_rates(drive.base, states)
    parts = [fix_rows(drive.base, drive.arrays, places[own], offsets[own], used, rates)]
    for kind, all_series in ((SPEED_SAMPLE, drive.given.speeds), (HEADING_SAMPLE, drive.given.headings)):
        for series in all_series:
            k = names[series.clock]
            parts.append(sample_rows(drive.base, series, kind, int(places[k]), float(offsets[k]), rates))
    path_points = 0
    if states is not None and position_m2 is not None:
        for path in drive.paths:
            rows = path_rows(drive.base, path, states, position_m2, drive.rules)
            path_points += len(rows.node)
            parts.append(rows)
    return *in_order(parts), path_points


def _gate(drive: DriveData, used: Bools, decided: Bools, square: Floats, gate: Floats) -> Bools:
    """Leave out the worst fix in each stretch, and take back those that fit; of those that are decided on."""
    changed = used.copy()
    time = drive.arrays.time_s + np.array([entry.clock.offset_s for entry in drive.segments])[drive.segment_of]
    bad = np.flatnonzero(used & decided & (square > gate))
    for k in bad[np.argsort(-square[bad])]:
        near = np.abs(time - time[k]) <= _NEIGHBOURS_S
        if not (near & used & ~changed).any():
            changed[k] = False
            # the same wrong marker in other frames
            changed &= ~((drive.arrays.passage == drive.arrays.passage[k]) & (square > gate))
    back = ~used & decided & (square < _READMIT * gate)
    return changed | back


# --- stretches and clocks ---------------------------------------------------------------------------------------------


def _with_stretches(drive: DriveData, smoothed: Smoothed) -> Smoothed:
    """Begin again with the markers that were left out one after another, and keep what fits more markers."""
    passage = drive.arrays.passage
    tried = smoothed.used.copy()
    for rows in stretches_left_out(smoothed.used, drive.markers, passage):
        tried[rows] = True
    if (tried == smoothed.used).all():
        return smoothed
    try:
        other = _smooth(drive, tried=tried)
    except FloatingPointError:
        return smoothed
    return other if count_passages(other.used, passage) > count_passages(smoothed.used, passage) else smoothed


def _with_jumps(drive: DriveData, smoothed: Smoothed) -> Smoothed:
    """Give a clock that was set during the drive another offset from then on, if more fixes fit then."""
    for _try in range(MAX_JUMPS):
        if (drive.markers & ~smoothed.used).sum() < _MIN_LEFT_OUT:
            break
        segments, segment_of = list(drive.segments), drive.segment_of
        if not _split_at_jump(drive):
            break
        other = _smooth(drive)
        passages = [count_passages(one.used, drive.arrays.passage) for one in (smoothed, other)]
        if passages[1] < passages[0] + 2:
            drive.segments, drive.segment_of = segments, segment_of
            for entry, place in zip(segments, _places(segments), strict=True):
                entry.place = place
            break
        smoothed = other
    return smoothed


def _split_at_jump(drive: DriveData) -> bool:
    """Look for steps by a smoother whose offsets may change; divide the segment with the largest. Whether there is."""
    loose = _smooth(drive, clock_s=_EXPLORED_S)
    node, _after = drive.base.nearest(drive.arrays.time_s + drive.offsets(None)[drive.segment_of])
    found = []
    for k, entry in enumerate(drive.segments):
        rows = np.flatnonzero((drive.segment_of == k) & loose.used)
        if entry.place >= 0 and rows.size:
            jump = find_jump(drive.arrays.time_s[rows], loose.states[node[rows], entry.place])
            if jump is not None:
                found.append((abs(jump.after_s - jump.before_s), k, jump))
    if not found:
        return False
    _size, k, jump = max(found, key=lambda entry: entry[:2])
    old = drive.segments[k]
    parts = [
        replace(old, clock=replace(old.clock, offset_s=offset), jumped=jumped)
        for offset, jumped in ((jump.before_s, old.jumped), (jump.after_s, True))
    ]
    drive.segments = [*drive.segments[:k], parts[0], *drive.segments[k + 1 :], parts[1]]
    after = (drive.segment_of == k) & (drive.arrays.time_s >= jump.first_s)
    drive.segment_of = np.where(after, len(drive.segments) - 1, drive.segment_of)
    return True
