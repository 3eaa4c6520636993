"""The largest chain of fixes that agree with each other: where the filter starts from.

A wrong first fix must be rejected: a filter that starts at it leaves out all that are right. Fixes i and j agree if
the vector between them is the one that was driven, by dead reckoning, within its error. The longest chain of fixes each
of which agrees with the one before is found by dynamic programming. What it leaves out is tested again against the
smoothed track.
"""

from __future__ import annotations

import math

import numpy as np

from app.tracks.dead_reckoning import DeadReckoning
from app.tracks.types import Bools, Floats, Ints

_WINDOW = 40  # fixes before that a fix is compared with; source: by hand, more than one pass of frames by a plate
_SIGMAS = 4.0  # within which two fixes agree; source: by hand, the smoother tests more closely
_DRIFT = 0.02  # [1] error of the driven distance that is left when scale and bias are out; source: by hand
_MAX_SPEED_M_S = 70.0  # [m/s] without a speed; source: app/sensors/pose_track.py
_SLACK_M = 1.0  # [m] source: by hand, errors of poses beyond their covariance


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
    driven : DeadReckoning

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
