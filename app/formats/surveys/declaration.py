"""What is declared of a survey: CRS, datum, units, columns and checks, which most files do not contain."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from app.errors import InvalidParameter

FORMATS = ("csv", "geojson", "gpkg", "shapefile", "kml", "kmz", "gpx", "landxml", "jobxml", "dxf", "gsi")
FIXED_LAYOUTS = {
    "pnezd": ("point", "northing", "easting", "height", "description"),
    "penzd": ("point", "easting", "northing", "height", "description"),
    "nezd": ("northing", "easting", "height", "description"),
    "enzd": ("easting", "northing", "height", "description"),
}
"""Columns by position, by the name that survey software has for them."""
LAYOUTS = (*FIXED_LAYOUTS, "named")
ENCODINGS = ("utf-8", "utf-16", "windows-1252", "iso-8859-1", "iso-8859-2", "windows-1250", "cp437", "cp850")
DUPLICATES = ("refuse", "store")
Unit = Literal["m", "ft-us", "ft-intl"]
METRES: dict[str, float] = {"m": 1.0, "ft-us": 1200.0 / 3937.0, "ft-intl": 0.3048}
"""Metres to a unit of length: US survey foot and international foot (NIST SP 811)."""
FEET = "ft"
"""Unit of a file that does not state which foot."""
TEXT_ROLES = ("point", "code", "description", "road", "side", "status")
NUMBER_ROLES = ("heading_deg", "measure_m", "offset_m", "horizontal_rmse_m", "vertical_rmse_m")
COORDINATE_ROLES = ("lon_deg", "lat_deg", "easting", "northing", "height")
ROLES = (*COORDINATE_ROLES, *TEXT_ROLES, *NUMBER_ROLES)
MATCHES = ("code", "nearest")
MAX_AREA_DEG = 30.0
"""Largest side of a declared area: a larger one would check nothing. [deg]"""


@dataclass(frozen=True, slots=True)
class ControlPoint:
    """A point that is known in a local grid and in the declared CRS."""

    point: str  # its point number, which names it in reports and in the file
    # `easting`, `northing`: in the CRS and its unit
    easting: float
    northing: float
    # `local_easting`, `local_northing`: in the local grid, in the unit of the file; those of the row with the same
    # point number without
    local_easting: float | None = None
    local_northing: float | None = None


@dataclass(frozen=True, slots=True)
class LocalGrid:
    """How coordinates of a local grid are transformed to the declared CRS."""

    control_points: tuple[ControlPoint, ...]
    scale: str = "fixed"  # ``fixed`` (1, as for distances that are reduced to the grid) or ``free`` (estimated)
    limit_m: float = 0.05  # [m] largest residual of a control point

    def __post_init__(self) -> None:
        needed = 2 if self.scale == "fixed" else 3
        if len(self.control_points) < needed:
            raise InvalidParameter(
                f"{len(self.control_points)} control points leave no residuals to check",
                field="local_grid.control_points",
                limit=f"at least {needed} with scale {self.scale}",
                cure="declare further control points",
            )
        names = [control.point for control in self.control_points]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InvalidParameter(
                f"the control point {twice[:40]!r} is declared twice", field="local_grid.control_points",
                limit="each point once", cure="leave one of the two out",
            )  # fmt: skip


@dataclass(frozen=True, slots=True)
class ImportDeclaration:
    """What is declared of a survey."""

    format: str | None = None  # one of `FORMATS`; detected by the content if it is left out
    # of CSV: one of `FIXED_LAYOUTS` (no header needed), or ``named`` columns; detected without
    layout: str | None = None
    # role to the column's name, or None where the file has no column of this role; common names are found without.
    # Roles are `ROLES`.
    columns: Mapping[str, str | None] = field(default_factory=dict)
    layer: str | None = None  # of a GeoPackage or a DXF
    # `decimal`, `delimiter`, `encoding`: of CSV; detected without
    decimal: str | None = None
    delimiter: str | None = None
    encoding: str | None = None
    # `crs`, `realization`, `epoch`, `vertical_datum`: frame of the coordinates. [epoch: decimal year]
    crs: str | None = None
    realization: str | None = None
    epoch: float | None = None
    vertical_datum: str | None = None
    # `unit`, `height_unit`: ``m``, ``ft-us`` or ``ft-intl``; that of the CRS without
    unit: str | None = None
    height_unit: str | None = None
    local_grid: LocalGrid | None = None  # where easting and northing are those of a local grid
    ignore_heights: bool = False  # leave heights out
    # [deg] west, south, east, north of a box that contains all rows
    area_deg: tuple[float, float, float, float] | None = None
    height_range_m: tuple[float, float] | None = None  # [m] lowest and highest plausible height
    # `family`, `status`, `road`: of the markers
    family: str = "plate"
    status: str | None = None
    road: str | None = None
    # the survey finds registered markers as built: rows are matched, and moved markers get a new version
    compare: bool = False
    duplicates: str = "refuse"  # ``refuse`` what is already registered, or ``store`` it once more
    match: str = "code"  # ``code`` or ``nearest``
    tolerance_m: float = 0.1  # [m] residuals beyond it are reported
    leave_out: tuple[int, ...] = ()  # numbers of rows, counted from 1, that are neither checked nor stored
    # horizontal_rmse_m, vertical_rmse_m, survey_method, surveyor, instrument, check_points
    survey: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, value, allowed in (
            ("format", self.format, (None, *FORMATS)),
            ("layout", self.layout, (None, *LAYOUTS)),
            ("decimal", self.decimal, (None, ".", ",")),
            ("delimiter", self.delimiter, (None, ",", ";", "\t", "|", "space")),
            ("encoding", self.encoding, (None, *ENCODINGS)),
            ("duplicates", self.duplicates, DUPLICATES),
            ("unit", self.unit, (None, *METRES)),
            ("height_unit", self.height_unit, (None, *METRES)),
            ("match", self.match, MATCHES),
        ):
            if value not in allowed:
                known = ", ".join(repr(name) for name in allowed if name is not None)
                raise InvalidParameter(f"there is no {name} {str(value)[:40]!r}", field=name, limit=known, cure=_CURE)
        unknown = next((role for role in self.columns if role not in ROLES), None)
        if unknown is not None:
            raise InvalidParameter(
                f"there is no role {unknown[:40]!r}", field="columns", limit=", ".join(ROLES), cure=_CURE
            )
        _check_area(self.area_deg)
        if self.height_range_m is not None and not self.height_range_m[0] < self.height_range_m[1]:
            raise InvalidParameter(
                "the lowest height is not below the highest", field="height_range_m", limit="low < high", cure=_CURE
            )
        if not (math.isfinite(self.tolerance_m) and 0 < self.tolerance_m <= 100):
            raise InvalidParameter("the tolerance is out of range", field="tolerance_m", limit="0 to 100 m", cure=_CURE)


_CURE = "docs/imports.md lists what can be declared"


def _check_area(area: tuple[float, float, float, float] | None) -> None:
    if area is None:
        return
    west, south, east, north = area
    fits = -180 <= west < east <= 180 and -90 <= south < north <= 90
    if not fits or max(east - west, north - south) > MAX_AREA_DEG:
        raise InvalidParameter(
            "area_deg is no box of west, south, east, north, or one too large to check anything",
            field="area_deg",
            limit=f"west < east, south < north, at most {MAX_AREA_DEG:g} degrees wide",
            cure="send the box of the project; split a survey that crosses the antimeridian",
        )
