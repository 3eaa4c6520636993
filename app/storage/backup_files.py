"""The files of a backup: a folder, or the same folder as one tar file, in which every member has its SHA-256.

``members.sha256`` has the format of sha256sum: ``sha256sum -c members.sha256`` verifies a folder without Waymark.
A backup that was not finished never has the name that was asked for.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
import secrets
import shutil
import tarfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import IO, Protocol

from app.errors import InvalidParameter

MANIFEST, MANIFEST_HASH, MEMBERS = "manifest.json", "manifest.sha256", "members.sha256"
TAR_SUFFIX = ".tar"
_CHUNK_BYTES = 1024**2
_SPOOLED_BYTES = 32 * 1024**2
_LINE = re.compile(r"([0-9a-f]{64})  ([A-Za-z0-9_][A-Za-z0-9_.-]*(?:/[A-Za-z0-9_][A-Za-z0-9_.-]*)*)")
"""A line of sha256sum. No part of a name starts with a dot, so that none leaves the folder."""


class DamagedBackup(InvalidParameter):
    """A backup is not complete, or was changed."""


class _Sink(Protocol):
    def add(self, name: str, content: IO[bytes]) -> None: ...
    def finish(self, target: Path) -> None: ...
    def discard(self) -> None: ...


class BackupWriter:
    """Writes members; `finish` gives the backup its name.

    Attributes
    ----------
    hashes : dict
        SHA-256 of each member so far, by name.
    size_bytes : int
        Of all members. [byte]
    """

    def __init__(self, sink: _Sink) -> None:
        self._sink = sink
        self.hashes: dict[str, str] = {}
        self.size_bytes = 0

    def add(self, name: str, chunks: Iterable[bytes]) -> None:
        """Write a member."""
        digest = hashlib.sha256()
        with SpooledTemporaryFile(_SPOOLED_BYTES) as spooled:
            for chunk in chunks:
                digest.update(chunk)
                spooled.write(chunk)
            self.size_bytes += spooled.tell()
            spooled.seek(0)
            self._sink.add(name, spooled)
        self.hashes[name] = digest.hexdigest()

    def add_file(self, name: str, path: Path) -> None:
        """Write a member from a file."""
        with path.open("rb") as file:
            self.hashes[name] = hashlib.file_digest(file, "sha256").hexdigest()
            self.size_bytes += file.tell()
            file.seek(0)
            self._sink.add(name, file)

    def add_index(self) -> str:
        """Write the list of the members' hashes, and return its own hash."""
        listed = "".join(f"{digest}  {name}\n" for name, digest in sorted(self.hashes.items())).encode()
        self._sink.add(MEMBERS, io.BytesIO(listed))
        return hashlib.sha256(listed).hexdigest()

    def add_manifest(self, manifest: bytes) -> None:
        """Write the manifest and its hash, the last members."""
        self._sink.add(MANIFEST, io.BytesIO(manifest))
        line = f"{hashlib.sha256(manifest).hexdigest()}  {MANIFEST}\n"
        self._sink.add(MANIFEST_HASH, io.BytesIO(line.encode()))


@contextmanager
def new_backup(target: Path) -> Iterator[BackupWriter]:
    """A backup that gets its name, durably, when the block ends without an error; otherwise nothing is left.

    Raises
    ------
    InvalidParameter
        There is something under this name already, or its folder does not exist.
    """
    if target.exists():
        raise InvalidParameter(f"{target} already exists", cure="remove it, or choose another name")
    if not target.absolute().parent.is_dir():
        raise InvalidParameter(f"{target.absolute().parent} is not a folder", cure="create it first")
    partial = target.with_name(f".{target.name}.{secrets.token_hex(4)}.partial")
    sink: _Sink = _TarSink(partial) if target.suffix == TAR_SUFFIX else _FolderSink(partial)
    try:
        yield BackupWriter(sink)
        sink.finish(target)
    except BaseException:
        sink.discard()
        raise
    _sync(target.absolute().parent)


class _FolderSink:
    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(mode=0o700)  # rows of all agencies, hashes of keys, pictures

    def add(self, name: str, content: IO[bytes]) -> None:
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("xb") as file:
            shutil.copyfileobj(content, file, _CHUNK_BYTES)

    def finish(self, target: Path) -> None:
        for place, _folders, names in os.walk(self._folder):  # by now the kernel has written most of them
            for name in names:
                _sync(Path(place, name))
            _sync(Path(place))
        self._folder.rename(target)

    def discard(self) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)


class _TarSink:
    def __init__(self, path: Path) -> None:
        self._path = path
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        self._file = os.fdopen(descriptor, "r+b")
        self._tar = tarfile.TarFile(fileobj=self._file, mode="w", format=tarfile.PAX_FORMAT)

    def add(self, name: str, content: IO[bytes]) -> None:
        member = tarfile.TarInfo(name)
        content.seek(0, os.SEEK_END)
        member.size, member.mode = content.tell(), 0o600
        content.seek(0)
        self._tar.addfile(member, content)

    def finish(self, target: Path) -> None:
        self._tar.close()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        self._path.rename(target)

    def discard(self) -> None:
        with suppress(OSError, ValueError):
            self._file.close()
        self._path.unlink(missing_ok=True)


# --- reading --------------------------------------------------------------------------------------------------------


class BackupReader:
    """Reads a backup; `verify` compares every member with its hash."""

    def __init__(self, members: dict[str, Path | tarfile.TarInfo], tar: tarfile.TarFile | None) -> None:
        self._members, self._tar = members, tar

    def names(self) -> set[str]:
        """Names of all members."""
        return set(self._members)

    def stream(self, name: str) -> Iterator[bytes]:
        """Content of a member, part by part.

        Raises
        ------
        DamagedBackup
            There is no such member, or the file ends in it.
        """
        member = self._members.get(name)
        if member is None:
            raise DamagedBackup(f"{name} is missing from the backup", cure="use another backup")
        try:
            if isinstance(member, Path):
                file: IO[bytes] | None = member.open("rb")
            else:
                assert self._tar is not None
                file = self._tar.extractfile(member)
            assert file is not None
            with file:
                while chunk := file.read(_CHUNK_BYTES):
                    yield chunk
        except (tarfile.TarError, OSError) as error:
            raise DamagedBackup(f"{name} cannot be read: {error}", cure="use another backup") from error

    def read(self, name: str) -> bytes:
        """Content of a small member."""
        return b"".join(self.stream(name))

    def extract(self, name: str, target: Path) -> None:
        """Write a member to a new file, durably."""
        with target.open("xb") as file:
            for chunk in self.stream(name):
                file.write(chunk)
            file.flush()
            os.fsync(file.fileno())

    def read_manifest(self) -> bytes:
        """The manifest, verified by its hash."""
        manifest = self.read(MANIFEST)
        if self.read(MANIFEST_HASH) != f"{hashlib.sha256(manifest).hexdigest()}  {MANIFEST}\n".encode():
            raise _differs(MANIFEST)
        return manifest

    def verify(self, index_sha256: str) -> dict[str, str]:
        """Compare every member with its hash; returns the hashes by name.

        Raises
        ------
        DamagedBackup
            A member is missing, was changed, or is not listed.
        """
        listed = self.read(MEMBERS)
        if hashlib.sha256(listed).hexdigest() != index_sha256:
            raise _differs(MEMBERS)
        hashes = {}
        for line in listed.decode("ascii", "replace").splitlines():
            if (found := _LINE.fullmatch(line)) is None:
                raise DamagedBackup(f"{MEMBERS} has a line that is none: {line[:80]!r}")
            hashes[found[2]] = found[1]
        for name, expected in hashes.items():
            digest = hashlib.sha256()
            for chunk in self.stream(name):
                digest.update(chunk)
            if digest.hexdigest() != expected:
                raise _differs(name)
        if others := self.names() - set(hashes) - {MANIFEST, MANIFEST_HASH, MEMBERS}:
            raise DamagedBackup(f"{min(others)} does not belong to the backup", cure="remove it, or use another backup")
        return hashes


@contextmanager
def open_backup(path: Path) -> Iterator[BackupReader]:
    """A backup to read.

    Raises
    ------
    DamagedBackup
        This is no backup.
    """
    if path.is_dir():
        files = (Path(place, name) for place, _folders, names in os.walk(path) for name in names)
        yield BackupReader({str(file.relative_to(path)): file for file in files}, None)
        return
    try:
        with tarfile.open(path, "r:") as tar:
            yield BackupReader({member.name: member for member in tar.getmembers() if member.isfile()}, tar)
    except (tarfile.TarError, OSError) as error:
        raise DamagedBackup(f"{path} is not a backup, or is cut off: {error}", cure="use another backup") from error


def _differs(name: str) -> DamagedBackup:
    return DamagedBackup(f"{name} differs from its hash: the backup was changed", cure="use another backup")


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
