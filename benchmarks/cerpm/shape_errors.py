"""Rows about surveys, logs and receivers that are wrong together: which wrong paths are called fit, and which right
ones are not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from app.decoders.cerpm.merge import merge_markers
from app.decoders.cerpm.verify import verify_packets
from app.decoding.recordings import packet_strengths
from app.lanes.estimate import Lane, LaneMarkers, fit_lane
from app.lanes.types import PacketStrengths
from app.sensors.pose_track import PoseTrack, ReceivedPacket
from app.services.decodes.packet_documents import path_warnings
from app.simulation.radio.attacks import corrupt_packets, forge_packets, move_claim, repeat_packets, shuffle_packets
from app.simulation.radio.drive import Drive, Driver, SatelliteReceiver, drive_lane, drive_past
from app.simulation.radio.lanes import InstalledMarkers, TrueLane, lose_share, make_lane
from app.values import Floats
from benchmarks.cerpm import scenes
from benchmarks.cerpm.path_errors import MIN_CONFIDENCE, place_errors
from benchmarks.cerpm.paths import Result
from benchmarks.scenes.road_shapes import RoadShape, lane_of_shape

WRONG_M = 0.5  # [m] a path that is farther from the true centre line somewhere, and sure of it, is wrong
LENGTH_M = 500.0  # [m] of straight and gently bent lanes
PRECISE, PLAIN = "2 cm", "2 m"
RECEIVERS = {PRECISE: SatelliteReceiver.rtk, PLAIN: SatelliteReceiver.plain}
SHIFT_M = 1.0  # [m] of all markers
JUMP_M = (0.8, 1.9)  # [m] of half of the markers: between datums
STEP_M, STEP_SHARE = (0.5, 1.5), (0.3, 0.7)  # [m, 1] of a receiver that goes on to state its accuracy, and where
WILD, WILD_M = 8, 8.0  # fixes, and how far away they are [m]
GAP_M = (100.0, 200.0)  # [m] of a tunnel
CHANGE_M, CHANGE_LENGTH_M, BESIDE_M = 3.3, 45.0, 80.0  # [m] into the next lane, over a length, and for how long
MOST_M = 10.0  # [m] of a receiver's error when a tunnel ends
CONVERGED_M = 40.0  # [m] of driving until that is a third


class Upload(NamedTuple):
    """What a vehicle sends, and the true lane."""

    lane: TrueLane
    markers: LaneMarkers
    track: PoseTrack | None
    strengths: PacketStrengths


Scene = Callable[[SatelliteReceiver, np.random.Generator], Upload]


def run_shape_errors(seed: int, short: bool) -> Result:
    """Error by error, receiver by receiver."""
    rows: list[Sequence[object]] = []
    for number, (name, (scene, receivers)) in enumerate(SCENES.items()):
        for receiver in receivers:
            drives = range(3 if short else 20)
            found = [_judge(scene(RECEIVERS[receiver](), np.random.default_rng([seed, 62, number, k]))) for k in drives]
            counts = [sum(one[0] == what for one in found) for what in ("right", "unfit", "refused", "found", "silent")]
            worst = max((one[1] for one in found if one[0] in ("right", "silent")), default=float("nan"))
            rows.append((name, receiver, len(found), *counts, f"{worst:.2f}"))
    note = (
        f"A path is wrong if it is more than {WRONG_M:g} m off where its confidence is {MIN_CONFIDENCE:g} or more, or "
        "runs against the direction of travel. Right paths that are called unfit to localize a vehicle are a "
        "loss; wrong ones that are found (unfit or refused) are as they should be; wrong ones that are called fit are "
        "silent errors."
    )
    head = (
        "what is wrong", "receiver", "drives", "right", "right, but unfit", "right markers, refused", "wrong, found",
        "silent", "worst that is fit [m]",
    )  # fmt: skip
    return note, head, rows


def _judge(upload: Upload) -> tuple[str, float]:
    """How a path is reported, and its largest error where it is sure. [m]"""
    path = fit_lane(upload.markers, upload.track, strengths=upload.strengths)
    if path.refusal is not None:
        return "refused", np.inf
    off_m = worst_m(upload.lane, path)
    fit = is_fit(path)
    if off_m > WRONG_M:
        return ("silent" if fit else "found"), off_m
    return ("right" if fit else "unfit"), off_m


def is_fit(path: Lane) -> bool:
    """Whether the service would call a path fit to localize a vehicle."""
    return not path_warnings(path) and not path.track_apart


def worst_m(lane: TrueLane, path: Lane) -> float:
    """Largest error of a path where its confidence is high; infinite where it runs the other way. [m]"""
    chainage = lane.chainage_m[[np.argmin(np.hypot(*(lane.centre_m - p).T)) for p in lane.enu_from_wgs84(
        path.lon_deg[[0, -1]], path.lat_deg[[0, -1]])]]  # fmt: skip
    if chainage[1] < chainage[0]:
        return float("inf")
    errors = place_errors(lane, path, 0.0, lane.length_m)
    if errors is None:
        return float("inf")
    return float(errors.off_m[errors.confidence >= MIN_CONFIDENCE].max(initial=0.0))


# --- scenes -------------------------------------------------------------------------------------------------------


def _upload(
    lane: TrueLane, installed: InstalledMarkers, receiver: SatelliteReceiver, rng: np.random.Generator,
    drive: Drive | None = None,
) -> Upload:  # fmt: skip
    heard = drive_past(lane, installed, rng, sign=scenes.sign, receiver=receiver, drive=drive)
    return _read(lane, installed, heard.packets, heard.track)


def _read(
    lane: TrueLane, installed: InstalledMarkers, packets: Sequence[ReceivedPacket], track: PoseTrack | None
) -> Upload:
    """A log verified and merged, as that of an upload is."""
    verification = verify_packets(packets, scenes.keys_for(installed))
    merged = merge_markers(verification.packets, {}, track)
    return Upload(lane, scenes.markers_from_merged(merged), track, packet_strengths(verification))


def _moved(lane: TrueLane, installed: InstalledMarkers, by_m: Floats) -> InstalledMarkers:
    """Markers that send other positions than their own."""
    lon, lat = lane.wgs84_from_enu(lane.enu_from_wgs84(installed.lon_deg, installed.lat_deg) + by_m)
    return replace(installed, lon_deg=lon, lat_deg=lat)


def _across(lane: TrueLane, chainage_m: float, size_m: float, rng: np.random.Generator) -> Floats:
    """A shift across the lane at a place, to either side."""
    yaw = float(np.interp(chainage_m, lane.chainage_m, lane.yaw_rad))
    return np.asarray(size_m * rng.choice([-1.0, 1.0]) * np.array([-np.sin(yaw), np.cos(yaw)]))


def tight_bends(receiver: SatelliteReceiver, rng: np.random.Generator) -> Upload:
    """Bends of 9 to 14 m and a log with faults: no sides, lost, forged, spoofed and corrupt packets."""
    shape = RoadShape(
        length_m=250.0, radius_m=float(rng.uniform(9, 14)), turn_deg=float(rng.uniform(60, 170)), clothoid_m=12.0,
        second_radius_m=float(rng.uniform(9, 20)), second_turn_deg=float(rng.uniform(40, 120)),
        turns_left=bool(rng.integers(2)), width_m=float(rng.uniform(3.0, 3.6)), heading_deg=float(rng.uniform(0, 360)),
    )  # fmt: skip
    lane = lane_of_shape(shape)
    installed = lose_share(scenes.install(lane, rng).without_sides(), 0.2, rng)
    installed = move_claim(lane, installed, int(rng.integers(1, len(installed) - 1)), rng)
    heard = drive_past(lane, installed, rng, sign=scenes.sign, receiver=receiver)
    log = corrupt_packets(heard.packets, 0.1, rng)
    log += forge_packets(heard.packets, len(log) // 20, rng)
    log = shuffle_packets(repeat_packets(log, 0.3, rng), rng)
    return _read(lane, installed, log, heard.track)


def two_datums(receiver: SatelliteReceiver, rng: np.random.Generator) -> Upload:
    """From a place on, all markers are surveyed in another datum."""
    lane = make_lane(rng, length_m=LENGTH_M)
    installed = scenes.install(lane, rng)
    from_m = lane.length_m * float(rng.uniform(0.3, 0.7))
    shift = _across(lane, from_m, float(rng.uniform(*JUMP_M)), rng)
    moved = _moved(lane, installed, (installed.chainage_m > from_m)[:, None] * shift)
    return _upload(lane, moved, receiver, rng)


def common_shift(receiver: SatelliteReceiver, rng: np.random.Generator) -> Upload:
    """All markers are surveyed a metre to one side."""
    lane = make_lane(rng, length_m=LENGTH_M)
    installed = scenes.install(lane, rng)
    shift = _across(lane, lane.length_m / 2, SHIFT_M, rng)
    return _upload(lane, _moved(lane, installed, shift), receiver, rng)


def swapped_sides(receiver: SatelliteReceiver, rng: np.random.Generator) -> Upload:
    """Every marker names the other side, and the log has no track."""
    lane = make_lane(rng, length_m=LENGTH_M)
    installed = scenes.install(lane, rng)
    installed = replace(installed, broadcast_side=3 - installed.broadcast_side)
    heard = drive_past(lane, installed, rng, sign=scenes.sign, receiver=receiver)
    return _read(lane, installed, heard.packets, None)


def reversed_track(receiver: SatelliteReceiver, rng: np.random.Generator) -> Upload:
    """The positions of the track are in the opposite order."""
    lane = make_lane(rng, length_m=LENGTH_M)
    sent = _upload(lane, scenes.install(lane, rng), receiver, rng)
    assert sent.track is not None
    track = replace(sent.track, lon_deg=sent.track.lon_deg[::-1], lat_deg=sent.track.lat_deg[::-1])
    return sent._replace(track=replace(track, heading_deg=sent.track.heading_deg[::-1]))


def nothing(receiver: SatelliteReceiver, rng: np.random.Generator) -> Upload:
    """A drive without errors but the usual ones."""
    lane = make_lane(rng, length_m=LENGTH_M)
    return _upload(lane, scenes.install(lane, rng), receiver, rng)


def _with_errors(sent: Upload, errors_m: Callable[[Floats, Floats], Floats]) -> Upload:
    """The track with errors that depend on the distance driven and on the direction there."""
    assert sent.track is not None
    fixes = sent.lane.enu_from_wgs84(sent.track.lon_deg, sent.track.lat_deg)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(fixes, axis=0).T))])
    yaw = np.radians(90.0 - sent.track.heading_deg)
    lon, lat = sent.lane.wgs84_from_enu(fixes + errors_m(along, np.stack([-np.sin(yaw), np.cos(yaw)], 1)))
    return sent._replace(track=replace(sent.track, lon_deg=lon, lat_deg=lat))


def receiver_step(receiver: SatelliteReceiver, rng: np.random.Generator) -> Upload:
    """A receiver that fixes wrong integers: its positions step, and it goes on to state its accuracy."""
    sent = nothing(receiver, rng)
    size, share = float(rng.uniform(*STEP_M)) * rng.choice([-1, 1]), float(rng.uniform(*STEP_SHARE))
    return _with_errors(sent, lambda along, left: size * left * (along > share * along[-1])[:, None])


def receiver_drift(receiver: SatelliteReceiver, rng: np.random.Generator) -> Upload:
    """A receiver that drifts by up to a metre and a half, and goes on to state its accuracy."""
    sent = nothing(receiver, rng)
    drift = rng.uniform(*STEP_M) * np.array([np.cos(angle := rng.uniform(0, 2 * np.pi)), np.sin(angle)])
    return _with_errors(sent, lambda along, _left: drift * (along / along[-1])[:, None])


def wild_fixes(receiver: SatelliteReceiver, rng: np.random.Generator) -> Upload:
    """Single fixes that are metres away, in tight bends."""
    sent = tight_bends(receiver, rng)
    assert sent.track is not None
    off = np.zeros((len(sent.track.time_s), 2))
    off[rng.choice(len(off), WILD, replace=False)] = rng.normal(0, WILD_M, (WILD, 2))
    return _with_errors(sent, lambda _along, _left: off)


def tunnel(receiver: SatelliteReceiver, rng: np.random.Generator) -> Upload:
    """No fixes in a tunnel; afterwards an error of metres that decays."""
    sent = nothing(receiver, rng)
    angle, size = rng.uniform(0, 2 * np.pi), float(rng.uniform(0.5, MOST_M / 2))
    first = sent.lane.length_m * float(rng.uniform(0.3, 0.5))
    last = first + float(rng.uniform(*GAP_M))

    def errors_m(along: Floats, _left: Floats) -> Floats:
        after = (along > last) * np.exp(-np.maximum(along - last, 0.0) / CONVERGED_M)
        return np.asarray(size * after[:, None] * np.array([np.cos(angle), np.sin(angle)]))

    assert sent.track is not None
    fixes = sent.lane.enu_from_wgs84(sent.track.lon_deg, sent.track.lat_deg)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(fixes, axis=0).T))])
    kept, track = (along < first) | (along > last), _with_errors(sent, errors_m).track
    assert track is not None
    names = ("time_s", "lon_deg", "lat_deg", "heading_deg", "accuracy_m")
    return sent._replace(track=PoseTrack(*(getattr(track, name)[kept] for name in names)))


def overtaking(receiver: SatelliteReceiver, rng: np.random.Generator) -> Upload:
    """The vehicle leaves the only marked lane to its left and comes back."""
    lane = make_lane(rng, length_m=LENGTH_M)
    drive = drive_lane(lane, Driver(), rng)
    start = lane.length_m * float(rng.uniform(0.3, 0.5))

    def ramp(from_m: float) -> Floats:
        return np.asarray((1 - np.cos(np.pi * np.clip((drive.chainage_m - from_m) / CHANGE_LENGTH_M, 0, 1))) / 2)

    left = drive.left_m + CHANGE_M * (ramp(start) - ramp(start + CHANGE_LENGTH_M + BESIDE_M))
    point = lane.points_m(drive.chainage_m, left)
    step = np.gradient(point, axis=0)
    yaw = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    moved = replace(drive, left_m=left, point_m=point, yaw_rad=yaw)
    return _upload(lane, scenes.install(lane, rng), receiver, rng, moved)


SCENES: dict[str, tuple[Scene, tuple[str, ...]]] = {
    "tight bends, faulty log": (tight_bends, (PRECISE, PLAIN)),
    "half of the road in another datum": (two_datums, (PRECISE, PLAIN)),
    "all markers shifted by 1 m": (common_shift, (PRECISE, PLAIN)),
    "sides exchanged, no track": (swapped_sides, (PRECISE,)),
    "track in the opposite order": (reversed_track, (PRECISE, PLAIN)),
    "nothing": (nothing, (PRECISE, PLAIN)),
    "receiver steps": (receiver_step, (PRECISE,)),
    "receiver drifts": (receiver_drift, (PRECISE,)),
    "eight wild fixes": (wild_fixes, (PRECISE,)),
    "tunnel": (tunnel, (PRECISE, PLAIN)),
    "vehicle overtakes outside the marked lane": (overtaking, (PRECISE, PLAIN)),
}
