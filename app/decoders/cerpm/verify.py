"""Heard packets -> which of them their marker sent, fresh and once."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from app.decoders.cerpm.freshness import (
    FASTEST_INTERVAL_S,
    FreshnessRules,
    HeardOrder,
    LearntIntervals,
    SequenceSpan,
    order_of_spans,
    within_spans,
)
from app.decoders.cerpm.packets import HeardPacket
from app.decoders.cerpm.payload import UndecodablePayload, decode_message, has_valid_tag
from app.errors import InvalidParameter
from app.markers.cerpm import CerpmMessage

Floats = npt.NDArray[np.float64]
Keys = Callable[[int], bytes | None] | Mapping[int, bytes]

_CLAIM_BYTES = 16
"""Of a payload before its sequence: they change only when a marker is programmed again."""
_DAMAGED_BITS = 12
_DAMAGED_TAG_BITS = 8
_WRONG_KEY_PACKETS = 3
_CLEAR = "sent in clear, without a tag: anyone can have sent it"
_NO_KEY = "no marker of this number is registered, so there is no key to check it with"
_FORGED = "the tag is not the marker's: forged, or damaged on the way"
_WRONG_KEY = "every packet of this number has a tag of another key: programmed with a wrong key, or forged throughout"
_DAMAGED = "the tag does not fit, and the packet is an authentic one but for a few bits: damaged on the way"


class Verdict(StrEnum):
    """What a packet is worth. Only an authentic one says where a marker is."""

    AUTHENTIC = "authentic"
    UNAUTHENTICATED = "unauthenticated"
    UNKNOWN_MARKER = "unknown-marker"
    WRONG_KEY = "wrong-key"
    FORGED = "forged"
    CORRUPT = "corrupt"
    REPLAYED = "replayed"
    OUT_OF_ORDER = "out-of-order"
    DUPLICATE = "duplicate"
    UNDECODABLE = "undecodable"


@dataclass(frozen=True, slots=True)
class VerifiedPacket:
    """A packet and what it is worth.

    Attributes
    ----------
    packet : HeardPacket
    verdict : Verdict
    number : int or None
        That it gives for its marker; only authentic, replayed, out-of-order and duplicate ones carry that marker's tag.
    message : CerpmMessage or None
        Of a payload that can be decoded, whoever sent it; of a packet in clear see `packet.claim`.
    reason : str
        Why it is not accepted; of an authentic one, what is not sure about it.
    """

    packet: HeardPacket
    verdict: Verdict
    number: int | None = None
    message: CerpmMessage | None = None
    reason: str = ""

    @property
    def entry(self) -> int:
        """Where in the log it is."""
        return self.packet.entry

    @property
    def accepted(self) -> bool:
        """Whether it may say where a marker is."""
        return self.verdict is Verdict.AUTHENTIC

    @property
    def signed(self) -> bool:
        """Whether it carries the marker's tag, fresh or not."""
        return self.verdict in _SIGNED


_SIGNED = frozenset((Verdict.AUTHENTIC, Verdict.REPLAYED, Verdict.OUT_OF_ORDER, Verdict.DUPLICATE))


@dataclass(frozen=True, slots=True)
class Verification:
    """All packets of a log with their verdicts.

    Attributes
    ----------
    packets : list of VerifiedPacket
        In the order they came.
    spans : dict of int to tuple of SequenceSpan
        Accepted sequences of each marker, to be kept and given as `heard_before` next time.
    warnings : list of str
    """

    packets: list[VerifiedPacket]
    spans: dict[int, tuple[SequenceSpan, ...]]
    warnings: list[str]

    def counts(self) -> dict[Verdict, int]:
        """Packets of each verdict."""
        found = dict.fromkeys(Verdict, 0)
        for packet in self.packets:
            found[packet.verdict] += 1
        return found


def verify_packets(
    packets: Sequence[HeardPacket],
    keys: Keys,
    heard_before: Mapping[int, Sequence[SequenceSpan]] | None = None,
    rules: FreshnessRules | None = None,
) -> Verification:
    """Tell authentic, fresh packets from all others.

    Parameters
    ----------
    packets : sequence of HeardPacket
        Of one log, in any order.
    keys : callable or mapping
        The key of the marker of a number; None, or no entry, where there is no such marker.
    heard_before : mapping of int to sequence of SequenceSpan, optional
        What earlier logs gave, by number; logs may come late.
    rules : FreshnessRules, optional

    Returns
    -------
    Verification

    Raises
    ------
    InvalidParameter
        A key has the wrong length.

    Notes
    -----
    A packet without a time is only accepted above every sequence known, and its freshness stays unknown. A recorded
    packet that nobody heard before, sent again where no newer one of its marker is heard, is fresh by all that its
    bytes can tell; where the vehicle was when it heard it must tell (see `merge_markers`).
    """
    rules = rules or FreshnessRules()
    checked = _check_tags(packets, keys)
    _name_failures(checked)
    by_number: dict[int, list[int]] = defaultdict(list)
    for index, packet in enumerate(checked):
        if packet.accepted and packet.number is not None:
            by_number[packet.number].append(index)
    intervals = LearntIntervals({n: _sequences_and_times([checked[i] for i in at]) for n, at in by_number.items()})
    spans: dict[int, tuple[SequenceSpan, ...]] = {}
    for number, indices in by_number.items():
        known = tuple((heard_before or {}).get(number, ()))
        least_s = intervals.least_s(number) if rules.least_interval_s is None else rules.least_interval_s
        for index, verdict, reason in _judge_marker([checked[i] for i in indices], known, rules, least_s):
            at = indices[index]
            checked[at] = replace(checked[at], verdict=verdict, reason=reason)
        accepted = [checked[i] for i in indices if checked[i].accepted]
        if accepted:
            spans[number] = _spans_of(accepted)
    return Verification(checked, spans, _warnings(checked))


# --- tags ---------------------------------------------------------------------------------------------------------


def _check_tags(packets: Iterable[HeardPacket], keys: Keys) -> list[VerifiedPacket]:
    find_key = keys.get if isinstance(keys, Mapping) else keys
    known_keys: dict[int, bytes | None] = {}
    seen: dict[bytes, tuple[Verdict, int | None, CerpmMessage | None, str]] = {}
    checked = []
    for packet in packets:
        if packet.payload is None:
            checked.append(_in_clear(packet))
            continue
        found = seen.get(packet.payload)
        if found is None:
            found = seen[packet.payload] = _check_tag(packet.payload, find_key, known_keys)
        checked.append(VerifiedPacket(packet, *found))
    return checked


def _in_clear(packet: HeardPacket) -> VerifiedPacket:
    if packet.claim is None:
        return VerifiedPacket(packet, Verdict.UNDECODABLE, reason="there is neither a payload nor a claim in it")
    return VerifiedPacket(packet, Verdict.UNAUTHENTICATED, packet.claim.number, reason=_CLEAR)


def _check_tag(
    payload: bytes, find_key: Callable[[int], bytes | None], known_keys: dict[int, bytes | None]
) -> tuple[Verdict, int | None, CerpmMessage | None, str]:
    try:
        message, _tag = decode_message(payload)
    except UndecodablePayload as error:
        return Verdict.UNDECODABLE, None, None, error.message
    except InvalidParameter as error:
        return Verdict.CORRUPT, None, None, error.message
    number = message.number
    if number not in known_keys:
        known_keys[number] = find_key(number)
    key = known_keys[number]
    if key is None:
        return Verdict.UNKNOWN_MARKER, number, message, _NO_KEY
    if has_valid_tag(payload, key):
        return Verdict.AUTHENTIC, number, message, ""
    return Verdict.FORGED, number, message, _FORGED


def _name_failures(checked: list[VerifiedPacket]) -> None:
    """Tell damage and wrong keys from forgeries, for people: none of them is accepted."""
    claims: dict[int, int] = {}
    tags: dict[bytes, int] = {}
    failed: dict[tuple[int, bytes], set[int]] = defaultdict(set)
    for packet in checked:
        payload = packet.packet.payload
        if payload is None or packet.number is None or packet.message is None:
            continue
        if packet.accepted:
            claims.setdefault(packet.number, int.from_bytes(payload[:_CLAIM_BYTES]))
            tags[payload[:-4]] = int.from_bytes(payload[-4:])
        elif packet.verdict is Verdict.FORGED:
            failed[packet.number, payload[:_CLAIM_BYTES]].add(packet.message.sequence)
    for index, packet in enumerate(checked):
        payload = packet.packet.payload
        if packet.verdict is not Verdict.FORGED or payload is None or packet.number is None:
            continue
        if packet.number not in claims:
            if len(failed[packet.number, payload[:_CLAIM_BYTES]]) >= _WRONG_KEY_PACKETS:
                checked[index] = replace(packet, verdict=Verdict.WRONG_KEY, reason=_WRONG_KEY)
        elif _is_damaged(payload, claims[packet.number], tags):
            checked[index] = replace(packet, verdict=Verdict.CORRUPT, reason=_DAMAGED)


def _is_damaged(payload: bytes, claim: int, tags: Mapping[bytes, int]) -> bool:
    bits = (int.from_bytes(payload[:_CLAIM_BYTES]) ^ claim).bit_count()
    if bits:
        return bits <= _DAMAGED_BITS
    tag = tags.get(payload[:-4])
    return tag is not None and (int.from_bytes(payload[-4:]) ^ tag).bit_count() <= _DAMAGED_TAG_BITS


# --- freshness ----------------------------------------------------------------------------------------------------

_Judged = tuple[int, Verdict, str]


def _judge_marker(
    packets: Sequence[VerifiedPacket], known: Sequence[SequenceSpan], rules: FreshnessRules, least_interval_s: float
) -> list[_Judged]:
    """Verdicts on packets of one marker that carry its tag; those that are accepted are left out unless unsure."""
    sequences, heard_s = _sequences_and_times(packets)
    judged: list[_Judged] = []
    timed = np.isfinite(heard_s)
    if rules.received_at_s is not None:
        future = timed & (heard_s > rules.received_at_s + rules.clock_tolerance_s)
        for i in np.flatnonzero(future):
            ahead_s = heard_s[i] - rules.received_at_s
            judged.append((int(i), Verdict.OUT_OF_ORDER, f"heard {ahead_s:.0f} s after the log was uploaded"))
        timed &= ~future
    leaders, echoes = _split_echoes(packets, sequences, heard_s, np.flatnonzero(timed), rules)
    judged += echoes
    judged += _judge_timed(sequences[leaders], heard_s[leaders], leaders, known, rules, least_interval_s)
    highest = max([span.last_sequence for span in known] + [int(sequences[i]) for i in leaders], default=-1)
    return judged + _judge_untimed(sequences, np.flatnonzero(np.isnan(heard_s)), highest)


def _sequences_and_times(packets: Sequence[VerifiedPacket]) -> tuple[Floats, Floats]:
    sequences = [packet.message.sequence if packet.message else 0 for packet in packets]
    return np.array(sequences, float), np.array([packet.packet.heard_at_s for packet in packets], float)


def _split_echoes(
    packets: Sequence[VerifiedPacket],
    sequences: Floats,
    heard_s: Floats,
    among: npt.NDArray[np.intp],
    rules: FreshnessRules,
) -> tuple[npt.NDArray[np.intp], list[_Judged]]:
    """The first hearing of each sequence, and verdicts on the others."""
    order = among[np.lexsort((among, heard_s[among], sequences[among]))]
    new = np.diff(sequences[order], prepend=-1) > 0
    leaders = order[new]
    judged: list[_Judged] = []
    for i, leader in zip(order[~new], leaders[np.cumsum(new) - 1][~new], strict=True):
        packet, first = packets[i].packet, packets[leader].packet
        after_s = heard_s[i] - heard_s[leader]
        if packet.payload != first.payload:
            reason = f"another message of the same sequence is entry {first.entry}: two markers have this number"
            judged.append((int(i), Verdict.OUT_OF_ORDER, reason))
        elif after_s <= rules.echo_s or (packet.event is not None and packet.event == first.event):
            judged.append((int(i), Verdict.DUPLICATE, f"heard already as entry {first.entry}"))
        else:
            reason = f"heard already {after_s:.0f} s before, as entry {first.entry}"
            judged.append((int(i), Verdict.REPLAYED, reason))
    return leaders, judged


def _judge_timed(
    sequences: Floats,
    heard_s: Floats,
    indices: npt.NDArray[np.intp],
    known: Sequence[SequenceSpan],
    rules: FreshnessRules,
    least_interval_s: float,
) -> list[_Judged]:
    # a marker may have been programmed to another interval between drives
    before = order_of_spans(known, rules.least_interval_s or FASTEST_INTERVAL_S)
    within = within_spans(known, sequences)
    late_s, early_s = before.late_s(sequences, heard_s), before.early_s(sequences, heard_s)
    late_here_s = HeardOrder(sequences, heard_s, least_interval_s).late_s(sequences, heard_s)
    tolerance_s = rules.clock_tolerance_s + rules.log_tolerance_s
    judged: list[_Judged] = []
    for k in np.flatnonzero((late_s > tolerance_s) | (early_s > tolerance_s) | (late_here_s > rules.log_tolerance_s)):
        index, sequence = int(indices[k]), int(sequences[k])
        if late_s[k] > tolerance_s:
            verdict = Verdict.REPLAYED if within[k] else Verdict.OUT_OF_ORDER
            ago = f"{late_s[k]:.0f} s too late" if math.isfinite(late_s[k]) else "too late, or in a log without times"
            reason = f"sequence {sequence} was sent before another that an earlier drive heard: heard again {ago}"
        elif early_s[k] > tolerance_s:
            verdict = Verdict.OUT_OF_ORDER
            reason = f"sequence {sequence} is heard {early_s[k]:.0f} s before a lower one of another drive"
        else:
            verdict = Verdict.OUT_OF_ORDER
            reason = f"sequence {sequence} is heard {late_here_s[k]:.0f} s too late for a higher one of this log"
        judged.append((index, verdict, reason))
    return judged


def _judge_untimed(sequences: Floats, indices: npt.NDArray[np.intp], highest: int) -> list[_Judged]:
    judged: list[_Judged] = []
    seen: set[int] = set()
    for i in indices:
        sequence = int(sequences[i])
        if sequence in seen:
            judged.append(
                (int(i), Verdict.DUPLICATE, "this sequence is in the log already; without times no more is known")
            )
        elif sequence <= highest:
            reason = f"without a time it must be above sequence {highest}, which is known already; it is {sequence}"
            judged.append((int(i), Verdict.OUT_OF_ORDER, reason))
        else:
            judged.append((int(i), Verdict.AUTHENTIC, "freshness unknown: the log has no time for it"))
        seen.add(sequence)
    return judged


def _spans_of(accepted: Sequence[VerifiedPacket]) -> tuple[SequenceSpan, ...]:
    spans = []
    for timed in (True, False):
        group = [p for p in accepted if math.isfinite(p.packet.heard_at_s) is timed and p.message is not None]
        if group:
            sequences = [p.message.sequence for p in group if p.message is not None]
            times = [p.packet.heard_at_s for p in group] if timed else [math.nan]
            spans.append(SequenceSpan(min(sequences), max(sequences), min(times), max(times)))
    return tuple(spans)


def _warnings(checked: Iterable[VerifiedPacket]) -> list[str]:
    untimed = sum(1 for p in checked if p.accepted and not math.isfinite(p.packet.heard_at_s))
    if not untimed:
        return []
    return [f"freshness unknown: {untimed} packets have no time; they are accepted by the order of sequences alone"]
