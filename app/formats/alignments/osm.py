"""Nodes, ways and relations of an OSM file, as lanelet2 stores its maps."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np

from app.errors import UnreadableUpload
from app.formats.alignments.geometry import Floats
from app.formats.xml_tree import finite_number, parse_xml

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
    """A map.

    Attributes
    ----------
    ways, relations : dict
        By id.
    places : dict of str to int
        Row of each node in the arrays.
    points : ndarray, shape (N, 3)
        Longitude, latitude [deg], or local x, y [m]; height [m], NaN without one.
    metres : ndarray, shape (N, 2)
        Places on a plane, good enough to see what touches what. [m]
    scale : ndarray, shape (2,)
        Metres per unit of the coordinates.
    is_local : bool
        Whether the coordinates are local.
    """

    ways: dict[str, Way]
    relations: dict[str, Relation]
    places: dict[str, int]
    points: Floats
    metres: Floats
    scale: Floats
    is_local: bool

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
