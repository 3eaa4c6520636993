"""The fewest pairs of CERPMs with which a lane's path stays within an error: close where the curvature changes."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.geodesy.ellipsoid import ecef_from_wgs84
from app.planning.alignment import Floats, Lane, format_station
from app.planning.placement.cerpms import MIN_SPACING_M, path_error_m

_ROUNDS = 60  # of adapting the limits; source: chosen by measurement, the count no longer falls after 25 to 35
_REPAIRS = 3  # times that gaps with too much error are halved in each round; source: by hand
_FIRST_SHARE = 0.3  # of the error, limit of a curve by itself; source: by hand, below what the spline adds to it
_STRONGER, _WEAKER = 0.5, 1.1  # factors on the limits of gaps with too much and with little error; source: by hand
_LITTLE = 0.6  # share of the error below which a gap may become longer; source: by hand


def fewest_pairs(
    lane: Lane, max_error_m: float, *, max_spacing_m: float, allowed: npt.NDArray[np.bool_] | None = None
) -> Floats:
    """Chainages of the fewest pairs found with which a cubic spline stays within an error.

    Parameters
    ----------
    lane : Lane
    max_error_m : float
        Of the path, as `path_error_m` computes it. [m]
    max_spacing_m : float
        Only areas where no pair may stand make longer gaps. [m]
    allowed : ndarray of bool, shape (N,), optional
        Samples of the lane at which a pair may stand; all without. Pairs at the ends need no permission.

    Returns
    -------
    ndarray, shape (K,)
        Increasing, both ends among them. [m]

    Raises
    ------
    InvalidParameter
        No spacing of at least 2 m is enough.

    Notes
    -----
    A gap between pairs is possible where the cubic curve with the lane's directions at both ends leaves the lane by no
    more than a limit; the fewest gaps follow by reaching as far as possible from each pair. The spline's own error
    depends on all pairs. It is computed for the whole lane, the limits of gaps with too much error are made stronger
    and those of gaps with little error weaker, and the best pairs of all rounds are kept: near the optimum, not proved.
    """
    allowed = np.ones(len(lane.chainage_m), dtype=bool) if allowed is None else allowed
    errors = _gap_errors_m(lane, max_spacing_m)
    limits = np.full(len(allowed), max_error_m * _FIRST_SHARE)
    best = _even_if_allowed(lane, max_error_m, max_spacing_m, allowed)
    least = (math.inf, 0.0)
    for _ in range(_ROUNDS):
        pairs = _reach(lane, errors, limits, allowed, max_spacing_m)
        for repair in range(_REPAIRS):
            worst, gap, at_m = _worst_of_gaps(lane, pairs)
            if repair == 0:
                factor = np.where(worst > max_error_m, _STRONGER, np.where(worst < _LITTLE * max_error_m, _WEAKER, 1.0))
                limits = limits * factor[gap]
            least = min(least, (float(worst.max()), at_m))
            if worst.max() <= max_error_m:
                if best is None or len(pairs) < len(best):
                    best = pairs
                break
            pairs = _halved(lane, pairs, worst > max_error_m, allowed)
    if best is None:
        raise InvalidParameter(
            f"the path error of lane {lane.name} is {least[0]:.3f} m at {format_station(least[1])} at best",
            field="quality.path_error_m",
            limit=f"pairs {MIN_SPACING_M:g} to {max_spacing_m:g} m apart outside of avoided areas",
            cure="allow a larger error, a larger spacing, or fewer avoided areas",
        )
    return best


def even_pairs(lane: Lane, max_error_m: float, *, max_spacing_m: float) -> Floats:
    """Chainages of the fewest pairs at even distances that stay within an error, both ends among them, shape (K,). [m]

    Raises
    ------
    InvalidParameter
        No even spacing of at least 2 m is enough.
    """

    def enough(count: int) -> bool:
        return bool(path_error_m(lane, np.linspace(0.0, lane.length_m, count + 1)).max() <= max_error_m)

    low, most = math.ceil(lane.length_m / max_spacing_m - 1e-9), int(lane.length_m / MIN_SPACING_M)
    count = max(low, 1)
    while not enough(count):
        if count >= most:
            raise InvalidParameter(
                f"no even spacing keeps the path error of lane {lane.name} within {max_error_m:g} m",
                field="quality.path_error_m",
                limit=f"pairs at least {MIN_SPACING_M:g} m apart",
                cure="allow a larger error",
            )
        low, count = count + 1, min(max(math.ceil(count * 1.02), count + 1), most)
    for fewer in range(low, count):
        if enough(fewer):
            count = fewer
            break
    return np.linspace(0.0, lane.length_m, count + 1)


def _gap_errors_m(lane: Lane, max_spacing_m: float) -> Floats:
    """Distance of the lane from the cubic curve between two samples, shape (steps, N); NaN beyond the end. [m]

    Row k is for gaps of k + 1 steps; it is at least that of every shorter gap from the same sample.
    """
    points = ecef_from_wgs84(lane.lon_deg, lane.lat_deg)
    slopes = np.gradient(points, lane.chainage_m, axis=0)
    steps = min(max(int(max_spacing_m / lane.step_m + 1e-9), 1), len(points) - 1)
    errors = np.full((steps, len(points)), np.nan)
    for k in range(1, steps + 1):
        h = k * lane.step_m
        start, end, first, last = points[:-k], points[k:], slopes[:-k], slopes[k:]
        away = np.zeros(len(start))
        for inner in {k // 4, k // 2, (3 * k) // 4} - {0}:
            p = inner / k
            curve = (
                (1 + 2 * p) * (1 - p) ** 2 * start
                + p**2 * (3 - 2 * p) * end
                + h * p * (1 - p) * ((1 - p) * first - p * last)
            )
            away = np.maximum(away, np.linalg.norm(curve - points[inner : inner + len(start)], axis=1))
        errors[k - 1, : len(start)] = away if k == 1 else np.maximum(away, errors[k - 2, : len(start)])
    return errors


def _even_if_allowed(
    lane: Lane, max_error_m: float, max_spacing_m: float, allowed: npt.NDArray[np.bool_]
) -> Floats | None:
    """Pairs at even distances, None where they are not enough or not allowed."""
    try:
        pairs = even_pairs(lane, max_error_m, max_spacing_m=max_spacing_m)
    except InvalidParameter:
        return None
    return pairs if allowed[np.rint(pairs / lane.step_m).astype(np.intp)[1:-1]].all() else None


def _reach(lane: Lane, errors: Floats, limits: Floats, allowed: npt.NDArray[np.bool_], max_spacing_m: float) -> Floats:
    """Chainages of pairs, each as far from the one before as the limits allow, but at least 2 m; both ends. [m]"""
    possible = np.nan_to_num(errors, nan=np.inf) <= limits
    steps = possible.sum(axis=0)
    reach = np.where(steps == len(errors), max_spacing_m, np.maximum(steps * lane.step_m, MIN_SPACING_M)).tolist()
    pairs = [0.0]
    while pairs[-1] < lane.length_m:
        here = pairs[-1]
        ahead = here + reach[round(here / lane.step_m)]
        if ahead >= lane.length_m - 1e-6:
            pairs.append(lane.length_m)
        else:
            pairs.append(_nearest_allowed(lane, allowed, ahead, here))
    if len(pairs) > 2 and pairs[-1] - pairs[-2] < MIN_SPACING_M:
        pairs[-2] = _nearest_allowed(lane, allowed, (pairs[-3] + pairs[-1]) / 2, pairs[-3])
    return np.array(pairs)


def _nearest_allowed(lane: Lane, allowed: npt.NDArray[np.bool_], chainage_m: float, after_m: float) -> float:
    """The chainage, or where it is not allowed the nearest sample before it, or else the next one after it. [m]"""
    k = round(chainage_m / lane.step_m)
    if allowed[k]:
        return chainage_m
    first = math.floor((after_m + MIN_SPACING_M) / lane.step_m) + 1
    before = np.flatnonzero(allowed[first:k])
    if len(before):
        return float(lane.chainage_m[first + before[-1]])
    after = np.flatnonzero(allowed[k:])
    return float(lane.chainage_m[k + after[0]]) if len(after) else lane.length_m


def _worst_of_gaps(lane: Lane, pairs: Floats) -> tuple[Floats, npt.NDArray[np.intp], float]:
    """Greatest path error of each gap [m], the gap of each sample, and the chainage of the greatest error [m]."""
    error = path_error_m(lane, pairs)
    gap = np.clip(np.searchsorted(pairs, lane.chainage_m, side="right") - 1, 0, len(pairs) - 2)
    worst = np.zeros(len(pairs) - 1)
    np.maximum.at(worst, gap, error)
    return worst, gap, float(lane.chainage_m[np.argmax(error)])


def _halved(lane: Lane, pairs: Floats, wrong: npt.NDArray[np.bool_], allowed: npt.NDArray[np.bool_]) -> Floats:
    """With a pair more in the middle of each wrong gap that is long enough and where it may stand."""
    middles = ((pairs[:-1] + pairs[1:]) / 2)[wrong & (np.diff(pairs) >= 2 * MIN_SPACING_M)]
    middles = middles[allowed[np.rint(middles / lane.step_m).astype(np.intp)]]
    return np.sort(np.concatenate([pairs, middles]))
