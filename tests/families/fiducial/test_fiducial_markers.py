"""Fiducial signs in the registry, over HTTP."""

from __future__ import annotations

import csv
import io
import json
from datetime import UTC, datetime
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from app.decoders.fiducial import decode_fiducials, known_fiducials, match_fiducial
from app.decoders.snapshot import open_snapshot
from app.markers.fiducial import FiducialCode, FiducialGeometry, KnownFiducial
from app.markers.snapshot import Trust
from tests.conftest import Place

pytestmark = pytest.mark.both_databases


def sign(place: dict[str, Any], number: int = 17, dictionary: str = "apriltag-36h11", **more: Any) -> dict[str, Any]:
    """A sign to register."""
    return {
        "family": "fiducial",
        "position": {**place, "height_m": 7.0, "horizontal_rmse_m": 0.01, "vertical_rmse_m": 0.02},
        "code": {"dictionary": dictionary, "number": number},
        "geometry": {"side_mm": 400.0, "mounting": "upright"},
        "heading_deg": 30.0,
        **more,
    }


def post(client: httpx.Client, body: dict[str, Any]) -> dict[str, Any]:
    """The sign that a request registers."""
    answer = client.post("/v1/markers", json=body)
    assert answer.status_code == 201, answer.text
    document: dict[str, Any] = answer.json()
    return document


def test_a_sign_is_registered_read_and_listed(client: httpx.Client, place: Place) -> None:
    made = post(client, sign(place()))
    assert made["code"] == {
        "scheme": "apriltag-36h11", "text": "apriltag-36h11-17", "dictionary": "apriltag-36h11", "number": 17
    }  # fmt: skip
    assert made["geometry"] == {"side_mm": 400.0, "quiet_mm": 50.0, "mounting": "upright", "image": None}
    assert client.get(f"/v1/markers/{made['id']}").json() == made
    query = {"family": "fiducial", "code": "apriltag-36h11-17"}
    assert made["id"] in [item["id"] for item in client.get("/v1/markers", params=query).json()["items"]]
    changed = client.patch(f"/v1/markers/{made['id']}", json={"status": "built"}, headers={"If-Match": '"1"'}).json()
    assert (changed["status"], changed["geometry"]) == ("built", made["geometry"])
    versions = client.get(f"/v1/markers/{made['id']}/versions").json()["items"]
    assert [version["marker"]["status"] for version in versions] == ["planned", "built"]


def test_the_same_sign_is_not_registered_twice_near_by(client: httpx.Client, place: Place) -> None:
    at = place()
    made = post(client, sign(at, dictionary="aruco-4x4-50", status="built"))
    again = client.post("/v1/markers", json=sign(at, dictionary="aruco-4x4-250"))
    assert (again.status_code, again.json()["field"]) == (409, "code.number")
    post(client, sign(at, number=18, dictionary="aruco-4x4-50"))
    client.patch(f"/v1/markers/{made['id']}", json={"status": "retired"}, headers={"If-Match": "*"})
    post(client, sign(at, dictionary="aruco-4x4-250"))


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"code": {"dictionary": "aruco-9x9", "number": 1}}, "code.dictionary"),
        ({"code": {"dictionary": "apriltag-16h5", "number": 30}}, "code.number"),
        ({"geometry": {"side_mm": 5.0}}, "geometry.side_mm"),
        ({"geometry": {"side_mm": 400.0, "mounting": "hanging"}}, "geometry.mounting"),
    ],
)
def test_what_no_sign_can_be_is_refused(client: httpx.Client, place: Place, change: dict[str, Any], field: str) -> None:
    answer = client.post("/v1/markers", json=sign(place()) | change)
    assert answer.status_code == 422, answer.text
    assert answer.json()["field"] == field


def test_artwork_is_at_true_size_and_reads_back(client: httpx.Client, place: Place) -> None:
    made = post(client, sign(place(), number=301, geometry={"side_mm": 300.0, "quiet_mm": 40.0}))
    path = f"/v1/markers/{made['id']}/artwork"
    picture = client.get(f"{path}.png", params={"resolution_dpi": 100})
    assert picture.status_code == 200, picture.text
    assert picture.headers["waymark-proof"] == "read-back digits=apriltag-36h11-301 confidence=1.000000"
    pixels = cv2.imdecode(np.frombuffer(picture.content, np.uint8), cv2.IMREAD_COLOR)
    code = FiducialCode("apriltag-36h11", 301)
    (reading,) = decode_fiducials(pixels, known=[KnownFiducial(code, FiducialGeometry(300.0, 40.0))])
    assert reading.code == code
    assert reading.side_px / 100 * 25.4 == pytest.approx(300.0, abs=0.5)
    for form, start in (("svg", b"<?xml"), ("pdf", b"%PDF"), ("dxf", b"  0")):
        assert client.get(f"{path}.{form}").content.startswith(start)
    refused = client.get(f"{path}.svg", params={"heaters": True})
    assert (refused.status_code, refused.json()["field"]) == (422, "heaters")


def test_a_sign_goes_out_to_gis_files_and_vehicles(client: httpx.Client, place: Place) -> None:
    at = place()
    made = post(client, sign(at, status="active"))
    lon, lat = at["lon_deg"], at["lat_deg"]
    box = f"{lon - 0.001},{lat - 0.001},{lon + 0.001},{lat + 0.001}"
    features = client.get("/ogc/collections/markers/items", params={"bbox": box}).json()["features"]
    (feature,) = [feature for feature in features if feature["id"] == made["id"]]
    properties = feature["properties"]
    assert (properties["family"], properties["code"]) == ("fiducial", "apriltag-36h11-17")
    text = client.get("/v1/exports/csv", params={"bbox": box}).text
    assert [row["code"] for row in csv.DictReader(io.StringIO(text)) if row["id"] == made["id"]] == [
        "apriltag-36h11-17"
    ]
    trust = Trust.from_document(client.get("/v1/snapshots/trust").json())
    data = client.get("/v1/snapshots", params={"bbox": box}).content
    snapshot = open_snapshot(data, trust, datetime.now(UTC))
    code = FiducialCode("apriltag-36h11", 17)
    assert known_fiducials(snapshot, lon, lat, 50.0) == (KnownFiducial(code, FiducialGeometry(400.0, 50.0)),)
    match = match_fiducial(snapshot, code, lon, lat, 50.0)
    assert match is not None
    assert match.marker_id == made["id"]
    assert snapshot.summary()["markers"] == {"fiducial": 1}


@pytest.mark.slow
def test_a_survey_registers_signs_by_their_numbers(client: httpx.Client, place: Place) -> None:
    at = place()
    lon, lat = at["lon_deg"], at["lat_deg"]
    rows = [f"{number},{lon + k * 1e-4:.7f},{lat:.7f}" for k, number in enumerate((3, 4, 700, 5))]
    declared = {
        "crs": "EPSG:4326", "family": "fiducial", "mode": "good", "area_deg": [lon - 1, lat - 1, lon + 1, lat + 1],
        "sign": {"dictionary": "apriltag-36h11", "geometry": {"side_mm": 400.0}},
    }  # fmt: skip
    files = {
        "file": ("signs.csv", "\n".join(["code,lon,lat", *rows]).encode(), "text/csv"),
        "declaration": (None, json.dumps(declared), "application/json"),
    }
    report = client.post("/v1/imports", files=files)
    assert report.status_code == 201, report.text
    assert (report.json()["stored"], report.json()["refused_rows"]) == (3, 1)
    found = client.get("/v1/markers", params={"near": f"{lon},{lat},100"}).json()["items"]
    assert sorted(item["code"]["number"] for item in found) == [3, 4, 5]
    assert {item["geometry"]["quiet_mm"] for item in found} == {50.0}
