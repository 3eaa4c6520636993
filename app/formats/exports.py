"""Markers as files for GIS and surveyors. Each writer takes flat records, one a marker, with the names of `FIELDS`."""

from __future__ import annotations

import io
import re
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import IO, Any, NamedTuple
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import numpy.typing as npt
import orjson
import shapely
from pyproj import Transformer

from app.formats.text import TableWriter
from app.geodesy.systems import is_ellipsoidal
from app.values import JsonObject

Record = JsonObject

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
MAX_FROM_MERIDIAN_DEG = 9.0
"""Farthest longitude from the central meridian of a zone that a marker is projected in. [deg] A road of 6 degrees that
begins in one zone lies in it whole."""


class WrittenFile(NamedTuple):
    """A file, and the ids of the markers that lie too far from its UTM zone."""

    path: Path
    left_out: tuple[str, ...] = ()


_DXF_PLACE = (111111.25, 222222.25, 333333.25)
_DXF_VALUES = (*map(str, _DXF_PLACE), "<CODE>", "<ID>", "<HEIGHT>")
"""What stands in the reference that is repeated, in the place of a marker's position and texts."""
_DXF_SECTION_END = "  0\nENDSEC\n"
_GIS_PAGE = 50_000


class _Zone(NamedTuple):
    """Markers in a UTM zone [m], and the ids of the others."""

    code: int
    records: list[Record]
    east: npt.NDArray[np.float64]
    north: npt.NDArray[np.float64]
    left_out: tuple[str, ...]


def write_csv(pages: Iterable[Sequence[Record]]) -> Iterator[bytes]:
    """CSV (RFC 4180), a page at a time; a text that a spreadsheet would run as a formula gets an apostrophe."""
    yield (",".join(FIELDS) + "\r\n").encode()
    for page in pages:
        text = io.StringIO(newline="")
        writer = TableWriter(text)
        for record in page:
            writer.write_row([*(_text(record[n]) for n in TEXTS), *(_number(record[n]) for n in NUMBERS)])
        yield text.getvalue().encode()


def _text(value: object) -> str:
    return "" if value is None else str(value)


def _number(value: object) -> str:
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


def _feature(record: Record) -> dict[str, object]:
    height_m = _ellipsoidal_m(record)
    place = [record["lon_deg"], record["lat_deg"], *([] if height_m is None else [height_m])]
    properties = {name: record[name] for name in FIELDS if name not in ("id", "lon_deg", "lat_deg")}
    geometry = {"type": "Point", "coordinates": place}
    return {"type": "Feature", "id": record["id"], "geometry": geometry, "properties": properties}


def _ellipsoidal_m(record: Record) -> float | None:
    """Height of a point's geometry, of all formats: above the ellipsoid, or none (RFC 7946, section 4)."""
    return record["height_m"] if is_ellipsoidal(record["vertical_datum"]) else None


def write_file(kind: str, pages: Iterable[Sequence[Record]], folder: Path, *, all_heights: bool) -> WrittenFile:
    """A file of a kind that has to be complete before it can be sent, in an empty folder.

    Parameters
    ----------
    kind : str
        ``gpkg``, ``shapefile``, ``kml``, ``landxml`` or ``dxf``.
    pages : iterable of sequences of mapping
        At least one page, with at least one record.
    all_heights : bool
        As for `write_gis`.
    """
    if kind in ("landxml", "dxf"):
        path = folder / f"markers.{kind}"
        write = write_landxml if kind == "landxml" else write_dxf
        with path.open("wb") as file:
            return WrittenFile(path, write(list(chain.from_iterable(pages)), file))
    records = chain.from_iterable(pages)
    first = iter(lambda: list(islice(records, None if kind == "kml" else _GIS_PAGE)), [])
    return WrittenFile(write_gis(first, kind, folder, all_heights=all_heights))


def write_gis(pages: Iterable[Sequence[Record]], driver: str, folder: Path, *, all_heights: bool) -> Path:
    """A GeoPackage, a zipped Shapefile (names of `SHAPEFILE_NAMES`) or KML in a folder, by GDAL, a page at a time.

    Parameters
    ----------
    pages : iterable of sequences of mapping
        At least one page; of KML, exactly one.
    driver : str
        ``gpkg``, ``shapefile`` or ``kml``.
    folder : Path
        An empty one.
    all_heights : bool
        Whether every marker has an ellipsoidal height. The points of a Shapefile all have one or none; those of a
        GeoPackage have it where it is known. KML has none: it takes them to be above the geoid.
    """
    from pyogrio import raw  # type: ignore[import-untyped]  # 50 MB that most servers never need

    name, suffix = {"gpkg": ("GPKG", "gpkg"), "shapefile": ("ESRI Shapefile", "shp"), "kml": ("KML", "kml")}[driver]
    names = [SHAPEFILE_NAMES[n] for n in FIELDS] if driver == "shapefile" else list(FIELDS)
    kind = "Point Z" if all_heights and driver == "shapefile" else "Point"  # GDAL adds z to a GeoPackage's as it comes
    path = folder / f"markers.{suffix}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # KML has a name of its own for some fields
        for number, page in enumerate(pages):
            geometry, columns = _gis_columns(page, flat=kind == "Point" and driver != "gpkg")
            raw.write(
                path, geometry, columns, names, driver=name, geometry_type=kind, crs="EPSG:4326",
                layer="markers", encoding="UTF-8", append=number > 0,
            )  # fmt: skip
    return _zipped(folder) if driver == "shapefile" else path


def _gis_columns(page: Sequence[Record], *, flat: bool) -> tuple[object, list[Any]]:
    """Points as WKB, and the columns of `FIELDS`."""
    values = list(zip(*(record.values() for record in page), strict=True))
    of = dict(zip(page[0], values, strict=True))
    columns = [np.array(of[n], dtype=object) for n in TEXTS]
    columns += [np.array([np.nan if v is None else v for v in of[n]], dtype=np.float64) for n in NUMBERS]
    lon, lat = (columns[FIELDS.index(n)] for n in ("lon_deg", "lat_deg"))
    points = shapely.points(lon, lat)
    if not flat:
        height = np.array([_ellipsoidal_m(record) for record in page], dtype=np.float64)
        known = np.isfinite(height)
        points[known] = shapely.points(lon[known], lat[known], height[known])
    return shapely.to_wkb(points), columns


def _zipped(folder: Path) -> Path:
    path = folder / "markers.shp.zip"
    parts = sorted(folder.iterdir())
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for part in parts:
            archive.write(part, part.name)
    return path


def write_landxml(records: Sequence[Record], file: IO[bytes]) -> tuple[str, ...]:
    """LandXML 1.2 CgPoints (north, east, ellipsoidal height) in the UTM zone of WGS 84 that most markers lie in.

    Returns the ids of the markers that lie too far from it.
    """
    zone = _utm(records)
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" version="1.2"><Units><Metric linearUnit="meter" '
        'areaUnit="squareMeter" volumeUnit="cubicMeter" temperatureUnit="celsius" pressureUnit="milliBars"/></Units>',
        f'<CoordinateSystem epsgCode="{zone.code}"/><CgPoints>',
    ]
    lines += [f"<!-- left out: {marker_id}, too far from this zone -->" for marker_id in zone.left_out]
    for record, e, n in zip(zone.records, zone.east, zone.north, strict=True):
        z = _ellipsoidal_m(record)
        height = f" {z:.4f}" if z is not None else ""
        name, description = quoteattr(_code(record)), quoteattr("; ".join([str(record["id"]), *_other_height(record)]))
        lines.append(f"<CgPoint name={name} desc={description}>{n:.4f} {e:.4f}{escape(height)}</CgPoint>")
    file.writelines(f"{line}\n".encode() for line in (*lines, "</CgPoints></LandXML>"))
    return zone.left_out


def write_dxf(records: Sequence[Record], file: IO[bytes]) -> tuple[str, ...]:
    """DXF R2010 in metres: a block reference a marker with its code and id, in the UTM zone of WGS 84 that most lie in.

    Its z is the ellipsoidal height; 0, the plane of the drawing, where that is unknown: a block always has one. Another
    height is the attribute HEIGHT, with its datum. Returns the ids of the markers that lie too far from the zone.

    ezdxf writes the drawing with one reference, which is repeated as text for each marker: objects would take 7 kB and
    a millisecond of processor time for each.
    """
    from ezdxf.filemanagement import new

    zone = _utm(records)
    layer = f"WAYMARK_EPSG_{zone.code}"
    document = new("R2010", units=6)
    document.header["$INSUNITS"] = 6
    document.layers.add(layer)
    for marker_id in zone.left_out:
        document.header.custom_vars.append("LEFT_OUT", marker_id)
    block = document.blocks.new("WAYMARK_MARKER")
    block.add_point((0, 0))
    for tag in ("CODE", "ID", "HEIGHT"):
        block.add_attdef(tag, (0, 0), dxfattribs={"height": 0.25})
    reference = document.modelspace().add_blockref("WAYMARK_MARKER", _DXF_PLACE, dxfattribs={"layer": layer})
    reference.add_auto_attribs({tag: f"<{tag}>" for tag in ("CODE", "ID", "HEIGHT")})
    parts = (reference, *reference.attribs, reference.seqend)
    handles = [str(part.dxf.handle) for part in parts if part is not None]
    text = io.StringIO()
    document.write(text)
    before, start, rest = text.getvalue().partition(f"  0\nINSERT\n  5\n{handles[0]}\n")
    own, _, after = rest.partition(_DXF_SECTION_END)
    first_handle, step = int(str(document.entitydb.next_handle()), 16), len(handles)
    seed = re.compile(r"(\$HANDSEED\n  5\n)[0-9A-F]+")
    file.write(seed.sub(rf"\g<1>{first_handle + step * len(zone.records):X}", before).encode())
    changing = "|".join([*(rf"(?<=\n){handle}(?=\n)" for handle in handles), *_DXF_VALUES])
    template = re.sub(changing, lambda found: f"{{{(*handles, *_DXF_VALUES).index(found[0])}}}", start + own)
    for k, (record, e, n) in enumerate(zip(zone.records, zone.east.tolist(), zone.north.tolist(), strict=True)):
        numbers = (f"{first_handle + step * k + j:X}" for j in range(step))
        texts = (_code(record), str(record["id"]), "".join(_other_height(record)))
        values = (*numbers, e, n, _ellipsoidal_m(record) or 0.0, *map(_one_line, texts))
        file.write(template.format(*values).encode())
    file.write((_DXF_SECTION_END + after).encode())
    return zone.left_out


def _one_line(text: str) -> str:
    return " ".join(text.splitlines())


def _code(record: Record) -> str:
    return str(record["code"] if record["code"] is not None else record["id"])


def _other_height(record: Record) -> list[str]:
    """A height that is not in the geometry, in words."""
    known = record["height_m"] is not None and _ellipsoidal_m(record) is None
    return [f"{record['height_m']:.4f} m above {record['vertical_datum']}"] if known else []


def _utm(records: Sequence[Record]) -> _Zone:
    """The zone that most markers lie in, with those that are not too far from it."""
    lon, lat = (np.array([r[n] for r in records], dtype=np.float64) for n in ("lon_deg", "lat_deg"))
    number = int(np.bincount(np.minimum((lon + 180.0) // 6.0, 59.0).astype(np.intp)).argmax())
    away_deg = np.abs((lon - (6.0 * number - 177.0) + 180.0) % 360.0 - 180.0)
    near = away_deg <= MAX_FROM_MERIDIAN_DEG
    code = (32601 if float(np.median(lat[near])) >= 0 else 32701) + number
    east, north = Transformer.from_crs("EPSG:4326", f"EPSG:{code}", always_xy=True).transform(lon[near], lat[near])
    kept = [record for record, is_near in zip(records, near, strict=True) if is_near]
    left_out = tuple(str(record["id"]) for record, is_near in zip(records, near, strict=True) if not is_near)
    return _Zone(code, kept, np.asarray(east), np.asarray(north), left_out)
