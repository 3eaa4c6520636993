"""One server with real decoder processes for all tests of this folder; a stand-in says what they do with a frame."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from app.main import create_app
from app.services.blobs import OWNERS
from app.settings import Settings
from tests.conftest import ADMIN_KEY, LiveServer
from tests.formats.pictures import corner_frame, png
from tests.jobs import standin

Post = Callable[..., httpx.Response]


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The server's data folder."""
    return tmp_path_factory.mktemp("decodes") / "var"


@pytest.fixture(scope="session")
def server(folder: Path) -> Iterator[LiveServer]:
    """A server whose frames go through `standin.decode` in real child processes."""
    settings = Settings(data_dir=folder, admin_key=ADMIN_KEY, decode_timeout_s=120.0, max_archive_frames=20)
    with LiveServer(create_app(settings, decode=standin.decode)) as running:
        yield running


@pytest.fixture(scope="session")
def real_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveServer]:
    """A server with the decoder that is shipped."""
    settings = Settings(data_dir=tmp_path_factory.mktemp("real") / "var", admin_key=ADMIN_KEY, warm_decoders=False)
    with LiveServer(create_app(settings)) as running:
        with running.client() as client:  # the first frame waits for the kernels, which may have to be compiled
            client.timeout = httpx.Timeout(280)
            assert post_frame(client, png(corner_frame())).status_code == 201
        yield running


_REAL_AGENCIES = itertools.count(1)


@pytest.fixture
def real_client(real_server: LiveServer) -> Iterator[httpx.Client]:
    """A client of an agency that only this test uses, on the server with the real decoder."""
    with real_server.agency(f"real agency {next(_REAL_AGENCIES)}") as agency:
        yield agency


def post_frame(
    client: httpx.Client, data: bytes, context: Any = None, *, name: str = "frame.jpg", **headers: str
) -> httpx.Response:
    """Upload a file with its context as a form."""
    parts: dict[str, Any] = {"file": (name, data, "application/octet-stream")}
    if context is not None:
        text = context if isinstance(context, str | bytes) else json.dumps(context)
        parts["context"] = (None, text, "application/json")
    return client.post("/v1/decodes", files=parts, headers=headers)


class Stored:
    """What the server has on disk."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._engine = sa.create_engine(f"sqlite:///{folder / 'waymark.sqlite3'}", poolclass=sa.NullPool)

    def counts(self) -> dict[str, int]:
        """Rows and blobs."""
        with self._engine.connect() as connection:
            rows = {
                table: connection.execute(sa.text(f"SELECT count(*) FROM {table}")).scalar_one()
                for table in ("decodes", "observations", "idempotency_keys")
            }
        return rows | {"blobs": len(self.blobs())}

    def blobs(self) -> list[Path]:
        """Files of the blob store."""
        found = (path for path in (self._folder / "blobs").rglob("*") if path.is_file())
        return [path for path in found if OWNERS not in path.parts]  # its marks belong to no upload

    def rows(self, query: str, **values: Any) -> list[Any]:
        """Rows of a query."""
        with self._engine.connect() as connection:
            return list(connection.execute(sa.text(query), values))


@pytest.fixture
def stored(server: LiveServer, folder: Path) -> Stored:
    """What the server has on disk."""
    return Stored(folder)


@pytest.fixture
def unchanged(stored: Stored) -> Iterator[None]:
    """Fail if the test leaves a row or a blob."""
    before = stored.counts()
    yield
    assert stored.counts() == before


@pytest.fixture
def plate(client: httpx.Client, place: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """A surveyed plate of the test's agency."""
    position = place() | {"height_m": 5.0, "horizontal_rmse_m": 0.01, "vertical_rmse_m": 0.02}
    answer = client.post("/v1/markers", json={"position": position, "heading_deg": 30.0, "status": "surveyed"})
    assert answer.status_code == 201, answer.text
    document: dict[str, Any] = answer.json()
    return document


def near(plate: dict[str, Any], accuracy_m: float = 20.0, **more: Any) -> dict[str, Any]:
    """Context of a vehicle beside a plate."""
    position = plate["position"]
    coarse = {"lon_deg": position["lon_deg"], "lat_deg": position["lat_deg"], "accuracy_m": accuracy_m}
    return {"coarse_position": coarse, **more}
