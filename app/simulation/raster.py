"""Compiled inner loops of the camera simulation: area sampling of squares on the road, and the sensor's noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from app.compiled import kernel, step

FloatArray = npt.NDArray[np.float32]


@kernel
def accumulate_face(
    rays: Any,
    samples: Any,
    row_time_s: Any,
    motion: Any,
    spin: Any,
    height_m: float,
    face_from_ground: Any,
    reflectance: Any,
    emission: Any,
    light: Any,
    shade: Any,
    shade_from_ground: Any,
    out: Any,
    cover: Any,
) -> None:  # pragma: no cover - compiled
    """Integrate what each pixel sees of a square on the road over its area and the exposure.

    Parameters
    ----------
    rays : float64 (H, W, 3, 3)
        Of each pixel in the vehicle frame: direction at its centre, and its derivatives by column and by row.
    samples : float64 (S, 3)
        Column and row offset within the pixel [px], time from mid-exposure [s].
    row_time_s : float64 (H,)
        Mid-exposure of each row. [s]
    motion, spin : float64 (3,)
        Velocity [m/s] and angular rate [rad/s] of the camera, vehicle frame.
    height_m : float
        Camera above the road. [m]
    face_from_ground : float64 (2, 3)
        To columns and rows of the texture, texel edges at integers.
    reflectance, emission : float32 (T, T, 3)
        ``emission`` may have no texels.
    light : float32 (3,)
        Radiance of a white diffuser in full light.
    shade : float32 (N, N), shade_from_ground : float64 (2, 3)
        Share of the light that arrives, by bilinear lookup.
    out, cover : float32 (H, W, 3), (H, W)
        Added to: radiance from the square, and the share of the footprint that it fills.
    """
    rows, cols = out.shape[0], out.shape[1]
    count, size = samples.shape[0], reflectance.shape[0]
    glows = emission.shape[0] > 0
    weight = 1.0 / count
    begin, end = samples[:, 2].min(), samples[:, 2].max()
    for i in range(rows):
        for j in range(cols):
            if _misses(rays[i, j], row_time_s[i], begin, end, motion, spin, height_m, face_from_ground, size):
                continue
            blue = green = red = hit = 0.0
            for s in range(count):
                du, dv, t = samples[s, 0], samples[s, 1], samples[s, 2] + row_time_s[i]
                gx, gy = _ground(rays[i, j], du, dv, t, motion, spin, height_m)
                fx = face_from_ground[0, 0] * gx + face_from_ground[0, 1] * gy + face_from_ground[0, 2]
                fy = face_from_ground[1, 0] * gx + face_from_ground[1, 1] * gy + face_from_ground[1, 2]
                if fx < 0 or fy < 0 or fx >= size or fy >= size:
                    continue
                a, b = int(fy), int(fx)
                lit = weight * _bilinear(shade, shade_from_ground, gx, gy)
                blue += lit * light[0] * reflectance[a, b, 0]
                green += lit * light[1] * reflectance[a, b, 1]
                red += lit * light[2] * reflectance[a, b, 2]
                if glows:
                    blue += weight * emission[a, b, 0]
                    green += weight * emission[a, b, 1]
                    red += weight * emission[a, b, 2]
                hit += weight
            if hit > 0:
                out[i, j, 0] += blue
                out[i, j, 1] += green
                out[i, j, 2] += red
                cover[i, j] += hit


@step
def _ground(
    ray: Any, du: float, dv: float, t: float, motion: Any, spin: Any, height_m: float
) -> tuple[float, float]:  # pragma: no cover - compiled
    """Where a spot of a pixel looks at the road at time t; far away above the horizon."""
    dx = ray[0, 0] + du * ray[1, 0] + dv * ray[2, 0]
    dy = ray[0, 1] + du * ray[1, 1] + dv * ray[2, 1]
    dz = ray[0, 2] + du * ray[1, 2] + dv * ray[2, 2]
    ex = dx + t * (spin[1] * dz - spin[2] * dy)
    ey = dy + t * (spin[2] * dx - spin[0] * dz)
    ez = dz + t * (spin[0] * dy - spin[1] * dx)
    scale = (height_m + motion[2] * t) / max(-ez, 1e-6)
    return ex * scale + motion[0] * t, ey * scale + motion[1] * t


@kernel
def _misses(
    ray: Any,
    row_time_s: float,
    begin: float,
    end: float,
    motion: Any,
    spin: Any,
    height_m: float,
    face_from_ground: Any,
    size: int,
) -> bool:  # pragma: no cover - compiled
    """Whether the corners of a pixel's footprint at both ends of the exposure all lie beyond one side of the face."""
    low_x = low_y = 1e30  # fastmath knows no infinity
    high_x = high_y = -1e30
    for du in (-0.6, 0.6):
        for dv in (-0.6, 0.6):
            for t in (begin, end):
                gx, gy = _ground(ray, du, dv, row_time_s + t, motion, spin, height_m)
                fx = face_from_ground[0, 0] * gx + face_from_ground[0, 1] * gy + face_from_ground[0, 2]
                fy = face_from_ground[1, 0] * gx + face_from_ground[1, 1] * gy + face_from_ground[1, 2]
                low_x, high_x = min(low_x, fx), max(high_x, fx)
                low_y, high_y = min(low_y, fy), max(high_y, fy)
    return high_x < 0 or high_y < 0 or low_x > size or low_y > size


@kernel
def _bilinear(field: Any, field_from_ground: Any, gx: float, gy: float) -> float:  # pragma: no cover - compiled
    size = field.shape[0]
    if size == 1:
        return float(field[0, 0])
    u = field_from_ground[0, 0] * gx + field_from_ground[0, 1] * gy + field_from_ground[0, 2]
    v = field_from_ground[1, 0] * gx + field_from_ground[1, 1] * gy + field_from_ground[1, 2]
    u, v = min(max(u, 0.0), size - 1.001), min(max(v, 0.0), size - 1.001)
    c, r = int(u), int(v)
    p, q = u - c, v - r
    top = field[r, c] * (1 - p) + field[r, c + 1] * p
    low = field[r + 1, c] * (1 - p) + field[r + 1, c + 1] * p
    return float(top * (1 - q) + low * q)


@kernel
def shade_rays(
    rays: Any, height_m: float, shade: Any, shade_from_ground: Any, out: Any
) -> None:  # pragma: no cover - compiled
    """Share of the light that arrives where each ray meets the road; 1 above the horizon. ``out``: float32 (H, W)."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            dz = rays[i, j, 2]
            if dz > -0.02:
                out[i, j] = 1.0
                continue
            scale = height_m / -dz
            out[i, j] = _bilinear(shade, shade_from_ground, rays[i, j, 0] * scale, rays[i, j, 1] * scale)


@kernel
def expose_photo(
    photo: Any, share: Any, encode: Any, sigma: Any, noise: Any, offsets: Any, out: Any
) -> None:  # pragma: no cover - compiled
    """Give a photo the camera's tone and noise.

    Parameters
    ----------
    photo, out : uint8 (H, W, C)
    share : float32 (h, w)
        Light that arrives, 0 to 1, at every fourth row and column; a single value stands for all.
    encode, sigma : float32 (L, C, 256)
        Encoded value and noise of a photo's value at L even steps of light from 0 to 1. [grey levels]
    noise : float32 (M,)
        Standard normal numbers; ``offsets`` : int64 (H,), where each row starts in them.
    """
    rows, cols, channels = photo.shape
    top_level = encode.shape[0] - 1
    even = share.size == 1
    level = int(share[0, 0] * top_level + 0.5)
    for i in range(rows):
        k = offsets[i]
        r, q = i >> 2, (i & 3) * 0.25
        for j in range(cols):
            if not even:
                c0, p = j >> 2, (j & 3) * 0.25
                top = share[r, c0] * (1 - p) + share[r, c0 + 1] * p
                low = share[r + 1, c0] * (1 - p) + share[r + 1, c0 + 1] * p
                level = int((top * (1 - q) + low * q) * top_level + 0.5)
            for c in range(channels):
                v = photo[i, j, c]
                x = encode[level, c, v] + sigma[level, c, v] * noise[k] + 0.5
                k += 1
                out[i, j, c] = 0 if x < 0 else (255 if x >= 255.5 else int(x))
