"""Registered plates and readings of frames."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from app.decoders.plate.pose import locate_plate
from app.decoding.declarations import CoarsePosition
from app.decoding.frames import MAX_CODEBOOK, Match, Nearby, match_plate, with_registered_size
from app.markers.plate import PlateCode, PlateGeometry
from app.markers.reading import MarkerRow, PlateOutcome, PlateReading
from app.sensors.camera import Camera

CAMERA = Camera.from_field_of_view(1920, 1080, 70.0)
CODE = PlateCode.from_registry_number(0x1234ABCD)
HERE = CoarsePosition(lon_deg=10.0, lat_deg=45.0, accuracy_m=20.0)


def row(number: int = 1, *, unit_mm: float = 50.0, lat_deg: float = 45.0, digits: str = CODE.digits) -> MarkerRow:
    columns = dict.fromkeys(MarkerRow._fields)
    own = {"id": str(number), "family": "plate", "status": "surveyed", "scheme": "id", "digits": digits, "n": 8}
    size = {"unit_mm": unit_mm, "gap_mm": 5.0, "thickness_mm": 20.0, "lon_deg": 10.0, "lat_deg": lat_deg}
    return MarkerRow(**{**columns, **own, **size})  # type: ignore[arg-type]


def reading(true: PlateGeometry, taken_for: PlateGeometry) -> PlateReading:
    """A plate 4 m ahead of the camera, taken for one of another size."""
    down = np.radians(CAMERA.depression_deg)
    towards = np.array([[1.0, 0.0, 0.0], [0.0, -np.sin(down), np.cos(down)], [0.0, -np.cos(down), -np.sin(down)]]).T
    corners_m = np.column_stack([true.corners_mm / 1000, np.zeros(4)]) @ towards + (0.0, 0.0, 4.0)
    corners_px = cv2.projectPoints(corners_m, np.zeros(3), np.zeros(3), CAMERA.matrix, np.zeros(4))[0][:, 0]
    covariance_px2 = 0.01 * np.eye(8)
    pose = locate_plate(corners_px, covariance_px2, taken_for, CAMERA)
    return PlateReading(
        PlateOutcome.READ, corners_px, covariance_px2, code=CODE, geometry=taken_for, pose=pose
    )  # fmt: skip


def test_the_pose_of_a_matched_plate_follows_from_its_registered_size() -> None:
    found = reading(PlateGeometry(8, 50.0, 5.0), PlateGeometry(8, 35.0, 5.0))
    assert found.pose is not None
    assert found.pose.translation_m[2] < 3.3, "taken for a smaller plate, it seems nearer"
    match = Match(row(), plausible=True)
    corrected = with_registered_size(found, match, CAMERA)
    assert corrected.pose is not None
    assert corrected.pose.translation_m[2] == pytest.approx(4.0, abs=0.01)
    assert corrected.geometry is not None
    assert corrected.geometry.unit_mm == 50.0
    same = reading(PlateGeometry(8, 50.0, 5.0), PlateGeometry(8, 50.0, 5.0))
    assert with_registered_size(same, match, CAMERA) is same
    assert with_registered_size(found, Match(row()), CAMERA) is found, "another plate with this code"
    assert with_registered_size(found, Match(None), CAMERA) is found


def test_plates_within_reach_are_found_nearest_first_and_counted() -> None:
    rows = [row(k, lat_deg=45.0 + k * 1e-5, digits=CODE.digits if k % 2 else "0" * 12) for k in range(MAX_CODEBOOK + 5)]
    nearby = Nearby.of(reversed(rows), HERE)
    assert [one.id for one in nearby.rows[:3]] == ["0", "1", "2"]
    assert 100 < len(nearby.rows) < 115, "1.1 m apart, up to 120 m"
    assert nearby.complete
    match = match_plate(nearby, CODE, HERE)
    assert match is not None
    assert match.row is rows[1]
    assert match.ambiguous
    assert match_plate(Nearby.of(rows[:1], HERE), CODE, HERE) is None
    crowded = Nearby.of([row(k, lat_deg=45.0 + k * 1e-7) for k in range(MAX_CODEBOOK + 1)], HERE)
    assert (len(crowded.rows), crowded.complete) == (MAX_CODEBOOK, False)
