"""A printed plate with faults of its print, and the photo of it that a fabricator takes by hand."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.markers.plate import PlateCode, PlateGeometry
from app.sensors.camera import Camera
from app.simulation.camera import render_plate_scene
from app.simulation.plate_face import Colour, Face, PlateLook
from app.simulation.plate_scene import PlacedFace, PlateScene, Sensor, Shadow
from app.values import Floats32

MARGIN = 0.08
"""[plate sides] of the sheet around the plate."""
_FLOOR_REFLECTANCE = 0.28
_FINE = 4  # samples a texel and side, by which edges are mixed


@dataclass(frozen=True, slots=True)
class Stain:
    """A round opaque stain."""

    # `x_mm`, `y_mm`: [mm] centre in the plate frame
    x_mm: float
    y_mm: float
    radius_mm: float
    reflectance: Colour = (0.25, 0.27, 0.3)  # blue, green, red


@dataclass(frozen=True, slots=True)
class PrintFaults:
    """What went wrong when a plate was printed."""

    stretch: float = 0.0  # the print is longer by this share along the direction of travel
    growth_mm: float = 0.0  # [mm] every unit is larger by this on each of its sides; negative: smaller
    # [mm] displaced units: to the right and up; they lie over the others
    shifts_mm: dict[tuple[int, int], tuple[float, float]] = field(default_factory=dict)
    # units that moved by this share towards the other paint
    faded: dict[tuple[int, int], float] = field(default_factory=dict)
    stains: tuple[Stain, ...] = ()


def printed_face(
    code: PlateCode, geometry: PlateGeometry, look: PlateLook, faults: PrintFaults, *, texels_per_mm: float = 2.0
) -> Face:
    """A printed plate on a sheet with a margin, as a square of the sheet's size.

    Parameters
    ----------
    code : PlateCode
        Of the geometry's size.
    geometry : PlateGeometry
    look : PlateLook
    faults : PrintFaults
    texels_per_mm : float
        Resolution. [1/mm]

    Raises
    ------
    InvalidParameter
        The code is of another size than the geometry.
    """
    if code.n != geometry.n:
        raise InvalidParameter(f"a code of {code.n} units on a plate of {geometry.n}", field="code.n")
    side_mm = geometry.side_mm * (1 + 2 * MARGIN + max(faults.stretch, 0.0))
    size = round(side_mm * texels_per_mm)
    painter = _Painter(size, side_mm, faults.stretch, (_FLOOR_REFLECTANCE,) * 3)
    half = geometry.side_mm / 2
    painter.polygon([(-half, half), (half, half), (half, -half), (-half, -half)], look.gap)
    _paint_markers(painter, geometry, look)
    last = geometry.n - 2
    for row, column in sorted(np.ndindex(geometry.n, geometry.n), key=faults.shifts_mm.__contains__):
        if (row < 2 or row >= last) and (column < 2 or column >= last):
            continue
        own, other = (look.dark, look.light) if code.units[row, column] else (look.light, look.dark)
        share = faults.faded.get((row, column), 0.0)
        x, y = _unit_centre_mm(geometry, row, column)
        dx, dy = faults.shifts_mm.get((row, column), (0.0, 0.0))
        reach = geometry.unit_mm / 2 + faults.growth_mm
        painter.square(x + dx, y + dy, reach, _mixed(own, other, share))
    for stain in faults.stains:
        painter.circle(stain)
    return Face(side_mm / 1000, painter.face())


def photograph_print(
    face: Face,
    rng: np.random.Generator,
    *,
    side_px: float = 1500.0,
    tilt_deg: float = 4.0,
    turn_deg: float = 0.0,
    size_px: tuple[int, int] = (4032, 3024),
    horizontal_fov_deg: float = 69.4,
    exposure: float = 1.0,
    blur_px: float = 0.9,
    shadow: Shadow | None = None,
) -> bytes:
    """Photo of a sheet that lies on a floor, taken from above by hand with a phone: a JPEG without EXIF.

    Parameters
    ----------
    face : Face
        Of `printed_face`.
    rng : numpy.random.Generator
        Draws the noise.
    side_px : float
        Side of the sheet in the photo. [px]
    tilt_deg : float
        Of the camera's axis from straight down. [deg]
    turn_deg : float
        Of the sheet, clockwise. [deg]
    size_px : tuple of int
        Width and height. [px]
    horizontal_fov_deg : float
        Source: 69.4 degrees are a lens of 26 mm on 36 mm film.
    exposure : float
        1 exposes a white of reflectance 0.75 to 0.75 of the sensor's saturation.
    blur_px : float
        Standard deviation of the blur. [px]
    shadow : Shadow, optional
    """
    focal_px = size_px[0] / 2 / math.tan(math.radians(horizontal_fov_deg) / 2)
    range_m = focal_px * face.side_m / side_px
    tilt = math.radians(tilt_deg)
    camera = Camera.from_field_of_view(
        *size_px, horizontal_fov_deg, height_m=range_m * math.cos(tilt), depression_deg=90.0 - tilt_deg
    )
    sensor = Sensor(blur_px=blur_px, gain=exposure, full_well_e=8000.0, shoulder=0.9, sharpen=0.3, jpeg_quality=93)
    scene = PlateScene(
        camera, (PlacedFace(face, range_m * math.sin(tilt), 0.0, turn_deg),), exposure_s=1e-4,
        road_reflectance=_FLOOR_REFLECTANCE, shadow=shadow or Shadow(), sensor=sensor,
    )  # fmt: skip
    floor = np.full((size_px[1], size_px[0], 3), 144, np.uint8)  # 0.28 of linear light, so that white gets 1
    return render_plate_scene(scene, floor, rng).jpeg


def _unit_centre_mm(geometry: PlateGeometry, row: int, column: int) -> tuple[float, float]:
    first = geometry.gap_mm + geometry.unit_mm / 2 - geometry.side_mm / 2
    return first + column * geometry.pitch_mm, -(first + row * geometry.pitch_mm)


def _mixed(own: Colour, other: Colour, share: float) -> Colour:
    blue, green, red = (a + (b - a) * share for a, b in zip(own, other, strict=True))
    return (blue, green, red)


def _paint_markers(painter: _Painter, geometry: PlateGeometry, look: PlateLook) -> None:
    reach = geometry.unit_mm + geometry.gap_mm / 2
    middle = geometry.side_mm / 2 - geometry.gap_mm - reach
    for x, y in ((1, 1), (1, -1), (-1, -1)):
        painter.square(x * middle, y * middle, reach, look.green)
    painter.square(-middle, middle, reach, look.triangle_rest)
    low, high = -middle - reach, -middle + reach
    painter.polygon([(low, -low), (high, -low), (low, -high)], look.red)


class _Painter:
    """Areas painted one over the other, each mixed at its edges by area."""

    def __init__(self, size: int, side_mm: float, stretch: float, ground: Colour) -> None:
        self._scale, self._middle = size / side_mm, size / 2
        self._stretch = 1 + stretch
        self._face: Floats32 = np.empty((size, size, 3), np.float32)
        self._face[:] = ground

    def face(self) -> Floats32:
        """Reflectance, shape (size, size, 3)."""
        return self._face

    def square(self, x_mm: float, y_mm: float, reach_mm: float, colour: Colour) -> None:
        """A square about a centre."""
        low_x, high_x, low_y, high_y = x_mm - reach_mm, x_mm + reach_mm, y_mm - reach_mm, y_mm + reach_mm
        self.polygon([(low_x, high_y), (high_x, high_y), (high_x, low_y), (low_x, low_y)], colour)

    def circle(self, stain: Stain) -> None:
        """A stain."""
        turn = np.linspace(0, 2 * np.pi, 49)[:-1]
        x, y = stain.x_mm + stain.radius_mm * np.cos(turn), stain.y_mm + stain.radius_mm * np.sin(turn)
        self.polygon(list(zip(x.tolist(), y.tolist(), strict=True)), stain.reflectance)

    def polygon(self, points_mm: list[tuple[float, float]], colour: Colour) -> None:
        """Any area."""
        points: npt.NDArray[np.float64] = np.array(points_mm) * (1, -self._stretch) * self._scale + self._middle
        size = len(self._face)
        low = np.clip(np.floor(points.min(axis=0)).astype(int) - 1, 0, size)
        high = np.clip(np.ceil(points.max(axis=0)).astype(int) + 1, 0, size)
        width, height = (high - low).tolist()
        if width <= 0 or height <= 0:
            return
        mask = np.zeros((height * _FINE, width * _FINE), np.uint8)
        fixed = np.round(((points - low) * _FINE - 0.5) * 256).astype(np.int32)
        cv2.fillPoly(mask, [fixed], 255, shift=8)
        cover = cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)[..., None] / 255
        part = self._face[low[1] : high[1], low[0] : high[0]]
        part += (np.array(colour, np.float32) - part) * cover
