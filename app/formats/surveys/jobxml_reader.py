"""Surveys as Trimble JobXML: the reduced points of a job, with grid coordinates in metres and WGS 84 coordinates."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

from app.formats.surveys.table import Detected, Fault, Faults, SourceTable, warn
from app.formats.surveys.xml_reader import check_size, elements
from app.formats.xml_tree import local_name

_GRID = {"North": "northing", "East": "easting", "Elevation": "height"}
_WGS84 = {"Latitude": "lat_deg", "Longitude": "lon_deg", "Height": "ellipsoidal_height"}
_TEXTS = {"Name": "point", "Code": "code", "SurveyMethod": "method"}
_POOR = ("Float", "Code", "Autonomous", "SBAS", "Differential")
"""Ends of survey methods without fixed ambiguities: Trimble JobXML schema 5.3, SurveyMethodEnum."""
_NAMES = (*_TEXTS.values(), *_GRID.values(), *_WGS84.values())


def read_jobxml(data: bytes) -> SourceTable:
    """Points below `Reductions`, which have been averaged and adjusted; lengths are in metres whatever the job shows.

    Raises
    ------
    UnreadableUpload
        It is no XML, has a document type, or too many elements.
    """
    rows: list[dict[str, str | float | None]] = []
    without, faults = 0, Faults()
    for point in elements(data, "Point"):
        row = _row(point)
        if row is None:
            without += 1
        else:
            rows.append(row)
            faults.add(_check_method(len(rows), str(row["method"] or "")))
        check_size(len(rows), len(_NAMES))
    detected = [Detected("unit", "m", "JobXML has its lengths in metres")]
    if without:
        detected.append(Detected("other points", f"{without} left out", "points without coordinates"))
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
