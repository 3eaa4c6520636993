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

from app.compiled import loop, routine, step
from app.values import Floats, Ints

NORMAL_REACH = 4.25
"""[standard deviations] end of the table of the normal distribution, beyond which 1e-5 of it lies."""
NORMAL_DENSITY = 128
"""[entries per standard deviation] of the table. Source: linear interpolation then errs by at most h^2 / 8 max |f''| =
3e-6."""
_Z = np.arange(-NORMAL_REACH, NORMAL_REACH + 2.5 / NORMAL_DENSITY, 1 / NORMAL_DENSITY)
NORMAL_TABLE = np.stack([[NormalDist().cdf(z) for z in _Z], np.exp(-0.5 * _Z**2) / math.sqrt(2 * math.pi)], axis=1)
"""Cumulative distribution and density of the standard normal distribution, shape (entries, 2)."""
PROFILE_REACH = 3.0
"""[standard deviations] beyond which a unit's share of a point is left out. Source: 0.1 % of the normal distribution
lie beyond it."""
SHORT_MOTION = 0.3
"""[standard deviations] length of the motion below which it is replaced by a Gaussian of its variance, m^2 / 12."""


class AxisProfiles(NamedTuple):
    """Profiles at one point of an axis."""

    # shape (n + 3, 4): rows: the n units, the low marker, the high marker, the whole plate. Columns: value, and its
    # derivatives by the point, by the standard deviation of the blur and by the square of the motion's length.
    values: Floats
    span: Ints  # shape (2,): first and last unit that the blur reaches; the rows of other units are not set


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


# === Quadrature for a blur that lies on neither axis of the plate.
#
# A round blur in the image is an ellipse on the plate, long along the line of sight; so is the motion's. An upright
# plate has that line nearly along its columns, where the profiles of the shapes are exact. What is left there, the
# covariance of the blur along the rows and along the columns, moves the corners of small plates by a tenth of a pixel,
# which matters to a pose and not to the units.


UPRIGHT_SINE = 0.35
"""[1] sine of the angle between the blur's long axis and the plate's columns up to which the blur counts as lying along
them. Source: 20 degrees."""
ROUND_BLUR = 1.69
"""[1] ratio of the blur's variances up to which it counts as round. Source: 1.3 squared."""
NODES_PER_RATIO = 1.2
"""[1] quadrature nodes on each side of the middle per ratio of the blur's axes."""
NODE_REACH = 2.2
"""[standard deviations] of the outermost node."""
MIN_SKEW = 0.02
"""[1] correlation of an upright plate's blur along its rows and columns that is left out. 0.6 degrees on a blur five
times as long as wide."""
MIN_MOTION2 = 0.0004
"""[plate sides^2] square of the motion that the quadrature allows for at least, so that its derivative is not zero."""


class Quadrature(NamedTuple):
    """Nodes along the part of the blur that lies on neither axis of the plate; one node where there is none."""

    # `nodes`, `weights`: shape (K,): places along `direction` [plate sides], and weights that sum to 1
    nodes: Floats
    weights: Floats
    direction: Floats  # shape (2,): unit vector on the plate
    # shape (2,): relative change of the nodes with the logarithm of the lens blur and with the motion's square
    by_spread: Floats
    # the profiles along both axes have the blur of the ellipse's short axis, and the nodes have the motion too
    is_turned: bool
    # share of the blur's variance along u and v that is left to the profiles of a plate that is not turned
    share: float


class _Ellipse(NamedTuple):
    """Blur on the plate: covariance, variances along the long and the short axis [plate sides^2], angle [rad]."""

    uu: float
    uv: float
    vv: float
    long2: float
    short2: float
    angle: float


@step
def _blur_ellipse(pose: Floats, wide: float, tall: float) -> _Ellipse:
    """Blur at the frame's origin from its standard deviations in the image, in normalised coordinates.

    The covariance is J diag(wide^2, tall^2) J^T with the homography's derivative J; its eigenvalues are the variances.
    """
    ux = (pose[0] - pose[2] * pose[6]) * wide
    uy = (pose[1] - pose[2] * pose[7]) * tall
    vx = (pose[3] - pose[5] * pose[6]) * wide
    vy = (pose[4] - pose[5] * pose[7]) * tall
    a = ux * ux + uy * uy
    b = ux * vx + uy * vy
    d = vx * vx + vy * vy
    root = math.sqrt(0.25 * (a - d) * (a - d) + b * b)
    return _Ellipse(a, b, d, 0.5 * (a + d) + root, max(0.5 * (a + d) - root, 1e-18), 0.5 * math.atan2(2.0 * b, a - d))


@step
def _set_nodes(ratio: float, spread2: float, max_nodes: int) -> tuple[Floats, Floats]:
    """Evenly spaced samples of a Gaussian, and their weights; the spacing gives exactly its variance."""
    half = min(max(math.ceil(NODES_PER_RATIO * ratio), 1), max_nodes)
    nodes = np.empty(2 * half + 1)
    weights = np.empty(2 * half + 1)
    total = 0.0
    second = 0.0
    for k in range(2 * half + 1):
        nodes[k] = NODE_REACH * (k - half) / half
        weights[k] = math.exp(-0.5 * nodes[k] * nodes[k])
        total += weights[k]
        second += weights[k] * nodes[k] * nodes[k]
    scale = math.sqrt(spread2 * total / second)
    for k in range(2 * half + 1):
        nodes[k] *= scale
        weights[k] /= total
    return nodes, weights


@step
def _upright_quadrature(blur: _Ellipse, lens_share: float, max_nodes: int) -> Quadrature:
    """Quadrature of the covariance of an upright plate's blur along its rows and columns.

    With the correlation r, the covariance matrix is (1 - |r|) diag(uu, vv) + w w^T, w = sqrt|r| (sqrt uu, +-sqrt vv):
    of all ways to take off one line, this one leaves most to both profiles.
    """
    skew = abs(blur.uv) / math.sqrt(blur.uu * blur.vv)
    along_u = math.sqrt(skew * blur.uu)
    along_v = math.copysign(math.sqrt(skew * blur.vv), blur.uv)
    length2 = along_u * along_u + along_v * along_v
    if skew < MIN_SKEW:
        return Quadrature(np.zeros(1), np.ones(1), np.array([0.0, 1.0]), np.zeros(2), False, 1.0)
    nodes, weights = _set_nodes(math.sqrt(skew / (1.0 - skew)), length2, max_nodes)
    direction = np.array([along_u, along_v]) / math.sqrt(length2)
    return Quadrature(nodes, weights, direction, np.array([lens_share, 0.0]), False, 1.0 - skew)


@routine
def blur_quadrature(pose: Floats, frame: Floats, grid: Floats, max_nodes: int, is_skewed: bool) -> Quadrature:
    """Quadrature of the blur for a pose, with at most `max_nodes` nodes on each side of the middle.

    The nodes of a turned plate have what the ellipse's long axis has beyond the short one, with the motion. An upright
    plate has nodes only if `is_skewed`.
    """
    lens2 = math.exp(2.0 * pose[8])
    wide = math.sqrt(lens2 + (grid[2] * grid[2] - 1.0) / 12.0) / frame[2]
    tall = math.sqrt(lens2 + (grid[3] * grid[3] - 1.0) / 12.0) / frame[2]
    blur = _blur_ellipse(pose, wide, tall)
    direction = np.array([math.cos(blur.angle), math.sin(blur.angle)])
    lens_share = 2.0 * lens2 / (frame[2] * frame[2] * (wide * wide + tall * tall))
    if blur.long2 < ROUND_BLUR * blur.short2 or abs(direction[0]) < UPRIGHT_SINE:
        if is_skewed:
            return _upright_quadrature(blur, lens_share, max_nodes)
        return Quadrature(np.zeros(1), np.ones(1), direction, np.zeros(2), False, 1.0)
    motion2 = max(pose[9], MIN_MOTION2)
    spread2 = blur.long2 - blur.short2 + motion2 / 12.0
    nodes, weights = _set_nodes(math.sqrt(spread2 / blur.short2), spread2, max_nodes)
    by_spread = np.array([lens_share * (1.0 - motion2 / (12.0 * spread2)), 1.0 / (24.0 * spread2)])
    return Quadrature(nodes, weights, direction, by_spread, True, 1.0)
