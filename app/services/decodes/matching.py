"""Readings of frames, traces and packet logs to registered markers, and the positions that follow."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from typing import cast

import numpy as np
import sqlalchemy as sa

from app.decoders.cerpm.merge import (
    KnownCerpms,
    MergedMarkers,
    MergeRules,
    RegisteredMarker,
    grade_markers,
    match_known_markers,
)
from app.decoders.cerpm.signal import SignalReport, SignalRules, profile_signals
from app.decoders.cerpm.verify import FreshnessRules, SequenceSpan, Verification
from app.decoders.magnet.identify import MAX_TAGS, RegisteredTag
from app.decoders.plate.pose import VehicleFix, fix_vehicle
from app.families import FAMILIES, get_family
from app.families.cerpm import radio_of, side_of, speed_limit_of
from app.families.family import FrameReader, FrameReading, Match, Nearby
from app.families.magnet.layouts import INFORMATION_TAG, MagnetSpec, meaning_of
from app.families.plate.frames import plate_codebook
from app.families.plate.plates import PLATE
from app.families.surveys import RETIRED
from app.geodesy import (
    LocalizationGrade,
    decimal_year,
    enu_from_wgs84,
    grade_accuracy,
    move_to_epoch,
    total_accuracy_m,
    wgs84_from_enu,
    worst_grade,
)
from app.lanes.types import LaneMarkers, PacketStrengths
from app.markers import reading
from app.markers.cerpm import derive_marker_key
from app.markers.magnet import InformationTag, parse_tag
from app.markers.plate import PlateCode
from app.markers.reading import PlatePose
from app.registry import markers
from app.registry import markers as store
from app.registry.marker_rows import MarkerRow
from app.registry.markers import MarkerFilter, SpanRow
from app.sensors.camera import Camera
from app.services.access.agency_secrets import AgencySecrets
from app.services.decodes.declarations import CoarsePosition, DeclaredPackets
from app.services.decodes.packet_tasks import DriveFiles

MAX_CODEBOOK = 500
FRAME_READERS: Mapping[str, FrameReader[FrameReading, object]] = {
    family.name: family.frames for family in FAMILIES if family.frames is not None
}
"""Families whose markers are read in camera frames."""


@dataclass(frozen=True, slots=True)
class NearbyMarkers:
    """The agency's markers that could be in view, by family."""

    by_family: Mapping[str, Nearby] = field(default_factory=dict)

    def of(self, family: str) -> Nearby:
        """Those of one family; none where no position is known."""
        return self.by_family.get(family, Nearby())

    @property
    def codebook(self) -> tuple[PlateCode, ...]:
        """Codes of the plates nearby."""
        return plate_codebook(self.of(PLATE.name))


def find_nearby_markers(connection: sa.Connection, agency_id: str, position: CoarsePosition | None) -> NearbyMarkers:
    """Markers of the agency within the coarse accuracy and the range of view."""
    if position is None:
        return NearbyMarkers()
    names = tuple(FRAME_READERS)
    rows = store.list_near(
        connection, agency_id, names, position.lon_deg, position.lat_deg, position.reach_m, limit=MAX_CODEBOOK + 1
    )
    complete = len(rows) <= MAX_CODEBOOK
    return NearbyMarkers(
        {name: Nearby(tuple(row for row in rows[:MAX_CODEBOOK] if row.family == name), complete) for name in names}
    )


def match_reading(
    connection: sa.Connection,
    agency_id: str,
    reading: FrameReading,
    position: CoarsePosition | None,
    nearby: NearbyMarkers,
) -> Match | None:
    """The registered marker of a reading; None where nothing was read or there is no position to look from."""
    reader = get_family(reading.family).frames
    assert reader is not None
    return reader.match(connection, agency_id, reading, position, nearby.of(reading.family))


# === Matched plates to the position of the vehicle.


# used where no accuracy is registered; fixes that depend on one of them are approximate only
ASSUMED_HORIZONTAL_RMSE_M = 1.0
ASSUMED_VERTICAL_RMSE_M = 1.0
ASSUMED_HEADING_RMSE_DEG = 2.0
COARSE_HEADING_RMSE_DEG = 5.0


@dataclass(frozen=True, slots=True)
class Fix:
    """Where the vehicle is."""

    vehicle: VehicleFix
    grade: LocalizationGrade  # of the plates' positions; UNFIT where there is a reason against the match
    notes: tuple[str, ...]  # why it is unfit for localization, and what was assumed
    has_height: bool  # whether the plates' heights are known
    marker_ids: tuple[str, ...]  # the plates it rests on
    epoch: float | None  # [decimal year] of its position in the ITRF; None where a plate's position has no epoch


def fix_from_match(
    pose: PlatePose, camera: Camera, match: Match, vehicle_heading_deg: float | None, *, epoch: float
) -> Fix | None:
    """Vehicle's position in the ITRF at an epoch from one matched plate.

    Returns
    -------
    Fix or None
        None if neither the plate's heading nor the vehicle's is known: then a plate fixes no direction.
    """
    if match.row is None or not match.plausible:
        return None
    row = marker_at(match.row, epoch)
    label = get_family(row.family).label
    notes = position_warnings(row, label)
    if match.ambiguous:
        notes.append(f"several {label}s within reach carry these digits")
    heading_deg, heading_rmse_deg = row.heading_deg, row.heading_rmse_deg
    if heading_deg is None:
        if vehicle_heading_deg is None:
            return None
        heading_deg = (vehicle_heading_deg + _plate_heading_in_vehicle_deg(pose, camera)) % 360.0
        heading_rmse_deg = COARSE_HEADING_RMSE_DEG
        notes.append(f"the {label}'s heading is not registered; the vehicle's own heading was used")
    fit = not notes
    for name, value in (("heading_rmse_deg", heading_rmse_deg), ("vertical_rmse_m", row.vertical_rmse_m)):
        if value is None and (name != "vertical_rmse_m" or row.height_m is not None):
            notes.append(f"{name} of the {label} is not registered; an assumed value was used")
    vehicle = fix_vehicle(
        pose,
        camera,
        lon_deg=row.lon_deg,
        lat_deg=row.lat_deg,
        height_m=row.height_m or 0.0,
        heading_deg=heading_deg,
        horizontal_rmse_m=_or_assumed(horizontal_rmse_m(row), ASSUMED_HORIZONTAL_RMSE_M),
        vertical_rmse_m=_or_assumed(row.vertical_rmse_m, ASSUMED_VERTICAL_RMSE_M),
        heading_rmse_deg=_or_assumed(heading_rmse_deg, ASSUMED_HEADING_RMSE_DEG),
    )
    grade = LocalizationGrade(row.localization_grade) if fit else LocalizationGrade.UNFIT
    return Fix(vehicle, grade, tuple(notes), row.height_m is not None, (str(row.id),), row.epoch)


def fuse_fixes(fixes: Sequence[Fix]) -> Fix | None:
    """Covariance-weighted mean of the fixes of one frame; unfit ones count only where there are no others.

    Notes
    -----
    The plates' survey errors are taken as independent, and so are the poses: corners share a frame's calibration
    error, which no covariance here knows of.
    """
    used = [fix for fix in fixes if fix.grade is not LocalizationGrade.UNFIT] or list(fixes)
    if len(used) < 2:
        return used[0] if used else None
    first = used[0].vehicle
    origin = (first.lon_deg, first.lat_deg, first.height_m)
    information, weighted = np.zeros((4, 4)), np.zeros(4)
    for fix in used:
        vehicle = fix.vehicle
        enu_m = enu_from_wgs84(vehicle.lon_deg, vehicle.lat_deg, vehicle.height_m, origin)
        turn = math.radians((vehicle.heading_deg - first.heading_deg + 180.0) % 360.0 - 180.0)
        weight = np.linalg.inv(vehicle.covariance)
        information += weight
        weighted += weight @ np.array([*enu_m, turn])
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    mean = covariance @ weighted
    lon_deg, lat_deg, height_m = wgs84_from_enu(mean[:3], origin)
    heading_deg = (first.heading_deg + math.degrees(mean[3])) % 360.0
    return Fix(
        VehicleFix(lon_deg, lat_deg, height_m, heading_deg, covariance),
        worst_grade(fix.grade for fix in used),
        tuple(dict.fromkeys(note for fix in used for note in fix.notes)),
        all(fix.has_height for fix in used),
        tuple(marker_id for fix in used for marker_id in fix.marker_ids),
        used[0].epoch if all(fix.epoch is not None for fix in used) else None,
    )


def position_warnings(row: MarkerRow, what: str) -> list[str]:
    """What makes the position of a plate or a tag unfit for localization."""
    return reading.position_warnings(
        what, grade=row.localization_grade, transform_note=row.transform_note, status=row.status
    )


def horizontal_rmse_m(row: MarkerRow) -> float | None:
    """What a marker's position is good to: its survey, and the stated bound of what brought it to WGS 84 / ITRF. [m]"""
    stated, bound_m = row.horizontal_rmse_m, row.transform_accuracy_m
    return None if stated is None else math.hypot(stated, bound_m or 0.0)


def marker_at(row: MarkerRow, epoch: float) -> MarkerRow:
    """The row with the position that its marker has at an epoch, by the motion of its plate.

    A position without an epoch stays: its accuracy already allows for the motion of ten years.

    Parameters
    ----------
    epoch : float
        [decimal year]
    """
    if row.epoch is None or row.transform_accuracy_m is None:
        return row
    moved = move_to_epoch(row.lon_deg, row.lat_deg, row.epoch, epoch)
    accuracy_m = math.hypot(row.transform_accuracy_m, float(moved.accuracy_m[0]))
    return row._replace(
        lon_deg=float(moved.lon_deg[0]), lat_deg=float(moved.lat_deg[0]), epoch=epoch, transform_accuracy_m=accuracy_m,
        localization_grade=grade_accuracy(total_accuracy_m(row.horizontal_rmse_m, accuracy_m)).value,
    )  # fmt: skip


def _or_assumed(value: float | None, assumed: float) -> float:
    return assumed if value is None else float(value)


def _plate_heading_in_vehicle_deg(pose: PlatePose, camera: Camera) -> float:
    """Direction of travel that the plate shows, clockwise from straight ahead of the vehicle. [deg]"""
    forward, left, _up = camera.camera_from_vehicle.T @ pose.rotation @ np.array([0.0, 1.0, 0.0])
    return -math.degrees(math.atan2(left, forward))


# === Information tags of the registry as the decoder of traces takes them.


@dataclass(frozen=True, slots=True)
class NearbyTags:
    """The agency's information tags that the drive can have passed."""

    tags: tuple[RegisteredTag, ...] = ()
    complete: bool = True

    @property
    def texts(self) -> tuple[str, ...]:
        """Their codes, without repetitions; none if there are too many to look for."""
        return tuple(dict.fromkeys(tag.tag.text for tag in self.tags)) if self.complete else ()


def find_nearby_tags(
    connection: sa.Connection, agency_id: str, position: CoarsePosition | None, reach_m: float, epoch: float
) -> NearbyTags:
    """Information tags within the coarse accuracy and the length of a drive, where they are at an epoch."""
    if position is None:
        return NearbyTags()
    near = (position.lon_deg, position.lat_deg, position.accuracy_m + reach_m)
    rows = store.list_markers(
        connection, agency_id, MarkerFilter(near=near, family="magnet"), after=None, limit=4 * MAX_TAGS
    )
    tags = [row for row in rows if row.scheme == INFORMATION_TAG and row.status != "retired"]
    complete = len(tags) <= MAX_TAGS and len(rows) < 4 * MAX_TAGS
    return NearbyTags(tuple(registered_tag(row, epoch) for row in tags[:MAX_TAGS]), complete)


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
        tuple(position_warnings(row, "tag")), meaning_of(spec),
    )  # fmt: skip


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
            {number: tuple(position_warnings(row, "marker")) for number, row in self.rows.items()},
            frozenset(number for number, row in self.rows.items() if row.status == RETIRED),
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


def find_known(
    connection: sa.Connection, agency_id: str, secrets: AgencySecrets, numbers: list[int], before: str | None = None
) -> KnownMarkers:
    """Markers, key and earlier drives of an agency; of a decode that is done again, those before it."""
    spans = markers.list_spans(connection, agency_id, numbers, before)
    return KnownMarkers(
        markers.list_by_number(connection, agency_id, numbers),
        secrets.find_key(connection, agency_id),
        {number: [_span(row) for row in rows] for number, rows in spans.items()},
        markers.newest_row(spans),
    )


def read_packets_of(
    files: DriveFiles,
    known: KnownMarkers,
    declared: DeclaredPackets,
    max_invalid_tags: int,
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
    merged = _at_epoch(merged, known.rows, decimal_year(_driven_at(files) or observed_at))
    places = {
        int(number): (float(lon), float(lat))
        for number, lon, lat in zip(merged.number, merged.lon_deg, merged.lat_deg, strict=True)
    }
    signal = profile_signals(verification.packets, places, files.track, SignalRules.of(declared.receiver))
    grade, localization_warnings = grade_markers(merged, verification, known.cerpms)
    return ReadPackets(
        verification, merged, signal, known, grade, localization_warnings, 1e3 * (time.perf_counter() - began)
    )


def lane_markers(merged: MergedMarkers) -> LaneMarkers:
    """Merged markers as the lane's fit takes them."""
    return LaneMarkers(
        merged.number, merged.lon_deg, merged.lat_deg, merged.side, merged.sigma_m, merged.speed_limit_kmh
    )


def packet_strengths(verification: Verification) -> PacketStrengths:
    """How strongly authentic packets were received, for the lane's fit."""
    heard = [
        (packet.number, packet.packet.received_at_s, packet.packet.rssi_dbm)
        for packet in verification.packets
        if packet.accepted and packet.number is not None and math.isfinite(packet.packet.received_at_s)
    ]
    number, time_s, rssi_dbm = zip(*heard, strict=True) if heard else ((), (), ())
    return PacketStrengths(np.array(number, np.int64), np.array(time_s, float), np.array(rssi_dbm, float))


def spans_of(verification: Verification) -> list[dict[str, object]]:
    """The accepted transmissions, as the registry stores them."""
    return [
        {
            "number": number,
            "first_sequence": span.first_sequence,
            "last_sequence": span.last_sequence,
            "first_heard_s": span.first_heard_s if math.isfinite(span.first_heard_s) else None,
            "last_heard_s": span.last_heard_s if math.isfinite(span.last_heard_s) else None,
        }
        for number, spans in verification.spans.items()
        for span in spans
    ]


def _span(row: SpanRow) -> SequenceSpan:
    first, last = row.first_heard_s, row.last_heard_s
    return SequenceSpan(
        row.first_sequence,
        row.last_sequence,
        math.nan if first is None else first,
        math.nan if last is None else last,
    )


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
