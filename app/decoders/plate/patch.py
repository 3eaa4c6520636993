"""The image around a plate, in linear light and averaged to about two or three pixels a unit."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.plate.synthesis import Light, PlatePatch

Frame = npt.NDArray[np.uint8]
Array = npt.NDArray[np.float64]

GAMMA = 2.2
"""[1] exponent from encoded values to linear light. Source: close to sRGB, IEC 61966-2-1, without its linear toe."""
MIN_STEP_PX = 1.25
"""[px] below which pixels are not averaged. Source: chosen by hand: resampling by so little costs more than it
saves."""
PATCH_PAD = 0.15
"""[extent of the plate's image] cut out around it, so that the corners may move. Source: chosen by hand."""
MIN_PATCH_EXTENT_PX = 3.0
"""[px] least width and height of a plate's image. Source: chosen by hand."""
MAX_TURNED = 1.5
"""[1] factor by which a turned plate's bounding box is cut finer: root of its area over the plate's. Source: chosen by
hand."""
MIN_PATCH_PX = 4
"""[px] least side of an averaged patch. Source: chosen by hand."""
MIN_WEIGHT_LEVEL = 0.18
"""[encoded level] below which noise in the dark, not the gamma, sets a pixel's weight. Source: chosen by hand."""
_LEVELS = np.linspace(0.0, 1.0, 256)
_LIGHT = (_LEVELS**GAMMA).astype(np.float32)
_LINEAR = _LEVELS.astype(np.float32)
# weight of a pixel's squared error by its light: noise is even in grey levels, so light errs by the slope of the gamma
_WEIGHTS = ((GAMMA * np.maximum(_LEVELS ** (1 / GAMMA), MIN_WEIGHT_LEVEL) ** (GAMMA - 1)) ** -2.0).astype(np.float32)


def cut_patch(image: Frame, corners_px: Array, wanted_px: float, linear: bool) -> PlatePatch | None:
    """The image around a plate, averaged down to about this many pixels along its sides; None outside the image."""
    low, high = corners_px.min(axis=0), corners_px.max(axis=0)
    extent = high - low
    if not (extent > MIN_PATCH_EXTENT_PX).all() or not (extent < 2 * max(image.shape)).all():
        return None
    turned = math.sqrt(float(extent.prod()) / max(cv2.contourArea(corners_px.astype(np.float32)), 1.0))
    step = extent / (wanted_px * min(turned, MAX_TURNED))
    pad = PATCH_PAD * extent + 2 * step
    x0, y0 = (int(v) for v in np.maximum(low - pad, 0))
    x1, y1 = (int(v) for v in np.minimum(high + pad + 1, [image.shape[1], image.shape[0]]))
    wide, tall = ((far - near if s < MIN_STEP_PX else round((far - near) / s))
                  for near, far, s in ((x0, x1, step[0]), (y0, y1, step[1])))  # fmt: skip
    if min(wide, tall) < MIN_PATCH_PX:
        return None
    step = np.array([(x1 - x0) / wide, (y1 - y0) / tall])
    patch = image[y0:y1, x0:x1]
    luma = cv2.cvtColor(patch, cv2.COLOR_BGR2GRAY) if patch.ndim == 3 else np.ascontiguousarray(patch)
    light: Light = np.asarray(cv2.LUT(luma, _LINEAR if linear else _LIGHT), np.float32)
    if (tall, wide) != light.shape:
        light = np.asarray(cv2.resize(light, (wide, tall), interpolation=cv2.INTER_AREA), np.float32)
    weights: Light = np.ones_like(light) if linear else _WEIGHTS[(light * 255 + 0.5).astype(np.uint8)]
    grid = np.array([x0 + (step[0] - 1) / 2, y0 + (step[1] - 1) / 2, step[0], step[1]])
    return PlatePatch(light, weights, grid)
