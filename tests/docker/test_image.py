"""The server starts from the files that `.dockerignore` and `docker/Dockerfile` put into the image."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from tempfile import TemporaryDirectory

import httpx
import pytest

from app.api.http.connections import MAX_HEADER_BYTES
from app.settings import Settings
from tests.http import WITHIN_S

ROOT = Path(__file__).resolve().parents[2]
NOT_IN_A_CLONE = {".git", ".venv", "var", "demo-out", "bench-out", "build", "dist", ".hypothesis"}
USER = 10001
KEY = {"Authorization": "Bearer an-admin-key-for-the-image-only"}
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


def copies(stage: str) -> list[tuple[list[str], str]]:
    """Sources and target of each COPY from the context in a stage of the build."""
    text = re.split(rf"^FROM \S+ AS {stage}$", (ROOT / "docker/Dockerfile").read_text(), flags=re.MULTILINE)[1]
    lines = re.findall(r"^COPY (?!--from)(.+)$", text.split("\nFROM ")[0], re.MULTILINE)
    return [(words[:-1], words[-1]) for words in (line.split() for line in lines)]


def assemble(image: Path, *stages: str) -> None:
    """Copy to `image` what the COPY lines copy from the context; a source that is missing there fails the build."""
    context = context_files()
    for sources, target in (copy for stage in stages for copy in copies(stage)):
        for source in sources:
            files = [path for path in context if path == Path(source) or Path(source) in path.parents]
            assert files, f"COPY {source}: .dockerignore excludes it"
            inside = target.lstrip("/")  # of the image, not of this machine
            for path in files:
                below = path.relative_to(source) if path != Path(source) else Path()
                copy = image / (Path(inside) / path.name if target.endswith("/") else Path(inside) / below)
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(ROOT / path, copy)


def as_the_images_user(data: Path) -> list[str]:
    """What a command begins with that runs as the user of the image, who may read all files and write none but its own.

    Only root can become another user. The interpreter of a test may lie in a folder that others cannot read, which the
    capability to read makes up for.
    """
    data.mkdir(parents=True, exist_ok=True)
    setpriv = shutil.which("setpriv")
    if os.geteuid() != 0 or setpriv is None:
        return []
    os.chown(data, USER, USER)
    may = "--inh-caps=-all,+dac_read_search --ambient-caps=-all,+dac_read_search --bounding-set=-all,+dac_read_search"
    return [setpriv, f"--reuid={USER}", f"--regid={USER}", "--clear-groups", *may.split(), "--no-new-privs"]


def files_of(tree: Path) -> dict[str, bytes]:
    return {str(path.relative_to(tree)): path.read_bytes() for path in tree.rglob("*") if path.is_file()}


@contextmanager
def serving(image: Path, data: Path, *, drop: bool = True, **more: str) -> Iterator[str]:
    """Start `waymark serve` on the assembled files alone, as the image's user; yields its address.

    Without `drop` it runs as this user, who may also keep what Python and Numba compile.
    """
    own = {"PYTHONPATH": str(image), "WAYMARK_DATA_DIR": str(data), "WAYMARK_WARM_DECODERS": "false"} | more
    if drop:
        own |= {"PYTHONDONTWRITEBYTECODE": "1", "HOME": str(data), "NUMBA_CACHE_DIR": str(data / "numba")}
    environment = {name: value for name, value in os.environ.items() if not name.startswith("WAYMARK_")} | own
    command = [
        *(as_the_images_user(data) if drop else ()),
        sys.executable,
        "-c",
        "from app.cli import main; main()",
        "serve",
    ]
    command += ["--port", "0"]  # a port that was looked for before may be taken when the server has started
    with subprocess.Popen(
        command, cwd=image, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        lines: list[str] = []
        try:
            while (started := STARTED.search(lines[-1] if lines else "")) is None:
                lines.append(process.stderr.readline())
                assert lines[-1], "".join(lines)  # the server ended
            drain = threading.Thread(target=process.stderr.read)
            drain.start()
            yield started[1]
            process.send_signal(signal.SIGTERM)
            drain.join()
        finally:
            process.kill()


@pytest.fixture
def root() -> Iterator[Path]:
    """A folder that every user can reach, unlike `tmp_path`."""
    with TemporaryDirectory(prefix="waymark-image-") as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


@pytest.mark.slow
def test_the_command_copies_the_compiled_decoders_once(tmp_path: Path) -> None:
    kernels, numba = tmp_path / "kernels", tmp_path / "numba"
    (kernels / "plate").mkdir(parents=True)
    (kernels / "plate/fit.nbi").write_bytes(b"compiled")
    script = (ROOT / "docker/waymark").read_text().replace("/opt/waymark/kernels", str(kernels))
    environment = os.environ | {"NUMBA_CACHE_DIR": str(numba)}
    for stored in (b"compiled", b"compiled later"):
        done = subprocess.run(
            [sys.executable, "-c", script, "--version"], cwd=ROOT, env=environment, check=True, capture_output=True
        )
        assert b"waymark" in done.stdout.lower()
        assert (numba / "plate/fit.nbi").read_bytes() == stored  # what a process wrote since then is kept
        (numba / "plate/fit.nbi").write_bytes(b"compiled later")


@pytest.mark.slow
def test_the_image_has_what_the_server_needs(root: Path) -> None:
    assemble(root, "build")
    image = root / "opt/waymark/src"
    assert (root / "tmp/requirements.txt").is_file()
    assert not list(image.glob("**/__pycache__"))
    assert {path.name for path in image.iterdir()} == {"app", "migrations", "static", "LICENSE"}
    for path in (image, *image.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)  # the image is read-only, also for the owner of these files
    before = files_of(image)
    key = {"WAYMARK_ADMIN_KEY": KEY["Authorization"].removeprefix("Bearer ")}
    with (
        serving(image, root / "var", **key) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=WITHIN_S) as client,
    ):
        assert client.get("/healthz").status_code == 200
        page = client.get("/")
        assert page.status_code == 200
        assert "<title>Waymark</title>" in page.text
        for name in re.findall(r'(?:src|href)="(/static/[^"]+)"', page.text):
            assert client.get(name).content == (image / name.removeprefix("/")).read_bytes()
        created = client.post("/v1/markers", json={"position": {"lon_deg": 8.4, "lat_deg": 49.0}}, headers=KEY)
        assert created.status_code == 201, created.text
    assert files_of(image) == before
    if os.geteuid() == 0:
        assert (root / "var/waymark.sqlite3").stat().st_uid == USER
    for path in (image, *(path for path in image.rglob("*") if path.is_dir())):
        path.chmod(0o755)  # for pytest, which removes it


def test_the_base_is_pinned_and_nothing_is_downloaded_without_a_hash() -> None:
    lines = (ROOT / "docker/Dockerfile").read_text()
    bases = set(re.findall(r"^FROM (\S+)", lines, re.MULTILINE))
    assert bases == {"${PYTHON}", "build"}
    assert re.search(r"^ARG PYTHON=python:3\.11-slim-bookworm@sha256:[0-9a-f]{64}$", lines, re.MULTILINE)
    runs = re.findall(r"^RUN (.+?[^\\])$", lines, re.MULTILINE | re.DOTALL)
    assert len(runs) == 6
    for run in runs:
        assert not re.search(r"\b(apt|apt-get|curl|wget|git)\b", run)
        assert "pip" not in run or "--require-hashes" in run
    pattern = r"^[a-z0-9][^\n]*==[^\n]*(?:\n +[^\n]*)*"
    wanted = re.findall(pattern, (ROOT / "docker/requirements.txt").read_text(), re.M)
    assert len(wanted) > 80
    wanted += re.findall(pattern, (ROOT / "docker/requirements-guide.txt").read_text(), re.M)
    assert len(wanted) > 100
    assert all("--hash=sha256:" in requirement for requirement in wanted)


def test_the_images_requirements_are_those_of_the_tests() -> None:
    def versions(path: str) -> set[str]:
        return set(re.findall(r"^([a-z0-9][\w.-]*==\S+)", (ROOT / path).read_text(), re.MULTILINE))

    assert versions("requirements.txt") <= versions("docker/requirements.txt") <= versions("requirements-dev.txt")
    assert versions("docker/requirements-guide.txt") <= versions("requirements-dev.txt")


def test_what_the_build_does_not_need_stays_outside() -> None:
    files = set(context_files())
    assert Path("static/index.html") in files
    for path in ("tests/docker/test_image.py", "benchmarks/pictures.py", "Makefile", ".gitignore"):
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
