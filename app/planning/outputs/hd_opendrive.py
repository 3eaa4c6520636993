"""HD map -> ASAM OpenDRIVE 1.7: each lane as a road along its centre line, each marker as an object and a signal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy
from pyproj import Proj

from app.errors import InvalidParameter
from app.formats.alignments.geometry import BoundaryStyle
from app.planning.alignment import Lane
from app.planning.outputs.hd_map import HdMap, MapMarker, attribute, number, refine_breaks
from app.values import Floats

# === A lane's centre line as cubic curves, with profiles along it: what OpenDRIVE calls a road's reference line.


CURVE_ERROR_M = 0.002
"""Greatest distance of the curves from the lane's samples, and of heights and widths from theirs. [m] A fifth of the
centimetre that maps may be off."""
_TILT_ERROR_RAD = 0.0002  # [rad] of superelevation; source: 2 mm at 10 m beside the line
_ROUNDS = 12  # of Newton's method; source: converges to a nanometre in 5 from a sample half a metre away
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(7)


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """Cubic polynomials along a line, each in the distance from its start."""

    s: Floats  # shape (P,): [m] starts
    coefficients: Floats  # shape (P, 4): a, b, c, d of a + b x + c x^2 + d x^3

    def at(self, s: Floats) -> Floats:
        """Values at distances, shape (K,)."""
        piece = np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 1)
        a, b, c, d = self.coefficients[piece].T
        x = s - self.s[piece]
        return np.asarray(a + x * (b + x * (c + x * d)))


class Foot(NamedTuple):
    """Points by the line: s, t (left positive), what s and t leave of the distance [m], and the line's direction."""

    s: Floats
    t: Floats
    residual_m: Floats
    heading_rad: Floats


class ReferenceLine:
    """The centre line of a lane in a plane.

    Attributes
    ----------
    lane : Lane
    xy : ndarray, shape (N, 2)
        The lane's samples. [m]
    breaks : ndarray of int, shape (P + 1,)
        Samples at which the curves begin and end.
    start_xy, start_heading, start_s, lengths : ndarray, shape (P, 2), (P,), (P,), (P,)
        Of the curves; headings counter-clockwise from x. [m, rad, m, m]
    local : ndarray, shape (P, 3, 2)
        Coefficients b, c, d of each curve in its own frame, p from 0 to 1; b has no v.
    width, elevation, superelevation : Profile or None
        None where heights are unknown, and where the road is nowhere tilted.
    """

    def __init__(self, lane: Lane, x: Floats, y: Floats) -> None:
        self.lane = lane
        self.xy = np.column_stack([x, y])
        chainage = lane.chainage_m
        self._slope = np.asarray(scipy.interpolate.CubicSpline(chainage, self.xy)(chainage, 1))
        whole = np.array([0, len(chainage) - 1])
        self.breaks = refine_breaks(whole, self._error, CURVE_ERROR_M)
        self._b, self._c, self._d = _hermite(chainage, self.xy, self._slope, self.breaks)
        self.start_xy = self.xy[self.breaks[:-1]]
        self.start_heading = np.arctan2(self._b[:, 1], self._b[:, 0])
        cos, sin = np.cos(self.start_heading), np.sin(self.start_heading)
        turn = np.stack([np.stack([cos, sin], 1), np.stack([-sin, cos], 1)], 1)
        self.local = np.einsum("pij,pkj->pki", turn, np.stack([self._b, self._c, self._d], 1))
        p = ((_NODES + 1) / 2)[:, None]
        tangent = self._b[:, None] + p * (2 * self._c[:, None] + 3 * p * self._d[:, None])
        self.lengths = np.asarray(np.linalg.norm(tangent, axis=2) @ _WEIGHTS / 2)
        ends = np.concatenate([[0.0], np.cumsum(self.lengths)])
        self.start_s, self.length = ends[:-1], float(ends[-1])
        s = np.interp(chainage, chainage[self.breaks], ends)
        self._s = s
        self.width = _profile(s, lane.width_m, CURVE_ERROR_M)
        known = bool(np.isfinite(lane.height_m).all())
        self.elevation = _profile(s, lane.height_m, CURVE_ERROR_M) if known else None
        tilted = bool(np.any(lane.superelevation_rad != 0))
        self.superelevation = _profile(s, lane.superelevation_rad, _TILT_ERROR_RAD) if tilted else None

    @property
    def ends(self) -> tuple[Floats, Floats]:
        """Start and end with their heights, 0 where unknown, each of shape (3,). [m]"""
        points = np.column_stack([self.xy, np.nan_to_num(self.lane.height_m)])
        return points[0], points[-1]

    def speeds_kmh(self) -> list[tuple[float, float]]:
        """s from which a design speed holds, and the speed; none where a part of the lane has none. [m, km/h]"""
        if not np.isfinite(self.lane.design_speed_m_s).all():
            return []  # a speed of OpenDRIVE holds until the next one
        speed = np.round(self.lane.design_speed_m_s * 3.6)
        first = np.flatnonzero(np.concatenate([[True], np.diff(speed) != 0]))
        return list(zip(self._s[first].tolist(), speed[first].tolist(), strict=True))

    def project(self, points_m: Floats, chainage_m: Floats) -> Foot:
        """Points beside the line, from the chainages of samples near them.

        Parameters
        ----------
        points_m : ndarray, shape (K, 2)
        chainage_m : ndarray, shape (K,)
        """
        starts = self.lane.chainage_m[self.breaks]
        chainage = np.array(chainage_m)
        for _ in range(_ROUNDS):
            piece, p = self._piece(starts, chainage)
            away, first, second = self._away(points_m, piece, p)
            slope = np.einsum("ij,ij->i", first, first) + np.einsum("ij,ij->i", away, second)
            step = np.einsum("ij,ij->i", away, first) / np.where(slope > 0, slope, np.inf)
            chainage = np.clip(chainage - step * np.diff(starts)[piece], starts[0], starts[-1])
        piece, p = self._piece(starts, chainage)
        away, first, _second = self._away(points_m, piece, p)
        tangent = first / np.linalg.norm(first, axis=1)[:, None]
        t = tangent[:, 1] * away[:, 0] - tangent[:, 0] * away[:, 1]
        residual = np.abs(np.einsum("ij,ij->i", away, tangent))
        s = self.start_s[piece] + p * self.lengths[piece]
        return Foot(s, t, residual, np.arctan2(tangent[:, 1], tangent[:, 0]))

    def _piece(self, starts: Floats, chainage_m: Floats) -> tuple[npt.NDArray[np.intp], Floats]:
        piece = np.clip(np.searchsorted(starts, chainage_m, side="right") - 1, 0, len(starts) - 2)
        return piece, (chainage_m - starts[piece]) / np.diff(starts)[piece]

    def _away(self, points_m: Floats, piece: npt.NDArray[np.intp], p: Floats) -> tuple[Floats, Floats, Floats]:
        """From points to the curves, and the curves' derivatives, each of shape (K, 2)."""
        b, c, d, q = self._b[piece], self._c[piece], self._d[piece], p[:, None]
        on_curve = self.start_xy[piece] + q * (b + q * (c + q * d))
        return on_curve - points_m, b + q * (2 * c + 3 * q * d), 2 * c + 6 * q * d

    def _error(self, breaks: npt.NDArray[np.intp]) -> Floats:
        return np.asarray(np.linalg.norm(_hermite_error(self.lane.chainage_m, self.xy, self._slope, breaks), axis=1))


def _profile(s: Floats, values: Floats, limit: float) -> Profile:
    """Values at distances as cubic polynomials, within a limit at each of them."""
    column = values[:, None]
    slope = np.gradient(values, s)[:, None] if len(s) > 1 else np.zeros((1, 1))

    def error_of(breaks: npt.NDArray[np.intp]) -> Floats:
        return np.abs(_hermite_error(s, column, slope, breaks)[:, 0])

    breaks = refine_breaks(np.array([0, len(s) - 1]), error_of, limit)
    b, c, d = _hermite(s, column, slope, breaks)
    h = np.diff(s[breaks])[:, None]
    return Profile(s[breaks[:-1]], np.hstack([column[breaks[:-1]], b / h, c / h**2, d / h**3]))


def _hermite(at: Floats, values: Floats, slopes: Floats, breaks: npt.NDArray[np.intp]) -> tuple[Floats, Floats, Floats]:
    """Coefficients b, c, d of the cubic curves between breaks in p from 0 to 1, each of shape (P, columns)."""
    h = np.diff(at[breaks])[:, None]
    rise = np.diff(values[breaks], axis=0)
    first, last = h * slopes[breaks[:-1]], h * slopes[breaks[1:]]
    return first, 3 * rise - 2 * first - last, first + last - 2 * rise


def _hermite_error(at: Floats, values: Floats, slopes: Floats, breaks: npt.NDArray[np.intp]) -> Floats:
    """Cubic curves between breaks minus the values at all samples, shape (N, columns)."""
    b, c, d = _hermite(at, values, slopes, breaks)
    piece = np.clip(np.searchsorted(breaks, np.arange(len(at)), side="right") - 1, 0, len(breaks) - 2)
    p = ((at - at[breaks[piece]]) / np.diff(at[breaks])[piece])[:, None]
    return np.asarray(values[breaks[piece]] + p * (b[piece] + p * (c[piece] + p * d[piece])) - values)


# === HD map -> ASAM OpenDRIVE 1.7.


MAX_BESIDE_M = 100.0
"""Greatest distance of a marker from the nearest lane. [m] Wider than a motorway."""
_MISPLACED_M = 0.01  # [m] between a marker and its place by s and t; source: the error that maps may have
_SAME_END_M = 0.05  # [m] between the end of a lane and the start of its successor
_MARKS = {
    BoundaryStyle.SOLID: "solid",
    BoundaryStyle.DASHED: "broken",
    BoundaryStyle.NONE: "none",
    BoundaryStyle.UNKNOWN: "none",
}


def write_opendrive(content: HdMap, *, leave_out: bool = False) -> bytes:
    """An OpenDRIVE map; see `OpenDriveMap`."""
    return OpenDriveMap(content, leave_out=leave_out).write()


class OpenDriveMap:
    """An OpenDRIVE map whose markers have their places on roads.

    Parameters
    ----------
    content : HdMap
        With at least one lane.
    leave_out : bool
        Leave out markers that lie beside no lane, and name them in the file, instead of refusing them.

    Raises
    ------
    InvalidParameter
        There are no lanes, or a marker lies beside none of them.

    Notes
    -----
    - Coordinates are of a transverse Mercator projection around the lanes, with scale 1 in its middle and no offset.
    - A road has one lane, -1, in its direction. Its reference line is the lane's centre line as cubic curves
      (paramPoly3), within 2 mm of the samples; the lane offset is half the width. Elevation, superelevation, width,
      speed and road marks follow. Roads that continue one another are linked where they do not branch.
    - Each marker is an object ``roadMark`` with its family as subtype, and a signal with its family as type, because
      CARLA keeps only signals. Family, code and id are the user data of the object; the signal has the code as text and
      the id as name. Its country ``OpenDRIVE`` says that types are of no country's catalogue.
    - zOffset is the height above the reference line (XSD of 1.7), 0 where the height is unknown.
    - The header names the markers that are left out as user data ``left_out``, separated by spaces.
    """

    def __init__(self, content: HdMap, *, leave_out: bool = False) -> None:
        if not content.lanes:
            raise InvalidParameter(
                "an OpenDRIVE map without lanes",
                field="lanes",
                limit="at least one, because objects and signals belong to roads",
                cure="choose a road, or write a lanelet2 map",
            )
        self._content = content
        projection, self._georeference = _projection(content.lanes)
        self._lines = [ReferenceLine(lane, *projection(lane.lon_deg, lane.lat_deg)) for lane in content.lanes]
        self._placed, missing = _place(content.markers, self._lines, projection)
        self._left_out = [content.markers[k].id for k in missing]
        if missing and not leave_out:
            marker = content.markers[missing[0]]
            raise InvalidParameter(
                f"marker {marker.id} at {marker.lon_deg:.6f}, {marker.lat_deg:.6f} lies beside no lane of the map",
                field="markers",
                limit=f"within {MAX_BESIDE_M:g} m, square to a lane between its ends",
                cure="leave the marker out, or add its road",
            )

    def write(self) -> bytes:
        """An ``.xodr`` file, valid by ASAM's schema of version 1.7."""
        content, lines = self._content, self._lines
        links = _links(lines)
        xy = np.concatenate([line.xy for line in lines])
        (west, south), (east, north) = xy.min(axis=0).tolist(), xy.max(axis=0).tolist()
        more = f'<userData code="vertical_datum" value={attribute(content.vertical_datum or "unknown")}/>'
        if self._left_out:
            more += f'<userData code="left_out" value={attribute(" ".join(self._left_out))}/>'
        parts = [
            '<?xml version="1.0" encoding="UTF-8"?>',
            "<OpenDRIVE>",
            f'<header revMajor="1" revMinor="7" name={attribute(content.name)} version="1.00" vendor="Waymark"'
            f' north="{number(north)}" south="{number(south)}" east="{number(east)}" west="{number(west)}">'
            f"<geoReference><![CDATA[{self._georeference}]]></geoReference>{more}</header>",
        ]
        for k, line in enumerate(lines):
            parts += _road(k, line, links, self._placed.get(k, []), "town" if content.urban else "rural")
        return "\n".join([*parts, "</OpenDRIVE>\n"]).encode()


def _projection(lanes: Sequence[Lane]) -> tuple[Proj, str]:
    """A transverse Mercator projection around lanes, and how the file states it."""
    lon = np.concatenate([lane.lon_deg for lane in lanes])
    lat = np.concatenate([lane.lat_deg for lane in lanes])
    east = (lon - lon[0] + 180.0) % 360.0 - 180.0
    middle = (lon[0] + (east.min() + east.max()) / 2 + 180.0) % 360.0 - 180.0
    text = (
        f"+proj=tmerc +lat_0={(lat.min() + lat.max()) / 2:.6f} +lon_0={middle:.6f} +k=1 +x_0=0 +y_0=0 +datum=WGS84 "
        "+units=m +vunits=m +no_defs"
    )
    return Proj(text), text


def _links(lines: Sequence[ReferenceLine]) -> list[tuple[int | None, int | None]]:
    """Number of the road before and after each road, None where there is none or more than one."""
    starts = np.array([line.ends[0] for line in lines])
    ends = np.array([line.ends[1] for line in lines])
    after = [tuple(found) for found in scipy.spatial.cKDTree(starts).query_ball_point(ends, _SAME_END_M)]
    before = [tuple(found) for found in scipy.spatial.cKDTree(ends).query_ball_point(starts, _SAME_END_M)]
    return [
        (
            before[k][0] if len(before[k]) == 1 and len(after[before[k][0]]) == 1 else None,
            after[k][0] if len(after[k]) == 1 and len(before[after[k][0]]) == 1 else None,
        )
        for k in range(len(lines))
    ]


# --- markers --------------------------------------------------------------------------------------------------------


class _Placed(NamedTuple):
    """A marker on a road; `number` is that of the object and the signal in the file."""

    number: int
    marker: MapMarker
    s: float
    t: float
    z_offset: float
    heading_rad: float


class _Place(NamedTuple):
    """Where a marker lies along and beside road `k`, and how high the road is there."""

    k: int
    s: float
    t: float
    heading_rad: float
    ground_m: float


class _Feet(NamedTuple):
    """Where markers lie along and beside one road, and how high it is there; arrays of shape (K,)."""

    s: Floats
    t: Floats
    heading_rad: Floats
    ground_m: Floats
    is_beside: npt.NDArray[np.bool_]


def _place(
    markers: Sequence[MapMarker], lines: Sequence[ReferenceLine], projection: Proj
) -> tuple[dict[int, list[_Placed]], list[int]]:
    """Markers by the number of the nearest road beside which they lie, by s; and those that lie beside none."""
    if not markers:
        return {}, []
    lon, lat = np.array([(marker.lon_deg, marker.lat_deg) for marker in markers]).T
    xy = np.column_stack(projection(lon, lat))
    convergence = np.asarray(projection.get_factors(lon, lat).meridian_convergence)
    road, sample = _nearest(markers, lines, xy)
    places: dict[int, _Place] = {}
    for k in np.unique(road).tolist():
        own = np.flatnonzero(road == k)
        _add_places(places, k, own, _feet(lines[k], xy[own], sample[own]))
    rest = np.array([i for i in range(len(markers)) if i not in places], dtype=np.intp)
    if len(rest):  # beyond the end of the nearest road they may lie beside another one
        for k, line in enumerate(lines):
            _add_places(
                places, k, rest, _feet(line, xy[rest], np.asarray(scipy.spatial.cKDTree(line.xy).query(xy[rest])[1]))
            )
    placed: dict[int, list[_Placed]] = {}
    for i, (k, s, t, direction, ground_m) in sorted(places.items(), key=lambda item: item[1][:2]):
        marker = markers[i]
        z_offset = 0.0 if marker.height_m is None else marker.height_m - ground_m
        turn = _turn(marker.heading_deg, float(convergence[i]), direction)
        placed.setdefault(k, []).append(_Placed(i + 1, marker, s, t, z_offset, turn))
    return placed, [i for i in range(len(markers)) if i not in places]


def _feet(line: ReferenceLine, xy: Floats, sample: npt.NDArray[np.intp]) -> _Feet:
    foot = line.project(xy, line.lane.chainage_m[sample])
    is_beside = (foot.residual_m <= _MISPLACED_M) & (np.abs(foot.t) <= MAX_BESIDE_M)
    ground_m = line.elevation.at(foot.s) if line.elevation else np.zeros(len(xy))
    return _Feet(foot.s, foot.t, foot.heading_rad, ground_m, is_beside)


def _add_places(places: dict[int, _Place], k: int, own: npt.NDArray[np.intp], feet: _Feet) -> None:
    """Keep the place of each marker beside road `k`, unless it lies nearer to another road."""
    columns = (feet.s, feet.t, feet.heading_rad, feet.ground_m)
    rows = zip(own.tolist(), feet.is_beside.tolist(), *(column.tolist() for column in columns), strict=True)
    for i, is_beside, s, t, direction, ground_m in rows:
        if is_beside and (i not in places or abs(t) < abs(places[i].t)):
            places[i] = _Place(k, s, t, direction, ground_m)


def _nearest(
    markers: Sequence[MapMarker], lines: Sequence[ReferenceLine], xy: Floats
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Number of the nearest road, and of its nearest sample; by height too where all heights are known."""
    height = np.array([np.nan if marker.height_m is None else marker.height_m for marker in markers])
    points = [np.column_stack([line.xy, line.lane.height_m]) for line in lines]
    road = np.repeat(np.arange(len(lines)), [len(own) for own in points])
    sample = np.concatenate([np.arange(len(own)) for own in points])
    every = np.concatenate(points)
    if np.isfinite(height).all() and np.isfinite(every).all():
        xy = np.column_stack([xy, height])
    _, found = scipy.spatial.cKDTree(every[:, : xy.shape[1]]).query(xy)
    return road[found], sample[found]


def _turn(heading_deg: float | None, convergence_deg: float, direction_rad: float) -> float:
    """From the reference line's direction to a heading, counter-clockwise, -pi to pi. [rad]"""
    if heading_deg is None:
        return 0.0
    angle = np.radians(90.0 - heading_deg + convergence_deg) - direction_rad
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


# --- XML ------------------------------------------------------------------------------------------------------------


def _road(
    k: int,
    line: ReferenceLine,
    links: Sequence[tuple[int | None, int | None]],
    placed: Sequence[_Placed],
    kind: str,
) -> list[str]:
    before, after = links[k]
    link = ""
    lane_link = ""
    for name, other, contact in (("predecessor", before, "end"), ("successor", after, "start")):
        if other is not None:
            link += f'<{name} elementType="road" elementId="{other + 1}" contactPoint="{contact}"/>'
            lane_link += f'<{name} id="-1"/>'
    return [
        f'<road name={attribute(line.lane.name)} length="{number(line.length)}" id="{k + 1}" junction="-1" rule="RHT">',
        f"<link>{link}</link>",
        f'<type s="0" type="{kind}"/>',
        *_plan_view(line),
        *_profiles(line),
        *_lanes(line, lane_link),
        *(["<objects>", *map(_object, placed), "</objects>"] if placed else []),
        *(["<signals>", *map(_signal, placed), "</signals>"] if placed else []),
        "</road>",
    ]


def _plan_view(line: ReferenceLine) -> list[str]:
    rows = zip(
        line.start_s.tolist(), line.lengths.tolist(), line.start_xy.tolist(), line.start_heading.tolist(),
        line.local.tolist(), strict=True,
    )  # fmt: skip
    geometry = [
        f'<geometry s="{number(s)}" x="{number(x)}" y="{number(y)}" hdg="{number(heading)}" length="{number(length)}">'
        f'<paramPoly3 aU="0" bU="{number(b[0])}" cU="{number(c[0])}" dU="{number(d[0])}"'
        f' aV="0" bV="0" cV="{number(c[1])}" dV="{number(d[1])}" pRange="normalized"/></geometry>'
        for s, length, (x, y), heading, (b, c, d) in rows
    ]
    return ["<planView>", *geometry, "</planView>"]


def _profiles(line: ReferenceLine) -> list[str]:
    elevation = _rows("elevation", "s", line.elevation) if line.elevation else []
    superelevation = _rows("superelevation", "s", line.superelevation) if line.superelevation else []
    return [
        "<elevationProfile>", *elevation, "</elevationProfile>",
        "<lateralProfile>", *superelevation, "</lateralProfile>",
    ]  # fmt: skip


def _rows(name: str, along: str, profile: Profile, factor: float = 1.0) -> list[str]:
    return [
        f'<{name} {along}="{number(s)}" a="{number(a)}" b="{number(b)}" c="{number(c)}" d="{number(d)}"/>'
        for s, (a, b, c, d) in zip(profile.s.tolist(), (factor * profile.coefficients).tolist(), strict=True)
    ]


def _lanes(line: ReferenceLine, link: str) -> list[str]:
    left, right = (
        f'<roadMark sOffset="0" type="{_MARKS[style]}" weight="standard" color="standard" width="0.12"/>'
        for style in (line.lane.left_style, line.lane.right_style)
    )
    speeds = [f'<speed sOffset="{number(s)}" max="{speed:g}" unit="km/h"/>' for s, speed in line.speeds_kmh()]
    return [
        "<lanes>",
        *_rows("laneOffset", "s", line.width, 0.5),
        f'<laneSection s="0"><center><lane id="0" type="none" level="false">{left}</lane></center>',
        f'<right><lane id="-1" type="driving" level="false"><link>{link}</link>',
        *_rows("width", "sOffset", line.width),
        right,
        *speeds,
        "</lane></right></laneSection>",
        "</lanes>",
    ]


def _object(placed: _Placed) -> str:
    marker = placed.marker
    size = ""
    if marker.side_m is not None:
        size = f' width="{number(marker.side_m)}" {"height" if marker.upright else "length"}="{number(marker.side_m)}"'
    return (
        f'<object id="{placed.number}" name={attribute(marker.id)} type="roadMark" subtype={attribute(marker.family)}'
        f' s="{number(placed.s)}" t="{number(placed.t)}" zOffset="{number(placed.z_offset)}"'
        f' hdg="{number(placed.heading_rad)}" orientation="+" dynamic="no"{size}>'
        f'<validity fromLane="-1" toLane="-1"/><userData code="family" value={attribute(marker.family)}/>'
        f'<userData code="kind" value={attribute(marker.kind)}/><userData code="code" value={attribute(marker.code)}/>'
        f'<userData code="id" value={attribute(marker.id)}/></object>'
    )


def _signal(placed: _Placed) -> str:
    marker = placed.marker
    return (
        f'<signal id="{placed.number}" name={attribute(marker.id)} s="{number(placed.s)}" t="{number(placed.t)}"'
        f' zOffset="{number(placed.z_offset)}" hOffset="{number(placed.heading_rad)}" dynamic="no" orientation="+"'
        f' country="OpenDRIVE" type={attribute(marker.family)} subtype={attribute(marker.kind or "-1")}'
        f' text={attribute(marker.code)}><validity fromLane="-1" toLane="-1"/></signal>'
    )
