"""Markers as files for GIS and surveyors. Each writer takes flat records, one a marker, with the names of `FIELDS`."""

from __future__ import annotations

import io
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import orjson
import shapely
from ezdxf.filemanagement import new
from pyogrio import raw  # type: ignore[import-untyped]
from pyproj import Transformer

from app.errors import InvalidParameter
from app.formats.spreadsheet import TableWriter

Record = Mapping[str, Any]

TEXTS = (
    "id", "family", "status", "scheme", "code", "side", "road", "realization", "vertical_datum", "survey_method",
    "crs", "surveyor", "instrument", "survey_file_sha256", "localization_grade", "transform_note", "updated_at",
)  # fmt: skip
NUMBERS = (
    "lon_deg", "lat_deg", "height_m", "heading_deg", "measure_m", "offset_m", "epoch", "horizontal_rmse_m",
    "vertical_rmse_m", "check_points", "transform_accuracy_m", "version",
)  # fmt: skip
FIELDS = (*TEXTS, *NUMBERS)
SHAPEFILE_NAMES = {
    "id": "id", "family": "family", "status": "status", "scheme": "scheme", "code": "code", "side": "side",
    "road": "road", "realization": "realizatn", "vertical_datum": "vert_datum", "survey_method": "method",
    "localization_grade": "loc_grade", "updated_at": "updated_at", "lon_deg": "lon_deg", "lat_deg": "lat_deg",
    "height_m": "height_m", "heading_deg": "headng_deg", "measure_m": "measure_m", "offset_m": "offset_m",
    "epoch": "epoch", "horizontal_rmse_m": "h_rmse_m", "vertical_rmse_m": "v_rmse_m", "version": "version",
    "crs": "crs", "surveyor": "surveyor", "instrument": "instrument", "survey_file_sha256": "survy_file",
    "transform_note": "trans_note", "check_points": "check_pts", "transform_accuracy_m": "trans_acc",
}  # fmt: skip
"""Ten characters a name, the same in every file."""


def write_csv(pages: Iterable[Sequence[Record]]) -> Iterator[bytes]:
    """CSV (RFC 4180), a page at a time; a text that a spreadsheet would run as a formula gets an apostrophe."""
    yield (",".join(FIELDS) + "\r\n").encode()
    for page in pages:
        text = io.StringIO(newline="")
        writer = TableWriter(text)
        for record in page:
            writer.write_row([*(_text(record[n]) for n in TEXTS), *(_number(record[n]) for n in NUMBERS)])
        yield text.getvalue().encode()


def _text(value: Any) -> str:
    return "" if value is None else str(value)


def _number(value: Any) -> str:
    return "" if value is None else repr(value)


def write_geojson(pages: Iterable[Sequence[Record]]) -> Iterator[bytes]:
    """A FeatureCollection (RFC 7946), a page at a time."""
    yield b'{"type":"FeatureCollection","features":['
    first = True
    for page in pages:
        text = b",".join(orjson.dumps(_feature(record)) for record in page)
        yield text if first else b"," + text
        first = False
    yield b"]}"


def _feature(record: Record) -> dict[str, Any]:
    place = [record["lon_deg"], record["lat_deg"]]
    if record["height_m"] is not None and record["vertical_datum"] == "ellipsoid":  # section 3.1.1: above WGS 84
        place.append(record["height_m"])
    properties = {name: record[name] for name in FIELDS if name not in ("id", "lon_deg", "lat_deg")}
    geometry = {"type": "Point", "coordinates": place}
    return {"type": "Feature", "id": record["id"], "geometry": geometry, "properties": properties}


def write_gis(pages: Iterable[Sequence[Record]], driver: str, folder: Path, *, has_heights: bool) -> Path:
    """A GeoPackage, a zipped Shapefile (names of `SHAPEFILE_NAMES`) or KML in a folder, by GDAL, a page at a time.

    Parameters
    ----------
    pages : iterable of sequences of mapping
        At least one page; of KML, exactly one.
    driver : str
        ``gpkg``, ``shapefile`` or ``kml``.
    folder : Path
        An empty one.
    has_heights : bool
        Whether points have a z; zero where a marker has no height. KML has none: it takes them to be above the geoid.
    """
    name, suffix = {"gpkg": ("GPKG", "gpkg"), "shapefile": ("ESRI Shapefile", "shp"), "kml": ("KML", "kml")}[driver]
    names = [SHAPEFILE_NAMES[n] for n in FIELDS] if driver == "shapefile" else list(FIELDS)
    kind = "Point Z" if has_heights and driver != "kml" else "Point"
    path = folder / f"markers.{suffix}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # KML has a name of its own for some fields
        for number, page in enumerate(pages):
            geometry, columns = _gis_columns(page, flat=kind == "Point")
            raw.write(
                path, geometry, columns, names, driver=name, geometry_type=kind, crs="EPSG:4326",
                layer="markers", encoding="UTF-8", append=number > 0,
            )  # fmt: skip
    return _zipped(folder) if driver == "shapefile" else path


def _gis_columns(page: Sequence[Record], *, flat: bool) -> tuple[Any, list[Any]]:
    """Points as WKB, and the columns of `FIELDS`."""
    values = list(zip(*(record.values() for record in page), strict=True))
    of = dict(zip(page[0], values, strict=True))
    columns = [np.array(of[n], dtype=object) for n in TEXTS]
    columns += [np.array([np.nan if v is None else v for v in of[n]], dtype=np.float64) for n in NUMBERS]
    lon, lat = (columns[FIELDS.index(n)] for n in ("lon_deg", "lat_deg"))
    height = np.nan_to_num(columns[FIELDS.index("height_m")])
    points = shapely.points(lon, lat) if flat else shapely.points(lon, lat, height)
    return shapely.to_wkb(points), columns


def _zipped(folder: Path) -> Path:
    path = folder / "markers.shp.zip"
    parts = sorted(folder.iterdir())
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for part in parts:
            archive.write(part, part.name)
    return path


def write_landxml(records: Sequence[Record]) -> bytes:
    """LandXML 1.2 CgPoints (north, east, elevation) in the UTM zone of WGS 84 that the markers lie in."""
    code, east, north = _utm(records)
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" version="1.2"><Units><Metric linearUnit="meter" '
        'areaUnit="squareMeter" volumeUnit="cubicMeter" temperatureUnit="celsius" pressureUnit="milliBars"/></Units>',
        f'<CoordinateSystem epsgCode="{code}"/><CgPoints>',
    ]
    for record, e, n in zip(records, east, north, strict=True):
        height = f" {record['height_m']:.4f}" if record["height_m"] is not None else ""
        name, identifier = quoteattr(_code(record)), quoteattr(str(record["id"]))
        lines.append(f"<CgPoint name={name} desc={identifier}>{n:.4f} {e:.4f}{escape(height)}</CgPoint>")
    return "\n".join([*lines, "</CgPoints></LandXML>", ""]).encode()


def write_dxf(records: Sequence[Record]) -> bytes:
    """DXF R2010 in metres: a block reference a marker with its code and id, in the UTM zone of WGS 84."""
    code, east, north = _utm(records)
    document = new("R2010", units=6)
    document.header["$INSUNITS"] = 6
    document.layers.add(f"WAYMARK_EPSG_{code}")
    block = document.blocks.new("WAYMARK_MARKER")
    block.add_point((0, 0))
    for tag in ("CODE", "ID"):
        block.add_attdef(tag, (0, 0), dxfattribs={"height": 0.25})
    space = document.modelspace()
    for record, e, n in zip(records, east, north, strict=True):
        place = (float(e), float(n), record["height_m"] or 0.0)
        reference = space.add_blockref("WAYMARK_MARKER", place, dxfattribs={"layer": f"WAYMARK_EPSG_{code}"})
        reference.add_auto_attribs({"CODE": _code(record), "ID": str(record["id"])})
    text = io.StringIO()
    document.write(text)
    return text.getvalue().encode()


def _code(record: Record) -> str:
    return str(record["code"] if record["code"] is not None else record["id"])


def _utm(records: Sequence[Record]) -> tuple[int, np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """EPSG code of the zone, eastings and northings [m]."""
    lon, lat = (np.array([r[n] for r in records], dtype=np.float64) for n in ("lon_deg", "lat_deg"))
    middle = float(np.median(lon))
    if len(records) and float(np.ptp(lon)) > 6.0:
        raise InvalidParameter(
            "the markers lie too far apart for one UTM zone",
            field="bbox",
            limit="6 degrees of longitude",
            cure="export a smaller box, or a format in degrees",
        )
    zone = min(int((middle + 180.0) // 6.0) + 1, 60)
    code = (32600 if float(np.median(lat)) >= 0 else 32700) + zone
    east, north = Transformer.from_crs("EPSG:4326", f"EPSG:{code}", always_xy=True).transform(lon, lat)
    return code, np.asarray(east), np.asarray(north)
