"""Formats of uploaded files, a name, a way to detect it and a way to read it; the files themselves, and archives."""

from __future__ import annotations

import hashlib
import io
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, Generic, TypeVar

from app.errors import UnreadableUpload, UnsupportedUpload, UploadTooLarge, WaymarkError
from app.formats.text import DelimitedLog, decode_text, is_clean_text, is_text

# === An uploaded file as readers and decoder processes get it: small ones as bytes, others by their path.


HEAD_BYTES = 1 << 16
"""As much as detection of formats looks at. [byte]"""
_BLOCK_BYTES = 1 << 20


class SpooledFile:
    """Content of an upload. It can be pickled: a large one crosses a pipe as its path, which the other process opens.

    Whoever made it deletes the file; nothing here does.

    Parameters
    ----------
    data : bytes or None
        All of it, if it is held in memory.
    path : Path or None
        Absolute path of the file that holds it. The server chose the name, which does not depend on the content.
    size : int
        [byte]
    sha256 : str, optional
        In hexadecimal digits, if it is known.

    Attributes
    ----------
    path : Path or None
        None for a small file that is held in memory. The file of a job always has a path.
    size : int
        [byte]
    """

    __slots__ = ("_data", "_sha256", "path", "size")

    def __init__(self, *, data: bytes | None, path: Path | None, size: int, sha256: str | None = None) -> None:
        if (data is None) == (path is None):
            raise ValueError("a file is held in memory, or it has a path")
        self._data, self.path, self.size, self._sha256 = data, path, size, sha256

    @classmethod
    def of(cls, data: bytes) -> SpooledFile:
        """A file that is held in memory."""
        return cls(data=data, path=None, size=len(data))

    @classmethod
    def at(cls, path: Path, *, sha256: str | None = None) -> SpooledFile:
        """A file on this machine."""
        return cls(data=None, path=path.resolve(), size=path.stat().st_size, sha256=sha256)

    @property
    def sha256(self) -> str:
        """In hexadecimal digits. If it was not computed while the file arrived, the file is read for it."""
        if self._sha256 is None:
            digest = hashlib.sha256()
            with self.open() as stream:
                while block := stream.read(_BLOCK_BYTES):
                    digest.update(block)
            self._sha256 = digest.hexdigest()
        return self._sha256

    def head(self, size: int = HEAD_BYTES) -> bytes:
        """The first bytes."""
        if self._data is not None:
            return self._data[:size]
        with self.open() as stream:
            return stream.read(size)

    def open(self) -> BinaryIO:
        """A stream over the content, which can be sought."""
        if self._data is not None:
            return io.BytesIO(self._data)
        assert self.path is not None
        return self.path.open("rb")

    def read(self) -> bytes:
        """All of the content. Only for readers that need it whole, in a decoder process or after a check of `size`."""
        if self._data is not None:
            return self._data
        with self.open() as stream:
            return stream.read()


# === What a format of uploaded files is: a name, a way to detect it and a way to read it.


ReadT_co = TypeVar("ReadT_co", covariant=True)


class Use(StrEnum):
    """What the files of a format are used for."""

    FRAME = "frame"
    TRACE = "trace"
    PACKETS = "packets"
    POSES = "poses"
    SURVEY = "survey"
    ALIGNMENT = "alignment"


class Confidence(IntEnum):
    """How sure it is that a file has a format.

    `POSSIBLE` is enough where the use is declared (any text can be CSV), `PLAUSIBLE` where it has to be guessed. Known
    column names make a format `LIKELY`, a signature makes it `CERTAIN`.
    """

    NONE = 0
    POSSIBLE = 1
    PLAUSIBLE = 2
    LIKELY = 3
    CERTAIN = 4


@dataclass(frozen=True)
class Sample:
    """What detection looks at."""

    name: str  # of the file; its suffix is a hint
    data: bytes  # the file, or its beginning
    # names of columns that the uploader declares, by quantity
    declared: Mapping[str, str] = field(default_factory=dict)

    @property
    def suffix(self) -> str:
        """With its dot, in lower case."""
        return "." + self.name.rsplit(".", 1)[-1].lower()

    @cached_property
    def is_text(self) -> bool:
        """Whether it looks like text, possibly damaged."""
        return is_text(self.data)

    @cached_property
    def is_clean_text(self) -> bool:
        """Whether it looks like undamaged text in ASCII or UTF-8."""
        return is_clean_text(self.data)

    @cached_property
    def decoded(self) -> tuple[str, str | None]:
        """Its text, and a warning about the encoding or None."""
        return decode_text(self.name, self.data)

    @property
    def text(self) -> str:
        """Its text."""
        return self.decoded[0]

    @cached_property
    def start(self) -> str:
        """The first characters of the text, without blanks before them."""
        return self.text[:_START_CHARS].lstrip("\ufeff \t\r\n")

    @cached_property
    def log(self) -> DelimitedLog:
        """The text as a table with a header."""
        return DelimitedLog.open(self.text)


_START_CHARS = 1 << 16  # [character]


@dataclass(frozen=True, slots=True)
class Format(Generic[ReadT_co]):
    """A format of uploaded files."""

    name: str  # as reports and declarations have it
    use: Use
    description: str  # for messages that list what is accepted
    detect: Callable[[Sample], Confidence]  # how sure it is that a sample has this format
    read: ReadT_co  # reads a file; each use has its own parameters


def detect_format(
    sample: Sample, formats: Iterable[Format[ReadT_co]], at_least: Confidence = Confidence.POSSIBLE
) -> Format[ReadT_co] | None:
    """The format that fits a sample best, the first of several; None if none is as likely as asked for."""
    rated = [(found.detect(sample), found) for found in formats]
    confidence, best = max(rated, key=lambda pair: pair[0])
    return best if confidence >= at_least else None


def list_accepted(formats: Iterable[Format[object]]) -> str:
    """Descriptions of formats, for a message."""
    return ", ".join(found.description for found in formats)


def detect_signature(*signatures: bytes) -> Callable[[Sample], Confidence]:
    """Detection by the first bytes."""

    def detect(sample: Sample) -> Confidence:
        return Confidence.CERTAIN if sample.data.startswith(signatures) else Confidence.NONE

    return detect


# === ZIP archives of frames, opened without trusting their headers.
#
# Names are for people only, never paths. Sizes are counted while inflating, never taken from a header.


Source = bytes | BinaryIO | SpooledFile
"""An archive: its bytes, a stream that can be sought, or a file. Only its directory and one file are in memory."""

FIELD = "file"
ZIP_MAGIC = b"PK\x03\x04"
_EOCD = b"PK\x05\x06"
_ZIP64_LOCATOR = b"PK\x06\x07"
NAME_LENGTH = 120
"""[character] of a name, without its folder."""
_ENCRYPTED = 0x1  # bit 0 of the flags; PKWARE APPNOTE, section 4.4.4
_CHUNK = 1 << 16  # [byte] inflated at a time
_TAIL_BYTES = 20 + 22 + 65535
"""Locator, end of the directory and longest comment. [byte] Source: PKWARE APPNOTE, sections 4.3.15 and 4.3.16."""
_DEFECTS = (
    zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, ValueError, NotImplementedError, RuntimeError
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class ArchiveLimits:
    """Limits of an archive."""

    members: int = 500  # largest number of frames
    # `member_bytes`, `total_bytes`: [byte] largest size of one frame and of all, as stored in the archive's files
    member_bytes: int = 32 * 1024**2
    total_bytes: int = 512 * 1024**2
    ratio: float = 50.0  # largest expansion of one compressed byte; pictures are compressed already


@dataclass(frozen=True, slots=True)
class Member:
    """One file of an archive: its bytes, or the error that prevented reading it."""

    index: int
    name: str
    data: bytes = b""
    error: WaymarkError | None = None


def is_archive(data: bytes) -> bool:
    """Whether the bytes begin like a ZIP archive."""
    return data.startswith((ZIP_MAGIC, _EOCD))


def count_members(data: Source, limits: ArchiveLimits | None = None) -> int:
    """Number of files in an archive, after checking its directory.

    Raises
    ------
    UnreadableUpload
        Damaged or empty.
    UploadTooLarge
        More members than the limit.
    UnsupportedUpload
        ZIP64, which nothing below 4 GiB needs.
    """
    with _open(data, limits or ArchiveLimits()) as archive:
        return len(_files(archive))


def list_names(data: Source, limits: ArchiveLimits | None = None) -> list[str]:
    """Names of the files of an archive, as `Member.name` has them; raises as `count_members`."""
    with _open(data, limits or ArchiveLimits()) as archive:
        return [_printable(info.filename) for info in _files(archive)]


def read_members(
    data: Source, limits: ArchiveLimits | None = None, *, start: int = 0, only: Callable[[str], bool] | None = None
) -> Iterator[Member]:
    """Inflate an archive file by file; a file that breaks a rule is reported and the rest goes on.

    Raises
    ------
    UnreadableUpload, UploadTooLarge, UnsupportedUpload
        As `count_members`; or all files together exceed the limit, which ends the iteration.
    """
    limits = limits or ArchiveLimits()
    spent = 0
    with _open(data, limits) as archive:
        for index, info in enumerate(_files(archive)):
            name = _printable(info.filename)
            if index < start or (only is not None and not only(name)):
                continue
            try:
                content = _inflate(archive, info, limits)
            except WaymarkError as error:
                yield Member(index, name, error=error)
                continue
            spent += len(content)
            if spent > limits.total_bytes:
                raise UploadTooLarge(
                    "the archive's files are too large together",
                    field=FIELD,
                    limit=f"{limits.total_bytes} bytes when expanded",
                    cure="send several smaller archives",
                )
            yield Member(index, name, content)


def read_member(data: Source, index: int, limits: ArchiveLimits | None = None) -> Member:
    """One file of an archive."""
    for member in read_members(data, limits, start=index):
        return member
    raise UnreadableUpload(f"the archive has no file {index}", field="frame")


@contextmanager
def _open(source: Source, limits: ArchiveLimits) -> Iterator[zipfile.ZipFile]:
    with ExitStack() as stack:
        if isinstance(source, bytes):
            stream: BinaryIO = io.BytesIO(source)
        elif isinstance(source, SpooledFile):
            stream = stack.enter_context(source.open())
        else:
            stream = source
        _check_directory(stream, limits)
        try:
            archive = stack.enter_context(zipfile.ZipFile(stream))
        except _DEFECTS as error:
            raise _damaged() from error
        count = len(_files(archive))
        if count == 0:
            raise UnreadableUpload("the archive is empty", field=FIELD, limit="at least one frame")
        if count > limits.members:
            raise _too_many(limits)
        yield archive


def _check_directory(stream: BinaryIO, limits: ArchiveLimits) -> None:
    """Bound the directory before it is parsed: a large one costs a kilobyte of memory per 46 bytes."""
    size = stream.seek(0, io.SEEK_END)
    stream.seek(max(size - _TAIL_BYTES, 0))
    data = stream.read(_TAIL_BYTES)
    at = len(data) - 22 if data[-22:-18] == _EOCD and data[-2:] == b"\x00\x00" else data.rfind(_EOCD, -(22 + 65535))
    if at < 0 or at + 22 > len(data):
        raise _damaged()
    (directory_bytes,) = struct.unpack_from("<I", data, at + 12)
    if data[max(at - 20, 0) : at][:4] == _ZIP64_LOCATOR or directory_bytes == 0xFFFFFFFF:
        raise UnsupportedUpload("ZIP64 archives are not read", field=FIELD, limit="plain ZIP", cure="send a plain ZIP")
    if directory_bytes > limits.members * 1024:
        raise _too_many(limits)


def is_file(info: zipfile.ZipInfo) -> bool:
    """Whether an entry is a file with a name; `ZipInfo.is_dir` raises IndexError where there is no name."""
    return info.filename != "" and not info.is_dir()


def _files(archive: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
    return [info for info in archive.infolist() if is_file(info)]


def _inflate(archive: zipfile.ZipFile, info: zipfile.ZipInfo, limits: ArchiveLimits) -> bytes:
    if info.flag_bits & _ENCRYPTED:
        raise UnsupportedUpload("the file is encrypted", field=FIELD, cure="send the frames without a password")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise UnsupportedUpload(
            "the file is compressed by a method other than deflate", field=FIELD, limit="stored or deflate"
        )
    allowed = min(limits.member_bytes, int(max(info.compress_size, 1024) * limits.ratio))
    parts, size = [], 0
    try:
        with archive.open(info) as stream:
            while part := stream.read(_CHUNK):
                size += len(part)
                if size > allowed:
                    break
                parts.append(part)
    except _DEFECTS as error:
        raise UnreadableUpload("the file is damaged in the archive", field=FIELD, cure="pack it again") from error
    if size > allowed:
        raise UploadTooLarge(
            "the file expands beyond its limit",
            field=FIELD,
            limit=f"{limits.member_bytes} bytes, {limits.ratio:g} times its compressed size",
            cure="send pictures as the camera wrote them",
        )
    return b"".join(parts)


def _printable(name: str) -> str:
    last = name.replace("\\", "/").rsplit("/", 1)[-1]
    return "".join(c if c.isprintable() and not 0xD800 <= ord(c) <= 0xDFFF else "?" for c in last)[:NAME_LENGTH]


def _damaged() -> UnreadableUpload:
    return UnreadableUpload("the archive is damaged or cut short", field=FIELD, cure="pack it again and send it whole")


def _too_many(limits: ArchiveLimits) -> UploadTooLarge:
    return UploadTooLarge(
        "the archive holds too many files",
        field=FIELD,
        limit=f"{limits.members} frames",
        cure="send several smaller archives",
    )
