"""QR codes on artwork: the public page of the marker, or none where nobody could open its address."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from pydantic import ValidationError

from app.settings import Settings
from tests.conftest import LiveServer
from tests.encoders.plate.artwork_reading import qr_text
from tests.http import created

pytestmark = pytest.mark.slow

PUBLIC = "https://roads.example.org/waymark"
NONE = 'none; reason="the server has no public address"'


def qr_of(client: httpx.Client, marker_id: str) -> tuple[httpx.Response, str]:
    answer = client.get(f"/v1/markers/{marker_id}/artwork.png", params={"resolution_dpi": 200})
    assert answer.status_code == 200, answer.text
    picture = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    return answer, qr_text(picture)


@pytest.mark.parametrize(
    ("public_url", "start"),
    [
        (PUBLIC, PUBLIC), (f"{PUBLIC}/", PUBLIC), ("", ""), ("http://127.0.0.1:8000", ""),
        ("http://localhost:8080", ""),
    ],
)  # fmt: skip
def test_the_qr_code_opens_the_public_page_or_there_is_none(
    settings: Settings, serve: Callable[[Settings], LiveServer], place: Callable[[], dict[str, Any]],
    public_url: str, start: str,
) -> None:  # fmt: skip
    server = serve(settings.model_copy(update={"public_url": public_url}))
    with server.client() as client, server.client(None) as anybody:
        plate = created(client, "/v1/markers", position=place(), status="active")
        answer, text = qr_of(client, plate["id"])
        assert answer.headers["waymark-qr-code"] == ("public-page" if start else NONE)
        assert f"digits={plate['code']['digits']} " in answer.headers["waymark-proof"]
        assert text == (f"{start}/m/{plate['id']}" if start else "")
        if start:
            assert anybody.get(text.removeprefix(start)).status_code == 200
        code = {"dictionary": "apriltag-36h11", "number": 7}
        geometry = {"side_mm": 300.0, "mounting": "upright"}
        sign = created(client, "/v1/markers", family="fiducial", position=place(), code=code, geometry=geometry)
        answer, text = qr_of(client, sign["id"])
        assert answer.headers["waymark-qr-code"] == ("public-page" if start else NONE)
        assert text.startswith(f"{start}/m/") if start else text == ""
        bundle = client.post("/v1/artwork", json={"marker_ids": [plate["id"]], "formats": ["svg"]})
        assert bundle.headers["waymark-qr-code"] == ("public-page" if start else NONE)
        with zipfile.ZipFile(io.BytesIO(bundle.content)) as archive:
            manifest = json.loads(archive.read("manifest.json"))
        assert manifest["plates"][0]["record_url"] == (f"{start}/m/{plate['id']}" if start else None)
        assert bool(manifest["notes"]) is not bool(start)
        operation = client.get("/openapi.json").json()["paths"]["/v1/markers/{marker_id}/artwork.{form}"]["get"]
        assert "Waymark-QR-Code" in operation["responses"]["200"]["headers"]


@pytest.mark.parametrize(
    ("public_url", "expected"),
    [
        ("", ""),
        ("https://waymark.example.org", "https://waymark.example.org"),
        ("http://192.0.2.7:8000/", "http://192.0.2.7:8000"),
        ("http://[2001:db8::1]", "http://[2001:db8::1]"),
        ("http://localhost:8000", ""),
        ("https://waymark.localhost", ""),
        ("http://127.1.2.3", ""),
        ("http://[::1]:8000", ""),
        ("http://0.0.0.0:8000", ""),
    ],
)
def test_addresses_that_only_this_machine_can_open_are_in_no_qr_code(public_url: str, expected: str) -> None:
    assert Settings(public_url=public_url).qr_code_url == expected


@pytest.mark.parametrize(
    "public_url",
    [
        "waymark.example.org",
        "ftp://x.example",
        "https://",
        "https://x/?a",
        "https://x/#a",
        "https://ü.example",
        "https://x y",
    ],
)
def test_a_public_url_is_an_address(public_url: str) -> None:
    with pytest.raises(ValidationError, match="public_url"):
        Settings(public_url=public_url)
