"""Encodings of XML: decoded as declared or marked, everywhere XML is read."""

from __future__ import annotations

import pytest

from app.errors import UnreadableUpload
from app.formats.alignments.read import read_alignment
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.read import read_survey
from tests.formats.alignments.xodr import road

NAMES = {
    "GB2312": "科技路",
    "gbk": "朱镕基路",
    "GB18030": "𠀀路",
    "Big5": "中山路",
    "Shift_JIS": "国道１号①",
    "EUC-JP": "国道",
    "EUC-KR": "세종대로",
    "ks_c_5601-1987": "세종대로",
    "windows-31j": "東名高速①",
    "windows-1251": "Тверская",
    "KOI8-R": "Тверская",
    "ISO-8859-15": "Straße 3 €",
    "ISO-8859-1": "Königsstraße",
    "windows-1252": "Allee – Süd",
    "UTF-16": "科技路",
    "UTF-8": "科技路",
}
_PYTHON = {
    "Shift_JIS": "cp932",
    "windows-31j": "cp932",
    "ks_c_5601-1987": "cp949",
}  # what programs on Windows write under this name


def _encoded(text: str, encoding: str) -> bytes:
    return f'<?xml version="1.0" encoding="{encoding}"?>\n{text}'.encode(_PYTHON.get(encoding, encoding))


def _opendrive(name: str) -> str:
    named = road(attributes=f'id="7" name="{name}"')
    return f'<OpenDRIVE><header revMajor="1" revMinor="7"/>{named}</OpenDRIVE>'


def _landxml(name: str) -> str:
    line = "<Line><Start>0 0</Start><End>0 90</End></Line>"
    return (
        '<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2"><Units><Metric linearUnit="meter"/></Units>'
        f'<Alignments><Alignment name="{name}"><CoordGeom>{line}</CoordGeom></Alignment></Alignments></LandXML>'
    )


def _lanelet2(name: str) -> str:
    places = [(1, 49.0, 8.0), (2, 49.0, 8.001), (3, 49.00003, 8.0), (4, 49.00003, 8.001)]
    nodes = "".join(f'<node id="{i}" lat="{lat}" lon="{lon}"/>' for i, lat, lon in places)
    ways = '<way id="5"><nd ref="1"/><nd ref="2"/></way><way id="6"><nd ref="3"/><nd ref="4"/></way>'
    members = '<member type="way" ref="6" role="left"/><member type="way" ref="5" role="right"/>'
    tags = "".join(
        f'<tag k="{key}" v="{value}"/>'
        for key, value in {"type": "lanelet", "subtype": "road", "location": "urban", "name": name}.items()
    )
    return f'<osm version="0.6">{nodes}{ways}<relation id="7">{members}{tags}</relation></osm>'


@pytest.mark.parametrize("encoding", NAMES)
def test_roads_are_read_in_the_declared_encoding(encoding: str) -> None:
    name = NAMES[encoding]
    assert {lane.road for lane in read_alignment(_encoded(_opendrive(name), encoding)).lanes} == {name}
    assert read_alignment(_encoded(_landxml(name), encoding)).lanes[0].name == name
    assert read_alignment(_encoded(_lanelet2(name), encoding)).format == "lanelet2"


@pytest.mark.parametrize("encoding", NAMES)
def test_surveys_are_read_in_the_declared_encoding(encoding: str) -> None:
    name = NAMES[encoding]
    kml = (
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><name>{0}</name><Point><coordinates>8.4,49.0'
        "</coordinates></Point></Placemark></kml>"
    )
    gpx = '<gpx xmlns="http://www.topografix.com/GPX/1/1"><wpt lat="49.0" lon="8.4"><name>{0}</name></wpt></gpx>'
    for text in (kml, gpx):
        read = read_survey(_encoded(text.format(name), encoding), ImportDeclaration(ignore_heights=True))
        assert list(read.texts["point"]) == [name]
        assert read.first.tolist() == [8.4]


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be", "utf-32"])
@pytest.mark.parametrize("declared", ['<?xml version="1.0" encoding="UTF-16"?>', '<?xml version="1.0"?>', ""])
def test_wide_characters_with_and_without_a_mark(encoding: str, declared: str) -> None:
    text = declared + _opendrive("科技路")
    assert read_alignment(("\ufeff" * (encoding != "utf-32") + text).encode(encoding)).lanes[0].road == "科技路"
    if encoding != "utf-32":
        assert read_alignment(text.encode(encoding)).lanes[0].road == "科技路"


@pytest.mark.parametrize("declared", ["utf-16", "us-ascii", "ASCII", "UTF8", "utf-8"])
def test_utf_8_under_another_name(declared: str) -> None:
    """.NET writes texts as UTF-16 in the declaration, and programs save them in UTF-8."""
    text = f'<?xml version="1.0" encoding="{declared}"?>{_opendrive("科技路")}'
    assert read_alignment(text.encode()).lanes[0].road == "科技路"
    assert read_alignment(b"\xef\xbb\xbf" + text.encode()).lanes[0].road == "科技路"


@pytest.mark.parametrize(
    ("data", "message", "cure"),
    [
        (_encoded(_opendrive("A"), "ascii").replace(b'"ascii"', b'"x-klingon"'), "'x-klingon', which is not", "UTF-8"),
        (_encoded(_opendrive("A"), "ascii").replace(b'"ascii"', b'"base64"'), "'base64', which is not known", "UTF-8"),
        (_encoded(_opendrive("A"), "ascii").replace(b'"ascii"', b'"unicode_escape"'), "which is not known", "UTF-8"),
        (_encoded(_opendrive("ж"), "EUC-JP").replace(b'name="', b'name="\xff'), "declared to be in EUC-JP", "UTF-8"),
        (_opendrive("科技路").encode("gb2312"), "is not UTF-8, and the file declares no other", "first line"),
        (_encoded(f"<!DOCTYPE a>{_opendrive('路')}", "gb2312"), "document type", "without a DTD"),
        (_encoded(f"<!DOCTYPE a>{_opendrive('路')}", "utf-16"), "document type", "without a DTD"),
    ],
)
def test_other_encodings_are_refused_with_the_cure(data: bytes, message: str, cure: str) -> None:
    for read in (
        lambda: read_alignment(data, format="opendrive"),
        lambda: read_survey(data.replace(b"OpenDRIVE", b"kml"), ImportDeclaration(format="kml")),
    ):
        with pytest.raises(UnreadableUpload) as caught:
            read()
        assert message in caught.value.message
        assert cure in (caught.value.cure or "")
        assert caught.value.limit
