"""The lane drawn on a camera frame: pixel coordinates of its boundaries and centre line.

CERPM paper, section 2.2, equation 2: points in a local north, east, down frame, shifted to the camera, are turned by
the heading theta to right, down, ahead,

    [X_c]   [-sin theta  cos theta  0] [N]
    [Y_c] = [     0          0      1] [E]
    [Z_c]   [ cos theta  sin theta  0] [D]

With theta clockwise from north, ahead is (cos, sin, 0) and right (-sin, cos, 0) in north, east, down: the rows are
right, down and ahead, right x down = ahead, so the determinant is +1 and the matrix is a proper rotation as printed. It
takes the camera as level and looking straight ahead; here the mount's azimuth, depression and roll follow it. The
vehicle stands level, and nothing hides the road.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from typing_extensions import TypedDict

from app.errors import InvalidParameter
from app.sensors.camera import Camera
from app.values import Bools, Floats

NEAR_M = 0.2  # [m] nearest distance along the camera's axis that is drawn
_LEVEL_FROM_VEHICLE = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
_VIEW_MARGIN = 0.02  # share of the field of view beyond the frame's border where points are projected
_BORDER_POINTS = 33  # on each side of the frame
_MAX_BORDER_ERROR_PX = 0.5  # [px] of undistorting and distorting the border; source: half a pixel
_CURVE_STEP_PX = 12.0  # [px] between points of lines that the lens bends
_MAX_STEPS = 200  # between two points of a line; bounds the time of a frame


@dataclass(frozen=True, slots=True)
class VehiclePose:
    """Position of a vehicle's reference point on the road, and its heading.

    Raises
    ------
    InvalidParameter
        A value is not finite.
    """

    position_ned_m: tuple[float, float, float]  # [m] north, east, down in the frame of the lane
    heading_deg: float  # [deg] clockwise from north

    def __post_init__(self) -> None:
        if len(self.position_ned_m) != 3 or not all(math.isfinite(v) for v in self.position_ned_m):
            raise InvalidParameter(
                "a position is three finite numbers", field="pose.position_ned_m", limit="north, east, down"
            )
        if not math.isfinite(self.heading_deg):
            raise InvalidParameter("a heading is finite", field="pose.heading_deg", limit="a number of degrees")


@dataclass(frozen=True, slots=True, eq=False)
class PointsInFrame:
    """Images of points."""

    points_px: Floats  # shape (N, 2): [px] u right, v down; NaN behind the camera and far beyond the frame's border
    visible: Bools  # shape (N,): within the frame
    ahead_m: Floats  # shape (N,): [m] along the optical axis


@dataclass(frozen=True, slots=True, eq=False)
class LineInFrame:
    """Image of a line."""

    points: PointsInFrame  # of the line's own points
    # shape (M, 2): [px] parts of the line within the frame, cut at its border and at the camera
    pieces_px: tuple[Floats, ...]


class LaneInFrame(TypedDict):
    """Pixel coordinates of the lane in the camera frame."""

    frame: str
    left_px: list[list[list[float]]]
    right_px: list[list[list[float]]]
    centre_px: list[list[list[float]]]
    area_px: list[list[list[float]]]
    markers_px: list[list[float]]


@dataclass(frozen=True, slots=True, eq=False)
class LaneOverlay:
    """A lane in a frame."""

    left: LineInFrame
    right: LineInFrame
    centre: LineInFrame
    area_px: tuple[Floats, ...]  # shape (M, 2): [px] polygons between the boundaries, within the frame
    markers: PointsInFrame

    def visible(self, frame: str = "") -> LaneInFrame:
        """What is to be drawn over the frame of this name."""

        def listed(pieces: tuple[Floats, ...]) -> list[list[list[float]]]:
            return [np.round(piece, 2).tolist() for piece in pieces]

        return {
            "frame": frame,
            "left_px": listed(self.left.pieces_px),
            "right_px": listed(self.right.pieces_px),
            "centre_px": listed(self.centre.pieces_px),
            "area_px": listed(self.area_px),
            "markers_px": np.round(self.markers.points_px[self.markers.visible], 2).tolist(),
        }


def ned_from_enu(points_enu_m: npt.ArrayLike) -> Floats:
    """North, east, down from east, north[, up] of the same origin; without up they lie in its plane. [m]"""
    points = np.asarray(points_enu_m, float)
    up = points[..., 2] if points.shape[-1] == 3 else np.zeros(points.shape[:-1])
    return np.stack([points[..., 1], points[..., 0], -up], axis=-1)


def level_camera_from_ned(heading_deg: float) -> Floats:
    """Equation 2 of the CERPM paper as printed: right, down, ahead from north, east, down, shape (3, 3)."""
    theta = math.radians(heading_deg)
    s, c = math.sin(theta), math.cos(theta)
    return np.array([[-s, c, 0.0], [0.0, 0.0, 1.0], [c, s, 0.0]])


def camera_from_ned(points_ned_m: npt.ArrayLike, pose: VehiclePose, camera: Camera) -> Floats:
    """Points in the camera frame.

    Parameters
    ----------
    points_ned_m : array_like, shape (N, 3)
        NaN where there is none. [m]
    camera : Camera
        Its mount places it on the vehicle.

    Returns
    -------
    ndarray, shape (N, 3)
        Right, down, along the optical axis. [m]

    Raises
    ------
    InvalidParameter
        The points have another shape, or one is infinite.
    """
    points = np.asarray(points_ned_m, float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InvalidParameter(
            f"points have shape {points.shape}", field="points_ned_m", limit="north, east, down each"
        )
    if np.isinf(points).any():
        raise InvalidParameter("a point is infinite", field="points_ned_m", limit="finite, or NaN for none")
    level = (points - pose.position_ned_m) @ level_camera_from_ned(pose.heading_deg).T
    level -= _LEVEL_FROM_VEHICLE @ camera.position_vehicle_m
    mounted: Floats = level @ (camera.camera_from_vehicle @ _LEVEL_FROM_VEHICLE.T).T
    return mounted


def points_in_frame(points_ned_m: npt.ArrayLike, pose: VehiclePose, camera: Camera) -> PointsInFrame:
    """Pixel coordinates of points.

    Parameters
    ----------
    points_ned_m : array_like, shape (N, 3)
        [m]

    Returns
    -------
    PointsInFrame

    Raises
    ------
    InvalidParameter
        As `camera_from_ned`, or the camera's distortion folds its own picture over.
    """
    return _images(camera_from_ned(points_ned_m, pose, camera), camera, _field_of_view(camera))


def lane_in_frame(
    left_ned_m: npt.ArrayLike,
    right_ned_m: npt.ArrayLike,
    centre_ned_m: npt.ArrayLike,
    *,
    pose: VehiclePose,
    camera: Camera,
    markers_ned_m: npt.ArrayLike = (),
    far_m: float = 150.0,
) -> LaneOverlay:
    """Project a lane into a camera frame.

    Parameters
    ----------
    left_ned_m, right_ned_m, centre_ned_m : array_like, shape (N, 3)
        Boundaries and centre line, in order along the lane; the boundaries are NaN where they are not known. [m]
    pose : VehiclePose
        At the time of the frame.
    camera : Camera
        Intrinsics and mount.
    markers_ned_m : array_like, shape (K, 3)
        [m]
    far_m : float
        Lane and markers are not drawn beyond, along the optical axis. [m]

    Returns
    -------
    LaneOverlay
        Lines and polygons are cut where they pass the near plane and the frame's border, between points too.

    Raises
    ------
    InvalidParameter
        Shapes don't fit, a point is infinite, or the camera's distortion folds its own picture over.
    """
    if not far_m > NEAR_M:
        raise InvalidParameter("far_m is too near", field="far_m", limit=f"> {NEAR_M:g} m")
    left, right, centre = (camera_from_ned(points, pose, camera) for points in (left_ned_m, right_ned_m, centre_ned_m))
    if len(left) != len(right):
        raise InvalidParameter("boundaries have different lengths", field="right_ned_m", limit="one point per station")
    view = _field_of_view(camera)
    both = np.isfinite(np.hstack([left, right])).all(axis=1)
    strips = [np.vstack([left[run], right[run][::-1]]) for run in _runs(both)]
    area = [_polygon_in_frame(strip, camera, view, far_m) for strip in strips]
    markers_m = np.asarray(markers_ned_m, float)
    markers = points_in_frame(markers_m.reshape(-1, 3) if markers_m.size == 0 else markers_m, pose, camera)
    return LaneOverlay(
        left=_line_in_frame(left, camera, view, far_m),
        right=_line_in_frame(right, camera, view, far_m),
        centre=_line_in_frame(centre, camera, view, far_m),
        area_px=tuple(polygon for polygon in area if len(polygon) >= 3),
        markers=replace(markers, visible=markers.visible & (markers.ahead_m <= far_m)),
    )


# --- the camera's field of view -----------------------------------------------------------------------------------


def _field_of_view(camera: Camera) -> Floats:
    """Planes (4, 3) through the optical centre that bound the field of view, inside positive."""
    w, h = camera.width_px - 0.5, camera.height_px - 0.5
    across, down = np.linspace(-0.5, w, _BORDER_POINTS), np.linspace(-0.5, h, _BORDER_POINTS)
    border = np.concatenate(
        [np.column_stack([across, np.full_like(across, v)]) for v in (-0.5, h)]
        + [np.column_stack([np.full_like(down, u), down]) for u in (-0.5, w)]
    )
    ideal = (border - (camera.cx_px, camera.cy_px)) / (camera.fx_px, camera.fy_px)
    if camera.distortion:
        ideal = camera.undistort(border)
        back = camera.project(np.column_stack([ideal, np.ones(len(ideal))]))
        if not np.abs(back - border).max() < _MAX_BORDER_ERROR_PX:
            raise InvalidParameter(
                "the distortion folds the camera's own picture over",
                field="camera.distortion",
                limit="one direction for each pixel",
                cure="check the coefficients and their order: k1, k2, p1, p2, k3",
            )
    margin = _VIEW_MARGIN * np.ptp(ideal, axis=0)
    (x0, y0), (x1, y1) = ideal.min(axis=0) - margin, ideal.max(axis=0) + margin
    return np.array([[1, 0, -x0], [-1, 0, x1], [0, 1, -y0], [0, -1, y1]], float)


def _images(points_m: Floats, camera: Camera, view: Floats) -> PointsInFrame:
    ahead = points_m[:, 2]
    seen = (ahead >= NEAR_M) & (points_m @ view.T >= 0).all(axis=1)
    image = np.full((len(points_m), 2), np.nan)
    image[seen] = camera.project(points_m[seen])
    u, v = image.T
    inside = (u >= -0.5) & (u <= camera.width_px - 0.5) & (v >= -0.5) & (v <= camera.height_px - 0.5)
    return PointsInFrame(image, inside, ahead.copy())


# --- cutting ------------------------------------------------------------------------------------------------------


def _runs(kept: Bools | np.bool_) -> list[slice]:
    """Runs of two or more consecutive points that are kept."""
    edges = np.flatnonzero(np.diff(np.r_[False, np.atleast_1d(kept), False].astype(np.int8)))
    return [slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= 2]


def _cut(points: Floats, depth: Floats) -> Floats:
    """Points, with new ones inserted where the line crosses depth 0."""
    cross = np.flatnonzero((depth[:-1] >= 0) != (depth[1:] >= 0))
    if not len(cross):
        return points
    share = (depth[cross] / (depth[cross] - depth[cross + 1]))[:, None]
    between = points[cross] + share * (points[cross + 1] - points[cross])
    return np.insert(points, cross + 1, between, axis=0)


def _cut_lines(lines: Sequence[Floats], plane: Floats, offset: float) -> list[Floats]:
    """Pieces of open lines on the positive side of a plane."""
    pieces = []
    for line in lines:
        cut = _cut(line, line @ plane + offset)
        pieces += [cut[run] for run in _runs(cut @ plane + offset >= -1e-9)]
    return pieces


def _cut_polygon(polygon: Floats, plane: Floats, offset: float) -> Floats:
    """Part of a polygon on the positive side of a plane (Sutherland-Hodgman algorithm)."""
    closed = np.vstack([polygon, polygon[:1]])
    cut = _cut(closed, closed @ plane + offset)[:-1]
    return cut[cut @ plane + offset >= -1e-9]


def _bounds(view: Floats, far_m: float) -> list[tuple[Floats, float]]:
    ahead = np.array([0.0, 0.0, 1.0])
    return [(ahead, -NEAR_M), (-ahead, far_m), *((plane, 0.0) for plane in view)]


def _frame_edges(camera: Camera) -> list[tuple[Floats, float]]:
    u, v = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    return [(u, 0.5), (-u, camera.width_px - 0.5), (v, 0.5), (-v, camera.height_px - 0.5)]


def _line_in_frame(points_m: Floats, camera: Camera, view: Floats, far_m: float) -> LineInFrame:
    pieces = [points_m[run] for run in _runs(np.isfinite(points_m).all(axis=1))]
    for plane, offset in _bounds(view, far_m):
        pieces = _cut_lines(pieces, plane, offset)
    images = [camera.project(_curve(piece, camera)) for piece in pieces]
    for plane, offset in _frame_edges(camera):
        images = _cut_lines(images, plane, offset)
    return LineInFrame(_images(points_m, camera, view), tuple(images))


def _polygon_in_frame(polygon_m: Floats, camera: Camera, view: Floats, far_m: float) -> Floats:
    for plane, offset in _bounds(view, far_m):
        if len(polygon_m):
            polygon_m = _cut_polygon(polygon_m, plane, offset)
    if len(polygon_m) < 3:
        return np.empty((0, 2))
    image = camera.project(_curve(np.vstack([polygon_m, polygon_m[:1]]), camera))[:-1]
    for plane, offset in _frame_edges(camera):
        if len(image):
            image = _cut_polygon(image, plane, offset)
    return image


def _curve(points_m: Floats, camera: Camera) -> Floats:
    """More points along a line, evenly in the image, where the lens bends straight lines."""
    if not camera.distortion:
        return points_m
    image = points_m[:, :2] / points_m[:, 2:] * (camera.fx_px, camera.fy_px)
    lengths = np.hypot(*np.diff(image, axis=0).T)
    parts = [points_m[:1]]
    for k, length in enumerate(lengths):
        steps = int(np.clip(math.ceil(length / _CURVE_STEP_PX), 1, _MAX_STEPS))
        near, far = points_m[k], points_m[k + 1]
        u = np.arange(1, steps + 1) / steps
        share = u * near[2] / (far[2] + u * (near[2] - far[2]))  # evenly in the image, not on the road
        parts.append(near + share[:, None] * (far - near))
    return np.vstack(parts)
