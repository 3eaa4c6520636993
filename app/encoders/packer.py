"""Files into a ZIP that is the same for the same files, with what a manifest states of them."""

from __future__ import annotations

import hashlib
import zipfile

from app.values import JsonObject

_LEVEL = 1  # of the compression; for speed


class Packer:
    """Writes files into an archive and keeps their name, size and hash.

    In the caller's thread: a second one waits for the interpreter longer than the compression takes (measured).
    """

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive
        self.entries: list[dict[str, object]] = []

    def add(self, name: str, content: bytes) -> None:
        """Write a file."""
        info = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
        info.compress_type = zipfile.ZIP_STORED if name.endswith(".png") else zipfile.ZIP_DEFLATED
        info.external_attr = 0o644 << 16
        self._archive.writestr(info, content, compresslevel=_LEVEL)
        self.entries.append(file_entry(name, content))


def file_entry(name: str, content: bytes) -> JsonObject:
    """What a manifest states of a file."""
    return {"name": name, "size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
