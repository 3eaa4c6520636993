"""Coordinates of a table: its geometry, a column of WKT, or two columns of numbers, checked against a second pair."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain, islice
from typing import Any

import numpy as np
import shapely
from pyproj import CRS

from app.errors import InvalidParameter, ReferenceSystemError
from app.formats.surveys.declaration import METRES, NUMBER_ROLES, ImportDeclaration
from app.formats.surveys.roles import WKT_NAMES, cell_text, plain_name
from app.formats.surveys.table import (
    PLAIN,
    Change,
    Detected,
    Fault,
    NumberForm,
    Severity,
    SourceTable,
    Texts,
    are_sexagesimal,
    detect_number_form,
    read_numbers,
    read_sexagesimal,
    warn,
)
from app.geodesy import normalize_crs, reference_system
from app.geodesy.systems import best_effort, covers, have_same_places, split_heights
from app.values import Floats, JsonObject

# === Grids of projected systems: their unit, and eastings that begin with the number of the zone.


_ZONE_M = 1e6  # [m] one zone number; eastings with the number of the zone are this times the number greater
_MAX_ZONE = 60
_NARROW_ZONES = 9  # greatest number that eastings in feet without a zone could begin with
_HALF_WIDTH_M = 450_000.0  # greatest distance from the meridian of a zone of 6 degrees; 3 degrees are 334 km at 0 deg
_FALSE_EASTING_M = 500_000.0  # of zones of transverse Mercator grids, EPSG guidance note 7-2, table of zoned grids


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


def unit_factor(unit: str | None, system: CRS) -> float:
    """Units of the CRS in one unit of the coordinates. [1]"""
    own = crs_unit(system)
    return 1.0 if unit is None or unit in (own, "deg") or own == "deg" else METRES[unit] / METRES[own]


def zone_numbers(system: CRS) -> tuple[int, ...]:
    """Numbers that the zone of a transverse Mercator grid has: of 6 degrees (UTM), and of 3 degrees (Gauss-Krueger).

    Empty where the CRS has no such zone, or its eastings contain the number already.
    """
    if not system.is_projected or crs_unit(system) != "m" or system.coordinate_operation is None:
        return ()
    values: JsonObject = {parameter.name: parameter.value for parameter in system.coordinate_operation.params}
    if "Transverse Mercator" not in system.coordinate_operation.method_name:
        return ()
    if values.get("False easting") != _FALSE_EASTING_M:
        return ()
    meridian_deg = float(values.get("Longitude of natural origin", math.nan))
    utm, narrow = (meridian_deg + 183.0) / 6.0, meridian_deg / 3.0
    return tuple(round(zone) for zone in (utm, narrow) if zone == round(zone) and 1 <= zone <= _MAX_ZONE)


def without_zone(easting: Floats, system: CRS) -> tuple[Floats, int | None]:
    """Eastings without the number of the zone, and the number; None where they do not begin with it.

    Parameters
    ----------
    easting : ndarray, shape (N,)
        In the unit of the CRS.

    Raises
    ------
    InvalidParameter
        The eastings begin with the number of another zone.
    """
    finite = easting[np.isfinite(easting)]
    own = zone_numbers(system) if len(finite) else ()
    zone = int(np.median(np.floor(finite / _ZONE_M))) if own else 0
    if zone in own:
        return np.where(np.floor(easting / _ZONE_M) == zone, easting - zone * _ZONE_M, easting), zone
    if _NARROW_ZONES < zone <= _MAX_ZONE and np.all(np.abs(finite % _ZONE_M - _FALSE_EASTING_M) < _HALF_WIDTH_M):
        raise InvalidParameter(
            f"the eastings begin with the number of zone {zone}, {system.name} has zone {own[0]}",
            field="crs",
            limit=f"zone {own[0]}",
            cure="declare the CRS of the zone that the eastings begin with",
        )
    return easting, None


def share_inside(easting: Floats, northing: Floats, declaration: ImportDeclaration) -> float:
    """Share of the positions that lie in the declared area and the area of use of the declared CRS. [1]

    Parameters
    ----------
    easting, northing : ndarray, shape (N,)
        In the declared unit; N is at least 1.
    """
    name = normalize_crs(declaration.crs)
    system = reference_system(name)
    factor = unit_factor(declaration.unit, system)
    easting, _zone = without_zone(easting * factor, system)
    lon, lat = (np.asarray(v) for v in best_effort(name).transform(easting, northing * factor))
    with np.errstate(invalid="ignore"):
        inside = np.isfinite(lon) & np.isfinite(lat) & (np.abs(lat) <= 90) & covers(system.area_of_use, lon, lat)
        if declaration.area_deg is not None:
            west, south, east_deg, north_deg = declaration.area_deg
            inside &= (lon >= west) & (lon <= east_deg) & (lat >= south) & (lat <= north_deg)
    return float(inside.mean())


# === Coordinates of a table.


PAIRS = (("lon_deg", "lat_deg"), ("easting", "northing"))
_SAMPLE = 1000  # cells of a column by which the form of its numbers is detected
_BLANKS = {" ": "blanks", "\u00a0": "no-break spaces", "\u2009": "thin spaces", "\u202f": "narrow no-break spaces"}
_WKT = re.compile(  # also with the marks of Z and M, and WKB as PostGIS or its `bytea` write it
    r"\s*(?:SRID=[0-9]+;)?\s*(?:MULTI)?POINT(?:\s*(?:ZM?|M))?\b.*|(?:\\x)?0[01][0-9A-Fa-f]{40,}",
    re.IGNORECASE | re.DOTALL,
)
_SRID = re.compile(r"SRID=([0-9]{4,6});", re.IGNORECASE)
_AGREE_M = 5.0
"""Difference between two pairs of coordinates of a row that the datums of a continent explain. [m] Above NAD83 - WGS 84
(1 to 2 m) and the rounding of five decimals of a degree, below NAD27 or ED50 (30 to 200 m)."""
_IGNORED = (Change("ignore_heights", True),)
_NO_COLUMN = Change("columns.height", None)
_ROUNDED = 0.06  # difference of a height from the same one rounded to a tenth of its unit
_FEW = 4  # rows whose heights may be equal by chance
_MIN_SHARE = 0.5  # [1] of the rows that must lie in an area for their order to be possible
_OF_REGISTRY = frozenset({"localization_grade", "survey_file_sha256"})
"""Columns of an export of Waymark, in which `crs` is the system of the original survey, not of the coordinates."""
_EPSG_NAMES = ("epsg", "epsgcode", "srid", "crs", "srs", "coordinatesystem", "koordinatensystem")
_SYSTEM_NAMES = (*_EPSG_NAMES, "datum")
_ONE_CODE = re.compile(r"(?:EPSG ?:{0,2} ?)?([0-9]{4,6})", re.IGNORECASE)
_ONE_ZONE = re.compile(r"(?:UTM)? ?(?:zone)? ?([0-9]{1,2}) ?[A-Z]?", re.IGNORECASE)
_ZONE_NAMES = ("zone", "utmzone", "gridzone")
_SYSTEM_VALUE = re.compile(r"[A-Z]|[0-9]{4,6}$", re.IGNORECASE)  # dates, which Datum is in German, are no systems
_ZONE_VALUE = re.compile(r"[0-9]{1,2} ?[A-Z]?$", re.IGNORECASE)
_M_PER_DEG = 111_195.0  # [m/deg] on a sphere of 6371 km, the Earth's mean radius


@dataclass(slots=True)
class Coordinates:
    """Coordinates of the rows as the file has them."""

    # `first`, `second`: shape (N,): longitude and latitude, or easting and northing; NaN where there is none
    first: Floats
    second: Floats
    height: Floats | None  # shape (N,), or None
    projected: bool | None  # None where the columns do not show it
    form: NumberForm = PLAIN  # of the file's numbers
    is_sexagesimal: bool = False  # whether longitudes and latitudes are degrees, minutes and seconds
    check_deg: tuple[Floats, Floats] | None = None  # longitudes and latitudes beside eastings and northings
    crs: str | None = None  # of the geometry
    faults: list[Fault] = field(default_factory=list)
    detected: list[Detected] = field(default_factory=list)
    places: dict[str, int | None] = field(default_factory=dict)  # columns by role


def read_coordinates(source: SourceTable, declaration: ImportDeclaration, places: dict[str, int | None]) -> Coordinates:
    """Coordinates of all rows; faults of cells that are no numbers.

    Raises
    ------
    InvalidParameter
        No two columns hold coordinates.
    """
    if source.points is not None:
        of_geometry = _with_column_of_heights(Coordinates(*source.points, None), source, declaration, places)
        return _with_plausible_heights(of_geometry, declaration)
    pair = _choose_pair(source, declaration, places)
    if pair is None:
        wkt = _wkt_column(source)
        if wkt is None:
            raise _not_identified(source)
        of_geometry = _with_column_of_heights(_from_wkt(source, wkt), source, declaration, places)
        return _with_plausible_heights(of_geometry, declaration)
    form, shown = _form(source, declaration, places)
    is_sexagesimal = all(are_sexagesimal(_sample_of(source, places[role])) for role in PAIRS[0])
    values = [_numbers(source, places, role, form, is_sexagesimal) for role in (*pair, "height")]
    faults = [fault for _values, wrong in values for fault in wrong]
    first, second, height = (found for found, _wrong in values)
    assert first is not None
    assert second is not None
    read = Coordinates(first, second, height, pair == PAIRS[1], form, is_sexagesimal, faults=faults, places=places)
    if is_sexagesimal:
        read.detected.append(Detected("degrees", "degrees, minutes, seconds", "the signs in most of the values"))
    read.detected += _detected_form(form, shown)
    used = set(places.values())
    if (stated := _check_one_system(source, used, declaration)) is not None:
        read.crs, found = stated
        read.detected.append(found)
        declaration = declaration.model_copy(update={"crs": declaration.crs or read.crs})
    if pair == PAIRS[1]:
        _check_order(source, declaration, places, first, second)
    else:
        read.first, read.second = (_with_hemisphere(source, used, role, read) for role in PAIRS[0])
    if pair == PAIRS[1] and None not in (places["lon_deg"], places["lat_deg"]):
        lon, lat = (_numbers(source, places, role, form, is_sexagesimal)[0] for role in PAIRS[0])
        assert lon is not None
        assert lat is not None
        read.check_deg = lon, lat
    return _with_plausible_heights(read, declaration)


def check_second_pair(read: Coordinates, crs: str, factor: float) -> Iterator[Fault]:
    """Rows whose longitude and latitude are not where their easting and northing are; one fault if most are not.

    Parameters
    ----------
    crs : str
        Of the eastings and northings.
    factor : float
        Units of the CRS in one unit of the coordinates.
    """
    if read.check_deg is None:
        return
    with np.errstate(invalid="ignore"):
        lon, lat = (np.asarray(v) for v in best_effort(crs).transform(read.first * factor, read.second * factor))
        east = (read.check_deg[0] - lon) * np.cos(np.radians(lat)) * _M_PER_DEG
        apart_m = np.hypot(east, (read.check_deg[1] - lat) * _M_PER_DEG)
    known = np.isfinite(apart_m)
    if not known.any():
        return
    usual_m = float(np.median(apart_m[known]))
    cure = "check crs; declare columns.easting null if longitude and latitude are right, and their CRS"
    if usual_m > _AGREE_M:
        message = f"longitude and latitude lie {usual_m:.0f} m from easting and northing in {crs} (median)"
        yield warn(None, "position", "coordinates_disagree", message, cure)
        return
    for row in np.flatnonzero(known & (apart_m > _AGREE_M + usual_m)):
        message = f"longitude and latitude lie {apart_m[row]:.0f} m from easting and northing in {crs}"
        yield warn(int(row) + 1, "position", "coordinates_disagree", message, "compare the digits of both pairs")


def _choose_pair(
    source: SourceTable, declaration: ImportDeclaration, places: dict[str, int | None]
) -> tuple[str, str] | None:
    """The pair that is declared, or that the declared CRS has; None if there is none."""
    declared = [pair for pair in PAIRS if any(declaration.columns.get(role) for role in pair)]
    there = declared or [pair for pair in PAIRS if None not in (places[pair[0]], places[pair[1]])]
    if len(there) == 2 and declaration.crs is not None:
        there = [PAIRS[bool(reference_system(declaration.crs).is_projected)]]
    if len(there) > 1 or (there and None in (places[there[0][0]], places[there[0][1]])):
        raise _not_identified(source)
    return there[0] if there else None


def _not_identified(source: SourceTable) -> InvalidParameter:
    return InvalidParameter(
        "the columns of the coordinates cannot be identified",
        field="columns",
        limit="lon_deg and lat_deg, or easting and northing",
        cure=f"declare two of the columns {', '.join(source.names)[:200]}, and crs",
    )


def _sample_of(source: SourceTable, column: int | None) -> Iterator[str]:
    """Texts throughout a column; none of a column of numbers."""
    cells = source.columns[column] if column is not None else ()
    if isinstance(cells, Texts):
        yield from (cells[k] for k in range(0, len(cells), max(len(cells) // _SAMPLE, 1)))


def _numbers(
    source: SourceTable, places: dict[str, int | None], role: str, form: NumberForm, is_sexagesimal: bool = False
) -> tuple[Floats | None, list[Fault]]:
    column = places[role]
    if column is None:
        return None, []
    if is_sexagesimal and role in PAIRS[0]:
        found, wrong = read_sexagesimal(source.columns[column], role)
    else:
        found, wrong = read_numbers(source.columns[column], role, form=form, required=role != "height")
    broken = source.faults.flags(source.rows, Severity.REFUSED)
    return found, [fault for fault in wrong if not broken[(fault.row or 1) - 1]]


def _form(source: SourceTable, declaration: ImportDeclaration, places: dict[str, int | None]) -> tuple[NumberForm, str]:
    """How the numbers of the coordinates, heights and other measures are written."""
    columns = [source.columns[k] for role, k in places.items() if k is not None and _holds_numbers(role)]
    texts = [column for column in columns if isinstance(column, Texts)]
    if not texts:
        return NumberForm(declaration.decimal or "."), ""
    sample = chain.from_iterable(_sample_of(source, k) for role, k in places.items() if _holds_numbers(role))
    form, shown = detect_number_form(islice(sample, _SAMPLE * len(texts)), declaration.decimal)
    return form, shown if declaration.decimal is None or form.group else ""


def _detected_form(form: NumberForm, shown: str) -> list[Detected]:
    if not shown:
        return []
    group = _BLANKS.get(form.group, form.group)
    value = form.decimal + (f", with {group} between groups of three digits" if form.group else "")
    return [Detected("decimal sign", value, f"most numbers are written like {shown!r}")]


def _holds_numbers(role: str) -> bool:
    return role in NUMBER_ROLES or role == "height" or any(role in pair for pair in PAIRS)


def _check_order(
    source: SourceTable, declaration: ImportDeclaration, places: dict[str, int | None], first: Floats, second: Floats
) -> None:
    """Refuse columns X and Y that nothing orders: in many national systems X is the northing, GIS software differs."""
    x, y = (source.names[place].strip() for role in PAIRS[1] if (place := places[role]) is not None)
    is_declared = any(role in declaration.columns for role in PAIRS[1]) or declaration.local_grid is not None
    if is_declared or declaration.crs is None or not plain_name(x).startswith("x"):
        return
    axes = reference_system(declaration.crs).axis_info
    if not any(axis.abbrev.upper() == "X" and axis.direction == "north" for axis in axes):
        return
    known = np.isfinite(first) & np.isfinite(second)
    pairs = ((first[known], second[known]), (second[known], first[known]))
    if known.any() and all(share_inside(*pair, declaration) > _MIN_SHARE for pair in pairs):
        raise InvalidParameter(
            f"the columns {x!r} and {y!r} can be read in both orders: X is the northing of {declaration.crs}, GIS"
            " software writes the easting there, and the rows lie in its area of use either way",
            field="columns",
            limit="columns.easting and columns.northing, or area_deg",
            cure=f'declare columns {{"easting": "{y}", "northing": "{x}"}} if {x} is the northing, else the reverse',
        )


def _check_one_system(
    source: SourceTable, used: set[int | None], declaration: ImportDeclaration
) -> tuple[str, Detected] | None:
    """The CRS that a column of EPSG codes states for all rows; a column that has a role is no column of systems.

    Raises
    ------
    InvalidParameter
        A column of codes, datums or zones has several values, or another zone than the CRS, or a code that is not
        known.
    """
    if _OF_REGISTRY.issubset(source.names):
        return None
    stated: tuple[str, Detected] | None = None
    zones: list[tuple[int, str]] = []
    for column, name in enumerate(source.names):
        plain = plain_name(name)
        if column in used or plain not in (*_SYSTEM_NAMES, *_ZONE_NAMES):
            continue
        values = sorted({text for value in source.columns[column] if (text := cell_text(value))})
        form = _ZONE_VALUE if plain in _ZONE_NAMES else _SYSTEM_VALUE
        shown_name = name.strip()[:40]
        cure = f'if it is no CRS of the coordinates, declare columns {{"description": "{shown_name}"}}'
        if len(values) > 1 and all(map(form.match, values)):
            shown = ", ".join(text[:30] for text in values[:_FEW])
            raise InvalidParameter(
                f"the rows are in several systems: the column {shown_name!r} has {shown}",
                field="crs",
                limit="one CRS a file",
                cure=f"send a file for each; {cure}",
            )
        if len(values) != 1:
            continue
        if plain in _ZONE_NAMES and (found := _ONE_ZONE.fullmatch(values[0])):
            zones.append((int(found[1]), shown_name))
        elif plain in _EPSG_NAMES and (found := _ONE_CODE.fullmatch(values[0])):
            crs, evidence = f"EPSG:{found[1]}", f"all rows of the column {shown_name!r} have the same CRS"
            if stated is not None and stated[0] != crs:
                message = f"the columns state several systems: {stated[0]} and {crs}"
                raise InvalidParameter(message, field="crs", limit="one CRS a file", cure=cure)
            try:
                reference_system(split_heights(crs)[0])
            except ReferenceSystemError as error:
                message = f"the column {shown_name!r} has {crs}, which is no CRS that is known here"
                raise InvalidParameter(message, field="crs", limit="the EPSG code of a CRS", cure=cure) from error
            stated = crs, Detected("crs", crs, evidence)
    crs_of_all = declaration.crs or (stated[0] if stated is not None else None)
    own = zone_numbers(reference_system(split_heights(crs_of_all)[0])) if zones and crs_of_all is not None else ()
    for zone, shown_name in zones:
        if own and zone not in own:
            raise InvalidParameter(
                f"the column {shown_name!r} has zone {zone} in all rows, {crs_of_all} has zone {own[0]}",
                field="crs",
                limit=f"zone {own[0]}",
                cure="declare the CRS of the zone that the rows are in; if it is no zone of the coordinates, declare"
                f' columns {{"description": "{shown_name}"}}',
            )
    if stated is not None and declaration.crs is not None:
        of_rows, declared = split_heights(stated[0])[0], normalize_crs(declaration.crs)
        if of_rows != declared and not have_same_places(of_rows, declared):
            raise InvalidParameter(
                f"{stated[1].evidence}: {stated[0]}, the declaration has {declared}",
                field="crs",
                limit=stated[0],
                cure="declare the CRS that the coordinates are in; if the column states no CRS of the coordinates,"
                ' declare columns {"description": its name}',
            )
        return None
    return stated


# --- hemispheres ----------------------------------------------------------------------------------------------------


_LETTERS = {
    "n": "N", "north": "N", "northern": "N", "norte": "N", "nord": "N", "s": "S", "south": "S", "southern": "S",
    "sur": "S", "sud": "S", "e": "E", "east": "E", "eastern": "E", "este": "E", "ost": "E", "est": "E", "w": "W",
    "west": "W", "western": "W", "oeste": "W", "ouest": "W", "o": "O",
}  # fmt: skip
_HEMISPHERES = {"lon_deg": ("E", "W"), "lat_deg": ("N", "S")}
_OF_HEMISPHERE = r"(?:hemisphere|hemi|hem|h|ref|reference|dir|direction|sign|indicator|ind|cardinal|letter|card|{pair})"
_LAT = rf"(?:gps)?(?:lat|latitude|latitud|breite){_OF_HEMISPHERE.format(pair='(?:ns|sn|nors)')}"
_LON = rf"(?:gps)?(?:lon|long|lng|longitude|longitud|lange|laenge){_OF_HEMISPHERE.format(pair='(?:ew|we|eorw)')}"
_BESIDE = r"(?:hemisphere|hemi)\w*|\w*hemisphere"
_HEMISPHERE_NAMES = {
    "lat_deg": re.compile(rf"{_LAT}|(?:ns|sn|nors|northsouth)(?:indicator|ind|hemisphere|hemi)?|{_BESIDE}"),
    "lon_deg": re.compile(rf"{_LON}|(?:ew|we|eorw|eastwest)(?:indicator|ind|hemisphere|hemi)?|{_BESIDE}"),
}
_NAMELESS = ("", "dir", "ref", "direction")
"""Names of columns that hold hemispheres only between and behind the coordinates; elsewhere they are of traffic."""
_BOTH_NAMES = re.compile(_BESIDE)
_MIXED = re.compile(r"[NS][EWO]|O|[+-]1?", re.IGNORECASE)  # other ways to write a hemisphere


def _with_hemisphere(source: SourceTable, used: set[int | None], role: str, read: Coordinates) -> Floats:
    """Longitudes or latitudes with the sign of a column of hemispheres beside them.

    Raises
    ------
    InvalidParameter
        The column has other cells, too, or contradicts signs of the values.
    """
    values = read.first if role == "lon_deg" else read.second
    for column, name in enumerate(source.names):
        if column in used or not _may_be_hemisphere(source, column, role, read):
            continue
        cells = [_LETTERS.get(cell_text(cell).lower().rstrip("."), cell_text(cell)) for cell in source.columns[column]]
        positive, negative = _HEMISPHERES[role]
        known = np.isfinite(values)
        of_rows = {cell for cell, is_known in zip(cells, known.tolist(), strict=True) if is_known}
        both = {letter for letters in _HEMISPHERES.values() for letter in letters}
        shown = name.strip()[:40]
        if of_rows.isdisjoint({positive, negative}):
            is_of_other = not of_rows.isdisjoint(both) and _BOTH_NAMES.fullmatch(plain_name(name)) is not None
            is_other_text = not any(_MIXED.fullmatch(cell) for cell in of_rows)
            if is_of_other or (of_rows.isdisjoint(both) and is_other_text):
                continue
        is_negative = np.array([cell == negative for cell in cells], dtype=bool)
        if not of_rows <= {positive, negative}:
            other = next(iter(sorted(of_rows - {positive, negative})))
            problem = f"the column {shown!r} beside {role} has {other[:20]!r}, not only {positive} and {negative}"
        elif not (values[known] < 0).any():
            if is_negative[known].any():
                value = f"{role} is negative where {shown!r} is {negative}"
                read.detected.append(Detected("hemisphere", value, "all values are without sign"))
            return np.where(is_negative, -values, values)
        elif np.array_equal(values[known] < 0, is_negative[known] & (values[known] != 0)):
            return values
        else:
            problem = f"the column {shown!r} contradicts signs of {role}"
        raise InvalidParameter(
            problem,
            field=f"columns.{role}",
            limit=f"{positive} and {negative} beside values without sign",
            cure="write decimal degrees, negative in the south and west, and leave the column out; if it holds no"
            f' hemispheres, declare columns {{"description": "{shown}"}}',
        )
    return values


def _may_be_hemisphere(source: SourceTable, column: int, role: str, read: Coordinates) -> bool:
    name = plain_name(source.names[column])
    if _HEMISPHERE_NAMES[role].fullmatch(name):
        return True
    lon, lat = (read.places[one] for one in PAIRS[0])
    is_between = lon is not None and lat is not None and abs(lon - lat) == 2
    return is_between and name.rstrip("0123456789") in _NAMELESS and column - 1 == read.places[role]


# --- geometry -------------------------------------------------------------------------------------------------------


def _wkt_column(source: SourceTable) -> int | None:
    for column, name in enumerate(source.names):
        if plain_name(name) in WKT_NAMES:
            texts = (cell_text(value) for value in source.columns[column])
            if _WKT.fullmatch(next((text for text in texts if text), "")):
                return column
    return None


def _from_wkt(source: SourceTable, column: int) -> Coordinates:
    texts = [cell_text(value).removeprefix("\\x") for value in source.columns[column]]
    first = next(text for text in texts if text)
    is_hex = first[0] == "0"
    read: Any = shapely.from_wkb if is_hex else shapely.from_wkt
    shapes = read([text if is_hex else _SRID.sub("", text) for text in texts], on_invalid="ignore")
    if is_hex:
        srids = {int(srid) for srid, shape in zip(shapely.get_srid(shapes), shapes, strict=True) if shape is not None}
    else:
        srids = {int(found[1]) if (found := _SRID.match(text)) else 0 for text in texts if text}
    if len(srids) > 1:
        raise InvalidParameter(
            f"the geometries have several SRIDs: {', '.join(str(srid or 'none') for srid in sorted(srids)[:_FEW])}",
            field="crs",
            limit="one CRS a file",
            cure="send a file for each, or transform all with ST_Transform",
        )
    srid = next(iter(srids), 0)
    (x, y, z), faults = points_of(shapes)
    evidence = f"the column {source.names[column][:60]!r} holds {'WKB' if is_hex else 'WKT'} such as {first[:40]!r}"
    detected = [Detected("coordinates", "geometry", evidence)]
    crs = f"EPSG:{srid}" if srid else None
    return Coordinates(x, y, z, None, crs=crs, faults=faults, detected=detected)


def _with_column_of_heights(
    read: Coordinates, source: SourceTable, declaration: ImportDeclaration, places: dict[str, int | None]
) -> Coordinates:
    """With the heights of a column beside geometry: where the geometry has none, or where the column is declared."""
    column = places["height"]
    if column is None or declaration.ignore_heights:
        return read
    form, shown = _form(source, declaration, places)
    values, faults = _numbers(source, places, "height", form)
    assert values is not None
    name, is_declared = source.names[column].strip()[:60], bool(declaration.columns.get("height"))
    there = np.isfinite(values)
    if not is_declared and len(faults) > there.sum():
        message = f"the column {name!r} was not read as height: most of its values are no numbers"
        cure = f'declare columns {{"height": "{name}"}} if it is, or {{"height": null}} if it is not'
        read.faults.append(warn(None, "height", "role_without_evidence", message, cure, (_NO_COLUMN,)))
        return read
    if not there.any() and not faults:
        return read
    z = np.full(len(values), np.nan) if read.height is None else read.height
    has_z = bool(np.any(z[np.isfinite(z)]))
    common = there & np.isfinite(z)
    apart = np.abs(values - z, where=common, out=np.zeros(len(z)))
    differ = int((apart > _ROUNDED).sum()) if has_z else 0
    if differ:
        used, others = ("column, which is declared,", "geometry") if is_declared else ("geometry", "column")
        message = (
            f"{differ} heights of the geometry differ from the column {name!r}, by up to {apart.max():.2f};"
            f" those of the {used} are used"
        )
        change = _NO_COLUMN if is_declared else Change("columns.height", source.names[column])
        cure = f"declare columns.height {'null' if is_declared else name} if those of the {others} are right"
        read.faults.append(warn(None, "height", "heights_disagree", message, cure, (change,)))
    first, second = (values, z) if is_declared or not has_z else (z, values)
    agree = has_z and not differ and common.any()
    read.height = np.where(np.isnan(first), second, first) if agree else first
    if first is values:
        read.form, read.faults = form, [*read.faults, *faults]
        read.detected += _detected_form(form, shown)
    return read


def points_of(shapes: Any, start: int = 0) -> tuple[tuple[Floats, Floats, Floats], list[Fault]]:
    """Coordinates of shapes, NaN and a fault where one is no point; a multipoint of one point counts as the point."""
    kinds = shapely.get_type_id(shapes)
    single = (kinds == shapely.GeometryType.MULTIPOINT) & (shapely.get_num_geometries(shapes) == 1)
    shapes = np.where(single, shapely.get_geometry(shapes, 0), shapes)
    usable = (shapely.get_type_id(shapes) == shapely.GeometryType.POINT) & ~shapely.is_empty(shapes)
    points = np.where(usable, shapes, shapely.Point(np.nan, np.nan))
    x, y, z = shapely.get_x(points), shapely.get_y(points), shapely.get_z(points)
    usable &= np.isfinite(x) & np.isfinite(y)
    faults = [
        Fault(start + int(row) + 1, "geometry", "no_point", "the feature is no point with finite numbers")
        for row in np.flatnonzero(~usable)
    ]
    return (x, y, z), faults


def _with_plausible_heights(read: Coordinates, declaration: ImportDeclaration) -> Coordinates:
    """Without heights that are none: not declared, missing everywhere, or zero everywhere."""
    if read.height is None or declaration.ignore_heights or np.isnan(read.height).all():
        read.height = None
        return read
    known = read.height[np.isfinite(read.height)]
    if len(known) > 1 and not known.any():
        message = f"all {len(known)} heights are 0, as software writes unknown ones; they were left out"
        cure = "measure the heights, or declare ignore_heights"
        read.faults.append(warn(None, "height", "zero_heights", message, cure, _IGNORED))
        read.height = None
    elif len(known) > _FEW and np.ptp(known) == 0:
        message = f"all {len(known)} heights are {known[0]:g}, as devices without heights write them"
        cure = "declare ignore_heights to leave them out"
        read.faults.append(warn(None, "height", "equal_heights", message, cure, _IGNORED))
    return read
