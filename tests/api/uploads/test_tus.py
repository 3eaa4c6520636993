"""Resumable uploads by tus 1.0, over HTTP as its clients send it."""

from __future__ import annotations

import base64
import hashlib
import io
import socket
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from urllib.parse import urlsplit

import httpx
import pytest
import sqlalchemy as sa
from tusclient.client import TusClient

from app.formats.format import SpooledFile
from app.registry.decodes import decodes
from app.registry.uploads import stored_bytes, upload_parts, uploads
from app.services.access.access import Scope
from tests.api.uploads.conftest import PART, TUS, append, offset_of, problem_of, start, zip_of_frames
from tests.conftest import LiveServer
from tests.http import WITHIN_S

pytestmark = pytest.mark.both_databases


def wait_until(holds: Callable[[], bool]) -> None:
    """Wait for an event."""
    last = time.monotonic() + WITHIN_S
    while not holds():
        assert time.monotonic() < last
        time.sleep(0.02)


def test_tuspy_uploads_in_parts_and_gets_a_decode(server: LiveServer, client: httpx.Client) -> None:
    data = zip_of_frames(300_000)
    tus = TusClient(f"{server.url}/v1/uploads", headers=dict(client.headers) | {"Content-Length": ""})
    tus.headers.pop("Content-Length")
    uploader = tus.uploader(
        file_stream=io.BytesIO(data),
        chunk_size=100_000,
        metadata={"filename": "drive.zip", "context": '{"heading_deg": 10}'},
    )
    uploader.upload()
    assert uploader.offset == len(data)
    place = urlsplit(uploader.url).path
    head = client.head(place, headers=TUS)
    assert int(head.headers["Upload-Offset"]) == len(data)
    decode = client.get(head.headers["Waymark-Decode"]).json()
    assert decode["kind"] == "archive"
    with server.app.state.database.read() as connection:
        row = connection.execute(sa.select(decodes).where(decodes.c.id == decode["id"])).one()
        assert row.upload_sha256 == hashlib.sha256(data).hexdigest()
        assert row.upload_bytes == len(data)
        assert row.context["heading_deg"] == 10
        parts = connection.execute(sa.select(upload_parts).where(upload_parts.c.upload_id == place[-36:])).all()
        assert parts == []
    with server.app.state.use_cases.decodes._blobs.opened(row.upload_key) as file:
        assert file.read() == data
    document = client.get(place).json()
    assert (document["state"], document["decode_id"]) == ("done", decode["id"])


def test_the_last_part_answers_with_the_decode(client: httpx.Client) -> None:
    data = zip_of_frames()
    place = start(client, len(data)).headers["Location"]
    assert append(client, place, 0, data[:50]).headers["Upload-Offset"] == "50"
    last = append(client, place, 50, data[50:])
    assert last.status_code == 204
    assert last.headers["Location"] == last.headers["Waymark-Decode"]
    assert client.get(last.headers["Location"]).status_code == 200
    again = append(client, place, len(data), b"")
    assert again.status_code == 409


def test_a_part_may_come_with_the_creation(client: httpx.Client) -> None:
    data = zip_of_frames()
    response = client.post("/v1/uploads", content=data, headers={**PART, "Upload-Length": str(len(data))})
    assert response.status_code == 201
    assert response.headers["Upload-Offset"] == str(len(data))
    assert client.get(response.headers["Waymark-Decode"]).json()["kind"] == "archive"


def test_options_name_what_is_spoken(client: httpx.Client) -> None:
    headers = client.options("/v1/uploads").headers
    assert headers["Tus-Version"] == "1.0.0"
    assert set(headers["Tus-Extension"].split(",")) == {
        "creation", "creation-with-upload", "termination", "checksum", "expiration"
    }  # fmt: skip
    assert int(headers["Tus-Max-Size"]) == 4 * 1024**3


@pytest.mark.parametrize(
    ("changed", "status"),
    [
        ({"Tus-Resumable": "0.2.2"}, 412),
        ({"Content-Type": "application/json"}, 415),
        ({"Upload-Offset": "7"}, 409),
        ({"Upload-Offset": "x"}, 400),
        ({"Upload-Checksum": "sha256 " + base64.b64encode(b"0" * 32).decode()}, 460),
        ({"Upload-Checksum": "crc32 AAAA"}, 400),
    ],
)
def test_a_wrong_part_changes_nothing(client: httpx.Client, changed: dict[str, str], status: int) -> None:
    place = start(client, 100).headers["Location"]
    response = append(client, place, 0, b"0123456789", **changed)
    assert response.status_code == status
    assert problem_of(response)["status"] == status
    assert response.headers["Tus-Resumable"] == "1.0.0"
    assert offset_of(client, place) == 0
    assert append(client, place, 0, b"0123456789").status_code == 204


@pytest.mark.parametrize("name", ["sha1", "sha256", "md5"])
def test_a_right_checksum_is_accepted(client: httpx.Client, name: str) -> None:
    place = start(client, 100).headers["Location"]
    digest = base64.b64encode(hashlib.new(name, b"0123456789").digest()).decode()
    assert append(client, place, 0, b"0123456789", **{"Upload-Checksum": f"{name} {digest}"}).status_code == 204
    assert offset_of(client, place) == 10


def test_more_than_the_length_is_refused(client: httpx.Client) -> None:
    place = start(client, 10).headers["Location"]
    assert append(client, place, 0, b"0" * 11).status_code == 413
    unsized = client.patch(place, content=iter([b"0" * 6, b"0" * 6]), headers={**PART, "Upload-Offset": "0"})
    assert unsized.status_code == 413
    assert offset_of(client, place) == 0


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Upload-Length": "10"}, 412),
        (TUS, 400),
        ({**TUS, "Upload-Length": "0"}, 400),
        ({**TUS, "Upload-Length": str(4 * 1024**3 + 1)}, 413),
        ({**TUS, "Upload-Length": "9" * 30}, 400),
        ({**TUS, "Upload-Length": "10", "Upload-Metadata": "filename ***"}, 400),
        ({**TUS, "Upload-Length": "10", "Upload-Metadata": "a YQ==,a YQ=="}, 400),
        ({**TUS, "Upload-Length": "10", "Upload-Metadata": "context " + base64.b64encode(b'{"x": 1}').decode()}, 422),
        ({**TUS, "Upload-Length": "10", "Upload-Metadata": "context " + base64.b64encode(b"{").decode()}, 400),
    ],
)
def test_a_wrong_start_is_refused(client: httpx.Client, headers: dict[str, str], status: int) -> None:
    assert client.post("/v1/uploads", headers=headers).status_code == status


def test_a_file_that_no_decoder_reads_is_refused_by_its_last_part(client: httpx.Client) -> None:
    data = b"PK\x03\x04" + bytes(50)
    place = start(client, len(data)).headers["Location"]
    response = append(client, place, 0, data)
    assert response.status_code == 422
    document = client.get(place).json()
    assert document["state"] == "refused"
    assert document["error"]["kind"] == "UnreadableUpload"
    assert client.delete(place, headers=TUS).status_code == 204


def test_an_interrupted_part_keeps_what_arrived(server: LiveServer, client: httpx.Client) -> None:
    data = zip_of_frames(200_000)
    place = start(client, len(data)).headers["Location"]
    address = urlsplit(server.url)
    with socket.create_connection((address.hostname, address.port)) as raw:
        head = f"PATCH {place} HTTP/1.1\r\nHost: x\r\nAuthorization: {client.headers['Authorization']}\r\n"
        head += f"Tus-Resumable: 1.0.0\r\nUpload-Offset: 0\r\nContent-Type: {PART['Content-Type']}\r\n"
        raw.sendall(f"{head}Content-Length: {len(data)}\r\n\r\n".encode() + data[:150_000])
    wait_until(lambda: offset_of(client, place) > 0)
    arrived = offset_of(client, place)
    assert arrived == 150_000
    wait_until(lambda: append(client, place, arrived, data[arrived:]).status_code == 204)
    assert client.get(place).json()["state"] == "done"


def test_one_of_two_requests_writes(server: LiveServer, client: httpx.Client) -> None:
    place = start(client, 100).headers["Location"]
    address = urlsplit(server.url)
    with socket.create_connection((address.hostname, address.port)) as raw:
        head = f"PATCH {place} HTTP/1.1\r\nHost: x\r\nAuthorization: {client.headers['Authorization']}\r\n"
        head += f"Tus-Resumable: 1.0.0\r\nUpload-Offset: 0\r\nContent-Type: {PART['Content-Type']}\r\n"
        raw.sendall(f"{head}Content-Length: 20\r\n\r\n".encode() + b"0123456789")

        def is_locked() -> bool:
            with server.app.state.database.read() as connection:
                query = sa.select(uploads.c.lock_id).where(uploads.c.id == place[-36:])
                return connection.execute(query).scalar_one() is not None

        wait_until(is_locked)
        second = append(client, place, 0, b"x" * 20)
        assert second.status_code == 423
        assert int(second.headers["Retry-After"]) >= 1
        assert client.delete(place, headers=TUS).status_code == 423
        raw.sendall(b"0123456789")
        assert b" 204 " in raw.recv(4096)
    assert offset_of(client, place) == 20


def test_an_upload_belongs_to_its_agency_and_to_its_vehicle(server: LiveServer, client: httpx.Client) -> None:
    place = start(client, 100).headers["Location"]
    with server.agency("another agency of uploads") as other:
        assert other.get(place).status_code == 404
        assert other.head(place, headers=TUS).status_code == 404
        assert append(other, place, 0, b"x").status_code == 404
        assert other.delete(place, headers=TUS).status_code == 404
    with (
        server.agency("fleet of uploads", Scope.VEHICLE) as one,
        server.agency("fleet of uploads", Scope.VEHICLE) as two,
    ):
        own = start(one, 100).headers["Location"]
        assert offset_of(one, own) == 0
        assert append(two, own, 0, b"x").status_code == 404
    assert offset_of(client, place) == 0


def test_termination_deletes_what_arrived(server: LiveServer, client: httpx.Client) -> None:
    place = start(client, 100).headers["Location"]
    append(client, place, 0, b"0123456789")
    with server.app.state.database.read() as connection:
        key = connection.execute(
            sa.select(upload_parts.c.blob_key).where(upload_parts.c.upload_id == place[-36:])
        ).scalar_one()
    assert client.delete(place, headers=TUS).status_code == 204
    assert client.head(place, headers=TUS).status_code == 404
    assert key not in set(server.app.state.use_cases.decodes._blobs.list_keys())


def test_an_upload_expires(server: LiveServer, client: httpx.Client) -> None:
    place = start(client, 100).headers["Location"]
    assert "GMT" in append(client, place, 0, b"0123456789").headers["Upload-Expires"]
    with server.app.state.database.write() as connection:
        row = sa.update(uploads).where(uploads.c.id == place[-36:])
        connection.execute(row.values(expires_at=datetime.now(UTC) - timedelta(seconds=1)))
    assert append(client, place, 10, b"x").status_code == 410
    server.app.state.use_cases.uploads.tidy()
    assert client.head(place, headers=TUS).status_code == 410
    with server.app.state.database.read() as connection:
        found = connection.execute(sa.select(upload_parts).where(upload_parts.c.upload_id == place[-36:])).all()
    assert found == []


def test_a_complete_upload_is_finished_by_the_next_server(server: LiveServer, client: httpx.Client) -> None:
    """The server was killed after the last part was stored and before the decode was."""
    data = zip_of_frames()
    place = start(client, len(data)).headers["Location"]
    append(client, place, 0, data[:20])
    cases = server.app.state.use_cases.uploads
    caller = server.app.state.use_cases.access.authenticate(client.headers["Authorization"].split()[1])
    grant = cases.begin(caller, place[-36:], 20, None)
    cases.save(grant, SpooledFile.of(data[20:]))
    cases.end(grant)
    assert client.get(place).json()["state"] == "open"
    cases.tidy()
    first = client.get(place).json()
    assert first["state"] == "done"
    with server.app.state.database.write() as connection:  # killed before it was noted that there is a decode
        connection.execute(sa.update(uploads).where(uploads.c.id == place[-36:]).values(state="open", decode_id=None))
        part = {"upload_id": place[-36:], "start": 0, "size": len(data), "sha256": "", "agency_id": caller.agency_id}
        key = connection.execute(sa.select(decodes.c.upload_key).where(decodes.c.id == first["decode_id"])).scalar_one()
        connection.execute(sa.insert(upload_parts), {**part, "blob_key": key})
    cases.tidy()
    assert client.get(place).json()["decode_id"] == first["decode_id"]  # and not a second decode


def test_quotas(serve_uploads: Callable[..., LiveServer]) -> None:
    server = serve_uploads(key_stored_bytes=2000, key_open_uploads=2, max_resumable_bytes=10_000)
    with server.agency("small") as client:
        assert start(client, 10_001).status_code == 413
        refused = start(client, 2001)
        assert refused.status_code == 429
        assert problem_of(refused)["type"].endswith("quota-exceeded")
        assert int(refused.headers["Retry-After"]) > 0
        places = [start(client, 900).headers["Location"] for _ in range(2)]
        assert start(client, 10).status_code == 429
        client.delete(places[0], headers=TUS)
        assert start(client, 1500).status_code == 429  # 900 bytes are promised to the other one
        assert start(client, 1000).status_code == 201
        huge = client.post("/v1/decodes", content=b"x" * 2001, headers={"Content-Type": "application/octet-stream"})
        assert huge.status_code == 429
        data = zip_of_frames()
        sent = [
            client.post("/v1/decodes", content=data, headers={"Content-Type": "application/zip"}) for _ in range(20)
        ]
        statuses = [response.status_code for response in sent]
        fits = 2000 // len(data)
        assert statuses[:fits] == [202] * fits
        assert set(statuses[fits:]) == {429}
    with server.app.state.database.read() as connection:
        stored = sum(connection.execute(sa.select(stored_bytes.c.bytes)).scalars())
        blobs = sum(connection.execute(sa.select(decodes.c.upload_bytes)).scalars())
    assert stored == blobs == fits * len(data)
