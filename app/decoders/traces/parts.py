"""Files by name, as bytes or open streams, read in pieces and counted while they are read."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import BinaryIO

from app.decoders.archives import ArchiveLimits, count_members, is_archive
from app.decoders.traces.declaration import TraceFormat, TraceLimits
from app.errors import UnreadableUpload, UnsupportedUpload, UploadTooLarge

BLOCK_BYTES = 4 * 1024**2
_HEAD = 65536
_MAX_MEMBERS = 32
_MAX_RATIO = 400
_DEFECTS = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, ValueError, RuntimeError)
_CAN_SUFFIXES = (".asc", ".blf", ".trc", ".log")


@dataclass(slots=True)
class Part:
    """A file of an upload.

    Attributes
    ----------
    name : str
        For people, and its suffix as a hint.
    head : bytes
        How it begins.
    stream : BinaryIO
        What follows the head.
    limit_bytes : int
        Most bytes, expanded. [byte]
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
                raise UploadTooLarge(
                    f"{self.name} is too large",
                    field=self.name,
                    limit=f"{self.limit_bytes} bytes expanded",
                    cure="cut the recording into shorter ones",
                )
            yield block
            block = _read(self.stream, BLOCK_BYTES, self.name)

    def content(self) -> bytes:
        """All of it."""
        return b"".join(self.blocks())


def open_parts(parts: Mapping[str, bytes | BinaryIO], limits: TraceLimits) -> list[Part]:
    """Open files, and those within ZIP archives.

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
        raise UnreadableUpload("no file was given", field="parts", limit="one or more", cure="send the recording")
    for part in opened:
        if not part.head:
            raise UnreadableUpload(
                f"{part.name} is empty", field=part.name, limit="at least one sample", cure="send the file again, whole"
            )
    return opened


def detect_format(part: Part) -> TraceFormat:
    """What a file is, by how it begins; its suffix decides only between kinds of text.

    Raises
    ------
    UnsupportedUpload
        Nothing that is read here.
    """
    head, suffix = part.head, "." + part.name.rsplit(".", 1)[-1].lower()
    if head.startswith(b"PAR1"):
        return TraceFormat.PARQUET
    if head.startswith(b"LOGG"):
        return TraceFormat.CAN
    if is_text(head):
        if suffix == ".dbc" or head.lstrip().startswith((b"VERSION", b"NS_ :")):
            return TraceFormat.DBC
        if suffix in _CAN_SUFFIXES:
            return TraceFormat.CAN
        return _detect_csv(head)
    if suffix in (".csv", ".txt", ".dbc", ".asc", ".trc", ".log", ".json", ".xlsx", ".mf4", ".mat"):
        raise UnsupportedUpload(
            f"{part.name} is not the text that its name says",
            field=part.name,
            limit="CSV, Parquet, METRO stream, CAN log (asc, blf, csv, log, trc), DBC",
            cure="export it as one of these, text as UTF-8",
        )
    return TraceFormat.STREAM


def _detect_csv(head: bytes) -> TraceFormat:
    first = head.split(b"\n", 1)[0].decode("utf-8-sig", "replace")
    names = [cell.strip().strip('"').lower() for cell in first.replace(";", ",").replace("\t", ",").split(",")]
    if "arbitration_id" in names:
        return TraceFormat.CAN
    if "time stamp" in names:
        if any(n.startswith("sensor ") for n in names):
            return TraceFormat.RECORDER_FIELD
        if "speed" in names:
            return TraceFormat.RECORDER_SPEED
        if "swa" in names:
            return TraceFormat.RECORDER_STEERING
    return TraceFormat.CSV


def is_text(head: bytes) -> bool:
    """Whether bytes look like text: no control characters but white space."""
    sample = head[:4096]
    control = sum(sample.count(bytes([c])) for c in (*range(9), 11, 12, *range(14, 32), 127))
    return control == 0


def _members(archive: Part, limits: TraceLimits) -> list[Part]:
    data = archive.content()
    count_members(data, ArchiveLimits(members=_MAX_MEMBERS, total_bytes=limits.file_bytes))
    opened = []
    try:
        packed = zipfile.ZipFile(io.BytesIO(data))
        for info in packed.infolist():
            if info.is_dir():
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
