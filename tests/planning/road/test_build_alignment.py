"""Lanes in WGS 84: places, true distances, directions, values, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from pyproj import CRS, Geod, Transformer

from app.errors import InvalidParameter, ReferenceSystemError
from app.formats.alignments.geometry import (
    AlignmentDeclaration,
    AlignmentFile,
    AreaGeometry,
    EventGeometry,
    EventKind,
    LaneGeometry,
)
from app.geodesy import LocalizationGrade
from app.planning.alignment import Alignment, Lane
from app.planning.build_alignment import build_alignment
from app.planning.rules import RoadRules

from .roads import RULES, build, centre_lane, east_north, wgs84

GEOD = Geod(ellps="WGS84")


def _arc_lane(radius_m: float, turn_rad: float) -> tuple[LaneGeometry, float]:
    """50 m straight, an arc, 50 m straight, sampled within 1 mm, with curvature; and the length."""
    arc_m = radius_m * turn_rad
    angles = np.linspace(0, turn_rad, math.ceil(turn_rad / (2 * math.acos(1 - 0.001 / radius_m))) + 1)
    arc = np.stack([50 + radius_m * np.sin(angles), radius_m * (1 - np.cos(angles))], axis=1)
    end = arc[-1] + 50 * np.array([math.cos(turn_rad), math.sin(turn_rad)])
    points = np.concatenate([[[0, 0]], arc[:1], arc, arc[-1:], [end]])
    curvature = np.concatenate([[0, 0], np.full(len(arc), 1 / radius_m), [0, 0]])
    return centre_lane(points, curvature_per_m=curvature), 100 + arc_m


def _lane(lane: LaneGeometry, **rules: object) -> Lane:
    return build(lane, rules=RoadRules(**{"design_speed_kmh": 50.0} | rules)).lanes[0]  # type: ignore[arg-type]


@pytest.mark.parametrize("radius_m", [6.0, 20.0, 300.0])
def test_samples_lie_on_the_arcs_that_the_file_defines(radius_m: float) -> None:
    geometry, length_m = _arc_lane(radius_m, math.pi / 2)
    lane = _lane(geometry)
    assert lane.length_m == pytest.approx(length_m, abs=2e-4)
    arc = (lane.chainage_m > 50.001) & (lane.chainage_m < length_m - 50.001)
    points = east_north(lane.lon_deg, lane.lat_deg)
    assert np.abs(np.hypot(points[arc, 0] - 50, points[arc, 1] - radius_m) - radius_m).max() < 1e-4
    assert np.abs(points[lane.chainage_m < 50, 1]).max() < 1e-4
    np.testing.assert_allclose(lane.curvature_per_m[arc], 1 / radius_m, rtol=1e-6)
    assert np.abs(lane.curvature_per_m[lane.chainage_m < 49.9]).max() == 0.0
    expected = 90 - np.degrees(np.clip((lane.chainage_m - 50) / radius_m, 0, math.pi / 2))
    assert np.abs((lane.heading_deg - expected + 180) % 360 - 180).max() < 0.02


def test_polylines_are_kept() -> None:
    points = np.array([[0.0, 0.0], [30.0, 0.0], [60.0, 4.0], [90.0, 0.0]])
    lane = _lane(centre_lane(points))
    assert lane.length_m == pytest.approx(np.hypot(*np.diff(points, axis=0).T).sum(), abs=1e-5)
    expected = np.interp(lane.chainage_m, [0, 30, 30 + math.hypot(30, 4), lane.length_m], points[:, 1])
    assert np.abs(east_north(lane.lon_deg, lane.lat_deg)[:, 1] - expected).max() < 1e-4


def test_chainages_are_distances_on_the_ellipsoid_over_a_hundred_kilometres() -> None:
    azimuth = 63.0
    distances = np.arange(0.0, 100_001.0, 25.0)
    lon, lat, _ = GEOD.fwd(*(np.full(len(distances), v) for v in (8.0, 60.0, azimuth)), distances)
    lane = _lane(LaneGeometry("1", np.column_stack([lon, lat, np.full(len(lon), np.nan)])))
    assert lane.length_m == pytest.approx(100_000.0, abs=0.001)
    chosen = lane.chainage_m[::997]
    want_lon, want_lat, _ = GEOD.fwd(*(np.full(len(chosen), v) for v in (8.0, 60.0, azimuth)), chosen)
    _, _, away = GEOD.inv(want_lon, want_lat, lane.lon_deg[::997], lane.lat_deg[::997])
    assert np.max(away) < 0.001
    assert np.abs(lane.curvature_per_m).max() < 1e-6
    assert lane.step_m <= 1.0


def test_a_long_lane_between_boundaries_is_accurate_far_from_its_middle() -> None:
    distances = np.arange(0.0, 60_001.0, 20.0)
    start = [np.full(len(distances), v) for v in (8.0, 50.0, 90.0)]
    lon, lat, back = GEOD.fwd(*start, distances)
    sides = {}
    for name, turn in (("left", -90.0), ("right", 90.0)):
        side_lon, side_lat, _ = GEOD.fwd(lon, lat, np.asarray(back) + 180 + turn, np.full(len(lon), 1.8))
        sides[name] = np.column_stack([side_lon, side_lat, np.full(len(lon), np.nan)])
    lane = _lane(LaneGeometry("1", **sides))
    assert lane.length_m == pytest.approx(60_000.0, abs=0.002)
    chosen = lane.chainage_m[::499]
    want_lon, want_lat, _ = GEOD.fwd(*(np.full(len(chosen), v) for v in (8.0, 50.0, 90.0)), chosen)
    _, _, away = GEOD.inv(want_lon, want_lat, lane.lon_deg[::499], lane.lat_deg[::499])
    assert np.max(away) < 0.0015
    np.testing.assert_allclose(lane.width_m, 3.6, atol=0.001)


def test_straight_lines_are_straight_in_the_coordinates_of_the_file() -> None:
    """RFC 7946, section 3.1.1: a line between two positions is straight in longitude and latitude."""
    lane = _lane(LaneGeometry("1", np.array([[8.0, 60.0, np.nan], [8.2, 60.0, np.nan]])))
    assert np.abs(lane.lat_deg - 60.0).max() < 1e-9
    utm = np.array([[400_000.0, 6_600_000.0, np.nan], [410_000.0, 6_600_000.0, np.nan]])
    lane = build(LaneGeometry("1", utm), crs="EPSG:32632").lanes[0]
    back = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    assert np.abs(back.transform(lane.lon_deg, lane.lat_deg)[1] - 6_600_000.0).max() < 0.001


@pytest.mark.parametrize("first", [179.99, -179.99])
def test_a_road_across_the_antimeridian(first: float) -> None:
    second = -first
    lane = _lane(LaneGeometry("1", np.array([[first, -17.0, 0.0], [second, -17.0, 0.0]])))
    assert lane.length_m == pytest.approx(0.02 * 111_320 * math.cos(math.radians(17)), rel=0.002)
    assert np.abs(lane.lon_deg).min() > 179.9
    assert np.abs(lane.lon_deg).max() <= 180.0
    assert lane.heading_deg[100] == pytest.approx(90.0 if first > 0 else 270.0, abs=0.1)
    sides = [np.array([[first, lat, np.nan], [second, lat, np.nan]]) for lat in (-17.0, -17.00003)]
    if first < 0:
        sides.reverse()
    between = _lane(LaneGeometry("1", left=sides[0], right=sides[1]))
    assert between.length_m == pytest.approx(lane.length_m, abs=0.1)


def test_values_along_the_lane() -> None:
    points = np.array([[0.0, 0.0], [40.0, 0.0], [40.0, 0.0], [100.0, 0.0]])
    centre = wgs84(points)
    centre[:, 2] = [100.0, 102.0, 102.0, 102.0]
    lane = LaneGeometry(
        "1",
        centre,
        curvature_per_m=np.zeros(4),
        superelevation_rad=np.array([0.0, 0.02, 0.02, 0.02]),
        width_m=np.array([3.0, 4.0, 4.0, 4.0]),
        speed_limit_m_s=np.array([10.0, 20.0, 20.0, 20.0]),
        station_m=np.array([1000.0, 960.0, 960.0, 900.0]),
        road="A 5",
    )
    file = AlignmentFile("geojson", (lane,))
    alignment = build_alignment(file, RULES, AlignmentDeclaration(vertical_datum="EPSG:5783"))
    built = alignment.lanes[0]
    assert built.road == "A 5"
    assert alignment.vertical_datum == "EPSG:5783"
    assert built.value_at(built.width_m, 20.0) == pytest.approx(3.5, abs=1e-6)
    assert built.value_at(built.superelevation_rad, 20.0) == pytest.approx(0.01, abs=1e-6)
    assert built.value_at(built.station_m, [20.0, 70.0]) == pytest.approx([980.0, 930.0], abs=1e-4)
    assert built.value_at(built.height_m, 20.0) == pytest.approx(101.0, abs=1e-6)
    assert built.value_at(built.grade, [15.0, 80.0]) == pytest.approx([0.05, 0.0], abs=0.002)
    assert built.design_speed_m_s[[0, 39, 41, -1]].tolist() == [10.0, 10.0, 20.0, 20.0]
    (event,) = alignment.events
    assert (event.kind, event.value) == (EventKind.SPEED_LIMIT, 72.0)
    assert 40.0 <= event.chainage_m <= 41.0


def test_what_the_file_leaves_open_comes_from_the_rules() -> None:
    lane = centre_lane([[0, 0], [50, 0]], speed_limit_m_s=np.full(2, 20.0))
    assert _lane(lane).design_speed_m_s[0] == 20.0
    assert _lane(lane, override_speed=True).design_speed_m_s[0] == pytest.approx(50 / 3.6)
    assert _lane(lane, lane_width_m=3.1).width_m[0] == 3.1
    assert build(lane).lanes[0].road == "road"


def test_events_belong_to_the_nearest_lane() -> None:
    lanes = (centre_lane([[0, 0], [100, 0]], "a"), centre_lane([[100, 3.5], [0, 3.5]], "b"))
    places = wgs84(np.array([[30.0, -1.0], [40.0, 4.0], [50.0, 0.0], [60.0, 40.0], [105.0, 0.0]]))[:, :2]
    kinds = (EventKind.STOP_LINE, EventKind.CROSSING, EventKind.ARROW, EventKind.JUNCTION, EventKind.STOP_LINE)
    events = tuple(
        EventGeometry(kind, (float(p[0]), float(p[1])), "b" if kind is EventKind.ARROW else None)
        for kind, p in zip(kinds, places, strict=True)
    )
    alignment = build(*lanes, events=events)
    found = [(e.kind.value, e.lane, round(e.chainage_m, 3)) for e in alignment.events]
    assert found == [("stop_line", "a", 30.0), ("stop_line", "a", 100.0), ("arrow", "b", 50.0), ("crossing", "b", 60.0)]
    assert [w for w in alignment.warnings if "junction" in w and "left out" in w]
    with pytest.raises(InvalidParameter, match="lane 'c', which is not in the file"):
        build(*lanes, events=(EventGeometry(EventKind.STOP_LINE, (8.4, 49.0), "c"),))
    alone = build(*lanes, events=events, rules=RoadRules(design_speed_kmh=50, lanes=["a"]))
    assert {e.lane for e in alone.events} == {"a"}


def test_areas_are_placed() -> None:
    ring = wgs84(np.array([[0.0, -1], [2, -1], [2, 1], [0, -1]]))[:, :2]
    (area,) = build(centre_lane([[0, 0], [100, 0]]), areas=(AreaGeometry("joints", ring),)).areas
    np.testing.assert_allclose(area.ring_deg, ring, atol=1e-12)


def test_an_area_across_the_antimeridian_stands_on_both_sides() -> None:
    lane = LaneGeometry("1", np.array([[179.99, -17.0, np.nan], [-179.99, -17.0, np.nan]]))
    ring = np.array([[179.9999, -17.1], [-179.9999, -17.1], [-179.9999, -16.9], [179.9999, -17.1]])
    near = EventGeometry(EventKind.STOP_LINE, (-179.999, -17.0))
    alignment = build(lane, areas=(AreaGeometry("joints", ring),), events=(near,))
    assert [(round(a.ring_deg[:, 0].min()), np.ptp(a.ring_deg[:, 0]) < 0.001) for a in alignment.areas] == [
        (180, True), (-180, True),
    ]  # fmt: skip
    assert alignment.events[0].chainage_m == pytest.approx(0.011 * 111_320 * math.cos(math.radians(17)), rel=0.002)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 999.0])
def test_events_and_areas_that_cannot_be_placed(bad: float) -> None:
    lane = centre_lane([[0, 0], [100, 0]])
    with pytest.raises(InvalidParameter, match=r"the arrow at 8.4, .* cannot be placed"):
        build(lane, events=(EventGeometry(EventKind.ARROW, (8.4, bad)),))
    ring = np.array([[8.4, 49], [8.5, 49], [8.5, bad], [8.4, 49]])
    with pytest.raises(InvalidParameter, match=r"area 1 \(joints\) at 8.4, 49 cannot be placed"):
        build(lane, areas=(AreaGeometry("joints", ring),))


# --- reference systems ------------------------------------------------------------------------------------------------


def _declared(lane: LaneGeometry, stated: str | None = None, **declaration: object) -> Alignment:
    file = AlignmentFile("dxf", (lane,), stated, unit_m=None)
    return build_alignment(file, RULES, AlignmentDeclaration(**declaration))  # type: ignore[arg-type]


LOCAL = LaneGeometry("1", np.array([[0.0, 0.0, 0.0], [0.0, 100.0, 0.0]]))
UTM = LaneGeometry("1", np.array([[456_000.0, 5_430_000.0, 0.0], [456_100.0, 5_430_000.0, 0.0]]))


def test_local_coordinates_need_an_origin_and_are_not_surveyed() -> None:
    with pytest.raises(ReferenceSystemError, match="local") as refused:
        _declared(LOCAL)
    assert "origin" in str(refused.value.cure)
    alignment = build_alignment(
        AlignmentFile("opendrive", (LOCAL,)), RULES, AlignmentDeclaration(origin=(8.4, 49.0), bearing_deg=30.0)
    )
    lane = alignment.lanes[0]
    assert not alignment.surveyed
    assert alignment.grade is LocalizationGrade.UNFIT
    assert alignment.transform_accuracy_m is None
    assert (lane.lon_deg[0], lane.lat_deg[0]) == pytest.approx((8.4, 49.0), abs=1e-12)
    azimuth, _, distance = GEOD.inv(8.4, 49.0, lane.lon_deg[-1], lane.lat_deg[-1])
    assert azimuth == pytest.approx(30.0, abs=1e-6)
    assert distance == pytest.approx(100.0, abs=1e-6)
    assert any("origin" in warning for warning in alignment.warnings)


@pytest.mark.parametrize(
    ("points", "crs", "exchanged"),
    [
        ([[5_430_000.0, 456_000.0], [5_430_100.0, 456_000.0]], "EPSG:25832", True),
        ([[49.0, 8.4], [49.001, 8.4]], "EPSG:4258", True),
        ([[42.3, -83.0], [42.301, -83.0]], "EPSG:6318", True),
        ([[200_000.0, 986_000.0], [200_000.0, 986_300.0]], "EPSG:6539", True),
        ([[9_456_000.0, 430_000.0], [9_456_100.0, 430_000.0]], "EPSG:25832", False),
        ([[140.0, 8.4], [140.001, 8.4]], "EPSG:4258", False),
    ],
)
def test_exchanged_coordinates_are_named_where_the_area_of_use_shows_them(
    points: list[list[float]], crs: str, exchanged: bool
) -> None:
    lane = LaneGeometry("1", np.column_stack([points, [0.0, 0.0]]))
    with pytest.raises(InvalidParameter, match="outside the area of use") as refused:
        _declared(lane, crs=crs)
    assert ("inside it if the two coordinates are exchanged" in refused.value.message) == exchanged
    assert ("exchange the two" in str(refused.value.cure)) == exchanged


def test_the_problem_of_a_reference_is_reported() -> None:
    file = AlignmentFile("opendrive", (LOCAL,), crs_problem="the geoReference is empty")
    with pytest.raises(ReferenceSystemError, match="the geoReference is empty"):
        build_alignment(file, RULES)


@pytest.mark.parametrize(
    "crs",
    [
        "EPSG:32632",
        "urn:ogc:def:crs:EPSG::32632",
        "+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs",
        CRS("EPSG:32632+5773").to_wkt(),
        "+proj=utm +zone=32 +datum=WGS84 +units=m +geoidgrids=egm96_15.gtx +vunits=m",
        "+proj=tmerc +lat_0=0 +lon_0=9 +k=0.9996 +x_0=500000 +y_0=0 +datum=WGS84 +units=m",
    ],
)
def test_references_in_their_usual_forms_are_known(crs: str) -> None:
    alignment = _declared(UTM, crs, realization="ITRF2014", epoch=2020.0)
    want = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True).transform(456_000.0, 5_430_000.0)
    lane = alignment.lanes[0]
    assert (lane.lon_deg[0], lane.lat_deg[0]) == pytest.approx(want, abs=1e-10)
    assert alignment.grade is LocalizationGrade.CM
    assert alignment.surveyed


@pytest.mark.parametrize("crs", ["+proj=tmerc +lat_0=0 +lon_0=9.1 +k=0.9996 +x_0=500000 +ellps=WGS84", "EPSG:31467"])
def test_without_a_bound_a_road_is_unfit(crs: str) -> None:
    lane = LaneGeometry("1", UTM.centre + np.array([3e6 if crs == "EPSG:31467" else 0.0, 0, 0]))
    alignment = _declared(lane, crs)
    assert alignment.grade is LocalizationGrade.UNFIT
    assert alignment.surveyed
    assert alignment.warnings


def test_the_shift_of_a_datum_without_a_code_is_used() -> None:
    """Without its +towgs84 the road would lie 130 m away."""
    shift = "+towgs84=577.326,90.129,463.919,5.137,1.474,5.297,2.4232"
    crs = f"+proj=tmerc +lat_0=0 +lon_0=9.1 +k=1 +x_0=500000 +y_0=0 +ellps=bessel {shift} +units=m +no_defs"
    alignment = _declared(UTM, crs)
    lane = alignment.lanes[0]
    assert (lane.lon_deg[0], lane.lat_deg[0]) == pytest.approx((8.49836055726, 49.00593998998), abs=1e-9)  # by cs2cs
    assert alignment.grade is LocalizationGrade.UNFIT
    assert any("its own +towgs84" in warning for warning in alignment.warnings)


def test_an_ellipsoid_alone_is_no_datum() -> None:
    """Bessel's ellipsoid has the datums of many countries: the first one that the registry lists was taken."""
    lane = LaneGeometry("1", UTM.centre + np.array([3e6, 0, 0]))
    grid = "+proj=tmerc +lat_0=0 +lon_0=9 +k=1 +x_0=3500000 +y_0=0 +ellps=bessel +units=m +no_defs"
    alone = _declared(lane, grid)
    assert alone.grade is LocalizationGrade.UNFIT
    assert any("no known datum" in warning for warning in alone.warnings)
    assert _declared(lane, grid, crs="EPSG:31467").crs == "EPSG:31467", "the declaration says which datum it is"
    with pytest.raises(ReferenceSystemError, match="the declaration has EPSG:31468"):
        _declared(lane, grid, crs="EPSG:31468")


def test_heights_are_in_the_datum_and_unit_of_a_compound_system() -> None:
    assert UTM.centre is not None
    lane = LaneGeometry("1", UTM.centre + np.array([0.0, 0.0, 700.0]))
    wkt = CRS("EPSG:26917+6360").to_wkt()  # heights above NAVD88 in US survey feet
    built = _declared(lane, wkt)
    assert built.vertical_datum == "EPSG:5703"
    assert built.lanes[0].height_m == pytest.approx(700 * 1200 / 3937)
    with pytest.raises(InvalidParameter, match="the declaration has ellipsoid"):
        _declared(lane, wkt, vertical_datum="ellipsoid")


def test_the_horizontal_part_of_a_compound_code_is_used() -> None:
    assert _declared(UTM, "EPSG:5555").crs == "EPSG:25832"


def test_the_epoch_of_a_dynamic_transformation_is_that_of_the_positions() -> None:
    lane = LaneGeometry("1", np.array([[-77.2, 38.9, np.nan], [-77.199, 38.9, np.nan]]))
    assert _declared(lane, "EPSG:6318").epoch == 2020.0
    alignment = _declared(lane, "EPSG:6318", epoch=2010.0)
    assert alignment.grade is LocalizationGrade.CM
    assert alignment.realization == "ITRF2014"
    assert alignment.epoch == 2010.0


@pytest.mark.parametrize(
    ("crs", "declaration", "error"),
    [
        ("EPSG:32632", {"crs": "EPSG:25832"}, "the file is in EPSG:32632, the declaration has EPSG:25832"),
        ("EPSG:32632", {"origin": (8.0, 49.0)}, "an origin is declared"),
        ("+init=/etc/passwd:x", {}, "cannot be used"),
        ("+proj=utm +zone=32 +nadgrids=/etc/passwd", {}, "cannot be used"),
        ("proj=utm zone=32 nadgrids=/etc/passwd", {}, "cannot be used"),
        ("nonsense", {}, "cannot be used"),
        ("EPSG:5783", {}, "cannot be used|does not place"),
        (None, {"crs": "EPSG:999999"}, "not in the EPSG registry"),
    ],
)
def test_references_that_cannot_be_used(crs: str | None, declaration: dict[str, object], error: str) -> None:
    with pytest.raises(ReferenceSystemError, match=error):
        _declared(UTM, crs, **declaration)


def test_units() -> None:
    feet = LaneGeometry("1", UTM.centre[:, :3] / 0.3048)
    file = AlignmentFile("dxf", (feet,), unit_m=0.3048)
    lane = build_alignment(file, RULES, AlignmentDeclaration(crs="EPSG:32632")).lanes[0]
    assert lane.length_m == pytest.approx(100 / 0.9996, abs=0.05)
    unstated = replace(file, unit_m=None)
    same = build_alignment(unstated, RULES, AlignmentDeclaration(crs="EPSG:32632", unit="ft-intl")).lanes[0]
    assert same.lon_deg[0] == lane.lon_deg[0]
    with pytest.raises(InvalidParameter, match="unit"):
        build_alignment(file, RULES, AlignmentDeclaration(crs="EPSG:32632", unit="ft-us"))
    with pytest.raises(InvalidParameter, match="area of use"):
        build_alignment(replace(file, unit_m=1.0), RULES, AlignmentDeclaration(crs="EPSG:32632"))


def test_heights_need_a_datum() -> None:
    lane = LaneGeometry("1", np.array([[8.4, 49.0, 110.0], [8.401, 49.0, 111.0]]))
    with pytest.raises(InvalidParameter, match="vertical datum") as refused:
        build(lane)
    assert refused.value.field == "vertical_datum"
    file = AlignmentFile("geojson", (lane,))
    without = build_alignment(file, RULES, AlignmentDeclaration(ignore_heights=True)).lanes[0]
    assert np.isnan(without.height_m).all()
    flat = LaneGeometry("1", lane.centre * (1, 1, 0))
    assert np.isnan(build(flat).lanes[0].height_m).all()
    assert build(flat).vertical_datum is None


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"origin": (8.0, 49.0), "crs": "EPSG:4326"}, "origin"),
        ({"bearing_deg": 10.0}, "bearing_deg"),
        ({"origin": (8.0, 49.0), "bearing_deg": math.nan}, "bearing_deg"),
        ({"origin": (200.0, 49.0)}, "origin.lon_deg"),
        ({"unit": "yd"}, "unit"),
        ({"epoch": 1066.0}, "epoch"),
    ],
)
def test_declarations_that_contradict_themselves(values: dict[str, object], field: str) -> None:
    with pytest.raises(InvalidParameter) as refused:
        AlignmentDeclaration(**values)  # type: ignore[arg-type]
    assert refused.value.field == field
