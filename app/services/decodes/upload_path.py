"""The path of every upload: start, decode, match, store; the same for an immediate response and for a job.

`UploadHandler` is what one kind of upload adds to it.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Annotated, Any, ClassVar, Generic, Literal, NotRequired, Protocol, TypeVar, cast

import sqlalchemy as sa
from prometheus_client import CollectorRegistry, Histogram, generate_latest
from pydantic import Field, JsonValue
from typing_extensions import TypedDict

from app.errors import Unavailable, WaymarkError
from app.formats.format import SpooledFile
from app.registry import audit, markers
from app.registry import decodes as store
from app.registry.audit import Author
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.decodes import DecodeRow, NewObservation
from app.registry.health import NewUnregistered, add_unregistered
from app.registry.jobs import JobState
from app.services.access.access import Caller
from app.services.blobs import StagedBlobs, staged
from app.services.decodes.context import DecodeContext, DecodeKind
from app.services.decodes.frame_documents import (
    AnyReading,
    FixDocument,
    FrameDocument,
    FramesResult,
    FrameSummary,
    SeenPlateDocument,
)
from app.services.decodes.frame_poses import GapDocument, ReceiverPositions
from app.services.decodes.lane_documents import DecodedLaneDocument, OverlayDocument, SteeringDocument
from app.services.decodes.packet_documents import (
    PacketReportDocument,
    PacketsResult,
    PacketSummary,
    PathLossDocument,
    ReceivedMarkerDocument,
)
from app.services.decodes.trace_documents import (
    CrossingDocument,
    NoiseDocument,
    PassedMagnetDocument,
    TagDocument,
    TagFixDocument,
    TraceMotionDocument,
    TraceReportDocument,
    TraceResultDocument,
    TraceSummary,
)
from app.services.documents import ErrorDocument
from app.services.fleet.vehicles import count_driven, count_upload
from app.services.health.record import BAR, CAMERA, RADIO, ObservedDrive, record_drive
from app.services.idempotency import IdempotencyKey, idempotent
from app.services.jobs import RunningJob
from app.services.ports import Blobs, Clock
from app.services.uploads.quotas import Quotas

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


# === Decodes as clients see them.


class DecodeLinks(TypedDict):
    """Paths of the decode and of what can be drawn from it."""

    self: str
    annotated: NotRequired[str]
    samples: NotRequired[str]
    packets: NotRequired[str]
    track: NotRequired[str]
    readings: NotRequired[str]
    plot: NotRequired[str]
    lane: NotRequired[str]
    overlay: NotRequired[str]


class DecodeHead(TypedDict):
    """A decode without its result."""

    id: str
    state: JobState
    kind: DecodeKind
    progress: Annotated[float, Field(description="0 to 1.")]
    attempts: int
    created_at: datetime
    finished_at: datetime | None
    context: Annotated[dict[str, JsonValue], Field(description="What was declared of the upload.")]
    file_name: Annotated[str | None, Field(description="Of the uploaded file, if it had one.")]
    upload_bytes: Annotated[int | None, Field(description="Size of the upload; null of those of older versions.")]
    error: ErrorDocument | None
    links: DecodeLinks


class DecodeDocument(DecodeHead):
    """A decode. `decoder` and what follows it are there once it is done, or as far as it is done: then `partial`."""

    partial: NotRequired[Annotated[bool, Field(description="The decode goes on; this is its result so far.")]]

    decoder: NotRequired[str]
    summary: NotRequired[FrameSummary | TraceSummary | PacketSummary]
    codebook_plates: NotRequired[int]
    readings: NotRequired[list[AnyReading]]
    frames: NotRequired[list[FrameDocument]]
    plates: NotRequired[list[SeenPlateDocument]]
    gaps: NotRequired[list[GapDocument]]
    receiver: NotRequired[ReceiverPositions | None]
    warnings: NotRequired[list[str]]
    fix: NotRequired[FixDocument | TagFixDocument | None]
    codebook_tags: NotRequired[int]
    report: NotRequired[TraceReportDocument | PacketReportDocument]
    tags: NotRequired[list[TagDocument]]
    crossings: NotRequired[list[CrossingDocument]]
    magnets: NotRequired[list[PassedMagnetDocument]]
    noise: NotRequired[list[NoiseDocument]]
    motion: NotRequired[TraceMotionDocument]
    markers: NotRequired[list[ReceivedMarkerDocument]]
    lane: NotRequired[DecodedLaneDocument]
    steering: NotRequired[SteeringDocument | None]
    overlay: NotRequired[OverlayDocument | None]
    path_loss: NotRequired[PathLossDocument | None]


class DecodePage(TypedDict):
    """A page of decodes without their results, newest first; the Link header leads to the next one."""

    items: list[DecodeHead]


def decode_document(row: DecodeRow) -> DecodeDocument:
    """A decode with its result, once there is one."""
    so_far = {"partial": True} if row.state == "running" and row.result else {}
    return cast("DecodeDocument", {**decode_head(row), **so_far, **(row.result or {})})


def decode_head(row: DecodeRow) -> DecodeHead:
    """A decode without its result."""
    return {
        "id": row.id,
        "state": row.state,
        "kind": DecodeKind(row.kind),
        "progress": row.progress,
        "attempts": row.attempts,
        "created_at": row.created_at,
        "finished_at": row.finished_at,
        "context": {name: value for name, value in row.context.items() if name != "file_name"},
        "file_name": _file_name(row.context),
        "upload_bytes": row.upload_bytes,
        "error": cast("ErrorDocument | None", row.error),
        "links": _links(f"/v1/decodes/{row.id}", row.kind, row.result or {}),
    }


def _file_name(context: Mapping[str, Any]) -> str | None:
    declared = context.get("trace") or context.get("packets") or {}
    return context.get("file_name") or declared.get("file_name")


def _links(path: str, kind: str, result: Mapping[str, Any]) -> DecodeLinks:
    links: DecodeLinks = {"self": path}
    frames = [frame["frame"] for frame in result.get("frames", ()) if frame["error"] is None]
    if kind in (DecodeKind.FRAME, DecodeKind.ARCHIVE):
        links["annotated"] = f"{path}/annotated.jpg"
    elif kind == DecodeKind.VIDEO and frames:
        links["annotated"] = f"{path}/annotated.jpg?frame={frames[0]}"
    elif kind != DecodeKind.VIDEO:
        links["plot"] = f"{path}/plot.svg"
    if kind == DecodeKind.TRACE:
        links["samples"] = f"{path}/samples"
    if kind == DecodeKind.PACKETS:
        links["lane"] = f"{path}/lane.geojson"
        links["packets"] = f"{path}/packets"
        if result.get("overlay"):
            links["overlay"] = f"{path}/overlay.jpg"
    if result:
        links["track"], links["readings"] = f"{path}/track.geojson", f"{path}/readings.geojson"
    return links


# === The path of every upload.


UPLOADS, PICTURES = "uploads", "pictures"
"""Folders of the blob store."""
MAX_TRIES = 12
"""How often an upload is matched anew because another one was stored in between."""
SignalT = TypeVar("SignalT")
SignalT_co = TypeVar("SignalT_co", covariant=True)


@dataclass(frozen=True, slots=True)
class Upload:
    """A file with its context."""

    agency_id: str
    author: Author  # who uploaded it
    file: SpooledFile
    context: DecodeContext
    received_at: datetime
    wait_s: float = 0.0  # [s] how long to wait for a decoder process
    # called with the frames that are done, and all, by handlers that work for long; what it raises stops the decode
    report_progress: Callable[[int, int], None] = lambda _done, _total: None
    # called as `report_progress`, and with the result so far, which is stored; what it raises stops the decode
    report_part: Callable[[int, int, FramesResult], None] = lambda _done, _total, _part: None
    # id of the stored decode that is decoded again, to compare; nothing of that is stored with it
    again_id: str | None = None

    @property
    def observed_at(self) -> datetime:
        """When markers were observed: when the upload was captured, else when it was received."""
        return self.context.captured_at or self.received_at


@dataclass(frozen=True, slots=True)
class Decoded:
    """An upload that was decoded and matched, ready to be stored."""

    document: FramesResult | TraceResultDocument | PacketsResult  # the result
    observations: Sequence[NewObservation] = ()
    spans: Sequence[dict[str, Any]] = ()  # transmissions of CERPMs that were received
    # what the audit log records about the upload: details by action
    incidents: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    unregistered: Sequence[NewUnregistered] = ()  # markers that were read where none is registered


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
    replayed : bool
        Another request with the same Idempotency-Key was faster; nothing was stored.
    """

    response: DecodeDocument  # the decode, once it is stored

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
    markers.add_spans(connection, upload.agency_id, decode_id, decoded.spans)
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
