"""Markers as files for GIS and surveyors. Each writer takes flat records, one a marker, with the names of `FIELDS`."""

from __future__ import annotations

import io
import math
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

from app.errors import InvalidParameter, ReferenceSystemError
from app.formats.surveys.coordinates import crs_unit
from app.formats.surveys.declaration import METRES
from app.formats.text import TableWriter
from app.geodesy import reference_system
from app.geodesy.place import Origin, heights_above, positions_in_system
from app.geodesy.systems import ELLIPSOID, covers, is_ellipsoidal, is_global
from app.values import Floats, JsonObject

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


FRAME_TEXTS = ("geometry_crs", "geometry_realization", "geometry_vertical_datum")
FRAME_NUMBERS = ("geometry_epoch",)
FRAME_FIELDS = (*FRAME_TEXTS, *FRAME_NUMBERS)
"""What the geometry of a framed record is in; `lon_deg`, `lat_deg` and `height_m` stay those of the registry."""
SHAPEFILE_NAMES |= {
    "geometry_crs": "geom_crs", "geometry_realization": "geom_realz", "geometry_vertical_datum": "geom_vdatm",
    "geometry_epoch": "geom_epoch",
}  # fmt: skip
ORIGIN_FIELDS = ("origin_crs", "origin_realization")
"""System and realization in which a marker, or the road of its plan, came; records that are framed have them."""
_ORIGIN = (*ORIGIN_FIELDS, "epoch", "vertical_datum")
_PLACE = ("x", "y", "z_m")


class ExportFrame(NamedTuple):
    """The reference system of an export."""

    crs: str  # ``EPSG:code`` or ``OGC:CRS84``
    realization: str | None = None  # without, that in which each marker came, where it came in this system
    epoch: float | None = None  # [decimal year] without, that of each marker
    # as `normalize_vertical_datum` writes it; without, each height is above its own datum
    vertical_datum: str | None = None
    needs_heights: bool = True  # False: a height that cannot be transformed to the vertical datum is left out


def frame_records(records: Sequence[Record], frame: ExportFrame) -> tuple[list[Record], ReferenceSystemError | None]:
    """Records with their place in a reference system, `_PLACE` and `FRAME_FIELDS`, and why some have none.

    A marker outside the system's area, or whose own system has no transformation to it, has no place.
    """
    groups: dict[tuple[Any, ...], list[int]] = {}
    for number, record in enumerate(records):
        unknown = record["transform_accuracy_m"] is None
        groups.setdefault((*(record[name] for name in _ORIGIN), unknown), []).append(number)
    framed: list[Record] = [{} for _ in records]
    problem: ReferenceSystemError | None = None
    for (crs, realization, epoch, datum, unknown), numbers in groups.items():
        origin = Origin(crs, not unknown, epoch, is_ellipsoidal(datum), realization)
        own = [records[number] for number in numbers]
        place = np.full((3, len(own)), np.nan)
        try:
            found = _place_in(own, frame, origin, datum or ELLIPSOID)
        except ReferenceSystemError as error:
            problem = problem or error
        else:
            place[:] = found
        is_own = not is_global(reference_system(frame.crs))
        realization = frame.realization or (realization if is_own else None)
        stated = (frame.crs, realization, frame.vertical_datum or datum or ELLIPSOID, frame.epoch or epoch)
        for number, values in zip(numbers, place.T.tolist(), strict=True):
            coordinates = (None if math.isnan(value) else value for value in values)
            named = zip((*FRAME_FIELDS, *_PLACE), (*stated, *coordinates), strict=True)
            framed[number] = {**records[number], **dict(named)}
    return framed, problem


def _place_in(records: Sequence[Record], frame: ExportFrame, origin: Origin, datum: str) -> Floats:
    """Coordinates and heights, shape (3, N); NaN outside the system's area, and where a height is unknown."""
    lon, lat = (np.array([record[name] for record in records], np.float64) for name in ("lon_deg", "lat_deg"))
    height = np.array([np.nan if record["height_m"] is None else record["height_m"] for record in records], np.float64)
    place = np.full((3, len(records)), np.nan)
    inside = covers(reference_system(frame.crs).area_of_use, lon, lat)
    if not inside.any():
        inside[:] = True  # all are refused below, with the area that the system is made for
    at = (lon[inside], lat[inside])
    found = positions_in_system(
        *at, height[inside], frame.crs, origin=origin, realization=frame.realization, epoch=frame.epoch
    )
    up = found.height_m
    try:
        if np.isfinite(up).any():
            up = heights_above(*at, up, frame.crs, datum, frame.vertical_datum or datum)
    except ReferenceSystemError:
        if frame.needs_heights:
            raise
        up = np.full_like(up, np.nan)
    place[:, inside] = found.first, found.second, up
    return place


class WrittenFile(NamedTuple):
    """A file, and the ids of the markers that lie outside its reference system's area."""

    path: Path
    left_out: tuple[str, ...] = ()


INSUNITS = {"m": 6, "ft-intl": 2, "ft-us": 21}
"""Units of drawings. Source: Autodesk DXF reference, "HEADER section group codes"."""
LANDXML_UNITS = {
    "m": '<Metric linearUnit="meter" areaUnit="squareMeter" volumeUnit="cubicMeter" temperatureUnit="celsius" '
    'pressureUnit="milliBars"/>',
    **{
        unit: f'<Imperial linearUnit="{name}" areaUnit="squareFoot" volumeUnit="cubicFeet" '
        'temperatureUnit="fahrenheit" pressureUnit="inchHG"/>'
        for unit, name in (("ft-intl", "foot"), ("ft-us", "USSurveyFoot"))
    },
}
_DXF_PLACE = (111111.25, 222222.25, 333333.25)
_DXF_VALUES = (*map(str, _DXF_PLACE), "<CODE>", "<ID>", "<HEIGHT>")
"""What stands in the reference that is repeated, in the place of a marker's position and texts."""
_DXF_SECTION_END = "  0\nENDSEC\n"
_GIS_PAGE = 50_000
_BOX = ("xmin", "ymin", "xmax", "ymax")


class _Zone(NamedTuple):
    """Markers in a projected system, in its unit, and the ids of the others."""

    code: int
    records: list[Record]
    east: npt.NDArray[np.float64]
    north: npt.NDArray[np.float64]
    left_out: tuple[str, ...]
    unit: str = "m"
    stated: str = "WGS 84 / ITRF, heights above the ellipsoid"  # what the coordinates are in, for people


def write_csv(pages: Iterable[Sequence[Record]], frame: ExportFrame | None = None) -> Iterator[bytes]:
    """CSV (RFC 4180), a page at a time; a text that a spreadsheet would run as a formula gets an apostrophe."""
    texts, numbers = (
        (TEXTS, NUMBERS) if frame is None else ((*TEXTS, *FRAME_TEXTS), (*NUMBERS, *FRAME_NUMBERS, *_PLACE))
    )
    yield (",".join((*texts, *numbers)) + "\r\n").encode()
    for page in pages:
        text = io.StringIO(newline="")
        writer = TableWriter(text)
        for record in page:
            writer.write_row([*(_text(record[n]) for n in texts), *(_number(record[n]) for n in numbers)])
        yield text.getvalue().encode()


def _text(value: object) -> str:
    return "" if value is None else str(value)


def _number(value: object) -> str:
    return "" if value is None else repr(value)


def write_geojson(pages: Iterable[Sequence[Record]], frame: ExportFrame | None = None) -> Iterator[bytes]:
    """A FeatureCollection (RFC 7946), a page at a time; in another system with its name, as GeoJSON 2008 has it."""
    yield b'{"type":"FeatureCollection",'
    if frame is not None:
        urn = f"urn:ogc:def:crs:{'OGC::CRS84' if frame.crs == 'OGC:CRS84' else frame.crs.replace(':', '::')}"
        yield b'"crs":' + orjson.dumps({"type": "name", "properties": {"name": urn}}) + b","
    yield b'"features":['
    first = True
    for page in pages:
        text = b",".join(orjson.dumps(_feature(record)) for record in page)
        yield text if first else b"," + text
        first = False
    yield b"]}"


def _feature(record: Record) -> dict[str, object]:
    x, y, height_m = _place(record)
    names = [*FIELDS, *(FRAME_FIELDS if _is_framed(record) else ())]
    properties = {name: record[name] for name in names if name not in ("id", "lon_deg", "lat_deg")}
    coordinates = [x, y, *([] if height_m is None else [height_m])]
    geometry = None if x is None else {"type": "Point", "coordinates": coordinates}
    return {"type": "Feature", "id": record["id"], "geometry": geometry, "properties": properties}


def _is_framed(record: Record) -> bool:
    return "geometry_crs" in record


def _place(record: Record) -> tuple[float | None, float | None, float | None]:
    """Coordinates of a record's geometry; heights of those without a frame are ellipsoidal, or there are none."""
    if _is_framed(record):
        return record["x"], record["y"], record["z_m"]
    return record["lon_deg"], record["lat_deg"], _ellipsoidal_m(record)


def _ellipsoidal_m(record: Record) -> float | None:
    """Height of a point's geometry, of all formats: above the ellipsoid, or none (RFC 7946, section 4)."""
    return record["height_m"] if is_ellipsoidal(record["vertical_datum"]) else None


def write_file(kind: str, pages: Iterable[Sequence[Record]], folder: Path, *, all_heights: bool) -> WrittenFile:
    """A file of a kind that has to be complete before it can be sent, in an empty folder.

    Parameters
    ----------
    kind : str
        ``gpkg``, ``geoparquet``, ``flatgeobuf``, ``shapefile``, ``kml``, ``landxml`` or ``dxf``.
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
    steps = iter(lambda: list(islice(records, None if kind == "kml" else _GIS_PAGE)), [])
    if kind == "geoparquet":
        return write_geoparquet(steps, folder / "markers.parquet")
    return write_gis(steps, kind, folder, all_heights=all_heights)


def write_gis(pages: Iterable[Sequence[Record]], driver: str, folder: Path, *, all_heights: bool) -> WrittenFile:
    """A GeoPackage, FlatGeobuf, a zipped Shapefile (names of `SHAPEFILE_NAMES`) or KML in a folder, by GDAL, a page at
    a time.

    Parameters
    ----------
    pages : iterable of sequences of mapping
        At least one page; of KML, exactly one.
    driver : str
        ``gpkg``, ``flatgeobuf``, ``shapefile`` or ``kml``.
    folder : Path
        An empty one.
    all_heights : bool
        Whether every marker has a height that its geometry can have. The points of a Shapefile or of FlatGeobuf all
        have one or none; those of a GeoPackage have it where it is known. KML has none: it takes them to be above the
        geoid.
    """
    from pyogrio import raw  # type: ignore[import-untyped]  # 50 MB that most servers never need

    table = "gpkg" if driver == "flatgeobuf" else driver  # FlatGeobuf cannot be appended to
    name, suffix = {"gpkg": ("GPKG", "gpkg"), "shapefile": ("ESRI Shapefile", "shp"), "kml": ("KML", "kml")}[table]
    path, left_out, written = folder / f"markers.{suffix}", list[str](), 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # KML has a name of its own for some fields
        for whole in pages:
            page = _with_place(whole, left_out)
            if not page:
                continue
            texts, numbers, crs = _columns_of(page[0])
            fields = (*texts, *numbers)
            names = [SHAPEFILE_NAMES[n] for n in fields] if driver == "shapefile" else list(fields)
            # GDAL adds z to a GeoPackage's geometry as it comes
            kind = "Point Z" if all_heights and driver in ("shapefile", "flatgeobuf") else "Point"
            points, columns = _gis_columns(page, texts, numbers, flat=kind == "Point" and driver != "gpkg")
            raw.write(
                path, shapely.to_wkb(points), columns, names, driver=name, geometry_type=kind, crs=crs,
                layer="markers", encoding="UTF-8", append=written > 0,
            )  # fmt: skip
            written += len(page)
        if not written:
            raise _none_in_area()
        if driver == "flatgeobuf":
            layer, path = path, folder / "markers.fgb"
            with raw.open_arrow(layer, use_pyarrow=False) as (meta, rows):
                raw.write_arrow(
                    rows, path, driver="FlatGeobuf", layer="markers", geometry_type=kind, crs=crs,
                    geometry_name=meta["geometry_name"],
                )  # fmt: skip
            layer.unlink()
    return WrittenFile(_zipped(folder) if driver == "shapefile" else path, tuple(left_out))


def write_geoparquet(pages: Iterable[Sequence[Record]], path: Path) -> WrittenFile:
    """GeoParquet 1.1, a row group a page: points with z where it is known, and their boxes in the column `bbox`.

    The file states an epoch if it is that of all markers. Needs the extra `parquet`.
    """
    import pyarrow as pa
    from pyarrow.parquet import ParquetWriter

    remaining = iter(pages)
    first = next(remaining)
    texts, numbers, crs = _columns_of(first[0])
    types = {**dict.fromkeys(texts, pa.string()), **dict.fromkeys(numbers, pa.float64())}
    types |= {"bbox": pa.struct([(name, pa.float64()) for name in _BOX]), "geometry": pa.binary()}
    schema = pa.schema(list(types.items()))
    left_out, bounds = list[str](), list[Floats]()
    shapes, epochs = set[str](), set[float | None]()
    with ParquetWriter(path, schema, compression="zstd") as writer:
        for whole in chain([first], remaining):
            page = _with_place(whole, left_out)
            if not page:
                continue
            points, columns = _gis_columns(page, texts, numbers, flat=False)
            place = shapely.get_coordinates(points, include_z=True)
            x, y = (pa.array(place[:, axis]) for axis in (0, 1))
            arrays = {
                name: pa.array(values, types[name], from_pandas=True)  # NaN is null
                for name, values in zip((*texts, *numbers), columns, strict=True)
            }
            arrays["bbox"] = pa.StructArray.from_arrays([x, y, x, y], names=_BOX)
            arrays["geometry"] = pa.array(shapely.to_wkb(points, flavor="iso"), pa.binary())
            writer.write_table(pa.table(arrays, schema=schema))
            bounds += [np.fmin.reduce(place), np.fmax.reduce(place)]
            shapes.update(np.where(shapely.has_z(points), "Point Z", "Point").tolist())
            epochs.update(record["geometry_epoch" if _is_framed(record) else "epoch"] for record in page)
        if not bounds:
            raise _none_in_area()
        axes = 3 if "Point Z" in shapes else 2
        geometry: JsonObject = {
            "encoding": "WKB", "geometry_types": sorted(shapes), "crs": reference_system(crs).to_json_dict(),
            "edges": "planar", "covering": {"bbox": {name: ["bbox", name] for name in _BOX}},
            "bbox": [*np.fmin.reduce(bounds)[:axes].tolist(), *np.fmax.reduce(bounds)[:axes].tolist()],
        }  # fmt: skip
        if len(epochs) == 1 and (epoch := epochs.pop()) is not None:
            geometry["epoch"] = epoch
        geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": geometry}}
        writer.add_key_value_metadata({"geo": orjson.dumps(geo).decode()})
    return WrittenFile(path, tuple(left_out))


def _with_place(records: Sequence[Record], left_out: list[str]) -> list[Record]:
    """The records that have a place; the ids of the others are added to `left_out`."""
    left_out += [str(record["id"]) for record in records if _place(record)[0] is None]
    return [record for record in records if _place(record)[0] is not None]


def _columns_of(record: Record) -> tuple[Sequence[str], Sequence[str], str]:
    """Texts and numbers of a file of such records, and the system of its geometry."""
    if _is_framed(record):
        return (*TEXTS, *FRAME_TEXTS), (*NUMBERS, *FRAME_NUMBERS), record["geometry_crs"]
    return TEXTS, NUMBERS, "EPSG:4326"


def _none_in_area() -> InvalidParameter:
    return InvalidParameter(
        "no marker of the selection has a place in the system of the export",
        field="crs",
        limit="a system in whose area they lie",
        cure="choose another system, or leave crs out",
    )


def _gis_columns(
    page: Sequence[Record], texts: Sequence[str], numbers: Sequence[str], *, flat: bool
) -> tuple[npt.NDArray[np.object_], list[Any]]:
    """Points, and the columns."""
    values = list(zip(*(record.values() for record in page), strict=True))
    of = dict(zip(page[0], values, strict=True))
    columns = [np.array(of[n], dtype=object) for n in texts]
    columns += [np.array([np.nan if v is None else v for v in of[n]], dtype=np.float64) for n in numbers]
    x, y, z = np.array([_place(record) for record in page], dtype=np.float64).T
    points = shapely.points(x, y)
    if not flat:
        known = np.isfinite(z)
        points[known] = shapely.points(x[known], y[known], z[known])
    return points, columns


def _zipped(folder: Path) -> Path:
    path = folder / "markers.shp.zip"
    parts = sorted(folder.iterdir())
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for part in parts:
            archive.write(part, part.name)
    return path


def write_landxml(records: Sequence[Record], file: IO[bytes]) -> tuple[str, ...]:
    """LandXML 1.2 CgPoints (north, east, height) in the system of the records, or in the UTM zone of WGS 84 that most
    markers lie in, with ellipsoidal heights.

    Returns the ids of the markers that lie too far from it.
    """
    zone = _zone_of(records)
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" version="1.2">'
        f"<Units>{LANDXML_UNITS[zone.unit]}</Units>",
        f'<CoordinateSystem epsgCode="{zone.code}" desc={quoteattr(zone.stated)}/><CgPoints>',
    ]
    lines += [f"<!-- left out: {marker_id}, too far from this zone -->" for marker_id in zone.left_out]
    for record, e, n in zip(zone.records, zone.east, zone.north, strict=True):
        z_m = _place(record)[2]
        height = f" {z_m / METRES[zone.unit]:.4f}" if z_m is not None else ""
        name, description = quoteattr(_code(record)), quoteattr("; ".join([str(record["id"]), *_other_height(record)]))
        lines.append(f"<CgPoint name={name} desc={description}>{n:.4f} {e:.4f}{escape(height)}</CgPoint>")
    file.writelines(f"{line}\n".encode() for line in (*lines, "</CgPoints></LandXML>"))
    return zone.left_out


def write_dxf(records: Sequence[Record], file: IO[bytes]) -> tuple[str, ...]:
    """DXF R2010: a block reference a marker with its code and id, in the system of the records, or in metres in the UTM
    zone of WGS 84 that most lie in.

    Its z is the height in that system; 0, the plane of the drawing, where that is unknown: a block always has one.
    Another height is the attribute HEIGHT, with its datum. Returns the ids of the markers that lie too far from the
    zone.

    ezdxf writes the drawing with one reference, which is repeated as text for each marker: objects would take 7 kB and
    a millisecond of processor time for each.
    """
    from ezdxf.filemanagement import new

    zone = _zone_of(records)
    layer = f"WAYMARK_EPSG_{zone.code}"
    document = new("R2010", units=INSUNITS[zone.unit])
    document.header["$INSUNITS"] = INSUNITS[zone.unit]
    document.header.custom_vars.append("COORDINATE_SYSTEM", zone.stated)
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
        up = (_place(record)[2] or 0.0) / METRES[zone.unit]
        values = (*numbers, e, n, up, *map(_one_line, texts))
        file.write(template.format(*values).encode())
    file.write((_DXF_SECTION_END + after).encode())
    return zone.left_out


def _one_line(text: str) -> str:
    return " ".join(text.splitlines())


def _code(record: Record) -> str:
    return str(record["code"] if record["code"] is not None else record["id"])


def _other_height(record: Record) -> list[str]:
    """A height that is not in the geometry, in words."""
    known = record["height_m"] is not None and _place(record)[2] is None
    return [f"{record['height_m']:.4f} m above {record['vertical_datum']}"] if known else []


def _zone_of(records: Sequence[Record]) -> _Zone:
    """The system of the records, or the UTM zone that most lie in."""
    if not _is_framed(records[0]):
        return _utm(records)
    system = reference_system(records[0]["geometry_crs"])
    if not system.is_projected:
        raise InvalidParameter(
            f"{records[0]['geometry_crs']} is geographic, and LandXML and DXF take eastings and northings",
            field="crs",
            limit="a projected system",
            cure="choose a projected system, or leave crs out",
        )
    kept = [record for record in records if record["x"] is not None]
    if not kept:
        raise _none_in_area()
    east, north = (np.array([record[name] for record in kept], np.float64) for name in ("x", "y"))
    left_out = tuple(str(record["id"]) for record in records if record["x"] is None)
    frames = dict.fromkeys(_frame_in_words(record) for record in kept)
    code = int(records[0]["geometry_crs"].partition(":")[2])
    return _Zone(code, kept, east, north, left_out, crs_unit(system), f"{system.name}: {' / '.join(list(frames)[:3])}")


def _frame_in_words(record: Record) -> str:
    realization, epoch = record["geometry_realization"], record["geometry_epoch"]
    parts = [realization or "realization not stated", f"epoch {epoch:g}" if epoch else "epoch not stated"]
    return ", ".join([*parts, f"heights above {record['geometry_vertical_datum']}"])


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
