"""Packets of a drive -> which were sent by their markers, which markers these are, and where they are."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sqlalchemy as sa

from app.decoders.cerpm.freshness import SequenceSpan
from app.decoders.cerpm.lane_types import LaneMarkers
from app.decoders.cerpm.merge import SURVEY_SIGMA_M, merge_markers
from app.decoders.cerpm.merge_types import MergedMarkers, MergeRules, RegisteredMarker
from app.decoders.cerpm.payload import decode_message
from app.decoders.cerpm.signal import SignalReport, profile_signals
from app.decoders.cerpm.verify import Verification, verify_packets
from app.errors import WaymarkError
from app.geodesy import LocalizationGrade
from app.markers.cerpm import MESSAGE_BYTES
from app.markers.cerpm_keys import derive_marker_key
from app.registry import cerpms
from app.registry.markers import Row
from app.services.agency_secrets import AgencySecrets
from app.services.cerpm_markers import radio_of, side_of, speed_limit_of
from app.services.fixes import horizontal_rmse_m, position_doubts
from app.services.marker_rules import RETIRED
from app.services.packets import DriveFiles, PacketTerms

RETIRED_REASON = "it is retired: nothing that it says counts any more"


@dataclass(frozen=True, slots=True)
class KnownMarkers:
    """What the registry knows of the markers that packets claim to be from.

    Attributes
    ----------
    rows : dict of int to Row
        By number.
    agency_key : bytes or None
    heard_before : dict of int to list of SequenceSpan
    last_span : int
        Newest row among these spans: who writes more must see the same.
    """

    rows: dict[int, Row]
    agency_key: bytes | None
    heard_before: dict[int, list[SequenceSpan]]
    last_span: int


@dataclass(frozen=True, slots=True)
class ReadPackets:
    """A drive's packets with what the registry made of them."""

    verification: Verification
    merged: MergedMarkers
    signal: SignalReport
    known: KnownMarkers
    grade: LocalizationGrade
    doubts: tuple[str, ...]
    verify_ms: float


def numbers_in(files: DriveFiles) -> list[int]:
    """Numbers that the packets of a drive give, each once."""
    found = set()
    for payload in {packet.payload for packet in files.packets}:
        if payload is not None and len(payload) == MESSAGE_BYTES:
            try:
                found.add(decode_message(payload)[0].number)
            except WaymarkError:
                continue  # verification says what is wrong with it
    found |= {packet.claim.number for packet in files.packets if packet.claim is not None}
    return sorted(found)


def find_known(connection: sa.Connection, agency_id: str, secrets: AgencySecrets, numbers: list[int]) -> KnownMarkers:
    """Markers, key and earlier drives of an agency."""
    spans = cerpms.list_spans(connection, agency_id, numbers)
    return KnownMarkers(
        cerpms.list_by_number(connection, agency_id, numbers),
        secrets.find_key(connection, agency_id),
        {number: [_span(row) for row in rows] for number, rows in spans.items()},
        max((row["row"] for rows in spans.values() for row in rows), default=0),
    )


def read_packets_of(files: DriveFiles, known: KnownMarkers, terms: PacketTerms, received_at_s: float) -> ReadPackets:
    """Verify packets and merge them to one place a marker."""
    began = time.perf_counter()

    def key_of(number: int) -> bytes | None:
        if known.agency_key is None or number not in known.rows:
            return None
        return derive_marker_key(known.agency_key, number)

    freshness = replace(terms.freshness, received_at_s=received_at_s, least_interval_s=_least_interval_s(known))
    verification = verify_packets(files.packets, key_of, known.heard_before, freshness)
    registered = {number: _registered(row) for number, row in known.rows.items()}
    rules = MergeRules(accept_clear=terms.accept_clear)
    merged = _without_retired(merge_markers(verification.packets, registered, files.track, rules), known)
    places = {
        int(number): (float(lon), float(lat))
        for number, lon, lat in zip(merged.number, merged.lon_deg, merged.lat_deg, strict=True)
    }
    signal = profile_signals(verification.packets, places, files.track, terms.signal)
    grade, doubts = _grade(merged, verification, known)
    return ReadPackets(verification, merged, signal, known, grade, doubts, 1e3 * (time.perf_counter() - began))


def lane_markers(merged: MergedMarkers) -> LaneMarkers:
    """Merged markers as the lane's fit takes them."""
    return LaneMarkers(
        merged.number, merged.lon_deg, merged.lat_deg, merged.side, merged.sigma_m, merged.speed_limit_km_h
    )


def spans_of(verification: Verification) -> list[dict[str, Any]]:
    """What was accepted, as the registry keeps it."""
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


def _least_interval_s(known: KnownMarkers) -> float | None:
    """Half of the shortest interval that any of the markers is programmed with: their clocks may be off. [s]"""
    radios = [radio_of(row) for row in known.rows.values()]
    return min((radio.interval_s * (1 - radio.jitter_share) / 2 for radio in radios), default=None)


def _span(row: Row) -> SequenceSpan:
    first, last = row["first_heard_s"], row["last_heard_s"]
    return SequenceSpan(
        row["first_sequence"],
        row["last_sequence"],
        math.nan if first is None else first,
        math.nan if last is None else last,
    )


def _registered(row: Row) -> RegisteredMarker:
    limit, rmse_m = speed_limit_of(row), horizontal_rmse_m(row)
    return RegisteredMarker(
        row["lon_deg"],
        row["lat_deg"],
        row["height_m"],
        side_of(row),
        math.nan if limit is None else limit.km_h,
        SURVEY_SIGMA_M if not rmse_m else rmse_m / math.sqrt(2),  # horizontal RMSE is of both axes together
    )


def _without_retired(merged: MergedMarkers, known: KnownMarkers) -> MergedMarkers:
    retired = [n for n in merged.number.tolist() if n in known.rows and known.rows[n]["status"] == RETIRED]
    if not retired:
        return merged
    kept = ~np.isin(merged.number, retired)
    arrays = ("number", "lon_deg", "lat_deg", "side", "sigma_m", "speed_limit_km_h", "packets", "registered")
    return replace(
        merged,
        **{name: getattr(merged, name)[kept] for name in arrays},
        left_out={**merged.left_out, **dict.fromkeys(retired, RETIRED_REASON)},
    )


def _grade(
    merged: MergedMarkers, verification: Verification, known: KnownMarkers
) -> tuple[LocalizationGrade, tuple[str, ...]]:
    """Whether the path may localize a vehicle, and what speaks against it."""
    doubts: dict[str, int] = {}
    authentic = {packet.number for packet in verification.packets if packet.accepted}
    for number in merged.number.tolist():
        row = known.rows.get(number)
        told = position_doubts(row, "marker") if row is not None else ["the marker is not registered"]
        if number not in authentic:
            told.append("the marker was only heard in clear: anyone can have sent it")
        for doubt in told:
            doubts[doubt] = doubts.get(doubt, 0) + 1
    if merged.shift_m is not None:
        doubts["the markers claim places in another datum"] = len(merged.left_out)
    texts = tuple(f"{doubt} ({count} of {len(merged.number)})" for doubt, count in doubts.items())
    return (LocalizationGrade.APPROXIMATE if doubts else LocalizationGrade.EXACT), texts
