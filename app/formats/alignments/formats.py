"""Formats of roads: how each is detected and read. Libraries of rarer formats are loaded when they are needed."""

from __future__ import annotations

import re
from collections.abc import Callable

from app.formats.alignments.geojson import read_geojson
from app.formats.alignments.geometry import AlignmentFile
from app.formats.alignments.registered_road import ROAD_FORMAT, read_registered_road
from app.formats.format import Confidence, Format, Sample, Use, detect_signature

AlignmentReader = Callable[[bytes], AlignmentFile]

_HEAD_BYTES = 4096  # [byte] chosen by hand
_DXF_STARTS = (b"0\n", b"0\r", b"999\n", b"999\r")


def _head(sample: Sample) -> bytes:
    return sample.data[:_HEAD_BYTES].removeprefix(b"\xef\xbb\xbf").lstrip()


def _detect_geojson(sample: Sample) -> Confidence:
    return Confidence.CERTAIN if _head(sample).startswith(b"{") else Confidence.NONE


def _detect_registered_road(sample: Sample) -> Confidence:
    """By the first member, before GeoJSON."""
    start = f'{{"format":"{ROAD_FORMAT}"'.encode()
    return Confidence.CERTAIN if _head(sample).startswith(start) else Confidence.NONE


def _detect_dxf(sample: Sample) -> Confidence:
    head = _head(sample)
    return Confidence.CERTAIN if head.startswith(_DXF_STARTS) or b"SECTION" in head[:40] else Confidence.NONE


def _detect_xml(root: str) -> Callable[[Sample], Confidence]:
    """Whether the first element has this name, with or without a prefix."""
    start = re.compile(rb"<(?:\w+:)?%s[\s/>]" % root.encode())

    def detect(sample: Sample) -> Confidence:
        head = _head(sample)
        return Confidence.CERTAIN if head.startswith(b"<") and start.search(head) else Confidence.NONE

    return detect


def _read_opendrive(data: bytes) -> AlignmentFile:
    from app.formats.alignments.opendrive import read_opendrive

    return read_opendrive(data)


def _read_landxml(data: bytes) -> AlignmentFile:
    from app.formats.alignments.landxml import read_landxml

    return read_landxml(data)


def _read_lanelet2(data: bytes) -> AlignmentFile:
    from app.formats.alignments.lanelet2 import read_lanelet2

    return read_lanelet2(data)


def _read_gpkg(data: bytes) -> AlignmentFile:
    from app.formats.alignments.vector import read_gpkg

    return read_gpkg(data)


def _read_shapefile(data: bytes) -> AlignmentFile:
    from app.formats.alignments.vector import read_shapefile

    return read_shapefile(data)


def _read_dxf(data: bytes) -> AlignmentFile:
    from app.formats.alignments.dxf import read_dxf

    return read_dxf(data)


ALIGNMENT_FORMATS: tuple[Format[AlignmentReader], ...] = (
    Format("road", Use.ALIGNMENT, "registered road", _detect_registered_road, read_registered_road),
    Format("geojson", Use.ALIGNMENT, "GeoJSON", _detect_geojson, read_geojson),
    Format("gpkg", Use.ALIGNMENT, "GeoPackage", detect_signature(b"SQLite format 3\x00"), _read_gpkg),
    Format("shapefile", Use.ALIGNMENT, "zipped Shapefile", detect_signature(b"PK\x03\x04"), _read_shapefile),
    Format("opendrive", Use.ALIGNMENT, "OpenDRIVE", _detect_xml("OpenDRIVE"), _read_opendrive),
    Format("landxml", Use.ALIGNMENT, "LandXML", _detect_xml("LandXML"), _read_landxml),
    Format("lanelet2", Use.ALIGNMENT, "lanelet2 map", _detect_xml("osm"), _read_lanelet2),
    Format("dxf", Use.ALIGNMENT, "DXF", _detect_dxf, _read_dxf),
)
