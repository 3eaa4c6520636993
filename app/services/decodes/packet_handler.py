"""Packet logs of CERPMs: verified against the registry, and a lane estimated through their markers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sqlalchemy as sa

from app.decoders.cerpm.match import list_numbers
from app.decoders.cerpm.vehicle_positions import vehicle_positions
from app.formats.spooled_file import SpooledFile
from app.registry import cerpms
from app.registry.database import Database
from app.registry.decodes import NewObservation
from app.sensors.camera import Camera
from app.services.access.agency_secrets import AgencySecrets
from app.services.decoder_processes import DecoderProcesses, Pending
from app.services.decodes.context import DecodeContext
from app.services.decodes.invalid_tags import InvalidTagLimit, forgery_detail
from app.services.decodes.kinds import DecodeKind
from app.services.decodes.packet_documents import claimed_place, packet_observations, packets_document
from app.services.decodes.packet_matching import ReadPackets, find_known, lane_markers, read_packets_of, spans_of
from app.services.decodes.packet_task import DriveFiles, DriveTask, LaneResult, LaneTask, PacketTerms, packet_terms
from app.services.decodes.rules import DecodeRules
from app.services.decodes.trace_handler import check_not_empty
from app.services.decodes.upload_path import Decoded, OutdatedMatch, Upload, UploadHandler
from app.services.health.packets import lane_directions, missed_cerpms, packet_evidence, with_evidence

Pose = tuple[float, float, float]
"""Longitude, latitude and heading of a vehicle. [deg]"""


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

    def start(self, upload: Upload) -> StartedDrive:
        """Have the files of the drive read."""
        if upload.again_id is None:
            self._invalid_tags.left(_holder(upload), upload.received_at)
        declared = upload.context.packets or {}
        name = str(declared.get("file_name") or "packets")
        task = DriveTask(name, upload.file, declared, self._rules.packets, self._rules.images)
        files = self._processes.submit(task, wait_s=upload.wait_s)
        return StartedDrive(upload, files, self._database, self._processes, self._secrets, self._invalid_tags)

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
        spans = cerpms.list_spans(connection, upload.agency_id, verification.spans, upload.again_id)
        newest = cerpms.newest_row(spans)
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
        return [*with_evidence(rows, evidence, directions), *missed]


@dataclass(frozen=True, slots=True)
class StartedDrive:
    """The files of a drive in a decoder process."""

    upload: Upload
    files: Pending[DriveFiles]
    database: Database
    processes: DecoderProcesses
    secrets: AgencySecrets
    invalid_tags: InvalidTagLimit

    def result(self) -> DriveSignal:
        """Verify the packets against the registry as it is now, and estimate the lane."""
        upload, files = self.upload, self.files.result()
        terms = packet_terms(upload.context.packets or {})
        camera, pose = _view(files, upload.context)
        with self.database.read() as connection:
            known = find_known(connection, upload.agency_id, self.secrets, list_numbers(files.packets), upload.again_id)
        max_invalid_tags = self.invalid_tags.left(_holder(upload), upload.received_at)
        read = read_packets_of(
            files,
            known,
            terms,
            max_invalid_tags,
            received_at=upload.received_at,
            observed_at=upload.observed_at,
        )
        task = _lane_task(files, read, terms, camera, pose)
        return DriveSignal(files, read, self.processes.submit(task, wait_s=upload.wait_s).result())

    def cancel(self) -> None:
        """Stop the process."""
        self.files.cancel()


def _holder(upload: Upload) -> str:
    return upload.author.key_id or upload.agency_id


def _lane_task(
    files: DriveFiles, read: ReadPackets, terms: PacketTerms, camera: Camera | None, pose: Pose | None
) -> LaneTask:
    profiles = [profile for profile in read.signal.profiles.values() if len(profile.distance_m)]
    none = np.empty(0)
    distance_m = np.concatenate([profile.distance_m for profile in profiles] or [none])
    rssi_dbm = np.concatenate([profile.rssi_dbm for profile in profiles] or [none])
    measured = np.isfinite(distance_m) & np.isfinite(rssi_dbm)
    loss = read.signal.path_loss
    return LaneTask(
        lane_markers(read.merged),
        _left_out(read),
        files.track,
        terms,
        (distance_m[measured], rssi_dbm[measured]),
        None if loss is None else (loss.at_1m_dbm, loss.exponent.value),
        camera,
        pose,
    )


def _left_out(read: ReadPackets) -> tuple[tuple[int, float, float, str], ...]:
    found = []
    for number, reason in read.merged.left_out.items():
        lon_deg, lat_deg = claimed_place(number, read)
        if lon_deg is not None and lat_deg is not None:
            found.append((number, lon_deg, lat_deg, reason.partition(":")[0].partition(" (")[0]))
    return tuple(found)


def _view(files: DriveFiles, context: DecodeContext) -> tuple[Camera | None, Pose | None]:
    """Camera of the frame, and where the vehicle was and pointed when it was taken."""
    if files.frame is None or context.camera is None:
        return None, None
    camera = context.camera.camera_for(files.frame[1])
    track = files.track
    if track is not None and context.captured_at is not None:
        at_s = context.captured_at.timestamp()
        lon_deg, lat_deg = vehicle_positions(track, [at_s])[0]
        headings = np.isfinite(track.heading_deg)
        if np.isfinite(lon_deg) and headings.any():
            turned = np.unwrap(track.heading_deg[headings], period=360.0)
            heading_deg = float(np.interp(at_s, track.time_s[headings], turned)) % 360.0
            return camera, (float(lon_deg), float(lat_deg), heading_deg)
    coarse = context.coarse_position
    if coarse is not None and context.heading_deg is not None:
        return camera, (coarse.lon_deg, coarse.lat_deg, context.heading_deg)
    return camera, None
