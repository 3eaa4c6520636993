"""Stakeout files for a crew's receiver, total station, CAD and GIS. The same stakeout always gives the same bytes."""

from __future__ import annotations

import io
import math
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import orjson
import shapely
from pyproj import Geod

from app.errors import InvalidParameter
from app.formats.exports import INSUNITS, LANDXML_UNITS
from app.formats.surveys.coordinates import crs_unit
from app.formats.surveys.declaration import METRES
from app.geodesy import normalize_crs, reference_system
from app.geodesy.place import Origin, SystemPositions, positions_in_system
from app.planning.alignment import format_station
from app.planning.outputs.plan_document import marker_feature
from app.planning.plan import Plan, PlannedCerpm, PlannedLineMagnet, PlannedMarker, PlannedPlate, PlannedTag
from app.values import Floats

# === Points that a crew stakes: one a marker, one a magnet of a tag, in the crew's reference system and unit.


CODES = {"plate": "PLATE", "line": "MAGL", "tag": "MAGT", "cerpm": "CERPM"}
"""Feature codes of the points and layers of the DXF."""
_ZONES = 60  # of UTM; source: DMA TM 8358.2
_GEOD = Geod(ellps="WGS84")
_AHEAD_M = 10.0  # [m] to the second point of a bearing; 0.1 mm of it are 0.0006 degrees
_MAX_LON_SPAN_DEG = 6.0  # of a road in one zone; source: as for exports, a zone's width


@dataclass(frozen=True, slots=True)
class StakePoint:
    """One point."""

    name: str  # number of the marker; of a tag's magnets with a letter, e.g. ``12A``.
    kind: str  # key in `CODES`
    marker: PlannedMarker
    # `lon_deg`, `lat_deg`: [deg] WGS 84
    lon_deg: float
    lat_deg: float
    # `east`, `north`: in the crew's system and unit
    east: float
    north: float
    height: float | None  # in the crew's unit
    # [deg] in which a plate's upper edge and a lying magnet's north pole point, clockwise from grid north; None without
    # one
    bearing_deg: float | None
    detail: str  # what is set there, without commas
    station: str  # displayed station

    @property
    def code(self) -> str:
        """Feature code."""
        return CODES[self.kind]

    @property
    def description(self) -> str:
        """For the D of PNEZD: code, what it is, lane, station, bearing; without commas."""
        bearing = "" if self.bearing_deg is None else f" BRG {self.bearing_deg % 360.0:.2f}"
        lane = "".join(c if c.isprintable() and c not in ',;"' else " " for c in self.marker.lane)[:40]
        return f"{self.code} {self.detail} LANE {lane} STA {self.station}{bearing}"


@dataclass(frozen=True, slots=True)
class Stakeout:
    """All points of a plan."""

    plan: Plan
    crs: str  # ``EPSG:code``
    crs_name: str
    unit: str  # of coordinates and heights: ``m``, ``ft-intl`` or ``ft-us``
    accuracy_m: float  # [m] stated accuracy of the transformation from WGS 84
    note: str  # the transformation
    points: tuple[StakePoint, ...]


def plan_stakeout(
    plan: Plan,
    crs: str | None = None,
    unit: str | None = None,
    realization: str | None = None,
    epoch: float | None = None,
) -> Stakeout:
    """Points of a plan in the crew's reference system and unit.

    Parameters
    ----------
    crs : str, optional
        A projected system; without, that of the road, or the UTM zone of WGS 84 that it lies in.
    unit : str, optional
        ``m``, ``ft-intl`` or ``ft-us``; without, the unit of the system.
    realization, epoch : optional
        As for `positions_in_system`.

    Raises
    ------
    ReferenceSystemError
        The system is unknown, not made for this place, or has no transformation with a stated accuracy.
    InvalidParameter
        The system is not projected, there is no such unit, or the plan has no markers.
    """
    if not plan.markers:
        raise InvalidParameter("the plan has no markers", field="plan", limit="at least one", cure="check the rules")
    name = normalize_crs(crs) if crs is not None else _default_system(plan)
    system = reference_system(name)
    if not system.is_projected:
        raise InvalidParameter(
            f"{name} ({system.name}) is geographic, and stakeout takes northing and easting",
            field="crs",
            limit="a projected system",
            cure="choose a projected system, e.g. the UTM zone or the state plane zone of the road",
        )
    own = crs_unit(system)
    unit = unit or own
    if unit not in METRES:
        raise InvalidParameter(
            f"there is no unit {unit[:40]!r}", field="unit", limit=", ".join(METRES), cure="choose one of these"
        )
    places = _places(plan)
    lon, lat, height = (np.array([place[k] for place in places], dtype=np.float64) for k in (2, 3, 4))
    road = plan.alignment
    origin = Origin(
        road.crs,
        road.transform_accuracy_m is not None,
        road.epoch,
        road.vertical_datum == "ellipsoid",
        road.declared_realization,
    )
    frame = partial(positions_in_system, crs=name, origin=origin, realization=realization, epoch=epoch)
    found = frame(lon, lat, height)
    scale, up = METRES[own] / METRES[unit], 1.0 / METRES[unit]
    east, north, high = (found.first * scale).tolist(), (found.second * scale).tolist(), (found.height_m * up).tolist()
    bearings = np.array([np.nan if place[6] is None else place[6] for place in places])
    grid = _grid_bearings(lon, lat, height, bearings, found, frame).tolist()
    points = tuple(
        StakePoint(
            point, kind, marker, lon_deg, lat_deg, east[k], north[k], high[k] if math.isfinite(high[k]) else None,
            grid[k] if math.isfinite(grid[k]) else None, detail, station,
        )
        for k, (point, marker, lon_deg, lat_deg, _, kind, _, detail, station) in enumerate(places)
    )  # fmt: skip
    return Stakeout(plan, name, str(system.name), unit, found.accuracy_m, found.note, points)


def _grid_bearings(
    lon: Floats, lat: Floats, height: Floats, bearings: Floats, found: SystemPositions,
    frame: Callable[[Floats, Floats, Floats], SystemPositions],
) -> Floats:  # fmt: skip
    """Bearings from grid north of bearings from true north, shape (N,); NaN stays. [deg]"""
    grid = np.full(len(lon), np.nan)
    k = np.flatnonzero(np.isfinite(bearings))
    if len(k):
        ahead_lon, ahead_lat, _ = _GEOD.fwd(lon[k], lat[k], bearings[k], np.full(len(k), _AHEAD_M))
        ahead = frame(np.asarray(ahead_lon), np.asarray(ahead_lat), height[k])
        grid[k] = np.degrees(np.arctan2(ahead.first - found.first[k], ahead.second - found.second[k])) % 360.0
    return grid


_Place = tuple[str, PlannedMarker, float, float, float, str, float | None, str, str]
"""Name, marker, lon, lat, height, kind, bearing, detail, station."""


def _places(plan: Plan) -> list[_Place]:
    road = plan.alignment
    lanes = {lane.name: lane for lane in road.lanes}
    fixed = " SURFACE" if plan.rules.installation.on_surface else ""
    places: list[_Place] = []
    for marker in plan.markers:
        detail = marker.detail
        height = math.nan if marker.height_m is None else marker.height_m
        station = format_station(marker.station_m)
        here = (marker.lon_deg, marker.lat_deg, height)
        name = str(marker.number)
        match detail:
            case PlannedPlate():
                places.append((name, marker, *here, "plate", marker.heading_deg, detail.code.digits, station))
            case PlannedLineMagnet():
                way = "UP" if detail.tag.polarity.value == "N" else "DOWN"
                side = detail.side.name
                places.append((name, marker, *here, "line", None, f"{side} LINE NORTH POLE {way}{fixed}", station))
            case PlannedCerpm():
                places.append((name, marker, *here, "cerpm", None, f"{detail.number} {detail.side.name}", station))
            case PlannedTag():
                lane = lanes[marker.lane]
                rise = lane.value_at(lane.height_m, [c for c, _, _ in detail.magnets]) - float(
                    lane.value_at(lane.height_m, marker.chainage_m)
                )
                bearing = tag_bearing_deg(detail)
                for k, ((_, lon, lat), polarity) in enumerate(zip(detail.magnets, detail.tag.polarities, strict=True)):
                    pole = (bearing + (0.0 if polarity.value == "N" else 180.0)) % 360.0
                    way = "FWD" if polarity.value == "N" else "BACK"
                    text = f"{detail.tag.text} MAGNET {k + 1} NORTH POLE {way}{fixed}"
                    letter = chr(ord("A") + k)
                    places.append(
                        (f"{name}{letter}", marker, lon, lat, height + float(rise[k]), "tag", pole, text, station)
                    )
    return places


def tag_bearing_deg(tag: PlannedTag) -> float:
    """Direction from the first magnet of a tag to the last, clockwise from true north. [deg]"""
    (_, lon_a, lat_a), (_, lon_b, lat_b) = tag.magnets[0], tag.magnets[-1]
    return float(_GEOD.inv(lon_a, lat_a, lon_b, lat_b)[0]) % 360.0


def _default_system(plan: Plan) -> str:
    """The road's own system where it is projected, else its UTM zone of WGS 84."""
    road = plan.alignment
    if road.surveyed:
        try:
            name = normalize_crs(road.crs)
            if reference_system(name).is_projected:
                return name
        except InvalidParameter:
            pass  # a system without a code
    lon = np.array([marker.lon_deg for marker in plan.markers])
    if float(np.ptp(lon)) > _MAX_LON_SPAN_DEG:
        raise InvalidParameter(
            "the road is too long for one UTM zone",
            field="crs",
            limit=f"{_MAX_LON_SPAN_DEG:g} degrees of longitude",
            cure="name a projected system that covers the road",
        )
    zone = min(int((float(np.median(lon)) + 180.0) // 6.0) + 1, _ZONES)
    return f"EPSG:{(32600 if plan.markers[0].lat_deg >= 0 else 32700) + zone}"


# === Stakeout files for a crew's receiver, total station, CAD and GIS. The same stakeout always gives the same bytes.


_COLOURS = {"plate": 5, "line": 2, "tag": 1, "cerpm": 3}  # ACI of the layers: blue, yellow, red, green
_TEXT_HEIGHT_M = 0.5  # of labels in CAD; 1 mm at 1 : 500
_STAMP = "2000-01-01T00:00:00.000Z"  # of GeoPackages, so that the same plan gives the same bytes
_DATES = re.compile(r"(\$TD(?:CREATE|UPDATE)\n 40\n)[^\n]*")
_GUIDS = re.compile(r"(\$(?:FINGERPRINT|VERSION)GUID\n  2\n)[^\n]*")
_STAMPS = re.compile(r"^(\d+\.\d+[^ \n]*) @ \d{4}-\d\d-\d\dT[^\n]*$", re.MULTILINE)
_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # source: XML 1.0, section 2.2


class StakeoutFormat(StrEnum):
    """What a stakeout can be written as; the value is the file's name."""

    PNEZD = "stakeout-pnezd.csv"
    PENZD = "stakeout-penzd.csv"
    LANDXML = "stakeout.xml"
    DXF = "stakeout.dxf"
    GPKG = "stakeout.gpkg"
    GEOJSON = "stakeout.geojson"
    README = "stakeout-README.txt"

    @property
    def media_type(self) -> str:
        """For HTTP's Content-Type."""
        return _MEDIA_TYPES[self.value.rpartition(".")[2]]


_MEDIA_TYPES = {
    "csv": "text/csv; charset=utf-8",
    "xml": "application/xml",
    "dxf": "image/vnd.dxf",
    "gpkg": "application/geopackage+sqlite3",
    "geojson": "application/geo+json",
    "txt": "text/plain; charset=utf-8",
}


def write_stakeout(stakeout: Stakeout, form: StakeoutFormat) -> bytes:
    """Write a stakeout in one format."""
    return _WRITERS[form](stakeout)


def _delimited(stakeout: Stakeout, *, northing_first: bool) -> bytes:
    """Point, two coordinates, elevation, description: comma separated, without a header, to 0.1 mm or 0.0001 ft."""
    lines = []
    for point in stakeout.points:
        first, second = (point.north, point.east) if northing_first else (point.east, point.north)
        height = "" if point.height is None else f"{point.height:z.4f}"
        lines.append(f"{point.name},{first:.4f},{second:.4f},{height},{point.description}\r\n")
    return "".join(lines).encode()


def _landxml(stakeout: Stakeout) -> bytes:
    """LandXML 1.2 with CgPoints in groups by family: northing, easting, elevation."""
    code = stakeout.crs.partition(":")[2]
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" version="1.2" date="2000-01-01" time="00:00:00">',
        f"<Units>{LANDXML_UNITS[stakeout.unit]}</Units>",
        f"<CoordinateSystem epsgCode={quoteattr(code)} desc={_attribute(stakeout.crs_name)}/>",
        f"<Project name={_attribute(stakeout.plan.name)} desc={_attribute(stakeout.note)}/>",
        '<Application name="Waymark"/>',
    ]
    for kind, label in CODES.items():
        group = [point for point in stakeout.points if point.kind == kind]
        if not group:
            continue
        lines.append(f'<CgPoints name="{label}">')
        for point in group:
            height = "" if point.height is None else f" {point.height:z.4f}"
            attributes = f'name="{point.name}" code="{label}" desc={_attribute(point.description)} state="proposed"'
            lines.append(f"<CgPoint {attributes}>{point.north:.4f} {point.east:.4f}{height}</CgPoint>")
        lines.append("</CgPoints>")
    return "\n".join([*lines, "</LandXML>", ""]).encode()


def _attribute(text: str) -> str:
    return quoteattr(_NOT_XML.sub("?", text))


# --- DXF ------------------------------------------------------------------------------------------------------------


def _dxf(stakeout: Stakeout) -> bytes:
    """DXF R2010: a block with attributes and a POINT at true height for each point, on a layer per family.

    The frame of the file is made by ezdxf; the points are written as text, a hundred thousand take a second.
    """
    from ezdxf.filemanagement import new

    document = new("R2010", units=INSUNITS[stakeout.unit])
    document.header["$INSUNITS"] = INSUNITS[stakeout.unit]
    document.header["$MEASUREMENT"] = int(stakeout.unit == "m")
    document.header["$PDMODE"], document.header["$PDSIZE"] = 34, -1.0  # a cross in a circle, 1 % of the view
    height = _TEXT_HEIGHT_M / METRES[stakeout.unit]
    for kind, code in CODES.items():
        document.layers.add(_layer(code), color=_COLOURS[kind])
        block = document.blocks.new(f"WAYMARK_{code}")
        block.add_circle((0, 0), height / 4, dxfattribs={"layer": "0"})
        block.add_line((0, 0), (0, height), dxfattribs={"layer": "0"})
        for row, tag in enumerate(_TAGS):
            attributes = {"height": height, "layer": "0", "invisible": int(row > 0)}
            block.add_attdef(tag, (height / 2, -row * 1.5 * height), dxfattribs={**attributes, "flags": int(row > 0)})
    space = document.modelspace()
    owner = str(space.block_record_handle)
    points = stakeout.points
    middle = (float(np.mean([p.east for p in points])), float(np.mean([p.north for p in points])))
    document.set_modelspace_vport(height=float(max(np.ptp([p.north for p in points]), 10.0)), center=middle)
    stream = io.StringIO()
    document.write(stream)
    text = _undated(stream.getvalue())
    first = int(document.header.get("$HANDSEED", "0") or "0", 16) + 0x1000
    entities, last = _entities(stakeout, owner, height, first)
    text = re.sub(r"(\$HANDSEED\n  5\n)[^\n]*", rf"\g<1>{last + 1:X}", text)
    head, section, rest = text.partition("  2\nENTITIES\n")
    return (head + section + entities + rest).encode("utf-8")


_TAGS = ("NUMBER", "CODE", "DETAIL", "LANE", "STATION", "BEARING")


def _layer(code: str) -> str:
    return f"WAYMARK-{code}"


def _entities(stakeout: Stakeout, owner: str, height: float, handle: int) -> tuple[str, int]:
    """INSERT with its ATTRIBs and a POINT for each point, and the last handle."""
    pieces = []
    for point in stakeout.points:
        code, layer = point.code, _layer(point.code)
        place = f" 10\n{point.east:.4f}\n 20\n{point.north:.4f}\n 30\n{point.height or 0.0:z.4f}\n"
        turn = 0.0 if point.bearing_deg is None else -point.bearing_deg % 360.0
        insert = handle
        pieces.append(
            f"  0\nINSERT\n  5\n{insert:X}\n330\n{owner}\n100\nAcDbEntity\n  8\n{layer}\n100\n"
            f"AcDbBlockReference\n 66\n1\n  2\nWAYMARK_{code}\n{place} 50\n{turn:.6f}\n"
        )
        for row, (tag, value) in enumerate(zip(_TAGS, _values(point), strict=True)):
            handle += 1
            y = point.north - row * 1.5 * height
            at = f" 10\n{point.east + height / 2:.4f}\n 20\n{y:.4f}\n 30\n{point.height or 0.0:z.4f}\n"
            pieces.append(
                f"  0\nATTRIB\n  5\n{handle:X}\n330\n{insert:X}\n100\nAcDbEntity\n  8\n{layer}\n100\nAcDbText\n{at}"
                f" 40\n{height:.4f}\n  1\n{_dxf_text(value)}\n100\nAcDbAttribute\n  2\n{tag}\n 70\n{int(row > 0)}\n"
            )
        pieces.append(f"  0\nSEQEND\n  5\n{handle + 1:X}\n330\n{insert:X}\n100\nAcDbEntity\n  8\n{layer}\n")
        pieces.append(
            f"  0\nPOINT\n  5\n{handle + 2:X}\n330\n{owner}\n100\nAcDbEntity\n  8\n{layer}\n100\nAcDbPoint\n{place}"
        )
        handle += 3
    return "".join(pieces), handle


def _values(point: StakePoint) -> tuple[str, ...]:
    bearing = "" if point.bearing_deg is None else f"{point.bearing_deg:.2f}"
    return point.name, point.marker.code, point.detail, point.marker.lane, point.station, bearing


def _dxf_text(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text).replace("^", "^ ")[:250]


def _undated(dxf: str) -> str:
    """Take the time of writing and the random ids out, which ezdxf puts into every file."""
    dxf = _DATES.sub(r"\g<1>2451545.0", dxf)
    dxf = _GUIDS.sub(r"\g<1>{00000000-0000-0000-0000-000000000000}", dxf)
    return _STAMPS.sub(r"\1", dxf)


# --- GIS ------------------------------------------------------------------------------------------------------------


def _gpkg(stakeout: Stakeout) -> bytes:
    """GeoPackage with one layer of points, in the crew's system; coordinates are in the unit of that system."""
    import pyogrio  # type: ignore[import-untyped]

    own_m = METRES[crs_unit(reference_system(stakeout.crs))]
    scale = METRES[stakeout.unit] / own_m
    points = stakeout.points
    heights = [np.nan if p.height is None else p.height * METRES[stakeout.unit] for p in points]
    known = bool(np.isfinite(heights).all())
    geometry = shapely.points(
        *(np.array(values) for values in ([p.east * scale for p in points], [p.north * scale for p in points])),
        *([np.array(heights)] if known else []),
    )
    rows: dict[str, list[Any]] = {
        "point": [p.name for p in points],
        "code": [p.code for p in points],
        "family": [p.marker.family for p in points],
        "marker": [p.marker.number for p in points],
        "marker_code": [p.marker.code for p in points],
        "description": [p.description for p in points],
        "lane": [p.marker.lane for p in points],
        "station": [p.station for p in points],
        "height_m": heights,
        "grid_bearing_deg": [np.nan if p.bearing_deg is None else p.bearing_deg for p in points],
    }
    columns = [
        np.array(
            values, dtype=np.int64 if name == "marker" else (np.float64 if name.endswith(("_m", "_deg")) else object)
        )
        for name, values in rows.items()
    ]
    stream = io.BytesIO()
    before = pyogrio.get_gdal_config_option("OGR_CURRENT_DATE")
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": _STAMP})
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            pyogrio.raw.write(
                stream, shapely.to_wkb(geometry), columns, list(rows), driver="GPKG", layer="stakeout",
                geometry_type="Point Z" if known else "Point", crs=stakeout.crs,
                layer_metadata={"unit": stakeout.unit, "transformation": stakeout.note},
            )  # fmt: skip
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": before})
    return stream.getvalue()


def _geojson(stakeout: Stakeout) -> bytes:
    """GeoJSON (RFC 7946) in WGS 84, with the crew's easting, northing and elevation as properties."""
    features = []
    for point in stakeout.points:
        feature = marker_feature(stakeout.plan, point.marker)
        properties = {
            "point": point.name, "code": point.code, "description": point.description, "easting": round(point.east, 4),
            "northing": round(point.north, 4), "elevation": None if point.height is None else round(point.height, 4),
            "grid_bearing_deg": point.bearing_deg, "crs": stakeout.crs, "unit": stakeout.unit,
        }  # fmt: skip
        place = [round(point.lon_deg, 9), round(point.lat_deg, 9), *feature["geometry"]["coordinates"][2:]]
        features.append(
            {
                "type": "Feature",
                "id": point.name,
                "geometry": {"type": "Point", "coordinates": place},
                "properties": {**properties, "marker": feature["properties"]},
            }
        )
    return orjson.dumps({"type": "FeatureCollection", "name": stakeout.plan.name, "features": features})


def _readme(stakeout: Stakeout) -> bytes:
    """What the other files cannot state: reference system, unit, heights, accuracy."""
    road = stakeout.plan.alignment
    datum = road.vertical_datum or "none: the road has no heights"
    warning = [] if road.surveyed else ["PLANNED - POSITIONS NOT SURVEYED: the road was placed by an origin.", ""]
    lines = [
        f"Stakeout of the plan {stakeout.plan.name}",
        "",
        *warning,
        *([f"Magnets: {fixed}"] if (fixed := stakeout.plan.rules.installation.text) else []),
        f"Points: {len(stakeout.points)} for {len(stakeout.plan.markers)} markers; magnets of tags are 12A, 12B, ...",
        f"Reference system: {stakeout.crs} ({stakeout.crs_name})",
        f"Unit of coordinates and heights: {stakeout.unit} ({METRES[stakeout.unit]:.12g} m)",
        f"Heights: road surface; datum: {datum}",
        f"Transformation: {stakeout.note}",
        f"Stated accuracy of the transformation: {stakeout.accuracy_m:g} m",
        f"Positions of the road: {road.grade}; realization {road.realization or 'not stated'}, "
        f"epoch {road.epoch or 'not stated'}",
        "Bearings (BRG): clockwise from grid north; of plates the upper edge, of lying magnets the north pole.",
        "PNEZD: point, northing, easting, elevation, description. PENZD: point, easting, northing, elevation, ...",
        f"Codes: {', '.join(f'{code} = {kind}' for kind, code in CODES.items())}.",
        "GeoPackage: coordinates in the unit of the reference system. GeoJSON: WGS 84, with easting and northing.",
        "",
    ]
    return "\r\n".join(lines).encode()


_WRITERS: Mapping[StakeoutFormat, Callable[[Stakeout], bytes]] = {
    StakeoutFormat.PNEZD: lambda stakeout: _delimited(stakeout, northing_first=True),
    StakeoutFormat.PENZD: lambda stakeout: _delimited(stakeout, northing_first=False),
    StakeoutFormat.LANDXML: _landxml,
    StakeoutFormat.DXF: _dxf,
    StakeoutFormat.GPKG: _gpkg,
    StakeoutFormat.GEOJSON: _geojson,
    StakeoutFormat.README: _readme,
}
