"""Path loss from packets that were strong enough to be heard, and markers whose radio fails."""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from time import process_time

import numpy as np
import numpy.typing as npt
import pytest
from pydantic import ValidationError

from app.decoders.cerpm.signal import SignalHealth, SignalReport, SignalRules, profile_signals
from app.decoders.cerpm.verify import Verdict, VerifiedPacket
from app.markers.cerpm import CerpmMessage
from app.radio.link import EXPONENT, fit_path_loss
from app.sensors.pose_track import PoseTrack, ReceivedPacket
from tests.decoders.cerpm.payloads import LAT_DEG, LON_DEG, START_S

M_EAST = 1 / (111_320 * math.cos(math.radians(LAT_DEG)))
SENSITIVITY_DBM = -121.0


def drive(
    seed: int,
    *,
    markers: int = 20,
    offset_db: Mapping[int, float] | None = None,
    lost: Mapping[int, float] | None = None,
) -> tuple[list[VerifiedPacket], dict[int, tuple[float, float]], PoseTrack]:
    """Past markers 30 m apart at 15 m/s, a packet of each every 2 s, shadows of 4 dB over 25 m, fading of 2 dB."""
    rng = np.random.default_rng(seed)
    length_m = 30.0 * markers
    time_s = np.arange(-30, length_m / 15 + 30, 0.5)
    nothing = np.full(len(time_s), np.nan)
    track = PoseTrack(START_S + time_s, LON_DEG + 15 * time_s * M_EAST, np.full(len(time_s), LAT_DEG), nothing, nothing)
    packets, places = [], {}
    for number in range(1, markers + 1):
        east_m = 30.0 * number
        places[number] = (LON_DEG + east_m * M_EAST, LAT_DEG + 2e-5)
        shadow = rng.normal()
        for sequence, t in enumerate(np.arange(-29 + rng.uniform(0, 2), time_s[-1] - 1, 2.0)):
            keep = math.exp(-30 / 25)
            shadow = keep * shadow + math.sqrt(1 - keep**2) * rng.normal()
            distance_m = math.hypot(15 * t - east_m, 2.7)
            rssi = -108 - 10 * EXPONENT * math.log10(distance_m / 50) + 4 * shadow + rng.normal(0, 2)
            rssi += (offset_db or {}).get(number, 0.0)
            audible = rng.random() < 1 / (1 + math.exp(-(rssi - SENSITIVITY_DBM)))
            if not audible or rng.random() < (lost or {}).get(number, 0.2):
                continue
            message = CerpmMessage(number, *places[number], sequence=1000 + sequence)
            heard = ReceivedPacket(len(packets), START_S + float(t), b"", rssi_dbm=float(round(rssi)))
            packets.append(VerifiedPacket(heard, Verdict.AUTHENTIC, number, message))
    return packets, places, track


def health(report: SignalReport) -> dict[int, SignalHealth]:
    """Of each marker."""
    return {number: profile.health for number, profile in report.profiles.items()}


def sample(rng: np.random.Generator, count: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Distances up to 500 m, and strengths of what is heard of packets there."""
    distance = rng.uniform(5, 500, count)
    rssi = np.round(-108 - 10 * EXPONENT * np.log10(distance / 50) + rng.normal(0, 4.5, count))
    heard = rng.random(count) < 1 / (1 + np.exp(-(rssi - SENSITIVITY_DBM)))
    return distance[heard], rssi[heard]


def test_the_papers_line() -> None:
    assert pytest.approx(2.04, abs=0.005) == EXPONENT


def test_weak_packets_that_are_never_heard_do_not_flatten_the_line() -> None:
    rng = np.random.default_rng(1003)
    distance, rssi = sample(rng, 1500)
    line = fit_path_loss(distance, rssi, rng.integers(0, 30, len(rssi)))
    assert line is not None
    slope = -np.polyfit(10 * np.log10(distance / 50), rssi, 1)[0]
    assert slope < EXPONENT - 0.3  # least squares
    assert line.exponent.value == pytest.approx(EXPONENT, abs=0.2)
    assert line.exponent.low < EXPONENT < line.exponent.high
    assert line.level_at_50m_dbm.low < -108 < line.level_at_50m_dbm.high
    assert line.level_at_50m_dbm.high - line.level_at_50m_dbm.low < 3
    assert line.spread_db == pytest.approx(4.5, abs=0.6)
    assert line.sensitivity_dbm == pytest.approx(SENSITIVITY_DBM, abs=1.5)
    assert line.at_1m_dbm == pytest.approx(-108 + 10 * EXPONENT * math.log10(50), abs=4)


def test_strays_do_not_move_the_line() -> None:
    rng = np.random.default_rng(1004)
    distance, rssi = sample(rng, 800)
    rssi[::60] = -60
    line = fit_path_loss(distance, rssi, rng.integers(0, 30, len(rssi)), SENSITIVITY_DBM)
    assert line is not None
    assert line.exponent.value == pytest.approx(EXPONENT, abs=0.3)
    assert line.level_at_50m_dbm.value == pytest.approx(-108, abs=1.2)


def test_intervals_hold_what_they_promise() -> None:
    held = np.zeros(2)
    for seed in range(1100, 1140):
        packets, places, track = drive(seed, markers=12)
        line = profile_signals(packets, places, track).path_loss
        assert line is not None
        held += [
            line.level_at_50m_dbm.low <= -108 <= line.level_at_50m_dbm.high,
            line.exponent.low <= EXPONENT <= line.exponent.high,
        ]
    assert (held >= 35).all()  # 38 of 40 are promised


def test_a_sensitivity_that_cannot_be_told_does_not_run_away() -> None:
    packets, places, track = drive(1302)  # it did, to 4040 dBm
    line = profile_signals(packets, places, track).path_loss
    assert line is not None
    assert line.level_at_50m_dbm.value == pytest.approx(-108, abs=3)


def test_distances_that_are_all_alike_tell_no_exponent() -> None:
    rng = np.random.default_rng(1005)
    line = fit_path_loss(rng.uniform(95, 105, 60), rng.normal(-114, 3, 60), np.arange(60) // 6)
    assert line is not None
    assert not line.fitted_exponent
    assert line.exponent.value == EXPONENT
    assert line.level_at_50m_dbm.value == pytest.approx(-108, abs=2)
    assert fit_path_loss(np.full(19, 50.0), np.full(19, -108.0), np.zeros(19)) is None


def test_profiles_tell_distances_and_deliveries() -> None:
    packets, places, track = drive(1006)
    report = profile_signals(packets, places, track)
    profile = report.profiles[10]
    assert profile.compared_with == "fleet"
    assert len(profile.distance_m) == profile.received
    assert profile.nearest_m < 40
    assert 150 < profile.farthest_m < 700
    assert profile.delivery is not None
    assert profile.expected > profile.received
    assert profile.delivery.low < profile.received / profile.expected < profile.delivery.high
    levels = [profile.level_db for profile in report.profiles.values() if profile.level_db]
    assert len(levels) == 20
    assert sum(level.low < 0 < level.high for level in levels) >= 18
    assert "level" in profile.reason
    assert "transmissions" in profile.reason


def test_healthy_markers_are_not_accused_and_weak_ones_are_found() -> None:
    accused = found = 0
    for seed in range(1200, 1210):
        packets, places, track = drive(seed, offset_db={5: -14.0, 15: -18.0})
        verdicts = health(profile_signals(packets, places, track))
        found += sum(verdicts.get(n) in (SignalHealth.WEAK, SignalHealth.FAILING) for n in (5, 15))
        accused += sum(
            verdict in (SignalHealth.WEAK, SignalHealth.FAILING) for n, verdict in verdicts.items() if n not in (5, 15)
        )
    assert accused <= 2  # of 180
    assert found >= 12  # of 20; of the others too little was heard


def test_a_marker_that_skips_transmissions_is_found() -> None:
    skipping, fleet = [], []
    for seed in range(1400, 1405):
        packets, places, track = drive(seed, lost={7: 0.85})
        for number, profile in profile_signals(packets, places, track).profiles.items():
            if profile.delivery is not None:
                (skipping if number == 7 else fleet).append(profile.delivery.value)
    assert np.mean(skipping) < 0.6 * np.mean(fleet)


def test_without_a_track_only_deliveries_are_known() -> None:
    packets, places, _track = drive(1011)
    report = profile_signals(packets, places, None)
    assert report.path_loss is None
    profile = report.profiles[3]
    assert profile.level_db is None
    assert math.isnan(profile.farthest_m)
    assert profile.delivery is not None


def test_one_marker_is_held_against_the_paper() -> None:
    packets, places, track = drive(1012, markers=1, offset_db={1: 1.0})
    profile = profile_signals(packets, places, track).profiles[1]
    assert profile.compared_with == "paper"
    assert profile.health in (SignalHealth.HEALTHY, SignalHealth.NOT_ENOUGH_DATA)


def test_few_packets_are_no_verdict() -> None:
    packets, places, track = drive(1013)
    some = [p for p in packets if p.number == 4][:3]
    assert health(profile_signals(some, places, track)) == {4: SignalHealth.NOT_ENOUGH_DATA}
    assert profile_signals([], {}, track).profiles == {}


def test_two_passes_an_hour_apart_are_not_one_of_losses() -> None:
    packets, places, _track = drive(1014)
    shift = [
        VerifiedPacket(
            ReceivedPacket(p.entry, p.packet.received_at_s + 3600, b"", rssi_dbm=p.packet.rssi_dbm),
            Verdict.AUTHENTIC, p.number,
            CerpmMessage(p.number or 1, LON_DEG, LAT_DEG, sequence=p.message.sequence + 1800),
        )
        for p in packets if p.message
    ]  # fmt: skip
    once, twice = profile_signals(packets, places, None), profile_signals(packets + shift, places, None)
    assert twice.profiles[10].expected == 2 * once.profiles[10].expected


def test_packets_without_a_strength_or_that_are_not_accepted() -> None:
    packets, places, track = drive(1015)
    silent = [
        VerifiedPacket(ReceivedPacket(0, p.packet.received_at_s, b""), p.verdict, p.number, p.message) for p in packets
    ]
    report = profile_signals(silent, places, track)
    assert report.path_loss is None
    assert report.profiles[2].farthest_m > 0
    refused = [VerifiedPacket(p.packet, Verdict.REPLAYED, p.number, p.message) for p in packets]
    assert profile_signals(refused, places, track).profiles == {}


def with_times(packets: list[VerifiedPacket], changed: Mapping[int, float]) -> list[VerifiedPacket]:
    """The packets with other times of reception, by index."""
    return [
        replace(p, packet=replace(p.packet, received_at_s=changed[i])) if i in changed else p
        for i, p in enumerate(packets)
    ]


@pytest.mark.parametrize("off_s", [-1024 * 7 * 86400.0, 1024 * 7 * 86400.0, 1e17, 1e300])
@pytest.mark.parametrize("which", ["first", "middle", "last"])
def test_a_clock_that_is_years_off_adds_no_transmissions(off_s: float, which: str) -> None:
    packets, places, track = drive(1016, markers=8)
    own = [i for i, p in enumerate(packets) if p.number == 4]
    at = {"first": own[0], "middle": own[len(own) // 2], "last": own[-1]}[which]
    honest = profile_signals(packets, places, track)
    spoilt = with_times(packets, {at: packets[at].packet.received_at_s + off_s})
    with memory_limit(200_000_000):
        found = profile_signals(spoilt, places, track)
    assert found.profiles.keys() == honest.profiles.keys()
    for number in set(places) - {4}:
        level, before = found.profiles[number].level_db, honest.profiles[number].level_db
        assert level is not None
        assert before is not None
        assert level.value == pytest.approx(before.value, abs=1.0)
    assert found.profiles[4].health in (SignalHealth.HEALTHY, SignalHealth.NOT_ENOUGH_DATA)


def test_a_sequence_that_jumps_by_billions_adds_no_transmissions() -> None:
    packets, places, track = drive(1017, markers=8)
    last = max(i for i, p in enumerate(packets) if p.number == 4)
    message = packets[last].message
    assert message is not None
    spoilt = list(packets)
    spoilt[last] = replace(packets[last], message=replace(message, sequence=4_000_000_000))
    with memory_limit(200_000_000):
        assert profile_signals(spoilt, places, track).profiles.keys() == places.keys()


@contextmanager
def memory_limit(limit: int) -> Iterator[None]:
    """Fail where more bytes than the limit are in use at a time."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < limit


def test_rules_are_checked() -> None:
    for values in ({"weak_db": 1.0}, {"failing_db": -3.0}, {"weak_share": 0.1}, {"failing_share": 0.0}):
        with pytest.raises(ValidationError):
            SignalRules(**values)


def test_many_packets_take_seconds() -> None:
    rng = np.random.default_rng(1016)
    distance, rssi = sample(rng, 100_000)
    began = process_time()
    assert fit_path_loss(distance, rssi, np.sort(rng.integers(0, 500, len(rssi)))) is not None
    assert process_time() - began < 5
