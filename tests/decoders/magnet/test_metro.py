"""Each step of the METRO paper's pipeline, and the whole of it."""

from __future__ import annotations

import numpy as np
import pytest

from app.decoders.magnet import metro as steps
from app.decoders.magnet.metro import MetroSettings, decode_trace_metro
from app.decoders.magnet.readings import MagnetReading, TagReading
from app.markers.magnet import InformationTag, Orientation, Polarity
from app.simulation.magnetic.drive import MPH, Course, Scene, Vehicle, simulate_drive
from app.simulation.magnetic.road import PlacedTag, Road, RoadMagnet


@pytest.mark.parametrize(("mph", "samples"), [(10, 15), (30, 9), (50, 5)])
def test_smoothing_follows_the_speed(mph: float, samples: int) -> None:
    pulse = np.zeros(101)
    pulse[50] = 1
    smooth = steps.smooth_speed_aware(pulse, np.full(101, mph * MPH))
    assert np.count_nonzero(smooth) == samples
    assert smooth.sum() == pytest.approx(1)
    assert np.argmax(smooth) == 50


def test_the_derivative_of_a_parabola() -> None:
    t = np.arange(200) / 350
    derivative = steps.derive_savitzky_golay(3 * t**2, 350)
    np.testing.assert_allclose(derivative[10:-10], 6 * t[10:-10], rtol=1e-6)


def test_zero_crossings_tell_peaks_from_valleys() -> None:
    t = np.linspace(0, 1, 1000, endpoint=False)
    at, slope = steps.find_zero_crossings(np.cos(2 * np.pi * t + 0.01))  # of a sine: peak, then valley
    assert list(np.sign(slope)) == [-1, 1]
    np.testing.assert_allclose(t[at], [0.248, 0.748], atol=0.003)


def test_thresholds() -> None:
    slopes = np.concatenate([np.linspace(-2, 2, 50), [50.0]])
    assert steps.slope_threshold(slopes) == pytest.approx(3)
    x = np.zeros(1000)
    x[500] = 20
    assert steps.amplitude_steps(x, np.array([100, 500]), 350)[1] == pytest.approx(20, abs=0.1)


def test_scaling_takes_offset_and_spread() -> None:
    rng = np.random.default_rng(1)
    front, reference = 5 + 2 * rng.standard_normal(400), 100 + 30 * rng.standard_normal(400)
    scaled = steps.scale_reference(reference, front, 400)
    assert scaled.mean() == pytest.approx(5, abs=0.3)
    assert scaled.std() == pytest.approx(front.std(), rel=1e-6)


def test_lms_takes_out_what_the_reference_tells() -> None:
    t = np.arange(7000) / 350
    noise = 60 * np.sin(2 * np.pi * 7 * t)
    out = steps.cancel_wheel_noise(noise, noise, 4, 1e-6, 50)
    assert out[-1000:].std() < 0.2 * noise[-1000:].std()
    np.testing.assert_array_equal(steps.cancel_wheel_noise(noise, np.zeros(7000), 4, 1e-6, 50), noise)


def test_equation_1_projects_on_the_first_heading() -> None:
    t = np.arange(0, 1.0001, 0.001)
    heading = 90 * t
    whole = steps.segment_distance_m(t, np.full(t.size, 10.0), heading, 0, 1000, 0.0)
    assert whole == pytest.approx(10 * 2 / np.pi, rel=1e-3)
    assert steps.segment_distance_m(t, np.full(t.size, 10.0), None, 0, 500, 0.0) == pytest.approx(5)


def test_detections_of_one_magnet_are_merged() -> None:
    rows = [
        (a, MagnetReading(0, s, 0, Polarity.N, Orientation.UP, 0.5)) for a, s in ((5.0, 1.0), (9.0, 1.2), (4.0, 3.0))
    ]
    assert [m.odometer_m for m in steps.merge_detections(rows, 0.35)] == [1.2, 3.0]


def test_reads_the_papers_default_tag_at_16_cm() -> None:
    # figure 13(a): all magnets at 15 to 25 mph. The z axis sees a forward magnet nearly as well as the x axis
    tag = InformationTag.from_gaps("NNN", 1.0, (1, 3))
    vehicle = Vehicle.compact(wheel_moment_am2=0)
    right = 0
    for seed in range(8):
        scene = Scene(Road(90), vehicle, Course(20 * MPH), tags=[PlacedTag(tag, 60.0, 0.08)])
        drive = simulate_drive(scene, np.random.default_rng(seed))
        found = decode_trace_metro(drive.trace, vehicle.bar, MetroSettings(cancel_wheels=False))
        tags = [f for f in found if isinstance(f, TagReading)]
        right += len(tags) == 1 and tags[0].polarities == tag.polarities and abs(tags[0].ratios[0] / 3 - 1) < 0.05
    assert right == 8


def test_an_upright_magnet_is_a_line() -> None:
    vehicle = Vehicle.compact(wheel_moment_am2=0)
    lines = [RoadMagnet(60.0, 0.08, Polarity.S, Orientation.UP)]
    drive = simulate_drive(Scene(Road(90), vehicle, lines=lines), np.random.default_rng(3))
    found = decode_trace_metro(drive.trace, vehicle.bar)
    magnets = [f for f in found if isinstance(f, MagnetReading)]
    assert [(m.polarity, m.phi_deg) for m in magnets] == [(Polarity.S, Orientation.UP)]
