"""Files by name, as bytes or open streams, read in pieces and counted while they are read."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from app.errors import UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.archives import ArchiveLimits, count_members, is_archive, is_file
from app.formats.spooled_file import SpooledFile
from app.formats.traces.declaration import TraceLimits

BLOCK_BYTES = 4 * 1024**2
"""Bytes that are read at a time. Source: chosen by hand, bounds the memory."""
_HEAD = 65536  # [byte] by which formats are detected; source: by hand
_MAX_MEMBERS = 32  # files of an archive; source: by hand, a recorder writes three
_MAX_RATIO = 400  # expanded over compressed size; source: by hand, deflate reaches 1032 with zeros only
_DEFECTS = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, ValueError, RuntimeError)


@dataclass(slots=True)
class Part:
    """A file of an upload.

    Attributes
    ----------
    name : str
        Shown in messages; its suffix is a hint.
    head : bytes
        Its beginning.
    stream : BinaryIO
        The rest.
    limit_bytes : int
        Largest size, expanded. [byte]
    """

    name: str
    head: bytes
    stream: BinaryIO
    limit_bytes: int

    def blocks(self) -> Iterator[bytes]:
        """The content in pieces.

        Raises
        ------
        UploadTooLarge
            The limit is passed.
        UnreadableUpload
            The archive that holds it is damaged here.
        """
        size, block = 0, self.head
        while block:
            size += len(block)
            if size > self.limit_bytes:
                raise self.too_large()
            yield block
            block = _read(self.stream, BLOCK_BYTES, self.name)

    def too_large(self) -> UploadTooLarge:
        """The error of a file that passes its limit."""
        return UploadTooLarge(
            f"{self.name} is too large",
            field=self.name,
            limit=f"{self.limit_bytes} bytes expanded",
            cure="cut the recording into shorter ones",
        )

    def as_file(self) -> SpooledFile:
        """All of it, as a file; one in an archive, or in memory, is held in memory.

        Raises
        ------
        UploadTooLarge
            The limit is passed.
        """
        name = getattr(self.stream, "name", None)
        path = Path(name) if isinstance(self.stream, io.BufferedReader) and isinstance(name, str | Path) else None
        if path is None:
            return SpooledFile.of(self.content())
        found = SpooledFile.at(path)
        if found.size > self.limit_bytes:
            raise self.too_large()
        return found

    def content(self) -> bytes:
        """All of it."""
        return b"".join(self.blocks())


def open_parts(parts: Mapping[str, bytes | BinaryIO], limits: TraceLimits) -> list[Part]:
    """Open files, and those within ZIP archives. A stream that is an archive is sought in, so it has to allow that.

    Raises
    ------
    UnreadableUpload
        No file, an empty file, a damaged archive.
    """
    opened: list[Part] = []
    for name, content in parts.items():
        stream: BinaryIO = io.BytesIO(content) if isinstance(content, bytes | bytearray | memoryview) else content
        part = Part(_printable(name), _read(stream, _HEAD, name), stream, limits.file_bytes)
        if is_archive(part.head):
            opened += _members(part, limits)
        else:
            opened.append(part)
    if not opened:
        raise UnreadableUpload("there is no file", field="parts", limit="one or more", cure="send the recording")
    for part in opened:
        if not part.head:
            raise UnreadableUpload(
                f"{part.name} is empty", field=part.name, limit="at least one sample", cure="send the file again, whole"
            )
    return opened


def _members(archive: Part, limits: TraceLimits) -> list[Part]:
    if archive.stream.seek(0, io.SEEK_END) > archive.limit_bytes:
        raise archive.too_large()
    count_members(archive.stream, ArchiveLimits(members=_MAX_MEMBERS, total_bytes=limits.file_bytes))
    opened = []
    try:
        packed = zipfile.ZipFile(archive.stream)
        for info in packed.infolist():
            if not is_file(info):
                continue
            if info.flag_bits & 1 or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise UnsupportedUpload(
                    f"{_printable(info.filename)} is encrypted or compressed by another method than deflate",
                    field=archive.name,
                    limit="stored or deflate",
                    cure="pack it again as a plain ZIP",
                )
            stream = packed.open(info)  # read later, piece by piece
            name = _printable(info.filename)
            limit = min(limits.file_bytes, max(info.compress_size, 1024) * _MAX_RATIO)
            opened.append(Part(name, _read(stream, _HEAD, name), stream, limit))  # type: ignore[arg-type]
    except _DEFECTS as error:
        raise UnreadableUpload(
            f"{archive.name} is damaged or cut short", field=archive.name, cure="pack it again and send it whole"
        ) from error
    return opened


def _read(stream: BinaryIO, size: int, name: str) -> bytes:
    try:
        return stream.read(size)
    except _DEFECTS as error:
        raise UnreadableUpload(
            f"{name} is damaged or cut short in its archive", field=name, cure="pack it again and send it whole"
        ) from error


def _printable(name: str) -> str:
    last = name.replace("\\", "/").rsplit("/", 1)[-1]
    return "".join(c if c.isprintable() and not 0xD800 <= ord(c) <= 0xDFFF else "?" for c in last)[:120]
