"""GeoPackages and Shapefiles, as GDAL writes them."""

from __future__ import annotations

import io
import sqlite3
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio.raw
import pytest
import shapely

from app.errors import ReferenceSystemError, UnreadableUpload
from app.formats.alignments.geometry import AlignmentFile, EventKind
from app.formats.alignments.read import read_alignment

UTM = "EPSG:25832"
FEET = "EPSG:2263"  # New York Long Island, US survey foot


def _write(path: Path, shapes: list[Any], shape: str, layer: str, crs: str = UTM, /, **fields: list[Any]) -> None:
    pyogrio.raw.write(
        str(path),
        np.array([shapely.to_wkb(shape) for shape in shapes], dtype=object),
        [np.array(values) for values in fields.values()],
        list(fields),
        geometry_type=shape,
        crs=crs,
        layer=layer,
        append=path.exists(),
    )


def _lines(*heights: float) -> list[Any]:
    z = heights[0] if heights else None
    points = [(456_000 + k * 10.0, 5_430_000.0) for k in range(4)]
    return [shapely.LineString([(*p, z) if z is not None else p for p in points])]


def _gpkg(path: Path) -> AlignmentFile:
    return read_alignment(path.read_bytes(), path.name)


def test_layers_of_a_geopackage(tmp_path: Path) -> None:
    path = tmp_path / "road.gpkg"
    _write(
        path, _lines(110.0) * 2, "LineString Z", "lanes", lane=[1, 2], width_m=[3.5, np.nan], maxspeed=["50", "30 mph"]
    )
    _write(path, [shapely.Point(456_010, 5_430_001)], "Point", "stop_line", lane=["2"])
    _write(path, [shapely.box(456_000, 5_429_990, 456_002, 5_430_010)], "Polygon", "Bridges", name=["b"])
    file = _gpkg(path)
    assert (file.format, file.crs, file.unit_m) == ("gpkg", UTM, None)
    first, second = file.lanes
    assert (first.name, second.name) == ("1", "2")
    assert first.centre is not None
    assert first.centre[:, 2].tolist() == [110.0] * 4
    assert first.width_m is not None
    assert second.width_m is None
    assert second.speed_limit_m_s == pytest.approx(np.full(4, 30 * 0.44704))
    (event,) = file.events
    assert (event.kind, event.lane, event.point) == (EventKind.STOP_LINE, "2", (456_010.0, 5_430_001.0))
    (area,) = file.areas
    assert area.kind == "bridges"
    assert area.ring.shape == (5, 2)


def test_a_layer_with_any_name_holds_lanes_and_multi_lines_are_joined(tmp_path: Path) -> None:
    path = tmp_path / "road.gpkg"
    halves = shapely.MultiLineString([[(0, 0), (10, 0)], [(10, 0), (20, 0)]])
    _write(path, [halves], "MultiLineString", "B 27 Nord")
    (lane,) = _gpkg(path).lanes
    assert lane.centre is not None
    assert lane.centre[:, 0].tolist() == [0.0, 10.0, 20.0]
    assert np.isnan(lane.centre[:, 2]).all()


def test_layers_in_different_systems_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "road.gpkg"
    _write(path, _lines(), "LineString", "lanes")
    _write(path, [shapely.Point(8.4, 49)], "Point", "arrow", "EPSG:4326")
    with pytest.raises(ReferenceSystemError, match=r"different CRSs \(lanes: EPSG:25832, arrow: EPSG:4326\)"):
        _gpkg(path)


def test_views_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "road.gpkg"
    _write(path, _lines(), "LineString", "lanes")
    connection = sqlite3.connect(path)
    connection.execute("CREATE VIEW v AS SELECT * FROM lanes")
    connection.commit()
    connection.close()
    with pytest.raises(UnreadableUpload, match="view"):
        _gpkg(path)


def _zipped(folder: Path) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for part in sorted(folder.glob("lanes.*")):
            archive.write(part, part.name)
    return packed.getvalue()


def test_boundaries_in_a_zipped_shapefile(tmp_path: Path) -> None:
    left, right = (shapely.LineString([(980_000, y), (980_300, y)]) for y in (200_006, 199_994))
    _write(
        tmp_path / "lanes.shp", [left, right], "LineString", "lanes", FEET, side=["L", "R"], lane=[1.0, 1.0],
        speed=[np.nan, np.nan],
    )  # fmt: skip
    file = read_alignment(_zipped(tmp_path))
    assert (file.format, file.crs, file.unit_m) == ("shapefile", FEET, None)
    (lane,) = file.lanes
    assert lane.name == "1"
    assert lane.left is not None
    assert lane.left[0, 1] == 200_006


def test_damage_is_reported(tmp_path: Path) -> None:
    _write(tmp_path / "lanes.shp", _lines(), "LineString", "lanes")
    data = _zipped(tmp_path)
    with pytest.raises(UnreadableUpload):
        read_alignment(data[: len(data) // 2])
    points = tmp_path / "points"
    points.mkdir()
    _write(points / "lanes.shp", [shapely.Point(1, 2)], "Point", "lanes", kind=["arrow"])
    with pytest.raises(UnreadableUpload, match="no lanes"):
        read_alignment(_zipped(points))
    with pytest.raises(UnreadableUpload):
        read_alignment(b"SQLite format 3\x00" + bytes(1000))
