"""An uploaded file as readers and decoder processes get it: small ones as bytes, others by their path."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path
from typing import BinaryIO

HEAD_BYTES = 1 << 16
"""As much as detection of formats looks at. [byte] Source: chosen by hand."""
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
