"""Survey files: the format is detected, columns get their roles, the CRS and the units are checked."""

from __future__ import annotations

from typing import Any

import numpy as np
from pyproj import CRS

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload
from app.formats.format import Format, Sample, detect_format, list_accepted
from app.formats.surveys.cells import read_numbers
from app.formats.surveys.declaration import METRES, NUMBER_ROLES, TEXT_ROLES, ImportDeclaration
from app.formats.surveys.formats import SURVEY_FORMATS, SurveyReader
from app.formats.surveys.table import (
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
from app.geodesy import normalize_crs, reference_system

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
    return _with_roles(_find_format(data, declaration).read(data, declaration), declaration)


def _find_format(data: bytes, declaration: ImportDeclaration) -> Format[SurveyReader]:
    """The declared format, or the one that the content shows."""
    if declaration.format is not None:
        return next(found for found in SURVEY_FORMATS if found.name == declaration.format)
    found = detect_format(Sample("", data), SURVEY_FORMATS)
    if found is None:
        raise UnsupportedUpload(
            "the file has no format that surveys are read in",
            field="file",
            limit=list_accepted(SURVEY_FORMATS),
            cure="export it again in one of these formats",
        )
    return found


def _with_roles(source: SourceTable, declaration: ImportDeclaration) -> SurveyTable:
    if not source.rows:
        raise UnreadableUpload("the file has no points", field="file", limit="at least one row", cure="send the survey")
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
            "the columns of the coordinates cannot be identified",
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
    in_file = normalize_crs(source.crs) if source.crs is not None else None
    if source.format == "geojson" and in_file is None:
        in_file = None if declaration.crs is not None else "OGC:CRS84"
    declared = normalize_crs(declaration.crs) if declaration.crs is not None else None
    if (
        in_file is not None
        and declared is not None
        and in_file != declared
        and {in_file, declared} != {"OGC:CRS84", "EPSG:4326"}
    ):
        raise InvalidParameter(
            f"the file is in {in_file}, the declaration has {declared}",
            field="crs",
            limit=in_file,
            cure="leave crs out, or export the file again in the CRS that it is in",
        )
    name = declared or in_file
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
            f"the file is in {source.unit}, the declaration has {declaration.unit}",
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
        The CRS has another unit.
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
            "the file has heights, and their vertical datum is not declared",
            field="vertical_datum",
            limit="ellipsoid, or the datum, e.g. EPSG:5703",
            cure="declare vertical_datum, or ignore_heights to leave them out",
        )


def _unit_names(
    source: SourceTable, places: dict[str, int | None], unit: str, height_unit: str, height_name: str
) -> list[Fault]:
    """Columns whose names end with another unit than the one that is used."""
    faults = []
    for role, unit_used in (("easting", unit), ("northing", unit), ("height", height_unit)):
        column = places[role]
        name = source.names[column].lower().replace(" ", "_") if column is not None else ""
        named = next((feet for ending, feet in _UNIT_ENDINGS if name.endswith(ending)), None)
        if named is None and name.endswith(("_m", "(m)")):
            named = "m"
        if named is not None and unit_used not in named.split(" or "):
            message = f"the column {name} is named in {named}, its values are read as {unit_used}"
            faults.append(Fault(None, role, "unit_in_header", message, f"declare unit or height_unit {named}"))
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
    """A fault that only warns."""
    return Fault(row, field, code, message, proposal, Severity.WARNING)
