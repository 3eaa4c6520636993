"""Archives of frames and long recordings, decoded as jobs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import structlog

from app.decoders.archives import Member, count_members, read_members
from app.errors import Unavailable, UnreadableUpload, WaymarkError
from app.registry import decodes as store
from app.registry.database import Database
from app.registry.decodes import Row
from app.registry.tenancy import across_agencies, acting_for
from app.services.agency_secrets import AgencySecrets
from app.services.decode_context import DecodeContext, context_from_document
from app.services.decode_documents import ReadFrame, error_document, result_document
from app.services.decode_rules import DecodeRules
from app.services.frame_reading import observations_of, read_frame, start_frame
from app.services.frames import Blobs, FrameDecoder, PendingFrame
from app.services.matching import NearbyPlates, find_nearby_plates
from app.services.packet_decodes import (
    PACKETS,
    TRIES,
    decode_packets,
    is_still_newest,
    keep_heard,
    start_packets,
    too_many_at_once,
)
from app.services.ports import Clock
from app.services.trace_decodes import PICTURES, TRACE, finished_columns, start_trace, store_observations
from app.services.vehicle_uploads import count_driven
from app.storage.blobs import new_blob_key

_PATIENCE_S = 60.0
_LOG = structlog.get_logger(__name__)


class DecodeJobs:
    """Runs the decodes that were queued.

    Parameters
    ----------
    database : Database
    clock : Clock
    blobs : Blobs
        Where the uploads are.
    decoder : FrameDecoder
        Decoder processes.
    secrets : AgencySecrets
        Keys of CERPMs.
    rules : DecodeRules, optional
    run_import : callable, optional
        Does the jobs that are imports of surveys.
    """

    def __init__(
        self,
        database: Database,
        clock: Clock,
        *,
        blobs: Blobs,
        decoder: FrameDecoder,
        secrets: AgencySecrets,
        rules: DecodeRules | None = None,
        run_import: Callable[[Row], None] | None = None,
    ) -> None:
        self._run_import = run_import
        self._database = database
        self._clock = clock
        self._blobs = blobs
        self._decoder = decoder
        self._secrets = secrets
        self._rules = rules or DecodeRules()

    def run_job(self, decode_id: str) -> None:
        """Decode a queued upload. It may be called again and at the same time: the effect happens once.

        Raises
        ------
        Unavailable
            The decoder processes or the stores do not answer; the job stays unfinished and can be run again.
        """
        with across_agencies(), self._database.write() as connection:
            row = store.start_decode(connection, decode_id)
        if row is not None:
            with acting_for(row["agency_id"]):
                self._run(row)

    def _run(self, row: Row) -> None:
        if row["attempts"] > self._rules.max_attempts:
            self._fail(row, _given_up(self._rules.max_attempts))
            return
        try:
            if row["kind"] == store.IMPORT and self._run_import is not None:
                self._run_import(row)
                return
            if row["kind"] == TRACE:
                self._run_trace(row)
                return
            if row["kind"] == PACKETS:
                self._run_packets(row)
                return
            frames, codebook_plates = self._read_archive(row)
        except _Cancelled:
            self._finish(row, {"state": "cancelled"})
        except Unavailable:
            raise
        except WaymarkError as error:
            self._fail(row, error)
        except Exception:  # noqa: BLE001 - a defect must not leave a job that runs for ever
            _LOG.exception("a decode job failed on a defect", decode_id=row["id"])
            self._fail(row, WaymarkError("the job failed on a defect of the server; its log has the details"))
        else:
            result = result_document(frames, codebook_plates=codebook_plates)
            self._finish(row, {"state": "done", "progress": 1.0, "result": result}, frames)

    def list_unfinished(self) -> list[str]:
        """Jobs that an earlier process left; main submits them again."""
        with across_agencies(), self._database.read() as connection:
            return store.list_unfinished(connection)

    def _run_trace(self, row: Row) -> None:
        context = context_from_document(row["context"])
        data = self._blobs.get(row["upload_key"])
        agency_id = row["agency_id"]
        with self._database.read() as connection:
            started = start_trace(
                connection, agency_id, self._decoder, data, context, self._rules, wait_s=_PATIENCE_S
            )  # fmt: skip
        done, trace = finished_columns(started.pending.result(), started, context, self._blobs)
        with self._database.write() as connection:
            if store.finish_decode(connection, row["id"], {**done, "finished_at": self._clock()}):
                store_observations(connection, agency_id, row["id"], trace, context.captured_at or row["created_at"])
                count_driven(connection, agency_id, row["id"], context, done["result"])
                return
        self._blobs.delete(done["picture_key"])

    def _run_packets(self, row: Row) -> None:
        context = context_from_document(row["context"])
        data = self._blobs.get(row["upload_key"])
        agency_id, received_at = row["agency_id"], row["created_at"]
        files = start_packets(self._decoder, data, context, self._rules, wait_s=_PATIENCE_S).result()
        for _try in range(TRIES):
            drive = decode_packets(
                self._database, agency_id, self._secrets, self._decoder, files, context, received_at, wait_s=_PATIENCE_S
            )
            picture_key = new_blob_key(PICTURES)
            self._blobs.put(picture_key, drive.plot)
            done = {"state": "done", "progress": 1.0, "result": drive.document, "picture_key": picture_key}
            with self._database.write() as connection:
                newest = is_still_newest(connection, agency_id, drive)
                if newest and store.finish_decode(connection, row["id"], {**done, "finished_at": self._clock()}):
                    keep_heard(connection, agency_id, row["id"], drive, context.captured_at or received_at)
                    count_driven(connection, agency_id, row["id"], context, drive.document)
                    return
            self._blobs.delete(picture_key)
            if newest:
                return  # somebody else finished or cancelled it
        raise too_many_at_once()

    def _read_archive(self, row: Row) -> tuple[list[ReadFrame], int]:
        context = context_from_document(row["context"])
        data = self._blobs.get(row["upload_key"])
        total = count_members(data, self._rules.archives)
        with self._database.read() as connection:
            nearby = find_nearby_plates(connection, row["agency_id"], context.coarse_position)
        frames: list[ReadFrame] = []
        waiting: deque[tuple[Member, PendingFrame | WaymarkError]] = deque()
        noted_at = self._clock()
        try:
            for member in read_members(data, self._rules.archives):
                waiting.append((member, self._start_member(member, context, nearby)))
                if len(waiting) >= self._rules.frames_in_flight:
                    frames.append(self._finish_member(row["agency_id"], *waiting.popleft(), context, nearby))
                if self._clock() - noted_at >= self._rules.progress_every:
                    noted_at = self._clock()
                    self._note_progress(row["id"], len(frames) / total)
            while waiting:
                frames.append(self._finish_member(row["agency_id"], *waiting.popleft(), context, nearby))
        finally:
            for _member, pending in waiting:
                if not isinstance(pending, WaymarkError):
                    pending.cancel()
        return frames, len(nearby.codebook)

    def _start_member(
        self, member: Member, context: DecodeContext, nearby: NearbyPlates
    ) -> PendingFrame | WaymarkError:
        if member.error is not None:
            return member.error
        try:
            started = start_frame(self._decoder, member.data, context, self._rules.images, wait_s=_PATIENCE_S)
            started.look_for(nearby)
            return started.pending
        except Unavailable:
            raise
        except WaymarkError as error:
            return error

    def _finish_member(
        self,
        agency_id: str,
        member: Member,
        pending: PendingFrame | WaymarkError,
        context: DecodeContext,
        nearby: NearbyPlates,
    ) -> ReadFrame:
        try:
            if isinstance(pending, WaymarkError):
                raise pending
            result = pending.result()
        except Unavailable:
            raise
        except WaymarkError as error:
            return ReadFrame(member.index, member.name, error=error)
        with self._database.read() as connection:
            return read_frame(connection, agency_id, member, result, context, nearby)

    def _note_progress(self, decode_id: str, progress: float) -> None:
        with self._database.write() as connection:
            if store.record_progress(connection, decode_id, progress):
                raise _Cancelled

    def _fail(self, row: Row, error: WaymarkError) -> None:
        self._finish(row, {"state": "failed", "error": error_document(error)})

    def _finish(self, row: Row, values: dict[str, Any], frames: Sequence[ReadFrame] = ()) -> None:
        now = self._clock()
        context = context_from_document(row["context"])
        with self._database.write() as connection:
            if store.finish_decode(connection, row["id"], {**values, "finished_at": now}):
                seen = observations_of(row["id"], frames, context.captured_at or row["created_at"])
                store.add_observations(connection, row["agency_id"], seen)
                if "result" in values:
                    count_driven(connection, row["agency_id"], row["id"], context, values["result"])


class _Cancelled(Exception):
    """Somebody asked the job to stop."""


def _given_up(attempts: int) -> WaymarkError:
    return UnreadableUpload(
        "the job was started again and again and never finished",
        field="file",
        limit=f"{attempts} attempts",
        cure="send the frames in smaller archives",
    )
