"""Points, heights and systems that a file states in a less usual way are read, or their loss is reported."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely

from app.errors import InvalidParameter
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.read import read_survey
from app.formats.surveys.table import SurveyTable


def _read(data: str | bytes, **declared: Any) -> SurveyTable:
    content = data if isinstance(data, bytes) else data.encode()
    return read_survey(content, ImportDeclaration(**declared))


# --- WKT and WKB of PostGIS -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cell", "height"),
    [
        ("SRID=25832;POINTM(457000 5428000 77)", None),
        ("SRID=25832;POINT M (457000 5428000 77)", None),
        ("SRID=25832;MULTIPOINTM((457000 5428000 77))", None),
        ("SRID=25832;POINTZM(457000 5428000 130.5 77)", 130.5),
        ("SRID=25832;POINT ZM (457000 5428000 130.5 77)", 130.5),
        ("SRID=25832;POINTZ(457000 5428000 130.5)", 130.5),
        ("SRID=25832;POINT(457000 5428000 130.5 77)", 130.5),  # ST_AsEWKT has no mark where there are both
    ],
)
def test_marks_of_z_and_m(cell: str, height: float | None) -> None:
    read = _read(f"id,geom\n1,{cell}\n2,{cell}", vertical_datum="ellipsoid")
    assert (read.crs, read.first[1], read.second[1]) == ("EPSG:25832", 457000, 5428000)
    assert (None if read.height is None else read.height.tolist()) == (None if height is None else [height] * 2)
    assert not read.faults.counts


def test_bytea() -> None:
    """The text of PostgreSQL for bytes, with M, which is no height, and with z."""
    for wkt, height in (("POINT M (457000 5428000 77)", None), ("POINT Z (457000 5428000 130.5)", 130.5)):
        point = shapely.set_srid(shapely.from_wkt(wkt), 25832)
        cell = "\\x" + shapely.to_wkb(point, hex=True, include_srid=True, output_dimension=4).lower()
        read = _read(f"id,geom\n1,{cell}\n2,{cell}", vertical_datum="ellipsoid")
        assert (read.crs, read.first[1], read.second[1]) == ("EPSG:25832", 457000, 5428000)
        assert (None if read.height is None else read.height[0]) == height


# --- JobXML -----------------------------------------------------------------------------------------------------------


def test_points_that_were_deleted_in_a_job_are_left_out() -> None:
    point = (
        "<Point><Name>{}</Name><Classification>{}</Classification>"
        "<Grid><North>5428000</North><East>457000</East><Elevation>112.5</Elevation></Grid></Point>"
    )
    kinds = (("101", "Normal"), ("102", "DeletedNormal"), ("103", "DeletedControl"))
    points = "".join(point.format(*kind) for kind in kinds)
    read = _read(f"<JOBFile><Reductions>{points}</Reductions></JOBFile>", crs="EPSG:25832", vertical_datum="ellipsoid")
    assert list(read.texts["point"]) == ["101"]
    others = next(one for one in read.detected if one.what == "other points")
    assert (others.value, others.evidence) == ("2 left out", "2 deleted in the job: 102, 103")


# --- KML --------------------------------------------------------------------------------------------------------------


def _placemark(name: str, inside: str, data: str = "") -> str:
    return f"<Placemark><name>{name}</name>{data}{inside}</Placemark>"


def _point(place: str, mode: str | None = None) -> str:
    altitude = "" if mode is None else f"<altitudeMode>{mode}</altitudeMode>"
    return f"<Point>{altitude}<coordinates>{place}</coordinates></Point>"


def _kml(*placemarks: str) -> str:
    return f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{"".join(placemarks)}</Document></kml>'


def test_only_absolute_altitudes_are_heights() -> None:
    modes = ("absolute", "relativeToGround", "clampToGround", None)
    marks = [_placemark(f"{mode}", _point("8.4,49.0,130.5", mode)) for mode in modes]
    read = _read(_kml(*marks), vertical_datum="ellipsoid")
    assert read.height is not None
    assert np.isfinite(read.height).tolist() == [True, False, False, False]
    (warning,) = read.faults.shown(9)
    assert (warning.row, warning.code, warning.message[:11]) == (None, "altitude_mode", "3 altitudes")
    assert _read(_kml(*marks[1:])).height is None
    assert _read(_kml(marks[0]), vertical_datum="ellipsoid").faults.counts == {}


def test_every_point_of_a_multigeometry_is_a_row() -> None:
    many = f"<MultiGeometry>{_point('8.4,49.0')}<MultiGeometry>{_point('8.5,49.1')}</MultiGeometry></MultiGeometry>"
    line = "<LineString><coordinates>8.4,49.0 8.5,49.1</coordinates></LineString>"
    read = _read(_kml(_placemark("a", many), _placemark("b", line), _placemark("c", _point("8.6,49.2"))))
    assert list(read.texts["point"]) == ["a", "a", "b", "c"]
    assert read.first[[0, 1, 3]].tolist() == [8.4, 8.5, 8.6]
    assert [(fault.row, fault.code) for fault in read.faults.shown(9)] == [(3, "no_point")]


# --- LandXML ----------------------------------------------------------------------------------------------------------


def _landxml(code: str) -> str:
    return (
        '<LandXML><Units><Metric linearUnit="meter"/></Units>'
        f'<CoordinateSystem epsgCode="{code}"/><CgPoints><CgPoint name="1">5428000 457000</CgPoint></CgPoints></LandXML>'
    )


@pytest.mark.parametrize("code", ["25832", " EPSG:25832 ", "epsg:25832", "5555"])
def test_usable_codes_of_landxml(code: str) -> None:
    read = _read(_landxml(code))
    assert (read.crs, len(read.faults)) == ("EPSG:25832", 0)
    with pytest.raises(InvalidParameter, match="the file is in EPSG:25832"):
        _read(_landxml(code), crs="EPSG:25833")


@pytest.mark.parametrize("code", ["0", "-1", "25832.0", "999999", "7837", "EPSG:EPSG:25832", "x[", "5" * 5000])
def test_with_an_unusable_code_the_declared_system_counts(code: str) -> None:
    read = _read(_landxml(code), crs="EPSG:25832")
    assert (read.crs, read.faults.counts) == ("EPSG:25832", {"unusable_crs": 1})
    with pytest.raises(InvalidParameter, match="is not declared"):
        _read(_landxml(code))
