"""Lanes of an OpenDRIVE road in their direction of travel, their sections joined where the file links them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from app.formats.alignments.curves import GAP_ERROR_M, GAP_WARNING_M, Frame, Ints, sample
from app.formats.alignments.geometry import BoundaryStyle, Floats, LaneGeometry
from app.formats.alignments.opendrive.road import LaneRecord, Road, Section

MIN_WIDTH_M = 0.05
"""Stretches of lanes that are narrower are left out. [m] Source: chosen by hand; tapers begin and end at zero width."""
_MIN_STRETCH = 0.02
"""Length of a lane per length of the reference line; with less it lies at the centre of a bend. Source: by hand."""
_SAME = (1e-6, 1e-6, 1e-3, 1e-6)
"""Changes of curvature [1/m], superelevation [rad], width [m] and speed [m/s] that are none. Source: rounding."""
_X, _Y, _Z, _K, _ROLL, _WIDTH, _SPEED, _S, _OK = range(9)

Values = tuple[Floats, Floats, Floats]
"""A value along the road, and its first two derivatives."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One lane, with what places events on it.

    Attributes
    ----------
    geometry : LaneGeometry
    ids : list of (start, end, id)
        Its lane numbers between distances along the road. [m]
    forward : bool
        Whether vehicles drive in the direction of s.
    """

    geometry: LaneGeometry
    ids: list[tuple[float, float, int]]
    forward: bool

    def point_at(self, s: float) -> tuple[float, float] | None:
        """Place on the centre line at a distance along the road; None beyond its ends. [m]"""
        assert self.geometry.centre is not None
        assert self.geometry.station_m is not None
        centre, station = self.geometry.centre, self.geometry.station_m
        if not self.forward:
            centre, station = centre[::-1], station[::-1]
        if not station[0] <= s <= station[-1]:
            return None
        return float(np.interp(s, station, centre[:, 0])), float(np.interp(s, station, centre[:, 1]))

    def lane_id_at(self, s: float) -> int | None:
        """Its lane number at a distance along the road; None beyond its ends."""
        return next((lane for start, end, lane in self.ids if start <= s <= end), None)


class Grid:
    """Vertices of a road's lanes: distances along the road, and the smooth interval that each belongs to."""

    def __init__(self, road: Road) -> None:
        self.road = road
        self.breaks, self.section = _breaks(road)
        self.middle = (self.breaks[:-1] + self.breaks[1:]) / 2.0
        self.piece = road.curve.piece_at(self.middle)
        lines = max(len(section.lanes) for section in road.sections)
        self.s, self.interval = sample(self.breaks, self._bend, road.place, lines)
        self.lookup = self.middle[self.interval]
        self.frame = road.curve.evaluate(self.s, self.piece[self.interval])
        self.roll = road.superelevation.at(self.s, self.lookup)[0]
        self.height = road.elevation.at(self.s, self.lookup)[0]
        self.offset = road.offset.at(self.s, self.lookup)

    def rows(self, section: int, interval: Ints) -> slice:
        """Rows of a section among rows with these intervals."""
        of = self.section[interval]
        return slice(int(np.searchsorted(of, section)), int(np.searchsorted(of, section, side="right")))

    def _bend(self, s: Floats, interval: Ints) -> Floats:
        """Greatest second derivative of the drivable lanes, across them, by distance along the road."""
        road, lookup = self.road, self.middle[interval]
        frame = road.curve.evaluate(s, self.piece[interval])
        offset = road.offset.at(s, lookup)
        worst = np.abs(frame.k)
        for number, section in enumerate(road.sections):
            rows = self.rows(number, interval)
            part = Frame(*(values[rows] for values in frame))
            for lane, inner, outer in lane_edges(section, _cut(offset, rows), s[rows], lookup[rows]):
                if lane.drivable:
                    stretch, curvature = lane_curvature(part, _middle(inner, outer))
                    bend = np.where(_turned(part, _middle(inner, outer)), 0.0, np.abs(curvature) * stretch**2)
                    worst[rows] = np.maximum(worst[rows], bend)
        return np.asarray(np.hypot(worst, road.elevation.at(s, lookup)[2]))


def lane_edges(
    section: Section, offset: Values, s: Floats, lookup: Floats
) -> Iterator[tuple[LaneRecord, Values, Values]]:
    """Every lane but lane 0, from the inside out, with its edges left of the reference line. [m]"""
    for sign in (1.0, -1.0):
        edge = offset
        for number in sorted((number for number in section.lanes if number * sign > 0), key=abs):
            lane = section.lanes[number]
            width = lane.width.at(s, lookup)
            outer = (edge[0] + sign * width[0], edge[1] + sign * width[1], edge[2] + sign * width[2])
            yield lane, edge, outer
            edge = outer


def lane_curvature(frame: Frame, t: Values) -> tuple[Floats, Floats]:
    """Length per distance along the road, and curvature, of a line at t left of the reference line. [1], [1/m]

    With T, N along and across the reference line, the line's derivatives by s are (1 - k t) T + t' N and
    -(2 k t' + k' t) T + (k (1 - k t) + t'') N.
    """
    along = 1.0 - frame.k * t[0]
    stretch = np.hypot(along, t[1])
    across = along * (frame.k * along + t[2]) + t[1] * (frame.dk * t[0] + 2.0 * frame.k * t[1])
    with np.errstate(all="ignore"):
        return stretch, across / stretch**3


def build_tracks(road: Road, grid: Grid, names: set[str], road_name: str) -> list[Track]:
    """Lanes of a road in their direction of travel; what is left out or mended goes to the road's warnings.

    Parameters
    ----------
    road : Road
    grid : Grid
    names : set of str
        Names that are taken; those of the lanes are added.
    road_name : str
    """
    parts = _lane_parts(road, grid)
    prefix = f"junction {road.junction} {road.place}" if road.junction is not None else road.place
    tracks = []
    for chain in _chains(road.sections):
        first = chain[0]
        forward = (first[1] < 0) != road.left_hand
        table = np.concatenate([parts[key] for key in chain])
        styles = _styles(road, chain)
        ids = [(road.sections[i].start, road.sections[i].end, lane) for i, lane in chain]
        name = f"{prefix} lane {first[1] if forward else chain[-1][1]}"
        runs = _runs(table, f"{prefix} lane {first[1]}", road.warnings)
        if not forward:
            signs = np.where(np.isin(np.arange(table.shape[1]), (_K, _ROLL)), -1.0, 1.0)
            table, runs = table[::-1], [run[::-1] * signs for run in reversed(runs)]
        for number, run in enumerate(runs):
            start = (run if number else table)[0, _S]
            tracks.append(Track(_geometry(run, _free(name, start, names), styles, road_name), ids, forward))
    return tracks


def _breaks(road: Road) -> tuple[Floats, Ints]:
    """Where a cubic, geometry, limit or section begins or ends, and the section of every interval between."""
    cubics = [road.offset, road.elevation, road.superelevation]
    cubics += [lane.width for section in road.sections for lane in section.lanes.values()]
    speeds = [s for section in road.sections for lane in section.lanes.values() for s, _ in lane.speeds]
    starts = np.concatenate([c.starts for c in cubics] + [road.curve.s, speeds, [s for s, _ in road.speeds]])
    ends = np.array([section.start for section in road.sections] + [road.sections[-1].end])
    inner = np.unique(starts[(starts > ends[0]) & (starts < ends[-1])])
    near = ends[np.minimum(np.searchsorted(ends, inner - 1e-6), len(ends) - 1)]
    inner = inner[np.abs(near - inner) > 1e-6]
    inner = inner[np.diff(inner, prepend=-np.inf) > 1e-6]
    breaks = np.union1d(inner, ends)
    return breaks, np.searchsorted(ends, breaks[:-1], side="right") - 1


def _cut(values: Values, rows: slice) -> Values:
    return values[0][rows], values[1][rows], values[2][rows]


def _middle(inner: Values, outer: Values) -> Values:
    return (inner[0] + outer[0]) / 2.0, (inner[1] + outer[1]) / 2.0, (inner[2] + outer[2]) / 2.0


def _turned(frame: Frame, t: Values) -> npt.NDArray[np.bool_]:
    """Where a line lies at the centre of a bend of the reference line, or beyond it."""
    return np.asarray(1.0 - frame.k * t[0] < _MIN_STRETCH)


def _lane_parts(road: Road, grid: Grid) -> dict[tuple[int, int], Floats]:
    """Vertices of drivable lanes by section and lane number, shape (N, 9), in the direction of s."""
    parts = {}
    for number, section in enumerate(road.sections):
        rows = grid.rows(number, grid.interval)
        s, lookup, roll = grid.s[rows], grid.lookup[rows], grid.roll[rows]
        frame = Frame(*(values[rows] for values in grid.frame))
        cos = np.cos(roll)
        limit = _steps(road.speeds, lookup, np.full(len(s), np.nan))
        for lane, inner, outer in lane_edges(section, _cut(grid.offset, rows), s, lookup):
            if not lane.drivable:
                continue
            middle = _middle(inner, outer)
            t = (middle[0] * cos, middle[1] * cos, middle[2] * cos)  # widths are measured on the inclined road
            width = np.abs(outer[0] - inner[0]) * np.sign((outer[0] - inner[0]) * lane.id)
            parts[number, lane.id] = np.stack(
                [
                    frame.x - np.sin(frame.hdg) * t[0],
                    frame.y + np.cos(frame.hdg) * t[0],
                    grid.height[rows] + middle[0] * np.sin(roll),
                    lane_curvature(frame, t)[1],
                    roll,
                    width,
                    _steps(lane.speeds, lookup, limit),
                    s,
                    (width >= MIN_WIDTH_M) & ~_turned(frame, t),
                ],
                axis=1,
            )
    return parts


def _steps(records: list[tuple[float, float]], lookup: Floats, before: Floats) -> Floats:
    """Values of the records that apply, each from its start on."""
    if not records:
        return before
    i = np.searchsorted([s for s, _ in records], lookup, side="right") - 1
    return np.where(i >= 0, np.array([value for _, value in records])[np.maximum(i, 0)], before)


def _chains(sections: tuple[Section, ...]) -> list[list[tuple[int, int]]]:
    """Drivable lanes that follow each other from section to section, as pairs of section and lane number."""
    following: dict[tuple[int, int], tuple[int, int]] = {}
    for i, (section, after) in enumerate(pairwise(sections)):
        for lane in section.lanes.values():
            backwards = (other.id for other in after.lanes.values() if other.predecessor == lane.id)
            next_id = lane.successor if lane.successor is not None else next(backwards, None)
            found = after.lanes.get(next_id) if next_id is not None else None
            usable = lane.drivable and found is not None and found.drivable and found.id * lane.id > 0
            if found is not None and usable and (i + 1, found.id) not in following.values():
                following[i, lane.id] = (i + 1, found.id)
    taken = set(following.values())
    chains = []
    for i, section in enumerate(sections):
        for lane in sorted(section.lanes.values(), key=lambda lane: (abs(lane.id), lane.id)):
            if lane.drivable and (i, lane.id) not in taken:
                chain = [(i, lane.id)]
                while chain[-1] in following:
                    chain.append(following[chain[-1]])
                chains.append(chain)
    return chains


def _runs(table: Floats, place: str, warnings: list[str]) -> list[Floats]:
    """Stretches without a jump sideways and wide enough; a vertex stands twice only where its values jump."""
    same = np.diff(table[:, _S]) == 0.0
    step = np.diff(table[:, : _Z + 1], axis=0)
    gap = np.where(same, np.sqrt(np.nansum(step * step, axis=1)), 0.0)
    usable = (table[:-1, _OK] > 0.0) & (table[1:, _OK] > 0.0)
    for i in np.flatnonzero(usable & (gap > GAP_WARNING_M)):
        state = "it is divided there" if gap[i] > GAP_ERROR_M else "the jump is closed"
        warnings.append(f"{place}: it jumps by {gap[i]:.3f} m at s {table[i, _S]:.3f} m; {state}.")
    closed = np.flatnonzero(same & (gap <= GAP_ERROR_M))
    table[closed + 1, : _Z + 1] = table[closed, : _Z + 1]
    change = np.abs(np.diff(table[:, _K : _SPEED + 1], axis=0))
    change[np.isnan(table[1:, _K : _SPEED + 1]) & np.isnan(table[:-1, _K : _SPEED + 1])] = 0.0
    twice = np.zeros(len(table), dtype=np.bool_)
    twice[1:] = same & (gap <= GAP_ERROR_M) & (change <= _SAME).all(axis=1)
    divided = np.concatenate([[False], gap > GAP_ERROR_M])[~twice]
    table = table[~twice]
    turns = np.flatnonzero(divided | (np.diff(table[:, _OK], prepend=table[0, _OK]) != 0.0))
    found = []
    for run in np.split(table, turns):
        length = run[-1, _S] - run[0, _S]
        if run[0, _OK] and length > GAP_WARNING_M:
            found.append(run)
        elif not run[0, _OK]:
            warnings.append(
                f"{place}: it is narrower than {MIN_WIDTH_M * 1000:g} mm, or at the centre of a bend, from s "
                f"{run[0, _S]:.3f} to {run[-1, _S]:.3f} m; this stretch is left out."
            )
    return found


def _free(name: str, s: float, names: set[str]) -> str:
    """The name, or one with the distance along the road, or with a number as well."""
    place = f"{name} from s {s:.0f}"
    found = name if name not in names else place
    number = 2
    while found in names:
        found, number = f"{place} ({number})", number + 1
    names.add(found)
    return found


def _styles(road: Road, chain: list[tuple[int, int]]) -> tuple[BoundaryStyle, BoundaryStyle]:
    """Paint left and right in the direction of travel: the styles along the greater part of the lane."""
    lengths: tuple[dict[BoundaryStyle, float], ...] = (defaultdict(float), defaultdict(float))
    for i, number in chain:
        section = road.sections[i]
        inside = section.lanes.get(_inside(section, number))
        # Of a double line on the neighbour's border the far one is nearer to this lane; lane 0 has left, right.
        near = 0 if inside is not None and inside.id == 0 and number > 0 else 1
        for side, lane, line in ((0, inside, near), (1, section.lanes[number], 0)):
            marks = lane.marks if lane is not None else []
            ends = [*[mark[0] for mark in marks], section.end][1:]
            covered = 0.0
            for mark, end in zip(marks, ends, strict=True):
                part = max(min(end, section.end) - max(mark[0], section.start), 0.0)
                lengths[side][mark[1][line]] += part
                covered += part
            lengths[side][BoundaryStyle.UNKNOWN] += section.end - section.start - covered
    inner, outer = (max(part, key=lambda style: part[style]) for part in lengths)
    return (outer, inner) if road.left_hand else (inner, outer)


def _inside(section: Section, number: int) -> int:
    """The neighbour nearer to the reference line."""
    sign = 1 if number > 0 else -1
    return max((n for n in section.lanes if 0 < n * sign < number * sign), key=abs, default=0)


def _geometry(run: Floats, name: str, styles: tuple[BoundaryStyle, BoundaryStyle], road: str) -> LaneGeometry:
    speed = run[:, _SPEED]
    return LaneGeometry(
        name=name,
        centre=np.ascontiguousarray(run[:, : _Z + 1]),
        curvature_per_m=run[:, _K],
        superelevation_rad=run[:, _ROLL],
        width_m=run[:, _WIDTH],
        speed_limit_mps=None if np.isnan(speed).all() else speed,
        station_m=run[:, _S],
        left_style=styles[0],
        right_style=styles[1],
        road=road,
    )
