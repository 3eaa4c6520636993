"""Read rates and path errors that are predicted for the markers of a plan."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.markers.plate import PlateGeometry
from app.planning.alignment import Floats, Lane
from app.planning.placement.cerpms import one_of_each_pair, path_error_m
from app.planning.plate_view import camera_of, unit_heights_px
from app.planning.predict.models import PlateModel, fitted_models, normal_quadrature
from app.planning.rules import CameraRules, PredictionRules

FAR_M = 18.0
"""[m] ahead, from where frames count. Source: `FAR_M` of app/planning/proof/plates.py."""
MIN_UNIT_PX = 1.0
"""[px] height of a unit from which frames count. Source: `MIN_UNIT_PX` of app/planning/proof/plates.py."""
STRETCH_M = 500.0
"""[m] of lane that path errors are predicted for. Source: `LANE_STRETCH_M` of app/planning/proof/prove.py."""
_GRID_M = 0.02  # [m] between distances at which the view is computed; source: chosen by hand
_PHASES = 8  # of the first frame; source: chosen by hand
_SPEED_STEP_MPS = 0.5  # [m/s] speeds are rounded up to it; source: chosen by hand, at most 4 % of 13 m/s
_OFFSET_STEP_M = 0.1  # [m] source: chosen by hand, less than a vehicle's own 0.15 m


def plate_rates(
    offsets_m: Floats,
    speeds_mps: Floats,
    geometry: PlateGeometry,
    camera: CameraRules,
    condition: str,
    rules: PredictionRules,
) -> Floats:
    """Probability that a pass reads each plate that is there, shape (K,), by its offset from the centre line [m]."""
    speed = np.ceil(np.maximum(speeds_mps * rules.speed_share, 0.1) / _SPEED_STEP_MPS) * _SPEED_STEP_MPS
    offset = np.round(offsets_m / _OFFSET_STEP_M) * _OFFSET_STEP_M
    kinds, which = np.unique(np.column_stack([speed, offset]), axis=0, return_inverse=True)
    found = [plate_read_rate(geometry, camera, condition, v, left) for v, left in kinds.tolist()]
    return np.asarray(np.array(found)[which.reshape(-1)])


@lru_cache(maxsize=4096)
def plate_read_rate(
    geometry: PlateGeometry, camera: CameraRules, condition: str, speed_mps: float, left_m: float
) -> float:
    """Probability that a pass at a speed reads a plate beside the camera's path, on a flat and straight road.

    Notes
    -----
    Frames follow each other at the speed's distance from a first one of any phase. Each is read with the log-odds of
    its unit's height; the pass's own circumstances shift all of them alike (`PlateModel`).
    """
    return read_rate_of_model(fitted_models().plate_model(condition), geometry, camera, speed_mps, left_m)


def read_rate_of_model(
    model: PlateModel, geometry: PlateGeometry, camera: CameraRules, speed_mps: float, left_m: float = 0.0
) -> float:
    """As `plate_read_rate`, for another model than the fitted ones."""
    ahead = np.arange(_GRID_M, FAR_M, _GRID_M)
    height = unit_heights_px(camera_of(camera), geometry, ahead, left_m)
    exposures = [max(camera.exposure_s, least) for least in model.exposures_s] or [camera.exposure_s]
    rates = [_rate(model, ahead, height, speed_mps, speed_mps * exposure, camera, geometry) for exposure in exposures]
    return float(np.mean(rates))


def readable_frames(geometry: PlateGeometry, camera: CameraRules, speed_mps: float) -> float:
    """Mean number of frames of a pass in which a unit is `MIN_UNIT_PX` high or more, on a flat and straight road."""
    ahead = np.arange(_GRID_M, FAR_M, _GRID_M)
    in_reach = unit_heights_px(camera_of(camera), geometry, ahead) >= MIN_UNIT_PX
    return float(in_reach.sum() * _GRID_M / (speed_mps / camera.frames_per_s))


def _rate(
    model: PlateModel,
    ahead: Floats,
    height: Floats,
    speed_mps: float,
    blur_m: float,
    camera: CameraRules,
    geometry: PlateGeometry,
) -> float:
    blur = blur_m / (geometry.pitch_mm / 1000)
    nodes, weights = normal_quadrature()
    step = speed_mps / camera.frames_per_s
    missed = 0.0
    for phase in (np.arange(_PHASES) + 0.5) / _PHASES:
        at = np.arange(phase * step, FAR_M, step)
        units = np.where(at >= _GRID_M, np.interp(at, ahead, height), 0.0)
        odds = model.pass_log_odds(units[units >= MIN_UNIT_PX], blur)[:, None] + model.spread * nodes
        missed += float((weights * np.exp(-np.logaddexp(0, odds).sum(axis=0))).sum()) / _PHASES
    return float(model.readable_share(blur)) * (1.0 - missed)


def plate_fix_error_m(condition: str, survey_rmse_m: float) -> float:
    """Standard error of a position from a plate, horizontal. [m]"""
    return float(np.hypot(fitted_models().plate_model(condition).fix_rms_m, survey_rmse_m))


def tag_fix_error_m(survey_rmse_m: float) -> float:
    """Standard error of a position from a tag, horizontal. [m]"""
    return float(np.hypot(fitted_models().tags.fix_rms_m, survey_rmse_m))


def tag_fix_share() -> float:
    """Share of the tags that are read that also fix the position."""
    return fitted_models().tags.fix_share


def tag_rates(lane: Lane, chainages_m: npt.ArrayLike, clearance_m: float) -> Floats:
    """Probability that a pass reads each tag that is there, shape (K,)."""
    at = np.asarray(chainages_m, dtype=np.float64)
    return fitted_models().tags.read_rate(clearance_m, lane.value_at(lane.curvature_per_m, at))


def line_rates(lane: Lane, chainages_m: npt.ArrayLike, clearance_m: float) -> Floats:
    """Probability that a vehicle with its bar over a line reads each of its magnets, shape (K,)."""
    at = np.asarray(chainages_m, dtype=np.float64)
    return fitted_models().lines.read_rate(clearance_m, lane.value_at(lane.curvature_per_m, at))


class Stretches(NamedTuple):
    """Equal stretches of a lane with CERPMs, each of shape (S,).

    Attributes
    ----------
    spacing_m : ndarray
        Mean distance between pairs. [m]
    speed_mps : ndarray
        Mean design speed. [m/s]
    exact_rms_m, exact_worst_m : ndarray
        Distances of a cubic spline through the exact pairs of the lane from its centre line. [m]
    ends_per_m : ndarray
        Ends of the lane in the stretch over its length. [1/m]
    """

    spacing_m: Floats
    speed_mps: Floats
    exact_rms_m: Floats
    exact_worst_m: Floats
    ends_per_m: Floats


def lane_stretches(lane: Lane, chainages_m: Floats) -> Stretches:
    """A lane with CERPMs at chainages as equal stretches of at most 500 m."""
    count = max(int(np.ceil(lane.length_m / STRETCH_M - 1e-9)), 1)
    borders = np.linspace(0.0, lane.length_m, count + 1)
    stretch = np.minimum((lane.chainage_m / lane.length_m * count).astype(np.intp), count - 1)
    samples = np.bincount(stretch, minlength=count)
    error = path_error_m(lane, chainages_m)
    worst = np.zeros(count)
    np.maximum.at(worst, stretch, error)
    pairs = np.histogram(one_of_each_pair(chainages_m, None)[0], borders)[0]
    ends = np.zeros(count)
    ends[0] += 1.0
    ends[-1] += 1.0
    return Stretches(
        np.diff(borders) / np.maximum(pairs, 1),
        np.bincount(stretch, lane.design_speed_mps, count) / samples,
        np.sqrt(np.bincount(stretch, error**2, count) / samples),
        worst,
        ends / np.diff(borders),
    )


def path_errors_m(lane: Lane, chainages_m: Floats, rules: PredictionRules) -> tuple[Floats, Floats]:
    """Root mean square and greatest path error of each stretch of a lane with CERPMs at chainages, shape (S,). [m]"""
    found, model = lane_stretches(lane, chainages_m), fitted_models().path
    spacing = found.spacing_m / (1.0 - rules.lost_share)
    speed = found.speed_mps * rules.speed_share
    rms = model.rms_of(rules.survey_rmse_m, spacing, speed, found.exact_rms_m, found.ends_per_m)
    return rms, np.maximum(rms * model.worst_share, np.sqrt(model.exact_share) * found.exact_worst_m)
