"""Drives of a bar of magnetometers over magnets of the plan: an information tag, or a stretch of a painted line."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from app.decoders.magnet.decoder import decode_trace
from app.decoders.magnet.identify import TagFormat
from app.decoders.magnet.match import match_tags, tag_candidates
from app.decoders.magnet.readings import MagnetReading
from app.decoders.magnet.registered_tag import RegisteredTag
from app.geodesy import enu_from_wgs84, grade_accuracy, wgs84_from_enu
from app.markers.magnet import Orientation
from app.planning.alignment import Floats, Lane
from app.planning.plan import PlannedLineMagnet, PlannedMarker, PlannedTag
from app.planning.proof.results import MarkerPass, WrongReading
from app.simulation.magnetic.drive import Scene, SimulatedDrive, TrueMagnet, simulate_drive
from app.simulation.magnetic.road import PlacedTag, Road, RoadMagnet, tag_magnets
from app.simulation.magnetic.vehicle import Course, Vehicle

LEAD_M, TAIL_M = 60.0, 20.0
"""[m] driven before and after. Source: benchmarks/magnets/scenes.py."""
UNDER_CM = 88.0
"""[cm] from the middle of the bar; a magnet farther off is beside it. Source: app/demo/traces.py."""
REACH_M = 0.4
"""[m] a reading so near to a magnet is of it. Source: app/demo/traces.py."""
_OTHER = -1  # tag number of magnets that are not driven for
_TAG_REACH_M = 1.0  # [m] of a tag's reading from its first magnet; source: app/demo/traces.py
_WEAVE_M = 0.1  # [m] source: app/demo/magnets.py, between the 0.05 m of the benchmarks and its 0.12 m
_CURVED_1PM = 1e-5  # [1/m] below it a road is straight; source: by hand, 100 km of radius
_SLOWER = 0.5  # of the speed, to find out whether speed is the cause; source: chosen by hand
_HEADING_STD_DEG = 0.1  # [deg] of a tag's surveyed direction; source: TAG_BEARING_STD_DEG of the decoder


@dataclass(frozen=True, slots=True, eq=False)
class MagnetPass:
    """A drive over a stretch of a lane with magnets.

    Attributes
    ----------
    lane : Lane
    from_m, to_m : float
        Of the lane, without lead and tail. [m]
    tag : PlannedMarker or None
        The tag that is driven over.
    lines : sequence of (PlannedMarker, float, float)
        Line magnets near by with chainage and offset on this lane. [m]
    nearby : sequence of PlannedMarker
        Tags that the vehicle looks for.
    left_m : float
        Of the vehicle from the lane's centre. [m]
    speed_m_s, clearance_m, survey_rmse_m : float
    seed : tuple of int
    """

    lane: Lane
    from_m: float
    to_m: float
    tag: PlannedMarker | None
    lines: Sequence[tuple[PlannedMarker, float, float]]
    nearby: Sequence[PlannedMarker]
    left_m: float
    speed_m_s: float
    clearance_m: float
    survey_rmse_m: float
    seed: tuple[int, ...]
    bends: bool = True

    def scene(self) -> Scene:
        """What is driven; chainage 0 of the simulated road is `LEAD_M` before the stretch."""
        start_m = self.from_m - LEAD_M
        length_m = self.to_m - self.from_m + LEAD_M + TAIL_M
        heading_deg = float(self.lane.heading_at(max(start_m, 0.0)))
        road = Road(length_m, _bends(self.lane, start_m, length_m) if self.bends else (), heading_deg=heading_deg)
        tags = []
        if self.tag is not None:
            tags = [PlacedTag(_planned(self.tag).tag, self.tag.chainage_m - start_m, self.tag.offset_m)]
        lines = [
            RoadMagnet(at - start_m, left, _line(marker).tag.polarity, Orientation.UP, marker.number)
            for marker, at, left in self.lines
        ]
        others = [marker for marker in self.nearby if marker is not self.tag and marker.lane == self.lane.name]
        beside = [PlacedTag(_planned(marker).tag, marker.chainage_m - start_m, marker.offset_m) for marker in others]
        lines += [replace(magnet, tag=_OTHER) for magnet in tag_magnets(beside) if 0 < magnet.chainage_m < length_m]
        course = Course(speed_m_s=self.speed_m_s, left_m=self.left_m, weave_m=_WEAVE_M)
        return Scene(road, Vehicle.compact(clearance_m=self.clearance_m), course, tags=tags, lines=lines)


def drive_tag(one: MagnetPass, weight: float) -> tuple[MarkerPass, list[WrongReading]]:
    """Read a tag in one pass; a miss is repeated without one difficulty at a time, to find its cause."""
    assert one.tag is not None
    read, fix_m, wrong = read_tag(one)
    cause = None if read else _tag_cause(one)
    number = one.tag.number
    result = MarkerPass(
        marker=number, weight=weight, lost=False, readable=1, seen=1, read=int(read), fix_m=fix_m, cause=cause
    )
    return result, [WrongReading(marker=number, text=text) for text in wrong]


def drive_line(one: MagnetPass, weight: float) -> tuple[list[MarkerPass], list[WrongReading]]:
    """Read the magnets of a line along which the vehicle drives with its bar over the line."""
    simulated = simulate_drive(one.scene(), np.random.default_rng(one.seed))
    bar = Vehicle.compact(clearance_m=one.clearance_m).bar
    readings = [found for found in decode_trace(simulated.trace, bar) if isinstance(found, MagnetReading)]
    inside = {marker.number for marker, at, _left in one.lines if one.from_m <= at < one.to_m}
    passes, left = [], list(readings)
    for magnet in simulated.magnets:
        near = [reading for reading in left if _is_near(reading, magnet)]
        nearest = min(near, key=lambda reading: abs(reading.t_s - magnet.t_s)) if near else None
        right = nearest is not None and nearest.polarity == magnet.polarity and nearest.phi_deg == magnet.orientation
        if nearest is not None:
            left.remove(nearest)
        if magnet.tag in inside and abs(magnet.lateral_cm) <= UNDER_CM:
            passes.append(
                MarkerPass(
                    marker=magnet.tag, weight=weight, lost=False, readable=1, seen=1, read=int(right), fix_m=None,
                    cause=None if right else "sensor noise",
                )
            )  # fmt: skip
    wrong = [
        WrongReading(marker=0, text=f"magnet {reading.polarity} at {reading.lateral_cm:.0f} cm")
        for reading in left
        if LEAD_M <= reading.odometer_m <= LEAD_M + one.to_m - one.from_m  # the truth lacks those at the ends
    ]
    return passes, wrong


def read_tag(one: MagnetPass) -> tuple[bool, list[float] | None, list[str]]:
    """Whether the tag was read, error of the fix along and across, and codes that are not there."""
    assert one.tag is not None
    scene = one.scene()
    rng = np.random.default_rng(one.seed)
    simulated = simulate_drive(scene, rng)
    registered = [_registered(marker, one.survey_rmse_m, rng) for marker in one.nearby]
    tag = _planned(one.tag).tag
    formats = {TagFormat(tag.magnet_count, tag.length_m, tag.segment_m)}
    bar = scene.vehicle.bar
    findings = decode_trace(simulated.trace, bar, candidates=tag_candidates(registered, formats))
    magnets = [magnet for magnet in simulated.magnets if magnet.tag == 0]
    read, fix_m, wrong = False, None, []
    for found in match_tags(findings, registered, bar).tags:
        near = bool(magnets) and _first_apart_m(found.reading.start_s, magnets[0]) < _TAG_REACH_M
        if found.reading.tag == tag and near and not found.reading.wrong_way:
            read = True
            if found.fix is not None and found.match is not None and found.match.tag is not None:
                matched = found.match.tag.marker_id == str(one.tag.number)
                if matched:
                    fix_m = _fix_error(one, simulated, magnets[-1], found.fix.lon_deg, found.fix.lat_deg, found.fix.t_s)
        elif found.reading.tag is not None:
            wrong.append(found.reading.tag.text)
    return read, fix_m, wrong


def _tag_cause(one: MagnetPass) -> str:
    slower = replace(one, speed_m_s=_SLOWER * one.speed_m_s)
    tries = (
        ("neighbour magnet", replace(one, lines=())), ("bend", replace(one, bends=False)), ("speed", slower),
        ("clearance", replace(one, clearance_m=min(one.clearance_m, 0.16))),
    )  # fmt: skip
    for cause, easier in tries:
        if read_tag(easier)[0]:
            return cause
    return "sensor noise"


def _fix_error(
    one: MagnetPass, simulated: SimulatedDrive, last: TrueMagnet, lon_deg: float, lat_deg: float, t_s: float
) -> list[float]:
    """Error of the vehicle's reference point along and across the tag. [m]

    The true heading is that of the trace, within a tenth of a degree.
    """
    assert one.tag is not None
    origin = (one.tag.lon_deg, one.tag.lat_deg, one.tag.height_m or 0.0)
    east, north, _up = enu_from_wgs84(lon_deg, lat_deg, origin[2], origin)
    bearing = math.radians(_bearing_deg(one.tag))
    along = east * math.sin(bearing) + north * math.cos(bearing)
    across = -east * math.cos(bearing) + north * math.sin(bearing)
    trace = simulated.trace
    assert trace.heading_t_s is not None
    assert trace.heading_deg is not None
    heading = float(np.interp(last.t_s, trace.heading_t_s, np.unwrap(trace.heading_deg, period=360.0)))
    turn = math.radians((heading - math.degrees(bearing) + 180.0) % 360.0 - 180.0)  # to the right of the tag
    bar = Vehicle.compact(clearance_m=one.clearance_m).bar
    forward_m = float(np.mean(bar.positions_m[bar.array, 0]))
    driven_m = (t_s - last.t_s) * last.speed_m_s
    true_along = _planned(one.tag).tag.length_m + driven_m - forward_m * math.cos(turn)
    true_across = -last.lateral_cm / 100 + forward_m * math.sin(turn)
    return [float(along - true_along), float(across - true_across)]


def _registered(marker: PlannedMarker, rmse_m: float, rng: np.random.Generator) -> RegisteredTag:
    """A tag of the plan as it is registered after a survey."""
    planned = _planned(marker)
    off = rng.normal(0, rmse_m / math.sqrt(2), 2)
    height = marker.height_m or 0.0
    lon, lat, _height = wgs84_from_enu(np.array([*off, 0.0]), (marker.lon_deg, marker.lat_deg, height))
    bearing = _bearing_deg(marker) + float(rng.normal(0, _HEADING_STD_DEG))
    return RegisteredTag(
        str(marker.number), "surveyed", planned.tag, lon, lat, height, bearing, marker.lon_deg, marker.lat_deg,
        rmse_m, grade_accuracy(rmse_m), meaning=planned.meaning,
    )  # fmt: skip


def _bearing_deg(marker: PlannedMarker) -> float:
    """Direction from the first magnet to the last, clockwise from north. [deg]"""
    first, last = _planned(marker).magnets[0], _planned(marker).magnets[-1]
    east, north, _up = enu_from_wgs84(last[1], last[2], 0.0, (first[1], first[2], 0.0))
    return math.degrees(math.atan2(east, north)) % 360.0


def _bends(lane: Lane, start_m: float, length_m: float) -> list[tuple[float, float, float]]:
    """Stretches of constant radius along a part of the lane; straight beyond its ends. [m]"""
    step = 2.0 * lane.step_m
    at: Floats = np.arange(max(start_m, 0.0), min(start_m + length_m, lane.length_m), step)
    curvature = lane.value_at(lane.curvature_per_m, at + step / 2)
    return [
        (float(a) - start_m, float(a) - start_m + step, 1 / float(k))
        for a, k in zip(at, curvature, strict=True)
        if abs(k) > _CURVED_1PM
    ]


def _is_near(reading: MagnetReading, magnet: TrueMagnet) -> bool:
    off_m = abs(reading.t_s - magnet.t_s) * magnet.speed_m_s
    return off_m < REACH_M and abs(reading.lateral_cm - magnet.lateral_cm) < 100 * REACH_M


def _first_apart_m(start_s: float, first: TrueMagnet) -> float:
    return abs(start_s - first.t_s) * first.speed_m_s


def _planned(marker: PlannedMarker) -> PlannedTag:
    assert isinstance(marker.detail, PlannedTag)
    return marker.detail


def _line(marker: PlannedMarker) -> PlannedLineMagnet:
    assert isinstance(marker.detail, PlannedLineMagnet)
    return marker.detail
