"""Surveys as XML: placemarks of KML, waypoints of GPX, CgPoints of LandXML. No document type, so no entity expands."""

from __future__ import annotations

import io
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from app.errors import ReferenceSystemError, UnreadableUpload
from app.formats.format import ArchiveLimits, read_members
from app.formats.surveys.declaration import FEET
from app.formats.surveys.table import MAX_COLUMNS, MAX_ROWS, Detected, Fault, Faults, SourceTable, warn
from app.formats.xml_tree import MAX_BYTES, check_xml, local_name
from app.geodesy import normalize_crs, reference_system
from app.geodesy.systems import split_heights

MAX_ELEMENTS = 20 * MAX_ROWS
"""Elements of a document."""
_GPX_NAMES = {"name": "point", "desc": "description", "cmt": "comment", "sym": "symbol", "type": "type"}
_KMZ_LIMITS = ArchiveLimits(members=1000, member_bytes=MAX_BYTES, total_bytes=MAX_BYTES, ratio=200.0)
"""Of a KMZ with its pictures. Ratio: KML of many points is about 20 times smaller in a ZIP; measured with 8 to 100,000
placemarks by `tests/formats/surveys/test_formats.py`."""
_LANDXML_UNITS = {"meter": "m", "foot": FEET, "ussurveyfoot": "ft-us"}


def read_kml(data: bytes) -> SourceTable:
    """Points of placemarks, one row for each point of a MultiGeometry; their names, descriptions and data are columns.

    Longitude first, as KML has it. Altitudes are heights where their mode is ``absolute``; the others, also those
    without a mode, are above the ground, or mean nothing (OGC KML 2.2, altitudeModeEnumType).

    Raises
    ------
    UnreadableUpload
        It is no XML, has a document type, or too many elements.
    """
    rows: list[dict[str, object]] = []
    points: list[tuple[float, float, float]] = []
    faults: list[Fault] = []
    above_ground = 0
    for placemark in elements(data, "Placemark"):
        values = _kml_values(placemark)
        for element in list(_below(placemark, "Point")) or [ET.Element("Point")]:
            point = _numbers(_text_of(element, "coordinates").split(","))
            rows.append(values)
            if point is None or len(point) not in (2, 3):
                faults.append(Fault(len(rows), "geometry", "no_point", "the placemark is no point with finite numbers"))
                point = [math.nan, math.nan]
            height = point[2] if len(point) == 3 else math.nan
            if math.isfinite(height) and _text_of(element, "altitudeMode").strip() != "absolute":
                above_ground += height != 0
                height = math.nan
            points.append((point[0], point[1], height))
    if above_ground:
        message = (
            f"{above_ground} altitudes are above the ground or without meaning, as altitudeMode states, which is"
            " clampToGround where it is missing; they were left out"
        )
        cure = "if they are heights above the vertical datum, write altitudeMode absolute into each Point"
        faults.append(warn(None, "height", "altitude_mode", message, cure))
    return _table("kml", rows, points, faults, crs="EPSG:4326")


def read_kmz(data: bytes) -> SourceTable:
    """The one KML of a KMZ archive.

    Raises
    ------
    UnreadableUpload, UploadTooLarge, UnsupportedUpload
        The archive is damaged or encrypted, holds no KML or several, or is too large when inflated.
    """
    members = [member for member in read_members(data, _KMZ_LIMITS) if member.name.lower().endswith(".kml")]
    main = [member for member in members if member.name.lower() == "doc.kml"] or members
    if len(main) != 1:
        raise UnreadableUpload(
            f"the archive holds {len(members)} KML files", field="file", limit="one KML", cure="save it as one KML"
        )
    if main[0].error is not None:
        raise main[0].error
    return replace(read_kml(main[0].data), format="kmz")


def read_gpx(data: bytes) -> SourceTable:
    """Waypoints; points of tracks and routes are no surveyed points.

    Raises
    ------
    UnreadableUpload
        It is no XML, has a document type, or too many elements.
    """
    rows: list[dict[str, object]] = []
    points: list[tuple[float, float, float]] = []
    faults: list[Fault] = []
    tracked = 0
    for element in elements(data, "wpt", "trkpt", "rtept"):
        if local_name(element.tag) != "wpt":
            tracked += 1
            continue
        values = {local_name(child.tag): (child.text or "").strip() for child in element}
        rows.append({name: values.get(tag) for tag, name in _GPX_NAMES.items()})
        place = _numbers([element.get("lon", "-"), element.get("lat", "-")])
        height = _numbers([values.get("ele", "")])
        if place is None or height is None:
            faults.append(Fault(len(rows), "geometry", "no_point", "the waypoint has no finite lon, lat and ele"))
        lon, lat = place or (math.nan, math.nan)
        points.append((lon, lat, height[0] if height else math.nan))
    if tracked and not rows:
        raise UnreadableUpload(
            f"the GPX has no waypoints, but {tracked} points of tracks and routes",
            field="file",
            limit="waypoints (wpt)",
            cure="export the surveyed points as waypoints",
        )
    table = _table("gpx", rows, points, faults, crs="EPSG:4326")
    skipped = (Detected("tracks", f"{tracked} points left out", "only waypoints are markers"),) if tracked else ()
    return replace(table, detected=skipped)


def read_landxml(data: bytes) -> SourceTable:
    """CgPoints, which are always north, east, elevation, with the units and the CRS that the file declares.

    Raises
    ------
    UnreadableUpload
        It is no XML, has a document type, names units that are not known, or too many elements.
    """
    rows: list[dict[str, object]] = []
    points: list[tuple[float, float, float]] = []
    faults: list[Fault] = []
    crs = unit = height_unit = None
    for element in elements(data, "CgPoint", "CoordinateSystem", "Metric", "Imperial"):
        kind = local_name(element.tag)
        if kind == "CoordinateSystem":
            code = element.get("epsgCode", "").strip()
            if code:
                crs, problem = _landxml_crs(code)
                faults += problem
        elif kind != "CgPoint":
            unit = _linear_unit(element.get("linearUnit", ""))
            height_unit = _elevation_unit(element.get("elevationUnit", ""), unit)
        else:
            found = _numbers((element.text or "").split())
            rows.append({"point": element.get("name"), "code": element.get("code"), "description": element.get("desc")})
            if found is None or len(found) not in (2, 3):
                faults.append(Fault(len(rows), "geometry", "no_point", "the CgPoint has no two or three numbers"))
                found = [math.nan, math.nan]
            points.append((found[1], found[0], found[2] if len(found) == 3 else math.nan))
    return replace(_table("landxml", rows, points, faults, crs=crs, unit=unit), height_unit=height_unit)


def _landxml_crs(code: str) -> tuple[str | None, list[Fault]]:
    """The CRS of an epsgCode; none, and a warning, where it cannot be used."""
    try:
        crs = normalize_crs(code if code.upper().startswith("EPSG:") else f"EPSG:{code}")
        horizontal, _heights = split_heights(crs)
        if "[" not in horizontal:
            reference_system(horizontal)
    except ReferenceSystemError as error:
        message = f"the epsgCode {code[:20]!r} of the file cannot be used: {error.message}"
        return None, [
            warn(None, "crs", "unusable_crs", message, "check the declared crs: the file does not confirm it")
        ]
    return crs, []


def _linear_unit(name: str) -> str:
    unit = _LANDXML_UNITS.get(name.lower())
    if unit is None:
        raise UnreadableUpload(
            f"the linear unit {name[:40]!r} is not known",
            field="file",
            limit="meter, foot, USSurveyFoot",
            cure="export the survey in metres or feet",
        )
    return unit


def _elevation_unit(name: str, unit: str) -> str | None:
    """Unit of the elevations, where it is another one than that of the coordinates; feet are of the same kind."""
    found = _LANDXML_UNITS.get({"feet": "foot"}.get(name.lower(), name.lower()))
    if name and found is None:
        raise UnreadableUpload(
            f"the unit of elevations {name[:40]!r} is not known",
            field="file",
            limit="meter, feet",
            cure="export the survey with elevations in metres or feet",
        )
    if found is None or (found == "m") == (unit == "m"):
        return None
    return "m" if found == "m" else "ft-intl"


def check_size(rows: int, names: int) -> None:
    """Check the number of points and of their columns.

    Raises
    ------
    UnreadableUpload
        There are too many.
    """
    if names > MAX_COLUMNS or rows > MAX_ROWS:
        raise UnreadableUpload(
            "the file has too many points or names",
            field="file",
            limit=f"{MAX_ROWS} points, {MAX_COLUMNS} names",
            cure="cut the file",
        )


def elements(data: bytes, *names: str) -> Iterator[ET.Element]:
    """Elements of these names; each is forgotten after its turn."""
    data = check_xml(data, max_elements=MAX_ELEMENTS, cure="send the points alone")
    parents: list[ET.Element] = []
    for event, element in ET.iterparse(io.BytesIO(data), events=("start", "end")):
        if event == "start":
            parents.append(element)
            continue
        parents.pop()
        if local_name(element.tag) in names:
            yield element
            element.clear()
        if parents and not any(local_name(parent.tag) in names for parent in parents):
            parents[-1].remove(element)


def _below(element: ET.Element, name: str) -> Iterator[ET.Element]:
    return (child for child in element.iter() if local_name(child.tag) == name)


def _text_of(element: ET.Element, name: str) -> str:
    return next((below.text or "" for below in _below(element, name)), "")


def _kml_values(placemark: ET.Element) -> dict[str, object]:
    values: dict[str, object] = {}
    for child in placemark.iter():
        kind = local_name(child.tag)
        if kind in ("name", "description") and kind not in values:
            values[{"name": "point"}.get(kind, kind)] = (child.text or "").strip()
        elif kind == "SimpleData" and child.get("name"):
            values[child.get("name", "")] = (child.text or "").strip()
        elif kind == "Data" and child.get("name"):
            inner = next(_below(child, "value"), None)
            values[child.get("name", "")] = (inner.text or "").strip() if inner is not None else None
    return values


def _numbers(parts: list[str]) -> list[float] | None:
    try:
        found = [float(part) for part in parts if part.strip()]
    except ValueError:
        return None
    return found if all(math.isfinite(v) for v in found) else None


def _table(
    kind: str,
    rows: list[dict[str, object]],
    points: list[tuple[float, float, float]],
    faults: list[Fault],
    *,
    crs: str | None = None,
    unit: str | None = None,
) -> SourceTable:
    names = tuple(dict.fromkeys(name for row in rows for name in row))
    check_size(len(rows), len(names))
    columns = tuple([row.get(name) for row in rows] for name in names)
    xyz = np.array(points, dtype=np.float64).reshape(-1, 3)
    return SourceTable(kind, names, columns, (xyz[:, 0], xyz[:, 1], xyz[:, 2]), crs, unit, faults=Faults(faults))


# === Surveys as Trimble JobXML: the reduced points of a job, with grid coordinates in metres and WGS 84 coordinates.


_GRID = {"North": "northing", "East": "easting", "Elevation": "height"}
_WGS84 = {"Latitude": "lat_deg", "Longitude": "lon_deg", "Height": "ellipsoidal_height"}
_TEXTS = {"Name": "point", "Code": "code", "SurveyMethod": "method"}
_POOR = ("Float", "Code", "Autonomous", "SBAS", "Differential")
"""Ends of survey methods without fixed ambiguities: Trimble JobXML schema 5.3, SurveyMethodEnum."""
_SHOWN = 10  # names of points in a report
_NAMES = (*_TEXTS.values(), *_GRID.values(), *_WGS84.values())


def read_jobxml(data: bytes) -> SourceTable:
    """Points below `Reductions`, which have been averaged and adjusted; lengths are in metres whatever the job shows.

    Points that were deleted in the job are left out.

    Raises
    ------
    UnreadableUpload
        It is no XML, has a document type, or too many elements.
    """
    rows: list[dict[str, str | float | None]] = []
    without, faults = 0, Faults()
    deleted: list[str] = []
    for point in elements(data, "Point"):
        row = _row(point)
        if _is_deleted(point):
            deleted.append(next((child.text or "" for child in point if local_name(child.tag) == "Name"), "").strip())
        elif row is None:
            without += 1
        else:
            rows.append(row)
            faults.add(_check_method(len(rows), str(row["method"] or "")))
        check_size(len(rows), len(_NAMES))
    detected = [Detected("unit", "m", "JobXML has its lengths in metres")]
    if without or deleted:
        reasons = ["points without coordinates"] if without else []
        if deleted:
            shown = ", ".join(name[:40] for name in deleted[:_SHOWN]) + (" and others" if deleted[_SHOWN:] else "")
            reasons.append(f"{len(deleted)} deleted in the job: {shown}")
        detected.append(Detected("other points", f"{without + len(deleted)} left out", "; ".join(reasons)))
    names = tuple(name for name in _NAMES if any(row[name] is not None for row in rows))
    columns = tuple([row[name] for row in rows] for name in names)
    return SourceTable("jobxml", names, columns, unit="m", faults=faults, detected=tuple(detected))


def _check_method(row: int, method: str) -> list[Fault]:
    """Warnings of points that were typed in, or measured without fixed ambiguities."""
    if method == "KeyedIn":
        message, cure = "the point was keyed in, not measured", "leave out points of the plan and of the control"
        return [warn(row, "point", "keyed_in_point", message, cure)]
    if method.endswith(_POOR):
        message = f"the point was measured with {method}: decimetres to metres"
        return [warn(row, "point", "poor_solution", message, "measure it again with fixed ambiguities")]
    return []


def _is_deleted(point: ET.Element) -> bool:
    """Whether the surveyor deleted the point: its classification is ``DeletedNormal`` or another that begins so."""
    texts = (child.text or "" for child in point if local_name(child.tag) == "Classification")
    return any(text.strip().lower().startswith("deleted") for text in texts)


def _row(point: ET.Element) -> dict[str, str | float | None] | None:
    """Values of a point; None without coordinates."""
    row: dict[str, str | float | None] = dict.fromkeys(_NAMES)
    has_place = False
    for child in point:
        kind = local_name(child.tag)
        if kind in _TEXTS:
            row[_TEXTS[kind]] = (child.text or "").strip()
        for names in (_GRID,) if kind == "Grid" else (_WGS84,) if kind == "WGS84" else ():
            for value in child:
                if (name := names.get(local_name(value.tag))) is not None and (value.text or "").strip():
                    row[name] = _number(value.text or "")
                    has_place = True
    return row if has_place else None


def _number(text: str) -> float | str:
    """A number, or the text where it is none, which becomes a fault of its row."""
    try:
        value = float(text)
    except ValueError:
        return text.strip()
    return value if math.isfinite(value) else text.strip()
