"""What a drive past markers hears, and what forgers and faults make of it."""

from __future__ import annotations

import numpy as np
import pytest

from app.encoders.cerpm import encode_message
from app.errors import InvalidParameter
from app.markers.cerpm import BODY_BYTES, CerpmMessage, SpeedLimit, SpeedUnit, message_tag
from app.planning.cerpm_placement import place_markers
from app.simulation.radio.attacks import (
    corrupt_packets,
    forge_packets,
    move_claim,
    number_entries,
    repeat_packets,
    replay_packets,
    shift_clock,
    shuffle_packets,
)
from app.simulation.radio.drive import SimulatedDrive, drive_past
from app.simulation.radio.lanes import InstalledMarkers, TrueLane, install_markers, make_lane
from app.simulation.radio.link import Radio

LIMIT = SpeedLimit(25, SpeedUnit.MPH)


def _key(number: int) -> bytes:
    return number.to_bytes(16)


def _sign(message: CerpmMessage) -> bytes:
    return encode_message(message, _key(message.number))


@pytest.fixture(scope="module")
def lane() -> TrueLane:
    return make_lane(np.random.default_rng(1010))


@pytest.fixture(scope="module")
def installed(lane: TrueLane) -> InstalledMarkers:
    return install_markers(
        lane, place_markers(lane.left_m, lane.right_m), np.random.default_rng(1011), speed_limit=LIMIT
    )


@pytest.fixture(scope="module")
def heard(lane: TrueLane, installed: InstalledMarkers) -> SimulatedDrive:
    return drive_past(lane, installed, np.random.default_rng(1012), sign=_sign)


def test_every_packet_is_a_signed_message_of_its_marker(heard: SimulatedDrive, installed: InstalledMarkers) -> None:
    assert len(heard.packets) > 2 * len(installed)
    for packet, row in zip(heard.packets, heard.sender, strict=True):
        assert packet.payload is not None
        number = int(installed.number[row])
        assert int.from_bytes(packet.payload[1:5]) == number
        assert packet.payload[BODY_BYTES:] == message_tag(_key(number), packet.payload[:BODY_BYTES])
        assert int.from_bytes(packet.payload[5:9], signed=True) == round(installed.lon_deg[row] * 1e7)
        assert packet.payload[15] == 25
    assert (heard.sent.sender[heard.transmission] == heard.sender).all()
    ended_s = heard.sent.start_s[heard.transmission] + Radio().airtime_s
    assert ended_s == pytest.approx([p.received_at_s for p in heard.packets], rel=0, abs=1e-6)
    assert [p.entry for p in heard.packets] == list(range(len(heard.packets)))
    assert (np.diff([p.received_at_s for p in heard.packets]) >= 0).all()


def test_strength_falls_with_distance_as_the_link_says(lane: TrueLane) -> None:
    """The middle of what arrives at 50 m and 340 m, heard or not, is the paper's."""
    near, far = [], []
    for k in range(6):
        rng = np.random.default_rng(1020 + k)
        drive = drive_past(lane, install_markers(lane, place_markers(lane.left_m, lane.right_m), rng), rng, sign=None)
        near.append(drive.strength_dbm[np.abs(drive.distance_m - 50) < 5])
        far.append(drive.strength_dbm[np.abs(drive.distance_m - 340) < 20])
    assert np.concatenate(near).mean() == pytest.approx(-108, abs=0.5)
    assert np.concatenate(far).mean() == pytest.approx(-125, abs=0.5)
    assert np.concatenate(near).std() == pytest.approx(np.hypot(4, 2), rel=0.1)


def test_what_is_heard_is_near_and_told_in_whole_decibels(heard: SimulatedDrive) -> None:
    told = np.array([p.rssi_dbm for p in heard.packets])
    assert (told == np.round(told)).all()
    assert told.min() >= Radio().sensitivity_dbm - 3
    assert all((4 * p.snr_db).is_integer() for p in heard.packets)


def test_a_lower_spreading_factor_hears_less_far(lane: TrueLane, installed: InstalledMarkers) -> None:
    def reach_m(radio: Radio) -> float:
        drive = drive_past(lane, installed, np.random.default_rng(1013), sign=_sign, radio=radio)
        away = []
        for packet, row in zip(drive.packets, drive.sender, strict=True):
            at = [np.interp(packet.received_at_s, drive.drive.time_s, drive.drive.point_m[:, k]) for k in range(2)]
            away.append(np.linalg.norm(installed.point_m[row] - at))
        return float(np.quantile(away, 0.9))

    sparse = {"interval_s": 20.0}
    assert reach_m(Radio(7, 500_000, **sparse)) < reach_m(Radio(9, 125_000, **sparse)) - 30


def test_packets_in_clear_carry_a_claim(lane: TrueLane, installed: InstalledMarkers) -> None:
    drive = drive_past(lane, installed, np.random.default_rng(1014), sign=None)
    packet, row = drive.packets[0], drive.sender[0]
    assert packet.payload is None
    assert packet.claim is not None
    assert packet.claim.number == installed.number[row]
    assert packet.claim.lat_deg == pytest.approx(installed.lat_deg[row], abs=1e-9)


def test_a_moved_marker_claims_a_place_thirty_metres_off_every_line(
    lane: TrueLane, installed: InstalledMarkers
) -> None:
    rng = np.random.default_rng(1015)
    for row in (0, 1, 7, len(installed) - 1):
        moved = move_claim(lane, installed, row, rng)
        claim = lane.enu_from_wgs84(moved.lon_deg[row], moved.lat_deg[row])
        assert np.linalg.norm(claim - installed.point_m[row]) == pytest.approx(30, abs=0.02)
        for line in (lane.left_m, lane.right_m):
            assert np.linalg.norm(line - claim, axis=1).min() > 0.99
        others = np.arange(len(installed)) != row
        assert (moved.lon_deg[others] == installed.lon_deg[others]).all()
    with pytest.raises(InvalidParameter):
        move_claim(lane, installed, 0, rng, distance_m=0.2)


def test_no_forgery_carries_the_tag_of_its_bytes(heard: SimulatedDrive) -> None:
    forged = forge_packets(heard.packets, 3000, np.random.default_rng(1016))
    real = {p.payload for p in heard.packets}
    assert len(forged) == 3000
    right = 0
    for packet in forged:
        assert packet.payload is not None
        assert packet.payload not in real
        assert len(packet.payload) == 24
        number = int.from_bytes(packet.payload[1:5])
        right += packet.payload[BODY_BYTES:] == message_tag(_key(number), packet.payload[:BODY_BYTES])
    assert right == 0
    places = {p.payload[5:13] for p in forged if p.payload is not None}
    assert len(places) > 500  # a fair part of them claims places that no marker has


def test_replays_are_the_recorded_bytes_at_the_times_asked(heard: SimulatedDrive) -> None:
    replayed = replay_packets(heard.packets, 500, np.random.default_rng(1017), at_s=(2e9, 2e9 + 60))
    assert {p.payload for p in replayed} <= {p.payload for p in heard.packets}
    assert all(2e9 <= p.received_at_s <= 2e9 + 60 for p in replayed)
    with pytest.raises(InvalidParameter):
        replay_packets([], 5, np.random.default_rng(0), at_s=(0, 1))


def test_faults_do_what_they_say_and_no_more(heard: SimulatedDrive) -> None:
    rng = np.random.default_rng(1018)
    packets = heard.packets
    damaged = corrupt_packets(packets, 0.2, rng)
    changed = [a.payload != b.payload for a, b in zip(packets, damaged, strict=True)]
    assert np.mean(changed) == pytest.approx(0.2, abs=0.05)
    assert len({len(p.payload or b"") for p in damaged}) > 5
    twice = repeat_packets(packets, 0.3, rng)
    assert len(twice) / len(packets) == pytest.approx(1.3, abs=0.06)
    mixed = shuffle_packets(packets, rng)
    assert sorted(mixed, key=lambda p: p.entry) == list(packets)
    places = np.array([p.entry for p in mixed])
    assert 0 < np.abs(places - np.arange(len(places))).max() <= 8
    late = shift_clock(packets, 3.5)
    assert late[5].received_at_s - packets[5].received_at_s == pytest.approx(3.5, abs=1e-6)
    assert [p.entry for p in number_entries(mixed)] == list(range(len(mixed)))
