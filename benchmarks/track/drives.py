"""Simulated drives along real lanes, at the level of decoded fixes.

The curvature is that of the lanes in benchmarks/cerpm/routes (their licences are there), repeated until a drive is long
enough. Errors of fixes are drawn from the standard deviations that stand here; the decoders' own benchmarks measure
them (docs/benchmarks.md).
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy import signal
from scipy.ndimage import gaussian_filter1d

from app.geodesy.frames import metres_per_radian
from app.tracks import Clock, LanePath, PositionFix, Samples, TrackInput
from app.values import Floats

ROUTES = Path(__file__).parents[1] / "cerpm" / "routes"
T0_S, STEP_S = 1_780_000_000.0, 0.05
PLATE_ALONG_M, PLATE_ACROSS_M, PLATE_HEADING_DEG, PLATE_SURVEY_M = 0.10, 0.05, 0.5, 0.03
TAG_ALONG_M, TAG_ACROSS_M, TAG_HEADING_DEG, TAG_SURVEY_M = 0.05, 0.02, 0.3, 0.02
PATH_SIGMA_M = 0.06
SPEED_SCALE, SPEED_DRIFT, SPEED_NOISE_M_S = 0.02, 0.003, 0.05
HEADING_BIAS_DEG, HEADING_DRIFT_DEG, HEADING_NOISE_DEG = 1.0, 0.5, 0.3
MAX_OFFSET_S = 0.5


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive: what the sensors report, and the truth."""

    given: TrackInput
    time_s: Floats
    lon: Floats
    lat: Floats
    heading: Floats
    offset_s: float
    wrong: frozenset[int]

    def errors_m(self, time_s: Floats, lon_deg: Floats, lat_deg: Floats) -> tuple[Floats, Floats]:
        """Errors along and across the drive."""
        lon, lat = (np.interp(time_s, self.time_s, values) for values in (self.lon, self.lat))
        psi = np.interp(time_s, self.time_s, self.heading)
        east_per, north_per = metres_per_radian(lat)
        east = (np.radians(lon_deg) - lon) * east_per
        north = (np.radians(lat_deg) - lat) * north_per
        return east * np.sin(psi) + north * np.cos(psi), -east * np.cos(psi) + north * np.sin(psi)


@cache
def curvatures() -> tuple[tuple[str, Floats], ...]:
    """Curvature of each lane every metre. [1/m]"""
    found = []
    for path in sorted(ROUTES.glob("*.geojson")):
        places = _longest_line(json.loads(path.read_text()))
        lat = np.radians(places[:, 1])
        east_per, north_per = metres_per_radian(lat)
        east = (np.radians(places[:, 0]) - np.radians(places[0, 0])) * east_per
        north = (lat - lat[0]) * north_per
        along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(east), np.diff(north)))])
        at = np.arange(0.0, along[-1], 1.0)
        east, north = (gaussian_filter1d(np.interp(at, along, v), 8.0, mode="nearest") for v in (east, north))
        psi = np.unwrap(np.arctan2(np.gradient(east), np.gradient(north)))
        found.append((path.stem, np.clip(np.gradient(psi), -0.03, 0.03)[10:-10]))
    return tuple(found)


def simulate(seed: int, length_m: float = 4000.0) -> Drive:
    """A drive with two outages of 500 m, wrong markers, a cloned plate, and a camera whose clock is off."""
    rng = np.random.default_rng(seed)
    _name, curvature = curvatures()[seed % len(curvatures())]
    count = int(length_m) + 200
    bends = np.tile(np.concatenate([curvature, -curvature]), count // (2 * len(curvature)) + 1)[:count]
    lane_heading = rng.uniform(0, 2 * np.pi) + np.cumsum(bends)
    chainage, speed, t = _speeds(rng, bends, length_m)
    left = _gauss_markov(rng, t.size, 0.25, 6.0, STEP_S)
    left = gaussian_filter1d(left, 40)
    psi = np.interp(chainage, np.arange(count), lane_heading) - np.gradient(left, STEP_S) / np.maximum(speed, 3.0)
    lon, lat = _drive_along(rng, speed, psi)
    return _with_sensors(rng, t, chainage, speed, psi, lon, lat, left, length_m)


def _longest_line(document: dict[str, object]) -> Floats:
    lines: list[list[list[float]]] = []

    def walk(node: object) -> None:
        if isinstance(node, dict):
            if node.get("type") == "LineString":
                lines.append(node["coordinates"])
            for value in node.values():
                walk(value)
        elif isinstance(node, list):
            for value in node:
                walk(value)

    walk(document)
    return np.array(max(lines, key=len), float)[:, :2]


def _speeds(rng: np.random.Generator, bends: Floats, length_m: float) -> tuple[Floats, Floats, Floats]:
    wanted = rng.uniform(11, 20) * (1 + 0.25 * gaussian_filter1d(rng.standard_normal(len(bends)), 120) * 20)
    comfort = np.sqrt(2.0 / np.maximum(gaussian_filter1d(np.abs(bends), 10), 1e-4))
    by_place = gaussian_filter1d(np.clip(np.minimum(wanted, comfort), 5.0, 25.0), 30)
    chainage, where = [0.0], 0.0
    while where < length_m:
        k = int(where)
        where += float(by_place[k] + (where - k) * (by_place[k + 1] - by_place[k])) * STEP_S
        chainage.append(where)
    along: Floats = np.array(chainage)
    speed: Floats = np.gradient(along, STEP_S)
    time_s: Floats = STEP_S * np.arange(along.size, dtype=np.float64)
    return along, speed, time_s


def _drive_along(rng: np.random.Generator, speed: Floats, psi: Floats) -> tuple[Floats, Floats]:
    lat = np.full(speed.size, math.radians(rng.uniform(-60, 65)))
    _e, north_per = metres_per_radian(lat)
    lat = lat + np.concatenate([[0.0], np.cumsum(speed * np.cos(psi) * STEP_S)[:-1]]) / north_per
    east_per, _n = metres_per_radian(lat)
    lon = math.radians(rng.uniform(-170, 170)) + np.concatenate(
        [[0.0], np.cumsum(speed * np.sin(psi) * STEP_S / east_per)[:-1]]
    )
    return lon, lat


def _gauss_markov(rng: np.random.Generator, count: int, sigma: float, over_s: float, step_s: float) -> Floats:
    keep = math.exp(-step_s / over_s)
    noise = rng.normal(0, sigma, count) * math.sqrt(1 - keep * keep)
    noise[0] = rng.normal(0, sigma)
    return np.asarray(signal.lfilter([1.0], [1.0, -keep], noise))


def _with_sensors(
    rng: np.random.Generator, t: Floats, chainage: Floats, speed: Floats, psi: Floats, lon: Floats, lat: Floats,
    left: Floats, length_m: float,
) -> Drive:  # fmt: skip
    offset_s = rng.uniform(-MAX_OFFSET_S, MAX_OFFSET_S)
    starts = (length_m * rng.uniform(0.15, 0.3), length_m * rng.uniform(0.6, 0.75))
    fixes: list[PositionFix] = []
    wrong: set[int] = set()

    def add(at_m: float, family: str, survey_m: Floats, off_m: Floats, marker: str) -> None:
        k = min(int(np.searchsorted(chainage, at_m)), t.size - 1)
        along_s, across_s, heading_s, survey_s = (
            (PLATE_ALONG_M, PLATE_ACROSS_M, PLATE_HEADING_DEG, PLATE_SURVEY_M)
            if family == "plate"
            else (TAG_ALONG_M, TAG_ACROSS_M, TAG_HEADING_DEG, TAG_SURVEY_M)
        )
        forward = np.array([math.sin(psi[k]), math.cos(psi[k])])
        axes = np.column_stack([forward, [-forward[1], forward[0]]])
        error = axes @ rng.normal(0, (along_s, across_s)) + survey_m + off_m
        cov = axes @ np.diag([along_s**2, across_s**2]) @ axes.T + survey_s**2 * np.eye(2)
        east_per, north_per = metres_per_radian(lat[k : k + 1])
        if off_m.any():
            wrong.add(len(fixes))
        fixes.append(
            PositionFix(
                "camera" if family == "plate" else "bar", T0_S + t[k] - (offset_s if family == "plate" else 0.0),
                math.degrees(lon[k] + error[0] / east_per[0]), math.degrees(lat[k] + error[1] / north_per[0]),
                (float(cov[0, 0]), float(cov[0, 1]), float(cov[1, 1])),
                (math.degrees(psi[k]) + rng.normal(0, heading_s)) % 360, heading_s,
                common_m2=survey_s**2, marker_id=marker, family=family, decode_id=family, place=len(fixes),
            )
        )  # fmt: skip

    share = rng.uniform(0.05, 0.10)
    for family, spacing_m, ahead in (("plate", 120.0, (12.0, 9.0, 6.0)), ("magnet", 200.0, (0.0,))):
        places = np.arange(rng.uniform(20, 100), length_m - 30, spacing_m)
        kept = [p for p in places if not any(start <= p <= start + 500.0 for start in starts)]
        cloned = rng.integers(2, len(kept)) if family == "plate" else -1
        for number, at_m in enumerate(kept):
            off = np.zeros(2)
            if number == cloned or rng.random() < share:
                size, way = 50.0 if number == cloned else 2.0 * 25.0 ** rng.random(), rng.uniform(0, 2 * np.pi)
                off = size * np.array([math.cos(way), math.sin(way)])
            survey = rng.normal(0, PLATE_SURVEY_M if family == "plate" else TAG_SURVEY_M, 2)
            for before in ahead:
                add(at_m - before, family, survey, off, f"{family} {number}")
    every = slice(None, None, 2)
    scale = 1 + rng.normal(0, SPEED_SCALE) + _gauss_markov(rng, t.size, SPEED_DRIFT, 60.0, STEP_S)
    bias = rng.normal(0, HEADING_BIAS_DEG) + _gauss_markov(rng, t.size, HEADING_DRIFT_DEG, 60.0, STEP_S)
    speeds = (speed * scale + rng.normal(0, SPEED_NOISE_M_S, t.size))[every]
    headings = (np.degrees(psi) + bias + rng.normal(0, HEADING_NOISE_DEG, t.size))[every] % 360
    given = TrackInput(
        (Clock("bar"), Clock("camera")), tuple(fixes),
        (Samples("bar", T0_S + t[every], speeds, SPEED_NOISE_M_S),),
        (Samples("bar", T0_S + t[every], headings, HEADING_NOISE_DEG),),
        (_path(rng, chainage, psi, lon, lat, left, length_m),),
    )  # fmt: skip
    return Drive(given, T0_S + t, lon, lat, psi, offset_s, frozenset(wrong))


def _path(
    rng: np.random.Generator, chainage: Floats, psi: Floats, lon: Floats, lat: Floats, left: Floats, length_m: float
) -> LanePath:
    """The lane's middle as CERPMs give it, over the first 60 % of the drive: the first outage is on it."""
    kept = np.flatnonzero(chainage < 0.6 * length_m)[::10]
    east_per, north_per = metres_per_radian(lat[kept])
    off = gaussian_filter1d(rng.standard_normal(kept.size), 3.0)
    across = off / max(float(off.std()), 1e-9) * PATH_SIGMA_M - left[kept]
    lon_deg = np.degrees(lon[kept] - across * np.cos(psi[kept]) / east_per)
    lat_deg = np.degrees(lat[kept] + across * np.sin(psi[kept]) / north_per)
    return LanePath("packets", lon_deg, lat_deg, PATH_SIGMA_M)
