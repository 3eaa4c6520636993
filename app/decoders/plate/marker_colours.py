"""How red the triangle of a fitted plate is, and how green its squares are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from app.compiled import ieee_kernel
from app.decoders.plate.colour import MarkerSignal
from app.decoders.plate.homography import project
from app.decoders.plate.layout import unit_edges
from app.markers.plate import PlateGeometry

Floats = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]

LEVEL_QUANTILES = (0.15, 0.85)
"""Shares of the units below the level of dark ones and of light ones. Source: by hand."""
MIN_LEVEL_CONTRAST = 0.2
"""[light units] between both levels, to call a triangle black. Source: by hand."""
SPOT_PITCH = 0.03
"""[plate sides] between the 3 x 3 points that are sampled on a marker. Source: chosen by hand; half a marker is 0.115
on 8 x 8, 0.077 on 12 x 12."""
_SPOTS = np.array([(x, y) for x in (-SPOT_PITCH, 0.0, SPOT_PITCH) for y in (-SPOT_PITCH, 0.0, SPOT_PITCH)])

TRIANGLE_SPOT, REST_SPOT, BESIDE_SPOTS, SPOT_REACH = (
    (0.28, 0.28),
    (0.75, 0.75),
    ((-0.45, 0.3), (0.3, -0.45), (-0.45, -0.45)),
    0.09,
)
"""[sides of the triangle's cell] from its outer corner: a spot in the triangle, one in the other half, three beside the
plate, and half the side of all. Source: chosen by hand: as far from the edges as the cell allows."""


@dataclass(frozen=True, slots=True)
class MarkerColours:
    """How red the triangle of a fitted plate is, and how green its squares are.

    Attributes
    ----------
    margins : ndarray, shape (4,)
        How far the signal of the triangle and the squares stands out of the units', in their spreads.
    tints : ndarray, shape (4,)
        Red of the triangle, green of the squares above their other colours, as shares of the median square's; grey
        being the units' colour. A black square in the dark has none, whatever the ratio of its few grey levels.
    cast : ndarray, shape (2,)
        Blue and red of the units as shares of their green.
    rest : float
        Red of the other half of the triangle's cell over the triangle's own: near 1 where the marker is a square.
    beside : float
        The same of the reddest spot beside the plate: above 1 where red spreads from there into a dark corner.
    paleness : float
        The lower of blue and red of the palest square, from 0 as of dark units to 1 as of light ones: near 1 where the
        square is white.
    triangle_red : float
        Red of the triangle on the same scale: below 0 where it is black.
    """

    margins: Floats
    tints: Floats
    cast: Floats
    rest: float = 0.0
    beside: float = 0.0
    paleness: float = 0.0
    triangle_red: float = 1.0


def red_around_triangle(
    image: npt.NDArray[np.uint8], plate_from_image: Floats, geometry: PlateGeometry, cast: Floats
) -> tuple[float, float]:
    """Red of the other half of the triangle's cell and beside the plate, over the triangle's own.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3)
    plate_from_image : ndarray, shape (3, 3)
    geometry : PlateGeometry
    cast : ndarray, shape (2,)
        Blue and red of the units as shares of their green.

    Returns
    -------
    rest, beside : float
        As of `MarkerColours`.
    """
    edges = unit_edges(geometry)
    low, side = float(edges[0, 0]), float(edges[1, 1] - edges[0, 0])
    spots = np.array([TRIANGLE_SPOT, REST_SPOT, *BESIDE_SPOTS])
    reach = SPOT_REACH * np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)])
    points: Floats = low + side * (spots[:, None] + reach).reshape(-1, 2)
    at_px = project(np.asarray(np.linalg.inv(plate_from_image), float), points).astype(np.float32)
    seen: npt.NDArray[Any] = cv2.remap(
        image, at_px[None, :, 0], at_px[None, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )[0]
    blue, green, red = seen.astype(float).reshape(len(spots), len(reach), 3).mean(axis=1).T
    tints = red / cast[1] - np.maximum(green, blue / cast[0])
    shares = tints[1:] / max(float(tints[0]), 1.0)
    return float(shares[0]), float(shares[1:].max())


def marker_colours(signal: MarkerSignal, plate_from_image: Floats, centroids: Floats, units: Floats) -> MarkerColours:
    """Colours of a fitted plate's markers.

    Parameters
    ----------
    signal : MarkerSignal
    plate_from_image : ndarray, shape (3, 3)
        Full-resolution pixels to plate coordinates.
    centroids : ndarray, shape (4, 2)
        Of the markers, in plate coordinates.
    units : ndarray, shape (U, 2)
        Centres of the units, in plate coordinates.
    """
    points = np.concatenate([(centroids[:, None] + _SPOTS[None]).reshape(-1, 2), units])
    planes = signal.planes
    seen = np.empty((4, len(points)))
    sampled = _Signal(signal.opponent, planes.blue, planes.green, planes.red, signal.scale)
    _look_up(np.asarray(np.linalg.inv(plate_from_image), float), points, sampled, seen)
    strength, blue, green, red = seen
    spots = 4 * len(_SPOTS)
    cast = np.array([plane[spots:].sum() for plane in (blue, green, red)])
    cast = np.maximum(cast, 1.0) / max(cast[1], 1.0)
    sign = np.array([1, -1, -1, -1])
    inside = strength[:spots].reshape(4, -1).mean(axis=1)
    between = strength[spots:]
    paleness, triangle_red = _between_levels(blue, red, spots)
    # as grey units would look in the same light
    blue, green, red = (
        plane[:spots].reshape(4, -1).mean(axis=1) / c for plane, c in zip((blue, green, red), cast, strict=True)
    )
    tints = np.where(sign > 0, red - np.maximum(green, blue), green - np.maximum(red, blue))
    return MarkerColours(sign * (inside - between.mean()) / (between.std() + 1.0),
                         tints / max(float(np.sort(tints[1:])[1]), 1.0), cast[[0, 2]],
                         paleness=paleness, triangle_red=triangle_red)  # fmt: skip


def _between_levels(blue: Floats, red: Floats, spots: int) -> tuple[float, float]:
    """`MarkerColours.paleness` and `triangle_red`; the latter is 0.5 where the units have no two levels.

    Parameters
    ----------
    blue, red : ndarray, shape (points,)
        At the spots of the markers, then at the units.
    spots : int
        Of all markers.
    """
    planes = np.stack([blue, red])
    units = np.sort(planes[:, spots:], axis=1)
    low, high = (units[:, int(share * (units.shape[1] - 1))] for share in LEVEL_QUANTILES)
    markers = (planes[:, :spots].reshape(2, 4, -1).mean(axis=2).T - low) / np.maximum(high - low, 1.0)
    has_levels = high[1] - low[1] > MIN_LEVEL_CONTRAST * high[1]  # an all-light plate has none
    return float(markers[1:].min(axis=1).max()), float(markers[0, 1]) if has_levels else 0.5


class _Signal(NamedTuple):
    """What is sampled: attributes of `MarkerSignal` and its planes, shape (H // scale, W // scale)."""

    opponent: npt.NDArray[np.int16]
    blue: Grey
    green: Grey
    red: Grey
    scale: int


@ieee_kernel
def _look_up(image_from_plate: Floats, points: Floats, signal: _Signal, seen: Floats) -> None:
    """Set the signal, blue, green and red at points of the plate, shape (4, points): those of the nearest pixels."""
    height, width = signal.opponent.shape
    scale = signal.scale
    m = image_from_plate
    for k in range(points.shape[0]):
        u = points[k, 0]
        v = points[k, 1]
        w = m[2, 0] * u + m[2, 1] * v + m[2, 2]
        x = ((m[0, 0] * u + m[0, 1] * v + m[0, 2]) / w - (scale - 1) / 2) / scale
        y = ((m[1, 0] * u + m[1, 1] * v + m[1, 2]) / w - (scale - 1) / 2) / scale
        column = int(np.rint(min(max(x, 0.0), width - 1.0)))
        row = int(np.rint(min(max(y, 0.0), height - 1.0)))
        seen[0, k] = signal.opponent[row, column]
        seen[1, k] = signal.blue[row, column]
        seen[2, k] = signal.green[row, column]
        seen[3, k] = signal.red[row, column]
