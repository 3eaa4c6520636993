"""Alignments: roads that plans are made for, kept as the files that they came as."""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from datetime import timedelta
from typing import Any

from app.planning.alignment_declaration import AlignmentDeclaration
from app.registry.database import Database
from app.registry.plans import ALIGNMENTS, AlignmentRow
from app.registry.resources import first_version
from app.services.access.access import Caller
from app.services.access.audit import log_change
from app.services.decoder_processes import DecoderProcesses
from app.services.documents import document_of
from app.services.idempotency import IdempotencyKey, find_earlier, idempotent
from app.services.plans.documents import AlignmentDocument, AlignmentPage
from app.services.plans.tasks import RoadFile, SummarizeRoadTask
from app.services.ports import Blobs, Clock
from app.services.staged_blobs import staged

BUSY_WAIT_S = 10.0
"""How long a request waits for a decoder process. [s] Source: chosen by hand, as imports."""


class Alignments:
    """Use cases on alignments.

    Parameters
    ----------
    database, clock, blobs, processes
    accuracy_m : float
        Worst stated accuracy of a transformation whose result still counts as exact. [m]
    idempotency_ttl : timedelta
    """

    def __init__(
        self, database: Database, clock: Clock, blobs: Blobs, processes: DecoderProcesses,
        *, accuracy_m: float, idempotency_ttl: timedelta = timedelta(hours=24),
    ) -> None:  # fmt: skip
        self._database, self._clock, self._blobs, self._processes = database, clock, blobs, processes
        self._accuracy_m, self._ttl = accuracy_m, idempotency_ttl

    def add(
        self,
        caller: Caller,
        name: str,
        data: bytes,
        file_name: str,
        declaration: AlignmentDeclaration,
        key: IdempotencyKey | None = None,
    ) -> tuple[AlignmentDocument, bool]:
        """Read a road and store it; returns the document and whether the request had been made before.

        Raises
        ------
        UnreadableUpload, UnsupportedUpload, InvalidParameter, ReferenceSystemError
            The file, the declaration, or both together cannot be used.
        Conflict
            The agency has an alignment of this name.
        """
        now, agency_id = self._clock(), caller.agency_id
        if earlier := find_earlier(self._database, agency_id, key, now):
            return earlier, True
        with self._database.read() as connection:
            ALIGNMENTS.check_name(connection, agency_id, name)
        road = RoadFile(data, file_name, declaration, name, self._accuracy_m)
        summary = self._processes.submit(SummarizeRoadTask(road), wait_s=BUSY_WAIT_S).result()
        declared = {**asdict(declaration), "file_name": file_name}
        with staged(self._blobs) as stage:
            source_key = stage.put("alignments", data, durable=True)
            with (
                self._database.write() as connection,
                idempotent(connection, agency_id, key, now, self._ttl) as answer,
            ):
                if answer.replayed:
                    return answer.response, True
                ALIGNMENTS.check_name(connection, agency_id, name)
                values: dict[str, Any] = {
                    **first_version(now),
                    "name": name,
                    "source_key": source_key,
                    "source_sha256": hashlib.sha256(data).hexdigest(),
                    "declaration": {member: value for member, value in declared.items() if value is not None},
                    "summary": summary,
                }
                document = answer.store(alignment_document(ALIGNMENTS.add(connection, agency_id, values)))
                log_change(connection, caller, "alignment.added", now=now, subject=document["id"], document=document)
            stage.keep()
        return document, False

    def get(self, caller: Caller, alignment_id: str) -> AlignmentDocument:
        """One alignment."""
        with self._database.read() as connection:
            return alignment_document(ALIGNMENTS.get(connection, caller.agency_id, alignment_id))

    def page(self, caller: Caller, *, after: str | None = None, limit: int = 100) -> tuple[AlignmentPage, str | None]:
        """A page of alignments, and the id to continue after if there are more."""
        with self._database.read() as connection:
            rows, last = ALIGNMENTS.page(connection, caller.agency_id, beyond=after, limit=limit)
        return {"items": [alignment_document(row) for row in rows]}, last

    def source(self, caller: Caller, alignment_id: str) -> tuple[bytes, str]:
        """The file as it came, and its name."""
        with self._database.read() as connection:
            row = ALIGNMENTS.get(connection, caller.agency_id, alignment_id)
        return self._blobs.get(row.source_key), row.declaration.get("file_name") or "road"


def road_of(row: AlignmentRow, data: bytes, accuracy_m: float) -> RoadFile:
    """The road of a stored alignment."""
    declared = {name: value for name, value in row.declaration.items() if name != "file_name"}
    if declared.get("origin") is not None:
        declared["origin"] = tuple(declared["origin"])
    return RoadFile(data, row.declaration.get("file_name", ""), AlignmentDeclaration(**declared), row.name, accuracy_m)


def alignment_document(row: AlignmentRow) -> AlignmentDocument:
    """An alignment as clients see it."""
    own = ("id", "name", "declaration", "source_sha256", "version", "created_at", "updated_at")
    return document_of(
        AlignmentDocument, row, **{name: value for name, value in row.summary.items() if name not in own}
    )
