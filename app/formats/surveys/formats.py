"""Formats of surveys: how each is detected and read. Libraries of rarer formats are loaded when they are needed."""

from __future__ import annotations

from collections.abc import Callable

from app.formats.format import Confidence, Format, Sample, Use, detect_signature
from app.formats.surveys.csv_reader import read_csv
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.json_reader import read_geojson
from app.formats.surveys.table import SourceTable

SurveyReader = Callable[[bytes, ImportDeclaration], SourceTable]

_HEAD_BYTES = 4096  # [byte] chosen by hand
_DXF_STARTS = (b"0\n", b"0\r", b"999\n", b"999\r")
_BELOW_TAB = frozenset(range(9))


def _head(sample: Sample) -> bytes:
    return sample.data[:_HEAD_BYTES].removeprefix(b"\xef\xbb\xbf").lstrip()


def _detect_landxml(sample: Sample) -> Confidence:
    head = _head(sample)
    return Confidence.CERTAIN if head.startswith(b"<") and b"<LandXML" in head else Confidence.NONE


def _detect_kml(sample: Sample) -> Confidence:
    return Confidence.LIKELY if _head(sample).startswith(b"<") else Confidence.NONE


def _detect_geojson(sample: Sample) -> Confidence:
    return Confidence.CERTAIN if _head(sample).startswith(b"{") else Confidence.NONE


def _detect_dxf(sample: Sample) -> Confidence:
    head = _head(sample)
    return Confidence.CERTAIN if head.startswith(_DXF_STARTS) or b"SECTION" in head[:40] else Confidence.NONE


def _detect_csv(sample: Sample) -> Confidence:
    head = _head(sample)
    return Confidence.POSSIBLE if head and _BELOW_TAB.isdisjoint(head) else Confidence.NONE


def _read_kml(data: bytes, _declaration: ImportDeclaration) -> SourceTable:
    from app.formats.surveys.xml_reader import read_kml

    return read_kml(data)


def _read_landxml(data: bytes, _declaration: ImportDeclaration) -> SourceTable:
    from app.formats.surveys.xml_reader import read_landxml

    return read_landxml(data)


def _read_dxf(data: bytes, declaration: ImportDeclaration) -> SourceTable:
    from app.formats.surveys.dxf_reader import read_dxf

    return read_dxf(data, declaration.layer)


def _read_gpkg(data: bytes, declaration: ImportDeclaration) -> SourceTable:
    from app.formats.surveys.gis_reader import read_gpkg

    return read_gpkg(data, declaration.layer)


def _read_shapefile(data: bytes, _declaration: ImportDeclaration) -> SourceTable:
    from app.formats.surveys.gis_reader import read_shapefile

    return read_shapefile(data)


SURVEY_FORMATS: tuple[Format[SurveyReader], ...] = (
    Format("csv", Use.SURVEY, "csv", _detect_csv, read_csv),
    Format("geojson", Use.SURVEY, "geojson", _detect_geojson, lambda data, _declaration: read_geojson(data)),
    Format("gpkg", Use.SURVEY, "gpkg", detect_signature(b"SQLite format 3\x00"), _read_gpkg),
    Format("shapefile", Use.SURVEY, "shapefile", detect_signature(b"PK\x03\x04"), _read_shapefile),
    Format("kml", Use.SURVEY, "kml", _detect_kml, _read_kml),
    Format("landxml", Use.SURVEY, "landxml", _detect_landxml, _read_landxml),
    Format("dxf", Use.SURVEY, "dxf", _detect_dxf, _read_dxf),
)
