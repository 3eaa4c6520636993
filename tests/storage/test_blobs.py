"""Blobs in a real folder."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from app.errors import Conflict, InvalidParameter, NotFound
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


@pytest.mark.parametrize("durable", [False, True])
def test_what_is_put_is_got(blobs: Blobs, durable: bool) -> None:
    key = new_blob_key("uploads")
    blobs.put(key, b"\x00frame\xff", durable=durable)
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
