"""Whether a folder can be written: there is room, and a file in it can be made durable."""

from __future__ import annotations

import os
from pathlib import Path

MIN_FREE_BYTES = 1024**2
"""Room below which a folder counts as full. [byte] Chosen by hand: more than most requests store."""
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
