"""What a camera sees of one pass over a plate: frames, motion blur, and how often the plate is predicted to be read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from app.errors import InvalidParameter
from app.markers.plate import PlateGeometry
from app.planning.alignment import Floats
from app.planning.plate_view import camera_of, project_road, unit_heights_px
from app.planning.predict.models import DAY, fitted_models
from app.planning.predict.rates import FAR_M, MIN_UNIT_PX, plate_read_rate, readable_frames
from app.planning.rules import CameraRules
from app.sensors.camera import Camera

MAX_FRAMES = 40
"""Frames of a pass that are listed; of more, so many at equal steps. Source: chosen by hand, a page of a table."""
_GRID_M = 0.02  # [m] between distances at which the view is computed; source: as in app/planning/predict/rates.py


@dataclass(frozen=True, slots=True)
class PassFrame:
    """One frame of a pass.

    Attributes
    ----------
    ahead_m : float
        From the camera to the plate's centre, along the road. [m]
    unit_px : float
        Height of a unit's image. [px]
    plate_width_px, plate_height_px : float
        Extent of the plate's image. [px]
    blur_px : float
        How far the plate's image moves during the exposure. [px]
    read_probability : float
        Of reading this frame by day, in mean circumstances.
    """

    ahead_m: float
    unit_px: float
    plate_width_px: float
    plate_height_px: float
    blur_px: float
    read_probability: float


@dataclass(frozen=True, slots=True)
class CameraPass:
    """A pass over a plate at even speed on a flat and straight road.

    Attributes
    ----------
    step_m : float
        That the vehicle advances from frame to frame. [m]
    near_m, far_m : float or None
        Nearest and farthest distance at which a unit is `MIN_UNIT_PX` high or more and the plate is whole in view;
        None where it never is. [m]
    readable_frames : float
        Mean number of frames of a pass between these two.
    best_unit_px : float
        Greatest height of a unit's image. [px]
    blur_m, blur_units : float
        Distance driven during the exposure, and as a share of the pitch of the units. [m, 1]
    frames : tuple of PassFrame
        Those between these two, far to near.
    listed_every : int
        `frames` has one of so many.
    read_rates : dict of str to float
        Probability that a pass reads the plate, by condition.
    """

    step_m: float
    near_m: float | None
    far_m: float | None
    readable_frames: float
    best_unit_px: float
    blur_m: float
    blur_units: float
    frames: tuple[PassFrame, ...]
    listed_every: int
    read_rates: dict[str, float]


def camera_pass(geometry: PlateGeometry, rules: CameraRules, speed_mps: float, left_m: float = 0.0) -> CameraPass:
    """Predict a pass.

    Parameters
    ----------
    geometry : PlateGeometry
    rules : CameraRules
    speed_mps : float
        Above 0. [m/s]
    left_m : float
        Plate's centre left of the camera's path. [m]

    Raises
    ------
    InvalidParameter
        The speed is not positive.

    Notes
    -----
    The rates are those of plans: `app.planning.predict.rates`. A single frame's probability is that of the same model
    without the spread between passes.
    """
    if not speed_mps > 0:
        raise InvalidParameter(f"the speed is {speed_mps:g} m/s", field="speed_kmh", limit="above 0")
    camera = camera_of(rules)
    grid = np.arange(_GRID_M, FAR_M, _GRID_M)
    unit_px = unit_heights_px(camera, geometry, grid, left_m)
    in_reach = grid[unit_px >= MIN_UNIT_PX]
    step_m = speed_mps / rules.frames_per_s
    blur_m = speed_mps * rules.exposure_s
    ahead = np.arange(step_m / 2, FAR_M, step_m)
    ahead = ahead[unit_heights_px(camera, geometry, ahead, left_m) >= MIN_UNIT_PX]
    every = max(-(-len(ahead) // MAX_FRAMES), 1)
    models = fitted_models()
    return CameraPass(
        step_m=step_m,
        near_m=float(in_reach[0]) if len(in_reach) else None,
        far_m=float(in_reach[-1]) if len(in_reach) else None,
        readable_frames=readable_frames(geometry, rules, speed_mps) if not left_m else len(in_reach) * _GRID_M / step_m,
        best_unit_px=float(unit_px.max()),
        blur_m=blur_m,
        blur_units=blur_m / (geometry.pitch_mm / 1000),
        frames=_frames(camera, geometry, ahead[::every][::-1], left_m, blur_m),
        listed_every=every,
        read_rates={name: plate_read_rate(geometry, rules, name, speed_mps, left_m) for name in models.plates},
    )


def _frames(
    camera: Camera, geometry: PlateGeometry, ahead_m: Floats, left_m: float, blur_m: float
) -> tuple[PassFrame, ...]:
    half = geometry.side_mm / 2000
    corners = [(forward, across) for forward in (-half, half) for across in (-half, half)]
    seen = [project_road(camera, ahead_m + forward, left_m + across) for forward, across in corners]
    u, v = np.stack([columns for columns, _ in seen]), np.stack([rows for _, rows in seen])
    ends = [project_road(camera, ahead_m + way, left_m) for way in (-blur_m / 2, blur_m / 2)]
    blur_px = np.hypot(ends[1][0] - ends[0][0], ends[1][1] - ends[0][1])
    unit_px = unit_heights_px(camera, geometry, ahead_m, left_m)
    model = fitted_models().plate_model(DAY)
    blur_units = blur_m / (geometry.pitch_mm / 1000)
    share = scipy.special.expit(model.pass_log_odds(unit_px, blur_units)) * float(model.readable_share(blur_units))
    rows = np.column_stack([ahead_m, unit_px, np.ptp(u, axis=0), np.ptp(v, axis=0), np.nan_to_num(blur_px), share])
    return tuple(PassFrame(*row) for row in rows.tolist())
