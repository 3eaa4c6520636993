"""Roads as DXF: polylines with true arcs, lines and arcs; their layers decide what they are.

A layer that is named after areas (joints, manholes, crossings, bridges) or after events (stop_line, arrow, ...) holds
these; every other layer holds lanes. A layer whose name ends with left or right holds boundaries of the lane that the
rest of the name gives.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from app.errors import UnreadableUpload
from app.formats.alignments.features import (
    AREA_KINDS,
    EVENT_KINDS,
    Link,
    RoadFeature,
    Shape,
    area_kind,
    assemble_road,
    chain_parts,
    check_counts,
    check_vertices,
    normalize_kind,
    turned_part,
)
from app.formats.alignments.geometry import CHORD_ERROR_M, MAX_VERTICES, AlignmentFile
from app.formats.surveys.declaration import FEET, METRES
from app.formats.surveys.dxf_reader import open_dxf, reading_dxf
from app.values import Floats

NAME_DISTANCE_M = 10.0
"""Farthest distance of a text from the line that it names. [m] Three lane widths."""
_SIDE = re.compile(r"(?P<lane>.*?)[ _.:-]*(?P<side>left|right|_l|_r|-l|-r)", re.IGNORECASE)
_LINES = "LINE ARC CIRCLE LWPOLYLINE POLYLINE"
_FLAT = 1e-6  # [unit] rise of an arc above its chord below which it is a line; source: far below a survey's accuracy
_OTHER_CURVES = ("SPLINE", "ELLIPSE", "HELIX")


@dataclass(frozen=True, slots=True, eq=False)
class _Path:
    """A line of an entity with the curvature at its vertices; reversible if its direction is not drawn."""

    layer: str
    vertices: Floats
    curvature: Floats
    reversible: bool
    closed: bool


@dataclass(frozen=True, slots=True)
class _Label:
    """A text or a block, at its insertion point."""

    layer: str
    text: str
    point: tuple[float, float, float]


def read_dxf(data: bytes) -> AlignmentFile:
    """A road of the model space. Lines and arcs that meet end to end are one lane; texts name the nearest line.

    Raises
    ------
    UnreadableUpload
        It is no ASCII DXF, has units that no survey has, or no lines.
    InvalidParameter
        A geometry cannot be used; the message names the layer.
    """
    with reading_dxf():
        document, unit = open_dxf(data)
        unit_m = None if unit is None else METRES["ft-intl" if unit[0] == FEET else unit[0]] * unit[1]
        space = document.modelspace()
        paths = [path for entity in space.query(_LINES) for path in _paths(entity, unit_m or 1.0)]
        for path in paths:
            check_vertices(path.vertices, f"layer {path.layer}")
        labels = list(_labels(space))
        others = [entity.dxf.layer for entity in space.query(" ".join(_OTHER_CURVES))]
    check_counts(len(paths) + len(labels), sum(len(path.vertices) for path in paths))
    notes = []
    if unit is None:
        notes.append("the DXF states no unit ($INSUNITS); that of the CRS is used, or metres")
    if others:
        notes.append(
            f"{len(others)} splines and ellipses are left out, the first on layer {others[0]}; export them as polylines"
        )
    features = list(_features(paths, labels, unit_m or 1.0))
    return assemble_road("dxf", features, unit_m=unit_m, warnings=notes)


# --- entities ---------------------------------------------------------------------------------------------------------


def _paths(entity: Any, unit_m: float) -> Iterator[_Path]:
    kind, layer = entity.dxftype(), str(entity.dxf.layer)
    if kind == "LINE":
        ends = np.array([entity.dxf.start, entity.dxf.end], dtype=np.float64)
        yield _Path(layer, ends, np.zeros(2), True, False)
        return
    mirrored = _is_mirrored(entity)
    if kind in ("ARC", "CIRCLE"):
        start, end = (entity.dxf.start_angle, entity.dxf.end_angle) if kind == "ARC" else (0.0, 360.0)
        turn = math.radians((end - start) % 360.0 or 360.0)
        centre, radius = np.array(entity.dxf.center, dtype=np.float64), float(entity.dxf.radius)
        if 0 < radius < math.inf and math.isfinite(turn):
            arc = _arc(centre, radius, math.radians(start), turn, unit_m)
            yield _Path(layer, *_unmirrored(arc, np.full(len(arc), 1 / radius), mirrored), kind == "ARC", kind != "ARC")
        return
    points, bulges, closed = _polyline(entity)
    if len(points) > 1:
        vertices, curvature = _with_arcs(points, bulges, unit_m)
        yield _Path(layer, *_unmirrored(vertices, curvature, mirrored), False, closed)


def _polyline(entity: Any) -> tuple[Floats, Floats, bool]:
    """Vertices, the bulge of the piece after each, and whether it is closed."""
    if entity.dxftype() == "LWPOLYLINE":
        rows = np.array(entity.get_points("xyb"), dtype=np.float64).reshape(-1, 3)
        points = np.column_stack([rows[:, :2], np.full(len(rows), float(entity.dxf.elevation))])
        bulges = rows[:, 2]
    else:
        if not (entity.is_2d_polyline or entity.is_3d_polyline):
            return np.zeros((0, 3)), np.zeros(0), False  # a mesh
        points = np.array([vertex.dxf.location for vertex in entity.vertices], dtype=np.float64).reshape(-1, 3)
        bulges = np.array([vertex.dxf.get("bulge", 0.0) for vertex in entity.vertices], dtype=np.float64)
        if entity.is_2d_polyline:
            points[:, 2] = float(entity.dxf.elevation[2])
    closed = bool(entity.is_closed)
    if closed and len(points) > 1:
        points, bulges = np.concatenate([points, points[:1]]), np.concatenate([bulges, [0.0]])
    return points, bulges, closed


def _is_mirrored(entity: Any) -> bool:
    """Whether its plane is seen from below: AutoCAD's MIRROR draws polylines so."""
    x, y, z = entity.dxf.get("extrusion", (0.0, 0.0, 1.0))
    if abs(x) > 1e-6 or abs(y) > 1e-6:
        raise UnreadableUpload(
            f"the DXF has a {entity.dxftype()} on layer {entity.dxf.layer} that does not lie flat",
            field="file",
            limit="entities in plan",
            cure="flatten the drawing, or export it with 3D polylines",
        )
    return bool(z < 0)


def _unmirrored(vertices: Floats, curvature: Floats, mirrored: bool) -> tuple[Floats, Floats]:
    return (vertices * (-1.0, 1.0, -1.0), -curvature) if mirrored else (vertices, curvature)


def _with_arcs(points: Floats, bulges: Floats, unit_m: float) -> tuple[Floats, Floats]:
    """Vertices with arcs sampled within 1 mm, and curvature [1/unit], with two values where it jumps.

    A bulge is the tangent of a quarter of the arc's angle, positive for left turns (DXF reference, LWPOLYLINE).
    """
    if not bulges[:-1].any():
        return points, np.zeros(len(points))
    if not (np.isfinite(points).all() and np.isfinite(bulges).all()):
        raise ValueError("a coordinate or a bulge is not finite")
    pieces, curvature = [], []
    for start, end, bulge in zip(points[:-1], points[1:], bulges[:-1].tolist(), strict=True):
        chord = end[:2] - start[:2]
        length = float(np.hypot(*chord))
        if abs(bulge) * length / 2 < _FLAT:
            pieces.append(np.stack([start, end]))
            curvature.append(np.zeros(2))
            continue
        radius = length * (1 + bulge**2) / (4 * bulge)  # signed
        across = np.array([-chord[1], chord[0]]) * (1 - bulge**2) / (4 * bulge)
        centre = np.array([*((start[:2] + end[:2]) / 2 + across), start[2]])
        first = math.atan2(*(start[:2] - centre[:2])[::-1])
        arc = _arc(centre, abs(radius), first, 4 * math.atan(bulge), unit_m)
        arc[0, :2], arc[-1, :2] = start[:2], end[:2]
        arc[:, 2] = np.linspace(start[2], end[2], len(arc))
        pieces.append(arc)
        curvature.append(np.full(len(arc), 1 / radius))
    return np.concatenate(pieces), np.concatenate(curvature)


def _arc(centre: Floats, radius: float, start_rad: float, turn_rad: float, unit_m: float) -> Floats:
    sagitta = min(CHORD_ERROR_M / unit_m / radius, 1.0)
    steps = max(2.0, abs(turn_rad) / (4 * math.asin(math.sqrt(sagitta / 2))))
    if not steps < MAX_VERTICES:
        raise ValueError(f"an arc has a radius of {radius:g}")
    angles = start_rad + np.linspace(0.0, turn_rad, math.ceil(steps) + 1)
    flat = centre[:2] + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.column_stack([flat, np.full(len(flat), centre[2])])


def _labels(space: Any) -> Iterator[_Label]:
    for entity in space.query("TEXT MTEXT INSERT POINT"):
        kind = entity.dxftype()
        if kind == "INSERT":
            values = {str(attribute.dxf.tag).lower(): str(attribute.dxf.text) for attribute in entity.attribs}
            text = values.get("value", "")
        elif kind == "POINT":
            text = ""
        else:
            text = entity.plain_text() if kind == "MTEXT" else entity.dxf.text
        place = entity.dxf.location if kind == "POINT" else entity.dxf.insert
        point = (float(place[0]), float(place[1]), float(place[2]))
        yield _Label(str(entity.dxf.layer), " ".join(str(text).split())[:120], point)


# --- features ---------------------------------------------------------------------------------------------------------


def _features(paths: Sequence[_Path], labels: Sequence[_Label], unit_m: float) -> Iterator[RoadFeature]:
    for layer in dict.fromkeys((*(path.layer for path in paths), *(label.layer for label in labels))):
        own = [path for path in paths if path.layer == layer]
        texts = [label for label in labels if label.layer == layer]
        kind = normalize_kind(layer)
        if area_kind(kind) in AREA_KINDS and kind not in EVENT_KINDS:
            yield from _areas(layer, own)
        elif kind in EVENT_KINDS:
            yield from _events(layer, own, texts)
        else:
            yield from _lanes(layer, own, texts, unit_m)


def _areas(layer: str, paths: Iterable[_Path]) -> Iterator[RoadFeature]:
    for number, path in enumerate(paths, 1):
        closed = path.closed or bool(np.array_equal(path.vertices[0, :2], path.vertices[-1, :2]))
        shape = Shape.AREA if closed and len(path.vertices) > 3 else Shape.LINE
        yield RoadFeature(f"layer {layer}, entity {number}", shape, (path.vertices,), {}, layer)


def _events(layer: str, paths: Iterable[_Path], labels: Sequence[_Label]) -> Iterator[RoadFeature]:
    for number, path in enumerate(paths, 1):
        yield RoadFeature(f"layer {layer}, line {number}", Shape.LINE, (path.vertices,), {}, layer)
    for number, label in enumerate(labels, 1):
        properties = {"value": label.text} if label.text else {}
        yield RoadFeature(f"layer {layer}, point {number}", Shape.POINT, (np.array([label.point]),), properties, layer)


def _lanes(layer: str, paths: Sequence[_Path], labels: Sequence[_Label], unit_m: float) -> Iterator[RoadFeature]:
    if not paths:
        return
    vertices = [path.vertices for path in paths]
    chains = chain_parts(vertices, geographic=False, unit_m=unit_m, reversible=[path.reversible for path in paths])
    lines = [_chained(paths, chain, unit_m) for chain in chains]
    names = _names(layer, [line for line, _curvature in lines], labels, unit_m)
    side = _SIDE.fullmatch(layer)
    for number, ((line, curvature), name) in enumerate(zip(lines, names, strict=True), 1):
        properties = {"kind": "lane", "lane": name}
        if side is not None:
            lane = name if name != layer and len(lines) > 1 else side["lane"] or "1"
            properties |= {"side": side["side"].strip("_-"), "lane": lane}
        yield RoadFeature(f"layer {layer}, line {number}", Shape.LINE, (line,), properties, layer, curvature)


def _chained(paths: Sequence[_Path], chain: Sequence[Link], unit_m: float) -> tuple[Floats, Floats | None]:
    """Vertices of a chain, and curvature if it has an arc. [1/m]"""
    curved = any(paths[link.part].curvature.any() for link in chain)
    skip = 0 if curved else 1  # where curvature jumps the vertex stands twice
    parts = [turned_part(paths[link.part].vertices, link)[skip if k else 0 :] for k, link in enumerate(chain)]
    if not curved:
        return np.concatenate(parts), None
    signs = [-1.0 if link.turned else 1.0 for link in chain]
    values = [turned_part(paths[link.part].curvature, link) * s for link, s in zip(chain, signs, strict=True)]
    return np.concatenate(parts), np.concatenate(values) / unit_m


def _names(layer: str, lines: Sequence[Floats], labels: Sequence[_Label], unit_m: float) -> list[str]:
    """For each line the nearest text within reach, else the layer; numbered where names repeat."""
    names = [layer] * len(lines)
    best = [NAME_DISTANCE_M / unit_m] * len(lines)
    for label in labels:
        if not label.text:
            continue
        away = [_distance(line, label.point) for line in lines]
        nearest = int(np.argmin(away))
        if away[nearest] <= best[nearest]:
            best[nearest], names[nearest] = away[nearest], label.text
    times = {name: names.count(name) for name in names}
    numbers: dict[str, int] = {}
    unique = []
    for name in names:
        numbers[name] = numbers.get(name, 0) + 1
        unique.append(name if times[name] == 1 else f"{name} {numbers[name]}")
    return unique


def _distance(line: Floats, point: tuple[float, float, float]) -> float:
    """Of a point from a line. [unit]"""
    start, along = line[:-1, :2], np.diff(line[:, :2], axis=0)
    away = np.array(point[:2]) - start
    square = np.maximum((along**2).sum(axis=1), 1e-12)
    share = np.clip((away * along).sum(axis=1) / square, 0.0, 1.0)
    return float(np.hypot(*(away - share[:, None] * along).T).min())
