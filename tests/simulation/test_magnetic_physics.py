"""The options of the magnetic simulation against closed forms, and drives without them against recorded ones."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.markers.magnet import MOMENT_AM2, Orientation, Polarity
from app.simulation.magnetic.clutter import (
    KINDS,
    SHAPES,
    Clutter,
    Spheroid,
    demagnetising_factors,
    spheroid_clutter,
    spheroid_dipoles,
    spheroid_moment_am2,
)
from app.simulation.magnetic.dipoles import METRO_CYLINDER, Cylinder, cylinder_dipoles, dipole_field_ut
from app.simulation.magnetic.drive import EARTH_UT, Scene, Vehicle, simulate_drive
from app.simulation.magnetic.recorder import Chip
from app.simulation.magnetic.road import Road, RoadMagnet
from app.values import Floats

MU0_UT = 0.4 * math.pi  # [uT / (A/m)]
NO_EARTH = np.zeros(3)


def _field_ut(points_m: Floats, dipoles: Floats) -> Floats:
    return np.sum([dipole_field_ut(points_m, one[:3], one[3:]) for one in dipoles], axis=0)


def _cylinder_field_ut(points_m: list[list[float]], cylinder: Cylinder, moment_am2: list[float]) -> Floats:
    row = np.array([[0.0, 0.0, 0.0, *moment_am2]])
    return _field_ut(np.array(points_m), cylinder_dipoles(row, np.zeros(1), cylinder)[0])


@pytest.mark.parametrize("cylinder", [METRO_CYLINDER, Cylinder(0.014, 0.05), Cylinder(0.1, 0.03)])
def test_a_cylinder_has_the_field_of_two_charged_discs_on_its_axis(cylinder: Cylinder) -> None:
    """B = mu0 M / 2 (cos of the near disc's half angle - that of the far one): Furlani 2001, section 4.2."""
    moment, radius, half = 2.47, cylinder.diameter_m / 2, cylinder.length_m / 2
    at = half + 2 * max(radius, half) * np.array([1.0, 1.5, 3.0])
    magnetisation_am = moment / (math.pi * radius**2 * cylinder.length_m)
    discs = (at + half) / np.hypot(at + half, radius) - (at - half) / np.hypot(at - half, radius)
    found = _cylinder_field_ut([[0.0, 0.0, z] for z in at], cylinder, [0.0, 0.0, moment])
    error = found[:, 2] / (MU0_UT * magnetisation_am / 2 * discs) - 1
    assert (np.abs(error) < (0.02, 0.005, 0.001)).all(), error
    np.testing.assert_allclose(found[:, :2], 0, atol=1e-9)


def test_far_away_a_cylinder_is_a_dipole_and_close_by_it_is_not() -> None:
    rod, moment = Cylinder(0.014, 0.05), [0.9, -1.4, 1.8]
    for away_m, tolerance in ((1.5, 1e-3), (6.0, 1e-4)):
        point = [0.6 * away_m, 0.48 * away_m, 0.64 * away_m]
        dipole = dipole_field_ut(np.array([point]), np.zeros(3), np.array(moment))
        difference = _cylinder_field_ut([point], rod, moment) - dipole
        assert np.linalg.norm(difference) < tolerance * np.linalg.norm(dipole)
    near = _cylinder_field_ut([[0.0, 0.0, 0.08]], rod, [0.0, 0.0, 1.0])[0, 2]
    assert near > 1.15 * dipole_field_ut(np.array([[0.0, 0.0, 0.08]]), np.zeros(3), np.array([0.0, 0.0, 1.0]))[0, 2]


def test_cylinders_keep_moment_place_and_chainage() -> None:
    rows = np.array([[1.0, 2.0, 0.005, 0.0, 0.0, 2.0], [4.0, 5.0, 0.005, 1.0, 0.0, 0.0]])
    parts, at = cylinder_dipoles(rows, np.array([10.0, 20.0]), Cylinder(0.02, 0.06, sunk_m=0.03))
    for k, chainage in enumerate((10.0, 20.0)):
        mine = parts[at == chainage]
        np.testing.assert_allclose(mine[:, 3:].sum(axis=0), rows[k, 3:])
        np.testing.assert_allclose(mine[:, :3].mean(axis=0), rows[k, :3] - (0, 0, 0.03))
    with pytest.raises(InvalidParameter):
        Cylinder(0.0, 0.05)


@pytest.mark.parametrize(("aspect", "published"), [(1.0, 0.3333), (2.0, 0.1736), (5.0, 0.0558), (10.0, 0.0203)])
def test_demagnetising_factors_are_the_published_ones(aspect: float, published: float) -> None:
    # Osborn 1945 and Bozorth 1951, table of prolate ellipsoids, N / 4 pi
    along, across = demagnetising_factors(aspect)
    assert along == pytest.approx(published, abs=6e-5)
    assert along + 2 * across == pytest.approx(1)


@pytest.mark.parametrize("aspect", [1.5, 4.0])
def test_a_spheroids_field_is_continuous_at_its_surface(aspect: float) -> None:
    """Inside, B = mu0 M (1 - N): at the tip along the axis B goes on, at the waist H = -N M does."""
    body = Spheroid((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.1 * aspect, 0.1, (1000.0, 0.0, 0.0))
    outside = _field_ut(np.array([[0.1 * aspect, 0, 0], [0, 0, 0.1]]), spheroid_dipoles(body, NO_EARTH, nodes=80))
    along, _across = demagnetising_factors(aspect)
    np.testing.assert_allclose(outside[:, 0], MU0_UT * 1000 * np.array([1 - along, -along]), rtol=1e-6)


def test_a_sphere_is_the_textbooks_and_far_iron_follows_the_field_along_its_axis() -> None:
    sphere = Spheroid((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.1, 0.1)
    induced = spheroid_moment_am2(sphere, np.array(EARTH_UT))
    # 4 pi a^3 (mu - 1) / (mu + 2) H: Jackson, Classical Electrodynamics, section 5.11
    expected = 4 * math.pi * 0.1**3 * 200 / 203 * np.array(EARTH_UT) / MU0_UT
    np.testing.assert_allclose(induced, expected, rtol=1e-9)
    turned = Spheroid((0.0, 0.0, 0.0), (0.6, 0.8, 0.0), 0.5, 0.02)
    moment = spheroid_moment_am2(turned, np.array([50.0, 0.0, 0.0]))
    assert moment[1] / moment[0] == pytest.approx(0.8 / 0.6, rel=0.1)


def test_the_default_line_of_dipoles_is_fine_enough_under_the_bar() -> None:
    bar = Spheroid((0.0, 0.0, -0.06), (0.0, 1.0, 0.0), 1.8, 0.008, (0.0, 3000.0, 0.0))
    points = np.stack([np.full(50, 0.03), np.linspace(-2.0, 2.0, 50), np.full(50, 0.1)], 1)
    fine = _field_ut(points, spheroid_dipoles(bar, np.array(EARTH_UT), nodes=400))
    np.testing.assert_allclose(
        _field_ut(points, spheroid_dipoles(bar, np.array(EARTH_UT))), fine, atol=0.01 * np.abs(fine).max()
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(KINDS))
def test_spheroids_are_about_as_strong_as_the_dipoles_of_their_kind(kind: str) -> None:
    road, points = Road(20), np.array([[0.0, 1.2, 0.6], [0.3, -1.2, 0.6], [0.0, 0.1, 0.9]])
    if kind not in ("car", "steel plate"):
        points = np.array([[0.0, 0.0, 0.25], [0.2, 0.1, 0.25], [-0.2, -0.1, 0.25]])
    thing, point, body = Clutter(kind, 5.0, 0.0), [], []
    points = points + ((0, 0.6, 0.3) if kind == "car" else (0, 0, 0))
    for seed in range(40):
        local = spheroid_clutter(thing, road, np.random.default_rng(seed), earth_ut=EARTH_UT)
        body.append(np.linalg.norm(_field_ut(points, local), axis=1).max())
        point.append(np.linalg.norm(_field_ut(points, KINDS[kind](np.random.default_rng(seed))), axis=1).max())
    assert 1 / 4 < np.median(body) / np.median(point) < 4, (np.median(body), np.median(point))
    assert set(SHAPES) == set(KINDS)


def test_what_the_earth_induces_turns_with_the_road() -> None:
    thing, rng = Clutter("rebar", 5.0, 0.0), np.random.default_rng
    north = spheroid_clutter(thing, Road(20, heading_deg=0), rng(1), earth_ut=(0, 20, 0))[:, 3:].sum(axis=0)
    east = spheroid_clutter(thing, Road(20, heading_deg=90), rng(1), earth_ut=(0, 20, 0))[:, 3:].sum(axis=0)
    none = spheroid_clutter(thing, Road(20), rng(1), earth_ut=(0, 0, 0))[:, 3:].sum(axis=0)
    assert abs((north - none)[1]) < 1e-9  # the field is across the bars
    assert (east - none)[1] > 50 * abs((north - none)[0])  # along them, to the left
    right = spheroid_clutter(thing, Road(20, heading_deg=0), rng(1), earth_ut=(20, 0, 0))[:, 3:].sum(axis=0)
    assert (right - none)[1] == pytest.approx(-(east - none)[1])


SCENE = Scene(
    Road(60),
    Vehicle.compact(),
    lines=[RoadMagnet(20.0, 0.1, Polarity.N, Orientation.UP), RoadMagnet(30.0, -0.3, Polarity.S, Orientation.FORWARD)],
    clutter=[Clutter("manhole cover", 40.0, 0.2)],
)


def _with_chip(**options: float) -> Scene:
    return replace(SCENE, chip=replace(Chip(), **options))


def test_without_options_a_drive_is_the_one_recorded_before_they_existed() -> None:
    """Recorded at commit 76a3225: the generator's next number after the drive, three samples, and the mean size."""
    rng = np.random.default_rng(4242)
    field = simulate_drive(SCENE, rng).trace.field_ut
    assert rng.integers(2**60) == 606344317659925614
    assert field.shape == (1529, 14, 3)
    samples = field[(200, 700, 1200), (0, 5, 11), (0, 1, 2)]
    np.testing.assert_allclose(samples, (-185.7, 365.7, 71.874), atol=0.01)
    assert np.abs(field.astype(float)).mean() == pytest.approx(184.366116437, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "scene",
    [
        replace(SCENE, magnet_shape=Cylinder(0.014, 0.05)), replace(SCENE, spheroid_iron=True),
        _with_chip(range_ut=100.0), _with_chip(cross_axis=0.05), _with_chip(gain_error=0.05),
        _with_chip(stamp_jitter_s=0.001),
    ],
)  # fmt: skip
def test_every_option_changes_the_field_and_is_the_same_for_the_same_seed(scene: Scene) -> None:
    base, one, again = (simulate_drive(s, np.random.default_rng(3)) for s in (SCENE, scene, scene))
    assert np.array_equal(one.trace.field_ut, again.trace.field_ut)
    assert not np.array_equal(base.trace.field_ut, one.trace.field_ut)
    assert np.array_equal(base.trace.t_s, one.trace.t_s) or scene.spheroid_iron


def test_a_saturated_axis_stays_at_its_range() -> None:
    field = simulate_drive(_with_chip(range_ut=100.0, spikes=0.0), np.random.default_rng(3)).trace.field_ut
    assert np.abs(field).max() < 100.2
    assert 0.3 < np.mean(np.abs(field) > 99.7) < 0.9  # offsets have a spread of 200 uT


def test_axes_are_mixed_by_a_matrix_of_the_spread_asked_for() -> None:
    chip, axes = Chip(cross_axis=0.03, gain_error=0.05), np.tile(np.eye(3), (4000, 1, 1))
    mixed = chip.mixed_axes(axes, np.random.default_rng(1)) - axes
    diagonal = np.eye(3, dtype=bool)
    assert mixed[:, diagonal].std() == pytest.approx(0.05, rel=0.03)
    assert mixed[:, ~diagonal].std() == pytest.approx(0.03, rel=0.03)
    rows = Chip(misalignment_deg=3.0).axes(5, np.random.default_rng(2))
    matrix = Chip(cross_axis=0.1).mixed_axes(np.tile(np.eye(3), (5, 1, 1)), np.random.default_rng(3))
    np.testing.assert_allclose(Chip(cross_axis=0.1).mixed_axes(rows, np.random.default_rng(3)), matrix @ rows)


def test_jitter_moves_a_magnet_in_the_samples_but_not_the_recorded_times() -> None:
    times = np.arange(0, 10, 0.003)
    off = Chip(stamp_jitter_s=0.001).true_times_s(times, np.random.default_rng(1)) - times
    assert off.std() == pytest.approx(0.001, rel=0.05)
    assert abs(off.mean()) < 1e-4
    still = Chip().true_times_s(times, np.random.default_rng(1))
    assert still is times


def test_a_metro_magnet_under_the_bar_is_nearly_a_dipole() -> None:
    dipole = dipole_field_ut(np.array([[0.0, 0.0, 0.16]]), np.zeros(3), np.array([0.0, 0.0, MOMENT_AM2]))[0, 2]
    cylinder = _cylinder_field_ut([[0.0, 0.0, 0.16]], METRO_CYLINDER, [0.0, 0.0, MOMENT_AM2])[0, 2]
    assert cylinder == pytest.approx(dipole, rel=0.005)
