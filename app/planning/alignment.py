"""The road that a plan is made for: its lanes in WGS 84, sampled at even steps, with events and areas to avoid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from pyproj import Geod

from app.formats.alignments.geometry import BoundaryStyle, EventKind, Stationing
from app.geodesy import LocalizationGrade, grade_accuracy
from app.values import Floats

# === The road that a plan is made for.


STEP_M = 1.0
"""Greatest distance between samples of a lane. [m] The sagitta at 20 m radius is 6 mm."""
_GEOD = Geod(ellps="WGS84")


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """One lane in its direction of travel, sampled along its centre line."""

    name: str  # unique in the alignment
    road: str
    # shape (N,): [m] True distance along the centre line from the lane's start, at even steps of at most 1 m, from 0
    chainage_m: Floats
    # `lon_deg`, `lat_deg`: shape (N,): [deg] WGS 84
    lon_deg: Floats
    lat_deg: Floats
    height_m: Floats  # shape (N,): [m] above the ellipsoid or the datum of the source; NaN where unknown
    heading_deg: Floats  # shape (N,): [deg] direction of travel, clockwise from true north, 0 to 360
    curvature_per_m: Floats  # shape (N,): [1/m] left positive
    grade: Floats  # shape (N,): [-] rise per distance, 0 where heights are unknown
    superelevation_rad: Floats  # shape (N,): [rad] positive falls to the right
    width_m: Floats  # shape (N,)
    design_speed_m_s: Floats  # shape (N,)
    # shape (N,): [m] True distance along the road's reference line; decreases in lanes of the opposite direction
    station_m: Floats
    # `left_style`, `right_style`: paint of the boundaries
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
    """Something on a lane that vehicles must know ahead of time."""

    kind: EventKind
    lane: str
    chainage_m: float  # [m] along the lane
    # speed limit [km/h], direction of an arrow, or turn of a curve [deg, left positive]
    value: float | str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class AvoidedArea:
    """An area in which nothing may be installed."""

    kind: str
    # shape (N, 2): [deg] closed ring of longitudes and latitudes that do not jump: across the antimeridian they run
    # beyond 180, and the area stands a second time, 360 degrees away
    ring_deg: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Lanes of a road, with what lies on them."""

    name: str
    lanes: tuple[Lane, ...]
    # by lane and chainage; curves are found by `build_alignment`, the others come with the file
    events: tuple[RoadEvent, ...] = ()
    areas: tuple[AvoidedArea, ...] = ()
    # whether the file states coordinates on Earth; False where an origin placed a road of local coordinates
    surveyed: bool = True
    # `crs`, `vertical_datum`: as declared or stated by the file; the datum is None where heights are unknown
    crs: str = "EPSG:4326"
    # `realization`, `epoch`: of the lanes' positions
    realization: str | None = None
    epoch: float | None = None
    vertical_datum: str | None = None
    # [m] horizontal accuracy of the transformation, the realization and the epoch; None if it is unknown
    transform_accuracy_m: float | None = 0.0
    declared_realization: str | None = None
    stationing: Mapping[str, Stationing] = field(default_factory=dict)  # by road; without, true distances from 0
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

    def stations_at(self, lane: Lane, chainage_m: npt.ArrayLike) -> list[float]:
        """Stations of places on a lane, as signs and drawings show them. [m]"""
        displayed_m = self.stationing.get(lane.road, Stationing()).displayed_m
        return [displayed_m(at) for at in np.atleast_1d(lane.value_at(lane.station_m, chainage_m)).tolist()]


def format_station(station_m: float) -> str:
    """A station as metric drawings write it, e.g. ``1+234.56``."""
    sign, value = ("-", -station_m) if station_m < 0 else ("", station_m)
    kilometre, rest = divmod(round(value, 2), 1000.0)
    return f"{sign}{int(kilometre)}+{rest:06.2f}"
