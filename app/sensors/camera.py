"""A camera on a vehicle: pinhole with the OpenCV distortion model, and its mount; the board that calibrates it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import ConfigDict, Field, with_config

from app.errors import InvalidParameter
from app.inputs import Declaration, Number, Whole
from app.values import Floats

_UNTIL_REST = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)  # steps and px at most


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsics and mount of a camera."""

    # `width_px`, `height_px`: [px] image size
    width_px: int
    height_px: int
    # `fx_px`, `fy_px`, `cx_px`, `cy_px`: [px] focal lengths and principal point; pixel centres at integers
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()  # OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]]; empty for none
    height_m: float = 1.57  # [m] above the road
    depression_deg: float = 23.0  # [deg] optical axis below the horizontal
    azimuth_deg: float = 0.0  # [deg] optical axis clockwise (to the right) from straight ahead
    roll_deg: float = 0.0  # [deg] clockwise about the optical axis, seen from behind the camera
    # `forward_m`, `left_m`: [m] optical centre in the vehicle frame (ISO 8855) from the vehicle's reference point on
    # the road
    forward_m: float = 0.0
    left_m: float = 0.0
    # [s] rolling shutter: time from the first row's exposure to the last's; 0 is a global shutter
    readout_s: float = 0.0

    def __post_init__(self) -> None:
        if self.width_px < 1 or self.height_px < 1:
            raise InvalidParameter("an image has at least one pixel a side", field="camera.width_px", limit=">= 1 px")
        for name in ("fx_px", "fy_px", "height_m"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InvalidParameter(f"{name} must be positive", field=f"camera.{name}", limit="> 0")
        if not 0 <= self.readout_s <= 1:
            raise InvalidParameter("readout_s is 0 to 1 s", field="camera.readout_s", limit="0 to 1 s")
        if len(self.distortion) not in (0, 4, 5, 8):
            raise InvalidParameter(
                "distortion has 0, 4, 5 or 8 coefficients", field="camera.distortion", limit="0, 4, 5 or 8 values"
            )

    @classmethod
    def from_field_of_view(cls, width_px: int, height_px: int, horizontal_fov_deg: float, **mount: float) -> Camera:
        """Camera with square pixels and a centred principal point from its horizontal field of view. [deg]"""
        if not 1 <= horizontal_fov_deg < 179:
            raise InvalidParameter(
                "the horizontal field of view is 1 to 179 degrees",
                field="camera.horizontal_fov_deg",
                limit="1 to 179 deg",
            )
        focal_px = width_px / 2 / math.tan(math.radians(horizontal_fov_deg) / 2)
        return cls(width_px, height_px, focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2, (), **mount)

    @property
    def matrix(self) -> npt.NDArray[np.float64]:
        """Intrinsic matrix K, shape (3, 3). [px]"""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    @property
    def lens(self) -> npt.NDArray[np.float64]:
        """The distortion as OpenCV takes it: four zeros for none."""
        return np.array(self.distortion or (0.0,) * 4)

    def project(self, points_m: Floats) -> Floats:
        """Images of points in the camera's frame, shape (N, 3) to (N, 2). [m] to [px]"""
        if not len(points_m):
            return np.empty((0, 2))
        zero = np.zeros(3)
        return np.asarray(cv2.projectPoints(points_m, zero, zero, self.matrix, self.lens)[0][:, 0], float)

    def undistort(self, points_px: Floats) -> Floats:
        """Where the rays of image points, shape (N, 2), meet the plane at a distance of 1 before the camera.

        Notes
        -----
        Steps until they rest: OpenCV's default, five, is up to 43 px short on wide lenses of the rational model.
        """
        points = np.asarray(points_px, float).reshape(-1, 1, 2)
        return np.asarray(
            cv2.undistortPoints(points, self.matrix, self.lens, None, None, None, _UNTIL_REST)[:, 0], float
        )

    @property
    def camera_from_vehicle(self) -> npt.NDArray[np.float64]:
        """Rotation from the vehicle frame (x forward, y left, z up) to the camera frame, shape (3, 3)."""
        axes = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # level, straight ahead
        a, d, r = (math.radians(v) for v in (self.azimuth_deg, self.depression_deg, self.roll_deg))
        # turning the camera right by a = rotating the world left about its y (down) axis, and so on
        yaw = np.array([[math.cos(a), 0, -math.sin(a)], [0, 1, 0], [math.sin(a), 0, math.cos(a)]])
        pitch = np.array([[1, 0, 0], [0, math.cos(d), -math.sin(d)], [0, math.sin(d), math.cos(d)]])
        roll = np.array([[math.cos(r), math.sin(r), 0], [-math.sin(r), math.cos(r), 0], [0, 0, 1]])
        rotation: npt.NDArray[np.float64] = roll @ pitch @ yaw @ axes
        return rotation

    @property
    def position_vehicle_m(self) -> npt.NDArray[np.float64]:
        """Optical centre in the vehicle frame, shape (3,). [m]"""
        return np.array([self.forward_m, self.left_m, self.height_m])


# === A camera as a vehicle declares it.


INTRINSICS = ("fx_px", "fy_px", "cx_px", "cy_px")
_PROJECTION = {"width_px", "height_px", *INTRINSICS, "distortion", "horizontal_fov_deg", "calibration_id"}


class CameraDeclaration(Declaration):
    """Intrinsics of the frames or their horizontal field of view, and the mount on the vehicle."""

    width_px: Whole | None = Field(None, ge=1, description="Width of the upright frames. [px]")
    height_px: Whole | None = Field(None, ge=1, description="Height of the upright frames. [px]")
    fx_px: Number | None = Field(None, description="Focal length in x. [px]")
    fy_px: Number | None = Field(None, description="Focal length in y. [px]")
    cx_px: Number | None = Field(None, description="Principal point, pixel centres at integers. [px]")
    cy_px: Number | None = Field(None, description="Principal point, pixel centres at integers. [px]")
    distortion: tuple[Number, ...] = Field((), max_length=8, description="OpenCV k1 k2 p1 p2 [k3 ...].")
    horizontal_fov_deg: Number | None = Field(None, description="Horizontal field of view. [deg]")
    height_m: Number = Field(1.57, le=100, description="Above the road. [m]")
    depression_deg: Number = Field(23.0, ge=-90, le=90, description="Optical axis below the horizontal. [deg]")
    azimuth_deg: Number = Field(0.0, ge=-180, le=360, description="Optical axis right of straight ahead. [deg]")
    roll_deg: Number = Field(0.0, ge=-180, le=180, description="Clockwise about the optical axis. [deg]")
    forward_m: Number = Field(0.0, ge=-100, le=100, description="Ahead of the vehicle's reference point. [m]")
    left_m: Number = Field(0.0, ge=-100, le=100, description="Left of the vehicle's reference point. [m]")
    readout_s: Number = Field(
        0.0, ge=0, le=1, description="Rolling shutter: from the first row's exposure to the last's. [s]"
    )

    @property
    def has_projection(self) -> bool:
        """Whether it states its projection, completely or in part."""
        return any(getattr(self, name) is not None for name in (*INTRINSICS, "horizontal_fov_deg"))

    def check(self) -> None:
        """Refuse a camera that is incomplete or contradicts itself, after a vehicle's profile completed it.

        Raises
        ------
        InvalidParameter
            The field is below ``camera``.
        """
        intrinsics = [name for name in INTRINSICS if getattr(self, name) is not None]
        if bool(intrinsics) == (self.horizontal_fov_deg is not None) or len(intrinsics) not in (0, 4):
            raise InvalidParameter(
                "a camera has four intrinsics or a horizontal field of view",
                field="camera.horizontal_fov_deg" if not intrinsics else "camera.fx_px",
                limit="fx_px, fy_px, cx_px, cy_px; or horizontal_fov_deg",
                cure="send all four intrinsics with width_px and height_px, or horizontal_fov_deg alone",
            )
        if intrinsics and (self.width_px is None or self.height_px is None):
            raise InvalidParameter(
                "intrinsics belong to one size of frame",
                field="camera.width_px",
                limit="width_px and height_px beside intrinsics",
                cure="send the size of the frames that the camera was calibrated with",
            )
        if self.distortion and not intrinsics:
            raise InvalidParameter(
                "distortion needs the four intrinsics", field="camera.distortion", limit="with intrinsics only"
            )
        self.camera_of(self.width_px or 1920, self.height_px or 1080)

    def camera_of(self, width_px: int, height_px: int) -> Camera:
        """The camera of upright frames of a size.

        Raises
        ------
        InvalidParameter
            The frames have another size than the camera.
        """
        for name, declared, actual in (
            ("width_px", self.width_px, width_px),
            ("height_px", self.height_px, height_px),
        ):
            if declared is not None and declared != actual:
                raise InvalidParameter(
                    f"the camera's {name} is {declared}, the frame's is {actual} (upright)",
                    field=f"camera.{name}",
                    limit=f"{width_px} x {height_px} px",
                    cure="send the camera parameters of these frames, or the frames as the camera wrote them",
                )
        mount = self.model_dump(exclude=_PROJECTION)
        if self.horizontal_fov_deg is not None:
            return Camera.from_field_of_view(width_px, height_px, self.horizontal_fov_deg, **mount)
        fx, fy, cx, cy = (float(getattr(self, name)) for name in INTRINSICS)
        return Camera(width_px, height_px, fx, fy, cx, cy, self.distortion, **mount)


# === The board that cameras are calibrated with: a chessboard whose white squares hold ArUco markers (ChArUco).


DICTIONARY: Literal["DICT_5X5_100"] = "DICT_5X5_100"
MODULES = 7
"""Of a marker along a side: five of its code and a black border."""
SIDES = (4, 24)
SQUARE_MM = (8.0, 250.0)
RATIO = (0.5, 0.85)
"""Side of a marker over that of its square."""
MAX_SIDE_MM = 3000.0
_MARKERS = 100


@with_config(ConfigDict(extra="forbid"))
@dataclass(frozen=True, slots=True)
class CalibrationBoard:
    """A board: squares across and down, the upper left one black, and their sides as measured on the print.

    Board frame: millimetres from its upper left corner, x right, y down. Intrinsics do not depend on the scale.

    Raises
    ------
    InvalidParameter
        A figure is out of its limits.
    """

    columns: Annotated[Whole, Field(description="Squares across, 4 to 24.")] = 7
    rows: Annotated[Whole, Field(description="Squares down, 4 to 24; at most 200 squares.")] = 10
    square_mm: Annotated[Number, Field(description="Side of a square, 8 to 250. [mm]")] = 25.0
    marker_mm: Annotated[Number, Field(description="Side of a marker, 0.5 to 0.85 of a square. [mm]")] = 18.0
    dictionary: Annotated[Literal["DICT_5X5_100"], Field(description="ArUco markers of the white squares.")] = (
        DICTIONARY
    )

    def __post_init__(self) -> None:
        for name in ("columns", "rows"):
            if not SIDES[0] <= getattr(self, name) <= SIDES[1]:
                raise InvalidParameter(
                    f"the board has {getattr(self, name)} {name}",
                    field=f"board.{name}",
                    limit=f"{SIDES[0]} to {SIDES[1]}",
                    cure="7 x 10 fits an A4 sheet",
                )
        if self.columns * self.rows > 2 * _MARKERS:
            raise InvalidParameter(
                f"the board has {self.columns * self.rows} squares",
                field="board.rows",
                limit=f"at most {2 * _MARKERS} squares: {DICTIONARY} has {_MARKERS} markers",
            )
        if not SQUARE_MM[0] <= self.square_mm <= SQUARE_MM[1]:
            raise InvalidParameter(
                f"square_mm is {self.square_mm:g}",
                field="board.square_mm",
                limit=f"{SQUARE_MM[0]:g} to {SQUARE_MM[1]:g} mm",
            )
        if not RATIO[0] <= self.marker_mm / self.square_mm <= RATIO[1]:
            raise InvalidParameter(
                f"marker_mm is {self.marker_mm:g}, {self.marker_mm / self.square_mm:.3g} of a square",
                field="board.marker_mm",
                limit=f"{RATIO[0]:g} to {RATIO[1]:g} of square_mm",
                cure="0.72 of a square is usual",
            )
        if max(self.columns, self.rows) * self.square_mm > MAX_SIDE_MM:
            raise InvalidParameter(
                f"the board is {self.columns * self.square_mm:g} x {self.rows * self.square_mm:g} mm",
                field="board.square_mm",
                limit=f"{MAX_SIDE_MM:g} mm a side",
            )

    @property
    def title(self) -> str:
        """The board in words."""
        return (
            f"Calibration board {self.columns} x {self.rows}, squares {self.square_mm:g} mm, "
            f"markers {self.marker_mm:g} mm, ArUco {DICTIONARY[5:].replace('_', ' ').lower()}"
        )

    @property
    def dark_squares(self) -> list[tuple[int, int]]:
        """Column and row of each black square."""
        return [(c, r) for r in range(self.rows) for c in range(self.columns) if (c + r) % 2 == 0]

    @property
    def marker_squares(self) -> list[tuple[int, int]]:
        """Column and row of the square of each marker, in the order of their numbers from 0."""
        return [(c, r) for r in range(self.rows) for c in range(self.columns) if (c + r) % 2 == 1]

    @property
    def corner_count(self) -> int:
        """Inner corners: where four squares meet."""
        return (self.columns - 1) * (self.rows - 1)

    @property
    def corners_mm(self) -> Floats:
        """Inner corners, row by row, shape (corner_count, 2). [mm]"""
        column, row = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        corners: Floats = np.stack([column.ravel(), row.ravel()], axis=1).astype(float) * self.square_mm
        return corners

    def marker_corners_mm(self, number: int) -> Floats:
        """Corners of a marker, clockwise from its upper left, shape (4, 2). [mm]"""
        column, row = self.marker_squares[number]
        edge = (self.square_mm - self.marker_mm) / 2
        left, top = column * self.square_mm + edge, row * self.square_mm + edge
        side = self.marker_mm
        return np.array([(left, top), (left + side, top), (left + side, top + side), (left, top + side)])


def marker_is_dark(number: int) -> npt.NDArray[np.bool_]:
    """Modules of a marker with its border, True where black, shape (7, 7)."""
    dark = np.ones((MODULES, MODULES), bool)
    code = board_dictionary().bytesList[number : number + 1]
    dark[1:-1, 1:-1] = np.asarray(cv2.aruco.Dictionary.getBitsFromByteList(code, MODULES - 2)) == 0
    return dark


def board_dictionary() -> Any:
    """OpenCV's dictionary of the markers."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
