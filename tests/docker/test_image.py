"""The wheel, and the image built as docker/Dockerfile does: it serves as its user and decodes every kind of upload."""

from __future__ import annotations

import io
import json
import os
import re
import runpy
import secrets
import shutil
import signal
import subprocess
import sys
import threading
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import av
import cv2
import httpx
import pytest
import sqlalchemy as sa

from app import __version__
from app.api.http.connections import MAX_HEADER_BYTES
from app.formats.traces.declaration import TraceDeclaration
from app.formats.traces.read import read_trace
from app.sensors.magnetometer_bar import MagnetTrace
from app.settings import Settings
from app.simulation.magnetic.recorder import write_array_stream
from tests.brokers import find_broker, own_queues
from tests.databases import PostgresServer
from tests.docker.image_build import build_image, command_of, context_files, settings_of
from tests.formats.traces.recordings import zipped
from tests.formats.traces.test_can import log as can_log
from tests.formats.traces.test_tables import parquet
from tests.http import WITHIN_S, finished, wait_until
from tests.machine import require_tool

ROOT = Path(__file__).resolve().parents[2]
USER = 10001
KEY = "an-admin-key-for-the-image-only"
VIDEO_FRAMES = 60
STARTED = re.compile(r"Uvicorn running on (http://[\d.:]+)")


def can_mount() -> bool:
    """Whether this user may mount file systems that only a process and its children see."""
    unshare = shutil.which("unshare")
    return (
        unshare is not None
        and os.geteuid() == 0
        and subprocess.run([unshare, "--mount", "true"], check=False).returncode == 0
    )


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


@pytest.mark.slow
def test_the_command_copies_the_compiled_decoders_once(tmp_path: Path) -> None:
    kernels, numba = tmp_path / "kernels", tmp_path / "numba"
    (kernels / "plate").mkdir(parents=True)
    (kernels / "plate/fit.nbi").write_bytes(b"compiled")
    script = (ROOT / "docker/waymark").read_text().replace("sys.prefix", repr(str(tmp_path)))
    environment = os.environ | {"NUMBA_CACHE_DIR": str(numba)}
    for stored in (b"compiled", b"compiled later"):
        done = subprocess.run(
            [sys.executable, "-c", script, "--version"], cwd=ROOT, env=environment, check=True, capture_output=True
        )
        assert b"waymark" in done.stdout.lower()
        assert (numba / "plate/fit.nbi").read_bytes() == stored  # what a process wrote since then is kept
        (numba / "plate/fit.nbi").write_bytes(b"compiled later")


def test_a_process_of_the_image_does_not_start_the_command_again() -> None:
    """Python runs the script once more in every decoder process, under another name."""
    runpy.run_path(str(ROOT / "docker/waymark"), run_name="__mp_main__")


# --- the image, built -----------------------------------------------------------------------------------------------


def recording() -> MagnetTrace:
    """The trace of the drive in docs/images."""
    with zipfile.ZipFile(ROOT / "docs/images/drive.zip") as archive:
        return read_trace({name: archive.read(name) for name in archive.namelist()}, TraceDeclaration()).trace


def uploads(folder: Path) -> Iterator[tuple[str, bytes, dict[str, Any]]]:
    """Name, content and context of a file of each kind."""
    pictures = ROOT / "docs/images"
    place = json.loads((pictures / "frame.json").read_text())
    yield "frame.jpg", (pictures / "frame.jpg").read_bytes(), place
    picture = cv2.resize(cv2.imread(str(pictures / "frame.jpg")), (960, 540))
    film, camera = io.BytesIO(), place["camera"] | {"width_px": 960, "height_px": 540}
    with av.open(film, "w", format="mp4") as container:
        stream: Any = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 960, 540, "yuv420p", 20_000_000
        for _ in range(VIDEO_FRAMES):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode(None))
    yield "drive.mp4", film.getvalue(), place | {"camera": camera}
    near = {"coarse_position": {"lon_deg": 8.417, "lat_deg": 49.006, "accuracy_m": 50}}
    near |= {"captured_at": "2026-06-01T08:00:00Z"}
    yield "drive.zip", (pictures / "drive.zip").read_bytes(), near | {"trace": {}}
    yield "packets.csv", (pictures / "packets.csv").read_bytes(), {"packets": {"accept_clear": True}}
    trace = recording()
    straight = replace(trace, heading_t_s=trace.speed_t_s, heading_deg=0.0 * trace.speed_t_s)  # the log has headings
    files = {"array.bin": write_array_stream(trace), "drive.log": can_log(straight, "log", folder)}
    speed = {"arbitration_id": 0x36A, "start_bit": 23, "length": 12, "byte_order": "big", "factor": 1 / 64}
    can = {"speed": speed | {"unit": "km/h", "maximum": 300}, "offset_s": 0.0}
    yield "can.zip", zipped(files), near | {"trace": {"can": can}}
    yield "drive.parquet", parquet(trace), near | {"trace": {"unit": "uT", "axes": "ISO8855"}}


def found_in(name: str, decode: dict[str, Any]) -> int:
    """Number of tags, of points of a lane, of frames decoded of a video, or of plates in a frame."""
    if "lane" in decode:
        return len(decode["lane"]["stations"]["confidence"])
    return len(decode["frames" if name.endswith(".mp4") else "tags" if "tags" in decode else "readings"])


@contextmanager
def running(image: Path, log: Path, *arguments: str, **more: str) -> Iterator[subprocess.Popen[bytes]]:
    """The image's own program with its own environment, as its user and with a root that is read-only where possible.

    Only root can become another user and mount; another user runs it as itself, on files without the right to write.
    """
    data, temporary = image / "var/lib/waymark", image / "tmp"
    environment = {n: v for n, v in os.environ.items() if not n.startswith(("WAYMARK_", "PYTHON", "NUMBA_"))}
    environment |= settings_of(image) | {"HOME": str(data), "TMPDIR": str(temporary)} | more
    command = [*as_the_images_user(data), command_of(image)[0], *arguments]
    if os.geteuid() == 0:
        os.chown(temporary, USER, USER)
    if can_mount():
        mounts = [f"mount --bind {folder} {folder}" for folder in (data, temporary)]
        script = " && ".join(["mount --make-rprivate /", *mounts, "mount -o remount,bind,ro /", 'exec "$@"'])
        command = ["unshare", "--mount", "sh", "-c", script, "sh", *command]
    with log.open("wb") as out, subprocess.Popen(command, cwd="/", env=environment, stdout=out, stderr=out) as process:
        try:
            yield process
            assert process.poll() is None, log.read_text()[-5000:]
            process.send_signal(signal.SIGTERM)
            process.wait(WITHIN_S)
        finally:
            process.kill()


@pytest.fixture(scope="module")
def image() -> Iterator[Path]:
    """The image, in a folder that every user can reach, unlike those of pytest."""
    with TemporaryDirectory(prefix="waymark-image-") as folder:
        Path(folder).chmod(0o755)
        built = build_image(Path(folder))
        code = [path for path in (built / "opt/waymark/lib").rglob("*") if not path.is_symlink()]
        for path in code:  # as the user of the image finds it, also where the tests run without root
            path.chmod(path.stat().st_mode & ~0o222)
        yield built
        for path in code:
            if path.is_dir():
                path.chmod(0o755)


def started(process: subprocess.Popen[bytes], log: Path) -> str:
    """Address of a server, as soon as its log has it."""

    def address() -> str | None:
        assert process.poll() is None, log.read_text()[-5000:]
        found = STARTED.search(log.read_text())
        return found[1] if found else None

    return wait_until(address, "the server", 2 * WITHIN_S)


def decode_all(client: httpx.Client, folder: Path, **headers: str) -> dict[str, int]:
    """Upload a file of each kind; what was found in each."""
    found = {}
    for name, content, context in uploads(folder):
        parts = {"file": (name, content), "context": (None, json.dumps(context), "application/json")}
        answer = client.post("/v1/decodes", files=parts, headers=headers)
        assert answer.status_code in (201, 202), f"{name}: {answer.text}"
        decode = answer.json()
        if answer.status_code == 202:
            decode = finished(client, answer.headers["location"])
            assert decode["state"] == "done", f"{name}: {decode}"
        found[name] = found_in(name, decode)
    return found


@pytest.mark.slow
@pytest.mark.timeout(3600)  # a loaded machine compiles the decoders for minutes
def test_the_wheel_has_one_package_at_the_top_with_all_its_files(image: Path, tmp_path: Path) -> None:
    (wheel,) = (image.parent / "wheel/opt/build/wheels").glob("*.whl")
    assert wheel.name.startswith(f"waymark_roads-{__version__}-")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert {name.split("/")[0] for name in names} == {"app", f"waymark_roads-{__version__}.dist-info"}
    assert {"app/py.typed", "app/migrations/env.py", "app/static/index.html"} <= set(names)
    assert {str(path) for path in context_files() if path.parts[0] == "app"} <= set(names)
    for folder in ("static", "migrations"):
        assert {f"app/{path}" for path in context_files() if path.parts[0] == folder} <= set(names)
    asked = "import app, app.registry.database as d; print(app.__file__, d.MIGRATIONS)"
    python = [str(image / "opt/waymark/bin/python"), "-c", asked]
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("WAYMARK_", "PYTHON"))}
    found = subprocess.run(python, cwd=tmp_path, env=kept, capture_output=True, text=True, check=True).stdout
    assert [Path(path).is_relative_to(image) for path in found.split()] == [True, True], found


@pytest.mark.slow
@pytest.mark.timeout(3600)  # a loaded machine compiles the decoders for minutes
def test_the_server_of_the_image_decodes_every_kind_of_upload(image: Path, tmp_path: Path) -> None:
    pip = [str(image / "opt/waymark/bin/python"), "-m", "pip", "show", "waymark-roads"]
    assert f"Version: {__version__}" in subprocess.run(pip, capture_output=True, text=True, check=True).stdout
    kernels = {path.name.split("-")[0] for path in (image / "opt/waymark/kernels").rglob("*.nbi")}
    assert kernels == declared_kernels(), "`waymark compile` does not compile all kernels"
    before = {path: path.lstat().st_mtime_ns for path in (image / "opt").rglob("*")}
    own = {"WAYMARK_ADMIN_KEY": KEY, "WAYMARK_HOST": "127.0.0.1", "WAYMARK_DECODE_TIMEOUT_S": "600"}
    log = tmp_path / "server"
    with running(image, log, *command_of(image)[1:], "--port", "0", **own) as process:
        url = started(process, log)
        with httpx.Client(base_url=url, headers={"X-API-Key": KEY}, trust_env=False, timeout=2 * WITHIN_S) as client:
            page = client.get("/").text
            assert "<title>Waymark</title>" in page
            for name in re.findall(r'(?:src|href)="(/static/[^"]+)"', page):
                assert client.get(name).content == (ROOT / name.removeprefix("/")).read_bytes()
            assert_all_found(decode_all(client, tmp_path))
            ready = client.get("/readyz")
            assert ready.status_code == 200, ready.text
    text = log.read_text()
    assert len(STARTED.findall(text)) == 1, "a decoder process started the server again"
    assert "kernels are compiled" not in text
    assert {path: path.lstat().st_mtime_ns for path in (image / "opt").rglob("*")} == before
    if os.geteuid() == 0:
        assert (image / "var/lib/waymark/waymark.sqlite3").stat().st_uid == USER


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_worker_of_the_image_decodes_every_kind_of_upload(
    image: Path, tmp_path: Path, postgres: PostgresServer
) -> None:
    log, other = tmp_path / "server", tmp_path / "worker"
    with login(postgres) as database_url, own_queues(broker_url := find_broker()) as prefix:
        own = {"WAYMARK_ADMIN_KEY": KEY, "WAYMARK_HOST": "127.0.0.1", "WAYMARK_DECODE_TIMEOUT_S": "600"}
        own |= {"WAYMARK_DATABASE_URL": database_url, "WAYMARK_BROKER_URL": broker_url, "WAYMARK_BROKER_PREFIX": prefix}
        own |= {"WAYMARK_BLOBS_SHARED": "true", "WAYMARK_WORKER_METRICS_PORT": "0"}
        with running(image, log, "serve", "--port", "0", **own, WAYMARK_WARM_DECODERS="false") as process:
            url = started(process, log)
            with (
                running(image, other, "worker", **own),
                httpx.Client(base_url=url, headers={"X-API-Key": KEY}, trust_env=False, timeout=WITHIN_S) as client,
            ):
                assert_all_found(decode_all(client, tmp_path, Prefer="respond-async"))
    assert "kernels are compiled" not in other.read_text()


def assert_all_found(found: dict[str, int]) -> None:
    assert found.pop("drive.mp4") == VIDEO_FRAMES
    assert len(found) == 5
    assert min(found.values()) > 0, found
    assert found["can.zip"] == found["drive.parquet"] == found["drive.zip"]


@contextmanager
def login(postgres: PostgresServer) -> Iterator[str]:
    """URL of an empty database for a role with a password: the image's user is none of the server's machine."""
    url = sa.make_url(postgres.empty())
    role, password = f"waymark_image_{secrets.token_hex(4)}", secrets.token_hex(16)
    options = str(url.query["options"])
    owner = options.rsplit("role=", 1)[1]
    engine = sa.create_engine(postgres.url, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.exec_driver_sql(f"CREATE ROLE {role} LOGIN PASSWORD '{password}' IN ROLE {owner}")
        port = int(connection.exec_driver_sql("SHOW port").scalar_one())
        try:
            yield sa.URL.create(
                url.drivername, role, password, "127.0.0.1", port, url.database, {"options": options}
            ).render_as_string(hide_password=False)
        finally:
            connection.exec_driver_sql(f"DROP ROLE {role}")
    engine.dispose()


def declared_kernels() -> set[str]:
    """Module and name of every function whose compiled code is cached, as the names of the cache's files begin."""
    declared = r"^@(?:ieee_)?(?:loop_)?kernel\ndef (\w+)"
    files = (ROOT / "app").rglob("*.py")
    return {f"{path.stem}.{name}" for path in files for name in re.findall(declared, path.read_text(), re.M)}


def test_the_base_is_pinned_and_nothing_is_downloaded_without_a_hash() -> None:
    lines = (ROOT / "docker/Dockerfile").read_text()
    bases = set(re.findall(r"^FROM (\S+)", lines, re.MULTILINE))
    assert bases == {"${PYTHON}", "build"}  # stages and the pinned base
    assert re.search(r"^ARG PYTHON=python:3\.11-slim-bookworm@sha256:[0-9a-f]{64}$", lines, re.MULTILINE)
    runs = re.findall(r"^RUN (.+?[^\\])$", lines, re.MULTILINE | re.DOTALL)
    assert len(runs) == 10
    for run in runs:
        assert not re.search(r"\b(apt|apt-get|curl|wget|git)\b", run)
        assert "bin/pip" not in run or "--require-hashes" in run or "--no-index" in run
    pattern = r"^[a-z0-9][^\n]*==[^\n]*(?:\n +[^\n]*)*"
    wanted = re.findall(pattern, (ROOT / "docker/requirements.txt").read_text(), re.M)
    assert len(wanted) > 80
    for other in ("guide", "build"):
        wanted += re.findall(pattern, (ROOT / f"docker/requirements-{other}.txt").read_text(), re.M)
    assert len(wanted) > 100
    assert all("--hash=sha256:" in requirement for requirement in wanted)


def test_the_images_requirements_are_those_of_the_tests() -> None:
    def versions(path: str) -> set[str]:
        return set(re.findall(r"^([a-z0-9][\w.-]*==\S+)", (ROOT / path).read_text(), re.MULTILINE))

    assert versions("requirements.txt") <= versions("docker/requirements.txt") <= versions("requirements-dev.txt")
    for other in ("guide", "build"):
        assert versions(f"docker/requirements-{other}.txt") <= versions("requirements-dev.txt")


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
    command = [require_tool("nginx"), "-t", "-p", str(tmp_path), "-c", "nginx.conf"]
    checked = subprocess.run(command, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
