"""Units of a proof and how one is computed: pure, with seeds by drive and marker, so that any order gives the same."""

from __future__ import annotations

import math
import zlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import pairwise

import numpy as np
import scipy

from app.decoders.magnet.identify import TagFormat
from app.decoding.declarations import CoarsePosition, DeclaredTrace
from app.decoding.recordings import MAX_MAGNET_ROWS, radio_of
from app.errors import InvalidParameter
from app.geodesy.frames import ecef_from_wgs84
from app.markers.magnet_design import Codebook
from app.markers.reading import MarkerRow
from app.planning.alignment import Lane
from app.planning.plan import Plan, PlannedCerpm, PlannedLineMagnet, PlannedMarker, PlannedPlate, PlannedTag
from app.planning.predict.rates import camera_of
from app.planning.proof.drives import (
    ASIDE_M,
    AUDIBLE_M,
    COARSE_M,
    LEAD_M,
    RADIUS_95,
    TAIL_M,
    LanePass,
    MagnetPass,
    coarse_position,
    drive_cerpms,
    drive_line,
    drive_tag,
    simulated_radio,
    surveyed_row,
)
from app.planning.proof.plates import PLACEMENT_SD_M, ROTATION_SD_DEG, PlatePass, draw_drive, draw_plate, drive_plate
from app.planning.proof.report import (
    Condition,
    DriveTerms,
    MarkerPass,
    ProofReport,
    ProofTerms,
    ProofUnit,
    UnitKind,
    UnitResult,
    drive_terms,
    parse_conditions,
    summarize,
)
from app.simulation.conditions import Conditions
from app.simulation.radio.link import Radio
from app.values import Floats

# === Markers of a plan beside a lane, whatever lane they were placed for.


BesideLane = tuple[PlannedMarker, float, float]
"""A marker with its chainage and its offset on a lane, left positive. [m]"""


class LaneFrame:
    """A lane's samples with directions along and to the left, to find chainage and offset of positions."""

    def __init__(self, lane: Lane) -> None:
        self.lane = lane
        self._points = ecef_from_wgs84(lane.lon_deg, lane.lat_deg)
        along = np.gradient(self._points, axis=0)
        self._along = along / np.linalg.norm(along, axis=1)[:, None]
        up = self._points / np.linalg.norm(self._points, axis=1)[:, None]  # to 0.2 deg, no matter over some metres
        self._left = np.cross(up, self._along)

    @cached_property
    def _tree(self) -> scipy.spatial.cKDTree:
        return scipy.spatial.cKDTree(self._points)

    def project(self, lon_deg: Floats, lat_deg: Floats, reach_m: float) -> tuple[Floats, Floats]:
        """Chainage and offset, left positive, each shape (K,); NaN farther than a reach from the centre line. [m]"""
        places = ecef_from_wgs84(lon_deg, lat_deg)
        away, nearest = self._tree.query(places, distance_upper_bound=reach_m + self.lane.step_m)
        found = np.isfinite(away)
        at = np.where(found, nearest, 0)
        off = places - self._points[at]
        chainage = self.lane.chainage_m[at] + np.einsum("ij,ij->i", off, self._along[at])
        left = np.einsum("ij,ij->i", off, self._left[at])
        return np.where(found, chainage, np.nan), np.where(found, left, np.nan)


def markers_beside(frame: LaneFrame, markers: Sequence[PlannedMarker], reach_m: float) -> list[BesideLane]:
    """Markers within a reach of a lane with their chainage and offset on it, by chainage. [m]"""
    if not markers:
        return []
    chainage, left = frame.project(
        np.array([marker.lon_deg for marker in markers]), np.array([marker.lat_deg for marker in markers]), reach_m
    )
    found = [(markers[k], float(chainage[k]), float(left[k])) for k in np.flatnonzero(np.isfinite(chainage)).tolist()]
    return sorted(found, key=lambda one: (one[1], one[0].number))


# === Which markers and stretches a drive passes over, where a road has more than the terms allow.
#
# Strata are a lane's markers of one purpose at a similar speed, in bends and outside of them, and on changes of grade.
# Each stratum gets a share of the sample in proportion to its size and at least one; within a stratum every k-th marker
# along the road is taken from a random start. Over several drives the sample moves, so that weak markers are found.


_SPEED_STEP_M_S = 5.0  # [m/s] of the strata; 18 km/h
_BEND_PER_M = 1 / 400.0  # [1/m] source: the default of `road.curve_radius_m`
_CREST_PER_M = 1 / 1000.0  # [1/m] change of grade; sharper than any crest at 60 km/h


def stratum_of(marker: PlannedMarker, lane: Lane) -> tuple[int, bool, bool, str]:
    """What makes markers alike: speed, bend, crest or sag, purpose."""
    at = marker.chainage_m
    speed = float(lane.value_at(lane.design_speed_m_s, at))
    bend = abs(float(lane.value_at(lane.curvature_per_m, at))) > _BEND_PER_M
    before = max(at - 10.0, 0.0)
    change = float(lane.value_at(lane.grade, at) - lane.value_at(lane.grade, before)) / 10.0
    return int(speed / _SPEED_STEP_M_S), bend, abs(change) > _CREST_PER_M, str(marker.purpose)


def sample_markers(
    markers: Sequence[PlannedMarker], lanes: dict[str, Lane], most: int, rng: np.random.Generator
) -> list[tuple[PlannedMarker, float]]:
    """Markers with their weights, at most about `most` of them; all of them if there are no more than that."""
    if len(markers) <= most:
        return [(marker, 1.0) for marker in markers]
    strata: dict[tuple[int, bool, bool, str], list[PlannedMarker]] = defaultdict(list)
    for marker in markers:
        strata[stratum_of(marker, lanes[marker.lane])].append(marker)
    chosen = []
    for key in sorted(strata):
        members = strata[key]
        count = min(max(round(most * len(members) / len(markers)), 1), len(members))
        chosen += [(members[k], len(members) / count) for k in spread(len(members), count, rng)]
    return sorted(chosen, key=lambda one: one[0].number)


def spread(size: int, count: int, rng: np.random.Generator) -> list[int]:
    """Indices of a systematic sample: every (size / count)-th from a random start."""
    start = float(rng.random())
    return [int((k + start) * size / count) for k in range(count)]


def cut_stretches(length_m: float, longest_m: float) -> list[tuple[float, float]]:
    """A lane as equal stretches of at most a length. [m]"""
    count = max(int(np.ceil(length_m / longest_m - 1e-9)), 1)
    borders = np.linspace(0.0, length_m, count + 1)
    return [(float(a), float(b)) for a, b in pairwise(borders)]


# === Units of a proof and how one is computed.


PLATES_A_UNIT, TAGS_A_UNIT = 4, 8
"""Markers of a unit. Some seconds of work."""
LINE_STRETCH_M, LANE_STRETCH_M = 60.0, 500.0
"""[m] driven over a line's magnets, and past CERPMs. Some seconds of work."""
TAGS_NEAR_M = 500.0
"""[m] within which tags are looked for. A road with one codebook."""
NEAR_M = 200.0
"""[m] about a plate, within which others can be in the codebook of a frame. Source: the 120 m of a coarse position with
the range of view, the 18 m from where frames are taken, and the error of the position."""
MAX_UNITS = 10_000
"""Units of one proof at most. Some hours of work on two cores."""
_MIN_MARKERS = 4  # in a stretch that is driven; two pairs
_BESIDE_M = 0.8  # [m] beyond a boundary, where its markers still are; source: twice `CerpmRules` and paint
_LINE_OFFSET_SD_M = 0.25  # [m] of the bar's middle over a line; a quarter of the bar
_NO_PASS = MarkerPass(marker=0, weight=0.0, lost=True, readable=0, seen=0, read=0, fix_m=None, cause="lost")


class Prover:
    """A plan and terms, with what units share; one a process.

    Parameters
    ----------
    rows : mapping of int to MarkerRow
        Rows of the plan's markers as its commit stores them, by their numbers in the plan.
    """

    def __init__(self, plan: Plan, terms: ProofTerms, rows: Mapping[int, MarkerRow]) -> None:
        self.plan = plan
        self.terms = terms
        self.rows = rows
        self.lanes = {lane.name: lane for lane in plan.alignment.lanes}
        self.by_number = {marker.number: marker for marker in plan.markers}
        self._frames: dict[str, LaneFrame] = {}
        self._near: dict[tuple[str, type, float], list[BesideLane]] = {}

    @property
    def _min_frames(self) -> int:
        return self.plan.rules.plates.min_frames if self.plan.rules.plates is not None else 1

    # --- units ------------------------------------------------------------------------------------------------------

    def list_units(self) -> list[ProofUnit]:
        """All units, drive by drive."""
        return [unit for drive in range(self.terms.drives) for unit in self._drive_units(drive)]

    def check_size(self) -> None:
        """Check that there is something to prove, and not too much: all drives have about as many units as the first.

        Raises
        ------
        InvalidParameter
            The plan has nothing that a vehicle reads, there are more than `MAX_UNITS` units, or a camera is unknown.
        """
        for k in range(len(self.terms.cameras or ())):
            drive_terms(self.plan, self.terms, k * len(self.terms.conditions))
        count = len(self._drive_units(0))
        if not count:
            raise InvalidParameter(
                "the plan has nothing that a vehicle could read",
                field="plan",
                limit=f"a plate or a tag, or {_MIN_MARKERS} line magnets or CERPMs on a stretch of lane",
                cure="choose rules that place markers on this road",
            )
        if count * self.terms.drives > MAX_UNITS:
            raise InvalidParameter(
                f"{self.terms.drives} drives of about {count} units each are too many",
                field="drives",
                limit=f"{MAX_UNITS} units, here {MAX_UNITS // count} drives",
                cure="ask for fewer drives, or lower max_markers_per_drive and max_sections_per_drive",
            )

    def _drive_units(self, drive: int) -> list[ProofUnit]:
        most = self.terms.max_markers_per_drive
        units: list[ProofUnit] = []
        for kind, of, size in (
            (UnitKind.PLATES, PlannedPlate, PLATES_A_UNIT),
            (UnitKind.TAGS, PlannedTag, TAGS_A_UNIT),
        ):
            markers = [marker for marker in self.plan.markers if isinstance(marker.detail, of)]
            chosen = sample_markers(markers, self.lanes, most, self.rng(drive, kind, 0))
            units += _chunks(kind, drive, chosen, size)
        for kind, stretches in ((UnitKind.LINE, self._line_stretches), (UnitKind.LANE, self._lane_stretches)):
            count = min(len(stretches), self.terms.max_sections_per_drive)
            for k in spread(len(stretches), count, self.rng(drive, kind)) if count < len(stretches) else range(count):
                lane, low, high = stretches[k]
                units.append(ProofUnit(kind, drive, lane, (), low, high, (len(stretches) / count,)))
        return units

    @cached_property
    def _line_stretches(self) -> list[tuple[str, float, float]]:
        """Stretches of lanes that have line magnets."""
        return self._stretches(PlannedLineMagnet, LINE_STRETCH_M)

    @cached_property
    def _lane_stretches(self) -> list[tuple[str, float, float]]:
        """Stretches of lanes that have CERPMs."""
        return self._stretches(PlannedCerpm, LANE_STRETCH_M)

    def _stretches(self, of: type, longest_m: float) -> list[tuple[str, float, float]]:
        found = []
        for lane in self.lanes.values():
            at = np.sort([at for _, at, _ in self._beside(lane.name, of)])
            for low, high in cut_stretches(lane.length_m, longest_m):
                if np.searchsorted(at, high) - np.searchsorted(at, low) >= _MIN_MARKERS:
                    found.append((lane.name, low, high))
        return found

    def _beside(self, lane: str, of: type, aside_m: float = _BESIDE_M) -> list[BesideLane]:
        """Markers of a kind on a lane and its boundaries, or farther aside, with chainage and offset."""
        key = (lane, of, aside_m)
        if key not in self._near:
            frame = self._frames.setdefault(lane, LaneFrame(self.lanes[lane]))
            markers = [marker for marker in self.plan.markers if isinstance(marker.detail, of)]
            self._near[key] = markers_beside(frame, markers, float(self.lanes[lane].width_m.max()) / 2 + aside_m)
        return self._near[key]

    def _along(
        self, lane: str, of: type, low: float, high: float, drive: int, aside_m: float = _BESIDE_M
    ) -> list[BesideLane]:
        """Those along a stretch that are not missing in a drive."""
        beside = self._beside(lane, of, aside_m)
        return [one for one in beside if low <= one[1] <= high and not self.is_lost(drive, one[0].number)]

    def prove_unit(self, unit: ProofUnit) -> UnitResult:
        """Compute one unit."""
        drive = drive_terms(self.plan, self.terms, unit.drive)
        result = UnitResult(
            key=unit.key, kind=str(unit.kind), drive=unit.drive, lane=unit.lane, condition=drive.condition,
            camera=drive.camera.name, weight=unit.weight[0], passes=[], wrong=[], path=None,
        )  # fmt: skip
        match unit.kind:
            case UnitKind.PLATES:
                self._prove_plates(unit, drive, result)
            case UnitKind.TAGS:
                self._prove_tags(unit, result)
            case UnitKind.LINE:
                result["passes"], result["wrong"] = drive_line(self.line_pass(unit), unit.weight[0])
            case UnitKind.LANE:
                result["path"] = drive_cerpms(self.lane_pass(unit))
        return result

    def rng(self, *key: int | str) -> np.random.Generator:
        """Random numbers of one purpose alone, from the seed of the terms."""
        return np.random.default_rng(self.seed_of(*key))

    def seed_of(self, *key: int | str) -> tuple[int, ...]:
        """Seed of one purpose."""
        return (self.terms.seed, *(zlib.crc32(part.encode()) if isinstance(part, str) else part for part in key))

    def is_lost(self, drive: int, marker: int) -> bool:
        """Whether a marker is missing in a drive."""
        return bool(self.rng(drive, "lost", marker).random() < self.terms.lost_share)

    # --- magnets and CERPMs -----------------------------------------------------------------------------------------

    def _prove_tags(self, unit: ProofUnit, result: UnitResult) -> None:
        for number, weight in zip(unit.markers, unit.weight, strict=True):
            if self.is_lost(unit.drive, number):
                result["passes"].append({**_NO_PASS, "marker": number, "weight": weight})
                continue
            done, wrong = drive_tag(self.tag_pass(self.by_number[number], unit.drive), weight)
            result["passes"].append(done)
            result["wrong"] += wrong

    def tag_pass(self, marker: PlannedMarker, drive: int) -> MagnetPass:
        """A drive over a tag in the middle of its lane."""
        assert isinstance(marker.detail, PlannedTag)
        low, high = marker.chainage_m, marker.chainage_m + marker.detail.tag.length_m
        habit_m = float(self.rng(drive, "habit").normal(0, PLACEMENT_SD_M / math.sqrt(2)))
        wander_m = float(self.rng(drive, "tag", marker.number).normal(0, PLACEMENT_SD_M / math.sqrt(2)))
        return self._magnet_pass(
            marker.lane, (low, high), drive, self.seed_of(drive, "tag noise", marker.number), habit_m + wander_m, marker
        )

    def line_pass(self, unit: ProofUnit) -> MagnetPass:
        """A drive with the bar over one of the lines along a stretch, as in a departure from the lane."""
        rng = self.rng(unit.drive, "line", unit.lane, int(unit.from_m))
        lines = [left for _, at, left in self._beside(unit.lane, PlannedLineMagnet) if unit.from_m <= at <= unit.to_m]
        sides = [side for side in (1.0, -1.0) if sum(left * side > 0 for left in lines) > 0]
        side = sides[int(rng.integers(len(sides)))]
        left_m = float(np.mean([left for left in lines if left * side > 0])) + float(rng.normal(0, _LINE_OFFSET_SD_M))
        seed = self.seed_of(unit.drive, "line noise", unit.lane, int(unit.from_m))
        return self._magnet_pass(unit.lane, (unit.from_m, unit.to_m), unit.drive, seed, left_m)

    def _magnet_pass(
        self, lane: str, stretch_m: tuple[float, float], drive: int, seed: tuple[int, ...], left_m: float,
        tag: PlannedMarker | None = None,
    ) -> MagnetPass:  # fmt: skip
        low, high = stretch_m
        reach_m = (low - LEAD_M, high + TAIL_M)
        tags = [
            one for one in self._tags if one.lane == lane and low - TAGS_NEAR_M <= one.chainage_m <= high + TAGS_NEAR_M
        ]
        start_m = max(low - LEAD_M, 0.0)
        (lon_deg,), (lat_deg,) = self.lanes[lane].position_at(start_m, left_m)
        position = coarse_position(float(lon_deg), float(lat_deg), self.rng(drive, "coarse", lane, int(start_m)))
        book = self.plan.codebook
        return MagnetPass(
            lane=self.lanes[lane],
            from_m=low,
            to_m=high,
            tag=tag,
            lines=self._along(lane, PlannedLineMagnet, *reach_m, drive),
            nearby=tags,
            position=position,
            rows=self._magnet_rows(position, drive),
            formats=() if book is None else (_format_of(book),),
            left_m=left_m,
            speed_m_s=self._speed_m_s(lane, (low + high) / 2),
            clearance_m=self.terms.clearance_m,
            seed=seed,
            depth_m=self.plan.rules.installation.depth_m,
        )

    def _magnet_rows(self, position: CoarsePosition, drive: int) -> list[MarkerRow]:
        """The magnet markers that the server looks for in a recording that begins at a coarse position."""
        numbers, tree = self._magnets
        if not numbers:
            return []
        reach_m = position.accuracy_m + DeclaredTrace().reach_m
        near = tree.query_ball_point(ecef_from_wgs84(np.array(position.lon_deg), np.array(position.lat_deg)), reach_m)
        return [self.surveyed(numbers[k], drive) for k in sorted(near)[:MAX_MAGNET_ROWS]]

    @cached_property
    def _magnets(self) -> tuple[list[int], scipy.spatial.cKDTree]:
        return self._row_tree("magnet")

    def _row_tree(self, family: str) -> tuple[list[int], scipy.spatial.cKDTree]:
        """Numbers of the rows of a family, and their places."""
        numbers = [number for number, row in self.rows.items() if row.family == family]
        rows = [self.rows[number] for number in numbers]
        lon_deg, lat_deg = np.array([row.lon_deg for row in rows]), np.array([row.lat_deg for row in rows])
        return numbers, scipy.spatial.cKDTree(ecef_from_wgs84(lon_deg, lat_deg).reshape(-1, 3))

    def surveyed(self, number: int, drive: int) -> MarkerRow:
        """The row of a marker after the commit and a survey; each drive is after another survey."""
        return surveyed_row(self.rows[number], self.terms.survey_rmse_m, self.rng(drive, "survey", number))

    @cached_property
    def _tags(self) -> list[PlannedMarker]:
        return [marker for marker in self.plan.markers if isinstance(marker.detail, PlannedTag)]

    def lane_pass(self, unit: ProofUnit) -> LanePass:
        low, high = unit.from_m - AUDIBLE_M, unit.to_m + AUDIBLE_M
        own = self._beside(unit.lane, PlannedCerpm)
        return LanePass(
            lane=self.lanes[unit.lane],
            from_m=unit.from_m,
            to_m=unit.to_m,
            markers=self._along(unit.lane, PlannedCerpm, low, high, unit.drive, ASIDE_M),
            rows=self.rows,
            own=frozenset(one.detail.number for one, _, _ in own if isinstance(one.detail, PlannedCerpm)),
            radio=self._radio,
            speed_m_s=self._speed_m_s(unit.lane, (unit.from_m + unit.to_m) / 2),
            survey_rmse_m=self.terms.survey_rmse_m,
            rng=self.rng(unit.drive, "lane", unit.lane, int(unit.from_m)),
        )

    @cached_property
    def _radio(self) -> Radio:
        """Of the CERPMs, as they are programmed."""
        return simulated_radio(next(radio_of(row) for row in self.rows.values() if row.family == "cerpm"))

    def _speed_m_s(self, lane: str, at_m: float) -> float:
        one = self.lanes[lane]
        return self.terms.speed_share * float(one.value_at(one.design_speed_m_s, at_m))

    # --- plates -----------------------------------------------------------------------------------------------------

    def _prove_plates(self, unit: ProofUnit, drive: DriveTerms, result: UnitResult) -> None:
        for number, weight in zip(unit.markers, unit.weight, strict=True):
            if self.is_lost(drive.drive, number):
                result["passes"].append({**_NO_PASS, "marker": number, "weight": weight})
                continue
            done, wrong = drive_plate(self.plate_pass(self.by_number[number], drive), weight, self._min_frames)
            result["passes"].append(done)
            result["wrong"] += wrong

    def plate_pass(self, marker: PlannedMarker, drive: DriveTerms) -> PlatePass:
        """A pass over a plate with everything drawn."""
        lane = self.lanes[marker.lane]
        parts = parse_conditions(drive.condition)
        same, fair = (self._drive_conditions(drive, which) for which in (parts, frozenset({Condition.DAY})))
        rng = self.rng(drive.drive, "plate", marker.number)
        conditions = draw_plate(same, parts, rng)
        fair = draw_plate(fair, frozenset({Condition.DAY}), self.rng(drive.drive, "plate", marker.number))
        habit_m = float(self.rng(drive.drive, "habit").normal(0, PLACEMENT_SD_M / math.sqrt(2)))
        return PlatePass(
            marker=marker,
            lane=lane,
            camera=camera_of(drive.camera),
            conditions=conditions,
            fair=fair,
            parts=parts,
            speed_m_s=self._speed_m_s(marker.lane, marker.chainage_m),
            fps=drive.camera.frames_per_s,
            left_m=marker.offset_m + habit_m + float(rng.normal(0, PLACEMENT_SD_M / math.sqrt(2))),
            rotation_deg=float(rng.normal(0, ROTATION_SD_DEG)),
            rows=self.plates_near(marker, drive.drive),
            coarse_error_m=rng.normal(0, COARSE_M / RADIUS_95, 2),
            noise_seed=self.seed_of(drive.drive, "noise", marker.number),
        )

    def _drive_conditions(self, drive: DriveTerms, parts: frozenset[Condition]) -> Conditions:
        return draw_drive(drive.camera, parts, self.rng(drive.drive, "drive"))

    def plates_near(self, marker: PlannedMarker, drive: int) -> list[MarkerRow]:
        """Rows of the plates about a marker, its own among them."""
        numbers, tree = self._plates
        near = tree.query_ball_point(ecef_from_wgs84(np.array(marker.lon_deg), np.array(marker.lat_deg)), NEAR_M)
        return [self.surveyed(numbers[k], drive) for k in sorted(near)]

    @cached_property
    def _plates(self) -> tuple[list[int], scipy.spatial.cKDTree]:
        return self._row_tree("plate")


def _chunks(kind: UnitKind, drive: int, chosen: Sequence[tuple[PlannedMarker, float]], size: int) -> list[ProofUnit]:
    """Chosen markers lane by lane, some at a time."""
    units = []
    for lane in dict.fromkeys(marker.lane for marker, _ in chosen):
        own = [one for one in chosen if one[0].lane == lane]
        for start in range(0, len(own), size):
            part = own[start : start + size]
            numbers = tuple(marker.number for marker, _ in part)
            units.append(ProofUnit(kind, drive, lane, numbers, weight=tuple(weight for _, weight in part)))
    return units


def _format_of(book: Codebook) -> TagFormat:
    return TagFormat(book.design.magnets, book.design.length_m, book.design.segment_m)


def prove_plan(plan: Plan, terms: ProofTerms, rows: Mapping[int, MarkerRow]) -> ProofReport:
    """Compute all units here, one after the other, and summarize them; `rows` as of `Prover`."""
    prover = Prover(plan, terms, rows)
    return summarize(plan, terms, [prover.prove_unit(unit) for unit in prover.list_units()])
