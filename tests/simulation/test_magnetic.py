"""The dipole simulation against physics and its own truth."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from app.markers.magnet import InformationTag, Orientation, Polarity
from app.sensors.magnetometer_bar import MagnetometerBar
from app.simulation.magnetic.dipoles import dipole_field_ut
from app.simulation.magnetic.drive import Course, Scene, Vehicle, simulate_drive
from app.simulation.magnetic.recorder import CanBus, Chip
from app.simulation.magnetic.road import PlacedTag, Road, RoadMagnet, Spread, place_magnets, tag_magnets

QUIET = Chip(
    noise_ut=(0, 0, 0), count_ut=(0, 0, 0), offset_ut=0, gain=0, misalignment_deg=0, soft_iron=0, jitter=0, stale=0,
    spikes=0, axis_delay_s=(0, 0, 0),
)  # fmt: skip
EXACT = Spread(0, 0, 0, 0)


def test_a_magnet_gives_32_ut_at_25_cm() -> None:
    # reference formats: "about 32 uT on its axis at 25 cm, falling with the cube"
    up = np.array([0, 0, 2.47])
    near, far = dipole_field_ut(np.array([[0, 0, 0.25], [0, 0, 0.5]]), np.zeros(3), up)[:, 2]
    assert near == pytest.approx(31.6, abs=0.1)
    assert near / far == pytest.approx(8)


def cuboid_field_ut(points_m: np.ndarray, size_m: tuple[float, float, float], remanence_t: float) -> np.ndarray:
    """Field of a cuboid magnetised along its z axis: two charged faces (Furlani 2001, section 4.2)."""
    field = np.zeros((len(points_m), 3))
    for i, j, k in itertools.product((-1, 1), repeat=3):
        x, y, z = (points_m - np.array([i, j, k]) * np.array(size_m) / 2).T
        r = np.sqrt(x * x + y * y + z * z)
        sign = i * j * k
        field += np.stack([-sign * np.log(r + y), -sign * np.log(r + x), sign * np.arctan2(x * y, z * r)], axis=1)
    return field * remanence_t * 1e6 / (4 * np.pi)


def test_the_dipole_agrees_with_the_cuboid() -> None:
    points = np.array([[0.0, 0, 0.16], [0.1, 0.05, 0.2], [0.3, 0, 0.15]])
    cuboid = cuboid_field_ut(points, (0.015, 0.015, 0.0095), 1.45)
    dipole = dipole_field_ut(points, np.zeros(3), np.array([0, 0, 2.47]))
    np.testing.assert_allclose(cuboid, dipole, rtol=0.02, atol=0.1)


@pytest.mark.parametrize(("orientation", "axis", "sign"), [(Orientation.UP, 2, 1), (Orientation.FORWARD, 0, -1)])
@pytest.mark.parametrize("polarity", list(Polarity))
def test_polarity_conventions(orientation: Orientation, axis: int, sign: int, polarity: Polarity) -> None:
    # DESIGN section 2: N up: the field above points up; N forward: it points backward straight above
    magnet = RoadMagnet(10.0, 0.08, polarity, orientation)
    scene = Scene(
        Road(25), Vehicle.compact(wheel_moment_am2=0, roughness=0), Course(hunting=0, weave_m=0), lines=[magnet],
        spread=EXACT, chip=QUIET, earth_ut=(0, 0, 0),
    )  # fmt: skip
    drive = simulate_drive(scene, np.random.default_rng(5))
    row = drive.trace.field_ut[:, 0, axis]  # sensor 0 is 8 cm to the left
    peak = row[np.argmax(np.abs(row))]
    assert np.sign(peak) == sign * polarity.sign
    assert abs(peak) == pytest.approx({2: 2, 0: 1}[axis] * 0.247 / 0.155**3, rel=0.08)
    truth = drive.magnets[0]
    assert drive.trace.t_s[np.argmax(np.abs(row))] == pytest.approx(truth.t_s, abs=0.003)
    assert truth.lateral_cm == pytest.approx(8, abs=0.5)


def test_the_wrong_way_turns_order_and_polarity() -> None:
    tag = InformationTag.from_gaps("NNS", 1.0, (1, 3))
    scene = Scene(Road(40), Vehicle.compact(), tags=[PlacedTag(tag, 15.0)], wrong_way=True)
    drive = simulate_drive(scene, np.random.default_rng(6))
    assert [m.polarity.value for m in drive.magnets] == ["N", "S", "S"]
    t = [m.t_s for m in drive.magnets]
    assert (t[1] - t[0]) / (t[2] - t[1]) == pytest.approx(3, rel=0.1)


def test_a_buried_magnet_is_that_much_farther_below_the_bar() -> None:
    rng = np.random.default_rng(1)
    magnets = [RoadMagnet(5.0, 0.0, Polarity.N, Orientation.UP, depth_m=depth) for depth in (-0.005, 0.295)]
    tag = PlacedTag(InformationTag.from_gaps("NS", 1.0, [2]), 8.0, depth_m=0.1)
    dipoles, _at = place_magnets([*magnets, *tag_magnets([tag])], Road(20.0), EXACT, rng)
    assert dipoles[:, 2] == pytest.approx([0.005, -0.295, -0.1, -0.1])


def test_the_earths_field_turns_with_the_heading() -> None:
    road = Road(120, [(20, 80, 40.0)], heading_deg=0)
    scene = Scene(road, Vehicle.compact(wheel_moment_am2=0, roughness=0), Course(hunting=0, weave_m=0), chip=QUIET)
    trace = simulate_drive(scene, np.random.default_rng(7)).trace
    start, end = trace.field_ut[5, 3], trace.field_ut[-5, 3]
    assert np.hypot(*start[:2]) == pytest.approx(np.hypot(*end[:2]), rel=0.02)
    assert start[0] == pytest.approx(18, abs=0.6)  # heading north
    turned = np.degrees(60 / 40)
    assert end[0] == pytest.approx(18 * np.cos(np.radians(turned)), abs=1)
    assert trace.heading_deg is not None
    assert trace.heading_deg[-1] == pytest.approx(360 - turned, abs=1.5)


def test_the_reference_sees_a_wheel_best() -> None:
    scene = Scene(Road(80), Vehicle.compact(wheel_moment_am2=1.0, roughness=0), chip=QUIET, earth_ut=(0, 0, 0))
    spread = simulate_drive(scene, np.random.default_rng(8)).trace.field_ut.std(axis=0).max(axis=1)
    assert spread[6] > 3 * spread[5] > 3 * spread[0]  # well, outermost, innermost on the left
    assert spread[13] > 3 * spread[12]


def test_the_readout_has_the_chips_faults() -> None:
    chip = Chip(stale=0.01, spikes=0.001)
    scene = Scene(Road(200), Vehicle.compact(wheel_moment_am2=0), chip=chip)
    field = simulate_drive(scene, np.random.default_rng(9)).trace.field_ut
    still = (np.diff(field, axis=0) == 0).all(axis=2)
    assert 0.005 < still.mean() < 0.02
    off = np.abs(field[:, 2, 0] / 0.15 - np.round(field[:, 2, 0] / 0.15))
    assert 0 < np.mean(off > 1e-2) < 0.005  # all but the spikes are whole counts
    assert field[50].std(axis=0).min() > 50  # offsets of hundreds of uT
    noise = np.median(np.abs(np.diff(field, axis=0)), axis=(0, 1)) / 0.6745 / np.sqrt(2)
    np.testing.assert_allclose(noise, [1.5, 1.5, 1.9], rtol=0.15)


def test_can_is_late_coarse_and_too_fast() -> None:
    t = np.arange(0, 20, 0.01)
    at, speed = CanBus(speed_latency_s=0.5, speed_scale=0.02, speed_count_m_s=0.1).speed(t, 10 + t)
    assert np.median(np.diff(at)) == pytest.approx(0.1)
    np.testing.assert_allclose(speed[20:], 1.02 * (10 + at[20:] - 0.5), atol=0.051)
    np.testing.assert_allclose(speed / 0.1, np.round(speed / 0.1), atol=1e-6)


def test_the_same_seed_gives_the_same_drive() -> None:
    scene = Scene(Road(40), Vehicle.compact())
    a, b, c = (simulate_drive(scene, np.random.default_rng(s)).trace for s in (1, 1, 2))
    assert np.array_equal(a.field_ut, b.field_ut)
    assert a.field_ut.shape != c.field_ut.shape or not np.array_equal(a.field_ut, c.field_ut)


def test_metros_bar() -> None:
    bar = MagnetometerBar.metro()
    assert bar.sensor_count == 14
    assert list(bar.references) == [6, 13]
    y = np.sort(bar.positions_m[bar.array, 1])
    np.testing.assert_allclose(np.diff(y), 0.16)
    assert bar.positions_m[5, 1] > bar.positions_m[0, 1] > 0 > bar.positions_m[7, 1] > bar.positions_m[12, 1]
