"""Artwork over HTTP: drawn, read back by the shipped decoder, and only then handed out."""

from __future__ import annotations

import hashlib
import io
import json
import struct
import xml.etree.ElementTree as ET
import zipfile
from typing import Any

import httpx
import pytest

from app.services.markers.artwork import MAX_PLATES
from tests.conftest import LiveServer, Place


def register(client: httpx.Client, position: dict[str, Any], **more: Any) -> dict[str, Any]:
    answer = client.post("/v1/markers", json={"position": position, **more})
    assert answer.status_code == 201, answer.text
    document: dict[str, Any] = answer.json()
    return document


@pytest.fixture
def marker(real_client: httpx.Client, place: Place) -> dict[str, Any]:
    return register(real_client, place())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "media_type", "magic"),
    [
        ("svg", "image/svg+xml", b"<?xml"),
        ("pdf", "application/pdf", b"%PDF-"),
        ("dxf", "image/vnd.dxf", b"  0"),
        ("png", "image/png", b"\x89PNG"),
    ],
)
def test_one_plate(real_client: httpx.Client, marker: dict[str, Any], form: str, media_type: str, magic: bytes) -> None:
    answer = real_client.get(f"/v1/markers/{marker['id']}/artwork.{form}")
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"].startswith(media_type)
    assert answer.content.startswith(magic)
    proof = answer.headers["waymark-proof"]
    assert proof.startswith(f"read-back digits={marker['code']['digits']} ")
    assert float(proof.rpartition("=")[2]) > 0.99
    assert f"{marker['id']}-r1.{form}" in answer.headers["content-disposition"]


@pytest.mark.parametrize("scheme", ["position-check", "id"])
@pytest.mark.parametrize("n", [8, 10])
def test_every_scheme_proves_itself(real_client: httpx.Client, place: Place, scheme: str, n: int) -> None:
    marker = register(real_client, place(), code={"scheme": scheme}, geometry={"n": n})
    answer = real_client.get(f"/v1/markers/{marker['id']}/artwork.svg")
    assert answer.status_code == 200, answer.text
    assert f"digits={marker['code']['digits']}" in answer.headers["waymark-proof"]


def test_true_size(real_client: httpx.Client, marker: dict[str, Any]) -> None:
    answer = real_client.get(f"/v1/markers/{marker['id']}/artwork.svg")
    assert answer.headers["x-content-type-options"] == "nosniff"
    policy = {part.strip() for part in answer.headers["content-security-policy"].split(";")}
    assert {"sandbox", "default-src 'none'", "style-src 'unsafe-inline'"} <= policy  # opened by itself, it runs nothing
    svg = ET.fromstring(answer.content)
    assert svg.get("width", "").endswith("mm")
    png = real_client.get(f"/v1/markers/{marker['id']}/artwork.png?resolution_dpi=100").content
    at = png.index(b"pHYs")
    assert struct.unpack(">II", png[at + 4 : at + 12]) == (3937, 3937)


def test_options_change_the_drawing_and_its_etag(real_client: httpx.Client, marker: dict[str, Any]) -> None:
    path = f"/v1/markers/{marker['id']}/artwork.svg"
    plain, heated = real_client.get(path), real_client.get(path + "?heaters=true&leds=true")
    assert len(heated.content) > len(plain.content)
    assert plain.headers["etag"] != heated.headers["etag"]
    again = real_client.get(path, headers={"If-None-Match": plain.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    real_client.patch(f"/v1/markers/{marker['id']}", json={"road": "M1"}, headers={"If-Match": "*"})
    changed = real_client.get(path, headers={"If-None-Match": plain.headers["etag"]})
    assert changed.status_code == 200
    assert "-r2.svg" in changed.headers["content-disposition"]


@pytest.mark.parametrize("query", ["resolution_dpi=10", "resolution_dpi=nan", "resolution_dpi=1e9", "heaters=maybe"])
def test_bad_options(real_client: httpx.Client, marker: dict[str, Any], query: str) -> None:
    answer = real_client.get(f"/v1/markers/{marker['id']}/artwork.png?{query}")
    assert answer.status_code == 422
    assert answer.json()["field"] == query.partition("=")[0]


def test_other_agencies_and_other_formats(
    real_server: LiveServer, real_client: httpx.Client, marker: dict[str, Any]
) -> None:
    path = f"/v1/markers/{marker['id']}/artwork"
    with real_server.agency("artwork strangers") as stranger:
        assert stranger.get(f"{path}.svg").status_code == 404
        assert stranger.post("/v1/artwork", json={"marker_ids": [marker["id"]]}).status_code == 404
    assert real_client.get(f"{path}.eps").status_code in (404, 422)
    with real_server.client(key=None) as nobody:
        assert nobody.get(f"{path}.svg").status_code == 401
        assert nobody.post("/v1/artwork", json={}).status_code == 401


@pytest.mark.slow
def test_artwork_that_does_not_read_back_is_not_handed_out(client: httpx.Client, plate: dict[str, Any]) -> None:
    """This server's decoder is the stand-in, which reads nothing."""
    answer = client.get(f"/v1/markers/{plate['id']}/artwork.svg")
    assert answer.status_code == 500
    assert answer.json()["type"] == "urn:waymark:problem:proof-failed"
    assert client.post("/v1/artwork", json={"marker_ids": [plate["id"]]}).status_code == 500


# --- selections ---------------------------------------------------------------------------------------------------


def unpack(answer: httpx.Response) -> tuple[zipfile.ZipFile, dict[str, Any]]:
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/zip"
    assert int(answer.headers["content-length"]) == len(answer.content)
    archive = zipfile.ZipFile(io.BytesIO(answer.content))
    assert archive.testzip() is None
    return archive, json.loads(archive.read("manifest.json"))


def test_a_selection_by_id(real_client: httpx.Client, place: Place) -> None:
    markers = [register(real_client, place()) for _ in range(3)]
    wanted = [markers[2]["id"], markers[0]["id"]]
    answer = real_client.post(
        "/v1/artwork",
        json={
            "marker_ids": wanted,
            "formats": ["pdf", "svg", "dxf"],
            "sheet": {"width_mm": 1000.0, "height_mm": 1000.0},
        },
    )
    archive, manifest = unpack(answer)
    assert [entry["plate_id"] for entry in manifest["plates"]] == wanted
    assert manifest["proved"] is True
    assert [entry["proof"]["read_back"] for entry in manifest["plates"]] == [
        markers[2]["code"]["digits"],
        markers[0]["code"]["digits"],
    ]
    proof = answer.headers["waymark-proof"]
    assert proof.startswith("read-back plates=2 ")
    assert float(proof.rpartition("=")[2]) > 0.99
    for entry in manifest["files"]:
        assert hashlib.sha256(archive.read(entry["name"])).hexdigest() == entry["sha256"]
    assert {"sheets/sheet-0001.pdf", "quality.csv"} <= set(archive.namelist())


def test_a_selection_by_filter_and_approximate_positions(real_client: httpx.Client, place: Place) -> None:
    here = place()
    frame = {"realization": "ITRF2014", "epoch": 2026.4, "horizontal_rmse_m": 0.02}
    inside = register(real_client, here | frame, status="surveyed")
    register(real_client, here | {"lat_deg": here["lat_deg"] + 0.001}, status="planned")
    register(real_client, place(), status="surveyed")
    bbox = [here["lon_deg"] - 0.01, here["lat_deg"] - 0.01, here["lon_deg"] + 0.01, here["lat_deg"] + 0.01]
    answer = real_client.post("/v1/artwork", json={"bbox": bbox, "status": "surveyed", "formats": ["svg"]})
    assert [entry["plate_id"] for entry in unpack(answer)[1]["plates"]] == [inside["id"]]
    assert "waymark-note" not in answer.headers

    vague = register(real_client, {"lon_deg": -84.55, "lat_deg": 42.73, "crs": "EPSG:4267"})
    assert vague["position"]["localization_grade"] == "unfit"
    answer = real_client.post("/v1/artwork", json={"marker_ids": [vague["id"]], "formats": ["svg"]})
    [entry] = unpack(answer)[1]["plates"]
    assert "not for localization" in entry["crs"]
    assert answer.headers["waymark-note"] == "1 of 1 plates have a position that is not for localization"


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({}, "marker_ids"),
        ({"marker_ids": []}, "marker_ids"),
        ({"marker_ids": ["x"]}, "marker_ids.0"),
        ({"status": "built"}, "marker_ids"),
        ({"status": "lost"}, "status"),
        ({"bbox": [0.0, 1.0, 0.0, 0.0]}, "bbox"),
        ({"bbox": [0.0, 0.0, 181.0, 1.0]}, "bbox.lon_deg"),
        ({"bbox": [0.0, 0.0, 1.0]}, "bbox"),
        ({"status": "built", "formats": []}, "formats"),
        ({"status": "built", "formats": ["eps"]}, "formats.0"),
        ({"status": "planned", "sheet": {"width_mm": 100.0, "height_mm": 100.0}}, "sheet.width_mm"),
        ({"status": "planned", "colour": "red"}, "colour"),
    ],
)
def test_bad_selections(real_client: httpx.Client, marker: dict[str, Any], body: dict[str, Any], field: str) -> None:
    answer = real_client.post("/v1/artwork", json=body)
    assert answer.status_code == 422, answer.text
    assert answer.json()["field"] == field


def test_too_many_plates_name_the_limit(real_client: httpx.Client, marker: dict[str, Any]) -> None:
    ids = [f"01890000-0000-7000-8000-{k:012x}" for k in range(MAX_PLATES + 1)]
    answer = real_client.post("/v1/artwork", json={"marker_ids": ids})
    assert answer.status_code == 422
    assert answer.json()["limit"] == f"{MAX_PLATES} plates at once"
    twice = real_client.post("/v1/artwork", json={"marker_ids": [marker["id"]] * 2})
    assert twice.status_code == 422
