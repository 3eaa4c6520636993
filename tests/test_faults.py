"""The judge of the benchmark of faults notices what is lost; starts on disks that are full or read-only."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

import httpx
import pytest
import sqlalchemy as sa
from typer.testing import CliRunner

from app.cli import cli
from app.cli.backups import _read_heads
from app.demo.server import free_ports
from app.errors import InvalidParameter, MalformedRequest
from app.registry import agencies
from app.registry import decodes as store
from app.registry.column_types import new_id
from app.registry.decodes import DecodeRow
from app.registry.marker_rows import markers
from app.storage.blobs import new_blob_key
from benchmarks.faults.stored import Stored
from benchmarks.faults.writers import IMPORT_ROAD, IMPORT_ROWS, Acknowledged
from tests.conftest import ADMIN_KEY, verified_server
from tests.http import created, wait_until

WAYMARK = [sys.executable, "-c", "from app.cli import main; main()"]
WAIT_S = 1200.0
PLACE = {"lon_deg": 8.4, "lat_deg": 49.0}
NOW = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)


def test_lost_and_changed_writes_are_noticed(tmp_path: Path) -> None:
    stored = Stored(tmp_path)
    stored.database.migrate()
    key, unused, row = new_blob_key("uploads"), new_blob_key("uploads"), new_id(NOW)
    for blob in (key, unused):
        stored.blobs.put(blob, b"frame")
    with stored.database.write() as connection:
        agency_id = agencies.add_agency(connection, "one", NOW)
        store.add_decode(connection, agency_id, "x", DecodeRow(row, "frame", {}, NOW, upload_key=key))
    kept = Acknowledged(uploads={row: hashlib.sha256(b"frame").hexdigest()})
    assert stored.list_lost(kept) == []
    lost = Acknowledged({"a marker"}, {row: hashlib.sha256(b"another").hexdigest(), new_id(NOW): "0" * 64})
    assert len(stored.list_lost(lost)) == 3
    assert stored.delete_unused() == (1, 2, 0)
    assert stored.list_lost(kept) == []
    stored.database.close()


def test_surveys_in_part_and_rows_without_a_blob_are_noticed(tmp_path: Path) -> None:
    with verified_server(tmp_path, "") as server, server.client() as client:
        places = [{"lon_deg": 8.5 + k * 5e-4, "lat_deg": 49.0} for k in range(IMPORT_ROWS)]
        items = [{"create": {"position": place, "family": "cerpm", "road": f"{IMPORT_ROAD}1"}} for place in places]
        assert client.post("/v1/markers/bulk", json={"items": items}).status_code == 200
    stored, key = Stored(tmp_path), new_blob_key("uploads")
    try:
        assert stored.list_partial() == stored.list_without_blob() == []
        with stored.database.write() as connection:
            agency_id, last = connection.execute(sa.select(markers.c.agency_id, markers.c.id).limit(1)).one()
            connection.execute(sa.update(markers).where(markers.c.id == last).values(road=f"{IMPORT_ROAD}2"))
            store.add_decode(connection, agency_id, "x", DecodeRow(new_id(NOW), "frame", {}, NOW, upload_key=key))
        assert sorted(stored.list_partial()) == ["import 1: 19 of 20", "import 2: 1 of 20"]
        assert stored.list_without_blob() == [key]
        assert stored.list_lost(Acknowledged(imports={"x": "import 3"}, plans={"y": 4})) == ["import x", "plan y"]
    finally:
        stored.database.close()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 24 MB, removed at the end."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=24m", "tmpfs", str(place)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no file system may be mounted here: {error}")
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)


def _fill(disk: Path) -> None:
    """Leave no block free."""
    with suppress(OSError), (disk / "ballast").open("ab", buffering=0) as file:
        while True:
            file.write(bytes(4096))


@contextmanager
def _served(folder: Path, log: Path) -> Iterator[httpx.Client]:
    """`waymark serve` on a folder, as soon as it answers; it is ended by SIGTERM."""
    (port,) = free_ports(1)
    own = {"DATA_DIR": str(folder), "ADMIN_KEY": ADMIN_KEY, "PORT": str(port), "WARM_DECODERS": "false"}
    environment = (
        os.environ | {f"WAYMARK_{name}": value for name, value in own.items()} | {"WAYMARK_LOG_FORMAT": "json"}
    )
    with log.open("wb") as file:
        process = subprocess.Popen([*WAYMARK, "serve"], env=environment, stdout=file, stderr=file)
    try:
        with httpx.Client(
            base_url=f"http://127.0.0.1:{port}", headers={"X-API-Key": ADMIN_KEY}, trust_env=False, timeout=60
        ) as client:

            def answers() -> bool:
                assert process.poll() is None, log.read_text()
                with suppress(httpx.TransportError):
                    return client.get("/healthz").status_code == 200
                return False

            wait_until(answers, "the server answers", WAIT_S)
            yield client
    finally:
        process.terminate()
        process.wait()


@pytest.mark.slow
@pytest.mark.timeout(2 * WAIT_S)  # a start of the server takes minutes on a busy machine
@pytest.mark.parametrize("kind", ["full", "read-only"])
def test_a_start_on_a_full_or_read_only_disk_serves_reads(small_disk: Path, tmp_path: Path, kind: str) -> None:
    folder, log = small_disk / "var", tmp_path / "log"
    with verified_server(folder, f"sqlite:///{folder / 'waymark.sqlite3'}") as server, server.client() as client:
        marker = created(client, "/v1/markers", position=PLACE)
    if kind == "full":
        _fill(small_disk)
    else:
        subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    with _served(folder, log) as client:
        assert client.get(f"/v1/markers/{marker['id']}").json() == marker
        ready = client.get("/readyz")
        assert (ready.status_code, ready.json()["parts"]["storage"]) == (503, False)
        if kind == "full":
            _fill(small_disk)  # what was left of the reserve
        answers = [client.post("/v1/markers", json={"position": PLACE}) for _ in range(12)]
        last = answers[-1]
        assert last.status_code in (503, 507), last.text
        assert last.headers["content-type"] == "application/problem+json"
        assert {answer.status_code for answer in answers} <= {201, 503, 507}
        assert client.get(f"/v1/markers/{marker['id']}").json() == marker
        if kind == "full":
            (small_disk / "ballast").unlink()
            wait_until(lambda: client.get("/readyz").status_code == 200, "the server is ready", WAIT_S)
            created(client, "/v1/markers", position=PLACE)
    lines = [line for line in log.read_text().splitlines() if "the disk is full or read-only" in line]
    assert len(lines) == 1
    assert str(folder) in lines[0]
    assert "Traceback" not in log.read_text()


@pytest.mark.slow
def test_a_first_start_on_a_full_disk_ends_with_the_cause(small_disk: Path) -> None:
    _fill(small_disk)
    environment = os.environ | {"WAYMARK_DATA_DIR": str(small_disk)}
    ended = subprocess.run([*WAYMARK, "serve"], env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stderr.startswith(f"waymark: the disk of {small_disk} is full\n")
    assert "Traceback" not in ended.stderr + ended.stdout


@pytest.mark.parametrize("revision", ["zzz", "", "-99"])
def test_an_unknown_revision_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, revision: str) -> None:
    monkeypatch.setenv("WAYMARK_DATA_DIR", str(tmp_path))
    ended = CliRunner().invoke(cli, ["migrate", "--", revision])
    assert ended.exit_code == 2
    assert ended.stderr.startswith(f"waymark: there is no revision {revision!r}")
    assert ended.stderr.count("\n") == 1


def test_an_argument_that_is_not_utf_8_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WAYMARK_DATA_DIR", str(tmp_path))
    ended = CliRunner().invoke(cli, ["key", "agency \udcff"])
    assert isinstance(ended.exception, MalformedRequest)
    assert ended.exception.field == "option.agency"


def test_a_file_of_heads_that_is_nested_deeply_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "heads.json"
    path.write_text("[" * 100_000)
    with pytest.raises(InvalidParameter, match="has no heads"):
        _read_heads(path)
