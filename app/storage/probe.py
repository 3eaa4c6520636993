"""Whether a folder can be written: there is room, and a file in it can be made durable."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

MIN_FREE_BYTES = 1024**2
"""Room below which a folder counts as full. [byte] Chosen by hand: more than most requests store."""
_FILE = ".probe"
_VALID_S = 1.0
"""How long a result is valid: whoever asks often does not keep the disk busy. [s]"""


class FolderProbe:
    """Writes a small file into folders, at most once a second.

    Parameters
    ----------
    folders : set of Path
    """

    def __init__(self, folders: set[Path]) -> None:
        self._folders = folders
        self._lock = threading.Lock()
        self._result, self._until_s = False, float("-inf")

    def is_writable(self) -> bool:
        """Whether each of the folders can be written."""
        with self._lock:
            if time.monotonic() >= self._until_s:
                self._result = all(map(_is_writable, self._folders))
                self._until_s = time.monotonic() + _VALID_S
            return self._result


def _is_writable(folder: Path) -> bool:
    try:
        status = os.statvfs(folder)
        if status.f_bavail * status.f_frsize < MIN_FREE_BYTES:
            return False
        path = folder / _FILE
        with path.open("wb") as file:
            file.write(b"waymark")
            file.flush()
            os.fsync(file.fileno())
        path.unlink()
    except OSError:
        return False
    return True
