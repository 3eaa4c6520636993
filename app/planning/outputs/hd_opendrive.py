"""HD map -> ASAM OpenDRIVE 1.7: each lane as a road along its centre line, each marker as an object and a signal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy
from pyproj import Proj

from app.errors import InvalidParameter
from app.formats.alignments.geometry import BoundaryStyle
from app.planning.alignment import Floats, Lane
from app.planning.outputs.hd_map import HdMap, MapMarker, attribute, number
from app.planning.outputs.reference_line import Profile, ReferenceLine

MAX_BESIDE_M = 100.0
"""Greatest distance of a marker from the nearest lane. [m] Source: chosen by hand, wider than a motorway."""
_MISPLACED_M = 0.01  # [m] between a marker and its place by s and t; source: the error that maps may have
_SAME_END_M = 0.05  # [m] between the end of a lane and the start of its successor; source: chosen by hand
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
