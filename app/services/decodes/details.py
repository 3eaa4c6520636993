"""A closer look at stored decodes: samples of traces, packets of logs, the vehicle's track, lists of readings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from app.decoders.cerpm.payload import decode_message
from app.decoders.cerpm.vehicle_positions import vehicle_positions
from app.errors import InvalidParameter, NotFound, WaymarkError
from app.markers.cerpm import MESSAGE_BYTES
from app.registry import decodes as store
from app.registry.database import Database
from app.registry.decodes import DecodeRow
from app.sensors.pose_track import PoseTrack
from app.sensors.receiver import ReceivedPacket
from app.services.access.access import Caller
from app.services.decoder_processes import DecoderProcesses
from app.services.decodes.decode_track import track_csv, track_geojson, track_gpx, track_points
from app.services.decodes.kinds import DecodeKind
from app.services.decodes.packet_documents import MAX_REFUSED
from app.services.decodes.packet_task import DriveTask
from app.services.decodes.reading_rows import readings_csv, readings_geojson
from app.services.decodes.rules import DecodeRules
from app.services.decodes.sample_task import (
    DEFAULT_SERIES,
    MAX_PACKETS,
    MAX_POINTS,
    MAX_SERIES,
    PacketsDocument,
    SamplesDocument,
    SamplesTask,
    VehicleTrackDocument,
)
from app.services.ports import Blobs

TrackForm = Literal["geojson", "csv", "gpx"]
ReadingsForm = Literal["geojson", "csv"]
_TRACK_WRITERS: Mapping[str, Callable[[DecodeRow], Any]] = {
    "geojson": track_geojson,
    "csv": track_csv,
    "gpx": track_gpx,
}
_READING_WRITERS: Mapping[str, Callable[[DecodeRow], Any]] = {"geojson": readings_geojson, "csv": readings_csv}


class DecodeDetails:
    """Use cases on what a decode and its upload hold beyond the stored result.

    Parameters
    ----------
    database : Database
    blobs : Blobs
        Where uploads are stored.
    processes : DecoderProcesses
    rules : DecodeRules, optional
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
        declared = row.context.get("trace") or {}
        name = str(declared.get("file_name") or "recording")
        with self._blobs.opened(_upload_key(row)) as file:
            task = SamplesTask(name, file, declared, names, from_s, to_s, min(points, MAX_POINTS), self._rules.traces)
            return self._processes.submit(task).result()

    def packets(self, caller: Caller, decode_id: str) -> PacketsDocument:
        """Packets of a log with their strength and verdict, and the vehicle's track.

        Raises
        ------
        NotFound
            There is no such decode, it is of no packet log, or it is not done.
        """
        row = self._done(caller, decode_id, DecodeKind.PACKETS, "a packet log")
        declared = row.context.get("packets") or {}
        name = str(declared.get("file_name") or "packets")
        with self._blobs.opened(_upload_key(row)) as file:
            task = DriveTask(name, file, declared, self._rules.packets, self._rules.images)
            files = self._processes.submit(task).result()
        return _packets(files.packets, files.track, row.result or {})

    def track(self, caller: Caller, decode_id: str, form: TrackForm) -> Any:
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

    def readings(self, caller: Caller, decode_id: str, form: ReadingsForm) -> Any:
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


def _packets(packets: Sequence[ReceivedPacket], track: PoseTrack | None, result: Mapping[str, Any]) -> PacketsDocument:
    """Columns of packets, of many evenly chosen ones."""
    times_s = np.array([packet.received_at_s for packet in packets], float)
    order = np.argsort(times_s, kind="stable")
    kept = (
        order[np.linspace(0, len(order) - 1, min(len(order), MAX_PACKETS)).round().astype(int)] if len(order) else order
    )
    chosen = [packets[k] for k in kept]
    listed = (result.get("report") or {}).get("refused") or []
    refused = {entry["entry"]: entry for entry in listed}
    last = listed[-1]["entry"] if len(listed) >= MAX_REFUSED else None
    positions = np.full((len(chosen), 2), np.nan)
    if track is not None:
        positions = vehicle_positions(track, times_s[kept])
    verdicts = [_verdict(packet.entry, refused, last) for packet in chosen]
    return {
        "total": len(packets),
        "entry": [packet.entry for packet in chosen],
        "time_s": _listed(times_s[kept], 3),
        "number": [_number(packet) for packet in chosen],
        "rssi_dbm": _listed([packet.rssi_dbm for packet in chosen], 2),
        "snr_db": _listed([packet.snr_db for packet in chosen], 2),
        "verdict": verdicts,
        "reason": [refused[packet.entry]["reason"] if packet.entry in refused else None for packet in chosen],
        "lon_deg": _listed(positions[:, 0], 9),
        "lat_deg": _listed(positions[:, 1], 9),
        "track": None if track is None or not len(track.time_s) else _track(track),
    }


def _verdict(entry: int, refused: Mapping[int, Mapping[str, Any]], last: int | None) -> str | None:
    if entry in refused:
        return str(refused[entry]["verdict"])
    return "accepted" if last is None or entry <= last else None


def _track(track: PoseTrack) -> VehicleTrackDocument:
    kept = np.linspace(0, len(track.time_s) - 1, min(len(track.time_s), MAX_PACKETS)).round().astype(int)
    return {
        "time_s": np.round(track.time_s[kept], 3).tolist(),
        "lon_deg": np.round(track.lon_deg[kept], 9).tolist(),
        "lat_deg": np.round(track.lat_deg[kept], 9).tolist(),
        "heading_deg": _listed(track.heading_deg[kept], 2),
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


def _listed(values: Any, places: int) -> list[float | None]:
    rounded: list[float] = np.round(np.asarray(values, float), places).tolist()
    return [value if np.isfinite(value) else None for value in rounded]
