"""Registered plates that a frame shows without the colours of their markers: under snow, mirrored lights or motion.

The height and the angles of the camera give a bird's-eye view of the road, in which a plate has a known size. Squares
of that size with more edges than the road around them are compared with the patterns of the plates that are registered
nearby: the logarithm of the light, without its slow changes, is correlated with each pattern. The best match is fitted,
and its units must confirm the code, as those of any plate whose colours are missing (`evidence`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from app.decoders.plate import Array
from app.markers.plate import PlateCode, PlateGeometry
from app.sensors.camera import Camera
from app.values import Floats, Floats32

ROAD_M = 0.02
"""[m] distance of the samples of the road that is searched: half a unit."""
LEVELS = 4
"""[images] the frame, and it averaged down to a half, a quarter and an eighth."""
MIN_UNIT_ROWS = 1.2
"""[px] height of a unit in the image from which on a plate is sought, as `follow_plate.MIN_EXPECTED_UNIT_PX`."""
NEAREST_M, FARTHEST_M, REACH_ASIDE_M, WIDENING = 0.8, 12.0, 2.0, 0.15
"""[m, m, m, 1] road that is searched, from the first distance to the second at most; to both sides as far as the third,
and farther by this share of the distance: the lane, and half of each one beside it."""
MAX_PLACES, MIN_BUSY = 5, 0.2
"""[places, log] busiest places that are compared, and how much busier than the road around they are at least."""
LOG_FLOOR = 16.0
"""[grey levels] added before the logarithm, so that noise in the dark stays small."""
FLAT = 0.004
"""[log light] change from sample to sample of an even road, which noise has anyway."""
SLOW_UNITS = 4
"""[units] over which the light is averaged that is taken off before patterns are compared: shadows, mirrored lights."""
PATTERN_BLUR = 0.35
"""[units] blur of a pattern: of the lens and of the samples."""
FLAT_VIEW = 0.02
"""[log light] norm of an even view, which noise has anyway."""
MAX_CODES = 64
"""[codes] that are compared, the first ones: the registry lists the nearest first. For speed."""
MIN_LIKENESS, MAX_FITTED = 0.4, 2
"""[1, places] correlation with a pattern from which on a place is fitted, and how many are. For speed: the units of a
place decide. Source: of plates in snow, sand and dusk and on wet roads, 95 % have more than 0.49."""


class LikelyPlate(NamedTuple):
    """A place of a frame that looks like a registered plate."""

    geometry: PlateGeometry
    corners_px: Floats  # shape (4, 2), clockwise from the triangle's
    tries: int  # shifts, turns and lengths of which this is the best


class _RoadView:
    """A frame seen from above: samples of the road by their place before the camera."""

    def __init__(self, image: Array, camera: Camera) -> None:
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        self._levels: list[Floats32] = [np.asarray(grey, np.float32)]
        while len(self._levels) < LEVELS:
            height, width = (side // 2 for side in self._levels[-1].shape)
            half = cv2.resize(self._levels[-1], (width, height), interpolation=cv2.INTER_AREA)
            self._levels.append(np.asarray(half, np.float32))
        self.camera = camera
        self._from_road = camera.camera_from_vehicle
        self._lens_m = -self._from_road[:, 2] * camera.height_m  # of the road below the camera, in the camera's frame

    def project(self, road_m: Floats) -> Floats:
        """Images of points of the road, shape (N, 2), forward and left of the camera [m]; far outside behind it."""
        in_camera = road_m @ self._from_road[:, :2].T + self._lens_m
        image_px = np.full((len(road_m), 2), -1e4)
        ahead = in_camera[:, 2] > 0.1 * self.camera.height_m
        image_px[ahead] = self.camera.project(in_camera[ahead])
        return image_px

    def sample(self, road_from_view: Floats, width: int, height: int, *, per_sample_px: float, step: int) -> Floats32:
        """Log light of views, shape (views, height, width); NaN outside the frame.

        Parameters
        ----------
        road_from_view : ndarray, shape (views, 3, 3)
            From samples, right and down, to the road, forward and left. [m]
        per_sample_px : float
            Pixels of the frame that a sample stands for: of a frame that is averaged down it is fewer.
        step : int
            Samples from one place that is projected to the next; in between they are interpolated.
        """
        level = min(max(int(math.log2(max(per_sample_px, 1.0))), 0), LEVELS - 1)
        across, down = _interpolation(width, step), _interpolation(height, step)
        right, back = np.meshgrid(np.arange(across.shape[1]) * step, np.arange(down.shape[1]) * step)
        on_view = np.stack([right.ravel(), back.ravel(), np.ones(right.size)])
        road_m = np.asarray(road_from_view[:, :2] @ on_view, float).transpose(0, 2, 1).reshape(-1, 2)
        image_px = self.project(road_m).T.reshape(2, -1, *right.shape)
        at = (down @ ((image_px + 0.5) / (1 << level) - 0.5) @ across.T).astype(np.float32).reshape(2, -1, width)
        seen = cv2.remap(
            self._levels[level], at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=math.nan
        )
        return np.asarray(np.log(np.asarray(seen) + LOG_FLOOR), np.float32).reshape(-1, height, width)


@lru_cache
def _interpolation(size: int, step: int) -> Floats:
    """Weights that give values at 0, 1, ... from those at 0, `step`, ..., shape (size, values)."""
    at = np.arange(size) / step
    return np.asarray(np.maximum(1 - np.abs(at[:, None] - np.arange(math.ceil(at[-1]) + 1)), 0.0))


def find_registered(
    image: Array, camera: Camera, codebook: Sequence[PlateCode], geometries: Sequence[PlateGeometry]
) -> Iterator[LikelyPlate]:
    """Places of a frame that look like a registered plate, the most alike first.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3) or (H, W)
    camera : Camera
        Its mount gives the road.
    codebook : sequence of PlateCode
        Of the plates nearby, the nearest first.
    geometries : sequence of PlateGeometry
        That they may have.
    """
    if not codebook:
        return
    view = _RoadView(image, camera)
    matches: list[tuple[PlateGeometry, Sequence[PlateCode], _Match]] = []
    for geometry in geometries:
        codes = [code for code in codebook[:MAX_CODES] if code.n == geometry.n]
        for middle_m in _busy_places(view, geometry) if codes else ():
            matches.append((geometry, codes, _match(view, geometry, codes, _Place(middle_m), COARSE)))
    for geometry, known, coarse in sorted(matches, key=lambda one: -one[2].likeness)[:MAX_FITTED]:
        if coarse.likeness < MIN_LIKENESS:
            break
        fine = _match(view, geometry, [known[coarse.code]], coarse.place, FINE)
        road_from_plate = fine.place.from_samples(geometry.side_mm / 1000, 1)
        yield LikelyPlate(geometry, view.project((_CORNERS @ road_from_plate.T)[:, :2]), COARSE.tries)


def _busy_places(view: _RoadView, geometry: PlateGeometry) -> list[Floats]:
    """Where the road has more edges than around, in both directions: forward and left, shape (2,). [m]"""
    side_m, camera = geometry.side_mm / 1000, view.camera
    box = round(side_m / ROAD_M)
    far_m = min(math.sqrt(camera.fy_px * camera.height_m * side_m / geometry.n / MIN_UNIT_ROWS), FARTHEST_M)
    found: list[tuple[float, Floats]] = []
    while far_m > 2 * NEAREST_M:
        near_m, aside_m = far_m / 2.3, REACH_ASIDE_M + WIDENING * far_m
        road_from_view = np.array([[0, -ROAD_M, far_m], [-ROAD_M, 0, aside_m], [0, 0, 1.0]])
        shape = int(2 * aside_m / ROAD_M), int((far_m - near_m) / ROAD_M)
        per_sample_px = camera.fx_px * ROAD_M / (far_m + near_m)
        seen = view.sample(road_from_view[None], *shape, per_sample_px=per_sample_px, step=8)[0]
        inside = np.isfinite(seen)
        busy = _busier(np.where(inside, seen, 0.0).astype(np.float32), box)
        busy[cv2.erode(inside.astype(np.uint8), np.ones((box, box), np.uint8)) == 0] = -math.inf
        for _ in range(MAX_PLACES):
            _least, most, _where, (x, y) = cv2.minMaxLoc(busy)
            if most < MIN_BUSY:
                break
            found.append((most, (road_from_view @ (x, y, 1.0))[:2]))
            busy[max(y - box // 2, 0) : y + box // 2 + 1, max(x - box // 2, 0) : x + box // 2 + 1] = -math.inf
        far_m /= 2.2
    return [place_m for _most, place_m in sorted(found, key=lambda one: -one[0])[:MAX_PLACES]]


def _busier(seen: Floats32, box: int) -> Floats32:
    """How much more the light changes within a box than around it, along the direction where that is less. [log]"""
    least = np.full(seen.shape, math.inf, np.float32)
    for kernel in (np.array([[-1.0, 0.0, 1.0]]), np.array([[-1.0], [0.0], [1.0]])):
        change = np.abs(cv2.filter2D(seen, cv2.CV_32F, kernel))
        inside, around = cv2.blur(change, (box, box)), cv2.blur(change, (3 * box, 3 * box))
        rest = np.maximum(9 * around - inside, 0) / 8
        least = np.minimum(least, np.log((inside + FLAT) / (rest + FLAT)))
    return least


class _Place(NamedTuple):
    """Where a plate may lie on the road."""

    middle_m: Floats  # shape (2,): forward and left of the camera
    turn_rad: float = 0.0  # to the right
    stretch: float = 1.0  # length over the true one

    def from_samples(self, sample_m: float, width: int) -> Floats:
        """Affine map from samples of a square view of it, right and down, to the road, shape (3, 3). [m]"""
        cosine, sine = math.cos(self.turn_rad), math.sin(self.turn_rad)
        right, back = np.array([-sine, -cosine]), self.stretch * np.array([-cosine, sine])
        road_from_view = np.eye(3)
        road_from_view[:2, :2] = sample_m * np.column_stack([right, back])
        road_from_view[:2, 2] = self.middle_m - road_from_view[:2, :2].sum(axis=1) * (width - 1) / 2
        return road_from_view


class _Grid(NamedTuple):
    """How finely a plate is placed."""

    samples: int  # of a unit
    reach: int  # [units] by which it may be off
    # turns [rad] and stretches about those of the place
    turns: tuple[float, ...]
    stretches: tuple[float, ...]

    @property
    def tries(self) -> int:
        """Shifts by whole units, turns and stretches: other shifts show about the same."""
        return (2 * self.reach + 1) ** 2 * len(self.turns) * len(self.stretches)


COARSE = _Grid(2, 3, tuple(math.radians(turn_deg) for turn_deg in (-20, -10, 0, 10, 20)), (0.92, 1.0, 1.09))
"""A pitch of the vehicle by half a degree lengthens a plate at 5 m by 8 %."""
FINE = _Grid(4, 1, tuple(math.radians(turn_deg) for turn_deg in (-5, 0, 5)), (0.96, 1.0, 1.04))


class _Match(NamedTuple):
    """The best match of patterns about a place."""

    likeness: float
    code: int  # number of the pattern
    place: _Place


_CORNERS = np.array([(-0.5, -0.5, 1), (0.5, -0.5, 1), (0.5, 0.5, 1), (-0.5, 0.5, 1)])  # [plate sides] from its middle


def _match(view: _RoadView, geometry: PlateGeometry, codes: Sequence[PlateCode], about: _Place, grid: _Grid) -> _Match:
    """The best match of any code, of the shifts, turns and stretches of a grid; -1 outside the frame."""
    side = geometry.n * grid.samples
    width = side + 2 * grid.reach * grid.samples
    sample_m = geometry.side_mm / 1000 / side
    distance2_m2 = about.middle_m[0] ** 2 + view.camera.height_m**2
    per_sample_px = view.camera.fy_px * view.camera.height_m * sample_m / distance2_m2 / 1.5
    patterns, used = np.stack([_pattern(code, grid.samples) for code in codes], axis=1), _used(geometry.n, grid.samples)
    turns = [(about.turn_rad + turn, about.stretch * stretch) for turn in grid.turns for stretch in grid.stretches]
    places = [_Place(about.middle_m, turn_rad, stretch) for turn_rad, stretch in turns]
    road_from_view = np.stack([place.from_samples(sample_m, width) for place in places])
    seen = view.sample(road_from_view, width, width, per_sample_px=per_sample_px, step=4)
    slow = SLOW_UNITS * grid.samples + 1
    even = np.stack([one - cv2.blur(one, (slow, slow)) for one in seen])
    samples = np.lib.stride_tricks.sliding_window_view(even, (side, side), axis=(1, 2)).reshape(-1, side * side)
    spread2 = (samples * samples) @ used - (samples @ used) ** 2 / used.sum()
    likeness = (samples @ patterns) / (np.sqrt(np.maximum(spread2, 0.0)) + FLAT_VIEW)[:, None]
    likeness[~np.isfinite(likeness)] = -1.0
    best, code = divmod(int(likeness.argmax()), len(codes))
    number, down, across = np.unravel_index(best, (len(places), width - side + 1, width - side + 1))
    middle_m = (road_from_view[number] @ (across + (side - 1) / 2, down + (side - 1) / 2, 1.0))[:2]
    return _Match(float(likeness[best, code]), code, places[number]._replace(middle_m=middle_m))


@lru_cache
def _used(n: int, samples: int) -> Floats32:
    """Samples of a plate that show its units: 1 there and 0 on the markers, flat."""
    used = np.ones((n, n), np.float32)
    used[:2, :2] = used[:2, -2:] = used[-2:, :2] = used[-2:, -2:] = 0
    return np.kron(used, np.ones((samples, samples), np.float32)).ravel()


@lru_cache(maxsize=512)
def _pattern(code: PlateCode, samples: int) -> Floats32:
    """A plate's units as samples, light positive, without the mean and of norm 1, flat."""
    used = _used(code.n, samples)
    light = np.kron(1 - 2.0 * code.units, np.ones((samples, samples))).astype(np.float32)
    pattern = cv2.GaussianBlur(light, (0, 0), PATTERN_BLUR * samples).ravel() * used
    pattern -= used * (pattern.sum() / used.sum())
    return np.asarray(pattern / max(float(np.linalg.norm(pattern)), 1e-9), np.float32)  # 0 for a blank face
