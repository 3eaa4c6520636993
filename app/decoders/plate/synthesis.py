"""A plate's pixels as a sum of blurred shapes, and the normal equations of their values and of where they lie.

Shapes are the units, the triangle, its other half, the squares, the gap (four values, bilinear) and the road around
(the same). In plate coordinates the blur of a point is an ellipse: a round lens blur and the averaging of pixels, seen
obliquely, and the motion. Along the plate's axes the profiles of blurred boxes are exact; the part of the ellipse that
is on neither axis is a quadrature along a line.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from scipy.special import ndtr

POSE = 10  # eight of the homography, log of the blur, square of the motion's length
SINGLES = 13  # triangle, its other half, three squares, four of the gap, four of the road
ROAD_WEIGHT = 0.3  # the road around may hold anything
ROAD_SPREAD = 0.1  # of its light; what is further off, a lane line, counts less
UPRIGHT_SINE = 0.35  # of the angle between line of sight and plate columns up to which blur is along the plate's axes
ROUND = 1.69  # ratio of the blur's variances up to which it is round
_REACH = 4.25
_DENSITY = 128
_Z = np.arange(-_REACH, _REACH + 2.5 / _DENSITY, 1 / _DENSITY)
NORMAL_TABLE = np.stack([ndtr(_Z), np.exp(-0.5 * _Z**2) / math.sqrt(2 * math.pi)], axis=1)


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy", inline="always")
def _normal(z, table):  # type: ignore[no-untyped-def]
    """Cumulative and density of the standard normal distribution, from the table."""
    if z >= 4.25:
        return 1.0, 0.0
    if z <= -4.25:
        return 0.0, 0.0
    t = (z + 4.25) * 128.0
    i = int(t)
    f = t - i
    return table[i, 0] + f * (table[i + 1, 0] - table[i, 0]), table[i, 1] + f * (table[i + 1, 1] - table[i, 1])


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _moved_step(x, s, motion, table):  # type: ignore[no-untyped-def]
    """Unit step at 0, blurred by a Gaussian and a box, at x: value and its derivatives by x, s and motion squared."""
    a = (x + 0.5 * motion) / s
    b = (x - 0.5 * motion) / s
    ca, pa = _normal(a, table)
    cb, pb = _normal(b, table)
    value = (a * ca + pa - b * cb - pb) * s / motion
    return value, (ca - cb) / motion, (pa - pb) / motion, (0.5 * (ca + cb) - value) / (2.0 * motion * motion)


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _box(low, high, x, s, motion, wide, table, out, row):  # type: ignore[no-untyped-def]
    """Blurred box at x into a row: value and its derivatives by x, s and motion squared.

    A motion that is short against the blur only widens it, to 1 / `wide`; else that is 0.
    """
    if wide > 0.0:
        a = (x - low) * wide
        b = (x - high) * wide
        ca, pa = _normal(a, table)
        cb, pb = _normal(b, table)
        spread = (b * pb - a * pa) * wide
        out[row, 0] = ca - cb
        out[row, 1] = (pa - pb) * wide
        out[row, 2] = spread * s * wide
        out[row, 3] = spread * wide / 24.0
    else:
        first = _moved_step(x - low, s, motion, table)
        last = _moved_step(x - high, s, motion, table)
        out[row, 0] = first[0] - last[0]
        out[row, 1] = first[1] - last[1]
        out[row, 2] = first[2] - last[2]
        out[row, 3] = first[3] - last[3]


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _profiles(x, s, motion, edges, table, out, span):  # type: ignore[no-untyped-def]
    """Blurred boxes along one axis at x, rows: units 0..n-1, low marker, high marker, plate."""
    n = edges.shape[0]
    reach = 3.0 * s + 0.5 * motion
    pitch = edges[1, 0] - edges[0, 0]
    first = max(math.floor((x - reach - edges[0, 1]) / pitch) + 1, 0)
    last = min(math.floor((x + reach - edges[0, 0]) / pitch), n - 1)
    wide = 1.0 / math.sqrt(s * s + motion * motion / 12.0) if motion < 0.3 * s else 0.0
    span[0] = first
    span[1] = last
    for i in range(first, last + 1):
        _box(edges[i, 0], edges[i, 1], x, s, motion, wide, table, out, i)
    if first <= 1:
        _box(edges[0, 0], edges[1, 1], x, s, motion, wide, table, out, n)
    else:
        out[n, :] = 0.0
    if last >= n - 2:
        _box(edges[n - 2, 0], edges[n - 1, 1], x, s, motion, wide, table, out, n + 1)
    else:
        out[n + 1, :] = 0.0
    if first <= 0 or last >= n - 1:
        _box(0.0, 1.0, x, s, motion, wide, table, out, n + 2)
    else:
        out[n + 2, 0] = 1.0
        out[n + 2, 1:] = 0.0


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy", inline="always")
def _add(value, index, entries, j, amount):  # type: ignore[no-untyped-def]
    """Add to a shape's share of the pixel; returns how many shapes it has."""
    if value[j] == 0.0:
        index[entries] = j
        entries += 1
        value[j] = 1e-300
    value[j] += amount
    return entries


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy", inline="always")
def _bilinear(corner, u, v):  # type: ignore[no-untyped-def]
    """Weight of one of the four values of gap and road."""
    return (u if corner % 2 else 1.0 - u) * (v if corner >= 2 else 1.0 - v)


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _add_units(pu, pv, su, sv, slot, coef, gap, share, value, index, entries, by):  # type: ignore[no-untyped-def]
    """Add the units' shares of a pixel and what moves with them; their sum, and how many shapes the pixel has."""
    total = 0.0
    for r in range(sv[0], sv[1] + 1):
        row = share * pv[r, 0]
        least = 1e-3 * share
        sum0 = 0.0
        sum1 = 0.0
        sum2 = 0.0
        part = 0.0
        for c in range(su[0], su[1] + 1):
            j = slot[r, c]
            b = row * pu[c, 0]
            if j < 0 or b < least:
                continue
            part += pu[c, 0]
            entries = _add(value, index, entries, j, b)
            a = coef[j] - gap
            sum0 += a * pu[c, 0]
            sum1 += a * pu[c, 1]
            sum2 += a * pu[c, 2]
        total += pv[r, 0] * part
        by[0] += pv[r, 0] * sum1
        by[1] += pv[r, 1] * sum0
        by[2] += pv[r, 0] * sum2
        by[3] += pv[r, 2] * sum0
        by[4] += pv[r, 3] * sum0
    return total, entries


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _add_markers(pu, pv, n, diagonal, spread, coef, gap, share, value, index, entries, by, table):  # type: ignore[no-untyped-def]
    """The same for the markers, clockwise from the triangle, whose long side is `diagonal` away."""
    base = coef.shape[0] - SINGLES
    total = 0.0
    for m in range(4):
        c = n + (1 if m == 1 or m == 2 else 0)
        r = n + (1 if m >= 2 else 0)
        b = pv[r, 0] * pu[c, 0]
        if b < 1e-3:
            continue
        total += b
        bu = pv[r, 0] * pu[c, 1]
        bv = pv[r, 1] * pu[c, 0]
        low = 1.0
        slope = 0.0
        if m == 0:
            low, density = _normal(diagonal / spread, table)
            slope = -density / spread
        for half in range(2 if m == 0 else 1):
            j = base + half if m == 0 else base + 1 + m
            f = low if half == 0 else 1.0 - low
            df = slope if half == 0 else -slope
            entries = _add(value, index, entries, j, share * b * f)
            a = coef[j] - gap
            by[0] += a * (bu * f + b * df)
            by[1] += a * (bv * f + b * df)
            by[2] += a * pv[r, 0] * pu[c, 2] * f
            by[3] += a * pv[r, 2] * pu[c, 0] * f
            by[4] += a * pv[r, 3] * pu[c, 0] * f
    return total, entries


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _add_rows(jac, value, index, entries, target, weight, normal, cross, inner, rhs, rhs_pose):  # type: ignore[no-untyped-def]
    """Add a pixel's row to the normal equations; clears its shares."""
    for e in range(entries):
        j = index[e]
        b = weight * value[j]
        rhs[j] += b * target
        for f in range(e + 1):
            i = index[f]
            normal[max(i, j), min(i, j)] += b * value[i]
        for p in range(POSE):
            cross[j, p] += b * jac[p]
    for p in range(POSE):
        b = weight * jac[p]
        rhs_pose[p] += b * target
        for q in range(POSE):
            inner[p, q] += b * jac[q]
    for e in range(entries):
        value[index[e]] = 0.0


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def accumulate(  # type: ignore[no-untyped-def]
    light, weights, grid, box, frame, pose, edges, slot, coef, nodes, node_weights, direction, by_spread, margin, table,
    normal, cross, inner, rhs, rhs_pose, sums, misfit,
):  # fmt: skip
    """Normal equations of shape values and pose from every pixel in a box, shape values taken as `coef`.

    Parameters
    ----------
    light, weights : ndarray of float32, shape (h, w)
        Linear light of each pixel, and what its error counts.
    grid : ndarray, shape (4,)
        Where pixel (0, 0) lies in the frame, x and y, and the distance to the next one, x and y. [px]
    box : ndarray of int, shape (4,)
        First and last pixels to look at: x, y, x, y.
    frame : ndarray, shape (3,)
        Origin and scale of the normalised coordinates that the homography takes. [px]
    nodes, node_weights, direction, by_spread
        Of `blur_nodes`.
    margin : ndarray, shape (2,)
        How far around the plate pixels count, in plate sides.
    normal, cross, inner, rhs, rhs_pose : ndarray
        Are added to: shapes by shapes (lower triangle), shapes by pose, pose by pose, and both right sides.
    sums : ndarray, shape (8,)
        Is set: pixels; pixels inside, their weight, squared residual, light, light squared; all pixels' variance about
        their mean, and their light squared.
    misfit : ndarray, shape (n, n, 2)
        Is set: weight of the pixels on each unit with the half of the gaps around it, and their squared residual.
    """
    n = edges.shape[0]
    shapes = coef.shape[0]
    base = shapes - SINGLES
    pu = np.zeros((n + 3, 4))
    pv = np.zeros((n + 3, 4))
    su = np.zeros(2, np.int64)
    sv = np.zeros(2, np.int64)
    index = np.empty(shapes, np.int64)
    value = np.zeros(shapes)
    jac = np.empty(POSE)
    by = np.empty(5)  # derivatives of the pixel by u, v, blur along u, along v, motion
    diagonal = edges[1, 1] + edges[0, 0]
    lens2 = math.exp(2.0 * pose[8])
    pixel_u = (grid[2] * grid[2] - 1.0) / 12.0
    pixel_v = (grid[3] * grid[3] - 1.0) / 12.0
    many = nodes.shape[0] > 1
    motion = 0.0 if many else math.sqrt(pose[9])
    sums[:] = 0.0
    misfit[:] = 0.0
    pitch = edges[1, 0] - edges[0, 0]
    border = 0.5 * (edges[0, 0] + edges[0, 1] - pitch)  # of the units with their halves of the gaps
    all_w = 0.0
    all_t = 0.0
    for y in range(box[1], box[3]):
        py = (grid[1] + y * grid[3] - frame[1]) / frame[2]
        for x in range(box[0], box[2]):
            px = (grid[0] + x * grid[2] - frame[0]) / frame[2]
            w = pose[6] * px + pose[7] * py + 1.0
            if w <= 0.05:
                continue
            iw = 1.0 / w
            u0 = (pose[0] * px + pose[1] * py + pose[2]) * iw
            v0 = (pose[3] * px + pose[4] * py + pose[5]) * iw
            if u0 < -margin[0] or u0 > 1.0 + margin[0] or v0 < -margin[1] or v0 > 1.0 + margin[1]:
                continue
            k = iw / frame[2]
            ux = (pose[0] - u0 * pose[6]) * k
            uy = (pose[1] - u0 * pose[7]) * k
            vx = (pose[3] - v0 * pose[6]) * k
            vy = (pose[4] - v0 * pose[7]) * k
            a = ux * ux * (lens2 + pixel_u) + uy * uy * (lens2 + pixel_v)
            d = vx * vx * (lens2 + pixel_u) + vy * vy * (lens2 + pixel_v)
            if many:
                b = ux * vx * (lens2 + pixel_u) + uy * vy * (lens2 + pixel_v)
                a = 0.5 * (a + d - math.sqrt((a - d) * (a - d) + 4.0 * b * b))
                d = a
            s_u = math.sqrt(a)
            s_v = math.sqrt(d)
            bu = min(max(u0, 0.0), 1.0)
            bv = min(max(v0, 0.0), 1.0)
            gap_light = 0.0
            road_light = 0.0
            for corner in range(4):
                f = _bilinear(corner, bu, bv)
                gap_light += f * coef[base + 5 + corner]
                road_light += f * coef[base + 9 + corner]
            entries = 0
            gap_share = 0.0
            road_share = 0.0
            du = 0.0
            dv = 0.0
            d_su = 0.0
            d_sv = 0.0
            d_motion = 0.0
            d_nodes = 0.0
            for q in range(nodes.shape[0]):
                share = node_weights[q]
                u = u0 + nodes[q] * direction[0]
                v = v0 + nodes[q] * direction[1]
                _profiles(u, s_u, 0.0, edges, table, pu, su)
                _profiles(v, s_v, motion, edges, table, pv, sv)
                by[:] = 0.0
                units, entries = _add_units(pu, pv, su, sv, slot, coef, gap_light, share, value, index, entries, by)
                marks, entries = _add_markers(
                    pu, pv, n, diagonal - u - v, math.sqrt(a + d + motion * motion / 12.0), coef, gap_light, share,
                    value, index, entries, by, table,
                )  # fmt: skip
                plate = pv[n + 2, 0] * pu[n + 2, 0]
                gap_share += share * (plate - units - marks)
                road_share += share * (1.0 - plate)
                rise = gap_light - road_light
                by_u = by[0] + rise * pv[n + 2, 0] * pu[n + 2, 1]
                by_v = by[1] + rise * pv[n + 2, 1] * pu[n + 2, 0]
                du += share * by_u
                dv += share * by_v
                d_su += share * (by[2] + rise * pv[n + 2, 0] * pu[n + 2, 2])
                d_sv += share * (by[3] + rise * pv[n + 2, 2] * pu[n + 2, 0])
                d_motion += share * (by[4] + rise * pv[n + 2, 3] * pu[n + 2, 0])
                d_nodes += share * nodes[q] * (by_u * direction[0] + by_v * direction[1])
            for corner in range(4):
                f = _bilinear(corner, bu, bv)
                if gap_share > 1e-4:
                    entries = _add(value, index, entries, base + 5 + corner, gap_share * f)
                if road_share > 1e-4:
                    entries = _add(value, index, entries, base + 9 + corner, road_share * f)
            jac[8] = (d_su * (ux * ux + uy * uy) / s_u + d_sv * (vx * vx + vy * vy) / s_v) * lens2
            if many:
                jac[8] = (d_su + d_sv) * s_u * lens2 / (lens2 + 0.5 * (pixel_u + pixel_v)) + d_nodes * by_spread[0]
            jac[9] = d_nodes * by_spread[1] if many else d_motion
            du *= iw
            dv *= iw
            both = -(du * u0 + dv * v0)
            jac[0] = du * px
            jac[1] = du * py
            jac[2] = du
            jac[3] = dv * px
            jac[4] = dv * py
            jac[5] = dv
            jac[6] = both * px
            jac[7] = both * py
            target = np.float64(light[y, x])
            weight = np.float64(weights[y, x])
            sums[0] += 1.0
            if 0.0 <= u0 <= 1.0 and 0.0 <= v0 <= 1.0:
                residual = target
                for e in range(entries):
                    residual -= coef[index[e]] * value[index[e]]
                sums[1] += 1.0
                sums[2] += weight
                sums[3] += weight * residual * residual
                sums[4] += weight * target
                sums[5] += weight * target * target
                row = min(max(int((v0 - border) / pitch), 0), n - 1)
                column = min(max(int((u0 - border) / pitch), 0), n - 1)
                misfit[row, column, 0] += weight
                misfit[row, column, 1] += weight * residual * residual
            else:
                off = (target - road_light) / ROAD_SPREAD
                weight *= ROAD_WEIGHT / (1.0 + off * off)
            all_w += weight
            all_t += weight * target
            sums[7] += weight * target * target
            _add_rows(jac, value, index, entries, target, weight, normal, cross, inner, rhs, rhs_pose)
    sums[6] = sums[7] - all_t * all_t / max(all_w, 1e-300)


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def blur_nodes(pose, frame, grid, most):  # type: ignore[no-untyped-def]
    """Quadrature for a blur that is not along the plate's axes: nodes, weights, direction, derivatives of the spread.

    A round blur in the image is an ellipse in the plate, long along the line of sight; so is the motion's. An upright
    plate has that line along its columns, where the shapes' profiles are exact, and needs no quadrature.
    """
    lens2 = math.exp(2.0 * pose[8])
    wide = math.sqrt(lens2 + (grid[2] * grid[2] - 1.0) / 12.0) / frame[2]
    tall = math.sqrt(lens2 + (grid[3] * grid[3] - 1.0) / 12.0) / frame[2]
    ux = (pose[0] - pose[2] * pose[6]) * wide
    uy = (pose[1] - pose[2] * pose[7]) * tall
    vx = (pose[3] - pose[5] * pose[6]) * wide
    vy = (pose[4] - pose[5] * pose[7]) * tall
    a = ux * ux + uy * uy
    b = ux * vx + uy * vy
    d = vx * vx + vy * vy
    root = math.sqrt(0.25 * (a - d) * (a - d) + b * b)
    long2 = 0.5 * (a + d) + root
    short2 = max(0.5 * (a + d) - root, 1e-18)
    angle = 0.5 * math.atan2(2.0 * b, a - d)
    direction = np.array([math.cos(angle), math.sin(angle)])
    if long2 < ROUND * short2 or (abs(direction[0]) < UPRIGHT_SINE):
        return np.zeros(1), np.ones(1), np.array([0.0, 1.0]), np.zeros(2)
    motion2 = max(pose[9], 0.0004)
    spread2 = long2 - short2 + motion2 / 12.0
    spread = math.sqrt(spread2)
    half = math.ceil(1.2 * spread / math.sqrt(short2))
    half = min(max(half, 1), most)
    nodes = np.empty(2 * half + 1)
    weights = np.empty(2 * half + 1)
    total = 0.0
    for k in range(2 * half + 1):
        nodes[k] = -2.2 + 2.2 * k / half
        weights[k] = math.exp(-0.5 * nodes[k] * nodes[k])
        total += weights[k]
    weights /= total
    second = 0.0
    for k in range(2 * half + 1):
        second += weights[k] * nodes[k] * nodes[k]
    lens_share = 2.0 * lens2 / (frame[2] * frame[2] * (wide * wide + tall * tall))
    by_spread = np.array([lens_share * (1.0 - motion2 / (12.0 * spread2)), 1.0 / (24.0 * spread2)])
    return nodes * (spread / math.sqrt(second)), weights, direction, by_spread
