"""Lanes, markers and drives of the benchmark."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import fields
from functools import lru_cache
from pathlib import Path

import numpy as np

from app.decoders.cerpm.merge import MergedMarkers
from app.encoders.cerpm import encode_message
from app.lanes.estimate import LaneMarkers
from app.markers.cerpm import CerpmMessage, SpeedLimit, SpeedUnit, derive_marker_key
from app.planning.cerpm_placement import place_markers
from app.sensors.pose_track import PoseTrack, ReceivedPacket
from app.simulation.radio.drive import Driver, SatelliteReceiver, drive_lane, observe_track
from app.simulation.radio.lanes import InstalledMarkers, TrueLane, install_markers, lane_from_wgs84, make_lane

ROUTES = Path(__file__).parent / "routes"
ROUTE_NAMES = ("karlsruhe_low_1", "karlsruhe_moderate_1", "tfhrc_bend_1", "tfhrc_low_1")
MADE = "made"
LIMIT = SpeedLimit(25, SpeedUnit.MPH)
AGENCY_KEY = bytes(range(16))
SURVEY_M = 0.02
_HEIGHT_M = 120.0


@lru_cache(maxsize=8)
def route(name: str) -> TrueLane:
    """A lane of the shared routes."""
    with (ROUTES / f"{name}.geojson").open() as file:
        features = json.load(file)["features"]
    sides = {f["properties"]["side"]: np.array(f["geometry"]["coordinates"])[:, :2] for f in features}
    return lane_from_wgs84(sides["L"], sides["R"], height_m=_HEIGHT_M)


def list_lanes(seed: int, run: int, made: int) -> list[tuple[str, TrueLane]]:
    """The shared routes and fresh made lanes."""
    lanes = [(name, route(name)) for name in ROUTE_NAMES]
    return lanes + [(MADE, make_lane(np.random.default_rng([seed, 1, run, k]))) for k in range(made)]


def shortened(lane: TrueLane, longest_m: float) -> TrueLane:
    """The first so many metres of a lane."""
    kept = lane.chainage_m <= longest_m
    parts = {f.name: getattr(lane, f.name)[kept] for f in fields(lane) if f.name != "origin"}
    return TrueLane(lane.origin, **parts)


def install(lane: TrueLane, rng: np.random.Generator, per_side: int | None = None) -> InstalledMarkers:
    """Markers every 40 ft, closer in bends; or so many a side."""
    return install_markers(
        lane,
        place_markers(lane.left_m, lane.right_m, markers_per_side=per_side),
        rng,
        speed_limit=LIMIT,
        survey_sd_m=SURVEY_M,
    )


def track(lane: TrueLane, rng: np.random.Generator, receiver: SatelliteReceiver | None = None) -> PoseTrack:
    """A drive as the vehicle's receiver has it."""
    return observe_track(lane, drive_lane(lane, Driver(), rng), receiver or SatelliteReceiver.rtk(), rng)


def markers_for_lane(installed: InstalledMarkers) -> LaneMarkers:
    """Markers as if all were received and verified."""
    limit = installed.speed_limit.km_h if installed.speed_limit else np.nan
    n = len(installed)
    return LaneMarkers(
        installed.number,
        installed.lon_deg,
        installed.lat_deg,
        installed.broadcast_side,
        np.full(n, SURVEY_M),
        np.full(n, limit),
    )


def markers_from_merged(merged: MergedMarkers) -> LaneMarkers:
    """What is left of a log when verified and merged."""
    return LaneMarkers(
        merged.number, merged.lon_deg, merged.lat_deg, merged.side, merged.sigma_m, merged.speed_limit_kmh
    )


@lru_cache(maxsize=100_000)
def key_of(number: int) -> bytes:
    """Of a marker of the benchmark's agency."""
    return derive_marker_key(AGENCY_KEY, number)


def sign(message: CerpmMessage) -> bytes:
    """What a marker of the benchmark's agency sends."""
    return encode_message(message, key_of(message.number))


def keys_for(installed: InstalledMarkers) -> dict[int, bytes]:
    """Keys of the registered markers."""
    return {int(n): key_of(int(n)) for n in installed.number}


def payload_of(packets: Iterable[ReceivedPacket]) -> set[bytes]:
    """Payloads of a log."""
    return {p.payload for p in packets if p.payload is not None}


def long_lane(rng: np.random.Generator, length_m: float, rate_hz: float = 10.0) -> tuple[LaneMarkers, PoseTrack]:
    """Many kilometres of markers in pairs every 12.25 m, and a drive along them at 25 m/s."""
    lane = make_lane(rng, length_m=length_m, max_curvature_per_m=0.01)
    every = slice(0, None, 49)
    both = np.concatenate([lane.left_m[every], lane.right_m[every]])
    lon, lat = lane.wgs84_from_enu(both + rng.normal(0, SURVEY_M, both.shape))
    half = len(both) // 2
    side = np.repeat([1, 2], half)
    n = len(both)
    markers = LaneMarkers(np.arange(1, n + 1), lon, lat, side, np.full(n, SURVEY_M), np.full(n, LIMIT.km_h))
    drive = drive_lane(lane, Driver(speed_m_s=25.0), rng)
    return markers, observe_track(lane, drive, SatelliteReceiver.rtk(rate_hz), rng)
