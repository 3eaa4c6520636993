"""Authentic, fresh packets told from all others."""

from __future__ import annotations

import math
from dataclasses import replace
from time import process_time

import numpy as np
import pytest
from pydantic import ValidationError

from app.decoders.cerpm.verify import FreshnessRules, SequenceSpan, Verdict, Verification, verify_packets
from app.sensors.pose_track import PlainClaim, ReceivedPacket
from tests.decoders.cerpm.payloads import LAT_DEG, LON_DEG, START_S, body, heard, key_of, signed

KEYS = {number: key_of(number) for number in range(1, 41)}
DAY_S = 86_400.0


def verdicts(packets: list[ReceivedPacket], **given: object) -> list[Verdict]:
    """Of each packet."""
    return [p.verdict for p in verify_packets(packets, KEYS, **given).packets]  # type: ignore[arg-type]


def drive(
    start_s: float, first: int, *, count: int = 20, number: int = 7, interval_s: float = 1.0
) -> list[ReceivedPacket]:
    """An honest drive past one marker."""
    return [heard(first + i, start_s + i * interval_s, number, entry=i) for i in range(count)]


def test_an_honest_drive_is_accepted_and_its_span_kept() -> None:
    found = verify_packets(drive(0, 100), KEYS)
    assert {p.verdict for p in found.packets} == {Verdict.AUTHENTIC}
    assert found.spans == {7: (SequenceSpan(100, 119, START_S, START_S + 19),)}
    assert found.packets[3].message is not None
    assert found.packets[3].message.sequence == 103


def test_what_is_not_signed_is_named() -> None:
    good = signed(body(3, sequence=5))
    cases = {
        Verdict.UNAUTHENTICATED: ReceivedPacket(0, START_S, claim=PlainClaim(3, LON_DEG, LAT_DEG)),
        Verdict.UNKNOWN_MARKER: ReceivedPacket(1, START_S, signed(body(4000))),
        Verdict.FORGED: ReceivedPacket(2, START_S, body(4) + b"\0\0\0\1"),
        Verdict.CORRUPT: ReceivedPacket(3, START_S, good[:7] + bytes([good[7] ^ 0x21]) + good[8:]),
        Verdict.AUTHENTIC: ReceivedPacket(4, START_S, good),
        Verdict.UNDECODABLE: ReceivedPacket(5, START_S, good[:23]),
    }
    found = verify_packets(list(cases.values()), KEYS)
    assert [p.verdict for p in found.packets] == list(cases)
    assert all(p.reason for p in found.packets if not p.accepted)
    assert set(found.spans) == {3}


def test_impossible_values_and_a_turned_tag_are_damage() -> None:
    good = signed(body(3, sequence=5))
    turned = good[:-1] + bytes([good[-1] ^ 4])
    nowhere = signed(body(3, lon_deg=200.0, sequence=6))
    packets = [ReceivedPacket(i, START_S + i, p) for i, p in enumerate((good, turned, nowhere))]
    assert verdicts(packets) == [Verdict.AUTHENTIC, Verdict.CORRUPT, Verdict.CORRUPT]


def test_a_marker_with_another_key_is_named_as_that() -> None:
    packets = [ReceivedPacket(i, START_S + i, signed(body(5, sequence=i), key_of(99))) for i in range(4)]
    assert verdicts(packets) == [Verdict.WRONG_KEY] * 4
    assert verdicts(packets[:2]) == [Verdict.FORGED] * 2


def test_nothing_is_checked_after_too_many_invalid_tags() -> None:
    """Otherwise one log could try all 2^32 tags. Equal payloads are one guess; other verdicts are none."""
    guesses = [ReceivedPacket(i, START_S + i, body(4, sequence=i) + b"\0\0\0\1") for i in range(4)]
    unknown = ReceivedPacket(9, START_S + 9, signed(body(4000)))
    honest = drive(20, 100, count=2)
    found = verify_packets([guesses[0], *guesses[:3], unknown, *honest, guesses[3]], KEYS, max_invalid_tags=3)
    expected = [*[Verdict.FORGED] * 4, Verdict.UNKNOWN_MARKER, *[Verdict.UNCHECKED] * 3]
    assert [p.verdict for p in found.packets] == [
        Verdict.WRONG_KEY if verdict is Verdict.FORGED else verdict for verdict in expected
    ]
    assert (found.invalid_tags, found.spans) == (3, {})
    assert found.warnings == ["3 packets were not checked, because too many tags before them had failed"]
    assert not any(p.accepted or p.signed for p in found.packets)
    found = verify_packets([*guesses, *honest], KEYS, max_invalid_tags=5)
    assert (found.invalid_tags, found.counts()[Verdict.AUTHENTIC]) == (4, 2)
    assert verify_packets(honest, KEYS, max_invalid_tags=1).invalid_tags == 0


def test_disorder_and_echoes_cost_nothing() -> None:
    packets = drive(0, 100)
    echoes = [replace(p, received_at_s=p.received_at_s + 1.5, entry=50 + p.entry) for p in packets[::4]]
    mixed = packets + echoes
    np.random.default_rng(3).shuffle(mixed)  # type: ignore[arg-type]
    found = verify_packets(mixed, KEYS)
    assert found.counts()[Verdict.AUTHENTIC] == 20
    assert found.counts()[Verdict.DUPLICATE] == 5
    assert all(p.entry >= 50 for p in found.packets if p.verdict is Verdict.DUPLICATE)


def test_the_same_sequence_again_is_a_replay_unless_it_is_the_same_uplink() -> None:
    first = replace(heard(100, 0), event="uplink-1")
    again = replace(first, received_at_s=first.received_at_s + 40)
    other = replace(again, event="uplink-2")
    assert verdicts([first, again]) == [Verdict.AUTHENTIC, Verdict.DUPLICATE]
    assert verdicts([first, other]) == [Verdict.AUTHENTIC, Verdict.REPLAYED]


def test_an_older_one_heard_after_a_newer_one_is_not_used() -> None:
    packets = [*drive(0, 100), heard(90, 5, entry=99)]  # sequence 90 was lost on the way, and played later
    found = verify_packets(packets, KEYS)
    assert found.packets[-1].verdict is Verdict.OUT_OF_ORDER
    assert found.counts()[Verdict.AUTHENTIC] == 20


def test_a_recorded_one_played_before_the_first_honest_one_came_too_late() -> None:
    recorded = heard(100, 995, entry=0)  # 900 transmissions before the honest ones take longer than 5 s
    honest = drive(1000, 1000)
    assert verdicts([recorded, *honest])[0] is Verdict.OUT_OF_ORDER
    sharper = FreshnessRules(min_interval_s=0.5)
    assert verdicts([heard(980, 995), *honest], rules=sharper)[0] is Verdict.OUT_OF_ORDER
    assert verdicts([heard(998, 998), *honest], rules=sharper) == [Verdict.AUTHENTIC] * 21


def fleet(
    start_s: float, first: int, numbers: range, *, interval_s: float = 2.0, count: int = 6
) -> list[ReceivedPacket]:
    """An honest drive past several markers, whose transmissions are up to 10 % early or late."""
    rng = np.random.default_rng(first)
    return [
        heard(first + i, start_s + (i + rng.uniform(-0.1, 0.1)) * interval_s, number)
        for number in numbers
        for i in range(count)
    ]


def test_the_interval_in_a_log_shows_what_was_recorded_and_sent_again() -> None:
    honest = fleet(100, 1000, range(1, 9))
    # sent 100 times before the first honest one, so 200 s before, and heard 60 s before it
    late = [heard(900, 40, number) for number in (1, 5)]
    found = verdicts([*late, *honest])
    assert found[:2] == [Verdict.OUT_OF_ORDER] * 2
    assert set(found[2:]) == {Verdict.AUTHENTIC}
    assert verdicts([*late, *honest[:12]])[:1] == [Verdict.AUTHENTIC]  # of two markers the interval does not show


def test_a_flood_of_replays_costs_no_honest_packet() -> None:
    rng = np.random.default_rng(1008)
    honest = fleet(100, 1000, range(1, 9))
    flood = [heard(int(rng.integers(0, 999)), rng.uniform(95, 115), int(rng.integers(1, 9))) for _ in range(400)]
    found = verdicts([*honest, *flood])
    assert set(found[: len(honest)]) == {Verdict.AUTHENTIC}


def test_markers_of_other_intervals_are_no_replays() -> None:
    slow = fleet(100, 1000, range(1, 9), interval_s=20.0)
    fast = fleet(105, 5000, range(9, 10), interval_s=1.0, count=30)
    few = [heard(7000, 110, 10), heard(7010, 120, 10)]
    assert set(verdicts([*slow, *fast, *few])) == {Verdict.AUTHENTIC}


def test_a_replay_on_another_day_is_known_from_the_spans() -> None:
    first = verify_packets(drive(0, 100), KEYS)
    spans = {number: list(kept) for number, kept in first.spans.items()}
    replays = [replace(p, received_at_s=p.received_at_s + DAY_S) for p in drive(0, 100)]
    lost = heard(110, DAY_S)
    earlier = heard(99, DAY_S)
    fresh = drive(DAY_S, 80_000)
    assert verdicts(replays, earlier_spans=spans) == [Verdict.REPLAYED] * 20
    assert verdicts([lost, earlier], earlier_spans=spans) == [Verdict.REPLAYED, Verdict.OUT_OF_ORDER]
    assert verdicts(fresh, earlier_spans=spans) == [Verdict.AUTHENTIC] * 20


def test_a_late_log_fits_between_those_that_came_before_it() -> None:
    spans = {
        7: [
            SequenceSpan(100, 120, START_S, START_S + 20),
            SequenceSpan(5000, 5020, START_S + DAY_S, START_S + DAY_S + 20),
        ]
    }
    assert verdicts(drive(3600, 2000), earlier_spans=spans) == [Verdict.AUTHENTIC] * 20
    assert verdicts(drive(-3600, 50, count=1), earlier_spans=spans) == [Verdict.AUTHENTIC]
    assert verdicts(drive(2 * DAY_S, 4000), earlier_spans=spans) == [Verdict.OUT_OF_ORDER] * 20
    assert verdicts(drive(-3600, 4000), earlier_spans=spans) == [Verdict.OUT_OF_ORDER] * 20


@pytest.mark.parametrize("offset_s", [-30.0, 30.0])
def test_clocks_may_differ_between_drives(offset_s: float) -> None:
    spans = verify_packets([replace(p, received_at_s=p.received_at_s - offset_s) for p in drive(0, 100)], KEYS).spans
    beside = [replace(p, received_at_s=p.received_at_s + offset_s) for p in drive(0.2, 100, interval_s=0.99)]
    assert verdicts(beside, earlier_spans=spans) == [Verdict.AUTHENTIC] * 20


def test_the_same_log_again_is_read_again() -> None:
    spans = verify_packets(drive(0, 100), KEYS).spans
    assert verdicts(drive(0, 100), earlier_spans=spans) == [Verdict.AUTHENTIC] * 20


def test_without_times_only_what_is_above_all_known_is_accepted() -> None:
    packets = [replace(p, received_at_s=math.nan) for p in drive(0, 100)]
    found = verify_packets([*packets, packets[0]], KEYS, {7: [SequenceSpan(1, 104, START_S, START_S)]})
    assert [p.verdict for p in found.packets] == [Verdict.OUT_OF_ORDER] * 5 + [Verdict.AUTHENTIC] * 15 + [
        Verdict.DUPLICATE
    ]
    assert "freshness unknown" in found.packets[10].reason
    assert "freshness unknown" in found.warnings[0]
    (span,) = found.spans[7]
    assert (span.first_sequence, span.last_sequence) == (105, 119)
    assert math.isnan(span.last_heard_s)
    assert verdicts(drive(DAY_S, 110), earlier_spans=found.spans) == [Verdict.REPLAYED] * 10 + [Verdict.AUTHENTIC] * 10


def test_nothing_is_heard_after_its_upload() -> None:
    rules = FreshnessRules(uploaded_at_s=START_S + 10)
    assert verdicts([heard(1, 0), heard(2, 3600)], rules=rules) == [Verdict.AUTHENTIC, Verdict.OUT_OF_ORDER]


def test_two_markers_of_one_number_are_seen_by_their_messages() -> None:
    other = heard(103, 3, payload=signed(body(7, LON_DEG + 1e-3, sequence=103)), entry=77)
    found = verify_packets([*drive(0, 100), other], KEYS)
    assert found.packets[-1].verdict is Verdict.OUT_OF_ORDER
    assert "two markers" in found.packets[-1].reason


def test_ten_thousand_forged_and_replayed_packets_are_all_refused_and_no_honest_one() -> None:
    rng = np.random.default_rng(1007)
    spans: dict[int, list[SequenceSpan]] = {}
    refused = honest = 0
    recorded: list[ReceivedPacket] = []
    for day in range(5):
        clock_s = day * 3600 + rng.uniform(-30, 30)
        log = [
            heard(1000 + 3600 * day + i, clock_s + i + rng.uniform(0, 0.5), number)
            for number in range(1, 41)
            for i in range(30)
            if rng.random() > 0.3
        ]
        attack = [_forgery(rng, clock_s) for _ in range(1000)]
        attack += [_replay(rng, recorded or log, clock_s, day > 0) for _ in range(1000)]
        mixed = [replace(p, entry=i) for i, p in enumerate(log + attack)]
        rng.shuffle(mixed)  # type: ignore[arg-type]
        found = verify_packets(mixed, KEYS, spans, max_invalid_tags=10_000)
        refused += sum(1 for p in found.packets if p.entry >= len(log) and not p.accepted)
        honest += sum(1 for p in found.packets if p.entry < len(log) and not p.accepted)
        for number, kept in found.spans.items():
            spans.setdefault(number, []).extend(kept)
        recorded += log
    assert refused == 10_000
    assert honest == 0


def _forgery(rng: np.random.Generator, clock_s: float) -> ReceivedPacket:
    content = body(int(rng.integers(1, 41)), LON_DEG + 3e-4, sequence=int(rng.integers(0, 2**32)))
    return ReceivedPacket(0, START_S + clock_s + rng.uniform(0, 30), content + rng.bytes(4))


def _replay(rng: np.random.Generator, recorded: list[ReceivedPacket], clock_s: float, old: bool) -> ReceivedPacket:
    packet = recorded[int(rng.integers(len(recorded)))]
    at_s = START_S + clock_s + rng.uniform(0, 30) if old else packet.received_at_s + rng.uniform(0.1, 100)
    return replace(packet, received_at_s=at_s)


def test_a_long_log_takes_seconds() -> None:
    packets = [heard(i // 40, i / 40, 1 + i % 40, entry=i) for i in range(20_000)]
    began = process_time()
    found = verify_packets(packets, KEYS, {})
    assert process_time() - began < 5
    assert found.counts()[Verdict.AUTHENTIC] == 20_000


@pytest.mark.parametrize("name", ["clock_tolerance_s", "echo_s", "min_interval_s", "uploaded_at_s"])
def test_rules_are_checked(name: str) -> None:
    for value in (-1.0, math.nan, math.inf):
        with pytest.raises(ValidationError, match=name):
            FreshnessRules(**{name: value})


def test_an_empty_log_is_a_result() -> None:
    assert verify_packets([], lambda number: None) == Verification([], {}, [], 0)
