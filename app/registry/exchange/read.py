"""A file becomes a survey: its kind is told by its content, its columns get their roles, its units are settled."""

from __future__ import annotations

from typing import Any

import numpy as np
from pyproj import CRS

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload
from app.geodesy import normalize_crs, reference_system
from app.registry.exchange.cells import read_numbers
from app.registry.exchange.csv_reader import read_csv
from app.registry.exchange.declaration import FORMATS, METRES, NUMBER_ROLES, TEXT_ROLES, ImportDeclaration
from app.registry.exchange.json_reader import read_geojson
from app.registry.exchange.table import (
    MAX_TEXT,
    Fault,
    Faults,
    Flags,
    Floats,
    Severity,
    SourceTable,
    SurveyTable,
    Texts,
)

_NAMES = {
    "lon_deg": ("lon_deg", "lon", "longitude", "long", "lng"),
    "lat_deg": ("lat_deg", "lat", "latitude"),
    "easting": ("easting", "easting_m", "east", "e", "x"),
    "northing": ("northing", "northing_m", "north", "n", "y"),
    "height": ("height", "height_m", "elevation", "elev", "z", "h", "altitude"),
    "point": ("point", "point_id", "pt", "p", "name", "no"),
    "code": ("code", "digits", "number", "registry_number"),
    "description": ("description", "desc", "d"),
}
_UNIT_ENDINGS = (("_usft", "ft-us"), ("_ftus", "ft-us"), ("_ft", "ft-intl or ft-us"), ("(ft)", "ft-intl or ft-us"))


def read_survey(data: bytes, declaration: ImportDeclaration) -> SurveyTable:
    """Read a file of any format.

    Raises
    ------
    UnsupportedUpload, UnreadableUpload
        The file is of no format that is read here, or damaged, or beyond the limits.
    InvalidParameter, ReferenceSystemError
        The declaration does not fit the file: columns, layer, CRS, units or heights.
    """
    kind = declaration.format or tell_format(data)
    return _with_roles(_source(kind, data, declaration), declaration)


def tell_format(data: bytes) -> str:
    """Format of a file by its first bytes.

    Raises
    ------
    UnsupportedUpload
        It is none of `FORMATS`.
    """
    head = data[:4096].removeprefix(b"\xef\xbb\xbf").lstrip()
    if data.startswith(b"SQLite format 3\x00"):
        return "gpkg"
    if data.startswith(b"PK\x03\x04"):
        return "shapefile"
    if head.startswith(b"<"):
        return "landxml" if b"<LandXML" in head else "kml"
    if head.startswith(b"{"):
        return "geojson"
    if head.startswith((b"0\n", b"0\r", b"999\n", b"999\r")) or b"SECTION" in head[:40]:
        return "dxf"
    if head and not any(byte < 9 for byte in head):
        return "csv"
    raise UnsupportedUpload("no survey is of this kind", field="file", limit=", ".join(FORMATS), cure="export it again")


def _source(kind: str, data: bytes, declaration: ImportDeclaration) -> SourceTable:
    # the libraries of the rarer formats are loaded when they are needed
    if kind == "csv":
        return read_csv(data, declaration)
    if kind == "geojson":
        return read_geojson(data)
    if kind in ("kml", "landxml"):
        from app.registry.exchange.xml_reader import read_kml, read_landxml

        return read_kml(data) if kind == "kml" else read_landxml(data)
    if kind == "dxf":
        from app.registry.exchange.dxf_reader import read_dxf

        return read_dxf(data, declaration.layer)
    from app.registry.exchange.gis_reader import read_gpkg, read_shapefile

    return read_gpkg(data, declaration.layer) if kind == "gpkg" else read_shapefile(data)


def _with_roles(source: SourceTable, declaration: ImportDeclaration) -> SurveyTable:
    if not source.rows:
        raise UnreadableUpload("the file has no points", field="file", limit="one row at least", cure="send the survey")
    places = {role: _find_column(source, role, declaration) for role in (*_NAMES, *TEXT_ROLES, *NUMBER_ROLES)}
    faults = source.faults
    broken = source.faults.flags(source.rows, Severity.REFUSED)
    height: Floats | None
    if source.points is not None:
        first, second, z = source.points
        height = None if np.isnan(z).all() or declaration.ignore_heights else z
        projected = None
        height_name = "height"
    else:
        first, second, height, projected, height_name = _coordinates(source, declaration, places, faults, broken)
    crs, system = _crs(source, declaration, projected)
    unit, height_unit = _units(source, declaration, system, has_height=height is not None)
    _check_datum(declaration, has_height=height is not None)
    faults.add(_unit_names(source, places, unit, height_unit, height_name))
    texts = {role: _texts(source, places[role]) for role in TEXT_ROLES if places[role] is not None}
    numbers: dict[str, Floats] = {}
    for role in NUMBER_ROLES:
        if (column := places[role]) is not None:
            numbers[role], wrong = read_numbers(
                source.columns[column], role, decimal=declaration.decimal, required=False
            )
            faults.add(wrong)
    return SurveyTable(
        source.format, first, second, height, bool(system.is_projected), crs, unit, height_unit, texts, numbers,
        faults,
    )  # fmt: skip


def _find_column(source: SourceTable, role: str, declaration: ImportDeclaration) -> int | None:
    wanted = declaration.columns.get(role)
    if wanted is not None:
        if wanted not in source.names:
            raise InvalidParameter(
                f"there is no column {wanted[:60]!r}",
                field=f"columns.{role}",
                limit=", ".join(source.names)[:300],
                cure="declare a column of the file",
            )
        return source.names.index(wanted)
    taken = set(declaration.columns.values())
    names = [name.lower() if name not in taken else "" for name in source.names]
    return next((names.index(name) for name in _NAMES.get(role, (role,)) if name in names), None)


def _coordinates(
    source: SourceTable,
    declaration: ImportDeclaration,
    places: dict[str, int | None],
    faults: Faults,
    broken: Flags,
) -> tuple[Floats, Floats, Floats | None, bool, str]:
    pairs = (("lon_deg", "lat_deg"), ("easting", "northing"))
    declared = [pair for pair in pairs if pair[0] in declaration.columns or pair[1] in declaration.columns]
    there = declared or [pair for pair in pairs if places[pair[0]] is not None and places[pair[1]] is not None]
    if len(there) != 1 or None in (places[there[0][0]], places[there[0][1]]):
        raise InvalidParameter(
            "the columns of the coordinates are not clear",
            field="columns",
            limit="lon_deg and lat_deg, or easting and northing",
            cure=f"declare two of the columns {', '.join(source.names)[:200]}",
        )
    values = []
    for role in there[0]:
        column = places[role]
        assert column is not None
        read, wrong = read_numbers(source.columns[column], role, decimal=declaration.decimal, required=True)
        faults.add(fault for fault in wrong if not broken[(fault.row or 1) - 1])
        values.append(read)
    height, name = None, "height"
    if (column := places["height"]) is not None and not declaration.ignore_heights:
        height, wrong = read_numbers(source.columns[column], "height", decimal=declaration.decimal, required=False)
        faults.add(fault for fault in wrong if not broken[(fault.row or 1) - 1])
        name = source.names[column]
        if np.isnan(height).all():
            height = None
    return values[0], values[1], height, there[0] == pairs[1], name


def _crs(source: SourceTable, declaration: ImportDeclaration, projected: bool | None) -> tuple[str, CRS]:
    said = normalize_crs(source.crs) if source.crs is not None else None
    if source.format == "geojson" and said is None:
        said = None if declaration.crs is not None else "OGC:CRS84"
    declared = normalize_crs(declaration.crs) if declaration.crs is not None else None
    if (
        said is not None
        and declared is not None
        and said != declared
        and {said, declared} != {"OGC:CRS84", "EPSG:4326"}
    ):
        raise InvalidParameter(
            f"the file says {said}, the declaration {declared}",
            field="crs",
            limit=said,
            cure="leave crs out, or export the file again in the CRS that it is in",
        )
    name = declared or said
    if name is None:
        raise InvalidParameter(
            "the CRS of the coordinates is not declared",
            field="crs",
            limit="an EPSG code",
            cure="declare crs, e.g. EPSG:4326, EPSG:25832, EPSG:6318",
        )
    system = reference_system(name)
    if projected is not None and projected != bool(system.is_projected):
        wanted = "easting and northing" if system.is_projected else "lon_deg and lat_deg"
        raise InvalidParameter(
            f"{name} is {'projected' if system.is_projected else 'geographic'}, the columns are not",
            field="crs",
            limit=wanted,
            cure="declare the CRS that the coordinates are in, and their columns",
        )
    return name, system


def _units(source: SourceTable, declaration: ImportDeclaration, system: CRS, *, has_height: bool) -> tuple[str, str]:
    if source.unit is not None and declaration.unit is not None and source.unit != declaration.unit:
        raise InvalidParameter(
            f"the file says {source.unit}, the declaration {declaration.unit}",
            field="unit",
            limit=source.unit,
            cure="leave unit out, or export the file again in the unit that it is in",
        )
    own = crs_unit(system)
    unit = (declaration.unit or source.unit or own) if system.is_projected else "deg"
    height_unit = declaration.height_unit or source.unit or declaration.unit
    if height_unit is None and has_height and own in METRES and own != "m":
        raise InvalidParameter(
            "the unit of the heights is not declared",
            field="height_unit",
            limit=", ".join(METRES),
            cure=f"declare height_unit: the CRS is in {own}, heights need not be",
        )
    return unit, height_unit or "m"


def crs_unit(system: CRS) -> str:
    """Unit of the axes of a CRS: one of `METRES`, or ``deg``.

    Raises
    ------
    InvalidParameter
        It is in another unit.
    """
    if not system.is_projected:
        return "deg"
    factor = system.axis_info[0].unit_conversion_factor
    for name, metres in METRES.items():
        if abs(factor / metres - 1) < 1e-9:
            return name
    raise InvalidParameter(
        f"{system.name} is in {system.axis_info[0].unit_name}",
        field="crs",
        limit=", ".join(METRES),
        cure="transform it",
    )


def _check_datum(declaration: ImportDeclaration, *, has_height: bool) -> None:
    if has_height and declaration.vertical_datum is None:
        raise InvalidParameter(
            "the file has heights, and what they are above is not declared",
            field="vertical_datum",
            limit="ellipsoid, or the datum, e.g. EPSG:5703",
            cure="declare vertical_datum, or ignore_heights to leave them out",
        )


def _unit_names(
    source: SourceTable, places: dict[str, int | None], unit: str, height_unit: str, height_name: str
) -> list[Fault]:
    """Columns whose names say another unit than the one that holds."""
    faults = []
    for role, holds in (("easting", unit), ("northing", unit), ("height", height_unit)):
        column = places[role]
        name = source.names[column].lower().replace(" ", "_") if column is not None else ""
        said = next((feet for ending, feet in _UNIT_ENDINGS if name.endswith(ending)), None)
        if said is None and name.endswith(("_m", "(m)")):
            said = "m"
        if said is not None and holds not in said.split(" or "):
            message = f"the column {name} says {said}, its values count as {holds}"
            faults.append(Fault(None, role, "unit_in_header", message, f"declare unit or height_unit {said}"))
    return faults


def _texts(source: SourceTable, column: int | None) -> Texts:
    assert column is not None
    cells = source.columns[column]
    texts = Texts()
    for part in cells.parts() if isinstance(cells, Texts) else (cells,):
        texts.extend([_text(value) for value in part])
    return texts


def _text(value: Any) -> str:
    if value is None or (isinstance(value, float) and value != value):
        return ""
    if isinstance(value, float | np.floating) and float(value).is_integer():
        value = int(value)
    return str(value).strip()[:MAX_TEXT].replace("\x00", "")


def warn(row: int | None, field: str, code: str, message: str, proposal: str | None = None) -> Fault:
    """A fault that refuses nothing."""
    return Fault(row, field, code, message, proposal, Severity.WARNING)
