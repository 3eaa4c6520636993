"""Blobs and the rows that refer to them: written before their transaction, and deleted when no row refers to them."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import numpy.typing as npt
import sqlalchemy as sa
import structlog

from app.errors import CommitUnknown, Conflict, Unavailable
from app.formats.format import SpooledFile
from app.registry.agencies import find_first_agency
from app.registry.database import Database
from app.registry.engines import across_agencies
from app.registry.tables import blob_references
from app.services.ports import Blobs, Clock
from app.storage.blobs import new_blob_key

# === Blobs that are written before the transaction that refers to them, and deleted if it does not commit.


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

    If the rows that refer to them may have been committed, they stay: `app.services.blobs` decides later.
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


# === Blobs to which no row refers: a server that is killed between writing a blob and committing its row leaves one.


MIN_AGE = timedelta(hours=6)
"""Younger blobs may belong to an upload whose row is not committed yet. An upload is given up after two hours: it is
matched at most `MAX_TRIES` = 12 times, and each time waits at most 600 s for a decoder process."""
OWNERS = "owners"
"""Folder of the store in which each database that uses it has an empty blob, named after its oldest agency."""


class UnusedBlobs:
    """Deletes blobs that no row refers to; several servers of one database may do so at the same time.

    Parameters
    ----------
    alone : bool
        No other process uses the database and the store, so that every blob from before this object was made belongs to
        an upload that has ended.
    """

    def __init__(self, database: Database, clock: Clock, blobs: Blobs, *, alone: bool = False) -> None:
        self._database, self._clock, self._blobs = database, clock, blobs
        self._alone_since = clock() if alone else None
        self._stopping = threading.Event()

    def stop(self) -> None:
        """End a `delete` that runs."""
        self._stopping.set()

    def delete(self) -> int:
        """Delete blobs that no row refers to and that belong to no upload that goes on; returns their number.

        Nothing is deleted from a store that another database uses, too: its rows cannot be seen from here.
        """
        if not self._is_ours():
            return 0
        before = self._clock() - MIN_AGE
        if self._alone_since is not None:  # once, at the start: later, a clock that was set back could mislead it
            before, self._alone_since = max(before, self._alone_since), None
        self._blobs.delete_partial(before)
        # Blobs are listed before rows are read: a row that refers to a listed blob is seen if it is committed by now,
        # and cannot be committed later, because the blob is too old.
        old = _ids(self._list_old(before))
        with across_agencies(), self._database.read(long=True) as connection:
            used = _ids(blob_references(connection))
        unused = np.setdiff1d(old, used)
        if not unused.size:
            return 0
        deleted = 0
        for key in self._list_old(before):
            if self._stopping.is_set():
                break
            if _contains(unused, _id_of(key)):
                self._blobs.delete(key)
                deleted += 1
        _LOG.info("blobs that no row refers to were deleted", count=deleted)
        return deleted

    def try_to_delete(self) -> None:
        """As `delete`; a store that does not answer is logged and tried the next time."""
        try:
            self.delete()
        except (Unavailable, sa.exc.SQLAlchemyError) as error:
            _LOG.warning("blobs that no row refers to could not be deleted", why=str(error))

    def _list_old(self, before: datetime) -> Iterator[str]:
        return (key for key in self._blobs.list_keys(before) if not key.startswith(f"{OWNERS}/"))

    def _is_ours(self) -> bool:
        """Mark the store as used by this database; False if another one uses it, too."""
        with across_agencies(), self._database.read() as connection:
            agency_id = find_first_agency(connection)
        if agency_id is None:
            return False
        name = agency_id.replace("-", "")
        own = f"{OWNERS}/{name[:2]}/{name}"
        with suppress(Conflict):
            self._blobs.put(own, b"")
        others = [key for key in self._blobs.list_keys() if key.startswith(f"{OWNERS}/") and key != own]
        if others:
            _LOG.warning("unused blobs are kept: another database uses the store; delete its mark if not", marks=others)
        return not others


def _ids(keys: Iterable[str]) -> npt.NDArray[np.uint64]:
    """Blobs as sorted numbers: a store of ten million takes 80 MB of memory."""
    return np.unique(np.fromiter(map(_id_of, keys), np.uint64))


def _id_of(key: str) -> int:
    """The first 64 random bits of a key. Of two keys that share them, the unused one is kept if the other is used."""
    return int(key[-32:-16], 16)


def _contains(numbers: npt.NDArray[np.uint64], number: int) -> bool:
    place = np.searchsorted(numbers, np.uint64(number))
    return bool(place < numbers.size and numbers[place] == number)
