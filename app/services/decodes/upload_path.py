"""The path of every upload: start, wait for the signal, and one transaction that matches and stores it.

An immediate response and a job take the same steps. `UploadHandler` is what one kind of upload adds to them.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from functools import partial
from typing import ClassVar, Generic, Literal, TypeVar

import orjson
import sqlalchemy as sa
from prometheus_client import CollectorRegistry, Histogram, generate_latest

from app.decoding.declarations import DecodeContext
from app.errors import Unavailable, WaymarkError
from app.formats.format import SpooledFile
from app.registry import audit, jobs, markers
from app.registry import decodes as store
from app.registry.audit import Author
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.decodes import DecodeRow, NewObservation, StoredResult
from app.registry.health import NewUnregistered, add_unregistered
from app.registry.jobs import JobKind, new_job
from app.services.access.access import Caller
from app.services.blobs import StagedBlobs, staged
from app.services.decodes.context import DecodeKind
from app.services.decodes.documents import DecodeDocument, decode_document
from app.services.decodes.frame_documents import FramesResult
from app.services.decodes.packet_documents import PacketsResult
from app.services.decodes.trace_documents import TraceResult
from app.services.fleet.vehicles import count_driven, count_upload
from app.services.health.record import BAR, CAMERA, RADIO, ObservedDrive, record_drive
from app.services.idempotency import IdempotencyKey, write_once
from app.services.jobs import RunningJob
from app.services.ports import Blobs, Clock, JobQueue, Pending
from app.services.uploads.quotas import Quotas
from app.values import JsonObject

# === What a kind of upload adds.


@dataclass(frozen=True, slots=True)
class Upload:
    """A file with its context."""

    agency_id: str
    author: Author  # who uploaded it
    file: SpooledFile
    context: DecodeContext
    received_at: datetime
    wait_s: float = 0.0  # for a decoder process
    job: RunningJob | None = None  # that decodes it; None while its sender waits for the response
    again_id: str | None = None  # of the stored decode that is decoded again, to compare; nothing of that is stored

    @property
    def observed_at(self) -> datetime:
        """When markers were observed: when the upload was captured, else when it was received."""
        return self.context.captured_at or self.received_at

    def report(self, done: int, total: int, part: FramesResult | None = None) -> None:
        """Record how many frames are done, and store the result so far.

        Raises
        ------
        JobCancelled
            Somebody asked the job to stop.
        """
        if self.job is None:
            return
        keep = None
        if part is not None:
            keep = partial(store.store_part, agency_id=self.agency_id, decode_id=self.job.row.id, result=part)
        self.job.report_progress(done / total, steps=(done, total), keep=keep, resumable=False)


@dataclass(frozen=True, slots=True)
class Decoded:
    """An upload that was decoded and matched, ready to be stored."""

    document: FramesResult | TraceResult | PacketsResult  # the result
    observations: Sequence[NewObservation] = ()
    spans: Sequence[dict[str, object]] = ()  # transmissions of CERPMs that were received
    incidents: Mapping[str, Mapping[str, object]] = field(default_factory=dict)  # for the audit log: details by action
    unregistered: Sequence[NewUnregistered] = ()  # markers that were read where none is registered

    @property
    def result(self) -> JsonObject:
        """The result as JSON values, as it is stored."""
        stored: JsonObject = orjson.loads(orjson.dumps(self.document, option=orjson.OPT_SERIALIZE_NUMPY))
        return stored


class OutdatedMatch(Exception):
    """What an upload was matched against has changed: it has to be matched again."""


ResultT = TypeVar("ResultT")
SignalT = TypeVar("SignalT")


class UploadHandler(ABC, Generic[SignalT]):
    """What one kind of upload adds to the common path."""

    kind: ClassVar[DecodeKind]

    @abstractmethod
    def accepts(self, context: DecodeContext, file: SpooledFile) -> bool:
        """Whether an upload is of this kind."""

    @abstractmethod
    def is_job(self, file: SpooledFile) -> bool:
        """Whether an upload takes too long for an immediate response. Raises if it is not worth decoding."""

    @abstractmethod
    def start(self, upload: Upload) -> Pending[SignalT]:
        """Hand the upload to the decoder processes. After an `OutdatedMatch`, the path asks for the result again.

        Raises
        ------
        UnreadableUpload, UnsupportedUpload, UploadTooLarge, InvalidParameter
            The upload is refused.
        Unavailable
            The decoder processes are busy.
        """

    @abstractmethod
    def match(self, connection: sa.Connection, upload: Upload, signal: SignalT) -> Decoded:
        """Match the signal against the registry, in the transaction that stores the result.

        Raises
        ------
        OutdatedMatch
            The signal rests on rows that have changed.
        """

    def plot(self, signal: SignalT) -> bytes | None:
        """A plot of the signal, SVG."""
        return None


@dataclass(frozen=True, slots=True)
class PendingSignal(Generic[ResultT, SignalT]):
    """A task on its way through a decoder process, and the function that makes the signal from its result."""

    pending: Pending[ResultT]
    make_signal: Callable[[ResultT], SignalT]

    def result(self) -> SignalT:
        """Wait for the result, and make the signal; called again after an `OutdatedMatch`."""
        return self.make_signal(self.pending.result())

    def cancel(self) -> None:
        """Stop the task."""
        self.pending.cancel()


# === The path.


UPLOADS, PICTURES = "uploads", "pictures"
"""Folders of the blob store."""
MAX_TRIES = 12
"""How often an upload is matched again because another one was stored in between."""


class UploadPath:
    """Takes uploads through their handlers. Nothing is stored unless the transaction commits.

    Parameters
    ----------
    blobs : Blobs
        Where uploads and plots are stored.
    quotas : Quotas
        Of keys and agencies.
    queue : JobQueue
        Where uploads wait that take too long for an immediate response.
    """

    def __init__(
        self,
        database: Database,
        clock: Clock,
        blobs: Blobs,
        quotas: Quotas,
        queue: JobQueue,
        idempotency_ttl: timedelta,
    ) -> None:
        self._database, self._clock, self._blobs = database, clock, blobs
        self._quotas, self._queue, self._ttl = quotas, queue, idempotency_ttl

    def decode_now(
        self, caller: Caller, upload: Upload, handler: UploadHandler[SignalT], key: IdempotencyKey | None
    ) -> tuple[DecodeDocument, bool]:
        """Decode an upload whose sender waits for the response.

        Returns
        -------
        decode : DecodeDocument
        replayed : bool
            Another request with the same Idempotency-Key was faster; nothing was stored.

        Raises
        ------
        Unavailable
            The decoder processes are busy, or other uploads about the same markers were stored in between each time.
        """
        agency_id, received_at = upload.agency_id, upload.received_at
        with (
            measured(handler.kind) as measure,
            staged(self._blobs) as stage,
            cancelled_on_error(handler.start(upload)) as started,
        ):
            row = new_decode(handler, upload, stage)  # while the decoder process works
            for signal, picture_key in _signals(handler, started, stage):
                try:
                    with write_once(self._database, agency_id, key, received_at, self._ttl) as (connection, answer):
                        if answer.replayed:
                            return answer.response, True
                        decoded = handler.match(connection, upload, signal)
                        measure.has_read = bool(decoded.observations)
                        now, result = self._clock(), decoded.result
                        row = row._replace(state="done", progress=1.0, attempts=1, finished_at=now)
                        row = row._replace(result=result, picture_key=picture_key)
                        self._quotas.count(connection, caller, upload.file.size)
                        store.add_decode(connection, agency_id, caller.key_id, row)
                        count_upload(connection, agency_id, row.id, upload.context, received_at)
                        _store_findings(connection, upload, row.id, decoded, result, now)
                        document = answer.store(decode_document(row))
                except OutdatedMatch:
                    continue
                stage.keep()
                return document, False
        raise _outdated_each_time()

    def put_in_queue(
        self, caller: Caller, upload: Upload, handler: UploadHandler[SignalT], key: IdempotencyKey | None
    ) -> tuple[DecodeDocument, bool]:
        """Store an upload with a job that decodes it. Returns the decode and `replayed`, as `decode_now`."""
        agency_id, now = upload.agency_id, upload.received_at
        with staged(self._blobs) as stage:
            row = new_decode(handler, upload, stage)
            job_input = {"label": caller.label}
            job = new_job(JobKind.DECODE, row.id, agency_id, caller.key_id, now, job_input=job_input)
            with write_once(self._database, agency_id, key, now, self._ttl) as (connection, answer):
                if answer.replayed:
                    return answer.response, True
                self._quotas.count(connection, caller, upload.file.size)
                store.add_decode(connection, agency_id, caller.key_id, row)
                jobs.add_job(connection, job)
                count_upload(connection, agency_id, row.id, upload.context, now)
                document = answer.store(decode_document(row))
            stage.keep()
        self._queue.submit(row.id, agency_id, JobKind.DECODE)
        return document, False

    def decode_queued(self, job: RunningJob, upload: Upload, handler: UploadHandler[SignalT]) -> None:
        """Decode an upload that was queued, and finish its job.

        Raises
        ------
        Unavailable
            As `decode_now`.
        """
        agency_id, decode_id = upload.agency_id, job.row.id
        with (
            measured(handler.kind) as measure,
            staged(self._blobs) as stage,
            cancelled_on_error(handler.start(upload)) as started,
        ):
            for signal, picture_key in _signals(handler, started, stage):
                try:
                    with self._database.write() as connection:
                        decoded = handler.match(connection, upload, signal)
                        measure.has_read = bool(decoded.observations)
                        if not job.finish(connection):
                            return
                        now, result = self._clock(), decoded.result
                        store.store_result(
                            connection, agency_id, decode_id, result=result, picture_key=picture_key, now=now
                        )
                        _store_findings(connection, upload, decode_id, decoded, result, now)
                except OutdatedMatch:
                    continue
                stage.keep()
                return
        raise _outdated_each_time()

    def decode_again(self, upload: Upload, handler: UploadHandler[SignalT]) -> tuple[Decoded, bytes | None]:
        """Decode a stored upload again and match it; nothing is stored. Returns what was decoded, and its plot.

        Raises
        ------
        Unavailable
            The decoder processes are busy.
        """
        with cancelled_on_error(handler.start(upload)) as started:
            signal = started.result()
            with self._database.read() as connection:
                return handler.match(connection, upload, signal), handler.plot(signal)


def new_decode(handler: UploadHandler[SignalT], upload: Upload, stage: StagedBlobs) -> DecodeRow:
    """A decode that waits for its result, with its upload, which is written as a blob."""
    return DecodeRow(
        new_id(upload.received_at),
        handler.kind,
        upload.context.document(),
        upload.received_at,
        upload_key=stage.add(UPLOADS, upload.file),
        upload_bytes=upload.file.size,
        upload_sha256=upload.file.sha256,
    )


@contextmanager
def cancelled_on_error(pending: Pending[SignalT]) -> Iterator[Pending[SignalT]]:
    """Stop work in the decoder processes if the block raises an error."""
    try:
        yield pending
    except BaseException:
        pending.cancel()
        raise


def _signals(
    handler: UploadHandler[SignalT], started: Pending[SignalT], stage: StagedBlobs
) -> Iterator[tuple[SignalT, str | None]]:
    """The signal, and the key of its plot; another one each time that the match of the one before was outdated."""
    for _try in range(MAX_TRIES):
        signal = started.result()
        plot = handler.plot(signal)
        picture_key = stage.put(PICTURES, plot) if plot is not None else None
        yield signal, picture_key
        stage.delete(picture_key)


def _outdated_each_time() -> Unavailable:
    return Unavailable("other drives past the same markers are being stored", cure="try again in a few seconds")


def _store_findings(
    connection: sa.Connection,
    upload: Upload,
    decode_id: str,
    decoded: Decoded,
    result: StoredResult,
    now: datetime,
) -> None:
    markers.add_spans(connection, upload.agency_id, decode_id, decoded.spans)
    store.add_observations(connection, upload.agency_id, decode_id, decoded.observations)
    add_unregistered(connection, upload.agency_id, decode_id, decoded.unregistered)
    context = upload.context
    vehicle = context.vehicle.id if context.vehicle else upload.author.key_id or ""
    sensor = BAR if context.trace is not None else RADIO if context.packets is not None else CAMERA
    drive = ObservedDrive(decode_id, sensor, vehicle, decoded.observations, decoded.unregistered)
    record_drive(connection, upload.agency_id, drive, now)
    count_driven(connection, upload.agency_id, decode_id, upload.context, result)
    for action, detail in decoded.incidents.items():
        audit.record(connection, upload.agency_id, upload.author, action, now=now, subject=decode_id, detail=detail)


# === Times and outcomes of decodes, for /metrics: of this process, whichever app or worker in it decodes.


Outcome = Literal["read", "none", "refused", "failed"]
DECODE_METRICS = CollectorRegistry()
_SECONDS = Histogram(
    "waymark_decode_seconds",
    "Time from the start of a decode to its stored result, waiting for a decoder process included",
    ("kind", "outcome"),
    buckets=(0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 120, 300, 600),
    registry=DECODE_METRICS,
)


class MeasuredDecode:
    """A decode that goes on.

    Attributes
    ----------
    has_read : bool
        Whether a marker was read in it.
    """

    has_read = False


@contextmanager
def measured(kind: str) -> Iterator[MeasuredDecode]:
    """Measure a decode: what was refused is the upload's fault, what failed is ours or a matter of load."""
    decode, started_s = MeasuredDecode(), time.perf_counter()
    outcome: Outcome = "failed"
    try:
        yield decode
        outcome = "read" if decode.has_read else "none"
    except Unavailable:
        raise
    except WaymarkError:
        outcome = "refused"
        raise
    finally:
        _SECONDS.labels(kind, outcome).observe(time.perf_counter() - started_s)


def written_metrics(registry: CollectorRegistry) -> bytes:
    """The metrics of an app or worker, and of the decodes of this process, as text."""
    return generate_latest(registry) + generate_latest(DECODE_METRICS)
