"""Blobs that are written before the transaction that refers to them, and deleted if it does not commit."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import structlog

from app.errors import CommitUnknown, Unavailable
from app.formats.spooled_file import SpooledFile
from app.services.ports import Blobs
from app.storage.blobs import new_blob_key

_LOG = structlog.get_logger(__name__)


class StagedBlobs:
    """Blobs that were written and are not referred to yet."""

    def __init__(self, blobs: Blobs) -> None:
        self._blobs = blobs
        self._keys: list[str] = []

    def put(self, folder: str, data: bytes) -> str:
        """Write a blob. Returns its key."""
        key = new_blob_key(folder)
        self._keys.append(key)
        self._blobs.put(key, data)
        return key

    def put_file(self, folder: str, path: Path) -> str:
        """Write a blob from a file. Returns its key."""
        key = new_blob_key(folder)
        self._keys.append(key)
        self._blobs.put_file(key, path)
        return key

    def add(self, folder: str, file: SpooledFile) -> str:
        """Write an upload as a blob; its temporary file may become the blob. Returns its key."""
        key = new_blob_key(folder)
        self._keys.append(key)
        if file.path is None:
            self._blobs.put(key, file.read())
        else:
            self._blobs.take_file(key, file.path)
        return key

    def keep(self) -> None:
        """Leave the blobs where they are: the transaction that refers to them has committed."""
        self._keys.clear()

    def delete(self, key: str | None) -> None:
        """Delete a blob that is not needed any more. One that cannot be deleted stays, and is logged."""
        if key is None:
            return
        self._keys.remove(key)
        delete_unused(self._blobs, [key])

    def delete_all(self) -> None:
        """Delete the blobs that were not kept."""
        for key in list(self._keys):
            self.delete(key)


@contextmanager
def staged(blobs: Blobs) -> Iterator[StagedBlobs]:
    """Write blobs inside the block; when it ends, those that were not kept are deleted.

    If the rows that refer to them may have been committed, they stay: `app.services.unused_blobs` decides later.
    """
    stage = StagedBlobs(blobs)
    try:
        yield stage
    except CommitUnknown:
        stage.keep()
        raise
    finally:
        stage.delete_all()


def delete_unused(blobs: Blobs, keys: Iterable[str]) -> None:
    """Delete blobs that nothing refers to any more. One that cannot be deleted stays, and is logged."""
    for key in keys:
        try:
            blobs.delete(key)
        except Unavailable:
            _LOG.warning("a blob that nothing refers to could not be deleted", blob_key=key)
