"""What a file with a road contains, in the coordinates of the file: lines, events and areas.

Every reader returns an `AlignmentFile`. `app.planning.build_alignment` turns it into lanes in WGS 84.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

MAX_VERTICES = 2_000_000
"""Vertices of all lines of a file at most. Source: chosen by hand, 1,000 km at 0.5 m."""
CHORD_ERROR_M = 0.001
"""Greatest distance of arcs, spirals and polynomials from the chords that they are sampled by. [m] Source: chosen by
hand, a tenth of the best survey's accuracy."""

MAX_COORDINATE = 1e12
"""Largest coordinate or height. Source: app/formats/surveys/json_reader.py, far beyond every projection."""


class BoundaryStyle(StrEnum):
    """How a boundary of a lane is painted."""

    SOLID = "solid"
    DASHED = "dashed"
    NONE = "none"
    UNKNOWN = "unknown"


class EventKind(StrEnum):
    """Events on the road of which a vehicle is informed in advance."""

    STOP_LINE = "stop_line"
    JUNCTION = "junction"
    CROSSING = "crossing"
    ARROW = "arrow"
    SPEED_LIMIT = "speed_limit"
    CURVE = "curve"


@dataclass(frozen=True, slots=True, eq=False)
class LaneGeometry:
    """One lane in its direction of travel, by its centre line or by both boundaries.

    Arrays of values belong to the vertices of `centre`, or of `left` where there is no centre line.

    Attributes
    ----------
    name : str
        Unique in the file.
    centre, left, right : ndarray, shape (N, 3), or None
        Longitude, latitude [deg] or easting, northing [unit of the file], and height; height is NaN where the file has
        none. Either `centre` or both `left` and `right` are given. Curves are sampled within 1 mm.
    curvature_per_m : ndarray, shape (N,), or None
        Left positive, where the file defines it (arcs, spirals, polynomials). Where it jumps, the vertex stands twice,
        with the value before and the value after. [1/m]
    superelevation_rad : ndarray, shape (N,), or None
        Positive falls to the right in the direction of travel. [rad]
    width_m : ndarray, shape (N,), or None
        [m]
    speed_limit_mps : ndarray, shape (N,), or None
        NaN where none is given. [m/s]
    station_m : ndarray, shape (N,), or None
        Along the road's reference line, in its direction; decreases along a lane of the opposite direction. [m]
    left_style, right_style : BoundaryStyle
    road : str or None
        Name of the road in the file.
    """

    name: str
    centre: Floats | None = None
    left: Floats | None = None
    right: Floats | None = None
    curvature_per_m: Floats | None = None
    superelevation_rad: Floats | None = None
    width_m: Floats | None = None
    speed_limit_mps: Floats | None = None
    station_m: Floats | None = None
    left_style: BoundaryStyle = BoundaryStyle.UNKNOWN
    right_style: BoundaryStyle = BoundaryStyle.UNKNOWN
    road: str | None = None


@dataclass(frozen=True, slots=True)
class EventGeometry:
    """Something on the road that decides what vehicles must know.

    Attributes
    ----------
    kind : EventKind
    point : tuple of float
        In the coordinates of the file.
    lane : str or None
        Name of the lane; None: the nearest one.
    value : float, str or None
        Speed limit [km/h], direction of an arrow (`app.markers.magnet_codebook.Arrow`); None for the others.
    """

    kind: EventKind
    point: tuple[float, float]
    lane: str | None = None
    value: float | str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class AreaGeometry:
    """An area in which nothing may be installed: joint, manhole, crossing, bridge.

    Attributes
    ----------
    kind : str
    ring : ndarray, shape (N, 2)
        Closed outer ring in the coordinates of the file.
    """

    kind: str
    ring: Floats


@dataclass(frozen=True, slots=True)
class StationEquation:
    """Where the displayed station jumps; the geometry stays in true distance.

    Attributes
    ----------
    distance_m : float
        True distance from the start of the reference line. [m]
    back_m, ahead_m : float
        Displayed stations before and after. [m]
    """

    distance_m: float
    back_m: float
    ahead_m: float


@dataclass(frozen=True, slots=True)
class EarlierTransformation:
    """Coordinates that were transformed into the file's CRS before.

    Attributes
    ----------
    exact : bool
        Whether a transformation with a stated accuracy did it; otherwise positions are unfit for localization.
    note : str or None
        How, for people.
    accuracy_m : float or None
        Its accuracy; None in documents that were written without it. [m]
    """

    exact: bool
    note: str | None
    accuracy_m: float | None = None


@dataclass(frozen=True, slots=True)
class AlignmentFile:
    """Content of a file with a road.

    Attributes
    ----------
    format : str
        Name of the format, as in `app.formats.alignments.formats`.
    lanes : tuple of LaneGeometry
    crs : str or None
        As the file states it: ``EPSG:code``, WKT or a PROJ string; None if it states none that places it on Earth.
    crs_problem : str or None
        Why the stated reference cannot be used, for people; with it, `crs` is None.
    unit_m : float or None
        Length of the file's unit of easting, northing and height; None: the unit of its CRS, or metres without one. [m]
    events, areas : tuple
    station_equations : tuple of StationEquation
    start_station_m : float
        Displayed station of the start of the reference line. [m]
    warnings : tuple of str
        What was left out or repaired, in sentences for people.
    earlier : EarlierTransformation or None
        Of all coordinates, before they came into the file.
    """

    format: str
    lanes: tuple[LaneGeometry, ...]
    crs: str | None = None
    crs_problem: str | None = None
    unit_m: float | None = 1.0
    events: tuple[EventGeometry, ...] = ()
    areas: tuple[AreaGeometry, ...] = ()
    station_equations: tuple[StationEquation, ...] = ()
    start_station_m: float = 0.0
    warnings: tuple[str, ...] = ()
    earlier: EarlierTransformation | None = None
