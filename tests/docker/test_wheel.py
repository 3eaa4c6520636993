"""The wheel has one package at the top, and what it installs runs outside the checkout."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import httpx
import pytest

from app import __version__
from tests.docker.image_build import context_files
from tests.docker.test_image import STARTED
from tests.http import WITHIN_S, wait_until

ROOT = Path(__file__).resolve().parents[2]
KEY = "an-admin-key-for-the-wheel-only"
SOURCES = ("pyproject.toml", "setup.py", "README.md", "LICENSE", "app", "migrations", "static")


def build_wheel(folder: Path) -> Path:
    """Build the wheel from a copy of the sources, without a network; the checkout's own `build/` takes no part."""
    for path in context_files():
        if path.parts[0] in SOURCES:
            (folder / "source" / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / path, folder / "source" / path)
    options = ["--no-index", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder)]
    command = [sys.executable, "-m", "pip", "wheel", *options, str(folder / "source")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = folder.glob("*.whl")
    return wheel


def install(wheel: Path, folder: Path) -> Path:
    """Install a wheel into a new environment, which finds the dependencies in that of the tests; its programs."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    packages = Path(sysconfig.get_path("purelib", "venv", vars={"base": str(folder), "platbase": str(folder)}))
    options = ["--no-index", "--no-deps", "--ignore-installed", "--prefix", str(folder)]
    pip = [sys.executable, "-m", "pip", "--python", str(folder / "bin/python"), "install", *options, str(wheel)]
    done = subprocess.run(pip, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (packages / "of_the_tests.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return folder / "bin"


@pytest.mark.slow
@pytest.mark.timeout(3600)  # a loaded machine compiles the decoders for minutes
def test_the_wheel_runs_in_an_empty_folder(tmp_path: Path) -> None:
    wheel = build_wheel(tmp_path)
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert wheel.name.startswith(f"waymark_roads-{__version__}-")
    assert {name.split("/")[0] for name in names} == {"app", f"waymark_roads-{__version__}.dist-info"}
    assert {"app/py.typed", "app/migrations/env.py", "app/static/index.html"} <= set(names)
    assert {str(path) for path in context_files() if path.parts[0] == "app"} <= set(names)
    for folder in ("static", "migrations"):
        assert {f"app/{path}" for path in context_files() if path.parts[0] == folder} <= set(names)
    programs, empty = install(wheel, tmp_path / "environment"), tmp_path / "empty"
    empty.mkdir()
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("WAYMARK_", "PYTHON"))}
    environment = kept | {"PATH": str(programs), "WAYMARK_ADMIN_KEY": KEY, "WAYMARK_WARM_DECODERS": "false"}
    asked = "import app, app.registry.database as d; print(app.__file__, d.MIGRATIONS)"
    python = [str(programs / "python"), "-c", asked]
    found = subprocess.run(python, cwd=empty, env=environment, capture_output=True, text=True, check=True).stdout
    assert [Path(path).is_relative_to(tmp_path) for path in found.split()] == [True, True], found
    subprocess.run([str(programs / "waymark"), "migrate"], cwd=empty, env=environment, check=True, capture_output=True)
    log = tmp_path / "log"
    command = [str(programs / "waymark"), "serve", "--port", "0"]
    with log.open("wb") as out, subprocess.Popen(command, cwd=empty, env=environment, stderr=out, stdout=out) as server:
        try:
            match = wait_until(lambda: STARTED.search(log.read_text()), "the server")
            with httpx.Client(base_url=match[1], headers={"X-API-Key": KEY}, trust_env=False, timeout=1800) as client:
                page = client.get("/").text
                for name in re.findall(r'(?:src|href)="(/static/[^"]+)"', page):
                    assert client.get(name).content == (ROOT / name.removeprefix("/")).read_bytes()
                context = json.loads((ROOT / "docs/images/frame.json").read_text())
                parts = {"file": ("frame.jpg", (ROOT / "docs/images/frame.jpg").read_bytes())}
                answer = client.post("/v1/decodes", files=parts, data={"context": json.dumps(context)})
                assert answer.status_code == 201, answer.text
                assert answer.json()["readings"]
            server.send_signal(signal.SIGTERM)
            server.wait(WITHIN_S)
        finally:
            server.kill()
