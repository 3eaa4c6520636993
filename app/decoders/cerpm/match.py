"""Received packets matched with known markers: which packets are authentic, where the markers are, and how accurately.

Used on the server with the registry, and on board with a snapshot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from app.decoders.cerpm.freshness import FreshnessRules, SequenceSpan
from app.decoders.cerpm.merge import merge_markers
from app.decoders.cerpm.merged_markers import MergedMarkers, MergeRules, RegisteredMarker
from app.decoders.cerpm.payload import decode_message
from app.decoders.cerpm.verify import Verification, verify_packets
from app.errors import WaymarkError
from app.geodesy import LocalizationGrade, grade_accuracy
from app.markers.cerpm import MESSAGE_BYTES
from app.markers.cerpm_keys import MAX_INVALID_TAGS_PER_LOG
from app.sensors.pose_track import PoseTrack
from app.sensors.receiver import ReceivedPacket

RETIRED_REASON = "it is retired: its messages are not used any more"


@dataclass(frozen=True, slots=True)
class KnownCerpms:
    """What is known of markers, by their numbers.

    Attributes
    ----------
    registered : dict of int to RegisteredMarker
    earlier_spans : dict of int to list of SequenceSpan
        Of earlier drives.
    min_interval_s : dict of int to float
        Shortest programmed time between two transmissions of a marker. [s]
    localization_warnings : dict of int to tuple of str
        Why a registered position is unfit for localization.
    retired : frozenset of int
        Their messages are not used.
    """

    registered: dict[int, RegisteredMarker] = field(default_factory=dict)
    earlier_spans: dict[int, list[SequenceSpan]] = field(default_factory=dict)
    min_interval_s: dict[int, float] = field(default_factory=dict)
    localization_warnings: dict[int, tuple[str, ...]] = field(default_factory=dict)
    retired: frozenset[int] = frozenset()


def list_numbers(packets: Iterable[ReceivedPacket]) -> list[int]:
    """Marker numbers in packets, each once, sorted."""
    received = list(packets)
    found = {packet.claim.number for packet in received if packet.claim is not None}
    for payload in {packet.payload for packet in received}:
        if payload is not None and len(payload) == MESSAGE_BYTES:
            try:
                found.add(decode_message(payload)[0].number)
            except WaymarkError:
                continue  # verification reports what is wrong with it
    return sorted(found)


def match_known_markers(
    packets: Sequence[ReceivedPacket],
    keys: Callable[[int], bytes | None] | Mapping[int, bytes],
    known: KnownCerpms,
    track: PoseTrack | None = None,
    freshness: FreshnessRules | None = None,
    rules: MergeRules | None = None,
    *,
    max_invalid_tags: int = MAX_INVALID_TAGS_PER_LOG,
) -> tuple[Verification, MergedMarkers]:
    """Verify packets, and merge them to one position a marker.

    Parameters
    ----------
    packets : sequence of ReceivedPacket
    keys : callable or mapping
        As of `verify_packets`.
    known : KnownCerpms
    track : PoseTrack, optional
    freshness : FreshnessRules, optional
        Its `min_interval_s` is replaced by half of the shortest programmed interval of these markers, if known: their
        clocks may be inaccurate.
    rules : MergeRules, optional
    max_invalid_tags : int
        As of `verify_packets`.
    """
    numbers = list_numbers(packets)
    intervals_s = [known.min_interval_s[n] / 2 for n in numbers if n in known.min_interval_s]
    freshness = replace(freshness or FreshnessRules(), min_interval_s=min(intervals_s, default=None))
    verification = verify_packets(packets, keys, known.earlier_spans, freshness, max_invalid_tags=max_invalid_tags)
    merged = merge_markers(verification.packets, known.registered, track, rules)
    return verification, _without_retired(merged, known.retired)


def grade_markers(
    merged: MergedMarkers, verification: Verification, known: KnownCerpms
) -> tuple[LocalizationGrade, tuple[str, ...]]:
    """Grade of the least accurate of these markers, and the reasons why their path may not localize a vehicle."""
    localization_warnings: dict[str, int] = {}
    authentic = {packet.number for packet in verification.packets if packet.accepted}
    for number in merged.number.tolist():
        warnings = list(known.localization_warnings.get(number, ()))
        if number not in known.registered:
            warnings.append("the marker is not registered")
        if number not in authentic:
            warnings.append("the marker was only received in clear: anyone can have sent it")
        for warning in warnings:
            localization_warnings[warning] = localization_warnings.get(warning, 0) + 1
    if merged.shift_m is not None:
        localization_warnings["the markers send positions in another datum"] = len(merged.left_out)
    texts = tuple(f"{warning} ({count} of {len(merged.number)})" for warning, count in localization_warnings.items())
    if texts or not len(merged.number):
        return LocalizationGrade.UNFIT, texts
    return grade_accuracy(float(merged.sigma_m.max()) * math.sqrt(2)), texts  # horizontal RMSE is of both axes


def _without_retired(merged: MergedMarkers, retired: frozenset[int]) -> MergedMarkers:
    named = [number for number in merged.number.tolist() if number in retired]
    if not named:
        return merged
    kept = ~np.isin(merged.number, named)
    arrays = ("number", "lon_deg", "lat_deg", "side", "sigma_m", "speed_limit_km_h", "packets", "registered")
    return replace(
        merged,
        **{name: getattr(merged, name)[kept] for name in arrays},
        left_out={**merged.left_out, **dict.fromkeys(named, RETIRED_REASON)},
    )
