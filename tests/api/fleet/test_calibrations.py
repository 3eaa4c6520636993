"""/v1/calibrations and /v1/calibration-boards over real HTTP through real decoder processes, on both databases."""

from __future__ import annotations

import io
import itertools
import json
import zipfile
from collections.abc import Iterator
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from app.services.access.access import Scope
from tests.api.fleet.board_photos import BOARD, TrueCamera, good_photos, jpeg
from tests.conftest import LiveServer
from tests.formats.pictures import huge_png
from tests.http import refused

pytestmark = [pytest.mark.slow, pytest.mark.both_databases]

_AGENCIES = itertools.count(1)
CAMERA = TrueCamera()


@pytest.fixture
def fleet(server: LiveServer) -> Iterator[httpx.Client]:
    """A client of an agency that only this test uses."""
    with server.agency(f"calibrations {next(_AGENCIES)}") as client:
        client.timeout = httpx.Timeout(280)
        yield client


@pytest.fixture(scope="module")
def photos() -> list[bytes]:
    return [jpeg(grey) for grey in good_photos()]


def _send(client: httpx.Client, photos: list[Any], declaration: Any = None, **headers: str) -> httpx.Response:
    parts: list[Any] = [
        ("photos", photo if isinstance(photo, tuple) else (f"{k}.jpg", photo, "image/jpeg"))
        for k, photo in enumerate(photos)
    ]
    if declaration is not None:
        text = declaration if isinstance(declaration, str) else json.dumps(declaration)
        parts.append(("declaration", (None, text, "application/json")))
    return client.post("/v1/calibrations", files=parts, headers=headers)


def _zip(photos: list[bytes]) -> tuple[str, bytes, str]:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for k, photo in enumerate(photos):
            archive.writestr(f"photos/{k}.jpg", photo)
    return ("photos.zip", stream.getvalue(), "application/zip")


def test_photos_calibrate_a_vehicles_camera(fleet: httpx.Client, photos: list[bytes]) -> None:
    declaration = {"board": {"columns": 7, "rows": 10, "square_mm": 25.0, "marker_mm": 18.0}}
    answer = _send(fleet, [*photos, ("notes.txt", b"not a picture", "text/plain")], declaration)
    assert answer.status_code == 201, answer.text
    found = answer.json()
    assert answer.headers["location"] == f"/v1/calibrations/{found['id']}"
    assert fleet.get(answer.headers["location"]).json() == found
    assert fleet.get("/v1/calibrations").json() == {"items": [found]}
    camera = found["camera"]
    assert camera["fx_px"] == pytest.approx(CAMERA.fx_px, rel=0.003)
    assert camera["fy_px"] == pytest.approx(CAMERA.fy_px, rel=0.003)
    assert found["rms_px"] < 0.3
    assert found["coverage"]["share"] > 0.9
    assert [view["used"] for view in found["views"]] == [True] * 14 + [False]
    assert found["views"][14]["reason"] == "not-a-picture"
    assert all(view["rms_px"] < 0.3 for view in found["views"][:14])
    assert found["summary"].startswith("14 of 15 photos used, reprojection error 0.")

    mount = {"height_m": 1.4, "depression_deg": 12.0, "horizontal_fov_deg": 60.0}
    vehicle = fleet.post("/v1/vehicles", json={"name": "BUS-7", "profile": {"camera": mount}}).json()
    path = f"/v1/vehicles/{vehicle['id']}"
    choice = {"calibration_id": found["id"]}
    refused(fleet.put(f"{path}/calibration", json=choice), 428, "version-required", field="If-Match")
    put = fleet.put(f"{path}/calibration", json=choice, headers={"If-Match": '"1"'})
    assert put.status_code == 200, put.text
    assert put.headers["etag"] == '"2"'
    kept = put.json()["profile"]["camera"]
    assert kept == {"height_m": 1.4, "depression_deg": 12.0, **camera, "calibration_id": found["id"]}
    versions = fleet.get(f"{path}/versions").json()["items"]
    assert versions[1]["why"] == f"calibration {found['id']}"
    # the section can be sent back as it came, but not with figures that are not the calibration's
    again = fleet.patch(path, json={"profile": {"camera": kept | {"height_m": 1.5}}}, headers={"If-Match": "*"})
    assert again.status_code == 200, again.text
    wrong = fleet.patch(path, json={"profile": {"camera": kept | {"fx_px": 700.0}}}, headers={"If-Match": "*"})
    refused(wrong, 422, "invalid-parameter", field="profile.camera.fx_px")
    # and an upload is decoded with it
    frame = cv2.imencode(".png", np.full((720, 960), 90, np.uint8))[1].tobytes()
    used = fleet.post("/v1/decodes", files={"file": ("f.png", frame)}, data={"vehicle": "BUS-7"})
    assert used.status_code == 201, used.text
    assert used.json()["context"]["camera"]["fx_px"] == camera["fx_px"]
    assert used.json()["context"]["vehicle"]["version"] == 3


def test_a_zip_gives_the_same_and_a_repeated_request_one_calibration(fleet: httpx.Client, photos: list[bytes]) -> None:
    key = {"Idempotency-Key": "once"}
    packed = _zip(photos)
    first = _send(fleet, [packed], **key)
    assert first.status_code == 201, first.text
    assert first.json()["views"][3]["name"] == "3.jpg"
    again = _send(fleet, [packed], **key)
    assert again.json() == first.json()
    assert again.headers["idempotency-replayed"] == "true"
    refused(_send(fleet, photos[:6], **key), 409, "idempotency-conflict", field="Idempotency-Key")
    assert len(fleet.get("/v1/calibrations").json()["items"]) == 1
    assert first.json()["camera"]["fx_px"] == pytest.approx(CAMERA.fx_px, rel=0.003)


def test_what_is_not_good_enough_is_refused_with_each_photos_reason(fleet: httpx.Client, photos: list[bytes]) -> None:
    mirrored = jpeg(good_photos()[0][:, ::-1].copy())
    small = jpeg(cv2.resize(good_photos()[1], (480, 360), interpolation=cv2.INTER_AREA))
    bad: list[Any] = [
        mirrored, small, ("bomb.png", huge_png(), "image/png"), ("cut.jpg", photos[2][:3000], "image/jpeg"),
        ("page.html", b"<html>", "text/html"), jpeg(np.full((720, 960), 90, np.uint8)),
    ]  # fmt: skip
    problem = refused(_send(fleet, [*photos[:3], *bad, photos[0]]), 422, "calibration-refused", field="photos")
    assert problem["detail"].startswith("too-few-views: 3 of 10 photos")
    reasons = {entry["field"]: entry["detail"].partition(":")[0] for entry in problem["errors"][1:]}
    assert reasons == {
        "photos.3": "mirrored",
        "photos.4": "other-size",
        "photos.5": "too-large",
        "photos.6": "unreadable",
        "photos.7": "not-a-picture",
        "photos.8": "no-board",
        "photos.9": "alike",
    }
    alike = refused(_send(fleet, [photos[0]] * 8), 422, "calibration-refused", field="photos")
    assert alike["detail"].startswith("views-alike: ")
    other = {"board": {"columns": 8, "rows": 9}}
    wrong = refused(_send(fleet, photos[:7], other), 422, "calibration-refused", field="photos")
    assert {entry["detail"].partition(":")[0] for entry in wrong["errors"][1:]} == {"wrong-board"}
    assert fleet.get("/v1/calibrations").json() == {"items": []}


@pytest.mark.parametrize(
    ("declaration", "status", "field"),
    [
        ("{", 400, "declaration"),
        ('{"board": {"columns": NaN}}', 400, "declaration.board.columns"),
        ("[]", 422, "declaration"),
        ('{"board": {"columns": 3}}', 422, "board.columns"),
        ('{"board": {"columns": 1000000000}}', 422, "board.columns"),
        ('{"board": {"square_mm": 0}}', 422, "board.square_mm"),
        ('{"board": {"marker_mm": 25}}', 422, "board.marker_mm"),
        ('{"coefficients": 6}', 422, "coefficients"),
        ('{"colour": "red"}', 422, "colour"),
    ],
)
def test_a_bad_declaration_is_a_problem(fleet: httpx.Client, declaration: str, status: int, field: str) -> None:
    answer = _send(fleet, [b"x"], declaration)
    assert answer.status_code == status, answer.text
    assert answer.json()["field"].endswith(field), answer.text


def test_a_bad_form_is_a_problem(fleet: httpx.Client) -> None:
    refused(fleet.post("/v1/calibrations", json={}), 415, "unsupported-upload", field="Content-Type")
    refused(
        fleet.post("/v1/calibrations", files={"declaration": (None, "{}")}), 422, "unreadable-upload", field="photos"
    )
    assert fleet.post("/v1/calibrations", files={"photo": b"x"}).status_code == 400
    assert _send(fleet, [b""] * 70).status_code in (400, 413)
    refused(_send(fleet, [b""]), 422, "calibration-refused", field="photos")
    refused(
        _send(fleet, [("a.zip", b"PK\x03\x04 damaged", "application/zip")]),
        422,
        "unreadable-upload",
        field="file",
    )
    many = _zip([b"x"] * 61)
    assert _send(fleet, [many]).status_code == 413


def test_boards_are_drawn_for_printing(fleet: httpx.Client) -> None:
    for form, media in (("svg", "image/svg+xml"), ("pdf", "application/pdf"), ("png", "image/png")):
        answer = fleet.get(f"/v1/calibration-boards/board.{form}")
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith(media)
        assert f"waymark-board-7x10-25mm.{form}" in answer.headers["content-disposition"]
    grey = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_GRAYSCALE)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    detector = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard((7, 10), 25, 18, dictionary))
    assert len(detector.detectBoard(grey)[1]) == BOARD.corner_count
    for query, field in (
        ("columns=3", "board.columns"),
        ("columns=1000000000", "columns"),
        ("square_mm=nan", "square_mm"),
        ("marker_mm=30", "board.marker_mm"),
        ("columns=20&rows=10&square_mm=150&marker_mm=100&resolution_dpi=300", "dpi"),
    ):
        answer = fleet.get(f"/v1/calibration-boards/board.png?{query}")
        assert answer.status_code == 422, query
        assert answer.json()["field"] == field
    assert fleet.get("/v1/calibration-boards/board.exe").status_code == 422


def test_calibrations_are_the_agencys_own(server: LiveServer, fleet: httpx.Client, photos: list[bytes]) -> None:
    found = _send(fleet, photos).json()
    with server.agency(f"strangers {next(_AGENCIES)}") as stranger:
        refused(stranger.get(f"/v1/calibrations/{found['id']}"), 404, "not-found", field="calibration_id")
        vehicle = stranger.post("/v1/vehicles", json={"name": "A"}).json()
        choice = {"calibration_id": found["id"]}
        put = stranger.put(f"/v1/vehicles/{vehicle['id']}/calibration", json=choice, headers={"If-Match": "*"})
        refused(put, 404, "not-found", field="calibration_id")
        assert stranger.get("/v1/calibrations").json() == {"items": []}
    with server.agency(f"calibrations {next(_AGENCIES)}", Scope.VIEWER) as viewer:
        assert _send(viewer, photos).status_code == 403
