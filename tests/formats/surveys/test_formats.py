"""Files of survey instruments and programs: GSI, JobXML, GPX, KMZ, LandXML, DXF and GeoJSON."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import ezdxf
import numpy as np
import pytest
from pyproj import Geod, Transformer

from app.errors import UnreadableUpload, UnsupportedUpload, WaymarkError
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.dxf_reader import read_dxf
from app.formats.surveys.read import read_survey
from app.formats.surveys.table import SurveyTable
from app.geodesy import place_positions

DATA = Path(__file__).parents[2] / "data/surveys"
UTM = {"crs": "EPSG:25832", "vertical_datum": "EPSG:7837"}


def _read(data: str | bytes, **declared: Any) -> SurveyTable:
    content = data if isinstance(data, bytes) else data.encode()
    return read_survey(content, ImportDeclaration(**{**UTM, **declared}))


def _detected(read: SurveyTable) -> dict[str, str]:
    return {one.what: one.value for one in read.detected}


# --- GSI --------------------------------------------------------------------------------------------------------------

GSI_8 = (
    "110001+0000STN1 84..10+00012345 85..10+00067890 86..10+00001234 \r\n"
    "410002+0000CODE 42....+00000001 \r\n"
    "110003+00000P-7 81..00+00456789 82..00-00012345 83..00+00112500 71....+000KERB1 \r\n"
    "110004+0000P-8A 81..00+00456790 82..00-00012346 83..00+00000000 \r\n"
)
GSI_16 = (
    "*110001+00000000000000A1 81..10+0000000456789123 82..10+0000005427345678 83..10+0000000000112500 \n"
    "*110002+00000000000000A2 81..10+0000000456799123 82..10+0000005427346678 83..10+0000000000112600 \n"
)


def test_gsi_8() -> None:
    read = _read(GSI_8)
    assert read.format == "gsi"
    assert list(read.texts["point"]) == ["P-7", "P-8A"]
    assert list(read.texts["description"]) == ["KERB1", ""]
    assert (read.first.tolist(), read.second.tolist()) == ([456.789, 456.79], [-12.345, -12.346])
    assert read.height is not None
    assert read.height.tolist() == [112.5, 0.0]
    found = _detected(read)
    assert found["words"] == "GSI-8"
    assert (found["stations"], found["other lines"]) == ("1 lines left out", "1 left out")


@pytest.mark.parametrize(
    ("unit", "digits", "metres", "name"),
    [
        ("0", 456789123, 456789.123, "m"), ("6", 4567891234, 456789.1234, "m"), ("8", 45678912345, 456789.12345, "m"),
        ("1", 456789123, 456789.123, "ft-intl"), ("7", 4567891234, 456789.1234, "ft-intl"),
    ],
)  # fmt: skip
def test_units_of_gsi_16(unit: str, digits: int, metres: float, name: str) -> None:
    line = f"*110001+00000000000000A1 81..0{unit}+{digits:016d} 82..0{unit}+{digits:016d} 83..0{unit}+{digits:016d} \n"
    read = _read(line * 2)
    assert (read.first[0], read.unit, read.height_unit) == (metres, name, name)
    assert _detected(read)["words"] == "GSI-16"


def test_stations_are_read_where_there_are_no_other_points() -> None:
    read = _read("110001+0000STN1 84..10+00012345 85..10+00067890 86..10+00001234 \n")
    assert (list(read.texts["point"]), read.first.tolist(), read.second.tolist()) == (["STN1"], [12.345], [67.89])


def test_gsi_without_heights() -> None:
    """Dashes stand for a value that was not measured."""
    read = _read(GSI_16.replace("0000000000112500", "00000000000-----"))
    assert read.height is not None
    assert np.isnan(read.height).tolist() == [True, False]
    assert not read.faults.counts
    assert _read(GSI_16.replace("0000000000112500", "00000000001a2500")).faults.counts == {"not_a_number": 1}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("110001+0000STN1 21.102+00012345 \n", "no coordinates"),
        (GSI_8 + "some text\n", "line 5 is no line of GSI"),
        (GSI_16.replace("82..10", "82..11"), "several units"),
        (GSI_16.replace("81..10", "81..12").replace("82..10", "82..12"), "several units"),
    ],
)
def test_bad_gsi(text: str, message: str) -> None:
    with pytest.raises(UnreadableUpload, match=message):
        _read(text)


# --- XML --------------------------------------------------------------------------------------------------------------


def _jobxml(points: str) -> str:
    return (
        '<?xml version="1.0" encoding="UTF-8"?><JOBFile jobName="B10" version="5.74" product="Trimble Access">'
        "<Environment><DisplaySettings><DistanceUnits>USSurveyFeet</DistanceUnits></DisplaySettings></Environment>"
        '<FieldBook><PointRecord ID="1"><Name>raw</Name><Grid><North>1</North></Grid></PointRecord></FieldBook>'
        f"<Reductions>{points}</Reductions></JOBFile>"
    )


JOBXML = _jobxml(
    "<Point><ID>1</ID><Name>101</Name><Code>IP</Code><SurveyMethod>NetworkRTK</SurveyMethod>"
    "<Grid><North>5427345.678</North><East>456789.123</East><Elevation>112.5</Elevation></Grid>"
    "<WGS84><Latitude>48.99763</Latitude><Longitude>8.40921</Longitude><Height>160.5</Height></WGS84></Point>"
    "<Point><ID>2</ID><Name>102</Name><Code>IP</Code><Grid><North>5427346.678</North><East>456799.123</East>"
    "<Elevation>112.6</Elevation></Grid><WGS84><Latitude>48.99764</Latitude><Longitude>8.40935</Longitude>"
    "<Height>160.6</Height></WGS84></Point><Point><Name>azimuth</Name><Grid/></Point>"
)


def test_jobxml_has_grid_and_wgs84_coordinates() -> None:
    read = _read(JOBXML)
    assert (read.format, read.unit, read.first.tolist()) == ("jobxml", "m", [456789.123, 456799.123])
    assert read.second.tolist() == [5427345.678, 5427346.678]
    assert read.height is not None
    assert read.height.tolist() == [112.5, 112.6]
    assert list(read.texts["point"]) == ["101", "102"]
    assert _detected(read)["other points"] == "1 left out"
    degrees = _read(JOBXML, crs="EPSG:4326", vertical_datum="ellipsoid")
    assert (degrees.first.tolist(), degrees.second.tolist()) == ([8.40921, 8.40935], [48.99763, 48.99764])
    assert degrees.height is not None
    assert degrees.height.tolist() == [160.5, 160.6]


def test_jobxml_of_a_receiver() -> None:
    """The grid coordinates are where the receiver's own WGS 84 coordinates are, by PROJ within a centimetre."""
    data = (DATA / "kierzkowo.jxl").read_bytes()
    read = _read(data, crs="EPSG:2177", vertical_datum="EPSG:5621")  # ETRF2000-PL / CS2000/18: zone 6 in the eastings
    assert list(read.texts["point"]) == ["413-1033", "413-1034", "101", "102", "103", "104", "105", "164"]
    assert read.first[2] == 6492430.5665061
    assert read.faults.counts == {"keyed_in_point": 2, "poor_solution": 1}
    receiver = np.array([[17.882364673859, 54.775102817023], [17.88230642274, 54.77509893477]])
    found = Transformer.from_crs("EPSG:2177", "EPSG:9702", always_xy=True).transform(read.first[2:4], read.second[2:4])
    assert np.column_stack(found) == pytest.approx(receiver, abs=1e-7)
    degrees = _read(data, crs="EPSG:4326", vertical_datum="ellipsoid")
    assert np.column_stack([degrees.first[2:4], degrees.second[2:4]]) == pytest.approx(receiver, abs=1e-12)
    wrong = _read(data, crs="EPSG:2178", vertical_datum="EPSG:5621")  # the zone of 21 degrees
    assert wrong.faults.counts["coordinates_disagree"] == 1


def test_gpx_of_a_receiver() -> None:
    read = _read((DATA / "cerknicko_jezero.gpx").read_bytes(), crs=None)
    assert read.rows == 7
    assert (read.first[1], read.second[1], read.texts["point"][1]) == (14.294899916, 45.757933259, "BACK T TH")
    assert read.faults.counts == {"equal_heights": 1}  # -0.11438 m in the karst of Slovenia
    assert _detected(read)["tracks"] == "2 points left out"


GPX = (
    '<gpx xmlns="http://www.topografix.com/GPX/1/1" version="1.1" creator="a receiver">'
    '<wpt lat="49.0051" lon="8.4164"><ele>112.5</ele><name>A1</name><desc>nail</desc><sym>Flag</sym></wpt>'
    '<wpt lat="49.0052" lon="8.4165"><ele>112.6</ele><name>A2</name></wpt>'
    '<trk><trkseg><trkpt lat="1" lon="1"/></trkseg></trk></gpx>'
)


def test_gpx_waypoints_but_no_tracks() -> None:
    read = _read(GPX, crs=None)
    assert (read.format, read.crs) == ("gpx", "EPSG:4326")
    assert (read.first.tolist(), read.second.tolist()) == ([8.4164, 8.4165], [49.0051, 49.0052])
    assert (list(read.texts["point"]), list(read.texts["description"])) == (["A1", "A2"], ["nail", ""])
    assert read.height is not None
    assert read.height.tolist() == [112.5, 112.6]
    assert _detected(read)["tracks"] == "1 points left out"
    with pytest.raises(UnreadableUpload, match="no waypoints, but 1 points of tracks"):
        _read(GPX[: GPX.index("<wpt")] + GPX[GPX.index("<trk>") :], crs=None)


def _kml(count: int) -> bytes:
    marks = "".join(
        f"<Placemark><name>A{k}</name><Point><coordinates>8.4{k:06d},49.0,0</coordinates></Point></Placemark>"
        for k in range(count)
    )
    return f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{marks}</Document></kml>'.encode()


def _zip(**members: bytes) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name.replace("_", "."), content)
    return packed.getvalue()


@pytest.mark.parametrize("count", [8, 20_000])
def test_kmz(count: int) -> None:
    read = _read(_zip(doc_kml=_kml(count), icon_png=b"\x89PNG"), crs=None)
    assert (read.format, read.rows, read.texts["point"][count - 1]) == ("kmz", count, f"A{count - 1}")
    assert read.height is None
    assert not read.faults.counts  # 0 on the ground is what programs write without heights


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (_zip(doc_kml=b"<kml>" + b" " * 2**26 + b"</kml>"), "expands beyond its limit"),
        (_zip(a_kml=_kml(1), b_kml=_kml(1)), "holds 2 KML files"),
        (_zip(doc_kml=b'<!DOCTYPE k [<!ENTITY a "aa">]><kml>&a;</kml>'), "document type"),
        (_zip(doc_kml=_kml(8))[:-30], "damaged"),
    ],
)
def test_bad_kmz(data: bytes, message: str) -> None:
    with pytest.raises(WaymarkError, match=message):
        _read(data, crs=None)


@pytest.mark.parametrize("root", ["gpx", "JOBFile", "LandXML", "kml"])
def test_no_xml_may_declare_a_document_type(root: str) -> None:
    with pytest.raises(UnreadableUpload, match="document type"):
        _read(f'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaa">]><{root}>&a;</{root}>')


# --- units ------------------------------------------------------------------------------------------------------------


def test_feet_of_a_crs_in_us_survey_feet() -> None:
    points = (
        '<CgPoint name="1">1900000.0 1176000.0 600.0</CgPoint><CgPoint name="2">1900010.0 1176000.0 601.0</CgPoint>'
    )
    text = (
        '<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2"><Units><Imperial linearUnit="foot"/></Units>'
        f'<CoordinateSystem epsgCode="3435"/><CgPoints>{points}</CgPoints></LandXML>'
    )
    plain = _read(text, crs=None)
    assert (plain.unit, plain.height_unit) == ("ft-us", "ft-us")
    assert plain.faults.counts == {"which_foot": 1}
    declared = _read(text, crs=None, unit="ft-intl")
    assert (declared.unit, declared.faults.counts) == ("ft-intl", {})
    assert plain.first.tolist() == declared.first.tolist()  # the same numbers; only the unit differs
    metric = _read(text.replace('"3435"', '"26916"'), crs=None)
    assert (metric.unit, metric.faults.counts) == ("ft-intl", {})


def test_a_drawing_in_millimetres() -> None:
    document = ezdxf.new("R2010", units=4)
    document.modelspace().add_point((456_789_123.0, 5_427_345_678.0, 112_500.0))
    document.modelspace().add_point((456_799_123.0, 5_427_345_678.0, 112_600.0))
    text = io.StringIO()
    document.write(text)
    read = _read(text.getvalue())
    assert (read.first[0], read.second[0]) == pytest.approx((456789.123, 5427345.678), abs=1e-6)
    assert read.height == pytest.approx([112.5, 112.6])
    assert _detected(read)["unit of the drawing"] == "0.001 m"
    kept = _read(text.getvalue(), unit="m")  # the unit of a template, not of the coordinates
    assert kept.first[0] == 456_789_123.0


def test_points_that_are_not_drawn_are_left_out() -> None:
    document = ezdxf.new("R2010", units=6)
    document.layers.add("OLD").freeze()
    document.layers.add("OFF").off()
    for layer in ("NEW", "old", "OFF"):
        document.modelspace().add_point((456789.0, 5427345.0, 112.0), dxfattribs={"layer": layer})
    text = io.StringIO()
    document.write(text)
    read = _read(text.getvalue())
    assert read.first.tolist() == [456789.0]
    assert read.faults.counts == {"hidden_layers": 1}
    with pytest.raises(UnreadableUpload, match=r"no points that are drawn\. The layer old is frozen or switched off"):
        _read(text.getvalue(), layer="OLD")


def test_points_in_bound_references() -> None:
    document = ezdxf.new("R2010", units=6)
    symbol = document.blocks.new("PEG")
    symbol.add_point((0, 0))
    symbol.add_circle((0, 0), 0.2)
    part = document.blocks.new("survey$0$points")
    part.add_point((10.0, 0.0, 112.0))
    part.add_point((20.0, 0.0, 112.0), dxfattribs={"layer": "own"})
    part.add_blockref("PEG", (30.0, 0.0, 112.0)).add_attrib("NAME", "P3", (0, 0))
    space = document.modelspace()
    space.add_blockref("PEG", (456000.0, 5427000.0, 112.0)).add_attrib("NAME", "P1", (0, 0))
    space.add_blockref("PEG", (456001.0, 5427000.0, 112.0))
    space.add_blockref("survey$0$points", (456000.0, 5427345.0), dxfattribs={"layer": "host", "rotation": 90})
    text = io.StringIO()
    document.write(text)
    read = _read(text.getvalue(), columns={"point": "name"})
    assert read.first.tolist() == pytest.approx([456000, 456001, 456000, 456000, 456000])
    assert read.second.tolist() == pytest.approx([5427000, 5427000, 5427355, 5427365, 5427375])
    assert list(read.texts["point"]) == ["P1", "", "", "", "P3"]
    of_layer = _read(text.getvalue(), layer="host", columns={"point": "name"})
    assert of_layer.second.tolist() == pytest.approx([5427355, 5427375])


def test_dxf_symbols_are_where_cad_draws_them() -> None:
    """In a plane that is seen from below x is turned; a block that holds one block with points is a part, too."""
    document = ezdxf.new("R2010", units=6)
    space = document.modelspace()
    document.blocks.new("NAIL").add_circle((0, 0), 0.1)
    rows = {"layer": "nail", "extrusion": (0, 0, -1), "row_count": 2, "row_spacing": 5.0}
    space.add_blockref("NAIL", (-456789.0, 5427345.0, -112.0), dxfattribs=rows)
    part = document.blocks.new("points")
    part.add_point((20.0, 0.0, 112.0))
    part.add_point((30.0, 0.0, 112.0))
    document.blocks.new("whole").add_blockref("points", (0.0, 1.0))
    space.add_blockref("whole", (456000.0, 5427345.0), dxfattribs={"layer": "host"})
    stream = io.StringIO()
    document.write(stream)
    table = read_dxf(stream.getvalue().encode(), None)
    assert table.points is not None
    assert np.stack(table.points, axis=1).tolist() == [
        [456789.0, 5427345.0, 112.0],
        [456789.0, 5427350.0, 112.0],
        [456020.0, 5427346.0, 112.0],
        [456030.0, 5427346.0, 112.0],
    ]
    assert table.columns[table.names.index("layer")] == ["nail", "nail", "host", "host"]


def test_multipoints_of_geojson() -> None:
    many = {"type": "MultiPoint", "coordinates": [[8.4164, 49.0051], [8.4165, 49.0052], [8.4166, "x"]]}
    one = {"type": "Point", "coordinates": [8.4167, 49.0053]}
    features = [
        {"type": "Feature", "properties": {"name": name}, "geometry": shape}
        for name, shape in (("a", many), ("b", one))
    ]
    read = _read(json.dumps({"type": "FeatureCollection", "features": features}), crs=None)
    assert list(read.texts["point"]) == ["a", "a", "a", "b"]
    assert read.first[[0, 1, 3]].tolist() == [8.4164, 8.4165, 8.4167]
    assert [(fault.row, fault.code) for fault in read.faults.shown(9)] == [(3, "no_point")]


def test_positions_of_feet_differ_by_2_ppm() -> None:
    """EPSG:3435: read in the unit of the CRS, the point is where PROJ places it; as international feet 1.36 m away."""
    x, y = 1176000.0, 1900000.0
    true = Transformer.from_crs("EPSG:3435", "EPSG:4269", always_xy=True).transform(x, y)
    off = Transformer.from_crs("EPSG:3435", "EPSG:4269", always_xy=True).transform(x * 0.999998, y * 0.999998)
    assert Geod(ellps="GRS80").inv(*true, *off)[2] == pytest.approx(1.362, abs=0.005)
    placed = place_positions(np.array([x]), np.array([y]), np.array([np.nan]), crs="EPSG:3435")
    assert (placed.lon_deg[0], placed.lat_deg[0]) == pytest.approx(true, abs=2e-5)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (_zip(**{"xl/workbook_xml": b"<x/>"}), "an Excel workbook"),
        (b"%PDF-1.4\n1 0 obj\n", "a PDF"),
        (b"AC1032\x00", "a DWG"),
        (b"JB,NMTEST,DT06-01-2025\nMO,AD0,UN1\n", "raw data"),
    ],
)
def test_documents_that_are_no_surveys_are_named(data: bytes, message: str) -> None:
    with pytest.raises(UnsupportedUpload, match=message) as caught:
        _read(data)
    assert caught.value.cure
