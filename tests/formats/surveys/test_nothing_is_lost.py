"""Points, heights and systems that a file states in a less usual way are read, or their loss is reported."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import ezdxf
import numpy as np
import pytest
import shapely
from pyogrio import raw

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
        f'<CoordinateSystem epsgCode="{code}"/><CgPoints><CgPoint name="1">5428000 457000</CgPoint></CgPoints>'
        "</LandXML>"
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


# --- heights beside geometry ------------------------------------------------------------------------------------------

PLACES = [(457000.0, 5428000.0), (457010.0, 5428000.0), (457020.0, 5428001.0)]
HEIGHTS = [130.5, 131.25, 129.75]


def _geojson(heights: Any, z: list[float] | None = None) -> str:
    features = [
        {
            "type": "Feature",
            "properties": {"H": height},
            "geometry": {"type": "Point", "coordinates": [*place, *([] if z is None else [z[k]])]},
        }
        for k, (place, height) in enumerate(zip(PLACES, heights, strict=True))
    ]
    return json.dumps({"type": "FeatureCollection", "features": features})


def _gpkg(folder: Path) -> bytes:
    path = folder / "a.gpkg"
    raw.write(
        path, shapely.to_wkb(shapely.points(PLACES)), [np.array(HEIGHTS)], ["H"], driver="GPKG", layer="a",
        geometry_type="Point", crs="EPSG:25832",
    )  # fmt: skip
    return path.read_bytes()


def _dxf(_folder: Path) -> bytes:
    document = ezdxf.new()
    document.units = 6
    document.blocks.new("nail").add_attdef("HOEHE", (0, 0))
    for place, height in zip(PLACES, HEIGHTS, strict=True):
        document.modelspace().add_blockref("nail", place).add_attrib("HOEHE", str(height))
    text = io.StringIO()
    document.write(text)
    return text.getvalue().encode()


def _kml_with_data(_folder: Path) -> bytes:
    data = '<ExtendedData><Data name="H"><value>{}</value></Data></ExtendedData>'
    marks = [_placemark(str(k), _point(f"8.4{k},49.0,0"), data.format(height)) for k, height in enumerate(HEIGHTS)]
    return _kml(*marks).encode()


def _wkt(_folder: Path) -> bytes:
    """With a decimal comma in the column alone."""
    rows = [f"POINT({x} {y});{str(h).replace('.', ',')}" for (x, y), h in zip(PLACES, HEIGHTS, strict=True)]
    return "\n".join(["geom;H", *rows]).encode()


@pytest.mark.parametrize("is_declared", [True, False])
@pytest.mark.parametrize(
    "write",
    [
        _gpkg,
        _dxf,
        _kml_with_data,
        lambda _folder: _geojson(HEIGHTS).encode(),
        lambda _folder: _geojson(HEIGHTS, [0.0, 0.0, 0.0]).encode(),
        _wkt,
    ],
    ids=["gpkg", "dxf", "kml", "geojson", "zeros", "wkt"],
)
def test_a_column_of_heights_beside_plane_geometry(write: Any, is_declared: bool, tmp_path: Path) -> None:
    data = write(tmp_path)
    crs = "EPSG:4326" if b"<kml" in data else "EPSG:25832"
    column = {"height": "hoehe" if b"HOEHE" in data else "H"}
    read = _read(data, crs=crs, vertical_datum="ellipsoid", columns=column if is_declared else {})
    assert read.height is not None
    assert read.height.tolist() == HEIGHTS
    assert not read.faults.counts
    with pytest.raises(InvalidParameter, match="vertical datum is not declared"):
        _read(data, crs=crs)
    assert _read(data, crs=crs, ignore_heights=True).height is None
    assert _read(data, crs=crs, columns={"height": None}).height is None


def test_two_heights_that_disagree_are_warned_of() -> None:
    z = [130.5, 131.3, 179.75]
    declared = {"crs": "EPSG:25832", "vertical_datum": "ellipsoid"}
    for columns, used, change in (({}, z, "H"), ({"height": "H"}, HEIGHTS, None)):
        read = _read(_geojson(HEIGHTS, z), columns=columns, **declared)
        assert read.height is not None
        assert read.height.tolist() == used
        (warning,) = read.faults.shown(9)
        assert (warning.code, warning.row, warning.changes[0].value) == ("heights_disagree", None, change)
        assert "1 heights of the geometry differ from the column 'H', by up to 50.00" in warning.message
    rounded = _read(_geojson([*HEIGHTS[:2], None], [130.5, 131.3, 129.7]), columns={"height": "H"}, **declared)
    assert not rounded.faults.counts
    assert rounded.height is not None
    assert rounded.height.tolist() == [130.5, 131.25, 129.7]


def test_a_column_that_is_only_named_like_heights_is_not_read() -> None:
    read = _read(_geojson(["left", "right", "left"]), crs="EPSG:25832")
    assert (read.height, read.faults.counts) == (None, {"role_without_evidence": 1})
    wrong = _read(_geojson(["130.5", "131.25", "about 130"]), crs="EPSG:25832", vertical_datum="ellipsoid")
    assert [(fault.row, fault.code) for fault in wrong.faults.shown(9)] == [(3, "not_a_number")]


@pytest.mark.parametrize("role", ["easting", "lat_deg"])
def test_no_column_can_be_declared_for_coordinates_of_geometry(role: str) -> None:
    with pytest.raises(InvalidParameter, match="those of the file's geometry") as refused:
        _read(_geojson(HEIGHTS), crs="EPSG:25832", columns={role: "H"})
    assert refused.value.field == f"columns.{role}"
