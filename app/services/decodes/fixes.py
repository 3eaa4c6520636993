"""Matched plates to the position of the vehicle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from app.decoders.plate.pose import VehicleFix, fix_vehicle
from app.families import get_family
from app.families.frames import Match
from app.geodesy import (
    LocalizationGrade,
    enu_from_wgs84,
    grade_accuracy,
    move_to_epoch,
    total_accuracy_m,
    wgs84_from_enu,
    worst_grade,
)
from app.markers import localization_warnings
from app.markers.reading import PlatePose
from app.registry.marker_rows import MarkerRow
from app.sensors.camera import Camera

# used where no accuracy is registered; fixes that depend on one of them are approximate only
ASSUMED_HORIZONTAL_RMSE_M = 1.0
ASSUMED_VERTICAL_RMSE_M = 1.0
ASSUMED_HEADING_RMSE_DEG = 2.0
COARSE_HEADING_RMSE_DEG = 5.0


@dataclass(frozen=True, slots=True)
class Fix:
    """Where the vehicle is.

    Attributes
    ----------
    vehicle : VehicleFix
    grade : LocalizationGrade
        Of the plates' positions; UNFIT where there is a reason against the match.
    notes : tuple of str
        Why it is unfit for localization, and what was assumed.
    has_height : bool
        Whether the plates' heights are known.
    marker_ids : tuple of str
        The plates it rests on.
    epoch : float or None
        Of its position in the ITRF; None where a plate's position has no epoch. [decimal year]
    """

    vehicle: VehicleFix
    grade: LocalizationGrade
    notes: tuple[str, ...]
    has_height: bool
    marker_ids: tuple[str, ...]
    epoch: float | None


def fix_from_match(
    pose: PlatePose, camera: Camera, match: Match, vehicle_heading_deg: float | None, *, epoch: float
) -> Fix | None:
    """Vehicle's position in the ITRF at an epoch from one matched plate.

    Returns
    -------
    Fix or None
        None if neither the plate's heading nor the vehicle's is known: then a plate fixes no direction.
    """
    if match.row is None or not match.plausible:
        return None
    row = marker_at(match.row, epoch)
    label = get_family(row.family).label
    notes = position_warnings(row, label)
    if match.ambiguous:
        notes.append(f"several {label}s within reach carry these digits")
    heading_deg, heading_rmse_deg = row.heading_deg, row.heading_rmse_deg
    if heading_deg is None:
        if vehicle_heading_deg is None:
            return None
        heading_deg = (vehicle_heading_deg + _plate_heading_in_vehicle_deg(pose, camera)) % 360.0
        heading_rmse_deg = COARSE_HEADING_RMSE_DEG
        notes.append(f"the {label}'s heading is not registered; the vehicle's own heading was used")
    fit = not notes
    for name, value in (("heading_rmse_deg", heading_rmse_deg), ("vertical_rmse_m", row.vertical_rmse_m)):
        if value is None and (name != "vertical_rmse_m" or row.height_m is not None):
            notes.append(f"{name} of the {label} is not registered; an assumed value was used")
    vehicle = fix_vehicle(
        pose,
        camera,
        lon_deg=row.lon_deg,
        lat_deg=row.lat_deg,
        height_m=row.height_m or 0.0,
        heading_deg=heading_deg,
        horizontal_rmse_m=_or_assumed(horizontal_rmse_m(row), ASSUMED_HORIZONTAL_RMSE_M),
        vertical_rmse_m=_or_assumed(row.vertical_rmse_m, ASSUMED_VERTICAL_RMSE_M),
        heading_rmse_deg=_or_assumed(heading_rmse_deg, ASSUMED_HEADING_RMSE_DEG),
    )
    grade = LocalizationGrade(row.localization_grade) if fit else LocalizationGrade.UNFIT
    return Fix(vehicle, grade, tuple(notes), row.height_m is not None, (str(row.id),), row.epoch)


def fuse_fixes(fixes: Sequence[Fix]) -> Fix | None:
    """Covariance-weighted mean of the fixes of one frame; unfit ones count only where there are no others.

    Notes
    -----
    The plates' survey errors are taken as independent, and so are the poses: corners share a frame's calibration
    error, which no covariance here knows of.
    """
    used = [fix for fix in fixes if fix.grade is not LocalizationGrade.UNFIT] or list(fixes)
    if len(used) < 2:
        return used[0] if used else None
    first = used[0].vehicle
    origin = (first.lon_deg, first.lat_deg, first.height_m)
    information, weighted = np.zeros((4, 4)), np.zeros(4)
    for fix in used:
        vehicle = fix.vehicle
        enu_m = enu_from_wgs84(vehicle.lon_deg, vehicle.lat_deg, vehicle.height_m, origin)
        turn = math.radians((vehicle.heading_deg - first.heading_deg + 180.0) % 360.0 - 180.0)
        weight = np.linalg.inv(vehicle.covariance)
        information += weight
        weighted += weight @ np.array([*enu_m, turn])
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    mean = covariance @ weighted
    lon_deg, lat_deg, height_m = wgs84_from_enu(mean[:3], origin)
    heading_deg = (first.heading_deg + math.degrees(mean[3])) % 360.0
    return Fix(
        VehicleFix(lon_deg, lat_deg, height_m, heading_deg, covariance),
        worst_grade(fix.grade for fix in used),
        tuple(dict.fromkeys(note for fix in used for note in fix.notes)),
        all(fix.has_height for fix in used),
        tuple(marker_id for fix in used for marker_id in fix.marker_ids),
        used[0].epoch if all(fix.epoch is not None for fix in used) else None,
    )


def position_warnings(row: MarkerRow, what: str) -> list[str]:
    """What makes the position of a plate or a tag unfit for localization."""
    return localization_warnings.position_warnings(
        what, grade=row.localization_grade, transform_note=row.transform_note, status=row.status
    )  # fmt: skip


def horizontal_rmse_m(row: MarkerRow) -> float | None:
    """What a marker's position is good to: its survey, and the stated bound of what brought it to WGS 84 / ITRF. [m]"""
    stated, bound_m = row.horizontal_rmse_m, row.transform_accuracy_m
    return None if stated is None else math.hypot(stated, bound_m or 0.0)


def marker_at(row: MarkerRow, epoch: float) -> MarkerRow:
    """The row with the position that its marker has at an epoch, by the motion of its plate.

    A position without an epoch stays: its accuracy already allows for the motion of ten years.

    Parameters
    ----------
    row : MarkerRow
    epoch : float
        [decimal year]
    """
    if row.epoch is None or row.transform_accuracy_m is None:
        return row
    moved = move_to_epoch(row.lon_deg, row.lat_deg, row.epoch, epoch)
    accuracy_m = math.hypot(row.transform_accuracy_m, float(moved.accuracy_m[0]))
    return row._replace(
        lon_deg=float(moved.lon_deg[0]), lat_deg=float(moved.lat_deg[0]), epoch=epoch, transform_accuracy_m=accuracy_m,
        localization_grade=grade_accuracy(total_accuracy_m(row.horizontal_rmse_m, accuracy_m)).value,
    )  # fmt: skip


def _or_assumed(value: float | None, assumed: float) -> float:
    return assumed if value is None else float(value)


def _plate_heading_in_vehicle_deg(pose: PlatePose, camera: Camera) -> float:
    """Direction of travel that the plate shows, clockwise from straight ahead of the vehicle. [deg]"""
    forward, left, _up = camera.camera_from_vehicle.T @ pose.rotation @ np.array([0.0, 1.0, 0.0])
    return -math.degrees(math.atan2(left, forward))
