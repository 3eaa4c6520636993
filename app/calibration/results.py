"""Photos and rules of a calibration, and its result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.calibration.board_view import BoardView, ViewFault


@dataclass(frozen=True, slots=True)
class CalibrationRules:
    """When a calibration is good enough.

    Attributes
    ----------
    min_views : int
    alike_share : float
        Mean shift of the corners from one view to another over the image's diagonal, below which the second is left
        out.
    min_tilt_deg : float
        Largest angle between two views of the board. [deg]
    min_coverage : float
        Share of the image's 6 x 8 cells with a corner in them.
    max_rms_px : float
        Reprojection error over all views. [px]
    max_focal_share : float
        Standard deviation of the focal length over itself.
    outlier_px, outlier_factor : float
        A view is left out when its error is above both: absolute, and times the median view's. [px]

    Notes
    -----
    Source: all chosen by hand, no measurement was kept; Zhang's method (`calibrate_camera`) needs three views at least.
    """

    min_views: int = 6
    alike_share: float = 0.01
    min_tilt_deg: float = 20.0
    min_coverage: float = 0.4
    max_rms_px: float = 1.0
    max_focal_share: float = 0.005
    outlier_px: float = 0.5
    outlier_factor: float = 3.0


@dataclass(frozen=True, slots=True)
class ViewReport:
    """How a photo was used, or why it was left out.

    Attributes
    ----------
    photo : int
        From 0, as they were sent.
    name : str
    fault : ViewFault or None
        None where it was used.
    detail : str
    corners : int
    rms_px, tilt_deg : float or None
        Reprojection error; angle between the board and the image plane. Of views that were used. [px, deg]
    edge_width_px : float or None
        [px]
    """

    photo: int
    name: str
    fault: ViewFault | None = None
    detail: str = ""
    corners: int = 0
    rms_px: float | None = None
    tilt_deg: float | None = None
    edge_width_px: float | None = None


@dataclass(frozen=True, slots=True)
class Photo:
    """A photo after the search for the board.

    Attributes
    ----------
    name : str
    size_px : (int, int) or None
        Width and height, upright; None where it could not be read.
    orientation : int
        Of its EXIF data: photos that were turned differently are not of one image plane.
    view : BoardView
    """

    name: str
    size_px: tuple[int, int] | None
    orientation: int
    view: BoardView


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """A calibrated camera.

    Attributes
    ----------
    width_px, height_px : int
    parameters : dict of str to float
        fx_px, fy_px, cx_px, cy_px; pixel centres at integers. [px]
    distortion : tuple of float
        OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]].
    sigma : dict of str to float
        Standard deviations of the parameters. [px]
    distortion_sigma : tuple of float
        Of the coefficients.
    rms_px : float
        Reprojection error over all views. [px]
    views : tuple of ViewReport
        One a photo.
    covered : ndarray of bool, shape (6, 8)
        Cells of the image with a corner in them.
    tilt_spread_deg : float
        Largest angle between two views of the board. [deg]
    """

    width_px: int
    height_px: int
    parameters: dict[str, float]
    distortion: tuple[float, ...]
    sigma: dict[str, float]
    distortion_sigma: tuple[float, ...]
    rms_px: float
    views: tuple[ViewReport, ...]
    covered: npt.NDArray[np.bool_]
    tilt_spread_deg: float

    @property
    def coverage(self) -> float:
        """Share of the image's cells with a corner in them."""
        return float(self.covered.mean())
