"""Reference systems that files state: compound ones, WKT 2, longitude and latitude of the OGC, three axes."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from pydantic import ValidationError
from pyogrio import raw
from pyproj import CRS

from app.errors import InvalidParameter, WaymarkError
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.read import read_survey
from app.formats.surveys.table import SurveyTable
from app.geodesy.systems import split_heights
from tests.api.surveys.survey_files import COUNTY_GRID

UTM = [(457000.0 + k * 10, 5428000.0, 112.0 + k) for k in range(3)]
DEGREES = [(8.4 + k * 1e-4, 49.0, 112.0 + k) for k in range(3)]
NAVD = [(-77.1 + k * 1e-4, 38.9, 10.0 + k) for k in range(3)]


def layer(folder: Path, points: Sequence[tuple[float, ...]], crs: str | None, prj: str | None = None) -> bytes:
    """A GeoPackage, or with a text of the .prj a Shapefile."""
    shapes = shapely.to_wkb(shapely.points(points))
    numbers = np.array([str(k) for k in range(len(points))], dtype=object)
    driver, name = ("GPKG", "survey.gpkg") if prj is None else ("ESRI Shapefile", "survey.shp")
    raw.write(folder / name, shapes, [numbers], ["number"], driver=driver, geometry_type="Point Z", crs=crs)
    if prj is None:
        return (folder / name).read_bytes()
    (folder / "survey.prj").write_text(prj)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for part in folder.glob("survey.*"):
            archive.write(part, part.name)
    return packed.getvalue()


def read(data: bytes, **declared: Any) -> SurveyTable:
    return read_survey(data, ImportDeclaration(family="cerpm", **declared))


def check(table: SurveyTable, points: Sequence[tuple[float, ...]], crs: str, datum: str) -> None:
    assert (table.crs, table.vertical_datum, table.height_unit) == (crs, datum, "m")
    assert table.height is not None
    assert np.column_stack([table.first, table.second, table.height]).tolist() == [list(point) for point in points]
    assert not table.faults.counts


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("version", ["WKT1_GDAL", "WKT1_ESRI", "WKT2_2019", "WKT2_2015", "gpkg"])
@pytest.mark.parametrize(
    ("compound", "points", "crs", "datum"),
    [("EPSG:5555", UTM, "EPSG:25832", "EPSG:5783"), ("EPSG:6349", NAVD, "EPSG:6318", "EPSG:5703")],
)
def test_a_compound_system_states_the_datum_of_the_heights(
    tmp_path: Path, version: Any, compound: str, points: list[tuple[float, ...]], crs: str, datum: str
) -> None:
    if version == "gpkg":
        data = layer(tmp_path, points, compound)
    else:
        data = layer(tmp_path, points, None, CRS(compound).to_wkt(version))
    check(read(data), points, crs, datum)
    check(read(data, crs=crs, vertical_datum=datum), points, crs, datum)
    check(read(data, crs=compound), points, crs, datum)
    for other in ("ellipsoid", "EPSG:7837"):
        with pytest.raises(InvalidParameter, match=f"above {datum}") as refused:
            read(data, vertical_datum=other)
        assert (refused.value.field, refused.value.limit) == ("vertical_datum", datum)
    assert read(data, ignore_heights=True).height is None


def test_a_compound_system_is_declared() -> None:
    lines = "".join(f"{k},{x},{y},{z}\n" for k, (x, y, z) in enumerate(UTM))
    data = f"number,easting,northing,height\n{lines}".encode()
    check(read(data, crs="EPSG:5555"), UTM, "EPSG:25832", "EPSG:5783")
    check(read(data, crs="urn:ogc:def:crs:EPSG::5555", vertical_datum="DHHN92"), UTM, "EPSG:25832", "EPSG:5783")
    with pytest.raises(ValidationError, match="the declaration has ellipsoid"):
        read(data, crs="EPSG:5555", vertical_datum="ellipsoid")
    assert read(data, crs="EPSG:5555", ignore_heights=True).vertical_datum is None


def test_heights_of_a_compound_system_in_feet_and_below() -> None:
    feet = ("NAVD88 height (ftUS)", "EPSG:5703", pytest.approx(1200 / 3937, rel=1e-12), False)
    assert split_heights("EPSG:8720") == ("EPSG:2231", feet)
    data = b"number,easting,northing,height\n1,500000,300000,5280\n2,500010,300000,5281\n"
    with pytest.raises(ValidationError, match="'NGVD29 height \\(ftUS\\)', a vertical datum that is not known"):
        read(data, crs="EPSG:7407", unit="ft-us", height_unit="ft-us")
    with pytest.raises(ValidationError, match="are depths"):
        read(b"number,lon,lat,height\n1,4,52,5\n", crs="EPSG:9289", vertical_datum="EPSG:5709")


@pytest.mark.filterwarnings("ignore")
def test_a_prj_of_wkt_2(tmp_path: Path) -> None:
    texts = {CRS("EPSG:25832").to_wkt(version) for version in ("WKT2_2019", "WKT2_2015")}
    texts |= {re.sub(r',\s*ID\["EPSG",\d+\]', "", text) for text in texts}
    for number, text in enumerate(sorted(texts)):
        folder = tmp_path / str(number)
        folder.mkdir()
        table = read(layer(folder, UTM, None, text), vertical_datum="ellipsoid")
        assert (table.crs, table.first.tolist()) == ("EPSG:25832", [x for x, _y, _z in UTM])
    county = COUNTY_GRID.format(base="GCS_NAD_1983_2011", datum="D_NAD_1983_2011")
    feet = [(500000.0 + k * 30, 400000.0, 900.0 + k) for k in range(3)]
    found = []
    for number, text in enumerate((county, CRS(county).to_wkt("WKT2_2019"))):
        folder = tmp_path / f"county {number}"
        folder.mkdir()
        table = read(layer(folder, feet, None, text), vertical_datum="ellipsoid", height_unit="ft-us")
        found.append((table.crs, table.first.tolist(), table.second.tolist()))
    assert found[0] == found[1]
    assert found[0][0] == "EPSG:6318"
    folder = tmp_path / "none"
    folder.mkdir()
    with pytest.raises(WaymarkError, match="not declared"):
        read(layer(folder, UTM, None, "PROJCRS[no WKT"), vertical_datum="ellipsoid")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("crs", "name"),
    [
        ("OGC:CRS84", "EPSG:4326"), ("EPSG:4979", "EPSG:4979"), ("EPSG:4937", "EPSG:4937"),
        ("EPSG:7912", "EPSG:7912"), ("EPSG:6319", "EPSG:6319"),
    ],
)  # fmt: skip
def test_longitudes_come_first_in_geopackage_and_shapefile(tmp_path: Path, crs: str, name: str) -> None:
    """GeoPackage 1.3, requirement 19: x is the longitude whatever the order of the axes in the definition is."""
    points = NAVD if crs == "EPSG:6319" else DEGREES
    check(read(layer(tmp_path, points, crs), vertical_datum="ellipsoid"), points, name, "ellipsoid")
    if crs != "OGC:CRS84":
        check(read(layer(tmp_path, points, crs)), points, name, "ellipsoid")  # three axes: heights above the ellipsoid
        flat = CRS(crs).to_2d().to_epsg()
        packed = layer(tmp_path, points, None, CRS(crs).to_wkt("WKT1_ESRI"))
        check(read(packed, vertical_datum="ellipsoid"), points, f"EPSG:{flat}", "ellipsoid")
        check(read(packed, crs=crs), points, crs, "ellipsoid")


def test_a_file_in_another_unit_than_its_declared_heights_is_refused() -> None:
    data = (
        b'<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2"><Units><Imperial linearUnit="USSurveyFoot"/>'
        b'</Units><CoordinateSystem epsgCode="6539"/><CgPoints><CgPoint name="1">500000 984000 30</CgPoint></CgPoints>'
        b"</LandXML>"
    )
    with pytest.raises(InvalidParameter, match="the file is in ft-us, the declaration has heights in m"):
        read(data, vertical_datum="ellipsoid", height_unit="m")
    assert read(data, vertical_datum="ellipsoid").height_unit == "ft-us"
    assert read(data, vertical_datum="ellipsoid", unit="ft-us", height_unit="m").height_unit == "m"
