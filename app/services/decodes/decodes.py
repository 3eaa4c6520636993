"""Uploads are decoded now or queued, and decodes are listed, read and cancelled."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import sqlalchemy as sa

from app.errors import NotFound
from app.formats.spooled_file import SpooledFile
from app.registry import decodes as store
from app.registry import jobs
from app.registry.audit import Author
from app.registry.database import Database
from app.registry.decodes import DecodeFilter
from app.registry.jobs import JobKind, new_job
from app.services.access.access import Caller
from app.services.access.audit import author_of
from app.services.decodes.context import ContextInput, context_from_document
from app.services.decodes.documents import DecodeDocument, DecodeHead, decode_document, decode_head
from app.services.decodes.frame_documents import FramesResult
from app.services.decodes.rules import DecodeRules
from app.services.decodes.upload_path import (
    NewRecord,
    QueuedRecord,
    Upload,
    UploadHandler,
    UploadPath,
    new_decode,
    with_upload,
)
from app.services.fleet.vehicle_uploads import count_upload, resolve_context
from app.services.idempotency import IdempotencyKey, find_response, write_once
from app.services.jobs import RunningJob
from app.services.ports import Blobs, Clock, JobQueue
from app.services.staged_blobs import staged
from app.services.uploads.quotas import Quotas

_WAIT_S = 60.0
"""How long a job waits for a decoder process before it is put back. [s]"""


class Decodes:
    """Use cases on decodes.

    Parameters
    ----------
    database : Database
    clock : Clock
    blobs : Blobs
        Where uploads are stored.
    quotas : Quotas
        Of keys and agencies.
    queue : JobQueue
        Where uploads wait that take too long for an immediate response.
    handlers : sequence of UploadHandler
        The first one that accepts an upload decodes it.
    rules : DecodeRules, optional
    """

    def __init__(
        self,
        database: Database,
        clock: Clock,
        *,
        blobs: Blobs,
        quotas: Quotas,
        queue: JobQueue,
        handlers: Sequence[UploadHandler[Any]],
        rules: DecodeRules | None = None,
    ) -> None:
        self._database, self._clock = database, clock
        self._blobs, self._quotas, self._queue = blobs, quotas, queue
        self._handlers = handlers
        self._rules = rules or DecodeRules()
        self._path = UploadPath(database, blobs)

    # --- uploads ------------------------------------------------------------------------------------------------------

    def decode_upload(
        self,
        caller: Caller,
        file: SpooledFile,
        given: ContextInput,
        key: IdempotencyKey | None = None,
        *,
        as_job: bool = False,
    ) -> tuple[DecodeDocument, bool]:
        """Decode an upload now, or queue it if that takes too long, or in any case `as_job`.

        Returns
        -------
        decode : DecodeDocument
        replayed : bool
            The request had been made before under the same Idempotency-Key; nothing was stored now.

        Raises
        ------
        UnreadableUpload, UploadTooLarge, UnsupportedUpload, InvalidParameter
            The upload or its context is refused; nothing is stored.
        NotFound, NotAllowed, Conflict
            The vehicle is unknown, not this key's, or retired.
        Unavailable
            The decoder processes are busy.
        """
        now = self._clock()
        with self._database.read() as connection:
            earlier = find_response(connection, caller.agency_id, key, now)
            if earlier is not None:
                return earlier, True
            context = resolve_context(connection, caller, given, file)
        handler = next(handler for handler in self._handlers if handler.accepts(context, file))
        upload = Upload(caller.agency_id, author_of(caller), file, context, now)
        if handler.is_job(file) or as_job:
            return self._put_in_queue(caller, upload, handler, key)
        record = NewRecord(
            caller, handler, upload, self._clock, quotas=self._quotas, key=key, ttl=self._rules.idempotency_ttl
        )
        self._path.decode(upload, handler, record)
        return record.response, record.replayed

    def _put_in_queue(
        self, caller: Caller, upload: Upload, handler: UploadHandler[Any], key: IdempotencyKey | None
    ) -> tuple[DecodeDocument, bool]:
        agency_id, now, ttl = caller.agency_id, upload.received_at, self._rules.idempotency_ttl
        with staged(self._blobs) as stage:
            row = with_upload(new_decode(handler, upload), stage, upload)
            with write_once(self._database, agency_id, key, now, ttl) as (connection, answer):
                if answer.replayed:
                    return answer.response, True
                self._quotas.count(connection, caller, upload.file.size)
                store.add_decode(connection, agency_id, caller.key_id, row)
                jobs.add_job(
                    connection,
                    new_job(JobKind.DECODE, row.id, agency_id, caller.key_id, now, job_input={"label": caller.label}),
                )
                count_upload(connection, agency_id, row.id, upload.context, now)
                document = answer.store(decode_document(row))
            stage.keep()
        self._queue.submit(row.id, agency_id, JobKind.DECODE)
        return document, False

    def run(self, job: RunningJob) -> None:
        """Decode an upload that was queued; the handler of jobs of the kind `JobKind.DECODE`."""
        with self._database.read() as connection:
            row = store.get_decode(connection, job.row.agency_id, job.row.id)
        assert row.upload_key is not None
        handler = next(handler for handler in self._handlers if handler.kind == row.kind)
        with self._blobs.opened(row.upload_key) as file:
            upload = Upload(
                job.row.agency_id, Author(job.row.input.get("label", ""), job.row.holder_id), file,
                context_from_document(row.context), row.created_at,
                wait_s=_WAIT_S, report_progress=partial(_report, job), report_part=partial(self._keep_part, job),
            )  # fmt: skip
            self._path.decode(upload, handler, QueuedRecord(job, upload, self._clock))

    def _keep_part(self, job: RunningJob, done: int, total: int, part: FramesResult) -> None:
        """Store the result so far."""

        def keep(connection: sa.Connection) -> None:
            store.store_part(connection, job.row.agency_id, job.row.id, part)

        job.report_progress(done / total, steps=(done, total), keep=keep, resumable=False)

    def decode_again(self, agency_id: str, decode_id: str) -> tuple[dict[str, Any], bytes | None]:
        """The result of a stored upload by the present decoders, and its plot; nothing is stored.

        Raises
        ------
        NotFound
            There is no such decode, or its upload is gone.
        UnreadableUpload
            The upload cannot be decoded any more.
        Unavailable
            The decoder processes are busy.
        """
        with self._database.read() as connection:
            row = store.get_decode(connection, agency_id, decode_id)
        if row.upload_key is None:
            raise NotFound(f"decode {decode_id} has no upload", field="decode_id")
        handler = next(handler for handler in self._handlers if handler.kind == row.kind)
        with self._blobs.opened(row.upload_key) as file:
            upload = Upload(
                agency_id, Author(""), file, context_from_document(row.context), row.created_at,
                wait_s=_WAIT_S, again_id=decode_id,
            )  # fmt: skip
            decoded, plot = self._path.decode_again(upload, handler)
        return dict(decoded.document), plot

    # --- stored decodes -----------------------------------------------------------------------------------------------

    def get(self, caller: Caller, decode_id: str) -> DecodeDocument:
        """One decode with its result."""
        with self._database.read() as connection:
            row = store.get_decode(connection, caller.agency_id, decode_id, holder_id=caller.own_key_id)
        return decode_document(row)

    def page(
        self, caller: Caller, wanted: DecodeFilter | None = None, *, before: str | None = None, limit: int = 100
    ) -> tuple[list[DecodeHead], str | None]:
        """A page of decodes without their results, newest first, and the id to continue before."""
        with self._database.read() as connection:
            rows = store.list_decodes(
                connection, caller.agency_id, wanted or DecodeFilter(),
                before=before, limit=limit + 1, holder_id=caller.own_key_id,
            )  # fmt: skip
        page = [decode_head(row) for row in rows[:limit]]
        return page, page[-1]["id"] if len(rows) > limit else None

    def cancel(self, caller: Caller, decode_id: str) -> DecodeDocument:
        """Ask the job of a decode to stop; a finished one stays as it is."""
        own = caller.own_key_id
        with self._database.write() as connection:
            store.get_decode(connection, caller.agency_id, decode_id, holder_id=own)
            jobs.request_cancel(connection, caller.agency_id, decode_id, self._clock())
            return decode_document(store.get_decode(connection, caller.agency_id, decode_id, holder_id=own))


def _report(job: RunningJob, done: int, total: int) -> None:
    job.report_progress(done / total, steps=(done, total))
