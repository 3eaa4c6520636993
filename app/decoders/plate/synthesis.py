"""A pixel's light as a sum of blurred shapes, and how it changes with the plate's pose and blur.

The shapes are the units, the triangle, the other half of its cell, the three squares, the gaps (four values, bilinear)
and the road around the plate (the same). A pixel's light is the sum of the shapes' values times their shares of it. In
plate coordinates the blur of a point is an ellipse: a round lens blur and the averaging of pixels, seen obliquely, and
the motion. Along the plate's axes the profiles of blurred boxes are exact; the part of the ellipse that lies on neither
axis is a quadrature along a line.
"""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from app.compiled import kernel, loop, routine, step
from app.values import Floats, Floats32, Ints

# === Profiles of blurred boxes along one axis of the plate: how much of a point's light comes from each unit.
#
# A box from `low` to `high`, blurred by a Gaussian of standard deviation s and by a motion of length m, is the
# difference of two blurred steps. A blurred step is the integral of the normal distribution over the motion:
#
#     step(x) = (s / m) (G((x + m/2) / s) - G((x - m/2) / s)),  G(z) = z CDF(z) + PDF(z)
#
# All lengths are in plate sides.


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


# === A pixel's light, and how it changes with pose and blur.


POSE = 10
"""Unknowns of pose and blur: eight of the homography, logarithm of the lens blur, square of the motion's length."""
BLUR, MOTION = 8, 9
"""Their places in the pose."""
SINGLES = 13
"""Shapes beside the units: triangle, the other half of its cell, three squares, four of the gaps, four of the road."""
FIRST_GAP, FIRST_ROAD = 5, 9
"""Places of the gaps' and the road's four values among these."""
MIN_DEPTH = 0.05
"""[depth of the plate's middle] below which a pixel is not used, clear of the horizon."""
MIN_UNIT_SHARE, MIN_MARKER_SHARE, MIN_FIELD_SHARE = 1e-3, 1e-3, 1e-4
"""[share of a pixel] shapes with less are left out of its equation. Source: less than half of a grey level, 1 / 510."""
_PRESENT = 1e-300  # [1] marks a shape as present before its share is added; almost 0


class PlateModel(NamedTuple):
    """The plate's shapes and their present state; `pose` and `values` change in place."""

    edges: Floats  # shape (n, 2): [plate sides] low and high edge of the units along a side
    unit_shape: Ints  # shape (n, n): number of each unit's shape; -1 in the corner cells
    frame: Floats  # shape (3,): [px] origin and scale of the normalised image coordinates that the homography takes
    # shape (10,): [plate sides^2] eight entries of plate_from_image on normalised coordinates (the ninth is 1),
    # logarithm of the lens blur [px], square of the motion's length
    pose: Floats
    values: Floats  # shape (shapes,): [1] light of each shape: units, then the 13 others
    table: Floats  # shape (entries, 2): `NORMAL_TABLE`


class PlatePatch(NamedTuple):
    """The image around a plate."""

    # `light`, `weights`: float32, shape (h, w): [1] linear light of each pixel, and the weight of its squared error
    light: Floats32
    weights: Floats32
    # shape (4,): [px] place of pixel (0, 0) in the frame, x and y, and the distance to the next one, x and y
    grid: Floats


class LensBlur(NamedTuple):
    """Variance of the lens blur alone, and with the averaging of pixels in x and in y. [px^2]"""

    round: float
    x: float
    y: float


class PixelPlace(NamedTuple):
    """A pixel in normalised coordinates (x, y) and on the plate (u, v); derivatives of u, v by frame pixels. [1/px]"""

    x: float
    y: float
    u: float
    v: float
    inverse_depth: float
    u_x: float
    u_y: float
    v_x: float
    v_y: float


class PixelRow(NamedTuple):
    """One pixel's row of the design matrix, sparse in the shapes."""

    shape: Ints  # shape (shapes,): numbers of the shapes in the pixel, in its first entries
    share: Floats  # shape (shapes,): share of each shape in the pixel; 0 for all that are not in it
    by_pose: Floats  # shape (10,): derivative of the pixel's light by the pose
    # shape (5,): derivatives by u, v, the blur along u, the blur along v and the motion's square, at one node
    by: Floats


@routine
def new_row(shapes: int) -> PixelRow:
    """A row without entries."""
    return PixelRow(np.empty(shapes, np.int64), np.zeros(shapes), np.empty(POSE), np.empty(5))


class Scratch(NamedTuple):
    """Memory that serves one pixel after the other: the row of the pixel, and the profiles along both axes."""

    row: PixelRow
    along_u: AxisProfiles
    along_v: AxisProfiles


@routine
def new_scratch(shapes: int, n: int) -> Scratch:
    """Memory for plates of n x n units."""
    return Scratch(
        new_row(shapes),
        AxisProfiles(np.zeros((n + 3, 4)), np.zeros(2, np.int64)),
        AxisProfiles(np.zeros((n + 3, 4)), np.zeros(2, np.int64)),
    )


class Slopes(NamedTuple):
    """Derivatives of a pixel's light by its place, its blur along both axes, the motion's square and the node scale."""

    u: float
    v: float
    blur_u: float
    blur_v: float
    motion: float
    nodes: float


@step
def lens_blur(pose: Floats, grid: Floats) -> LensBlur:
    """Blur in the patch: the lens, and the averaging of s pixels into one, whose variance grows by (s^2 - 1) / 12."""
    lens = math.exp(2.0 * pose[BLUR])
    return LensBlur(lens, lens + (grid[2] * grid[2] - 1.0) / 12.0, lens + (grid[3] * grid[3] - 1.0) / 12.0)


@step
def place_pixel(pose: Floats, frame: Floats, grid: Floats, column: int, row: int) -> PixelPlace:
    """Apply the homography to a pixel of the patch; the inverse depth is 0 where it is not in front of the camera."""
    x = (grid[0] + column * grid[2] - frame[0]) / frame[2]
    y = (grid[1] + row * grid[3] - frame[1]) / frame[2]
    depth = pose[6] * x + pose[7] * y + 1.0
    inverse = 1.0 / depth if depth > MIN_DEPTH else 0.0
    u = (pose[0] * x + pose[1] * y + pose[2]) * inverse
    v = (pose[3] * x + pose[4] * y + pose[5]) * inverse
    k = inverse / frame[2]
    return PixelPlace(
        x, y, u, v, inverse,
        (pose[0] - u * pose[6]) * k, (pose[1] - u * pose[7]) * k, (pose[3] - v * pose[6]) * k,
        (pose[4] - v * pose[7]) * k,
    )  # fmt: skip


@step
def blur_on_plate(pixel: PixelPlace, lens: LensBlur, quadrature: Quadrature) -> tuple[float, float]:
    """Variances of the blur along u and v that are left to the profiles by the quadrature."""
    a = pixel.u_x * pixel.u_x * lens.x + pixel.u_y * pixel.u_y * lens.y
    d = pixel.v_x * pixel.v_x * lens.x + pixel.v_y * pixel.v_y * lens.y
    if quadrature.is_turned:
        b = pixel.u_x * pixel.v_x * lens.x + pixel.u_y * pixel.v_y * lens.y
        short = 0.5 * (a + d - math.sqrt((a - d) * (a - d) + 4.0 * b * b))
        return short, short
    return quadrature.share * a, quadrature.share * d


@loop
def bilinear(corner: int, u: float, v: float) -> float:
    """Weight of one of the four corner values of the gaps and of the road."""
    return (u if corner % 2 else 1.0 - u) * (v if corner >= 2 else 1.0 - v)


@loop
def _add_share(row: PixelRow, entries: int, shape: int, amount: float) -> int:
    """Add to a shape's share of the pixel; returns the number of shapes in the pixel."""
    if row.share[shape] == 0.0:
        row.shape[entries] = shape
        entries += 1
        row.share[shape] = _PRESENT
    row.share[shape] += amount
    return entries


@step
def _add_units(
    u: AxisProfiles, v: AxisProfiles, model: PlateModel, gap: float, weight: float, row: PixelRow, entries: int
) -> tuple[float, int]:
    """Add the units' shares at one node and their derivatives; returns their sum and the number of shapes."""
    total = 0.0
    for r in range(v.span[0], v.span[1] + 1):
        height = weight * v.values[r, 0]
        min_share = MIN_UNIT_SHARE * weight
        sum0 = 0.0
        sum1 = 0.0
        sum2 = 0.0
        width = 0.0
        for c in range(u.span[0], u.span[1] + 1):
            shape = model.unit_shape[r, c]
            share = height * u.values[c, 0]
            if shape < 0 or share < min_share:
                continue
            width += u.values[c, 0]
            entries = _add_share(row, entries, shape, share)
            contrast = model.values[shape] - gap  # units replace the gaps' light
            sum0 += contrast * u.values[c, 0]
            sum1 += contrast * u.values[c, 1]
            sum2 += contrast * u.values[c, 2]
        total += v.values[r, 0] * width
        row.by[0] += v.values[r, 0] * sum1
        row.by[1] += v.values[r, 1] * sum0
        row.by[2] += v.values[r, 0] * sum2
        row.by[3] += v.values[r, 2] * sum0
        row.by[4] += v.values[r, 3] * sum0
    return total, entries


@step
def _add_markers(
    u: AxisProfiles, v: AxisProfiles, model: PlateModel, distance: float, spread: float, gap: float, weight: float,
    row: PixelRow, entries: int,
) -> tuple[float, int]:  # fmt: skip
    """Add the markers' shares, clockwise from the triangle; returns their sum and the number of shapes.

    The triangle is its cell times a half-plane that ends at its long side, `distance` away [plate sides, times the
    square root of 2] and blurred by `spread`; the rest of the cell is the other half.
    """
    n = model.edges.shape[0]
    base = model.values.shape[0] - SINGLES
    total = 0.0
    for marker in range(4):
        c = n + (1 if marker == 1 or marker == 2 else 0)
        r = n + (1 if marker >= 2 else 0)
        cell = v.values[r, 0] * u.values[c, 0]
        if cell < MIN_MARKER_SHARE:
            continue
        total += cell
        by_u = v.values[r, 0] * u.values[c, 1]
        by_v = v.values[r, 1] * u.values[c, 0]
        low = 1.0
        slope = 0.0
        if marker == 0:
            low, density = normal(distance / spread, model.table)
            slope = -density / spread
        for half in range(2 if marker == 0 else 1):
            shape = base + half if marker == 0 else base + 1 + marker
            f = low if half == 0 else 1.0 - low
            df = slope if half == 0 else -slope
            entries = _add_share(row, entries, shape, weight * cell * f)
            contrast = model.values[shape] - gap
            row.by[0] += contrast * (by_u * f + cell * df)
            row.by[1] += contrast * (by_v * f + cell * df)
            row.by[2] += contrast * v.values[r, 0] * u.values[c, 2] * f
            row.by[3] += contrast * v.values[r, 2] * u.values[c, 0] * f
            row.by[4] += contrast * v.values[r, 3] * u.values[c, 0] * f
    return total, entries


@step
def _add_fields(model: PlateModel, u: float, v: float, gap: float, road: float, row: PixelRow, entries: int) -> int:
    """Add the shares of the gaps' and the road's corner values; returns the number of shapes."""
    base = model.values.shape[0] - SINGLES
    for corner in range(4):
        f = bilinear(corner, u, v)
        if gap > MIN_FIELD_SHARE:
            entries = _add_share(row, entries, base + FIRST_GAP + corner, gap * f)
        if road > MIN_FIELD_SHARE:
            entries = _add_share(row, entries, base + FIRST_ROAD + corner, road * f)
    return entries


@step
def field_light(model: PlateModel, first: int, u: float, v: float) -> float:
    """Light of the gaps or of the road at a point, from their four corner values."""
    light = 0.0
    base = model.values.shape[0] - SINGLES + first
    for corner in range(4):
        light += bilinear(corner, u, v) * model.values[base + corner]
    return light


@step
def synthesize(
    pixel: PixelPlace, variance_u: float, variance_v: float, model: PlateModel, quadrature: Quadrature,
    gap_light: float, road_light: float, row: PixelRow, along_u: AxisProfiles, along_v: AxisProfiles,
) -> tuple[int, Slopes]:  # fmt: skip
    """Set a pixel's shares of all shapes; returns the number of shapes in it and the derivatives of its light.

    The pixel is a mean over the quadrature's nodes; at each node the shares are products of the profiles along u and v.
    """
    n = model.edges.shape[0]
    motion = 0.0 if quadrature.is_turned else math.sqrt(model.pose[MOTION])
    blur_u = AxisBlur(math.sqrt(variance_u), 0.0)
    blur_v = AxisBlur(math.sqrt(variance_v), motion)
    diagonal_spread = math.sqrt(variance_u + variance_v + motion * motion / 12.0)
    diagonal = model.edges[1, 1] + model.edges[0, 0]  # u + v on the triangle's long side
    rise = gap_light - road_light
    entries = 0
    gap_share = 0.0
    road_share = 0.0
    slopes = Slopes(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for q in range(quadrature.nodes.shape[0]):
        weight = quadrature.weights[q]
        u = pixel.u + quadrature.nodes[q] * quadrature.direction[0]
        v = pixel.v + quadrature.nodes[q] * quadrature.direction[1]
        set_profiles(u, blur_u, model.edges, model.table, along_u)
        set_profiles(v, blur_v, model.edges, model.table, along_v)
        row.by[:] = 0.0
        units, entries = _add_units(along_u, along_v, model, gap_light, weight, row, entries)
        markers, entries = _add_markers(
            along_u, along_v, model, diagonal - u - v, diagonal_spread, gap_light, weight, row, entries
        )
        # the gaps fill what the plate has left, the road what is outside
        pu = along_u.values
        pv = along_v.values
        plate = pv[n + 2, 0] * pu[n + 2, 0]
        gap_share += weight * (plate - units - markers)
        road_share += weight * (1.0 - plate)
        by_u = row.by[0] + rise * pv[n + 2, 0] * pu[n + 2, 1]
        by_v = row.by[1] + rise * pv[n + 2, 1] * pu[n + 2, 0]
        slopes = Slopes(
            slopes.u + weight * by_u,
            slopes.v + weight * by_v,
            slopes.blur_u + weight * (row.by[2] + rise * pv[n + 2, 0] * pu[n + 2, 2]),
            slopes.blur_v + weight * (row.by[3] + rise * pv[n + 2, 2] * pu[n + 2, 0]),
            slopes.motion + weight * (row.by[4] + rise * pv[n + 2, 3] * pu[n + 2, 0]),
            slopes.nodes
            + weight * quadrature.nodes[q] * (by_u * quadrature.direction[0] + by_v * quadrature.direction[1]),
        )
    u = min(max(pixel.u, 0.0), 1.0)
    v = min(max(pixel.v, 0.0), 1.0)
    return _add_fields(model, u, v, gap_share, road_share, row, entries), slopes


@step
def set_pose_derivatives(
    pixel: PixelPlace, variance_u: float, variance_v: float, lens: LensBlur, slopes: Slopes, quadrature: Quadrature,
    by_pose: Floats,
) -> None:  # fmt: skip
    """Set the derivatives of a pixel's light by the pose: the chain rule from plate coordinates and blur.

    With u = (h0 x + h1 y + h2) / d and d = h6 x + h7 y + 1: du / dh0 = x / d, du / dh6 = -u x / d, and so on.
    """
    by_u = slopes.u * pixel.inverse_depth
    by_v = slopes.v * pixel.inverse_depth
    by_depth = -(by_u * pixel.u + by_v * pixel.v)
    by_pose[0] = by_u * pixel.x
    by_pose[1] = by_u * pixel.y
    by_pose[2] = by_u
    by_pose[3] = by_v * pixel.x
    by_pose[4] = by_v * pixel.y
    by_pose[5] = by_v
    by_pose[6] = by_depth * pixel.x
    by_pose[7] = by_depth * pixel.y
    if quadrature.is_turned:
        averaged = 0.5 * (lens.x + lens.y)
        by_round = (slopes.blur_u + slopes.blur_v) * math.sqrt(variance_u) * lens.round / averaged
        by_pose[BLUR] = by_round + slopes.nodes * quadrature.by_spread[0]
        by_pose[MOTION] = slopes.nodes * quadrature.by_spread[1]
    else:
        u2 = pixel.u_x * pixel.u_x + pixel.u_y * pixel.u_y
        v2 = pixel.v_x * pixel.v_x + pixel.v_y * pixel.v_y
        by_axes = slopes.blur_u * u2 / math.sqrt(variance_u) + slopes.blur_v * v2 / math.sqrt(variance_v)
        by_pose[BLUR] = by_axes * lens.round * quadrature.share + slopes.nodes * quadrature.by_spread[0]
        by_pose[MOTION] = slopes.motion


# === The shares that the shapes of a fitted plate have in each pixel around it.


@kernel
def set_pixel_shares(patch: PlatePatch, model: PlateModel, max_nodes: int, shares: Floats, places: Floats) -> None:
    """Set the shares of all shapes and the place on the plate of every pixel of a patch.

    Parameters
    ----------
    max_nodes : int
        Quadrature nodes on each side of the middle at most.
    shares : ndarray, shape (h, w, shapes)
        Set to what each shape has in each pixel; 0 where the pixel is not in front of the camera.
    places : ndarray, shape (h, w, 2)
        Set to the pixel's place. [plate sides]
    """
    quadrature = blur_quadrature(model.pose, model.frame, patch.grid, max_nodes, False)
    scratch = new_scratch(model.values.shape[0], model.edges.shape[0])
    _set_all(patch, model, quadrature, scratch, shares, places)


@loop
def _set_all(
    patch: PlatePatch, model: PlateModel, quadrature: Quadrature, scratch: Scratch, shares: Floats, places: Floats
) -> None:
    """Set the shares and the places of all pixels."""
    row, along_u, along_v = scratch
    lens = lens_blur(model.pose, patch.grid)
    for y in range(patch.light.shape[0]):
        for x in range(patch.light.shape[1]):
            pixel = place_pixel(model.pose, model.frame, patch.grid, x, y)
            for k in range(shares.shape[2]):
                shares[y, x, k] = 0.0
            places[y, x, 0] = pixel.u
            places[y, x, 1] = pixel.v
            if pixel.inverse_depth <= 0.0 or not (-0.2 < pixel.u < 1.2 and -0.2 < pixel.v < 1.2):
                continue
            variance_u, variance_v = blur_on_plate(pixel, lens, quadrature)
            entries, _slopes = synthesize(
                pixel, variance_u, variance_v, model, quadrature, 0.0, 0.0, row, along_u, along_v
            )
            for e in range(entries):
                shares[y, x, row.shape[e]] = row.share[row.shape[e]]
                row.share[row.shape[e]] = 0.0


@kernel
def gather_shares(
    shares: Floats, order: Ints, min_share: float, max_road: float, used: Ints, units: Floats, rest: Floats
) -> int:
    """Gather the shares in the pixels on a plate; returns their number.

    Parameters
    ----------
    shares : ndarray, shape (pixels, shapes)
        Of `set_pixel_shares`.
    order : ndarray of int, shape (units,)
        Shapes of the units that are wanted.
    min_share, max_road : float
        Share of all shapes in a pixel from which on, and of the road up to which it is on the plate.
    used : ndarray of int, shape (pixels,)
        Set to the numbers of these pixels.
    units : ndarray, shape (pixels, units)
        Set to the shares of the units in them.
    rest : ndarray, shape (pixels, 1 + FIRST_GAP)
        Set to those of the gaps with what the pixel has of the road, and of the markers' parts.
    """
    shapes = shares.shape[1]
    base = shapes - SINGLES
    count = 0
    for p in range(shares.shape[0]):
        total = 0.0
        for k in range(shapes):
            total += shares[p, k]
        road = 0.0
        for k in range(base + FIRST_ROAD, shapes):
            road += shares[p, k]
        if total <= min_share or road >= max_road:
            continue
        used[count] = p
        rest[count, 0] = road
        for k in range(FIRST_GAP, FIRST_ROAD):
            rest[count, 0] += shares[p, base + k]
        for k in range(FIRST_GAP):
            rest[count, 1 + k] = shares[p, base + k]
        for k in range(order.size):
            units[count, k] = shares[p, order[k]]
        count += 1
    return count
