"""Roads as DXF: polylines with true arcs, lines and arcs; their layers decide what they are.

A layer that is named after areas (joints, manholes, crossings, bridges) or after events (stop_line, arrow, ...) holds
these; every other layer holds lanes. A layer whose name ends with left or right holds boundaries of the lane that the
rest of the name gives. Layers of bound external references are named ``plan$0$LANE``; the part after the last $ counts.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
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
from app.formats.alignments.geometry import (
    CHORD_ERROR_M,
    MAX_VERTICES,
    AlignmentDeclaration,
    AlignmentFile,
    unit_length_m,
)
from app.formats.surveys.declaration import METRES
from app.formats.surveys.dxf_reader import drawn_entities, hidden_layers, insertion_point, open_dxf, reading_dxf
from app.formats.text import count_of
from app.values import Floats

NAME_DISTANCE_M = 10.0
"""Farthest distance of a text from the line that it names. [m] Three lane widths."""
_SIDE = re.compile(r"(?P<lane>.*?)[ _.:-]*(?P<side>left|right|_l|_r|-l|-r)", re.IGNORECASE)
_BOUND = re.compile(r".*\$[0-9]+\$")  # in names of layers: where an external reference was bound
_LINES = frozenset({"LINE", "ARC", "CIRCLE", "LWPOLYLINE", "POLYLINE"})
_LABELS = frozenset({"TEXT", "MTEXT", "INSERT", "POINT"})
_FLAT = 1e-6  # [unit] rise of an arc above its chord below which it is a line; source: far below a survey's accuracy
_OTHER_CURVES = {
    "SPLINE": "splines", "ELLIPSE": "ellipses", "HELIX": "helices", "MLINE": "multilines",
    "ACAD_PROXY_ENTITY": "objects of other programs", "AECC_ALIGNMENT": "Civil 3D alignments",
}  # fmt: skip
SYMBOL_M = 5.0
"""Blocks whose drawing is smaller are symbols, whose lines are no lanes. [m] Source: as the shortest lane,
`app.planning.build_alignment`."""
_SYMBOL_ENTITIES = 200  # greatest number in a block that can be a symbol; bounds the time of measuring it
_FRAME = 16  # flag of vertices of the frame of a spline, which are not on the line; source: DXF reference, VERTEX


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


class _Blocks:
    """Which block references are opened for the lines in them, and what is reported of the others."""

    def __init__(self, unit_m: float) -> None:
        self.unit_m = unit_m
        self.symbols: list[str] = []
        self.external: list[str] = []
        self.clipped: list[str] = []
        self._sizes: dict[str, float] = {}  # [unit] of blocks that can be symbols, infinite for others

    def is_opened(self, insert: Any, layer: str) -> bool:
        from ezdxf.xclip import XClip

        kind, name, block = normalize_kind(_own_name(layer)), str(insert.dxf.name), insert.block()
        if kind in EVENT_KINDS:
            return False  # the reference itself is the event
        if block.block.is_xref or block.block.is_xref_overlay:
            self.external.append(name)
            return False
        if name not in self._sizes:
            self._sizes[name] = _symbol_size(block)
        scale = max(abs(insert.dxf.get(axis, 1.0)) for axis in ("xscale", "yscale"))
        if self._sizes[name] * scale * self.unit_m < SYMBOL_M and area_kind(kind) not in AREA_KINDS:
            self.symbols.append(name)
            return False
        clip = XClip(insert)
        if clip.has_clipping_path and clip.is_clipping_enabled:
            self.clipped.append(name)
        return True

    def notes(self) -> Iterator[str]:
        """Sentences about what is left out."""
        if self.external:
            yield (
                f"{count_of(len(self.external), 'reference')} to other drawings left out, the first is "
                f"{self.external[0][:80]}; bind them (XREF, Bind) and export the drawing again."
            )
        if self.symbols:
            yield (
                f"{count_of(len(self.symbols), 'block reference')} smaller than {SYMBOL_M:g} m left out as symbols, "
                f"the first is {self.symbols[0][:80]}."
            )
        if self.clipped:
            yield (
                f"{count_of(len(self.clipped), 'clipped block reference')} (XCLIP) read whole, the first is "
                f"{self.clipped[0][:80]}."
            )


def _symbol_size(block: Any) -> float:
    """Diagonal of a block; infinite if it cannot be a symbol, because of its size or of layers of areas or events.

    A symbol holds other blocks once and one level deep, so that few entities are measured.
    """
    from ezdxf import bbox

    inner = [entity for entity in block if entity.dxftype() == "INSERT"]
    blocks = [one.block() or () for one in inner]
    if any(one.mcount > 1 for one in inner) or any(entity.dxftype() == "INSERT" for one in blocks for entity in one):
        return math.inf
    if len(block) + sum(len(one) for one in blocks) > _SYMBOL_ENTITIES:
        return math.inf
    kinds = {normalize_kind(_own_name(str(entity.dxf.layer))) for entity in block}
    if any(kind in EVENT_KINDS or area_kind(kind) in AREA_KINDS for kind in kinds):
        return math.inf
    box = bbox.extents((entity for entity in block if entity.dxftype() in _LINES | {"INSERT"}), fast=True)
    return float(box.size.magnitude) if box.has_data else 0.0


def _own_name(layer: str) -> str:
    """Name of a layer in the drawing that it is from."""
    return _BOUND.sub("", layer) or layer


def read_dxf(data: bytes, declaration: AlignmentDeclaration | None = None) -> AlignmentFile:
    """A road of the model space. Lines and arcs that meet end to end are one lane; texts name the nearest line.

    Blocks are read where they are inserted, except symbols. What CAD does not draw, on frozen or switched-off layers,
    is left out. A declared unit counts more than $INSUNITS, as for surveys.

    Raises
    ------
    UnreadableUpload
        It is no ASCII DXF, has units that no survey has, or no lines.
    InvalidParameter
        A geometry cannot be used; the message names the layer.
    """
    declaration = declaration or AlignmentDeclaration()
    paths: list[_Path] = []
    labels: list[_Label] = []
    others: list[tuple[str, str]] = []
    hidden: set[str] = set()
    spelled: dict[str, str] = {}
    with reading_dxf():
        document, unit = open_dxf(data, is_declared=declaration.unit is not None)
        unit_m, notes = _unit(document, unit, declaration)
        blocks = _Blocks(unit_m or 1.0)
        for entity, layer in drawn_entities(
            document, _LINES | _LABELS | _OTHER_CURVES.keys(), blocks.is_opened, hidden
        ):
            kind, own = entity.dxftype(), _own_name(layer)
            own = spelled.setdefault(own.lower(), own)  # the case of names of layers does not count
            if kind in _LINES:
                paths += _paths(entity, own, unit_m or 1.0)
            elif kind in _LABELS:
                labels.append(_label(entity, own))
            else:
                others.append((kind, own))
        for path in paths:
            check_vertices(path.vertices, f"layer {path.layer}")
    check_counts(len(paths) + len(labels), sum(len(path.vertices) for path in paths))
    notes += [*_leave_out_zero_heights(paths), *blocks.notes()]
    if hidden:
        notes.append(hidden_layers(hidden))
        if not paths:
            raise UnreadableUpload(
                f"the DXF has no lines that are drawn. {notes[-1]}",
                field="file",
                limit="lines on layers that are drawn",
                cure="thaw and switch on the layers of the lanes, and export the drawing again",
            )
    if others:
        kinds = " and ".join(dict.fromkeys(_OTHER_CURVES[kind] for kind, _layer in others))
        notes.append(
            f"left out: {kinds} ({len(others)} in all), the first on layer {others[0][1]}; export them as polylines"
        )
    features = list(_features(paths, labels, unit_m or 1.0))
    return assemble_road("dxf", features, unit_m=unit_m, warnings=notes)


# --- entities ---------------------------------------------------------------------------------------------------------


def _unit(
    document: Any, unit: tuple[str, float] | None, declaration: AlignmentDeclaration
) -> tuple[float | None, list[str]]:
    """Length of the drawing's unit [m], and notes on it."""
    if unit is None:
        note = "the DXF states no unit ($INSUNITS); that of the CRS is used, or metres"
        return (METRES[declaration.unit], []) if declaration.unit is not None else (None, [note])
    stated_m, notes = unit_length_m(unit, declaration, None)
    if declaration.unit is None or abs(stated_m / METRES[declaration.unit] - 1) < 1e-9:
        return stated_m, notes
    return METRES[declaration.unit], [
        f"The unit of the drawing is {stated_m:.9g} m ($INSUNITS {document.header['$INSUNITS']}); the coordinates were "
        f"read in the declared unit, {declaration.unit}."
    ]


def _paths(entity: Any, layer: str, unit_m: float) -> Iterator[_Path]:
    kind = entity.dxftype()
    if kind == "LINE":
        ends = np.array([entity.dxf.start, entity.dxf.end], dtype=np.float64)
        yield _Path(layer, ends, np.zeros(2), True, False)
        return
    mirrored = _is_mirrored(entity, layer)
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
        on_line = [vertex for vertex in entity.vertices if not vertex.dxf.flags & _FRAME]
        points = np.array([vertex.dxf.location for vertex in on_line], dtype=np.float64).reshape(-1, 3)
        bulges = np.array([vertex.dxf.get("bulge", 0.0) for vertex in on_line], dtype=np.float64)
        if entity.is_2d_polyline:
            points[:, 2] = float(entity.dxf.elevation[2])
    closed = bool(entity.is_closed)
    if closed and len(points) > 1:
        points, bulges = np.concatenate([points, points[:1]]), np.concatenate([bulges, [0.0]])
    return points, bulges, closed


def _is_mirrored(entity: Any, layer: str) -> bool:
    """Whether its plane is seen from below: AutoCAD's MIRROR draws polylines so."""
    x, y, z = entity.dxf.get("extrusion", (0.0, 0.0, 1.0))
    if abs(x) > 1e-6 or abs(y) > 1e-6:
        raise UnreadableUpload(
            f"the DXF has a {entity.dxftype()} on layer {layer} that does not lie flat",
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


def _label(entity: Any, layer: str) -> _Label:
    kind = entity.dxftype()
    if kind == "INSERT":
        values = {str(attribute.dxf.tag).lower(): str(attribute.dxf.text) for attribute in entity.attribs}
        text = values.get("value", "")
    elif kind == "POINT":
        text = ""
    else:
        text = entity.plain_text() if kind == "MTEXT" else entity.dxf.text
    return _Label(layer, " ".join(str(text).split())[:120], insertion_point(entity) or (math.nan,) * 3)


def _leave_out_zero_heights(paths: list[_Path]) -> Iterator[str]:
    """Lines of lanes at height 0 have no heights if others have some: they are drawn in plan."""
    of_lanes = [k for k, path in enumerate(paths) if _is_of_lanes(path.layer)]
    flat = [k for k in of_lanes if not paths[k].vertices[:, 2].any()]
    if not flat or len(flat) == len(of_lanes):
        return
    for k in flat:
        paths[k] = replace(paths[k], vertices=paths[k].vertices * (1.0, 1.0, math.nan))
    yield (
        f"{count_of(len(flat), 'line')} at height 0 read without heights, because other lines have heights; the first "
        f"is on layer {paths[flat[0]].layer}."
    )


def _is_of_lanes(layer: str) -> bool:
    kind = normalize_kind(layer)
    return kind not in EVENT_KINDS and area_kind(kind) not in AREA_KINDS


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
