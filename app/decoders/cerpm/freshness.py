"""Which transmissions were heard when, and whether another one fits between them.

A marker counts its transmissions, so a message of sequence s was made before every message of a higher sequence, and by
at least the shortest interval for each step between them. Whoever heard the higher one at t proves that the lower one
was made before t: heard later than that, it was kept back and sent again. This holds whoever sent it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter

Floats = npt.NDArray[np.float64]


FASTEST_INTERVAL_S = 0.014
"""Less than the time on air of a message at the fastest setting (SF7, 500 kHz). [s]"""
_MOST_STEPS, _LEAST_PAIRS, _LEAST_OWN_PAIRS = 50, 20, 6
_ALIKE, _SHARE_ALIKE = 1.25, 0.5
_HALF = 0.5


@dataclass(frozen=True, slots=True)
class SequenceSpan:
    """Sequences of one marker that were heard in one drive.

    Attributes
    ----------
    first_sequence, last_sequence : int
        Lowest and highest.
    first_heard_s, last_heard_s : float
        When, seconds since 1970-01-01 UTC; NaN where the log had no times: then nothing up to the highest sequence is
        fresh any more. [s]
    """

    first_sequence: int
    last_sequence: int
    first_heard_s: float
    last_heard_s: float


@dataclass(frozen=True, slots=True)
class FreshnessRules:
    """How strictly times and sequences are held against each other.

    Attributes
    ----------
    clock_tolerance_s : float
        Most that the clocks of two drives differ by. [s]
    log_tolerance_s : float
        Most that times within one log are out of order by. [s]
    echo_s : float
        The same sequence again within this is an echo (another gateway, a repeated delivery), later it is a replay. [s]
    least_interval_s : float or None
        Shortest time from one transmission of a marker to the next, where it is known. Without it half of the interval
        that the log itself shows is taken within the log, and the time on air at the fastest setting beyond it. [s]
    received_at_s : float or None
        When the log was uploaded: nothing can have been heard later. [s]

    Raises
    ------
    InvalidParameter
        A figure is negative or not finite.
    """

    clock_tolerance_s: float = 60.0
    log_tolerance_s: float = 3.0
    echo_s: float = 3.0
    least_interval_s: float | None = None
    received_at_s: float | None = None

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= 0):
                raise InvalidParameter(f"{name} is {value}", field=f"freshness.{name}", limit="0 or more, finite [s]")


class HeardOrder:
    """Sequences of one marker with the times that they were heard at.

    Parameters
    ----------
    sequences : array_like, shape (N,)
    heard_s : array_like, shape (N,)
        NaN counts as heard before any time. [s]
    least_interval_s : float
        [s]
    """

    def __init__(self, sequences: npt.ArrayLike, heard_s: npt.ArrayLike, least_interval_s: float) -> None:
        known = np.asarray(sequences, float)
        order = np.argsort(known, kind="stable")
        times = np.asarray(heard_s, float)[order]
        times[np.isnan(times)] = -np.inf
        self._interval_s = least_interval_s
        self._sequences = known[order]
        made = times - self._sequences * least_interval_s
        self._made_before_s = np.append(np.minimum.accumulate(made[::-1])[::-1], np.inf)
        self._heard_after_s = np.append(-np.inf, np.maximum.accumulate(times))

    def late_s(self, sequences: npt.ArrayLike, heard_s: npt.ArrayLike) -> Floats:
        """How long after the last moment that it can have been made each was heard; -inf where nothing bounds it."""
        asked = np.asarray(sequences, float)
        at = np.searchsorted(self._sequences, asked, side="left")
        with np.errstate(invalid="ignore"):
            return np.asarray(heard_s, float) - (self._made_before_s[at] + asked * self._interval_s)

    def early_s(self, sequences: npt.ArrayLike, heard_s: npt.ArrayLike) -> Floats:
        """How long before a lower sequence, or the same, each was heard; -inf where there is none."""
        at = np.searchsorted(self._sequences, np.asarray(sequences, float), side="right")
        return np.asarray(self._heard_after_s[at] - np.asarray(heard_s, float))


def order_of_spans(spans: Sequence[SequenceSpan], least_interval_s: float) -> HeardOrder:
    """The first and the last transmission of each span."""
    return HeardOrder(
        [s for span in spans for s in (span.first_sequence, span.last_sequence)],
        [t for span in spans for t in (span.first_heard_s, span.last_heard_s)],
        least_interval_s,
    )


def within_spans(spans: Sequence[SequenceSpan], sequences: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Whether each sequence lies in one of the spans."""
    asked = np.asarray(sequences, float)
    if not spans:
        return np.zeros(len(asked), bool)
    order = sorted(spans, key=lambda span: span.first_sequence)
    first = np.array([span.first_sequence for span in order], float)
    last = np.maximum.accumulate(np.array([span.last_sequence for span in order], float))
    at = np.searchsorted(first, asked, side="right") - 1
    return (at >= 0) & (last[np.maximum(at, 0)] >= asked)


class LearntIntervals:
    """Intervals between transmissions as a log shows them.

    Parameters
    ----------
    heard : mapping of int to (array, array)
        Sequences and times of the packets of each marker that carry its tag. [s]

    Notes
    -----
    Times from one packet to the next, over their steps in sequence, crowd about the interval where packets are honest,
    and lie anywhere where they were kept back. So the densest place counts, if half of all are there: whoever floods a
    log spoils the estimate, and then nothing is taken as known, but does not shift it.
    """

    def __init__(self, heard: Mapping[int, tuple[Floats, Floats]]) -> None:
        self._own = {number: _steps_s(*values) for number, values in heard.items()}
        pooled = np.concatenate(list(self._own.values())) if self._own else np.empty(0)
        self._fleet_s = _densest(pooled, _LEAST_PAIRS)

    def least_s(self, number: int) -> float:
        """Half of the marker's own interval or of the fleet's, whichever is shorter of those that show. [s]"""
        own = self._own.get(number, np.empty(0))
        found = [interval for interval in (self._fleet_s, _densest(own, _LEAST_OWN_PAIRS)) if interval is not None]
        if self._fleet_s is not None and len(own):  # one that is clearly faster than the others
            found.append(float(own.max()))
        return max(_HALF * min(found), FASTEST_INTERVAL_S) if found else FASTEST_INTERVAL_S


def _steps_s(sequences: Floats, heard_s: Floats) -> Floats:
    order = np.lexsort((heard_s, sequences))
    order = order[np.diff(sequences[order], prepend=-1) > 0]  # of each sequence the first hearing
    steps, apart_s = np.diff(sequences[order]), np.diff(heard_s[order])
    kept = (steps >= 1) & (steps <= _MOST_STEPS) & (apart_s > 0)
    return np.asarray(apart_s[kept] / steps[kept])


def _densest(intervals_s: Floats, least: int) -> float | None:
    """The middle of the shortest stretch that holds half of the values, if they are alike there."""
    if len(intervals_s) < least:
        return None
    values = np.sort(np.log(intervals_s))
    half = math.ceil(_SHARE_ALIKE * len(values))
    widths = values[half - 1 :] - values[: len(values) - half + 1]
    first = int(widths.argmin())
    if widths[first] > 2 * math.log(_ALIKE):
        return None
    return float(np.exp(np.median(values[first : first + half])))
