"""Uploads over real HTTP into real processes: what is answered, and what is stored."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from app.formats.images import FRAME_FORMATS
from app.formats.packets.read import PACKET_FORMATS
from app.formats.poses import POSE_FORMATS
from app.formats.traces.formats import TRACE_FORMATS
from app.main import create_app
from app.services.access.access import Scope
from app.settings import Settings
from tests.api.decodes.conftest import Stored, near, post_frame
from tests.conftest import ADMIN_KEY, LiveServer
from tests.formats.pictures import corner_frame, huge_png, jpeg, lying_png, png
from tests.jobs import standin

GOOD = png(standin.frame_that(standin.OBEY))


def check_problem(answer: httpx.Response, status: int, slug: str, field: str) -> dict[str, Any]:
    """A problem document that names field, limit or cure."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem: dict[str, Any] = answer.json()
    assert problem["type"] == f"urn:waymark:problem:{slug}"
    assert problem["field"] == field
    assert problem.get("limit") or problem.get("cure")
    return problem


# --- frames -------------------------------------------------------------------------------------------------------


def test_a_frame_is_decoded_matched_and_kept(client: httpx.Client, plate: dict[str, Any], stored: Stored) -> None:
    answer = post_frame(client, GOOD, near(plate, captured_at="2026-05-04T08:30:00Z"))
    assert answer.status_code == 201, answer.text
    decode = answer.json()
    assert answer.headers["location"] == f"/v1/decodes/{decode['id']}"
    assert (decode["state"], decode["kind"], decode["progress"], decode["codebook_plates"]) == ("done", "frame", 1, 1)
    [reading] = decode["readings"]
    assert reading["outcome"] == "read"
    assert reading["digits"] == plate["code"]["digits"]
    assert reading["match"]["registered"] is True
    assert reading["match"]["marker_id"] == plate["id"]
    assert reading["match"]["distance_m"] < 0.01
    assert decode["summary"]["text"] == "1 plate read in 1 frame, 1 of them registered"
    assert decode["frames"][0]["width_px"] == 96
    assert decode["decoder"].startswith("waymark ")

    assert client.get(answer.headers["location"]).json() == decode
    [(what, at, frame)] = stored.rows(
        "SELECT what, at, frame FROM observations WHERE decode_id = :id AND marker_id = :m",
        id=decode["id"],
        m=plate["id"],
    )
    assert (what, at[:19], frame) == ("seen", "2026-05-04 08:30:00", 0)


def test_no_plate_is_a_result(client: httpx.Client, place: Callable[[], dict[str, Any]]) -> None:
    answer = post_frame(client, jpeg(), {"coarse_position": place() | {"accuracy_m": 5.0}})
    assert answer.status_code == 201
    decode = answer.json()
    assert [r["outcome"] for r in decode["readings"]] == ["unsure"]
    assert decode["fix"] is None
    assert decode["summary"]["text"] == "no plate read; 1 candidate refused"


def test_context_may_be_left_out(client: httpx.Client) -> None:
    decode = post_frame(client, GOOD).json()
    assert decode["state"] == "done"
    assert decode["codebook_plates"] == 0
    assert decode["readings"][0]["match"] is None


def test_a_bare_body_with_its_context_in_a_header(client: httpx.Client, plate: dict[str, Any]) -> None:
    headers = {"Content-Type": "image/png", "Waymark-Context": json.dumps(near(plate))}
    answer = client.post("/v1/decodes", content=GOOD, headers=headers)
    assert answer.status_code == 201, answer.text
    assert answer.json()["readings"][0]["match"]["marker_id"] == plate["id"]


def test_the_name_and_the_declared_type_mean_nothing(client: httpx.Client, stored: Stored) -> None:
    before = set(stored.blobs())
    for name in ("../../../../tmp/x.jpg", "/etc/passwd", "frame.mp4", "a" * 300, "ein Bild ü.png"):
        assert post_frame(client, GOOD, name=name).status_code == 201
    new = set(stored.blobs()) - before
    assert len(new) == 5
    assert all(path.read_bytes() == GOOD and len(path.name) == 32 for path in new)


def test_only_the_plates_within_reach_are_the_codebook(client: httpx.Client, plate: dict[str, Any]) -> None:
    context = near(plate)
    context["coarse_position"]["lat_deg"] += 300 / 111_000
    assert post_frame(client, GOOD, context).json()["codebook_plates"] == 0
    context["coarse_position"]["accuracy_m"] = 250.0
    assert post_frame(client, GOOD, context).json()["codebook_plates"] == 1


def test_the_same_bytes_or_their_hash_give_no_other_agency_anything(
    client: httpx.Client, server: LiveServer, plate: dict[str, Any]
) -> None:
    own = post_frame(client, GOOD, near(plate)).json()
    digest = hashlib.sha256(GOOD).hexdigest()
    assert client.get(f"/v1/decodes/{own['id']}").status_code == 200
    with server.agency("agency that guesses hashes") as other:
        for path in (own["id"], f"{own['id']}/annotated.jpg", digest, f"uploads/{digest}"):
            answer = other.get(f"/v1/decodes/{path}")
            assert answer.status_code in (404, 422), (path, answer.text)
        same = post_frame(other, GOOD, near(plate)).json()
        assert same["id"] != own["id"]
        assert (own["codebook_plates"], same["codebook_plates"]) == (1, 0)
        assert other.get(f"/v1/decodes/{own['id']}").status_code == 404
        assert [decode["id"] for decode in other.get("/v1/decodes").json()["items"]] == [same["id"]]


def test_retired_plates_are_no_codebook(client: httpx.Client, plate: dict[str, Any]) -> None:
    client.patch(f"/v1/markers/{plate['id']}", json={"status": "retired"}, headers={"If-Match": "*"})
    assert post_frame(client, GOOD, near(plate)).json()["codebook_plates"] == 0


# --- refusals: a problem that names field and cure, and nothing stored --------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("data", "status", "slug"),
    [
        (b"", 422, "unreadable-upload"),
        (b"no picture at all", 415, "unsupported-upload"),
        (lying_png(), 422, "unreadable-upload"),
        (huge_png(), 413, "too-large"),
        (jpeg()[:-300], 422, "unreadable-upload"),
        (png()[:-30], 422, "unreadable-upload"),
        (jpeg(orientation=2), 415, "unsupported-upload"),
        (jpeg(cmyk=True), 415, "unsupported-upload"),
        (png(corner_frame(20, 20)), 422, "unreadable-upload"),
        (b"ffconcat version 1.0\nfile other.avi", 415, "unsupported-upload"),
        (b"#EXTM3U\nfile:///etc/passwd", 415, "unsupported-upload"),
        (png(standin.frame_that(standin.DIE)), 422, "process-stopped"),
        (png(standin.frame_that(standin.HOG)), 422, "process-stopped"),
    ],
    ids=[
        "empty", "text", "lying-length", "huge", "cut-jpeg", "cut-png", "mirrored", "cmyk", "tiny", "ffconcat", "m3u8",
        "deadly", "hungry",
    ],
)  # fmt: skip
@pytest.mark.usefixtures("unchanged")
def test_bad_files(client: httpx.Client, data: bytes, status: int, slug: str) -> None:
    check_problem(post_frame(client, data), status, slug, "file")


@pytest.mark.usefixtures("unchanged")
def test_a_file_of_no_kind_is_refused_with_all_kinds(client: httpx.Client) -> None:
    for data, looks_like in (
        (b"no picture", "not a JPEG"),
        (b"v=0\no=- 0 0 IN IP4 127.0.0.1", "SDP"),
        (b"GIF89a", "GIF"),
    ):
        problem = check_problem(post_frame(client, data), 415, "unsupported-upload", "file")
        assert looks_like in problem["detail"]
        for found in (*FRAME_FORMATS, *TRACE_FORMATS, *PACKET_FORMATS, *POSE_FORMATS):
            assert found.name in problem["limit"]
        assert "MP4" in problem["limit"]
        assert "ROS 1" in problem["limit"]


@pytest.mark.slow
def test_a_frame_that_takes_too_long_is_refused(tmp_path: Path) -> None:
    """The stand-in would sleep for ten minutes: the time limit of a frame ends it."""
    settings = Settings(data_dir=tmp_path / "var", admin_key=ADMIN_KEY, decode_timeout_s=1.0)
    with LiveServer(create_app(settings, decode=standin.decode)) as server, server.client() as client:
        answer = post_frame(client, png(standin.frame_that(standin.SLEEP)))
        assert check_problem(answer, 422, "process-stopped", "file")["limit"] == "1 s a file"
        assert not any(Stored(tmp_path / "var").counts().values())


@pytest.mark.usefixtures("unchanged")
def test_a_killed_process_disturbs_nobody_else(client: httpx.Client) -> None:
    check_problem(post_frame(client, png(standin.frame_that(standin.DIE))), 422, "process-stopped", "file")


@pytest.mark.slow
@pytest.mark.usefixtures("unchanged")
def test_a_defect_of_ours_is_a_500_and_stores_nothing(client: httpx.Client) -> None:
    answer = post_frame(client, png(standin.frame_that(standin.BUG)))
    assert answer.status_code == 500
    assert "ZeroDivisionError" not in answer.text


COARSE = {"lon_deg": 10.0, "lat_deg": 50.0, "accuracy_m": 10.0}
FOV = {"horizontal_fov_deg": 70.0}


@pytest.mark.parametrize(
    ("context", "status", "field"),
    [
        ('{"heading_deg": NaN}', 400, "context.heading_deg"),
        ('{"heading_deg": 1e999}', 400, "context.heading_deg"),
        ('{"heading_deg": "nan"}', 422, "heading_deg"),
        ('{"heading_deg": 361}', 422, "heading_deg"),
        ('{"heading_deg": 1, "heading_deg": 2}', 400, "heading_deg"),
        ("{", 400, "context"),
        ("[" * 60_000, 400, "context"),
        (b'"\xff\xfe"', 422, "context"),
        ("[]", 422, "context"),
        ('{"color": "red"}', 422, "color"),
        ({"coarse_position": COARSE | {"lat_deg": 91.0}}, 422, "coarse_position.lat_deg"),
        ({"coarse_position": COARSE | {"lon_deg": -180.1}}, 422, "coarse_position.lon_deg"),
        ({"coarse_position": COARSE | {"accuracy_m": 0.0}}, 422, "coarse_position.accuracy_m"),
        ({"coarse_position": COARSE | {"accuracy_m": 30_000.0}}, 422, "coarse_position.accuracy_m"),
        ({"coarse_position": {"lon_deg": 1.0, "lat_deg": 2.0}}, 422, "coarse_position.accuracy_m"),
        ({"captured_at": "2026-05-04T08:30:00"}, 422, "captured_at"),
        ({"thermal_range": [1.0, 2.0]}, 422, "thermal_range"),
        ({"thermal": True, "thermal_range": [2.0, 1.0]}, 422, "thermal_range"),
        ({"camera": {}}, 422, "camera.horizontal_fov_deg"),
        ({"camera": FOV | {"fx_px": 1000.0}}, 422, "camera.fx_px"),
        ({"camera": {"horizontal_fov_deg": 180.0}}, 422, "camera.horizontal_fov_deg"),
        ({"camera": FOV | {"height_m": -1.0}}, 422, "camera.height_m"),
        ({"camera": FOV | {"distortion": [0.1, 0.0, 0.0, 0.0]}}, 422, "camera.distortion"),
        ({"camera": {"fx_px": 1e3, "fy_px": 1e3, "cx_px": 48.0, "cy_px": 32.0}}, 422, "camera.width_px"),
        ({"camera": FOV | {"width_px": 1920, "height_px": 1080}}, 422, "camera.width_px"),
        ({"camera": FOV | {"width_px": 96, "height_px": 60}}, 422, "camera.height_px"),
    ],
)
@pytest.mark.usefixtures("unchanged")
def test_bad_contexts(client: httpx.Client, context: Any, status: int, field: str) -> None:
    answer = post_frame(client, GOOD, context)
    assert answer.status_code == status, answer.text
    assert answer.json()["field"] == field
    assert answer.json()["detail"]


def test_a_camera_is_of_the_upright_frame(client: httpx.Client) -> None:
    frame = np.ascontiguousarray(np.rot90(corner_frame(128, 64)))
    turned = jpeg(frame, orientation=6)
    fits = {"camera": FOV | {"width_px": 128, "height_px": 64}}
    assert post_frame(client, turned, fits).status_code == 201
    check_problem(
        post_frame(client, turned, {"camera": FOV | {"width_px": 64, "height_px": 128}}),
        422, "invalid-parameter", "camera.width_px",
    )  # fmt: skip


@pytest.mark.usefixtures("unchanged")
def test_requests_without_a_file(client: httpx.Client) -> None:
    check_problem(client.post("/v1/decodes", files={"context": (None, "{}")}), 422, "unreadable-upload", "file")
    check_problem(client.post("/v1/decodes", files={"file": (None, "text")}), 422, "unreadable-upload", "file")
    check_problem(client.post("/v1/decodes", json={"a": 1}), 415, "unsupported-upload", "Content-Type")
    check_problem(client.post("/v1/decodes"), 415, "unsupported-upload", "Content-Type")
    check_problem(
        client.post("/v1/decodes", content=GOOD, headers={"Content-Type": "video/mp4"}),
        415, "unsupported-upload", "Content-Type",
    )  # fmt: skip
    two = [("file", ("a.png", GOOD)), ("file", ("b.png", GOOD))]
    check_problem(client.post("/v1/decodes", files=two), 400, "malformed-request", "file")
    stray = {"file": ("a.png", GOOD), "agency": (None, "other")}
    check_problem(client.post("/v1/decodes", files=stray), 400, "malformed-request", "agency")
    assert post_frame(client, GOOD, "[" * 100_000).status_code == 400
    many = [("file", ("a.png", GOOD))] * 5
    assert client.post("/v1/decodes", files=many).status_code == 400
    assert client.post(
        "/v1/decodes", content=b"no form", headers={"Content-Type": "multipart/form-data"}
    ).status_code in (400, 422)


@pytest.mark.usefixtures("unchanged")
def test_33_mebibytes_are_refused(client: httpx.Client) -> None:
    check_problem(post_frame(client, bytes(33 * 1024**2)), 413, "too-large", "body")


@pytest.mark.usefixtures("unchanged")
def test_a_stream_without_a_length_is_stopped_at_the_limit(client: httpx.Client) -> None:
    def parts() -> Any:
        for _ in range(40):
            yield bytes(1024**2)

    try:
        answer = client.post("/v1/decodes", content=parts(), headers={"Content-Type": "image/png"})
    except httpx.WriteError:
        return  # the server hung up while we were still sending
    assert answer.status_code == 413


@pytest.mark.usefixtures("unchanged")
def test_keys_and_scopes(server: LiveServer) -> None:
    with server.client(key=None) as nobody:
        assert post_frame(nobody, GOOD).status_code == 401
    with server.agency("readers", Scope.VIEWER) as reader:
        assert post_frame(reader, GOOD).status_code == 403
        assert reader.get("/v1/decodes").status_code == 200


# --- repeated requests --------------------------------------------------------------------------------------------


def test_an_idempotency_key_decodes_once(client: httpx.Client, plate: dict[str, Any], stored: Stored) -> None:
    key = {"Idempotency-Key": "frame-0001"}
    first = post_frame(client, GOOD, near(plate), **key)
    counts = stored.counts()
    again = post_frame(client, GOOD, near(plate), **key)
    assert again.status_code == 201
    assert again.json() == first.json()
    assert again.headers["idempotency-replayed"] == "true"
    assert stored.counts() == counts
    other = post_frame(client, jpeg(), near(plate), **key)
    check_problem(other, 409, "idempotency-conflict", "Idempotency-Key")
    assert stored.counts() == counts


def test_a_vehicle_that_repeats_another_upload_gets_a_decode_of_its_own(server: LiveServer) -> None:
    key, name = {"Idempotency-Key": "frame-0001"}, "agency of a vehicle"
    with server.agency(name, Scope.ADMIN) as admin, server.agency(name, Scope.VEHICLE) as vehicle:
        first = post_frame(admin, GOOD, **key).json()["id"]
        mine = post_frame(vehicle, GOOD, **key)
        assert mine.status_code == 201
        assert "idempotency-replayed" not in mine.headers
        assert mine.json()["id"] != first
        assert vehicle.get(f"/v1/decodes/{first}").status_code == 404


# --- reading back -------------------------------------------------------------------------------------------------


def test_agencies_never_see_each_other(server: LiveServer, client: httpx.Client, plate: dict[str, Any]) -> None:
    decode = post_frame(client, GOOD, near(plate)).json()
    with server.agency("strangers") as stranger:
        for path in ("", "/annotated.png", "/annotated.jpg"):
            assert stranger.get(f"/v1/decodes/{decode['id']}{path}").status_code == 404
        assert stranger.post(f"/v1/jobs/{decode['id']}/cancel").status_code == 404
        assert stranger.get("/v1/decodes").json() == {"items": []}
        mine = post_frame(stranger, GOOD, near(plate)).json()
        assert mine["codebook_plates"] == 0
        etag = {"If-None-Match": f'"{decode["id"]}-0-png"'}
        assert stranger.get(f"/v1/decodes/{decode['id']}/annotated.png", headers=etag).status_code == 404


def test_pages_are_newest_first(client: httpx.Client) -> None:
    ids = [post_frame(client, GOOD).json()["id"] for _ in range(5)]
    seen, url = [], "/v1/decodes?limit=2&state=done"
    while url:
        answer = client.get(url)
        seen += [item["id"] for item in answer.json()["items"]]
        assert "readings" not in answer.json()["items"][0]
        url = answer.links.get("next", {}).get("url", "")
    assert seen == ids[::-1]
    assert client.get("/v1/decodes?state=failed").json() == {"items": []}
    assert client.get("/v1/decodes?state=lost").status_code == 422
    assert client.get("/v1/decodes?limit=0").status_code == 422


def test_unknown_decodes(client: httpx.Client) -> None:
    missing = "01890000-0000-7000-8000-000000000000"
    check_problem(client.get(f"/v1/decodes/{missing}"), 404, "not-found", "decode_id")
    check_problem(client.get(f"/v1/decodes/{missing}/annotated.png"), 404, "not-found", "decode_id")
    assert client.get("/v1/decodes/..%2F..%2Fetc").status_code in (404, 422)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_the_annotated_picture(client: httpx.Client, suffix: str) -> None:
    decode = post_frame(client, png(corner_frame(320, 240))).json()
    path = f"/v1/decodes/{decode['id']}/annotated.{suffix}"
    answer = client.get(path)
    assert answer.status_code == 200
    assert answer.headers["content-type"] == {"png": "image/png", "jpg": "image/jpeg"}[suffix]
    pixels = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR)
    assert pixels.shape == (240, 320, 3)
    assert (pixels != corner_frame(320, 240)[..., ::-1]).any()
    assert client.get(path, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304
    assert client.get(path + "?frame=1").status_code == 404
    assert client.get(path[:-3] + "gif").status_code in (404, 422)


@pytest.mark.slow
def test_openapi_describes_uploads(client: httpx.Client) -> None:
    document = client.get("/openapi.json").json()
    body = document["paths"]["/v1/decodes"]["post"]["requestBody"]["content"]
    assert set(body) == {
        "multipart/form-data",
        "image/jpeg",
        "image/png",
        "application/zip",
        "application/octet-stream",
        "text/csv",
        "application/vnd.apache.parquet",
        "application/json",
        "application/x-ndjson",
        "text/plain",
    }
    context = body["multipart/form-data"]["schema"]["properties"]["context"]
    name = context["$ref"].removeprefix("#/components/schemas/")
    assert "camera" in document["components"]["schemas"][name]["properties"]
    assert "#/$defs" not in json.dumps(document)
