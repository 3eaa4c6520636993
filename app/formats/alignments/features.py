"""Features of a file with a road: lines, points and areas with their properties, before their meaning is known."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
import numpy.typing as npt
from pyproj import CRS
from pyproj.exceptions import CRSError

from app.errors import InvalidParameter, UnreadableUpload
from app.formats.alignments.geometry import MAX_COORDINATE, MAX_VERTICES, BoundaryStyle, EventKind

Floats = npt.NDArray[np.float64]

AREA_KINDS = ("joints", "manholes", "crossings", "bridges")
"""Areas that are recognized by a line's or an area's kind; areas may have other kinds too. Source: issue 13."""
EVENT_KINDS = tuple(kind.value for kind in EventKind)
SPEEDS_KMH = (2.0, 250.0)
"""Lowest and highest plausible speed limit. [km/h] Source: `app.planning.rules.SpeedKmh`."""
KMH_PER_MPH = 1.609344
"""International mile. Source: NIST SP 811, table 6."""
_MAX_FEATURES = 200_000  # source: chosen by hand, bounds the time of a file
_SINGULAR = {"joint": "joints", "manhole": "manholes", "crossing": "crossings", "bridge": "bridges"}
_SPEED = re.compile(r"\s*(?P<value>[0-9]+(\.[0-9]+)?)\s*(?P<unit>mph|km/?h|kph)?\s*", re.IGNORECASE)
_SPEED_NAMES = ("speed_limit_kmh", "speed_limit_mph", "maxspeed")
_STYLE_SYNONYMS = {"broken": "dashed", "dash": "dashed", "continuous": "solid", "virtual": "none"}


class Shape(StrEnum):
    """Kind of a feature's geometry."""

    LINE = "line"
    POINT = "point"
    AREA = "area"


@dataclass(frozen=True, slots=True, eq=False)
class RoadFeature:
    """A feature of a file.

    Attributes
    ----------
    where : str
        Place in the file, for messages: ``feature 3``.
    shape : Shape
    parts : tuple of ndarray, shape (N, 3)
        Lines, points, or outer rings of areas; height is NaN where there is none.
    properties : mapping
        By lower-case name.
    layer : str
        Name of its layer; decides the kind of a feature that states none.
    curvature_per_m : ndarray, shape (N,), or None
        Of a line with one part; left positive. [1/m]
    """

    where: str
    shape: Shape
    parts: tuple[Floats, ...]
    properties: Mapping[str, Any] = field(default_factory=dict)
    layer: str = ""
    curvature_per_m: Floats | None = None

    @property
    def kind(self) -> str:
        """As stated by the property `kind`, or by the layer; in lower case with underscores."""
        return normalize_kind(self.text("kind") or self.layer)

    def text(self, name: str) -> str | None:
        """A property as text; whole numbers without decimals; None if it is empty."""
        value = self.properties.get(name)
        if value is None or isinstance(value, bool) or (isinstance(value, float) and math.isnan(value)):
            return None
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        return str(value).strip()[:120] or None

    def number(self, name: str) -> float | None:
        """A property as a number; None if it is empty.

        Raises
        ------
        InvalidParameter
            It is no finite number.
        """
        text = self.text(name)
        if text is None:
            return None
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InvalidParameter(
                f"{self.where}: {name} is {text[:40]!r}",
                field=f"properties.{name}",
                limit="a finite number",
                cure="write a number, or leave the property out",
            )
        return value

    def speed_limit_mps(self) -> float:
        """Speed limit; NaN without one. [m/s]

        Raises
        ------
        InvalidParameter
            It is not between 2 and 250 km/h.
        """
        for name in _SPEED_NAMES:
            text = self.text(name)
            if text is None or (name == "maxspeed" and _SPEED.fullmatch(text) is None):
                continue  # maxspeed=none, walk or DE:urban states no number
            found = _SPEED.fullmatch(text) if name == "maxspeed" else None
            value = float(found["value"]) if found else self.number(name) or 0.0
            mph = name.endswith("_mph") or (found is not None and (found["unit"] or "").lower() == "mph")
            speed_kmh = value * KMH_PER_MPH if mph else value
            if not SPEEDS_KMH[0] <= speed_kmh <= SPEEDS_KMH[1]:
                raise InvalidParameter(
                    f"{self.where}: {name} is {text[:40]}",
                    field=f"properties.{name}",
                    limit=f"{SPEEDS_KMH[0]:g} to {SPEEDS_KMH[1]:g} km/h",
                    cure="correct the speed limit, or leave it out",
                )
            return speed_kmh / 3.6
        return math.nan

    def style(self, *names: str) -> BoundaryStyle:
        """Style of the first of several properties that is there.

        Raises
        ------
        InvalidParameter
            ``left_style`` or ``right_style`` is no style; other properties may hold anything.
        """
        name, text = next(((name, found) for name in names if (found := self.text(name)) is not None), ("", "unknown"))
        style = _STYLE_SYNONYMS.get(text.lower(), text.lower())
        if style in set(BoundaryStyle):
            return BoundaryStyle(style)
        if name in ("left_style", "right_style"):
            raise InvalidParameter(
                f"{self.where}: {name} is {text[:40]!r}",
                field=f"properties.{name}",
                limit=", ".join(BoundaryStyle),
                cure="name one of these, or leave the property out",
            )
        return BoundaryStyle.UNKNOWN


def normalize_kind(text: str) -> str:
    """A kind in lower case with underscores; plurals of event kinds are made singular."""
    kind = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
    singular = kind.removesuffix("s")
    return singular if singular in EVENT_KINDS and kind not in AREA_KINDS else kind


def area_kind(kind: str) -> str:
    """Kind of an area as the rules name it: ``bridge`` becomes ``bridges``."""
    return _SINGULAR.get(kind, kind)


def read_vertices(values: Any, where: str) -> Floats:
    """Vertices as an array, shape (N, 3), with NaN as height where there is none.

    Parameters
    ----------
    values : array_like, shape (N, 2) or (N, 3), or nested lists
        Further coordinates are left out.

    Raises
    ------
    InvalidParameter
        A coordinate is not a finite number.
    """
    try:
        array = _array(values)
    except ValueError as error:
        raise _bad_vertex(where, "the coordinates are not pairs of numbers") from error
    if array.ndim != 2 or array.shape[1] < 2 or array.dtype.kind not in "iuf":
        raise _bad_vertex(where, "the coordinates are not pairs of numbers")
    vertices = np.full((len(array), 3), np.nan)
    vertices[:, : min(array.shape[1], 3)] = array[:, :3]
    vertices[~np.isfinite(vertices[:, 2]), 2] = np.nan
    check_vertices(vertices, where)
    return vertices


def check_vertices(vertices: Floats, where: str) -> None:
    """Raises InvalidParameter if a coordinate is not a plausible number; heights may be NaN."""
    usable = np.abs(vertices[:, :2]).max(axis=1, initial=0.0) <= MAX_COORDINATE
    bad = np.flatnonzero(~usable | (np.abs(vertices[:, 2]) > MAX_COORDINATE))
    if len(bad):
        raise _bad_vertex(where, f"vertex {int(bad[0]) + 1} is not finite")


def _array(values: Any) -> npt.NDArray[Any]:
    try:
        return np.asarray(values)
    except ValueError:  # some vertices have heights, others none
        return np.asarray([[*vertex, math.nan][:3] if isinstance(vertex, list) else vertex for vertex in values])


def read_ring(values: Any, where: str) -> Floats:
    """Closed ring of an area; raises InvalidParameter if it has fewer than three different vertices."""
    ring = read_vertices(values, where)
    if len(ring) and not np.array_equal(ring[0, :2], ring[-1, :2]):
        ring = np.concatenate([ring, ring[:1]])
    if len(ring) < 4:
        raise _bad_vertex(where, "the area has fewer than three vertices")
    return ring


def check_counts(features: int, vertices: int) -> None:
    """Raises UnreadableUpload if a file has too many features or vertices."""
    if features > _MAX_FEATURES or vertices > MAX_VERTICES:
        raise UnreadableUpload(
            f"the file has {features} features and {vertices} vertices",
            field="file",
            limit=f"{_MAX_FEATURES} features, {MAX_VERTICES} vertices",
            cure="cut the road into sections and plan each of them",
        )


def is_geographic(crs: str | None) -> bool:
    """Whether coordinates in a CRS are longitudes and latitudes; False for one that cannot be read."""
    try:
        return crs is not None and bool(CRS.from_user_input(crs).is_geographic)
    except CRSError:
        return False


def unit_of_crs_m(crs: str | None) -> float:
    """Length of the unit of a projected CRS; 1 for others. [m]"""
    try:
        system = CRS.from_user_input(crs) if crs is not None else None
    except CRSError:
        return 1.0
    return float(system.axis_info[0].unit_conversion_factor) if system is not None and system.is_projected else 1.0


def _bad_vertex(where: str, what: str) -> InvalidParameter:
    return InvalidParameter(
        f"{where}: {what}", field="file", limit="finite coordinates", cure="correct or remove the feature"
    )
