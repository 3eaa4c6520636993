"""Valid surveys with known content, for `benchmarks.fuzz.grammar`: tables, layers of GIS, files of instruments.

A file is read with what its sender declares, and no more; where two readings are possible, the declaration decides.
"""

from __future__ import annotations

import csv
import io
import json
import re
import warnings
import zipfile
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from xml.sax.saxutils import escape

import numpy as np
import shapely
from ezdxf.filemanagement import new
from pyproj import CRS, Transformer

from app.formats.surveys.declaration import METRES, ImportDeclaration
from app.formats.surveys.read import read_survey
from app.formats.surveys.table import Severity
from app.values import Floats
from benchmarks.fuzz.grammar import Check, Grammar, Rng

_SYSTEMS = (
    "EPSG:25832", "EPSG:25833", "EPSG:32632", "EPSG:32719", "EPSG:31467", "EPSG:2180", "EPSG:2056", "EPSG:27700",
    "EPSG:2154", "EPSG:5514", "EPSG:28992", "EPSG:6539", "EPSG:2992", "EPSG:6677", "EPSG:7855", "EPSG:4326",
    "EPSG:4258", "EPSG:6318", "EPSG:4269",
)  # fmt: skip
_NORTH_X = ("EPSG:31467", "EPSG:2180", "EPSG:6677")
"""Systems whose X is the northing."""
_DEGREE_M = 111_000.0  # [m/deg]


class Points(NamedTuple):
    """What a survey holds."""

    crs: str
    first: Floats  # in the unit of the CRS
    second: Floats
    height_m: Floats | None

    @property
    def unit(self) -> str:
        """One of `METRES`, or ``deg``."""
        system = _system(self.crs)
        factor = system.axis_info[0].unit_conversion_factor
        return next((n for n, m in METRES.items() if abs(factor / m - 1) < 1e-9), "m") if system.is_projected else "deg"


@lru_cache(maxsize=100)
def _system(crs: str) -> CRS:
    return CRS(crs)


@lru_cache(maxsize=100)
def _to_degrees(crs: str) -> Transformer:
    return Transformer.from_crs(crs, _system(crs).geodetic_crs, always_xy=True)


@lru_cache(maxsize=100)
def _centre(crs: str) -> tuple[float, float, float, float]:
    """West, south, east, north of the inner part of the area of use. [deg]"""
    area = _system(crs).area_of_use
    assert area is not None
    width, height = (area.east - area.west) % 360.0 or 360.0, area.north - area.south
    if not _system(crs).is_projected:
        return (6.0, 45.0, 14.0, 54.0) if crs in ("EPSG:4326", "EPSG:4258") else (-110.0, 32.0, -80.0, 45.0)
    return area.west + 0.3 * width, area.south + 0.3 * height, area.west + 0.7 * width, area.south + 0.7 * height


def _points(rng: Rng, systems: Sequence[str], decimals: int = 4) -> Points:
    """A road of a few hundred metres, rounded as it is written."""
    crs = str(rng.choice(list(systems)))
    west, south, east, north = _centre(crs)
    lon, lat = float(rng.uniform(west, east)), float(rng.uniform(south, north))
    count = int(rng.integers(3, 16))
    steps = np.cumsum(rng.uniform(5, 20, (2, count)), axis=1)
    system = _system(crs)
    if system.is_projected:
        x, y = _to_degrees(crs).transform(lon, lat, direction="INVERSE")
        first, second = np.round(x + steps[0], decimals), np.round(y + steps[1], decimals)
    else:
        first, second = np.round(lon + steps[0] / _DEGREE_M, 9), np.round(lat + steps[1] / _DEGREE_M, 9)
    height_m = np.round(float(rng.uniform(5, 900)) + rng.normal(0, 1, count), 3)
    return Points(crs, first, second, height_m if rng.random() < 0.7 else None)


def _check(data: bytes, points: Points, declared: dict[str, Any], tolerance_m: float = 2e-4) -> Check:
    """Reads a file and compares the places in degrees on the datum of the CRS, and the heights."""

    def check() -> str:
        table = read_survey(data, ImportDeclaration(family="cerpm", **declared))
        sent = f"({json.dumps(declared, default=str)})"
        if table.faults.refuses_file or table.faults.flags(table.rows, Severity.REFUSED).any():
            return f"refused: {[fault[:4] for fault in table.faults.shown(2)]} {sent}"
        if table.rows != len(points.first):
            return f"{table.rows} of {len(points.first)} rows {sent}"
        own, found = _system(points.crs).geodetic_crs, _system(table.crs).geodetic_crs
        assert own is not None
        assert own.datum is not None
        assert found is not None
        assert found.datum is not None
        if own.datum.name.removesuffix(" ensemble") != found.datum.name.removesuffix(" ensemble"):
            return f"in {table.crs}, not in {points.crs} {sent}"
        factor = METRES[table.unit] / METRES[Points(table.crs, *points[1:]).unit] if table.unit != "deg" else 1.0
        lon, lat = _to_degrees(table.crs).transform(table.first * factor, table.second * factor)
        aim = _to_degrees(points.crs).transform(points.first, points.second)
        away_m = np.hypot((lon - aim[0]) * np.cos(np.radians(lat)), lat - aim[1]) * _DEGREE_M
        if not away_m.max() < tolerance_m:
            return f"{away_m.max():.4f} m away, in {table.crs} and {table.unit} {sent}"
        if (table.height is None) != (points.height_m is None):
            return f"heights: {table.height} {sent}"
        if table.height is not None and points.height_m is not None:
            apart_m = np.abs(table.height * METRES[table.height_unit] - points.height_m)
            if not apart_m.max() < 1e-3:
                return f"heights {apart_m.max():.4f} m away, in {table.height_unit} {sent}"
        return ""

    return check


def _height_declared(points: Points, height_unit: str | None = None) -> dict[str, Any]:
    """What has to be declared of heights."""
    if points.height_m is None:
        return {}
    unit = {"height_unit": height_unit} if height_unit is not None else {}
    return {"vertical_datum": "ellipsoid", **unit}


# === Delimited text.


_NAMES = (
    (("Easting", "Northing", "Elevation"), ("Longitude", "Latitude", "Height"), "Point", "Description"),
    (("E", "N", "Z"), ("lon", "lat", "alt"), "PtID", "Desc"),
    (("Rechtswert", "Hochwert", "Höhe"), ("Länge", "Breite", "Höhe"), "Punkt-Nr.", "Bemerkung"),
    (("Ostwert", "Nordwert", "HÖHE"), ("Länge", "Breite", "Hoehe"), "Punktnummer", "Beschreibung"),
    (("ESTE", "NORTE", "COTA"), ("Longitud", "Latitud", "Cota"), "PUNTO", "Descr"),
    (("grid_easting", "grid_northing", "ortho_height"), ("long", "lat", "ele"), "pt", "remarks"),
)
_TEXTS = ("kerb", "Bordstein, links", 'the "old" one', "a;b", "", "IP 12|3", "two\nlines", "Mañana", "5 m left")
_EMPTY_GROUPS = {"": "", " ": " ", "'": "'", "nbsp": "\u00a0", "thin": "\u202f"}


class _Form(NamedTuple):
    delimiter: str
    decimal: str
    group: str


def _form(rng: Rng, *, is_projected: bool, is_unicode: bool) -> _Form:
    delimiter = str(rng.choice([",", ";", "\t", "|", "space"]))
    decimal = str(rng.choice([".", ","])) if delimiter != "," else "."
    groups = ["", "", "'"]
    if delimiter != "space":
        groups += [" ", "\u00a0" if is_unicode else " "]
        groups += ["\u202f"] if is_unicode else []
        groups += ["."] if decimal == "," else [","]
    return _Form(delimiter, decimal, str(rng.choice(groups)) if is_projected else "")


def _number(value: float, decimals: int, form: _Form) -> str:
    whole, _, rest = f"{abs(value):.{decimals}f}".partition(".")
    if form.group:
        whole = re.sub(r"(?<=\d)(?=(?:\d{3})+$)", lambda _found: form.group, whole)
    sign = "-" if value < 0 else ""
    return f"{sign}{whole}{form.decimal}{rest}" if rest else f"{sign}{whole}"


def _sexagesimal(value: float, letters: str, form: _Form) -> str:
    seconds = round(abs(value) * 3600, 5)
    degrees, rest = divmod(seconds, 3600)
    minutes, rest = divmod(rest, 60)
    text = f"{int(degrees)}°{int(minutes):02d}'{rest:08.5f}\""
    return text.replace(".", form.decimal) + letters[int(value < 0)]


def _table(rng: Rng) -> tuple[str | bytes, Check]:
    """Columns of numbers or of geometry, with a header or by position."""
    points = _points(rng, _SYSTEMS)
    is_projected = points.unit != "deg"
    encoding = str(rng.choice(["utf-8", "utf-8-sig", "utf-16", "cp1252"]))
    form = _form(rng, is_projected=is_projected, is_unicode=encoding != "cp1252")
    declared: dict[str, Any] = {"crs": points.crs}
    kind = str(rng.choice(["named", "named", "named", "position", "wkt"]))
    unit, height_unit = points.unit, "m"
    if is_projected and rng.random() < 0.3:
        unit = str(rng.choice(list(METRES)))
    if points.unit != unit:
        declared["unit"] = unit
    if rng.random() < 0.2:
        height_unit = str(rng.choice(list(METRES)))
    if points.height_m is not None and (
        height_unit != "m" or unit not in ("m", "deg") or points.unit not in ("m", "deg")
    ):
        declared["height_unit"] = height_unit
    declared |= _height_declared(points)
    factor = METRES.get(points.unit, 1.0) / METRES.get(unit, 1.0)
    first, second = points.first * factor, points.second * factor
    heights = None if points.height_m is None else points.height_m / METRES[height_unit]
    if unit == "m" and points.crs in ("EPSG:25832", "EPSG:25833") and rng.random() < 0.3:
        first = first + 1e6 * int(points.crs[-2:])
    decimals = (5 if unit != points.unit else 4) if is_projected else 9
    if kind == "wkt":
        rows, names = _geometry_rows(rng, points, first, second, heights, declared)
        form = form._replace(decimal=".", group="")
        if form.delimiter in ("space", ";"):
            form = form._replace(delimiter=",")
    else:
        is_sexagesimal = not is_projected and kind == "named" and rng.random() < 0.4 and form.delimiter != "space"
        place = [
            [_sexagesimal(v, letters, form) for v in values.tolist()] if is_sexagesimal
            else [_number(v, decimals, form) for v in values.tolist()]
            for values, letters in ((first, "EW"), (second, "NS"))
        ]  # fmt: skip
        up = None if heights is None else [_number(v, 5, form) for v in heights.tolist()]
        if kind == "named":
            rows, names = _named_rows(rng, points, place, up, form, declared)
        else:
            rows, names = _rows_by_position(rng, points, place, up, form, declared)
    if kind == "named" and "columns" not in declared:  # whose names are as they were declared
        units = {"e": _UNIT_TEXTS[unit], "z": _UNIT_TEXTS[height_unit]}
        rows, names = _with_units(rng, rows, names, units, form)
    text = _written(rng, rows, names, form)
    data = text.encode(encoding, "replace" if encoding == "cp1252" else "strict")
    return text, _check(data, points, declared)


def _geometry_rows(
    rng: Rng, points: Points, first: Floats, second: Floats, heights: Floats | None, declared: dict[str, Any]
) -> tuple[list[list[str]], list[str]]:
    places = np.column_stack([first, second] + ([] if heights is None else [heights]))
    shapes = shapely.points(places)
    srid, kind = int(points.crs[5:]), str(rng.choice(["wkt", "ewkt", "wkb", "ewkb"]))
    if kind in ("ewkt", "ewkb") and "unit" not in declared:
        del declared["crs"]
    if kind in ("wkb", "ewkb"):
        whole = shapely.set_srid(shapes, srid) if kind == "ewkb" else shapes
        texts = [str(v) for v in shapely.to_wkb(whole, hex=True, include_srid=kind == "ewkb").tolist()]
    else:
        before = f"SRID={srid};" if kind == "ewkt" else ""
        texts = [before + str(v) for v in shapely.to_wkt(shapes, rounding_precision=12).tolist()]
    name = str(rng.choice(["geom", "WKT", "the_geom", "geometry"]))
    return [[str(k), text, "kerb"] for k, text in enumerate(texts, 1)], ["id", name, "description"]


def _named_rows(
    rng: Rng, points: Points, place: list[list[str]], up: list[str] | None, form: _Form, declared: dict[str, Any]
) -> tuple[list[list[str]], list[str]]:
    projected, geographic, number, description = _NAMES[int(rng.integers(len(_NAMES)))]
    east, north, height = geographic if points.unit == "deg" else projected
    if points.unit != "deg" and rng.random() < 0.3:
        east, north, height = "X", "Y", "Z"
        is_clear = points.crs == "EPSG:31467"  # its eastings are never northings
        if points.crs in _NORTH_X and not (is_clear and rng.random() < 0.5):
            if rng.random() < 0.5:  # as the surveyors of the country write them, not as GIS does
                east, north = north, east
            declared["columns"] = {"easting": east, "northing": north}
    columns = [(number, [f"P{k}" for k in range(1, len(place[0]) + 1)]), (east, place[0]), (north, place[1])]
    columns += [] if up is None else [(height, up)]
    if form.delimiter != "space":
        texts = [str(rng.choice(_TEXTS)) for _ in place[0]]
        columns.append((description, texts))
    order = rng.permutation(len(columns))
    if form.delimiter == "space":  # names of one word
        columns = [(name.replace(" ", ""), cells) for name, cells in columns]
    chosen = [columns[k] for k in order]
    return [list(row) for row in zip(*(cells for _name, cells in chosen), strict=True)], [name for name, _ in chosen]


def _rows_by_position(
    rng: Rng, points: Points, place: list[list[str]], up: list[str] | None, form: _Form, declared: dict[str, Any]
) -> tuple[list[list[str]], list[str]]:
    layout = str(rng.choice(["pnezd", "penzd", "nezd", "enzd"]))
    is_near_origin = min(np.abs(points.first).min(), np.abs(points.second).min()) < 1e5
    if up is None or rng.random() < 0.5 or points.unit != "m" or is_near_origin:
        declared["layout"] = layout
    else:  # by the area of the project
        lon, lat = _to_degrees(points.crs).transform(points.first, points.second)
        declared["area_deg"] = (lon.min() - 0.02, lat.min() - 0.02, lon.max() + 0.02, lat.max() + 0.02)
    columns = {"p": [f"{k}" for k in range(101, 101 + len(place[0]))], "e": place[0], "n": place[1]}
    columns |= {} if up is None else {"z": up}
    if up is not None and form.delimiter != "space":
        columns["d"] = [str(rng.choice(["kerb", "IP", "axis 1"])) for _ in place[0]]
    return [list(row) for row in zip(*(columns[c] for c in layout if c in columns), strict=True)], []


_UNIT_TEXTS = {
    "m": ("m", "metres"), "ft-us": ("usft", "US ft", "US survey foot"), "ft-intl": ("ft", "ift", "feet"),
    "deg": ("deg", "°"),
}  # fmt: skip


def _with_units(
    rng: Rng, rows: list[list[str]], names: list[str], units: dict[str, tuple[str, ...]], form: _Form
) -> tuple[list[list[str]], list[str]]:
    """Units in the names of the columns, or in a row below them, or nowhere."""
    spoken = {name for _p, _g, *texts in _NAMES for name in texts}
    heights = {group[2] for both in _NAMES for group in both[:2]} | {"Z"}
    of = ["" if name in spoken else str(rng.choice(units["z" if name in heights else "e"])) for name in names]
    where = rng.random()
    if form.delimiter == "space" or where < 0.6:
        return rows, names
    if where < 0.8:
        before, after = (("(", ")"), ("[", "]"))[int(rng.integers(2))]
        return rows, [f"{name} {before}{unit}{after}" if unit else name for name, unit in zip(names, of, strict=True)]
    if any(" " in unit for unit in of):
        return rows, names
    return [of, *rows], names


def _written(rng: Rng, rows: list[list[str]], names: list[str], form: _Form) -> str:
    """The text of a table, with comments, blank lines, and with or without the last line end."""
    end = str(rng.choice(["\n", "\r\n"]))
    text = io.StringIO(newline="")
    if form.delimiter == "space":
        gap = str(rng.choice([" ", "   ", "\t "]))
        lines = [gap.join(row) + end for row in ([names] if names else []) + rows]
    else:
        quoting: Any = csv.QUOTE_ALL if rng.random() < 0.2 else csv.QUOTE_MINIMAL
        lines = []
        for row in ([names] if names else []) + rows:
            text.seek(0)
            text.truncate()
            csv.writer(text, delimiter=form.delimiter, lineterminator=end, quoting=quoting).writerow(row)
            lines.append(text.getvalue())
    if rng.random() < 0.3:
        lines.insert(0, str(rng.choice(["# survey of a road", "// exported 2026-05-01", "#"])) + end)
    if rng.random() < 0.2:
        lines.insert(int(rng.integers(2, len(lines))), end)
    if rng.random() < 0.2:
        lines.append(end * 2)
    if rng.random() < 0.2:
        lines[-1] = lines[-1].rstrip("\r\n")
    return "".join(lines)


# === Layers of GIS: GeoPackage, Shapefile, GeoJSON, KML and KMZ, GPX.


_ESRI_GRID = (
    'PROJCS["Local_Grid_{number}",GEOGCS["{base}",DATUM["{datum}",SPHEROID["{spheroid}",6378137.0,{flattening}]],'
    'PRIMEM["Greenwich",0.0],UNIT["Degree",0.0174532925199433]],PROJECTION["{method}"],'
    'PARAMETER["False_Easting",{x0}],PARAMETER["False_Northing",{y0}],PARAMETER["Central_Meridian",{lon0}],'
    '{more}PARAMETER["Latitude_Of_Origin",{lat0}],UNIT["{unit}",{metres}]]'
)
"""A projection without an EPSG code, in the form of ESRI."""
_DATUMS = (
    ("EPSG:4326", "GCS_WGS_1984", "D_WGS_1984", "WGS_1984", "298.257223563"),
    ("EPSG:4258", "GCS_ETRS_1989", "D_ETRS_1989", "GRS_1980", "298.257222101"),
    ("EPSG:6318", "GCS_NAD_1983_2011", "D_NAD_1983_2011", "GRS_1980", "298.257222101"),
    ("EPSG:4269", "GCS_North_American_1983", "D_North_American_1983", "GRS_1980", "298.257222101"),
)


def _gis(rng: Rng) -> tuple[str | bytes, Check]:
    """One of the formats; with the CRS in the file, or none where it is declared."""
    kind = str(rng.choice(["gpkg", "shapefile", "shapefile", "custom", "geojson", "kml", "kmz", "gpx"]))
    if kind in ("gpkg", "shapefile", "custom"):
        return _layer(rng, kind)
    systems = _SYSTEMS if kind == "geojson" else ("EPSG:4326",)
    points = _points(rng, systems)
    declared = _height_declared(points)
    places = np.column_stack([points.first, points.second] + ([] if points.height_m is None else [points.height_m]))
    if kind == "geojson":
        return _geojson(rng, points, places.tolist(), declared)
    rows = ""
    for k, row in enumerate(places.tolist()):
        if kind == "gpx":
            up = f"<ele>{row[2]!r}</ele>" if len(row) == 3 else ""
            rows += f'<wpt lon="{row[0]!r}" lat="{row[1]!r}">{up}<name>P{k}</name></wpt>\n'
        else:
            name = escape(str(rng.choice(["P & Q", "<1>", f"P{k}"])))
            gap = str(rng.choice(["", "\n   "]))
            text = f"{gap}{','.join(map(repr, row))}{gap}"
            mode = "<altitudeMode>absolute</altitudeMode>" if len(row) == 3 else ""
            point = f"<Point>{mode}<coordinates>{text}</coordinates></Point>"
            rows += f"<Placemark><name>{name}</name>{point}</Placemark>"
    if kind == "gpx":
        track = "<trk><trkseg>" + '<trkpt lat="1" lon="2"/>' * int(rng.integers(0, 3)) + "</trkseg></trk>"
        text = f'<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1" version="1.1">{rows}{track}</gpx>'
        return text, _check(text.encode(), points, declared)
    folders = str(rng.choice(["", "Folder"]))
    inner = f"<{folders}>{rows}</{folders}>" if folders else rows
    text = f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{inner}</Document></kml>'
    data = _zip({str(rng.choice(["doc.kml", "survey.kml"])): text.encode()}) if kind == "kmz" else text.encode()
    return text, _check(data, points, {**declared, **({"crs": "EPSG:4326"} if rng.random() < 0.3 else {})})


def _geojson(
    rng: Rng, points: Points, places: list[list[float]], declared: dict[str, Any]
) -> tuple[str | bytes, Check]:
    features: list[dict[str, Any]] = []
    if rng.random() < 0.2:
        geometry: dict[str, Any] = {"type": "MultiPoint", "coordinates": places}
        features.append({"type": "Feature", "properties": {"name": "all"}, "geometry": geometry})
    else:
        for k, row in enumerate(places):
            geometry = {"type": "Point", "coordinates": row}
            properties = {"point": f"P{k}", "x": k, "note": None} if rng.random() < 0.8 else None
            features.append({"type": "Feature", "id": k, "properties": properties, "geometry": geometry})
    document: dict[str, Any] = {"type": "FeatureCollection", "features": features}
    code = points.crs[5:]
    if rng.random() < 0.4 and points.crs != "EPSG:4326":
        document = {"crs": {"type": "name", "properties": {"name": f"urn:ogc:def:crs:EPSG::{code}"}}, **document}
    elif points.crs != "EPSG:4326":
        declared["crs"] = points.crs
    if points.unit not in ("m", "deg") and points.height_m is not None:
        declared["height_unit"] = "m"
    text = json.dumps(document, indent=int(rng.integers(1, 3)) if rng.random() < 0.3 else None)
    data = text.encode("utf-8-sig" if rng.random() < 0.1 else "utf-8")
    return text, _check(data, points, declared)


def _layer(rng: Rng, kind: str) -> tuple[str | bytes, Check]:
    """A layer of a GeoPackage among others, or a zipped Shapefile."""
    from pyogrio import raw  # type: ignore[import-untyped]

    points, prj = _points(rng, _SYSTEMS), None
    if kind == "custom":
        points, prj = _custom(rng, points)
    declared = _height_declared(points)
    crs: str | None = points.crs
    if kind == "shapefile":
        version: Any = rng.choice(["WKT1_GDAL", "WKT1_ESRI", "WKT2_2019", "WKT2_2015"])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            prj = _system(points.crs).to_wkt(version, pretty=bool(rng.integers(2)))
    if points.unit not in ("m", "deg") and points.height_m is not None:
        declared["height_unit"] = "m"
    places = np.column_stack([points.first, points.second] + ([] if points.height_m is None else [points.height_m]))
    shapes = shapely.to_wkb(shapely.points(places))
    fields = [np.array([f"P{k}" for k in range(len(shapes))], dtype=object), points.first + 5]
    shape = "Point" if points.height_m is None else "Point Z"
    layers = ["survey"] if kind != "gpkg" or rng.random() < 0.6 else ["old", "survey"]
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(folder) / ("survey.gpkg" if kind == "gpkg" else "survey.shp")
        for number, layer in enumerate(layers):
            raw.write(
                path, shapes[: len(shapes) if layer == "survey" else 1], [v[: len(shapes) if layer == "survey" else 1]
                for v in fields], ["point", "x"], driver="GPKG" if kind == "gpkg" else "ESRI Shapefile", layer=layer,
                geometry_type=shape, crs=None if prj is not None else crs, append=number > 0,
            )  # fmt: skip
        if kind == "gpkg":
            data = path.read_bytes()
        else:
            (Path(folder) / "survey.prj").write_text(prj or "")
            inside = str(rng.choice(["", "export/", "Vermessung 2026/"]))
            data = _zip({inside + part.name: part.read_bytes() for part in sorted(Path(folder).iterdir())})
    if len(layers) > 1:
        declared["layer"] = "survey"
    return prj or data, _check(data, points, declared)


def _custom(rng: Rng, points: Points) -> tuple[Points, str]:
    """Points in a grid of a county or a site, and its definition."""
    base, *names = _DATUMS[int(rng.integers(len(_DATUMS)))]
    west, south, east, north = _centre(base)
    lon0, lat0 = round(float(rng.uniform(west, east)), 4), round(float(rng.uniform(south, north)), 4)
    unit, metres = (("Meter", 1.0), ("Foot_US", 1200 / 3937), ("Foot", 0.3048))[int(rng.integers(3))]
    is_conic = bool(rng.integers(2))
    more = (
        f'PARAMETER["Standard_Parallel_1",{lat0 - 0.5}],PARAMETER["Standard_Parallel_2",{lat0 + 0.5}],'
        if is_conic
        else f'PARAMETER["Scale_Factor",{1 + round(float(rng.uniform(-3e-4, 3e-4)), 8)!r}],'
    )
    wkt = _ESRI_GRID.format(
        number=int(rng.integers(1000)), base=names[0], datum=names[1], spheroid=names[2], flattening=names[3],
        method="Lambert_Conformal_Conic" if is_conic else "Transverse_Mercator", x0=float(rng.integers(0, 9) * 1e5),
        y0=float(rng.integers(0, 9) * 1e4), lon0=lon0, lat0=lat0, more=more, unit=unit, metres=repr(metres),
    )  # fmt: skip
    steps = np.round(np.cumsum(rng.uniform(5, 20, (2, len(points.first))), axis=1), 4)
    x, y = _to_degrees(wkt).transform(lon0 + 0.05, lat0 + 0.05, direction="INVERSE")
    text = _system(wkt).to_wkt("WKT2_2019") if rng.random() < 0.3 else wkt
    return Points(wkt, np.round(x + steps[0], 4), np.round(y + steps[1], 4), points.height_m), text


def _zip(files: dict[str, bytes]) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return packed.getvalue()


# === Files of instruments and of CAD: LandXML, JobXML, GSI, DXF.


_LINEAR = {"m": ("Metric", "meter"), "ft-intl": ("Imperial", "foot"), "ft-us": ("Imperial", "USSurveyFoot")}


def _instrument(rng: Rng) -> tuple[str | bytes, Check]:
    """One of the formats, in metres or feet."""
    kind = str(rng.choice(["landxml", "landxml", "jobxml", "gsi", "dxf"]))
    points = _points(rng, [crs for crs in _SYSTEMS if crs not in ("EPSG:4326", "EPSG:4258", "EPSG:6318", "EPSG:4269")])
    write: Callable[[Rng, Points, dict[str, Any]], str] = {
        "landxml": _landxml, "jobxml": _jobxml, "gsi": _gsi, "dxf": _dxf,
    }[kind]  # fmt: skip
    declared = {"crs": points.crs, **_height_declared(points)}
    text = write(rng, points, declared)
    return text, _check(text.encode(), points, declared, 3e-4 if kind in ("gsi", "landxml") else 2e-4)


def _landxml(rng: Rng, points: Points, declared: dict[str, Any]) -> str:
    unit = points.unit if rng.random() < 0.6 else str(rng.choice(list(METRES)))
    system, linear = _LINEAR[unit]
    height_unit, elevation = unit, ""
    if rng.random() < 0.4:
        elevation = "meter" if unit == "m" else "feet"
        if rng.random() < 0.3:
            height_unit, elevation = ("ft-intl", "feet") if unit == "m" else ("m", "meter")
        elevation = f' elevationUnit="{elevation}"'
    if unit == "ft-intl" and points.unit == "ft-us":  # `foot` alone would be that of the CRS
        declared["unit"] = "ft-intl"
    has_code = rng.random() < 0.7
    if has_code:
        del declared["crs"]
    system_text = f'<CoordinateSystem epsgCode="{points.crs[5:]}" name="x"/>' if has_code else ""
    factor = METRES[points.unit] / METRES[unit]
    rows = ""
    for k, (x, y) in enumerate(zip((points.first * factor).tolist(), (points.second * factor).tolist(), strict=True)):
        up = "" if points.height_m is None else f" {points.height_m[k] / METRES[height_unit]:.5f}"
        rows += f'<CgPoint name="P{k}" code="IP" oID="{k}">{y:.5f} {x:.5f}{up}</CgPoint>\n'
    parts = [f'<Units><{system} areaUnit="squareMeter" linearUnit="{linear}"{elevation}/></Units>', system_text]
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" version="1.2">'
        f"{''.join(parts)}<CgPoints>{rows}</CgPoints></LandXML>"
    )


def _jobxml(rng: Rng, points: Points, declared: dict[str, Any]) -> str:
    """Lengths of JobXML are metres, whatever the job shows."""
    del rng
    rows, unit_m = "", METRES[points.unit]
    for k, (x, y) in enumerate(zip((points.first * unit_m).tolist(), (points.second * unit_m).tolist(), strict=True)):
        up = "" if points.height_m is None else f"<Elevation>{points.height_m[k]:.4f}</Elevation>"
        rows += (
            f"<Point><ID>{k}</ID><Name>P{k}</Name><SurveyMethod>NetworkFixed</SurveyMethod>"
            f"<Grid><North>{y!r}</North><East>{x!r}</East>{up}</Grid></Point>\n"
        )
    return f'<?xml version="1.0"?><JOBFile version="5.74"><Reductions>{rows}</Reductions></JOBFile>'


def _gsi(rng: Rng, points: Points, declared: dict[str, Any]) -> str:
    """Words of 16 characters, in units of 1, 0.1 or 0.01 mm."""
    info, scale = (("0", 1e3), ("6", 1e4), ("8", 1e5))[int(rng.integers(1, 3))]
    rows, unit_m = "", METRES[points.unit]
    heights = points.height_m
    for k in range(len(points.first)):
        place = [points.first[k] * unit_m, points.second[k] * unit_m, *([] if heights is None else [heights[k]])]
        words = [f"{i}..1{info}{round(v * scale):+017d}" for i, v in zip((81, 82, 83), place, strict=False)]
        rows += f"*11{k + 1:04d}+{k + 101:016d} {' '.join(words)} \r\n"
    return rows


def _dxf(rng: Rng, points: Points, declared: dict[str, Any]) -> str:
    """Points or blocks; z is in the unit of the drawing, and 0 without heights."""
    unit, code = (("m", 6), ("ft-us", 21), ("mm", 4))[int(rng.integers(3))]
    factor = METRES[points.unit] / {**METRES, "mm": 0.001}[unit]
    document = new("R2010", units=code)
    document.header["$INSUNITS"] = code
    block = document.blocks.new("MARKER")
    block.add_attdef("NUMBER", (0, 0))
    is_block = bool(rng.integers(2))
    for k in range(len(points.first)):
        up = 0.0 if points.height_m is None else float(points.height_m[k]) / {**METRES, "mm": 0.001}[unit]
        place = (float(points.first[k]) * factor, float(points.second[k]) * factor, up)
        if is_block:
            document.modelspace().add_blockref("MARKER", place).add_auto_attribs({"NUMBER": f"P{k}"})
        else:
            document.modelspace().add_point(place)
    if points.height_m is None:
        declared["ignore_heights"] = True
    text = io.StringIO()
    document.write(text)
    return text.getvalue()


SURVEY_GRAMMARS: dict[str, Grammar] = {"survey-csv": _table, "survey-gis": _gis, "survey-landxml": _instrument}
