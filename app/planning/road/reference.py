"""How the coordinates of a file with a road become WGS 84: by its CRS, by a declared one, or by an origin."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from app.errors import InvalidParameter, ReferenceSystemError
from app.formats.alignments.geometry import AlignmentDeclaration, AlignmentFile
from app.formats.surveys.declaration import METRES, choose_datum
from app.geodesy import normalize_crs, place_positions, reference_system
from app.geodesy.systems import HeightSystem, geographic_code, has_datum, is_global, name_system, split_heights
from app.values import Floats

MAX_LOCAL_M = 200_000.0
"""Farthest distance of local coordinates from their origin. [m] UTM northings are larger."""
_CRS84 = "OGC:CRS84"
_PROJ_KEYS = frozenset({
    "R", "a", "alpha", "axis", "b", "datum", "ellps", "f", "gamma", "k", "k_0", "lat_0", "lat_1", "lat_2", "lat_ts",
    "lon_0", "lonc", "no_defs", "over", "pm", "proj", "rf", "south", "to_meter", "towgs84", "type", "units",
    "vto_meter", "vunits", "wktext", "x_0", "y_0", "zone",
})  # fmt: skip
"""Other keys of PROJ strings can name files. Source: PROJ documentation, "Cartographic projection"."""
_SAME_GRID_M = 1e-3  # [m] between the coordinates of two systems that are one grid
_WKT = re.compile(r"\s*[A-Z][A-Z0-9_]*\s*[\[(]", re.IGNORECASE)
_DROPPED_KEYS = ("geoidgrids", "geoid_crs")  # of heights, whose datum is declared


@dataclass(frozen=True, slots=True)
class PlacedRoad:
    """Positions of vertices, and how they were found; NaN where a position cannot be placed."""

    # `lon_deg`, `lat_deg`, `height_m`: shape (N,)
    lon_deg: Floats
    lat_deg: Floats
    height_m: Floats
    # `crs`, `realization`, `epoch`, `transform_accuracy_m`: as in `app.planning.alignment.Alignment`
    crs: str
    realization: str | None
    epoch: float | None
    transform_accuracy_m: float | None
    surveyed: bool
    note: str | None  # why positions are unfit for localization


@dataclass(frozen=True, slots=True)
class RoadReference:
    """Reference system of a file's coordinates."""

    name: str  # ``EPSG:code``, ``OGC:CRS84``, or a WKT or PROJ string; ``local`` with an origin
    geographic: bool
    unit_m: float  # [m] length of the coordinates' unit; 1 for degrees
    height_unit_m: float
    declaration: AlignmentDeclaration

    def place(self, vertices: Floats, accuracy_m: float) -> PlacedRoad:
        """Vertices of the file, shape (N, 3), in WGS 84 / ITRF."""
        height = vertices[:, 2] * self.height_unit_m
        if self.declaration.ignore_heights:
            height = np.full_like(height, np.nan)
        if self.declaration.origin is not None:
            return self._place_locally(vertices, height, self.declaration.origin)
        first, second, name, problem = vertices[:, 0], vertices[:, 1], self.name, None
        if self.geographic:
            first = (first + 180.0) % 360.0 - 180.0
        else:
            own = _unit_m(_system(self.name))
            first, second = first * (self.unit_m / own), second * (self.unit_m / own)
        if not _has_code(self.name):
            first, second, name, problem = _to_geographic(self.name, first, second)
        placed = place_positions(
            np.ascontiguousarray(first),
            np.ascontiguousarray(second),
            height,
            crs=name,
            realization=self.declaration.realization,
            epoch=self.declaration.epoch,
            ellipsoidal_height=self.declaration.vertical_datum == "ellipsoid",
            accuracy_m=accuracy_m,
        )
        bound, note = placed.transform_accuracy_m, placed.note
        if problem is not None:
            bound, note = None, problem
        return PlacedRoad(
            placed.lon_deg,
            placed.lat_deg,
            placed.height_m,
            self.name,
            placed.realization,
            placed.epoch,
            bound,
            True,
            note if bound is None else None,
        )

    def _place_locally(self, vertices: Floats, height: Floats, origin: tuple[float, float]) -> PlacedRoad:
        turn = math.radians(self.declaration.bearing_deg)
        x, y = vertices[:, 0] * self.unit_m, vertices[:, 1] * self.unit_m
        farthest = float(np.nanmax(np.hypot(x, y), initial=0.0))
        if farthest > MAX_LOCAL_M:
            raise ReferenceSystemError(
                f"coordinates are up to {farthest / 1000:.0f} km from the origin",
                field="origin",
                limit=f"{MAX_LOCAL_M / 1000:g} km",
                cure="declare the crs of the coordinates instead of an origin",
            )
        plane = local_plane(*origin)
        lon, lat = plane.transform(
            x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn), direction="INVERSE"
        )
        return PlacedRoad(
            np.asarray(lon), np.asarray(lat), height, "local", None, None, None, False,
            "the road is in local coordinates, placed by the declared origin",
        )  # fmt: skip


def local_plane(lon_deg: float, lat_deg: float) -> Transformer:
    """From WGS 84 to east and north in a conformal plane with true scale at a place (transverse Mercator)."""
    return Transformer.from_pipeline(
        f"+proj=tmerc +lat_0={lat_deg!r} +lon_0={lon_deg!r} +k=1 +x_0=0 +y_0=0 +ellps=WGS84"
    )


def find_reference(file: AlignmentFile, declaration: AlignmentDeclaration, *, has_heights: bool) -> RoadReference:
    """Reference system of a file, by what it states and what is declared.

    Raises
    ------
    ReferenceSystemError
        Neither places the road on Earth, they contradict each other, or the system cannot be used.
    InvalidParameter
        Units or the vertical datum are missing or contradict each other.
    """
    stated = _stated(file.crs) if file.crs is not None else None
    heights = _heights_of(file.crs) if has_heights and file.crs is not None else None
    if heights is not None:
        datum = choose_datum(declaration.vertical_datum, heights, f"the file ({str(file.crs)[:60]})")
        declaration = replace(declaration, vertical_datum=datum)
    if declaration.origin is not None:
        if stated is not None:
            raise ReferenceSystemError(
                f"the file is in {stated[:80]}, and an origin is declared",
                field="origin",
                limit="an origin only for local coordinates",
                cure="leave the origin out",
            )
        unit = _unit(file, declaration, 1.0)
        return RoadReference("local", False, unit, _height_unit(declaration, unit), declaration)
    declared = normalize_crs(declaration.crs) if declaration.crs is not None else None
    if stated is not None and declared is not None and not _are_same(stated, declared):
        raise ReferenceSystemError(
            f"the file is in {stated[:80]}, the declaration has {declared}",
            field="crs",
            limit=stated[:80],
            cure="leave crs out, or export the file again in the CRS that it is in",
        )
    name = declared or stated or (_CRS84 if file.format == "geojson" else None)
    if name is None:
        raise ReferenceSystemError(
            file.crs_problem or "the file states no CRS, so its coordinates are local",
            field="crs",
            limit="a CRS or an origin",
            cure="declare crs, e.g. EPSG:25832; for local coordinates the origin as LON,LAT, with a bearing if needed",
        )
    system = _system(name)
    own = _unit_m(system)
    if has_heights:
        _check_heights(file, declaration, own, heights)
    unit = own if system.is_geographic else _unit(file, declaration, own)
    of_heights = unit if heights is None or file.unit_m is not None else heights.unit_m
    return RoadReference(name, bool(system.is_geographic), unit, _height_unit(declaration, of_heights), declaration)


def _heights_of(crs: str) -> HeightSystem | None:
    """Vertical part of the CRS of a file; None without one, and for PROJ strings."""
    try:
        return split_heights(crs)[1]
    except ReferenceSystemError:
        return None


def _stated(crs: str) -> str:
    """A CRS that a file states, as ``EPSG:code`` where it has one."""
    try:
        name = normalize_crs(crs)
        if name == _CRS84 or not CRS.from_user_input(name).is_compound:
            return name
    except (ReferenceSystemError, CRSError):
        name = crs
    return name_system(_horizontal(name)) or name


def _has_code(name: str) -> bool:
    return name == _CRS84 or re.fullmatch(r"EPSG:[0-9]+", name) is not None


@lru_cache(maxsize=64)
def _system(name: str) -> CRS:
    """The system of a name that `_stated` or `normalize_crs` wrote."""
    return reference_system(name) if _has_code(name) else _horizontal(name)


def _horizontal(name: str) -> CRS:
    """The horizontal part of a code, WKT or a PROJ string."""
    try:
        system = CRS.from_user_input(_checked(name))
    except CRSError as error:
        raise _unusable(name, str(error)[:120]) from error
    while system.is_compound or system.is_bound:
        inner = system.sub_crs_list[0] if system.is_compound else system.source_crs
        assert inner is not None
        system = inner
    if not (system.is_geographic or system.is_projected) or system.geodetic_crs is None:
        raise _unusable(name, f"it is a {system.type_name}")
    return system


def _checked(name: str) -> str:
    """A PROJ string without grids of heights, WKT, or a code; refused if it could name files."""
    if _has_code(name) or (_WKT.match(name) and "grids=" not in name.lower().replace("nadgrids=@null", "")):
        return name
    words = [word for word in name.split() if not word.lstrip("+").startswith(_DROPPED_KEYS)]
    for word in words:
        if word.lstrip("+").split("=")[0] not in _PROJ_KEYS:
            raise _unusable(name, f"it has {word[:40]!r}")
    return " ".join(words)


def _unusable(name: str, why: str) -> ReferenceSystemError:
    return ReferenceSystemError(
        f"the CRS of the file, {' '.join(name.split())[:80]!r}, cannot be used: {why}",
        field="crs",
        limit="an EPSG code, WKT or a PROJ string of a horizontal CRS",
        cure="export the file in a CRS of the EPSG registry",
    )


def _are_same(stated: str, declared: str) -> bool:
    if stated == declared or {stated, declared} == {_CRS84, "EPSG:4326"}:
        return True
    if _has_code(stated):
        return False
    one, other = _system(stated), _system(declared)
    return bool(one.equals(other, ignore_axis_order=True)) or (not has_datum(one) and _have_same_grid(one, other))


def _have_same_grid(one: CRS, other: CRS) -> bool:
    """Whether two systems differ only in their datums."""
    if one.is_projected != other.is_projected or one.ellipsoid != other.ellipsoid:
        return False
    if not one.is_projected:
        return True
    area = other.area_of_use
    if area is None or one.geodetic_crs is None or other.geodetic_crs is None:
        return False
    lon = np.array([area.west, area.east if area.east > area.west else area.west])
    lat = np.array([area.south, area.north])
    grids = [
        np.array(Transformer.from_crs(system.geodetic_crs, system, always_xy=True).transform(lon, lat))
        for system in (one, other)
    ]
    return bool(np.isfinite(grids).all() and np.abs(grids[0] - grids[1]).max() < _SAME_GRID_M)


def _to_geographic(name: str, first: Floats, second: Floats) -> tuple[Floats, Floats, str, str | None]:
    """Longitudes and latitudes of a system without a code, their geographic system, and why that is doubtful."""
    system = _system(name)
    geodetic = system.geodetic_crs
    assert geodetic is not None
    if (bound := _with_shift(name)) is not None:
        shifted = Transformer.from_crs(bound, _CRS84, always_xy=True).transform(first, second)
        problem = "the CRS of the file is shifted to WGS 84 by its own +towgs84, whose accuracy is not stated"
        return np.asarray(shifted[0]), np.asarray(shifted[1]), _CRS84, problem
    if system.is_projected:
        first, second = Transformer.from_crs(system, geodetic, always_xy=True).transform(first, second)
    if is_global(system):
        return np.asarray(first), np.asarray(second), _CRS84, None
    code = geographic_code(geodetic)
    unknown = None if code else "the CRS of the file states no known datum"
    return np.asarray(first), np.asarray(second), code or _CRS84, unknown


def _with_shift(name: str) -> CRS | None:
    """The system of a text whose parameters shift its datum to WGS 84; None of one without, or with zeros only."""
    system = CRS.from_user_input(_checked(name))
    while system.is_compound:
        system = system.sub_crs_list[0]
    is_shifted = (
        system.is_bound and system.coordinate_operation is not None and any(system.coordinate_operation.towgs84)
    )
    return system if is_shifted else None


def _unit_m(system: CRS) -> float:
    return float(system.axis_info[0].unit_conversion_factor) if system.is_projected else 1.0


def _unit(file: AlignmentFile, declaration: AlignmentDeclaration, own_m: float) -> float:
    declared = METRES[declaration.unit] if declaration.unit is not None else None
    if declared is not None and file.unit_m is not None and abs(file.unit_m / declared - 1) > 1e-9:
        raise InvalidParameter(
            f"the file's unit is {file.unit_m:.9g} m, the declaration has {declaration.unit}",
            field="unit",
            limit=f"{file.unit_m:.9g} m",
            cure="leave unit out, or export the file again in the unit that it is in",
        )
    return declared or file.unit_m or own_m


def _height_unit(declaration: AlignmentDeclaration, unit_m: float) -> float:
    return METRES[declaration.height_unit] if declaration.height_unit is not None else unit_m


def _check_heights(
    file: AlignmentFile, declaration: AlignmentDeclaration, own_m: float, heights: HeightSystem | None
) -> None:
    if declaration.vertical_datum is None:
        raise InvalidParameter(
            "the file has heights, and their vertical datum is not declared",
            field="vertical_datum",
            limit="ellipsoid, or the datum, e.g. EPSG:5703",
            cure="declare vertical_datum, or ignore_heights to leave them out",
        )
    is_stated = heights is not None or file.unit_m is not None
    if own_m != 1.0 and not is_stated and declaration.unit is None and declaration.height_unit is None:
        raise InvalidParameter(
            "the unit of the heights is not declared",
            field="height_unit",
            limit=", ".join(METRES),
            cure=f"declare height_unit: the unit of the CRS is {own_m:.9g} m, heights need not be in it",
        )
