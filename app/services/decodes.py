"""Uploads -> readings, matches, fixes and observations.

A frame or a short recording is decoded while the caller waits, an archive of frames or a long one becomes a job. Either
way the decoding happens in a child process, and everything that an upload leaves is written in one transaction.
"""

from __future__ import annotations

from datetime import datetime
from typing import Any

import sqlalchemy as sa

from app.decoders.archives import Member, count_members, is_archive, read_member
from app.errors import NotFound, UnreadableUpload
from app.registry import decodes as store
from app.registry.database import Database
from app.registry.ids import new_id
from app.services.access import Caller
from app.services.agency_secrets import AgencySecrets
from app.services.decode_context import DecodeContext, GivenContext, context_from_document
from app.services.decode_documents import ReadFrame, decode_document, result_document
from app.services.decode_rules import DecodeRules
from app.services.frame_reading import observations_of, read_frame, start_frame
from app.services.frames import AnnotationTask, Blobs, FrameDecoder, JobQueue, Outline
from app.services.idempotency import IdempotencyKey, find_answer, keep_answer
from app.services.lane_documents import lane_geojson, overlay_from_document
from app.services.matching import NearbyPlates, find_nearby_plates
from app.services.packet_decodes import (
    PACKETS,
    TRIES,
    DecodedDrive,
    decode_packets,
    is_still_newest,
    keep_heard,
    start_packets,
    too_many_at_once,
)
from app.services.packets import OverlayTask
from app.services.ports import Clock
from app.services.trace_decodes import PICTURES, TRACE, finished_columns, start_trace, store_observations
from app.services.vehicle_uploads import count_driven, count_upload, settle_context
from app.storage.blobs import new_blob_key

FRAME, ARCHIVE = "frame", "archive"
UPLOADS = "uploads"


class Decodes:
    """Use cases on decodes.

    Parameters
    ----------
    database : Database
    clock : Clock
    blobs : Blobs
        Where uploads are kept.
    decoder : FrameDecoder
        Decoder processes.
    queue : JobQueue
        Where archives wait for `DecodeJobs.run_job`.
    secrets : AgencySecrets
        Keys of CERPMs.
    rules : DecodeRules, optional
    """

    def __init__(
        self,
        database: Database,
        clock: Clock,
        *,
        blobs: Blobs,
        decoder: FrameDecoder,
        queue: JobQueue,
        secrets: AgencySecrets,
        rules: DecodeRules | None = None,
    ) -> None:
        self._database = database
        self._clock = clock
        self._blobs = blobs
        self._decoder = decoder
        self._queue = queue
        self._secrets = secrets
        self._rules = rules or DecodeRules()

    # --- uploads --------------------------------------------------------------------------------------------------

    def decode_upload(
        self, caller: Caller, data: bytes, given: GivenContext, key: IdempotencyKey | None = None
    ) -> tuple[dict[str, Any], bool]:
        """Decode a frame or a short recording now, or queue an archive of frames or a long recording.

        Returns
        -------
        decode : dict
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
        with self._database.read() as connection:
            answer = find_answer(connection, caller.agency_id, key, self._clock())
            if answer is not None:
                return answer, True
            context = settle_context(connection, caller, given, data)
        if not data and (context.trace is not None or context.packets is not None):
            raise UnreadableUpload("the file is empty", field="file", cure="send the recording again, whole")
        if context.trace is not None:
            if len(data) <= self._rules.trace_at_once_bytes:
                return self._decode_trace(caller, data, context, key)
            return self._put_in_queue(caller, TRACE, data, context, key)
        if context.packets is not None:
            if len(data) <= self._rules.trace_at_once_bytes:
                return self._decode_packets(caller, data, context, key)
            return self._put_in_queue(caller, PACKETS, data, context, key)
        if is_archive(data):
            count_members(data, self._rules.archives)
            return self._put_in_queue(caller, ARCHIVE, data, context, key)
        return self._decode_frame(caller, data, context, key)

    def _decode_frame(
        self, caller: Caller, data: bytes, context: DecodeContext, key: IdempotencyKey | None
    ) -> tuple[dict[str, Any], bool]:
        created_at = self._clock()
        started = start_frame(self._decoder, data, context, self._rules.images)
        blob_key = new_blob_key(UPLOADS)
        replayed = True
        try:
            with self._database.read() as connection:  # while the child loads the picture
                nearby = find_nearby_plates(connection, caller.agency_id, context.coarse_position)
            started.look_for(nearby)
            row = _new_row(FRAME, context, blob_key, created_at)  # while it decodes
            self._blobs.put(blob_key, data)
            result = started.pending.result()
            with self._database.write() as connection:
                document = find_answer(connection, caller.agency_id, key, created_at)
                if document is None:
                    replayed = False
                    frame = read_frame(connection, caller.agency_id, Member(0, ""), result, context, nearby)
                    document = self._store_frame(connection, caller, row, frame, context, nearby)
                    keep_answer(connection, caller.agency_id, key, document, created_at, self._rules.idempotency_ttl)
        except BaseException:
            started.pending.cancel()
            self._blobs.delete(blob_key)
            raise
        if replayed:
            self._blobs.delete(blob_key)
        return document, replayed

    def _store_frame(
        self,
        connection: sa.Connection,
        caller: Caller,
        row: dict[str, Any],
        frame: ReadFrame,
        context: DecodeContext,
        nearby: NearbyPlates,
    ) -> dict[str, Any]:
        row |= {
            "state": "done",
            "progress": 1.0,
            "attempts": 1,
            "result": result_document([frame], codebook_plates=len(nearby.codebook)),
            "finished_at": self._clock(),
        }
        self._add(connection, caller, row, context)
        seen_at = context.captured_at or row["created_at"]
        store.add_observations(connection, caller.agency_id, observations_of(row["id"], [frame], seen_at))
        return decode_document(row)

    def _decode_trace(
        self, caller: Caller, data: bytes, context: DecodeContext, key: IdempotencyKey | None
    ) -> tuple[dict[str, Any], bool]:
        created_at = self._clock()
        with self._database.read() as connection:
            started = start_trace(connection, caller.agency_id, self._decoder, data, context, self._rules)
        row = _new_row(TRACE, context, new_blob_key(UPLOADS), created_at)
        kept = [row["upload_key"]]
        replayed = True
        try:
            self._blobs.put(row["upload_key"], data)
            done, trace = finished_columns(started.pending.result(), started, context, self._blobs)
            kept.append(done["picture_key"])
            with self._database.write() as connection:
                document = find_answer(connection, caller.agency_id, key, created_at)
                if document is None:
                    replayed = False
                    row |= done | {"attempts": 1, "finished_at": self._clock()}
                    self._add(connection, caller, row, context)
                    seen_at = context.captured_at or created_at
                    store_observations(connection, caller.agency_id, row["id"], trace, seen_at)
                    document = decode_document(row)
                    keep_answer(connection, caller.agency_id, key, document, created_at, self._rules.idempotency_ttl)
        except BaseException:
            started.pending.cancel()
            for blob_key in kept:
                self._blobs.delete(blob_key)
            raise
        if replayed:
            for blob_key in kept:
                self._blobs.delete(blob_key)
        return document, replayed

    def _decode_packets(
        self, caller: Caller, data: bytes, context: DecodeContext, key: IdempotencyKey | None
    ) -> tuple[dict[str, Any], bool]:
        created_at = self._clock()
        files = start_packets(self._decoder, data, context, self._rules).result()
        row = _new_row(PACKETS, context, new_blob_key(UPLOADS), created_at)
        kept = [row["upload_key"]]
        try:
            self._blobs.put(row["upload_key"], data)
            for _try in range(TRIES):
                drive = decode_packets(
                    self._database, caller.agency_id, self._secrets, self._decoder, files, context, created_at
                )
                row |= {"picture_key": new_blob_key(PICTURES), "result": drive.document}
                kept.append(row["picture_key"])
                self._blobs.put(row["picture_key"], drive.plot)
                with self._database.write() as connection:
                    answer = find_answer(connection, caller.agency_id, key, created_at)
                    if answer is None and is_still_newest(connection, caller.agency_id, drive):
                        return self._store_packets(connection, caller, row, drive, context, key), False
                self._blobs.delete(kept.pop())
                if answer is not None:
                    self._blobs.delete(kept.pop())
                    return answer, True
            raise too_many_at_once()
        except BaseException:
            for blob_key in kept:
                self._blobs.delete(blob_key)
            raise

    def _store_packets(
        self,
        connection: sa.Connection,
        caller: Caller,
        row: dict[str, Any],
        drive: DecodedDrive,
        context: DecodeContext,
        key: IdempotencyKey | None,
    ) -> dict[str, Any]:
        now = self._clock()
        row |= {"state": "done", "progress": 1.0, "attempts": 1, "finished_at": now}
        self._add(connection, caller, row, context)
        seen_at = context.captured_at or row["created_at"]
        keep_heard(connection, caller.agency_id, row["id"], drive, seen_at)
        document = decode_document(row)
        keep_answer(connection, caller.agency_id, key, document, row["created_at"], self._rules.idempotency_ttl)
        return document

    def _put_in_queue(
        self, caller: Caller, kind: str, data: bytes, context: DecodeContext, key: IdempotencyKey | None
    ) -> tuple[dict[str, Any], bool]:
        created_at = self._clock()
        blob_key = new_blob_key(UPLOADS)
        row = _new_row(kind, context, blob_key, created_at)
        replayed = True
        try:
            self._blobs.put(blob_key, data, durable=True)
            with self._database.write() as connection:
                document = find_answer(connection, caller.agency_id, key, created_at)
                if document is None:
                    replayed = False
                    self._add(connection, caller, row, context)
                    document = decode_document(row)
                    keep_answer(connection, caller.agency_id, key, document, created_at, self._rules.idempotency_ttl)
        except BaseException:
            self._blobs.delete(blob_key)
            raise
        if replayed:
            self._blobs.delete(blob_key)
        else:
            self._queue.submit(row["id"])
        return document, replayed

    def _add(self, connection: sa.Connection, caller: Caller, row: dict[str, Any], context: DecodeContext) -> None:
        store.add_decode(connection, caller.agency_id, caller.key_id, row)
        count_upload(connection, caller.agency_id, row["id"], context, row["created_at"])
        if row["result"] is not None:
            count_driven(connection, caller.agency_id, row["id"], context, row["result"])

    # --- what is stored -------------------------------------------------------------------------------------------

    def get(self, caller: Caller, decode_id: str) -> dict[str, Any]:
        """One decode with its result."""
        with self._database.read() as connection:
            return decode_document(_get_own(connection, caller, decode_id))

    def page(
        self, caller: Caller, *, state: str | None = None, before: str | None = None, limit: int = 100
    ) -> tuple[list[dict[str, Any]], str | None]:
        """A page of decodes without their results, newest first, and the id to continue before."""
        with self._database.read() as connection:
            rows = store.list_decodes(
                connection,
                caller.agency_id,
                state=state,
                before=before,
                limit=limit + 1,
                holder_id=caller.own_key_id,
            )
        page = [decode_document(row) for row in rows[:limit]]
        return page, page[-1]["id"] if len(rows) > limit else None

    def cancel(self, caller: Caller, decode_id: str) -> dict[str, Any]:
        """Ask a job to stop; a finished one stays as it is."""
        with self._database.write() as connection:
            _get_own(connection, caller, decode_id)
            store.request_cancel(connection, caller.agency_id, decode_id, self._clock())
            return decode_document(_get_own(connection, caller, decode_id))

    def annotated(self, caller: Caller, decode_id: str, suffix: str, frame: int = 0) -> bytes:
        """A frame with its readings drawn over it, encoded as ``png`` or ``jpg``.

        Raises
        ------
        NotFound
            There is no such decode or frame, or it is not done.
        """
        row, result = self._result(caller, decode_id)
        known = next((entry for entry in result.get("frames", ()) if entry["frame"] == frame), None)
        if known is None or known["error"] is not None:
            raise NotFound(f"decode {decode_id} has no readable frame {frame}", field="frame")
        data = self._blobs.get(row["upload_key"])
        if row["kind"] == ARCHIVE:
            data = read_member(data, frame, self._rules.archives).data
        context = context_from_document(row["context"])
        outlines = tuple(_outline(reading) for reading in result["readings"] if reading["frame"] == frame)
        task = AnnotationTask(data, outlines, suffix, context.thermal, context.thermal_range, limits=self._rules.images)
        return self._decoder.annotate(task)

    def overlay(self, caller: Caller, decode_id: str, suffix: str) -> bytes:
        """The camera frame of a drive with its lane drawn over it, encoded as ``png`` or ``jpg``.

        Raises
        ------
        NotFound
            There is no such decode, or no overlay in it.
        """
        row, result = self._result(caller, decode_id)
        if not result.get("overlay"):
            raise NotFound(
                f"decode {decode_id} has no overlay",
                field="decode_id",
                limit="a packet log with a camera frame, a camera and the vehicle's pose",
                cure="report.warnings says what was missing",
            )
        overlay = result["overlay"]
        data = self._blobs.get(row["upload_key"])
        return self._decoder.draw_overlay(
            OverlayTask(data, overlay["frame"], overlay_from_document(overlay), suffix, self._rules.images)
        )

    def lane(self, caller: Caller, decode_id: str) -> dict[str, Any]:
        """Path, boundaries and markers of a drive as GeoJSON.

        Raises
        ------
        NotFound
            There is no such decode, or it is not of a packet log.
        """
        _row, result = self._result(caller, decode_id)
        if "lane" not in result:
            raise NotFound(
                f"decode {decode_id} is of no packet log", field="decode_id", limit="packet logs have a lane"
            )
        return lane_geojson(result["lane"], result["markers"])

    def _result(self, caller: Caller, decode_id: str) -> tuple[store.Row, dict[str, Any]]:
        with self._database.read() as connection:
            row = _get_own(connection, caller, decode_id)
        if row["result"] is None:
            raise NotFound(
                f"decode {decode_id} has no result: it is {row['state']}",
                field="decode_id",
                cure="wait until it is done",
            )
        return row, row["result"]

    def plot(self, caller: Caller, decode_id: str) -> bytes:
        """Plot of a trace or a lane with what was found, SVG.

        Raises
        ------
        NotFound
            There is no such decode, it is of frames, or it is not done.
        """
        with self._database.read() as connection:
            row = _get_own(connection, caller, decode_id)
        if row["picture_key"] is None:
            raise NotFound(
                f"decode {decode_id} has no plot: it is {row['state']}, of kind {row['kind']}",
                field="decode_id",
                cure="wait until it is done"
                if row["kind"] in (TRACE, PACKETS)
                else "frames have annotated.png and annotated.jpg",
            )
        return self._blobs.get(row["picture_key"])


def _get_own(connection: sa.Connection, caller: Caller, decode_id: str) -> store.Row:
    return store.get_decode(connection, caller.agency_id, decode_id, holder_id=caller.own_key_id)


def _new_row(kind: str, context: DecodeContext, blob_key: str, created_at: datetime) -> dict[str, Any]:
    return {
        "id": new_id(created_at),
        "state": "queued",
        "kind": kind,
        "context": context.document(),
        "upload_key": blob_key,
        "attempts": 0,
        "progress": 0.0,
        "created_at": created_at,
        "finished_at": None,
        "result": None,
        "picture_key": None,
        "error": None,
    }


def _outline(reading: dict[str, Any]) -> Outline:
    corners = tuple((float(x), float(y)) for x, y in reading["corners_px"] or ())
    label = f"{reading['digits']} {reading['confidence']:.1%}" if reading["digits"] else reading["outcome"]
    return Outline(corners, reading["outcome"], label)
