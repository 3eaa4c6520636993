"""Parts that go to S3 directly, with moto's server in the place of S3."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import boto3
import httpx
import pytest
import sqlalchemy as sa
from moto.server import ThreadedMotoServer

from app.main import create_app
from app.registry.decodes import decodes
from app.settings import Settings
from tests.api.uploads.conftest import TUS, problem_of, zip_of_frames
from tests.conftest import ADMIN_KEY, UNLIMITED, LiveServer
from tests.jobs import standin

BUCKET = "waymark-uploads"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveServer]:
    """A server whose blobs are in S3."""
    s3 = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    s3.start()
    host, port = s3.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {
            "AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_ACCESS_KEY_ID": "k", "AWS_SECRET_ACCESS_KEY": "s",
            "AWS_REGION": "us-east-1", "AWS_DEFAULT_REGION": "us-east-1", "AWS_ALLOW_HTTP": "true",
        }.items():  # fmt: skip
            patch.setenv(name, value)
        boto3.client("s3").create_bucket(Bucket=BUCKET)
        settings = Settings(
            data_dir=tmp_path_factory.mktemp("s3") / "var", blobs_url=f"s3://{BUCKET}/a/b", admin_key=ADMIN_KEY,
            **UNLIMITED,
        )  # fmt: skip
        with LiveServer(create_app(settings, decode=standin.decode)) as running:
            yield running
    s3.stop()


def started(client: httpx.Client, size: int) -> dict[str, object]:
    response = client.post("/v1/uploads", json={"method": "s3-parts", "size": size, "file_name": "drive.zip"})
    assert response.status_code == 201, response.text
    document: dict[str, object] = response.json()
    assert response.headers["Location"] == f"/v1/uploads/{document['id']}"
    return document


@pytest.mark.slow
def test_parts_in_s3_become_a_decode(server: LiveServer, client: httpx.Client) -> None:
    data = zip_of_frames(1000)
    document = started(client, len(data))
    [url] = document["part_urls"]  # type: ignore[misc]
    etag = httpx.put(url, content=data, trust_env=False).headers["ETag"]
    place = f"/v1/uploads/{document['id']}"
    done = client.post(f"{place}/complete", json={"etags": [etag]})
    assert done.status_code == 200, done.text
    assert done.json()["state"] == "done"
    assert client.post(f"{place}/complete", json={"etags": [etag]}).json() == done.json()
    with server.app.state.database.read() as connection:
        row = connection.execute(sa.select(decodes).where(decodes.c.id == done.json()["decode_id"])).one()
    assert row.upload_sha256 == hashlib.sha256(data).hexdigest()


def test_another_size_than_stated_is_refused(client: httpx.Client) -> None:
    document = started(client, 500)
    [url] = document["part_urls"]  # type: ignore[misc]
    etag = httpx.put(url, content=b"x" * 400, trust_env=False).headers["ETag"]
    refused = client.post(f"/v1/uploads/{document['id']}/complete", json={"etags": [etag]})
    assert refused.status_code == 422
    assert client.get(f"/v1/uploads/{document['id']}").json()["state"] == "refused"


def test_an_upload_that_is_given_up_leaves_no_parts(client: httpx.Client) -> None:
    document = started(client, 500)
    assert client.delete(f"/v1/uploads/{document['id']}", headers=TUS).status_code == 204
    left = boto3.client("s3").list_multipart_uploads(Bucket=BUCKET).get("Uploads", [])
    assert left == []


@pytest.mark.slow
def test_a_server_with_a_folder_names_tus(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / "var", admin_key=ADMIN_KEY, warm_decoders=False, **UNLIMITED)
    with LiveServer(create_app(settings, decode=standin.decode)) as local, local.agency("local") as client:
        response = client.post("/v1/uploads", json={"method": "s3-parts", "size": 10})
        assert response.status_code == 422
        assert "Tus-Resumable" in problem_of(response)["cure"]
