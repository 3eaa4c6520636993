"""Stakeout files: read back by the survey import and by other programs they give the plan's positions."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pyogrio
import pytest
import shapely
from ezdxf.filemanagement import read as read_dxf
from pyproj import Transformer

from app.errors import InvalidParameter, ReferenceSystemError
from app.formats.surveys.coordinates import crs_unit
from app.formats.surveys.declaration import METRES, ImportDeclaration
from app.formats.surveys.read import read_survey
from app.geodesy import place_positions, reference_system
from app.planning.alignment import Alignment
from app.planning.outputs.stakeout import Stakeout, StakeoutFormat, plan_stakeout, write_stakeout
from app.planning.plan import Plan, PlannedTag
from tests.planning.outputs.made import full_plan
from tests.planning.roads import GEOD

SYSTEMS = [
    ("EPSG:32632", "m", {}),
    ("EPSG:32632", "ft-intl", {}),
    ("EPSG:32632", "ft-us", {}),
    ("EPSG:25832", "m", {"epoch": 2010.0, "realization": "ITRF2014"}),  # ETRS89
    ("EPSG:31467", "m", {"crs": "EPSG:31467", "transform_accuracy_m": None}),  # undoes what has no stated accuracy
]


def plan_in(**road: Any) -> Plan:
    plan = full_plan()
    return replace(plan, alignment=replace(plan.alignment, **road))


def read_back(data: bytes, stakeout: Stakeout, **declared: Any) -> tuple[Any, Any]:
    """Positions by the survey import, as a crew's file would come back."""
    road = stakeout.plan.alignment
    terms = {"vertical_datum": "ellipsoid", **declared}
    table = read_survey(data, ImportDeclaration(crs=stakeout.crs, unit=stakeout.unit, **terms))
    scale = METRES[table.unit] / METRES[crs_unit(reference_system(stakeout.crs))]
    assert table.height is not None
    placed = place_positions(
        table.first * scale, table.second * scale, np.full_like(table.first, np.nan), crs=stakeout.crs,
        epoch=road.epoch, realization=road.realization,
    )  # fmt: skip
    heights = table.height * METRES[table.height_unit]
    assert heights == pytest.approx([p.marker.height_m for p in stakeout.points], abs=0.001)
    return placed.lon_deg, placed.lat_deg


def assert_same_places(lon: Any, lat: Any, stakeout: Stakeout, within_m: float = 0.001) -> None:
    points = stakeout.points
    away = GEOD.inv([p.lon_deg for p in points], [p.lat_deg for p in points], lon, lat)[2]
    assert np.max(away) < within_m


@pytest.mark.parametrize(("crs", "unit", "road"), SYSTEMS)
def test_pnezd_and_penzd_read_back_within_a_millimetre(crs: str, unit: str, road: dict[str, Any]) -> None:
    stakeout = plan_stakeout(plan_in(**road), crs, unit)
    for form, layout in ((StakeoutFormat.PNEZD, "pnezd"), (StakeoutFormat.PENZD, "penzd")):
        lon, lat = read_back(write_stakeout(stakeout, form), stakeout, layout=layout, height_unit=unit)
        assert_same_places(lon, lat, stakeout)


@pytest.mark.parametrize("unit", ["m", "ft-intl", "ft-us"])
def test_landxml_and_dxf_read_back_in_their_own_unit(unit: str) -> None:
    stakeout = plan_stakeout(full_plan(), "EPSG:32632", unit)
    groups = read_survey(
        write_stakeout(stakeout, StakeoutFormat.LANDXML), ImportDeclaration(vertical_datum="ellipsoid")
    )
    assert groups.unit == unit
    assert groups.crs == "EPSG:32632"
    by_name = dict(zip(groups.texts["point"], zip(groups.first, groups.second, strict=True), strict=True))
    assert [by_name[p.name] for p in stakeout.points] == [
        pytest.approx((p.east, p.north), abs=1e-4) for p in stakeout.points
    ]
    document = read_dxf(io.StringIO(write_stakeout(stakeout, StakeoutFormat.DXF).decode()))
    assert document.header["$INSUNITS"] == {"m": 6, "ft-intl": 2, "ft-us": 21}[unit]
    assert not document.audit().errors
    blocks = document.modelspace().query("INSERT")
    marks = document.modelspace().query("POINT")
    assert len(blocks) == len(marks) == len(stakeout.points)
    for point, block, mark in zip(stakeout.points, blocks, marks, strict=True):
        assert tuple(mark.dxf.location) == pytest.approx((point.east, point.north, point.height), abs=1e-4)
        assert tuple(block.dxf.insert) == pytest.approx((point.east, point.north, point.height), abs=1e-4)
        assert block.get_attrib_text("NUMBER") == point.name
        assert block.get_attrib_text("STATION") == point.station
        assert block.dxf.layer == mark.dxf.layer == f"WAYMARK-{point.code}"
    assert {layer.dxf.name for layer in document.layers} >= {"WAYMARK-PLATE", "WAYMARK-MAGT", "WAYMARK-CERPM"}


def test_geopackage_and_geojson_have_the_same_places(tmp_path: Path) -> None:
    stakeout = plan_stakeout(full_plan(), "EPSG:32632", "ft-us")
    path = tmp_path / "stakeout.gpkg"
    path.write_bytes(write_stakeout(stakeout, StakeoutFormat.GPKG))
    meta, _, geometry, columns = pyogrio.raw.read(path)
    assert meta["crs"] == "EPSG:32632"
    xyz = shapely.get_coordinates(shapely.from_wkb(geometry), include_z=True)
    lon, lat = Transformer.from_crs(32632, 4326, always_xy=True).transform(xyz[:, 0], xyz[:, 1])
    assert_same_places(lon, lat, stakeout, 1e-4)
    assert xyz[:, 2] == pytest.approx([p.marker.height_m for p in stakeout.points], abs=1e-4)
    assert list(columns[list(meta["fields"]).index("point")]) == [p.name for p in stakeout.points]
    features = orjson.loads(write_stakeout(stakeout, StakeoutFormat.GEOJSON))["features"]
    places = np.array([feature["geometry"]["coordinates"][:2] for feature in features])
    assert_same_places(places[:, 0], places[:, 1], stakeout)
    assert features[0]["properties"]["easting"] == pytest.approx(stakeout.points[0].east, abs=1e-4)
    assert features[0]["properties"]["unit"] == "ft-us"


def test_tags_are_staked_magnet_by_magnet() -> None:
    plan = full_plan()
    stakeout = plan_stakeout(plan)
    tags = [marker for marker in plan.markers if isinstance(marker.detail, PlannedTag)]
    assert len(stakeout.points) == len(plan.markers) + 2 * len(tags)
    for marker in tags:
        assert isinstance(marker.detail, PlannedTag)
        points = [p for p in stakeout.points if p.marker is marker]
        assert [p.name for p in points] == [f"{marker.number}{letter}" for letter in "ABC"]
        away = [np.hypot(p.east - points[0].east, p.north - points[0].north) for p in points]
        assert away == pytest.approx(marker.detail.tag.offsets_m, rel=0.0005), "the grid's scale is within 0.05 %"
        along = np.degrees(np.arctan2(points[-1].east - points[0].east, points[-1].north - points[0].north))
        for point, polarity in zip(points, marker.detail.tag.polarities, strict=True):
            turned = along + (0 if polarity.value == "N" else 180)
            assert point.bearing_deg is not None
            assert (point.bearing_deg - turned + 180) % 360 - 180 == pytest.approx(0, abs=0.01)


def test_bearings_are_from_grid_north() -> None:
    stakeout = plan_stakeout(full_plan(), "EPSG:32632")  # 8.4 E is 0.6 degrees west of its meridian
    point = next(p for p in stakeout.points if p.kind == "plate")
    assert point.bearing_deg is not None
    # convergence of transverse Mercator: atan(tan(lon - lon0) sin(lat)), Snyder (1987)
    convergence = np.degrees(np.arctan(np.tan(np.radians(point.lon_deg - 9)) * np.sin(np.radians(point.lat_deg))))
    assert point.marker.heading_deg - point.bearing_deg == pytest.approx(convergence, abs=0.002)


def test_the_same_stakeout_gives_the_same_bytes() -> None:
    for form in StakeoutFormat:
        assert write_stakeout(plan_stakeout(full_plan()), form) == write_stakeout(plan_stakeout(full_plan()), form)


def test_the_readme_states_system_unit_and_accuracy() -> None:
    road: dict[str, Any] = {"epoch": 2010.0, "realization": "ITRF2014", "surveyed": False}
    stakeout = plan_stakeout(plan_in(**road), "EPSG:25832", "ft-us")
    text = write_stakeout(stakeout, StakeoutFormat.README).decode()
    assert "EPSG:25832 (ETRS89 / UTM zone 32N)" in text
    assert "ft-us" in text
    assert f"Stated accuracy of the transformation: {stakeout.accuracy_m:g} m" in text
    assert stakeout.accuracy_m > 0
    assert "NOT SURVEYED" in text


def test_the_road_s_own_projected_system_is_the_default() -> None:
    assert plan_stakeout(full_plan()).crs == "EPSG:32632", "a road in degrees: its UTM zone"
    road: dict[str, Any] = {"crs": "EPSG:25832", "epoch": 2010.0}
    stakeout = plan_stakeout(plan_in(**road))
    assert stakeout.crs == "EPSG:25832"
    assert stakeout.accuracy_m == 0, "the transformation by which the road came is undone"
    assert plan_stakeout(plan_in(crs="local", surveyed=False)).crs == "EPSG:32632"


@pytest.mark.parametrize(
    ("crs", "unit", "error", "part"),
    [
        ("EPSG:4326", None, InvalidParameter, "geographic"),
        ("EPSG:99999", None, ReferenceSystemError, "EPSG registry"),
        ("nonsense", None, ReferenceSystemError, "not a coordinate reference system"),
        ("EPSG:2263", None, ReferenceSystemError, "outside the area of use"),
        ("EPSG:25832", None, ReferenceSystemError, "epoch"),
        ("EPSG:32632", "cubit", InvalidParameter, "cubit"),
    ],
)
def test_what_cannot_be_staked_is_refused(crs: str, unit: str | None, error: type[Exception], part: str) -> None:
    with pytest.raises(error, match=part) as raised:
        plan_stakeout(full_plan(), crs, unit)
    assert getattr(raised.value, "cure", None)


def test_a_plan_without_markers_is_not_staked() -> None:
    with pytest.raises(InvalidParameter, match="no markers"):
        plan_stakeout(Plan("empty", Alignment("road", ()), full_plan().rules, ()))
