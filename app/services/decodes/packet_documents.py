"""Decoded drives past CERPMs as clients see them."""

from __future__ import annotations

import itertools
import math
from datetime import datetime

import numpy as np
from typing_extensions import TypedDict

from app import __version__
from app.decoders.cerpm.merge import Disagreement, vehicle_positions
from app.decoders.cerpm.signal import SignalProfile
from app.decoders.cerpm.verify import Verdict, VerifiedPacket
from app.decoding.recordings import DriveFiles, ReadPackets
from app.formats.text import count_of
from app.geodesy import LocalizationGrade
from app.lanes.overlay import LaneInFrame
from app.lanes.types import Lane
from app.markers.cerpm import LaneSide
from app.radio.link import PathLoss
from app.registry.decodes import NewObservation
from app.services.decodes.frame_poses import ReceiverPositions, receiver_positions
from app.services.decodes.lane_documents import (
    DecodedLaneDocument,
    SteeringDocument,
    lane_document,
    steering_document,
)
from app.services.decodes.packet_tasks import LaneResult

DECODER_VERSION = "cerpm/3"
MAX_REFUSED = 500
MAX_PATH_SIGMA_M = 0.25
MAX_PROFILE = 200
"""Packets in the RSSI profile of one marker."""
_OBSERVED = {Disagreement.MOVED: "moved", Disagreement.TWO_PLACES: "cloned", Disagreement.OUT_OF_REACH: "out-of-reach"}


class MarkerHealthDocument(TypedDict):
    """How well a marker is received, compared with the others of the drive."""

    verdict: str
    sentence: str
    level_db: float | None
    level_db_low: float | None
    level_db_high: float | None
    delivery: float | None
    farthest_m: float | None


class RssiProfile(TypedDict):
    """Strength of a marker's packets by distance, nearest first; at most 200 of them."""

    distance_m: list[float]
    rssi_dbm: list[float]


class ReceivedMarkerDocument(TypedDict):
    """A marker whose packets were received."""

    number: int
    marker_id: str | None
    registered: bool
    authentic: bool
    side: str
    lon_deg: float | None
    lat_deg: float | None
    packets: int
    first_sequence: int | None
    last_sequence: int | None
    best_rssi_dbm: float | None
    off_registered_m: float | None
    residual_m: float | None
    left_out: str | None
    notes: list[str]
    health: MarkerHealthDocument | None
    rssi_profile: RssiProfile | None


class PacketSummary(TypedDict):
    """Packets, markers and the path in numbers, and in one sentence."""

    text: str
    packets: int
    accepted: int
    repeated: int
    in_clear: int
    refused: int
    markers: int
    left_out: list[int]
    path_m: float


class LogFileDocument(TypedDict):
    """About reading one file."""

    format: str
    entries: int
    left_out: int


class RefusedPacket(TypedDict):
    """A packet that was not accepted, and why."""

    entry: int
    number: int | None
    verdict: str
    reason: str


class LeftOutEntryDocument(TypedDict):
    """An entry of a file that could not be read."""

    file: str
    entry: int
    what: str
    reason: str


class PacketReportDocument(TypedDict):
    """About reading and verifying the log."""

    files: dict[str, LogFileDocument]
    packets: int
    verdicts: dict[str, int]
    refused: list[RefusedPacket]
    left_out: list[LeftOutEntryDocument]
    warnings: list[str]
    driven_m: float | None
    load_ms: float
    verify_ms: float
    decode_ms: float


class PacketsResult(TypedDict, total=False):
    """The result of decoding a packet log."""

    decoder: str
    summary: PacketSummary
    report: PacketReportDocument
    markers: list[ReceivedMarkerDocument]
    lane: DecodedLaneDocument
    steering: SteeringDocument | None
    overlay: LaneInFrame | None
    path_loss: PathLoss | None
    receiver: ReceiverPositions | None


def packets_document(files: DriveFiles, read: ReadPackets, result: LaneResult) -> PacketsResult:
    """The result of decoding a drive, as it is stored."""
    lane = result.lane
    markers = _markers(read, lane)
    unsure = path_warnings(lane)
    grade = LocalizationGrade.UNFIT if unsure or lane.track_apart else read.grade
    document = lane_document(lane, read.merged.number, grade=str(grade))
    document["localization_warnings"] += unsure
    document["localization_warnings"] += read.localization_warnings
    return {
        "decoder": f"waymark {__version__} {DECODER_VERSION}",
        "summary": _summary(files, read, markers, lane),
        "report": _report(files, read, result),
        "markers": markers,
        "lane": document,
        "steering": steering_document(result.steering),
        "overlay": result.overlay.visible(files.frame[0]) if result.overlay and files.frame else None,
        "path_loss": read.signal.path_loss,
        "receiver": receiver_positions(files.track),
    }


def path_warnings(lane: Lane) -> list[str]:
    """Reasons why a path cannot localize a vehicle, however good its markers are."""
    if lane.refusal is not None:
        return [lane.refusal]
    if not np.isfinite(lane.sigma_m).all():
        return ["the method gives no standard deviation of the path"]
    if float(np.median(lane.sigma_m)) > MAX_PATH_SIGMA_M:
        return [f"the standard deviation of the path is above {MAX_PATH_SIGMA_M:g} m"]
    if lane.track_agreement is not None and lane.track_agreement.disagrees:
        return [lane.track_agreement.reason]
    return []


def packet_observations(read: ReadPackets, lane: Lane, observed_at: datetime) -> list[NewObservation]:
    """One row for each registered marker whose packets were authentic."""
    off_line = {entry.number for entry in lane.left_out} - lane.of_other_lanes
    kinds = {finding.number: _OBSERVED.get(finding.kind) for finding in read.merged.findings}
    far = [number for number, kind in kinds.items() if kind == _OBSERVED[Disagreement.OUT_OF_REACH]]
    if 2 * len(far) > len(read.signal.profiles):
        return []  # the track is of another drive, so it is no evidence against a marker
    rows = []
    for number, row in read.known.rows.items():
        profile = read.signal.profiles.get(number)
        if profile is None:
            continue
        what = kinds.get(number) or ("off-line" if number in off_line else "seen")
        detail = {"packets": profile.received, "expected": profile.expected, "health": str(profile.health)}
        rows.append(NewObservation(row.id, 0, observed_at, what, detail))
    return rows


def _summary(files: DriveFiles, read: ReadPackets, markers: list[ReceivedMarkerDocument], lane: Lane) -> PacketSummary:
    counts = read.verification.counts()
    accepted, repeated, clear = (
        counts[verdict] for verdict in (Verdict.AUTHENTIC, Verdict.DUPLICATE, Verdict.UNAUTHENTICATED)
    )
    refused = len(files.packets) - accepted - repeated - clear
    others = lane.of_other_lanes
    named = [marker["number"] for marker in markers if marker["left_out"] and marker["number"] not in others]
    length_m = float(lane.station_m[-1]) if len(lane.station_m) else 0.0
    text = f"{count_of(len(files.packets), 'packet')}, {accepted} authentic"
    text += f", {repeated} repeated" if repeated else ""
    text += f", {clear} in clear" if clear else ""
    text += f", {refused} refused" if refused else ""
    text += f"; {count_of(len(markers), 'marker')}"
    text += f", {len(others)} of other lanes" if others else ""
    text += f", left out: {', '.join(str(number) for number in named)}" if named else ""
    changes = sum(before.lane != after.lane for before, after in itertools.pairwise(lane.stretches))
    text += f"; the vehicle changed lane {'once' if changes == 1 else f'{changes} times'}" if changes else ""
    if lane.refusal is None and np.isfinite(lane.sigma_m).all():
        text += f"; path of {length_m:.0f} m, ± {100 * float(np.median(lane.sigma_m)):.1f} cm"
    else:
        text += f"; path of {length_m:.0f} m" if lane.refusal is None else f"; no path: {lane.refusal}"
    return {
        "text": text,
        "packets": len(files.packets),
        "accepted": accepted,
        "repeated": repeated,
        "in_clear": clear,
        "refused": refused,
        "markers": len(markers),
        "left_out": named,
        "path_m": round(length_m, 3),
    }


def _report(files: DriveFiles, read: ReadPackets, result: LaneResult) -> PacketReportDocument:
    verdicts = {str(verdict): count for verdict, count in read.verification.counts().items()}
    refused: list[RefusedPacket] = [
        {"entry": p.entry, "number": p.number, "verdict": str(p.verdict), "reason": p.reason}
        for p in read.verification.packets
        if p.verdict not in (Verdict.AUTHENTIC, Verdict.DUPLICATE)
    ]
    left_out: list[LeftOutEntryDocument] = [
        {"file": name, "entry": entry.entry, "what": f"{name}, entry {entry.entry}", "reason": entry.reason}
        for name, report in files.reports.items()
        for entry in report.left_out
    ]
    warnings = [text for report in files.reports.values() for text in report.warnings]
    warnings += [*read.warnings, *read.verification.warnings, *read.merged.warnings]
    if files.track is not None and _is_of_another_time(files):
        warnings.append(
            "no packet was received while the vehicle's track lasts: how far away markers were is not known; the track "
            "is of another drive, or the clocks do not fit"
        )
    if files.frame is not None and result.overlay is None and not result.lane.refusal:
        warnings.append(
            "no overlay: it takes camera in the context, and where the vehicle was at captured_at (poses with "
            "headings), or coarse_position and heading_deg"
        )
    return {
        "files": {
            name: {"format": str(report.format), "entries": report.entries, "left_out": report.left_out_count}
            for name, report in files.reports.items()
        },
        "packets": len(files.packets),
        "verdicts": verdicts,
        "refused": refused[:MAX_REFUSED],
        "left_out": left_out,
        "warnings": list(dict.fromkeys(warnings)),
        "driven_m": files.driven_m,
        "load_ms": round(files.load_ms, 1),
        "verify_ms": round(read.verify_ms, 1),
        "decode_ms": round(result.decode_ms, 1),
    }


def _is_of_another_time(files: DriveFiles) -> bool:
    times_s = np.array([packet.received_at_s for packet in files.packets], float)
    times_s = times_s[np.isfinite(times_s)]
    return (
        len(times_s) > 0 and files.track is not None and not np.isfinite(vehicle_positions(files.track, times_s)).any()
    )


def _markers(read: ReadPackets, lane: Lane) -> list[ReceivedMarkerDocument]:
    merged = read.merged
    rows = {int(number): k for k, number in enumerate(merged.number)}
    off_line = {entry.number: entry for entry in lane.left_out}
    claims: dict[int, list[VerifiedPacket]] = {}
    for packet in read.verification.packets:
        if packet.number is not None and (packet.accepted or packet.number in rows or packet.number in merged.left_out):
            claims.setdefault(packet.number, []).append(packet)
    documents: list[ReceivedMarkerDocument] = []
    for number in sorted({*rows, *merged.left_out}):
        k, row, profile = rows.get(number), read.known.rows.get(number), read.signal.profiles.get(number)
        accepted = [packet for packet in claims.get(number, ()) if packet.accepted]
        sequences = [packet.message.sequence for packet in accepted if packet.message is not None]
        strengths = [p.packet.rssi_dbm for p in claims.get(number, ()) if math.isfinite(p.packet.rssi_dbm)]
        out = merged.left_out.get(number)
        if out is None and number in off_line:
            entry = off_line[number]
            out = entry.reason.text + (f", {entry.off_m:.2f} m" if math.isfinite(entry.off_m) else "")
        residual = float(lane.residual_m[k]) if k is not None else math.nan
        side = LaneSide(int(lane.side[k]) or int(merged.side[k])) if k is not None else LaneSide.UNKNOWN
        lon_deg, lat_deg = _place(number, read, k)
        documents.append(
            {
                "number": number,
                "marker_id": row.id if row is not None else None,
                "registered": row is not None,
                "authentic": bool(accepted),
                "side": side.name.lower(),
                "lon_deg": lon_deg,
                "lat_deg": lat_deg,
                "packets": len(accepted) or len(claims.get(number, ())),
                "first_sequence": min(sequences, default=None),
                "last_sequence": max(sequences, default=None),
                "best_rssi_dbm": max(strengths, default=None),
                "off_registered_m": _off_m(number, read),
                "residual_m": round(residual, 4) if math.isfinite(residual) else None,
                "left_out": out,
                "notes": [f.reason for f in merged.findings if f.number == number and f.reason != out],
                "health": _health(profile) if profile is not None else None,
                "rssi_profile": _rssi_profile(profile) if profile is not None else None,
            }
        )
    return documents


def _place(number: int, read: ReadPackets, k: int | None) -> tuple[float | None, float | None]:
    """Where a marker is taken to be; of one that was left out, where it claims to be."""
    if k is not None:
        return round(float(read.merged.lon_deg[k]), 9), round(float(read.merged.lat_deg[k]), 9)
    return claimed_place(number, read)


def claimed_place(number: int, read: ReadPackets) -> tuple[float | None, float | None]:
    """Position in the newest accepted packet of a marker, else in its first one in clear. [deg]"""
    own = [packet for packet in read.verification.packets if packet.number == number]
    accepted = [packet.message for packet in own if packet.accepted and packet.message is not None]
    if accepted:
        newest = max(reversed(accepted), key=lambda message: message.sequence)
        return newest.lon_deg, newest.lat_deg
    claim = next((packet.packet.claim for packet in own if packet.packet.claim is not None), None)
    return (None, None) if claim is None else (claim.lon_deg, claim.lat_deg)


def _off_m(number: int, read: ReadPackets) -> float | None:
    distance = [
        f.distance_m
        for f in read.merged.findings
        if f.number == number and f.kind in (Disagreement.MOVED, Disagreement.DATUM_SHIFT)
    ]
    return round(distance[0], 3) if distance and math.isfinite(distance[0]) else None


def _health(profile: SignalProfile) -> MarkerHealthDocument:
    level, delivery = profile.level_db, profile.delivery
    return {
        "verdict": str(profile.health),
        "sentence": profile.reason,
        "level_db": round(level.value, 2) if level is not None else None,
        "level_db_low": round(level.low, 2) if level is not None else None,
        "level_db_high": round(level.high, 2) if level is not None else None,
        "delivery": round(delivery.value, 4) if delivery is not None else None,
        "farthest_m": round(profile.farthest_m, 1) if math.isfinite(profile.farthest_m) else None,
    }


def _rssi_profile(profile: SignalProfile) -> RssiProfile | None:
    """Strength of a marker's packets by distance, nearest first; of many packets evenly chosen ones."""
    measured = np.flatnonzero(np.isfinite(profile.distance_m) & np.isfinite(profile.rssi_dbm))
    if not len(measured):
        return None
    rows = measured[np.argsort(profile.distance_m[measured], kind="stable")]
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), MAX_PROFILE)).round().astype(int)]
    return {
        "distance_m": profile.distance_m[rows].round(2).tolist(),
        "rssi_dbm": profile.rssi_dbm[rows].round(2).tolist(),
    }
