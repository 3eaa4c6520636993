"""What is not a plate: things on and beside the road that share a plate's colours, corners or grids."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from app.markers.plate import PlateCode, PlateGeometry
from app.sensors.camera import Camera
from app.simulation.plate_face import Face, PlateWear, draw_look, grid_face, plate_face, smooth_noise
from app.simulation.plate_scene import PlacedFace

Image = npt.NDArray[np.uint8]
_WHITE, _BLACK = np.array([0.75, 0.75, 0.75]), np.array([0.04, 0.04, 0.04])
_RED, _GREEN = np.array([0.06, 0.06, 0.5]), np.array([0.12, 0.38, 0.08])


def draw_distractor_faces(
    camera: Camera, rng: np.random.Generator, count: int, avoid: tuple[PlacedFace, ...] = ()
) -> tuple[PlacedFace, ...]:
    """Squares on the road that are no plates, at drawn places in front of the camera, clear of ``avoid``."""
    placed: list[PlacedFace] = []
    for _ in range(8 * count):
        if len(placed) == count:
            break
        face = _draw_face(rng)
        ahead = float(rng.uniform(1.5, 9.0))
        left = float(rng.uniform(-0.45, 0.45)) * (ahead + 1.5)
        clear = all(
            math.hypot(other.ahead_m - ahead, other.left_m - left) > 0.75 * (face.side_m + other.face.side_m)
            for other in (*avoid, *placed)
        )
        if clear and ahead * math.tan(math.radians(camera.depression_deg)) > 0.1:
            placed.append(PlacedFace(face, ahead, left, float(rng.uniform(0, 360))))
    return tuple(placed)


def _draw_face(rng: np.random.Generator) -> Face:
    wear = PlateWear(patchy_loss=float(rng.uniform(0, 0.5)))
    side_m = float(rng.uniform(0.2, 0.6))
    kind = int(rng.integers(7))
    if kind == 0:  # a painted square
        return grid_face([[_RED if rng.random() < 0.5 else _GREEN]], side_m, wear, rng)
    if kind == 1:  # a chessboard
        cells = int(rng.integers(4, 11))
        board = np.indices((cells, cells)).sum(axis=0) % 2
        return grid_face(np.where(board[..., None] > 0, _WHITE, _BLACK), side_m, wear, rng)
    if kind == 2:  # a tag
        return grid_face(_tag_cells(rng, int(rng.integers(4, 7))), side_m, wear, rng)
    if kind == 3:  # bars of a crossing
        bars = (np.arange(8) // 2) % 2
        return grid_face(np.where(np.repeat(bars[None], 8, axis=0)[..., None] > 0, _WHITE, _BLACK * 3), 2.5, wear, rng)
    if kind == 4:  # coloured patchwork
        palette = np.stack([_WHITE, _BLACK, _RED, _GREEN, np.array([0.05, 0.5, 0.6])])
        return grid_face(palette[rng.integers(0, 5, (6, 6))], side_m, wear, rng)
    if kind == 5:  # random dots without markers
        return grid_face(np.where(rng.random((8, 8, 1)) < 0.5, _WHITE, _BLACK), side_m, wear, rng)
    return decoy_plate(rng, wear)


def _tag_cells(rng: np.random.Generator, bits: int) -> npt.NDArray[np.float64]:
    cells = np.ones((bits + 4, bits + 4), bool)
    cells[1:-1, 1:-1] = False
    cells[2:-2, 2:-2] = rng.random((bits, bits)) < 0.5
    return np.where(cells[..., None], _WHITE, _BLACK)


def decoy_plate(rng: np.random.Generator, wear: PlateWear) -> Face:
    """A plate's grid whose corner markers are not a plate's: colours swapped, repeated or missing."""
    geometry = PlateGeometry()
    code = PlateCode("".join(str(d) for d in rng.integers(0, 10, 12)))
    face = plate_face(code, geometry, draw_look(rng), wear, rng)
    reflectance = face.reflectance.copy()
    size = reflectance.shape[0]
    marker = round((geometry.gap_mm + 2 * geometry.unit_mm + geometry.gap_mm) / geometry.side_mm * size)
    edge = round(geometry.gap_mm / geometry.side_mm * size)
    near, far = slice(edge, marker), slice(size - marker, size - edge)
    kind = int(rng.integers(4))
    if kind == 0:  # four green squares
        reflectance[near, near] = _GREEN
    elif kind == 1:  # no red, a black triangle's place
        reflectance[near, near] = _BLACK
    elif kind == 2:  # a green marker is gone
        reflectance[far, far] = _WHITE
    else:  # four red squares
        for rows in (near, far):
            for cols in (near, far):
                reflectance[rows, cols] = _RED
    return Face(face.side_m, reflectance)


# --- upright things, drawn into the photo -----------------------------------------------------------------------------


def paint_distractors(photo: Image, rng: np.random.Generator, count: int) -> Image:
    """Copy of a photo with tail lights, signs, cones, grass and leaves painted into it."""
    out = photo.copy()
    for _ in range(count):
        kind = int(rng.integers(6))
        x, y = int(rng.integers(0, photo.shape[1])), int(rng.integers(0, photo.shape[0]))
        size = float(rng.uniform(0.01, 0.06)) * photo.shape[1]
        (_tail_lights, _sign, _cone, _grass, _leaves, _traffic_light)[kind](out, x, y, size, rng)
    return out


def _fill(image: Image, points: npt.ArrayLike, colour: tuple[float, ...]) -> None:
    cv2.fillPoly(image, [np.round(np.asarray(points) * 16).astype(np.int32)], colour, cv2.LINE_AA, 4)


def _box(image: Image, x: float, y: float, w: float, h: float, colour: tuple[float, ...]) -> None:
    _fill(image, [(x, y), (x + w, y), (x + w, y + h), (x, y + h)], colour)


def _tail_lights(image: Image, x: int, y: int, size: float, rng: np.random.Generator) -> None:
    body = tuple(float(v) for v in rng.integers(10, 230, 3))
    _box(image, x, y, 3.2 * size, 1.8 * size, body)
    lit = (60.0, 60.0, 255.0) if rng.random() < 0.5 else (25.0, 20.0, 170.0)
    for left in (0.1, 2.6):
        _box(image, x + left * size, y + 0.6 * size, 0.5 * size, 0.45 * size, lit)
    _box(image, x + 1.2 * size, y + 1.1 * size, 0.8 * size, 0.25 * size, (220.0, 225.0, 225.0))


def _sign(image: Image, x: int, y: int, size: float, rng: np.random.Generator) -> None:
    colours = ((70.0, 110.0, 20.0), (40.0, 30.0, 190.0), (150.0, 80.0, 20.0))
    _box(image, x, y, 2.4 * size, 1.4 * size, (235.0, 235.0, 235.0))
    _box(image, x + 0.08 * size, y + 0.08 * size, 2.24 * size, 1.24 * size, colours[int(rng.integers(3))])
    for row in range(2):
        at = 0.2
        while at < 2.0:
            width = float(rng.uniform(0.05, 0.25))
            _box(image, x + at * size, y + (0.3 + 0.5 * row) * size, width * size, 0.3 * size, (235.0, 235.0, 235.0))
            at += width + 0.08


def _cone(image: Image, x: int, y: int, size: float, rng: np.random.Generator) -> None:
    orange = (20.0, float(rng.integers(60, 120)), 235.0)
    _fill(image, [(x, y), (x + 0.5 * size, y + 1.6 * size), (x - 0.5 * size, y + 1.6 * size)], orange)
    for top, bottom in ((0.5, 0.7), (0.95, 1.2)):
        left, right = top * size / 3.2, bottom * size / 3.2
        band = [(x - left, y + top * size), (x + left, y + top * size)]
        band += [(x + right, y + bottom * size), (x - right, y + bottom * size)]
        _fill(image, band, (230.0, 230.0, 230.0))


def _grass(image: Image, x: int, y: int, size: float, rng: np.random.Generator) -> None:
    height, width = int(1.5 * size), int(4 * size)
    part = image[y : y + height, x : x + width]
    if part.size == 0:
        return
    blades = smooth_noise(part.shape[:2], 3.0, rng)[..., None]
    green = np.array([50, 120, 80]) * rng.uniform(0.6, 1.3) * (0.4 + blades)
    alpha = np.clip(2.5 * smooth_noise(part.shape[:2], max(size / 3, 2), rng) - 0.6, 0, 1)[..., None]
    part[:] = np.clip(part * (1 - alpha) + green * alpha, 0, 255).astype(np.uint8)


def _leaves(image: Image, x: int, y: int, size: float, rng: np.random.Generator) -> None:
    for _ in range(12):
        cx, cy = x + size * rng.normal(0, 1.5), y + size * rng.normal(0, 0.7)
        colour = (30.0, float(rng.integers(40, 160)), float(rng.integers(40, 200)))
        turn = float(rng.uniform(0, 180))
        centre, axes = (round(cx), round(cy)), (max(round(size / 5), 1), max(round(size / 11), 1))
        cv2.ellipse(image, centre, axes, turn, 0, 360, colour, -1, cv2.LINE_AA)


def _traffic_light(image: Image, x: int, y: int, size: float, rng: np.random.Generator) -> None:
    _box(image, x, y, 0.8 * size, 2.2 * size, (25.0, 25.0, 25.0))
    lit = int(rng.integers(3))
    for k, colour in enumerate(((60.0, 50.0, 255.0), (60.0, 200.0, 255.0), (160.0, 255.0, 80.0))):
        shown = colour if k == lit else tuple(v * 0.2 for v in colour)
        centre = (round(x + 0.4 * size), round(y + (0.4 + 0.7 * k) * size))
        cv2.circle(image, centre, max(round(0.28 * size), 1), shown, -1, cv2.LINE_AA)
