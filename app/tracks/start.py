"""Where a drive starts, by a chain of fixes that agree with each other and with dead reckoning."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from app.geodesy.frames import metres_per_radian
from app.tracks.time_base import TimeBase
from app.tracks.types import BIAS, HEADING, SCALE, SPEED, WANDER, YAW_RATE, PositionFix, Samples
from app.values import Bools, Floats, Ints

if TYPE_CHECKING:
    from app.tracks.estimate import DriveData


# === The drive by its speeds and headings alone: a path in a plane that starts anywhere.


@dataclass(frozen=True, slots=True, eq=False)
class DeadReckoning:
    """The drive without fixes."""

    # `east_m`, `north_m`, `odometer_m`, `speed_m_s`, `heading_rad`: shape (N,): at the nodes; the headings are
    # unwrapped, and 0 where there are none
    east_m: Floats
    north_m: Floats
    odometer_m: Floats
    speed_m_s: Floats
    heading_rad: Floats
    has_heading: bool
    has_speed: bool


def dead_reckon(
    base: TimeBase, speeds: tuple[Samples, ...], headings: tuple[Samples, ...], offsets: dict[str, float]
) -> DeadReckoning:
    """Speeds and headings at the nodes, held where there are none, and the path that they give."""
    time = base.time_s
    speed = _at(time, speeds, offsets)
    heading = _at(time, tuple(_unwrapped(series) for series in headings), offsets)
    has_speed, has_heading = speed is not None, heading is not None
    v = speed if speed is not None else np.zeros(base.count)
    psi = np.radians(heading) if heading is not None else np.zeros(base.count)
    between = (v[1:] + v[:-1]) / 2 * base.step_s
    turn = (psi[1:] + psi[:-1]) / 2
    path = [np.concatenate([[0.0], np.cumsum(step)]) for step in (between * np.sin(turn), between * np.cos(turn))]
    odometer = np.concatenate([[0.0], np.cumsum(np.abs(between))])
    return DeadReckoning(path[0], path[1], odometer, v, psi, has_heading, has_speed)


def _unwrapped(series: Samples) -> Samples:
    return Samples(series.clock, series.time_s, np.unwrap(series.value, period=360.0), series.sigma)


def _at(time: Floats, all_series: tuple[Samples, ...], offsets: dict[str, float]) -> Floats | None:
    """Values at times: of the series that covers most of each time, held before its begin and after its end."""
    found: Floats | None = None
    for series in sorted(all_series, key=lambda series: series.time_s.size):
        if not series.time_s.size:
            continue
        t = series.time_s + offsets[series.clock]
        value = np.interp(time, t, series.value)
        inside = (time >= t[0]) & (time <= t[-1])
        found = value if found is None else np.where(inside, value, found)
    return found


def local_m(fixes: tuple[PositionFix, ...]) -> Floats:
    """East and north of fixes from the first one, for comparisons of neighbours, shape (K, 2). [m]"""
    lon = np.radians(np.array([fix.lon_deg for fix in fixes]))
    lat = np.radians(np.array([fix.lat_deg for fix in fixes]))
    east, north = metres_per_radian(lat)
    turn = (np.diff(lon) + np.pi) % (2 * np.pi) - np.pi
    steps_e = np.concatenate([[0.0], turn * (east[1:] + east[:-1]) / 2])
    steps_n = np.concatenate([[0.0], np.diff(lat) * (north[1:] + north[:-1]) / 2])
    return np.column_stack([np.cumsum(steps_e), np.cumsum(steps_n)])


# === The largest chain of fixes that agree with each other: where the filter starts from.
#
# A wrong first fix must be rejected: a filter that starts at it leaves out all that are right. Fixes i and j agree if
# the vector between them is the one that was driven, by dead reckoning, within its error. The longest chain of fixes
# each of which agrees with the one before is found by dynamic programming. What it leaves out is tested again against
# the smoothed track.


_WINDOW = 40  # fixes before that a fix is compared with; more than one pass of frames by a plate
_SIGMAS = 4.0  # within which two fixes agree; the smoother tests more closely
_DRIFT = 0.02  # [1] error of the driven distance that is left when scale and bias are out
_MAX_SPEED_M_S = 70.0  # [m/s] without a speed; source: app/sensors/pose_track.py
_SLACK_M = 1.0  # [m] errors of poses beyond their covariance


def consistent_chain(
    place_m: Floats, sigma_m: Floats, time_s: Floats, node: Ints, clock: Ints, clock_sigma_s: Floats,
    driven: DeadReckoning,
) -> tuple[Bools, float, float]:  # fmt: skip
    """Which fixes belong to the largest chain; turn and scale between dead reckoning and fixes.

    Parameters
    ----------
    place_m : ndarray, shape (K, 2)
        In the order of time. [m]
    sigma_m, time_s, node, clock, clock_sigma_s : ndarray, shape (K,)
        Larger standard deviation of each [m], its time [s] and node, the number and the error of its clock [s].

    Returns
    -------
    chain : ndarray of bool, shape (K,)
    turn_rad : float
        To be added to the headings. [rad]
    scale : float
        By which the driven distances are to be multiplied.
    """
    count = len(place_m)
    turn, scale = _turn_and_scale(place_m, sigma_m, node, driven)
    c, s = math.cos(turn), math.sin(turn)
    path = np.column_stack([driven.east_m[node], driven.north_m[node]]) @ np.array([[c, -s], [s, c]]) * scale
    odometer, speed = driven.odometer_m[node], np.abs(driven.speed_m_s[node])
    heading = driven.heading_rad[node]
    velocity = np.column_stack([speed * np.sin(heading), speed * np.cos(heading)])
    slip_m = clock_sigma_s * np.maximum(speed, 1.0)
    best, before = np.ones(count), np.full(count, -1)
    for j in range(count):
        i = np.arange(max(j - _WINDOW, 0), j)
        if not i.size:
            continue
        step = place_m[j] - place_m[i]
        length_m = odometer[j] - odometer[i]
        if driven.has_heading and driven.has_speed:
            off = np.hypot(*(step - (path[j] - path[i])).T)
        elif driven.has_speed:
            off = np.maximum(np.hypot(*step.T) - length_m * max(scale, 1.0), 0.0)
        else:
            off = np.maximum(np.hypot(*step.T) - _MAX_SPEED_M_S * (time_s[j] - time_s[i]), 0.0)
        # an offset that both share shows only where the velocity changes
        same = np.hypot(*(velocity[j] - velocity[i]).T) * clock_sigma_s[j]
        slip = np.where(clock[i] == clock[j], same, np.hypot(slip_m[i], slip_m[j]))
        spread = np.sqrt(sigma_m[i] ** 2 + sigma_m[j] ** 2 + slip**2 + (_DRIFT * length_m) ** 2)
        agrees = off <= _SIGMAS * spread + _SLACK_M
        if agrees.any():
            longest = np.where(agrees, best[i], 0.0)
            k = int(i.size - 1 - np.argmax(longest[::-1]))  # the latest of equal ones
            best[j], before[j] = longest[k] + 1, i[k]
    chain = np.zeros(count, bool)
    j = int(np.argmax(best)) if count else -1
    while j >= 0:
        chain[j] = True
        j = int(before[j])
    return chain, turn, scale


def _turn_and_scale(place_m: Floats, sigma_m: Floats, node: Ints, driven: DeadReckoning) -> tuple[float, float]:
    """Medians over neighbours that are far enough apart."""
    if not (driven.has_heading and driven.has_speed) or len(place_m) < 2:
        return 0.0, 1.0
    path = np.column_stack([driven.east_m[node], driven.north_m[node]])
    turns, scales = [], []
    for lag in (1, 2, 3):
        step, moved = place_m[lag:] - place_m[:-lag], path[lag:] - path[:-lag]
        length = np.hypot(*moved.T)
        far = length > 20.0 * (sigma_m[lag:] + sigma_m[:-lag]) + 5.0
        angle = np.arctan2(step[:, 0], step[:, 1]) - np.arctan2(moved[:, 0], moved[:, 1])
        turns.append(((angle + np.pi) % (2 * np.pi) - np.pi)[far])
        scales.append(np.hypot(*step.T)[far] / length[far])
    turn, scale = np.concatenate(turns), np.concatenate(scales)
    if turn.size < 2:
        return 0.0, 1.0
    best = float(np.median(scale))
    return float(np.median(turn)), best if 0.8 < best < 1.25 else 1.0


# === Where a drive starts, by a chain of fixes that agree with each other.


_START_SIGMA_M = 2000.0  # [m] dead reckoning of ten minutes back to the start


def start_set(drive: DriveData) -> tuple[Bools, float, float]:
    """Fixes of the chain, the turn between headings and the ground [rad], and the scale of the speeds."""
    who = np.flatnonzero(drive.markers)
    segment = drive.segment_of[who]
    node, _after = drive.base.nearest(drive.arrays.time_s[who] + drive.offsets(None)[segment])
    clock_sigma = np.array([0.0 if entry.is_reference else entry.clock.sigma_s for entry in drive.segments])
    chain, turn, scale = consistent_chain(
        local_m(drive.fixes)[who], drive.arrays.sigma_m[who], drive.base.time_s[node], node, segment,
        clock_sigma[segment], drive.driven,
    )  # fmt: skip
    used = np.zeros(len(drive.fixes), bool)
    used[who] = chain
    return used, turn, scale


def start_state(drive: DriveData, chain: Bools, turn: float, scale: float, size: int) -> tuple[Floats, Floats]:
    """State at the first node, by dead reckoning back from the first fix of the chain."""
    arrays, driven, rules = drive.arrays, drive.driven, drive.rules
    k = int(np.flatnonzero(chain)[0])
    node, _after = drive.base.nearest(arrays.time_s[[k]] + drive.offsets(None)[drive.segment_of[k]])
    first = int(node[0])
    heading, heading_sigma = _start_heading(drive, chain, turn)
    twist = heading - float(driven.heading_rad[first] if driven.has_heading else 0.0)
    east, north = -float(driven.east_m[first]) * scale, -float(driven.north_m[first]) * scale
    c, s = math.cos(twist), math.sin(twist)
    start = np.zeros(size)
    lat = float(arrays.lat_rad[k])
    curve = 1.0 - 0.0066943799901413165 * math.sin(lat) ** 2
    start[0] = float(arrays.lon_rad[k]) + (c * east + s * north) * math.sqrt(curve) / (6378137.0 * math.cos(lat))
    start[1] = lat + (c * north - s * east) * curve**1.5 / (6378137.0 * (1 - 0.0066943799901413165))
    start[HEADING] = (float(driven.heading_rad[0]) if driven.has_heading else 0.0) + twist
    start[SPEED] = float(driven.speed_m_s[0])
    for entry in drive.segments:
        if entry.place >= 0:
            start[entry.place] = entry.clock.offset_s
    sigma = np.zeros(size)
    sigma[:2] = _START_SIGMA_M
    sigma[HEADING] = heading_sigma
    sigma[SPEED] = 5.0 if driven.has_speed else 30.0
    sigma[YAW_RATE] = 0.2
    sigma[SCALE] = rules.speed_scale_sigma
    sigma[BIAS] = math.radians(rules.heading_bias_sigma_deg)
    sigma[WANDER] = rules.wander_m
    for entry in drive.segments:
        if entry.place >= 0:
            sigma[entry.place] = entry.clock.sigma_s
    return start, np.diag(sigma**2)


def _start_heading(drive: DriveData, chain: Bools, turn: float) -> tuple[float, float]:
    """Heading at the first fix of the chain, and its standard deviation. [rad]"""
    arrays, driven = drive.arrays, drive.driven
    known = chain & np.isfinite(arrays.heading_rad)
    node, _after = drive.base.nearest(arrays.time_s + drive.offsets(None)[drive.segment_of])
    first = int(np.flatnonzero(chain)[0])
    if driven.has_heading:
        off = turn
        if known.any():
            differences = np.exp(1j * (arrays.heading_rad[known] - driven.heading_rad[node[known]]))
            off = float(np.angle(np.median(differences.real) + 1j * np.median(differences.imag)))
        return float(driven.heading_rad[node[first]]) + off, math.radians(20.0)
    if known.any():
        return float(arrays.heading_rad[np.flatnonzero(known)[0]]), math.radians(30.0)
    place = local_m(drive.fixes)[chain]
    far = np.flatnonzero(np.hypot(*(place - place[0]).T) > 3.0)
    if not far.size:
        return 0.0, math.pi
    step = place[far[0]] - place[0]
    return math.atan2(step[0], step[1]), math.radians(40.0)
