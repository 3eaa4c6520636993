"""The face of a plate as a camera meets it: reflectance and emission of every spot, with wear and dirt.

Arrays are linear light in OpenCV's channel order (blue, green, red); row 0 is the plate's top edge (direction of
travel), column 0 its left edge.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.markers.plate import PlateCode, PlateGeometry
from app.values import Floats32

Colour = tuple[float, float, float]
_MAX_TEXELS = 800


@dataclass(frozen=True, slots=True)
class PlateLook:
    """Materials of a plate."""

    # `dark`, `light`, `gap`, `red`, `green`: Diffuse reflectance in blue, green, red, 0 to 1
    dark: Colour = (0.04, 0.04, 0.04)
    light: Colour = (0.75, 0.75, 0.75)
    gap: Colour = (0.1, 0.1, 0.1)
    red: Colour = (0.05, 0.05, 0.5)
    green: Colour = (0.12, 0.36, 0.06)
    # reflectance of the half of the red marker's cell that the triangle leaves free
    triangle_rest: Colour = (0.75, 0.75, 0.75)
    led: float = 0.0  # radiance of a lit light unit, as a share of the sensor's saturation at gain 1; 0 is off
    led_markers: bool = True  # the boundary markers are lit too, in their colours


@dataclass(frozen=True, slots=True)
class PlateWear:
    """Wear of a plate. All shares are 0 (new) to 1."""

    contrast_loss: float = 0.0  # even loss: every material moves this far towards the plate's mean
    patchy_loss: float = 0.0  # most that patches of worn surface move towards the colour of dust
    patch_mm: float = 60.0  # [mm] Typical size of a patch
    dirt_blobs: int = 0  # number of opaque stains
    dirt_mm: float = 20.0  # [mm] Typical radius of a stain
    # number of spots of paint: ellipses as dark as the dark units, as light as the light ones, or grey
    paint_spots: int = 0
    paint_mm: tuple[float, float] = (8.0, 30.0)  # [mm] least and greatest half axis of a spot


@dataclass(frozen=True, slots=True, eq=False)
class Face:
    """A square that lies on the road."""

    side_m: float  # [m] outer side
    # `reflectance`, `emission`: float32, shape (T, T, 3): Diffuse reflectance, and radiance that it emits by itself;
    # the latter may be None
    reflectance: Floats32 = field(repr=False)
    emission: Floats32 | None = field(default=None, repr=False)


def draw_look(rng: np.random.Generator) -> PlateLook:
    """Materials of a plate within the range that paints, acrylics and sheeting plausibly have."""
    dark = float(rng.uniform(0.02, 0.09))
    light = float(rng.uniform(0.45, 0.88))
    tint = rng.uniform(0.9, 1.0, 3)
    kind = int(rng.integers(3))
    gap = (dark * float(rng.uniform(0.7, 1.6)), float(rng.uniform(0.12, 0.35)), light * float(rng.uniform(0.8, 1.0)))[
        kind
    ]
    red_level, green_level = float(rng.uniform(0.3, 0.65)), float(rng.uniform(0.22, 0.5))
    red = (red_level * rng.uniform(0.06, 0.2), red_level * rng.uniform(0.04, 0.18), red_level)
    green = (green_level * rng.uniform(0.12, 0.6), green_level, green_level * rng.uniform(0.06, 0.35))
    light_colour = _colour(light * tint)
    rest = light_colour if rng.random() < 0.5 else _colour(np.full(3, gap))
    return PlateLook(
        dark=_colour(np.full(3, dark)),
        light=light_colour,
        gap=_colour(np.full(3, gap)),
        red=_colour(np.array(red)),
        green=_colour(np.array(green)),
        triangle_rest=rest,
    )


def _colour(values: npt.NDArray[np.floating]) -> Colour:
    b, g, r = (float(v) for v in values)
    return (b, g, r)


def plate_face(
    code: PlateCode,
    geometry: PlateGeometry,
    look: PlateLook,
    wear: PlateWear,
    rng: np.random.Generator,
    *,
    texels_per_mm: float = 1.0,
) -> Face:
    """Face of a plate with its wear.

    Parameters
    ----------
    code : PlateCode
        Of the geometry's size.
    rng : numpy.random.Generator
        Draws the places of patches and stains.
    texels_per_mm : float
        Resolution; edges between texels are mixed by area. [1/mm]

    Raises
    ------
    InvalidParameter
        The code is of another size than the geometry.
    """
    if code.n != geometry.n:
        raise InvalidParameter(
            f"a code of {code.n} x {code.n} units on a plate of {geometry.n} x {geometry.n}", field="code.n"
        )
    size = max(round(geometry.side_mm * texels_per_mm), 2)
    shares = material_shares(code, geometry, size)
    colours = np.array([look.gap, look.dark, look.light, look.red, look.green, look.triangle_rest], np.float32)
    reflectance = np.tensordot(shares, colours, axes=(0, 0)).astype(np.float32)
    reflectance = _worn(reflectance, wear, geometry.side_mm, rng)
    emission = _lit(shares, look, texels_per_mm) if look.led > 0 else None
    return Face(geometry.side_mm / 1000, reflectance, emission)


def _lit(shares: Floats32, look: PlateLook, texels_per_mm: float) -> Floats32:
    """Radiance of the light units and markers with light sources below them."""
    glow = shares[2][..., None] * np.ones(3, np.float32)
    if look.led_markers:
        for share, colour in ((shares[3], look.red), (shares[4], look.green)):
            glow = glow + share[..., None] * (np.array(colour, np.float32) / max(colour))
    spread = cv2.GaussianBlur(glow, (0, 0), 2.0 * texels_per_mm)  # light spreads inside the translucent cover
    return np.ascontiguousarray(look.led * spread, np.float32)


def grid_face(cells: npt.ArrayLike, side_m: float, wear: PlateWear, rng: np.random.Generator, led: float = 0.0) -> Face:
    """Face made of square cells of even colour, such as a tag or a chessboard, with the wear of a plate.

    Parameters
    ----------
    cells : array_like, shape (K, K, 3)
        Reflectances in blue, green, red.
    side_m : float
        Outer side. [m]
    rng : numpy.random.Generator
        Draws the places of patches and stains.
    led : float
        Radiance that the lightest cells emit, as a share of saturation; others in proportion.
    """
    colours = np.asarray(cells, np.float32)
    count = colours.shape[0]
    size = max(round(min(side_m * 1000, _MAX_TEXELS) / count) * count, count)
    crisp = np.repeat(np.repeat(colours, size // count, axis=0), size // count, axis=1)
    emission = np.ascontiguousarray(crisp * (led / max(float(colours.max()), 1e-6))) if led > 0 else None
    return Face(side_m, _worn(crisp, wear, side_m * 1000, rng), emission)


def material_shares(code: PlateCode, geometry: PlateGeometry, size: int) -> Floats32:
    """Share of each texel that is gap, dark, light, red, green, free half of the triangle's cell.

    Returns
    -------
    ndarray of float32, shape (6, size, size)
    """
    n, units = geometry.n, code.units
    unit_cover = np.array(
        [_cover(geometry.gap_mm + i * geometry.pitch_mm, geometry.unit_mm, geometry.side_mm, size) for i in range(n)]
    )
    marker_mm = 2 * geometry.unit_mm + geometry.gap_mm
    near = _cover(geometry.gap_mm, marker_mm, geometry.side_mm, size)
    far = _cover(geometry.side_mm - geometry.gap_mm - marker_mm, marker_mm, geometry.side_mm, size)
    is_code = np.ones((n, n))
    is_code[:2, :2] = is_code[:2, -2:] = is_code[-2:, :2] = is_code[-2:, -2:] = 0
    shares = np.zeros((6, size, size), np.float32)
    shares[1] = unit_cover.T @ (is_code * units) @ unit_cover
    shares[2] = unit_cover.T @ (is_code * (1 - units)) @ unit_cover
    shares[4] = np.outer(near, far) + np.outer(far, near) + np.outer(far, far)
    cell = np.outer(near, near)
    triangle = _triangle_cover(geometry.gap_mm, marker_mm, geometry.side_mm, size)
    shares[3], shares[5] = triangle, np.maximum(cell - triangle, 0)
    shares[0] = np.clip(1 - shares[1:].sum(axis=0), 0, 1)
    return shares


def _cover(start_mm: float, length_mm: float, side_mm: float, size: int) -> npt.NDArray[np.float64]:
    """Share of each texel along one axis that an interval covers, shape (size,)."""
    edges = np.arange(size + 1) * side_mm / size
    overlap = np.clip(np.minimum(edges[1:], start_mm + length_mm) - np.maximum(edges[:-1], start_mm), 0, None)
    cover: npt.NDArray[np.float64] = overlap * size / side_mm
    return cover


def _triangle_cover(start_mm: float, leg_mm: float, side_mm: float, size: int) -> npt.NDArray[np.float64]:
    """Share of each texel inside the triangle with its right angle at the plate's corner, by 8 x 8 samples."""
    fine = 8
    at_mm = (np.arange(size * fine) + 0.5) * side_mm / (size * fine) - start_mm
    count = int(np.ceil((start_mm + leg_mm) / side_mm * size)) * fine
    y, x = np.meshgrid(at_mm[:count], at_mm[:count], indexing="ij")
    inside = ((x >= 0) & (y >= 0) & (x + y <= leg_mm)).astype(np.float64)
    cover = np.zeros((size, size))
    coarse = inside.reshape(count // fine, fine, count // fine, fine).mean(axis=(1, 3))
    cover[: count // fine, : count // fine] = coarse
    return cover


def smooth_noise(shape: tuple[int, int], scale: float, rng: np.random.Generator) -> Floats32:
    """Smooth random field with values spread evenly over 0 to 1, features about ``scale`` texels wide."""
    coarse = (int(np.ceil(shape[0] / scale)) + 3, int(np.ceil(shape[1] / scale)) + 3)
    field = rng.random(coarse, dtype=np.float32)
    big = cv2.resize(field, (round(coarse[1] * scale) + 1, round(coarse[0] * scale) + 1), interpolation=cv2.INTER_CUBIC)
    top, left = round(scale), round(scale)
    return np.asarray(np.clip(big[top : top + shape[0], left : left + shape[1]], 0, 1), np.float32)


def _worn(reflectance: Floats32, wear: PlateWear, side_mm: float, rng: np.random.Generator) -> Floats32:
    size = reflectance.shape[0]
    texels_per_mm = size / side_mm
    mean = reflectance.mean(axis=(0, 1))
    out = reflectance + (mean - reflectance) * wear.contrast_loss
    dust = np.float32(rng.uniform(0.12, 0.3)) * np.array([0.85, 0.95, 1.05], np.float32)
    if wear.patchy_loss > 0:
        patches = smooth_noise((size, size), wear.patch_mm * texels_per_mm, rng)
        fine = smooth_noise((size, size), max(wear.patch_mm / 8 * texels_per_mm, 1.5), rng)
        amount = np.clip(1.6 * patches - 0.5 + 0.4 * (fine - 0.5), 0, 1) * wear.patchy_loss
        out = out + (dust - out) * amount[..., None]
    for _ in range(wear.dirt_blobs):
        out = _stained(out, wear.dirt_mm * texels_per_mm, dust, rng)
    for _ in range(wear.paint_spots):
        out = _painted(out, wear.paint_mm, texels_per_mm, rng)
    return np.ascontiguousarray(out, np.float32)


def _stained(face: Floats32, radius: float, dust: Floats32, rng: np.random.Generator) -> Floats32:
    """One stain with a ragged edge."""
    size = face.shape[0]
    x0, y0 = rng.uniform(0, size, 2)
    radii = radius * rng.uniform(0.5, 1.6) * (1 + 0.25 * rng.standard_normal(12))
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    stretch = rng.uniform(0.6, 1.6)
    outline = np.stack([x0 + radii * np.cos(angles) * stretch, y0 + radii * np.sin(angles) / stretch], axis=1)
    mask = np.zeros((size, size), np.float32)
    cv2.fillPoly(mask, [np.round(outline).astype(np.int32)], 1.0)
    spread = max(radius * 0.15, 0.8)
    low = np.clip(np.floor(outline.min(axis=0) - 4 * spread), 0, size).astype(int)
    high = np.clip(np.ceil(outline.max(axis=0) + 4 * spread), 0, size).astype(int)
    part = (slice(low[1], high[1]), slice(low[0], high[0]))
    opacity = np.float32(rng.uniform(0.5, 1.0))
    colour = dust * np.float32(rng.uniform(0.15, 1.5))
    if mask[part].size:
        soft = cv2.GaussianBlur(mask[part], (0, 0), spread) * opacity
        face[part] += (colour - face[part]) * soft[..., None]
    return face


def _painted(
    face: Floats32, half_axes_mm: tuple[float, float], texels_per_mm: float, rng: np.random.Generator
) -> Floats32:
    """One spot of paint, an ellipse with a sharp edge."""
    size = face.shape[0]
    axes = rng.uniform(*half_axes_mm, 2) * texels_per_mm
    centre = rng.uniform(0.1, 0.9, 2) * size
    mask = np.zeros((size, size), np.uint8)
    place, half = (int(centre[0]), int(centre[1])), (max(int(axes[0]), 1), max(int(axes[1]), 1))
    cv2.ellipse(mask, place, half, float(rng.uniform(0, 180)), 0, 360, 255, -1)
    cover = cv2.GaussianBlur(mask.astype(np.float32) / 255, (0, 0), 1.0) * np.float32(rng.uniform(0.7, 1.0))
    tones = ((0.02, 0.12), (0.5, 0.95), (0.15, 0.45))
    paint = np.float32(rng.uniform(*tones[int(rng.choice(3, p=(0.35, 0.35, 0.3)))]))
    painted: Floats32 = face + (paint - face) * cover[..., None]
    return painted
