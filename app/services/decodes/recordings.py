"""Recordings of magnetometers and packet logs of CERPMs: decoded, then matched against the registry."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta
from functools import partial

import numpy as np
import sqlalchemy as sa

from app.decoders.cerpm.merge import vehicle_positions
from app.decoders.cerpm.verify import Verdict, Verification
from app.decoders.magnet.identify import ReadTrace, TagFormat
from app.decoding.declarations import DeclaredPackets, DeclaredTrace, DecodeContext
from app.decoding.recordings import (
    DriveFiles,
    NearbyTags,
    ReadPackets,
    lane_markers,
    packet_strengths,
    read_packets_of,
)
from app.errors import TooManyRequests, UnreadableUpload
from app.formats.format import SpooledFile
from app.geodesy import decimal_year
from app.markers.cerpm import MAX_INVALID_TAGS_PER_DAY, MAX_INVALID_TAGS_PER_LOG
from app.plots.lane import SignalPicture
from app.registry import markers
from app.registry.database import Database
from app.registry.decodes import NewObservation
from app.registry.markers import CODEBOOKS, book_of
from app.services.access.agency_secrets import AgencySecrets
from app.services.decodes.context import DecodeKind, DecodeRules
from app.services.decodes.matching import find_known, find_nearby_tags, spans_of
from app.services.decodes.packet_documents import claimed_place, packet_observations, packets_document
from app.services.decodes.packet_tasks import LaneResult, LeftOutMarker, PosedCamera, estimate_lane, read_drive
from app.services.decodes.trace_documents import trace_result
from app.services.decodes.trace_tasks import DecodedTrace, decode_recording
from app.services.decodes.upload_path import Decoded, OutdatedMatch, PendingSignal, Upload, UploadHandler
from app.services.health.record import EVIDENCE
from app.services.health.traces import (
    lane_directions,
    missed_cerpms,
    missed_tags,
    packet_evidence,
    tag_evidence,
    with_evidence,
    with_stretches,
)
from app.services.markers.codebooks import MAX_BOOKS_SEARCHED
from app.services.ports import DecoderProcesses, Pending

# === Limits how often the tags of CERPMs can be guessed by uploading packets.


_SUSPICIOUS = (Verdict.FORGED, Verdict.WRONG_KEY, Verdict.UNCHECKED)


class InvalidTagLimit:
    """Counts the invalid tags that each holder of a key has uploaded today (UTC), in this process."""

    def __init__(self, per_day: int = MAX_INVALID_TAGS_PER_DAY) -> None:
        self._per_day = per_day
        self._day = date.min
        self._counts: dict[str, int] = {}

    def left(self, holder_id: str, now: datetime) -> int:
        """Invalid tags that the next log of a holder may contain, at least one.

        Raises
        ------
        TooManyRequests
            There were too many today.
        """
        left = self._per_day - self._of(now).get(holder_id, 0)
        if left <= 0:
            tomorrow = datetime.combine(now.astimezone(UTC).date() + timedelta(days=1), time(), UTC)
            raise TooManyRequests(
                "too many packets with invalid tags were uploaded with this key today",
                limit=f"{self._per_day} invalid tags in a day (UTC)",
                cure="upload the log after midnight UTC, and look for the source of the packets: see docs/cerpms.md",
                retry_after_s=max(1, math.ceil((tomorrow - now).total_seconds())),
            )
        return min(left, MAX_INVALID_TAGS_PER_LOG)

    def add(self, holder_id: str, invalid_tags: int, now: datetime) -> None:
        """Count the invalid tags of a log."""
        if invalid_tags:
            counts = self._of(now)
            counts[holder_id] = counts.get(holder_id, 0) + invalid_tags

    def _of(self, now: datetime) -> dict[str, int]:
        day = now.astimezone(UTC).date()
        if day > self._day:
            self._day, self._counts = day, {}
        return self._counts


def forgery_detail(verification: Verification) -> dict[str, int] | None:
    """What the audit log records of a log with forged packets; None if there are none."""
    counts = verification.counts()
    if not any(counts[verdict] for verdict in _SUSPICIOUS):
        return None
    return {**{str(verdict): counts[verdict] for verdict in _SUSPICIOUS}, "invalid_tags": verification.invalid_tags}


# === Recordings of magnetometers: through a decoder process, then matched against the registered information tags.


@dataclass(frozen=True, slots=True)
class TraceSignal:
    """What a decoder process found in a recording, and the tags that it was looking for."""

    nearby: NearbyTags
    result: DecodedTrace


class TraceHandler(UploadHandler[TraceSignal]):
    """Magnetometer traces. Short ones are decoded while the caller waits."""

    kind = DecodeKind.TRACE

    def __init__(self, database: Database, processes: DecoderProcesses, rules: DecodeRules) -> None:
        self._database, self._processes, self._rules = database, processes, rules

    def accepts(self, context: DecodeContext, file: SpooledFile) -> bool:
        """Uploads whose context declares a trace."""
        return context.trace is not None

    def is_job(self, file: SpooledFile) -> bool:
        """Whether the recording is longer than `DecodeRules.immediate_trace_bytes`."""
        check_not_empty(file)
        return file.size > self._rules.immediate_trace_bytes

    def start(self, upload: Upload) -> Pending[TraceSignal]:
        """Hand the recording over with the tags that the drive can have passed."""
        declared, position = upload.context.trace or DeclaredTrace(), upload.context.coarse_position
        with self._database.read() as connection:
            epoch = decimal_year(upload.observed_at)
            nearby = find_nearby_tags(connection, upload.agency_id, position, declared.reach_m, epoch)
            formats = () if nearby.texts else _book_formats(connection, upload.agency_id)
        pending = self._processes.submit(
            decode_recording,
            upload.context.file_name or "recording",
            upload.file,
            declared,
            nearby.texts,
            formats,
            self._rules.traces,
            nearby.depth_m,
            wait_s=upload.wait_s,
        )
        return PendingSignal(pending, partial(TraceSignal, nearby))

    def plot(self, signal: TraceSignal) -> bytes:
        """The trace with what was found in it."""
        return signal.result.plot

    def match(self, connection: sa.Connection, upload: Upload, signal: TraceSignal) -> Decoded:
        """Match the findings against the registered tags."""
        bar = (upload.context.trace or DeclaredTrace()).sensors
        trace = signal.nearby.match(signal.result.findings, bar)
        document = trace_result(signal.result, trace, codebook_tags=len(signal.nearby.texts))
        nearby, at = signal.nearby, upload.observed_at
        missed = missed_tags(trace, nearby.tags, nearby.complete, bar, at)
        return Decoded(document, [*_observations(trace, at), *missed])


def check_not_empty(file: SpooledFile) -> None:
    """Raise `UnreadableUpload` for a file without content."""
    if not file.size:
        raise UnreadableUpload("the file is empty", field="file", cure="send the recording again, whole")


def _book_formats(connection: sa.Connection, agency_id: str) -> tuple[TagFormat, ...]:
    """Formats of the agency's codebooks: what tags look like where none is registered nearby."""
    rows, _ = CODEBOOKS.page(connection, agency_id, limit=MAX_BOOKS_SEARCHED)
    designs = [book_of(row).design for row in rows]
    return tuple(dict.fromkeys(TagFormat(d.magnets, d.length_m, d.segment_m) for d in designs))


def _observations(trace: ReadTrace, observed_at: datetime) -> list[NewObservation]:
    """One row for each registered tag; of one that was passed twice the more confident reading counts."""
    rows: dict[str, NewObservation] = {}
    evidence = tag_evidence(trace)
    for tag in sorted(trace.tags, key=lambda tag: -tag.reading.confidence):
        if tag.match is None or tag.match.tag is None:
            continue
        reading, marker_id = tag.reading, tag.match.tag.marker_id
        detail = {
            "confidence": float(reading.confidence),
            "missing_magnets": reading.missing,
            "extra_magnets": reading.extra,
            "lateral_cm": round(float(reading.lateral_cm), 2),
            EVIDENCE: evidence[marker_id],
        }
        what = _what(reading.wrong_way, evidence[marker_id])
        rows.setdefault(marker_id, NewObservation(marker_id, 0, observed_at, what, detail))
    return list(rows.values())


def _what(wrong_way: bool, evidence: dict[str, object]) -> str:
    if evidence.get("two_places"):
        return "cloned"
    if "elsewhere_deg" in evidence:
        return "out-of-place"
    return "wrong-way" if wrong_way else "seen"


# === Packet logs of CERPMs: verified against the registry, and a lane estimated through their markers.


@dataclass(frozen=True, slots=True)
class DriveSignal:
    """A drive past CERPMs: its packets, verified against the registry, and the lane through their markers."""

    files: DriveFiles
    read: ReadPackets
    result: LaneResult


class PacketHandler(UploadHandler[DriveSignal]):
    """Packet logs. Short ones are decoded while the caller waits."""

    kind = DecodeKind.PACKETS

    def __init__(
        self, database: Database, processes: DecoderProcesses, secrets: AgencySecrets, rules: DecodeRules
    ) -> None:
        self._database, self._processes = database, processes
        self._secrets, self._rules = secrets, rules
        self._invalid_tags = InvalidTagLimit()

    def accepts(self, context: DecodeContext, file: SpooledFile) -> bool:
        """Uploads whose context declares packets."""
        return context.packets is not None

    def is_job(self, file: SpooledFile) -> bool:
        """Whether the log is longer than `DecodeRules.immediate_trace_bytes`."""
        check_not_empty(file)
        return file.size > self._rules.immediate_trace_bytes

    def start(self, upload: Upload) -> Pending[DriveSignal]:
        """Have the files of the drive read."""
        if upload.again_id is None:
            self._invalid_tags.left(_holder(upload), upload.received_at)
        declared, name = upload.context.packets or DeclaredPackets(), upload.context.file_name or "packets"
        packets, images = self._rules.packets, self._rules.images
        files = self._processes.submit(read_drive, name, upload.file, declared, packets, images, wait_s=upload.wait_s)
        return PendingSignal(files, partial(self._verify, upload))

    def _verify(self, upload: Upload, files: DriveFiles) -> DriveSignal:
        """Verify the packets against the registry as it is now, and estimate the lane."""
        declared = upload.context.packets or DeclaredPackets()
        with self._database.read() as connection:
            known = find_known(connection, upload.agency_id, self._secrets, files.numbers, upload.again_id)
        max_invalid_tags = self._invalid_tags.left(_holder(upload), upload.received_at)
        read = read_packets_of(
            files,
            known,
            declared,
            max_invalid_tags,
            received_at=upload.received_at,
            observed_at=upload.observed_at,
        )
        lane = self._processes.run(
            estimate_lane,
            lane_markers(read),
            packet_strengths(read.verification),
            _left_out(read),
            files.track,
            declared,
            _signals(read),
            _posed_camera(files, upload.context),
            wait_s=upload.wait_s,
        )
        return DriveSignal(files, read, lane)

    def plot(self, signal: DriveSignal) -> bytes:
        """The lane and the radio signals."""
        return signal.result.plot

    def match(self, connection: sa.Connection, upload: Upload, signal: DriveSignal) -> Decoded:
        """Check that the packets were verified against the newest state of the registry.

        Raises
        ------
        OutdatedMatch
            Another upload about these markers was stored since, so that these packets may be repetitions of its own.
        """
        verification = signal.read.verification
        forged = forgery_detail(verification)
        spans = markers.list_spans(connection, upload.agency_id, verification.spans, upload.again_id)
        newest = markers.newest_row(spans)
        if newest > signal.read.known.last_span:
            raise OutdatedMatch
        if upload.again_id is None:
            self._invalid_tags.add(_holder(upload), verification.invalid_tags, upload.received_at)
        return Decoded(
            packets_document(signal.files, signal.read, signal.result),
            self._observations(connection, upload, signal),
            spans_of(verification),
            {} if forged is None else {"packets.forged": forged},
        )

    def _observations(self, connection: sa.Connection, upload: Upload, signal: DriveSignal) -> list[NewObservation]:
        """What was received of registered markers, and which were passed without a packet."""
        read, at = signal.read, upload.observed_at
        rows = packet_observations(read, signal.result.lane, at)
        if not rows:
            return []
        kinds = {finding.number: finding.kind for finding in read.merged.findings}
        observed = {row.marker_id for row in rows}
        received = {number: row for number, row in read.known.rows.items() if row.id in observed}
        evidence = {
            row.id: packet_evidence(read, row, kinds.get(number), signal.files) for number, row in received.items()
        }
        directions = lane_directions(list(received.values()), signal.files.track)
        missed = missed_cerpms(connection, upload.agency_id, read, signal.files, at)
        rows = with_evidence(rows, evidence, directions)
        rows = with_stretches(rows, list(received.values()), signal.result.lane, signal.files.track)
        return [*rows, *missed]


def _holder(upload: Upload) -> str:
    return upload.author.key_id or upload.agency_id


def _signals(read: ReadPackets) -> SignalPicture | None:
    """Strengths of the accepted packets over the distance, and the path loss that was fitted to them."""
    profiles = [profile for profile in read.signal.profiles.values() if len(profile.distance_m)]
    if not profiles:
        return None
    distance_m = np.concatenate([profile.distance_m for profile in profiles])
    rssi_dbm = np.concatenate([profile.rssi_dbm for profile in profiles])
    known = np.isfinite(distance_m) & np.isfinite(rssi_dbm)
    if not known.any():
        return None
    loss = read.signal.path_loss
    fitted = (None, None) if loss is None else (loss.at_1m_dbm, loss.exponent.value)
    return SignalPicture(distance_m[known], rssi_dbm[known], *fitted)


def _left_out(read: ReadPackets) -> tuple[LeftOutMarker, ...]:
    found = []
    for number, reason in read.merged.left_out.items():
        lon_deg, lat_deg = claimed_place(number, read)
        if lon_deg is not None and lat_deg is not None:
            found.append((number, lon_deg, lat_deg, reason.partition(":")[0].partition(" (")[0]))
    return tuple(found)


def _posed_camera(files: DriveFiles, context: DecodeContext) -> PosedCamera | None:
    """Camera of the frame, and where the vehicle was and pointed when it was taken; None where either is unknown."""
    camera = context.camera_of(files.frame[1]) if files.frame is not None else None
    if camera is None:
        return None
    track = files.track
    if track is not None and context.captured_at is not None:
        at_s = context.captured_at.timestamp()
        lon_deg, lat_deg = vehicle_positions(track, [at_s])[0]
        headings = np.isfinite(track.heading_deg)
        if np.isfinite(lon_deg) and headings.any():
            turned = np.unwrap(track.heading_deg[headings], period=360.0)
            heading_deg = float(np.interp(at_s, track.time_s[headings], turned)) % 360.0
            return PosedCamera(camera, (float(lon_deg), float(lat_deg), heading_deg))
    coarse = context.coarse_position
    if coarse is not None and context.heading_deg is not None:
        return PosedCamera(camera, (coarse.lon_deg, coarse.lat_deg, context.heading_deg))
    return None
