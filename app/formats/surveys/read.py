"""Survey files: the format is detected, columns get their roles, the CRS and the units are checked."""

from __future__ import annotations

import re
from codecs import BOM_UTF8
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import chain, islice
from typing import Any

import numpy as np
import orjson
from pyproj import CRS, Transformer

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload
from app.formats.format import (
    ZIP_MAGIC,
    Confidence,
    Format,
    Sample,
    Use,
    detect_format,
    detect_signature,
    list_accepted,
)
from app.formats.surveys.coordinates import (
    PAIRS,
    Coordinates,
    check_second_pair,
    crs_unit,
    read_coordinates,
    unit_factor,
    without_zone,
)
from app.formats.surveys.csv_reader import read_csv, read_gsi
from app.formats.surveys.declaration import (
    FEET,
    FOOT_NAMES,
    METRES,
    NUMBER_ROLES,
    TEXT_ROLES,
    ImportDeclaration,
    choose_datum,
    choose_foot,
)
from app.formats.surveys.roles import CodeForm, cell_text, find_roles, split_unit, unit_of_cell
from app.formats.surveys.table import (
    MAX_COLUMNS,
    MAX_ROWS,
    MAX_TEXT,
    Change,
    Detected,
    Fault,
    Faults,
    Severity,
    SourceTable,
    SurveyTable,
    Texts,
    are_stations,
    read_numbers,
    warn,
)
from app.formats.text import guess_encoding
from app.geodesy import normalize_crs, reference_system
from app.geodesy.systems import HeightSystem, have_same_places, split_heights, system_of_wkt
from app.values import Floats

# === Surveys as GeoJSON (RFC 7946).


_CURE = "send a FeatureCollection of points"


def read_geojson(data: bytes) -> SourceTable:
    """Points of a FeatureCollection, with their properties as columns.

    Raises
    ------
    UnreadableUpload
        It is no JSON, no FeatureCollection, or has too many features or names.
    """
    try:
        document = orjson.loads(data.removeprefix(BOM_UTF8))  # RFC 8259, section 8.1: it may be there
    except (orjson.JSONDecodeError, RecursionError) as error:
        raise UnreadableUpload(f"not JSON: {error}", field="file", limit="RFC 8259", cure=_CURE) from error
    features = document.get("features") if isinstance(document, dict) else None
    if not isinstance(features, list) or document.get("type") != "FeatureCollection":
        raise UnreadableUpload("no FeatureCollection", field="file", limit="RFC 7946", cure=_CURE)
    features = list(islice(chain.from_iterable(map(_single_points, features)), MAX_ROWS + 1))
    if len(features) > MAX_ROWS:
        raise UnreadableUpload("too many points", field="file", limit=f"{MAX_ROWS} points", cure="cut the file")
    faults: list[Fault] = []
    points = np.full((3, len(features)), np.nan)
    names: dict[str, None] = {}
    for index, feature in enumerate(features):
        coordinates = _coordinates(feature)
        if coordinates is None:
            faults.append(
                Fault(index + 1, "geometry", "no_point", "the feature is no point with finite numbers", _CURE)
            )
        else:
            points[: len(coordinates), index] = coordinates
        names.update(dict.fromkeys(_properties(feature)))
        if len(names) > MAX_COLUMNS:
            raise UnreadableUpload("too many names", field="file", limit=f"{MAX_COLUMNS} properties", cure=_CURE)
    columns = tuple([_plain(_properties(feature).get(name)) for feature in features] for name in names)
    crs = _old_crs(document)
    return SourceTable(
        "geojson", tuple(names), columns, (points[0], points[1], points[2]), crs=crs, faults=Faults(faults)
    )


def _coordinates(feature: object) -> list[float] | None:
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    if not isinstance(geometry, dict) or geometry.get("type") != "Point":
        return None
    found = geometry.get("coordinates")
    if not isinstance(found, list) or not 2 <= len(found) <= 3:
        return None
    if any(isinstance(v, bool) or not isinstance(v, int | float) or abs(v) > 1e12 for v in found):
        return None
    return found


def _single_points(feature: Any) -> Iterable[object]:
    """One feature for each point of a multipoint, with the properties of all."""
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    if not isinstance(geometry, dict) or geometry.get("type") != "MultiPoint":
        return [feature]
    places = geometry.get("coordinates")
    if not isinstance(places, list):
        return [feature]
    return ({**feature, "geometry": {"type": "Point", "coordinates": place}} for place in places)


def _properties(feature: object) -> dict[str, object]:
    found = feature.get("properties") if isinstance(feature, dict) else None
    return found if isinstance(found, dict) else {}


def _plain(value: object) -> object:
    return value if value is None or isinstance(value, str | int | float) else str(value)[:200]


def _old_crs(document: dict[str, object]) -> str | None:
    """The CRS of GeoJSON 2008, which QGIS and others still write."""
    crs = document.get("crs")
    properties = crs.get("properties") if isinstance(crs, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    return name if isinstance(name, str) else None


# === Formats of surveys: how each is detected and read. Libraries of rarer formats are loaded when they are needed.


SurveyReader = Callable[[bytes, ImportDeclaration], SourceTable]

_HEAD_BYTES = 4096  # [byte]
_DXF_STARTS = (b"0\n", b"0\r", b"999\n", b"999\r")
_BELOW_TAB = frozenset(range(9))
_DIRECTORY_BYTES = 1 << 17  # [byte] at the end of a ZIP, for its directory; 1000 files at 100 bytes
_GSI = re.compile(rb"(?:\*[0-9]{2}[0-9.]{4}[+-]\S{16}|[0-9]{2}[0-9.]{4}[+-]\S{8})(?:\s|$)")  # a first word


def _head(sample: Sample) -> bytes:
    """The beginning of the file, in UTF-8 where it is UTF-16."""
    head = sample.data[:_HEAD_BYTES]
    name = guess_encoding(head)
    if name.startswith("utf-16"):
        head = head.decode(name, "ignore").encode()
    return head.removeprefix(b"\xef\xbb\xbf").lstrip()


def _detect_root(*roots: bytes) -> Callable[[Sample], Confidence]:
    """Detection of XML by the name of its root element."""

    def detect(sample: Sample) -> Confidence:
        head = _head(sample)
        found = head.startswith(b"<") and any(b"<" + root in head for root in roots)
        return Confidence.CERTAIN if found else Confidence.NONE

    return detect


def _detect_kml(sample: Sample) -> Confidence:
    return Confidence.LIKELY if _head(sample).startswith(b"<") else Confidence.NONE


def _detect_geojson(sample: Sample) -> Confidence:
    return Confidence.CERTAIN if _head(sample).startswith(b"{") else Confidence.NONE


def _detect_dxf(sample: Sample) -> Confidence:
    head = _head(sample)
    return Confidence.CERTAIN if head.startswith(_DXF_STARTS) or b"SECTION" in head[:40] else Confidence.NONE


def _detect_kmz(sample: Sample) -> Confidence:
    """A ZIP whose directory, at its end, names a KML."""
    is_zip = sample.data.startswith(ZIP_MAGIC)
    return Confidence.CERTAIN if is_zip and b".kml" in sample.data[-_DIRECTORY_BYTES:].lower() else Confidence.NONE


def _detect_zip(sample: Sample) -> Confidence:
    return Confidence.LIKELY if sample.data.startswith(ZIP_MAGIC) else Confidence.NONE


def _detect_gsi(sample: Sample) -> Confidence:
    return Confidence.CERTAIN if _GSI.match(_head(sample)) else Confidence.NONE


def _detect_csv(sample: Sample) -> Confidence:
    head = _head(sample)
    return Confidence.POSSIBLE if head and _BELOW_TAB.isdisjoint(head) else Confidence.NONE


def _read_kml(data: bytes, _declaration: ImportDeclaration) -> SourceTable:
    from app.formats.surveys.xml_reader import read_kml

    return read_kml(data)


def _read_landxml(data: bytes, _declaration: ImportDeclaration) -> SourceTable:
    from app.formats.surveys.xml_reader import read_landxml

    return read_landxml(data)


def _read_dxf(data: bytes, declaration: ImportDeclaration) -> SourceTable:
    from app.formats.surveys.dxf_reader import read_dxf

    return read_dxf(data, declaration.layer, declaration.unit)


def _read_kmz(data: bytes, _declaration: ImportDeclaration) -> SourceTable:
    from app.formats.surveys.xml_reader import read_kmz

    return read_kmz(data)


def _read_gpx(data: bytes, _declaration: ImportDeclaration) -> SourceTable:
    from app.formats.surveys.xml_reader import read_gpx

    return read_gpx(data)


def _read_jobxml(data: bytes, _declaration: ImportDeclaration) -> SourceTable:
    from app.formats.surveys.xml_reader import read_jobxml

    return read_jobxml(data)


def _read_gpkg(data: bytes, declaration: ImportDeclaration) -> SourceTable:
    from app.formats.surveys.gis_reader import read_gpkg

    return read_gpkg(data, declaration.layer)


def _read_shapefile(data: bytes, _declaration: ImportDeclaration) -> SourceTable:
    from app.formats.surveys.gis_reader import read_shapefile

    return read_shapefile(data)


SURVEY_FORMATS: tuple[Format[SurveyReader], ...] = (
    Format("csv", Use.SURVEY, "csv", _detect_csv, read_csv),
    Format("geojson", Use.SURVEY, "geojson", _detect_geojson, lambda data, _declaration: read_geojson(data)),
    Format("gpkg", Use.SURVEY, "gpkg", detect_signature(b"SQLite format 3\x00"), _read_gpkg),
    Format("shapefile", Use.SURVEY, "shapefile", _detect_zip, _read_shapefile),
    Format("kml", Use.SURVEY, "kml", _detect_kml, _read_kml),
    Format("kmz", Use.SURVEY, "kmz", _detect_kmz, _read_kmz),
    Format("gpx", Use.SURVEY, "gpx", _detect_root(b"gpx"), _read_gpx),
    Format("landxml", Use.SURVEY, "landxml", _detect_root(b"LandXML"), _read_landxml),
    Format("jobxml", Use.SURVEY, "jobxml", _detect_root(b"JOBFile"), _read_jobxml),
    Format("gsi", Use.SURVEY, "gsi", _detect_gsi, read_gsi),
    Format("dxf", Use.SURVEY, "dxf", _detect_dxf, _read_dxf),
)


# === Survey files.


_DOCUMENTS = (
    (ZIP_MAGIC, "an Excel workbook", "save the sheet as CSV UTF-8"),
    (b"\xd0\xcf\x11\xe0", "an old Excel or Word document", "save the table as CSV UTF-8"),
    (b"%PDF", "a PDF", "export the points as CSV"),
    (b"AC10", "a DWG", "save the drawing as DXF"),
    (b"JB,NM", "raw data of a data collector (RW5)", "export the coordinates as text"),
    (b"LASF", "a point cloud", "export the points of the markers alone"),
)
"""First bytes of files that are sent by mistake, their kind, and how a survey is made of it."""
_WEST_OR_SOUTH = re.compile(r"[\[({<]\s*(?:°|deg|degrees)?\s*(?:w|west|s|south|o|ouest)\s*[\])}>]\s*$", re.IGNORECASE)
_MEMBERS = {"easting": "unit", "northing": "unit", "height": "height_unit"}
"""What declares the unit of a column."""


def read_survey(data: bytes, declaration: ImportDeclaration, code_form: CodeForm | None = None) -> SurveyTable:
    """Read a file of any format.

    Parameters
    ----------
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
    source, of_file = _split(source, read.crs, declaration)
    crs, system = _crs(of_file, source.format, declaration, read.projected)
    has_height = read.height is not None
    unit, height_unit, feet = _units(source, declaration, system, has_height=has_height)
    vertical_datum = _datum(declaration, source.heights, of_file or crs, has_height=has_height)
    if vertical_datum is not None and declaration.vertical_datum is None:
        read.detected.append(Detected("vertical_datum", vertical_datum, "the CRS of the file"))
    is_local = declaration.local_grid is not None
    if is_local and (_is_wkt(crs) or not system.is_projected):
        raise InvalidParameter(
            f"a local grid is transformed to a projected CRS with an EPSG code, {system.name[:60]} is none",
            field="crs",
            limit="the EPSG code of a projected CRS",
            cure="declare the CRS of the control points",
        )
    first, zone = without_zone(read.first, system) if unit == "m" and not is_local else (read.first, None)
    faults += [*read.faults, *feet, *_unit_names(source, places, unit, height_unit, read)]
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
    second, written = read.second, None if zone is None else (read.first, read.second)
    if _is_wkt(crs):
        factor = unit_factor(unit, system)
        _system, base = system_of_wkt(crs)
        to_base = Transformer.from_crs(system, base, always_xy=True)
        first, second = (np.asarray(v, np.float64) for v in to_base.transform(first * factor, second * factor))
        evidence = f"the file is in {system.name[:60]!r}, a projection of it without an EPSG code; the step is exact"
        read.detected.append(Detected("crs", base, evidence))
        crs, unit = base, "deg"
    return SurveyTable(
        source.format, first, second, read.height, unit != "deg", crs, unit, height_unit, texts,
        numbers, source.faults, (*by_content, *source.detected, *detected, *read.detected),
        written=written, vertical_datum=vertical_datum,
    )  # fmt: skip


def _split(
    source: SourceTable, of_geometry: str | None, declaration: ImportDeclaration
) -> tuple[SourceTable, str | None]:
    """The table with what its CRS states about heights, and the horizontal part of its CRS."""
    stated = source.crs or of_geometry
    if stated is None:
        return source, None
    horizontal, heights = split_heights(stated)
    heights = heights or source.heights
    if heights is None:
        return source, horizontal
    unit = source.height_unit
    if (unit, source.unit, declaration.height_unit) == (None, None, None):
        unit = next((name for name, metres in METRES.items() if abs(heights.unit_m / metres - 1) < 1e-9), None)
    return replace(source, heights=heights, height_unit=unit), horizontal


def _is_wkt(crs: str) -> bool:
    return "[" in crs


def _crs(
    of_file: str | None, file_format: str, declaration: ImportDeclaration, projected: bool | None
) -> tuple[str, CRS]:
    if of_file is not None and _is_wkt(of_file):
        if declaration.crs is None:
            return of_file, system_of_wkt(of_file)[0]
        of_file = None  # programs write registered systems as WKT that differs from the registry's
    in_file = normalize_crs(of_file) if of_file is not None else None
    if file_format == "geojson" and in_file is None:
        in_file = None if declaration.crs is not None else "OGC:CRS84"
    declared = normalize_crs(declaration.crs) if declaration.crs is not None else None
    if in_file is not None and declared is not None and in_file != declared and not have_same_places(in_file, declared):
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
        of_file, of_crs = choose_foot(declaration.unit, METRES.get(own, 1.0))
        if of_crs and declaration.unit is None:
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
    if None not in (source.height_unit, declaration.height_unit) and source.height_unit != declaration.height_unit:
        raise InvalidParameter(
            f"the heights of the file are in {source.height_unit}, the declaration has {declaration.height_unit}",
            field="height_unit",
            limit=str(source.height_unit),
            cure="leave height_unit out, or export the file again in the unit that its heights are in",
        )
    of_heights = of_file if declaration.unit is None and source.height_unit is None else None
    if None not in (of_heights, declaration.height_unit) and of_heights != declaration.height_unit:
        raise InvalidParameter(
            f"the file is in {of_heights}, the declaration has heights in {declaration.height_unit}",
            field="height_unit",
            limit=str(of_heights),
            cure=f"leave height_unit out, or declare unit {of_heights}, too, if only the heights are in another unit",
        )
    height_unit = declaration.height_unit or source.height_unit or of_file or declaration.unit
    if height_unit is None and has_height and own in METRES and own != "m":
        raise InvalidParameter(
            "the unit of the heights is not declared",
            field="height_unit",
            limit=", ".join(METRES),
            cure=f"declare height_unit: the CRS is in {own}, heights need not be",
        )
    return unit, height_unit or "m", faults


def _datum(
    declaration: ImportDeclaration, heights: HeightSystem | None, system: str, *, has_height: bool
) -> str | None:
    """The vertical datum: declared, or that of the file's CRS."""
    if not has_height or heights is None:
        if has_height and declaration.vertical_datum is None:
            raise InvalidParameter(
                "the file has heights, and their vertical datum is not declared",
                field="vertical_datum",
                limit="ellipsoid, or the datum, e.g. EPSG:5703",
                cure="declare vertical_datum, or ignore_heights to leave them out",
            )
        return declaration.vertical_datum
    return choose_datum(declaration.vertical_datum, heights, f"the file ({system})")


def _unit_names(
    source: SourceTable, places: dict[str, int | None], unit: str, height_unit: str, read: Coordinates
) -> Iterator[Fault]:
    """Columns whose names, or the row of units below them, have another unit than the one that is used."""
    used = dict.fromkeys(NUMBER_ROLES, "m") | {"heading_deg": "deg"}
    if source.points is None:
        used |= {"lon_deg": "deg", "lat_deg": "deg"} if unit == "deg" else {"easting": unit, "northing": unit}
        used |= {"height": height_unit} if read.height is not None else {}
    for role, unit_used in used.items():
        if (column := places[role]) is None:
            continue
        name = source.names[column].strip()[:60]
        values = read.first if role == "lon_deg" else read.second
        if role in PAIRS[0] and _WEST_OR_SOUTH.search(name) and (values > 0).any():
            message = f"the column {name} is named as west or south, and its values are positive"
            cure = "write decimal degrees, negative in the south and west, and leave the letter out of the name"
            yield Fault(None, role, "hemisphere_letter", message, cure)
        below = unit_of_cell(source.units[column]) if column < len(source.units) else None
        for named in dict.fromkeys((below, split_unit(name).unit if source.has_names else None)):
            if named is None or named == unit_used or (named == FEET and unit_used in FOOT_NAMES):
                continue
            if named == "degrees, minutes" and read.is_sexagesimal and role in PAIRS[0]:
                continue
            if role == "measure_m" and named == "km" and are_stations(source.columns[column]):
                continue
            yield _fault_of_unit(role, name, named, unit_used)
            break


def _fault_of_unit(role: str, name: str, named: str, unit_used: str) -> Fault:
    message = f"the column {name} is named in {named}, its values are read as {unit_used}"
    member = _MEMBERS.get(role)
    changes: tuple[Change, ...] = ()
    if member is not None and named in METRES:
        cure, changes = f"declare {member} {named}", (Change(member, named),)
    elif member is not None:
        one_of = " or ".join(FOOT_NAMES)
        cure = f"declare {member} {one_of}" if named == FEET else f"write the column in {', '.join(METRES)}"
    elif role in PAIRS[0]:
        cure = "write decimal degrees, or degrees, minutes and seconds with their signs, and name the column so"
    else:
        quantity = "degrees" if unit_used == "deg" else "metres"
        cure, changes = (
            f'write the column in {quantity}, or declare columns {{"{role}": null}}',
            (Change(f"columns.{role}", None),),
        )
    return Fault(None, role, "unit_in_header", message, cure, Severity.REFUSED, changes)


def _texts(source: SourceTable, column: int | None) -> Texts:
    assert column is not None
    cells = source.columns[column]
    texts = Texts()
    for part in cells.parts() if isinstance(cells, Texts) else (cells,):
        texts.extend([cell_text(value)[:MAX_TEXT].replace("\x00", "") for value in part])
    return texts
