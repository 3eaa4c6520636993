"""Packets of a drive -> which were sent by their markers, which markers these are, and where they are."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from typing import Any

import numpy as np
import sqlalchemy as sa

from app.decoders.cerpm.freshness import SequenceSpan
from app.decoders.cerpm.match import KnownCerpms, grade_markers, match_known_markers
from app.decoders.cerpm.merged_markers import MergedMarkers, MergeRules, RegisteredMarker
from app.decoders.cerpm.signal import SignalReport, profile_signals
from app.decoders.cerpm.verify import Verification
from app.families.cerpm.message import radio_of, side_of, speed_limit_of
from app.families.rules import RETIRED
from app.geodesy import LocalizationGrade, decimal_year, move_to_epoch
from app.lanes.types import LaneMarkers
from app.markers.cerpm_keys import derive_marker_key
from app.registry import cerpms
from app.registry.cerpms import SpanRow
from app.registry.marker_rows import MarkerRow
from app.services.access.agency_secrets import AgencySecrets
from app.services.decodes.fixes import horizontal_rmse_m, position_warnings
from app.services.decodes.packet_task import DriveFiles, PacketTerms


@dataclass(frozen=True)
class KnownMarkers:
    """What the registry knows of the markers that packets claim to be from.

    Attributes
    ----------
    rows : dict of int to MarkerRow
        By number.
    agency_key : bytes or None
    earlier_spans : dict of int to list of SequenceSpan
    last_span : int
        Newest row among these spans: who writes more must see the same.
    """

    rows: dict[int, MarkerRow]
    agency_key: bytes | None
    earlier_spans: dict[int, list[SequenceSpan]]
    last_span: int

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
    spans = cerpms.list_spans(connection, agency_id, numbers, before)
    return KnownMarkers(
        cerpms.list_by_number(connection, agency_id, numbers),
        secrets.find_key(connection, agency_id),
        {number: [_span(row) for row in rows] for number, rows in spans.items()},
        cerpms.newest_row(spans),
    )


def read_packets_of(
    files: DriveFiles,
    known: KnownMarkers,
    terms: PacketTerms,
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

    freshness = replace(terms.freshness, uploaded_at_s=received_at.timestamp())
    rules = MergeRules(accept_clear=terms.accept_clear)
    verification, merged = match_known_markers(
        files.packets, key_of, known.cerpms, files.track, freshness, rules, max_invalid_tags=max_invalid_tags
    )
    merged = _at_epoch(merged, known.rows, decimal_year(_driven_at(files) or observed_at))
    places = {
        int(number): (float(lon), float(lat))
        for number, lon, lat in zip(merged.number, merged.lon_deg, merged.lat_deg, strict=True)
    }
    signal = profile_signals(verification.packets, places, files.track, terms.signal)
    grade, localization_warnings = grade_markers(merged, verification, known.cerpms)
    return ReadPackets(
        verification, merged, signal, known, grade, localization_warnings, 1e3 * (time.perf_counter() - began)
    )


def lane_markers(merged: MergedMarkers) -> LaneMarkers:
    """Merged markers as the lane's fit takes them."""
    return LaneMarkers(
        merged.number, merged.lon_deg, merged.lat_deg, merged.side, merged.sigma_m, merged.speed_limit_km_h
    )


def spans_of(verification: Verification) -> list[dict[str, Any]]:
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
