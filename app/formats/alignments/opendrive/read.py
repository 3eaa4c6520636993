"""A file of OpenDRIVE: its roads and what lies on them, in the coordinates that it states."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from app.errors import UnreadableUpload
from app.formats.alignments.curves import MAX_STEP_M
from app.formats.alignments.geometry import (
    MAX_VERTICES,
    AlignmentFile,
    AreaGeometry,
    EventGeometry,
    EventKind,
    usable_crs,
)
from app.formats.alignments.opendrive.road import Grid, Road, Track, build_tracks, lane_edges, parse_road, speed_m_s
from app.formats.xml_tree import attribute, parse_xml
from app.values import Floats

# === What lies on an OpenDRIVE road: stop lines, crossings, speed limits, ends at junctions, bridges.


_STOP_SIGNS = {("DE", "206"), ("DE", "294"), ("OPENDRIVE", "206"), ("OPENDRIVE", "294"), ("US", "R1-1")}
_SPEED_SIGNS = {("DE", "274"), ("OPENDRIVE", "274"), ("US", "R2-1")}
_CROSSING_SIGNS = {("DE", "293"), ("OPENDRIVE", "293")}
"""Country and type of signals. Source: StVO annex 2 (206 stop, 274 limit, 293 zebra crossing, 294 stop line), whose
numbers OpenDRIVE's own catalogue uses; MUTCD R1-1 and R2-1."""
_STOP_LINE = re.compile(r"stop[ _-]?line", re.IGNORECASE)
_CROSSING = re.compile(r"cross[ _-]?walk|zebra", re.IGNORECASE)
_SAME_PLACE_M = 5.0
"""A sign this near to a change of the lane's limit says the same. [m]"""


class Furniture(NamedTuple):
    """Events and areas of roads."""

    events: list[EventGeometry]
    areas: list[AreaGeometry]

    def __add__(self, other: object) -> Furniture:
        assert isinstance(other, Furniture)
        return Furniture(self.events + other.events, self.areas + other.areas)


def find_furniture(road: Road, grid: Grid, tracks: list[Track], signals: dict[str, ET.Element]) -> Furniture:
    """Events and areas of a road, events by lane.

    Raises
    ------
    UnreadableUpload
        A number of an object or signal is missing or wrong.
    """
    events = [event for track in tracks for event in _along(road, track)]
    areas: list[AreaGeometry] = []
    for holder in road.element.iterfind("signals/*"):
        place = f"{road.place}, signal {holder.get('id', '')[:40]}"
        signal = signals.get(holder.get("id", "")) if holder.tag == "signalReference" else holder
        if signal is not None and holder.tag in ("signal", "signalReference"):
            events += _signal(holder, signal, tracks, events, place)
    for item in road.element.iterfind("objects/object"):
        place = f"{road.place}, object {item.get('id', '')[:40]}"
        label = " ".join(item.get(key, "") for key in ("type", "subtype", "name"))
        if _CROSSING.search(label):
            s, ring = _outline(road, item, place)
            areas += [AreaGeometry("crossing", ring)] if ring is not None else []
            events += _at(EventKind.CROSSING, s, item, tracks)
        elif _STOP_LINE.search(label):
            events += _at(EventKind.STOP_LINE, _outline(road, item, place)[0], item, tracks)
    for bridge in road.element.iterfind("objects/bridge"):
        place = f"{road.place}, bridge {bridge.get('id', '')[:40]}"
        start = attribute(bridge, "s", place)
        ring = _carriageway(road, grid, start, start + attribute(bridge, "length", place))
        areas += [AreaGeometry("bridge", ring)] if ring is not None else []
    return Furniture(events, areas)


def _along(road: Road, track: Track) -> list[EventGeometry]:
    """Changes of the speed limit along a lane, and its end at a junction."""
    lane, found = track.geometry, []
    assert lane.centre is not None
    assert lane.station_m is not None
    if lane.speed_limit_m_s is not None:
        speed = lane.speed_limit_m_s
        for i in np.flatnonzero((speed[1:] != speed[:-1]) & np.isfinite(speed[1:])) + 1:
            found.append(_event(EventKind.SPEED_LIMIT, lane.centre[i], lane.name, round(speed[i] * 3.6, 1)))
    end = road.curve.end_s if track.forward else 0.0
    meets = road.ends_at_junction if track.forward else road.starts_at_junction
    if meets and road.junction is None and abs(lane.station_m[-1] - end) <= MAX_STEP_M:
        found.append(_event(EventKind.JUNCTION, lane.centre[-1], lane.name))
    return found


def _event(kind: EventKind, point: Floats, lane: str, value: float | None = None) -> EventGeometry:
    return EventGeometry(kind, (float(point[0]), float(point[1])), lane, value)


def _signal(
    holder: ET.Element, signal: ET.Element, tracks: list[Track], events: list[EventGeometry], place: str
) -> list[EventGeometry]:
    country = signal.get("country", "").upper() or "OPENDRIVE"
    sign = (country, signal.get("type", ""))
    kinds = (
        (_STOP_SIGNS, EventKind.STOP_LINE),
        (_SPEED_SIGNS, EventKind.SPEED_LIMIT),
        (_CROSSING_SIGNS, EventKind.CROSSING),
    )
    kind = next((kind for signs, kind in kinds if sign in signs), None)
    if kind is None:
        return []
    s = attribute(holder, "s", place)
    if kind is not EventKind.SPEED_LIMIT:
        return _at(kind, (s, s), holder, tracks)
    speed = ET.Element("speed", max=signal.get("value", ""), unit=signal.get("unit", _sign_unit(country)))
    limit_m_s = speed_m_s(speed, place)
    if math.isnan(limit_m_s):
        return []
    known = [(event.lane, event.point) for event in events if event.kind is kind]
    found = _at(kind, (s, s), holder, tracks, round(limit_m_s * 3.6, 1))
    return [
        event
        for event in found
        if not any(lane == event.lane and math.dist(point, event.point) <= _SAME_PLACE_M for lane, point in known)
    ]


def _sign_unit(country: str) -> str:
    return "mph" if country == "US" else "km/h"


def _at(
    kind: EventKind, span: tuple[float, float], holder: ET.Element, tracks: list[Track], value: float | None = None
) -> list[EventGeometry]:
    """Events on the lanes that the object or signal applies to, where vehicles reach it."""
    orientation = holder.get("orientation", "none")
    validity = [
        (int(low), int(high))
        for element in holder.iterfind("validity")
        if _whole(low := element.get("fromLane", "")) and _whole(high := element.get("toLane", ""))
    ]
    found = []
    for track in tracks:
        s = span[0] if track.forward else span[1]
        lane_id, point = track.lane_id_at(s), track.point_at(s)
        if point is None or lane_id is None or orientation == ("-" if track.forward else "+"):
            continue
        if not validity or any(min(pair) <= lane_id <= max(pair) for pair in validity):
            found.append(_event(kind, np.array(point), track.geometry.name, value))
    return found


def _whole(text: str) -> bool:
    return re.fullmatch(r"-?[0-9]{1,9}", text) is not None


def _outline(road: Road, item: ET.Element, place: str) -> tuple[tuple[float, float], Floats | None]:
    """Extent along the road, and closed ring of an object, None where it has no area."""
    s, t = attribute(item, "s", place), attribute(item, "t", place, 0.0)
    corners = [(attribute(c, "s", place), attribute(c, "t", place)) for c in _corners(item, "cornerRoad")]
    local = [(attribute(c, "u", place), attribute(c, "v", place)) for c in _corners(item, "cornerLocal")]
    if not corners and not local:
        length, width = attribute(item, "length", place, 0.0) / 2.0, attribute(item, "width", place, 0.0) / 2.0
        local = [(-length, -width), (length, -width), (length, width), (-length, width)] if length and width else []
    if corners:
        ring = _points(road, np.array([c[0] for c in corners]), np.array([c[1] for c in corners]))
        span = [c[0] for c in corners]
    else:
        turn = attribute(item, "hdg", place, 0.0)
        uv = np.array(local or [(0.0, 0.0)])
        along = uv[:, 0] * math.cos(turn) - uv[:, 1] * math.sin(turn)
        across = uv[:, 0] * math.sin(turn) + uv[:, 1] * math.cos(turn)
        frame = road.curve.evaluate(np.array([s]), road.curve.piece_at(np.array([s])))
        cos, sin = math.cos(frame.hdg[0]), math.sin(frame.hdg[0])
        x, y = along, across + t
        ring = np.stack([frame.x[0] + x * cos - y * sin, frame.y[0] + x * sin + y * cos], axis=1)
        span = [s + float(value) for value in along]
    low, high = max(min(span), 0.0), min(max(span), road.curve.end_s)
    return (low, max(low, high)), np.concatenate([ring, ring[:1]]) if len(ring) >= 3 else None


def _corners(item: ET.Element, tag: str) -> list[ET.Element]:
    """Corners of the first outline that has some: of `outline`, or of `outlines`, which 1.5 brought."""
    outlines = [*item.iterfind("outline"), *item.iterfind("outlines/outline")]
    return next((found for outline in outlines if (found := outline.findall(tag))), [])


def _points(road: Road, s: Floats, t: Floats) -> Floats:
    frame = road.curve.evaluate(s, road.curve.piece_at(s))
    return np.stack([frame.x - np.sin(frame.hdg) * t, frame.y + np.cos(frame.hdg) * t], axis=1)


def _carriageway(road: Road, grid: Grid, start: float, end: float) -> Floats | None:
    """Ring about all lanes between two distances along the road."""
    sides: tuple[list[Floats], list[Floats]] = ([], [])
    for number, section in enumerate(road.sections):
        rows = grid.rows(number, grid.interval)
        inside = (grid.s[rows] >= start) & (grid.s[rows] <= end)
        s = np.unique(np.concatenate([[max(start, section.start)], grid.s[rows][inside], [min(end, section.end)]]))
        if min(end, section.end) <= max(start, section.start):
            continue
        lookup = np.clip(s, section.start, section.end - 1e-9)
        offset = road.offset.at(s, lookup)
        edges = [outer[0] for _, _, outer in lane_edges(section, offset, s, lookup)] + [offset[0]]
        sides[0].append(_points(road, s, np.max(edges, axis=0)))
        sides[1].append(_points(road, s, np.min(edges, axis=0)))
    if not sides[0]:
        return None
    ring = np.concatenate([*sides[1], np.concatenate(sides[0])[::-1]])
    return np.concatenate([ring, ring[:1]])


# === A file of OpenDRIVE.


NEWEST = (1, 8)
"""Newest revision of OpenDRIVE that is read, major and minor."""
MAX_WARNINGS = 100
"""Warnings that are kept, the number of the others in one more."""
Offset = tuple[float, float, float, float]
"""header/offset: x, y, z [m], hdg [rad]."""


def read_opendrive(data: bytes) -> AlignmentFile:
    """Lanes that vehicles drive on, stop lines, crossings, speed limits and bridges of an OpenDRIVE file (1.4 to 1.8).

    Every lane has the direction in which vehicles drive on it, by the road's rule (right-hand traffic without one), and
    is named by its road and lane number. Sections are joined where the file links them; roads are not. The stations are
    distances along the road's reference line. header/offset is applied only where the geoReference is usable.

    Returns
    -------
    AlignmentFile
        `crs_problem` where the geoReference does not place the road on Earth.

    Raises
    ------
    UnreadableUpload
        It is no OpenDRIVE, is damaged, or contradicts itself; the message names road and place.
    """
    root = parse_xml(data, "OpenDRIVE")
    roads = [parse_road(element) for element in root.iterfind("road")]
    if not roads:
        raise UnreadableUpload("the file has no road", field="file", limit="one or more", cure="export it again")
    if len({road.id for road in roads}) < len(roads):
        ids = [road.id for road in roads]
        twice = next(road_id for road_id in ids if ids.count(road_id) > 1)
        raise UnreadableUpload(
            f"the road id {twice!r} occurs twice",
            field="file",
            limit="one road per id",
            cure="give each road an id of its own",
        )
    names = _road_names(roads)
    has_heights = any(len(road.elevation.starts) for road in roads)
    signals = {signal.get("id", ""): signal for signal in root.iterfind("road/signals/signal")}
    lanes: list[Track] = []
    furniture = Furniture([], [])
    taken: set[str] = set()
    vertices = 0
    for road in roads:
        if not road.sections:
            road.warnings.append(f"{road.place}: it has no lane section; it is left out.")
            continue
        grid = Grid(road)
        tracks = build_tracks(road, grid, taken, names[road.id])
        vertices += sum(len(_centre(track)) for track in tracks)
        if vertices > MAX_VERTICES:
            raise UnreadableUpload(
                f"the lanes need more than {MAX_VERTICES} vertices",
                field="file",
                limit=f"{MAX_VERTICES} vertices",
                cure="cut the road into parts",
            )
        lanes += tracks
        furniture += find_furniture(road, grid, tracks, signals)
    if not lanes:
        raise UnreadableUpload(
            "the file has no lane that vehicles drive on", field="file", limit="type driving", cure="export lane types"
        )
    return _place(root, lanes, furniture, roads, has_heights)


def _place(
    root: ET.Element, lanes: list[Track], furniture: Furniture, roads: list[Road], has_heights: bool
) -> AlignmentFile:
    offset = _header_offset(root)
    middle = np.mean([_centre(track)[[0, -1]].mean(axis=0) for track in lanes], axis=0)
    x, y = _moved(middle[None, :], offset)[0, :2]
    reference = root.find("header/geoReference")
    text = None if reference is None else "".join(reference.itertext())
    crs, problem = usable_crs(text, float(x), float(y))
    warnings = [*_newer_revision(root), *(warning for road in roads for warning in road.warnings)]
    if crs is None and any(offset):
        warnings.append("The header's offset is not applied, because the geoReference cannot be used.")
        offset = (0.0, 0.0, 0.0, 0.0)
    if len(warnings) > MAX_WARNINGS:
        warnings[MAX_WARNINGS:] = [f"There are {len(warnings) - MAX_WARNINGS} more warnings."]
    heights = 0.0 if has_heights else math.nan
    return AlignmentFile(
        format="opendrive",
        lanes=tuple(
            replace(track.geometry, centre=_moved(_centre(track) + np.array([0.0, 0.0, heights]), offset))
            for track in lanes
        ),
        crs=crs,
        crs_problem=problem,
        events=tuple(_moved_event(event, offset) for event in furniture.events),
        areas=tuple(AreaGeometry(area.kind, _moved(area.ring, offset)) for area in furniture.areas),
        warnings=tuple(warnings),
    )


def _newer_revision(root: ET.Element) -> list[str]:
    header = root.find("header")
    stated = [header.get(name, "").strip() if header is not None else "" for name in ("revMajor", "revMinor")]
    if not all(_whole(text) for text in stated) or tuple(map(int, stated)) <= NEWEST:
        return []
    newest = ".".join(map(str, NEWEST))
    return [
        f"The file has revision {'.'.join(stated)} of OpenDRIVE, which is newer than {newest}. What newer revisions "
        "changed is not read; compare the lanes with a map."
    ]


def _centre(track: Track) -> Floats:
    assert track.geometry.centre is not None
    return track.geometry.centre


def _road_names(roads: list[Road]) -> dict[str, str]:
    """Names of the file where they are unique, by road id."""
    given = [road.name for road in roads]
    return {road.id: road.name if road.name and given.count(road.name) == 1 else road.place for road in roads}


def _header_offset(root: ET.Element) -> Offset:
    element = root.find("header/offset")
    if element is None:
        return 0.0, 0.0, 0.0, 0.0
    x, y, z, hdg = (attribute(element, name, "header offset", 0.0) for name in ("x", "y", "z", "hdg"))
    return x, y, z, hdg


def _moved(points: Floats, offset: Offset) -> Floats:
    """Points (N, 2 or 3) translated, then turned about the new origin."""
    x, y, z, hdg = offset
    cos, sin = math.cos(hdg), math.sin(hdg)
    moved = points.copy()
    moved[:, 0] = x + cos * points[:, 0] - sin * points[:, 1]
    moved[:, 1] = y + sin * points[:, 0] + cos * points[:, 1]
    if points.shape[1] > 2:
        moved[:, 2] += z
    return moved


def _moved_event(event: EventGeometry, offset: Offset) -> EventGeometry:
    x, y = _moved(np.array([event.point]), offset)[0]
    return replace(event, point=(float(x), float(y)))
