"""Artwork and exports as jobs: drawn in decoder processes, stored, streamed, and deleted when they have expired."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.main import create_app
from app.services.access.access import Scope
from app.services.markers import artwork
from app.services.progress import KEPT
from app.settings import Settings
from tests.conftest import ADMIN_KEY, UNLIMITED, LiveServer
from tests.http import created, finished, refused

pytestmark = pytest.mark.both_databases
ASYNC = {"Prefer": "respond-async"}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, new_database_url: Callable[[Path], str]) -> Iterator[LiveServer]:
    """A server with one decoder process that the tests of this module share."""
    folder = tmp_path_factory.mktemp("files") / "var"
    url = new_database_url(folder)
    settings = Settings(
        data_dir=folder, database_url=url, admin_key=ADMIN_KEY, decode_workers=1, warm_decoders=False, **UNLIMITED
    )
    with LiveServer(create_app(settings)) as running:
        yield running


def plates(client: httpx.Client, place: Callable[[], dict[str, Any]], count: int) -> list[str]:
    return [created(client, "/v1/markers", position=place())["id"] for _ in range(count)]


def queued(answer: httpx.Response) -> str:
    assert answer.status_code == 202, answer.text
    job = answer.json()
    assert answer.headers["location"] == f"/v1/jobs/{job['id']}" == job["links"]["self"]
    return str(job["links"]["self"])


@pytest.mark.slow
def test_artwork_of_many_plates_is_a_job(
    client: httpx.Client, server: LiveServer, place: Callable[[], dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(artwork, "IMMEDIATE_PLATES", 1)
    ids = plates(client, place, 2)
    body = {"marker_ids": ids, "formats": ["svg"], "sheet": {"width_mm": 1500, "height_mm": 1500}}
    key = {"Idempotency-Key": "artwork-1"}
    path = queued(client.post("/v1/artwork", json=body, headers=key))
    assert queued(client.post("/v1/artwork", json=body, headers=key)) == path
    job = finished(client, path)
    assert (job["state"], job["done"], job["total"], job["kind"]) == ("done", 2, 2, "artwork"), job
    sent = client.get(job["links"]["result"])
    assert sent.headers["content-type"] == "application/zip"
    assert sent.headers["etag"] == f'"{hashlib.sha256(sent.content).hexdigest()}"'
    assert sent.headers["waymark-proof"].startswith("read-back plates=2 ")
    assert sent.headers["waymark-qr-code"] == 'none; reason="the server has no public address"'
    assert client.get(job["links"]["result"], headers={"If-None-Match": sent.headers["etag"]}).status_code == 304
    with zipfile.ZipFile(io.BytesIO(sent.content)) as archive:
        manifest = json.loads(archive.read("manifest.json"))
        names = set(archive.namelist())
    assert [plate["plate_id"] for plate in manifest["plates"]] == ids
    assert manifest["proved"] is True
    assert manifest["notes"] == ["2 of 2 plates have no QR code: the server has no public address"]
    assert [plate["record_url"] for plate in manifest["plates"]] == [None, None]
    assert {"quality.pdf", "quality.csv", "sheets/sheet-0001.svg"} < names
    # the ZIP that is answered at once has the same files
    monkeypatch.setattr(artwork, "IMMEDIATE_PLATES", 2)
    at_once = client.post("/v1/artwork", json=body)
    assert at_once.status_code == 200
    with zipfile.ZipFile(io.BytesIO(at_once.content)) as archive:
        assert json.loads(archive.read("manifest.json"))["files"] == manifest["files"]
    with server.agency("strangers", Scope.ADMIN) as stranger:
        refused(stranger.get(job["links"]["result"]), 404, "not-found")
    wrong = client.post("/v1/artwork", json={"marker_ids": [ids[0]] * 2}, headers=ASYNC)
    refused(wrong, 422, "invalid-parameter", field="marker_ids")


def test_exports_are_jobs_whose_files_expire(
    client: httpx.Client, server: LiveServer, place: Callable[[], dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    ids = plates(client, place, 3)
    path = queued(client.post("/v1/exports", json={"format": "csv", "family": "plate"}))
    job = finished(client, path)
    assert (job["state"], job["done"], job["total"]) == ("done", 3, 3), job
    sent = client.get(job["links"]["result"])
    assert sent.text == client.get("/v1/exports/csv").text
    assert all(marker_id in sent.text for marker_id in ids)
    box = {"format": "gpkg", "bbox": [-1, -1, 1, 1]}
    empty = finished(client, queued(client.post("/v1/exports", json=box)))
    assert (empty["state"], empty["error"]["field"]) == ("failed", "bbox")
    refused(client.get(f"/v1/jobs/{empty['id']}/result"), 409, "conflict")
    for wrong in ({}, {"format": "csv", "bbox": [5, 5, 4, 4]}, {"format": "csv", "from_m": 3}, {"format": "x"}):
        refused(client.post("/v1/exports", json=wrong), 422)
    files = server.app.state.use_cases.job_files
    key = [key for key in server.app.state.use_cases.unused_blobs._blobs.list_keys() if key.startswith("results/")]
    monkeypatch.setattr(files, "_clock", lambda: datetime.now(UTC) + KEPT - timedelta(hours=1))
    assert files.delete_expired() == 0
    monkeypatch.setattr(files, "_clock", lambda: datetime.now(UTC) + KEPT + timedelta(hours=1))
    assert files.delete_expired() >= 1
    assert files.delete_expired() == 0
    left = list(server.app.state.use_cases.unused_blobs._blobs.list_keys())
    assert key
    assert not set(key) & set(left)
    refused(client.get(job["links"]["result"]), 404, "not-found")


def test_other_jobs_have_no_file(client: httpx.Client) -> None:
    answer = client.post("/v1/imports", files={"file": ("survey.csv", b"lon,lat\n1,2\n")}, headers=ASYNC)
    refused(client.get(f"/v1/jobs/{answer.json()['id']}/result"), 404, "not-found", field="job_id")
