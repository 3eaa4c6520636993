"""What lies on and stands beside roads and has a plate's corners, grids or colours: codes, tiles, signs, markings."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt
import segno

from app.sensors.camera import Camera
from app.simulation.plate_face import Face, PlateWear, grid_face
from app.simulation.plate_scene import PlacedFace
from app.values import Floats32
from benchmarks.scenes.distractors import decoy_plate

Image = npt.NDArray[np.uint8]
Colour = tuple[float, float, float]
TEXELS = 240
"""Texels along the side of a drawing."""
WHITE, BLACK, ASPHALT = (0.75, 0.75, 0.75), (0.04, 0.04, 0.04), (0.16, 0.16, 0.16)
RED, GREEN, BLUE, YELLOW = (0.06, 0.06, 0.5), (0.12, 0.38, 0.08), (0.45, 0.2, 0.06), (0.05, 0.5, 0.65)
COLOURS = (WHITE, BLACK, RED, GREEN, BLUE, YELLOW)
GAMMA = 2.2


def draw_flat(camera: Camera, rng: np.random.Generator, count: int) -> tuple[PlacedFace, ...]:
    """Look-alikes that lie on the road in front of the camera, none over another."""
    placed: list[PlacedFace] = []
    for _ in range(8 * count):
        wear = PlateWear(contrast_loss=float(rng.uniform(0, 0.3)), patchy_loss=float(rng.uniform(0, 0.5)))
        face = decoy_plate(rng, wear) if rng.random() < 0.15 else _draw_face(rng, wear)
        ahead_m = float(rng.uniform(1.2, 9.0))
        left_m = float(rng.uniform(-0.45, 0.45)) * (ahead_m + 1.5)
        apart = (math.hypot(p.ahead_m - ahead_m, p.left_m - left_m) / (p.face.side_m + face.side_m) for p in placed)
        if all(one > 0.75 for one in apart) and ahead_m * math.tan(math.radians(camera.depression_deg)) > 0.1:
            placed.append(PlacedFace(face, ahead_m, left_m, float(rng.uniform(0, 360))))
        if len(placed) == count:
            break
    return tuple(placed)


def paint_upright(photo: Image, rng: np.random.Generator, count: int) -> Image:
    """Copy of a photo with look-alikes on posts, walls and vehicles, each turned a little away from the camera."""
    out = photo.copy()
    height, width = photo.shape[:2]
    for _ in range(count):
        side = float(np.exp(rng.uniform(math.log(16), math.log(220))))
        square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
        corners = (square + rng.uniform(-0.12, 0.12, (4, 2))) * (side * rng.uniform(0.5, 1.0), side)
        corners += rng.uniform((0, 0), (width - side, height - side))
        picture = _levels(_draw_cells(rng), float(rng.uniform(0.5, 1.5)))
        low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 1, 0)
        part = out[low[1] : int(corners[:, 1].max()) + 2, low[0] : int(corners[:, 0].max()) + 2]
        matrix = cv2.getPerspectiveTransform(square * TEXELS, (corners - low).astype(np.float32))
        size = (part.shape[1], part.shape[0])
        cover = cv2.warpPerspective(np.full((TEXELS, TEXELS), 255, np.uint8), matrix, size)
        shrunk = cv2.GaussianBlur(picture, (0, 0), max(TEXELS / side / 2.5, 0.1))
        warped = cv2.warpPerspective(shrunk, matrix, size)
        part[cover > 0] = warped[cover > 0]
    return out


def _levels(cells: Floats32, light: float) -> Image:
    """Gamma encoded levels of linear reflectances under a light."""
    return np.asarray(255 * np.clip(light * cells, 0, 1) ** (1 / GAMMA), np.uint8)


def _draw_face(rng: np.random.Generator, wear: PlateWear) -> Face:
    return grid_face(_draw_cells(rng), float(rng.uniform(0.2, 0.6)), wear, rng)


def _draw_cells(rng: np.random.Generator) -> Floats32:
    """Reflectances of one look-alike, shape (TEXELS, TEXELS, 3)."""
    kinds = (
        _qr_code, _tiles, _chessboard, _panel, _warning_sign, _round_sign, _direction_sign, _marking, _bicycle_lane,
    )  # fmt: skip
    return kinds[int(rng.integers(len(kinds)))](rng)


def _resized(cells: npt.ArrayLike) -> Floats32:
    size = (TEXELS, TEXELS)
    return np.asarray(cv2.resize(np.asarray(cells, np.float32), size, interpolation=cv2.INTER_NEAREST), np.float32)


def _pick(rng: np.random.Generator, colours: Sequence[Colour]) -> Colour:
    return colours[int(rng.integers(len(colours)))]


def _qr_code(rng: np.random.Generator) -> Floats32:
    """A QR code, some in colours, some with coloured finder patterns as red and green corners."""
    text = "".join(rng.choice(list("0123456789ABCDEF"), int(rng.integers(4, 40))))
    code = segno.make(text, micro=bool(len(text) < 8 and rng.random() < 0.3))
    dark = np.array([[bool(module) for module in row] for row in code.matrix_iter(border=1)])
    ink = _pick(rng, (BLACK, BLACK, BLACK, RED, GREEN, BLUE))
    cells = np.where(dark[..., None], np.array(ink), np.array(WHITE))
    if rng.random() < 0.4:
        corner, last = 8, len(dark) - 8
        near, far = slice(0, corner), slice(last, None)
        for rows, columns in ((near, near), (near, far), (far, near), (far, far)):
            tint = np.array(_pick(rng, (RED, GREEN, GREEN)))
            cells[rows, columns] = np.where(dark[rows, columns, None], tint, cells[rows, columns])
    return _resized(cells)


def _tiles(rng: np.random.Generator) -> Floats32:
    """Floor tiles with joints, in two to five colours."""
    count = int(rng.integers(4, 13))
    palette = np.array([_pick(rng, COLOURS) for _ in range(int(rng.integers(2, 6)))])
    cells = _resized(palette[rng.integers(0, len(palette), (count, count))])
    joint = np.array(_pick(rng, (WHITE, ASPHALT, BLACK)), np.float32)
    width = max(int(TEXELS / count * rng.uniform(0.04, 0.15)), 1)
    for edge in np.linspace(0, TEXELS - width, count + 1).astype(int):
        cells[edge : edge + width] = joint
        cells[:, edge : edge + width] = joint
    return cells


def _chessboard(rng: np.random.Generator) -> Floats32:
    """A chessboard, some with red and green corners in any order."""
    count = int(rng.integers(4, 11))
    board = np.indices((count, count)).sum(axis=0) % 2
    cells = np.where(board[..., None] > 0, np.array(WHITE), np.array(BLACK))
    if rng.random() < 0.6:
        for row in (slice(0, 2), slice(-2, None)):
            for column in (slice(0, 2), slice(-2, None)):
                cells[row, column] = _pick(rng, (RED, GREEN, GREEN, WHITE))
    return _resized(cells)


def _panel(rng: np.random.Generator) -> Floats32:
    """A board of one or two tones with coloured corners: mostly red and green squares as a plate has them."""
    count = int(rng.choice((8, 10, 12)))
    tones = np.array([_pick(rng, (WHITE, BLACK, ASPHALT)) for _ in range(int(rng.integers(1, 3)))])
    cells = tones[rng.integers(0, len(tones), (count, count))]
    corners = [RED, GREEN, GREEN, GREEN]
    if rng.random() < 0.4:
        rng.shuffle(corners)
    places = ((slice(0, 2), slice(0, 2)), (slice(0, 2), slice(-2, None)),
              (slice(-2, None), slice(-2, None)), (slice(-2, None), slice(0, 2)))  # fmt: skip
    for place, colour in zip(places, corners, strict=True):
        cells[place] = colour
    return _resized(cells)


def _sheet(colour: Colour) -> Floats32:
    return np.full((TEXELS, TEXELS, 3), colour, np.float32)


def _fill(cells: Floats32, points: npt.ArrayLike, colour: Colour) -> None:
    cv2.fillPoly(cells, [np.round(np.asarray(points) * TEXELS).astype(np.int32)], colour)


def _write(cells: Floats32, text: str, at: tuple[float, float], size: float, colour: Colour) -> None:
    place = (int(at[0] * TEXELS), int(at[1] * TEXELS))
    thick = max(int(TEXELS * size / 12), 1)
    letters = np.zeros((TEXELS, TEXELS), np.uint8)  # OpenCV writes on bytes only
    cv2.putText(letters, text, place, cv2.FONT_HERSHEY_SIMPLEX, size * TEXELS / 30, 255, thick)
    cells[letters > 0] = colour


def _warning_sign(rng: np.random.Generator) -> Floats32:
    """A red triangle on white, and the corner of a red one on asphalt."""
    cells = _sheet(_pick(rng, (ASPHALT, GREEN, WHITE)))
    _fill(cells, [(0.5, 0.05), (0.97, 0.92), (0.03, 0.92)], RED)
    _fill(cells, [(0.5, 0.25), (0.82, 0.83), (0.18, 0.83)], WHITE)
    _write(cells, "!", (0.45, 0.8), 0.5, BLACK)
    return cells


def _round_sign(rng: np.random.Generator) -> Floats32:
    """A speed limit, or a stop sign."""
    cells = _sheet(_pick(rng, (ASPHALT, GREEN, BLACK)))
    centre, radius = (TEXELS // 2, TEXELS // 2), int(0.47 * TEXELS)
    cv2.circle(cells, centre, radius, RED, -1)
    if rng.random() < 0.7:
        cv2.circle(cells, centre, int(0.36 * TEXELS), WHITE, -1)
        _write(cells, str(int(rng.integers(2, 13)) * 10), (0.22, 0.62), 0.35, BLACK)
    else:
        _write(cells, "STOP", (0.12, 0.6), 0.28, WHITE)
    return cells


def _direction_sign(rng: np.random.Generator) -> Floats32:
    """White letters and a frame on green, blue or red."""
    cells = _sheet(_pick(rng, (GREEN, BLUE, RED)))
    cv2.rectangle(cells, (6, 6), (TEXELS - 7, TEXELS - 7), WHITE, int(rng.integers(2, 8)))
    for row in range(int(rng.integers(1, 5))):
        text = "".join(rng.choice(list("ABEHIKLMNOTX0123456789"), int(rng.integers(2, 7))))
        _write(cells, text, (0.1, 0.25 + 0.2 * row), float(rng.uniform(0.12, 0.22)), _pick(rng, (WHITE, RED, YELLOW)))
    return cells


def _marking(rng: np.random.Generator) -> Floats32:
    """White or yellow arrows, words and bars of paint on asphalt."""
    cells, paint = _sheet(ASPHALT), _pick(rng, (WHITE, YELLOW))
    kind = int(rng.integers(3))
    if kind == 0:
        _fill(cells, [(0.5, 0.05), (0.8, 0.4), (0.58, 0.4), (0.58, 0.95), (0.42, 0.95), (0.42, 0.4), (0.2, 0.4)], paint)
    elif kind == 1:
        _write(cells, _pick_word(rng), (0.02, 0.65), 0.35, paint)
    else:
        bars = int(rng.integers(3, 9))
        for k in range(bars):
            _fill(cells, [(k / bars, 0), ((k + 0.5) / bars, 0), ((k + 0.5) / bars, 1), (k / bars, 1)], paint)
    return cells


def _pick_word(rng: np.random.Generator) -> str:
    return ("SLOW", "BUS", "STOP", "30", "TAXI", "50")[int(rng.integers(6))]


def _bicycle_lane(rng: np.random.Generator) -> Floats32:
    """White signs on red or green asphalt, with squares of the other colour beside them."""
    cells = _sheet(_pick(rng, (RED, GREEN)))
    for x in (0.3, 0.7):
        cv2.circle(cells, (int(x * TEXELS), int(0.6 * TEXELS)), int(0.16 * TEXELS), WHITE, int(rng.integers(3, 9)))
    for _ in range(int(rng.integers(0, 6))):
        x, y, side = (float(v) for v in rng.uniform((0, 0, 0.05), (0.8, 0.8, 0.2)))
        _fill(cells, [(x, y), (x + side, y), (x + side, y + side), (x, y + side)], _pick(rng, COLOURS))
    return cells
