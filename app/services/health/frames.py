"""What frames show of the health of markers: read ones with their offsets, and plates in view that were not read."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
import numpy.typing as npt
import scipy

from app.decoding.declarations import DecodeContext
from app.decoding.frames import Match, Nearby, plate_geometry
from app.families.plate.plates import PLATE
from app.families.surveys import RETIRED
from app.geodesy import decimal_year, enu_from_wgs84
from app.markers.reading import MarkerRow, PlateOutcome, PlatePose, horizontal_rmse_m, marker_at
from app.planning.predict.rates import DAY, fitted_models, normal_quadrature, unit_heights_px
from app.registry.decodes import NewObservation
from app.registry.health import NewUnregistered
from app.sensors.camera import Camera
from app.services.decodes.frame_documents import ReadFrame, ReadMarker
from app.services.health.record import EVIDENCE, MISSED, FrameHealth, rounded

SIGMAS_IN_ACCURACY = 3.0
"""Standard deviations in the accuracy of a coarse position, which holds the vehicle with near certainty."""
MAX_POSITION_SIGMA_M = 1.0
"""[m] of the vehicle's position, above which markers in view are not predicted. Two plates."""
HEADING_SIGMA_RAD = math.radians(0.5)
"""[rad] of the vehicle's heading. What changes less is the vehicle's own shift."""
SURVEY_SIGMA_M = 0.7
"""[m] each axis, of a marker without a stated accuracy. Source: `ASSUMED_HORIZONTAL_RMSE_M`, both axes together."""
MAX_SEEN_AHEAD_M = 18.0
"""[m] ahead, from where frames count. Source: `FAR_M` of app/planning/predict/rates.py."""
MIN_EXPECTED = 0.3
"""Probability from which a plate that was not read is observed as missed. Source:
`app.health.marker_tests.MIN_EXPECTED`."""
GRADE_NOMINAL, GRADE_SIGMA = 3.0, 0.6
"""Usual overall grade of a plate, and its standard deviation between passes. The tests compare it with the other plates
of the drive and with the plate's own record."""
FORWARD_DEG, BACKWARD_DEG = 45.0, 135.0
"""[deg] of a plate's direction from straight ahead: met forward, and met in reverse. Source: half a quarter turn."""
MIN_CONFIDENCE = 0.95
"""Of a reading of a plate that is not registered. Decoders refuse what is less sure than 0.99."""
FAR_M = 50.0
"""[m] beyond the coarse accuracy, from where a plate is elsewhere. Source: `app.health.marker_tests.SAME_PLACE_M`."""
_ON_ROAD = frozenset({"built", "surveyed", "active", "suspect"})


@dataclass(frozen=True, slots=True)
class VehicleView:
    """Where the vehicle of a frame was by its own position, and its camera."""

    # `lon_deg`, `lat_deg`, `heading_deg`: [deg]
    lon_deg: float
    lat_deg: float
    heading_deg: float
    sigma_m: float  # [m] of the position, each axis
    camera: Camera

    def place_m(self, row: MarkerRow) -> tuple[float, float]:
        """A marker ahead of the vehicle and to its left. [m]"""
        east, north, _up = enu_from_wgs84(row.lon_deg, row.lat_deg, 0.0, (self.lon_deg, self.lat_deg, 0.0))
        sin, cos = math.sin(math.radians(self.heading_deg)), math.cos(math.radians(self.heading_deg))
        return float(east * sin + north * cos), float(-east * cos + north * sin)

    def east_north_m(self, forward_m: float, left_m: float) -> tuple[float, float]:
        """A place in the vehicle's frame as east and north of the vehicle. [m]"""
        sin, cos = math.sin(math.radians(self.heading_deg)), math.cos(math.radians(self.heading_deg))
        return forward_m * sin - left_m * cos, forward_m * cos + left_m * sin


def view_of(context: DecodeContext, frame: ReadFrame) -> VehicleView | None:
    """The vehicle's own view of a frame; None if its position, heading or camera are not known well enough."""
    position = context.coarse_position
    camera = context.camera_of(frame.header) if frame.header is not None else None
    if position is None or context.heading_deg is None or camera is None:
        return None
    sigma_m = position.accuracy_m / SIGMAS_IN_ACCURACY
    if sigma_m > MAX_POSITION_SIGMA_M:
        return None
    return VehicleView(position.lon_deg, position.lat_deg, context.heading_deg, sigma_m, camera)


def frame_health(frame: ReadFrame, context: DecodeContext, nearby: Nearby, at: datetime) -> FrameHealth:
    """What a frame shows of the health of markers, with the context of its moment and the plates nearby."""
    view = view_of(context, frame)
    in_view = {}
    if view is not None and nearby.complete:
        for row in nearby.rows:
            expected = _expected(marker_at(row, decimal_year(at)), view) if row.status in _ON_ROAD else 0.0
            if expected >= MIN_EXPECTED:
                in_view[row.id] = rounded({**_about(row, frame), "expected": expected})
    of_readings = tuple(_reading_evidence(marker, frame, context, view, at) for marker in frame.markers)
    return FrameHealth(of_readings, in_view, tuple(_unregistered(frame, context, at)))


def missed_observations(frames: Sequence[ReadFrame], at: datetime) -> list[NewObservation]:
    """Markers that were in view at a readable size, and that no frame of the upload read: each once, where it was best
    in view.
    """
    read = {marker.match.row.id for frame in frames for marker in frame.markers if marker.match and marker.match.row}
    best: dict[str, tuple[int, dict[str, object]]] = {}
    for frame in frames:
        for marker_id, evidence in frame.health.in_view.items():
            known = best.get(marker_id)
            if marker_id not in read and (known is None or evidence["expected"] > known[1]["expected"]):
                best[marker_id] = frame.index, evidence
    return [
        NewObservation(marker_id, index, at, MISSED, {EVIDENCE: evidence})
        for marker_id, (index, evidence) in best.items()
    ]


def unregistered_readings(frames: Sequence[ReadFrame]) -> list[NewUnregistered]:
    """Readings of codes that are not registered, each code once."""
    first: dict[tuple[str, str], NewUnregistered] = {}
    for frame in frames:
        for reading in frame.health.unregistered:
            first.setdefault((reading.family, reading.code), reading)
    return [reading._replace(number=number) for number, reading in enumerate(first.values())]


def _about(row: MarkerRow, frame: ReadFrame) -> dict[str, object]:
    return {
        "family": row.family, "place_deg": (row.lon_deg, row.lat_deg), "along": float(frame.index),
        "survey_m": _survey_m(row),
    }  # fmt: skip


def _reading_evidence(
    marker: ReadMarker, frame: ReadFrame, context: DecodeContext, view: VehicleView | None, at: datetime
) -> dict[str, object]:
    """Evidence of a reading of a registered marker; empty where there is none."""
    match = marker.match
    if match is None or match.row is None or match.ambiguous or match.row.status == RETIRED:
        return {}
    row, evidence = match.row, _about(match.row, frame)
    if not match.plausible:
        place = _elsewhere(match, context)
        return {} if place is None else rounded({**evidence, "elsewhere_deg": place})
    if view is not None:
        evidence["expected"] = _expected(row, view)
    pose = marker.reading.pose
    camera = context.camera_of(frame.header) if frame.header is not None else None
    if pose is not None and camera is not None:
        if row.family == PLATE.name:
            evidence["reversed"] = _is_reversed(pose, camera)
        if view is not None:
            evidence |= _offset(pose, row, view, at)
    grade = getattr(marker.reading, "grade", None)
    if grade is not None:
        evidence["quality"] = (grade.overall - GRADE_NOMINAL) / GRADE_SIGMA
    return rounded(evidence)


def _unregistered(frame: ReadFrame, context: DecodeContext, at: datetime) -> Iterator[NewUnregistered]:
    """Markers that were read where none is registered: where their digits place them, else where the vehicle was."""
    position = context.coarse_position
    for marker in frame.markers:
        reading, match = marker.reading, marker.match
        code = getattr(reading, "code", None)
        if reading.outcome != PlateOutcome.READ or match is None or match.row is not None or code is None:
            continue
        if reading.confidence < MIN_CONFIDENCE or position is None or match.fits_two_places:
            continue
        if match.lon_deg is not None and not match.plausible:
            continue  # the digits encode a place that is out of reach: no plate of this kind, or a misread
        digits = str(getattr(code, "digits", None) or getattr(code, "text", ""))
        lon_deg = position.lon_deg if match.lon_deg is None else match.lon_deg
        lat_deg = position.lat_deg if match.lat_deg is None else match.lat_deg
        yield NewUnregistered(0, reading.family, digits, lon_deg, lat_deg, float(reading.confidence), at)


def _survey_m(row: MarkerRow) -> float:
    rmse_m = horizontal_rmse_m(row)
    return SURVEY_SIGMA_M if rmse_m is None else rmse_m / math.sqrt(2)


def _elsewhere(match: Match, context: DecodeContext) -> tuple[float, float] | None:
    position = context.coarse_position
    if position is None or match.distance_m is None or match.distance_m < position.reach_m + FAR_M:
        return None
    return position.lon_deg, position.lat_deg


def _offset(pose: PlatePose, row: MarkerRow, view: VehicleView, at: datetime) -> dict[str, object]:
    """Where the marker was seen less where it is registered, by the vehicle's own position."""
    camera, place = view.camera, marker_at(row, decimal_year(at))
    seen = camera.camera_from_vehicle.T @ pose.translation_m + camera.position_vehicle_m
    forward_m, left_m = view.place_m(place)
    east_m, north_m = view.east_north_m(float(seen[0]) - forward_m, float(seen[1]) - left_m)
    pose_m2 = float(np.trace(pose.covariance[3:, 3:])) / 2.0
    turned_m = HEADING_SIGMA_RAD * math.hypot(forward_m, left_m)
    return {
        "offset_m": (east_m, north_m),
        "sigma_m": math.sqrt(pose_m2 + turned_m**2),
        "position_sigma_m": view.sigma_m,
        "heading_deg": view.heading_deg,
    }


def _is_reversed(pose: PlatePose, camera: Camera) -> bool | None:
    forward, left, _up = camera.camera_from_vehicle.T @ pose.rotation @ np.array([0.0, 1.0, 0.0])
    turned_deg = abs(math.degrees(math.atan2(left, forward)))
    if FORWARD_DEG < turned_deg < BACKWARD_DEG:
        return None
    return turned_deg >= BACKWARD_DEG


def _expected(row: MarkerRow, view: VehicleView) -> float:
    """Probability that a healthy, clean plate there is read in the frame; 0 where it may be out of view."""
    if row.family != PLATE.name:
        return 0.0
    forward_m, left_m = view.place_m(row)
    if not 0.0 < forward_m < MAX_SEEN_AHEAD_M:
        return 0.0
    spare_m = 2.0 * view.sigma_m
    ahead = np.array([forward_m, forward_m - spare_m, forward_m + spare_m, forward_m, forward_m])
    left = np.array([left_m, left_m, left_m, left_m - spare_m, left_m + spare_m])
    unit_px = unit_heights_px(view.camera, plate_geometry(row), ahead, left)
    return float(_frame_rate(unit_px).min())


def _frame_rate(unit_px: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Read rate of a frame by day, by the height of a unit: `app.planning.predict.rates.PlateModel`."""
    model = fitted_models().plate_model(DAY)
    nodes, weights = normal_quadrature()
    odds = model.pass_log_odds(unit_px, 0.0)[:, None] + model.spread * nodes
    rate = (weights * scipy.special.expit(odds)).sum(axis=1) * model.readable_share(0.0)
    return np.where(unit_px > 0.0, rate, 0.0)
