"""Simulated drives of a proof over magnets and past CERPMs.

A drive becomes the files that a vehicle uploads. They are read and decoded by the functions that decode uploads
(`app.decoding`), with the rows of the plan's markers as the registry has them after the commit and the survey. What
else is known of a drive, such as the lane that it follows, is only used to judge the result.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache

import numpy as np
import scipy

from app.decoders.magnet.identify import ReadTrace, TagFormat
from app.decoders.magnet.readings import MagnetReading
from app.decoding.declarations import CoarsePosition, DeclaredPackets, DeclaredTrace
from app.decoding.recordings import (
    KnownMarkers,
    NearbyTags,
    estimate_path,
    find_magnets,
    lane_markers,
    packet_strengths,
    read_drive_files,
    read_packets_of,
    side_of,
    speed_limit_of,
)
from app.encoders.cerpm import encode_message
from app.formats.format import SpooledFile
from app.formats.traces.read import read_trace
from app.geodesy import (
    decimal_year,
    enu_from_wgs84,
    grade_accuracy,
    total_accuracy_m,
    wgs84_from_enu,
)
from app.lanes.types import Lane as LaneEstimate
from app.markers.cerpm import CerpmMessage, LaneSide, derive_marker_key
from app.markers.magnet import HALF_HEIGHT_M, Orientation
from app.markers.reading import MarkerRow
from app.planning.alignment import Lane
from app.planning.plan import PlannedCerpm, PlannedLineMagnet, PlannedMarker, PlannedTag
from app.planning.proof.report import LanePath, MarkerPass, WrongReading
from app.radio.settings import RadioSettings
from app.sensors.magnetometer_bar import BarDeclaration
from app.simulation.magnetic.drive import Course, Scene, SimulatedDrive, TrueMagnet, Vehicle, simulate_drive
from app.simulation.magnetic.recorder import write_tables
from app.simulation.magnetic.road import PlacedTag, Road, RoadMagnet, tag_magnets
from app.simulation.radio.drive import Driver, SatelliteReceiver, drive_past, write_packets, write_poses
from app.simulation.radio.lanes import InstalledMarkers, TrueLane, lane_from_wgs84
from app.simulation.radio.link import Radio
from app.values import Floats

# === The rows of a plan's markers after they were surveyed, and the time of the drives.


START = datetime(2026, 6, 2, 8, tzinfo=UTC)
"""When drives begin."""
EPOCH = decimal_year(START)
HEADING_RMSE_DEG = 0.1
"""[deg] of a plate's surveyed direction. Source: assumed, 0.5 mm across its side."""
COARSE_M = 20.0
"""[m] accuracy of a vehicle's coarse position. Source: assumed, between streets and buildings."""
RADIUS_95 = 2.4477  # standard deviations of each axis in the radius that contains 95 %
_MIN_RMSE_M = 1e-3  # [m] of a survey, so that its weight is finite


def surveyed_row(
    row: MarkerRow, rmse_m: float, rng: np.random.Generator, off_m: Sequence[float] = (0.0, 0.0)
) -> MarkerRow:
    """The row of a planned marker after a survey with RTK.

    Parameters
    ----------
    rmse_m : float
        Of both axes together, as the registry has it. [m]
    off_m : sequence of float, shape (2,)
        East and north of the marker from its planned place. [m]
    """
    found_m = np.array([*rng.normal(off_m, rmse_m / math.sqrt(2)), 0.0])
    lon_deg, lat_deg, _height = wgs84_from_enu(found_m, (row.lon_deg, row.lat_deg, row.height_m or 0.0))
    stated_m = max(rmse_m, _MIN_RMSE_M)
    if row.family == "plate" and row.heading_deg is not None:  # that of a tag follows from its lane
        heading_deg = (row.heading_deg + float(rng.normal(0, HEADING_RMSE_DEG))) % 360.0
        row = row._replace(heading_deg=heading_deg, heading_rmse_deg=HEADING_RMSE_DEG)
    return row._replace(
        status="surveyed", lon_deg=lon_deg, lat_deg=lat_deg, realization="ITRF2014", epoch=EPOCH,
        horizontal_rmse_m=stated_m, vertical_rmse_m=stated_m, survey_method="GNSS RTK", transform_accuracy_m=0.0,
        localization_grade=grade_accuracy(total_accuracy_m(stated_m, 0.0)).value, transform_note=None,
    )  # fmt: skip


def coarse_position(lon_deg: float, lat_deg: float, rng: np.random.Generator) -> CoarsePosition:
    """Where a vehicle at a place takes itself to be."""
    error_m = np.array([*rng.normal(0, COARSE_M / RADIUS_95, 2), 0.0])
    lon, lat, _height = wgs84_from_enu(error_m, (lon_deg, lat_deg, 0.0))
    return CoarsePosition(lon_deg=lon, lat_deg=lat, accuracy_m=COARSE_M)


def pack(files: Mapping[str, bytes | str]) -> SpooledFile:
    """Files of a drive as a ZIP that is uploaded."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return SpooledFile.of(packed.getvalue())


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


@dataclass(frozen=True, slots=True, eq=False)
class LanePass:
    """A drive along a stretch of a lane."""

    lane: Lane
    # `from_m`, `to_m`: [m] of the lane, in which errors count
    from_m: float
    to_m: float
    # [m] CERPMs within reach of the radio, with chainage and offset on the lane; missing ones are left out
    markers: Sequence[tuple[PlannedMarker, float, float]]
    rows: Mapping[int, MarkerRow]  # of all planned CERPMs, by their numbers in the plan
    # registry numbers of those on the boundaries of the lane, by which the path is judged
    own: frozenset[int]
    radio: Radio
    speed_m_s: float
    survey_rmse_m: float
    rng: np.random.Generator


def drive_cerpms(one: LanePass) -> LanePath:
    """Drive, decode what was received as the server decodes an upload, and compare the path with the centre line."""
    low, high = max(one.from_m - BEYOND_M, 0.0), min(one.to_m + BEYOND_M, one.lane.length_m)
    true = true_lane(one.lane, low, high)
    installed, rows = install(one, true, low)
    simulated = drive_past(
        true, installed, one.rng, sign=_sign, radio=one.radio, driver=Driver(speed_m_s=one.speed_m_s, lead_m=0.0),
        receiver=SatelliteReceiver.rtk(), start_s=START.timestamp(),
    )  # fmt: skip
    declared = DeclaredPackets()
    upload = pack({"packets.jsonl": write_packets(simulated.packets), "poses.csv": write_poses(simulated.track)})
    files = read_drive_files("drive.zip", upload, declared)
    known = KnownMarkers({n: rows[n] for n in files.numbers if n in rows}, _KEY, {}, last_span=0)
    read = read_packets_of(files, known, declared, received_at=START, observed_at=START)
    path = estimate_path(lane_markers(read), packet_strengths(read.verification), files.track, declared)
    inside = np.isin(installed.number, list(one.own))
    inside &= (installed.chainage_m + low >= one.from_m) & (installed.chainage_m + low <= one.to_m)
    received = np.isin(installed.number[inside], read.merged.number)
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


def install(one: LanePass, true: TrueLane, low_m: float) -> tuple[InstalledMarkers, dict[int, MarkerRow]]:
    """The stretch's markers, placed within a centimetre, and their rows after the survey, by registry number."""
    planned = [marker for marker, _, _ in one.markers]
    lon, lat = (np.array([getattr(marker, name) for marker in planned]) for name in ("lon_deg", "lat_deg"))
    off_m = one.rng.normal(0, PLACING_SD_M, (len(planned), 2))
    rows = [
        surveyed_row(one.rows[marker.number], one.survey_rmse_m, one.rng, off)
        for marker, off in zip(planned, off_m.tolist(), strict=True)
    ]
    installed = InstalledMarkers(
        number=np.array([int(row.digits) for row in rows], np.int64),
        side=np.array([int(LaneSide.LEFT if left > 0 else LaneSide.RIGHT) for _, _, left in one.markers], np.int64),
        chainage_m=np.array([at - low_m for _, at, _ in one.markers]),
        point_m=true.enu_from_wgs84(lon, lat) + off_m,
        lon_deg=np.array([row.lon_deg for row in rows]),
        lat_deg=np.array([row.lat_deg for row in rows]),
        broadcast_side=np.array([int(side_of(row)) for row in rows], np.int64),
        speed_limit=speed_limit_of(rows[0]) if rows else None,
    )
    return installed, {int(row.digits): row for row in rows}


def judge_path(path: LaneEstimate, true: TrueLane, one: LanePass, low_m: float, received: tuple[int, int]) -> LanePath:
    """Distances of the true centre line's places from the path, between the first and the last marker."""
    ends = [at - low_m for marker, at, _ in one.markers if _planned(marker).number in one.own] or [0.0]
    inside = (true.chainage_m >= max(one.from_m - low_m, min(ends))) & (
        true.chainage_m <= min(one.to_m - low_m, max(ends))
    )
    result = LanePath(
        places=int(inside.sum()), covered=0, square_sum_m2=0.0, worst_m=0.0, worst_at_m=one.from_m,
        received=received[0], markers=received[1],
        left_out=sorted({out.number for out in path.left_out} & one.own), refusal=path.refusal,
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


@lru_cache(maxsize=200_000)
def _key_of(number: int) -> bytes:
    return derive_marker_key(_KEY, number)


def _sign(message: CerpmMessage) -> bytes:
    return encode_message(message, _key_of(message.number))


def _planned(marker: PlannedMarker) -> PlannedCerpm:
    assert isinstance(marker.detail, PlannedCerpm)
    return marker.detail


# === Drives of a bar of magnetometers over magnets of the plan: an information tag, or a stretch of a painted line.


FORWARD_M = 3.2
"""[m] of the bar ahead of the rear axle. Source: `Vehicle.compact`."""
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
_TAG_ALONG_M = 5.0  # [m] of a tag's first magnet by the odometer, which is off by a share of the way


@dataclass(frozen=True, slots=True, eq=False)
class MagnetPass:
    """A drive over a stretch of a lane with magnets."""

    lane: Lane
    # `from_m`, `to_m`: [m] of the lane, without lead and tail
    from_m: float
    to_m: float
    tag: PlannedMarker | None  # the tag that is driven over
    lines: Sequence[tuple[PlannedMarker, float, float]]  # [m] line magnets nearby with chainage and offset on this lane
    nearby: Sequence[PlannedMarker]  # tags on the lane nearby
    position: CoarsePosition  # of the vehicle when the recording begins
    rows: Sequence[MarkerRow]  # of the magnet markers within reach of that position, after the survey
    formats: tuple[TagFormat, ...]  # of the codebook
    left_m: float  # [m] of the vehicle from the lane's centre
    speed_m_s: float
    clearance_m: float
    seed: tuple[int, ...]
    depth_m: float = -HALF_HEIGHT_M  # [m] of the magnets' centres below the road
    bends: bool = True

    def scene(self) -> Scene:
        """What is driven; chainage 0 of the simulated road is `LEAD_M` before the stretch."""
        start_m = self.from_m - LEAD_M
        length_m = self.to_m - self.from_m + LEAD_M + TAIL_M
        heading_deg = float(self.lane.heading_at(max(start_m, 0.0)))
        road = Road(length_m, _bends(self.lane, start_m, length_m) if self.bends else (), heading_deg=heading_deg)
        tags = []
        if self.tag is not None:
            tags = [self._placed(self.tag, start_m)]
        lines = [
            RoadMagnet(at - start_m, left, _line(marker).tag.polarity, Orientation.UP, marker.number, self.depth_m)
            for marker, at, left in self.lines
        ]
        others = [marker for marker in self.nearby if marker is not self.tag and marker.lane == self.lane.name]
        beside = [self._placed(marker, start_m) for marker in others]
        lines += [replace(magnet, tag=_OTHER) for magnet in tag_magnets(beside) if 0 < magnet.chainage_m < length_m]
        course = Course(speed_m_s=self.speed_m_s, left_m=self.left_m, weave_m=_WEAVE_M)
        return Scene(road, Vehicle.compact(clearance_m=self.clearance_m), course, tags=tags, lines=lines)

    def _placed(self, marker: PlannedMarker, start_m: float) -> PlacedTag:
        return PlacedTag(_planned_tag(marker).tag, marker.chainage_m - start_m, marker.offset_m, self.depth_m)


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
    trace = decode_upload(one, simulated)
    inside = {marker.number for marker, at, _left in one.lines if one.from_m <= at < one.to_m}
    passes, left = [], list(trace.magnets)
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
    low, high = LEAD_M, LEAD_M + one.to_m - one.from_m  # the truth lacks magnets at the ends
    wrong = [
        WrongReading(marker=0, text=f"magnet {reading.polarity} at {reading.lateral_cm:.0f} cm")
        for reading in left
        if low <= reading.odometer_m <= high
    ]
    driven = [(placed.tag, placed.chainage_m) for placed in simulated.tags] + [
        (_planned_tag(marker).tag, marker.chainage_m - one.from_m + LEAD_M) for marker in one.nearby
    ]
    for found in trace.tags:
        at_m = found.reading.magnets[0].odometer_m
        there = any(tag == found.reading.tag and abs(at - at_m) < _TAG_ALONG_M for tag, at in driven)
        if found.reading.tag is not None and low <= at_m <= high and not there:
            wrong.append(WrongReading(marker=0, text=found.reading.tag.text))
    return passes, wrong


def decode_upload(one: MagnetPass, simulated: SimulatedDrive) -> ReadTrace:
    """What the server reads in the recording of a drive that is uploaded to it."""
    declared = DeclaredTrace(unit="uT", axes="ISO8855", bar=BarDeclaration(forward_m=FORWARD_M))
    with pack(write_tables(simulated.trace)).open() as stream:
        trace = read_trace({"drive.zip": stream}, declared).trace
    nearby = NearbyTags.of(one.rows, EPOCH)
    checked, _version = find_magnets(trace, declared, nearby.texts, () if nearby.texts else one.formats, nearby.depth_m)
    return nearby.match(checked.findings, declared.sensors)


def read_tag(one: MagnetPass) -> tuple[bool, list[float] | None, list[str]]:
    """Whether the tag was read, error of the fix along and across, and codes that are not there."""
    assert one.tag is not None
    simulated = simulate_drive(one.scene(), np.random.default_rng(one.seed))
    tag = _planned_tag(one.tag).tag
    magnets = [magnet for magnet in simulated.magnets if magnet.tag == 0]
    read, fix_m, wrong = False, None, []
    for found in decode_upload(one, simulated).tags:
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
        ("depth", replace(one, depth_m=-HALF_HEIGHT_M)),
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
