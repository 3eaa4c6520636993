"""Holes measured on the ellipsoid with pyproj: distances, bearings, chainages and what is refused."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Geod

from app.encoders.magnet import Hole, MagnetLayout, place_line, place_tag
from app.errors import InvalidParameter
from app.markers.magnet import InformationTag, LineStyle, Orientation, Polarity
from app.roads.lane_line import LaneLine

WGS84 = Geod(ellps="WGS84")
TAG = InformationTag.from_gaps("SNS", 0.1, [10, 30])
LONG_TAG = InformationTag.from_gaps("NNSSNSN", 0.5, [1, 2, 1, 4, 1, 3])


def measured(a: Hole, b: Hole) -> tuple[float, float]:
    """Bearing [deg] and distance [m] from one hole to another on the ellipsoid."""
    bearing, _, distance = WGS84.inv(a.lon_deg, a.lat_deg, b.lon_deg, b.lat_deg)
    return bearing % 360, distance


def angle(a: float, b: float) -> float:
    return abs((a - b + 180) % 360 - 180)


@pytest.mark.parametrize("tag", [TAG, LONG_TAG])
@pytest.mark.parametrize("chainage_m", [0.0, 20.0, 67.0, 71.5, 75.25, 100.0])
@pytest.mark.parametrize("offset_m", [0.0, 1.75])
def test_holes_are_as_far_apart_as_the_code_says_also_on_a_bend(
    bend: LaneLine, tag: InformationTag, chainage_m: float, offset_m: float
) -> None:
    layout = place_tag(bend, tag, chainage_m, name="tag", offset_m=offset_m)
    assert [hole.polarity for hole in layout.holes] == list(tag.polarities)
    for (i, a), (k, b) in itertools.combinations(enumerate(layout.holes), 2):
        bearing, distance = measured(a, b)
        assert distance == pytest.approx(tag.offsets_m[k] - tag.offsets_m[i], abs=0.001)
        assert angle(bearing, layout.bearing_deg) < 0.02
    for hole in layout.holes:
        turned = 0 if hole.polarity is Polarity.N else 180
        assert hole.north_pole_bearing_deg is not None
        assert angle(hole.north_pole_bearing_deg, layout.bearing_deg + turned) < 1e-9
        assert hole.north_pole == ("forward" if hole.polarity is Polarity.N else "backward")
        assert hole.orientation is Orientation.FORWARD


def test_a_tag_begins_and_ends_on_the_lane(bend: LaneLine, bend_deg: list[list[float]]) -> None:
    layout = place_tag(bend, LONG_TAG, 70.0, name="tag")
    first, *middle, last = layout.holes
    assert first.chainage_m == pytest.approx(70.0, abs=1e-6)
    walked = WGS84.line_length(*zip(*bend_deg, strict=True))
    assert bend.length_m == pytest.approx(walked, rel=1e-6)
    for hole in (first, last):
        assert hole.offset_m == pytest.approx(0, abs=1e-6)
    assert last.chainage_m - first.chainage_m > 6.0  # the lane is longer than its chord
    assert max(abs(hole.offset_m) for hole in middle) > 0.15
    assert len({math.copysign(1, hole.offset_m) for hole in middle}) == 1


def test_travel_and_offset_have_the_right_sign() -> None:
    north = LaneLine.from_lon_lat([(8.0, 49.0), (8.0, 49.001)])
    layout = place_tag(north, TAG, 10.0, name="tag", offset_m=0.5)
    assert angle(layout.bearing_deg, 0) < 1e-6
    assert all(hole.lon_deg < 8.0 for hole in layout.holes)  # left of north is west
    assert [hole.offset_m for hole in layout.holes] == pytest.approx([0.5] * 3, abs=1e-6)
    assert layout.holes[2].lat_deg > layout.holes[0].lat_deg
    assert all(
        angle(hole.north_pole_bearing_deg or 0, wanted) < 1e-6
        for hole, wanted in zip(layout.holes, (180, 0, 180), strict=True)
    )
    south = LaneLine.from_lon_lat([(8.0, 49.001), (8.0, 49.0)])
    reverse = place_tag(south, TAG.reversed_wrong_way(), south.length_m - 14.0, name="tag", offset_m=-0.5)
    for here, there in zip(layout.holes, reversed(reverse.holes), strict=True):
        assert measured(here, there)[1] < 0.001  # the tag as a wrong-way driver meets it is the same in the road
        assert angle(here.north_pole_bearing_deg or 0, there.north_pole_bearing_deg or 0) < 0.01


@given(
    st.floats(-180, 180),
    st.floats(-85, 85),
    st.floats(0, 360),
    st.floats(-0.02, 0.02),
    st.floats(0, 30),
    st.floats(-400, 4000),
)
@settings(max_examples=100, deadline=None)
def test_holes_keep_their_distances_anywhere(
    lon_deg: float, lat_deg: float, heading_deg: float, curvature: float, chainage_m: float, height_m: float
) -> None:
    points = [(lon_deg, lat_deg)]
    for step in range(30):
        lon, lat, _ = WGS84.fwd(*points[-1], heading_deg + math.degrees(curvature * 2 * step), 2.0)
        points.append((lon, lat))
    layout = place_tag(LaneLine.from_lon_lat(points, height_m), LONG_TAG, chainage_m * 0.8, name="tag")
    at_height = 1 + height_m / 6.37e6
    for a, b in itertools.pairwise(layout.holes):
        assert measured(a, b)[1] * at_height == pytest.approx(b.along_m - a.along_m, abs=0.0005)


# --- lines ------------------------------------------------------------------------------------------------------------


def line_gaps(layout: MagnetLayout) -> np.ndarray:
    return np.array([measured(a, b)[1] for a, b in itertools.pairwise(layout.holes)])


@pytest.mark.parametrize(("style", "polarity", "pole"), [(LineStyle.SOLID, "N", "up"), (LineStyle.DASHED, "S", "down")])
def test_lines_are_upright_magnets_at_most_six_metres_apart(
    bend: LaneLine, style: LineStyle, polarity: str, pole: str
) -> None:
    layout = place_line(bend, style, name="line")
    gaps = line_gaps(layout)
    assert gaps.max() <= 6.0
    assert len(layout.holes) == math.ceil(bend.length_m / 6) + 1
    along = np.diff([hole.along_m for hole in layout.holes])
    np.testing.assert_allclose(along, bend.length_m / math.ceil(bend.length_m / 6), atol=1e-9)
    assert (gaps <= along + 0.001).all()
    assert (gaps > 0.98 * along).all()
    np.testing.assert_allclose(layout.gaps_m, gaps, atol=0.001)
    for hole in layout.holes:
        assert (hole.polarity, hole.orientation, hole.north_pole) == (polarity, Orientation.UP, pole)
        assert hole.north_pole_bearing_deg is None
        assert abs(hole.offset_m) < 1e-6
    assert (layout.holes[0].chainage_m, layout.holes[-1].chainage_m) == pytest.approx((0, bend.length_m))


def test_a_section_of_a_line_ends_on_its_ends(bend: LaneLine) -> None:
    layout = place_line(bend, LineStyle.SOLID, name="line", from_m=10.0, to_m=22.0, spacing_m=3.0)
    assert [hole.chainage_m for hole in layout.holes] == pytest.approx([10, 13, 16, 19, 22], abs=1e-6)
    assert [hole.along_m for hole in layout.holes] == pytest.approx([0, 3, 6, 9, 12])


# --- what is refused --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("points", "field"),
    [
        ([], "lane"),
        ([(8.0, 49.0)], "lane"),
        ([(8.0, 49.0), (8.0, 49.0)], "lane"),
        ([(8.0,), (8.1,)], "lane"),
        ([(8.0, 49.0), (9.0, 49.0)], "lane"),
        ([(8.0, 49.0), (8.0, 91.0)], "lane[1].lat_deg"),
        ([(8.0, 49.0), (math.nan, 49.0)], "lane[1].lon_deg"),
    ],
)
def test_what_is_no_lane_is_refused(points: list[tuple[float, ...]], field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        LaneLine.from_lon_lat(points)
    assert caught.value.field == field
    assert caught.value.limit


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"chainage_m": -0.1}, "chainage_m"),
        ({"chainage_m": math.nan}, "chainage_m"),
        ({"chainage_m": 148.0}, "chainage_m"),
        ({"chainage_m": 1000.0}, "chainage_m"),
        ({"offset_m": math.inf}, "offset_m"),
        ({"name": ""}, "name"),
        ({"name": "a\nb"}, "name"),
    ],
)
def test_a_tag_off_the_lane_is_refused(bend: LaneLine, options: dict[str, object], field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        place_tag(bend, TAG, **({"chainage_m": 10.0, "name": "tag"} | options))  # type: ignore[arg-type]
    assert caught.value.field == field
    assert caught.value.limit


def test_the_last_place_that_fits_is_allowed(bend: LaneLine) -> None:
    straight = LaneLine.from_lon_lat([(8.0, 49.0), (8.0, 49.001)])
    layout = place_tag(straight, TAG, straight.length_m - 4.0, name="tag")
    assert layout.holes[-1].chainage_m == pytest.approx(straight.length_m)
    with pytest.raises(InvalidParameter):
        place_tag(straight, TAG, straight.length_m - 3.999, name="tag")


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"spacing_m": 0.0}, "spacing_m"),
        ({"spacing_m": math.nan}, "spacing_m"),
        ({"spacing_m": 0.001}, "spacing_m"),
        ({"from_m": 20.0, "to_m": 20.0}, "to_m"),
        ({"from_m": -1.0}, "from_m"),
        ({"to_m": 1000.0}, "to_m"),
    ],
)
def test_a_line_that_cannot_be_laid_is_refused(bend: LaneLine, options: dict[str, float], field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        place_line(bend, LineStyle.SOLID, name="line", **options)
    assert caught.value.field == field
    assert caught.value.limit
