"""Shadows: how much light arrives on each spot of the road."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from app.simulation.plate_face import smooth_noise
from app.simulation.plate_scene import PlateScene, Shadow

FloatArray = npt.NDArray[np.float32]
Matrix = npt.NDArray[np.float64]
_CELLS, _CELL_M = 600, 0.015


@dataclass(frozen=True, slots=True)
class Shade:
    """Light on a square patch of road; beyond it the values of its border hold.

    Attributes
    ----------
    share : ndarray of float32, shape (N, N)
        Of the full light, 0 to 1; a single value is everywhere.
    cell_from_ground : ndarray, shape (2, 3)
        Affine map from the ground frame to columns and rows.
    """

    share: FloatArray
    cell_from_ground: Matrix

    @property
    def varies(self) -> bool:
        """There are shadows."""
        return self.share.size > 1


NO_SHADE = Shade(np.ones((1, 1), np.float32), np.zeros((2, 3)))


def shade_map(scene: PlateScene) -> Shade:
    """Light on the road around a scene's first face."""
    if scene.shadow.is_none or not scene.faces:
        return NO_SHADE
    first = scene.faces[0]
    centre = np.array([_CELLS / 2 - first.ahead_m / _CELL_M, _CELLS / 2 - first.left_m / _CELL_M])
    return Shade(_shade_field(scene.shadow), np.column_stack([np.eye(2) / _CELL_M, centre]))


@lru_cache(maxsize=8)
def _shade_field(shadow: Shadow) -> FloatArray:
    """Share of light, columns ahead, rows to the left."""
    at_m = (np.arange(_CELLS, dtype=np.float32) - _CELLS / 2) * np.float32(_CELL_M)
    field = np.ones((_CELLS, _CELLS), np.float32)
    if shadow.edge_light < 1:
        angle = math.radians(shadow.edge_angle_deg)
        across = at_m[None, :] * math.cos(angle) + at_m[:, None] * math.sin(angle) - shadow.edge_offset_m
        lit = 1 / (1 + np.exp(np.clip(-across / max(shadow.penumbra_m / 2, 1e-3), -40, 40)))
        field *= np.asarray(shadow.edge_light + (1 - shadow.edge_light) * lit, np.float32)
    if shadow.dapple_light < 1:
        rng = np.random.default_rng(shadow.seed)
        leaves = 0.7 * smooth_noise((_CELLS, _CELLS), shadow.dapple_m / _CELL_M, rng)
        leaves += 0.3 * smooth_noise((_CELLS, _CELLS), max(shadow.dapple_m / _CELL_M / 2.5, 2), rng)
        gaps = 1 / (1 + np.exp(-(leaves - 0.5) / max(shadow.dapple_softness, 0.02) * 2))
        field *= np.asarray(shadow.dapple_light + (1 - shadow.dapple_light) * gaps, np.float32)
    return field
