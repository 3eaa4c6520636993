"""Faulty samples are replaced, wheel noise is cancelled, and the path on the plane."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from app.decoders.magnet.preprocess import Blocks, Preprocessor
from app.decoders.magnet.readings import VehiclePath
from app.decoders.magnet.wheel_noise import Piece, WheelNoiseCanceller
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace

BAR = MagnetometerBar.metro()


def blocks_of(field: np.ndarray, pieces: int = 1) -> Blocks:
    """Field (N, 14, 3), 350 Hz at 10 m/s."""
    t = np.arange(len(field)) / 350
    front, blocks = Preprocessor(BAR), Blocks(BAR.sensor_count)
    for part in np.array_split(np.arange(len(t)), pieces):
        front.feed(MagnetTrace(t[part], field[part], t[part], np.full(len(part), 10.0)))
        front.take(blocks)
    front.take(blocks, final=True)
    return blocks


def quiet_field(n: int = 60) -> np.ndarray:
    return 40 + np.random.default_rng(1).normal(0, 1.0, (n, BAR.sensor_count, 3))


FAULTS: dict[str, dict[int, float | str]] = {
    "a spike": {30: 300.0},
    "a spike and its repeat": {30: 300.0, 31: 300.0},
    "a repeat, then a spike": {29: "repeat", 30: 300.0},
}


@pytest.mark.parametrize("fault", list(FAULTS))
@pytest.mark.parametrize("pieces", [1, 60])
def test_faulty_samples_are_repaired(fault: str, pieces: int) -> None:
    field = quiet_field()
    for i, value in FAULTS[fault].items():
        field[i, 3] = field[i - 1, 3] if isinstance(value, str) else value
    repaired = blocks_of(field, pieces)
    assert np.abs(repaired.x - repaired.x[0]).max() < 8
    assert repaired.w[:, 3].min() < 1


def test_a_fast_magnet_is_no_spike() -> None:
    at = (np.arange(60) - 30) * 10 / 350 * 3  # 30 m/s
    field = quiet_field()
    for j, y in zip(BAR.array, BAR.positions_m[BAR.array, 1], strict=True):
        r2 = at**2 + (y - 0.08) ** 2 + 0.16**2
        field[:, j, 2] += 0.1 * 2.47 * (3 * 0.16**2 - r2) / r2**2.5
    assert blocks_of(field).w.min() == 1


def yaw_of(heading_t_s: np.ndarray, heading_deg: np.ndarray, pieces: int) -> np.ndarray:
    """Yaw of the blocks of ten seconds at 10 m/s, 100 Hz, and their times, shape (2, N)."""
    t = np.arange(1000) / 100
    field = np.random.default_rng(1).normal(0, 1.0, (t.size, BAR.sensor_count, 3))
    trace = MagnetTrace(t, field, t, np.full(t.size, 10.0), heading_t_s, heading_deg)
    front, blocks = Preprocessor(BAR), Blocks(BAR.sensor_count)
    starts = np.array([-1.0, *t[1000 // pieces :: 1000 // pieces], 99.0])
    for start, end in pairwise(starts):
        front.feed(trace.between(start, end))
        front.take(blocks)
    front.take(blocks, final=True)
    return np.stack([blocks.t, blocks.yaw])


@pytest.mark.parametrize("pieces", [1, 200])
def test_headings_turn_through_north_and_are_waited_for(pieces: int) -> None:
    at = np.arange(0, 10, 0.1)
    t, yaw = yaw_of(at, (355 + 2 * at) % 360, pieces)
    np.testing.assert_allclose(np.degrees(yaw - yaw[0]), -2 * np.minimum(t - t[0], 9.9), atol=1e-6)
    np.testing.assert_array_equal(yaw, yaw_of(at, (355 + 2 * at) % 360, 1)[1])


def test_a_heading_is_kept_where_the_next_one_comes_late() -> None:
    t, yaw = yaw_of(np.array([0.0, 1.0, 6.0]), np.array([10.0, 20.0, 70.0]), 50)
    np.testing.assert_allclose(-np.degrees(yaw), np.where(t < 6, np.minimum(10 + 10 * t, 20), 70), atol=1e-6)


LENGTH_M = 1.95
PLACES_M = np.array([[0.0, 0.1 * j, 0.0] for j in range(3)] + [[-0.6, 0.1, 0.5]])


def wheel_noise(turns: np.ndarray, rng: np.random.Generator, size: float = 8.0) -> np.ndarray:
    """Field of a wheel at four sensors, the last one its reference, by its turns."""
    noise = np.zeros((turns.size, 4, 3))
    for h, share in ((1, 1.0), (2, 0.5), (3, 0.25)):
        phase = rng.uniform(0, 2 * np.pi, (4, 3))
        noise += size * share * np.cos(2 * np.pi * h * turns[:, None, None] + phase)
    noise[:, 3] *= 5
    return noise


def cancelled(s: np.ndarray, x: np.ndarray) -> np.ndarray:
    out = x.copy()
    WheelNoiseCanceller(np.array([3]), PLACES_M).cancel(s, np.zeros_like(s), out)
    return out


def test_wheel_noise_is_learnt_and_taken_out_but_not_a_magnet() -> None:
    rng = np.random.default_rng(2)
    s = np.arange(0, 200, 0.03)
    noise = wheel_noise(s / LENGTH_M, rng)
    x = noise + rng.normal(0, 0.5, noise.shape)
    bump = 40 * np.exp(-(((s - 150) / 0.15) ** 2))
    x[:, :3, 2] += bump[:, None]
    x = cancelled(s, x)
    late = (s > 80) & (abs(s - 150) > 1)
    assert x[late][:, :3].std(axis=0).max() < 0.25 * noise[late][:, :3].std(axis=0).min()
    near = abs(s - 150) < 0.2
    np.testing.assert_allclose(x[near][:, :3, 2], np.repeat(bump[near][:, None], 3, 1), atol=6)


def test_weak_wheel_noise_is_taken_out_and_none_is_put_in() -> None:
    rng = np.random.default_rng(5)
    s = np.arange(0, 200, 0.03)
    noise = wheel_noise(s / LENGTH_M, rng, size=0.8)
    chip = rng.normal(0, 1.5, noise.shape)
    late = s > 80
    left = cancelled(s, noise + chip) - chip
    assert left[late][:, :3].std() < 0.5 * noise[late][:, :3].std()
    np.testing.assert_array_equal(cancelled(s, chip), chip)


def test_an_inner_wheel_rolls_less() -> None:
    rng = np.random.default_rng(4)
    s, places = np.arange(0, 300, 0.03), PLACES_M + np.array([0, 0.7, 0])
    yaw = np.interp(s, [100, 130, 150, 180], [0, 30 / 18, 30 / 18, 0])  # bends of 18 m radius, left and right
    noise = wheel_noise((s - places[3, 1] * yaw) / LENGTH_M, rng)
    x = noise + rng.normal(0, 0.5, noise.shape)
    straight = x.copy()
    WheelNoiseCanceller(np.array([3]), places).cancel(s, yaw, x)
    WheelNoiseCanceller(np.array([3]), places).cancel(s, np.zeros_like(s), straight)
    bends = (s > 100) & (s < 200)
    left, left_if_straight = (part[bends][:, :3].std() / noise[bends][:, :3].std() for part in (x, straight))
    assert left < 0.15 < left_if_straight


def test_of_a_whole_recording_the_noise_is_known_from_its_beginning() -> None:
    rng = np.random.default_rng(6)
    s, places = np.arange(0, 60, 0.03), PLACES_M + np.array([0, 0.7, 0])
    yaw = np.interp(s, [0, 30], [0, 30 / 18])
    noise = wheel_noise((s - places[3, 1] * yaw) / LENGTH_M, rng)
    x = noise + rng.normal(0, 0.5, noise.shape)
    kept = x.copy()
    canceller = WheelNoiseCanceller(np.array([3]), places)
    canceller.learn_beginning(s, yaw, x)
    np.testing.assert_array_equal(x, kept)
    canceller.cancel(s, yaw, x)
    first = slice(1, int(np.searchsorted(s, 10)))
    assert x[first, :3].std() < 0.2 * noise[first, :3].std()


@pytest.mark.parametrize("turns", [1.0, 0.99, 2.0])
def test_noise_that_is_the_same_in_every_turn_is_not_that_of_a_line(turns: float) -> None:
    rng = np.random.default_rng(7)
    s, yaw = np.arange(0, 120, 0.03), np.zeros(4000)
    noise = wheel_noise(s / LENGTH_M, rng)
    line = np.zeros_like(noise)
    for at in np.arange(20, 105, turns * LENGTH_M):
        line[:, :3, 2] += 20 * np.exp(-(((s - at) / 0.2) ** 2))[:, None]
    x = noise + line + rng.normal(0, 0.5, noise.shape)
    kept = x.copy()
    canceller = WheelNoiseCanceller(np.array([3]), PLACES_M)
    canceller.learn_beginning(s, yaw, x)
    found = canceller.constant_turns(s, yaw, x)
    np.testing.assert_array_equal(x, kept)
    over = (s > 25) & (s < 100)
    off = [float((one.noise_ut(s) - noise)[over, :3].std()) for one in found]
    assert min(off) < 0.06 * noise[over, :3].std()
    pieces = [Piece(30.0, 60.0, found[int(np.argmin(off))]), Piece(60.0, 90.0, None)]
    canceller.with_pieces(pieces).cancel(s, yaw, x)
    np.testing.assert_array_equal(x[(s >= 60) & (s < 90)], kept[(s >= 60) & (s < 90)])
    left = (x - line)[(s >= 30) & (s < 60), :3]
    assert left.std() < 0.2 * noise[over, :3].std()


def test_a_short_stretch_shows_no_noise_that_is_the_same_in_every_turn() -> None:
    s = np.arange(0, 20, 0.03)
    x = wheel_noise(s / LENGTH_M, np.random.default_rng(8))
    canceller = WheelNoiseCanceller(np.array([3]), PLACES_M)
    assert canceller.constant_turns(s, np.zeros_like(s), x) == []
    assert canceller.constant_turns(s[:0], s[:0], x[:0]) == []


def test_without_references_nothing_is_changed() -> None:
    x = np.random.default_rng(3).normal(0, 5, (400, 4, 3))
    kept = x.copy()
    WheelNoiseCanceller(np.empty(0, np.intp), PLACES_M).cancel(np.arange(400) * 0.03, np.zeros(400), x)
    np.testing.assert_array_equal(x, kept)


def test_the_path_of_a_bend() -> None:
    # a right-hand quarter circle of 20 m radius
    s = np.linspace(0, 20 * np.pi / 2, 500)
    path = VehiclePath(0.0)
    path.append(s, -s / 20)
    np.testing.assert_allclose(path.position_m(s[-1], 0.0), [20, -20], atol=0.02)
    np.testing.assert_allclose(path.position_m(s[-1], 0.5), [20.5, -20], atol=0.02)  # heading south, left is east
    np.testing.assert_allclose(path.position_m(0.0, 0.5), [0, 0.5], atol=0.02)


def test_the_path_comes_in_pieces() -> None:
    s = np.arange(0, 40, 0.1)
    path = VehiclePath(1.0)
    path.append(s[:200], -s[:200] / 20)
    path.append(s[200:], -s[200:] / 20)
    assert path.reach_m == s[-1]
    step = np.linalg.norm(np.diff([path.position_m(x, 0.0) for x in s], axis=0), axis=1)
    np.testing.assert_allclose(step, 0.1, atol=2e-3)


def test_without_headings_the_path_is_straight() -> None:
    s = np.arange(0, 5, 0.1)
    path = VehiclePath(2.0)
    path.append(s, np.zeros_like(s))
    np.testing.assert_allclose(path.position_m(3.0, -0.4), [5.0, -0.4])
