"""Plates: frames in which each camera reads them at the design speed, and room in their scheme."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from app.markers.checks import Verdict
from app.markers.plate import PlateGeometry, PlateScheme, plate_capacity
from app.planning.plan import Plan, PlanFinding, PlannedMarker, PlannedPlate
from app.planning.plan_checks.finding import compare
from app.planning.plate_view import camera_of, project_road
from app.planning.rules import CameraRules, PlateRules
from app.sensors.camera import Camera

ROWS_PER_UNIT = 2.0
"""Rows of the image that a unit must cover to be readable. [px] Source: the decoder's bound of 1.5 rows for digits that
nothing else confirms (docs/decisions/0010), with a third in reserve."""
MAX_BLUR_UNITS = 1.0
"""Units that a plate may move during the exposure. Source: PolyU trials (docs/benchmarks.md): 80 km/h with 1/1000 s is
0.6 units and read."""
MAX_SHEAR_SHARE = 0.1
"""Share of its length by which a rolling shutter may stretch a plate. Source: chosen by hand, the pose fit's slack."""
_STEP_M = 0.02  # [m] between distances that are tried; source: chosen by hand
_NEAREST_M, _FARTHEST_M = 0.3, 40.0  # [m] source: beyond it no unit of 50 mm covers two rows of a camera up to 5 m high


def readable_zone_m(camera: Camera, geometry: PlateGeometry, left_m: float = 0.0, grade_change: float = 0.0) -> float:
    """Length of road on which a plate is wholly in the image with enough rows per unit. [m]

    Parameters
    ----------
    camera : Camera
    geometry : PlateGeometry
    left_m : float
        Plate's centre left of the camera. [m]
    grade_change : float
        Slope of the road at the plate against that under the vehicle; a crest makes it flatter in the image.
    """
    ahead = np.arange(_NEAREST_M, _FARTHEST_M, _STEP_M)
    side = geometry.side_mm / 1000
    corners = [(forward, across) for forward in (-side / 2, side / 2) for across in (-side / 2, side / 2)]
    inside = np.ones(len(ahead), dtype=bool)
    for forward, across in corners:
        u, v = project_road(camera, ahead + forward, left_m + across, grade_change * ahead)
        inside &= (u >= 0) & (u <= camera.width_px - 1) & (v >= 0) & (v <= camera.height_px - 1)
    unit = (geometry.unit_mm + geometry.gap_mm) / 1000
    rise = grade_change * ahead
    _, far = project_road(camera, ahead + side / 2, np.full_like(ahead, left_m), rise)
    _, near = project_road(camera, ahead + side / 2 - unit, np.full_like(ahead, left_m), rise)
    return float(np.count_nonzero(inside & (near - far >= ROWS_PER_UNIT)) * _STEP_M)


def frames_per_pass(
    camera: CameraRules, geometry: PlateGeometry, speed_mps: float, left_m: float = 0.0, grade_change: float = 0.0
) -> float:
    """Mean number of frames of a pass in which a plate is readable; 0 where it is blurred too much."""
    blur_units = speed_mps * camera.exposure_s / ((geometry.unit_mm + geometry.gap_mm) / 1000)
    if blur_units > MAX_BLUR_UNITS:
        return 0.0
    return readable_zone_m(camera_of(camera), geometry, left_m, grade_change) * camera.frames_per_s / speed_mps


def check_plates(plan: Plan) -> Iterator[PlanFinding]:
    """Frames per pass of each camera, rolling shutter, and room in the scheme."""
    rules = plan.rules.plates
    plates = [marker for marker in plan.markers if isinstance(marker.detail, PlannedPlate)]
    if rules is None or not plates:
        return
    for camera in plan.rules.cameras:
        yield _frames(plan, plates, camera, rules)
        if camera.rolling_shutter_s > 0:
            yield _rolling_shutter(plan, plates, camera)
    yield _room(plates, rules)


def _frames(plan: Plan, plates: Sequence[PlannedMarker], camera: CameraRules, rules: PlateRules) -> PlanFinding:
    geometry = PlateGeometry(rules.n, rules.unit_mm, rules.gap_mm, rules.thickness_mm)
    zones = {offset: readable_zone_m(camera_of(camera), geometry, offset) for offset in {m.offset_m for m in plates}}
    unit_m = (geometry.unit_mm + geometry.gap_mm) / 1000
    worst, frames, speed = plates[0], math.inf, 0.0
    for marker in plates:
        lane = plan.alignment.lane(marker.lane)
        at_mps = float(lane.value_at(lane.design_speed_mps, marker.chainage_m))
        blurred = at_mps * camera.exposure_s / unit_m > MAX_BLUR_UNITS
        found = 0.0 if blurred else zones[marker.offset_m] * camera.frames_per_s / at_mps
        if found < frames:
            worst, frames, speed = marker, found, at_mps
    sentence = (
        f"mean readable frames per pass of {camera.name} at {speed * 3.6:.0f} km/h: {zones[worst.offset_m]:.1f} m "
        f"of road with {ROWS_PER_UNIT:g} rows per unit at {camera.frames_per_s:g} frames/s"
    )
    if frames < rules.min_frames:
        sentence += "; a faster, higher or steeper camera, a shorter exposure or larger units give more"
    source = "geometry of the camera; rows per unit from docs/decisions/0010, blur from docs/benchmarks.md"
    return compare(f"frames-per-pass {camera.name}", frames, ">=", rules.min_frames, "frames", source, sentence, worst)


def _rolling_shutter(plan: Plan, plates: Sequence[PlannedMarker], camera: CameraRules) -> PlanFinding:
    """Stretch of a plate by the rows that are read later, as a share of its length."""
    worst = max(plates, key=lambda marker: _speed_mps(plan, marker))
    speed = _speed_mps(plan, worst)
    detail = worst.detail
    assert isinstance(detail, PlannedPlate)
    view = camera_of(camera)
    length = detail.geometry.side_mm / 1000
    ahead = view.height_m / math.tan(math.radians(max(view.depression_deg, 5.0)))
    _, far = project_road(view, np.array([ahead + length / 2]), np.zeros(1), np.zeros(1))
    _, near = project_road(view, np.array([ahead - length / 2]), np.zeros(1), np.zeros(1))
    seconds = float(near[0] - far[0]) / camera.height_px * camera.rolling_shutter_s
    share = speed * seconds / length
    sentence = f"share of its length by which {camera.name} stretches a plate at {speed * 3.6:.0f} km/h"
    return compare(
        f"rolling-shutter {camera.name}", share, "<=", MAX_SHEAR_SHARE, "share", "geometry of the camera", sentence,
        worst, missed=Verdict.WARN,
    )  # fmt: skip


def _room(plates: Sequence[PlannedMarker], rules: PlateRules) -> PlanFinding:
    capacity = plate_capacity(rules.n, rules.scheme, 1)
    codes = len({marker.code for marker in plates})
    if rules.scheme is PlateScheme.ID:
        used = codes / 2.0**capacity.bits
        sentence = f"{codes} of 2^{capacity.bits:.0f} registry numbers"
        return compare("plate-scheme", used, "<=", 0.5, "share", "PlateScheme.ID: Reed-Solomon over GF(16)", sentence)
    sentence = f"{len(plates) - codes} plates have the same digits as another plate of the plan"
    return compare("plate-scheme", len(plates) - codes, "<=", 0, "plates", "PolyU section II.A", sentence)


def _speed_mps(plan: Plan, marker: PlannedMarker) -> float:
    lane = plan.alignment.lane(marker.lane)
    return float(lane.value_at(lane.design_speed_mps, marker.chainage_m))
