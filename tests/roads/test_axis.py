"""Distances along axes and offsets from them: against PROJ's geodesics, and there and back."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import Geod

from app.errors import InvalidParameter
from app.roads.axis import Axis, IntArray
from app.values import Floats

GEOD = Geod(ellps="WGS84")
LANES = sorted((Path(__file__).parents[2] / "benchmarks/cerpm/routes").glob("*.geojson"))


def _lines(path: Path) -> list[list[list[float]]]:
    features = json.loads(path.read_text())["features"]
    return [f["geometry"]["coordinates"] for f in features if f["geometry"]["type"] == "LineString"]


def _line(*steps: tuple[float, float], start: tuple[float, float] = (8.4, 49.0)) -> list[tuple[float, float]]:
    """A line of (heading_deg, length_m) steps."""
    points = [start]
    for heading_deg, length_m in steps:
        lon, lat, _ = GEOD.fwd(*points[-1], heading_deg, length_m)
        points.append((lon, lat))
    return points


def _place(axis: Axis, chainage_m: float, offset_m: float, part: int = 0) -> tuple[float, float]:
    lon, lat, _ = axis.place(np.array([part]), np.array([chainage_m]), np.array([offset_m]))
    return float(lon[0]), float(lat[0])


@pytest.mark.parametrize("path", LANES, ids=lambda path: path.stem)
def test_real_lanes_there_and_back(path: Path) -> None:
    rng = np.random.default_rng(3)
    for line in _lines(path):
        axis = Axis([line])
        points = np.array(line)[:, :2]
        assert axis.length_m == pytest.approx(GEOD.line_length(points[:, 0], points[:, 1]), abs=1e-8)
        chainages, offsets = rng.uniform(0, axis.length_m, 500), rng.uniform(-6, 6, 500)
        lon, lat, folded = axis.place(np.zeros(500, dtype=np.intp), chainages, offsets)
        assert folded.mean() < 0.01
        for k, feet in enumerate(axis.locate(lon, lat, 30.0)):
            if not folded[k]:
                error_m = min(math.hypot(f.chainage_m - chainages[k], f.offset_m - offsets[k]) for f in feet)
                assert error_m < 1e-6
        found = 0
        lon = rng.uniform(points[:, 0].min(), points[:, 0].max(), 500)
        lat = rng.uniform(points[:, 1].min(), points[:, 1].max(), 500)
        for k, feet in enumerate(axis.locate(lon, lat, 20.0)):
            for foot in feet:
                back = _place(axis, foot.chainage_m, foot.offset_m, foot.part)
                error_m = GEOD.inv(lon[k], lat[k], *back)[2]
                assert error_m < 1e-6 or not foot.exact
                found += foot.exact
        assert found > 50


@pytest.mark.parametrize(
    "start", [(8.4, 49.0), (179.995, -16.5), (-179.9999, 0.0), (20.0, 69.9), (0.0, 89.97), (120.0, -89.99)]
)
def test_everywhere_on_the_ellipsoid(start: tuple[float, float]) -> None:
    axis = Axis([_line((95, 900), (80, 1_500), (110, 700), (95, 12_000), start=start)])
    assert axis.length_m == pytest.approx(15_100, abs=1e-7)
    rng = np.random.default_rng(5)
    chainages, offsets = rng.uniform(0, axis.length_m, 300), rng.uniform(-50, 50, 300)
    lon, lat, _ = axis.place(np.zeros(300, dtype=np.intp), chainages, offsets)
    for k, feet in enumerate(axis.locate(lon, lat, 51.0)):
        assert min(math.hypot(f.chainage_m - chainages[k], f.offset_m - offsets[k]) for f in feet) < 1e-6


def test_offsets_are_geodesic_distances_left_positive() -> None:
    axis = Axis([_line((90, 5_000))])
    assert _place(axis, 2_000, 3.5)[1] > _place(axis, 2_000, 0)[1] > _place(axis, 2_000, -3.5)[1]
    on, off = _place(axis, 2_000, 0), _place(axis, 2_000, 400)
    assert GEOD.inv(*on, *off)[2] == pytest.approx(400, abs=1e-9)
    assert axis.heading_deg(np.array([0]), np.array([0.0]))[0] == pytest.approx(90)


def test_a_hairpin_has_two_feet() -> None:
    axis = Axis([_line((0, 200), (90, 20), (180, 200))])
    spot = _place(axis, 100, -8.0)
    first, second = axis.locate(np.array([spot[0]]), np.array([spot[1]]), 15.0)[0]
    assert (first.chainage_m, first.offset_m) == (pytest.approx(100, abs=1e-6), pytest.approx(-8, abs=1e-6))
    assert (second.chainage_m, second.offset_m) == (pytest.approx(320, abs=0.01), pytest.approx(-12, abs=0.01))


def test_a_closed_loop_starts_where_it_ends() -> None:
    line = _line(*((heading, 10.0) for heading in range(0, 360, 10)))
    axis = Axis([[*line[:-1], line[0]]])
    feet = axis.locate(np.array([line[0][0]]), np.array([line[0][1]]), 5.0)[0]
    assert sorted(round(foot.chainage_m, 3) for foot in feet) == [0.0, round(axis.length_m, 3)]
    for chainage_m in (3.0, axis.length_m - 3.0):
        lon, lat = _place(axis, chainage_m, 4.0)
        (foot,) = axis.locate(np.array([lon]), np.array([lat]), 5.0)[0]
        assert foot.chainage_m == pytest.approx(chainage_m, abs=1e-6)


def test_a_road_that_crosses_itself_is_found_twice() -> None:
    axis = Axis([_line((0, 200), (90, 100), (180, 100), (270, 200))])
    crossing = _place(axis, 100.0, 0.0)
    feet = axis.locate(np.array([crossing[0]]), np.array([crossing[1]]), 3.0)[0]
    assert [round(foot.chainage_m, 1) for foot in feet] in ([100.0, 500.0], [500.0, 100.0])


def test_beyond_an_end_and_outside_a_corner_the_foot_says_so() -> None:
    axis = Axis([_line((0, 100), (120, 100))])
    lon, lat, _ = GEOD.fwd(*_line((0, 100))[1], 0, 7)
    (corner,) = axis.locate(np.array([lon]), np.array([lat]), 20.0)[0]
    assert (corner.chainage_m, corner.exact) == (pytest.approx(100, abs=1e-6), False)
    assert corner.offset_m == pytest.approx(7, abs=1e-4)  # the corner turns right, its outside is on the left
    lon, lat, _ = GEOD.fwd(8.4, 49.0, 180, 12)
    (start,) = axis.locate(np.array([lon]), np.array([lat]), 20.0)[0]
    assert (start.chainage_m, start.exact) == (0.0, False)
    assert (start.beyond_m, start.offset_m) == (pytest.approx(-12, abs=1e-6), pytest.approx(0, abs=1e-6))


def test_what_is_too_far_has_no_foot() -> None:
    axis = Axis([_line((0, 100))])
    assert axis.locate(np.array([8.41, -171.6, 8.4]), np.array([49.0, -49.0, 49.0005]), 50.0)[:2] == [[], []]


def test_parts_run_on() -> None:
    first = _line((0, 100))
    second = _line((0, 50), start=GEOD.fwd(*first[-1], 0, 30)[:2])
    axis = Axis([first, second])
    assert axis.part_ranges_m == [(0.0, pytest.approx(100)), (pytest.approx(100), pytest.approx(150))]
    assert GEOD.inv(*_place(axis, 100, 0, part=0), *_place(axis, 100, 0, part=1))[2] == pytest.approx(30, abs=1e-6)


def test_circles_cover_the_axis() -> None:
    axis = Axis([_line((95, 900), (80, 15_000), (200, 700), start=(179.95, 10.0))])
    circles = list(axis.list_circles(2_000.0))
    assert len(circles) < 12
    for chainage_m in np.arange(0, axis.length_m, 50):
        spot = _place(axis, float(chainage_m), 0)
        assert any(GEOD.inv(lon, lat, *spot)[2] <= radius_m for lon, lat, radius_m in circles)


@pytest.mark.parametrize(
    ("parts", "limit"),
    [
        ([[(8.0, 49.0)]], "two different"),
        ([[(8.0, 49.0), (8.0, 49.0)]], "two different"),
        ([[(8.0, 49.0), (49.0, 8.0)]], "20 km"),
        ([], "vertices"),
    ],
)
def test_lines_that_are_none_are_refused(parts: list[list[tuple[float, float]]], limit: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        Axis(parts)
    assert limit in str(caught.value.limit)


# --- lines that are made to take long -----------------------------------------------------------------------------


def _zigzag(vertices: int, width_deg: float, step_deg: float) -> list[list[float]]:
    i = np.arange(vertices)
    points: list[list[float]] = np.column_stack([8.0 + width_deg * (i % 2), 49.0 + step_deg * i]).tolist()
    return points


def test_a_place_beside_thousands_of_edges_has_the_nearest_twenty_feet(monkeypatch: pytest.MonkeyPatch) -> None:
    exact: list[int] = []
    compute = Axis._exact

    def count(self: Axis, places: IntArray, *rest: Any) -> tuple[Floats, Floats]:
        exact.append(len(places))
        return compute(self, places, *rest)

    monkeypatch.setattr(Axis, "_exact", count)
    axis = Axis([_zigzag(4000, 1e-4, 1e-7)])
    lon, lat = np.full(3, 8.00005), np.array([49.0001, 49.0002, 49.0003])
    found = axis.locate(lon, lat, 100.0)
    assert [len(feet) for feet in found] == [20, 20, 20]
    assert sum(exact) <= 3 * (20 + 1)
    edges_m = 1e-7 * math.radians(1) * 6_371_000
    for feet in found:
        assert feet == sorted(feet, key=lambda foot: foot.distance_m)
        assert feet[-1].distance_m < 12 * edges_m
        assert len({round(foot.chainage_m, 4) for foot in feet}) == 20


def test_more_pairs_of_places_and_edges_than_a_search_takes_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.roads.axis.MAX_PAIRS", 10_000)
    axis = Axis([_zigzag(1000, 1e-5, 1e-7)])
    with pytest.raises(InvalidParameter, match="20 positions have 19980 edges") as caught:
        axis.locate(np.full(20, 8.0), np.full(20, 49.0), 100.0)
    assert caught.value.limit is not None
    assert "10000 pairs" in caught.value.limit
    assert len(axis.locate(np.full(5, 8.0), np.full(5, 49.0), 100.0)) == 5


def test_a_line_that_is_too_long_is_refused_before_it_is_cut_into_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.roads.axis._cuts", lambda length: pytest.fail("it was cut"))
    with pytest.raises(InvalidParameter, match="km long"):
        Axis([_zigzag(70_000, 0.25, 1e-7)])
    with pytest.raises(InvalidParameter, match="km long") as caught:
        Axis([_zigzag(100, 0.25, 1e-7)], 1_000_000.0)
    assert caught.value.limit == "1000 km"
    with pytest.raises(InvalidParameter, match="2001 parts"):
        Axis([[[8.0, 49.0], [8.1, 49.0]]] * 2001)
