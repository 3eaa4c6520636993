"""A sign is registered, printed from its artwork, seen by a camera, read and matched, and places the vehicle."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from app.decoders.fiducial import decode_fiducials
from app.geodesy import enu_from_heading, enu_from_wgs84, wgs84_from_enu
from app.main import create_app
from app.markers.fiducial import FiducialCode, FiducialGeometry, KnownFiducial, Mounting
from app.sensors.camera import Camera
from app.settings import Settings
from app.values import Floats
from tests.api.decodes.conftest import post_frame
from tests.conftest import ADMIN_KEY, LiveServer
from tests.families.fiducial.scene import lying_axes, render_sign, square_px, upright_axes
from tests.families.fiducial.test_fiducial_markers import post, sign
from tests.jobs import standin

CAMERA_IN = {"horizontal_fov_deg": 70.0, "height_m": 1.5, "depression_deg": 8.0, "forward_m": 1.2, "left_m": 0.1}
CAMERA = Camera.from_field_of_view(1920, 1080, 70.0, height_m=1.5, depression_deg=8.0, forward_m=1.2, left_m=0.1)
HEADING_DEG = 63.0
SIDE_MM, QUIET_MM = 500.0, 62.5


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveServer]:
    """A server with real decoder processes; plates are read by a stand-in, signs by the real decoder."""
    settings = Settings(data_dir=tmp_path_factory.mktemp("signs") / "var", admin_key=ADMIN_KEY, decode_timeout_s=120.0)
    with LiveServer(create_app(settings, decode=standin.decode)) as running:
        yield running


def panel_of(client: httpx.Client, marker: dict[str, Any]) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """What is printed: the trimmed panel of the artwork."""
    answer = client.get(f"/v1/markers/{marker['id']}/artwork.png", params={"resolution_dpi": 50})
    assert answer.status_code == 200, answer.text
    sheet = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_GRAYSCALE)
    panel_px = round((SIDE_MM + 2 * QUIET_MM) / 25.4 * 50)
    left, top = (sheet.shape[1] - panel_px) // 2, round(36.0 / 25.4 * 50)
    return np.asarray(sheet[top : top + panel_px, left : left + panel_px], dtype=np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mounting", "ahead_m", "left_m", "up_m", "turn_deg", "limit_m"),
    [
        ("upright", 9.0, 1.5, 2.2, 20.0, 0.08),
        ("upright", 16.0, -2.0, 2.5, -25.0, 0.25),
        ("lying", 6.0, 0.3, 0.0, 5.0, 0.05),
    ],
)
def test_the_vehicle_is_found_by_a_sign(
    client: httpx.Client, place: Callable[[], dict[str, Any]], mounting: str, ahead_m: float, left_m: float,
    up_m: float, turn_deg: float, limit_m: float,
) -> None:  # fmt: skip
    vehicle = place()
    origin = (vehicle["lon_deg"], vehicle["lat_deg"], 40.0)
    in_vehicle = np.array([ahead_m, left_m, up_m])
    enu_m = enu_from_heading(HEADING_DEG) @ np.array([-in_vehicle[1], in_vehicle[0], in_vehicle[2]])
    lon, lat, height = wgs84_from_enu(enu_m, origin)
    position = {"lon_deg": lon, "lat_deg": lat, "height_m": height, "horizontal_rmse_m": 0.01, "vertical_rmse_m": 0.02}
    position |= {"realization": "ITRF2014", "epoch": 2026.4}
    # to the left is against the clock, by which headings count; a sign that faces the vehicle has its heading
    body = sign(vehicle, number=40 + int(ahead_m)) | {
        "position": position,
        "geometry": {"side_mm": SIDE_MM, "quiet_mm": QUIET_MM, "mounting": mounting, "image": "opencv"},
        "heading_deg": (HEADING_DEG - turn_deg) % 360.0,
        "heading_rmse_deg": 0.2,
        "status": "surveyed",
    }
    marker = post(client, body)
    axes = upright_axes(turn_deg) if mounting == "upright" else lying_axes(turn_deg)
    panel_m = (SIDE_MM + 2 * QUIET_MM) / 1000
    picture = render_sign(CAMERA, panel_of(client, marker), axes, in_vehicle, panel_m, np.random.default_rng(5))
    data = cv2.imencode(".png", picture)[1].tobytes()
    coarse = {"lon_deg": origin[0] + 3e-5, "lat_deg": origin[1] - 3e-5, "accuracy_m": 10.0}

    decode = post_frame(
        client, data, {"coarse_position": coarse, "camera": CAMERA_IN, "captured_at": "2026-05-27T00:00:00Z"}
    ).json()

    (reading,) = [reading for reading in decode["readings"] if reading["family"] == "fiducial"]
    assert (reading["outcome"], reading["digits"]) == ("read", marker["code"]["text"])
    assert reading["match"]["marker_id"] == marker["id"]
    fix = decode["fix"]
    assert fix["localization_grade"] == "cm"
    error_m = np.linalg.norm(enu_from_wgs84(fix["lon_deg"], fix["lat_deg"], fix["height_m"], origin))
    assert error_m < limit_m
    assert error_m < 5 * math.sqrt(np.trace(np.array(fix["covariance"])[:3, :3]))
    assert abs((fix["heading_deg"] - HEADING_DEG + 180) % 360 - 180) < 2.0
    (seen,) = client.get(f"/v1/markers/{marker['id']}/observations").json()["items"]
    assert (seen["what"], seen["detail"]["bit_errors"]) == ("seen", 0)
    assert client.get(f"/v1/decodes/{decode['id']}/annotated.jpg").status_code == 200
    elsewhere = {**coarse, "lon_deg": coarse["lon_deg"] + 0.1}
    unmatched = post_frame(client, data, {"coarse_position": elsewhere, "camera": CAMERA_IN}).json()
    assert [reading for reading in unmatched["readings"] if reading["family"] == "fiducial"] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("image", "declared_deg", "grade"),
    [(None, HEADING_DEG + 40.0, "cm"), (None, None, "unfit"), ("apriltag", None, "cm")],
)
def test_a_lying_sign_with_the_image_of_its_authors(
    client: httpx.Client, place: Callable[[], dict[str, Any]], image: str | None, declared_deg: float | None, grade: str
) -> None:
    vehicle, in_vehicle = place(), np.array([6.0, 0.3, 0.0])
    origin = (vehicle["lon_deg"], vehicle["lat_deg"], 40.0)
    enu_m = enu_from_heading(HEADING_DEG) @ np.array([-in_vehicle[1], in_vehicle[0], in_vehicle[2]])
    lon, lat, height = wgs84_from_enu(enu_m, origin)
    position = {"lon_deg": lon, "lat_deg": lat, "height_m": height, "horizontal_rmse_m": 0.01, "vertical_rmse_m": 0.02}
    geometry = {"side_mm": SIDE_MM, "quiet_mm": QUIET_MM, "mounting": "lying", "image": image}
    body = sign(vehicle, number=60) | {
        "position": {**position, "realization": "ITRF2014", "epoch": 2026.4},
        "geometry": geometry,
        "heading_deg": HEADING_DEG,
        "heading_rmse_deg": 0.2,
        "status": "surveyed",
    }
    panel = panel_of(client, post(client, body))
    if image is None:
        panel = np.ascontiguousarray(np.rot90(panel, 2))  # the artwork here is OpenCV's
    panel_m = (SIDE_MM + 2 * QUIET_MM) / 1000
    picture = render_sign(CAMERA, panel, lying_axes(0.0), in_vehicle, panel_m, np.random.default_rng(6))
    context = {
        "coarse_position": {"lon_deg": origin[0] + 3e-5, "lat_deg": origin[1] - 3e-5, "accuracy_m": 10.0},
        "camera": CAMERA_IN,
        "captured_at": "2026-05-27T00:00:00Z",
        **({"heading_deg": declared_deg} if declared_deg is not None else {}),
    }
    decode = post_frame(client, cv2.imencode(".png", picture)[1].tobytes(), context).json()
    fix = decode["fix"]
    assert fix["localization_grade"] == grade
    error_m = np.linalg.norm(enu_from_wgs84(fix["lon_deg"], fix["lat_deg"], fix["height_m"], origin))
    if grade == "cm":
        assert error_m < 0.05
    else:
        assert any("whose image" in note for note in fix["notes"])
    (reading,) = [reading for reading in decode["readings"] if reading["family"] == "fiducial"]
    assert reading["turned_deg"] == (180 if grade == "cm" else None)


@pytest.mark.slow
def test_corners_are_found_to_parts_of_a_pixel(capsys: pytest.CaptureFixture[str]) -> None:
    """`CORNER_SIGMA_PX` in app/decoders/fiducial.py rests on the figure that this test prints."""
    code = FiducialCode("apriltag-36h11", 17)
    known = KnownFiducial(code, FiducialGeometry(SIDE_MM, QUIET_MM, Mounting.UPRIGHT))
    panel = np.pad(np.kron(np.where(code.modules == 1, 25, 235), np.ones((16, 16))), 16, constant_values=235.0)
    rng, errors = np.random.default_rng(3), list[Floats]()
    for ahead_m in (5.0, 9.0, 14.0, 20.0):
        for turn_deg in (-30.0, 0.0, 25.0):
            axes, centre = upright_axes(turn_deg), np.array([ahead_m, rng.uniform(0.5, 1.5), 2.0])
            picture = render_sign(CAMERA, panel.astype(np.uint8), axes, centre, (SIDE_MM + 2 * QUIET_MM) / 1000, rng)
            (reading,) = decode_fiducials(picture, known=[known], camera=CAMERA, dictionaries=())
            assert reading.code == code
            assert reading.pose is not None
            found = CAMERA.camera_from_vehicle.T @ reading.pose.translation_m + CAMERA.position_vehicle_m
            assert np.linalg.norm(found - centre) < 0.01 * ahead_m
            errors.append((reading.corners_px - square_px(CAMERA, axes, centre, SIDE_MM / 1000)).ravel())
    sigma_px = float(np.std(np.concatenate(errors)))
    with capsys.disabled():
        print(f"corners of signs: {sigma_px:.3f} px")
    assert sigma_px < 0.1
