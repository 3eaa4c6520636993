"""Rolling shutters: the pose at the frame's time, with and without compensation."""

from __future__ import annotations

import numpy as np
import pytest

from app.decoders.plate.pose import locate_moving_plate
from app.markers.plate import PlateGeometry
from app.sensors.camera import Camera
from app.simulation.plate_face import Face
from app.simulation.plate_scene import PlacedFace, PlateScene, Sensor

SPEED_M_S = 30.0


@pytest.mark.parametrize("ahead_m", [3.0, 4.5, 7.0])
@pytest.mark.parametrize("readout_s", [0.0, 0.012, 0.025])
def test_the_pose_at_30_m_s_is_that_of_the_middle_row(ahead_m: float, readout_s: float) -> None:
    geometry = PlateGeometry(8)
    camera = Camera.from_field_of_view(1920, 1080, 70.0, readout_s=readout_s)
    face = PlacedFace(Face(geometry.side_mm / 1000, np.zeros((4, 4, 3), np.float32)), ahead_m, 0.4)
    scene = PlateScene(camera, (face,), speed_m_s=SPEED_M_S, sensor=Sensor(readout_s=readout_s))
    corners_px = scene.project(face.corners_ground_m)
    covariance = 0.05**2 * np.eye(8)

    def ahead_of(speed_m_s: float) -> float:
        pose = locate_moving_plate(corners_px, covariance, geometry, camera, speed_m_s)
        assert pose is not None
        return float((camera.camera_from_vehicle.T @ pose.translation_m)[0])

    assert ahead_of(SPEED_M_S) == pytest.approx(ahead_m, abs=0.01)
    if ahead_m == 3.0:  # the row that shows it is exposed late
        assert abs(ahead_of(0.0) - ahead_m) >= 3 * readout_s
