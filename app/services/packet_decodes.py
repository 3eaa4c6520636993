"""Packet logs of CERPMs -> verified markers, a lane, and observations: at once, or as a job."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
import sqlalchemy as sa

from app.decoders.cerpm.known import numbers_in
from app.decoders.cerpm.track_places import vehicle_places
from app.errors import Unavailable
from app.registry import cerpms
from app.registry import decodes as store
from app.registry.database import Database
from app.sensors.camera import Camera
from app.services.agency_secrets import AgencySecrets
from app.services.decode_context import DecodeContext
from app.services.decode_rules import DecodeRules
from app.services.packet_documents import claimed_place, packet_observations, packets_document
from app.services.packet_reading import (
    ReadPackets,
    find_known,
    lane_markers,
    read_packets_of,
    spans_of,
)
from app.services.packets import (
    DriveFiles,
    DriveTask,
    LaneResult,
    LaneTask,
    PacketDecoder,
    PacketTerms,
    PendingDrive,
    packet_terms,
)

PACKETS = "packets"
TRIES = 12
"""How often packets are verified anew because another upload was stored in between."""


@dataclass(frozen=True, slots=True)
class DecodedDrive:
    """Everything that a drive past CERPMs gave, ready to be stored."""

    document: dict[str, Any]
    plot: bytes
    read: ReadPackets
    result: LaneResult


def start_packets(
    decoder: PacketDecoder, data: bytes, context: DecodeContext, rules: DecodeRules, *, wait_s: float = 0.0
) -> PendingDrive:
    """Hand the files of a drive to a decoder process.

    Raises
    ------
    Unavailable
        The decoder processes are busy.
    """
    declared = context.packets or {}
    name = str(declared.get("file_name") or "packets")
    return decoder.start_drive(DriveTask(name, data, declared, rules.packets, rules.images), wait_s=wait_s)


def decode_packets(
    database: Database, agency_id: str, secrets: AgencySecrets, decoder: PacketDecoder, files: DriveFiles,
    context: DecodeContext, received_at: datetime, *, wait_s: float = 0.0,
) -> DecodedDrive:  # fmt: skip
    """Verify packets against the registry and lay a lane through their markers.

    Raises
    ------
    InvalidParameter
        The camera is not the frame's.
    UnreadableUpload, Unavailable
        The decoder process failed, or none could be had.
    """
    terms = packet_terms(context.packets or {})
    camera, pose = _view(files, context)
    with database.read() as connection:
        known = find_known(connection, agency_id, secrets, numbers_in(files.packets))
    read = read_packets_of(files, known, terms, received_at.timestamp())
    result = decoder.start_lane(_lane_task(files, read, terms, camera, pose), wait_s=wait_s).result()
    return DecodedDrive(packets_document(files, read, result), result.plot, read, result)


def is_still_newest(connection: sa.Connection, agency_id: str, drive: DecodedDrive) -> bool:
    """Whether nothing was stored about the markers of a drive since it was verified; else it is verified anew."""
    known = drive.read.known
    spans = cerpms.list_spans(connection, agency_id, drive.read.verification.spans)
    return max((row["row"] for rows in spans.values() for row in rows), default=0) <= known.last_span


def keep_heard(
    connection: sa.Connection, agency_id: str, decode_id: str, drive: DecodedDrive, seen_at: datetime
) -> None:
    """Keep what was heard of which marker, in the transaction that found it still newest."""
    cerpms.add_spans(connection, agency_id, decode_id, spans_of(drive.read.verification))
    store.add_observations(
        connection, agency_id, packet_observations(decode_id, drive.read, drive.result.lane, seen_at)
    )


def too_many_at_once() -> Unavailable:
    """Other uploads about the same markers came in between, again and again."""
    return Unavailable("other drives past the same markers are being stored", cure="try again in a few seconds")


def _lane_task(
    files: DriveFiles, read: ReadPackets, terms: PacketTerms, camera: Camera | None,
    pose: tuple[float, float, float] | None,
) -> LaneTask:  # fmt: skip
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


def _view(files: DriveFiles, context: DecodeContext) -> tuple[Camera | None, tuple[float, float, float] | None]:
    """Camera of the frame, and where the vehicle was and pointed when it was taken."""
    if files.frame is None or context.camera is None:
        return None, None
    camera = context.camera.camera_for(files.frame[1])
    track = files.track
    if track is not None and context.captured_at is not None:
        at_s = context.captured_at.timestamp()
        lon_deg, lat_deg = vehicle_places(track, [at_s])[0]
        headings = np.isfinite(track.heading_deg)
        if np.isfinite(lon_deg) and headings.any():
            turned = np.unwrap(track.heading_deg[headings], period=360.0)
            heading_deg = float(np.interp(at_s, track.time_s[headings], turned)) % 360.0
            return camera, (float(lon_deg), float(lat_deg), heading_deg)
    coarse = context.coarse_position
    if coarse is not None and context.heading_deg is not None:
        return camera, (coarse.lon_deg, coarse.lat_deg, context.heading_deg)
    return camera, None
