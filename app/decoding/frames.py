"""Plates in a frame: what is looked for, which registered plate a reading is of, and the vehicle's position.

A server calls these functions for uploads, and the proof of a plan for simulated ones, with the same inputs: pixels,
the context of the upload, and the registered markers nearby.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from app.decoders.plate.pose import VehicleFix, fix_vehicle, with_pose
from app.decoding.declarations import CoarsePosition
from app.geodesy import LocalizationGrade, enu_from_wgs84, wgs84_from_enu, worst_grade
from app.geodesy.frames import distance_m
from app.markers.plate import EXPECTED_GEOMETRIES, PlateCode, PlateGeometry, PlateScheme
from app.markers.reading import MarkerRow, PlatePose, PlateReading, horizontal_rmse_m, marker_at, row_warnings
from app.sensors.camera import Camera

# === Registered markers that could be in view, and the one that a reading is of.


MAX_CODEBOOK = 500
"""Markers that a frame is searched for at most."""


@dataclass(frozen=True, slots=True)
class Nearby:
    """The agency's markers of one family that could be in view."""

    rows: tuple[MarkerRow, ...] = ()  # nearest first
    complete: bool = True  # False if there are more than a search may hold

    @classmethod
    def of(cls, rows: Iterable[MarkerRow], position: CoarsePosition) -> Nearby:
        """Those among some rows, as the registry finds them."""
        away = sorted((distance_to_row(row, position), row.id, row) for row in rows)
        near = [row for distance, _, row in away if distance <= position.reach_m]
        return cls(tuple(near[:MAX_CODEBOOK]), len(near) <= MAX_CODEBOOK)


@dataclass(frozen=True, slots=True)
class Match:
    """The registered marker that a reading is of, or where an unregistered one would be."""

    row: MarkerRow | None  # the registered marker
    # `lon_deg`, `lat_deg`: [deg] of the registered marker, or by the digits of an unregistered one
    lon_deg: float | None = None
    lat_deg: float | None = None
    distance_m: float | None = None  # [m] from the approximate position
    plausible: bool = False  # whether that is within the accuracy of the approximate position and the range of view
    others: tuple[str, ...] = ()  # ids of further markers with the same code within reach
    note: str = ""  # what to know about the match
    fits_two_places: bool = False  # the digits of an unregistered marker fit two places within reach

    @property
    def ambiguous(self) -> bool:
        """Whether more than one marker or place fits."""
        return bool(self.others) or self.fits_two_places


def nearest_match(rows: Sequence[MarkerRow], position: CoarsePosition, label: str) -> Match:
    """The nearest of the markers that carry the code of a reading."""
    ranked = sorted(rows, key=lambda row: distance_to_row(row, position))
    row, others = ranked[0], tuple(other.id for other in ranked[1:])
    note = f"ambiguous: {len(ranked)} {label}s within reach carry these digits; this is the nearest" if others else ""
    return Match(row, row.lon_deg, row.lat_deg, distance_to_row(row, position), True, others, note)


def distance_to_row(row: MarkerRow, position: CoarsePosition) -> float:
    """Distance of a marker from the approximate position. [m]"""
    return distance_m(position.lon_deg, position.lat_deg, row.lon_deg, row.lat_deg)


# === The row of a plate as values of the core.


def plate_code(row: MarkerRow) -> PlateCode:
    """Code of a plate's row."""
    return PlateCode(row.digits, PlateScheme(row.scheme), row.n, row.check_digits or 1)


def plate_geometry(row: MarkerRow) -> PlateGeometry:
    """Geometry of a plate's row."""
    return PlateGeometry(row.n, row.unit_mm, row.gap_mm, row.thickness_mm)


# === Plates in frames.


Pixels = npt.NDArray[np.uint8]
DecodePlates = Callable[..., list[PlateReading]]


@dataclass(frozen=True, slots=True)
class PlateSearch:
    """What to look for in a frame."""

    camera: Camera | None = None
    # plates that the registry knows nearby
    codebook: tuple[PlateCode, ...] = ()  # plates that the registry knows nearby
    geometries: tuple[PlateGeometry, ...] = ()  # dimensions to look for; the decoder's own where there are none
    is_paper: bool = False  # by the paper's own algorithm


def search_plates(nearby: Nearby, camera: Camera | None) -> PlateSearch:
    """The codes nearby, and their dimensions beside the usual ones."""
    geometries = _distinct([*EXPECTED_GEOMETRIES, *(plate_geometry(row) for row in nearby.rows)])
    return PlateSearch(camera, plate_codebook(nearby), geometries)


def decode_plates(pixels: Pixels, **options: Any) -> list[PlateReading]:
    """As `app.decoders.plate.reader.decode_plates`, which is loaded with the first frame: a server decodes none."""
    from app.decoders.plate import reader

    return reader.decode_plates(pixels, **options)


def read_plates(
    pixels: Pixels, search: PlateSearch, decode: DecodePlates = decode_plates, *, thermal: bool = False
) -> Sequence[PlateReading]:
    """Decode the plates of a frame."""
    if search.is_paper:
        from app.decoders.plate.paper import decode_plates_paper  # loaded with the first frame, as the reader is

        return decode_plates_paper(pixels, camera=search.camera)
    options = {"geometries": search.geometries} if search.geometries else {}
    return decode(pixels, camera=search.camera, codebook=search.codebook, thermal=thermal, **options)


def match_plate(nearby: Nearby, code: PlateCode, position: CoarsePosition) -> Match | None:
    """The nearest of the plates nearby that carry a code; None if there is none."""
    rows = [row for row in nearby.rows if row.digits == code.digits and row.n == code.n]
    return nearest_match(rows, position, "plate") if rows else None


def with_registered_size(reading: PlateReading, match: Match, camera: Camera | None) -> PlateReading:
    """A matched plate with its registered dimensions and the pose that follows from them.

    A frame shows proportions, and plates of 35 and 50 mm units have nearly the same: with the wrong size, the vehicle's
    position is off by a quarter of the distance from the plate.
    """
    row, found = match.row, reading.geometry
    if row is None or not match.plausible or found is None or row.n != found.n:
        return reading
    if (row.unit_mm, row.gap_mm) == (found.unit_mm, found.gap_mm):
        return reading
    return with_pose(replace(reading, geometry=plate_geometry(row), pose=None), camera)


def plate_codebook(nearby: Nearby) -> tuple[PlateCode, ...]:
    """Codes of the plates nearby, without repetitions; none if not all of them are known."""
    return tuple(dict.fromkeys(plate_code(row) for row in nearby.rows)) if nearby.complete else ()


def _distinct(geometries: Sequence[PlateGeometry]) -> tuple[PlateGeometry, ...]:
    """The geometries without repetitions; thickness does not show in a frame."""
    seen: dict[tuple[int, float, float], PlateGeometry] = {}
    for geometry in geometries:
        seen.setdefault((geometry.n, geometry.unit_mm, geometry.gap_mm), geometry)
    return tuple(seen.values())


# === Matched plates to the position of the vehicle.


# used where no accuracy is registered; fixes that depend on one of them are approximate only
ASSUMED_HORIZONTAL_RMSE_M = 1.0
ASSUMED_VERTICAL_RMSE_M = 1.0
ASSUMED_HEADING_RMSE_DEG = 2.0
COARSE_HEADING_RMSE_DEG = 5.0


@dataclass(frozen=True, slots=True)
class Fix:
    """Where the vehicle is."""

    vehicle: VehicleFix
    grade: LocalizationGrade  # of the plates' positions; UNFIT where there is a reason against the match
    notes: tuple[str, ...]  # why it is unfit for localization, and what was assumed
    has_height: bool  # whether the plates' heights are known
    marker_ids: tuple[str, ...]  # the plates it rests on
    epoch: float | None  # [decimal year] of its position in the ITRF; None where a plate's position has no epoch


def fix_from_match(
    pose: PlatePose, camera: Camera, match: Match, label: str, vehicle_heading_deg: float | None, *, epoch: float,
    pose_warning: str = "",
) -> Fix | None:  # fmt: skip
    """Vehicle's position in the ITRF at an epoch from one matched plate.

    Parameters
    ----------
    label : str
        What a marker of its family is called.
    pose_warning : str
        Why the pose may be wrong; empty if nothing shows that.

    Returns
    -------
    Fix or None
        None if neither the plate's heading nor the vehicle's is known: then a plate fixes no direction.
    """
    if match.row is None or not match.plausible:
        return None
    row = marker_at(match.row, epoch)
    notes = [*([pose_warning] if pose_warning else []), *row_warnings(row, label)]
    if match.ambiguous:
        notes.append(f"several {label}s within reach carry these digits")
    heading_deg, heading_rmse_deg = row.heading_deg, row.heading_rmse_deg
    if heading_deg is None:
        if vehicle_heading_deg is None:
            return None
        heading_deg = (vehicle_heading_deg + plate_heading_in_vehicle_deg(pose, camera)) % 360.0
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


def _or_assumed(value: float | None, assumed: float) -> float:
    return assumed if value is None else float(value)


def plate_heading_in_vehicle_deg(pose: PlatePose, camera: Camera) -> float:
    """Direction of travel that the plate shows, clockwise from straight ahead of the vehicle. [deg]"""
    forward, left, _up = camera.camera_from_vehicle.T @ pose.rotation @ np.array([0.0, 1.0, 0.0])
    return -math.degrees(math.atan2(left, forward))
