"""What is in front of the camera: squares on the road, light, air, sensor; and the truth about it.

Ground frame: origin on the road below the camera at mid-exposure, x ahead (the vehicle's heading), y left, z up. [m]
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from app.markers.plate import PlateCode, PlateGeometry
from app.sensors.camera import Camera
from app.simulation.plate_face import Face, PlateWear, draw_look, grid_face, plate_face, smooth_noise

Matrix = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PlacedFace:
    """A square lying on the road.

    Parameters
    ----------
    face : Face
    ahead_m, left_m : float
        Its centre in the ground frame. [m]
    rotation_deg : float
        Clockwise, seen from above, from the vehicle's heading to the face's up direction. [deg]
    """

    face: Face
    ahead_m: float
    left_m: float = 0.0
    rotation_deg: float = 0.0

    @property
    def ground_from_face(self) -> Matrix:
        """Rotation (columns: the face's right, up, out of the road) in the ground frame, shape (3, 3)."""
        a = math.radians(self.rotation_deg)
        return np.array([[-math.sin(a), math.cos(a), 0], [-math.cos(a), -math.sin(a), 0], [0, 0, 1.0]])

    @property
    def corners_ground_m(self) -> Matrix:
        """Outer corners, clockwise from top-left, shape (4, 3). [m]"""
        half = self.face.side_m / 2
        corners = np.array([(-half, half, 0), (half, half, 0), (half, -half, 0), (-half, -half, 0)])
        placed: Matrix = corners @ self.ground_from_face.T + (self.ahead_m, self.left_m, 0)
        return placed

    @property
    def texel_from_ground(self) -> Matrix:
        """Affine map from ground x, y to columns, rows of the face's texture, shape (2, 3)."""
        size = self.face.reflectance.shape[0]
        scale = size / self.face.side_m
        right, up = self.ground_from_face[:2, 0], self.ground_from_face[:2, 1]
        linear = np.stack([right * scale, -up * scale])
        return np.column_stack([linear, size / 2 - linear @ (self.ahead_m, self.left_m)])


@dataclass(frozen=True, slots=True)
class Shadow:
    """Shadows on road and plate, fixed to the first face's centre.

    Parameters
    ----------
    edge_light : float
        Share of light behind a straight shadow edge; 1 is no edge.
    edge_angle_deg, edge_offset_m, penumbra_m : float
        Direction of the edge's normal from ahead [deg], its distance from the face's centre, half width of its
        soft border. [m]
    dapple_light : float
        Share of light in the darkest spot below leaves; 1 is none.
    dapple_m, dapple_softness : float
        Size of the spots [m], and how gradual they are, 0.02 to 0.5.
    seed : int
        Of the spots' places.
    """

    edge_light: float = 1.0
    edge_angle_deg: float = 0.0
    edge_offset_m: float = 0.0
    penumbra_m: float = 0.02
    dapple_light: float = 1.0
    dapple_m: float = 0.15
    dapple_softness: float = 0.15
    seed: int = 0

    @property
    def is_none(self) -> bool:
        """No shadow at all."""
        return self.edge_light >= 1 and self.dapple_light >= 1


@dataclass(frozen=True, slots=True)
class Air:
    """Between road and lens.

    Parameters
    ----------
    haze : float
        Share of the light replaced by airlight, 0 to 1.
    airlight : float
        Radiance of the haze, as a share of saturation.
    glare : float
        Radiance of the mirrored sky or sun on the first face at the lobe's centre, as a share of saturation.
    glare_at_m, glare_size_m : tuple of float
        Centre (right, up from the face's centre) and radii (across, along) of the lobe. [m]
    """

    haze: float = 0.0
    airlight: float = 0.7
    glare: float = 0.0
    glare_at_m: tuple[float, float] = (0.0, 0.0)
    glare_size_m: tuple[float, float] = (0.2, 0.4)


@dataclass(frozen=True, slots=True)
class Sensor:
    """Lens, sensor and image pipeline.

    Parameters
    ----------
    blur_px : float
        Standard deviation of the lens's Gaussian point spread. [px]
    full_well_e, read_noise_e : float
        Electrons at saturation and read noise. [e-]
    gain : float
        Exposure relative to the photo's.
    white_balance : tuple of float
        Gains on blue, green, red.
    gamma : float
        Encoding exponent is 1 / gamma above the linear toe.
    shoulder : float
        Radiance, as a share of saturation, from which highlights are compressed; 1 clips hard.
    bayer : bool
        Sample one colour a pixel and interpolate.
    sharpen : float
        Amount of unsharp masking that the pipeline adds.
    colour_shift_px : float
        Sideways shift between red and blue (lateral chromatic aberration). [px]
    readout_s : float
        Rolling shutter: time from the first row's exposure to the last's. [s]
    jpeg_quality : int or None
        4:2:0 JPEG round trip; None leaves it out.
    """

    blur_px: float = 0.7
    full_well_e: float = 6000.0
    read_noise_e: float = 4.0
    gain: float = 1.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    gamma: float = 2.2
    shoulder: float = 0.8
    bayer: bool = True
    sharpen: float = 0.0
    colour_shift_px: float = 0.0
    readout_s: float = 0.0
    jpeg_quality: int | None = 92


@dataclass(frozen=True, slots=True)
class Occluder:
    """Something between camera and plate: everything on one side of a line in the image.

    Parameters
    ----------
    angle_deg : float
        Direction in the image, clockwise from right, towards the hidden side. [deg]
    share : float
        How much of the first face's extent along that direction is hidden, 0 to 1.
    radiance : float
        As a share of saturation.
    softness_px : float
        Half width of its blurred edge. [px]
    """

    angle_deg: float
    share: float
    radiance: float = 0.05
    softness_px: float = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class PlateScene:
    """One exposure.

    Parameters
    ----------
    camera : Camera
        Intrinsics and mount.
    faces : tuple of PlacedFace
        Not overlapping; the first is the plate that shadows, glare and occluders refer to.
    speed_m_s, exposure_s : float
        Forward speed and exposure time.
    spin_deg_s : tuple of float
        Roll, pitch (nose down) and yaw (left) rates of the vehicle during the exposure. [deg/s]
    body_deg : tuple of float
        Roll, pitch (nose down) and yaw (left) of the vehicle against road and travel at mid-exposure. [deg]
    road_reflectance : float
        Of the road in the photo: its brightness over this is the light that falls on the plate.
    night_light : float or None
        Light on a white surface as a share of saturation, in place of the photo's; the photo is darkened too.
    """

    camera: Camera
    faces: tuple[PlacedFace, ...]
    speed_m_s: float = 0.0
    exposure_s: float = 0.001
    spin_deg_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    body_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    road_reflectance: float = 0.22
    night_light: float | None = None
    shadow: Shadow = field(default_factory=Shadow)
    air: Air = field(default_factory=Air)
    sensor: Sensor = field(default_factory=Sensor)
    occluder: Occluder | None = None

    @property
    def camera_from_ground(self) -> Matrix:
        """Rotation from the ground frame to the camera frame at mid-exposure, shape (3, 3)."""
        roll, pitch, yaw = (math.radians(v) for v in self.body_deg)
        ground_from_vehicle = cv2.Rodrigues(np.array([0, 0, yaw]))[0]
        ground_from_vehicle = ground_from_vehicle @ cv2.Rodrigues(np.array([0, pitch, 0.0]))[0]
        ground_from_vehicle = ground_from_vehicle @ cv2.Rodrigues(np.array([roll, 0, 0.0]))[0]
        rotation: Matrix = self.camera.camera_from_vehicle @ ground_from_vehicle.T
        return rotation

    def row_time_s(self, rows: npt.ArrayLike) -> Matrix:
        """Mid-exposure of image rows relative to the frame's. [s]"""
        share = (np.asarray(rows, float) - (self.camera.height_px - 1) / 2) / max(self.camera.height_px - 1, 1)
        times: Matrix = share * self.sensor.readout_s
        return times

    def project(self, points_ground_m: Matrix) -> Matrix:
        """Image of points on the road at their rows' mid-exposure; behind the camera: NaN.

        Parameters
        ----------
        points_ground_m : ndarray, shape (N, 3)
            In the ground frame at the frame's mid-exposure. [m]

        Returns
        -------
        ndarray, shape (N, 2)
            [px]
        """
        times = np.zeros(len(points_ground_m))
        for _ in range(6 if self.sensor.readout_s else 1):
            image = self.project_at(points_ground_m, times)
            rows = np.nan_to_num(image[:, 1], nan=0.0)
            times = self.row_time_s(np.clip(rows, -self.camera.height_px, 2 * self.camera.height_px))
        return image

    def project_at(self, points_ground_m: Matrix, times_s: Matrix) -> Matrix:
        """Image of points on the road at given times from mid-exposure [s]; behind the camera: NaN. [px]"""
        offset = points_ground_m - (0, 0, self.camera.height_m)
        offset = offset - times_s[:, None] * np.array([self.speed_m_s, 0, 0])
        spin = np.radians(self.spin_deg_s)
        turned = offset - times_s[:, None] * np.cross(spin, offset)
        in_camera = turned @ self.camera_from_ground.T
        image = np.full((len(in_camera), 2), np.nan)
        ahead = in_camera[:, 2] > 0.05
        if ahead.any():
            image[ahead] = cv2.projectPoints(
                in_camera[ahead],
                np.zeros(3),
                np.zeros(3),
                self.camera.matrix,
                np.array(self.camera.distortion or [0.0] * 4),
            )[0][:, 0]
        return image


@dataclass(frozen=True, slots=True)
class FaceTruth:
    """Where a square really is."""

    # shape (4, 2): [px] outer corners at mid-exposure, clockwise from top-left; NaN behind the camera
    corners_px: Matrix
    in_view: bool  # all four corners are inside the image
    partly_in_view: bool  # some of it is
    # `height_px`, `width_px`: [px] extent of the corners
    height_px: float
    width_px: float
    camera_from_face: Matrix  # shape (3, 3): when the row that shows its centre is exposed, as are the next two
    translation_m: Matrix  # shape (3,): [m] its centre in the camera frame
    camera_position_m: Matrix  # shape (3,): [m] optical centre in the face's frame (x right, y up, z out of the road)


def face_truth(scene: PlateScene, placed: PlacedFace) -> FaceTruth:
    """Truth about one square of a scene."""
    corners = scene.project(placed.corners_ground_m)
    size = np.array([scene.camera.width_px, scene.camera.height_px])
    whole = bool(np.isfinite(corners).all())
    inside = whole & bool(((corners >= -0.5) & (corners <= size - 0.5)).all())
    partly = whole and bool(((corners.max(axis=0) > -0.5) & (corners.min(axis=0) < size - 0.5)).all())
    extent = corners.max(axis=0) - corners.min(axis=0) if whole else np.full(2, np.nan)
    rotation, translation = _pose_when_exposed(scene, placed)
    return FaceTruth(
        corners, inside, partly, float(extent[1]), float(extent[0]), rotation, translation, -rotation.T @ translation
    )


def _pose_when_exposed(scene: PlateScene, placed: PlacedFace) -> tuple[Matrix, Matrix]:
    """camera_from_face at the mid-exposure of the row that shows the face's centre."""
    centre = np.array([[placed.ahead_m, placed.left_m, 0.0]])
    row = np.nan_to_num(scene.project(centre)[0, 1], nan=0.0)
    time_s = float(scene.row_time_s(np.clip(row, 0, scene.camera.height_px - 1)))
    turn = cv2.Rodrigues(-time_s * np.radians(scene.spin_deg_s))[0]
    camera_from_ground = scene.camera_from_ground @ turn
    offset = centre[0] - (time_s * scene.speed_m_s, 0.0, scene.camera.height_m)
    return camera_from_ground @ placed.ground_from_face, camera_from_ground @ offset


# === What is not a plate: things on and beside the road that share a plate's colours, corners or grids.


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
