"""The server starts from the files that `.dockerignore` and `docker/Dockerfile` put into the image."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path

import httpx
import pytest

from app.api.http.connections import MAX_HEADER_BYTES
from app.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
NOT_IN_A_CLONE = {".git", ".venv", "var", "demo-out", "bench-out", "build", "dist", ".hypothesis"}
STARTED = re.compile(r"Uvicorn running on (http://[\d.:]+)")


def ignore_rules() -> list[tuple[bool, list[str]]]:
    """Patterns of `.dockerignore` in order: whether one excludes, and its path in parts."""
    lines = (line.strip() for line in (ROOT / ".dockerignore").read_text().splitlines())
    return [
        (not line.startswith("!"), line.removeprefix("!").strip("/").split("/")) for line in lines if line[:1] != "#"
    ]


def matches(pattern: list[str], path: tuple[str, ...]) -> bool:
    """Whether a pattern is the path; `**` stands for any number of folders."""
    if not pattern:
        return not path
    if pattern[0] == "**":
        return any(matches(pattern[1:], path[k:]) for k in range(len(path) + 1))
    return bool(path) and fnmatchcase(path[0], pattern[0]) and matches(pattern[1:], path[1:])


def is_in_context(path: Path) -> bool:
    """Docker's rule: the last pattern that matches the path or a folder above it decides."""
    parts, included = path.parts, True
    for excludes, pattern in ignore_rules():
        if any(matches(pattern, parts[:k]) for k in range(1, len(parts) + 1)):
            included = not excludes
    return included


def context_files() -> list[Path]:
    """Files that `docker build` sends, relative to the root."""
    found = []
    for folder, folders, names in os.walk(ROOT):
        here = Path(folder).relative_to(ROOT)
        folders[:] = [name for name in folders if here != Path() or name not in NOT_IN_A_CLONE]
        found += [here / name for name in names if is_in_context(here / name)]
    return found


def copies() -> list[tuple[list[str], str]]:
    """Sources and target of each COPY from the context."""
    lines = re.findall(r"^COPY (?!--from)(.+)$", (ROOT / "docker/Dockerfile").read_text(), re.MULTILINE)
    return [(words[:-1], words[-1]) for words in (line.split() for line in lines)]


def assemble(image: Path) -> None:
    """Copy to `image` what the COPY lines copy from the context; a source that is missing there fails the build."""
    context = context_files()
    for sources, target in copies():
        for source in sources:
            files = [path for path in context if path == Path(source) or Path(source) in path.parents]
            assert files, f"COPY {source}: .dockerignore excludes it"
            for path in files:
                below = path.relative_to(source) if path != Path(source) else Path()
                copy = image / (Path(target) / path.name if target.endswith("/") else Path(target) / below)
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(ROOT / path, copy)


@contextmanager
def serving(image: Path, data: Path) -> Iterator[str]:
    """Start `waymark serve` on the assembled files alone; yields its address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    own = {"PYTHONPATH": str(image), "WAYMARK_DATA_DIR": str(data), "WAYMARK_WARM_DECODERS": "false"}
    environment = {name: value for name, value in os.environ.items() if not name.startswith("WAYMARK_")} | own
    command = [sys.executable, "-c", "from app.cli import main; main()", "serve", "--port", port]
    with subprocess.Popen(
        command, cwd=image, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        lines: list[str] = []
        try:
            while not any(STARTED.search(line) for line in lines):
                lines.append(process.stderr.readline())
                assert lines[-1], "".join(lines)  # the server ended
            drain = threading.Thread(target=process.stderr.read)
            drain.start()
            yield f"http://127.0.0.1:{port}"
            process.send_signal(signal.SIGTERM)
            drain.join()
        finally:
            process.kill()


def test_the_image_has_what_the_server_needs(tmp_path: Path) -> None:
    image = tmp_path / "src"
    assemble(image)
    assert not list(image.glob("**/__pycache__"))
    assert {path.name for path in image.iterdir()} >= {"app", "migrations", "static", "pyproject.toml"}
    with serving(image, tmp_path / "var") as url, httpx.Client(base_url=url, trust_env=False) as client:
        assert client.get("/healthz").status_code == 200
        page = client.get("/")
        assert page.status_code == 200
        assert "<title>Waymark</title>" in page.text
        for name in re.findall(r'(?:src|href)="(/static/[^"]+)"', page.text):
            assert client.get(name).content == (image / name.removeprefix("/")).read_bytes()


def test_what_the_build_does_not_need_stays_outside() -> None:
    files = set(context_files())
    assert Path("static/index.html") in files
    for path in ("tests/test_docker.py", "docs/ogc.md", "Makefile", ".gitignore"):
        assert Path(path) not in files


def test_the_proxy_has_the_limits_of_the_server(tmp_path: Path) -> None:
    text = (ROOT / "docker/nginx.conf").read_text()
    settings = Settings()
    for directive, expected in (
        ("client_header_timeout", f"{settings.header_timeout_s:.0f}s"),
        ("client_body_timeout", f"{settings.body_timeout_s:.0f}s"),
        ("send_timeout", f"{settings.body_timeout_s:.0f}s"),
        ("limit_conn addresses", f"{settings.max_connections_per_address}"),
        ("limit_conn all", f"{settings.max_connections}"),
        ("client_max_body_size", f"{settings.max_import_bytes // 1024**2 + 1}m"),
        ("large_client_header_buffers", f"4 {MAX_HEADER_BYTES // 4 // 1024}k"),
    ):
        assert re.search(rf"^ *{directive} {expected};", text, re.MULTILINE), directive
    (tmp_path / "nginx.conf").write_text(text.replace("server waymark:8000", "server 127.0.0.1:8000"))
    if (nginx := shutil.which("nginx", path=f"{os.environ['PATH']}:/usr/sbin")) is None:
        pytest.skip("nginx is not installed")
    command = [nginx, "-t", "-p", str(tmp_path), "-c", "nginx.conf"]
    checked = subprocess.run(command, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
