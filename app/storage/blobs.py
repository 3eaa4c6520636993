"""Blobs: uploads in a local folder or an S3 bucket, written once under keys that the server chose."""

from __future__ import annotations

import os
import re
import uuid
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote, urlsplit

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError
from obstore.store import LocalStore, ObjectStore, from_url

from app.errors import Conflict, InvalidParameter, NotFound, Unavailable

_CHUNK_BYTES = 5 * 1024**2  # source: S3's smallest part of an upload
_KEY = re.compile(r"[a-z]+/[0-9a-f]{2}/[0-9a-f]{32}")
_URL = "file:///FOLDER or s3://BUCKET/PREFIX"


def new_blob_key(kind: str) -> str:
    """A new random key, which depends neither on the client nor on the content."""
    name = uuid.uuid4().hex
    return f"{kind}/{name[:2]}/{name}"


class Blobs:
    """Create-once store of bytes.

    Parameters
    ----------
    url : str
        ``file:///FOLDER`` or ``s3://BUCKET/PREFIX``; credentials and endpoint of S3 come from AWS_* variables.

    Raises
    ------
    InvalidParameter
        The URL names no store that is supported.
    """

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        self._url = url
        self._folder: Path | None = None
        self._opened: ObjectStore | None = None
        if parts.scheme == "file" and not parts.netloc and parts.path:
            self._folder = Path(unquote(parts.path))
        elif parts.scheme != "s3" or not parts.netloc:
            raise InvalidParameter(f"no blob store at {url!r}", field="blobs_url", limit=_URL)

    def open(self) -> None:
        """Create the folder, or prepare the client."""
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            self._opened = LocalStore(self._folder)
        else:
            self._opened = from_url(self._url)

    @property
    def _store(self) -> ObjectStore:
        if self._opened is None:
            raise Unavailable("the blob store is not open")
        return self._opened

    def put(self, key: str, data: bytes, *, durable: bool = False) -> None:
        """Write a blob that does not exist yet.

        Parameters
        ----------
        key : str
            From `new_blob_key`.
        data : bytes
        durable : bool
            On a local folder, return only when the bytes would survive a power failure. S3 always does.

        Raises
        ------
        Conflict
            The key is taken.
        """
        _check_key(key)
        try:
            obstore.put(self._store, key, data, mode="create", use_multipart=False)
        except AlreadyExistsError as error:
            raise Conflict(f"blob {key} exists") from error
        except (BaseError, OSError) as error:
            raise Unavailable("the blob store does not answer", cure="try again in a few seconds") from error
        if durable:
            self._make_durable(key)

    def put_file(self, key: str, path: Path) -> None:
        """Write a blob from a file, a few megabytes at a time; it survives a power failure.

        Parameters
        ----------
        key : str
            From `new_blob_key`, and not used before: unlike `put`, this cannot refuse a taken one.
        path : Path
        """
        _check_key(key)
        try:
            obstore.put(self._store, key, path, chunk_size=_CHUNK_BYTES, max_concurrency=2)
        except (BaseError, OSError) as error:
            raise Unavailable("the blob store does not answer", cure="try again in a few seconds") from error
        self._make_durable(key)

    def stream(self, key: str) -> Iterator[bytes]:
        """Content of a blob, a few megabytes at a time.

        Raises
        ------
        NotFound
            There is none.
        """
        _check_key(key)
        try:
            found = obstore.get(self._store, key)
        except FileNotFoundError as error:
            raise NotFound(f"blob {key} is gone") from error
        except (BaseError, OSError) as error:
            raise Unavailable("the blob store does not answer", cure="try again in a few seconds") from error
        return (bytes(chunk) for chunk in found.stream(min_chunk_size=_CHUNK_BYTES))

    def _make_durable(self, key: str) -> None:
        if self._folder is not None:
            path = self._folder / key
            for place in (path, path.parent, path.parent.parent):
                _sync(place)

    def get(self, key: str) -> bytes:
        """Content of a blob.

        Raises
        ------
        NotFound
            There is none.
        """
        _check_key(key)
        try:
            return bytes(obstore.get(self._store, key).bytes())
        except FileNotFoundError as error:
            raise NotFound(f"blob {key} is gone") from error
        except (BaseError, OSError) as error:
            raise Unavailable("the blob store does not answer", cure="try again in a few seconds") from error

    def delete(self, key: str) -> None:
        """Remove a blob; one that is gone already is no error."""
        _check_key(key)
        try:
            obstore.delete(self._store, key)
        except FileNotFoundError:
            return
        except (BaseError, OSError) as error:
            raise Unavailable("the blob store does not answer", cure="try again in a few seconds") from error


def _check_key(key: str) -> None:
    if not _KEY.fullmatch(key):
        raise InvalidParameter(f"{key!r} is no blob key")


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
