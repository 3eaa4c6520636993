"""The spool folder: bodies are written here while they arrive, until they are blobs or refused.

A body that stays small is held in memory, so that a single frame costs no file; all such bodies together may take a
fixed amount. What a killed server leaves is deleted by the next one.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from app.errors import StorageFull, Unavailable, is_disk_full
from app.formats.format import SpooledFile

# === Whether a folder can be written: there is room, and a file in it can be made durable.


MIN_FREE_BYTES = 1024**2
"""Room below which a folder counts as full. [byte] More than most requests store."""
_FILE = ".probe"


def find_folder_fault(folder: Path) -> str | None:
    """Why a folder cannot be written; None if it can: a small file is written, made durable and deleted."""
    try:
        status = os.statvfs(folder)
        if (free := status.f_bavail * status.f_frsize) < MIN_FREE_BYTES:
            return f"{folder} has {free} bytes left, fewer than {MIN_FREE_BYTES}"
        path = folder / _FILE
        with path.open("wb") as file:
            file.write(b"waymark")
            file.flush()
            os.fsync(file.fileno())
        path.unlink()
    except OSError as error:
        return f"{folder}: {error.strerror}"
    return None


# === The spool folder.


IN_MEMORY_BYTES = 1 << 20
"""Largest body that is held in memory. [byte] A JPEG of 1080p has 0.2 to 0.8 MB."""
ALL_IN_MEMORY_BYTES = 64 << 20
"""Most that all bodies in memory take together. [byte] A fifth of the limit of 300 MB that docs/uploads.md states for
the server process."""
BLOCK_BYTES = 1 << 18
"""Bytes that are collected before they are written. [byte] 64 clients hold 16 MiB."""
MIN_AGE_S = 6 * 3600.0
"""Age from which a file that nobody writes belongs to a server that was killed. [s] Source: `blobs.MIN_AGE`."""
KEPT_FREE_BYTES = 64 << 20
"""Room that uploads leave on the disk, for the database. [byte]"""


class Spool:
    """Temporary files of bodies.

    Parameters
    ----------
    folder : Path
        On the disk of the blobs if they are in a folder: a file then becomes a blob without a copy.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder.resolve()
        self._lock = threading.Lock()
        self._in_memory = 0

    def open(self, *, alone: bool) -> None:
        """Create the folder, and delete what killed servers left in it.

        Parameters
        ----------
        alone : bool
            No other process uses the folder, so that all files are left-overs.
        """
        self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        self.delete_old(0.0 if alone else MIN_AGE_S)

    def delete_old(self, age_s: float = MIN_AGE_S) -> None:
        """Delete files that were not written for some time."""
        before = time.time() - age_s
        for path in self._folder.iterdir():
            with suppress(FileNotFoundError):
                if path.stat().st_mtime <= before:
                    path.unlink()

    def check_room(self, size: int) -> None:
        """Refuse a body that has no room on the disk.

        Raises
        ------
        StorageFull
        """
        if size > IN_MEMORY_BYTES and shutil.disk_usage(self._folder).free < size + KEPT_FREE_BYTES:
            raise StorageFull("the folder for uploads")

    @contextmanager
    def writing(self, *, on_disk: bool = False) -> Iterator[SpoolWriter]:
        """A new file, deleted at the end of the block unless it was moved away."""
        writer = self.create(on_disk=on_disk)
        try:
            yield writer
        finally:
            writer.discard()

    def create(self, *, on_disk: bool = False) -> SpoolWriter:
        """A new file; `SpoolWriter.discard` deletes it.

        Parameters
        ----------
        on_disk : bool
            Do not hold it in memory, however small it is.
        """
        return SpoolWriter(self, self._folder / uuid.uuid4().hex, on_disk=on_disk)

    def take_memory(self, size: int) -> bool:
        """Reserve memory for a body; False if there is none left."""
        with self._lock:
            if self._in_memory + size > ALL_IN_MEMORY_BYTES:
                return False
            self._in_memory += size
            return True

    def give_memory_back(self, size: int) -> None:
        """Memory is free again."""
        with self._lock:
            self._in_memory -= size


class SpoolWriter:
    """A file while it is written, by one thread at a time."""

    def __init__(self, spool: Spool, path: Path, *, on_disk: bool) -> None:
        self._spool, self._path = spool, path
        self._blocks: list[bytes] = []
        self._waiting = 0
        """Bytes in `_blocks`. [byte]"""
        self._reserved = 0
        self._on_disk = on_disk
        self._stream: BinaryIO | None = None
        self._digest = hashlib.sha256()
        self._file: SpooledFile | None = None
        self.size = 0

    def add(self, chunk: bytes) -> bool:
        """Add bytes. Returns whether `flush` has to be called before the next ones, in a thread: it writes."""
        self._blocks.append(chunk)
        self._waiting += len(chunk)
        self.size += len(chunk)
        if self._on_disk:
            return self._waiting >= BLOCK_BYTES
        if self.size <= IN_MEMORY_BYTES and self._spool.take_memory(len(chunk)):
            self._reserved += len(chunk)
            return False
        self._on_disk = True
        return True

    def flush(self) -> None:
        """Write what is waiting to the disk.

        Raises
        ------
        StorageFull, Unavailable
            There is no room, or the disk failed.
        """
        try:
            if self._stream is None:
                descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
                self._stream = os.fdopen(descriptor, "wb", buffering=0)
            for block in self._blocks:
                self._digest.update(block)
                view = memoryview(block)
                while view:
                    view = view[self._stream.write(view) :]
        except OSError as error:
            if is_disk_full(error):
                raise StorageFull("the folder for uploads") from error
            raise Unavailable("the folder for uploads cannot be written", cure="try again later") from error
        self._blocks.clear()
        self._waiting = 0
        self._give_memory_back()

    def write(self, chunk: bytes) -> None:
        """Add bytes, and write them if it is time to."""
        if self.add(chunk):
            self.flush()

    def finish(self) -> SpooledFile:
        """The file, complete. Without `flush` before, small ones stay in memory."""
        if self._file is None:
            if self._on_disk:
                self.flush()
                assert self._stream is not None
                self._stream.close()
                self._file = SpooledFile(data=None, path=self._path, size=self.size, sha256=self._digest.hexdigest())
            else:
                self._file = SpooledFile.of(b"".join(self._blocks))
                self._blocks.clear()
        return self._file

    @property
    def is_on_disk(self) -> bool:
        """Whether the content was or will be written to the disk."""
        return self._on_disk

    def discard(self) -> None:
        """Delete the file, unless it was moved away."""
        self._blocks.clear()
        self._give_memory_back()
        if self._stream is not None:
            self._stream.close()
            self._path.unlink(missing_ok=True)

    def _give_memory_back(self) -> None:
        self._spool.give_memory_back(self._reserved)
        self._reserved = 0
