"""Freshness of transmissions from their sequences and times of reception.

A marker counts its transmissions, so a message of sequence s was made before every message of a higher sequence, by at
least the shortest interval for each step between them. If the higher one was received at t, the lower one was made
before t; received later than that, it was recorded and sent again. This holds whoever sent it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter

Floats = npt.NDArray[np.float64]


FASTEST_INTERVAL_S = 0.014  # [s] source: below the 15.4 ms on air of 24 bytes at SF7, 500 kHz (`radio.airtime`)
_MAX_STEPS = 50  # of sequence between two packets whose interval is used; source: by hand, no measurement kept
_MIN_PAIRS = 20  # of packets for the interval of all markers; source: by hand, no measurement kept
_MIN_OWN_PAIRS = 6  # of packets for the interval of one marker; source: by hand, no measurement kept
_SIMILAR = 1.25  # ratio to the middle of similar intervals; source: jitter of 0.1 early and late is 1.2
_SIMILAR_SHARE = 0.5  # of all intervals that must be similar; source: a majority, so a flooded log gives none
_SAFETY = 0.5  # of the interval found, taken as the shortest; source: by hand, no measurement kept


@dataclass(frozen=True, slots=True)
class SequenceSpan:
    """Sequences of one marker that were received in one drive.

    Attributes
    ----------
    first_sequence, last_sequence : int
        Lowest and highest.
    first_heard_s, last_heard_s : float
        Times of reception, seconds since 1970-01-01 UTC; NaN if the log had no times: then no message up to the
        highest sequence is fresh any more. [s]
    """

    first_sequence: int
    last_sequence: int
    first_heard_s: float
    last_heard_s: float


@dataclass(frozen=True, slots=True)
class FreshnessRules:
    """Tolerances when times and sequences are compared.

    Attributes
    ----------
    clock_tolerance_s : float
        Maximum difference between the clocks of two drives. [s]
    log_tolerance_s : float
        Maximum by which times within one log are out of order. [s]
    echo_s : float
        The same sequence again within this time is an echo (another gateway, a repeated delivery), later a replay. [s]
    min_interval_s : float or None
        Shortest time from one transmission of a marker to the next, if known. Without it, half of the interval found
        in the log is used within the log, and the time on air at the fastest setting between logs. [s]
    uploaded_at_s : float or None
        When the log was uploaded: no packet can have been received later. [s]

    Raises
    ------
    InvalidParameter
        A value is negative or not finite.
    """

    clock_tolerance_s: float = 60.0  # [s] source: by hand, no measurement kept
    log_tolerance_s: float = 3.0  # [s] source: by hand, no measurement kept
    echo_s: float = 3.0  # [s] source: `log_tolerance_s`
    min_interval_s: float | None = None
    uploaded_at_s: float | None = None

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= 0):
                raise InvalidParameter(f"{name} is {value}", field=f"freshness.{name}", limit="0 or more, finite [s]")


class SequenceOrder:
    """Sequences of one marker in order, with their times of reception.

    Parameters
    ----------
    sequences : array_like, shape (N,)
    received_s : array_like, shape (N,)
        NaN counts as received before any other time. [s]
    min_interval_s : float
        [s]
    """

    def __init__(self, sequences: npt.ArrayLike, received_s: npt.ArrayLike, min_interval_s: float) -> None:
        known = np.asarray(sequences, float)
        order = np.argsort(known, kind="stable")
        times = np.asarray(received_s, float)[order]
        times[np.isnan(times)] = -np.inf
        self._interval_s = min_interval_s
        self._sequences = known[order]
        made = times - self._sequences * min_interval_s
        self._made_before_s = np.append(np.minimum.accumulate(made[::-1])[::-1], np.inf)
        self._received_by_s = np.append(-np.inf, np.maximum.accumulate(times))

    def late_s(self, sequences: npt.ArrayLike, received_s: npt.ArrayLike) -> Floats:
        """Delay of each reception after the last time it can have been made; -inf where there is no such time. [s]"""
        asked = np.asarray(sequences, float)
        at = np.searchsorted(self._sequences, asked, side="left")
        with np.errstate(invalid="ignore"):
            return np.asarray(received_s, float) - (self._made_before_s[at] + asked * self._interval_s)

    def early_s(self, sequences: npt.ArrayLike, received_s: npt.ArrayLike) -> Floats:
        """Time of each reception before that of a lower or equal sequence; -inf where there is none. [s]"""
        at = np.searchsorted(self._sequences, np.asarray(sequences, float), side="right")
        return np.asarray(self._received_by_s[at] - np.asarray(received_s, float))


def order_of_spans(spans: Sequence[SequenceSpan], min_interval_s: float) -> SequenceOrder:
    """The order of the first and the last transmission of each span."""
    return SequenceOrder(
        [s for span in spans for s in (span.first_sequence, span.last_sequence)],
        [t for span in spans for t in (span.first_heard_s, span.last_heard_s)],
        min_interval_s,
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


class LearnedIntervals:
    """Intervals between transmissions, estimated from a log.

    Parameters
    ----------
    received : mapping of int to (array, array)
        Sequences and times of the packets of each marker with a valid tag. [s]

    Notes
    -----
    Times from one packet to the next, divided by their steps in sequence, are close to the interval for genuine packets
    and arbitrary for packets that were recorded and sent again. So the shortest range that holds half of all values is
    used, if they are similar: flooding a log prevents an estimate, but does not shift it.
    """

    def __init__(self, received: Mapping[int, tuple[Floats, Floats]]) -> None:
        self._own = {number: _intervals_s(*values) for number, values in received.items()}
        pooled = np.concatenate(list(self._own.values())) if self._own else np.empty(0)
        self._all_s = _densest(pooled, _MIN_PAIRS)

    def min_s(self, number: int) -> float:
        """Half of the marker's own interval or of the interval of all markers, whichever is known and shorter. [s]"""
        own = self._own.get(number, np.empty(0))
        found = [interval for interval in (self._all_s, _densest(own, _MIN_OWN_PAIRS)) if interval is not None]
        if self._all_s is not None and len(own):  # a marker that is clearly faster than the others
            found.append(float(own.max()))
        return max(_SAFETY * min(found), FASTEST_INTERVAL_S) if found else FASTEST_INTERVAL_S


def _intervals_s(sequences: Floats, received_s: Floats) -> Floats:
    """Time between packets that follow each other, over their step in sequence. [s]"""
    order = np.lexsort((received_s, sequences))
    order = order[np.diff(sequences[order], prepend=-1) > 0]  # the first reception of each sequence
    steps, apart_s = np.diff(sequences[order]), np.diff(received_s[order])
    kept = (steps >= 1) & (steps <= _MAX_STEPS) & (apart_s > 0)
    return np.asarray(apart_s[kept] / steps[kept])


def _densest(intervals_s: Floats, min_count: int) -> float | None:
    """The median of the shortest range that holds half of the values, if they are similar. [s]"""
    if len(intervals_s) < min_count:
        return None
    values = np.sort(np.log(intervals_s))
    half = math.ceil(_SIMILAR_SHARE * len(values))
    widths = values[half - 1 :] - values[: len(values) - half + 1]
    first = int(widths.argmin())
    if widths[first] > 2 * math.log(_SIMILAR):
        return None
    return float(np.exp(np.median(values[first : first + half])))
