"""How a plan is cut into strips for drawing: stretches of a lane that fit on paper with the road horizontal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from app.errors import InvalidParameter
from app.formats.alignments.geometry import Stationing
from app.geodesy.frames import ecef_from_wgs84, metres_per_radian
from app.planning.alignment import Alignment, Lane
from app.planning.plan import Plan
from app.values import Floats

Indices = npt.NDArray[np.intp]

SCALES = {250: 10.0, 500: 20.0, 1000: 50.0, 2000: 100.0, 5000: 200.0}
"""Denominators of the scales, and the stations that get a number. [m] Source: ISO 5455 without 1:250, which site plans
use; stations at about 40 mm."""
STRIP_MM = 360.0
"""Greatest length of a strip on paper; whole stations at each scale. [mm] Source: A3 without margins."""
ROW_MM = 52.0
"""Greatest height of a strip's road on paper. [mm] Source: three strips on A3."""
MAX_STRIPS = 3000
"""Strips of one plan at most. A thousand sheets."""
_WANTED_SHEETS = {250: 12, 500: 40, 1000: 120, 2000: 240}
"""A scale is taken up to this many sheets, else the next one. What a crew carries."""
_SHORTEST = 0.02  # of the greatest length, which a strip has at least
_LEVEL_M = 1e-6  # between stations that neither rise nor fall
_JUMP_M = 3.0  # between stations of neighbouring samples, which an equation makes; three steps
_STRIPS_A_SHEET = 3
_BESIDE_M = 30.0  # [m] from the reference lane, within which other lanes are in its strips; source: a carriageway


@dataclass(frozen=True, slots=True, eq=False)
class LanePiece:
    """Part of a lane in a strip, in millimetres on paper, shape (K, 2) each."""

    lane: Lane
    centre_mm: Floats
    left_mm: Floats
    right_mm: Floats


@dataclass(frozen=True, slots=True, eq=False)
class BesideLane:
    """A lane beside a reference, with its edges."""

    lane: Lane
    along_m: Floats  # shape (N,): [m] nearest `Reference.along_m` of each sample; NaN where too far
    edges_deg: tuple[tuple[Floats, Floats], ...]  # shape (N,) each: centre line, left and right edge

    @classmethod
    def of(cls, lane: Lane, along_m: Floats) -> BesideLane:
        """With the edges at half of the width."""
        edges = (lane.position_at(lane.chainage_m, share * lane.width_m) for share in (0.0, 0.5, -0.5))
        return cls(lane, along_m, tuple(edges))


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """A lane that strips are cut along, towards growing stations."""

    road: Alignment
    lane: Lane
    along_m: Floats  # shape (N,): [m] distance along the lane from its end of the lower station
    distance_m: Floats  # shape (N,): [m] True distance along the road's reference line
    # `lon_deg`, `lat_deg`: shape (N,): longitudes without jumps
    lon_deg: Floats
    lat_deg: Floats
    station_m: Floats  # shape (N,): [m] displayed stations, as on signs
    lanes: tuple[BesideLane, ...]  # itself first
    markers: Indices  # shape (M,): indices of the markers that its strips show, by `marker_along_m`
    marker_along_m: Floats  # shape (M,)

    def round_stations(self, step_m: float) -> tuple[Floats, Floats]:
        """`along_m` of the displayed stations that are multiples of a step, and these stations, shape (K,) each."""
        steps = np.diff(self.station_m)
        jumps = np.flatnonzero(np.abs(steps) > _JUMP_M) + 1
        rises = np.where(np.abs(steps) < _LEVEL_M, np.nan, np.sign(steps))
        last = np.maximum.accumulate(np.where(np.isfinite(rises), np.arange(len(steps)), 0))
        rises = np.nan_to_num(rises[last], nan=1.0)
        turns = np.flatnonzero(rises[1:] != rises[:-1]) + 1  # from rising to falling stations, or back
        places, stations = [np.zeros(0)], [np.zeros(0)]
        for run in np.split(np.arange(len(self.station_m)), np.union1d(jumps, turns)):
            sign = 1.0 if self.station_m[run[-1]] >= self.station_m[run[0]] else -1.0
            here = np.maximum.accumulate(sign * self.station_m[run])
            wanted = np.arange(np.ceil((here[0] - 1e-6) / step_m), np.floor((here[-1] + 1e-6) / step_m) + 1) * step_m
            places.append(np.interp(wanted, here, self.along_m[run]))
            stations.append(sign * wanted)
        return np.concatenate(places), np.concatenate(stations)

    def station_at(self, along_m: float) -> float:
        """Displayed station of a place. [m]"""
        return self.stationing.displayed_m(float(np.interp(along_m, self.along_m, self.distance_m)))

    @property
    def stationing(self) -> Stationing:
        """Stations of the lane's road."""
        return self.road.stationing.get(self.lane.road, Stationing())


@dataclass(frozen=True, slots=True, eq=False)
class Strip:
    """One stretch on paper; x to the right with growing stations, y up, from the middle of its row."""

    number: int  # from 1
    reference: Reference
    # `from_m`, `to_m`: [m] `Reference.along_m` of the match lines
    from_m: float
    to_m: float
    scale: int  # Denominator
    origin_deg: tuple[float, float]
    bearing_deg: float  # of the x axis, clockwise from true north
    shift_mm: tuple[float, float]  # of the origin on paper
    # `continued_left`, `continued_right`: whether the strip before or after it is along the same reference
    continued_left: bool
    continued_right: bool

    def to_paper(self, lon_deg: Floats, lat_deg: Floats) -> Floats:
        """Places on paper, shape (N, 2). [mm]"""
        local = _local_m(lon_deg, lat_deg, self.origin_deg) @ _turn(self.bearing_deg)
        return np.asarray(local * (1000.0 / self.scale) + self.shift_mm)

    def pieces(self) -> Iterator[LanePiece]:
        """Parts of all lanes between the match lines."""
        for beside in self.reference.lanes:
            lane, along = beside.lane, beside.along_m
            inside = np.flatnonzero((along >= self.from_m - lane.step_m) & (along <= self.to_m + lane.step_m))
            for run in np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1):
                if len(run) < 2:
                    continue
                yield LanePiece(lane, *(self.to_paper(lon[run], lat[run]) for lon, lat in beside.edges_deg))

    @property
    def stations_m(self) -> tuple[float, float]:
        """Displayed stations of the match lines. [m]"""
        return self.reference.station_at(self.from_m), self.reference.station_at(self.to_m)

    @property
    def markers(self) -> Indices:
        """Indices of the markers between the match lines."""
        along = self.reference.marker_along_m
        first = int(np.sum(along < self.from_m)) if self.continued_left else 0
        end = int(np.sum(along < self.to_m)) if self.continued_right else len(along)
        return self.reference.markers[first:end]


def cut_strips(plan: Plan, scale: int | None = None) -> tuple[Strip, ...]:
    """Strips of a whole plan.

    Parameters
    ----------
    scale : int, optional
        Denominator, one of `SCALES`; without, the largest scale of not too many sheets.

    Raises
    ------
    InvalidParameter
        There is no such scale, or it takes too many sheets.
    """
    if scale is not None and scale not in SCALES:
        raise InvalidParameter(
            f"there is no scale 1 : {scale}",
            field="scale",
            limit=", ".join(f"1 : {one}" for one in SCALES),
            cure="choose one of these",
        )
    references = list(find_references(plan))
    if scale is not None:
        return _cut(references, scale)
    for wanted, sheets in _WANTED_SHEETS.items():
        length_m = sum(float(reference.along_m[-1]) for reference in references)
        if length_m > 1.5 * sheets * _STRIPS_A_SHEET * STRIP_MM / 1000 * wanted:
            continue
        strips = _cut(references, wanted)
        if len(strips) <= sheets * _STRIPS_A_SHEET and all(_height_mm(strip) <= ROW_MM for strip in strips):
            return strips
    return _cut(references, max(SCALES))


def find_references(plan: Plan) -> Iterator[Reference]:
    """Lanes along which all markers can be shown, longest first; those with growing stations before the others."""
    road = plan.alignment
    if not plan.markers:
        return
    lon = np.array([marker.lon_deg for marker in plan.markers])
    lat = np.array([marker.lat_deg for marker in plan.markers])
    places = ecef_from_wgs84(lon, lat)
    remaining = np.ones(len(plan.markers), dtype=bool)
    own = {marker.lane for marker in plan.markers}
    lanes = [lane for lane in road.lanes if lane.name in own]
    for lane in sorted(lanes, key=lambda lane: (lane.station_m[-1] < lane.station_m[0], -lane.length_m)):
        names = np.flatnonzero(remaining)
        if not len(names):
            return
        tree = scipy.spatial.cKDTree(ecef_from_wgs84(lane.lon_deg, lane.lat_deg))
        far, index = tree.query(places[names], distance_upper_bound=_BESIDE_M)
        mine, nearest = np.isfinite(far), np.asarray(index)
        if not any(plan.markers[k].lane == lane.name for k in names[mine]):
            continue
        remaining[names[mine]] = False
        yield _reference(road, lane, tree, names[mine], nearest[mine])


def _reference(
    road: Alignment,
    lane: Lane,
    tree: scipy.spatial.cKDTree,
    markers: Indices,
    nearest: Indices,
) -> Reference:
    falls = bool(lane.station_m[-1] < lane.station_m[0])
    along = lane.length_m - lane.chainage_m if falls else lane.chainage_m
    beside = [BesideLane.of(lane, along)]
    for other in road.lanes:
        if other is lane or not _near(other, lane):
            continue
        far, index = tree.query(ecef_from_wgs84(other.lon_deg, other.lat_deg), distance_upper_bound=_BESIDE_M)
        known = np.isfinite(far)
        if known.any():
            nearest_m = np.where(known, along[np.minimum(index, len(along) - 1)], np.nan)
            beside.append(BesideLane.of(other, nearest_m))
    order = np.argsort(along[nearest], kind="stable")
    way = slice(None, None, -1) if falls else slice(None)
    displayed = np.array(road.stations_at(lane, lane.chainage_m[way]))
    lon = np.unwrap(lane.lon_deg[way], period=360.0)
    return Reference(
        road, lane, np.ascontiguousarray(along[way]), np.ascontiguousarray(lane.station_m[way]), lon,
        np.ascontiguousarray(lane.lat_deg[way]), displayed, tuple(beside), markers[order], along[nearest][order],
    )  # fmt: skip


def _near(one: Lane, other: Lane) -> bool:
    """Whether the boxes of two lanes are nearer than the distance within which they share strips."""
    margin = _BESIDE_M / 60_000  # [deg], less than a degree's length at any latitude of roads
    return bool(
        one.lon_deg.min() <= other.lon_deg.max() + margin
        and one.lon_deg.max() >= other.lon_deg.min() - margin
        and one.lat_deg.min() <= other.lat_deg.max() + margin
        and one.lat_deg.max() >= other.lat_deg.min() - margin
    )


# --- cutting --------------------------------------------------------------------------------------------------------


def _cut(references: Sequence[Reference], scale: int) -> tuple[Strip, ...]:
    strips: list[Strip] = []
    for reference in references:
        stretches = list(_stretches(reference, scale))
        for k, (start, end) in enumerate(stretches):
            if len(strips) >= MAX_STRIPS:
                raise InvalidParameter(
                    f"the drawings at 1 : {scale} have more than {MAX_STRIPS} strips",
                    field="scale",
                    limit=f"{MAX_STRIPS} strips, three on a sheet",
                    cure="choose a smaller scale, or plan the road in sections",
                )
            strips.append(_strip(len(strips) + 1, reference, start, end, scale, (k > 0, k < len(stretches) - 1)))
    return tuple(strips)


def _stretches(reference: Reference, scale: int) -> Iterator[tuple[float, float]]:
    """From and to of strips that end on numbered stations and fit their row, from the first marker to the last."""
    longest, step = STRIP_MM / 1000 * scale, SCALES[scale] / 2
    stops, _ = reference.round_stations(step)
    start, last = 0.0, float(reference.along_m[-1])
    while start < last - 1e-6:
        if last - start <= longest * 1.02 and _fits(reference, start, last, scale):
            end = last
        else:
            inside = (stops > start + _SHORTEST * longest) & (stops <= start + longest + 1e-6)
            end = _longest_end(reference, start, stops[inside], min(start + longest / 2, last), scale)
        yield start, end
        start = end


def _longest_end(reference: Reference, start: float, stops: Floats, without: float, scale: int) -> float:
    """The last of the stops up to which the stretch fits; the first one if none fits, `without` if there are none."""
    if not len(stops):
        return without
    low, high = 0, len(stops) - 1
    if _fits(reference, start, float(stops[high]), scale):
        return float(stops[high])
    while low < high - 1:
        middle = (low + high) // 2
        if _fits(reference, start, float(stops[middle]), scale):
            low = middle
        else:
            high = middle
    return float(stops[low])


def _fits(reference: Reference, start: float, end: float, scale: int) -> bool:
    return _height_mm(_strip(0, reference, start, end, scale, (True, True))) <= ROW_MM


def _height_mm(strip: Strip) -> float:
    edges = [edge[:, 1] for piece in strip.pieces() for edge in (piece.left_mm, piece.right_mm)]
    return float(np.ptp(np.concatenate(edges))) if edges else 0.0


def _strip(
    number: int, reference: Reference, start: float, end: float, scale: int, continued: tuple[bool, bool]
) -> Strip:
    """A strip with the chord of its stretch along x, in the middle of its row."""
    along = reference.along_m
    lon = np.interp([start, (start + end) / 2, end], along, reference.lon_deg)
    lat = np.interp([start, (start + end) / 2, end], along, reference.lat_deg)
    origin = float(lon[1]), float(lat[1])
    ends = _local_m(lon, lat, origin)
    chord = ends[2] - ends[0]
    bearing = float(np.degrees(np.arctan2(chord[0], chord[1]))) % 360.0
    strip = Strip(number, reference, start, end, scale, origin, bearing, (0.0, 0.0), *continued)
    points = [np.concatenate([p.left_mm, p.right_mm]) for p in strip.pieces()] or [np.zeros((1, 2))]
    low, high = np.concatenate(points).min(axis=0), np.concatenate(points).max(axis=0)
    shift = float(-(low[0] + high[0]) / 2), float(-(low[1] + high[1]) / 2)
    return Strip(number, reference, start, end, scale, origin, bearing, shift, *continued)


def _local_m(lon_deg: Floats, lat_deg: Floats, origin_deg: tuple[float, float]) -> Floats:
    """East and north of an origin, shape (N, 2). [m]"""
    east_m, north_m = metres_per_radian(np.radians(np.array(origin_deg[1])))
    east = np.radians((np.asarray(lon_deg) - origin_deg[0] + 180.0) % 360.0 - 180.0) * east_m
    return np.stack([east, np.radians(np.asarray(lat_deg) - origin_deg[1]) * north_m], axis=-1)


def _turn(bearing_deg: float) -> Floats:
    """Matrix that takes row vectors of east, north to along, left of a bearing."""
    cos, sin = np.cos(np.radians(bearing_deg)), np.sin(np.radians(bearing_deg))
    return np.array([[sin, -cos], [cos, sin]])
