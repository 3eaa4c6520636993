"""The road that a plan is made for: its lanes in WGS 84, sampled at even steps, with events and areas to avoid."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pyproj import Geod

from app.errors import InvalidParameter
from app.formats.alignments.geometry import BoundaryStyle, EventKind, StationEquation
from app.formats.surveys.declaration import METRES
from app.geodesy import LocalizationGrade, check_lon_lat, grade_accuracy

# === What is declared of a file with a road, as for surveys: CRS, realization, epoch, heights, units, or an origin.


MAX_EPOCH = (1900.0, 2100.0)
"""Plausible coordinate epochs. [decimal year]"""


@dataclass(frozen=True, slots=True)
class AlignmentDeclaration:
    """What is declared of a file with a road.

    Attributes
    ----------
    crs : str, optional
        CRS of the coordinates; one that contradicts the file is an error.
    realization : str, optional
        Frame, e.g. ``ITRF2014``.
    epoch : float, optional
        Coordinate epoch. [decimal year]
    vertical_datum : str, optional
        ``ellipsoid``, or the datum of the heights, e.g. ``EPSG:5703``; needed where a file with a CRS has heights.
    unit, height_unit : str, optional
        ``m``, ``ft-us`` or ``ft-intl``; those of the file or of its CRS without.
    ignore_heights : bool
        Leave heights out.
    origin : tuple of two floats, optional
        Longitude and latitude of the origin of local coordinates. [deg]
    bearing_deg : float
        Direction of the local y axis, clockwise from true north; only with `origin`. [deg]

    Raises
    ------
    InvalidParameter
        A value is not allowed, or both a CRS and an origin are declared.
    """

    crs: str | None = None
    realization: str | None = None
    epoch: float | None = None
    vertical_datum: str | None = None
    unit: str | None = None
    height_unit: str | None = None
    ignore_heights: bool = False
    origin: tuple[float, float] | None = None
    bearing_deg: float = 0.0

    def __post_init__(self) -> None:
        for field, value in (("unit", self.unit), ("height_unit", self.height_unit)):
            if value not in (None, *METRES):
                raise InvalidParameter(
                    f"there is no unit {str(value)[:40]!r}",
                    field=field,
                    limit=", ".join(METRES),
                    cure="declare another",
                )
        if self.epoch is not None and not MAX_EPOCH[0] <= self.epoch <= MAX_EPOCH[1]:
            raise InvalidParameter(
                f"the epoch is {self.epoch}",
                field="epoch",
                limit=f"{MAX_EPOCH[0]:g} to {MAX_EPOCH[1]:g}",
                cure="declare the epoch as a decimal year, e.g. 2010.0",
            )
        if not math.isfinite(self.bearing_deg) or abs(self.bearing_deg) > 360:
            raise InvalidParameter(
                f"the bearing is {self.bearing_deg}",
                field="bearing_deg",
                limit="-360 to 360 deg",
                cure="declare another",
            )
        if self.origin is not None:
            check_lon_lat(*self.origin, field="origin")
        if self.origin is not None and self.crs is not None:
            raise InvalidParameter(
                "both a CRS and an origin are declared",
                field="origin",
                limit="one of the two",
                cure="declare crs for coordinates on Earth, origin for local ones",
            )
        if self.origin is None and self.bearing_deg:
            raise InvalidParameter(
                "a bearing is declared without an origin",
                field="bearing_deg",
                limit="only with origin",
                cure="declare the origin that the road is turned about",
            )


# === The road that a plan is made for.


Floats = npt.NDArray[np.float64]

STEP_M = 1.0
"""Greatest distance between samples of a lane. [m] The sagitta at 20 m radius is 6 mm."""
_GEOD = Geod(ellps="WGS84")


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """One lane in its direction of travel, sampled along its centre line.

    Attributes
    ----------
    name : str
        Unique in the alignment.
    road : str
    chainage_m : ndarray, shape (N,)
        True distance along the centre line from the lane's start, at even steps of at most 1 m, from 0. [m]
    lon_deg, lat_deg : ndarray, shape (N,)
        WGS 84. [deg]
    height_m : ndarray, shape (N,)
        Above the ellipsoid or the datum of the source; NaN where unknown. [m]
    heading_deg : ndarray, shape (N,)
        Direction of travel, clockwise from true north, 0 to 360. [deg]
    curvature_per_m : ndarray, shape (N,)
        Left positive. [1/m]
    grade : ndarray, shape (N,)
        Rise per distance, 0 where heights are unknown. [-]
    superelevation_rad : ndarray, shape (N,)
        Positive falls to the right. [rad]
    width_m : ndarray, shape (N,)
    design_speed_mps : ndarray, shape (N,)
    station_m : ndarray, shape (N,)
        True distance along the road's reference line; decreases in lanes of the opposite direction. [m]
    left_style, right_style : BoundaryStyle
        Paint of the boundaries.
    """

    name: str
    road: str
    chainage_m: Floats
    lon_deg: Floats
    lat_deg: Floats
    height_m: Floats
    heading_deg: Floats
    curvature_per_m: Floats
    grade: Floats
    superelevation_rad: Floats
    width_m: Floats
    design_speed_mps: Floats
    station_m: Floats
    left_style: BoundaryStyle = BoundaryStyle.UNKNOWN
    right_style: BoundaryStyle = BoundaryStyle.UNKNOWN

    @property
    def length_m(self) -> float:
        """Of the centre line. [m]"""
        return float(self.chainage_m[-1])

    @property
    def step_m(self) -> float:
        """Between samples. [m]"""
        return float(self.chainage_m[1])

    def value_at(self, values: Floats, chainage_m: npt.ArrayLike) -> Floats:
        """Values of one of the lane's arrays between its samples, linearly; not for longitudes and headings."""
        return np.asarray(np.interp(np.asarray(chainage_m, float), self.chainage_m, values))

    def heading_at(self, chainage_m: npt.ArrayLike) -> Floats:
        """Direction of travel, clockwise from true north, 0 to 360. [deg]"""
        unwrapped = np.unwrap(self.heading_deg, period=360.0)
        return np.asarray(self.value_at(unwrapped, chainage_m) % 360.0)

    def position_at(self, chainage_m: npt.ArrayLike, offset_m: npt.ArrayLike = 0.0) -> tuple[Floats, Floats]:
        """Longitudes and latitudes of places along and beside the centre line.

        Parameters
        ----------
        chainage_m : array_like, shape (K,)
            [m]
        offset_m : array_like, shape (K,) or ()
            Left positive, square to the direction of travel. [m]

        Returns
        -------
        lon_deg, lat_deg : ndarray, shape (K,)
        """
        chainage = np.atleast_1d(np.asarray(chainage_m, dtype=np.float64))
        offset = np.broadcast_to(np.asarray(offset_m, dtype=np.float64), chainage.shape)
        i = np.clip(np.searchsorted(self.chainage_m, chainage, side="right") - 1, 0, len(self.chainage_m) - 2)
        share = (chainage - self.chainage_m[i]) / (self.chainage_m[i + 1] - self.chainage_m[i])
        across = (self.lon_deg[i + 1] - self.lon_deg[i] + 180.0) % 360.0 - 180.0
        lon = self.lon_deg[i] + share * across
        lat = self.lat_deg[i] + share * (self.lat_deg[i + 1] - self.lat_deg[i])
        lon, lat, _ = _GEOD.fwd(lon, lat, self.heading_at(chainage) - 90.0, offset)
        return (np.asarray(lon) + 180.0) % 360.0 - 180.0, np.asarray(lat)


@dataclass(frozen=True, slots=True)
class RoadEvent:
    """Something on a lane that vehicles must know ahead of time.

    Attributes
    ----------
    kind : EventKind
    lane : str
    chainage_m : float
        Along the lane. [m]
    value : float, str or None
        Speed limit [km/h], direction of an arrow, or turn of a curve [deg, left positive].
    """

    kind: EventKind
    lane: str
    chainage_m: float
    value: float | str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class AvoidedArea:
    """An area in which nothing may be installed.

    Attributes
    ----------
    kind : str
    ring_deg : ndarray, shape (N, 2)
        Closed ring of longitudes and latitudes that do not jump: across the antimeridian they run beyond 180, and the
        area stands a second time, 360 degrees away. [deg]
    """

    kind: str
    ring_deg: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Lanes of a road, with what lies on them.

    Attributes
    ----------
    name : str
    lanes : tuple of Lane
    events : tuple of RoadEvent
        By lane and chainage; curves are found by `build_alignment`, the others come with the file.
    areas : tuple of AvoidedArea
    surveyed : bool
        Whether the file states coordinates on Earth; False where an origin placed a road of local coordinates.
    crs, vertical_datum
        As declared or stated by the file; the datum is None where heights are unknown.
    realization, epoch
        Of the lanes' positions.
    transform_accuracy_m : float or None
        Horizontal accuracy of the transformation, the realization and the epoch; None if it is unknown. [m]
    declared_realization : str or None
    start_station_m : float
        Displayed station of the start of the reference line. [m]
    station_equations : tuple of StationEquation
    warnings : tuple of str
    """

    name: str
    lanes: tuple[Lane, ...]
    events: tuple[RoadEvent, ...] = ()
    areas: tuple[AvoidedArea, ...] = ()
    surveyed: bool = True
    crs: str = "EPSG:4326"
    realization: str | None = None
    epoch: float | None = None
    vertical_datum: str | None = None
    transform_accuracy_m: float | None = 0.0
    declared_realization: str | None = None
    start_station_m: float = 0.0
    station_equations: tuple[StationEquation, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def grade(self) -> LocalizationGrade:
        """Best grade that positions along it can have."""
        return grade_accuracy(self.transform_accuracy_m)

    @property
    def lane_length_m(self) -> float:
        """Of all lanes together. [m]"""
        return sum(lane.length_m for lane in self.lanes)

    def lane(self, name: str) -> Lane:
        """A lane by its name; KeyError without it."""
        for lane in self.lanes:
            if lane.name == name:
                return lane
        raise KeyError(name)

    def displayed_station_m(self, station_m: float) -> float:
        """Station as signs and drawings show it, after the station equations. [m]"""
        number = bisect_right([equation.distance_m for equation in self.station_equations], station_m)
        if number == 0:
            return self.start_station_m + station_m
        last = self.station_equations[number - 1]
        return last.ahead_m + station_m - last.distance_m


def format_station(station_m: float) -> str:
    """A station as metric drawings write it, e.g. ``1+234.56``."""
    sign, value = ("-", -station_m) if station_m < 0 else ("", station_m)
    kilometre, rest = divmod(round(value, 2), 1000.0)
    return f"{sign}{int(kilometre)}+{rest:06.2f}"
