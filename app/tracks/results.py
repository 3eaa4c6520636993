"""The smoothed drive as a track: positions at a rate and at each marker, markers, clocks, gaps."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from app.tracks.measure import times_lost
from app.tracks.time_base import TimeBase
from app.tracks.types import (
    BIAS,
    HEADING,
    SCALE,
    SPEED,
    Clock,
    ClockOffset,
    ClockState,
    FixResult,
    LeftOutReason,
    PositionFix,
    Track,
    TrackGap,
    TrackRules,
)
from app.values import Bools, Floats, Ints

if TYPE_CHECKING:
    from app.tracks.estimate import Segment, Smoothed

_OBSERVED = 0.5  # of the declared error of a clock: an offset with a larger one is not observable
_PAUSE_S = 10.0  # [s] longer pauses without any data are gaps, whatever the filter makes of them


def collect_track(
    rules: TrackRules, base: TimeBase, fixes: tuple[PositionFix, ...], segments: list[Segment], segment_of: Ints,
    declared: tuple[Clock, ...], smoothed: Smoothed, passage: Ints, pauses: list[tuple[float, float]],
    warnings: tuple[str, ...],
) -> Track:  # fmt: skip
    """The track with all that belongs to it."""
    states = smoothed.states
    offsets = np.array(
        [float(states[0, entry.place]) if entry.place >= 0 else entry.clock.offset_s for entry in segments]
    )
    fix_time = np.array([fix.time_s for fix in fixes]) + offsets[segment_of]
    margin = 1.0 + 3.0 * max(clock.sigma_s for clock in declared)
    first, last = base.start_s + margin, base.start_s + base.step_s * (base.count - 1) - margin
    regular = np.arange(first, max(last, first) + 1e-6, 1.0 / rules.rate_hz)
    by_marker = np.array([fix.marker_id is not None for fix in fixes], bool)
    time = np.unique(np.round(np.concatenate([regular, fix_time[smoothed.used & by_marker]]), 4))
    place = np.clip((time - base.start_s) / base.step_s, 0, base.count - 1)
    low = np.minimum(place.astype(np.int64), max(base.count - 2, 0))
    share = (place - low)[:, None]
    high = np.minimum(low + 1, base.count - 1)
    state = (1 - share) * states[low] + share * states[high]
    covariance = (1 - share) * smoothed.position_m2[low] + share * smoothed.position_m2[high]
    heading_var = (1 - share[:, 0]) * smoothed.heading_rad2[low] + share[:, 0] * smoothed.heading_rad2[high]
    heading_sigma = np.degrees(np.sqrt(np.maximum(heading_var, 0.0)))
    east, cross, north = covariance.T
    sigma = np.sqrt(np.maximum((east + north) / 2 + np.sqrt(((east - north) / 2) ** 2 + cross**2), 0.0))
    driven = np.concatenate([[0.0], np.cumsum(np.abs(states[1:, SPEED]) * base.step_s)])
    odometer = np.interp(time, base.time_s, driven)
    lost = times_lost(fix_time, smoothed.used, by_marker, passage)
    in_gap, gaps = _gaps(rules, time, sigma, odometer, pauses, lost)
    node, _after = base.nearest(fix_time)
    results = _fix_results(fixes, fix_time, smoothed, states[node, HEADING])
    scale_var, bias_var = smoothed.ends[1, SCALE], smoothed.ends[1, BIAS]
    return Track(
        time_s=time,
        lon_deg=(np.degrees(state[:, 0]) + 180.0) % 360.0 - 180.0,
        lat_deg=np.degrees(state[:, 1]),
        heading_deg=np.degrees(state[:, HEADING]) % 360.0,
        speed_m_s=state[:, SPEED],
        covariance_m2=covariance,
        heading_sigma_deg=heading_sigma,
        in_gap=in_gap,
        fixes=results,
        clocks=_clocks(fixes, segments, segment_of, smoothed),
        gaps=gaps,
        length_m=float(odometer[-1] - odometer[0]) if len(odometer) else 0.0,
        speed_scale=(float(states[-1, SCALE]), math.sqrt(max(scale_var, 0.0))),
        heading_bias_deg=(math.degrees(states[-1, BIAS]), math.degrees(math.sqrt(max(bias_var, 0.0)))),
        path_points=smoothed.path_points,
        warnings=warnings,
    )


def _fix_results(
    fixes: tuple[PositionFix, ...], time_s: Floats, smoothed: Smoothed, heading_rad: Floats
) -> tuple[FixResult, ...]:
    east, north = smoothed.residual_m[:, 0], smoothed.residual_m[:, 1]
    along = east * np.sin(heading_rad) + north * np.cos(heading_rad)
    across = -east * np.cos(heading_rad) + north * np.sin(heading_rad)
    return tuple(
        FixResult(
            fix,
            bool(smoothed.used[k]),
            None if smoothed.used[k] else LeftOutReason.OUTLIER,
            float(time_s[k]),
            math.sqrt(max(float(smoothed.square[k]), 0.0)),
            float(along[k]),
            float(across[k]),
        )
        for k, fix in enumerate(fixes)
        if fix.marker_id is not None
    )


def _clocks(
    fixes: tuple[PositionFix, ...], segments: list[Segment], segment_of: Ints, smoothed: Smoothed
) -> tuple[ClockOffset, ...]:
    found = []
    for k, entry in enumerate(segments):
        times = [fix.time_s for fix, segment in zip(fixes, segment_of, strict=True) if segment == k]
        state, offset, sigma = ClockState.DECLARED, entry.clock.offset_s, entry.clock.sigma_s
        if entry.is_reference:
            state, sigma = ClockState.REFERENCE, 0.0
        elif entry.place >= 0:
            offset = float(smoothed.states[0, entry.place])
            sigma = math.sqrt(max(float(smoothed.ends[0, entry.place]), 0.0))
            observed = sigma < _OBSERVED * entry.clock.sigma_s
            state = ClockState.ESTIMATED if observed else ClockState.NOT_OBSERVABLE
        low, high = (min(times), max(times)) if times else (math.nan, math.nan)
        found.append(ClockOffset(entry.clock.name, state, offset, sigma, low, high, entry.jumped))
    return tuple(found)


def _gaps(
    rules: TrackRules,
    time: Floats,
    sigma: Floats,
    odometer: Floats,
    pauses: list[tuple[float, float]],
    lost: list[tuple[float, float]],
) -> tuple[Bools, tuple[TrackGap, ...]]:
    wide = sigma > rules.max_sigma_m
    paused = np.zeros(len(time), bool)
    for start, end in pauses:
        if end - start >= _PAUSE_S:
            paused |= (time > start) & (time < end)
    astray = np.zeros(len(time), bool)
    for start, end in lost:
        astray |= (time > start) & (time < end)
    in_gap = wide | paused | astray
    edges = np.flatnonzero(np.diff(np.r_[False, in_gap, False].astype(np.int8)))
    gaps = []
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        reason = "too far from the next marker"
        if paused[a:b].any():
            reason = "no sensor recorded"
        elif astray[a:b].any():
            reason = "the markers there do not fit the track"
        low, high = max(a - 1, 0), min(b, len(time) - 1)
        length = float(odometer[high] - odometer[low])
        gaps.append(TrackGap(float(time[low]), float(time[high]), length, float(sigma[a:b].max()), reason))
    return in_gap, tuple(gaps)
