"""The path of every upload: start, decode, match, store; the same for an immediate response and for a job.

`UploadHandler` is what one kind of upload adds to it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import sqlalchemy as sa

from app.errors import Unavailable
from app.formats.spooled_file import SpooledFile
from app.registry import audit, cerpms
from app.registry import decodes as store
from app.registry.audit import Author
from app.registry.database import Database
from app.registry.decodes import DecodeRow, NewObservation
from app.registry.health import NewUnregistered, add_unregistered
from app.registry.ids import new_id
from app.services.access.access import Caller
from app.services.decodes.context import DecodeContext
from app.services.decodes.documents import DecodeDocument, decode_document
from app.services.decodes.frame_documents import FramesResult
from app.services.decodes.kinds import DecodeKind
from app.services.decodes.measures import MeasuredDecode, measured
from app.services.decodes.packet_documents import PacketsResult
from app.services.decodes.trace_documents import TraceResultDocument
from app.services.fleet.vehicle_uploads import count_driven, count_upload
from app.services.health.record import BAR, CAMERA, RADIO, ObservedDrive, record_drive
from app.services.idempotency import IdempotencyKey, idempotent
from app.services.jobs import RunningJob
from app.services.ports import Blobs, Clock
from app.services.staged_blobs import StagedBlobs, staged
from app.services.uploads.quotas import Quotas

UPLOADS, PICTURES = "uploads", "pictures"
"""Folders of the blob store."""
MAX_TRIES = 12
"""How often an upload is matched anew because another one was stored in between."""
SignalT = TypeVar("SignalT")
SignalT_co = TypeVar("SignalT_co", covariant=True)


@dataclass(frozen=True, slots=True)
class Upload:
    """A file with its context.

    Attributes
    ----------
    agency_id : str
    author : Author
        Who uploaded it.
    file : SpooledFile
    context : DecodeContext
    received_at : datetime
    wait_s : float
        How long to wait for a decoder process. [s]
    report_progress : callable
        Called with the frames that are done, and all, by handlers that work for long; what it raises stops the decode.
    report_part : callable
        Called as `report_progress`, and with the result so far, which is stored; what it raises stops the decode.
    again_id : str or None
        Id of the stored decode that is decoded again, to compare; nothing of that is stored with it.
    """

    agency_id: str
    author: Author
    file: SpooledFile
    context: DecodeContext
    received_at: datetime
    wait_s: float = 0.0
    report_progress: Callable[[int, int], None] = lambda _done, _total: None
    report_part: Callable[[int, int, FramesResult], None] = lambda _done, _total, _part: None
    again_id: str | None = None

    @property
    def observed_at(self) -> datetime:
        """When markers were observed: when the upload was captured, else when it was received."""
        return self.context.captured_at or self.received_at


@dataclass(frozen=True, slots=True)
class Decoded:
    """An upload that was decoded and matched, ready to be stored.

    Attributes
    ----------
    document
        The result.
    observations : sequence of NewObservation
    unregistered : sequence of NewUnregistered
        Markers that were read where none is registered.
    spans : sequence of dict
        Transmissions of CERPMs that were received.
    incidents : mapping of str to mapping
        What the audit log records about the upload: details by action.
    """

    document: FramesResult | TraceResultDocument | PacketsResult
    observations: Sequence[NewObservation] = ()
    spans: Sequence[dict[str, Any]] = ()
    incidents: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    unregistered: Sequence[NewUnregistered] = ()


class OutdatedMatch(Exception):
    """What an upload was matched against has changed: it has to be matched anew."""


class Started(Protocol[SignalT_co]):
    """An upload in the decoder processes."""

    def result(self) -> SignalT_co:
        """Wait for the signal; after an `OutdatedMatch` it is called again."""

    def cancel(self) -> None:
        """Stop the decoder processes."""


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
    def start(self, upload: Upload) -> Started[SignalT]:
        """Hand the upload to the decoder processes.

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


class DecodeRecord(Protocol):
    """Where a decode is stored: in a new row, or in the row that was queued."""

    def stage(self, stage: StagedBlobs) -> None:
        """Write the upload, if it is not stored yet."""

    def store(self, connection: sa.Connection, match: Callable[[], Decoded], picture_key: str | None) -> bool:
        """Store what `match` returns. Returns False if the result was stored before."""


class UploadPath:
    """Takes uploads through their handlers.

    Parameters
    ----------
    database : Database
    blobs : Blobs
        Where uploads and plots are stored.
    """

    def __init__(self, database: Database, blobs: Blobs) -> None:
        self._database, self._blobs = database, blobs

    def decode(self, upload: Upload, handler: UploadHandler[SignalT], record: DecodeRecord) -> None:
        """Decode an upload, match it and store the result. Nothing is stored unless the transaction commits.

        Raises
        ------
        Unavailable
            The decoder processes are busy, or other uploads about the same markers were stored in between each time.
        """
        with (
            measured(handler.kind) as measure,
            staged(self._blobs) as stage,
            _cancelled_on_error(handler.start(upload)) as started,
        ):
            record.stage(stage)  # while the decoder process works
            for _try in range(MAX_TRIES):
                signal = started.result()
                plot = handler.plot(signal)
                picture_key = stage.put(PICTURES, plot) if plot is not None else None
                try:
                    with self._database.write() as connection:
                        is_new = record.store(
                            connection, _bound(handler, connection, upload, signal, measure), picture_key
                        )
                except OutdatedMatch:
                    stage.delete(picture_key)
                    continue
                if is_new:
                    stage.keep()
                return
        raise Unavailable("other drives past the same markers are being stored", cure="try again in a few seconds")

    def decode_again(self, upload: Upload, handler: UploadHandler[SignalT]) -> tuple[Decoded, bytes | None]:
        """Decode a stored upload again and match it; nothing is stored. Returns what was decoded, and its plot.

        Raises
        ------
        Unavailable
            The decoder processes are busy.
        """
        with _cancelled_on_error(handler.start(upload)) as started:
            signal = started.result()
            with self._database.read() as connection:
                return handler.match(connection, upload, signal), handler.plot(signal)


def _bound(
    handler: UploadHandler[SignalT], connection: sa.Connection, upload: Upload, signal: SignalT, measure: MeasuredDecode
) -> Callable[[], Decoded]:
    def match() -> Decoded:
        decoded = handler.match(connection, upload, signal)
        measure.has_read = bool(decoded.observations)
        return decoded

    return match


@contextmanager
def _cancelled_on_error(started: Started[SignalT]) -> Iterator[Started[SignalT]]:
    try:
        yield started
    except BaseException:
        started.cancel()
        raise


# --- records ----------------------------------------------------------------------------------------------------------


class NewRecord:
    """The decode of an upload whose sender waits for the response.

    Attributes
    ----------
    response : DecodeDocument
        The decode, once it is stored.
    replayed : bool
        Another request with the same Idempotency-Key was faster; nothing was stored.
    """

    response: DecodeDocument

    def __init__(
        self, caller: Caller, handler: UploadHandler[Any], upload: Upload, clock: Clock,
        *, quotas: Quotas, key: IdempotencyKey | None, ttl: timedelta,
    ) -> None:  # fmt: skip
        self._caller, self._upload, self._clock, self._quotas = caller, upload, clock, quotas
        self._key, self._ttl = key, ttl
        self._row = new_decode(handler, upload)
        self.replayed = False

    def stage(self, stage: StagedBlobs) -> None:
        """Write the upload."""
        self._row = with_upload(self._row, stage, self._upload)

    def store(self, connection: sa.Connection, match: Callable[[], Decoded], picture_key: str | None) -> bool:
        """Store a new decode that is done."""
        agency_id, now = self._caller.agency_id, self._upload.received_at
        with idempotent(connection, agency_id, self._key, now, self._ttl) as answer:
            if not answer.replayed:
                decoded = match()
                row = self._row._replace(
                    state="done", progress=1.0, attempts=1, picture_key=picture_key, result=dict(decoded.document),
                    finished_at=self._clock(),
                )  # fmt: skip
                self._quotas.count(connection, self._caller, self._upload.file.size)
                store.add_decode(connection, agency_id, self._caller.key_id, row)
                count_upload(connection, agency_id, row.id, self._upload.context, now)
                _store_decoded(connection, self._upload, row.id, decoded, self._clock())
                answer.store(decode_document(row))
        self.response, self.replayed = answer.response, answer.replayed
        return not answer.replayed


class QueuedRecord:
    """The decode of a job."""

    def __init__(self, job: RunningJob, upload: Upload, clock: Clock) -> None:
        self._job, self._upload, self._clock = job, upload, clock

    def stage(self, stage: StagedBlobs) -> None:
        """The upload was stored when it was queued."""

    def store(self, connection: sa.Connection, match: Callable[[], Decoded], picture_key: str | None) -> bool:
        """Store the result of the decode, and finish its job."""
        decoded, decode_id = match(), self._job.row.id
        if not self._job.finish(connection):
            return False
        store.store_result(
            connection, self._upload.agency_id, decode_id,
            result=decoded.document, picture_key=picture_key, now=self._clock(),
        )  # fmt: skip
        _store_decoded(connection, self._upload, decode_id, decoded, self._clock())
        return True


def new_decode(handler: UploadHandler[Any], upload: Upload) -> DecodeRow:
    """A decode that waits for its result."""
    return DecodeRow(new_id(upload.received_at), handler.kind, upload.context.document(), upload.received_at)


def with_upload(row: DecodeRow, stage: StagedBlobs, upload: Upload) -> DecodeRow:
    """A decode with its upload, which is written as a blob."""
    key = stage.add(UPLOADS, upload.file)
    return row._replace(upload_key=key, upload_bytes=upload.file.size, upload_sha256=upload.file.sha256)


def _store_decoded(connection: sa.Connection, upload: Upload, decode_id: str, decoded: Decoded, now: datetime) -> None:
    cerpms.add_spans(connection, upload.agency_id, decode_id, decoded.spans)
    store.add_observations(connection, upload.agency_id, decode_id, decoded.observations)
    add_unregistered(connection, upload.agency_id, decode_id, decoded.unregistered)
    context = upload.context
    vehicle = context.vehicle["id"] if context.vehicle else upload.author.key_id or ""
    sensor = BAR if context.trace is not None else RADIO if context.packets is not None else CAMERA
    drive = ObservedDrive(decode_id, sensor, vehicle, decoded.observations, decoded.unregistered)
    record_drive(connection, upload.agency_id, drive, now)
    count_driven(connection, upload.agency_id, decode_id, upload.context, decoded.document)
    for action, detail in decoded.incidents.items():
        audit.record(connection, upload.agency_id, upload.author, action, now=now, subject=decode_id, detail=detail)
