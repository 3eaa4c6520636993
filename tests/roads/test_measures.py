"""Measures along axes: calibration, equations of stationing, gaps and overlaps."""

from __future__ import annotations

import pytest

from app.errors import InvalidParameter
from app.roads.lane_line import CalibrationPoint, calibrate

ONE = [(0.0, 1000.0)]


def test_without_points_measures_are_true_metres() -> None:
    measures = calibrate([(0.0, 1000.0), (1000.0, 1500.0)], [])
    assert measures.measure_at(0, 250.0) == 250.0
    assert measures.measure_at(1, 1250.0) == 1250.0
    assert measures.places_of(250.0) == [(0, 0, 250.0)]
    assert [place[0] for place in measures.places_of(1000.0)] == [0, 1]
    assert measures.places_of(1500.1) == []
    assert measures.places_of(-0.1) == []


def test_one_point_shifts() -> None:
    measures = calibrate(ONE, [CalibrationPoint(0, 100.0, 12_100.0)])
    assert measures.measure_at(0, 0.0) == 12_000.0
    assert measures.measure_at(0, 1000.0) == 13_000.0


def test_measures_are_straight_between_points_and_true_beyond() -> None:
    points = [CalibrationPoint(0, 900.0, 1_000.0), CalibrationPoint(0, 100.0, 200.0), CalibrationPoint(0, 500.0, 610.0)]
    measures = calibrate(ONE, points)
    for chainage_m, measure_m in [(0, 100), (100, 200), (300, 405), (500, 610), (700, 805), (900, 1000), (1000, 1100)]:
        assert measures.measure_at(0, chainage_m) == pytest.approx(measure_m)
        assert measures.places_of(measure_m) == [(0, 0, pytest.approx(chainage_m))]


def test_an_equation_ahead_leaves_measures_that_are_on_no_road() -> None:
    measures = calibrate(ONE, [CalibrationPoint(0, 400.0, 400.0, 450.0)])
    assert measures.measure_at(0, 399.0) == pytest.approx(399)
    assert measures.measure_at(0, 400.0) == pytest.approx(450)
    assert measures.measure_at(0, 1000.0) == pytest.approx(1050)
    assert measures.places_of(425.0) == []
    assert measures.places_of(500.0) == [(1, 0, pytest.approx(450))]
    assert (measures.section_at(0, 399.0), measures.section_at(0, 400.0)) == (0, 1)


def test_an_equation_back_gives_a_measure_two_places() -> None:
    measures = calibrate(ONE, [CalibrationPoint(0, 400.0, 400.0, 350.0)])
    assert measures.places_of(375.0) == [(0, 0, pytest.approx(375)), (1, 0, pytest.approx(425))]
    assert measures.places_of(300.0) == [(0, 0, pytest.approx(300))]


def test_an_equation_at_an_end_is_the_measure_there() -> None:
    measures = calibrate(ONE, [CalibrationPoint(0, 0.0, 7.0, 500.0)])
    assert measures.measure_at(0, 0.0) == 500.0
    assert len(measures.sections) == 1


def test_parts_have_measures_of_their_own() -> None:
    measures = calibrate([(0.0, 100.0), (100.0, 200.0)], [CalibrationPoint(1, 100.0, 130.0)])
    assert measures.measure_at(0, 100.0) == 100.0
    assert measures.measure_at(1, 100.0) == 130.0
    assert measures.places_of(115.0) == []


@pytest.mark.parametrize(
    "points",
    [
        [CalibrationPoint(0, 100.0, 500.0), CalibrationPoint(0, 900.0, 400.0)],
        [CalibrationPoint(0, 100.0, 0.0), CalibrationPoint(0, 900.0, 0.8)],
        [CalibrationPoint(0, 100.0, 0.0), CalibrationPoint(0, 900.0, 2624.67)],
        [CalibrationPoint(0, 100.0, 0.0), CalibrationPoint(0, 100.0, 0.1)],
        [CalibrationPoint(0, 100.0, 0.0, 50.0), CalibrationPoint(0, 300.0, 20.0)],
    ],
)
def test_what_does_not_rise_with_the_road_is_refused(points: list[CalibrationPoint]) -> None:
    with pytest.raises(InvalidParameter) as caught:
        calibrate(ONE, points)
    assert caught.value.field == "calibration"


def test_a_measure_that_hundreds_of_parts_have_is_at_its_first_twenty_places() -> None:
    ranges_m = [(100.0 * k, 100.0 * k + 100.0) for k in range(300)]
    measures = calibrate(ranges_m, [CalibrationPoint(k, start_m, 0.0) for k, (start_m, _) in enumerate(ranges_m)])
    assert measures.places_of(50.0) == [(k, k, 100.0 * k + 50.0) for k in range(20)]
    for part in (0, 17, 299):
        assert measures.section_at(part, ranges_m[part][0] + 50.0) == part
        assert measures.section_at(part, ranges_m[part][0] - 1.0) == part
        assert measures.measure_at(part, ranges_m[part][1]) == 100.0
