"""HD map -> lanelet2 ``.osm``: lanes as lanelets, plates and signs as Autoware's landmarks, other markers as points."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import scipy

from app.formats.alignments.geometry import BoundaryStyle, EventKind
from app.geodesy.frames import metres_per_radian
from app.planning.alignment import Lane
from app.planning.outputs.hd_map import (
    HdMap,
    MapMarker,
    attribute,
    boundary_heights_m,
    points_m,
    refine_breaks,
    speed_kmh,
)
from app.values import Floats

PIECE_M = 40.0
"""Length of a lanelet along the road's reference line; 50 m at most in bends too. [m] Source: TIER IV's convention of 1
to 50 m."""
CHORD_ERROR_M = 0.005
"""Greatest distance of a boundary from its chords. [m] Half of a survey's centimetre."""
SAME_POINT_M = 0.02
"""Ends of lanelets nearer than this are one node. [m] Above the readers' rounding, below a line's width."""
_LONGEST_M, _SHORTEST_M = 50.0, 1.0  # [m] of a lanelet; source: TIER IV's convention
_LINE_TAGS = {
    BoundaryStyle.SOLID: {"type": "line_thin", "subtype": "solid"},
    BoundaryStyle.DASHED: {"type": "line_thin", "subtype": "dashed"},
    BoundaryStyle.NONE: {"type": "virtual"},
    BoundaryStyle.UNKNOWN: {"type": "virtual"},
}  # source: lanelet2, LinestringTagging.md; a virtual line allows no change of lanes


def write_lanelet2(content: HdMap) -> bytes:
    """A lanelet2 map.

    Parameters
    ----------
    content : HdMap
        With or without lanes.

    Returns
    -------
    bytes
        An ``.osm`` file; its ids are positive and of one counter. lanelet2 keeps all of it.

    Notes
    -----
    - Lanelets are up to 50 m long. Neighbours share the line between them and successors their nodes where these are
      within 2 cm, so that routing finds them. Their speed limit is the lowest design speed of the piece. Lines of
      unknown paint are virtual.
    - A stop line is a way of the type ``stop_line``, and a regulatory element ``traffic_sign`` refers to it: a known
      subtype (an unknown one makes lanelet2 refuse the file). No sign is claimed to stand there.
    - A square marker is a way ``area=yes``, ``type=pose_marker``, ``subtype=family``, ``marker_id=code`` with four
      vertices counter-clockwise from the lower left of its face: x is from the first to the second, y from the second
      to the third (autoware_lanelet2_extension, landmarks). Others are nodes ``type=dot``, ``subtype=family``.
    - Each node has its height, ``ele``, in the datum of the plan; unknown heights are 0, and then a marker has
      ``height=unknown``.
    """
    writer = _Writer()
    pieces = [_cut(lane) for lane in content.lanes]
    nodes = _shared_nodes(writer, pieces)
    ways: dict[tuple[int, int], list[_Way]] = {}
    for lane, piece, ends in zip(content.lanes, pieces, nodes, strict=True):
        stops = [e.chainage_m for e in content.events if e.lane == lane.name and e.kind is EventKind.STOP_LINE]
        _add_lanelets(writer, lane, piece, ends, ways, stops, "urban" if content.urban else "nonurban")
    for group in ways.values():
        for way in group:
            writer.ways[way.id] = writer.way(way.id, way.nodes, _LINE_TAGS[way.style])
    _add_markers(writer, content.markers)
    return writer.document(content.name)


@dataclass(slots=True)
class _Writer:
    """Elements of the file and the counter of their ids."""

    last_id: int = 0
    nodes: list[str] = field(default_factory=list)
    ways: dict[int, str] = field(default_factory=dict)
    relations: list[str] = field(default_factory=list)

    def next_id(self) -> int:
        self.last_id += 1
        return self.last_id

    def add_nodes(self, lon: Floats, lat: Floats, height: Floats, tags: Iterable[str] = ()) -> list[int]:
        """Ids of new nodes; `tags` are the texts of further tags of each."""
        first = self.last_id + 1
        self.last_id += len(lon)
        ids = list(range(first, self.last_id + 1))
        rows = zip(ids, lon.tolist(), lat.tolist(), height.tolist(), tags or [""] * len(ids), strict=True)
        self.nodes += [
            f'<node id="{i}" visible="true" version="1" lat="{y:.11f}" lon="{x:.11f}">'
            f'<tag k="ele" v="{z:.4f}"/>{more}</node>'
            for i, x, y, z, more in rows
        ]
        return ids

    @staticmethod
    def way(number: int, nodes: Iterable[int], tags: dict[str, str]) -> str:
        refs = "".join([f'<nd ref="{node}"/>' for node in nodes])
        return f'<way id="{number}" visible="true" version="1">{refs}{_tags(tags)}</way>'

    def add_relation(self, number: int, members: Sequence[tuple[str, int, str]], tags: dict[str, str]) -> None:
        refs = "".join(f'<member type="{kind}" ref="{ref}" role="{role}"/>' for kind, ref, role in members)
        self.relations.append(f'<relation id="{number}" visible="true" version="1">{refs}{_tags(tags)}</relation>')

    def document(self, name: str) -> bytes:
        head = ['<?xml version="1.0" encoding="UTF-8"?>', '<osm version="0.6" generator="Waymark" upload="never">']
        note = f"<note>{attribute(name)[1:-1]}</note>"
        return "\n".join([*head, note, *self.nodes, *self.ways.values(), *self.relations, "</osm>\n"]).encode()


def _tags(tags: dict[str, str]) -> str:
    return "".join([f'<tag k="{key}" v={attribute(value)}/>' for key, value in tags.items()])


# --- lanes ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Cut:
    """A lane cut into lanelets: chainages of all possible vertices, which of them are cuts, and both boundaries."""

    chainage_m: Floats
    cuts: npt.NDArray[np.intp]
    lon_deg: tuple[Floats, Floats]
    lat_deg: tuple[Floats, Floats]
    points: tuple[Floats, Floats]
    breaks: npt.NDArray[np.intp]


@dataclass(slots=True)
class _Way:
    """A boundary of one or two lanelets: its nodes, the point halfway, and its paint."""

    id: int
    nodes: list[int]
    middle: Floats
    style: BoundaryStyle


def _cut(lane: Lane) -> _Cut:
    cuts_m = _cuts_m(lane)
    chainage = np.union1d(lane.chainage_m, cuts_m)
    keep = np.concatenate([[True], np.diff(chainage) > 1e-6])
    chainage = chainage[keep]
    cuts = np.unique(np.searchsorted(chainage, cuts_m - 1e-5).clip(0, len(chainage) - 1))
    lon, lat, points = [], [], []
    for sign in (0.5, -0.5):
        offset = sign * lane.value_at(lane.width_m, chainage)
        side_lon, side_lat = lane.position_at(chainage, offset)
        lon.append(side_lon)
        lat.append(side_lat)
        points.append(points_m(side_lon, side_lat, boundary_heights_m(lane, chainage, offset)))
    both = np.hstack(points)

    def error_of(breaks: npt.NDArray[np.intp]) -> Floats:
        chords = np.stack([np.interp(chainage, chainage[breaks], column[breaks]) for column in both.T], axis=1)
        away = (both - chords).reshape(len(both), 2, 4)
        return np.asarray(np.linalg.norm(away, axis=2).max(axis=1))

    breaks = refine_breaks(cuts, error_of, CHORD_ERROR_M)
    return _Cut(chainage, cuts, (lon[0], lon[1]), (lat[0], lat[1]), (points[0], points[1]), breaks)


def _cuts_m(lane: Lane) -> Floats:
    """Chainages of the ends of a lane's lanelets: at the same stations in all lanes of a road, shape (K,). [m]"""
    station, chainage = lane.station_m, lane.chainage_m
    if station[0] > station[-1]:
        station, chainage = station[::-1], chainage[::-1]
    if np.all(np.diff(station) > 0):
        first, last = np.ceil(station[0] / PIECE_M), np.floor(station[-1] / PIECE_M)
        inner = np.interp(np.arange(first, last + 1) * PIECE_M, station, chainage)
    else:
        inner = np.arange(PIECE_M, lane.length_m, PIECE_M)
    room = _LONGEST_M - PIECE_M
    inner = np.sort(inner[(inner > room / 2) & (inner < lane.length_m - room / 2)])
    cuts = np.concatenate([[0.0], inner, [lane.length_m]])
    parts = np.maximum(np.ceil(np.diff(cuts) / _LONGEST_M - 1e-9), 1).astype(int)
    pieces = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(cuts[:-1], cuts[1:], parts, strict=True)]
    return np.concatenate([*pieces, [lane.length_m]])


def _shared_nodes(writer: _Writer, pieces: Sequence[_Cut]) -> list[tuple[list[int], list[int]]]:
    """Ids of the nodes at the ends of all lanelets, left and right of each lane; ends at one place are one node."""
    if not pieces:
        return []
    sides = [(piece, side) for piece in pieces for side in (0, 1)]
    points = np.concatenate([piece.points[side][piece.cuts] for piece, side in sides])
    lon = np.concatenate([piece.lon_deg[side][piece.cuts] for piece, side in sides])
    lat = np.concatenate([piece.lat_deg[side][piece.cuts] for piece, side in sides])
    pairs = scipy.spatial.cKDTree(points).query_pairs(SAME_POINT_M, output_type="ndarray")
    links = scipy.sparse.coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    _, group = scipy.sparse.csgraph.connected_components(links, directed=False)
    _, first = np.unique(group, return_index=True)
    ids = np.array(writer.add_nodes(lon[first], lat[first], points[first, 3]))[group].tolist()
    nodes: list[list[int]] = []
    start = 0
    for piece, _side in sides:
        nodes.append(ids[start : start + len(piece.cuts)])
        start += len(piece.cuts)
    return list(zip(nodes[::2], nodes[1::2], strict=True))


def _add_lanelets(
    writer: _Writer,
    lane: Lane,
    piece: _Cut,
    ends: tuple[list[int], list[int]],
    ways: dict[tuple[int, int], list[_Way]],
    stops_m: Sequence[float],
    location: str,
) -> None:
    for k in range(len(piece.cuts) - 1):
        bounds = [
            _bound(writer, piece, side, k, ends[side], ways, style)
            for side, style in ((0, lane.left_style), (1, lane.right_style))
        ]
        first_m, last_m = piece.chainage_m[piece.cuts[k]], piece.chainage_m[piece.cuts[k + 1]]
        limit = speed_kmh(lane, first_m, last_m)
        last = k == len(piece.cuts) - 2
        stops = [s for s in stops_m if first_m <= s < last_m or (last and s >= last_m)]
        rules = [_add_stop_line(writer, lane, min(stop, lane.length_m)) for stop in stops]
        writer.add_relation(
            writer.next_id(),
            [
                ("way", bounds[0], "left"),
                ("way", bounds[1], "right"),
                *(("relation", rule, "regulatory_element") for rule in rules),
            ],
            {
                "type": "lanelet", "subtype": "road", "location": location, "one_way": "yes",
                "lane": lane.name, "road": lane.road, **({} if limit is None else {"speed_limit": f"{limit:g}"}),
            },
        )  # fmt: skip


def _bound(
    writer: _Writer,
    piece: _Cut,
    side: int,
    k: int,
    ends: Sequence[int],
    ways: dict[tuple[int, int], list[_Way]],
    style: BoundaryStyle,
) -> int:
    """Id of a lanelet's boundary: that of the neighbour if it is the same line, or a new way."""
    start, end = int(piece.cuts[k]), int(piece.cuts[k + 1])
    halfway = (piece.chainage_m[start] + piece.chainage_m[end]) / 2
    points = piece.points[side]
    part = slice(start, end + 1)
    middle = np.array([np.interp(halfway, piece.chainage_m[part], column) for column in points[part].T])
    known = ways.setdefault((min(ends[k], ends[k + 1]), max(ends[k], ends[k + 1])), [])
    for way in known:
        if np.linalg.norm(way.middle - middle) <= SAME_POINT_M:
            if way.style is BoundaryStyle.UNKNOWN:
                way.style = style
            return way.id
    first, last = np.searchsorted(piece.breaks, [start + 1, end])
    inner = piece.breaks[first:last]
    nodes = writer.add_nodes(piece.lon_deg[side][inner], piece.lat_deg[side][inner], points[inner, 3])
    known.append(_Way(writer.next_id(), [ends[k], *nodes, ends[k + 1]], middle, style))
    return known[-1].id


def _add_stop_line(writer: _Writer, lane: Lane, chainage_m: float) -> int:
    """Id of the regulatory element of a stop line across a lane."""
    at = np.full(2, chainage_m)
    offset = np.array([-0.5, 0.5]) * lane.value_at(lane.width_m, at)
    nodes = writer.add_nodes(*lane.position_at(at, offset), boundary_heights_m(lane, at, offset))
    line = writer.next_id()
    writer.ways[line] = writer.way(line, nodes, {"type": "stop_line", "subtype": "solid"})
    rule = writer.next_id()
    members = [("way", line, "refers"), ("way", line, "ref_line")]
    writer.add_relation(rule, members, {"type": "regulatory_element", "subtype": "traffic_sign"})
    return rule


# --- markers --------------------------------------------------------------------------------------------------------


def _add_markers(writer: _Writer, markers: Sequence[MapMarker]) -> None:
    faces = [marker for marker in markers if marker.side_m is not None and marker.heading_deg is not None]
    dots = [marker for marker in markers if marker.side_m is None or marker.heading_deg is None]
    if dots:
        height = np.array([marker.height_m or 0.0 for marker in dots])
        tags = [_tags({"type": "dot", "subtype": marker.family, **_marker_tags(marker)}) for marker in dots]
        lon, lat = (np.array([getattr(m, name) for m in dots], dtype=float) for name in ("lon_deg", "lat_deg"))
        writer.add_nodes(lon, lat, height, tags)
    if faces:
        lon, lat, height = face_corners(faces)
        nodes = writer.add_nodes(lon.ravel(), lat.ravel(), height.ravel())
        for k, marker in enumerate(faces):
            tags_of = {"area": "yes", "type": "pose_marker", "subtype": marker.family, **_marker_tags(marker)}
            way = writer.next_id()
            writer.ways[way] = writer.way(way, nodes[4 * k : 4 * k + 4], tags_of)


def _marker_tags(marker: MapMarker) -> dict[str, str]:
    tags = {"marker_id": marker.code, "waymark_id": marker.id}
    if marker.kind:
        tags["kind"] = marker.kind
    if marker.heading_deg is not None:
        tags["heading"] = f"{marker.heading_deg:.4f}"
    if marker.height_m is None:
        tags["height"] = "unknown"
    return tags


def face_corners(markers: Sequence[MapMarker]) -> tuple[Floats, Floats, Floats]:
    """Corners of square faces with a heading, counter-clockwise from the lower left as a reader sees the face.

    Returns
    -------
    lon_deg, lat_deg, height_m : ndarray, shape (M, 4)
    """
    heading = np.radians([marker.heading_deg or 0.0 for marker in markers])
    grade = np.array([marker.grade for marker in markers])
    crossfall = np.array([marker.crossfall for marker in markers])
    upright = np.array([marker.upright for marker in markers])
    level = np.zeros(len(markers))
    right = np.stack([np.cos(heading), -np.sin(heading), np.where(upright, 0.0, -crossfall)], axis=1)
    forward = np.stack([np.sin(heading), np.cos(heading), grade], axis=1)
    up = np.where(upright[:, None], np.stack([level, level, level + 1], axis=1), forward)
    right /= np.linalg.norm(right, axis=1)[:, None]
    up -= np.einsum("ij,ij->i", up, right)[:, None] * right
    up /= np.linalg.norm(up, axis=1)[:, None]
    half = np.array([(marker.side_m or 0.0) / 2 for marker in markers])[:, None, None]
    corner = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    enu = half * (corner[None, :, :1] * right[:, None, :] + corner[None, :, 1:] * up[:, None, :])
    lat = np.array([marker.lat_deg for marker in markers])
    east_m, north_m = metres_per_radian(np.radians(lat))
    lon = np.array([marker.lon_deg for marker in markers])[:, None] + np.degrees(enu[:, :, 0] / east_m[:, None])
    height = np.array([marker.height_m or 0.0 for marker in markers])[:, None] + enu[:, :, 2]
    return lon, lat[:, None] + np.degrees(enu[:, :, 1] / north_m[:, None]), height
