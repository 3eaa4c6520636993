"""Markers that were left out one after another: there the track may have lost its way, not the markers."""

from __future__ import annotations

import numpy as np

from app.tracks.types import Bools, Floats, Ints

MIN_PASSAGES = 3
"""Markers in a row. Source: by hand; where one in ten is wrong, three in a row are so once in 1000."""


def stretches_left_out(used: Bools, markers: Bools, passage: Ints) -> list[Ints]:
    """Rows of the fixes of each stretch in which `MIN_PASSAGES` markers or more were left out and none was used.

    Parameters
    ----------
    used, markers : ndarray of bool, shape (K,)
        In the order of the times.
    passage : ndarray of int, shape (K,)
    """
    rows = np.flatnonzero(markers)
    left = ~used[rows]
    edges = np.flatnonzero(np.diff(np.r_[False, left, False].astype(np.int8)))
    runs = [rows[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return [run for run in runs if np.unique(passage[run]).size >= MIN_PASSAGES]


def count_passages(used: Bools, passage: Ints) -> int:
    """Passes of markers that are used: the frames of one pass are one witness."""
    return int(np.unique(passage[used]).size)


def times_lost(time_s: Floats, used: Bools, markers: Bools, passage: Ints) -> list[tuple[float, float]]:
    """Stretches of time around such stretches, from the marker used before to the one used after. [s]"""
    kept = np.sort(time_s[used & markers])
    found = []
    for run in stretches_left_out(used, markers, passage):
        first, last = float(time_s[run].min()), float(time_s[run].max())
        before, after = kept[kept < first], kept[kept > last]
        found.append((float(before[-1]) if before.size else -np.inf, float(after[0]) if after.size else np.inf))
    return found
