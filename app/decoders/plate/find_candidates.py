"""What may be a plate in a frame: quadruples of markers whose colours and grid make a fit worth its time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.compiled import ieee_kernel, step
from app.decoders.plate.detect_blobs import MarkerSignal, Planes, coarse_ratio_signal, difference_signal, ratio_signal
from app.decoders.plate.detect_quads import FOUND_ALL, MARKER_RATIO, MarkerQuad, detect_marker_quads
from app.decoders.plate.marker_colours import SPOT_PITCH
from app.decoders.plate.pose import marker_centroids, unit_centres
from app.markers.plate import SIZES, PlateGeometry
from app.values import Floats

# === Candidates that are no plate, found out before they are fitted: odds from cheap features of the first homography.
#
# A fit costs milliseconds, these features microseconds: how the markers' colours stand out, how grey the units are, and
# whether they are as uniform within and as different between each other as light and dark units.


Grey = npt.NDArray[np.uint8]

UNIT_REACH = 0.3
"""[units] from a unit's centre to the four points that are sampled around it. Well inside of the unit, although the
first homography errs by a tenth of one."""
ROAD_OFFSET = 0.08
"""[plate sides] outside of the plate's edge where the road is sampled. Three units of blur."""
ROAD_POINTS = 6
"""[points] of the road along each side."""
WORN_RATIO = 0.95
"""[1] usual measured distance of marker centres over a marker's side, over `MARKER_RATIO`. Blur makes markers
larger."""
MIN_DEPTH = 1e-9
"""[1] denominator of a homography below which the plate is not in front of the camera. Source: rounding."""
FEATURES = (
    "weakest margin", "second margin", "third margin", "best margin", "weakest tint", "second tint", "best tint",
    "blue cast", "red cast", "rank", "contrast", "uniformity", "two levels", "road", "size", "size squared",
    "side ratio", "all squares",
)  # fmt: skip
"""Columns of `candidate_features`. Margins, tints and cast as of `MarkerColours`, sorted, margins as asinh(margin / 2);
rank of `MarkerQuad`; logarithms of the units' spread over their mean, of the variance within units over that between,
and of the road's spread over that of the units; share of their variance that two levels explain; size as log10 [px^2];
square of the logarithm by which the markers are too small or large; whether all green squares were seen."""
(BEST_MARGIN, WEAKEST_TINT, SECOND_TINT, BEST_TINT, BLUE_CAST, RED_CAST, RANK, CONTRAST, UNIFORMITY, TWO_LEVELS, ROAD,
 SIZE, SIZE2, SIDE_RATIO, ALL_SQUARES) = range(3, len(FEATURES))  # fmt: skip
WEAKEST_MARGIN = 0
MAX_RANK, USUAL_SIZE = 12.0, 3.5
"""[log odds, log10 px^2] rank above which none counts more, and size about which the squares are taken."""
HIDDEN_LOG_ODDS = -5.0
"""[log odds] that a marker of a plate is hidden."""
MIN_LOG_ODDS = -5.0
"""[log odds] below which a candidate is not fitted. Source: decision record 0010."""
WEIGHTS = np.array(
    [
        3.004,  # weakest margin
        0.098,  # second margin
        -0.217,  # third margin
        0.465,  # best margin
        2.396,  # weakest tint
        0.183,  # second tint
        -0.396,  # best tint
        -13.747,  # blue cast
        -5.416,  # red cast
        0.605,  # rank
        -1.039,  # contrast
        -1.091,  # uniformity
        -5.422,  # two levels
        -3.311,  # road
        -1.606,  # size
        -1.130,  # size squared
        -1.326,  # side ratio
        -1.103,  # all squares
        0.761,  # constant
    ]
)
"""[log odds] for a unit of each feature. Source: `python -m benchmarks.training.candidate_filter --frames 300 --seed
31`, whose ROC on the next seed loses 7 of 698 plates at -5 and keeps 1.6 % of 54,570 candidates that are none."""


class _View(NamedTuple):
    """What is sampled: attributes of `MarkerSignal` and its planes, shape (H // scale, W // scale)."""

    opponent: npt.NDArray[np.int16]
    blue: Grey
    green: Grey
    red: Grey
    luma: Grey
    scale: int


class _Layout(NamedTuple):
    """Centroids of the markers, shape (4, 2), centres of the units, shape (U, 2), a unit's side. [plate sides]"""

    markers: Floats
    units: Floats
    unit: float


def candidate_features(signal: MarkerSignal, quads: Sequence[MarkerQuad], geometry: PlateGeometry) -> Floats:
    """Features of candidates under a geometry, shape (Q, 18), columns named by `FEATURES`; NaN where one is no plate.

    Parameters
    ----------
    signal : MarkerSignal
        In which they were found.
    """
    planes = signal.planes
    view = _View(signal.opponent, planes.blue, planes.green, planes.red, planes.luma, signal.scale)
    layout = _Layout(marker_centroids(geometry), unit_centres(geometry), geometry.unit_mm / geometry.side_mm)
    features = np.empty((len(quads), len(FEATURES)))
    features[:, RANK] = [min(quad.rank, MAX_RANK) for quad in quads]
    features[:, SIDE_RATIO] = [size_misfit(quad, geometry) ** 2 for quad in quads]
    features[:, ALL_SQUARES] = [quad.found == FOUND_ALL for quad in quads]
    _set_features(view, layout, np.array([quad.centroids_px for quad in quads]).reshape(-1, 4, 2), features)
    return features


def candidate_log_odds(signal: MarkerSignal, quads: Sequence[MarkerQuad], geometry: PlateGeometry) -> Floats:
    """Logarithms of the odds that candidates are plates of a geometry whose fit succeeds, shape (Q,).

    Parameters as of `candidate_features`. A mixture: all markers are seen, or snow, sand or a mirrored light hides the
    weakest one, which then counts as much as the second. Source: logistic regression, fitted like `WEIGHTS`.
    """
    features = candidate_features(signal, quads, geometry)
    seen = features @ WEIGHTS[:-1] + WEIGHTS[-1]
    features[:, WEAKEST_MARGIN] = features[:, WEAKEST_MARGIN + 1]
    features[:, WEAKEST_TINT] = features[:, SECOND_TINT]
    hidden = features @ WEIGHTS[:-1] + WEIGHTS[-1] + HIDDEN_LOG_ODDS
    seen, hidden = (np.where(np.isfinite(log_odds), log_odds, -np.inf) for log_odds in (seen, hidden))
    return np.logaddexp(seen, hidden)


def size_misfit(quad: MarkerQuad, geometry: PlateGeometry) -> float:
    """Logarithm of the measured ratio of sizes (`MarkerQuad.size_ratio`) over the usual one of a geometry."""
    return math.log(quad.size_ratio / (WORN_RATIO * MARKER_RATIO[geometry.n]))


@step
def _set_basis(points: Floats, basis: Floats) -> bool:
    """Set the matrix that takes the three unit vectors, and their sum, to four points in homogeneous coordinates."""
    x1, y1 = points[0, 0], points[0, 1]
    x2, y2 = points[1, 0], points[1, 1]
    x3, y3 = points[3, 0], points[3, 1]
    x4, y4 = points[2, 0], points[2, 1]
    det = x1 * (y2 - y3) + x2 * (y3 - y1) + x3 * (y1 - y2)
    if abs(det) < MIN_DEPTH:
        return False
    a = (x4 * (y2 - y3) + x2 * (y3 - y4) + x3 * (y4 - y2)) / det
    b = (x1 * (y4 - y3) + x4 * (y3 - y1) + x3 * (y1 - y4)) / det
    c = (x1 * (y2 - y4) + x2 * (y4 - y1) + x4 * (y1 - y2)) / det
    basis[0, 0], basis[0, 1], basis[0, 2] = a * x1, b * x2, c * x3
    basis[1, 0], basis[1, 1], basis[1, 2] = a * y1, b * y2, c * y3
    basis[2, 0], basis[2, 1], basis[2, 2] = a, b, c
    return True


@step
def _set_homography(source: Floats, target: Floats, matrix: Floats) -> bool:
    """Set the homography that takes four points to four others, the ninth entry not normalised."""
    first = np.empty((3, 3))
    second = np.empty((3, 3))
    if not (_set_basis(source, first) and _set_basis(target, second)):
        return False
    adjugate = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            i1, i2, j1, j2 = (j + 1) % 3, (j + 2) % 3, (i + 1) % 3, (i + 2) % 3
            adjugate[i, j] = first[i1, j1] * first[i2, j2] - first[i1, j2] * first[i2, j1]
    for i in range(3):
        for j in range(3):
            matrix[i, j] = 0.0
            for k in range(3):
                matrix[i, j] += second[i, k] * adjugate[k, j]
    return True


@step
def _pixel(matrix: Floats, u: float, v: float, width: int, height: int) -> tuple[int, int]:
    """Row and column of the signal's pixel that shows a point of the plate, the nearest one at the frame's edge."""
    w = matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2]
    x = (matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]) / w
    y = (matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2]) / w
    column = int(min(max(x + 0.5, 0.0), width - 1.0))
    row = int(min(max(y + 0.5, 0.0), height - 1.0))
    return row, column


@step
def _is_in_front(matrix: Floats) -> bool:
    """Whether all corners of the plate are on one side of the line that maps to infinity."""
    low = 1e300
    high = -1e300
    for k in range(4):
        u = 1.1 if k == 1 or k == 2 else -0.1
        v = 1.1 if k >= 2 else -0.1
        w = matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2]
        low = min(low, w)
        high = max(high, w)
    return low > 0.0 or high < 0.0


@step
def _sort(values: Floats) -> None:
    """Sort a few values in place."""
    for i in range(1, values.shape[0]):
        value = values[i]
        j = i
        while j > 0 and values[j - 1] > value:
            values[j] = values[j - 1]
            j -= 1
        values[j] = value


@step
def _set_colour_features(view: _View, layout: _Layout, matrix: Floats, features: Floats) -> None:
    """Set margins, tints and casts, as `measure_marker_colours` does."""
    height, width = view.opponent.shape
    units = layout.units.shape[0]
    mean = 0.0
    square = 0.0
    blue = 1.0
    green = 1.0
    red = 1.0
    for k in range(units):
        row, column = _pixel(matrix, layout.units[k, 0], layout.units[k, 1], width, height)
        o = float(view.opponent[row, column])
        mean += o
        square += o * o
        blue += view.blue[row, column]
        green += view.green[row, column]
        red += view.red[row, column]
    mean /= units
    spread = math.sqrt(max(square / units - mean * mean, 0.0)) + 1.0
    cast_blue = blue / green
    cast_red = red / green
    margins = np.empty(4)
    tints = np.empty(4)
    for k in range(4):
        o = 0.0
        b = 0.0
        g = 0.0
        r = 0.0
        for i in range(-1, 2):
            for j in range(-1, 2):
                u = layout.markers[k, 0] + i * SPOT_PITCH
                row, column = _pixel(matrix, u, layout.markers[k, 1] + j * SPOT_PITCH, width, height)
                o += view.opponent[row, column]
                b += view.blue[row, column] / cast_blue
                g += view.green[row, column]
                r += view.red[row, column] / cast_red
        margin = (o / 9.0 - mean) / spread
        margins[k] = margin if k == 0 else -margin
        tints[k] = (r - max(g, b) if k == 0 else g - max(r, b)) / 9.0
    first = tints[1]
    tint = max(min(first, tints[2]), min(max(first, tints[2]), tints[3]))  # the median square's
    for k in range(4):
        tints[k] = min(max(tints[k] / max(tint, 1.0), -2.0), 3.0)
    _sort(margins)
    _sort(tints)
    for k in range(BEST_MARGIN + 1):
        features[k] = math.asinh(margins[k] / 2.0)
    features[WEAKEST_TINT] = tints[0]
    features[SECOND_TINT] = tints[1]
    features[BEST_TINT] = tints[3]
    features[BLUE_CAST] = abs(math.log(cast_blue))
    features[RED_CAST] = abs(math.log(cast_red))


@step
def _two_level_share(levels: Floats) -> float:
    """Share of the variance of sorted levels that two levels explain, at the best division."""
    count = levels.shape[0]
    total = 0.0
    for k in range(count):
        total += levels[k]
    mean = total / count
    variance = 0.0
    best = 0.0
    below = 0.0
    for k in range(count):
        variance += (levels[k] - mean) ** 2
        below += levels[k]
        above = count - k - 1
        if above > 0:
            apart = below / (k + 1) - (total - below) / above
            best = max(best, apart * apart * (k + 1) * above / count)
    return best / max(variance, 1e-9)


@step
def _road_spread(view: _View, matrix: Floats) -> float:
    """Standard deviation of the luma around the plate. [grey levels]"""
    height, width = view.luma.shape
    mean = 0.0
    square = 0.0
    for side in range(4):
        for k in range(ROAD_POINTS):
            along = (k + 0.5) / ROAD_POINTS
            across = -ROAD_OFFSET if side < 2 else 1.0 + ROAD_OFFSET
            u = along if side % 2 == 0 else across
            v = across if side % 2 == 0 else along
            row, column = _pixel(matrix, u, v, width, height)
            level = float(view.luma[row, column])
            mean += level
            square += level * level
    points = 4 * ROAD_POINTS
    mean /= points
    return math.sqrt(max(square / points - mean * mean, 0.0))


@step
def _set_light_features(view: _View, layout: _Layout, matrix: Floats, features: Floats) -> None:
    """Set contrast, uniformity within units, share of two levels and evenness of the road around."""
    height, width = view.luma.shape
    units = layout.units.shape[0]
    levels = np.empty(units)
    reach = UNIT_REACH * layout.unit
    within = 0.0
    mean = 0.0
    square = 0.0
    for k in range(units):
        unit_sum = 0.0
        unit_square = 0.0
        for i in range(5):
            u = layout.units[k, 0] + (reach if i == 1 or i == 3 else (0.0 if i == 0 else -reach))
            v = layout.units[k, 1] + (0.0 if i == 0 else (reach if i <= 2 else -reach))
            row, column = _pixel(matrix, u, v, width, height)
            level = float(view.luma[row, column])
            unit_sum += level
            unit_square += level * level
        levels[k] = unit_sum / 5.0
        within += unit_square / 5.0 - levels[k] * levels[k]
        mean += levels[k]
        square += levels[k] * levels[k]
    mean /= units
    between = max(square / units - mean * mean, 0.0)
    features[CONTRAST] = math.log(math.sqrt(between) / (mean + 4.0) + 0.02)
    features[UNIFORMITY] = math.log((within / units + 2.0) / (between + 2.0))
    _sort(levels)
    features[TWO_LEVELS] = _two_level_share(levels)
    features[ROAD] = math.log((_road_spread(view, matrix) + 2.0) / (math.sqrt(between) + 2.0))


@ieee_kernel
def _set_features(view: _View, layout: _Layout, centroids_px: Floats, features: Floats) -> None:
    """Set all features that come from pixels and from the size, row by row; NaN where a candidate spans no plate."""
    in_signal = np.empty((4, 2))
    matrix = np.empty((3, 3))
    for row in range(features.shape[0]):
        quad = centroids_px[row]
        for k in range(4):
            for axis in range(2):
                in_signal[k, axis] = (quad[k, axis] - (view.scale - 1) / 2.0) / view.scale
        if not _set_homography(layout.markers, in_signal, matrix) or not _is_in_front(matrix):
            features[row, :] = np.nan
            continue
        _set_colour_features(view, layout, matrix, features[row])
        _set_light_features(view, layout, matrix, features[row])
        right_x = quad[1, 0] - quad[0, 0]
        right_y = quad[1, 1] - quad[0, 1]
        down_x = quad[3, 0] - quad[0, 0]
        down_y = quad[3, 1] - quad[0, 1]
        size = math.log10(max(abs(right_x * down_y - right_y * down_x), 1.0))
        features[row, SIZE] = size
        features[row, SIZE2] = (size - USUAL_SIZE) ** 2


# === What may be a plate in a frame.


SIGNALS = (difference_signal, ratio_signal, coarse_ratio_signal)
"""Signals that are searched, one after the other until a plate is read. Source: decision record 0010."""
MAX_FITS = 5
"""[candidates] that are fitted for one signal. For speed."""
LOG_ODDS_RANGE = 4.0
"""[log odds] by which a candidate may miss the limit under the first geometry, so that the others are tried. For speed:
the colours are the same under all of them."""
SIZE_MISFIT_RANGE = (-0.4, 0.55)
"""[log] measured over usual size of the markers of a geometry that is tried. Wear and blur change the size of
markers."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """Quadruple of markers that may be a plate's, the geometries under which it may, and the log odds of the first.

    The likeliest geometry is the first.
    """

    quad: MarkerQuad
    geometries: tuple[PlateGeometry, ...]
    log_odds: float


def find_candidates(
    planes: Planes, geometries: Sequence[PlateGeometry]
) -> Iterator[tuple[MarkerSignal, list[Candidate]]]:
    """Signals of a frame at half resolution, each with its candidates, the likeliest first."""
    for signal_of in SIGNALS:
        signal = signal_of(planes)
        yield signal, _likely_candidates(signal, detect_marker_quads(signal), geometries)


def _likely_candidates(
    signal: MarkerSignal, quads: Sequence[MarkerQuad], geometries: Sequence[PlateGeometry]
) -> list[Candidate]:
    """Candidates that are worth a fit, each with the geometries under which they are."""
    first = candidate_log_odds(signal, quads, geometries[0]) if quads else np.empty(0)
    near = [
        (quad, float(odds)) for quad, odds in zip(quads, first, strict=True) if odds >= MIN_LOG_ODDS - LOG_ODDS_RANGE
    ]
    if not near:
        return []
    log_odds = {g: candidate_log_odds(signal, [quad for quad, _odds in near], g) for g in geometries[1:]}
    log_odds[geometries[0]] = np.array([odds for _quad, odds in near])
    likely = []
    for k, (quad, _odds) in enumerate(near):
        possible = [g for g in possible_geometries(quad, geometries) if log_odds[g][k] >= MIN_LOG_ODDS]
        if possible:
            possible.sort(key=lambda g: -log_odds[g][k])
            likely.append(Candidate(quad, tuple(possible), float(log_odds[possible[0]][k])))
    return sorted(likely, key=lambda candidate: -candidate.log_odds)[:MAX_FITS]


def possible_geometries(quad: MarkerQuad, geometries: Sequence[PlateGeometry]) -> list[PlateGeometry]:
    """Geometries whose markers have about a candidate's size; 8 x 8 always.

    Stains make markers smaller, and blur makes them larger.
    """
    misfit = {g: size_misfit(quad, g) for g in geometries}
    possible = [g for g in geometries if SIZE_MISFIT_RANGE[0] < misfit[g] < SIZE_MISFIT_RANGE[1] or g.n == SIZES[0]]
    return possible or [min(geometries, key=lambda g: abs(misfit[g]))]
