"""/v1/print-grades over real HTTP through real decoder processes, on both databases."""

from __future__ import annotations

import hashlib
import itertools
import json
import struct
import subprocess
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from app.markers.plate import PlateCode, PlateScheme
from app.services.access.access import Scope
from benchmarks.scenes.printed_plate import PrintFaults
from tests.conftest import LiveServer
from tests.decoders.plate.print_photos import CODE, photo_of, pixels
from tests.formats.pictures import huge_png
from tests.http import created, refused
from tests.machine import require_tool

pytestmark = [pytest.mark.slow, pytest.mark.both_databases]

_AGENCIES = itertools.count(1)
DECLARED = {"code": {"scheme": "position", "digits": CODE.digits}, "speed_kmh": 50.0}


@pytest.fixture
def workshop(server: LiveServer) -> Iterator[httpx.Client]:
    """A client that may only read, of an agency that only this test uses."""
    with server.agency(f"prints {next(_AGENCIES)}", Scope.VIEWER) as client:
        client.timeout = httpx.Timeout(280)
        yield client


@pytest.fixture(scope="module")
def photo() -> bytes:
    return photo_of()


def _send(client: httpx.Client, photo: Any, declaration: Any = None, path: str = "/v1/print-grades") -> httpx.Response:
    parts: list[Any] = [("photo", photo if isinstance(photo, tuple) else ("plate.jpg", photo, "image/jpeg"))]
    if declaration is not None:
        text = declaration if isinstance(declaration, str) else json.dumps(declaration)
        parts.append(("declaration", (None, text, "application/json")))
    return client.post(path, files=parts)


def _turned(photo: bytes, orientation: int, focal_35mm: int) -> bytes:
    """A photo stored on its side, with EXIF that turns it upright."""
    image = cv2.rotate(pixels(photo), cv2.ROTATE_90_COUNTERCLOCKWISE)
    jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    first = struct.pack("<HHHIHH", 2, 0x0112, 3, 1, orientation, 0) + struct.pack("<HHII", 0x8769, 4, 1, 38)
    exif = struct.pack("<HHHIHH", 1, 0xA405, 3, 1, focal_35mm, 0) + bytes(4)
    tiff = b"II*\0" + struct.pack("<I", 8) + first + bytes(4) + exif
    segment = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


def _letters(document: dict[str, Any]) -> dict[str, str]:
    return {one["name"]: one["letter"] for one in document["parameters"]}


def test_a_good_print_gets_an_a_and_is_read_at_the_design_speed(workshop: httpx.Client, photo: bytes) -> None:
    answer = _send(workshop, photo, DECLARED)
    assert answer.status_code == 200, answer.text
    document = answer.json()
    assert (document["grade"], document["letter"], document["limited_by"]) == (4.0, "A", [])
    assert set(_letters(document).values()) == {"A"}
    assert document["plate"]["source"] == "declaration"
    assert document["reading"] == {"outcome": "read", "digits": CODE.digits}
    assert document["photo"]["sha256"] == hashlib.sha256(photo).hexdigest()
    assert document["view"]["focal_length_source"] == "assumed"
    prediction = document["prediction"]
    assert prediction["will_be_read"]
    assert prediction["speed_kmh"] == 50.0
    assert 0.9 < prediction["read_rate"] <= prediction["faultless_read_rate"] <= 1
    assert prediction["frames_wrong"] == 0
    assert prediction["frames_read"] > 0.7 * prediction["simulated_frames"]
    assert any("no conformance" in note for note in document["notes"])
    margins = document["units"]["reflectance_margin"]
    assert [margins[0][0], margins[7][7]] == [None, None]
    assert min(value for row in margins for value in row if value is not None) > 0.9
    now = datetime.now(UTC)
    assert now - timedelta(minutes=10) < datetime.fromisoformat(document["graded_at"]) <= now
    again = _send(workshop, photo, DECLARED).json()
    assert {**again, "graded_at": ""} == {**document, "graded_at": ""}


def test_faults_have_their_cause_and_cure(workshop: httpx.Client) -> None:
    faults = PrintFaults(stretch=0.09, faded={(5, 3): 0.33})
    document = _send(workshop, photo_of(faults=faults, seed=9), DECLARED).json()
    letters = _letters(document)
    below = {name: letter for name, letter in letters.items() if letter != "A"}
    assert below == {"modulation": "C", "reflectance-margin": "C", "axial-nonuniformity": "C"}
    assert (document["grade"], document["letter"]) == (2.0, "C")
    modulation = next(one for one in document["parameters"] if one["name"] == "modulation")
    assert (modulation["unit_at"], modulation["unit"]) == ([6, 4], "%")
    assert modulation["thresholds"]["limits"][0] == 50
    assert "67" in modulation["finding"] or "%" in modulation["finding"]
    assert modulation["cure"]


def test_a_plate_that_vehicles_cannot_read_is_not_predicted_to_be_read(workshop: httpx.Client) -> None:
    wrong = PlateCode("987654321012")
    document = _send(workshop, photo_of(wrong), DECLARED).json()
    assert document["letter"] == "F"
    assert {"decode", "damage", "reflectance-margin"} <= set(document["limited_by"])
    assert document["prediction"]["frames_read"] == 0
    assert document["prediction"]["read_rate"] < 0.5
    assert not document["prediction"]["will_be_read"]


def test_a_registered_plate_says_what_it_should_be(client: httpx.Client, place: Any) -> None:
    client.timeout = httpx.Timeout(280)
    marker = created(client, "/v1/markers", position=place(), heading_deg=10.0, code={"scheme": "id"})
    code = PlateCode(marker["code"]["digits"], PlateScheme.ID)
    document = _send(client, photo_of(code), {"marker_id": marker["id"]}).json()
    assert document["letter"] == "A"
    assert document["plate"]["source"] == "marker"
    assert document["plate"]["marker_id"] == marker["id"]
    assert _letters(document)["unused-error-correction"] == "A"
    refused(_send(client, photo_of(code), {"marker_id": "0190a1b2-0000-7000-8000-000000000000"}), 404)
    both = {"marker_id": marker["id"], "code": {"digits": CODE.digits}}
    refused(_send(client, photo_of(code), both), 422, field="marker_id")


def test_a_marker_of_another_family_and_agency_is_refused(
    client: httpx.Client, workshop: httpx.Client, place: Any, photo: bytes
) -> None:
    position = place() | {"height_m": 5.0}
    cerpm = client.post("/v1/markers", json={"family": "cerpm", "position": position, "side": "left", "sequence": 3})
    if cerpm.status_code == 201:
        refused(_send(client, photo, {"marker_id": cerpm.json()["id"]}), 422, field="marker_id")
    marker = created(client, "/v1/markers", position=place(), heading_deg=10.0)
    refused(_send(workshop, photo, {"marker_id": marker["id"]}), 404)


def test_photos_are_turned_by_their_exif_and_its_focal_length_is_used(workshop: httpx.Client) -> None:
    photo = photo_of(tilt_deg=22.0)
    refused(_send(workshop, photo, DECLARED), 422, "print-not-graded", field="photo")
    document = _send(workshop, _turned(photo, 6, 26), DECLARED).json()
    assert document["letter"] == "A", document
    assert document["view"]["focal_length_source"] == "exif"
    assert (document["photo"]["width_px"], document["photo"]["height_px"]) == (1600, 1200)


def test_png_is_read_and_nothing_need_be_declared(workshop: httpx.Client, photo: bytes) -> None:
    png = cv2.imencode(".png", pixels(photo))[1].tobytes()
    document = _send(workshop, ("plate.png", png, "image/png")).json()
    assert document["letter"] == "A"
    assert document["plate"]["source"] == "photo"
    assert document["plate"]["digits"] == CODE.digits


def test_the_pdf_has_one_page_with_the_grade(workshop: httpx.Client, tmp_path: Path) -> None:
    photo = photo_of(faults=PrintFaults(faded={(5, 3): 0.28}))
    answer = _send(workshop, photo, DECLARED, "/v1/print-grades?format=pdf")
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/pdf"
    assert CODE.digits in answer.headers["content-disposition"]
    path = tmp_path / "grade.pdf"
    path.write_bytes(answer.content)
    command = [require_tool("pdftotext"), "-layout", path, "-"]
    text = subprocess.run(command, capture_output=True, check=True, text=True).stdout
    assert text.count("\f") == 1
    for expected in (CODE.digits, hashlib.sha256(photo).hexdigest(), "3.0 of 4.0", "row 6, column 4", "At 50 km/h",
                     f"{datetime.now(UTC):%Y-%m-%d}", "no conformance is claimed"):  # fmt: skip
        assert expected in text, expected
    subprocess.run([require_tool("pdftoppm"), "-r", "60", "-png", path, tmp_path / "page"], check=True)
    page = np.asarray(cv2.imread(str(next(tmp_path.glob("page*.png")))), np.int16)
    blue, green, red = page[150:350, 40:230].reshape(-1, 3).T  # where the plate's picture is
    assert ((red - np.maximum(green, blue)) > 80).mean() > 0.01, "the red triangle"
    assert ((green - np.maximum(red, blue)) > 40).mean() > 0.05, "the green squares"


BAD_DECLARATIONS: list[tuple[Any, int, str]] = [
    ({"code": {"digits": "12345"}}, 422, "code.digits"),
    ({"code": {"digits": "12345678901F"}}, 422, "code.digits"),
    ({"code": {"scheme": "id", "digits": "000000000001"}}, 422, "code.digits"),
    ({"geometry": {"n": 9}}, 422, "geometry.n"),
    ({"geometry": {"gap_mm": 50.0}}, 422, "geometry.gap_mm"),
    ({"speed_kmh": 0.0}, 422, "speed_kmh"),
    ('{"speed_kmh": NaN}', 400, "declaration.speed_kmh"),
    ({"camera": {"width_px": 10}}, 422, "camera.width_px"),
    ({"digits": CODE.digits}, 422, "digits"),
    ("no json", 400, "declaration"),
]


@pytest.mark.parametrize(("declaration", "status", "field"), BAD_DECLARATIONS)
def test_declarations_that_cannot_be_are_refused(
    workshop: httpx.Client, photo: bytes, declaration: Any, status: int, field: str
) -> None:
    refused(_send(workshop, photo, declaration), status, field=field)


def test_files_that_are_no_photo_are_refused(workshop: httpx.Client, photo: bytes) -> None:
    refused(_send(workshop, b"this is a text file, not a photo"), 415, field="photo")
    refused(_send(workshop, b"RIFF\0\0\0\0WEBPVP8 "), 415, field="photo")
    refused(_send(workshop, b""), 422, field="photo")
    refused(_send(workshop, photo[: len(photo) // 2]), 422, "unreadable-upload", field="photo")
    refused(_send(workshop, huge_png()), 413, field="photo")
    refused(workshop.post("/v1/print-grades", content=photo[:99], headers={"Content-Type": "image/jpeg"}), 415)
    refused(workshop.post("/v1/print-grades", files={"declaration": (None, "{}")}), 422, field="photo")
    refused(workshop.post("/v1/print-grades", files={"image": ("a.jpg", photo)}), 400, field="image")
    refused(_send(workshop, photo, DECLARED, "/v1/print-grades?format=docx"), 422, field="format")


def test_photos_that_cannot_be_graded_are_refused_with_the_limit_and_the_cure(workshop: httpx.Client) -> None:
    small = refused(_send(workshop, photo_of(side_px=330.0), DECLARED), 422, "print-not-graded", field="photo")
    assert "400 px" in small["limit"]
    assert "come nearer" in small["cure"]
    image = pixels(photo_of())

    def jpeg(pixels: Any) -> bytes:
        return bytes(cv2.imencode(".jpg", pixels)[1].tobytes())

    for picture, reason in (
        (cv2.GaussianBlur(image, (0, 0), 5.0), "blurred"),
        (cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), "grey"),
        (np.full((600, 800, 3), (90, 120, 140), np.uint8), "no plate"),
        (np.hstack([image, pixels(photo_of(PlateCode("555544443333")))]), "2 plates"),
        (pixels(photo_of(exposure=1.7)), "over-exposed"),
    ):
        problem = refused(_send(workshop, jpeg(picture)), 422, "print-not-graded")
        assert reason in problem["detail"], problem
        assert problem["cure"]


def test_vehicles_may_not_ask_for_grades(server: LiveServer, photo: bytes) -> None:
    with server.agency(f"prints {next(_AGENCIES)}", Scope.VEHICLE) as vehicle:
        refused(_send(vehicle, photo), 403)
    with httpx.Client(base_url=server.url) as stranger:
        refused(_send(stranger, photo), 401)
