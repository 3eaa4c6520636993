"""The link against the paper's two points, against ALOHA's closed form, and against collisions counted by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.radio.settings import Slots
from app.simulation.radio.link import Radio, draw_shadows_db, mean_rssi_dbm, receive_transmissions, send_beacons

LOUD_DBM = -80.0


def test_strength_at_the_papers_two_places() -> None:
    assert mean_rssi_dbm([50.0, 340.0]) == pytest.approx([-108.0, -125.0], abs=1e-9)
    assert mean_rssi_dbm(100.0) - mean_rssi_dbm(200.0) == pytest.approx(20.4 * math.log10(2), abs=0.02)


@pytest.mark.parametrize(
    ("count", "interval_s", "bandwidth_hz", "published"),
    [(20, 2.0, 125_000, 0.26), (100, 10.0, 125_000, 0.26), (20, 2.0, 500_000, 0.72), (50, 2.0, 500_000, 0.43)],
)
def test_losses_are_alohas_where_nothing_captures(
    count: int, interval_s: float, bandwidth_hz: int, published: float
) -> None:
    """exp(-2 N ToA / T) of reference/formats.md, 27 bytes at SF7."""
    radio = Radio(7, bandwidth_hz, interval_s, payload_bytes=27, lock_symbols=12.25, capture_db=math.inf)
    rates, spans = [], 40
    for k in range(12):
        rng = np.random.default_rng(1500 + k)
        sent = send_beacons(count, radio, 0.0, spans * interval_s, rng)
        heard = receive_transmissions(sent.start_s, np.full(len(sent.start_s), LOUD_DBM), radio, rng)
        rates.append(heard.mean())
    load = 2 * radio.airtime_s / interval_s
    assert np.mean(rates) == pytest.approx((1 - load) ** (count - 1), abs=0.03)
    assert np.mean(rates) == pytest.approx(published, abs=0.05)


def test_capture_and_the_preambles_spare_symbols_lose_less() -> None:
    rng = np.random.default_rng(1600)
    base = Radio(7, 500_000, 2.0)
    sent = send_beacons(60, base, 0.0, 200.0, rng)
    strength = rng.normal(-90, 8, len(sent.start_s))

    def rate(radio: Radio) -> float:
        return float(receive_transmissions(sent.start_s, strength, radio, np.random.default_rng(1)).mean())

    hard = rate(Radio(7, 500_000, 2.0, lock_symbols=12.25, capture_db=math.inf))
    spare = rate(Radio(7, 500_000, 2.0, capture_db=math.inf))
    captured = rate(base)
    assert hard < spare - 0.02
    assert spare < captured - 0.03
    assert captured < 0.95


def _heard(starts: list[float], strengths: list[float], radio: Radio | None = None) -> list[bool]:
    heard = receive_transmissions(
        np.array(starts), np.array(strengths), radio or Radio(10, 125_000, 5.0), np.random.default_rng(0)
    )
    return [bool(h) for h in heard]


def test_two_that_overlap() -> None:
    """SF10 at 125 kHz: 412 ms on air, symbols of 8.2 ms, of a preamble of 12.25 the last five are needed."""
    radio = Radio(10, 125_000, 5.0)
    air, spare = radio.airtime_s, radio.spare_s
    assert spare == pytest.approx(7.25 * 0.008192)
    assert _heard([0.0, air + 0.001], [-90, -90]) == [True, True]
    assert _heard([0.0, air / 2], [-90, -90]) == [False, False]
    assert _heard([0.0, air / 2], [-83.9, -90]) == [True, False]  # 6 dB above: read through the other
    assert _heard([0.0, air / 2], [-90, -80]) == [False, False]  # locked on the weak one, which the strong one takes
    assert _heard([0.0, spare / 2], [-90, -80]) == [False, True]  # strong enough before the lock
    assert _heard([0.0, air - spare / 2], [-90, -90]) == [False, True]  # only spare preamble is hit
    assert _heard([0.0, air - spare / 2], [-90, -97]) == [True, True]


def test_others_add_up() -> None:
    assert _heard([0.0, 0.2, 0.21], [-83, -90, -90]) == [False, False, False]  # 7 dB above each, 4 above both
    assert _heard([0.0, 0.2, 0.21], [-80, -90, -90]) == [True, False, False]


def test_the_receiver_is_deaf_below_its_sensitivity() -> None:
    radio = Radio(7, 500_000, 2.0)
    rng = np.random.default_rng(1700)
    start = np.arange(2000) * 1.0
    for over_db, low, high in ((-2, 0, 0.02), (0, 0.45, 0.55), (2, 0.98, 1)):
        heard = receive_transmissions(start, np.full(2000, radio.sensitivity_dbm + over_db), radio, rng)
        assert low <= heard.mean() <= high


def test_too_weak_to_be_read_still_disturbs() -> None:
    radio = Radio(7, 500_000, 2.0)
    weak = radio.sensitivity_dbm - 6
    assert _heard([0.0, 0.005], [radio.sensitivity_dbm + 3, weak], radio)[0]
    assert not _heard([0.0, 0.005], [radio.sensitivity_dbm + 3, weak + 5], radio)[0]


def test_markers_send_once_an_interval_and_count_on() -> None:
    radio = Radio(interval_s=2.0, jitter=0.1)
    sent = send_beacons(30, radio, 100.0, 200.0, np.random.default_rng(1800))
    assert (np.diff(sent.start_s) >= 0).all()
    for one in range(30):
        mine = sent.sender == one
        assert mine.sum() in (49, 50, 51)
        gaps = np.diff(sent.start_s[mine])
        assert gaps.min() > 1.6 - 1e-9
        assert gaps.max() < 2.4 + 1e-9
        assert gaps.mean() == pytest.approx(2.0, abs=0.02)
        assert (np.diff(sent.sequence[mine]) == 1).all()


def test_shadows_have_their_deviation_and_length() -> None:
    radio = Radio(shadow_sd_db=4.0, shadow_length_m=25.0)
    sender, travelled = np.repeat(np.arange(400), 2), np.tile([0.0, 25.0], 400)
    shadows = draw_shadows_db(sender, travelled, radio, np.random.default_rng(1900)).reshape(400, 2)
    assert shadows.std() == pytest.approx(4.0, rel=0.08)
    assert np.corrcoef(shadows.T)[0, 1] == pytest.approx(math.exp(-1), abs=0.12)


@pytest.mark.parametrize(
    "how", [{"spreading_factor": 6}, {"bandwidth_hz": 62_500}, {"interval_s": 0.01}, {"jitter": 0.6}]
)
def test_radios_that_cannot_be_are_refused(how: dict[str, float]) -> None:
    with pytest.raises(InvalidParameter):
        Radio(**how)  # type: ignore[arg-type]


# --- channels and slots -------------------------------------------------------------------------------------------


SLOTTED = Radio(7, 125_000, 1.0, channels=4, slots=Slots(1.0, 0.066, 4))


def test_in_slots_no_two_packets_meet_on_a_channel_unless_clocks_are_wrong() -> None:
    for clock_sd_s, meets in ((0.0, False), (0.02, True)):
        radio = replace(SLOTTED, clock_sd_s=clock_sd_s)
        sent = send_beacons(60, radio, 1000.0, 1030.0, np.random.default_rng(4))
        assert len(sent.start_s) == pytest.approx(60 * 30, abs=60)
        assert (np.diff(sent.start_s) >= 0).all()
        overlaps = sum(
            int((np.diff(sent.start_s[sent.channel == one]) < radio.airtime_s - 1e-9).sum()) for one in range(4)
        )
        assert (overlaps > 0) is meets
        for one in range(60):
            mine = sent.start_s[sent.sender == one]
            assert np.diff(mine) == pytest.approx(1.0)
            assert (np.diff(sent.sequence[sent.sender == one]) == 1).all()


def test_one_receiver_for_each_channel_reads_what_one_alone_loses() -> None:
    radio = Radio(10, 125_000, 5.0)
    start, strength = np.array([0.0, 0.05, 0.1]), np.full(3, LOUD_DBM)
    together = receive_transmissions(start, strength, radio, np.random.default_rng(0))
    apart = receive_transmissions(start, strength, radio, np.random.default_rng(0), np.array([0, 1, 2]))
    assert not together.any()
    assert apart.all()


def test_packets_hop_evenly_over_channels() -> None:
    sent = send_beacons(100, Radio(7, 500_000, 1.0, channels=5), 0.0, 100.0, np.random.default_rng(5))
    assert np.abs(np.bincount(sent.channel, minlength=5) / len(sent.channel) - 0.2).max() < 0.03


def test_another_modulation_has_its_own_airtime_and_sensitivity() -> None:
    radio = Radio(interval_s=10.0, other_airtime_s=0.4, other_sensitivity_dbm=-100.0)
    assert (radio.airtime_s, radio.sensitivity_dbm) == (0.4, -100.0)
    heard = receive_transmissions(np.array([0.0, 5.0]), np.array([-104.0, -96.0]), radio, np.random.default_rng(0))
    assert heard.tolist() == [False, True]
