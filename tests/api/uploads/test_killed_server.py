"""An upload goes on after the server was killed in the middle of a part."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest
from tusclient.client import TusClient

from benchmarks.faults.server import HEADERS, FaultServer
from tests.api.uploads.conftest import TUS, offset_of, zip_of_frames
from tests.http import WITHIN_S

MIB = 1 << 20


@pytest.mark.slow
def test_tuspy_resumes_after_kill_9(tmp_path: Path) -> None:
    data = zip_of_frames(40 * MIB)
    server = FaultServer(tmp_path / "var")
    server.start()
    try:
        tus = TusClient(f"{server.url}/v1/uploads", headers=HEADERS)
        uploader = tus.uploader(
            file_stream=io.BytesIO(data), metadata={"filename": "drive.zip"}, chunk_size=len(data) + 1
        )
        uploader.set_url(uploader.create_url())
        place = urlsplit(uploader.url).path
        thread = threading.Thread(target=_send_slowly, args=(server.url + place, data))
        thread.start()
        with server.client() as client:
            last = time.monotonic() + WITHIN_S
            while offset_of(client, place) == 0:
                assert time.monotonic() < last
                time.sleep(0.01)
        server.kill()
        thread.join()
        server.start()
        with server.client() as client:
            assert 16 * MIB <= offset_of(client, place) < len(data)  # what was durable is there, and no more is claimed
            again = tus.uploader(file_stream=io.BytesIO(data), url=uploader.url, chunk_size=8 * MIB)
            again.upload()
            head = client.head(place, headers=TUS)
            assert head.headers["Upload-Offset"] == str(len(data))
            assert client.get(head.headers["Waymark-Decode"]).json()["kind"] == "archive"
    finally:
        server.stop()


def _send_slowly(url: str, data: bytes) -> None:
    """A part of the whole file, of which the last mebibytes come late: the server is killed before."""

    def blocks() -> Iterator[bytes]:
        yield data[: 20 * MIB]
        for k in range(20, 40):
            time.sleep(0.5)
            yield data[k * MIB : (k + 1) * MIB]

    headers = {**HEADERS, **TUS, "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
    try:
        httpx.patch(url, content=blocks(), headers=headers, trust_env=False, timeout=60)
    except httpx.TransportError:
        return
    raise AssertionError("the server was not killed in the middle")
