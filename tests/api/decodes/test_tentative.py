"""Tentative readings over HTTP: alone they give nothing; frames of one ZIP, and the registry, confirm them."""

from __future__ import annotations

from typing import Any

import cv2
import httpx
import pytest

from app.markers.plate import PlateCode
from app.sensors.camera import Camera
from benchmarks.plates.sets import Job, Shot, find_shot
from tests.api.decodes.conftest import post_frame
from tests.api.decodes.test_archives import pack, wait_for
from tests.http import created

pytestmark = pytest.mark.slow

SEED, JOB, FIRST, LAST = 51, 1, 17, 19  # of a drive over a plate under spots of paint
WHERE = {"lon_deg": 11.5, "lat_deg": 48.1, "accuracy_m": 20}


@pytest.fixture(scope="module")
def drive() -> tuple[PlateCode, Camera, list[bytes]]:
    """The plate, the camera, and the frames as JPEG."""
    shots = [find_shot(Job("stains", JOB, SEED, 25), k) for k in range(FIRST, LAST + 1)]
    seen = [shot for shot in shots if isinstance(shot, Shot)]
    code = seen[0].code
    assert code is not None
    frames = [cv2.imencode(".jpg", shot.frame.image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes() for shot in seen]
    return code, seen[0].camera, frames


def context_of(camera: Camera) -> dict[str, Any]:
    matrix = {"fx_px": camera.fx_px, "fy_px": camera.fy_px, "cx_px": camera.cx_px, "cy_px": camera.cy_px}
    return {"coarse_position": WHERE, "camera": {"width_px": camera.width_px, "height_px": camera.height_px, **matrix}}


def test_a_tentative_reading_is_not_matched_and_gives_no_position(
    real_client: httpx.Client, drive: tuple[PlateCode, Camera, list[bytes]]
) -> None:
    code, camera, frames = drive
    [reading] = post_frame(real_client, frames[0], context_of(camera)).json()["readings"]
    assert (reading["outcome"], reading["certainty"]) == ("unsure", "tentative"), reading
    assert (reading["digits"], reading["likely_digits"], reading["scheme"]) == (None, code.digits, "position")
    assert reading["doubtful_cells"]
    assert reading["confidence"] <= 0.9
    assert (reading["match"], reading["fix"], reading["pose"]) == (None, None, None)


def test_frames_of_one_archive_confirm_each_other(
    real_client: httpx.Client, drive: tuple[PlateCode, Camera, list[bytes]]
) -> None:
    code, camera, frames = drive
    archive = pack({f"{k}.jpg": frame for k, frame in enumerate(frames)})
    answer = post_frame(real_client, archive, context_of(camera), name="drive.zip")
    decode = wait_for(real_client, answer.headers["location"])
    readings = decode["readings"]
    assert [reading["digits"] for reading in readings] == [code.digits] * len(frames), readings
    for reading in readings:
        assert (reading["certainty"], reading["likely_digits"], reading["doubtful_cells"]) == ("unchecked", None, [])
        assert reading["evidence_frames"] == list(range(len(frames)))
        assert reading["confidence"] == pytest.approx(0.99)  # these digits have no check
        assert reading["pose"] is not None
        assert reading["match"] is not None


def test_a_registered_plate_confirms_it(
    real_client: httpx.Client, drive: tuple[PlateCode, Camera, list[bytes]]
) -> None:
    code, camera, frames = drive
    lon_deg, lat_deg = 11 + int(code.digits[:6]) / 1e6, 48 + int(code.digits[6:]) / 1e6
    position = {"lon_deg": lon_deg, "lat_deg": lat_deg}
    plate = created(real_client, "/v1/markers", family="plate", position=position, heading_deg=0.0,
                    code={"scheme": "position", "digits": code.digits})  # fmt: skip
    context = context_of(camera) | {"coarse_position": position | {"accuracy_m": 20}}
    [reading] = post_frame(real_client, frames[0], context).json()["readings"]
    assert (reading["digits"], reading["certainty"], reading["from_codebook"]) == (code.digits, "sure", True)
    assert reading["match"]["marker_id"] == plate["id"]
