"""/v1/plate-drafts over real HTTP, on both databases: plates before they are registered."""

from __future__ import annotations

import io
import re
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from PIL import Image

from app.decoders.plate.reader import decode_plates
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme
from app.planning.predict.rates import plate_read_rate, readable_frames
from app.planning.rules import CameraRules
from app.services.access.access import Scope
from tests.conftest import LiveServer
from tests.http import created, refused

pytestmark = pytest.mark.both_databases

URL = "/v1/plate-drafts"
PLACE = {"lon_deg": 114.179203, "lat_deg": 22.304161}
NUMBERED = {"code": {"scheme": "id", "registry_number": 0xBEEF}}


def answered(client: httpx.Client, path: str, body: dict[str, Any]) -> Any:
    response = client.post(path, json=body)
    assert response.status_code == 200, response.text
    return response.json()


def test_a_draft_is_the_plate_that_is_registered(client: httpx.Client, place: Any) -> None:
    body = {"position": place(), "code": {"scheme": "position-robust"}, "geometry": {"gap_mm": 4.0}}
    draft = answered(client, URL, body)
    marker = created(client, "/v1/markers", **body)
    assert draft["code"]["digits"] == marker["code"]["digits"]
    assert draft["code"]["digits_match_position"] is True
    assert not draft["code"]["example"]
    assert draft["geometry"] == marker["geometry"]
    code = PlateCode(marker["code"]["digits"], PlateScheme.POSITION_ROBUST, 10)
    shown = "".join(draft["units"]).replace("-", "0")
    assert [int(unit) for unit in shown] == code.units.reshape(-1).tolist()
    assert [row.count("-") for row in draft["units"]] == [4, 4, 0, 0, 0, 0, 0, 0, 4, 4]


def test_every_dimension_adds_up(client: httpx.Client) -> None:
    draft = answered(client, URL, {**NUMBERED, "geometry": {"unit_mm": 40.0, "gap_mm": 4.0, "thickness_mm": 15.0}})
    mm = {row["name"]: row["value_mm"] for row in draft["dimensions"]}
    assert mm["side"] == 8 * mm["unit"] + 7 * mm["gap"] + 2 * mm["border"] == 356.0
    assert mm["pitch"] == mm["unit"] + mm["gap"]
    assert mm["marker"] == 2 * mm["unit"] + mm["gap"]
    assert mm["diagonal"] == pytest.approx(503.46, abs=0.01)
    assert (mm["thickness"], mm["sheet-width"], mm["sheet-height"]) == (15.0, 396.0, 464.0)
    tolerances = {row["name"]: row["tolerance_mm"] for row in draft["dimensions"]}
    assert (tolerances["side"], tolerances["unit"], tolerances["pitch"]) == (0.5, 0.3, None)


def test_a_number_is_an_example_until_it_is_given(client: httpx.Client) -> None:
    code = answered(client, URL, {})["code"]
    assert (code["example"], code["registry_number"]) == (True, "C0FFEE42")
    code = answered(client, URL, NUMBERED)["code"]
    assert (code["example"], code["registry_number"]) == (False, "BEEF")
    large = answered(client, URL, {"code": {"registry_number": 2**64 - 1}, "geometry": {"n": 12}})["code"]
    assert large["registry_number"] == "F" * 16
    assert (code["correctable_cells"], large["correctable_cells"]) == (2, 3)


@pytest.mark.parametrize(
    ("body", "field", "words"),
    [
        ({"code": {"scheme": "position"}}, "position", "the position of the plate's centre"),
        ({"position": {"lon_deg": 22.3, "lat_deg": 114.2}, "code": {"scheme": "position"}}, "position.lat_deg", "-90"),
        ({"position": {"lon_deg": 22.3}}, "position", "one complete pair"),
        ({"geometry": {"unit_mm": 19.0}}, "geometry.unit_mm", "20 to 50 mm"),
        ({"geometry": {"n": 12, "unit_mm": 50.0}}, "geometry.side_mm", "150 to 500 mm"),
        ({"code": {"scheme": "id", "registry_number": 2**40}}, "code.registry_number", "4294967295"),
        ({"code": {"scheme": "id", "digits": "0123456789AB"}}, "code.digits", "check symbols"),
        (
            {"position": PLACE, "code": {"scheme": "position", "digits": "1" * 12}},
            "code.digits",
            "leave the digits out",
        ),
        ({"colour": "blue"}, "colour", ""),
    ],
)
def test_a_draft_that_cannot_be_is_explained(client: httpx.Client, body: Any, field: str, words: str) -> None:
    problem = refused(client.post(URL, json=body), 422)
    assert problem["field"] == field
    assert words in f"{problem.get('limit')} {problem.get('cure')}"


@pytest.mark.parametrize("form", ["svg", "pdf", "dxf", "png"])
def test_artwork_of_a_draft_was_read_back_and_says_that_it_is_a_draft(client: httpx.Client, form: str) -> None:
    response = client.post(f"{URL}/artwork.{form}", json={**NUMBERED, "resolution_dpi": 60, "heaters": True})
    assert response.status_code == 200, response.text
    code = PlateCode.from_registry_number(0xBEEF)
    assert f"digits={code.digits} " in response.headers["waymark-proof"]
    assert response.headers["content-disposition"] == f'inline; filename="draft-{code.digits}.{form}"'
    if form == "svg":
        assert 'width="365mm"' in response.text
        assert 'id="HEATER"' in response.text
    if form == "dxf":
        assert "a draft, not registered" in response.text
    if form == "png":
        picture = np.asarray(Image.open(io.BytesIO(response.content)).convert("RGB"))[:, :, ::-1]
        readings = decode_plates(np.ascontiguousarray(picture), geometries=(PlateGeometry(),))
        assert [one.code.digits for one in readings if one.code is not None] == [code.digits]


def test_nothing_is_stored(server: LiveServer) -> None:
    with server.agency("drafts", Scope.VIEWER) as viewer:
        before = viewer.get("/v1/markers").json()["items"]
        answered(viewer, URL, {"position": PLACE, "code": {"scheme": "position"}})
        assert viewer.get("/v1/markers").json()["items"] == before == []


def test_a_pass_has_the_rates_of_plans(client: httpx.Client) -> None:
    camera = {"height_m": 1.4, "horizontal_fov_deg": 60.0, "exposure_s": 0.002, "frames_per_s": 20.0}
    found = answered(client, f"{URL}/pass", {"camera": camera, "speed_kmh": 72.0})
    rules = CameraRules(**camera)
    assert found["step_m"] == pytest.approx(1.0)
    assert found["blur_mm"] == pytest.approx(40.0)
    assert found["blur_units"] == pytest.approx(1.0)
    assert found["readable_frames_per_pass"] == pytest.approx(readable_frames(PlateGeometry(), rules, 20.0), abs=0.01)
    rates = {one["condition"]: one["read_rate"] for one in found["read_rates"]}
    assert rates["day"] == pytest.approx(plate_read_rate(PlateGeometry(), rules, "day", 20.0, 0.0), abs=1e-4)
    assert {"day", "night", "rain", "shade", "wear", "dirt"} == set(rates)
    for one in found["read_rates"]:
        assert one["will_be_read"] == (one["read_rate"] >= found["min_read_rate"])
    frames = found["frames"]
    assert [frame["ahead_m"] for frame in frames] == sorted((frame["ahead_m"] for frame in frames), reverse=True)
    assert abs(len(frames) - found["readable_frames_per_pass"]) <= 1
    assert all(found["near_m"] <= frame["ahead_m"] <= found["far_m"] for frame in frames)
    assert all(frame["unit_px"] * 8 == pytest.approx(frame["plate_height_px"]) for frame in frames)
    assert frames[-1]["read_probability"] > frames[0]["read_probability"]


def test_frames_fall_with_speed_and_none_is_listed_twice(client: httpx.Client) -> None:
    fast, slow = (answered(client, f"{URL}/pass", {"speed_kmh": speed}) for speed in (120.0, 2.0))
    assert slow["readable_frames_per_pass"] == pytest.approx(60 * fast["readable_frames_per_pass"], rel=0.01)
    assert len(slow["frames"]) <= 40
    assert slow["listed_every"] == pytest.approx(slow["readable_frames_per_pass"] / 40, abs=1)


def test_a_plate_out_of_view_has_no_frames(client: httpx.Client) -> None:
    found = answered(client, f"{URL}/pass", {"camera": {"depression_deg": 90.0, "height_m": 0.2}})
    assert (found["readable_frames_per_pass"], found["near_m"], found["far_m"], found["frames"]) == (0, None, None, [])
    assert not any(one["will_be_read"] for one in found["read_rates"])


def _corners(response: httpx.Response) -> np.ndarray[Any, Any]:
    text = response.headers["waymark-corners"]
    return np.array([float(value) for value in re.split("[ ,]", text)] if text else []).reshape(-1, 2)


@pytest.mark.slow
def test_a_picture_is_to_scale_and_decoded(client: httpx.Client) -> None:
    camera = {"width_px": 1280, "height_px": 720}
    body = {**NUMBERED, "camera": camera, "speed_kmh": 50.0, "ahead_m": 3.0}
    response = client.post(f"{URL}/view", json=body)
    assert response.status_code == 200, response.text
    picture = cv2.imdecode(np.frombuffer(response.content, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.shape == (720, 1280, 3)
    assert response.headers["waymark-reading"].startswith("alone confidence=")
    corners = _corners(response)
    reading = decode_plates(np.asarray(picture, np.uint8), geometries=(PlateGeometry(),))[0]
    assert reading.corners_px is not None
    assert np.abs(reading.corners_px - corners).max() < 1.5
    passing = answered(client, f"{URL}/pass", {"camera": camera, "speed_kmh": 50.0})
    nearest = min(passing["frames"], key=lambda frame: abs(frame["ahead_m"] - 3.0))
    assert np.ptp(corners[:, 1]) == pytest.approx(nearest["plate_height_px"], rel=0.5)


def test_a_blurred_picture_is_not_read(client: httpx.Client) -> None:
    camera = {"width_px": 640, "height_px": 360, "exposure_s": 0.02}
    response = client.post(f"{URL}/view", json={**NUMBERED, "camera": camera, "speed_kmh": 120.0, "ahead_m": 5.0})
    assert response.headers["waymark-reading"] == "not-read confidence=0.0000"
    assert response.headers["waymark-exposure"] == "0.020000"


def test_a_night_exposes_longer_and_a_plate_behind_the_frame_has_no_corners(client: httpx.Client) -> None:
    camera = {"width_px": 640, "height_px": 360}
    response = client.post(f"{URL}/view", json={"camera": camera, "condition": "night", "ahead_m": 0.3})
    assert response.status_code == 200, response.text
    assert float(response.headers["waymark-exposure"]) > 0.001
    assert not len(_corners(response))


@pytest.mark.parametrize(
    ("path", "body", "field", "words"),
    [
        ("/view", {"camera": {"width_px": 8000, "height_px": 6000}}, "camera.width_px", "9 million pixels"),
        ("/view", {"ahead_m": 30.0}, "ahead_m", ""),
        ("/view", {"condition": "fog"}, "condition", ""),
        ("/pass", {"speed_kmh": 0.0}, "speed_kmh", ""),
        ("/pass", {"camera": {"exposure_s": 1.0}}, "camera.exposure_s", ""),
        ("/artwork.png", {"resolution_dpi": 5000}, "resolution_dpi", ""),
    ],
)
def test_what_cannot_be_calculated_is_explained(
    client: httpx.Client, path: str, body: Any, field: str, words: str
) -> None:
    problem = refused(client.post(f"{URL}{path}", json=body), 422)
    assert field in (problem["field"], *(error["field"] for error in problem.get("errors", [])))
    assert words in str(problem.get("limit"))
