"""The drills of docs/operation.md: backup under load, restore elsewhere, upgrade; and damaged backups."""

from __future__ import annotations

import itertools
import json
import os
import random
import shutil
import subprocess
import sys
import tarfile
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from app import cli
from app.errors import Unavailable, WaymarkError
from app.main import create_app
from app.registry.database import Database, head_revision
from app.registry.dumps import copy_sqlite
from app.registry.engines import across_agencies
from app.registry.jobs import jobs
from app.registry.tables import blob_references
from app.services.backups import BackupOptions, Backups, Restores, verify_backup
from app.services.ports import utc_now
from app.settings import Settings
from app.storage.backup_files import DamagedBackup
from app.storage.blobs import Blobs
from tests.conftest import ADMIN_KEY, UNLIMITED, LiveServer
from tests.http import wait_until

pytestmark = pytest.mark.slow

NewUrl = Callable[[Path], str]
NUMBERS = itertools.count()
ROAD = {
    "type": "FeatureCollection",
    "features": [
        {
            "type": "Feature",
            "properties": {"lane": "1", "width_m": 3.5, "speed_limit_kmh": 70},
            "geometry": {"type": "LineString", "coordinates": [[8.0, 47.0], [8.001, 47.0], [8.002, 47.0]]},
        }
    ],
}


def settings_of(folder: Path, url: str) -> Settings:
    own = {"admin_key": ADMIN_KEY, "warm_decoders": False, "decode_workers": 1, **UNLIMITED}
    return Settings(data_dir=folder, database_url=url, **own)


def environment_of(settings: Settings) -> dict[str, str]:
    own = {"WAYMARK_DATA_DIR": str(settings.data_dir), "WAYMARK_DATABASE_URL": settings.database_url}
    return {name: value for name, value in os.environ.items() if not name.startswith("WAYMARK_")} | own


def waymark(settings: Settings, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A command in a process of its own, as an operator runs it beside the server."""
    command = [sys.executable, "-c", "from app.cli import main; main()", *arguments]
    return subprocess.run(command, env=environment_of(settings), capture_output=True, text=True, check=False)


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """A command in this process: its status and what it prints."""

    def run(settings: Settings, *arguments: str) -> tuple[int, str]:
        for name, value in environment_of(settings).items():
            if name.startswith("WAYMARK_"):
                monkeypatch.setenv(name, value)
        monkeypatch.setattr("sys.argv", ["waymark", *arguments])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        printed = capsys.readouterr()
        return int(ended.value.code or 0), printed.out + printed.err

    return run


def register(client: httpx.Client) -> str:
    number = next(NUMBERS)
    place = {"lon_deg": 10 + number * 0.003 % 100, "lat_deg": 20 + number * 0.0007 % 40}
    response = client.post("/v1/markers", json={"position": place})
    assert response.status_code == 201, response.text
    return str(response.json()["id"])


def send_road(client: httpx.Client) -> str:
    declaration = json.dumps({"name": f"road {next(NUMBERS)}"})
    file = ("road.geojson", json.dumps(ROAD).encode(), "application/geo+json")
    parts = {"file": file, "declaration": (None, declaration)}
    response = client.post("/v1/alignments", files=parts)
    assert response.status_code == 201, response.text
    return str(response.json()["id"])


@contextmanager
def writing(server: LiveServer) -> Iterator[tuple[list[str], list[str]]]:
    """Markers and roads (each with a blob) are written all the time; yields the ids of those that were acknowledged."""
    markers: list[str] = []
    roads: list[str] = []
    stop = threading.Event()
    faults: list[BaseException] = []

    def write(one: Callable[[httpx.Client], str], acknowledged: list[str]) -> None:
        try:
            with server.client() as client:
                while not stop.is_set():
                    acknowledged.append(one(client))
        except BaseException as error:
            faults.append(error)
            raise

    threads = [threading.Thread(target=write, args=pair) for pair in ((register, markers), (send_road, roads))]
    for thread in threads:
        thread.start()
    try:
        wait_until(lambda: faults or (len(markers) > 20 and len(roads) > 3), "the first writes")
        yield markers, roads
    finally:
        stop.set()
        for thread in threads:
            thread.join()
    assert not faults


@pytest.mark.both_databases
def test_drill_backup_under_load_restore_elsewhere(tmp_path: Path, new_database_url: NewUrl) -> None:
    settings = settings_of(tmp_path / "var", new_database_url(tmp_path / "var"))
    with LiveServer(create_app(settings)) as server, writing(server) as (markers, roads):
        before = list(markers), list(roads)
        done = waymark(settings, "backup", str(tmp_path / "backup.tar"))
        assert done.returncode == 0, done.stderr
        written = len(markers)
    assert written > len(before[0]), "nothing was written during the backup"
    assert f"at revision {head_revision()}" in done.stdout
    assert not list(tmp_path.glob(".*")), "temporary files are left"

    elsewhere = settings_of(tmp_path / "other", new_database_url(tmp_path / "other"))
    done = waymark(elsewhere, "restore", str(tmp_path / "backup.tar"))
    assert done.returncode == 0, done.stderr
    with LiveServer(create_app(elsewhere)) as server, server.client() as client:
        for marker_id in before[0]:
            assert client.get(f"/v1/markers/{marker_id}").status_code == 200
        for road_id in before[1]:
            assert client.get(f"/v1/alignments/{road_id}").status_code == 200
        with across_agencies(), server.app.state.database.read() as connection:
            referred = set(blob_references(connection))
            assert [fault for _, _, found in server.app.state.use_cases.audit.verify() for fault in found] == []
        store = elsewhere.data_dir / "blobs"
        present = {str(file.relative_to(store)) for file in store.glob("*/*/*")}
        assert len(referred) >= len(before[1])
        assert referred <= present
        register(client)  # sequences go on after the restored rows


@pytest.fixture
def small(tmp_path: Path) -> Settings:
    """Settings of a server that has stopped, with a few rows and blobs."""
    settings = settings_of(tmp_path / "var", "")
    with LiveServer(create_app(settings)) as server, server.client() as client:
        register(client)
        with across_agencies(), server.app.state.database.write() as connection:
            key = "decodes/ab/" + "ab" * 16
            add_row_with_blob(connection, server.app.state.use_cases.unused_blobs._blobs, key)
    return settings


def add_row_with_blob(connection: sa.Connection, blobs: Blobs, key: str) -> None:
    """A finished job with an upload, without the decoder processes that a real one takes."""
    blobs.put(key, b"frame" * 100)
    agency_id = connection.exec_driver_sql("SELECT id FROM agencies").scalar_one()
    values = {
        "id": "0" * 36, "agency_id": agency_id, "kind": "import", "state": "done", "attempts": 1, "progress": 1.0,
        "cancel_requested": False, "input": {}, "upload_key": key, "created_at": utc_now(),
    }  # fmt: skip
    connection.execute(sa.insert(jobs).values(values))


def backups_of(settings: Settings) -> Backups:
    blobs = Blobs(settings.resolved_blobs_url)
    blobs.open()
    keys = {"master.key": settings.resolved_master_key_file, "signing.key": settings.resolved_signing_key_file}
    return Backups(Database(settings.resolved_database_url), blobs, utc_now, "0", keys)


def restored(settings: Settings, source: Path) -> None:
    blobs = Blobs(settings.resolved_blobs_url)
    blobs.open()
    keys = {"master.key": settings.resolved_master_key_file, "signing.key": settings.resolved_signing_key_file}
    with closing(Database(settings.resolved_database_url)) as database:
        database.open()
        report = Restores(database, blobs, keys).restore(source)
        assert report.faults == ()


def test_a_changed_missing_or_cut_off_member_is_refused(small: Settings, tmp_path: Path) -> None:
    backup = tmp_path / "backup"
    backups_of(small).write(backup, BackupOptions())
    files = sorted(path for path in backup.rglob("*") if path.is_file())
    assert len(files) == 6  # database, list of blobs, a blob, manifest, two lists of hashes
    dice = random.Random(15)
    for file in files:
        content = file.read_bytes()
        at = dice.randrange(len(content))
        for damaged in (content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :], content[:at], None):
            if damaged is None:
                file.unlink()
            else:
                file.write_bytes(damaged)
            with pytest.raises(DamagedBackup) as refusal:
                verify_backup(backup)
            assert refusal.value.message
            elsewhere = settings_of(tmp_path / "other", "")
            with pytest.raises(DamagedBackup):
                restored(elsewhere, backup)
            assert not (elsewhere.data_dir / "waymark.sqlite3").exists()
            assert not list((elsewhere.data_dir / "blobs").glob("*/*/*"))
        file.write_bytes(content)
    (backup / "extra").write_bytes(b"")
    with pytest.raises(DamagedBackup, match="does not belong"):
        verify_backup(backup)
    (backup / "extra").unlink()
    verify_backup(backup)


def test_a_damaged_tar_file_is_refused(small: Settings, tmp_path: Path) -> None:
    backup = tmp_path / "backup.tar"
    backups_of(small).write(backup, BackupOptions())
    content = backup.read_bytes()
    with tarfile.open(backup) as tar:
        held = [range(member.offset_data, member.offset_data + member.size) for member in tar.getmembers()]
    dice = random.Random(15)
    for at in (dice.choice(dice.choice([span for span in held if span])) for _ in range(12)):
        backup.write_bytes(content[:at] + bytes([content[at] ^ 0x40]) + content[at + 1 :])
        with pytest.raises(DamagedBackup):
            verify_backup(backup)
    for length in (0, 100, 512, len(content) // 3, held[-1].stop - 1):
        backup.write_bytes(content[:length])
        with pytest.raises(DamagedBackup):
            verify_backup(backup)


def test_a_restore_overwrites_nothing(small: Settings, tmp_path: Path) -> None:
    backup = tmp_path / "backup"
    backups_of(small).write(backup, BackupOptions())
    was = small.data_dir / "waymark.sqlite3", (small.data_dir / "waymark.sqlite3").read_bytes()
    with pytest.raises(WaymarkError, match="is not empty"):
        restored(small, backup)
    assert was[0].read_bytes() == was[1]
    elsewhere = settings_of(tmp_path / "other", "")
    blobs = Blobs(elsewhere.resolved_blobs_url)
    blobs.open()
    blobs.put("decodes/cd/" + "cd" * 16, b"of another database")
    with pytest.raises(WaymarkError, match="not of the backup"):
        restored(elsewhere, backup)
    blobs.delete("decodes/cd/" + "cd" * 16)
    restored(elsewhere, backup)
    with pytest.raises(WaymarkError, match="is not empty"):
        restored(elsewhere, backup)


def test_a_restore_that_was_cut_off_is_repeated(
    small: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    backups_of(small).write(tmp_path / "backup", BackupOptions())
    elsewhere = settings_of(tmp_path / "other", "")

    def cut(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Restores, "_restore_database", cut)
        with pytest.raises(KeyboardInterrupt):
            restored(elsewhere, tmp_path / "backup")
    blob = elsewhere.data_dir / "blobs/decodes/ab" / ("ab" * 16)
    assert blob.stat().st_size == 500
    blob.write_bytes(b"half")
    restored(elsewhere, tmp_path / "backup")
    assert blob.stat().st_size == 500


def test_keys_are_kept_apart_or_included(
    small: Settings, tmp_path: Path, command: Callable[..., tuple[int, str]]
) -> None:
    small.resolved_master_key_file.write_bytes(b"m" * 32)
    status, printed = command(small, "backup", str(tmp_path / "without"))
    assert status == 0
    assert "does not contain master.key" in printed
    assert not (tmp_path / "without/keys").exists()
    status, printed = command(small, "backup", str(tmp_path / "with"), "--with-keys")
    assert "contains the keys master.key" in printed
    elsewhere = settings_of(tmp_path / "other", "")
    elsewhere.data_dir.mkdir()
    elsewhere.resolved_master_key_file.write_bytes(b"x" * 32)
    status, printed = command(elsewhere, "restore", str(tmp_path / "with"))
    assert status == 1
    assert "is not the key of the backup" in printed
    elsewhere.resolved_master_key_file.unlink()
    status, printed = command(elsewhere, "restore", str(tmp_path / "without"))
    assert (status, "still missing" in printed) == (0, True)
    other = settings_of(tmp_path / "third", "")
    assert command(other, "restore", str(tmp_path / "with"))[0] == 0
    assert other.resolved_master_key_file.read_bytes() == b"m" * 32
    assert other.resolved_master_key_file.stat().st_mode & 0o777 == 0o600


def test_a_lost_blob_stops_a_backup_unless_the_operator_allows_it(small: Settings, tmp_path: Path) -> None:
    blob = next((small.data_dir / "blobs/decodes").glob("*/*"))
    blob.unlink()
    with pytest.raises(Unavailable, match="is lost"):
        backups_of(small).write(tmp_path / "backup", BackupOptions())
    assert {path.name for path in tmp_path.iterdir()} == {"var"}
    manifest = backups_of(small).write(tmp_path / "backup", BackupOptions(allow_missing=True))
    assert manifest["blobs"]["missing"] == [f"decodes/ab/{'ab' * 16}"]


def test_a_blob_that_goes_after_the_snapshot_leads_to_a_new_snapshot(
    small: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    backups, stream, asked = backups_of(small), Blobs.stream, []

    def stream_after_cleaning(blobs: Blobs, key: str) -> Iterator[bytes]:
        asked.append(key)
        if len(asked) == 1:  # a plan has got a new document, and the old one was cleaned away
            blobs.put("decodes/ab/" + "cd" * 16, b"new")
            blobs.delete(key)
            with closing(Database(small.resolved_database_url)) as database, database.write() as connection:
                connection.execute(sa.update(jobs).values(upload_key="decodes/ab/" + "cd" * 16))
        return stream(blobs, key)

    monkeypatch.setattr(Blobs, "stream", stream_after_cleaning)
    backups.write(tmp_path / "backup", BackupOptions())
    assert asked == ["decodes/ab/" + "ab" * 16, "decodes/ab/" + "cd" * 16]
    assert not (tmp_path / "backup/blobs/decodes/ab" / ("ab" * 16)).exists()


def test_blobs_stay_in_a_store_that_is_backed_up_by_itself(small: Settings, tmp_path: Path) -> None:
    manifest = backups_of(small).write(tmp_path / "backup", BackupOptions(copy_blobs=False))
    assert (manifest["blobs"]["copied"], manifest["blobs"]["count"]) == (False, 1)
    assert not (tmp_path / "backup/blobs").exists()
    elsewhere = settings_of(tmp_path / "other", "")
    with pytest.raises(WaymarkError, match="lacks 1 of the 1 blobs"):
        restored(elsewhere, tmp_path / "backup")
    restored(elsewhere.model_copy(update={"blobs_url": small.resolved_blobs_url}), tmp_path / "backup")


def test_a_damaged_database_is_not_backed_up(small: Settings, tmp_path: Path) -> None:
    file = small.data_dir / "waymark.sqlite3"
    content = bytearray(file.read_bytes())
    page = 16_384
    content[5 * page : 5 * page + 64] = b"\xff" * 64
    file.write_bytes(content)
    with pytest.raises(Unavailable):
        copy_sqlite(file, tmp_path / "copy")


@pytest.mark.both_databases
def test_drill_upgrade_and_the_way_back(
    tmp_path: Path, new_database_url: NewUrl, command: Callable[..., tuple[int, str]]
) -> None:
    settings = settings_of(tmp_path / "var", new_database_url(tmp_path / "var"))
    with LiveServer(create_app(settings)) as server, server.client() as client:
        marker_id = register(client)
        status, printed = command(settings, "upgrade", "--backup", str(tmp_path / "before"))
        assert status == 1
        assert "stop" in printed
        assert not (tmp_path / "before").exists()
    with closing(Database(settings.resolved_database_url)) as database:
        database.migrate("0015")
    status, printed = command(settings, "upgrade", "--backup", str(tmp_path / "before"))
    assert status == 0, printed
    assert f"revision 0015 -> {head_revision()}" in printed
    assert f"waymark restore {tmp_path / 'before'}" in printed
    assert verify_backup(tmp_path / "before")["revision"] == "0015"
    elsewhere = settings_of(tmp_path / "other", new_database_url(tmp_path / "other"))
    assert command(elsewhere, "restore", str(tmp_path / "before"))[0] == 0
    for each in (settings, elsewhere):
        with LiveServer(create_app(each)) as server, server.client() as client:
            assert client.get(f"/v1/markers/{marker_id}").status_code == 200


def test_a_backup_of_another_kind_or_version_is_refused(small: Settings, tmp_path: Path) -> None:
    backup = tmp_path / "backup"
    backups_of(small).write(backup, BackupOptions())
    manifest = json.loads((backup / "manifest.json").read_bytes())
    for name, value, reason in (
        ("format_version", 2, "format_version"),
        ("revision", "9999", "not that of the manifest"),
        ("database", "postgresql", "missing from the backup|has"),
    ):
        write_manifest(backup, {**manifest, name: value})
        with pytest.raises(DamagedBackup, match=reason):
            verify_backup(backup)
    write_manifest(backup, manifest)
    verify_backup(backup)
    shutil.rmtree(backup)
    with pytest.raises(DamagedBackup):
        verify_backup(backup)


def write_manifest(backup: Path, manifest: dict[str, Any]) -> None:
    """A manifest with its right hash."""
    from hashlib import sha256

    content = json.dumps(manifest).encode()
    (backup / "manifest.json").write_bytes(content)
    (backup / "manifest.sha256").write_text(f"{sha256(content).hexdigest()}  manifest.json\n")
