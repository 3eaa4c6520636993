"""Imports of large surveys, as jobs: the file is kept, the caller gets a place to look at, the report comes later."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from app.errors import Conflict, Unavailable, WaymarkError
from app.registry import decodes as store
from app.registry.database import Database
from app.registry.decodes import IMPORT, Row
from app.registry.ids import new_id
from app.services.access import Caller, Scope
from app.services.decode_documents import error_document
from app.services.frames import Blobs, JobQueue
from app.services.idempotency import IdempotencyKey, find_answer, keep_answer
from app.services.imports import SETTLED, GivenImport, Imports
from app.services.marker_rules import MarkerRules
from app.services.ports import Clock
from app.storage.blobs import new_blob_key

AT_ONCE_BYTES = 8 * 1024**2
"""Surveys up to this size are imported while the caller waits, larger ones become jobs. [byte]"""
_STARTED = 0.1
_TOO_LATE = "read its report; what it stored is in the history, and is changed or retired marker by marker"
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
            "result": None, "error": None, "finished_at": None, "picture_key": None, "cancel_requested": False,
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

    def page(
        self, caller: Caller, *, state: str | None = None, before: str | None = None, limit: int = 100
    ) -> tuple[list[dict[str, Any]], str | None]:
        """A page of jobs without their reports, newest first, and the id to continue before."""
        with self._database.read() as connection:
            rows = store.list_imports(connection, caller.agency_id, state=state, before=before, limit=limit + 1)
        page = [_summary(row) for row in rows[:limit]]
        return page, page[-1]["id"] if len(rows) > limit else None

    def cancel(self, caller: Caller, import_id: str) -> dict[str, Any]:
        """Call a job off: one that waits never starts, one that runs stops before it stores anything.

        Raises
        ------
        NotFound
            There is none with this id, or it belongs to another.
        Conflict
            It is too late: it is storing, or finished. One that was cancelled before stays cancelled.
        """
        with self._database.read() as connection:
            row = store.get_import(connection, caller.agency_id, import_id)
        _check_in_time(row)
        with self._database.write() as connection:
            store.request_cancel_before(connection, caller.agency_id, import_id, self._clock(), progress=SETTLED)
            row = store.get_import(connection, caller.agency_id, import_id)
            _check_in_time(row)
        return _document(row)

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
            self._step(row, _STARTED)
            given = self._parse(row["context"]["declaration"], self._blobs.get(row["upload_key"]))
            key = IdempotencyKey(f"import {row['id']}", row["id"])
            report, _ = self._imports.run(caller, given, key, partial(self._step, row))
            done = {"state": "done", "progress": 1.0, "result": report}
        except _Cancelled:
            done = {"state": "cancelled"}
        except Unavailable:
            raise
        except WaymarkError as error:
            done = {"state": "failed", "error": error_document(error)}
        with self._database.write() as connection:
            store.finish_decode(connection, row["id"], {**done, "finished_at": self._clock()})

    def _step(self, row: Row, progress: float) -> None:
        if row["progress"] >= SETTLED:
            return  # it was storing when an earlier process stopped: it goes on to the end
        with self._database.write() as connection:
            if not store.begin_step(connection, row["id"], progress):
                raise _Cancelled


class _Cancelled(Exception):
    """Somebody asked the job to stop."""


def _check_in_time(row: Row) -> None:
    if row["state"] in ("done", "failed"):
        raise Conflict(
            f"the import is {row['state']}", field="import_id", limit="imports that are not finished", cure=_TOO_LATE
        )
    if row["state"] == "running" and row["progress"] >= SETTLED:
        raise Conflict(
            "the import is storing already", field="import_id", limit="imports that store nothing yet", cure=_TOO_LATE
        )


def _document(row: Any) -> dict[str, Any]:
    return {**_summary(row), "report": row["result"]}


def _summary(row: Any) -> dict[str, Any]:
    names = ("id", "state", "progress", "attempts", "cancel_requested", "created_at", "finished_at", "error")
    return {**{name: row[name] for name in names}, "links": {"self": f"/v1/imports/{row['id']}"}}
