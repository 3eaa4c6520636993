"""Simulated drives of a proof over magnets and past CERPMs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy

from app.decoders.cerpm.merge import RegisteredMarker, merge_markers
from app.decoders.cerpm.verify import verify_packets
from app.decoders.magnet.decoder import decode_trace
from app.decoders.magnet.identify import RegisteredTag, TagFormat, match_tags, tag_candidates
from app.decoders.magnet.readings import MagnetReading
from app.encoders.cerpm import encode_message
from app.geodesy import enu_from_wgs84, grade_accuracy, wgs84_from_enu
from app.lanes.estimate import Lane as LanePathEstimate
from app.lanes.estimate import LaneMarkers, fit_lane
from app.markers.cerpm import DEGREE_STEP, CerpmMessage, LaneSide, derive_marker_key
from app.markers.magnet import Orientation
from app.planning.alignment import Lane
from app.planning.plan import PlannedCerpm, PlannedLineMagnet, PlannedMarker, PlannedTag
from app.planning.proof.report import LanePath, MarkerPass, WrongReading
from app.radio.settings import RadioSettings
from app.simulation.magnetic.drive import Course, Scene, SimulatedDrive, TrueMagnet, Vehicle, simulate_drive
from app.simulation.magnetic.road import PlacedTag, Road, RoadMagnet, tag_magnets
from app.simulation.radio.drive import Driver, SatelliteReceiver, drive_past
from app.simulation.radio.lanes import InstalledMarkers, TrueLane, lane_from_wgs84
from app.simulation.radio.link import Radio
from app.values import Floats

# === A drive past the CERPMs of a stretch of lane: packets, the path that follows from them, and its errors.


AUDIBLE_M, ASIDE_M = 350.0, 50.0
"""[m] beyond a stretch and beside it, within which markers send while it is driven. Source: the preview of the CERPM
paper, 340 m; four lanes."""
BEYOND_M = 150.0
"""[m] of lane before and after a stretch that are driven too, so that its ends are no ends of the path. Source: the
`bridge_m` of `LaneRules`."""
NEAR_M = 1.0
"""[m] a place of the centre line is covered if the path is within this. Source: benchmarks/cerpm/path_errors.py."""
PLACING_SD_M = 0.01
"""[m] of placing a marker, each axis. Source: app/simulation/radio/lanes.py."""
_KEY = bytes(range(16))  # of the simulated agency; the proof needs authentic packets, not secret ones
_STEP_M = 1.0  # [m] between points of a boundary; source: the alignment's own step
_MAX_JITTER = 0.45  # source: `Radio` needs less than half
_MIN_ACCURACY_M = 1e-3  # [m] of a survey, so that its weight is finite


@dataclass(frozen=True, slots=True, eq=False)
class LanePass:
    """A drive along a stretch of a lane."""

    lane: Lane
    # `from_m`, `to_m`: [m] of the lane, in which errors count
    from_m: float
    to_m: float
    # [m] CERPMs within reach of the radio, with chainage and offset on the lane; missing ones are left out
    markers: Sequence[tuple[PlannedMarker, float, float]]
    # registry numbers of those that are registered on the boundaries of the lane: the path is fitted to them
    own: frozenset[int]
    radio: Radio
    speed_m_s: float
    survey_rmse_m: float
    rng: np.random.Generator


def drive_cerpms(one: LanePass) -> LanePath:
    """Drive, verify and merge the packets, fit the lane's path, and compare it with the true centre line."""
    low, high = max(one.from_m - BEYOND_M, 0.0), min(one.to_m + BEYOND_M, one.lane.length_m)
    true = true_lane(one.lane, low, high)
    installed = install(one, true, low)
    simulated = drive_past(
        true, installed, one.rng, sign=_sign, radio=one.radio, driver=Driver(speed_m_s=one.speed_m_s),
        receiver=SatelliteReceiver.rtk(),
    )  # fmt: skip
    registered = _registered(installed, one.survey_rmse_m)
    verified = verify_packets(simulated.packets, {int(number): _key_of(int(number)) for number in installed.number})
    merged = merge_markers(verified.packets, registered, simulated.track)
    at = dict(zip(installed.number.tolist(), installed.chainage_m.tolist(), strict=True))
    used = np.array([n in one.own and 0.0 <= at[n] <= high - low for n in merged.number.tolist()], bool)
    columns = (merged.number, merged.lon_deg, merged.lat_deg, merged.side, merged.sigma_m, merged.speed_limit_kmh)
    path = fit_lane(LaneMarkers(*(column[used] for column in columns)), simulated.track)
    inside = np.isin(installed.number, list(one.own))
    inside &= (installed.chainage_m + low >= one.from_m) & (installed.chainage_m + low <= one.to_m)
    received = np.isin(installed.number[inside], merged.number)
    return judge_path(path, true, one, low, (int(received.sum()), int(inside.sum())))


def simulated_radio(settings: RadioSettings) -> Radio:
    """The radio as it is simulated: on one channel, so that settings with several fare worse than they would."""
    return Radio(
        spreading_factor=settings.spreading_factor,
        bandwidth_hz=settings.bandwidth_hz,
        interval_s=settings.interval_s,
        jitter=min(settings.jitter_share, _MAX_JITTER),
        preamble_symbols=settings.preamble_symbols,
    )


def true_lane(lane: Lane, from_m: float, to_m: float) -> TrueLane:
    """A stretch of a lane between its boundaries; chainage 0 is its start."""
    at = np.linspace(from_m, to_m, max(math.ceil((to_m - from_m) / _STEP_M), 2) + 1)
    half = lane.value_at(lane.width_m, at) / 2
    left, right = (np.stack(lane.position_at(at, sign * half), 1) for sign in (1.0, -1.0))
    return lane_from_wgs84(left, right)


def install(one: LanePass, true: TrueLane, low_m: float) -> InstalledMarkers:
    """The stretch's markers, placed within a centimetre and surveyed."""
    lon = np.array([marker.lon_deg for marker, _, _ in one.markers])
    lat = np.array([marker.lat_deg for marker, _, _ in one.markers])
    count = len(one.markers)
    point = true.enu_from_wgs84(lon, lat) + one.rng.normal(0, PLACING_SD_M, (count, 2))
    survey = one.rng.normal(0, one.survey_rmse_m / math.sqrt(2), (count, 2))
    surveyed_lon, surveyed_lat = true.wgs84_from_enu(point + survey)
    details = [_planned(marker) for marker, _, _ in one.markers]
    return InstalledMarkers(
        number=np.array([detail.number for detail in details], np.int64),
        side=np.array([int(LaneSide.LEFT if left > 0 else LaneSide.RIGHT) for _, _, left in one.markers], np.int64),
        chainage_m=np.array([at - low_m for _, at, _ in one.markers]),
        point_m=point,
        lon_deg=np.round(surveyed_lon / DEGREE_STEP) * DEGREE_STEP,
        lat_deg=np.round(surveyed_lat / DEGREE_STEP) * DEGREE_STEP,
        broadcast_side=np.array([int(detail.side) for detail in details], np.int64),
        speed_limit=details[0].speed_limit if details else None,
    )


def judge_path(
    path: LanePathEstimate, true: TrueLane, one: LanePass, low_m: float, received: tuple[int, int]
) -> LanePath:
    """Distances of the true centre line's places from the path, between the first and the last marker."""
    ends = [at - low_m for marker, at, _ in one.markers if _planned(marker).number in one.own] or [0.0]
    inside = (true.chainage_m >= max(one.from_m - low_m, min(ends))) & (
        true.chainage_m <= min(one.to_m - low_m, max(ends))
    )
    result = LanePath(
        places=int(inside.sum()), covered=0, square_sum_m2=0.0, worst_m=0.0, worst_at_m=one.from_m,
        received=received[0], markers=received[1], left_out=sorted({out.number for out in path.left_out}),
        refusal=path.refusal,
    )  # fmt: skip
    if path.refusal is not None or len(path.lon_deg) < 2 or not inside.any():
        return result
    away = distances_m(true.centre_m[inside], true.enu_from_wgs84(path.lon_deg, path.lat_deg))
    covered = away <= NEAR_M
    if covered.any():
        worst = int(np.argmax(np.where(covered, away, -1.0)))
        result["covered"] = int(covered.sum())
        result["square_sum_m2"] = float((away[covered] ** 2).sum())
        result["worst_m"] = float(away[worst])
        result["worst_at_m"] = float(true.chainage_m[inside][worst] + low_m)
    return result


def distances_m(places_m: Floats, line_m: Floats) -> Floats:
    """Distance of places from a line of close points, shape (K,). [m]"""
    line = line_m[np.concatenate([[True], np.linalg.norm(np.diff(line_m, axis=0), axis=1) > 1e-9])]
    pieces = np.diff(line, axis=0)
    square = (pieces**2).sum(1)
    nearest = scipy.spatial.cKDTree(line).query(places_m)[1]
    away = np.full(len(places_m), np.inf)
    for piece in (np.maximum(nearest - 1, 0), np.minimum(nearest, len(pieces) - 1)):
        beside = places_m - line[piece]
        share = np.clip(np.einsum("ij,ij->i", beside, pieces[piece]) / square[piece], 0.0, 1.0)
        away = np.minimum(away, np.linalg.norm(beside - share[:, None] * pieces[piece], axis=1))
    return away


def _registered(installed: InstalledMarkers, rmse_m: float) -> dict[int, RegisteredMarker | None]:
    sigma_m = max(rmse_m / math.sqrt(2), _MIN_ACCURACY_M)
    return {
        int(number): RegisteredMarker(float(lon), float(lat), side=LaneSide(int(side)), sigma_m=sigma_m)
        for number, lon, lat, side in zip(
            installed.number, installed.lon_deg, installed.lat_deg, installed.broadcast_side, strict=True
        )
    }


@lru_cache(maxsize=200_000)
def _key_of(number: int) -> bytes:
    return derive_marker_key(_KEY, number)


def _sign(message: CerpmMessage) -> bytes:
    return encode_message(message, _key_of(message.number))


def _planned(marker: PlannedMarker) -> PlannedCerpm:
    assert isinstance(marker.detail, PlannedCerpm)
    return marker.detail


# === Drives of a bar of magnetometers over magnets of the plan: an information tag, or a stretch of a painted line.


LEAD_M, TAIL_M = 60.0, 20.0
"""[m] driven before and after. Source: benchmarks/magnets/scenes.py."""
UNDER_CM = 88.0
"""[cm] from the middle of the bar; a magnet farther off is beside it. Source: app/demo/magnets.py."""
REACH_M = 0.4
"""[m] a reading so near to a magnet is of it. Source: app/demo/magnets.py."""
_OTHER = -1  # tag number of magnets that are not driven for
_TAG_REACH_M = 1.0  # [m] of a tag's reading from its first magnet; source: app/demo/magnets.py
_WEAVE_M = 0.1  # [m] source: app/demo/magnets.py, between the 0.05 m of the benchmarks and its 0.12 m
_CURVED_PER_M = 1e-5  # [1/m] below it a road is straight; 100 km of radius
_SLOWER = 0.5  # of the speed, to find out whether speed is the cause
_HEADING_STD_DEG = 0.1  # [deg] of a tag's surveyed direction; source: TAG_BEARING_STD_DEG of the decoder


@dataclass(frozen=True, slots=True, eq=False)
class MagnetPass:
    """A drive over a stretch of a lane with magnets."""

    lane: Lane
    # `from_m`, `to_m`: [m] of the lane, without lead and tail
    from_m: float
    to_m: float
    tag: PlannedMarker | None  # the tag that is driven over
    lines: Sequence[tuple[PlannedMarker, float, float]]  # [m] line magnets nearby with chainage and offset on this lane
    nearby: Sequence[PlannedMarker]  # tags that the vehicle looks for
    left_m: float  # [m] of the vehicle from the lane's centre
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
            tags = [PlacedTag(_planned_tag(self.tag).tag, self.tag.chainage_m - start_m, self.tag.offset_m)]
        lines = [
            RoadMagnet(at - start_m, left, _line(marker).tag.polarity, Orientation.UP, marker.number)
            for marker, at, left in self.lines
        ]
        others = [marker for marker in self.nearby if marker is not self.tag and marker.lane == self.lane.name]
        beside = [
            PlacedTag(_planned_tag(marker).tag, marker.chainage_m - start_m, marker.offset_m) for marker in others
        ]
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
    registered = [_registered_tag(marker, one.survey_rmse_m, rng) for marker in one.nearby]
    tag = _planned_tag(one.tag).tag
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
        ("neighbour magnet", replace(one, lines=())),
        ("bend", replace(one, bends=False)),
        ("speed", slower),
        ("clearance", replace(one, clearance_m=min(one.clearance_m, 0.16))),
    )
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
    true_along = _planned_tag(one.tag).tag.length_m + driven_m - forward_m * math.cos(turn)
    true_across = -last.lateral_cm / 100 + forward_m * math.sin(turn)
    return [float(along - true_along), float(across - true_across)]


def _registered_tag(marker: PlannedMarker, rmse_m: float, rng: np.random.Generator) -> RegisteredTag:
    """A tag of the plan as it is registered after a survey."""
    planned = _planned_tag(marker)
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
    first, last = _planned_tag(marker).magnets[0], _planned_tag(marker).magnets[-1]
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
        if abs(k) > _CURVED_PER_M
    ]


def _is_near(reading: MagnetReading, magnet: TrueMagnet) -> bool:
    off_m = abs(reading.t_s - magnet.t_s) * magnet.speed_m_s
    return off_m < REACH_M and abs(reading.lateral_cm - magnet.lateral_cm) < 100 * REACH_M


def _first_apart_m(start_s: float, first: TrueMagnet) -> float:
    return abs(start_s - first.t_s) * first.speed_m_s


def _planned_tag(marker: PlannedMarker) -> PlannedTag:
    assert isinstance(marker.detail, PlannedTag)
    return marker.detail


def _line(marker: PlannedMarker) -> PlannedLineMagnet:
    assert isinstance(marker.detail, PlannedLineMagnet)
    return marker.detail
