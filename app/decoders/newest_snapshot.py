"""Open snapshots, and remember the newest one: a reader that has seen it refuses older ones.

The memory is a small file. Everything that decides is in `app.decoders.snapshot`.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import orjson

from app.decoders.snapshot import Snapshot, open_snapshot
from app.errors import UnreadableUpload
from app.markers.snapshot import Trust


class UnreadableMemory(UnreadableUpload):
    """The file that remembers the newest snapshot cannot be read; without it a rollback cannot be detected."""


def open_newest_snapshot(data: bytes, trust: Trust, now: datetime, memory: Path) -> Snapshot:
    """Verify a snapshot and read it, unless a newer one of the agency was opened before with the same memory.

    A reader that uses snapshots of several areas keeps one memory for each area: snapshots of different areas were made
    at different times.

    Parameters
    ----------
    data, trust, now
        As of `app.decoders.snapshot.open_snapshot`.
    memory : Path
        File with the time of the newest snapshot of each agency; created if it is missing. It is replaced atomically,
        and is on the disk before the snapshot is returned. Processes may share it.

    Raises
    ------
    SnapshotRefused
        As of `open_snapshot`. The memory is unchanged.
    UnreadableMemory
        The memory is damaged.
    OSError
        The memory cannot be read or written.
    """
    with _locked(memory.parent) as folder:
        newest = _read(memory)
        snapshot = open_snapshot(data, trust, now, newest_made_at_ms=newest.get(trust.agency_id))
        if newest.get(trust.agency_id) != snapshot.made_at_ms:
            _replace(memory, {**newest, trust.agency_id: snapshot.made_at_ms}, folder)
    return snapshot


@contextmanager
def _locked(folder: Path) -> Iterator[int]:
    """Descriptor of a folder that no other process locks meanwhile."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield descriptor
    finally:
        os.close(descriptor)


def _read(memory: Path) -> dict[str, int]:
    try:
        newest = orjson.loads(memory.read_bytes())
    except FileNotFoundError:
        return {}
    except orjson.JSONDecodeError:
        newest = None
    if not isinstance(newest, dict) or not all(type(made_at_ms) is int for made_at_ms in newest.values()):
        raise UnreadableMemory(
            f"{memory} is damaged",
            limit="an object of times by agency",
            cure="restore it; or remove it, and open a snapshot that was just fetched from the server",
        )
    return newest


def _replace(memory: Path, newest: dict[str, int], folder: int) -> None:
    """Write the file so that it is either the old or the new one after a loss of power."""
    fresh = memory.with_name(memory.name + ".new")
    with fresh.open("wb") as file:
        file.write(orjson.dumps(newest))
        file.flush()
        os.fsync(file.fileno())
    fresh.replace(memory)
    os.fsync(folder)
