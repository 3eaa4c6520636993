"""Bars that are mounted or wired otherwise than declared: what they record of a drive."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace
from app.values import Floats

Field = np.ndarray


def turned_bar(bar: MagnetometerBar, yaw_deg: float) -> MagnetometerBar:
    """The bar with its array turned about its middle, anticlockwise from above; references stay. [deg]"""
    positions, array = bar.positions_m.copy(), bar.array
    middle = positions[array].mean(axis=0)
    positions[array] = middle + (positions[array] - middle) @ _yaw(yaw_deg).T
    return replace(bar, positions_m=positions)


def turned_trace(trace: MagnetTrace, bar: MagnetometerBar, yaw_deg: float) -> MagnetTrace:
    """What the chips of a turned bar record, their axes turned with it."""
    field = trace.field_ut.copy()
    field[:, bar.array] = field[:, bar.array] @ _yaw(yaw_deg).astype(field.dtype)
    return replace(trace, field_ut=field)


def _yaw(angle_deg: float) -> Floats:
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _swapped(field: Field, bar: MagnetometerBar, at: float) -> Field:
    """Two cables swapped: any two sensors of the array."""
    array = bar.array
    first = int(at * len(array)) % len(array)
    second = (first + 1 + int(at * 997) % (len(array) - 1)) % len(array)
    order = np.arange(field.shape[1])
    order[[array[first], array[second]]] = array[second], array[first]
    return field[:, order]


def _upside_down(field: Field, bar: MagnetometerBar, at: float) -> Field:
    """One sensor turned over about the direction of travel."""
    out = field.copy()
    out[:, bar.array[int(at * len(bar.array)) % len(bar.array)], 1:] *= -1
    return out


def _reversed(field: Field, bar: MagnetometerBar, _at: float) -> Field:
    """The array plugged in the other way round, from left to right."""
    order = np.arange(field.shape[1])
    by_place = bar.array[np.argsort(bar.positions_m[bar.array, 1])]
    order[by_place] = by_place[::-1]
    return field[:, order]


def _mirrored_halves(field: Field, bar: MagnetometerBar, _at: float) -> Field:
    """Each half plugged in from its end inwards."""
    order, places = np.arange(field.shape[1]), bar.positions_m[:, 1]
    for side in (-1, 1):
        half = bar.array[side * places[bar.array] > 0]
        by_place = half[np.argsort(places[half])]
        order[by_place] = by_place[::-1]
    return field[:, order]


def _back_to_front(field: Field, bar: MagnetometerBar, _at: float) -> Field:
    """The whole bar upside down about the vehicle's transverse axis: x and z inverted."""
    out = field.copy()
    out[:, bar.array] *= np.array([-1, 1, -1], field.dtype)
    return out


def _exchanged_references(field: Field, bar: MagnetometerBar, _at: float) -> Field:
    """The cables of the reference sensors swapped."""
    order = np.arange(field.shape[1])
    order[bar.references] = bar.references[::-1]
    return field[:, order]


FAULTS: Mapping[str, Callable[[Field, MagnetometerBar, float], Field]] = {
    "two sensors swapped": _swapped,
    "one sensor upside down": _upside_down,
    "array from left to right": _reversed,
    "halves mirrored": _mirrored_halves,
    "x and z inverted": _back_to_front,
    "references exchanged": _exchanged_references,
}
"""What is wrong, and what is then recorded: of the field, shape (T, S, 3), the bar, and a number from 0 to 1 that says
which sensor it is."""


def spoiled_trace(trace: MagnetTrace, bar: MagnetometerBar, fault: str, at: float) -> MagnetTrace:
    """What a bar with a fault records."""
    return replace(trace, field_ut=np.ascontiguousarray(FAULTS[fault](trace.field_ut, bar, at)))


def lossy_trace(trace: MagnetTrace, share: float, rng: np.random.Generator) -> MagnetTrace:
    """The trace without a share of its samples, which a full bus dropped in runs of one to ten."""
    kept, count = np.ones(len(trace.t_s), bool), 0
    while count < share * len(kept):
        start, run = int(rng.integers(len(kept))), int(rng.integers(1, 11))
        count += int(kept[start : start + run].sum())
        kept[start : start + run] = False
    return replace(trace, t_s=trace.t_s[kept], field_ut=np.ascontiguousarray(trace.field_ut[kept]))
