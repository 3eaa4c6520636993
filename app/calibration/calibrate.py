"""Views of a calibration board -> a camera, with how sure each of its parameters is.

Zhang's method as OpenCV has it (calibrateCameraExtended), with what people forget round it: views that repeat others,
views that do not fit, an image that is hardly covered, a board that was never tilted, a distortion that turns back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from app.calibration.board_view import (
    BoardView,
    CalibratedCamera,
    CalibrationRules,
    CameraCalibration,
    Coverage,
    Intrinsics,
    Photo,
    ViewFault,
    ViewReport,
)
from app.errors import CalibrationRefused, InvalidParameter, UnreadableUpload, WaymarkError
from app.sensors.camera import CalibrationBoard, Camera
from app.values import Floats

VERSION = "calibration/1"
COEFFICIENTS = (4, 5, 8)
"""Numbers of distortion coefficients: k1, k2, p1, p2; with k3; with k4, k5, k6. Source: OpenCV's models."""
_CELLS = (6, 8)
"""[rows, columns] of cells over which coverage is counted."""
_ROUNDS = 4
"""[rounds] of fitting and leaving out views that do not fit, at most."""
MIN_COMMON_CORNERS = 4
"""[corners] that two views must share to be compared."""
K3_SIGMA = 3.0
"""[standard deviations] above which k3 is kept. Source: the three-sigma rule."""
MAX_MISFITS = 4
"""[views] one in this many may be left out in one round."""
MAX_TURN_BACK_PX = 0.5
"""[px] between a pixel and itself through the lens and back. Source: half a pixel."""


def calibrate_camera(
    photos: Sequence[Photo],
    board: CalibrationBoard,
    *,
    coefficients: int | None = None,
    rules: CalibrationRules | None = None,
) -> CameraCalibration:
    """Calibrate a camera from photos of a board.

    Parameters
    ----------
    coefficients : int, optional
        Of the distortion: 4, 5 or 8. Left out, k3 is kept where it is above three of its standard deviations.

    Raises
    ------
    CalibrationRefused
        Not good enough; begins with the name of the reason and lists why each photo was left out.
    InvalidParameter
        Another number of coefficients.

    Notes
    -----
    Z. Zhang, A flexible new technique for camera calibration, IEEE PAMI 22(11), 2000. Standard deviations are those of
    the least squares, with the reprojection error as the corners' own.
    """
    rules = rules or CalibrationRules()
    if coefficients is not None and coefficients not in COEFFICIENTS:
        raise InvalidParameter(
            f"{coefficients} coefficients", field="coefficients", limit="4, 5 or 8", cure="leave it out"
        )
    reports = [
        ViewReport(
            k,
            photo.name,
            photo.view.fault is None,
            photo.view.fault,
            photo.view.detail or None,
            len(photo.view.corner),
            edge_width_px=round(photo.view.edge_width_px, 3) if np.isfinite(photo.view.edge_width_px) else None,
        )
        for k, photo in enumerate(photos)
    ]
    size = _leave_out_other_sizes(photos, reports)
    _leave_out_alike(photos, reports, size, rules)
    fit = _fit(photos, reports, size, board, coefficients, rules)
    for _round in range(_ROUNDS):
        if not _leave_out_misfits(fit, reports, rules):
            break
        fit = _fit(photos, reports, size, board, coefficients, rules)
    return _assess(fit, photos, reports, size, board, rules)


@dataclass(slots=True, eq=False)
class _Fit:
    used: list[int]
    rms_px: float
    matrix: Floats
    distortion: Floats
    sigma: Floats
    rotations: Floats
    view_rms_px: Floats


def _leave_out_other_sizes(photos: Sequence[Photo], reports: list[ViewReport]) -> tuple[int, int]:
    """Keep the size, turned one way, that most usable photos have."""
    kinds = [(photo.size_px, photo.orientation) for photo in photos]
    usable = [kind for kind, report in zip(kinds, reports, strict=True) if report.used]
    if not usable:
        return 0, 0
    usual = max(usable, key=usable.count)
    for k, kind in enumerate(kinds):
        if reports[k].used and kind != usual:
            width, height = kind[0] or (0, 0)
            other = (
                f"turned otherwise (EXIF orientation {kind[1]})" if kind[0] == usual[0] else f"{width} x {height} px"
            )
            detail = f"{other}; most photos have {usual[0][0]} x {usual[0][1]} px" if usual[0] else other
            reports[k] = reports[k].left_out(ViewFault.OTHER_SIZE, detail)
    return usual[0] or (0, 0)


def _leave_out_alike(
    photos: Sequence[Photo], reports: list[ViewReport], size: tuple[int, int], rules: CalibrationRules
) -> None:
    """Of views that show the board in the same place, keep the first."""
    kept: list[int] = []
    for k, report in enumerate(reports):
        if not report.used:
            continue
        twin = next(
            (j for j in kept if _mean_shift_px(photos[j].view, photos[k].view) < rules.alike_share * np.hypot(*size)),
            None,
        )
        if twin is None:
            kept.append(k)
        else:
            detail = f"the board is in the same place as in photo {twin}"
            reports[k] = report.left_out(ViewFault.ALIKE, detail)


def _mean_shift_px(first: BoardView, second: BoardView) -> float:
    """Mean distance between corners that both views show. [px]"""
    _both, a, b = np.intersect1d(first.corner, second.corner, return_indices=True)
    if len(a) < MIN_COMMON_CORNERS:
        return float("inf")
    return float(np.linalg.norm(first.corners_px[a] - second.corners_px[b], axis=1).mean())


def _fit(
    photos: Sequence[Photo], reports: list[ViewReport], size: tuple[int, int], board: CalibrationBoard,
    coefficients: int | None, rules: CalibrationRules,
) -> _Fit:  # fmt: skip
    used = [report.photo for report in reports if report.used]
    if len(used) < rules.min_views:
        alike = sum(report.reason is ViewFault.ALIKE for report in reports)
        if alike and len(used) + alike >= rules.min_views:
            raise _refusal(
                "views-alike", f"{len(used)} different views of the board, {alike} repeat them", "photos",
                f"{rules.min_views} different views", "move and tilt the board between photos", reports,
            )  # fmt: skip
        raise _refusal(
            "too-few-views", f"{len(used)} of {len(reports)} photos can be used", "photos",
            f"{rules.min_views} at least, 12 to 20 are better", "take more photos; `errors` lists what each one lacks",
            reports,
        )  # fmt: skip
    plane = np.column_stack([board.corners_mm, np.zeros(board.corner_count)]).astype(np.float32)
    objects = [plane[photos[k].view.corner] for k in used]
    images = [photos[k].view.corners_px.astype(np.float32).reshape(-1, 1, 2) for k in used]
    flags = {4: cv2.CALIB_FIX_K3, 8: cv2.CALIB_RATIONAL_MODEL}.get(coefficients or 5, 0)
    fit = _solve(used, objects, images, size, flags)
    if coefficients is None and not abs(fit.distortion[4]) > K3_SIGMA * fit.sigma[8]:
        fit = _solve(used, objects, images, size, cv2.CALIB_FIX_K3)
        fit.distortion = fit.distortion[:4]
    elif coefficients is not None:
        fit.distortion = fit.distortion[:coefficients]
    return fit


def _solve(
    used: list[int], objects: list[npt.NDArray[np.float32]], images: list[npt.NDArray[np.float32]],
    size: tuple[int, int], flags: int,
) -> _Fit:  # fmt: skip
    try:
        rms, matrix, distortion, rotations, _shifts, sigma, _sigma_views, errors = cv2.calibrateCameraExtended(
            objects, images, size, np.eye(3), np.zeros(8), flags=flags
        )
    except cv2.error as error:
        raise UnreadableUpload(
            "the views do not determine a camera", field="photos", cure="tilt the board differently in each photo"
        ) from error
    turned = np.array([cv2.Rodrigues(rotation)[0] for rotation in rotations])
    return _Fit(
        used, float(rms), np.asarray(matrix, float), np.asarray(distortion, float).ravel(),
        np.asarray(sigma, float).ravel(), turned, np.asarray(errors, float).ravel(),
    )  # fmt: skip


def _leave_out_misfits(fit: _Fit, reports: list[ViewReport], rules: CalibrationRules) -> bool:
    """Leave the views out that do not fit the others, worst first and at most a quarter at a time."""
    limit = max(rules.outlier_px, rules.outlier_factor * float(np.median(fit.view_rms_px)))
    bad = [k for k in np.argsort(-fit.view_rms_px) if fit.view_rms_px[k] > limit][
        : max(len(fit.used) // MAX_MISFITS, 1)
    ]
    for k in bad:
        detail = f"reprojection error {fit.view_rms_px[k]:.2f} px, the limit beside the others is {limit:.2f} px"
        photo = fit.used[k]
        reports[photo] = reports[photo].left_out(ViewFault.DOES_NOT_FIT, detail)
    return bool(bad)


def _assess(
    fit: _Fit,
    photos: Sequence[Photo],
    reports: list[ViewReport],
    size: tuple[int, int],
    board: CalibrationBoard,
    rules: CalibrationRules,
) -> CameraCalibration:
    normals = fit.rotations[:, :, 2]
    tilt = np.degrees(np.arccos(np.clip(np.abs(normals[:, 2]), 0, 1)))
    spread_deg = float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1, 1))))
    for k, photo in enumerate(fit.used):
        rms_px, tilt_deg = round(float(fit.view_rms_px[k]), 3), round(float(tilt[k]), 3)
        reports[photo] = replace(reports[photo], rms_px=rms_px, tilt_deg=tilt_deg)
    covered = _covered([photos[k].view.corners_px for k in fit.used], size)
    (fx, _, cx), (_, fy, cy), _ = fit.matrix.tolist()
    fx_sigma, fy_sigma, cx_sigma, cy_sigma, *of_distortion = fit.sigma.tolist()
    found = CameraCalibration(
        CalibratedCamera(fx, fy, cx, cy, tuple(fit.distortion.tolist()), *size),
        Intrinsics(fx_sigma, fy_sigma, cx_sigma, cy_sigma, tuple(of_distortion[: len(fit.distortion)])),
        fit.rms_px,
        Coverage(float(covered.mean()), covered.astype(int).tolist()),
        spread_deg,
        board,
        tuple(reports),
    )
    _check(found, rules)
    return found


def _covered(corners_px: Sequence[Floats], size: tuple[int, int]) -> npt.NDArray[np.bool_]:
    covered = np.zeros(_CELLS, bool)
    points = np.concatenate(corners_px)
    row = (points[:, 1] + 0.5) / size[1] * _CELLS[0]
    column = (points[:, 0] + 0.5) / size[0] * _CELLS[1]
    covered[row.astype(int).clip(0, _CELLS[0] - 1), column.astype(int).clip(0, _CELLS[1] - 1)] = True
    return covered


def _check(found: CameraCalibration, rules: CalibrationRules) -> None:
    """Refuse a calibration that is not good enough, with the simplest reason first."""
    camera, sigma = found.camera, found.sigma
    focal_share = max(sigma.fx_px / abs(camera.fx_px), sigma.fy_px / abs(camera.fy_px))
    checks = (
        (found.tilt_spread_deg >= rules.min_tilt_deg, "views-alike",
         f"the board is tilted by {found.tilt_spread_deg:.1f} degrees at most from view to view",
         f"{rules.min_tilt_deg:g} degrees", "tilt the board by 30 to 45 degrees, to each side"),
        (found.coverage.share >= rules.min_coverage, "poor-coverage",
         f"corners lie in {found.coverage.share:.0%} of the image's cells",
         f"{rules.min_coverage:.0%}", "bring the board into the corners of the image too"),
        (found.rms_px <= rules.max_rms_px, "high-error",
         f"the reprojection error is {found.rms_px:.2f} px",
         f"{rules.max_rms_px:g} px", "is the board flat, the focus fixed, and the board the declared one?"),
        (focal_share <= rules.max_focal_share, "unsure-focal-length",
         f"the standard deviation of the focal length is {focal_share:.2%}",
         f"{rules.max_focal_share:.2%}", "take more photos, nearer, with the board more tilted"),
        (is_invertible(camera), "distortion-turns-back",
         "the distortion turns back within the image", "one ray a pixel",
         "cover the corners of the image, or ask for fewer coefficients"),
    )  # fmt: skip
    for passed, reason, message, limit, cure in checks:
        if not passed:
            raise _refusal(reason, message, "photos", limit, cure, found.views)


def is_invertible(camera: CalibratedCamera) -> bool:
    """Whether each pixel of the image's edge has its own ray: undistorted and distorted again, it is the same pixel."""
    lens = Camera(
        camera.width_px, camera.height_px, camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.distortion
    )
    w, h = camera.width_px - 1.0, camera.height_px - 1.0
    edge = np.array([(x, y) for x in np.linspace(0, w, 9) for y in (0.0, h)] + [(x, h / 2) for x in (0.0, w)])
    back = lens.project(np.column_stack([lens.undistort(edge), np.ones(len(edge))]))
    return bool(np.linalg.norm(back - edge, axis=1).max() < MAX_TURN_BACK_PX)


def _refusal(
    reason: str, message: str, field: str, limit: str, cure: str, views: Sequence[ViewReport]
) -> CalibrationRefused:
    parts: list[WaymarkError] = [
        UnreadableUpload(f"{view.reason}: {view.name}: {view.detail}", field=f"photos.{view.photo}")
        for view in views
        if not view.used
    ]
    error = CalibrationRefused(f"{reason}: {message}", field=field, limit=limit, cure=cure)
    error.parts = tuple(parts)
    return error
