"""Uploads are decoded now or queued, and decodes are listed, read and cancelled."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import numpy as np
from typing_extensions import TypedDict

from app.decoders.cerpm.merge import vehicle_positions
from app.decoders.cerpm.verify import decode_message
from app.decoding.declarations import DeclaredPackets, DeclaredTrace, DecodeContext, UploadContext
from app.errors import InvalidParameter, NotFound, WaymarkError
from app.formats.format import SpooledFile
from app.markers.cerpm import MESSAGE_BYTES
from app.registry import decodes as store
from app.registry.audit import Author
from app.registry.database import Database
from app.registry.decodes import DecodeFilter, DecodeRow, StoredResult
from app.sensors.pose_track import PoseTrack, ReceivedPacket
from app.services.access.access import Caller
from app.services.access.audit import author_of
from app.services.decodes.context import DecodeKind, DecodeRules
from app.services.decodes.documents import DecodeDocument, DecodeHead, decode_document, decode_head
from app.services.decodes.frame_poses import track_csv, track_geojson, track_gpx, track_points
from app.services.decodes.outputs import readings_csv, readings_geojson
from app.services.decodes.packet_documents import MAX_REFUSED
from app.services.decodes.packet_tasks import read_drive
from app.services.decodes.trace_tasks import DEFAULT_SERIES, MAX_POINTS, MAX_SERIES, SamplesDocument, read_samples
from app.services.decodes.upload_path import Upload, UploadHandler, UploadPath
from app.services.documents import listed
from app.services.fleet.vehicles import resolve_context
from app.services.idempotency import IdempotencyKey, find_response
from app.services.jobs import RunningJob
from app.services.ports import Blobs, Clock, DecoderProcesses, JobQueue
from app.services.uploads.quotas import Quotas
from app.values import JsonObject

_WAIT_S = 60.0
"""How long a job waits for a decoder process before it is put back. [s]"""


class Decodes:
    """Use cases on decodes.

    Parameters
    ----------
    blobs : Blobs
        Where uploads are stored.
    quotas : Quotas
        Of keys and agencies.
    queue : JobQueue
        Where uploads wait that take too long for an immediate response.
    handlers : sequence of UploadHandler
        The first one that accepts an upload decodes it.
    """

    def __init__(
        self,
        database: Database,
        clock: Clock,
        *,
        blobs: Blobs,
        quotas: Quotas,
        queue: JobQueue,
        handlers: Sequence[UploadHandler[object]],
        rules: DecodeRules | None = None,
    ) -> None:
        self._database, self._clock = database, clock
        self._blobs, self._handlers = blobs, handlers
        self._path = UploadPath(database, clock, blobs, quotas, queue, (rules or DecodeRules()).idempotency_ttl)

    # --- uploads ------------------------------------------------------------------------------------------------------

    def decode_upload(
        self,
        caller: Caller,
        file: SpooledFile,
        stated: UploadContext,
        key: IdempotencyKey | None = None,
        *,
        name: str = "",
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
            context = resolve_context(connection, caller, stated, file, name)
        handler = next(handler for handler in self._handlers if handler.accepts(context, file))
        upload = Upload(caller.agency_id, author_of(caller), file, context, now)
        if handler.is_job(file) or as_job:
            return self._path.put_in_queue(caller, upload, handler, key)
        return self._path.decode_now(caller, upload, handler, key)

    def run(self, job: RunningJob) -> None:
        """Decode an upload that was queued; the handler of jobs of the kind `JobKind.DECODE`."""
        with self._database.read() as connection:
            row = store.get_decode(connection, job.row.agency_id, job.row.id)
        assert row.upload_key is not None
        handler = next(handler for handler in self._handlers if handler.kind == row.kind)
        with self._blobs.opened(row.upload_key) as file:
            author = Author(job.row.input.get("label", ""), job.row.holder_id)
            context = DecodeContext.model_validate(row.context)
            upload = Upload(job.row.agency_id, author, file, context, row.created_at, wait_s=_WAIT_S, job=job)
            self._path.decode_queued(job, upload, handler)

    def decode_again(self, agency_id: str, decode_id: str) -> tuple[JsonObject, bytes | None]:
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
            context = DecodeContext.model_validate(row.context)
            upload = Upload(agency_id, Author(""), file, context, row.created_at, wait_s=_WAIT_S, again_id=decode_id)
            decoded, plot = self._path.decode_again(upload, handler)
        return decoded.result, plot

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
            agency_id, own = caller.agency_id, caller.own_key_id
            rows = store.list_decodes(
                connection, agency_id, wanted or DecodeFilter(), before=before, limit=limit + 1, holder_id=own
            )
        page = [decode_head(row) for row in rows[:limit]]
        return page, page[-1]["id"] if len(rows) > limit else None


# === A closer look at stored decodes: samples of traces, packets of logs, the vehicle's track, lists of readings.


TrackForm = Literal["geojson", "csv", "gpx"]
ReadingsForm = Literal["geojson", "csv"]
_TRACK_WRITERS: Mapping[str, Callable[[DecodeRow], object]] = {
    "geojson": track_geojson,
    "csv": track_csv,
    "gpx": track_gpx,
}
_READING_WRITERS: Mapping[str, Callable[[DecodeRow], object]] = {"geojson": readings_geojson, "csv": readings_csv}


MAX_PACKETS = 20_000
"""Packets that are listed at most. 2 MB of JSON."""


class VehicleTrackDocument(TypedDict):
    """The vehicle's own track beside a packet log; the heading is null where it is not known."""

    time_s: list[float]
    lon_deg: list[float]
    lat_deg: list[float]
    heading_deg: list[float | None]


class PacketsDocument(TypedDict):
    """Packets of a log in the order of their times, as columns; null where a value is not known.

    `time_s` are seconds since 1970-01-01 UTC. `verdict` is `accepted` for authentic packets and their repetitions, else
    the reason why a packet was refused; it is null where the decode does not list it, which has 500 refused packets at
    most. The position is that of the vehicle.
    """

    total: int
    entry: list[int]
    time_s: list[float | None]
    number: list[int | None]
    rssi_dbm: list[float | None]
    snr_db: list[float | None]
    verdict: list[str | None]
    reason: list[str | None]
    lon_deg: list[float | None]
    lat_deg: list[float | None]
    track: VehicleTrackDocument | None


class DecodeDetails:
    """Use cases on what a decode and its upload hold beyond the stored result.

    Parameters
    ----------
    blobs : Blobs
        Where uploads are stored.
    """

    def __init__(
        self, database: Database, *, blobs: Blobs, processes: DecoderProcesses, rules: DecodeRules | None = None
    ) -> None:
        self._database, self._blobs, self._processes = database, blobs, processes
        self._rules = rules or DecodeRules()

    def samples(
        self,
        caller: Caller,
        decode_id: str,
        *,
        series: Sequence[str] = (),
        from_s: float | None = None,
        to_s: float | None = None,
        points: int = 100_000,
    ) -> SamplesDocument:
        """Samples of a trace, thinned to a number of points.

        Raises
        ------
        NotFound
            There is no such decode, it is of no trace, or it is not done.
        InvalidParameter
            There is no such series, there are too many, or the times contradict each other.
        """
        row = self._done(caller, decode_id, DecodeKind.TRACE, "a trace")
        names = tuple(dict.fromkeys(series)) or DEFAULT_SERIES
        if len(names) > MAX_SERIES:
            raise InvalidParameter(
                f"{len(names)} series are asked for", field="series", limit=f"{MAX_SERIES} in a request"
            )
        if from_s is not None and to_s is not None and from_s >= to_s:
            raise InvalidParameter(
                f"from_s is {from_s:g}, to_s {to_s:g}", field="from_s", limit="from_s below to_s", cure="swap them"
            )
        context = DecodeContext.model_validate(row.context)
        declared, name = context.trace or DeclaredTrace(), context.file_name or "recording"
        with self._blobs.opened(_upload_key(row)) as file:
            most, limits = min(points, MAX_POINTS), self._rules.traces
            return self._processes.run(read_samples, name, file, declared, names, from_s, to_s, most, limits)

    def packets(self, caller: Caller, decode_id: str) -> PacketsDocument:
        """Packets of a log with their strength and verdict, and the vehicle's track.

        Raises
        ------
        NotFound
            There is no such decode, it is of no packet log, or it is not done.
        """
        row = self._done(caller, decode_id, DecodeKind.PACKETS, "a packet log")
        context = DecodeContext.model_validate(row.context)
        declared, name = context.packets or DeclaredPackets(), context.file_name or "packets"
        with self._blobs.opened(_upload_key(row)) as file:
            rules = self._rules
            files = self._processes.run(read_drive, name, file, declared, rules.packets, rules.images)
        return _packets(files.packets, files.track, row.result or {})

    def track(self, caller: Caller, decode_id: str, form: TrackForm) -> object:
        """The vehicle's track: a text, or a document for ``geojson``.

        Raises
        ------
        NotFound
            There is no such decode, it is not done, or it gives no position.
        """
        row = self._done(caller, decode_id)
        if form != "geojson" and not track_points(row):
            raise NotFound(
                f"decode {decode_id} gives no position of the vehicle",
                field="decode_id",
                limit="a matched marker with its position, or the vehicle's track beside the frames or packets",
                cure="send coarse_position and camera, or a track in the same ZIP",
            )
        return _TRACK_WRITERS[form](row)

    def readings(self, caller: Caller, decode_id: str, form: ReadingsForm) -> object:
        """All readings in the order of their times: a text, or a document for ``geojson``.

        Raises
        ------
        NotFound
            There is no such decode, or it is not done.
        """
        return _READING_WRITERS[form](self._done(caller, decode_id))

    def _done(self, caller: Caller, decode_id: str, kind: DecodeKind | None = None, what: str = "") -> DecodeRow:
        with self._database.read() as connection:
            row = store.get_decode(connection, caller.agency_id, decode_id, holder_id=caller.own_key_id)
        if kind is not None and row.kind != kind:
            raise NotFound(f"decode {decode_id} is of kind {row.kind}", field="decode_id", limit=f"decodes of {what}")
        if row.result is None:
            raise NotFound(
                f"decode {decode_id} has no result: it is {row.state}", field="decode_id", cure="wait until it is done"
            )
        return row


def _upload_key(row: DecodeRow) -> str:
    if row.upload_key is None:
        raise NotFound(f"the upload of decode {row.id} is not stored any more", field="decode_id")
    return row.upload_key


def _packets(packets: Sequence[ReceivedPacket], track: PoseTrack | None, result: StoredResult) -> PacketsDocument:
    """Columns of packets, of many evenly chosen ones."""
    times_s = np.array([packet.received_at_s for packet in packets], float)
    order = np.argsort(times_s, kind="stable")
    kept = (
        order[np.linspace(0, len(order) - 1, min(len(order), MAX_PACKETS)).round().astype(int)] if len(order) else order
    )
    chosen = [packets[k] for k in kept]
    stored = (result.get("report") or {}).get("refused") or []
    refused = {entry["entry"]: entry for entry in stored}
    last = stored[-1]["entry"] if len(stored) >= MAX_REFUSED else None
    positions = np.full((len(chosen), 2), np.nan)
    if track is not None:
        positions = vehicle_positions(track, times_s[kept])
    verdicts = [_verdict(packet.entry, refused, last) for packet in chosen]
    return {
        "total": len(packets),
        "entry": [packet.entry for packet in chosen],
        "time_s": listed(times_s[kept], 3),
        "number": [_number(packet) for packet in chosen],
        "rssi_dbm": listed([packet.rssi_dbm for packet in chosen], 2),
        "snr_db": listed([packet.snr_db for packet in chosen], 2),
        "verdict": verdicts,
        "reason": [refused[packet.entry]["reason"] if packet.entry in refused else None for packet in chosen],
        "lon_deg": listed(positions[:, 0], 9),
        "lat_deg": listed(positions[:, 1], 9),
        "track": None if track is None or not len(track.time_s) else _track(track),
    }


def _verdict(entry: int, refused: Mapping[int, Mapping[str, object]], last: int | None) -> str | None:
    if entry in refused:
        return str(refused[entry]["verdict"])
    return "accepted" if last is None or entry <= last else None


def _track(track: PoseTrack) -> VehicleTrackDocument:
    kept = np.linspace(0, len(track.time_s) - 1, min(len(track.time_s), MAX_PACKETS)).round().astype(int)
    return {
        "time_s": np.round(track.time_s[kept], 3).tolist(),
        "lon_deg": np.round(track.lon_deg[kept], 9).tolist(),
        "lat_deg": np.round(track.lat_deg[kept], 9).tolist(),
        "heading_deg": listed(track.heading_deg[kept], 2),
    }


def _number(packet: ReceivedPacket) -> int | None:
    """The number that a packet states, whoever sent it."""
    if packet.claim is not None:
        return packet.claim.number
    if packet.payload is None or len(packet.payload) != MESSAGE_BYTES:
        return None
    try:
        return decode_message(packet.payload)[0].number
    except WaymarkError:
        return None
