"""Files with roads: the format is detected by the content."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Annotated, Any, Final, Literal

import numpy as np
import orjson
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pyproj import Geod

from app.errors import InvalidParameter, ReferenceSystemError, UnreadableUpload, UnsupportedUpload
from app.formats.alignments.features import SPEEDS_KMH, RoadFeature, Shape, assemble_road, read_ring, read_vertices
from app.formats.alignments.geometry import (
    MAX_VERTICES,
    AlignmentDeclaration,
    AlignmentFile,
    BoundaryStyle,
    EarlierTransformation,
    LaneGeometry,
    StationEquation,
    Stationing,
)
from app.formats.format import Confidence, Format, Sample, Use, detect_format, detect_signature, list_accepted
from app.formats.xml_tree import xml_head
from app.roads.axis import Axis
from app.roads.lane_line import CalibrationPoint, Measures, calibrate, cut_edges, parallel_line
from app.values import Floats, JsonObject

# === Roads as GeoJSON (RFC 7946): lines are lanes or their boundaries, points are events, polygons are areas to avoid.


_CURE = "send a FeatureCollection with the lanes as lines"
_MAX_NESTED = 10  # levels of GeometryCollections


def read_geojson(data: bytes) -> AlignmentFile:
    """A road of a FeatureCollection, a Feature or a geometry.

    Raises
    ------
    UnreadableUpload
        It is no GeoJSON, has no line or too many vertices.
    InvalidParameter, ReferenceSystemError
        A feature cannot be used, or features have different CRSs; the message names the feature.
    """
    try:
        document = orjson.loads(data)
    except (orjson.JSONDecodeError, RecursionError) as error:
        raise _unreadable(f"it is not JSON: {error}") from error
    if not isinstance(document, dict):
        raise _unreadable("it is no object")
    found = document.get("features", [document])
    if not isinstance(found, list):
        raise _unreadable("its features are no list")
    features: list[RoadFeature] = []
    for number, feature in enumerate(found, 1):
        features += _features(feature, f"feature {number}")
    properties = document.get("properties")
    defaults = dict(properties) if isinstance(properties, dict) and "features" in document else {}
    if isinstance(document.get("name"), str):
        defaults.setdefault("name", document["name"])
    return assemble_road("geojson", features, defaults=defaults, crs=_crs(document, found, defaults), unit_m=None)


def _features(feature: object, where: str) -> Iterator[RoadFeature]:
    if not isinstance(feature, dict):
        raise _unreadable(f"{where} is no object")
    properties = feature.get("properties")
    names = {str(k).lower(): v for k, v in properties.items()} if isinstance(properties, dict) else {}
    geometry = feature["geometry"] if feature.get("type") == "Feature" and "geometry" in feature else feature
    for shape, parts in _geometries(geometry, where):
        yield RoadFeature(where, shape, parts, names)


def _geometries(geometry: Any, where: str, level: int = 0) -> Iterator[tuple[Shape, tuple[Any, ...]]]:
    if geometry is None:
        return
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    if kind == "GeometryCollection" and isinstance(geometry.get("geometries"), list) and level < _MAX_NESTED:
        for one in geometry["geometries"]:
            yield from _geometries(one, where, level + 1)
        return
    coordinates = geometry.get("coordinates") if isinstance(geometry, dict) else None
    if not isinstance(coordinates, list) or not isinstance(kind, str):
        raise _unreadable(f"{where} has no geometry")
    many = coordinates if kind.startswith("Multi") else [coordinates]
    if not all(isinstance(part, list) for part in many):
        raise InvalidParameter(f"{where}: the coordinates are not lists", field="file", limit="RFC 7946", cure=_CURE)
    match kind.removeprefix("Multi"):
        case "LineString":
            yield Shape.LINE, tuple(read_vertices(part, where) for part in many)
        case "Point":
            yield Shape.POINT, tuple(read_vertices([point], where) for point in many)
        case "Polygon":
            yield Shape.AREA, tuple(read_ring(rings[0], where) for rings in many if rings)
        case _:
            raise _unreadable(f"{where} has a geometry of type {kind[:40]!r}")


def _crs(document: dict[str, object], features: list[object], defaults: JsonObject) -> str | None:
    """The one CRS that the file states, as GeoJSON 2008 did and QGIS does, or as a property of the collection."""
    stated = {name for one in (document, *features) if (name := _old_crs(one)) is not None}
    if isinstance(defaults.get("crs"), str):
        stated.add(defaults["crs"])
    if len(stated) > 1:
        raise ReferenceSystemError(
            f"the file mixes the CRSs {', '.join(sorted(stated))[:200]}",
            field="crs",
            limit="one CRS for all features",
            cure="transform all features to one CRS, best EPSG:4326",
        )
    return stated.pop() if stated else None


def _old_crs(one: object) -> str | None:
    crs = one.get("crs") if isinstance(one, dict) else None
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    return name if isinstance(name, str) else None


def _unreadable(message: str) -> UnreadableUpload:
    return UnreadableUpload(f"the GeoJSON cannot be used: {message}", field="file", limit="RFC 7946", cure=_CURE)


# === Roads of the registry as sources of alignments: an axis with its calibration, and the lanes that are declared for
# it.
#
# The document is written by `write_registered_road`. It is read again for each plan, as files are.


ROAD_FORMAT: Final = "waymark-road/1"
MAX_LANES = 8
"""Lanes of one direction. Wider than any motorway."""
_SAME_RATE = 1e-9  # [1] below a micrometre in a kilometre
_SAME_STATION_M = 5e-4  # [m] jumps of the station that drawings do not show; source: half a millimetre
_GEOD = Geod(ellps="WGS84")


Longitude = Annotated[float, Field(ge=-180.0, le=180.0)]
Latitude = Annotated[float, Field(ge=-90.0, le=90.0)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class RoadLanes(_Part):
    """Lanes on both sides of a road's axis, which is the line between the two directions; on a road of one direction it
    is the middle of the carriageway.
    """

    forward: Annotated[int, Field(ge=0, le=MAX_LANES, description="Lanes in the direction of the axis.")] = 1
    backward: Annotated[int, Field(ge=0, le=MAX_LANES, description="Lanes against it.")] = 1
    width_m: Annotated[float, Field(ge=1.5, le=12.0, description="Of each lane. [m]")] = 3.5
    speed_limit_kmh: Annotated[float, Field(ge=SPEEDS_KMH[0], le=SPEEDS_KMH[1])]
    driving_side: Literal["right", "left"] = "right"
    centre_style: Annotated[BoundaryStyle, Field(description="Paint between the directions.")] = BoundaryStyle.UNKNOWN
    lane_style: Annotated[BoundaryStyle, Field(description="Paint between lanes one way.")] = BoundaryStyle.UNKNOWN
    edge_style: Annotated[BoundaryStyle, Field(description="Paint at the edges.")] = BoundaryStyle.UNKNOWN


class RegisteredRoad(_Part):
    """A road of the registry with its lanes."""

    format: Literal["waymark-road/1"] = ROAD_FORMAT
    # `road_id`, `version`: of the registry
    road_id: str
    version: int
    name: str
    # whether a transformation with a stated accuracy brought them there; otherwise they are not for localization
    exact: bool
    note: str | None  # how they were transformed before
    # [m] of the positions' reference frame; None in documents that were written without it
    accuracy_m: float | None = None
    lanes: RoadLanes
    calibration: list[CalibrationPoint]
    parts: list[list[tuple[Longitude, Latitude]]]  # [deg] in WGS 84 / ITRF


def write_registered_road(road: RegisteredRoad) -> bytes:
    """The document of a road."""
    return road.model_dump_json().encode()


def read_registered_road(data: bytes) -> AlignmentFile:
    """The lanes of a document that `write_registered_road` wrote.

    Raises
    ------
    UnreadableUpload
        It is no such document.
    InvalidParameter
        It has no lanes, its axis is none that could be registered, or there are too many vertices.
    """
    try:
        road = RegisteredRoad.model_validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        raise UnreadableUpload(
            f"this is no document of a registered road: {place}: {first['msg']}",
            field="file",
            limit=ROAD_FORMAT,
            cure="make the alignment from the road again",
        ) from None
    ranges_m = Axis(road.parts).part_ranges_m
    axes = [cut_edges(np.array(part).reshape(-1, 2)) for part in road.parts]
    lanes = road.lanes
    count = (lanes.forward + lanes.backward) * sum(map(len, axes))
    if not 0 < count <= MAX_VERTICES:
        raise InvalidParameter(
            f"the lanes of the road have {count} vertices",
            field="lanes",
            limit=f"1 to {MAX_VERTICES} vertices of all lanes",
            cure="declare lanes, or register the sections of the road as roads of their own",
        )
    chainages, start_m = [], 0.0
    for axis in axes:
        lengths = np.asarray(_GEOD.inv(axis[:-1, 0], axis[:-1, 1], axis[1:, 0], axis[1:, 1])[2])
        chainages.append(start_m + np.concatenate([[0.0], np.cumsum(lengths)]))
        start_m = float(chainages[-1][-1])
    measures = calibrate(ranges_m, road.calibration)
    earlier = EarlierTransformation(road.exact, road.note, road.accuracy_m)
    return AlignmentFile(
        "road",
        tuple(_lanes(road, axes, chainages)),
        "OGC:CRS84",
        stationing={road.name: Stationing(float(measures.sections[0].measures_m[0]), tuple(_equations(measures)))},
        unit_m=None,
        earlier=earlier,
    )


def _lanes(road: RegisteredRoad, axes: list[Floats], chainages: list[Floats]) -> Iterator[LaneGeometry]:
    """Lanes of both directions, numbered from the axis outward."""
    lanes = road.lanes
    right = -1.0 if lanes.driving_side == "right" else 1.0
    both = lanes.forward > 0 and lanes.backward > 0
    # without the other direction the axis is the middle of the carriageway
    shift = 0.0 if both else -max(lanes.forward, lanes.backward) / 2
    for part, (axis, chainage) in enumerate(zip(axes, chainages, strict=True), 1):
        where = f"part {part} " if len(axes) > 1 else ""
        for name, count, side, step in (("forward", lanes.forward, right, 1), ("backward", lanes.backward, -right, -1)):
            for k in range(count):
                line = parallel_line(axis, side * (k + 0.5 + shift) * lanes.width_m)[::step]
                inner = lanes.lane_style if k > 0 else lanes.centre_style if both else lanes.edge_style
                outer = lanes.lane_style if k + 1 < count else lanes.edge_style
                styles = (inner, outer) if lanes.driving_side == "right" else (outer, inner)
                yield LaneGeometry(
                    f"{where}{name} {k + 1}",
                    centre=np.column_stack([line, np.full(len(line), np.nan)]),
                    width_m=np.full(len(line), lanes.width_m),
                    speed_limit_m_s=np.full(len(line), lanes.speed_limit_kmh / 3.6),
                    station_m=chainage[::step],
                    left_style=styles[0],
                    right_style=styles[1],
                    road=road.name,
                )


def _equations(measures: Measures) -> Iterator[StationEquation]:
    """Where displayed stations jump, or go on faster or slower than the road, so that they are its measures."""
    shown = Stationing(float(measures.sections[0].measures_m[0]))
    for section in measures.sections:
        rates = np.diff(section.measures_m) / np.diff(section.chainages_m)
        for chainage, measure, rate in zip(
            section.chainages_m[:-1].tolist(), section.measures_m[:-1].tolist(), rates.tolist(), strict=True
        ):
            back, former = shown.displayed_m(chainage), shown.equations[-1].rate if shown.equations else 1.0
            if abs(measure - back) > _SAME_STATION_M or abs(rate - former) > _SAME_RATE:
                found = StationEquation(chainage, back, measure, rate)
                shown = Stationing(shown.start_m, (*shown.equations[-1:], found))
                yield found


# === Formats of roads: how each is detected and read. Libraries of rarer formats are loaded when they are needed.


AlignmentReader = Callable[[bytes, AlignmentDeclaration], AlignmentFile]

_HEAD_BYTES = 4096  # [byte]
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
        head = xml_head(sample.data)
        return Confidence.CERTAIN if head.startswith(b"<") and start.search(head) else Confidence.NONE

    return detect


def _read_opendrive(data: bytes, _declaration: AlignmentDeclaration) -> AlignmentFile:
    from app.formats.alignments.opendrive import read_opendrive

    return read_opendrive(data)


def _read_landxml(data: bytes, declaration: AlignmentDeclaration) -> AlignmentFile:
    from app.formats.alignments.landxml import read_landxml

    return read_landxml(data, declaration)


def _read_lanelet2(data: bytes, _declaration: AlignmentDeclaration) -> AlignmentFile:
    from app.formats.alignments.lanelet2 import read_lanelet2

    return read_lanelet2(data)


def _read_gpkg(data: bytes, _declaration: AlignmentDeclaration) -> AlignmentFile:
    from app.formats.alignments.vector import read_gpkg

    return read_gpkg(data)


def _read_shapefile(data: bytes, _declaration: AlignmentDeclaration) -> AlignmentFile:
    from app.formats.alignments.vector import read_shapefile

    return read_shapefile(data)


def _read_dxf(data: bytes, declaration: AlignmentDeclaration) -> AlignmentFile:
    from app.formats.alignments.dxf import read_dxf

    return read_dxf(data, declaration)


ALIGNMENT_FORMATS: tuple[Format[AlignmentReader], ...] = (
    Format(
        "road",
        Use.ALIGNMENT,
        "registered road",
        _detect_registered_road,
        lambda data, _declaration: read_registered_road(data),
    ),
    Format("geojson", Use.ALIGNMENT, "GeoJSON", _detect_geojson, lambda data, _declaration: read_geojson(data)),
    Format("gpkg", Use.ALIGNMENT, "GeoPackage", detect_signature(b"SQLite format 3\x00"), _read_gpkg),
    Format("shapefile", Use.ALIGNMENT, "zipped Shapefile", detect_signature(b"PK\x03\x04"), _read_shapefile),
    Format("opendrive", Use.ALIGNMENT, "OpenDRIVE", _detect_xml("OpenDRIVE"), _read_opendrive),
    Format("landxml", Use.ALIGNMENT, "LandXML", _detect_xml("LandXML"), _read_landxml),
    Format("lanelet2", Use.ALIGNMENT, "lanelet2 map", _detect_xml("osm"), _read_lanelet2),
    Format("dxf", Use.ALIGNMENT, "DXF", _detect_dxf, _read_dxf),
)


# === Files with roads.


def read_alignment(
    data: bytes, name: str = "", *, format: str | None = None, declaration: AlignmentDeclaration | None = None
) -> AlignmentFile:
    """Read a road of any format.

    Parameters
    ----------
    name : str
        Of the file, for messages.
    format : str, optional
        Name of a format in `ALIGNMENT_FORMATS`; detected by the content if it is left out.
    declaration : AlignmentDeclaration, optional
        Units and CRS that the file does not state.

    Raises
    ------
    UnsupportedUpload, UnreadableUpload
        The file is of no format that is read here, is damaged, or has no lanes.
    InvalidParameter, ReferenceSystemError
        A feature or the CRS of the file cannot be used.
    """
    if format is None:
        found = detect_format(Sample(name, data), ALIGNMENT_FORMATS)
    else:
        found = next((known for known in ALIGNMENT_FORMATS if known.name == format), None)
        if found is None:
            names = ", ".join(known.name for known in ALIGNMENT_FORMATS)
            raise InvalidParameter(
                f"there is no format {format[:40]!r}", field="format", limit=names, cure="leave it out to detect it"
            )
    if found is None:
        raise UnsupportedUpload(
            f"the file {name[:80]!r} has no format that roads are read in" if name else "the file has no such format",
            field="file",
            limit=list_accepted(ALIGNMENT_FORMATS),
            cure="export it again in one of these formats",
        )
    return found.read(data, declaration or AlignmentDeclaration())
