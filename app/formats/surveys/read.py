"""Survey files: the format is detected, columns get their roles, the CRS and the units are checked."""

from __future__ import annotations

from dataclasses import replace

from pyproj import CRS

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload
from app.formats.archives import ZIP_MAGIC
from app.formats.format import Format, Sample, detect_format, list_accepted
from app.formats.surveys.cells import read_numbers
from app.formats.surveys.coordinates import check_second_pair, read_coordinates
from app.formats.surveys.declaration import FEET, METRES, NUMBER_ROLES, TEXT_ROLES, ImportDeclaration
from app.formats.surveys.formats import SURVEY_FORMATS, SurveyReader
from app.formats.surveys.grids import crs_unit, unit_factor, without_zone
from app.formats.surveys.roles import CodeForm, cell_text, find_roles
from app.formats.surveys.table import (
    MAX_TEXT,
    Change,
    Detected,
    Fault,
    Floats,
    Severity,
    SourceTable,
    SurveyTable,
    Texts,
    warn,
)
from app.geodesy import normalize_crs, reference_system

_DOCUMENTS = (
    (ZIP_MAGIC, "an Excel workbook", "save the sheet as CSV UTF-8"),
    (b"\xd0\xcf\x11\xe0", "an old Excel or Word document", "save the table as CSV UTF-8"),
    (b"%PDF", "a PDF", "export the points as CSV"),
    (b"AC10", "a DWG", "save the drawing as DXF"),
    (b"JB,NM", "raw data of a data collector (RW5)", "export the coordinates as text"),
    (b"LASF", "a point cloud", "export the points of the markers alone"),
)
"""First bytes of files that are sent by mistake, their kind, and how a survey is made of it."""
_DIRECTORY_BYTES = 1 << 17  # [byte] at the end of a ZIP in which its directory is; chosen by hand
_FEET = ("ft-us", "ft-intl")
_UNIT_ENDINGS = (("_usft", "ft-us"), ("_ftus", "ft-us"), ("_ft", "ft-intl or ft-us"), ("(ft)", "ft-intl or ft-us"))


def read_survey(data: bytes, declaration: ImportDeclaration, code_form: CodeForm | None = None) -> SurveyTable:
    """Read a file of any format.

    Parameters
    ----------
    data : bytes
    declaration : ImportDeclaration
    code_form : CodeForm, optional
        What codes of the family look like: a column that is only named like one has to show it.

    Raises
    ------
    UnsupportedUpload, UnreadableUpload
        The file is of no format that is read here, or damaged, or beyond the limits.
    InvalidParameter, ReferenceSystemError
        The declaration does not fit the file: columns, layer, CRS, units or heights.
    """
    return _with_roles(_find_format(data, declaration).read(data, declaration), declaration, code_form)


def _find_format(data: bytes, declaration: ImportDeclaration) -> Format[SurveyReader]:
    """The declared format, or the one that the content shows."""
    _refuse_documents(data)
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


def _refuse_documents(data: bytes) -> None:
    """Refuse files of office and survey software that are no surveys, and name the way to one."""
    for signature, name, cure in _DOCUMENTS:
        if data.startswith(signature) and (signature != ZIP_MAGIC or b"xl/workbook.xml" in data[-_DIRECTORY_BYTES:]):
            raise UnsupportedUpload(f"the file is {name}", field="file", limit=list_accepted(SURVEY_FORMATS), cure=cure)


def _with_roles(source: SourceTable, declaration: ImportDeclaration, code_form: CodeForm | None) -> SurveyTable:
    if not source.rows:
        raise UnreadableUpload("the file has no points", field="file", limit="at least one row", cure="send the survey")
    places, faults, detected = find_roles(source, declaration, code_form)
    read = read_coordinates(source, declaration, places)
    crs, system = _crs(source.crs or read.crs, source.format, declaration, read.projected)
    has_height = read.height is not None
    unit, height_unit, feet = _units(source, declaration, system, has_height=has_height)
    _check_datum(declaration, has_height=has_height)
    is_local = declaration.local_grid is not None
    if is_local and not system.is_projected:
        raise InvalidParameter(
            f"a local grid is transformed to eastings and northings, {crs} has none",
            field="crs",
            limit="a projected CRS",
            cure="declare the CRS of the control points",
        )
    first, zone = without_zone(read.first, system) if unit == "m" and not is_local else (read.first, None)
    faults += [*read.faults, *feet, *_unit_names(source, places, unit, height_unit, has_height=has_height)]
    if not is_local:
        faults += check_second_pair(replace(read, first=first), crs, unit_factor(unit, system))
    if zone is not None:
        evidence = f"the eastings begin with {zone}, the zone of {crs}"
        read.detected.append(Detected("zone in the eastings", str(zone), evidence))
    texts = {role: _texts(source, places[role]) for role in TEXT_ROLES if places[role] is not None}
    numbers: dict[str, Floats] = {}
    for role in NUMBER_ROLES:
        if (column := places[role]) is not None:
            numbers[role], wrong = read_numbers(source.columns[column], role, form=read.form, required=False)
            faults += wrong
    source.faults.add(faults)
    by_content = (Detected("format", source.format, "its first bytes"),) if declaration.format is None else ()
    return SurveyTable(
        source.format, first, read.second, read.height, bool(system.is_projected), crs, unit, height_unit, texts,
        numbers, source.faults, (*by_content, *source.detected, *detected, *read.detected),
        written=None if zone is None else (read.first, read.second),
    )  # fmt: skip


def _crs(
    of_file: str | None, file_format: str, declaration: ImportDeclaration, projected: bool | None
) -> tuple[str, CRS]:
    in_file = normalize_crs(of_file) if of_file is not None else None
    if file_format == "geojson" and in_file is None:
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


def _units(
    source: SourceTable, declaration: ImportDeclaration, system: CRS, *, has_height: bool
) -> tuple[str, str, list[Fault]]:
    """Units of the coordinates and of the heights; a warning where the file does not state which foot."""
    own = crs_unit(system)
    of_file, faults = source.unit, list[Fault]()
    if of_file == FEET:
        of_file = declaration.unit if declaration.unit in _FEET else own if own in _FEET else "ft-intl"
        if own in _FEET and declaration.unit is None:
            message = f"the file is in feet without stating which; they were read as {own}, the unit of {system.name}"
            cure = "declare unit: ft-us or ft-intl; they differ by 2 ppm, a metre in 500 km"
            faults.append(warn(None, "unit", "which_foot", message, cure, (Change("unit", own),)))
    if of_file is not None and declaration.unit is not None and of_file != declaration.unit:
        raise InvalidParameter(
            f"the file is in {of_file}, the declaration has {declaration.unit}",
            field="unit",
            limit=of_file,
            cure="leave unit out, or export the file again in the unit that it is in",
        )
    unit = (declaration.unit or of_file or own) if system.is_projected else "deg"
    height_unit = declaration.height_unit or of_file or declaration.unit
    if height_unit is None and has_height and own in METRES and own != "m":
        raise InvalidParameter(
            "the unit of the heights is not declared",
            field="height_unit",
            limit=", ".join(METRES),
            cure=f"declare height_unit: the CRS is in {own}, heights need not be",
        )
    return unit, height_unit or "m", faults


def _check_datum(declaration: ImportDeclaration, *, has_height: bool) -> None:
    if has_height and declaration.vertical_datum is None:
        raise InvalidParameter(
            "the file has heights, and their vertical datum is not declared",
            field="vertical_datum",
            limit="ellipsoid, or the datum, e.g. EPSG:5703",
            cure="declare vertical_datum, or ignore_heights to leave them out",
        )


def _unit_names(
    source: SourceTable, places: dict[str, int | None], unit: str, height_unit: str, *, has_height: bool
) -> list[Fault]:
    """Columns whose names end with another unit than the one that is used."""
    faults = []
    for role, unit_used in (("easting", unit), ("northing", unit), ("height", height_unit)):
        column = places[role] if unit_used != "deg" and (has_height or role != "height") else None
        name = source.names[column].lower().replace(" ", "_") if column is not None else ""
        named = next((feet for ending, feet in _UNIT_ENDINGS if name.endswith(ending)), None)
        if named is None and name.endswith(("_m", "(m)")):
            named = "m"
        if named is not None and unit_used not in named.split(" or "):
            message = f"the column {name} is named in {named}, its values are read as {unit_used}"
            member = "height_unit" if role == "height" else "unit"
            changes = (Change(member, named),) if named in METRES else ()
            cure = f"declare unit or height_unit {named}"
            faults.append(Fault(None, role, "unit_in_header", message, cure, Severity.REFUSED, changes))
    return faults


def _texts(source: SourceTable, column: int | None) -> Texts:
    assert column is not None
    cells = source.columns[column]
    texts = Texts()
    for part in cells.parts() if isinstance(cells, Texts) else (cells,):
        texts.extend([cell_text(value)[:MAX_TEXT].replace("\x00", "") for value in part])
    return texts
