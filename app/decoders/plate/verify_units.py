"""The units of a fitted plate verified by its pixels: light, paint and stains as competing explanations.

The light on the plate is a Gaussian process, so that the edge of a shadow is no damage. For each unit the pixels around
it are compared under these hypotheses, with the light integrated out: the unit as it was read, or flipped, that is dark
instead of light or light instead of dark; clean, under a smooth stain, or flipped under a spot of paint that hides it.
Whether the plate has stains at all follows from all of its units.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.plate.fit import PlateFit
from app.decoders.plate.hypotheses import MIN_PIXELS, set_unit_likelihoods
from app.decoders.plate.layout import unit_edges, unit_shapes
from app.decoders.plate.light_field import LEVEL_VARIANCE, LIGHT_LENGTH_MM, fit_light
from app.decoders.plate.patch import cut_patch
from app.decoders.plate.pixel_shares import gather_shares, set_pixel_shares
from app.decoders.plate.plate_pixels import LightPrior, PlatePattern, PlatePixels, Spots
from app.decoders.plate.synthesis import FIRST_GAP
from app.decoders.plate.unit_likelihoods import UnitEvidence
from app.decoders.plate.unit_verification import UnitVerification
from app.decoders.plate.veil import DARK_SHARE, VEIL_LENGTH, Veil
from app.markers.plate import PlateGeometry, unit_index

Array = npt.NDArray[Any]

UNIT_PX = 4.5
"""[px] size of a unit in the patch, where the image has more. Source: trials with 3.0, which has more wrong readings of
stained plates."""
REACH_PITCHES = 1.25
"""[pitches] from a unit's centre within which its pixels are compared: the unit, the gaps around it and half of its
neighbours. Source: chosen by hand, for speed."""
INNER_SHARE = 0.7
"""[unit] part of a unit's half side within which lies what the pixels around it see of it. Source: chosen by hand."""
MAX_ROAD_SHARE, MIN_SHARE = 0.05, 0.9
"""[1] share of the road in a pixel up to which it is compared, and of all shapes from which on. Source: by hand."""
ALBEDO = (0.01, 1.3)
"""[white] least and greatest reflectance of a part to begin with. Source: chosen by hand."""
MIN_BLUR_MM = 2.0
"""[mm] width of the edge of a spot of paint at least. Source: chosen by hand."""
NODES = 4
"""Quadrature nodes on each side of the middle at most, as the fit has."""
WHITE_SPREAD, SPREAD_FACTOR, DARK_SHARE_OF_SPREAD = (0.03, 0.09), 2.0, 0.55
"""[white, 1, 1] least and greatest standard deviation of light units' own reflectances, the same over
`UnitEvidence.spread`, and that of dark units over it: where units are even, a spot of paint stands out. Source: plates
under painted stains (decision record 0011)."""
VEIL_ERROR = 0.05
"""[light level] standard deviation of the error of a veil of glare. Source: chosen by hand; with none, 51 of 100
frames in glare are read in place of 52 (decision record 0011)."""
SPOTS_MM = ((17, 17, 0), (22, 22, 0), (30, 30, 0), (26, 17, 0), (17, 26, 0), (28, 20, 45), (28, 20, 135))
"""[mm, mm, deg] half axes and turns of the spots of paint; each lies at nine places around the unit's centre. Source:
chosen by hand; smaller ones leave a part of the unit in view."""
PAINTS, OPACITIES = np.array([0.03, 0.1, 0.2, 0.35, 0.6, 0.85, 1.0, 1.15]), np.array([1.0, 0.8])
"""[white, 1] reflectances and opacities of the spots. Source: chosen by hand."""


def verify_units(
    image: npt.NDArray[np.uint8],
    fit: PlateFit,
    geometry: PlateGeometry,
    dark: npt.NDArray[np.bool_],
    units: UnitEvidence,
) -> UnitVerification | None:
    """Verify a pattern of units by the pixels.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3)
        The frame.
    fit : PlateFit
        Of the plate in it.
    geometry : PlateGeometry
    dark : ndarray of bool, shape (units,)
        The pattern, in the order of the symbols' units.
    units : UnitEvidence
        Of the fit: the explanations of its light, and how much its units differ.

    Returns
    -------
    UnitVerification or None
        None where the plate has too few pixels.
    """
    pixels = _cut(image, fit, geometry)
    if pixels is None:
        return None
    found = [_likelihoods(pixels, fit, geometry, dark, veil, units.spread) for veil in units.veils]
    if len(found) == 1:
        return UnitVerification(found[0])
    first, other, log_odds = *found, units.veil_log_odds
    return UnitVerification(np.logaddexp(first - np.logaddexp(0.0, -log_odds), other - np.logaddexp(0.0, log_odds)))


def _likelihoods(
    seen: PlatePixels,
    fit: PlateFit,
    geometry: PlateGeometry,
    dark: npt.NDArray[np.bool_],
    veil: Veil,
    unit_spread: float,
) -> Array:
    """Log likelihoods of the hypotheses about each unit under a veil, shape (units, 5)."""
    pixels, paints = _unveiled(seen, fit, geometry, veil)
    pattern = dark.astype(float)
    parts = np.column_stack([pixels.units @ pattern, pixels.rest])
    white = pixels.units @ (1 - pattern)
    field = fit_light(pixels, white, parts, paints, geometry.side_mm)
    likelihoods = np.empty((len(dark), 5))
    white_spread = min(max(SPREAD_FACTOR * unit_spread, WHITE_SPREAD[0]), WHITE_SPREAD[1])
    set_unit_likelihoods(
        pixels,
        PlatePattern(
            pattern, white + parts @ field.albedo, float(field.albedo[0]),
            white_spread, DARK_SHARE_OF_SPREAD * white_spread, _centres_mm(geometry),
            REACH_PITCHES * geometry.pitch_mm, INNER_SHARE * geometry.unit_mm / 2,
        ),
        LightPrior(
            field.light, field.noise, field.spread, LIGHT_LENGTH_MM, LEVEL_VARIANCE,
            0.0 if veil.is_even else (VEIL_ERROR * veil.level) ** 2, VEIL_LENGTH * geometry.side_mm / 8,
        ),
        Spots(_spot_shapes(geometry.pitch_mm), PAINTS, OPACITIES),
        likelihoods,
    )  # fmt: skip
    return likelihoods


def _cut(image: npt.NDArray[np.uint8], fit: PlateFit, geometry: PlateGeometry) -> PlatePixels | None:
    """The pixels on the plate as the camera sees them; None where it has too few."""
    n, side_mm = geometry.n, geometry.side_mm
    patch = cut_patch(image, fit.corners_px, n * UNIT_PX, linear=False)
    if patch is None:
        return None
    shapes = len(fit.model.values)
    shares, places = np.empty((*patch.light.shape, shapes)), np.empty((*patch.light.shape, 2))
    set_pixel_shares(patch, fit.model, NODES, shares, places)
    in_symbols, size = unit_shapes(n).reshape(-1)[unit_index(n).reshape(-1)], patch.light.size
    listed, units, rest = np.empty(size, np.int64), np.empty((size, len(in_symbols))), np.empty((size, 1 + FIRST_GAP))
    count = gather_shares(shares.reshape(size, -1), in_symbols, MIN_SHARE, MAX_ROAD_SHARE, listed, units, rest)
    if count < MIN_PIXELS * n:
        return None
    used = listed[:count]
    weights: Array = patch.weights.reshape(-1)[used]
    right, down = np.diff(fit.corners_px[:3], axis=0)
    mm_per_px = side_mm / math.sqrt(max(abs(float(right[0] * down[1] - right[1] * down[0])), 1.0))
    blur_px = math.sqrt(fit.blur_px**2 + patch.grid[2] * patch.grid[3] / 12)
    return PlatePixels(
        patch.light.reshape(-1)[used].astype(float),
        weights / float(weights.mean()),
        units[:count],
        rest[:count],
        places.reshape(size, 2)[used] * side_mm,
        math.nan,  # known once a veil is taken off
        max(mm_per_px * blur_px, MIN_BLUR_MM),
    )


def _unveiled(seen: PlatePixels, fit: PlateFit, geometry: PlateGeometry, veil: Veil) -> tuple[PlatePixels, Array]:
    """The pixels without a veil, and the reflectances of the plate's parts to begin with."""
    n = geometry.n
    across, along = (seen.places_mm.T / geometry.side_mm * n - 0.5).astype(np.float32)
    veiled = cv2.remap(veil.light.astype(np.float32), across, along, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    pixels = seen._replace(light=seen.light - np.asarray(veiled, float).reshape(-1), level=veil.level)
    at_cells = veil.light.reshape(n // 2, 2, n // 2, 2).mean(axis=(1, 3))
    markers = fit.markers - at_cells[[0, 0, 0, -1, -1], [0, 0, -1, -1, 0]]
    first = np.array([DARK_SHARE * veil.level, fit.gap - float(veil.light.mean()), *markers])
    return pixels, np.clip(first / veil.level, *ALBEDO)


@lru_cache
def _centres_mm(geometry: PlateGeometry) -> Array:
    """Centres of the units, in the order of the symbols' units, shape (units, 2). [mm]"""
    middle = unit_edges(geometry).mean(axis=1) * geometry.side_mm
    flat = unit_index(geometry.n).reshape(-1)
    return np.stack([middle[flat % geometry.n], middle[flat // geometry.n]], axis=1)


@lru_cache
def _spot_shapes(pitch_mm: float) -> Array:
    """Centre [mm], inverse shape xx, xy, yy [1/mm2] and mean radius [mm] of the spots, shape (6, spots)."""
    found = []
    for long_mm, short_mm, turn_deg in SPOTS_MM:
        cosine, sine = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
        axes = np.array([[cosine, sine], [-sine, cosine]])
        form = axes.T @ np.diag([long_mm**-2, short_mm**-2]) @ axes
        radius_mm = math.sqrt(long_mm * short_mm)
        for x in (-pitch_mm / 3, 0.0, pitch_mm / 3):
            for y in (-pitch_mm / 3, 0.0, pitch_mm / 3):
                found.append((x, y, form[0, 0], form[0, 1], form[1, 1], radius_mm))
    return np.ascontiguousarray(np.array(found).T)
