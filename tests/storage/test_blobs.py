"""Blobs in a real folder."""

from __future__ import annotations

import errno
import os
import stat
import uuid
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from app.errors import Conflict, InvalidParameter, NotFound, StorageFull, Unavailable
from app.storage.blobs import Blobs, new_blob_key


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "a folder" / "blobs"


@pytest.fixture
def blobs(folder: Path) -> Blobs:
    store = Blobs(folder.as_uri())
    assert not folder.exists()
    store.open()
    return store


def test_what_is_put_is_got(blobs: Blobs) -> None:
    key = new_blob_key("uploads")
    blobs.put(key, b"\x00frame\xff")
    assert blobs.get(key) == b"\x00frame\xff"


def test_files_are_put_and_streamed_part_by_part(blobs: Blobs, tmp_path: Path) -> None:
    key, content = new_blob_key("packages"), bytes(range(256)) * 60_000
    (tmp_path / "file").write_bytes(content)
    blobs.put_file(key, tmp_path / "file")
    assert blobs.get(key) == content
    chunks = list(blobs.stream(key))
    assert len(chunks) > 1
    assert b"".join(chunks) == content
    with pytest.raises(NotFound):
        blobs.stream(new_blob_key("packages"))
    with pytest.raises(InvalidParameter):
        blobs.put_file("../x", tmp_path / "file")


def test_a_blob_is_written_once(blobs: Blobs) -> None:
    key = new_blob_key("uploads")
    blobs.put(key, b"first")
    with pytest.raises(Conflict):
        blobs.put(key, b"second")
    assert blobs.get(key) == b"first"


def test_large_blobs_are_written_once_too(blobs: Blobs) -> None:
    key, large = new_blob_key("uploads"), bytes(12_000_000)
    blobs.put(key, large)
    with pytest.raises(Conflict):
        blobs.put(key, large)
    assert len(blobs.get(key)) == 12_000_000


@pytest.fixture
def synced(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """What is made durable, in order."""
    paths: list[Path] = []

    def fsync(descriptor: int, fsync: Callable[[int], None] = os.fsync) -> None:
        paths.append(Path(f"/proc/self/fd/{descriptor}").readlink())
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    return paths


def test_every_blob_is_durable_with_the_folders_that_lead_to_it(
    blobs: Blobs, folder: Path, tmp_path: Path, synced: list[Path]
) -> None:
    first = new_blob_key("uploads")
    blobs.put(first, b"x")
    path = folder.resolve() / first
    assert synced == [path, path.parent, path.parent.parent, path.parent.parent.parent]
    (tmp_path / "file").write_bytes(b"x")
    for put in (lambda key: blobs.put(key, b"x"), lambda key: blobs.put_file(key, tmp_path / "file")):
        synced.clear()
        second = first[:-4] + uuid.uuid4().hex[:4]
        put(second)
        assert synced == [folder.resolve() / second, path.parent]


@pytest.mark.parametrize(("number", "error"), [(errno.EIO, Unavailable), (errno.ENOSPC, StorageFull)])
def test_a_blob_that_could_not_be_made_durable_is_gone(
    blobs: Blobs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, error: type[Unavailable]
) -> None:
    (tmp_path / "file").write_bytes(b"x")

    def fail(_descriptor: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    for put in (lambda key: blobs.put(key, b"x"), lambda key: blobs.put_file(key, tmp_path / "file")):
        with pytest.raises(error) as caught:
            put(new_blob_key("uploads"))
        assert type(caught.value) is error
    assert list(blobs.list_keys()) == []


def test_blobs_are_listed_by_age_and_partial_files_are_deleted(blobs: Blobs, folder: Path) -> None:
    old, new = new_blob_key("uploads"), new_blob_key("pictures")
    now = datetime.now(UTC)
    for key in (old, new):
        blobs.put(key, b"x")
        (folder / f"{key}#1").write_bytes(b"half")
    (folder / "notes.txt").write_bytes(b"somebody's")
    for name in (old, f"{old}#1", "notes.txt"):
        os.utime(folder / name, (0, 0))
    assert list(blobs.list_keys(now - timedelta(hours=1))) == [old]
    assert set(blobs.list_keys()) == {old, new}
    blobs.delete_partial(now - timedelta(hours=1))
    assert {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()} == {
        old, new, f"{new}#1", "notes.txt",
    }  # fmt: skip


def test_delete_is_idempotent(blobs: Blobs) -> None:
    key = new_blob_key("uploads")
    blobs.put(key, b"x")
    blobs.delete(key)
    blobs.delete(key)
    with pytest.raises(NotFound):
        blobs.get(key)


@pytest.mark.parametrize(
    "key", ["../x", "uploads/../../x", "/etc/passwd", "uploads/holiday.jpg", "", "uploads/00/" + "A" * 32, "a\x00b"]
)
def test_only_our_own_keys(blobs: Blobs, key: str) -> None:
    for act in (lambda: blobs.put(key, b"x"), lambda: blobs.get(key), lambda: blobs.delete(key)):
        with pytest.raises(InvalidParameter):
            act()


def test_keys_are_random_and_the_folder_is_private(blobs: Blobs, folder: Path) -> None:
    assert len({new_blob_key("uploads") for _ in range(1000)}) == 1000
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


@pytest.mark.parametrize("url", ["", "/var/blobs", "http://example.org/x", "s3://", "file://host/x", "memory://"])
def test_other_urls_are_refused(url: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        Blobs(url)
    assert caught.value.field == "blobs_url"


def test_a_folder_name_with_a_percent_sign(tmp_path: Path) -> None:
    folder = tmp_path / "50%25 done"
    key = new_blob_key("uploads")
    blobs = Blobs(folder.as_uri())
    blobs.open()
    blobs.put(key, b"x")
    assert (folder / key).read_bytes() == b"x"
