"""Slots: who meets whom in a frame, and places that are far apart."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.radio.settings import RadioSettings, Slots, assign_places

TEN = Slots(frame_s=1.0, slot_s=0.065, channels=10)


def test_a_frame_holds_what_fits_and_each_place_is_alone() -> None:
    assert (TEN.per_channel, TEN.capacity) == (15, 150)
    for frame in (0, 1, 17, 2**32 + 5):
        slot, channel = TEN.at(np.arange(150), frame)
        assert len(set(zip(slot.tolist(), channel.tolist(), strict=True))) == 150
        assert slot.max() == 14
        assert (channel.min(), channel.max()) == (0, 9)


def test_the_channel_is_the_documented_one() -> None:
    slot, channel = TEN.at(47, 123_456)
    hop = zlib.crc32(b"waymark slot" + bytes.fromhex("0001e240") + bytes.fromhex("00000002"))
    assert (int(slot), int(channel)) == (2, (3 + (hop * 2654435761 % 2**32 >> 16)) % 10)
    assert TEN.at(47 + 150, 123_456 + 2**32)[1] == channel


def test_places_hop_over_all_channels_and_neighbouring_slots_seldom_meet() -> None:
    frames = np.arange(3600)
    _slot, first = TEN.at(3, frames)
    _slot, second = TEN.at(4, frames)
    # 3,600 draws of one in ten: five standard deviations are 90
    assert np.abs(np.bincount(first, minlength=10) - 360).max() < 90
    assert abs((first == second).sum() - 360) < 90


def test_assigned_places_are_shared_only_by_distant_markers() -> None:
    along = np.repeat(np.arange(0.0, 3000.0, 12.0), 3)
    points = np.stack([along, np.tile([0.0, 3.6, 7.2], len(along) // 3)], 1)
    place = assign_places(points, 60)
    assert place.min() == 0
    assert place.max() == 59
    gaps = [np.diff(along[place == one]).min() for one in range(60)]
    assert min(gaps) >= 19 * 12.0  # sixty places for three markers at a station: again after twenty stations
    shuffled = np.random.default_rng(3).permutation(len(points))
    mixed = assign_places(points[shuffled], 60)
    apart = [np.diff(np.sort(along[shuffled][mixed == one])).min() for one in range(60)]
    assert min(apart) >= 5 * 12.0


def test_few_markers_get_places_of_their_own() -> None:
    assert sorted(assign_places(np.random.default_rng(1).normal(0, 100, (40, 3)), 60)) == list(range(40))
    assert assign_places(np.empty((0, 2)), 60).tolist() == []


def test_an_interval_without_a_whole_slot_is_refused() -> None:
    with pytest.raises(InvalidParameter, match=r"no slot of 0\.055 s") as caught:
        RadioSettings(interval_s=0.05, slotted=True, slot_guard_s=0.04)
    assert caught.value.field == "interval_s"
    with pytest.raises(InvalidParameter) as caught:
        RadioSettings(slotted=True, slot_guard_s=0.0)
    assert caught.value.field == "slot_guard_s"
