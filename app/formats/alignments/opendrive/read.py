"""A file of OpenDRIVE: its roads and what lies on them, in the coordinates that it states."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np

from app.errors import UnreadableUpload
from app.formats.alignments.geometry import MAX_VERTICES, AlignmentFile, AreaGeometry, EventGeometry, Floats
from app.formats.alignments.georeference import usable_crs
from app.formats.alignments.opendrive.furniture import Furniture, find_furniture
from app.formats.alignments.opendrive.lanes import Grid, Track, build_tracks
from app.formats.alignments.opendrive.road import Road, parse_road
from app.formats.xml_tree import attribute, parse_xml

MAX_WARNINGS = 100
"""Warnings that are kept, the number of the others in one more. Source: chosen by hand."""
Offset = tuple[float, float, float, float]
"""header/offset: x, y, z [m], hdg [rad]."""


def read_opendrive(data: bytes) -> AlignmentFile:
    """Lanes that vehicles drive on, stop lines, crossings, speed limits and bridges of an OpenDRIVE file (1.4 to 1.7).

    Every lane has the direction in which vehicles drive on it, by the road's rule (right-hand traffic without one), and
    is named by its road and lane number. Sections are joined where the file links them; roads are not. The stations are
    distances along the road's reference line. header/offset is applied only where the geoReference is usable.

    Parameters
    ----------
    data : bytes

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
            f"the road id {twice!r} stands twice", field="file", limit="one road per id", cure="number the roads anew"
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
    warnings = [warning for road in roads for warning in road.warnings]
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
