"""Valid DXF drawings with known lines and points, written as group codes, for `benchmarks.fuzz.grammar`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import cast

import numpy as np

from app.formats.alignments.geometry import AlignmentDeclaration, AlignmentFile
from app.formats.alignments.read import read_alignment
from app.formats.surveys.declaration import Unit
from app.formats.surveys.dxf_reader import read_dxf as read_survey
from app.values import Floats
from benchmarks.fuzz.courses import compare_warnings
from benchmarks.fuzz.grammar import Check, Rng

_FOOT_M, _US_FOOT_M = 0.3048, 1200.0 / 3937.0
_DECLARED = {"m": 1.0, "ft-us": _US_FOOT_M, "ft-intl": _FOOT_M}
_UNITS = {
    1: _FOOT_M / 12, 2: _FOOT_M, 3: 5280 * _FOOT_M, 4: 0.001, 5: 0.01, 6: 1.0, 7: 1000.0, 10: 3 * _FOOT_M, 14: 0.1,
    15: 10.0, 16: 100.0, 21: _US_FOOT_M, 22: _US_FOOT_M / 12, 23: 3 * _US_FOOT_M, 24: 5280 * _US_FOOT_M,
}  # fmt: skip
"""Metres to a unit of $INSUNITS. Source: Autodesk DXF reference, header variables."""
_NO_SURVEY = (8, 9, 11, 12, 13, 17, 18, 19, 20)  # from angstroms to parsecs
_FEET = (1, 2, 3, 10)  # which do not say which foot
_TOLERANCE_M = 2e-6
"""Greatest difference of places. [m] Doubles of projected coordinates have 1e-9 m, and matrices of blocks lose some."""
_SAMPLED_M = 1e-5  # [m] of the lines here from their arcs
_CHORD_M = 0.0011  # [m] of the promised 1 mm, and how it is measured here
_VERSIONS = ("AC1009", "AC1015", "AC1018", "AC1021", "AC1024", "AC1027", "AC1032")
_UTF8 = ("AC1021", "AC1024", "AC1027", "AC1032")
_EPSILON_M = 0.05  # [m] about joints, where the curvature jumps

Rows = list[tuple[int, object]]
"""Group codes with their values."""
Matrix = Floats
"""Shape (4, 4): world coordinates from those of a block."""


@dataclass(frozen=True, slots=True, eq=False)
class _Line:
    """Where a line is, densely sampled: shape (N, 3) [unit], and its curvature there, NaN at corners [1/unit]."""

    points: Floats
    curvature: Floats
    is_circle: bool = False  # which has no start and no direction

    def moved(self, matrix: Matrix) -> _Line:
        """The line as a block reference draws it."""
        points = self.points @ matrix[:3, :3].T + matrix[:3, 3]
        scale = math.sqrt(abs(float(np.linalg.det(matrix[:2, :2]))))
        side = math.copysign(1.0, float(np.linalg.det(matrix[:2, :2])))
        return _Line(points, self.curvature * side / scale, self.is_circle)


@dataclass(slots=True)
class _Drawing:
    """Parts of a file as they are written."""

    rng: Rng
    unit_m: float
    version: str
    layers: dict[str, tuple[int, int]] = field(default_factory=dict)  # flags and colour
    blocks: list[Rows] = field(default_factory=list)
    entities: Rows = field(default_factory=list)
    lanes: dict[str, list[_Line]] = field(default_factory=dict)  # by layer
    names: dict[str, str] = field(default_factory=dict)  # texts by layer
    hidden: set[str] = field(default_factory=set)
    warnings: list[str] = field(default_factory=list)

    def unit(self, metres: float) -> float:
        return metres / self.unit_m

    def text(self, code: int, codepage: str) -> bytes:
        """The whole file."""
        rows: Rows = [(0, "SECTION"), (2, "HEADER"), (9, "$ACADVER"), (1, self.version), (9, "$DWGCODEPAGE")]
        rows += [(3, codepage), (9, "$INSUNITS"), (70, code), (0, "ENDSEC"), (0, "SECTION"), (2, "TABLES")]
        rows += [(0, "TABLE"), (2, "LAYER"), (70, len(self.layers))]
        for name, (flags, colour) in self.layers.items():
            rows += [(0, "LAYER"), (2, name), (70, flags), (62, colour), (6, "CONTINUOUS")]
        rows += [(0, "ENDTAB"), (0, "ENDSEC"), (0, "SECTION"), (2, "BLOCKS")]
        for block in self.blocks:
            rows += block
        rows += [(0, "ENDSEC"), (0, "SECTION"), (2, "ENTITIES"), *self.entities, (0, "ENDSEC"), (0, "EOF")]
        newline = "\r\n" if self.rng.random() < 0.5 else "\n"
        text = "".join(f"{group:>3}{newline}{_value(value)}{newline}" for group, value in rows)
        if self.version in _UTF8:
            return text.encode()
        escaped = self.rng.random() < 0.5
        return "".join(f"\\U+{ord(c):04X}" if escaped and ord(c) > 127 else c for c in text).encode("cp1252")


def _value(value: object) -> str:
    return repr(float(value)) if isinstance(value, float) else str(value)


def write_dxf(rng: Rng) -> tuple[bytes, Check]:
    """Roads far from each other, each on its own layer, in the model space or in nested blocks."""
    code, declared, unit_m = _unit(rng)
    drawing = _Drawing(rng, unit_m, str(rng.choice(_VERSIONS)))
    if code in _FEET and declared is None:
        drawing.warnings.append("in feet without stating which")
    if code == 0 and declared is None:
        drawing.warnings.append("states no unit")
    if declared is not None and code and abs(_stated_m(code, declared) / _DECLARED[declared] - 1) > 1e-9:
        drawing.warnings.append("the coordinates were read in the declared unit")
    base = (500_000.0, 5_400_000.0) if rng.random() < 0.7 else (0.0, 0.0)
    heights = bool(rng.random() < 0.6)
    for number in range(int(rng.integers(1, 4))):
        place = (base[0] + 3000.0 * number, base[1] + float(rng.uniform(0, 500)))
        flat = not heights or bool(rng.random() < 0.2)
        _road(drawing, number, place, 0.0 if flat else float(rng.uniform(-20, 500)))
    _hidden(drawing)
    text = drawing.text(code, "ANSI_1252")

    def check() -> str:
        file = read_alignment(text, declaration=AlignmentDeclaration(unit=cast("Unit | None", declared)))
        return _compare(file, drawing, unit_m)

    return text, check


def _unit(rng: Rng) -> tuple[int, str | None, float]:
    """$INSUNITS, what is declared, and the length of the unit. [m]"""
    code = int(rng.choice([0, 0, 4, 6, 6, 6, 6, *_UNITS, *_NO_SURVEY]))
    declared = str(rng.choice(list(_DECLARED))) if code in _NO_SURVEY or rng.random() < 0.3 else None
    if declared is not None:
        return code, declared, _DECLARED[declared]
    return code, None, _UNITS.get(code, 1.0)


def _stated_m(code: int, declared: str) -> float:
    if code in _NO_SURVEY:
        return math.inf
    return _UNITS[code] * (_US_FOOT_M / _FOOT_M if code in _FEET and declared == "ft-us" else 1.0)


# === Lines of entities.


def _road(drawing: _Drawing, number: int, place: tuple[float, float], z: float) -> None:
    """One line, or its copies in an array of blocks."""
    rng = drawing.rng
    layer = str(rng.choice(["LANE {}", "Achse Süd {}", "{}", "plan$0$Spur{}"])).format(number + 1)
    own = layer.rpartition("$")[2]
    drawing.layers[layer] = (0, int(rng.integers(1, 8)))
    depth = int(rng.choice([0, 0, 1, 2, 3]))
    start = (0.0, 0.0) if depth else place
    kind = str(rng.choice(["lwpolyline", "polyline", "polyline 3d", "spline", "chain", "circle"]))
    if kind == "lwpolyline" and drawing.version == "AC1009":
        kind = "polyline"
    by_block = depth > 0 and bool(rng.random() < 0.3)  # on layer 0, so that it is on the layer of the reference
    write = {"chain": _chain, "circle": _circle}.get(kind)
    on = "0" if by_block else layer
    rows, line = write(drawing, on, start, z) if write else _polyline(drawing, on, start, z, kind)
    label = f"Lane no. {number + 1}" if rng.random() < 0.4 else ""
    if label:
        rows += _label(drawing, on, label, line.points[len(line.points) // 2])
    matrices = [np.eye(4)]
    for level in range(depth):
        name = f"B{number}_{level}"
        block_point = rng.uniform(-50, 50, 3) / drawing.unit_m * (1, 1, z != 0)
        drawing.blocks.append(
            [(0, "BLOCK"), (8, "0"), (2, name), (70, 0), *_at(block_point), (3, name), *rows, (0, "ENDBLK"), (8, "0")]
        )
        last = level == depth - 1
        target = np.array([*place, 0.0] if last else [*rng.uniform(-100, 100, 2), 0.0]) / drawing.unit_m
        target[2] = float(rng.choice([0.0, drawing.unit(2.5)])) if z else 0.0
        on = layer if by_block and last else "0"
        rows, found = _insert(drawing, name, on, block_point, target, is_last=last, has_array=not label)
        matrices = [outer @ inner for outer in found for inner in matrices]
    drawing.entities += rows
    drawing.lanes[own] = [line.moved(matrix) for matrix in matrices]
    if label:
        drawing.names[own] = label


def _at(point: Sequence[float] | Floats, first: int = 10) -> Rows:
    return [(first + 10 * axis, float(value)) for axis, value in enumerate(point)]


def _extrusion(drawing: _Drawing) -> tuple[Rows, bool]:
    """Whether the plane is seen from below, where x and z are turned (arbitrary axis algorithm)."""
    mirrored = bool(drawing.rng.random() < 0.2)
    return ([(210, 0.0), (220, 0.0), (230, -1.0)] if mirrored else []), mirrored


def _turned(points: Floats, mirrored: bool) -> Floats:
    return points * (-1.0, 1.0, -1.0) if mirrored else points


def _bulged(points: Floats, bulges: Sequence[float], unit_m: float) -> _Line:
    """Straight lines and arcs from each point to the next; a bulge is the tangent of a quarter of the turn."""
    found, curvature = [], []
    for start, end, bulge in zip(points[:-1], points[1:], bulges, strict=False):
        chord, turn = end[:2] - start[:2], 4 * math.atan(bulge)
        length = float(np.hypot(*chord))
        if length == 0.0:
            continue
        share = np.linspace(0, 1, 2 if bulge == 0 else _steps(abs(turn), length * unit_m))
        if bulge:
            radius = length / (2 * math.sin(turn / 2))  # signed
            heading = math.atan2(chord[1], chord[0]) - turn / 2
            angle = heading + turn * share
            x = start[0] + radius * (np.sin(angle) - math.sin(heading))
            y = start[1] - radius * (np.cos(angle) - math.cos(heading))
        else:
            radius, x, y = math.inf, start[0] + chord[0] * share, start[1] + chord[1] * share
        found.append(np.stack([x, y, start[2] + (end[2] - start[2]) * share], axis=1))
        curvature.append(np.full(len(share), 1 / radius))
    return _Line(np.concatenate(found), np.concatenate(curvature))


def _steps(turn: float, chord_m: float) -> int:
    """How many points of an arc are wanted for chords within `_SAMPLED_M`."""
    radius = chord_m / (2 * math.sin(turn / 2)) if turn < math.tau else chord_m / 2
    return max(8, math.ceil(turn / (2 * math.acos(1 - _SAMPLED_M / max(radius, 1.0)))))


def _walk(drawing: _Drawing, start: tuple[float, float], z: float, count: int) -> Floats:
    """Corners of a line that does not turn back. [unit]"""
    rng = drawing.rng
    hdg = float(rng.uniform(-3, 3)) + np.cumsum(rng.uniform(-0.5, 0.5, count - 1))
    steps = rng.uniform(15, 60, count - 1)
    x = start[0] + np.concatenate([[0], np.cumsum(steps * np.cos(hdg))])
    y = start[1] + np.concatenate([[0], np.cumsum(steps * np.sin(hdg))])
    return np.stack([x, y, np.full(count, z)], axis=1) / drawing.unit_m


def _polyline(drawing: _Drawing, layer: str, start: tuple[float, float], z: float, kind: str) -> tuple[Rows, _Line]:
    """LWPOLYLINE, or POLYLINE in 2D and 3D, also fitted with a spline, whose frame is not on the line."""
    rng = drawing.rng
    points = _walk(drawing, start, z, int(rng.integers(2, 8)))
    closed = bool(len(points) > 3 and kind != "spline" and rng.random() < 0.1)
    flat = kind in ("lwpolyline", "polyline") or (kind == "spline" and bool(rng.random() < 0.5))
    curved = kind in ("lwpolyline", "polyline") and rng.random() < 0.7
    bulges = [float(rng.uniform(-0.6, 0.6)) if curved and rng.random() < 0.5 else 0.0 for _ in points]
    if not flat and z:
        points[:, 2] += rng.uniform(-3, 3, len(points)) / drawing.unit_m
    extrusion, mirrored = _extrusion(drawing) if flat else ([], False)
    ring = np.concatenate([points, points[:1]]) if closed else points
    line = _bulged(ring, bulges, drawing.unit_m)
    own = _turned(points, mirrored)
    shown = [-bulge if mirrored else bulge for bulge in bulges]
    head: Rows = [(8, layer), *([(62, 3)] if rng.random() < 0.3 else [])]
    if kind == "lwpolyline":
        rows: Rows = [(0, "LWPOLYLINE"), (100, "AcDbEntity"), *head, (100, "AcDbPolyline"), (90, len(own))]
        rows += [(70, int(closed))]
        rows += [(38, float(own[0, 2]))] if own[0, 2] or rng.random() < 0.5 else []
        width = rng.random() < 0.2
        for point, bulge in zip(own, shown, strict=True):
            rows += [*_at(point[:2]), *([(40, 0.1), (41, 0.1)] if width else [])]
            rows += [(42, bulge)] if bulge or rng.random() < 0.2 else []
        return rows + extrusion, line
    is_spline = kind == "spline"
    flags = int(closed) | (0 if flat else 8) | (4 if is_spline else 0) | (2 if curved else 0)
    elevation = float(own[0, 2]) if flat else 0.0
    rows = [(0, "POLYLINE"), *head, (66, 1), *_at((0.0, 0.0, elevation)), (70, flags), *extrusion]
    vertices = [(point, bulge, (8 if is_spline else 0)) for point, bulge in zip(own, shown, strict=True)]
    if is_spline:
        frame = own + rng.uniform(5, 9, (len(own), 1)) / drawing.unit_m * (1, 1, 0)
        vertices = [(point, 0.0, 16) for point in frame] + vertices
    for point, bulge, flag in vertices:
        # The height of vertices in 2D is not used (DXF reference, VERTEX: in OCS when 2D; elevation of the POLYLINE).
        rows += [(0, "VERTEX"), *head[:1], *_at(point), *([(42, bulge)] if bulge else [])]
        rows += [(70, flag | (0 if flat else 32))] if flag or not flat else []
    return [*rows, (0, "SEQEND"), *head[:1]], line


def _chain(drawing: _Drawing, layer: str, start: tuple[float, float], z: float) -> tuple[Rows, _Line]:
    """Lines and arcs that meet end to end, in any order and direction; the first that is written has its own."""
    rng = drawing.rng
    points = _walk(drawing, start, z, int(rng.integers(2, 6)))
    bulges = [float(rng.uniform(-0.6, 0.6)) if rng.random() < 0.5 else 0.0 for _ in points[1:]]
    line = _bulged(points, bulges, drawing.unit_m)
    parts: list[tuple[Rows, bool]] = []  # with whether its own direction is that of the line
    for a, b, bulge in zip(points[:-1], points[1:], bulges, strict=True):
        name = str(rng.choice([layer, layer.upper(), layer.lower()])) if rng.random() < 0.1 else layer
        if bulge == 0.0:
            along = bool(rng.random() < 0.6)
            one, two = (a, b) if along else (b, a)
            parts.append(([(0, "LINE"), (8, name), *_at(one), *_at(two, 11)], along))
            continue
        turn, chord = 4 * math.atan(bulge), b[:2] - a[:2]
        radius = float(np.hypot(*chord)) / (2 * math.sin(abs(turn) / 2))
        across = np.array([-chord[1], chord[0]]) / math.tan(turn / 2) / 2
        centre = np.array([*((a[:2] + b[:2]) / 2 + across), a[2]])
        extrusion, mirrored = _extrusion(drawing)
        ends = [_turned(end, mirrored)[:2] - _turned(centre, mirrored)[:2] for end in (a, b)]
        angles = [math.degrees(math.atan2(end[1], end[0])) % 360 for end in ends]
        along = (turn > 0) != mirrored  # arcs run counter-clockwise in their own plane
        first, last = angles if along else angles[::-1]
        shown = [(0, "ARC"), (8, name), *_at(_turned(centre, mirrored)), (40, radius), (50, first), (51, last)]
        # Seen from above, an arc in a plane that is seen from below runs clockwise.
        parts.append((shown + extrusion, along))
    order = rng.permutation(len(parts)) if rng.random() < 0.5 else np.arange(len(parts))
    if not parts[int(order[0])][1]:
        line = _Line(line.points[::-1], -line.curvature[::-1])
    return [row for k in order for row in parts[int(k)][0]], line


def _circle(drawing: _Drawing, layer: str, start: tuple[float, float], z: float) -> tuple[Rows, _Line]:
    radius = drawing.unit(float(drawing.rng.uniform(20, 80)))
    centre = np.array([drawing.unit(start[0]), drawing.unit(start[1]), drawing.unit(z)])
    extrusion, mirrored = _extrusion(drawing)
    rows: Rows = [(0, "CIRCLE"), (8, layer), *_at(_turned(centre, mirrored)), (40, radius), *extrusion]
    side = -1.0 if mirrored else 1.0
    angle = np.linspace(0, math.tau, _steps(math.tau, 2 * radius * drawing.unit_m))
    points = centre + radius * np.stack([side * np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return rows, _Line(points, np.full(len(points), side / radius), is_circle=True)


def _label(drawing: _Drawing, layer: str, text: str, at: Floats) -> Rows:
    """A text that names the line: left-aligned, aligned at its second point, seen from below, or in paragraphs."""
    place = at + np.array([0.4, 0.4, 0.0]) / drawing.unit_m
    height = drawing.unit(2.0)
    match int(drawing.rng.integers(4)):
        case 0:
            return [(0, "TEXT"), (8, layer), *_at(place), (40, height), (1, text)]
        case 1:  # programs other than AutoCAD leave the first point at 0
            points: Rows = [*_at((0.0, 0.0, 0.0)), *_at(place, 11)]
            return [(0, "TEXT"), (8, layer), *points, (40, height), (1, text), (72, 1), (73, 2)]
        case 2:
            down: Rows = [(210, 0.0), (220, 0.0), (230, -1.0)]
            return [(0, "TEXT"), (8, layer), *_at(_turned(place, True)), (40, height), (1, text), *down]
        case _ if drawing.version != "AC1009":
            return [(0, "MTEXT"), (100, "AcDbEntity"), (8, layer), (100, "AcDbMText"), *_at(place), (40, height),
                    (1, "{\\fArial|b0;" + text + "}")]  # fmt: skip
        case _:
            return [(0, "TEXT"), (8, layer), *_at(place), (40, height), (1, text)]


# === Blocks.


def _insert(
    drawing: _Drawing,
    name: str,
    layer: str,
    block_point: Floats,
    target: Floats,
    *,
    is_last: bool = True,
    has_array: bool = True,
) -> tuple[Rows, list[Matrix]]:
    """A reference to a block: moved, turned, scaled, mirrored, in rows and columns; and its matrices.

    Spacings of rows and columns are turned, but not scaled (DXF reference, INSERT).
    """
    rng = drawing.rng
    turn = float(rng.uniform(0, 360)) if rng.random() < 0.6 else 0.0
    scale = float(rng.choice([1.0, 1.0, 2.0, 1.25, *([0.5] if is_last else [])]))  # smaller ones would be symbols
    signs = rng.choice([-1.0, 1.0], 2, p=[0.2, 0.8]) if rng.random() < 0.5 else np.ones(2)
    scales = np.array([*(signs * scale), float(rng.choice([1.0, scale]))])
    extrusion, mirrored = _extrusion(drawing)
    rows: Rows = [(0, "INSERT"), (8, layer), (2, name)]
    rows += _at(_turned(target, mirrored))
    rows += [(41 + axis, float(value)) for axis, value in enumerate(scales)] if (scales != 1).any() else []
    rows += [(50, turn)] if turn else []
    columns, lines = (int(rng.integers(1, 3)), int(rng.integers(1, 4))) if has_array and rng.random() < 0.15 else (1, 1)
    spacing = (drawing.unit(float(rng.uniform(1100, 1200))), drawing.unit(float(rng.uniform(1100, 1200))))
    if columns * lines > 1:
        rows += [(70, columns), (71, lines), (44, spacing[0]), (45, spacing[1])]
    rows += extrusion
    cos, sin = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    about_z = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    plane = np.diag([-1.0, 1.0, -1.0]) if mirrored else np.eye(3)
    matrices = []
    for row in range(lines):
        for column in range(columns):
            matrix = np.eye(4)
            matrix[:3, :3] = plane @ about_z @ np.diag(scales)
            offset = about_z @ np.array([column * spacing[0], row * spacing[1], 0.0])
            matrix[:3, 3] = target + plane @ offset - matrix[:3, :3] @ block_point
            matrices.append(matrix)
    return rows, matrices


def _hidden(drawing: _Drawing) -> None:
    """What CAD does not draw: frozen and switched-off layers, invisible entities, paper space."""
    rng = drawing.rng
    line = [*_at((drawing.unit(100.0), drawing.unit(-900.0), 0.0)), *_at((drawing.unit(200.0), 0.0, 0.0), 11)]
    for name, layer in (("Frozen", (1, 7)), ("Off", (0, -7))):
        if rng.random() < 0.2:
            drawing.layers[name] = layer
            drawing.hidden.add(name)
            drawing.entities += [(0, "LINE"), (8, str(rng.choice([name, name.upper()]))), *line]
    visible = next(iter(drawing.layers))
    if rng.random() < 0.2:
        drawing.entities += [(0, "LINE"), (8, visible), (60, 1), *line]
    if rng.random() < 0.2:
        drawing.entities += [(0, "LINE"), (67, 1), (8, visible), *line]
    if drawing.hidden:
        drawing.warnings.append("frozen or switched off")


# === What was read.


def _compare(file: AlignmentFile, drawing: _Drawing, unit_m: float) -> str:
    lines = [line for lines in drawing.lanes.values() for line in lines]
    has_heights = any(line.points[:, 2].any() for line in lines)
    warnings = list(drawing.warnings)
    if has_heights and not all(line.points[:, 2].any() for line in lines):
        warnings.append("height 0")
    if problem := compare_warnings(file.warnings, warnings):
        return problem
    if abs((file.unit_m or 1.0) / unit_m - 1) > 1e-12:
        return f"the unit is {file.unit_m} m"
    if len(file.lanes) != len(lines):
        return f"{len(file.lanes)} lanes of {len(lines)}: {[lane.name for lane in file.lanes]}"
    for layer, wanted in drawing.lanes.items():
        name = drawing.names.get(layer, layer if len(wanted) == 1 else f"{layer} ")
        found = [lane for lane in file.lanes if lane.name.lower().startswith(name.lower())]
        for line in wanted:
            starts = [(float(np.hypot(*(_middle(lane.centre) - _middle(line.points)))), k)
                      for k, lane in enumerate(found) if lane.centre is not None]  # fmt: skip
            if not starts:
                return f"no lane {name!r}: {[lane.name for lane in file.lanes]}"
            lane = found[min(starts)[1]]
            assert lane.centre is not None
            flat = has_heights and not line.points[:, 2].any()
            if problem := _compare_line(line, lane.centre, lane.curvature_per_m, unit_m, flat):
                return f"layer {layer}: {problem}"
    return ""


def _middle(points: Floats) -> Floats:
    return np.asarray(points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2.0


def _compare_line(line: _Line, centre: Floats, curvature: Floats | None, unit_m: float, flat: bool) -> str:
    wanted, found = (line.points - line.points[0]) * unit_m, (centre - line.points[0]) * unit_m
    if flat != bool(np.isnan(found[:, 2]).all()):
        return "a line without heights has some" if flat else "there are no heights"
    stated = np.zeros(len(found)) if curvature is None else curvature
    if line.is_circle:
        return _compare_circle(line, wanted, found, stated, unit_m)
    ends = max(np.hypot(*(found[k] - wanted[k])[:2]) for k in (0, -1))
    if ends > _TOLERANCE_M:
        return f"an end is {ends:.6f} m off"
    off, z, k = _beside(wanted, line.curvature / unit_m, found)
    if off.max() > 20 * _SAMPLED_M:
        return f"a vertex is {off.max():.5f} m off"
    if not flat and np.abs(z - found[:, 2]).max() > 1e-4:
        return f"a height is {np.abs(z - found[:, 2]).max():.5f} m off"
    bent = np.where(np.isnan(k), 0.0, np.abs(stated - k))
    if bent.max() > 1e-6:
        return f"the curvature is {bent.max():.6f} 1/m off"
    away = _beside(found, np.zeros(len(found)), wanted)[0]
    return f"the line leaves {away.max():.5f} m out" if away.max() > _CHORD_M else ""


def _compare_circle(line: _Line, wanted: Floats, found: Floats, stated: Floats, unit_m: float) -> str:
    """A circle may begin anywhere."""
    middle, radius = (wanted.min(axis=0) + wanted.max(axis=0)) / 2.0, 1 / abs(float(line.curvature[0])) * unit_m
    off = np.abs(np.hypot(*(found - middle)[:, :2].T) - radius).max()
    angles = np.unwrap(np.arctan2(*(found - middle)[:, 1::-1].T))
    if off > 20 * _SAMPLED_M or abs(abs(angles[-1] - angles[0]) - math.tau) > 1e-6:
        return f"a circle is {off:.5f} m off, or is not closed"
    wrong = np.abs(np.abs(stated) - 1 / radius).max() > 1e-6 or np.sign(stated[1]) != np.sign(angles[1] - angles[0])
    return "the curvature of a circle is wrong" if wrong else ""


def _beside(line: Floats, curvature: Floats, points: Floats) -> tuple[Floats, Floats, Floats]:
    """Distances of points from a line, its heights and curvature there, NaN at joints.

    Only the parts about the same share of the length are looked at, because lines may cross themselves.
    """
    s = [np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(one[:, :2], axis=0).T))]) for one in (line, points)]
    at = s[1] * (s[0][-1] / s[1][-1])
    first = np.clip(np.searchsorted(s[0], at) - 1, 0, len(line) - 2)[:, None] + np.arange(-3, 4)
    first = np.clip(first, 0, len(line) - 2)
    start, along = line[first, :2], line[first + 1, :2] - line[first, :2]
    square = np.maximum((along**2).sum(axis=2), 1e-12)
    share = np.clip(((points[:, None, :2] - start) * along).sum(axis=2) / square, 0.0, 1.0)
    away = np.hypot(*np.moveaxis(points[:, None, :2] - start - share[:, :, None] * along, 2, 0))
    nearest = np.arange(len(points)), away.argmin(axis=1)
    row = first[nearest]
    z = line[row, 2] + share[nearest] * (line[row + 1, 2] - line[row, 2])
    joints = s[0][np.flatnonzero(np.diff(curvature, prepend=np.nan, append=np.nan))[:-1]]
    near = np.abs(at[:, None] - joints).min(axis=1) < _EPSILON_M
    return away[nearest], z, np.where(near | (at[-1] - at < _EPSILON_M), np.nan, curvature[row])


# === Surveys: points, and references to symbols with attributes.


def write_dxf_survey(rng: Rng) -> tuple[bytes, Check]:
    """Points and symbols in the model space and in blocks that are parts of the drawing."""
    code, declared, unit_m = _unit(rng)
    drawing = _Drawing(rng, unit_m, str(rng.choice(_VERSIONS)))
    drawing.layers = {"0": (0, 7), "Nägel": (0, 3), "CERPM": (0, 4), "Frozen": (1, 7)}
    symbol: Rows = [(0, "CIRCLE"), (8, "0"), *_at((0.0, 0.0, 0.0)), (40, drawing.unit(0.1))]
    drawing.blocks.append([(0, "BLOCK"), (8, "0"), (2, "NAIL"), (70, 2), *_at((0.0, 0.0, 0.0)), (3, "NAIL"), *symbol,
                           (0, "ENDBLK"), (8, "0")])  # fmt: skip
    wanted: list[tuple[str, str, tuple[float, float, float]]] = []
    rows, points = _points(drawing, (500_000.0, 5_400_000.0, 100.0), 0)
    drawing.entities += rows
    wanted += points
    matrices = [np.eye(4)]
    if rng.random() < 0.6:
        rows, points = _points(drawing, (20.0, 30.0, 5.0), 100)
        for level in range(int(rng.integers(1, 4))):
            name = f"PART{level}"
            block_point = rng.uniform(-50, 50, 3) / unit_m
            drawing.blocks.append([(0, "BLOCK"), (8, "0"), (2, name), (70, 0), *_at(block_point), (3, name), *rows,
                                   (0, "ENDBLK"), (8, "0")])  # fmt: skip
            target = np.array([500_100.0, 5_400_100.0, 3.0]) / unit_m
            rows, found = _insert(drawing, name, "0", block_point, target)
            matrices = [outer @ inner for outer in found for inner in matrices]
        drawing.entities += rows
        for matrix in matrices:
            for layer, number, place in points:
                x, y, z = matrix[:3, :3] @ np.array(place) + matrix[:3, 3]
                wanted.append((layer, number, (float(x), float(y), float(z))))
    if rng.random() < 0.3:
        drawing.entities += [(0, "POINT"), (8, "Frozen"), *_at((1.0, 2.0, 3.0))]
        drawing.hidden.add("Frozen")
    text = drawing.text(code, "ANSI_1252")

    def check() -> str:
        table = read_survey(text, None, declared)
        metres = {"m": 1.0, "ft-us": _US_FOOT_M, "ft-intl": _FOOT_M, "ft": _FOOT_M, None: 1.0}[table.unit]
        layers = table.columns[table.names.index("layer")]
        numbers = table.columns[table.names.index("no")] if "no" in table.names else [None] * len(layers)
        assert table.points is not None
        xyz = np.stack(table.points, axis=1) * metres / unit_m
        found = [
            (str(a), str(b or ""), *(float(value) for value in place))
            for a, b, place in zip(layers, numbers, xyz, strict=True)
        ]
        return _compare_points(sorted(found), sorted((a, b, *p) for a, b, p in wanted), unit_m)

    return text, check


def _points(
    drawing: _Drawing, at: tuple[float, float, float], first: int
) -> tuple[Rows, list[tuple[str, str, tuple[float, float, float]]]]:
    """Entities with their layer, number and place. [unit]"""
    rng = drawing.rng
    rows: Rows = []
    found = []
    for number in range(first, first + int(rng.integers(2, 6))):
        place = (np.array(at) + rng.uniform(0, 80, 3)) / drawing.unit_m
        layer = str(rng.choice(["Nägel", "CERPM"]))
        if rng.random() < 0.5:
            rows += [(0, "POINT"), (8, layer), *_at(place)]
            found.append((layer, "", (float(place[0]), float(place[1]), float(place[2]))))
            continue
        extrusion, mirrored = _extrusion(drawing)
        own = _turned(place, mirrored)
        rows += [(0, "INSERT"), (8, layer), (66, 1), (2, "NAIL"), *_at(own), (50, float(rng.uniform(0, 360)))]
        rows += [*extrusion, (0, "ATTRIB"), (8, layer), *_at(own), (40, drawing.unit(1.0)), (1, f"N{number}")]
        rows += [(2, "NO"), (70, 0), *extrusion, (0, "SEQEND"), (8, layer)]
        found.append((layer, f"N{number}", (float(place[0]), float(place[1]), float(place[2]))))
    return rows, found


def _compare_points(found: Sequence[tuple[object, ...]], wanted: Sequence[tuple[object, ...]], unit_m: float) -> str:
    if len(found) != len(wanted):
        return f"{len(found)} points of {len(wanted)}"
    for one, two in zip(found, wanted, strict=True):
        if one[:2] != two[:2]:
            return f"a point is {one[:2]}, not {two[:2]}"
        off = float(np.abs(np.array(one[2:], dtype=float) - np.array(two[2:], dtype=float)).max()) * unit_m
        if off > _TOLERANCE_M:
            return f"point {two[:2]} is {off:.6f} m off"
    return ""
