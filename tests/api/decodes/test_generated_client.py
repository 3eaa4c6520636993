"""A client that openapi-python-client generates from the document: no warnings, and it uploads a frame."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from io import BytesIO
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.api.decodes.conftest import near
from tests.conftest import LiveServer
from tests.formats.pictures import png
from tests.jobs import standin

pytestmark = pytest.mark.slow

CONFIG = Path(__file__).parents[3] / "docs" / "openapi-python-client.json"
PACKAGE = "waymark_client"


@pytest.fixture(scope="module")
def generated(server: LiveServer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that holds the package; generating it printed no warning."""
    folder = tmp_path_factory.mktemp("generated")
    (folder / "openapi.json").write_text(json.dumps(server.app.openapi()))
    command = [sys.executable, "-m", "openapi_python_client", "generate", "--path", "openapi.json", "--config", CONFIG]
    done = subprocess.run(
        [*command, "--meta", "none", "--output-path", PACKAGE, "--fail-on-warning"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "WARNING" not in done.stdout + done.stderr
    return folder


def test_the_generated_client_uploads_a_frame(
    generated: Path, server: LiveServer, client: httpx.Client, plate: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(generated))
    package = importlib.import_module(PACKAGE)
    models, types = importlib.import_module(f"{PACKAGE}.models"), importlib.import_module(f"{PACKAGE}.types")
    post_decode = importlib.import_module(f"{PACKAGE}.api.decodes.post_decode")
    get_board = importlib.import_module(f"{PACKAGE}.api.fleet.get_board")
    key = client.headers["Authorization"].removeprefix("Bearer ")
    caller = package.AuthenticatedClient(server.url, token=key, timeout=httpx.Timeout(120), verify_ssl=False)
    frame = types.File(BytesIO(png(standin.frame_that(standin.OBEY))), "frame.png", "image/png")
    body = models.PostDecodeFilesBody(file=frame, context=models.UploadContext.from_dict(near(plate)))

    with caller:
        answer = post_decode.sync_detailed(client=caller, body=body, idempotency_key="one")
        assert answer.status_code == 201
        decode = answer.parsed.to_dict()
        assert decode["state"] == "done"
        assert decode["readings"][0]["match"]["marker_id"] == plate["id"]
        board = get_board.sync_detailed(models.ArtworkFormat.SVG, client=caller)
        assert board.status_code == 200
        assert b"<svg" in board.parsed.payload.read()


def test_a_problem_is_parsed(generated: Path, server: LiveServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(generated))
    package = importlib.import_module(PACKAGE)
    get_road = importlib.import_module(f"{PACKAGE}.api.roads.get_road")
    with package.AuthenticatedClient(server.url, token="wrong", verify_ssl=False) as caller:
        problem = get_road.sync("019cb624-0000-7000-8000-00000000ffff", client=caller)
    assert (problem.status, problem.type_) == (401, "urn:waymark:problem:not-authenticated")
