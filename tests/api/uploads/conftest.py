"""Files and requests that tests of uploads share."""

from __future__ import annotations

import base64
import io
import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest
from PIL import Image

from app.main import create_app
from app.settings import Settings
from tests.conftest import ADMIN_KEY, UNLIMITED, LiveServer
from tests.jobs import standin

TUS = {"Tus-Resumable": "1.0.0"}
PART = {**TUS, "Content-Type": "application/offset+octet-stream"}


def zip_of_frames(padding_bytes: int = 0) -> bytes:
    """A ZIP with one frame, and an entry of noise that makes it as long as a test needs."""
    frame = io.BytesIO()
    Image.fromarray(standin.frame_that(standin.OBEY)).save(frame, "PNG")
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("a.png", frame.getvalue())
        if padding_bytes:
            archive.writestr("b.bin", b"x" * padding_bytes)
    return packed.getvalue()


def start(client: httpx.Client, length: int, metadata: dict[str, str] | None = None) -> httpx.Response:
    """Start an upload."""
    pairs = ",".join(f"{k} {base64.b64encode(v.encode()).decode()}" for k, v in (metadata or {}).items())
    return client.post("/v1/uploads", headers={**TUS, "Upload-Length": str(length), "Upload-Metadata": pairs})


def append(client: httpx.Client, place: str, offset: int, data: bytes, **headers: str) -> httpx.Response:
    """Send a part."""
    return client.patch(place, content=data, headers={**PART, "Upload-Offset": str(offset), **headers})


def offset_of(client: httpx.Client, place: str) -> int:
    """How far an upload is."""
    response = client.head(place, headers=TUS)
    assert response.status_code == 200, response.headers
    return int(response.headers["Upload-Offset"])


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, new_database_url: Callable[[Path], str]) -> Iterator[LiveServer]:
    """A server whose frames go through `standin.decode`; the tests of a module share it."""
    folder = tmp_path_factory.mktemp("uploads") / "var"
    settings = Settings(data_dir=folder, database_url=new_database_url(folder), admin_key=ADMIN_KEY, **UNLIMITED)
    with LiveServer(create_app(settings, decode=standin.decode)) as running:
        yield running


@pytest.fixture
def serve_uploads(settings: Settings) -> Iterator[Callable[..., LiveServer]]:
    """Start a server with other settings."""
    with ExitStack() as stack:
        yield lambda **changed: stack.enter_context(
            LiveServer(create_app(settings.model_copy(update=changed), decode=standin.decode))
        )


def problem_of(response: httpx.Response) -> dict[str, Any]:
    """The problem document of a response."""
    assert response.headers["content-type"] == "application/problem+json", response.text
    document: dict[str, Any] = response.json()
    return document
