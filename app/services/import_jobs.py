"""Imports of large surveys, as jobs: the file is kept, the caller gets a place to look at, the report comes later."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from app.errors import Unavailable, WaymarkError
from app.registry import decodes as store
from app.registry.database import Database
from app.registry.decodes import IMPORT, Row
from app.registry.ids import new_id
from app.services.access import Caller, Scope
from app.services.decode_documents import error_document
from app.services.frames import Blobs, JobQueue
from app.services.idempotency import IdempotencyKey, find_answer, keep_answer
from app.services.imports import GivenImport, Imports
from app.services.marker_rules import MarkerRules
from app.services.ports import Clock
from app.storage.blobs import new_blob_key

AT_ONCE_BYTES = 8 * 1024**2
"""Surveys up to this size are imported while the caller waits, larger ones become jobs. [byte]"""
Parse = Callable[[dict[str, Any], bytes], GivenImport]


class ImportJobs:
    """Use cases on imports that are jobs.

    Parameters
    ----------
    database, clock, blobs, queue, rules
    imports : Imports
        Does the work.
    parse : callable
        The import of a declaration as it was sent, and the file.
    """

    def __init__(
        self, database: Database, clock: Clock, blobs: Blobs, queue: JobQueue, rules: MarkerRules,
        *, imports: Imports, parse: Parse,
    ) -> None:  # fmt: skip
        self._database, self._clock, self._blobs, self._queue = database, clock, blobs, queue
        self._rules, self._imports, self._parse = rules, imports, parse

    def submit(
        self, caller: Caller, declaration: dict[str, Any], data: bytes, key: IdempotencyKey | None
    ) -> tuple[dict[str, Any], bool]:
        """Keep the file and queue its import; the job, and whether the same request had queued it before."""
        now = self._clock()
        blob_key = new_blob_key("uploads")
        row = {
            "id": new_id(now), "state": "queued", "kind": IMPORT, "upload_key": blob_key, "created_at": now,
            "context": {"declaration": declaration, "label": caller.label}, "progress": 0.0, "attempts": 0,
            "result": None, "error": None, "finished_at": None, "picture_key": None,
        }  # fmt: skip
        self._blobs.put(blob_key, data, durable=True)
        try:
            with self._database.write() as connection:
                document = find_answer(connection, caller.agency_id, key, now)
                replayed = document is not None
                if document is None:
                    store.add_decode(connection, caller.agency_id, caller.key_id, row)
                    document = _document(row)
                    keep_answer(connection, caller.agency_id, key, document, now, self._rules.idempotency_ttl)
        except BaseException:
            self._blobs.delete(blob_key)
            raise
        if replayed:
            self._blobs.delete(blob_key)
        else:
            self._queue.submit(str(row["id"]))
        return document, replayed

    def get(self, caller: Caller, import_id: str) -> dict[str, Any]:
        """A job with its report, once there is one.

        Raises
        ------
        NotFound
            There is none with this id, or it belongs to another.
        """
        with self._database.read() as connection:
            return _document(store.get_import(connection, caller.agency_id, import_id))

    def run(self, row: Row) -> None:
        """Import a file that was queued. It may be run again after a crash: the effect happens once.

        Raises
        ------
        Unavailable
            The decoder processes or the stores do not answer; the job stays unfinished and can be run again.
        """
        # nobody acts with this caller but the import itself: what its key may do was asked when it was sent
        caller = Caller(row["agency_id"], row["holder_id"], row["context"]["label"], Scope.SURVEYOR)
        done: dict[str, Any]
        try:
            given = self._parse(row["context"]["declaration"], self._blobs.get(row["upload_key"]))
            self._note(row, 0.1)
            report, _ = self._imports.run(caller, given, IdempotencyKey(f"import {row['id']}", row["id"]))
            done = {"state": "done", "progress": 1.0, "result": report}
        except Unavailable:
            raise
        except WaymarkError as error:
            done = {"state": "failed", "error": error_document(error)}
        with self._database.write() as connection:
            store.finish_decode(connection, row["id"], {**done, "finished_at": self._clock()})

    def _note(self, row: Row, progress: float) -> None:
        with self._database.write() as connection:
            store.record_progress(connection, row["id"], progress)


def _document(row: Any) -> dict[str, Any]:
    names = ("id", "state", "progress", "attempts", "created_at", "finished_at", "error")
    return {
        **{name: row[name] for name in names},
        "report": row["result"],
        "links": {"self": f"/v1/imports/{row['id']}"},
    }
