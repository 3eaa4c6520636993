"""Colours of a plate's markers: how red the triangle is, how green the squares are, and whether that makes a plate.

`measure_marker_colours` measures them under a homography. `is_promising` judges them after the coarse stage of a fit,
`find_wrong_colour` after the last.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from app.compiled import ieee_kernel
from app.decoders.plate.detect_blobs import MarkerSignal
from app.decoders.plate.fit import project
from app.decoders.plate.pose import marker_centroids, unit_centres, unit_edges
from app.markers.plate import PlateGeometry
from app.markers.reading import PlateOutcome
from app.values import Floats

Grey = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class MarkerColours:
    """How red the triangle of a fitted plate is, and how green its squares are."""

    # (4,) how far the signal of the triangle and the squares stands out of the units', in their spreads
    margins: Floats
    # (4,) red of the triangle, green of the squares above their other colours, as shares of the median square's; grey
    # being the units' colour. A black square in the dark has none, whatever the ratio of its few grey levels
    tints: Floats
    cast: Floats  # (2,) blue and red of the units as shares of their green
    # red of the other half of the triangle's cell over the triangle's own: near 1 where the marker is a square
    rest: float = 0.0
    # the same of the reddest spot beside the plate: above 1 where red spreads from there into a dark corner
    beside: float = 0.0
    # the lower of blue and red of the palest square, from 0 as of dark units to 1 as of light ones: near 1 where the
    # square is white
    paleness: float = 0.0
    triangle_red: float = 1.0  # red of the triangle on the same scale: below 0 where it is black


# --- which colours a plate has ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class PromisingColours:
    """Colours after the coarse stage of a fit with which the fit goes on.

    Chosen for speed: most of what is no plate ends here. `python -m benchmarks.plates` counts the plates that are read,
    and measures the time.
    """

    margin: float = 1.5  # [standard deviations] of the second weakest marker
    tint: float = 0.4  # of the second weakest marker
    weakest_margin: float = 1.0  # [standard deviations]
    weakest_tint: float = 0.3
    # share of the variance that is explained [1], or margin of the second weakest marker [standard deviations], with
    # which the weakest may be missing
    clear_explained: float = 0.93
    clear_margin: float = 8.0
    cast: tuple[float, float] = (0.74, 1.35)  # blue and red of the units over their green


@dataclass(frozen=True, slots=True)
class ColoursAlone:
    """Colours of a plate that no registry confirms: beyond them it may be a look-alike.

    Each value lies between plates that were read and what look-alikes have in `python -m benchmarks.plates false --sets
    look-alikes` with the seed beside it. `python -m benchmarks.plates.thresholds` decodes frames without the margins,
    the tints or the cast.
    """

    # [standard deviations] of every marker. A board with three green corners was read with 1.5 (seed 2712)
    min_margin: float = 2.2
    # of squares and of the triangle. Boards with red fringes on dark corners have 0.39 and 0.48 (seeds 2711, 2712)
    min_tint: float = 0.35
    min_triangle_tint: float = 0.5
    # 144 plates that were read have at most 0.60 below 1.5 px a unit, 0.53 below 2 and 0.35 above; red squares have 0.7
    # to 1.2
    max_rest: float = 0.65
    # 171 plates that were read have at most 0.91 below 2 px a unit and 0.47 above; a look-alike beside a red sign,
    # whose red spread into its dark corner, has 15 to 50 (`--sets free --seed 930`)
    max_beside: float = 1.0
    # paleness above which a square is white unless all margins [standard deviations] are larger than this. 423 plates
    # that were read have at most 0.57, but 0.75 in dapple and 1.05 in glare, with margins from 4.7 on; one with a white
    # square on a pink road has 0.91 and 2.2 (seed 3504)
    max_paleness: float = 0.8
    pale_margin: float = 3.5
    # below it the triangle is black. The same plates have -0.24 at least; one with a black square in its place has
    # -0.69 (seed 3507)
    min_triangle_red: float = -0.4
    cast: tuple[float, float] = (
        0.65,
        1.5,
    )  # blue and red of the units over their green, beyond which they are not grey


PROMISING = PromisingColours()
ALONE = ColoursAlone()
MIN_MARGIN = 1.0
"""[standard deviations] colour margin of a marker that is there, whatever the registry knows."""


def is_promising(colours: MarkerColours, explained: float) -> bool:
    """Whether a coarse fit is refined: most of what is no plate lacks colours where a plate has them."""
    margins, tints = np.sort(colours.margins), np.sort(colours.tints)
    has_weakest = margins[0] >= PROMISING.weakest_margin and tints[0] >= PROMISING.weakest_tint
    is_clear = explained >= PROMISING.clear_explained or margins[1] >= PROMISING.clear_margin
    return bool(
        (has_weakest or is_clear)
        and margins[1] >= PROMISING.margin
        and tints[1] >= PROMISING.tint
        and PROMISING.cast[0] < colours.cast.min()
        and colours.cast.max() < PROMISING.cast[1]
    )


def count_clear(colours: MarkerColours) -> int:
    """Markers whose colours need no registry to confirm them."""
    pale = _is_pale(colours)
    return 4 - int(pale.sum())


def _is_pale(colours: MarkerColours) -> npt.NDArray[np.bool_]:
    min_tints = np.array([ALONE.min_triangle_tint, *(3 * [ALONE.min_tint])])
    pale: npt.NDArray[np.bool_] = (colours.margins < ALONE.min_margin) | (colours.tints < min_tints)
    return pale


def find_wrong_colour(colours: MarkerColours) -> tuple[PlateOutcome, str] | None:
    """A marker or units whose colours need a registry to confirm them: a look-alike or a worn plate."""
    pale = _is_pale(colours)
    if pale[0]:
        return PlateOutcome.RED_MARKER_MISSING, "the red triangle is hardly red"
    if colours.beside > ALONE.max_beside:
        return PlateOutcome.RED_MARKER_MISSING, "the red spreads from beside the plate"
    if colours.rest > ALONE.max_rest:
        return PlateOutcome.RED_MARKER_MISSING, "the red marker is a square, not a triangle"
    if colours.triangle_red < ALONE.min_triangle_red:
        return PlateOutcome.RED_MARKER_MISSING, "the red triangle is as dark as the dark units"
    if pale.any():
        return PlateOutcome.GREEN_MARKER_MISSING, "a green square is hardly green"
    if colours.paleness > ALONE.max_paleness and colours.margins.min() < ALONE.pale_margin:
        return PlateOutcome.GREEN_MARKER_MISSING, "a green square is as light as the light units"
    if colours.cast.min() < ALONE.cast[0] or colours.cast.max() > ALONE.cast[1]:
        return PlateOutcome.CELLS_UNDECODABLE, "the units are coloured"
    return None


# --- how they are measured ----------------------------------------------------------------------------------------

SPOT_PITCH = 0.03
"""[plate sides] between the 3 x 3 points that are sampled on a marker; half a marker is 0.115 on 8 x 8, 0.077 on
12 x 12."""
_SPOTS = np.array([(x, y) for x in (-SPOT_PITCH, 0.0, SPOT_PITCH) for y in (-SPOT_PITCH, 0.0, SPOT_PITCH)])
_LEVEL_SHARES = (0.15, 0.85)
"""[1] shares of the units below the level of dark ones and of light ones."""
_MIN_LEVEL_CONTRAST = 0.2
"""[light units] between both levels, to call a triangle black."""
_TRIANGLE_SPOT, _REST_SPOT, _BESIDE_SPOTS = (0.28, 0.28), (0.75, 0.75), ((-0.45, 0.3), (0.3, -0.45), (-0.45, -0.45))
"""[sides of the triangle's cell] from its outer corner: middles of a spot in the triangle, of one in the other half,
of three beside the plate, as far from the edges as the cell allows."""
_SPOT_REACH = 0.09
"""[sides of the triangle's cell] half the side of each of these spots."""


class _Signal(NamedTuple):
    """What is sampled: attributes of `MarkerSignal` and its planes, shape (H // scale, W // scale)."""

    opponent: npt.NDArray[np.int16]
    blue: Grey
    green: Grey
    red: Grey
    scale: int


def measure_marker_colours(signal: MarkerSignal, plate_from_image: Floats, geometry: PlateGeometry) -> MarkerColours:
    """Colours of a fitted plate's markers in a signal at reduced resolution; `plate_from_image` is of full pixels."""
    points = np.concatenate(
        [(marker_centroids(geometry)[:, None] + _SPOTS[None]).reshape(-1, 2), unit_centres(geometry)]
    )
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
    return MarkerColours(
        margins=sign * (inside - between.mean()) / (between.std() + 1.0),
        tints=tints / max(float(np.sort(tints[1:])[1]), 1.0),
        cast=cast[[0, 2]],
        paleness=paleness,
        triangle_red=triangle_red,
    )


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
    low, high = (units[:, int(share * (units.shape[1] - 1))] for share in _LEVEL_SHARES)
    markers = (planes[:, :spots].reshape(2, 4, -1).mean(axis=2).T - low) / np.maximum(high - low, 1.0)
    has_levels = high[1] - low[1] > _MIN_LEVEL_CONTRAST * high[1]  # an all-light plate has none
    return float(markers[1:].min(axis=1).max()), float(markers[0, 1]) if has_levels else 0.5


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


def with_red_around(
    colours: MarkerColours, image: npt.NDArray[np.uint8], plate_from_image: Floats, geometry: PlateGeometry
) -> MarkerColours:
    """Colours with `rest` and `beside`: red of the other half of the triangle's cell, and beside the plate."""
    edges = unit_edges(geometry)
    low, side = float(edges[0, 0]), float(edges[1, 1] - edges[0, 0])
    spots = np.array([_TRIANGLE_SPOT, _REST_SPOT, *_BESIDE_SPOTS])
    reach = _SPOT_REACH * np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)])
    points: Floats = low + side * (spots[:, None] + reach).reshape(-1, 2)
    at_px = project(np.asarray(np.linalg.inv(plate_from_image), float), points).astype(np.float32)
    seen = cv2.remap(image, at_px[None, :, 0], at_px[None, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]
    blue, green, red = seen.astype(float).reshape(len(spots), len(reach), 3).mean(axis=1).T
    tints = red / colours.cast[1] - np.maximum(green, blue / colours.cast[0])
    shares = tints[1:] / max(float(tints[0]), 1.0)
    return replace(colours, rest=float(shares[0]), beside=float(shares[1:].max()))
