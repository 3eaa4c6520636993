"""Profiles of blurred boxes along one axis of the plate: how much of a point's light comes from each unit.

A box from `low` to `high`, blurred by a Gaussian of standard deviation s and by a motion of length m, is the
difference of two blurred steps. A blurred step is the integral of the normal distribution over the motion:

    step(x) = (s / m) (G((x + m/2) / s) - G((x - m/2) / s)),  G(z) = z CDF(z) + PDF(z)

All lengths are in plate sides.
"""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import loop

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

NORMAL_REACH = 4.25
"""[standard deviations] end of the table of the normal distribution, beyond which 1e-5 of it lies. Source: chosen by
hand."""
NORMAL_DENSITY = 128
"""[entries per standard deviation] of the table. Source: linear interpolation then errs by at most h^2 / 8 max |f''| =
3e-6."""
_Z = np.arange(-NORMAL_REACH, NORMAL_REACH + 2.5 / NORMAL_DENSITY, 1 / NORMAL_DENSITY)
NORMAL_TABLE = np.stack([[NormalDist().cdf(z) for z in _Z], np.exp(-0.5 * _Z**2) / math.sqrt(2 * math.pi)], axis=1)
"""Cumulative distribution and density of the standard normal distribution, shape (entries, 2)."""
PROFILE_REACH = 3.0
"""[standard deviations] beyond which a unit's share of a point is left out. Source: 0.1 % of the normal distribution
lie beyond it; chosen by hand."""
SHORT_MOTION = 0.3
"""[standard deviations] length of the motion below which it is replaced by a Gaussian of its variance, m^2 / 12.
Source: chosen by hand."""


class AxisProfiles(NamedTuple):
    """Profiles at one point of an axis.

    Attributes
    ----------
    values : ndarray, shape (n + 3, 4)
        Rows: the n units, the low marker, the high marker, the whole plate. Columns: value, and its derivatives by the
        point, by the standard deviation of the blur and by the square of the motion's length.
    span : ndarray of int, shape (2,)
        First and last unit that the blur reaches; the rows of other units are not set.
    """

    values: Floats
    span: Ints


class AxisBlur(NamedTuple):
    """Blur along one axis: standard deviation of the Gaussian, length of the motion. [plate sides]"""

    spread: float
    motion: float


@loop
def normal(z: float, table: Floats) -> tuple[float, float]:
    """Cumulative distribution and density of the standard normal distribution, from the table."""
    if z >= NORMAL_REACH:
        return 1.0, 0.0
    if z <= -NORMAL_REACH:
        return 0.0, 0.0
    t = (z + NORMAL_REACH) * NORMAL_DENSITY
    i = int(t)
    f = t - i
    return table[i, 0] + f * (table[i + 1, 0] - table[i, 0]), table[i, 1] + f * (table[i + 1, 1] - table[i, 1])


@loop
def _moved_step(x: float, blur: AxisBlur, table: Floats) -> tuple[float, float, float, float]:
    """Blurred unit step at x: value and its derivatives by x, by the spread and by the motion's square."""
    a = (x + 0.5 * blur.motion) / blur.spread
    b = (x - 0.5 * blur.motion) / blur.spread
    ca, pa = normal(a, table)
    cb, pb = normal(b, table)
    motion = blur.motion
    value = (a * ca + pa - b * cb - pb) * blur.spread / motion
    return value, (ca - cb) / motion, (pa - pb) / motion, (0.5 * (ca + cb) - value) / (2.0 * motion * motion)


@loop
def _set_box(x: float, low: float, high: float, blur: AxisBlur, table: Floats, out: Floats, row: int) -> None:
    """Set a row of the profiles to the blurred box from `low` to `high`, at x."""
    if blur.motion < SHORT_MOTION * blur.spread:
        wide = 1.0 / math.sqrt(blur.spread * blur.spread + blur.motion * blur.motion / 12.0)
        a = (x - low) * wide
        b = (x - high) * wide
        ca, pa = normal(a, table)
        cb, pb = normal(b, table)
        by_spread = (b * pb - a * pa) * wide
        out[row, 0] = ca - cb
        out[row, 1] = (pa - pb) * wide
        out[row, 2] = by_spread * blur.spread * wide
        out[row, 3] = by_spread * wide / 24.0
    else:
        first = _moved_step(x - low, blur, table)
        last = _moved_step(x - high, blur, table)
        out[row, 0] = first[0] - last[0]
        out[row, 1] = first[1] - last[1]
        out[row, 2] = first[2] - last[2]
        out[row, 3] = first[3] - last[3]


@loop
def set_profiles(x: float, blur: AxisBlur, edges: Floats, table: Floats, out: AxisProfiles) -> None:
    """Set the profiles of all boxes along one axis at x; `edges` are those of the units, shape (n, 2)."""
    n = edges.shape[0]
    reach = PROFILE_REACH * blur.spread + 0.5 * blur.motion
    pitch = edges[1, 0] - edges[0, 0]
    first = max(math.floor((x - reach - edges[0, 1]) / pitch) + 1, 0)
    last = min(math.floor((x + reach - edges[0, 0]) / pitch), n - 1)
    out.span[0] = first
    out.span[1] = last
    for i in range(first, last + 1):
        _set_box(x, edges[i, 0], edges[i, 1], blur, table, out.values, i)
    if first <= 1:  # the low marker lies on the units 0 and 1
        _set_box(x, edges[0, 0], edges[1, 1], blur, table, out.values, n)
    else:
        out.values[n, :] = 0.0
    if last >= n - 2:
        _set_box(x, edges[n - 2, 0], edges[n - 1, 1], blur, table, out.values, n + 1)
    else:
        out.values[n + 1, :] = 0.0
    if first <= 0 or last >= n - 1:
        _set_box(x, 0.0, 1.0, blur, table, out.values, n + 2)
    else:  # the plate's edges are out of reach
        out.values[n + 2, 0] = 1.0
        out.values[n + 2, 1:] = 0.0
