"""Blobs: uploads in a local folder or an S3 bucket, written once under keys that the server chose."""

from __future__ import annotations

import errno
import os
import re
import tempfile
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError
from obstore.store import LocalStore, ObjectStore, from_url

from app.errors import Conflict, InvalidParameter, NotFound, StorageFull, Unavailable, is_disk_full
from app.formats.format import SpooledFile

# === Uploads that go to S3 directly, part by part, with URLs that the server signs (S3's multipart uploads).


PART_BYTES = 64 * 1024**2
"""Size of each part but the last. [byte] S3 allows 5 MiB to 5 GiB, and 10,000 parts."""


class S3Parts:
    """Multipart uploads of an S3 bucket; credentials and endpoint come from AWS_* variables.

    Parameters
    ----------
    url : str
        Of the blob store.
    """

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        self._bucket = parts.netloc if parts.scheme == "s3" else ""
        self._prefix = parts.path.strip("/")
        self._made: object = None

    def start(self, key: str) -> str:
        """Begin an upload of a blob; returns its id in S3.

        Raises
        ------
        InvalidParameter
            The blobs are in a folder.
        Unavailable
            S3 does not answer, or the extra s3 is not installed.
        """
        if not self._bucket:
            raise InvalidParameter(
                "this server stores files in a folder, to which no parts can be sent directly",
                field="method",
                limit="tus",
                cure="upload by tus 1.0: POST /v1/uploads with the header Tus-Resumable: 1.0.0",
            )
        with _answering():
            answer: str = self._client().create_multipart_upload(Bucket=self._bucket, Key=self._name(key))["UploadId"]
        return answer

    def sign(self, key: str, upload_id: str, count: int, valid_s: int) -> list[str]:
        """URLs to which the parts are sent by PUT, in their order."""
        where = {"Bucket": self._bucket, "Key": self._name(key), "UploadId": upload_id}
        sign = self._client().generate_presigned_url
        return [
            sign("upload_part", Params={**where, "PartNumber": number}, ExpiresIn=valid_s)
            for number in range(1, count + 1)
        ]

    def complete(self, key: str, upload_id: str, etags: Sequence[str]) -> None:
        """Make the parts one blob; one that was completed before stays as it is.

        Raises
        ------
        InvalidParameter
            A part is missing, or has another ETag.
        """
        from botocore.exceptions import ClientError  # type: ignore[import-untyped]

        parts = [{"PartNumber": number, "ETag": etag} for number, etag in enumerate(etags, 1)]
        with _answering():
            try:
                self._client().complete_multipart_upload(
                    Bucket=self._bucket, Key=self._name(key), UploadId=upload_id, MultipartUpload={"Parts": parts}
                )
            except ClientError as error:
                code = error.response["Error"]["Code"]
                if code == "NoSuchUpload":
                    return  # whether there is a blob shows when it is opened
                if code in ("InvalidPart", "InvalidPartOrder", "EntityTooSmall"):
                    raise InvalidParameter(
                        f"S3 does not accept the parts ({code})", field="etags", cure="send all parts again"
                    ) from error
                raise

    def abort(self, key: str, upload_id: str) -> None:
        """Delete the parts of an upload that is given up."""
        from botocore.exceptions import ClientError

        with _answering():
            try:
                self._client().abort_multipart_upload(Bucket=self._bucket, Key=self._name(key), UploadId=upload_id)
            except ClientError as error:
                if error.response["Error"]["Code"] != "NoSuchUpload":
                    raise

    def _name(self, key: str) -> str:
        return f"{self._prefix}/{key}" if self._prefix else key

    def _client(self) -> Any:
        if self._made is None:
            try:
                import boto3  # type: ignore[import-untyped]
            except ImportError as error:
                raise Unavailable("the extra s3 is not installed", cure="pip install waymark-roads[s3]") from error
            self._made = boto3.client("s3")
        return self._made


@contextmanager
def _answering() -> Iterator[None]:
    """An S3 that fails or does not answer is `Unavailable`."""
    try:
        from botocore.exceptions import BotoCoreError, ClientError
    except ImportError as error:
        raise Unavailable("the extra s3 is not installed", cure="pip install waymark-roads[s3]") from error
    try:
        yield
    except (BotoCoreError, ClientError) as error:
        raise Unavailable("the blob store failed or does not answer", cure="try again in a few seconds") from error


# === Blobs.


_CHUNK_BYTES = 5 * 1024**2  # source: S3's smallest part of an upload
_KEY = re.compile(r"[a-z]+/[0-9a-f]{2}/[0-9a-f]{32}")
_NO_LINKS = (errno.EXDEV, errno.EPERM, errno.ENOTSUP, errno.EMLINK, errno.EACCES)
"""Errors of file systems that cannot give a file a second name. Source: link(2)."""
_DISK_FULL = re.compile(rf"\(os error ({errno.ENOSPC}|{errno.EDQUOT})\)")
_PARTIAL = re.compile(_KEY.pattern + "#[0-9]+")
"""Name under which obstore writes a file before it is whole. Source: `staged_upload_path` of the crate object_store."""
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
    scratch : Path, optional
        Folder for copies of blobs that are in S3; by default the system's for temporary files.

    Raises
    ------
    InvalidParameter
        The URL names no store that is supported.
    """

    def __init__(self, url: str, scratch: Path | None = None) -> None:
        parts = urlsplit(url)
        self._url, self._scratch = url, scratch
        self._folder: Path | None = None
        self._opened: ObjectStore | None = None
        self._durable_folders: set[Path] = set()
        if parts.scheme == "file" and not parts.netloc and parts.path:
            self._folder = Path(unquote(parts.path))
        elif parts.scheme != "s3" or not parts.netloc:
            raise InvalidParameter(f"no blob store at {url!r}", field="blobs_url", limit=_URL)

    @property
    def folder(self) -> Path | None:
        """The folder, unless the blobs are in S3."""
        return self._folder

    def open(self) -> None:
        """Create the folder, or prepare the client."""
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            for folder in list(self._folder.parents)[:2]:  # the data folder may be new, too
                with suppress(PermissionError):
                    _sync(folder)
            self._opened = LocalStore(self._folder)
        else:
            self._opened = from_url(self._url)

    @property
    def _store(self) -> ObjectStore:
        if self._opened is None:
            raise Unavailable("the blob store is not open")
        return self._opened

    def put(self, key: str, data: bytes) -> None:
        """Write a blob that does not exist yet. When this returns, it survives a power failure.

        Parameters
        ----------
        key : str
            From `new_blob_key`.

        Raises
        ------
        Conflict
            The key is taken.
        StorageFull
            There is no room.
        Unavailable
            The store does not answer, or its disk failed.
        """
        _check_key(key)
        with self._written(key):
            obstore.put(self._store, key, data, mode="create", use_multipart=False)

    def put_file(self, key: str, path: Path) -> None:
        """Write a blob from a file, a few megabytes at a time; it survives a power failure.

        Parameters
        ----------
        key : str
            From `new_blob_key`, and not used before: unlike `put`, this cannot refuse a taken one.

        Raises
        ------
        StorageFull, Unavailable
            As `put`.
        """
        _check_key(key)
        with self._written(key):
            obstore.put(self._store, key, path, chunk_size=_CHUNK_BYTES, max_concurrency=2)

    def take_file(self, key: str, path: Path) -> None:
        """Write a blob from a file that nobody changes any more, without a copy if that can be.

        The file may share its bytes with the blob afterwards; deleting it leaves the blob as it is.

        Raises
        ------
        Conflict
            The key is taken.
        StorageFull, Unavailable
            As `put`.
        """
        _check_key(key)
        if self._folder is not None:
            with self._written(key):
                target = self._folder / key
                target.parent.mkdir(parents=True, exist_ok=True)
                try:
                    os.link(path, target)
                    return
                except FileExistsError as error:
                    raise AlreadyExistsError(str(error)) from error
                except OSError as error:
                    if error.errno not in _NO_LINKS:
                        raise
        self.put_file(key, path)

    @contextmanager
    def opened(self, key: str) -> Iterator[SpooledFile]:
        """A blob as a file with a path, which must not be changed: the blob itself, or a copy that is then deleted.

        Raises
        ------
        NotFound
            There is no such blob.
        StorageFull, Unavailable
            The copy cannot be made, or the store does not answer.
        """
        _check_key(key)
        if self._folder is not None:
            path = self._folder / key
            if not path.is_file():
                raise NotFound(f"blob {key} is gone")
            yield SpooledFile.at(path)
            return
        with self._copied(key) as path:
            yield SpooledFile.at(path)

    @contextmanager
    def _copied(self, key: str) -> Iterator[Path]:
        """A copy of a blob on this machine. A killed process leaves one, which `app.storage.spool` deletes."""
        blocks = self.stream(key)
        if self._scratch is not None:
            self._scratch.mkdir(parents=True, exist_ok=True, mode=0o700)
        try:
            with tempfile.NamedTemporaryFile(dir=self._scratch) as file:
                for block in blocks:
                    file.write(block)
                file.flush()
                yield Path(file.name)
        except (BaseError, OSError) as error:
            raise _failure(error) from error

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
            raise _failure(error) from error
        return (bytes(chunk) for chunk in found.stream(min_chunk_size=_CHUNK_BYTES))

    @contextmanager
    def _written(self, key: str) -> Iterator[None]:
        """Make the blob durable that the block writes. One that failed is deleted: after a failed fsync the kernel may
        have dropped its pages, and a second fsync would succeed."""
        try:
            yield
            self._make_durable(key)
        except AlreadyExistsError as error:
            raise Conflict(f"blob {key} exists") from error
        except (BaseError, OSError) as error:
            with suppress(BaseError, OSError):
                obstore.delete(self._store, key)
            raise _failure(error) from error

    def _make_durable(self, key: str) -> None:
        if self._folder is None:
            return  # S3 answers when the object is durable
        path = self._folder / key
        _sync(path)
        _sync(path.parent)
        if path.parent not in self._durable_folders:
            _sync(path.parent.parent)
            _sync(self._folder)
            self._durable_folders.add(path.parent)

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
            raise _failure(error) from error

    def delete(self, key: str) -> None:
        """Remove a blob; one that is gone already is no error."""
        _check_key(key)
        try:
            obstore.delete(self._store, key)
        except FileNotFoundError:
            return
        except (BaseError, OSError) as error:
            raise _failure(error) from error

    def probe(self) -> None:
        """Write a small blob, read it and delete it.

        Raises
        ------
        StorageFull, Unavailable
            One of these failed.
        """
        key = f"probe/00/{uuid.uuid4().hex}"
        self.put(key, b"waymark")
        try:
            if self.get(key) != b"waymark":
                raise Unavailable("the blob store does not return what was written")
        finally:
            self.delete(key)

    def list_keys(self, before: datetime | None = None) -> Iterator[str]:
        """Keys of all blobs, or of those that were written before a time."""
        try:
            for name, written_at in self._list_all():
                if _KEY.fullmatch(name) and (before is None or written_at < before):
                    yield name
        except (BaseError, OSError) as error:
            raise _failure(error) from error

    def delete_partial(self, before: datetime) -> None:
        """Remove what writes into a folder that were cut off before a time have left.

        In S3 a rule of the bucket does so ("AbortIncompleteMultipartUpload").
        """
        try:
            for name, written_at in self._list_all():
                if self._folder is not None and _PARTIAL.fullmatch(name) and written_at < before:
                    (self._folder / name).unlink(missing_ok=True)
        except OSError as error:
            raise _failure(error) from error

    def _list_all(self) -> Iterator[tuple[str, datetime]]:
        """Name and time of every object; obstore does not list the partial files of a folder."""
        if self._folder is None:
            for chunk in obstore.list(self._store):
                yield from ((found["path"], found["last_modified"]) for found in chunk)
            return
        for place, _folders, names in os.walk(self._folder):
            for name in names:
                path = Path(place, name)
                with suppress(FileNotFoundError):  # deleted in the meantime
                    modified = datetime.fromtimestamp(path.stat().st_mtime, UTC)
                    yield str(path.relative_to(self._folder)), modified


def _failure(error: BaseException) -> Unavailable:
    """What an error of the store means. obstore has one class for most, with the operating system's number as text."""
    if is_disk_full(error) or _DISK_FULL.search(str(error)):
        return StorageFull("the blob store")
    return Unavailable("the blob store failed or does not answer", cure="try again in a few seconds")


def _check_key(key: str) -> None:
    if not _KEY.fullmatch(key):
        raise InvalidParameter(f"{key!r} is no blob key")


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
