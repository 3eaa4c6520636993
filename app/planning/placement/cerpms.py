"""Places of CERPMs on the boundaries of a lane: by the cycle of the markings, closer where the path asks for it."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from app.geodesy.ellipsoid import ecef_from_wgs84
from app.markers.cerpm import LaneSide
from app.planning.alignment import Floats, Lane
from app.planning.placement.site import Site
from app.planning.rules import CerpmRules

MIN_SPACING_M = 2.0
"""Least distance between pairs that the path error may ask for. [m] Source: chosen by hand, a sixth of a cycle."""
_ROUNDS = 6  # of halving the distances; source: from 36 m to below the least distance
_ROOM_M = 0.4  # [m] between a CERPM and a line magnet; source: half of a CERPM and half of METRO figure 17a's 0.5 m
_CLEAR_REACH_M = 2.0  # [m] within which another place is sought; source: chosen by hand, a third of the magnets' 6 m
_ONE_PLACE_M = 1.0  # [m] between markers of a pair along the lane; source: half of `MIN_SPACING_M`
_BEND_REACH_M = 6.0  # [m] before and after a bend; source: half of N, as in app/planning/cerpm_placement.py
_TAPER = (
    0.01  # change of width over length from which it is a transition; source: a taper of W S feet at mph, MUTCD 2009
)
# (3B.09, 6C.08), is 1 in 75 at 75 mph


def place_cerpms(lane: Lane, rules: CerpmRules, cycle_m: float, curve_radius_m: float) -> Floats:
    """Chainages of a lane's pairs, both ends among them, shape (K,). [m]

    Notes
    -----
    Straights have `straight` cycles between pairs; bends, and transitions where the lane's width changes, `curve`
    cycles. Then pairs are added in the middle of every gap in which a cubic spline through the pairs leaves the lane by
    more than `max_path_error_m`.

    Positioning guides are 2 N apart, and N or less on sharp curves and on transitions that reduce lanes or shift
    traffic: MUTCD 2009, sections 3B.11 and 3B.12 (2023: 3B.14 and 3B.15).
    """
    chainages = _by_cycle(lane, rules, cycle_m, curve_radius_m)
    if rules.max_path_error_m is None:
        return chainages
    for _ in range(_ROUNDS):
        error = path_error_m(lane, chainages)
        gap = np.clip(np.searchsorted(chainages, lane.chainage_m, side="right") - 1, 0, len(chainages) - 2)
        worst = np.zeros(len(chainages) - 1)
        np.maximum.at(worst, gap, np.abs(error))
        split = (worst > rules.max_path_error_m) & (np.diff(chainages) >= 2 * MIN_SPACING_M)
        if not split.any():
            break
        middles = (chainages[:-1] + chainages[1:])[split] / 2
        chainages = np.sort(np.concatenate([chainages, middles]))
    return chainages


def path_error_m(lane: Lane, chainages_m: Floats, shifts_m: Floats | None = None) -> Floats:
    """Distance of a cubic spline through the lane's pairs from its centre line at the lane's samples, shape (N,). [m]

    Parameters
    ----------
    lane : Lane
    chainages_m : ndarray, shape (K,)
        Of all markers. [m]
    shifts_m : ndarray, shape (K,), optional
        How far each is left of its boundary; the mean of a pair moves the path. [m]

    Notes
    -----
    Source: exact markers and a cubic spline, as in the CERPM paper's section 2.3; the change of curvature and the ends
    decide. Two or three pairs are joined by a straight line or a parabola.
    """
    chainages_m, shift_m = one_of_each_pair(chainages_m, shifts_m)
    knots = ecef_from_wgs84(*lane.position_at(chainages_m, shift_m))
    truth = ecef_from_wgs84(lane.lon_deg, lane.lat_deg)
    origin = truth[0]
    if len(chainages_m) < 4:
        degree = len(chainages_m) - 1
        fits = [np.polyfit(chainages_m, (knots - origin)[:, k], degree) for k in range(3)]
        path = np.stack([np.polyval(fit, lane.chainage_m) for fit in fits], 1)
    else:
        path = scipy.interpolate.CubicSpline(chainages_m, knots - origin)(lane.chainage_m)
    away = path - (truth - origin)
    tangent = np.gradient(truth, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    across = away - np.einsum("ij,ij->i", away, tangent)[:, None] * tangent
    return np.asarray(np.linalg.norm(across, axis=1))


def beside_magnets(lane: Lane, cerpms: Sequence[Site], magnets: Sequence[Site]) -> list[Site]:
    """CERPMs moved along the lane where they would stand on a line magnet, so far that there is room for both.

    The markers of a pair move together: vehicles take the line across a pair as square to the lane, and one that is
    0.8 m ahead of the other doubled the path's error in simulated drives.
    """
    taken = {side: np.array([m.chainage_m for m in magnets if m.side is side]) for side in LaneSide}
    sides: dict[float, set[LaneSide]] = defaultdict(set)
    for site in cerpms:
        sides[site.chainage_m].add(site.side)
    places = {
        at: _clear_place(lane, at, np.concatenate([taken[side] for side in sorted(own)])) for at, own in sides.items()
    }
    return [replace(site, chainage_m=places[site.chainage_m]) for site in cerpms]


def _clear_place(lane: Lane, chainage_m: float, taken_m: Floats) -> float:
    """The nearest place along the lane that is far enough from all magnets; the same place if there is none. [m]"""
    near = taken_m[np.abs(taken_m - chainage_m) < _CLEAR_REACH_M]
    tried = np.concatenate([[chainage_m], near + _ROOM_M, near - _ROOM_M])
    room = np.abs(tried[:, None] - near).min(axis=1, initial=np.inf) >= _ROOM_M - 1e-9
    clear = tried[room & (tried >= 0.0) & (tried <= lane.length_m)]
    return float(clear[np.argmin(np.abs(clear - chainage_m))]) if len(clear) else chainage_m


def one_of_each_pair(chainages_m: Floats, shifts_m: Floats | None) -> tuple[Floats, Floats]:
    """Rising chainages without those that follow another one within a metre, and the mean shift at each.

    Both sides of a pair are one place.
    """
    order = np.argsort(chainages_m)
    rising = chainages_m[order]
    is_first = np.diff(rising, prepend=-np.inf) > _ONE_PLACE_M
    if shifts_m is None:
        return np.asarray(rising[is_first]), np.zeros(int(is_first.sum()))
    place = np.cumsum(is_first) - 1
    return np.asarray(rising[is_first]), np.asarray(np.bincount(place, shifts_m[order]) / np.bincount(place))


def _by_cycle(lane: Lane, rules: CerpmRules, cycle_m: float, curve_radius_m: float) -> Floats:
    """Chainages between which the integral of the density is one; stretched so that both ends have a pair."""
    straight_m, curve_m = rules.straight * cycle_m, rules.curve * cycle_m
    reach = max(round(_BEND_REACH_M / lane.step_m), 1)
    taper = np.abs(np.gradient(lane.width_m, lane.chainage_m)) > _TAPER
    close = (
        np.convolve((np.abs(lane.curvature_per_m) > 1 / curve_radius_m) | taper, np.ones(2 * reach + 1), "same") > 0.5
    )
    density = np.where(close, 1 / min(curve_m, straight_m), 1 / straight_m)
    steps = np.diff(lane.chainage_m) * (density[1:] + density[:-1]) / 2
    count = np.concatenate([[0.0], np.cumsum(steps)])
    pairs = max(math.ceil(count[-1] - 1e-6), 1) + 1
    return np.asarray(np.interp(np.linspace(0.0, count[-1], pairs), count, lane.chainage_m))
