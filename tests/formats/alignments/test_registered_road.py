"""Lanes along a registered road's axis."""

from __future__ import annotations

from typing import Any

import numpy as np
import orjson
import pytest
from pyproj import Geod

from app.errors import InvalidParameter, UnreadableUpload
from app.formats.alignments.geometry import AlignmentDeclaration, BoundaryStyle
from app.formats.alignments.read import RegisteredRoad, RoadLanes, read_alignment, write_registered_road
from app.geodesy import LocalizationGrade
from app.planning.alignment import Alignment
from app.planning.build_alignment import build_alignment
from app.roads.axis import Axis
from app.roads.lane_line import CalibrationPoint, cut_edges

GEOD = Geod(ellps="WGS84")


def line(start: tuple[float, float], *steps: tuple[float, float]) -> list[tuple[float, float]]:
    """A line of (heading_deg, length_m) steps."""
    points = [start]
    for heading, length in steps:
        lon, lat, _ = GEOD.fwd(*points[-1], heading, length)
        points.append((lon, lat))
    return points


TIGHT = [(90.0, 50.0), *((90.0 - 9 * k, 2.0) for k in range(20)), (-90.0, 50.0)]
BEND = [(80.0 - 2.0 * max(0, min(k - 20, 20)), 25.0) for k in range(60)]


def road(start: tuple[float, float] = (8.0, 49.0), **more: Any) -> RegisteredRoad:
    values: dict[str, Any] = {
        "road_id": "r", "version": 3, "name": "A 7", "exact": True, "note": None, "calibration": [],
        "lanes": RoadLanes(speed_limit_kmh=70), "parts": [line(start, *BEND)],
    }  # fmt: skip
    return RegisteredRoad(**values | more)


def read(given: RegisteredRoad) -> Alignment:
    file = read_alignment(write_registered_road(given), "road.json")
    assert file.format == "road"
    return build_alignment(file, declaration=AlignmentDeclaration(realization="ITRF2014"), name="r")


@pytest.mark.parametrize("start", [(8.0, 49.0), (179.995, -17.0)], ids=["inland", "antimeridian"])
@pytest.mark.parametrize("driving_side", ["right", "left"])
def test_lanes_lie_at_their_offsets_from_the_axis(start: tuple[float, float], driving_side: str) -> None:
    lanes = RoadLanes(forward=2, backward=1, width_m=3.25, speed_limit_kmh=70, driving_side=driving_side)  # type: ignore[arg-type]
    given = road(start, lanes=lanes)
    axis = Axis(given.parts)
    sign = -1.0 if driving_side == "right" else 1.0
    offsets = {"forward 1": sign * 1.625, "forward 2": sign * 4.875, "backward 1": -sign * 1.625}
    built = read(given)
    assert {lane.name for lane in built.lanes} == set(offsets)
    for lane in built.lanes:
        feet = axis.locate(lane.lon_deg[5:-5:10], lane.lat_deg[5:-5:10], 20.0)
        found = np.array([foot[0].offset_m for foot in feet])
        assert np.abs(found - offsets[lane.name]).max() < 0.005
        assert lane.width_m == pytest.approx(3.25)
        assert lane.design_speed_m_s * 3.6 == pytest.approx(70)
        chainages = np.array([foot[0].chainage_m for foot in feet])
        assert np.all(np.diff(chainages) > 0) == lane.name.startswith("forward")
        # stations are chainages of the axis; in a wedge at a vertex the plain foot differs by centimetres
        assert np.abs(lane.station_m[5:-5:10] - chainages).max() < 0.2


def test_a_road_of_one_direction_has_its_axis_in_the_middle() -> None:
    given = road(lanes=RoadLanes(forward=2, backward=0, speed_limit_kmh=70, edge_style="solid", lane_style="dashed"))  # type: ignore[arg-type]
    axis = Axis(given.parts)
    built = read(given)
    offsets = [axis.locate(lane.lon_deg[50:51], lane.lat_deg[50:51], 20.0)[0][0].offset_m for lane in built.lanes]
    assert offsets == pytest.approx([1.75, -1.75], abs=0.005)
    styles = [(lane.left_style, lane.right_style) for lane in built.lanes]
    assert styles == [(BoundaryStyle.SOLID, BoundaryStyle.DASHED), (BoundaryStyle.DASHED, BoundaryStyle.SOLID)]


def test_stations_are_the_measures_of_the_road() -> None:
    stations = [
        CalibrationPoint(part=0, chainage_m=100.0, measure_m=1100.0),
        CalibrationPoint(part=0, chainage_m=600.0, measure_m=1602.0),
        CalibrationPoint(part=0, chainage_m=900.0, measure_m=1902.0, ahead_m=5000.0),
    ]
    built = read(road(calibration=stations))
    (stationing,) = built.stationing.values()
    shown = [stationing.displayed_m(at) for at in (0.0, 100.0, 350.0, 600.0, 700.0, 900.0, 1000.0)]
    assert shown == pytest.approx([1000.0, 1100.0, 1351.0, 1602.0, 1702.0, 5000.0, 5100.0], abs=1e-6)
    assert [equation.ahead_m - equation.back_m for equation in stationing.equations] == pytest.approx([0, 0, 3098])


def test_an_alignment_is_as_accurate_as_its_road() -> None:
    built = read(road(exact=False, note="from EPSG:4269: no operation states an accuracy"))
    assert built.grade is LocalizationGrade.UNFIT
    assert built.transform_accuracy_m is None
    assert any("EPSG:4269" in warning for warning in built.warnings)
    known = read(road(accuracy_m=0.05))
    assert (known.grade, known.transform_accuracy_m, known.realization) == (LocalizationGrade.CM, 0.05, "ITRF2014")


def test_long_edges_follow_the_geodesic() -> None:
    (lon_a, lat_a), (lon_b, lat_b) = line((8.0, 60.0), (90.0, 14_999.0))
    cut = cut_edges(np.array([(lon_a, lat_a), (lon_a, lat_a), (lon_b, lat_b)]))
    assert len(cut) == 31
    away = GEOD.inv(cut[:-1, 0], cut[:-1, 1], cut[1:, 0], cut[1:, 1])[2]
    assert away == pytest.approx(14_999.0 / 30)
    middle = GEOD.npts(lon_a, lat_a, lon_b, lat_b, 1)[0]
    assert GEOD.inv(*cut[15], *middle)[2] < 1e-6


@pytest.mark.parametrize(
    ("lanes", "steps", "match"),
    [
        ({"forward": 0, "backward": 0}, BEND, "0 vertices"),
        ({"forward": 8, "backward": 0}, TIGHT, "lane forward 1, chainage"),
        ({}, [(90.0, 3.0)], "no lane is left"),
        ({}, [(90.0, 25_000.0)], "25"),
        ({}, [], "vert"),
    ],
    ids=["no lanes", "tighter than the lanes", "too short", "a swapped vertex", "one vertex"],
)
def test_roads_without_usable_lanes_are_refused(
    lanes: dict[str, Any], steps: list[tuple[float, float]], match: str
) -> None:
    given = road(lanes=RoadLanes(speed_limit_kmh=50, **lanes), parts=[line((8.0, 49.0), *steps)])
    with pytest.raises(InvalidParameter, match=match) as refused:
        read(given)
    assert refused.value.cure


@pytest.mark.parametrize(
    "change",
    [
        {"parts": [[[8.0, 95.0], [8.1, 49.0]]]}, {"parts": "x"}, {"more": 1}, {"lanes": {"speed_limit_kmh": 900}},
        {"lanes": None}, {"parts": [[[8.0, None], [8.1, 49.0]]]},
    ],
)  # fmt: skip
def test_damaged_documents_are_refused(change: dict[str, Any]) -> None:
    document = orjson.loads(write_registered_road(road())) | change
    with pytest.raises(UnreadableUpload, match="registered road"):
        read_alignment(orjson.dumps(document), "road.json")
