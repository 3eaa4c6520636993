"""The built guide, made once for the tests of this folder, and a server that shows it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from app.main import create_app
from app.settings import Settings
from tests.conftest import ADMIN_KEY, LiveServer

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that `make docs` writes; a fault in any document fails here, with its place."""
    out = tmp_path_factory.mktemp("guide") / "site"
    command = [sys.executable, "-m", "guide", "--out", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return out


@pytest.fixture(scope="session")
def guide_server(site: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveServer]:
    """A server that shows it at /guide."""
    folder = tmp_path_factory.mktemp("guide-server")
    settings = Settings(data_dir=folder, admin_key=ADMIN_KEY, warm_decoders=False, guide_dir=site)  # type: ignore[arg-type]
    with LiveServer(create_app(settings)) as server:
        yield server
