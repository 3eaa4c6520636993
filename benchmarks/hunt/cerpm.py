"""Scenes of raised markers: a lane, markers along it, a drive past them, and the path that is decoded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from app.decoders.cerpm.merge import merge_markers
from app.decoders.cerpm.verify import verify_packets
from app.decoding.recordings import packet_strengths
from app.errors import InvalidParameter
from app.lanes.estimate import Lane, LaneMarkers, fit_lane
from app.lanes.initial_line import TRUSTED_TRACK_M
from app.lanes.types import PacketStrengths
from app.markers.cerpm import LaneSide
from app.planning.cerpm_placement import place_markers
from app.plots.lane import picture_of_lane, plot_lane
from app.sensors.pose_track import PoseTrack
from app.simulation.radio.drive import Driver, SatelliteReceiver, drive_lane, drive_past, observe_track
from app.simulation.radio.lanes import (
    InstalledMarkers,
    TrueLane,
    install_markers,
    lane_between,
    lose_row,
    lose_share,
)
from app.simulation.radio.link import Radio
from benchmarks.cerpm.path_errors import TOLERANCE_M, PlaceErrors, place_errors
from benchmarks.cerpm.scenes import LIMIT, ROUTE_NAMES, keys_for, markers_from_merged, route, sign
from benchmarks.hunt.scenes import Bound, Kind, Outcome, Parameters, switch
from benchmarks.scenes.road_shapes import RoadShape, lane_of_shape

_GREEN_BOOK = "AASHTO Green Book 2018, table 3-7: 21 m at 30 km/h; hairpins and junctions are tighter"
_BY_HAND = "by hand"
ROAD = {
    "route": Bound(0, len(ROUTE_NAMES), 0, "0 is a made lane, others are real ones", whole=True, plain=0.8),
    "length_m": Bound(120, 800, 400, "one to three radio ranges of 340 m (CERPM paper, 4.1)"),
    "radius_m": Bound(10, 800, 200, _GREEN_BOOK, logarithmic=True),
    "turn_deg": Bound(5, 200, 40, "a hairpin turns back"),
    "clothoid_m": Bound(5, 80, 30, _BY_HAND, logarithmic=True),
    "second_radius_m": Bound(10, 800, 300, _GREEN_BOOK, logarithmic=True),
    "second_turn_deg": Bound(5, 200, 30, "a hairpin turns back"),
    "straight_m": Bound(5, 150, 60, _BY_HAND),
    "turns_left": switch("either", simple=True),
    "width_m": Bound(2.7, 3.75, 3.3, "FHWA Mitigation Strategies, table 3; 3.75 m on German motorways"),
    "widening_m2": Bound(0, 40, 0, "about L^2 / 2 of a vehicle of up to 9 m", plain=0.4),
    "extra_m": Bound(0.3, 3.7, 0, "a lay-by, a turning lane, a second lane before a merge", plain=0.35),
    "extra_start": Bound(0, 0.9, 0.5, "anywhere"),
    "extra_length_m": Bound(0, 150, 60, _BY_HAND),
    "taper_m": Bound(8, 120, 40, "bus bays 1:5 to merging tapers 1:50", logarithmic=True),
    "extra_on_left": switch("either"),
    "extra_stays": switch("a lane that is added or dropped"),
    "shift_m": Bound(-3.5, 3.5, 0, "around an island, or into the next lane at a work zone", plain=0.6),
    "shift_length_m": Bound(15, 80, 40, "10 to 25 times the shift at 30 to 50 km/h", logarithmic=True),
    "shift_start": Bound(0, 0.9, 0.3, "anywhere"),
    "heading_deg": Bound(0, 360, 30, "any"),
}
MARKERS = {
    "spacing_m": Bound(8, 30, 12.192, "the paper's 40 ft, half of it, and 80 ft", logarithmic=True, plain=0.4),
    "survey_sd_m": Bound(0.01, 0.06, 0.02, "RTK, 2 cm; network RTK in towns", logarithmic=True, plain=0.3),
    "lost": Bound(0, 0.5, 0, "up to half of them dead, snowed in or hidden", plain=0.3),
    "lost_in_row": Bound(0, 6, 0, "resurfacing takes a stretch", whole=True, plain=0.5),
    "without_sides": switch("sides are optional in a message", plain=0.5),
    "wrong_sides": Bound(0, 0.15, 0, "programmed wrongly", plain=0.7),
    "misplaced": Bound(0, 3, 0, "moved, spoofed or surveyed wrongly", whole=True, plain=0.5),
    "misplaced_m": Bound(0.8, 30, 5, "a lane's width to the radio range", logarithmic=True),
    "shift_all_m": Bound(0.8, 40, 0, "another datum: 0.8 m between ITRF and ETRS89", logarithmic=True, plain=0.85),
    "shift_all_deg": Bound(0, 360, 0, "any direction"),
}
DRIVE = {
    "interval_s": Bound(0.5, 8, 2, "duty cycle and battery", logarithmic=True),
    "shadow_sd_db": Bound(2, 9, 4, "Rappaport 2002, table 4.2: 3 to 11.8 dB", plain=0.3),
    "speed_m_s": Bound(4, 36, 11, "walking traffic to a motorway", logarithmic=True),
    "wander_sd_m": Bound(0.05, 0.35, 0.15, "standard deviation of lateral position in driving studies, 0.15 to 0.35 m"),
    "habit_sd_m": Bound(0.02, 0.25, 0.09, _BY_HAND),
    "slow_sd_m": Bound(0.01, 3, 0.02, "RTK to a receiver without corrections", logarithmic=True, plain=0.3),
    "white_sd_m": Bound(0.005, 0.3, 0.01, "as above", logarithmic=True, plain=0.3),
    "slow_time_s": Bound(10, 120, 20, "multipath and troposphere", logarithmic=True),
    "without_track": switch("a log of packets alone", plain=0.85),
}
BESIDE = {
    "lane_beside": Bound(0, 2, 0, "none, a marked lane on the left, or one on the right", whole=True, plain=0.8),
    "lines_registered": switch("committed plans register the line of each marker"),
    "lines_wrong": Bound(0, 0.1, 0, "registered on the other line of the road", plain=0.7),
}
_WRONG_M, _LIMIT_WRONG_M = (
    1.0,
    0.5,
)  # [m] a path that is so far off is wrong, where the oracle is nearer; source: by hand
_FAR_Z, _FAR_M, _MAX_FAR_SHARE = 3.0, 0.12, 0.08  # [1, m, 1] sigma is too small; source: by hand
_MIN_COVERED, _ORACLE_RMS_M = 0.9, 0.3  # source: by hand
_EVERY_M = 60.0  # [m] errors further apart count as independent; source: by hand, about five spacings
_SEEN_Z = 6.0  # standard deviations from which on a shift must be seen; source: by hand


class _Drive(NamedTuple):
    lane: TrueLane
    honest: InstalledMarkers
    heard: LaneMarkers
    track: PoseTrack
    receiver: SatelliteReceiver
    span_m: tuple[float, float]
    numbers: set[int]
    strengths: PacketStrengths


class CerpmScenes:
    """Lanes and drives past their markers; the oracle knows which markers are honest, their sides, and the true track.

    The badness of a failure is an error in metres, or in standard deviations where these are too small.
    """

    bounds: Mapping[str, Bound] = {**ROAD, **MARKERS, **DRIVE, **BESIDE}

    def evaluate(self, parameters: Parameters, seed: int) -> Outcome:
        """Decode a drive, and compare its path with the true centre line and with the oracle's path."""
        try:
            drive = _simulate(parameters, seed)
        except InvalidParameter as error:  # a bend tighter than half its width
            return Outcome(Kind.BEYOND, detail=f"no such lane: {error}")
        if drive is None:
            return Outcome(Kind.BEYOND, detail="fewer than four markers were heard")
        path = _decode(parameters, drive)
        oracle = fit_lane(_oracle_markers(parameters, drive), _true_track(drive.lane, seed))
        return _judge(parameters, drive, path, oracle)

    def draw(self, parameters: Parameters, seed: int, path: Path) -> None:
        """Draw markers, track and path as SVG."""
        drive = _simulate(parameters, seed)
        if drive is not None:
            lane = _decode(parameters, drive)
            path.with_suffix(".svg").write_text(plot_lane(picture_of_lane(lane, drive.heard, drive.track)))


def make_lane(parameters: Parameters) -> TrueLane:
    """The lane of a scene.

    Raises
    ------
    InvalidParameter
        Its boundaries cross.
    """
    if parameters["route"]:
        return route(ROUTE_NAMES[int(parameters["route"]) - 1])
    shape: dict[str, Any] = {one.name: parameters[one.name] for one in fields(RoadShape)}
    return lane_of_shape(RoadShape(**shape))


def _simulate(p: Parameters, seed: int) -> _Drive | None:
    rng = np.random.default_rng([seed, 2])
    lane = make_lane(p)
    places = place_markers(lane.left_m, lane.right_m, spacing_m=p["spacing_m"])
    installed = install_markers(lane, places, rng, speed_limit=LIMIT, survey_sd_m=p["survey_sd_m"])
    installed = lose_share(installed, p["lost"], rng)
    side = LaneSide(int(rng.integers(1, 3)))
    row = min(int(p["lost_in_row"]), int((installed.side == side).sum()) - 3)
    if len(installed) < 6 or row < 0:
        return None
    honest = lose_row(installed, row, rng, side)
    sent, dishonest = _with_mistakes(p, lane, honest, rng)
    sent, line = _with_lane_beside(p, lane, sent, np.random.default_rng([seed, 4]))
    driver = Driver(speed_m_s=p["speed_m_s"], wander_sd_m=p["wander_sd_m"], habit_sd_m=p["habit_sd_m"])
    accuracy = float(np.hypot(p["white_sd_m"], p["slow_sd_m"]))
    receiver = SatelliteReceiver(p["white_sd_m"], p["slow_sd_m"], p["slow_time_s"], 1.0, accuracy)
    radio = Radio(interval_s=p["interval_s"], shadow_sd_db=p["shadow_sd_db"])
    passed = drive_past(lane, sent, rng, sign=sign, radio=radio, driver=driver, receiver=receiver)
    verification = verify_packets(list(passed.packets), keys_for(sent))
    heard = markers_from_merged(merge_markers(verification.packets, {}, None))
    if p["lines_registered"] and p["lane_beside"]:
        heard = replace(heard, line=np.array([line[number] for number in heard.number.tolist()]))
    numbers = set(heard.number.tolist()) - {int(honest.number[k]) for k in dishonest}
    chainage = honest.chainage_m[np.isin(honest.number, list(numbers))]
    if len(chainage) < 4:
        return None
    span_m, strengths = (chainage.min(), chainage.max()), packet_strengths(verification)
    return _Drive(lane, honest, heard, passed.track, receiver, span_m, numbers, strengths)


def _with_lane_beside(
    p: Parameters, lane: TrueLane, own: InstalledMarkers, rng: np.random.Generator
) -> tuple[InstalledMarkers, dict[int, int]]:
    """Markers of a lane beside, which shares a line with the driven one, and the line on which each is registered."""
    line = dict(zip(own.number.tolist(), own.side.tolist(), strict=True))
    if not p["lane_beside"]:
        return own, line
    on_left = p["lane_beside"] == 1
    normal = np.stack([-np.sin(lane.yaw_rad), np.cos(lane.yaw_rad)], 1) * p["width_m"]
    left, right = (lane.left_m + normal, lane.left_m) if on_left else (lane.right_m, lane.right_m - normal)
    beside = lane_between(left[::8], right[::8], lane.origin)
    outer = LaneSide.LEFT if on_left else LaneSide.RIGHT
    places = place_markers(beside.left_m, beside.right_m, spacing_m=p["spacing_m"])
    other = install_markers(
        beside, [place for place in places if place.side == outer], rng, speed_limit=LIMIT,
        survey_sd_m=p["survey_sd_m"], first_number=1 + int(own.number.max()),
    )  # fmt: skip
    names = [one.name for one in fields(own) if one.name != "speed_limit"]
    both: dict[str, Any] = {name: np.concatenate([getattr(own, name), getattr(other, name)]) for name in names}
    line |= dict.fromkeys(other.number.tolist(), 3)
    wrong = rng.random(len(line)) < p["lines_wrong"]
    line = {
        number: int(rng.integers(1, 4)) if off else true
        for (number, true), off in zip(line.items(), wrong, strict=True)
    }
    return replace(own, **both), line


def _is_sure_of_lane(p: Parameters, drive: _Drive) -> bool:
    """Whether the receiver can show in which of two lanes the vehicle is."""
    return not p["lane_beside"] or (not p["without_track"] and drive.receiver.reported_accuracy_m < TRUSTED_TRACK_M)


def _with_mistakes(
    p: Parameters, lane: TrueLane, honest: InstalledMarkers, rng: np.random.Generator
) -> tuple[InstalledMarkers, set[int]]:
    """Markers with wrong sides, misplaced ones, and all of them shifted; and which of them are misplaced."""
    count = len(honest)
    side = honest.broadcast_side.copy()
    wrong = rng.random(count) < p["wrong_sides"]
    side[wrong] = 3 - side[wrong]
    if p["without_sides"]:
        side[:] = LaneSide.UNKNOWN
    points = lane.enu_from_wgs84(honest.lon_deg, honest.lat_deg)
    moved = rng.choice(count, min(int(p["misplaced"]), count // 8), replace=False)
    angle = rng.uniform(0, 2 * np.pi, len(moved))
    points[moved] += p["misplaced_m"] * np.stack([np.cos(angle), np.sin(angle)], 1)
    common = np.radians(p["shift_all_deg"])
    points += p["shift_all_m"] * np.array([np.sin(common), np.cos(common)])
    lon, lat = lane.wgs84_from_enu(points)
    changed = replace(honest, lon_deg=lon, lat_deg=lat, broadcast_side=side)
    return changed, {int(k) for k in moved}


def _decode(p: Parameters, drive: _Drive) -> Lane:
    return fit_lane(drive.heard, None if p["without_track"] else drive.track, strengths=drive.strengths)


def _oracle_markers(p: Parameters, drive: _Drive) -> LaneMarkers:
    """The honest markers that were heard, with their true sides, where they really are."""
    kept = np.isin(drive.honest.number, list(drive.numbers))
    honest = drive.honest.chosen(kept)
    n = len(honest)
    return LaneMarkers(
        honest.number, honest.lon_deg, honest.lat_deg, honest.side, np.full(n, p["survey_sd_m"]), np.full(n, np.nan)
    )


def _true_track(lane: TrueLane, seed: int) -> PoseTrack:
    """An exact receiver in a vehicle that keeps to the centre."""
    rng = np.random.default_rng([seed, 3])
    centred = Driver(wander_sd_m=0.0, habit_sd_m=0.0, cut_m2=0.0)
    return observe_track(lane, drive_lane(lane, centred, rng), SatelliteReceiver(0.002, 0.0, 20.0, 0.1, 0.02), rng)


def _judge(p: Parameters, drive: _Drive, path: Lane, oracle: Lane) -> Outcome:
    limit = place_errors(drive.lane, oracle, *drive.span_m)
    possible = limit is not None and limit.coverage > _MIN_COVERED and limit.rms_m < _ORACLE_RMS_M
    found = place_errors(drive.lane, path, *drive.span_m)
    blocked = path.track_apart or (path.track_agreement is not None and path.track_agreement.disagrees)
    if p["shift_all_m"]:
        return _judge_shifted(p, drive, path, found, blocked)
    if found is None or blocked or found.coverage < _MIN_COVERED:
        alone = bool(p["without_track"]) and bool(p["without_sides"])  # nothing shows the direction of travel
        said = path.refusal or ("blocked by the track" if blocked else f"{found.coverage if found else 0:.0%} covered")
        missed = possible and not alone and _is_sure_of_lane(p, drive)
        covered = found.coverage if found is not None and not blocked else 0.0
        return Outcome(Kind.MISSED if missed else Kind.BEYOND, 1.0, said, read=covered if missed else None)
    sure = found.confidence > 0.5
    step = max(round(_EVERY_M / 0.25), 1)
    readings = [
        (float(c), bool(o <= TOLERANCE_M)) for c, o in zip(found.confidence[::step], found.off_m[::step], strict=True)
    ]
    squared = [(float((o / s) ** 2), 1) for o, s in zip(found.off_m[::step], found.sigma_m[::step], strict=True)]
    worst, share = float(found.off_m[sure].max(initial=0.0)), found.coverage if possible else None
    if worst > _WRONG_M and possible and limit is not None and limit.worst_m < _LIMIT_WRONG_M:
        return Outcome(
            Kind.WRONG, worst, f"{worst:.2f} m off, the oracle {limit.worst_m:.2f} m", readings, squared, share
        )
    z = found.off_m / found.sigma_m
    far = (z > _FAR_Z) & (found.off_m > _FAR_M)
    if far.mean() > _MAX_FAR_SHARE:
        said = f"{far.mean():.0%} of the path is beyond 3 sigma, up to {found.off_m[far].max():.2f} m"
        return Outcome(Kind.OVERCONFIDENT, float(z.max()), said, readings, squared, share)
    return Outcome(Kind.RIGHT, worst, f"RMS {found.rms_m:.3f} m", readings, squared, share)


def _judge_shifted(p: Parameters, drive: _Drive, path: Lane, found: PlaceErrors | None, blocked: bool) -> Outcome:
    """All markers are shifted: the path must be refused or blocked where the receiver can show the shift."""
    if found is None or blocked or found.rms_m < _WRONG_M:
        return Outcome(Kind.RIGHT, detail="a common shift that is seen, or hardly across the lane")
    accuracy = 1.5 * drive.receiver.reported_accuracy_m
    seen = found.rms_m > _SEEN_Z * float(np.hypot(accuracy, 0.25)) and not p["without_track"]
    said = f"all markers are shifted by {p['shift_all_m']:.1f} m, {found.rms_m:.2f} m across"
    return Outcome(Kind.WRONG if seen else Kind.BEYOND, found.rms_m, said)
