"""Received packets to a verdict on each: whether its marker sent it, just then and not before."""

from __future__ import annotations

import hmac
import math
import struct
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field

from app.errors import InvalidParameter
from app.inputs import Declaration
from app.markers.cerpm import (
    BODY_BYTES,
    KEY_BYTES,
    MAX_INVALID_TAGS_PER_LOG,
    MAX_NUMBER,
    MESSAGE_BYTES,
    NO_HEIGHT,
    VERSION,
    CerpmMessage,
    LaneSide,
    SpeedLimit,
    SpeedUnit,
    message_tag,
)
from app.sensors.pose_track import ReceivedPacket
from app.values import Floats

# === The 24 bytes of a CERPM to its message, and the check of its tag.


_BODY = struct.Struct(">BIiiHBI")  # source: the table of `app.markers.cerpm`
_LON_STEPS, _LAT_STEPS = 1_800_000_000, 900_000_000  # source: 180 and 90 degrees in 1e-7 (docs/cerpm-message.md)
_FIELD = "payload"
_CURE_DAMAGED = "ignore this packet; if all packets of a marker are like this, program it again"


class UndecodablePayload(InvalidParameter):
    """Bytes that are not a message of this version at all: another length, or another version."""


def decode_message(payload: bytes) -> tuple[CerpmMessage, bytes]:
    """Message and tag of a payload. The tag is not checked yet.

    Parameters
    ----------
    payload : bytes
        24 of them, in the layout of `app.markers.cerpm`.

    Returns
    -------
    CerpmMessage
    bytes
        The tag, 4 bytes.

    Raises
    ------
    UndecodablePayload
        Another length or an unknown version.
    InvalidParameter
        An invalid value: the reserved bit, a side, the number 0, or a position off the globe.
    """
    _check_form(payload)
    head, number, lon_steps, lat_steps, height_steps, speed, sequence = _BODY.unpack_from(payload)
    side = head >> 2 & 3
    if head & 1:
        raise _damaged("the reserved bit of byte 0 is set", "payload.head", "bit 0 is zero")
    if side > LaneSide.RIGHT:
        raise _damaged("the side of the lane is 3", "payload.side", "0 unknown, 1 left, 2 right")
    if not 1 <= number <= MAX_NUMBER:
        raise _damaged("the number of the marker is 0", "payload.number", f"1 to {MAX_NUMBER}")
    if abs(lon_steps) > _LON_STEPS:
        raise _damaged(f"the longitude is {lon_steps / 1e7} degrees", "payload.lon_deg", "-180 to 180 deg")
    if abs(lat_steps) > _LAT_STEPS:
        raise _damaged(f"the latitude is {lat_steps / 1e7} degrees", "payload.lat_deg", "-90 to 90 deg")
    message = CerpmMessage(
        number=number,
        lon_deg=lon_steps / 1e7,
        lat_deg=lat_steps / 1e7,
        height_m=None if height_steps == NO_HEIGHT else (height_steps - 10_000) / 10,
        side=LaneSide(side),
        speed_limit=SpeedLimit(speed, SpeedUnit.MPH if head & 2 else SpeedUnit.KM_H) if speed else None,
        sequence=sequence,
    )
    return message, payload[BODY_BYTES:]


def has_valid_tag(payload: bytes, key: bytes) -> bool:
    """Whether a payload carries the tag of this key.

    Parameters
    ----------
    payload : bytes
        24 of them.
    key : bytes
        The marker's own, 16 bytes.

    Raises
    ------
    InvalidParameter
        The payload or the key has another length.

    Notes
    -----
    Four bytes of AES-CMAC (RFC 4493): a guess is right once in 2^32.
    """
    if len(key) != KEY_BYTES:
        raise InvalidParameter(f"a marker's key has {len(key)} bytes", field="key", limit=f"{KEY_BYTES} bytes")
    if len(payload) != MESSAGE_BYTES:
        raise _wrong_length(payload)
    return hmac.compare_digest(message_tag(key, payload[:BODY_BYTES]), payload[BODY_BYTES:])


def _check_form(payload: bytes) -> None:
    if len(payload) != MESSAGE_BYTES:
        raise _wrong_length(payload)
    if payload[0] >> 4 != VERSION:
        raise UndecodablePayload(
            f"the payload is of version {payload[0] >> 4} (first byte 0x{payload[0]:02x})",
            field=_FIELD,
            limit=f"version {VERSION}: a first byte from 0x{VERSION << 4:02x} to 0x{(VERSION << 4) | 15:02x}",
            cure="send packets of CERPMs only; a newer version of the message needs a newer decoder",
        )


def _wrong_length(payload: bytes) -> UndecodablePayload:
    return UndecodablePayload(
        f"the payload has {len(payload)} bytes",
        field=_FIELD,
        limit=f"{MESSAGE_BYTES} bytes",
        cure="send the application payload alone, without LoRaWAN's frame, and not cut",
    )


def _damaged(message: str, field: str, limit: str) -> InvalidParameter:
    return InvalidParameter(message, field=field, limit=limit, cure=_CURE_DAMAGED)


# === Freshness of transmissions from their sequences and times of reception.
#
# A marker counts its transmissions, so a message of sequence s was made before every message of a higher sequence, by
# at least the shortest interval for each step between them. If the higher one was received at t, the lower one was made
# before t; received later than that, it was recorded and sent again. This holds whoever sent it.


FASTEST_INTERVAL_S = 0.014  # [s] source: below the 15.4 ms on air of 24 bytes at SF7, 500 kHz (`radio.settings`)
_MAX_STEPS = 50  # of sequence between two packets whose interval is used
_MIN_PAIRS = 20  # of packets for the interval of all markers
_MIN_OWN_PAIRS = 6  # of packets for the interval of one marker
_SIMILAR = 1.25  # ratio to the middle of similar intervals; source: jitter of 0.1 early and late is 1.2
_SIMILAR_SHARE = 0.5  # of all intervals that must be similar; source: a majority, so a flooded log gives none
_SAFETY = 0.5  # of the interval found, taken as the shortest


@dataclass(frozen=True, slots=True)
class SequenceSpan:
    """Sequences of one marker that were received in one drive."""

    # `first_sequence`, `last_sequence`: lowest and highest
    first_sequence: int
    last_sequence: int
    # `first_heard_s`, `last_heard_s`: [s] times of reception, seconds since 1970-01-01 UTC; NaN if the log had no
    # times: then no message up to the highest sequence is fresh any more
    first_heard_s: float
    last_heard_s: float


Tolerance = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class FreshnessDeclaration(Declaration):
    """How strictly times and sequences are compared."""

    clock_tolerance_s: Tolerance = Field(60.0, description="Largest difference between the clocks of two drives. [s]")
    log_tolerance_s: Tolerance = Field(3.0, description="Largest step back of the times within a log. [s]")
    # echoes come from another gateway, or are delivered again; source of the default: `log_tolerance_s`
    echo_s: Tolerance = Field(3.0, description="The same packet is an echo up to this time, later a replay. [s]")


class FreshnessRules(FreshnessDeclaration):
    """Tolerances when times and sequences are compared, with what is known of the log."""

    # [s] shortest time from one transmission of a marker to the next, if known. Without it, half of the interval found
    # in the log is used within the log, and the time on air at the fastest setting between logs.
    min_interval_s: Tolerance | None = None
    uploaded_at_s: Tolerance | None = None  # [s] when the log was uploaded: no packet can have been received later


class SequenceOrder:
    """Sequences of one marker in order, with their times of reception.

    Parameters
    ----------
    sequences : array_like, shape (N,)
    received_s : array_like, shape (N,)
        NaN counts as received before any other time. [s]
    min_interval_s : float
        [s]
    """

    def __init__(self, sequences: npt.ArrayLike, received_s: npt.ArrayLike, min_interval_s: float) -> None:
        known = np.asarray(sequences, float)
        order = np.argsort(known, kind="stable")
        times = np.asarray(received_s, float)[order]
        times[np.isnan(times)] = -np.inf
        self._interval_s = min_interval_s
        self._sequences = known[order]
        made = times - self._sequences * min_interval_s
        self._made_before_s = np.append(np.minimum.accumulate(made[::-1])[::-1], np.inf)
        self._received_by_s = np.append(-np.inf, np.maximum.accumulate(times))

    def late_s(self, sequences: npt.ArrayLike, received_s: npt.ArrayLike) -> Floats:
        """Delay of each reception after the last time it can have been made; -inf where there is no such time. [s]"""
        asked = np.asarray(sequences, float)
        at = np.searchsorted(self._sequences, asked, side="left")
        with np.errstate(invalid="ignore"):
            return np.asarray(received_s, float) - (self._made_before_s[at] + asked * self._interval_s)

    def early_s(self, sequences: npt.ArrayLike, received_s: npt.ArrayLike) -> Floats:
        """Time of each reception before that of a lower or equal sequence; -inf where there is none. [s]"""
        at = np.searchsorted(self._sequences, np.asarray(sequences, float), side="right")
        return np.asarray(self._received_by_s[at] - np.asarray(received_s, float))


def order_of_spans(spans: Sequence[SequenceSpan], min_interval_s: float) -> SequenceOrder:
    """The order of the first and the last transmission of each span."""
    return SequenceOrder(
        [s for span in spans for s in (span.first_sequence, span.last_sequence)],
        [t for span in spans for t in (span.first_heard_s, span.last_heard_s)],
        min_interval_s,
    )


def within_spans(spans: Sequence[SequenceSpan], sequences: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Whether each sequence lies in one of the spans."""
    asked = np.asarray(sequences, float)
    if not spans:
        return np.zeros(len(asked), bool)
    order = sorted(spans, key=lambda span: span.first_sequence)
    first = np.array([span.first_sequence for span in order], float)
    last = np.maximum.accumulate(np.array([span.last_sequence for span in order], float))
    at = np.searchsorted(first, asked, side="right") - 1
    return (at >= 0) & (last[np.maximum(at, 0)] >= asked)


class LearnedIntervals:
    """Intervals between transmissions, estimated from a log.

    Parameters
    ----------
    received : mapping of int to (array, array)
        Sequences and times of the packets of each marker with a valid tag. [s]

    Notes
    -----
    Times from one packet to the next, divided by their steps in sequence, are close to the interval for genuine packets
    and arbitrary for packets that were recorded and sent again. So the shortest range that holds half of all values is
    used, if they are similar: flooding a log prevents an estimate, but does not shift it.
    """

    def __init__(self, received: Mapping[int, tuple[Floats, Floats]]) -> None:
        self._own = {number: _intervals_s(*values) for number, values in received.items()}
        pooled = np.concatenate(list(self._own.values())) if self._own else np.empty(0)
        self._all_s = _densest(pooled, _MIN_PAIRS)

    def min_s(self, number: int) -> float:
        """Half of the marker's own interval or of the interval of all markers, whichever is known and shorter. [s]"""
        own = self._own.get(number, np.empty(0))
        found = [interval for interval in (self._all_s, _densest(own, _MIN_OWN_PAIRS)) if interval is not None]
        if self._all_s is not None and len(own):  # a marker that is clearly faster than the others
            found.append(float(own.max()))
        return max(_SAFETY * min(found), FASTEST_INTERVAL_S) if found else FASTEST_INTERVAL_S


def _intervals_s(sequences: Floats, received_s: Floats) -> Floats:
    """Time between packets that follow each other, over their step in sequence. [s]"""
    found, last, last_s = [], math.inf, math.inf
    known_s = np.where(np.isnan(received_s), np.inf, received_s)
    for sequence, at_s in sorted(zip(sequences.tolist(), known_s.tolist(), strict=True)):
        step, apart_s = sequence - last, at_s - last_s
        if 1 <= step <= _MAX_STEPS and 0 < apart_s < math.inf:
            found.append(apart_s / step)
        if step != 0:  # the first reception of each sequence counts
            last, last_s = sequence, at_s
    return np.array(found, float)


def _densest(intervals_s: Floats, min_count: int) -> float | None:
    """The median of the shortest range that holds half of the values, if they are similar. [s]"""
    if len(intervals_s) < min_count:
        return None
    values = np.sort(np.log(intervals_s))
    half = math.ceil(_SIMILAR_SHARE * len(values))
    widths = values[half - 1 :] - values[: len(values) - half + 1]
    first = int(widths.argmin())
    if widths[first] > 2 * math.log(_SIMILAR):
        return None
    return float(np.exp(np.median(values[first : first + half])))


# === Received packets to a verdict on each.


Keys = Callable[[int], bytes | None] | Mapping[int, bytes]

_FIXED_BYTES = (
    16  # [bytes] of a payload before its sequence; source: docs/cerpm-message.md; change when reprogrammed only
)
_MAX_DAMAGED_BITS = 12  # of the fixed bytes; of 128 random bits so few differ once in 1e22
_MAX_DAMAGED_TAG_BITS = 8  # of the tag's 32; of random tags one in 285 is as close
_MIN_WRONG_KEY_PACKETS = 3
_CLEAR = "sent in clear, without a tag: anyone can have sent it"
_NO_KEY = "no marker of this number is registered, so there is no key to check it with"
_FORGED = "the tag is not the marker's: forged, or damaged on the way"
_UNCHECKED = "not checked: too many tags of this log had failed before"
_WRONG_KEY = "every packet of this number has a tag of another key: programmed with a wrong key, or forged throughout"
_DAMAGED = "the tag does not fit, and the packet differs from an authentic one in a few bits: damaged on the way"


class Verdict(StrEnum):
    """Class of a packet. Only authentic packets contribute a marker's position."""

    AUTHENTIC = "authentic"
    UNAUTHENTICATED = "unauthenticated"
    UNKNOWN_MARKER = "unknown-marker"
    WRONG_KEY = "wrong-key"
    FORGED = "forged"
    UNCHECKED = "unchecked"
    CORRUPT = "corrupt"
    REPLAYED = "replayed"
    OUT_OF_ORDER = "out-of-order"
    DUPLICATE = "duplicate"
    UNDECODABLE = "undecodable"


@dataclass(frozen=True, slots=True)
class VerifiedPacket:
    """A packet and its verdict."""

    packet: ReceivedPacket
    verdict: Verdict
    # of its marker, as sent; only authentic, replayed, out-of-order and duplicate packets have that marker's tag
    number: int | None = None
    # of a payload that can be decoded, whoever sent it; for a packet in clear see `packet.claim`
    message: CerpmMessage | None = None
    reason: str = ""  # why it is not accepted; of an authentic packet, what could not be checked

    @property
    def entry(self) -> int:
        """Row, line or event of the log."""
        return self.packet.entry

    @property
    def accepted(self) -> bool:
        """Whether it contributes its marker's position."""
        return self.verdict is Verdict.AUTHENTIC

    @property
    def signed(self) -> bool:
        """Whether it has the marker's valid tag, fresh or not."""
        return self.verdict in _SIGNED


_SIGNED = frozenset((Verdict.AUTHENTIC, Verdict.REPLAYED, Verdict.OUT_OF_ORDER, Verdict.DUPLICATE))


@dataclass(frozen=True, slots=True)
class Verification:
    """All packets of a log with their verdicts."""

    packets: list[VerifiedPacket]  # in the order they came
    # accepted sequences of each marker, to be stored and passed as `earlier_spans` next time
    spans: dict[int, tuple[SequenceSpan, ...]]
    warnings: list[str]
    invalid_tags: int  # different payloads whose tag was checked and failed: guesses, if they were no accidents

    def counts(self) -> dict[Verdict, int]:
        """Number of packets of each verdict."""
        found = dict.fromkeys(Verdict, 0)
        for packet in self.packets:
            found[packet.verdict] += 1
        return found


def verify_packets(
    packets: Sequence[ReceivedPacket],
    keys: Keys,
    earlier_spans: Mapping[int, Sequence[SequenceSpan]] | None = None,
    rules: FreshnessRules | None = None,
    *,
    max_invalid_tags: int = MAX_INVALID_TAGS_PER_LOG,
) -> Verification:
    """Verify the tags and the freshness of packets.

    Parameters
    ----------
    packets : sequence of ReceivedPacket
        Of one log, in any order.
    keys : callable or mapping
        The key of the marker of a number; None, or no entry, where there is no such marker.
    earlier_spans : mapping of int to sequence of SequenceSpan, optional
        Spans of earlier logs, by number; logs may be uploaded in any order.
    max_invalid_tags : int
        Payloads after this many different ones with an invalid tag are not checked: tags of 32 bits can be guessed if
        somebody may guess often enough.

    Returns
    -------
    Verification

    Raises
    ------
    InvalidParameter
        A key has the wrong length.

    Notes
    -----
    A packet without a time is only accepted above every known sequence, and its freshness stays unknown. A recorded
    packet that was never received before, sent again where no newer packet of its marker is received, cannot be
    distinguished from a fresh one by its bytes; only the vehicle's position can show it (see `merge_markers`).
    """
    rules = rules or FreshnessRules()
    checked, invalid_tags = _check_tags(packets, keys, max_invalid_tags)
    _name_failures(checked)
    by_number: dict[int, list[int]] = defaultdict(list)
    for index, packet in enumerate(checked):
        if packet.accepted and packet.number is not None:
            by_number[packet.number].append(index)
    intervals = LearnedIntervals({n: _sequences_and_times([checked[i] for i in at]) for n, at in by_number.items()})
    spans: dict[int, tuple[SequenceSpan, ...]] = {}
    for number, indices in by_number.items():
        known = tuple((earlier_spans or {}).get(number, ()))
        min_s = intervals.min_s(number) if rules.min_interval_s is None else rules.min_interval_s
        for index, verdict, reason in _check_freshness([checked[i] for i in indices], known, rules, min_s):
            at = indices[index]
            checked[at] = replace(checked[at], verdict=verdict, reason=reason)
        accepted = [checked[i] for i in indices if checked[i].accepted]
        if accepted:
            spans[number] = _spans_of(accepted)
    return Verification(checked, spans, _warnings(checked), invalid_tags)


# --- tags ---------------------------------------------------------------------------------------------------------


def _check_tags(
    packets: Iterable[ReceivedPacket], keys: Keys, max_invalid_tags: int
) -> tuple[list[VerifiedPacket], int]:
    """Verdicts by tags alone, and the number of invalid tags; equal payloads are checked once."""
    find_key = keys.get if isinstance(keys, Mapping) else keys
    known_keys: dict[int, bytes | None] = {}
    seen: dict[bytes, tuple[Verdict, int | None, CerpmMessage | None, str]] = {}
    checked = []
    invalid_tags = 0
    for packet in packets:
        if packet.payload is None:
            checked.append(_in_clear(packet))
            continue
        found = seen.get(packet.payload)
        if found is None:
            found = _check_tag(packet.payload, find_key, known_keys, may_guess=invalid_tags < max_invalid_tags)
            seen[packet.payload] = found
            invalid_tags += found[0] is Verdict.FORGED
        checked.append(VerifiedPacket(packet, *found))
    return checked, invalid_tags


def _in_clear(packet: ReceivedPacket) -> VerifiedPacket:
    if packet.claim is None:
        return VerifiedPacket(packet, Verdict.UNDECODABLE, reason="it has neither a payload nor a position in clear")
    return VerifiedPacket(packet, Verdict.UNAUTHENTICATED, packet.claim.number, reason=_CLEAR)


def _check_tag(
    payload: bytes, find_key: Callable[[int], bytes | None], known_keys: dict[int, bytes | None], *, may_guess: bool
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
    if not may_guess:
        return Verdict.UNCHECKED, number, message, _UNCHECKED
    if has_valid_tag(payload, key):
        return Verdict.AUTHENTIC, number, message, ""
    return Verdict.FORGED, number, message, _FORGED


def _name_failures(checked: list[VerifiedPacket]) -> None:
    """Distinguish damage and wrong keys from forgeries, for people: none of them is accepted."""
    contents: dict[int, int] = {}  # fixed bytes by number, of authentic packets
    tags: dict[bytes, int] = {}  # tags by body, of authentic packets
    failed: dict[tuple[int, bytes], set[int]] = defaultdict(set)  # sequences with an invalid tag
    for packet in checked:
        payload = packet.packet.payload
        if payload is None or packet.number is None or packet.message is None:
            continue
        if packet.accepted:
            contents.setdefault(packet.number, int.from_bytes(payload[:_FIXED_BYTES]))
            tags[payload[:-4]] = int.from_bytes(payload[-4:])
        elif packet.verdict is Verdict.FORGED:
            failed[packet.number, payload[:_FIXED_BYTES]].add(packet.message.sequence)
    for index, packet in enumerate(checked):
        payload = packet.packet.payload
        if packet.verdict is not Verdict.FORGED or payload is None or packet.number is None:
            continue
        if packet.number not in contents:
            if len(failed[packet.number, payload[:_FIXED_BYTES]]) >= _MIN_WRONG_KEY_PACKETS:
                checked[index] = replace(packet, verdict=Verdict.WRONG_KEY, reason=_WRONG_KEY)
        elif _is_damaged(payload, contents[packet.number], tags):
            checked[index] = replace(packet, verdict=Verdict.CORRUPT, reason=_DAMAGED)


def _is_damaged(payload: bytes, content: int, tags: Mapping[bytes, int]) -> bool:
    """Whether a payload differs from an authentic one in a few bits of its fixed bytes or its tag."""
    bits = (int.from_bytes(payload[:_FIXED_BYTES]) ^ content).bit_count()
    if bits:
        return bits <= _MAX_DAMAGED_BITS
    tag = tags.get(payload[:-4])
    return tag is not None and (int.from_bytes(payload[-4:]) ^ tag).bit_count() <= _MAX_DAMAGED_TAG_BITS


# --- freshness ----------------------------------------------------------------------------------------------------


class _Finding(NamedTuple):
    """Verdict on one of a marker's packets, by its row."""

    row: int
    verdict: Verdict
    reason: str


def _check_freshness(
    packets: Sequence[VerifiedPacket], known: Sequence[SequenceSpan], rules: FreshnessRules, min_interval_s: float
) -> list[_Finding]:
    """Verdicts on packets of one marker with its valid tag; fresh packets have none unless their time is unknown."""
    sequences, received_s = _sequences_and_times(packets)
    if not known and _are_plainly_fresh(sequences, received_s, rules, min_interval_s):
        return []
    findings: list[_Finding] = []
    timed = np.isfinite(received_s)
    if rules.uploaded_at_s is not None:
        future = timed & (received_s > rules.uploaded_at_s + rules.clock_tolerance_s)
        for i in np.flatnonzero(future):
            ahead_s = received_s[i] - rules.uploaded_at_s
            findings.append(
                _Finding(int(i), Verdict.OUT_OF_ORDER, f"received {ahead_s:.0f} s after the log was uploaded")
            )
        timed &= ~future
    leaders, echoes = _split_echoes(packets, sequences, received_s, np.flatnonzero(timed), rules)
    findings += echoes
    findings += _check_timed(sequences[leaders], received_s[leaders], leaders, known, rules, min_interval_s)
    highest = max([span.last_sequence for span in known] + [int(sequences[i]) for i in leaders], default=-1)
    return findings + _check_untimed(sequences, np.flatnonzero(np.isnan(received_s)), highest)


def _are_plainly_fresh(sequences: Floats, received_s: Floats, rules: FreshnessRules, min_interval_s: float) -> bool:
    """Whether all packets of a marker that no earlier log knows are fresh, as nearly all are: the checks below find
    nothing then, but take ten times as long for a few packets.
    """
    latest_s = math.inf if rules.uploaded_at_s is None else rules.uploaded_at_s + rules.clock_tolerance_s
    made_before_s, above = math.inf, math.inf
    for sequence, at_s in sorted(zip(sequences.tolist(), received_s.tolist(), strict=True), reverse=True):
        made_s = at_s - sequence * min_interval_s
        if not at_s <= latest_s or sequence == above or not made_s - made_before_s <= rules.log_tolerance_s:
            return False
        made_before_s, above = min(made_before_s, made_s), sequence
    return not math.isinf(made_before_s)


def _sequences_and_times(packets: Sequence[VerifiedPacket]) -> tuple[Floats, Floats]:
    sequences = [packet.message.sequence if packet.message else 0 for packet in packets]
    return np.array(sequences, float), np.array([packet.packet.received_at_s for packet in packets], float)


def _split_echoes(
    packets: Sequence[VerifiedPacket],
    sequences: Floats,
    received_s: Floats,
    among: npt.NDArray[np.intp],
    rules: FreshnessRules,
) -> tuple[npt.NDArray[np.intp], list[_Finding]]:
    """The first reception of each sequence, and verdicts on the others."""
    order = among[np.lexsort((among, received_s[among], sequences[among]))]
    new = np.diff(sequences[order], prepend=-1) > 0
    leaders = order[new]
    findings: list[_Finding] = []
    for i, leader in zip(order[~new], leaders[np.cumsum(new) - 1][~new], strict=True):
        packet, first = packets[i].packet, packets[leader].packet
        after_s = received_s[i] - received_s[leader]
        if packet.payload != first.payload:
            reason = f"another message of the same sequence is entry {first.entry}: two markers have this number"
            findings.append(_Finding(int(i), Verdict.OUT_OF_ORDER, reason))
        elif after_s <= rules.echo_s or (packet.event is not None and packet.event == first.event):
            findings.append(_Finding(int(i), Verdict.DUPLICATE, f"received already as entry {first.entry}"))
        else:
            reason = f"received already {after_s:.0f} s before, as entry {first.entry}"
            findings.append(_Finding(int(i), Verdict.REPLAYED, reason))
    return leaders, findings


def _check_timed(
    sequences: Floats,
    received_s: Floats,
    indices: npt.NDArray[np.intp],
    known: Sequence[SequenceSpan],
    rules: FreshnessRules,
    min_interval_s: float,
) -> list[_Finding]:
    """Verdicts on late and early packets, by the order of their sequences."""
    # a marker may have been programmed to another interval between drives
    before = order_of_spans(known, rules.min_interval_s or FASTEST_INTERVAL_S)
    within = within_spans(known, sequences)
    late_s, early_s = before.late_s(sequences, received_s), before.early_s(sequences, received_s)
    late_here_s = SequenceOrder(sequences, received_s, min_interval_s).late_s(sequences, received_s)
    tolerance_s = rules.clock_tolerance_s + rules.log_tolerance_s
    findings: list[_Finding] = []
    for k in np.flatnonzero((late_s > tolerance_s) | (early_s > tolerance_s) | (late_here_s > rules.log_tolerance_s)):
        index, sequence = int(indices[k]), int(sequences[k])
        if late_s[k] > tolerance_s:
            verdict = Verdict.REPLAYED if within[k] else Verdict.OUT_OF_ORDER
            ago = f"{late_s[k]:.0f} s too late" if math.isfinite(late_s[k]) else "too late, or in a log without times"
            reason = f"sequence {sequence} was sent before another that an earlier drive received: received again {ago}"
        elif early_s[k] > tolerance_s:
            verdict = Verdict.OUT_OF_ORDER
            reason = f"sequence {sequence} is received {early_s[k]:.0f} s before a lower one of another drive"
        else:
            verdict = Verdict.OUT_OF_ORDER
            reason = f"sequence {sequence} is received {late_here_s[k]:.0f} s too late for a higher one of this log"
        findings.append(_Finding(index, verdict, reason))
    return findings


def _check_untimed(sequences: Floats, indices: npt.NDArray[np.intp], highest: int) -> list[_Finding]:
    """Verdicts on packets without times, which are accepted above the highest known sequence."""
    findings: list[_Finding] = []
    seen: set[int] = set()
    for i in indices:
        sequence = int(sequences[i])
        if sequence in seen:
            reason = "this sequence is in the log already; without times no more is known"
            findings.append(_Finding(int(i), Verdict.DUPLICATE, reason))
        elif sequence <= highest:
            reason = f"without a time it must be above sequence {highest}, which is known already; it is {sequence}"
            findings.append(_Finding(int(i), Verdict.OUT_OF_ORDER, reason))
        else:
            findings.append(_Finding(int(i), Verdict.AUTHENTIC, "freshness unknown: the log has no time for it"))
        seen.add(sequence)
    return findings


def _spans_of(accepted: Sequence[VerifiedPacket]) -> tuple[SequenceSpan, ...]:
    """One span of the packets with times, and one of those without."""
    spans = []
    for timed in (True, False):
        group = [p for p in accepted if math.isfinite(p.packet.received_at_s) is timed and p.message is not None]
        if group:
            sequences = [p.message.sequence for p in group if p.message is not None]
            times = [p.packet.received_at_s for p in group] if timed else [math.nan]
            spans.append(SequenceSpan(min(sequences), max(sequences), min(times), max(times)))
    return tuple(spans)


def _warnings(checked: Sequence[VerifiedPacket]) -> list[str]:
    warnings = []
    if unchecked := sum(1 for p in checked if p.verdict is Verdict.UNCHECKED):
        warnings.append(f"{unchecked} packets were not checked, because too many tags before them had failed")
    untimed = sum(1 for p in checked if p.accepted and not math.isfinite(p.packet.received_at_s))
    if not untimed:
        return warnings
    return [
        *warnings,
        f"freshness unknown: {untimed} packets have no time; they are accepted by the order of sequences alone",
    ]
