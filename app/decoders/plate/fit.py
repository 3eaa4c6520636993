"""Analysis by synthesis: the homography, the blur and the value of every unit that best explain a plate's pixels.

The plate is a sum of blurred shapes (units, markers, gaps, the road around), each with a free value: linear. Where they
lie and how they are blurred is not: plate_from_image (8 parameters), the lens blur and the length of the motion blur.
Gauss-Newton runs on both at once; every pixel touches only the few shapes near it, so the normal equations are cheap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numba as nb
import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from app.decoders.plate.linear import factorize, invert, solve_factorized
from app.markers.plate import PlateGeometry

Array = npt.NDArray[Any]

GAMMA = 2.2
POSE = 10  # eight of the homography, log of the blur, length of the motion
_EXTRA = 13  # triangle, its other half, three squares, four of the gap, four of the road
BLUR_PRIOR = (math.log(0.7), 0.35)  # log of the lens blur [px], and its spread
MOTION_PRIOR = (0.03, 0.06)  # length of the motion blur [plate sides], and its spread
UPRIGHT_SINE = 0.35  # of the angle between line of sight and plate columns up to which blur is along the plate's axes
HOPELESS = (0.3, 0.45)  # share of the pixels' variance that one and two steps explain on anything that is a plate
MAX_STEPS = 7
CORNER_SCATTER = 3.0  # of the corners against what even, independent noise would give: JPEG, optics, worn edges
FIRST_BLUR = 0.2  # units
LARGE_UNIT_PX = 5.0  # a unit of twice this size is averaged down
LOST_PX = 2.5  # a plate's corners move less after four steps
REST_PX, NEAR_PX = 0.08, 0.4  # the corners rest, or are near rest, when they move less in one step
COARSE_PIXELS, FINE_PIXELS = 3.5, 7.0  # pixels looked at for each unknown, where the image has more
_LEVELS = np.linspace(0.0, 1.0, 256)
LINEAR_LIGHT = _LEVELS**GAMMA
_LIGHT = LINEAR_LIGHT.astype(np.float32)
_SLOPE = GAMMA * np.maximum(_LEVELS, 0.18) ** (GAMMA - 1)
WEIGHT = 1.0 / _SLOPE**2  # noise is about even on the camera's output scale


@dataclass(slots=True)
class PlateFit:
    """What explains a plate's pixels.

    Attributes
    ----------
    plate_from_image : ndarray, shape (3, 3)
        Pixels to plate coordinates: (0, 0) at the triangle's corner, (1, 1) opposite.
    units : ndarray, shape (n, n)
        Light that each unit sends, linear, corners NaN. [1]
    units_covariance : ndarray, shape (cells * 4, cells * 4)
        Of the units in the order of `unit_order`, everything else free.
    unit_order : ndarray of int
        Flat indices into the grid.
    markers : ndarray, shape (5,)
        Triangle, its other half, squares clockwise. [1]
    gap, road : float
        Mean light of the gaps and of the road around. [1]
    corners_px : ndarray, shape (4, 2)
    corners_covariance_px2 : ndarray, shape (8, 8)
    residual : float
        Root mean square residual on the camera's scale. [1]
    explained : float
        Share of the pixels' variance that the model explains, at most 1.
    blur_px, motion : float
        Standard deviation of the lens blur [px], length of the motion [plate sides].
    pixels : int
        How many pixels spoke.
    """

    plate_from_image: Array
    units: Array
    units_covariance: Array
    unit_order: npt.NDArray[np.intp]
    markers: Array
    gap: float
    road: float
    corners_px: Array
    corners_covariance_px2: Array
    residual: float
    explained: float
    blur_px: float
    motion: float
    pixels: int

    @property
    def unit_px(self) -> float:
        """Size of a unit in the image across its shorter direction. [px]"""
        right = (self.corners_px[1] + self.corners_px[2] - self.corners_px[0] - self.corners_px[3]) / 2
        down = (self.corners_px[2] + self.corners_px[3] - self.corners_px[0] - self.corners_px[1]) / 2
        shorter = np.linalg.svd(np.stack([right, down]), compute_uv=False)[1]
        return float(shorter) / len(self.units)


@lru_cache
def unit_edges(geometry: PlateGeometry) -> Array:
    """Low and high edge of every unit along a side, in plate sides, shape (n, 2)."""
    low = (geometry.gap_mm + np.arange(geometry.n) * geometry.pitch_mm) / geometry.side_mm
    return np.stack([low, low + geometry.unit_mm / geometry.side_mm], axis=1)


@lru_cache
def marker_centroids(geometry: PlateGeometry) -> Array:
    """Centroids of the triangle and the three squares, clockwise, in plate sides, shape (4, 2)."""
    edges = unit_edges(geometry)
    low, side = edges[0, 0], edges[1, 1] - edges[0, 0]
    near, far = low + side / 2, 1 - low - side / 2
    tip = low + side / 3
    return np.array([(tip, tip), (far, near), (far, far), (near, far)])


_TABLE_REACH = 4.25
_TABLE_DENSITY = 128
_Z = np.arange(-_TABLE_REACH, _TABLE_REACH + 2.5 / _TABLE_DENSITY, 1 / _TABLE_DENSITY)
NORMAL_TABLE = np.stack([ndtr(_Z), np.exp(-0.5 * _Z**2) / math.sqrt(2 * math.pi)], axis=1)


@lru_cache
def unit_centres(geometry: PlateGeometry) -> Array:
    """Centres of the units that carry the code, in plate sides, shape (units, 2)."""
    middle = unit_edges(geometry).mean(axis=1)
    rows, columns = np.nonzero(_slots(geometry.n) >= 0)
    return np.stack([middle[columns], middle[rows]], axis=1)


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
def _step(x, s, motion, table):  # type: ignore[no-untyped-def]
    """Unit step at 0, blurred by a Gaussian and a box, at x: value and its derivatives by x, s and motion."""
    reach = 4.0 * s + 0.5 * motion
    if x > reach:
        return 1.0, 0.0, 0.0, 0.0
    if x < -reach:
        return 0.0, 0.0, 0.0, 0.0
    if motion < 0.3 * s:  # a short motion only widens the blur
        wide = s if motion == 0.0 else math.sqrt(s * s + motion * motion / 12.0)
        z = x / wide
        c, p = _normal(z, table)
        slope = p / wide
        return c, slope, -z * slope * s / wide, -z * slope * motion / (12.0 * wide)
    a = (x + 0.5 * motion) / s
    b = (x - 0.5 * motion) / s
    ca, pa = _normal(a, table)
    cb, pb = _normal(b, table)
    value = (a * ca + pa - b * cb - pb) * s / motion
    return value, (ca - cb) / motion, (pa - pb) / motion, (0.5 * (ca + cb) - value) / motion


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _box(low, high, x, s, motion, table, out):  # type: ignore[no-untyped-def]
    """Blurred box at x: value and derivatives as `_step`."""
    a = _step(x - low, s, motion, table)
    b = _step(x - high, s, motion, table)
    out[0] = a[0] - b[0]
    out[1] = a[1] - b[1]
    out[2] = a[2] - b[2]
    out[3] = a[3] - b[3]


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _profiles(x, s, motion, edges, table, out, span):  # type: ignore[no-untyped-def]
    """Blurred boxes along one axis at x, rows: units 0..n-1, low marker, high marker, plate."""
    n = edges.shape[0]
    reach = 3.5 * s + 0.5 * motion
    pitch = edges[1, 0] - edges[0, 0]
    first = max(math.floor((x - reach - edges[0, 1]) / pitch) + 1, 0)
    last = min(math.floor((x + reach - edges[0, 0]) / pitch), n - 1)
    span[0] = first
    span[1] = last
    for i in range(first, last + 1):
        _box(edges[i, 0], edges[i, 1], x, s, motion, table, out[i])
    if first <= 1:
        _box(edges[0, 0], edges[1, 1], x, s, motion, table, out[n])
    else:
        out[n, :] = 0.0
    if last >= n - 2:
        _box(edges[n - 2, 0], edges[n - 1, 1], x, s, motion, table, out[n + 1])
    else:
        out[n + 1, :] = 0.0
    if first <= 0 or last >= n - 1:
        _box(0.0, 1.0, x, s, motion, table, out[n + 2])
    else:
        out[n + 2, 0] = 1.0
        out[n + 2, 1:] = 0.0


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _accumulate(  # type: ignore[no-untyped-def]
    image, table, weight_table, normal_table, box, stride, frame, pose, edges, slot, coef,
    nodes, node_weights, direction, by_spread, margin,
    normal, cross, inner, rhs, rhs_pose,
):  # fmt: skip
    """Add every pixel's row to the normal equations of (shape values, pose); returns sums for the residual.

    frame: origin x, y and scale of the normalised pixel coordinates. slot: column of each unit, -1 in the corners.
    nodes, node_weights, direction: quadrature along a line in the plate for blurs that are not along its axes.
    """
    n = edges.shape[0]
    shapes = coef.shape[0]
    base = shapes - 13
    pu = np.zeros((n + 3, 4))
    pv = np.zeros((n + 3, 4))
    su = np.zeros(2, np.int64)
    sv = np.zeros(2, np.int64)
    index = np.empty(160, np.int64)
    value = np.zeros(shapes)
    jac = np.empty(10)
    sum_w = 0.0
    sum_r = 0.0
    sum_t = 0.0
    sum_tt = 0.0
    count = 0
    inside = 0
    low = edges[0, 0]
    leg = edges[1, 1] - low
    sigma = math.exp(pose[8])
    motion = pose[9]
    many = nodes.shape[0] > 1
    for y in range(box[1], box[3], stride[1]):
        py = (y - frame[1]) / frame[2]
        for x in range(box[0], box[2], stride[0]):
            px = (x - frame[0]) / frame[2]
            w = pose[6] * px + pose[7] * py + 1.0
            if w <= 0.05:
                continue
            iw = 1.0 / w
            u0 = (pose[0] * px + pose[1] * py + pose[2]) * iw
            v0 = (pose[3] * px + pose[4] * py + pose[5]) * iw
            if u0 < -margin[0] or u0 > 1.0 + margin[0] or v0 < -margin[1] or v0 > 1.0 + margin[1]:
                continue
            k = 1.0 / frame[2]
            ux = (pose[0] - u0 * pose[6]) * iw * k
            uy = (pose[1] - u0 * pose[7]) * iw * k
            vx = (pose[3] - v0 * pose[6]) * iw * k
            vy = (pose[4] - v0 * pose[7]) * iw * k
            if many:
                s = sigma * blur_minor(ux, uy, vx, vy)
                s_u = s
                s_v = s
            else:
                s_u = sigma * math.sqrt(ux * ux + uy * uy)
                s_v = sigma * math.sqrt(vx * vx + vy * vy)
            entries = 0
            iu = 0.0
            iv = 0.0
            isu = 0.0
            isv = 0.0
            im = 0.0
            inode = 0.0
            bilinear_u = min(max(u0, 0.0), 1.0)
            bilinear_v = min(max(v0, 0.0), 1.0)
            a_gap = 0.0
            a_road = 0.0
            for corner in range(4):
                f = (bilinear_u if corner % 2 else 1.0 - bilinear_u) * (bilinear_v if corner >= 2 else 1.0 - bilinear_v)
                a_gap += f * coef[base + 5 + corner]
                a_road += f * coef[base + 9 + corner]
            for q in range(nodes.shape[0]):
                wq = node_weights[q]
                u = u0 + nodes[q] * direction[0]
                v = v0 + nodes[q] * direction[1]
                _profiles(u, s_u, 0.0, edges, normal_table, pu, su)
                _profiles(v, s_v, 0.0 if many else motion, edges, normal_table, pv, sv)
                gu = 0.0
                gv = 0.0
                units = 0.0
                for r in range(sv[0], sv[1] + 1):
                    for c in range(su[0], su[1] + 1):
                        j = slot[r, c]
                        if j < 0:
                            continue
                        b = pv[r, 0] * pu[c, 0]
                        if b < 1e-5:
                            continue
                        units += b
                        if value[j] == 0.0:
                            index[entries] = j
                            entries += 1
                            value[j] = 1e-300
                        value[j] += wq * b
                        a = coef[j] - a_gap
                        gu += a * pv[r, 0] * pu[c, 1]
                        gv += a * pv[r, 1] * pu[c, 0]
                        isu += wq * a * pv[r, 0] * pu[c, 2]
                        isv += wq * a * pv[r, 2] * pu[c, 0]
                        im += wq * a * pv[r, 3] * pu[c, 0]
                # markers: 0 top-left, 1 top-right, 2 bottom-right, 3 bottom-left
                marks = 0.0
                for m in range(4):
                    mu = n + (1 if (m == 1 or m == 2) else 0)
                    mv = n + (1 if m >= 2 else 0)
                    b = pv[mv, 0] * pu[mu, 0]
                    if b < 1e-6:
                        continue
                    bu = pv[mv, 0] * pu[mu, 1]
                    bv = pv[mv, 1] * pu[mu, 0]
                    marks += b
                    if m == 0:
                        sd = math.sqrt(s_u * s_u + s_v * s_v + (0.0 if many else motion * motion / 12.0))
                        z = (leg + 2.0 * low - u - v) / sd
                        t, dt = _normal(z, normal_table)
                        dt = -dt / sd
                        for half in range(2):
                            j = base + half
                            f = t if half == 0 else 1.0 - t
                            df = dt if half == 0 else -dt
                            if value[j] == 0.0:
                                index[entries] = j
                                entries += 1
                                value[j] = 1e-300
                            value[j] += wq * b * f
                            a = coef[j] - a_gap
                            gu += a * (bu * f + b * df)
                            gv += a * (bv * f + b * df)
                            isu += wq * a * pv[mv, 0] * pu[mu, 2] * f
                            isv += wq * a * pv[mv, 2] * pu[mu, 0] * f
                            im += wq * a * pv[mv, 3] * pu[mu, 0] * f
                    else:
                        j = base + 1 + m
                        if value[j] == 0.0:
                            index[entries] = j
                            entries += 1
                            value[j] = 1e-300
                        value[j] += wq * b
                        a = coef[j] - a_gap
                        gu += a * bu
                        gv += a * bv
                        isu += wq * a * pv[mv, 0] * pu[mu, 2]
                        isv += wq * a * pv[mv, 2] * pu[mu, 0]
                        im += wq * a * pv[mv, 3] * pu[mu, 0]
                plate = pv[n + 2, 0] * pu[n + 2, 0]
                plate_u = pv[n + 2, 0] * pu[n + 2, 1]
                plate_v = pv[n + 2, 1] * pu[n + 2, 0]
                gap = plate - units - marks
                road = 1.0 - plate
                for corner in range(4):
                    f = (bilinear_u if corner % 2 else 1.0 - bilinear_u) * (
                        bilinear_v if corner >= 2 else 1.0 - bilinear_v
                    )
                    if gap > 1e-4:
                        j = base + 5 + corner
                        if value[j] == 0.0:
                            index[entries] = j
                            entries += 1
                            value[j] = 1e-300
                        value[j] += wq * gap * f
                    if road > 1e-4:
                        j = base + 9 + corner
                        if value[j] == 0.0:
                            index[entries] = j
                            entries += 1
                            value[j] = 1e-300
                        value[j] += wq * road * f
                a = a_gap - a_road
                gu += a * plate_u
                gv += a * plate_v
                isu += wq * a * pv[n + 2, 0] * pu[n + 2, 2]
                isv += wq * a * pv[n + 2, 2] * pu[n + 2, 0]
                im += wq * a * pv[n + 2, 3] * pu[n + 2, 0]
                iu += wq * gu
                iv += wq * gv
                inode += wq * nodes[q] * (gu * direction[0] + gv * direction[1])
            du = iu * iw
            dv = iv * iw
            jac[0] = du * px
            jac[1] = du * py
            jac[2] = du
            jac[3] = dv * px
            jac[4] = dv * py
            jac[5] = dv
            both = -(du * u0 + dv * v0)
            jac[6] = both * px
            jac[7] = both * py
            jac[8] = isu * s_u + isv * s_v + inode * by_spread[0]
            jac[9] = inode * by_spread[1] if many else im
            level = image[y, x]
            target = table[level]
            wt = weight_table[level]
            model = 0.0
            for e in range(entries):
                j = index[e]
                model += coef[j] * value[j]
            res = target - model
            count += 1
            if 0.0 <= u0 <= 1.0 and 0.0 <= v0 <= 1.0:
                inside += 1
                sum_r += wt * res * res
                sum_w += wt
                sum_t += wt * target
                sum_tt += wt * target * target
            else:  # the road around may hold anything
                wt *= 0.3
            for e in range(entries):
                j = index[e]
                b = wt * value[j]
                rhs[j] += b * target
                for f2 in range(e + 1):
                    i = index[f2]
                    normal[max(i, j), min(i, j)] += b * value[i]
                for p in range(10):
                    cross[j, p] += b * jac[p]
            for p in range(10):
                b = wt * jac[p]
                rhs_pose[p] += b * target
                for p2 in range(10):
                    inner[p, p2] += b * jac[p2]
            for e in range(entries):
                value[index[e]] = 0.0
    flat = sum_tt - sum_t * sum_t / max(sum_w, 1e-300)
    return sum_r / max(inside, 1), flat / max(inside, 1), count


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def blur_minor(ux, uy, vx, vy):  # type: ignore[no-untyped-def]
    """Smaller singular value of the Jacobian plate from image."""
    t = ux * ux + uy * uy + vx * vx + vy * vy
    d = ux * vy - uy * vx
    return math.sqrt(max(0.5 * (t - math.sqrt(max(t * t - 4.0 * d * d, 0.0))), 1e-18))


def fit_plate(
    image: npt.NDArray[Any], centroids_px: Array, geometry: PlateGeometry, *, linear: bool = False
) -> PlateFit | None:
    """Fit a plate whose marker centroids are roughly known.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3) or (H, W)
        Blue, green, red, of which the luma counts; or grey levels.
    centroids_px : ndarray, shape (4, 2)
        Triangle and squares, clockwise. [px]
    geometry : PlateGeometry
    linear : bool
        The levels are proportional to what is seen, as a thermal camera's; else they are gamma encoded.

    Returns
    -------
    PlateFit or None
        None when the steps leave the image, the plate degenerates, or it explains too little of what is there.
    """
    luma, origin_px, scale = _patch(image, centroids_px, geometry.n)
    if min(luma.shape) < 4:
        return None
    points = (centroids_px - origin_px) / scale
    centre = points.mean(axis=0)
    frame = np.array([centre[0], centre[1], max(float(np.ptp(points, axis=0).max()), 4.0)])
    edges, slot = unit_edges(geometry), _slots(geometry.n)
    levels, weights = (_LEVELS, np.ones(256)) if linear else (LINEAR_LIGHT, WEIGHT)
    try:
        start = _homography((points - centre) / frame[2], marker_centroids(geometry))
        pose = np.concatenate([start, [math.log(_first_blur(points, geometry.n)), MOTION_PRIOR[0]]])
        coef = _sample_shapes(luma, levels, pose, frame, edges, slot)
        normal = np.empty((len(coef) + POSE, len(coef) + POSE))
        ok, variance, explained, pixels = _gauss_newton(
            luma, levels, weights, NORMAL_TABLE, frame, pose, edges, slot, coef, normal
        )
        if not ok:
            return None
    except np.linalg.LinAlgError:
        return None
    covariance = invert(normal) * variance
    if not covariance.size:
        return None
    frame[:2] = frame[:2] * scale + origin_px
    frame[2] *= scale
    pose[8] += math.log(scale)
    return _result(frame, pose, slot, coef, covariance, math.sqrt(variance), explained, pixels)


def _first_blur(points_px: Array, n: int) -> float:
    """Blur to begin with: wide enough that an edge is felt from half a unit away. [px]"""
    right, down = points_px[1] - points_px[0], points_px[3] - points_px[0]
    unit = math.sqrt(max(abs(float(right[0] * down[1] - right[1] * down[0])), 1.0)) / (0.75 * n)
    return float(np.clip(FIRST_BLUR * unit, 0.7, 2.5))


def _patch(image: npt.NDArray[Any], centroids_px: Array, n: int) -> tuple[npt.NDArray[Any], Array, int]:
    """Luma around a plate, where in the image its pixel (0, 0) lies [px], and how many pixels a side make one of it.

    A large plate is averaged down: its edges are sharp against the distance between the pixels that are looked at.
    """
    low, high = centroids_px.min(axis=0), centroids_px.max(axis=0)
    scale = max(int((high - low).min() / (0.75 * n * LARGE_UNIT_PX)), 1)
    pad = 0.8 * (high - low) + 12
    x0, y0 = (int(v) for v in np.maximum(low - pad, 0))
    x1, y1 = (int(v) for v in np.minimum(high + pad, [image.shape[1], image.shape[0]]))
    wide, tall = max(x1 - x0, 0) // scale, max(y1 - y0, 0) // scale
    patch = image[y0 : y0 + tall * scale, x0 : x0 + wide * scale]
    if min(wide, tall) < 4:
        return np.empty((0, 0), np.uint8), np.zeros(2), 1
    luma = cv2.cvtColor(patch, cv2.COLOR_BGR2GRAY) if patch.ndim == 3 else np.ascontiguousarray(patch)
    if scale > 1:
        light = cv2.resize(cv2.LUT(luma, _LIGHT), (wide, tall), interpolation=cv2.INTER_AREA)
        light = cv2.GaussianBlur(light, (5, 5), 0.8)
        luma = np.rint(255 * light ** (1 / GAMMA)).astype(np.uint8)
    return luma, np.array([x0, y0]) + (scale - 1) / 2, scale


def _homography(source: Array, target: Array) -> Array:
    """First eight entries of the homography that takes four points to four others, the ninth is 1."""
    rows, rhs = [], []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
        rhs += [u, v]
    solution: Array = np.linalg.solve(np.array(rows), np.array(rhs))
    return solution


@lru_cache
def _slots(n: int) -> npt.NDArray[np.int64]:
    """Column of every unit in the normal equations, row by row; -1 in the corner cells, shape (n, n)."""
    corner = np.zeros((n, n), dtype=bool)
    corner[np.ix_([0, 1, n - 2, n - 1], [0, 1, n - 2, n - 1])] = True
    slot = np.full((n, n), -1, dtype=np.int64)
    slot[~corner] = np.arange(n * n - 16)
    return slot


def _matrix(pose: Array, frame: Array) -> Array:
    """plate_from_image for pixels, shape (3, 3)."""
    normalise = np.array([[1 / frame[2], 0, -frame[0] / frame[2]], [0, 1 / frame[2], -frame[1] / frame[2]], [0, 0, 1]])
    matrix: Array = np.append(pose[:8], 1.0).reshape(3, 3) @ normalise
    return matrix


def _project(matrix: Array, points: Array) -> Array:
    """Homography applied to points, shape (N, 2)."""
    w = points @ matrix[2, :2] + matrix[2, 2]
    projected: Array = (points @ matrix[:2, :2].T + matrix[:2, 2]) / w[:, None]
    return projected


def _sample_shapes(
    luma: npt.NDArray[Any], levels: Array, pose: Array, frame: Array, edges: Array, slot: npt.NDArray[np.int64]
) -> Array:
    """First values of all shapes: the pixels at their middles."""
    n = len(edges)
    middle = edges.mean(axis=1)
    rows, columns = np.nonzero(slot >= 0)
    a, b = (edges[0, 0] + edges[1, 1]) / 2, (edges[n - 2, 0] + edges[n - 1, 1]) / 2
    t, f = 0.66 * edges[0, 0] + 0.34 * edges[1, 1], 0.2 * edges[0, 0] + 0.8 * edges[1, 1]
    g = 0.5 * (edges[n // 2 - 1, 1] + edges[n // 2, 0])
    plate = np.concatenate(
        [
            np.stack([middle[columns], middle[rows]], axis=1),
            [(t, t), (f, f), (b, a), (b, b), (a, b)],
            [(g, g)] * 4,
            [(-0.08, -0.08), (1.08, -0.08), (-0.08, 1.08), (1.08, 1.08)],
        ]
    )
    points = np.rint(_project(np.linalg.inv(_matrix(pose, frame)), plate)).astype(int)
    height, width = luma.shape
    values: Array = levels[luma[np.clip(points[:, 1], 0, height - 1), np.clip(points[:, 0], 0, width - 1)]]
    return values


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _inverse(pose):  # type: ignore[no-untyped-def]
    """Inverse of the homography with these eight entries, up to scale."""
    a, b, c, d, e, f, g, h = pose[0], pose[1], pose[2], pose[3], pose[4], pose[5], pose[6], pose[7]
    inverse = np.empty((3, 3))
    inverse[0, 0] = e - f * h
    inverse[0, 1] = c * h - b
    inverse[0, 2] = b * f - c * e
    inverse[1, 0] = f * g - d
    inverse[1, 1] = a - c * g
    inverse[1, 2] = c * d - a * f
    inverse[2, 0] = d * h - e * g
    inverse[2, 1] = b * g - a * h
    inverse[2, 2] = a * e - b * d
    return inverse


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _corners(pose, frame, out):  # type: ignore[no-untyped-def]
    """Corners of the plate in pixels; False behind the camera."""
    m = _inverse(pose)
    sign = 1.0 if m[2, 0] * 0.5 + m[2, 1] * 0.5 + m[2, 2] > 0 else -1.0
    for k in range(4):
        u = 1.0 if k == 1 or k == 2 else 0.0
        v = 1.0 if k >= 2 else 0.0
        w = sign * (m[2, 0] * u + m[2, 1] * v + m[2, 2])
        if w < 1e-9:
            return False
        out[k, 0] = sign * (m[0, 0] * u + m[0, 1] * v + m[0, 2]) / w * frame[2] + frame[0]
        out[k, 1] = sign * (m[1, 0] * u + m[1, 1] * v + m[1, 2]) / w * frame[2] + frame[1]
    return True


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _blur_nodes(pose, frame, most):  # type: ignore[no-untyped-def]
    """Quadrature for a blur that is not along the plate's axes: nodes, weights, direction in the plate.

    A round blur in the image is an ellipse in the plate, long along the line of sight; so is the motion's. An upright
    plate has that line along its columns, where the shapes' profiles are exact, and needs no quadrature.
    """
    ux = (pose[0] - pose[2] * pose[6]) / frame[2]
    uy = (pose[1] - pose[2] * pose[7]) / frame[2]
    vx = (pose[3] - pose[5] * pose[6]) / frame[2]
    vy = (pose[4] - pose[5] * pose[7]) / frame[2]
    a = ux * ux + uy * uy
    b = ux * vx + uy * vy
    d = vx * vx + vy * vy
    root = math.sqrt(0.25 * (a - d) * (a - d) + b * b)
    long2 = 0.5 * (a + d) + root
    short2 = max(0.5 * (a + d) - root, 1e-18)
    angle = 0.5 * math.atan2(2.0 * b, a - d)
    direction = np.array([math.cos(angle), math.sin(angle)])
    if long2 < 1.69 * short2 or (abs(direction[0]) < UPRIGHT_SINE):
        return np.zeros(1), np.ones(1), np.array([0.0, 1.0]), np.zeros(2)
    sigma = math.exp(pose[8])
    motion = max(pose[9], 0.02)
    spread = math.sqrt((long2 - short2) * sigma * sigma + motion * motion / 12.0)
    half = math.ceil(1.2 * spread / (math.sqrt(short2) * sigma))
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
    by_spread = np.array([1.0 - motion * motion / (12.0 * spread * spread), motion / (12.0 * spread * spread)])
    return nodes * (spread / math.sqrt(second)), weights, direction, by_spread


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _hold_open_ends(normal, rhs, pose, coef, variance):  # type: ignore[no-untyped-def]
    """Hold what the pixels leave open: values near their mean, blur near the usual."""
    shapes = coef.shape[0]
    mean = 0.0
    for i in range(shapes - 13):
        mean += coef[i]
    mean = min(max(mean / (shapes - 13), 0.01), 2.0)
    ridge = variance / (1.44 * mean * mean)
    for i in range(shapes):
        normal[i, i] += ridge
        rhs[i] += ridge * mean
    for i in range(shapes, shapes + 8):
        normal[i, i] += 1e-6 * variance
    hold = variance / (BLUR_PRIOR[1] * BLUR_PRIOR[1])
    normal[shapes + 8, shapes + 8] += hold
    rhs[shapes + 8] += hold * (BLUR_PRIOR[0] - pose[8])
    hold = variance / (MOTION_PRIOR[1] * MOTION_PRIOR[1])
    normal[shapes + 9, shapes + 9] += hold
    rhs[shapes + 9] += hold * (MOTION_PRIOR[0] - pose[9])


@nb.njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _gauss_newton(luma, levels, weights, table, frame, pose, edges, slot, coef, normal):  # type: ignore[no-untyped-def]
    """Move pose and shape values until the corners rest: coarse steps on few pixels, then fine ones on more.

    Returns whether there is a plate, the residual's variance, the share of variance explained, and the pixels used.
    """
    shapes = coef.shape[0]
    rhs = np.empty(shapes + 10)
    cross = np.empty((shapes, 10))
    inner = np.empty((10, 10))
    corners = np.empty((4, 2))
    moved = np.empty((4, 2))
    box = np.empty(4, np.int64)
    stride = np.empty(2, np.int64)
    margin = np.empty(2)
    extents = np.empty(2)
    variance = 0.0
    explained = 0.0
    pixels = 0
    coarse = True
    for k in range(MAX_STEPS):
        if not _corners(pose, frame, corners):
            return False, variance, explained, pixels
        for axis in range(2):
            low = corners[:, axis].min()
            high = corners[:, axis].max()
            extent = high - low
            size = luma.shape[1 - axis]
            if not (3.0 < extent < 2.0 * size):
                return False, variance, explained, pixels
            box[axis] = max(int(low - 0.12 * extent - 2), 0)
            box[axis + 2] = min(int(high + 0.12 * extent + 3), size)
            extents[axis] = extent
            margin[axis] = 0.03 + 2.0 / extent
        area = 1.15 * abs(
            (corners[2, 0] - corners[0, 0]) * (corners[3, 1] - corners[1, 1])
            - (corners[2, 1] - corners[0, 1]) * (corners[3, 0] - corners[1, 0])
        )  # twice the quadrangle's, and its surroundings
        wanted = (COARSE_PIXELS if coarse else FINE_PIXELS) * (shapes + 10)
        both = max(0.5 * area / wanted, 1.0)  # pixels to pass over for each one that is looked at
        lean = math.sqrt(extents[0] / extents[1])
        stride[0] = max(int(math.sqrt(both) * lean + 0.5), 1)
        stride[1] = max(int(both / stride[0] + 0.5), 1)
        stride[0] = max(int(both / stride[1] + 0.5), 1)
        nodes, node_weights, direction, by_spread = _blur_nodes(pose, frame, 2 if coarse else 4)
        normal[:] = 0.0
        cross[:] = 0.0
        inner[:] = 0.0
        rhs[:] = 0.0
        total, flat, pixels = _accumulate(
            luma, levels, weights, table, box, stride, frame, pose, edges, slot, coef,
            nodes, node_weights, direction, by_spread, margin, normal, cross, inner, rhs[:shapes], rhs[shapes:],
        )  # fmt: skip
        normal[shapes:, :shapes] = cross.T
        normal[shapes:, shapes:] = inner
        if pixels < shapes:
            return False, variance, explained, pixels
        variance = max(total, (1.0 / 255) ** 2)
        explained = 1.0 - total / max(flat, 1e-12)
        if (k == 1 and explained < HOPELESS[0]) or (k == 2 and explained < HOPELESS[1]):
            return False, variance, explained, pixels
        _hold_open_ends(normal, rhs, pose, coef, variance)
        factor = factorize(normal)
        if factor.shape[0] == 0:
            return False, variance, explained, pixels
        solution = solve_factorized(factor, rhs)
        coef[:] = solution[:shapes]
        for i in range(10):
            limit = 0.15 if i < 6 else (0.1 if i < 8 else (0.4 if i == 8 else 0.08))
            pose[i] += min(max(solution[shapes + i], -limit), limit)
        pose[9] = max(pose[9], 0.0)
        if not np.isfinite(pose.sum()) or not _corners(pose, frame, moved):
            return False, variance, explained, pixels
        shift = np.abs(moved - corners).max()
        if not coarse and shift < REST_PX:
            break
        if k >= 3 and shift > LOST_PX:
            return False, variance, explained, pixels
        if (k >= 1 and shift < NEAR_PX) or k >= 3:
            coarse = False
    return True, variance, explained, pixels


def _result(
    frame: Array, pose: Array, slot: npt.NDArray[np.int64], coef: Array, covariance: Array,
    residual: float, explained: float, pixels: int,
) -> PlateFit:  # fmt: skip
    n, shapes = len(slot), len(coef)
    units = np.full((n, n), np.nan)
    order = np.flatnonzero(slot.reshape(-1) >= 0)
    units.reshape(-1)[order] = coef[: len(order)]
    corners = np.empty((4, 2))
    _corners(pose, frame, corners)
    jacobian = _corner_jacobian(pose, frame, corners)
    return PlateFit(
        plate_from_image=_matrix(pose, frame),
        units=units,
        units_covariance=covariance[: len(order), : len(order)],
        unit_order=order,
        markers=coef[shapes - _EXTRA : shapes - 8],
        gap=float(coef[shapes - 8 : shapes - 4].mean()),
        road=float(coef[shapes - 4 :].mean()),
        corners_px=corners,
        corners_covariance_px2=CORNER_SCATTER
        * (jacobian @ covariance[shapes : shapes + 8, shapes : shapes + 8] @ jacobian.T),
        residual=residual,
        explained=explained,
        blur_px=math.exp(pose[8]),
        motion=float(pose[9]),
        pixels=pixels,
    )


_SQUARE = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])


def _corner_jacobian(pose: Array, frame: Array, corners_px: Array) -> Array:
    """Derivative of the flattened corners [px] by the homography's eight entries, shape (8, 8)."""
    rows = []
    for (u, v), (x, y) in zip(_SQUARE, (corners_px - frame[:2]) / frame[2], strict=True):
        w = pose[6] * x + pose[7] * y + 1
        by_pose = np.array([[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]) / w
        by_point = (
            np.array([[pose[0] - u * pose[6], pose[1] - u * pose[7]], [pose[3] - v * pose[6], pose[4] - v * pose[7]]])
            / w
        )
        rows.append(-np.linalg.solve(by_point, by_pose) * frame[2])
    stacked: Array = np.concatenate(rows)
    return stacked
