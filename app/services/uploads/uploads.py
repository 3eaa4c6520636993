"""Uploads that arrive in parts: each part is a blob and a row; the last one makes them one file and a decode.

Several servers may take parts of one upload: the row has the offset and the writer, and a part counts when its
row is committed. Nothing is on the disk of one server alone but the part that is arriving.
"""

from __future__ import annotations

import threading
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import sqlalchemy as sa
import structlog

from app.decoding.declarations import UploadContext
from app.errors import (
    Conflict,
    Unavailable,
    UnreadableUpload,
    UploadExpired,
    UploadLocked,
    UploadTooLarge,
    WaymarkError,
    WrongOffset,
)
from app.formats.format import SpooledFile
from app.registry import uploads as store
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.engines import across_agencies, acting_for
from app.registry.uploads import PartRow, UploadRow
from app.services.access.access import Caller, Scope
from app.services.blobs import delete_unused, staged
from app.services.decodes.decodes import Decodes
from app.services.decodes.upload_path import UPLOADS
from app.services.documents import error_document
from app.services.idempotency import IdempotencyKey
from app.services.ports import Blobs, Clock
from app.services.uploads.quotas import Quotas, UploadDocument, UploadRules, check_length, upload_document
from app.storage.blobs import PART_BYTES, S3Parts, new_blob_key
from app.storage.spool import Spool

PARTS = "parts"
"""Folder of the blob store."""
LOCK = timedelta(seconds=30)
"""How long a request may write without a sign of life. Source: `Settings.body_timeout_s`, after which a body that
stands still is given up."""
COMPOSING = timedelta(minutes=10)
"""The same while the parts become one file: 4 GiB at 10 MB/s."""
KEPT = timedelta(days=7)
"""How long an upload can be asked about after it ended."""
_LOG = structlog.get_logger(__name__)


@dataclass(slots=True)
class Grant:
    """The right of one request to write an upload."""

    row: UploadRow  # as it was when the right was given; `received` is kept up to date
    lock_id: str
    received: int  # [byte]


class Uploads:
    """Use cases on uploads that arrive in parts.

    Parameters
    ----------
    s3 : S3Parts
        Where parts are sent that do not pass the server.
    decodes : Decodes
        Takes the complete file.
    """

    def __init__(
        self, database: Database, clock: Clock, *, blobs: Blobs, spool: Spool, s3: S3Parts, decodes: Decodes,
        quotas: Quotas, rules: UploadRules | None = None,
    ) -> None:  # fmt: skip
        self._database, self._clock = database, clock
        self._blobs, self._spool, self._s3, self._decodes, self._quotas = blobs, spool, s3, decodes, quotas
        self.rules = rules or UploadRules()
        self._stopping = threading.Event()

    # --- for clients --------------------------------------------------------------------------------------------------

    def create(
        self, caller: Caller, length: int, context: UploadContext, name: str, *, method: str = "tus",
        store_key: str | None = None, store_upload_id: str | None = None,
    ) -> UploadDocument:  # fmt: skip
        """Start an upload.

        Raises
        ------
        UploadTooLarge, QuotaExceeded
            It is too large, or there are too many.
        """
        check_length(length, self.rules.max_bytes)
        now = self._clock()
        declared = {"file_name": name, "context": context.stated, "vehicle": context.vehicle}
        row = UploadRow(
            new_id(now), caller.agency_id, caller.key_id, caller.label, caller.scope, method, "open", length, 0,
            declared, now, now + self.rules.expiry, store_key=store_key, store_upload_id=store_upload_id,
        )  # fmt: skip
        with self._database.write() as connection:
            self._quotas.check_open(connection, caller, length)
            store.add_upload(connection, row)
        return upload_document(row)

    def create_parts(
        self, caller: Caller, length: int, context: UploadContext, name: str
    ) -> tuple[UploadDocument, list[str]]:
        """Start an upload whose parts go to S3 directly; returns it with the URLs of its parts.

        Raises
        ------
        InvalidParameter
            The blobs are in a folder.
        UploadTooLarge, QuotaExceeded
            It is too large, or there are too many.
        """
        check_length(length, self.rules.max_bytes)
        key = new_blob_key(UPLOADS)
        s3_id = self._s3.start(key)
        try:
            made = self.create(caller, length, context, name, method="s3-parts", store_key=key, store_upload_id=s3_id)
        except BaseException:
            self._s3.abort(key, s3_id)
            raise
        count = -(-length // PART_BYTES)
        return made, self._s3.sign(key, s3_id, count, int(self.rules.expiry.total_seconds()))

    def complete_parts(self, caller: Caller, upload_id: str, etags: Sequence[str]) -> UploadDocument:
        """Make the parts that are in S3 one file, and the file a decode. Its size is checked and its hash computed.

        Raises
        ------
        Conflict
            It is no such upload, or has ended.
        InvalidParameter
            A part is missing.
        """
        row = self._get(caller, upload_id)
        if row.state == "done":
            return upload_document(row)
        if row.method != "s3-parts" or row.state != "open":
            raise Conflict(f"the upload is {row.state}, by {row.method}", field="upload_id", limit="open s3-parts")
        assert row.store_key is not None
        assert row.store_upload_id is not None
        grant = self._lock(row, COMPOSING)
        try:
            self._s3.complete(row.store_key, row.store_upload_id, etags)
        except BaseException:
            self.end(grant)
            raise
        return self.finish(grant)

    def get(self, caller: Caller, upload_id: str) -> UploadDocument:
        """One upload.

        Raises
        ------
        NotFound
            There is none with this id that this caller may see.
        UploadExpired
            It was deleted.
        """
        return upload_document(self._get(caller, upload_id))

    def delete(self, caller: Caller, upload_id: str) -> None:
        """Give an upload up; its decode stays, if there is one already.

        Raises
        ------
        NotFound, UploadExpired, UploadLocked
            There is none, or it is being written.
        """
        row = self._get(caller, upload_id)
        keys = self._part_keys(row)
        if row.state == "open":
            grant = self._lock(row, timedelta(seconds=0))
            with self._database.write() as connection:
                store.delete_upload(connection, row.agency_id, grant.row.id)
            self._abort(row)
        else:
            with self._database.write() as connection:
                store.delete_upload(connection, row.agency_id, row.id)
        delete_unused(self._blobs, keys)

    def begin(self, caller: Caller, upload_id: str, offset: int, declared_length: int | None) -> Grant:
        """Let a request append to an upload; `end` gives the right back.

        Parameters
        ----------
        offset : int
            Where the client goes on. [byte]
        declared_length : int or None
            Content-Length, if it was sent. [byte]

        Raises
        ------
        NotFound, UploadExpired
            There is no such upload any more.
        WrongOffset
            It ends elsewhere.
        UploadLocked
            Another request writes it.
        UploadTooLarge
            There would be more than its length.
        """
        row = self._get(caller, upload_id)
        if row.method != "tus" or row.state != "open":
            raise Conflict(
                f"the upload is {row.state}", field="upload_id", limit="open uploads", cure="start a new one"
            )
        _check_offset(row.received, offset)
        if declared_length is not None and offset + declared_length > row.length:
            raise _beyond(row)
        grant = self._lock(row, LOCK)
        try:
            _check_offset(grant.received, offset)
        except WrongOffset:
            self.end(grant)
            raise
        return grant

    def save(self, grant: Grant, file: SpooledFile) -> int:
        """Append a part durably. Returns where the upload ends now. [byte]

        Raises
        ------
        UploadTooLarge
            There are more bytes than its length.
        WrongOffset
            The right to write was lost.
        StorageFull, Unavailable
            It could not be stored.
        """
        row, now = grant.row, self._clock()
        if file.size == 0:
            return grant.received
        if grant.received + file.size > row.length:
            raise _beyond(row)
        with staged(self._blobs) as stage:
            part = PartRow(grant.received, file.size, file.sha256, stage.add(PARTS, file))
            with self._database.write() as connection:
                if not store.add_part(
                    connection, row, part,
                    lock_id=grant.lock_id, locked_until=now + LOCK, expires_at=now + self.rules.expiry,
                ):  # fmt: skip
                    raise WrongOffset(
                        "another request went on with the upload",
                        field="Upload-Offset",
                        cure="ask with HEAD, and go on",
                    )
            stage.keep()
        grant.received += file.size
        return grant.received

    def end(self, grant: Grant) -> None:
        """Give the right to write back."""
        with self._database.write() as connection:
            store.unlock_upload(connection, grant.row.agency_id, grant.row.id, grant.lock_id)

    def finish(self, grant: Grant) -> UploadDocument:
        """Make the parts of a complete upload one file, and the file a decode; ends the right to write.

        Raises
        ------
        WaymarkError
            The file is refused, and so is the upload.
        Unavailable
            It could not be done now; `finish_complete` tries again.
        """
        row, until = grant.row, self._clock() + COMPOSING
        with self._database.write() as connection:
            if not store.lock_upload(connection, row.agency_id, row.id, grant.lock_id, self._clock(), until):
                raise _locked()
        caller = Caller(row.agency_id, row.holder_id, row.label, Scope(row.scope))
        keys = self._part_keys(row)
        declared = row.declared
        context = UploadContext.model_validate({**declared["context"], "vehicle": declared["vehicle"]})
        key = IdempotencyKey(f"upload {row.id}", row.id, "")
        try:
            with self._composed(row, keys) as file:
                decode, _replayed = self._decodes.decode_upload(
                    caller, file, context, key, name=declared["file_name"], as_job=True
                )
        except Unavailable:
            self.end(grant)
            raise
        except WaymarkError as error:
            with self._database.write() as connection:
                store.end_upload(connection, row.agency_id, row.id, "refused", error=error_document(error))
            delete_unused(self._blobs, keys)
            raise
        with self._database.write() as connection:
            store.end_upload(connection, row.agency_id, row.id, "done", decode_id=decode["id"])
            ended = store.get_upload(connection, row.agency_id, row.id)
        delete_unused(self._blobs, keys)
        return upload_document(ended)

    # --- for the server -----------------------------------------------------------------------------------------------

    def release_all(self) -> None:
        """Remove all locks at the start of the only server of a database."""
        with across_agencies(), self._database.write() as connection:
            store.unlock_all(connection)

    def stop(self) -> None:
        """End a `tidy` that runs."""
        self._stopping.set()

    def tidy(self) -> None:
        """Finish uploads that are complete, and delete what expired; several servers may do so at the same time."""
        now = self._clock()
        with across_agencies(), self._database.read() as connection:
            complete, expired = store.list_complete(connection, now), store.list_expired(connection, now)
        for row in complete:
            if self._stopping.is_set():
                return
            with acting_for(row.agency_id):
                self._try_to_finish(row)
        for row in expired:
            if row.received < row.length:
                with acting_for(row.agency_id):
                    self._expire(row)
        with across_agencies(), self._database.write() as connection:
            store.delete_ended(connection, now - KEPT)

    def try_to_tidy(self) -> None:
        """As `tidy`; a store that does not answer is logged and tried the next time."""
        try:
            self.tidy()
        except (Unavailable, sa.exc.SQLAlchemyError) as error:
            _LOG.warning("uploads in parts could not be tidied", why=str(error))

    def _try_to_finish(self, row: UploadRow) -> None:
        try:
            self.finish(self._lock(row, LOCK))
        except WaymarkError as error:
            _LOG.warning("an upload could not be finished", upload_id=row.id, why=error.message)

    def _expire(self, row: UploadRow) -> None:
        keys = self._part_keys(row)
        try:
            self._lock(row, timedelta(seconds=0))
        except UploadLocked:
            return
        with self._database.write() as connection:
            store.end_upload(connection, row.agency_id, row.id, "expired")
        self._abort(row)
        delete_unused(self._blobs, keys)

    def _abort(self, row: UploadRow) -> None:
        if row.store_key is not None and row.store_upload_id is not None:
            try:
                self._s3.abort(row.store_key, row.store_upload_id)
            except Unavailable as error:  # S3 deletes it by the rule of the bucket
                _LOG.warning("parts in S3 could not be deleted", upload_id=row.id, why=error.message)

    # --- rows ---------------------------------------------------------------------------------------------------------

    def _get(self, caller: Caller, upload_id: str) -> UploadRow:
        with self._database.read() as connection:
            row = store.get_upload(connection, caller.agency_id, upload_id, holder_id=caller.own_key_id)
        is_late = row.state == "open" and row.received < row.length and row.expires_at < self._clock()
        if row.state == "expired" or is_late:
            raise UploadExpired(f"upload {upload_id} expired", field="upload_id", cure="start a new upload")
        return row

    def _lock(self, row: UploadRow, duration: timedelta) -> Grant:
        lock_id, now = str(uuid.uuid4()), self._clock()
        with self._database.write() as connection:
            if not store.lock_upload(connection, row.agency_id, row.id, lock_id, now, now + duration):
                raise _locked()
            fresh = store.get_upload(connection, row.agency_id, row.id)
        return Grant(fresh, lock_id, fresh.received)

    def _part_keys(self, row: UploadRow) -> list[str]:
        if row.store_key is not None:
            return [row.store_key]
        with self._database.read() as connection:
            return [part.blob_key for part in store.list_parts(connection, row.agency_id, row.id)]

    @contextmanager
    def _composed(self, row: UploadRow, keys: list[str]) -> Iterator[SpooledFile]:
        """The whole file. A single part is the file."""
        if len(keys) == 1:
            with self._blobs.opened(keys[0]) as file:
                if file.size != row.length:
                    raise UnreadableUpload(
                        f"the parts have {file.size} bytes together", field="size", limit=f"{row.length} bytes"
                    )
                yield file
            return
        with self._spool.writing(on_disk=True) as writer:
            for key in keys:
                for block in self._blobs.stream(key):
                    writer.write(block)
            file = writer.finish()
            if file.size != row.length:
                raise Unavailable(f"upload {row.id} has {file.size} bytes in its parts, not {row.length}")
            yield file


def _check_offset(received: int, offset: int) -> None:
    if offset != received:
        raise WrongOffset(
            f"the upload ends at {received}, not at {offset}",
            field="Upload-Offset",
            limit=str(received),
            cure="ask with HEAD where it ends, and go on there",
        )


def _beyond(row: UploadRow) -> UploadTooLarge:
    return UploadTooLarge(
        "there would be more bytes than the upload's length",
        field="body",
        limit=f"{row.length} bytes",
        cure="send the rest of the file and no more",
    )


def _locked() -> UploadLocked:
    return UploadLocked("another request writes this upload", cure="wait until it has ended", retry_after_s=1)
