"""Formats of surveys: how each is detected and read. Libraries of rarer formats are loaded when they are needed."""

from __future__ import annotations

import re
from collections.abc import Callable

from app.formats.archives import ZIP_MAGIC
from app.formats.format import Confidence, Format, Sample, Use, detect_signature
from app.formats.surveys.csv_reader import read_csv
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.gsi_reader import read_gsi
from app.formats.surveys.json_reader import read_geojson
from app.formats.surveys.table import SourceTable
from app.formats.text import guess_encoding

SurveyReader = Callable[[bytes, ImportDeclaration], SourceTable]

_HEAD_BYTES = 4096  # [byte] chosen by hand
_DXF_STARTS = (b"0\n", b"0\r", b"999\n", b"999\r")
_BELOW_TAB = frozenset(range(9))
_DIRECTORY_BYTES = 1 << 17  # [byte] of a ZIP's directory; 1000 files at 100 bytes. Chosen by hand
_GSI = re.compile(rb"(?:\*[0-9]{2}[0-9.]{4}[+-]\S{16}|[0-9]{2}[0-9.]{4}[+-]\S{8})(?:\s|$)")  # a first word


def _head(sample: Sample) -> bytes:
    """The beginning of the file, in UTF-8 where it is UTF-16."""
    head = sample.data[:_HEAD_BYTES]
    name = guess_encoding(head)
    if name.startswith("utf-16"):
        head = head.decode(name, "ignore").encode()
    return head.removeprefix(b"\xef\xbb\xbf").lstrip()


def _detect_root(*roots: bytes) -> Callable[[Sample], Confidence]:
    """Detection of XML by the name of its root element."""

    def detect(sample: Sample) -> Confidence:
        head = _head(sample)
        found = head.startswith(b"<") and any(b"<" + root in head for root in roots)
        return Confidence.CERTAIN if found else Confidence.NONE

    return detect


def _detect_kml(sample: Sample) -> Confidence:
    return Confidence.LIKELY if _head(sample).startswith(b"<") else Confidence.NONE


def _detect_geojson(sample: Sample) -> Confidence:
    return Confidence.CERTAIN if _head(sample).startswith(b"{") else Confidence.NONE


def _detect_dxf(sample: Sample) -> Confidence:
    head = _head(sample)
    return Confidence.CERTAIN if head.startswith(_DXF_STARTS) or b"SECTION" in head[:40] else Confidence.NONE


def _detect_kmz(sample: Sample) -> Confidence:
    """A ZIP whose directory, at its end, names a KML."""
    is_zip = sample.data.startswith(ZIP_MAGIC)
    return Confidence.CERTAIN if is_zip and b".kml" in sample.data[-_DIRECTORY_BYTES:].lower() else Confidence.NONE


def _detect_zip(sample: Sample) -> Confidence:
    return Confidence.LIKELY if sample.data.startswith(ZIP_MAGIC) else Confidence.NONE


def _detect_gsi(sample: Sample) -> Confidence:
    return Confidence.CERTAIN if _GSI.match(_head(sample)) else Confidence.NONE


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

    return read_dxf(data, declaration.layer, declaration.unit)


def _read_kmz(data: bytes, _declaration: ImportDeclaration) -> SourceTable:
    from app.formats.surveys.xml_reader import read_kmz

    return read_kmz(data)


def _read_gpx(data: bytes, _declaration: ImportDeclaration) -> SourceTable:
    from app.formats.surveys.xml_reader import read_gpx

    return read_gpx(data)


def _read_jobxml(data: bytes, _declaration: ImportDeclaration) -> SourceTable:
    from app.formats.surveys.jobxml_reader import read_jobxml

    return read_jobxml(data)


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
    Format("shapefile", Use.SURVEY, "shapefile", _detect_zip, _read_shapefile),
    Format("kml", Use.SURVEY, "kml", _detect_kml, _read_kml),
    Format("kmz", Use.SURVEY, "kmz", _detect_kmz, _read_kmz),
    Format("gpx", Use.SURVEY, "gpx", _detect_root(b"gpx"), _read_gpx),
    Format("landxml", Use.SURVEY, "landxml", _detect_root(b"LandXML"), _read_landxml),
    Format("jobxml", Use.SURVEY, "jobxml", _detect_root(b"JOBFile"), _read_jobxml),
    Format("gsi", Use.SURVEY, "gsi", _detect_gsi, read_gsi),
    Format("dxf", Use.SURVEY, "dxf", _detect_dxf, _read_dxf),
)
