"""Clocks of sensors that both know the speed: the offset at which their speeds agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from app.tracks.types import MAX_CLOCK_SIGMA_S, Clock, Floats, Samples, TrackInput

_STEP_S = 0.1  # [s] source: by hand, the smoother finds the rest
_MIN_OVERLAP_S = 20.0  # [s] source: by hand, one junction
_MIN_CHANGE_M_S = 0.5  # [m/s] standard deviation of a speed that has a shape; source: by hand
_MIN_CORRELATION = 0.9  # source: by hand, the same car
_MIN_LEAD = 0.02  # over offsets that are more than `_APART_S` away; source: by hand
_APART_S = 2.0  # [s]
_SEARCH_SIGMAS, _MIN_SEARCH_S = 4.0, 2.0  # source: by hand
_FOUND_SIGMA_S = 0.3  # [s] of an offset that was found so; source: by hand, three steps


def align_clocks(given: TrackInput, clocks: dict[str, Clock]) -> TrackInput:
    """Set the offsets of clocks by the speeds, compared with those of the clock that has most of them."""
    longest: dict[str, Samples] = {}
    for series in given.speeds:
        if series.clock not in longest or series.time_s.size > longest[series.clock].time_s.size:
            longest[series.clock] = series
    if len(longest) < 2:
        return given
    reference = min(longest, key=lambda name: (-longest[name].time_s.size, name))
    found = dict(clocks)
    for name, series in longest.items():
        clock = clocks[name]
        if name == reference or clock.sigma_s == 0:
            continue
        lag = _best_lag(longest[reference], clocks[reference], series, clock)
        if lag is not None:
            sigma = min(max(clock.sigma_s, 1e-3), _FOUND_SIGMA_S, MAX_CLOCK_SIGMA_S)
            found[name] = replace(clock, offset_s=clock.offset_s + lag, sigma_s=sigma)
    return replace(given, clocks=tuple(found.values()))


def _best_lag(reference: Samples, reference_clock: Clock, series: Samples, clock: Clock) -> float | None:
    """What is to be added to the offset; None where no offset stands out."""
    reach = max(_SEARCH_SIGMAS * clock.sigma_s, _MIN_SEARCH_S)
    t, own = reference.time_s + reference_clock.offset_s, series.time_s + clock.offset_s
    start, end = max(t[0], own[0]) + reach, min(t[-1], own[-1]) - reach
    if end - start < _MIN_OVERLAP_S:
        return None
    at = np.arange(start, end, _STEP_S)
    first = np.interp(at, t, reference.value)
    if first.std() < _MIN_CHANGE_M_S:
        return None
    lags = np.arange(-reach, reach + _STEP_S / 2, _STEP_S)
    score = np.array([_correlation(first, np.interp(at - lag, own, series.value)) for lag in lags])
    best = int(np.argmax(score))
    others = score[np.abs(lags - lags[best]) > _APART_S]
    if score[best] < _MIN_CORRELATION or (others.size and score[best] < others.max() + _MIN_LEAD):
        return None
    return float(lags[best])


def _correlation(a: Floats, b: Floats) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b) / max(float(np.sqrt((a @ a) * (b @ b))), 1e-9)
