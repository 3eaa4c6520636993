"""Where a drive starts, by a chain of fixes that agree with each other."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from app.tracks.consensus import consistent_chain
from app.tracks.dead_reckoning import local_m
from app.tracks.types import BIAS, HEADING, SCALE, SPEED, WANDER, YAW_RATE, Bools, Floats

if TYPE_CHECKING:
    from app.tracks.estimate import DriveData

_START_SIGMA_M = 2000.0  # [m] source: by hand, dead reckoning of ten minutes back to the start


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
