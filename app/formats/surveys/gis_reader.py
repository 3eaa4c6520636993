"""Surveys as GeoPackage and zipped Shapefile, by GDAL, after the contents are checked."""

from __future__ import annotations

import io
import sqlite3
import struct
import warnings
import zipfile
from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from pyproj import CRS
from pyproj.exceptions import CRSError

from app.errors import InvalidParameter, UnreadableUpload
from app.formats.format import is_file
from app.formats.surveys.coordinates import points_of
from app.formats.surveys.table import MAX_COLUMNS, MAX_ROWS, Faults, SourceTable, Texts
from app.geodesy.systems import name_system, split_heights

_SQLITE = b"SQLite format 3\x00"
_SHAPEFILE_CODE = 9994  # ESRI Shapefile Technical Description (1998), file header
_PARTS = (".shp", ".shx", ".dbf", ".prj", ".cpg")
_MAX_MEMBERS = 50  # files of an archive
MAX_INFLATED = 512 * 1024**2
"""Largest Shapefile, inflated. [byte]"""
_MAX_PRJ = 100_000  # [character] of a .prj; those of compound systems have about 2000
_PART = 100_000  # features read at a time, to bound memory


def read_gpkg(data: bytes, layer: str | None) -> SourceTable:
    """Points of a layer of a GeoPackage.

    Raises
    ------
    UnreadableUpload
        It is none, or its layer is a view or a virtual table, which could read other files or never end.
    InvalidParameter
        It has several layers and none is declared, or not the one declared.
    """
    name = _choose(list_gpkg_layers(data), layer)
    return _read("gpkg", data, name)


def read_shapefile(data: bytes) -> SourceTable:
    """Points of the one Shapefile in a ZIP archive.

    Raises
    ------
    UnreadableUpload
        The archive is damaged, holds no Shapefile or several, or is too large when inflated.
    """
    packed = repack_shapefile(data)
    table = _read("shapefile", packed, None)
    stated = read_prj(packed)
    if stated is None:
        return table
    own, heights = split_heights(stated)
    if table.crs is None:  # GDAL reads WKT 1 alone
        named = name_system(CRS.from_user_input(own))
        table = replace(table, crs=named or own)
    return replace(table, heights=heights)


def read_prj(packed: bytes) -> str | None:
    """WKT of the .prj; None if there is none that can be read."""
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        if "survey.prj" not in archive.namelist():
            return None
        text = archive.read("survey.prj").decode("utf-8-sig", "replace").strip("\x00 \t\r\n")
    if len(text) > _MAX_PRJ or "[" not in text:
        return None
    try:
        return CRS.from_wkt(text).to_wkt()
    except CRSError:
        return None


def list_gpkg_layers(data: bytes) -> list[str]:
    """Layers of features of a GeoPackage.

    Raises
    ------
    UnreadableUpload
        It is none, or has views or virtual tables, which could read other files or never end.
    """
    if not data.startswith(_SQLITE) or len(data) < 512:
        raise _damaged("the file is no GeoPackage")
    header = bytearray(data)
    header[18:20] = b"\x01\x01"  # a copy in WAL mode cannot be opened without its log; read what is in the file
    connection = sqlite3.connect(":memory:")
    try:
        connection.deserialize(bytes(header))
        connection.execute("PRAGMA trusted_schema = OFF")
        tables = connection.execute("SELECT name, type, sql FROM sqlite_master LIMIT 10000").fetchall()
        layers = connection.execute("SELECT table_name FROM gpkg_contents WHERE data_type = 'features'").fetchall()
    except (sqlite3.Error, OverflowError) as error:
        raise _damaged(f"the file is no GeoPackage: {error}") from error
    finally:
        connection.close()
    _refuse_programs(tables)
    plain = {name for name, kind, _sql in tables if kind == "table"}
    return [str(name) for (name,) in layers if name in plain]


def _refuse_programs(tables: list[tuple[str, str, str | None]]) -> None:
    """Views and virtual tables run when they are read; R*Trees are what a GeoPackage needs."""
    for name, kind, sql in tables:
        words = " ".join((sql or "").lower().split())
        virtual = words.startswith("create virtual table") and " using rtree" not in words
        if kind == "view" or virtual:
            raise UnreadableUpload(
                f"the GeoPackage holds the {'view' if kind == 'view' else 'virtual table'} {str(name)[:40]!r}",
                field="file",
                limit="tables and their R*Trees",
                cure="export the layer alone into a new GeoPackage",
            )


def _choose(layers: list[str], layer: str | None) -> str:
    if layer is not None and layer not in layers:
        raise InvalidParameter(
            f"there is no layer {layer[:60]!r}", field="layer", limit=", ".join(layers)[:300], cure="declare another"
        )
    if layer is None and len(layers) != 1:
        raise InvalidParameter(
            f"the GeoPackage has {len(layers)} layers of features",
            field="layer",
            limit=", ".join(layers)[:300] or "at least one layer",
            cure="declare the layer",
        )
    return layer or layers[0]


def repack_shapefile(data: bytes) -> bytes:
    """The parts of the Shapefile in a new archive, under fixed names, checked and not compressed."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [m for m in archive.infolist() if is_file(m) and "__MACOSX" not in m.filename]
            chosen = _parts(members)
            parts = {suffix: _inflated(archive, member) for suffix, member in chosen.items()}
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, OSError, EOFError, ValueError) as error:
        raise _damaged(f"the archive cannot be read: {error}") from error
    if len(parts[".shp"]) < 100 or struct.unpack(">i", parts[".shp"][:4])[0] != _SHAPEFILE_CODE:
        raise _damaged("the .shp is no Shapefile")
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
        for suffix, content in parts.items():
            archive.writestr(f"survey{suffix}", content)
    return packed.getvalue()


def _parts(members: list[zipfile.ZipInfo]) -> dict[str, zipfile.ZipInfo]:
    found: dict[str, zipfile.ZipInfo] = {}
    shapes = [m for m in members if m.filename.lower().endswith(".shp")]
    if len(members) > _MAX_MEMBERS or len(shapes) != 1:
        raise UnreadableUpload(
            f"the archive holds {len(shapes)} Shapefiles among {len(members)} files",
            field="file",
            limit=f"one Shapefile, at most {_MAX_MEMBERS} files",
            cure="zip the .shp, .shx, .dbf and .prj of one layer",
        )
    stem = shapes[0].filename[:-4]
    for member in members:
        if member.filename.startswith(stem + ".") and member.filename[len(stem) :].lower() in _PARTS:
            found[member.filename[len(stem) :].lower()] = member
    missing = [part for part in (".shx", ".dbf") if part not in found]
    if missing:
        raise UnreadableUpload(
            f"the Shapefile has no {missing[0]}", field="file", limit=".shp, .shx, .dbf", cure="zip all its parts"
        )
    if sum(member.file_size for member in found.values()) > MAX_INFLATED:
        raise _too_large()
    return found


def _inflated(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    with archive.open(member) as file:
        content = file.read(member.file_size + 1)  # a wrong size in the header is found by the CRC
    if len(content) > member.file_size:
        raise _too_large()
    return content


def _read(kind: str, data: bytes, layer: str | None) -> SourceTable:
    from pyogrio import raw, read_info  # type: ignore[import-untyped]

    points: list[object] = []
    columns: list[list[object]] = []
    faults = Faults()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GDAL warns of names without suffix
            info = read_info(data, layer=layer)
            if info["features"] > MAX_ROWS or len(info["fields"]) > MAX_COLUMNS:
                raise _too_large()
            for start in range(0, max(info["features"], 1), _PART):
                _meta, _ids, geometry, fields = raw.read(
                    data, layer=layer, skip_features=start, max_features=_PART, datetime_as_string=True
                )
                if geometry is None:
                    raise _damaged("the layer has no geometry")
                xyz, wrong = points_of(shapely.from_wkb(geometry, on_invalid="ignore"), start)
                points.append(xyz)
                columns.append([plain_values(column) for column in fields])
                faults.add(wrong)
    except (RuntimeError, ValueError, IndexError) as error:  # GDAL reports damage with any of these
        raise _damaged(f"the file cannot be read: {str(error)[:200]}") from error
    x, y, z = (np.concatenate(parts) for parts in zip(*points, strict=True))
    names = tuple(str(name) for name in info["fields"])
    joined = tuple(_joined([part[k] for part in columns]) for k in range(len(names)))
    return SourceTable(kind, names, joined, (x, y, z), crs=name_crs(info["crs"]) or info["crs"], faults=faults)


def _joined(parts: list[Any]) -> Any:
    """A column of all parts: numbers as an array, texts as `Texts`, anything else as a list."""
    if all(isinstance(part, np.ndarray) for part in parts):
        return np.concatenate(parts)
    if all(isinstance(part, Texts) for part in parts):
        whole = Texts()
        for part in parts:
            for cells in part.parts():
                whole.extend(cells)
        return whole
    return [value for part in parts for value in part]


def plain_values(column: Any) -> Any:
    """Values of a field: numbers as an array, texts as `Texts`, anything else as a list."""
    if column.dtype.kind in "fi":
        return column
    values = column.tolist()
    if all(isinstance(value, str) and "\x00" not in value for value in values):
        return Texts(values)
    return [None if v is None else v if isinstance(v, str | int | float) else str(v)[:200] for v in values]


def name_crs(crs: str | None) -> str | None:
    """``EPSG:code`` of the file's CRS; None if it has none or the EPSG registry does not list it."""
    if not crs:
        return None
    try:
        return name_system(CRS.from_user_input(crs))
    except CRSError:
        return None


def _damaged(message: str) -> UnreadableUpload:
    return UnreadableUpload(message, field="file", limit="a sound file", cure="export the layer again")


def _too_large() -> UnreadableUpload:
    return UnreadableUpload(
        "the file is too large when it is read",
        field="file",
        limit=f"{MAX_INFLATED} bytes, {MAX_ROWS} features, {MAX_COLUMNS} fields",
        cure="cut it into smaller ones",
    )
