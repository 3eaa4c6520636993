"""Packets held against what is known of their markers: which are authentic, where the markers are, how good that is.

The same on the server, from the registry, and on board, from a snapshot.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from app.decoders.cerpm.freshness import FreshnessRules, SequenceSpan
from app.decoders.cerpm.merge import merge_markers
from app.decoders.cerpm.merge_types import MergedMarkers, MergeRules, RegisteredMarker
from app.decoders.cerpm.packets import HeardPacket
from app.decoders.cerpm.payload import decode_message
from app.decoders.cerpm.verify import Verification, verify_packets
from app.errors import WaymarkError
from app.geodesy import LocalizationGrade
from app.markers.cerpm import MESSAGE_BYTES
from app.sensors.pose_track import PoseTrack

RETIRED_REASON = "it is retired: nothing that it says counts any more"


@dataclass(frozen=True, slots=True)
class KnownCerpms:
    """What is known of the markers that packets claim to be from, by their numbers.

    Attributes
    ----------
    registered : dict of int to RegisteredMarker
    heard_before : dict of int to list of SequenceSpan
        Of earlier drives.
    least_interval_s : dict of int to float
        Shortest time between two transmissions that a marker is programmed with. [s]
    doubts : dict of int to tuple of str
        What makes a registered position unfit for localization.
    retired : frozenset of int
        They count no more, whatever they say.
    """

    registered: dict[int, RegisteredMarker] = field(default_factory=dict)
    heard_before: dict[int, list[SequenceSpan]] = field(default_factory=dict)
    least_interval_s: dict[int, float] = field(default_factory=dict)
    doubts: dict[int, tuple[str, ...]] = field(default_factory=dict)
    retired: frozenset[int] = frozenset()


def numbers_in(packets: Iterable[HeardPacket]) -> list[int]:
    """Numbers that packets give, each once."""
    heard = list(packets)
    found = {packet.claim.number for packet in heard if packet.claim is not None}
    for payload in {packet.payload for packet in heard}:
        if payload is not None and len(payload) == MESSAGE_BYTES:
            try:
                found.add(decode_message(payload)[0].number)
            except WaymarkError:
                continue  # verification says what is wrong with it
    return sorted(found)


def hold_against_known(
    packets: Sequence[HeardPacket],
    keys: Callable[[int], bytes | None] | Mapping[int, bytes],
    known: KnownCerpms,
    track: PoseTrack | None = None,
    freshness: FreshnessRules | None = None,
    rules: MergeRules | None = None,
) -> tuple[Verification, MergedMarkers]:
    """Verify packets, and merge them to one place a marker.

    Parameters
    ----------
    packets : sequence of HeardPacket
    keys : callable or mapping
        As of `verify_packets`.
    known : KnownCerpms
    track : PoseTrack, optional
    freshness : FreshnessRules, optional
        Its `least_interval_s` is half of the shortest one that any of these markers is programmed with, where one is
        known: their clocks may be off.
    rules : MergeRules, optional
    """
    numbers = numbers_in(packets)
    intervals_s = [known.least_interval_s[n] / 2 for n in numbers if n in known.least_interval_s]
    freshness = replace(freshness or FreshnessRules(), least_interval_s=min(intervals_s, default=None))
    verification = verify_packets(packets, keys, known.heard_before, freshness)
    merged = merge_markers(verification.packets, known.registered, track, rules)
    return verification, _without_retired(merged, known.retired)


def grade_of(
    merged: MergedMarkers, verification: Verification, known: KnownCerpms
) -> tuple[LocalizationGrade, tuple[str, ...]]:
    """Whether a path through these markers may localize a vehicle, and what speaks against it."""
    doubts: dict[str, int] = {}
    authentic = {packet.number for packet in verification.packets if packet.accepted}
    for number in merged.number.tolist():
        told = list(known.doubts.get(number, ()))
        if number not in known.registered:
            told.append("the marker is not registered")
        if number not in authentic:
            told.append("the marker was only heard in clear: anyone can have sent it")
        for doubt in told:
            doubts[doubt] = doubts.get(doubt, 0) + 1
    if merged.shift_m is not None:
        doubts["the markers claim places in another datum"] = len(merged.left_out)
    texts = tuple(f"{doubt} ({count} of {len(merged.number)})" for doubt, count in doubts.items())
    return (LocalizationGrade.APPROXIMATE if doubts else LocalizationGrade.EXACT), texts


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
