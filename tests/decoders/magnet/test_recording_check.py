"""Mistakes in the declaration of a recording are named, and a recording without any gets no warning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.decoders.magnet.decoder import decode_trace
from app.decoders.magnet.recording_check import compare_with_dipoles, compare_with_earth, find_mistakes
from app.markers.magnet import InformationTag, parse_tag
from app.sensors.magnetometer_bar import MagnetTrace
from app.simulation.magnetic.clutter import ferrous_clutter
from app.simulation.magnetic.drive import Course, Scene, Vehicle, simulate_drive
from app.simulation.magnetic.road import PlacedTag, Road

pytestmark = pytest.mark.slow

BAR = Vehicle.compact().bar
BENDS = ((30.0, 70.0, 25.0),)


def recorded(*, tags: int = 4, bends: tuple[tuple[float, float, float], ...] = (), seed: int = 3) -> MagnetTrace:
    """A drive of 110 m at 11 m/s over tags of three magnets."""
    tag = parse_tag("SNS_4_0.1_10-30")
    assert isinstance(tag, InformationTag)
    placed = [PlacedTag(tag, 20.0 + 22.0 * k, 0.1) for k in range(tags)]
    clutter = [] if tags else ferrous_clutter(20.0, 100.0, 10.0, np.random.default_rng(seed))
    scene = Scene(Road(110.0, bends), Vehicle.compact(), Course(speed_m_s=11.0), tags=placed, clutter=clutter)
    return simulate_drive(scene, np.random.default_rng(seed)).trace


def with_axes(trace: MagnetTrace, order: tuple[int, ...], signs: tuple[int, ...]) -> MagnetTrace:
    return replace(trace, field_ut=np.ascontiguousarray(trace.field_ut[..., order] * np.array(signs, np.float32)))


@pytest.mark.parametrize(
    ("factor", "named", "seed"),
    [
        (1 / 3.6, "m/s where km/h", 3),
        (1 / 1.609344, "mph where km/h", 4),
        (3.6, "km/h where m/s", 5),
        (3.6, "km/h where m/s", 6),
        (1.609344, "km/h where mph", 6),
    ],
)
def test_a_wrong_unit_of_the_speed_is_named(factor: float, named: str, seed: int) -> None:
    """Also where magnets are read as sure in the wrong unit, but all of them too weak or too strong."""
    trace = recorded(seed=seed)
    trace = replace(trace, speed_m_s=trace.speed_m_s * factor)
    (mistake,) = find_mistakes(trace, BAR, decode_trace(trace, BAR))
    assert mistake.field == "speed_unit"
    assert named in mistake.text


@pytest.mark.parametrize(("factor", "named"), [(0.1, "ten times as large"), (10.0, "a tenth as large")])
def test_a_wrong_unit_of_the_field_is_named(factor: float, named: str) -> None:
    trace = recorded(bends=BENDS)
    trace = replace(trace, field_ut=trace.field_ut * np.float32(factor))
    mistake = compare_with_dipoles(trace, BAR)
    assert mistake is not None
    assert mistake.field == "unit"
    assert named in mistake.text
    by_earth = compare_with_earth(trace, BAR)
    assert by_earth is not None
    assert by_earth.field == "unit"


@pytest.mark.parametrize(
    ("order", "signs", "named"),
    [((0, 1, 2), (1, -1, -1), "FRD where FLU"), ((1, 0, 2), (1, 1, 1), "x and y"), ((0, 2, 1), (1, 1, 1), "y and z")],
)
def test_wrong_axes_are_named(order: tuple[int, ...], signs: tuple[int, ...], named: str) -> None:
    mistake = compare_with_dipoles(with_axes(recorded(), order, signs), BAR)
    assert mistake is not None
    assert mistake.field == "axes"
    assert named in mistake.text


def test_the_earths_field_shows_mirrored_and_inverted_axes() -> None:
    trace = recorded(bends=BENDS)
    mirrored = compare_with_earth(with_axes(trace, (0, 1, 2), (1, -1, -1)), BAR)
    assert mirrored is not None
    assert "against the heading" in mirrored.text
    inverted = with_axes(trace, (0, 1, 2), (-1, -1, -1))
    assert len(decode_trace(inverted, BAR)) >= 4  # polarity is wrong in all of them, and only this shows it
    mistake = compare_with_earth(inverted, BAR)
    assert mistake is not None
    assert "inverted" in mistake.text


@pytest.mark.parametrize("bends", [(), BENDS], ids=["straight", "bend"])
@pytest.mark.parametrize("tags", [4, 0], ids=["tags", "iron"])
def test_an_honest_recording_gets_no_warning(tags: int, bends: tuple[tuple[float, float, float], ...]) -> None:
    trace = recorded(tags=tags, bends=bends)
    assert find_mistakes(trace, BAR, decode_trace(trace, BAR)) == []


def test_a_straight_drive_says_nothing_of_the_earths_field() -> None:
    trace = recorded()
    assert compare_with_earth(with_axes(trace, (0, 1, 2), (-1, -1, -1)), BAR) is None
    assert compare_with_earth(replace(trace, heading_t_s=None, heading_deg=None), BAR) is None
