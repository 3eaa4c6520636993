"""Maps of lanelet2: lanelets for vehicles, chained to lanes, with stop lines, crossings and speed limits."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import dataclass

import numpy as np
import shapely

from app.errors import UnreadableUpload
from app.formats.alignments.geometry import (
    MAX_VERTICES,
    AlignmentFile,
    AreaGeometry,
    BoundaryStyle,
    EventGeometry,
    EventKind,
    LaneGeometry,
)
from app.formats.xml_tree import finite_number, parse_xml
from app.markers.magnet_design import Arrow
from app.values import Floats

# === Nodes, ways and relations of an OSM file, as lanelet2 stores its maps.


_ID = re.compile(r"-?[0-9]{1,20}")
METRES_PER_DEGREE = 111_319.5
"""Of latitude, and of longitude at the equator. [m] Source: 2 pi 6,378,137 m / 360; enough to see what touches what."""


@dataclass(frozen=True, slots=True)
class Way:
    """A line: numbers of its nodes, and its tags."""

    id: str
    nodes: tuple[str, ...]
    tags: dict[str, str]


@dataclass(frozen=True, slots=True)
class Relation:
    """A relation: members by role, as pairs of type and id, and its tags."""

    id: str
    members: dict[str, list[tuple[str, str]]]
    tags: dict[str, str]

    def ways(self, role: str) -> list[str]:
        """Ids of the ways with a role."""
        return [ref for kind, ref in self.members.get(role, []) if kind == "way"]

    def relations(self, role: str) -> list[str]:
        """Ids of the relations with a role."""
        return [ref for kind, ref in self.members.get(role, []) if kind == "relation"]


@dataclass(frozen=True, slots=True, eq=False)
class OsmMap:
    """A map."""

    # `ways`, `relations`: by id
    ways: dict[str, Way]
    relations: dict[str, Relation]
    places: dict[str, int]  # row of each node in the arrays
    points: Floats  # shape (N, 3): longitude, latitude [deg], or local x, y [m]; height [m], NaN without one
    metres: Floats  # shape (N, 2): [m] places on a plane, good enough to see what touches what
    scale: Floats  # shape (2,): metres per unit of the coordinates
    is_local: bool  # whether the coordinates are local

    def rows(self, nodes: tuple[str, ...]) -> list[int]:
        """Rows of nodes."""
        return [self.places[node] for node in nodes]

    def length_m(self, way: Way) -> float:
        """Length of a way. [m]"""
        return float(np.hypot(*np.diff(self.metres[self.rows(way.nodes)], axis=0).T).sum())


def read_osm(data: bytes) -> OsmMap:
    """A map, with the nodes that its ways use.

    Raises
    ------
    UnreadableUpload
        It is no such XML, a node is missing, or a coordinate is wrong.
    """
    root = parse_xml(data, "osm")
    present = [element for element in root if element.get("action") != "delete" and element.get("visible") != "false"]
    ways = {}
    for element in present:
        if element.tag == "way":
            nodes = [nd.get("ref", "") for nd in element.iterfind("nd")]
            unlike = tuple(node for i, node in enumerate(nodes) if i == 0 or node != nodes[i - 1])
            ways[element.get("id", "")] = Way(element.get("id", ""), unlike, _tags(element))
    used = {node for way in ways.values() for node in way.nodes}
    nodes_by_id = {
        element.get("id", ""): element for element in present if element.tag == "node" and element.get("id", "") in used
    }
    for way in ways.values():
        for node in way.nodes:
            if node not in nodes_by_id:
                raise UnreadableUpload(
                    f"way {way.id[:40]}: the node {node[:40]} is missing",
                    field="file",
                    limit="nodes of all ways",
                    cure="export the map again, with all nodes",
                )
    relations = {element.get("id", ""): _relation(element) for element in present if element.tag == "relation"}
    points, is_local = _coordinates(list(nodes_by_id.items()))
    metres, scale = points[:, :2].copy(), np.ones(2)
    if not is_local and len(points):
        metres[:, 0] = (points[:, 0] - points[0, 0] + 180.0) % 360.0 - 180.0
        scale = METRES_PER_DEGREE * np.array([max(np.cos(np.radians(np.median(points[:, 1]))), 1e-6), 1.0])
        metres *= scale
    return OsmMap(ways, relations, {node: i for i, node in enumerate(nodes_by_id)}, points, metres, scale, is_local)


def _tags(element: ET.Element) -> dict[str, str]:
    return {tag.get("k", ""): tag.get("v", "").strip() for tag in element.iterfind("tag")}


def _relation(element: ET.Element) -> Relation:
    members: dict[str, list[tuple[str, str]]] = {}
    for member in element.iterfind("member"):
        members.setdefault(member.get("role", ""), []).append((member.get("type", ""), member.get("ref", "")))
    if _ID.fullmatch(element.get("id", "")) is None:
        raise UnreadableUpload(
            f"the id {element.get('id', '')[:40]!r} of a relation is no number",
            field="file",
            limit="whole numbers",
            cure="export the map again",
        )
    return Relation(element.get("id", ""), members, _tags(element))


def _coordinates(nodes: list[tuple[str, ET.Element]]) -> tuple[Floats, bool]:
    """Coordinates of nodes, and whether they are local: no node has lat and lon, or all have the same."""
    tags = [_tags(element) for _, element in nodes]
    positions = {(element.get("lat", "").strip(), element.get("lon", "").strip()) for _, element in nodes}
    has_local = [bool(tag.get("local_x")) and bool(tag.get("local_y")) for tag in tags]
    on_earth = all(lat and lon for lat, lon in positions) and not (len(nodes) > 1 == len(positions) and all(has_local))
    if not on_earth and not all(has_local):
        name = next(
            name
            for (name, element), local in zip(nodes, has_local, strict=True)
            if not local and (len(positions) == 1 or not (element.get("lat") and element.get("lon")))
        )
        raise UnreadableUpload(
            f"node {name[:40]}: it has neither lat and lon nor local_x and local_y",
            field="file",
            limit="the same kind of coordinates at every node",
            cure="export the map again, with lat and lon",
        )
    points = np.full((len(nodes), 3), np.nan)
    for row, ((name, element), tag) in enumerate(zip(nodes, tags, strict=True)):
        place = f"node {name[:40]}"
        if on_earth:
            first, second = (
                finite_number(element.get("lon"), "lon", place),
                finite_number(element.get("lat"), "lat", place),
            )
            if abs(first) > 180.0 or abs(second) > 90.0:
                raise UnreadableUpload(
                    f"{place}: lat {second:g}, lon {first:g} is no place on Earth",
                    field="file",
                    limit="-90 to 90 and -180 to 180 deg",
                    cure="correct the node, or export the map again",
                )
        else:
            first, second = (finite_number(tag[key], key, place) for key in ("local_x", "local_y"))
        points[row] = first, second, finite_number(tag["ele"], "ele", place) if tag.get("ele") else np.nan
    return points, not on_earth


# === Maps of lanelet2.


VEHICLE_SUBTYPES = frozenset({"road", "highway", "play_street", "emergency_lane", "bus_lane", "road_shoulder"})
"""Lanelets that vehicles drive on. Source: lanelet2, LaneletAndAreaTagging; road_shoulder: Autoware."""
_STOPPING = frozenset({"traffic_light", "all_way_stop", "right_of_way"})
"""Regulatory elements whose ref_line is a stop line. Source: lanelet2, RegulatoryElementTagging."""
_UNPAINTED = frozenset({"virtual", "curbstone", "road_border", "guard_rail", "wall", "fence", "rail"})
"""Boundaries without paint. Source: lanelet2, LinestringTagging."""
_STYLES = {"solid": BoundaryStyle.SOLID, "dashed": BoundaryStyle.DASHED}
_SPEED = re.compile(r"(?P<value>\d+(\.\d+)?)\s*(?P<unit>km/h|kmh|kph|mph|m/s|mps)?", re.IGNORECASE)
_SPEED_SIGN = re.compile(r"de274[-_.](?P<value>\d+)", re.IGNORECASE)
_UNITS_M_S = {"m/s": 1.0, "mps": 1.0, "mph": 0.44704}
_KMH = 1 / 3.6
_REACH_M = 1.0
"""A stop line this near to the end of a lane is its stop line, one this near to its start is not. [m] Nodes of stop
lines and of lanelets are drawn apart."""
_OPEN_M = 1.75
"""Where boundaries meet in one node, a lane begins where they are this far apart. [m] A car."""
_CUT_STEP_M = 0.25
"""Between the places at which that is looked at. [m]"""
_ORIGIN = (
    "The nodes have local_x and local_y without lat and lon; give the origin of these coordinates (--origin LON,LAT)."
)


@dataclass(frozen=True, slots=True)
class _Lanelet:
    """A lanelet in its direction; a boundary is turned if its way is stored against it."""

    id: str
    left: Way
    right: Way
    left_turned: bool
    right_turned: bool
    tags: dict[str, str]
    speed_m_s: float

    @property
    def left_nodes(self) -> tuple[str, ...]:
        return self.left.nodes[::-1] if self.left_turned else self.left.nodes

    @property
    def right_nodes(self) -> tuple[str, ...]:
        return self.right.nodes[::-1] if self.right_turned else self.right.nodes

    @property
    def start(self) -> tuple[str, str]:
        return self.left_nodes[0], self.right_nodes[0]

    @property
    def end(self) -> tuple[str, str]:
        return self.left_nodes[-1], self.right_nodes[-1]


def read_lanelet2(data: bytes) -> AlignmentFile:
    """Lanes by both boundaries: lanelets that follow each other without a choice are one lane, named by the first one.

    Ways are turned where they are stored against the lanelet. Lanelets without a subtype, and those for pedestrians or
    bicycles alone, are left out. Two-way lanelets become lanes in their own direction alone.

    Returns
    -------
    AlignmentFile
        In EPSG:4326, or in local coordinates with a `crs_problem`.

    Raises
    ------
    UnreadableUpload
        It is no OSM file, is damaged, or has no lanelet for vehicles.
    """
    osm = read_osm(data)
    warnings: list[str] = []
    lanelets = _lanelets(osm, warnings)
    if not lanelets:
        raise UnreadableUpload(
            "the map has no lanelet that vehicles drive on",
            field="file",
            limit=f"type lanelet, subtype one of {', '.join(sorted(VEHICLE_SUBTYPES))}",
            cure="export the lanelets with their subtype",
        )
    chains = _chains(lanelets)
    if sum(len(one.left.nodes) + len(one.right.nodes) for one in lanelets) > MAX_VERTICES:
        raise UnreadableUpload(
            "the lanelets have too many vertices",
            field="file",
            limit=f"{MAX_VERTICES} vertices",
            cure="cut the map into parts",
        )
    made = [_lane(osm, chain, warnings) for chain in chains]
    chains = [chain for chain, lane in zip(chains, made, strict=True) if lane is not None]
    lanes = tuple(lane for lane in made if lane is not None)
    two_way = sum(one.tags.get("one_way") in ("no", "false") for one in lanelets)
    if two_way:
        warnings.append(f"{two_way} lanelets are two-way; they are used in the direction of their boundaries alone.")
    crossings = _crossings(osm)
    with np.errstate(all="ignore"):  # shapely divides by the lengths of pieces
        events = _events(osm, chains, lanes, crossings, warnings)
    return AlignmentFile(
        format="lanelet2",
        lanes=lanes,
        crs=None if osm.is_local else "EPSG:4326",
        crs_problem=_ORIGIN if osm.is_local else None,
        events=tuple(events),
        areas=tuple(AreaGeometry("crossing", osm.points[rows, :2]) for rows in crossings),
        warnings=tuple(warnings),
    )


def _lanelets(osm: OsmMap, warnings: list[str]) -> list[_Lanelet]:
    found = []
    for relation in osm.relations.values():
        if relation.tags.get("type") != "lanelet" or not _is_for_vehicles(relation):
            continue
        sides = _sides(osm, relation)
        if sides is None:
            warnings.append(
                f"Lanelet {relation.id}: it needs one left and one right way that have a length; it is left out."
            )
            continue
        left, right = sides
        turned = _turned(osm, left, right)
        found.append(_Lanelet(relation.id, left, right, *turned, relation.tags, _speed_limit(osm, relation, warnings)))
    return found


def _is_for_vehicles(relation: Relation) -> bool:
    """As the traffic rules of lanelet2: tags of participants, where there are any, replace what the subtype says."""
    participants = {key: value for key, value in relation.tags.items() if key.startswith("participant:")}
    if participants:
        return any(
            key.startswith("participant:vehicle") and participants[key] in ("yes", "true") for key in participants
        )
    return relation.tags.get("subtype") in VEHICLE_SUBTYPES


def _sides(osm: OsmMap, relation: Relation) -> tuple[Way, Way] | None:
    """The two ways; None if they are not there, or have no length."""
    left, right = (
        [osm.ways[ref] for ref in relation.ways(role) if ref in osm.ways and osm.length_m(osm.ways[ref]) > 0.0]
        for role in ("left", "right")
    )
    return (left[0], right[0]) if len(left) == len(right) == 1 and left[0] is not right[0] else None


def _turned(osm: OsmMap, left: Way, right: Way) -> tuple[bool, bool]:
    """Which ways are stored against the lanelet: boundaries are parallel, and left is on the left."""
    one, two = osm.metres[osm.rows(left.nodes)], osm.metres[osm.rows(right.nodes)]
    apart = math.dist(one[0], two[0]) + math.dist(one[-1], two[-1])
    against = math.dist(one[0], two[-1]) + math.dist(one[-1], two[0]) < apart
    ring = np.concatenate([two[::-1] if against else two, one[::-1]])
    ring = ring - ring[0]
    area = float(np.sum(ring[:-1, 0] * ring[1:, 1] - ring[1:, 0] * ring[:-1, 1]))
    backwards = area < 0.0
    return backwards, backwards != against


def _chains(lanelets: list[_Lanelet]) -> list[list[_Lanelet]]:
    """Lanelets that follow each other, where both have no other neighbour at these ends."""
    starts = Counter(one.start for one in lanelets)
    ends = Counter(one.end for one in lanelets)
    by_start = {one.start: one for one in lanelets}
    only = {key for key in starts if starts[key] == ends[key] == 1}
    heads = [one for one in lanelets if one.start not in only]
    chains, used = [], set()
    for head in (*heads, *lanelets):  # what is left after the heads are rings
        chain: list[_Lanelet] = []
        following: _Lanelet | None = head
        while following is not None and following.id not in used:
            used.add(following.id)
            chain.append(following)
            following = by_start[following.end] if following.end in only else None
        if chain:
            chains.append(chain)
    return chains


def _lane(osm: OsmMap, chain: list[_Lanelet], warnings: list[str]) -> LaneGeometry | None:
    """The lane of a chain; None, with a warning, if its boundaries are nowhere apart."""
    left = [*chain[0].left_nodes[:1], *(node for one in chain for node in one.left_nodes[1:])]
    right = [*chain[0].right_nodes[:1], *(node for one in chain for node in one.right_nodes[1:])]
    # A vertex between two lanelets has the limit of the second.
    speeds = [one.speed_m_s for one in chain for _ in one.left_nodes[1:]]
    speed = np.array([*speeds, chain[-1].speed_m_s])
    rows = osm.rows(tuple(left)), osm.rows(tuple(right))
    parts = np.column_stack([osm.points[rows[0]], speed]), osm.points[rows[1]]
    meets = left[0] == right[0], left[-1] == right[-1]
    if any(meets) and chain[0].start != chain[-1].end:
        ends = _open_part(osm.metres[rows[0]], osm.metres[rows[1]], *meets)
        if ends is None:
            warnings.append(f"Lanelet {chain[0].id}: its boundaries are nowhere {_OPEN_M:g} m apart; it is left out.")
            return None
        warnings.append(
            f"Lanelet {chain[0].id}: its boundaries meet at an end; it is used where they are {_OPEN_M:g} m apart, "
            f"from {ends[0]:.0%} to {ends[1]:.0%} of its length."
        )
        left_part, right_part = (
            _between(part, _shares(osm.metres[side]), ends) for part, side in zip(parts, rows, strict=True)
        )
    else:
        left_part, right_part = parts
    speed = left_part[:, 3]
    return LaneGeometry(
        name=f"lanelet {chain[0].id}",
        left=left_part[:, :3],
        right=right_part,
        speed_limit_m_s=None if np.isnan(speed).all() else speed,
        left_style=_style(osm, [(one.left, one.left_turned, True) for one in chain]),
        right_style=_style(osm, [(one.right, one.right_turned, False) for one in chain]),
    )


def _open_part(left: Floats, right: Floats, at_start: bool, at_end: bool) -> tuple[float, float] | None:
    """Shares of both boundaries between which they are apart, for those that meet at an end; None if they never are."""
    lines = shapely.LineString(left), shapely.LineString(right)
    shares = np.linspace(0.0, 1.0, min(int(max(line.length for line in lines) / _CUT_STEP_M), MAX_VERTICES) + 2)
    apart = np.minimum(
        shapely.distance(shapely.line_interpolate_point(lines[0], shares, normalized=True), lines[1]),
        shapely.distance(shapely.line_interpolate_point(lines[1], shares, normalized=True), lines[0]),
    )
    wide = shares[apart >= _OPEN_M]
    if len(wide) < 2:
        return None
    return float(wide[0]) if at_start else 0.0, float(wide[-1]) if at_end else 1.0


def _between(values: Floats, shares: Floats, ends: tuple[float, float]) -> Floats:
    """Values at the vertices between two shares of a line, and at these; a last column of limits holds ahead."""
    inside = (shares > ends[0]) & (shares < ends[1])
    cuts = np.stack([[np.interp(end, shares, column) for column in values.T] for end in ends])
    cuts[:, 3:] = values[np.clip(np.searchsorted(shares, ends, side="right") - 1, 0, len(values) - 1), 3:]
    return np.concatenate([cuts[:1], values[inside], cuts[1:]])


def _style(osm: OsmMap, sides: list[tuple[Way, bool, bool]]) -> BoundaryStyle:
    """Paint along the greater part of a boundary. Of a double line the one nearer to the lane counts."""
    lengths: dict[BoundaryStyle, float] = {}
    for way, turned, is_left in sides:
        words = way.tags.get("subtype", "").split("_")
        # Double lines are named from left to right in the direction of the way.
        word = words[-1] if is_left != turned else words[0]
        style = BoundaryStyle.NONE if way.tags.get("type") in _UNPAINTED else BoundaryStyle.UNKNOWN
        if way.tags.get("type") in ("line_thin", "line_thick"):
            style = _STYLES.get(word, BoundaryStyle.UNKNOWN)
        lengths[style] = lengths.get(style, 0.0) + osm.length_m(way)
    return max(lengths, key=lambda style: lengths[style])


def _speed_limit(osm: OsmMap, lanelet: Relation, warnings: list[str]) -> float:
    """By the lanelet's tags, or by its regulatory elements; NaN without. [m/s]"""
    texts = [lanelet.tags[key] for key in ("speed_limit", "speed_limit:vehicle") if lanelet.tags.get(key)]
    for ref in lanelet.relations("regulatory_element"):
        rule = osm.relations.get(ref)
        if rule is not None and rule.tags.get("subtype") == "speed_limit":
            signs = [osm.ways[sign].tags.get("subtype", "") for sign in rule.ways("refers") if sign in osm.ways]
            texts += [rule.tags[key] for key in ("sign_type", "speed_limit", "max_speed") if rule.tags.get(key)] + signs
    for text in texts:
        value = _speed_m_s(text)
        if value is not None:
            return value
    if texts:
        warnings.append(f"Lanelet {lanelet.id}: the speed limit {texts[0][:40]!r} is not understood.")
    return math.nan


def _speed_m_s(text: str) -> float | None:
    """``50``, ``50 km/h``, ``30 mph``, ``13.9 m/s`` or ``de274-50``; kilometres per hour without a unit."""
    sign, plain = _SPEED_SIGN.fullmatch(text), _SPEED.fullmatch(text)
    if sign is not None:
        return float(sign["value"][:4]) * _KMH or None
    if plain is None or len(plain["value"]) > 8:
        return None
    return float(plain["value"]) * _UNITS_M_S.get((plain["unit"] or "").lower(), _KMH) or None


def _crossings(osm: OsmMap) -> list[list[int]]:
    """Closed rings about crosswalks, as rows of nodes."""
    rings = []
    for relation in osm.relations.values():
        if relation.tags.get("type") == "lanelet" and relation.tags.get("subtype") == "crosswalk":
            sides = _sides(osm, relation)
            if sides is not None:
                against = len(set(_turned(osm, *sides))) == 2
                right = sides[1].nodes if against else sides[1].nodes[::-1]
                ring = osm.rows((*sides[0].nodes, *right))
                rings.append([*ring, ring[0]])
    return rings


def _events(
    osm: OsmMap,
    chains: list[list[_Lanelet]],
    lanes: tuple[LaneGeometry, ...],
    crossings: list[list[int]],
    warnings: list[str],
) -> list[EventGeometry]:
    middles = [_middle_line(osm, chain) for chain in chains]
    tree = shapely.STRtree(middles)
    events = []
    for way in osm.ways.values():
        value = way.tags.get("subtype", "").replace("_", "-")
        if way.tags.get("type") == "arrow" and value in set(Arrow) and way.nodes:
            x, y = osm.points[osm.rows(way.nodes), :2].mean(axis=0)
            events.append(EventGeometry(EventKind.ARROW, (float(x), float(y)), None, value))
    for k, point in _stop_lines(osm, chains, middles, tree, warnings):
        events.append(EventGeometry(EventKind.STOP_LINE, point, lanes[k].name))
    for ring in crossings:
        area = shapely.Polygon(osm.metres[ring]).buffer(0.0)
        for k in sorted(tree.query(area, predicate="intersects").tolist()):
            inside = shapely.get_coordinates(shapely.intersection(middles[k], area))
            reached = shapely.line_locate_point(middles[k], shapely.points(inside))
            if len(inside) and reached.min() > _REACH_M:
                point = _from_metres(osm, inside[int(reached.argmin())], ring[0])
                events.append(EventGeometry(EventKind.CROSSING, point, lanes[k].name))
    return events


def _stop_lines(
    osm: OsmMap,
    chains: list[list[_Lanelet]],
    middles: list[shapely.LineString],
    tree: shapely.STRtree,
    warnings: list[str],
) -> list[tuple[int, tuple[float, float]]]:
    """Number of the lane, and place on it, of stop lines that lanelets refer to, or that lie across lanes."""
    named = _referenced_stop_lines(osm, chains)
    lines = {ref for ref, way in osm.ways.items() if way.tags.get("type") == "stop_line"}.union(*named.values())
    found: list[tuple[int, tuple[float, float]]] = []
    alone = 0
    for ref in sorted(lines):
        if ref not in osm.ways or not osm.length_m(osm.ways[ref]) > 0.0:
            continue
        rows = osm.rows(osm.ways[ref].nodes)
        line = shapely.LineString(osm.metres[rows])
        near = tree.query(line, predicate="dwithin", distance=_REACH_M).tolist()
        own = sorted({k for k in near if _stops_at(middles[k], line)} | {k for k, refs in named.items() if ref in refs})
        places = [shapely.get_coordinates(shapely.shortest_line(middles[k], line))[0] for k in own]
        found += [(k, _from_metres(osm, place, rows[0])) for k, place in zip(own, places, strict=True)]
        alone += not own
    if alone:
        warnings.append(f"{alone} stop lines lie on no lane for vehicles; they are left out.")
    return found


def _from_metres(osm: OsmMap, place: Floats, near: int) -> tuple[float, float]:
    """Coordinates of the file at a place on the plane of `OsmMap.metres`, near a row."""
    x, y = osm.points[near, :2] + (place - osm.metres[near]) / osm.scale
    return float(x if osm.is_local else (x + 180.0) % 360.0 - 180.0), float(y)


def _referenced_stop_lines(osm: OsmMap, chains: list[list[_Lanelet]]) -> dict[int, set[str]]:
    """Ids of the stop lines that the lanelets of each chain refer to."""
    named: dict[int, set[str]] = {}
    for number, chain in enumerate(chains):
        for one in chain:
            for ref in osm.relations[one.id].relations("regulatory_element"):
                rule = osm.relations.get(ref)
                if rule is None or rule.tags.get("subtype") not in _STOPPING:
                    continue
                if rule.tags.get("subtype") == "right_of_way" and one.id not in rule.relations("yield"):
                    continue
                named.setdefault(number, set()).update(rule.ways("ref_line"))
    return named


def _stops_at(middle: shapely.LineString, line: shapely.LineString) -> bool:
    """Whether a stop line lies across a lane, or across its end; at its start it belongs to the lane before."""
    at = float(shapely.line_locate_point(middle, shapely.get_point(shapely.shortest_line(middle, line), 0)))
    if at <= _REACH_M or not (at > middle.length - _REACH_M or shapely.intersects(middle, line)):
        return False
    along = np.diff(shapely.get_coordinates(shapely.line_interpolate_point(middle, [at - _REACH_M, at])), axis=0)[0]
    ends = shapely.get_coordinates(line)[[0, -1]]
    across = ends[1] - ends[0]
    return bool(abs(along @ across) < math.sqrt(0.5) * np.hypot(*along) * np.hypot(*across))


def _middle_line(osm: OsmMap, chain: list[_Lanelet]) -> shapely.LineString:
    """Centre line of a chain on the plane: the middle between points at the same share of both boundaries."""
    points = []
    for one in chain:
        left, right = (osm.metres[osm.rows(nodes)] for nodes in (one.left_nodes, one.right_nodes))
        shares = [_shares(left), _shares(right)]
        both = np.union1d(*shares)
        points.append(
            sum(
                np.stack([np.interp(both, share, side[:, axis]) for axis in (0, 1)], axis=1)
                for share, side in zip(shares, (left, right), strict=True)
            )
            / 2.0
        )
    return shapely.LineString(np.concatenate(points))


def _shares(points: Floats) -> Floats:
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    return along / along[-1] if along[-1] > 0.0 else np.linspace(0.0, 1.0, len(along))
