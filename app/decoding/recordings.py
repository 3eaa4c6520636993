"""Recordings of magnetometers and packet logs of CERPMs, with what the registry knows of the markers in them.

A server calls these functions for uploads, and the proof of a plan for simulated ones, with the same inputs: the files
of an upload, its declaration, and rows of registered markers.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from typing import cast

import numpy as np

from app.decoders.cerpm.merge import (
    KnownCerpms,
    MergedMarkers,
    MergeRules,
    RegisteredMarker,
    grade_markers,
    list_numbers,
    match_known_markers,
)
from app.decoders.cerpm.signal import SignalReport, SignalRules, profile_signals
from app.decoders.cerpm.verify import FreshnessRules, SequenceSpan, Verification
from app.decoders.magnet.identify import MAX_TAGS, ReadTrace, RegisteredTag, TagCandidates, TagFormat, match_tags
from app.decoders.magnet.readings import CheckedRecording, Finding
from app.decoding.declarations import DeclaredPackets, DeclaredTrace
from app.errors import UnreadableUpload, naming
from app.formats.format import SpooledFile
from app.formats.images import ImageHeader, ImageLimits, inspect_image
from app.formats.kinds import detect_drive_file
from app.formats.logs import LogReport, describe_rollover
from app.formats.packets.read import read_packets
from app.formats.packets.rows import PacketLimits
from app.formats.poses import read_poses
from app.formats.traces.declaration import TraceLimits
from app.formats.traces.parts import open_parts
from app.geodesy import LocalizationGrade, decimal_year, move_to_epoch
from app.lanes.types import NO_LINE, Lane, LaneMarkers, LaneRules, PacketStrengths
from app.markers.cerpm import MAX_INVALID_TAGS_PER_LOG, LaneSide, SpeedLimit, SpeedUnit, derive_marker_key
from app.markers.magnet import HALF_HEIGHT_M, InformationTag, parse_tag
from app.markers.magnet_design import INFORMATION_TAG, MagnetSpec, installation_of, meaning_of
from app.markers.reading import MarkerRow, horizontal_rmse_m, marker_at, row_warnings
from app.radio.settings import RadioSettings
from app.sensors.magnetometer_bar import MAX_CLEARANCE_M, MIN_CLEARANCE_M, MagnetometerBar, MagnetTrace
from app.sensors.pose_track import PoseTrack, ReceivedPacket

# === Recordings of magnetometers: the information tags that are registered nearby, and what is found.


MAX_MAGNET_ROWS = 4 * MAX_TAGS
"""Magnet markers among which tags are looked for."""
_SAME_DEPTH_M = 0.03  # [m] of depths that count as one; source: as the decoder's error of a declared clearance


@dataclass(frozen=True, slots=True)
class NearbyTags:
    """The agency's information tags that the drive can have passed."""

    tags: tuple[RegisteredTag, ...] = ()
    complete: bool = True
    # [m] of all magnets nearby below the road, lines too; on the road where there are none, None where they differ
    depth_m: float | None = -HALF_HEIGHT_M

    @classmethod
    def of(cls, rows: Sequence[MarkerRow], epoch: float) -> NearbyTags:
        """Those among the magnet markers nearby, at most `MAX_MAGNET_ROWS`, where they are at an epoch."""
        rows = [row for row in rows if row.status != "retired"]
        tags = [row for row in rows if row.scheme == INFORMATION_TAG]
        complete = len(tags) <= MAX_TAGS and len(rows) < MAX_MAGNET_ROWS
        depths_m = [installation_of(row.spec).depth_m for row in rows] or [-HALF_HEIGHT_M]
        alike = max(depths_m) - min(depths_m) <= _SAME_DEPTH_M
        depth_m = float(np.median(depths_m)) if alike else None
        return cls(tuple(registered_tag(row, epoch) for row in tags[:MAX_TAGS]), complete, depth_m)

    @property
    def texts(self) -> tuple[str, ...]:
        """Their codes, without repetitions; none if there are too many to look for."""
        return tuple(dict.fromkeys(tag.tag.text for tag in self.tags)) if self.complete else ()

    def match(self, findings: Sequence[Finding], bar: MagnetometerBar) -> ReadTrace:
        """Match the tags that were found in a recording."""
        return match_tags(findings, self.tags, bar)


def registered_tag(stored: MarkerRow, epoch: float) -> RegisteredTag:
    """The information tag of a magnet marker's row, where it is at an epoch [decimal year]."""
    row = marker_at(stored, epoch)
    tag, spec = parse_tag(row.digits), cast(MagnetSpec, row.spec)
    assert isinstance(tag, InformationTag)
    assert row.heading_deg is not None
    lane_lon_deg, lane_lat_deg = spec["lane"]["points_deg"][0][:2]
    lane_lon_deg += row.lon_deg - stored.lon_deg
    lane_lat_deg += row.lat_deg - stored.lat_deg
    return RegisteredTag(
        row.id, row.status, tag, row.lon_deg, row.lat_deg, row.height_m, row.heading_deg,
        lane_lon_deg, lane_lat_deg, horizontal_rmse_m(row), row.localization_grade,
        tuple(row_warnings(row, "tag")), meaning_of(spec), installation_of(spec).depth_m,
    )  # fmt: skip


def bar_above(bar: MagnetometerBar, depth_m: float | None) -> MagnetometerBar:
    """A bar whose declared clearance is that above the magnets, as decoders take it; unknown where depths differ."""
    if bar.clearance_m is None or depth_m is None:
        return replace(bar, clearance_m=None)
    return replace(bar, clearance_m=min(max(bar.clearance_m + depth_m, MIN_CLEARANCE_M), MAX_CLEARANCE_M))


def find_magnets(
    trace: MagnetTrace,
    declared: DeclaredTrace,
    tags: tuple[str, ...],
    formats: tuple[TagFormat, ...],
    depth_m: float | None = -HALF_HEIGHT_M,
) -> tuple[CheckedRecording, str]:
    """Findings in a recording, in the order of their completion, and the version of the decoder.

    Parameters
    ----------
    tags : tuple of str
        Texts of the information tags that are registered nearby.
    formats : tuple of TagFormat
        Used where there are none, unless the upload declares some.
    depth_m : float, optional
        Of the magnets that are registered nearby, below the road; None where they differ. [m]
    """
    if declared.method == "metro":
        from app.decoders.magnet import metro  # not loaded before: scipy.signal takes most of a second

        return CheckedRecording(metro.decode_trace_metro(trace, declared.sensors), (), trace), metro.VERSION
    from app.decoders.magnet.decoder import VERSION
    from app.decoders.magnet.recording_check import decode_checked

    known = [tag for text in tags if isinstance(tag := parse_tag(text), InformationTag)]
    candidates = TagCandidates(tags=known) if known else TagCandidates(formats=declared.tag_formats or formats)
    return decode_checked(trace, bar_above(declared.sensors, depth_m), candidates=candidates), VERSION


# === Files of a drive past CERPMs.


@dataclass(frozen=True, slots=True)
class DriveFiles:
    """What the files of a drive hold."""

    packets: list[ReceivedPacket]  # of all packet logs; entries go on counting from file to file
    track: PoseTrack | None
    reports: dict[str, LogReport]  # about reading each file
    frame: tuple[str, ImageHeader] | None  # name and header of the camera frame
    load_ms: float
    driven_m: float | None = None  # along the track

    @property
    def numbers(self) -> list[int]:
        """Marker numbers in the packets, each once, sorted."""
        return list_numbers(self.packets)


def read_drive_files(
    name: str,
    file: SpooledFile,
    declared: DeclaredPackets = DeclaredPackets(),
    limits: PacketLimits = PacketLimits(),
    images: ImageLimits = ImageLimits(),
) -> DriveFiles:
    """Read the files of a drive: a packet log, or a ZIP of packet logs, poses and a camera frame."""
    began = time.perf_counter()
    packets: list[ReceivedPacket] = []
    track: PoseTrack | None = None
    frame: tuple[str, ImageHeader] | None = None
    reports: dict[str, LogReport] = {}
    with file.open() as stream:
        for part in open_parts({name: stream}, TraceLimits(file_bytes=limits.file_bytes)):
            if part.name.startswith("."):
                continue  # what a desktop leaves in a ZIP
            data = part.content()
            kind = (declared.files or {}).get(part.name) or detect_drive_file(part.name, data)
            if kind == "frame":
                if frame is not None:
                    raise _twice("camera frame", part.name)
                frame = (part.name, inspect_image(data, images))
            elif kind == "poses":
                if track is not None:
                    raise _twice("track", part.name)
                with naming("packets"):
                    track, reports[part.name] = read_poses(part.name, data, declared.poses)
            else:
                with naming("packets"):
                    log = read_packets(part.name, data, declared, limits)
                first = sum(report.entries for read_name, report in reports.items() if read_name != part.name)
                packets += [replace(packet, entry=packet.entry + first) for packet in log.packets]
                reports[part.name] = log.report
    if not packets:
        raise UnreadableUpload(
            "there is no packet log in the upload",
            field="file",
            limit="one packet log at least",
            cure="declare which file it is in packets.files if its content does not show it",
        )
    driven_m = None if track is None else round(track.driven_m(), 2)
    return DriveFiles(packets, track, reports, frame, 1e3 * (time.perf_counter() - began), driven_m)


def _twice(what: str, name: str) -> UnreadableUpload:
    return UnreadableUpload(
        f"{name} is a second {what}",
        field="file",
        limit=f"one {what} in an upload",
        cure="send each drive by itself, or name the kinds of its files in packets.files",
    )


# === Packets of a drive -> which were sent by their markers, which markers these are, and where they are.


@dataclass(frozen=True)
class KnownMarkers:
    """What the registry knows of the markers that packets claim to be from."""

    rows: dict[int, MarkerRow]  # by number
    agency_key: bytes | None
    earlier_spans: dict[int, list[SequenceSpan]]
    last_span: int  # newest row among these spans: who writes more must see the same

    @cached_property
    def cerpms(self) -> KnownCerpms:
        """As the decoder takes them."""
        radios = {number: radio_of(row) for number, row in self.rows.items()}
        return KnownCerpms(
            {number: _registered(row) for number, row in self.rows.items()},
            self.earlier_spans,
            {number: radio.interval_s * (1 - radio.jitter_share) for number, radio in radios.items()},
            {number: tuple(row_warnings(row, "marker")) for number, row in self.rows.items()},
            frozenset(number for number, row in self.rows.items() if row.status == "retired"),
        )


@dataclass(frozen=True, slots=True)
class ReadPackets:
    """A drive's packets with what the registry made of them."""

    verification: Verification
    merged: MergedMarkers
    signal: SignalReport
    known: KnownMarkers
    grade: LocalizationGrade
    localization_warnings: tuple[str, ...]
    verify_ms: float
    warnings: tuple[str, ...] = ()  # about the track


def read_packets_of(
    files: DriveFiles,
    known: KnownMarkers,
    declared: DeclaredPackets,
    max_invalid_tags: int = MAX_INVALID_TAGS_PER_LOG,
    *,
    received_at: datetime,
    observed_at: datetime,
) -> ReadPackets:
    """Verify packets and merge them to one place a marker, where it is when the drive was recorded."""
    began = time.perf_counter()

    def key_of(number: int) -> bytes | None:
        if known.agency_key is None or number not in known.rows:
            return None
        return derive_marker_key(known.agency_key, number)

    freshness = FreshnessRules.of(declared.freshness).model_copy(update={"uploaded_at_s": received_at.timestamp()})
    rules = MergeRules(accept_clear=declared.accept_clear)
    verification, merged = match_known_markers(
        files.packets, key_of, known.cerpms, files.track, freshness, rules, max_invalid_tags=max_invalid_tags
    )
    rollover = None
    if files.track is not None:
        rollover = describe_rollover(float(files.track.time_s[0]), observed_at.timestamp())
    merged = _at_epoch(merged, known.rows, decimal_year(_driven_at(files) or observed_at))
    places = {
        int(number): (float(lon), float(lat))
        for number, lon, lat in zip(merged.number, merged.lon_deg, merged.lat_deg, strict=True)
    }
    signal = profile_signals(verification.packets, places, files.track, SignalRules.of(declared.receiver))
    grade, localization_warnings = grade_markers(merged, verification, known.cerpms)
    verify_ms = 1e3 * (time.perf_counter() - began)
    warnings = (rollover,) if rollover else ()
    return ReadPackets(verification, merged, signal, known, grade, localization_warnings, verify_ms, warnings)


def lane_markers(read: ReadPackets) -> LaneMarkers:
    """Merged markers as the lane's fit takes them, with the lines of the road that are registered for them."""
    merged, numbers = read.merged, list[int]()
    names: dict[tuple[str | None, str], int] = {}
    for number in read.merged.number.tolist():
        name = None if (row := read.known.rows.get(number)) is None else line_of(row)
        numbers.append(NO_LINE if name is None else names.setdefault(name, len(names)))
    return LaneMarkers(
        merged.number, merged.lon_deg, merged.lat_deg, merged.side, merged.sigma_m, merged.speed_limit_kmh,
        np.array(numbers, np.int64),
    )  # fmt: skip


def packet_strengths(verification: Verification) -> PacketStrengths:
    """How strongly authentic packets were received, for the lane's fit."""
    heard = [
        (packet.number, packet.packet.received_at_s, packet.packet.rssi_dbm)
        for packet in verification.packets
        if packet.accepted and packet.number is not None and math.isfinite(packet.packet.received_at_s)
    ]
    number, time_s, rssi_dbm = zip(*heard, strict=True) if heard else ((), (), ())
    return PacketStrengths(np.array(number, np.int64), np.array(time_s, float), np.array(rssi_dbm, float))


def estimate_path(
    markers: LaneMarkers, strengths: PacketStrengths, track: PoseTrack | None, declared: DeclaredPackets
) -> Lane:
    """Estimate the path of the driven lane through verified markers."""
    from app.lanes.estimate import fit_lane

    rules = LaneRules.of(declared.lane)
    return fit_lane(markers, track, method=declared.method, rules=rules, strengths=strengths)


def _driven_at(files: DriveFiles) -> datetime | None:
    """Time of the drive by its packets; None if they have none."""
    times_s = np.array([packet.received_at_s for packet in files.packets])
    known = times_s[np.isfinite(times_s)]
    return datetime.fromtimestamp(float(np.median(known)), UTC) if len(known) else None


def _at_epoch(merged: MergedMarkers, rows: dict[int, MarkerRow], epoch: float) -> MergedMarkers:
    """Registered positions moved to an epoch; before, they are compared with those in messages, of their own epoch."""
    epochs = [row.epoch if (row := rows.get(number)) is not None else None for number in merged.number.tolist()]
    known = np.array([stored is not None for stored in epochs], dtype=bool) & merged.registered
    moved = move_to_epoch(merged.lon_deg, merged.lat_deg, [epoch if e is None else e for e in epochs], epoch)
    return replace(
        merged,
        lon_deg=np.where(known, moved.lon_deg, merged.lon_deg),
        lat_deg=np.where(known, moved.lat_deg, merged.lat_deg),
        sigma_m=np.where(known, np.hypot(merged.sigma_m, moved.accuracy_m / math.sqrt(2)), merged.sigma_m),
    )


def _registered(row: MarkerRow) -> RegisteredMarker:
    limit, rmse_m = speed_limit_of(row), horizontal_rmse_m(row)
    return RegisteredMarker(
        row.lon_deg,
        row.lat_deg,
        row.height_m,
        side_of(row),
        math.nan if limit is None else limit.km_h,
        math.nan if not rmse_m else rmse_m / math.sqrt(2),  # horizontal RMSE is of both axes together
    )


def speed_limit_of(row: MarkerRow) -> SpeedLimit | None:
    """Speed limit of a CERPM's row."""
    stored = row.spec["speed_limit"]
    return None if stored is None else SpeedLimit(stored["value"], SpeedUnit(stored["unit"]))


def side_of(row: MarkerRow) -> LaneSide:
    """Lane side of a CERPM's row."""
    return LaneSide[row.spec["side"].upper()]


def line_of(row: MarkerRow) -> tuple[str | None, str] | None:
    """Road and name of the line on which a CERPM is registered; None where none is."""
    name: str | None = row.spec.get("line")
    return None if name is None else (row.road, name)


def radio_of(row: MarkerRow) -> RadioSettings:
    """Radio of a CERPM's row."""
    return RadioSettings(**row.spec["radio"])
