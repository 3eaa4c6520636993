"""Which transmissions were heard when, and whether another one fits between them.

A marker counts its transmissions, so a message of sequence s was made before every message of a higher sequence, and by
at least the shortest interval for each step between them. Whoever heard the higher one at t proves that the lower one
was made before t: heard later than that, it was kept back and sent again. This holds whoever sent it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter

Floats = npt.NDArray[np.float64]


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
    least_interval_s : float
        Shortest time from one transmission of a marker to the next. The default is less than the time on air at the
        fastest setting; the interval that markers are programmed with makes the check sharper. [s]
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
    least_interval_s: float = 0.014
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
        """How long before a lower sequence each was heard; -inf where there is no lower one."""
        at = np.searchsorted(self._sequences, np.asarray(sequences, float), side="left")
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
