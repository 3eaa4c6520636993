"""Exact solvers for places along one line: the cheapest chain with bounded gaps, the cheapest cover of all windows."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from app.errors import InvalidParameter
from app.geodesy.frames import ecef_from_wgs84
from app.planning.alignment import Lane, format_station
from app.planning.placement.place import MIN_SPACING_M, path_error_m
from app.planning.rules import Quality
from app.values import Floats

# === Even distances along a lane.


def replace_every(quality: Quality, fix_every_m: float) -> Quality:
    """The quality with another distance between fixes. [m]"""
    return quality.model_copy(update={"fix_every_m": fix_every_m})


def middles(lane: Lane, step_m: float) -> Floats:
    """Middles of equal parts of a lane of at most a step. [m]"""
    return even_places(lane, max(math.ceil(lane.length_m / step_m - 1e-9), 1))


def even_places(lane: Lane, count: int) -> Floats:
    """Middles of so many equal parts of a lane, shape (count,). [m]"""
    return np.asarray((np.arange(count) + 0.5) * lane.length_m / max(count, 1))


# === Exact solvers for places along one line.


Indices = npt.NDArray[np.intp]

_SECTION_WINDOWS = 8.0
"""Length of the sections that a long line is solved in, in windows; the first half of each is kept. Source: chosen by
measurement: 3 km in windows of 100 m with 30 candidates each take 4 s in sections and cost 1.2 % more than the proved
optimum, which takes 13 s; 10 km at once do not end."""
_NODES = 5000  # nodes of branch and bound of one section, so that the same input gives the same result
_GAP = 1e-6  # relative, below the price of one marker in a thousand
_MAX_WINDOWS = 60.0
"""Length of a line in windows up to which sections are solved; longer ones are covered greedily, so that the time grows
with the length alone. Source: chosen by measurement: sections take about 0.15 s a window."""
_TOUCH_M = 1e-9  # [m] by which a window is closed at its end; source: rounding of chainages


@dataclass(frozen=True, slots=True, eq=False)
class Cover:
    """Chosen candidates."""

    chosen: Indices  # shape (K,): increasing
    cost: float
    bound: float  # no choice is cheaper than this

    @property
    def is_optimal(self) -> bool:
        """Whether the cost is proved to be the least."""
        return self.cost <= self.bound * (1 + 2 * _GAP) + 1e-9


def cheapest_chain(
    chainage_m: Floats, cost: Floats, reach_m: Floats, *, first_before_m: float, last_after_m: float
) -> Indices | None:
    """The cheapest candidates of which each is within reach of the one before it.

    Parameters
    ----------
    chainage_m : ndarray, shape (N,)
        Increasing. [m]
    cost : ndarray, shape (N,)
        Not negative.
    reach_m : ndarray, shape (N,)
        Chainage up to which the next one must follow. [m]
    first_before_m, last_after_m : float
        Chainages that the first one is at or before, and the last one at or after. [m]

    Returns
    -------
    ndarray of int, shape (K,), or None
        Increasing; None where a gap has no candidates.

    Notes
    -----
    A shortest path: candidates are visited in order, and a heap holds those before by the cost of the best chain that
    ends in them. One that no longer reaches the visited candidate reaches none after it either and is dropped.
    """
    previous = np.full(len(cost), -1, dtype=np.intp)
    heap: list[tuple[float, int]] = []
    reach = reach_m.tolist()
    totals = []
    for j, (at, price) in enumerate(zip(chainage_m.tolist(), cost.tolist(), strict=True)):
        while heap and reach[heap[0][1]] < at - _TOUCH_M:
            heapq.heappop(heap)
        if at <= first_before_m + _TOUCH_M:
            total = price
        elif heap:
            total, previous[j] = heap[0][0] + price, heap[0][1]
        else:
            total = np.inf
        totals.append(total)
        if total < np.inf:
            heapq.heappush(heap, (total, j))
    last = np.flatnonzero(chainage_m >= last_after_m - _TOUCH_M)
    if not len(last) or not np.isfinite(np.asarray(totals)[last]).any():
        return None
    chain = [int(last[np.argmin(np.asarray(totals)[last])])]
    while previous[chain[-1]] >= 0:
        chain.append(int(previous[chain[-1]]))
    return np.array(chain[::-1], dtype=np.intp)


def window_rows(chainage_m: Floats, window_m: float, length_m: float) -> tuple[Indices, Indices]:
    """First candidate of each window that matters and the one after its last, each of shape (R,).

    Every stretch of a window's length contains all candidates of one of these: the first stretch, and those that begin
    just after a candidate. A line shorter than a window is one.
    """
    if length_m <= window_m:
        return np.zeros(1, dtype=np.intp), np.array([len(chainage_m)])
    starts = np.unique(chainage_m[chainage_m + window_m < length_m - _TOUCH_M])
    first = np.searchsorted(chainage_m, starts, side="right")
    last = np.searchsorted(chainage_m, starts + window_m + _TOUCH_M, side="right")
    whole = np.searchsorted(chainage_m, window_m + _TOUCH_M, side="right")
    return np.concatenate([[0], first]), np.concatenate([[whole], last])


def least_gain(chainage_m: Floats, gain: Floats, window_m: float, length_m: float) -> float:
    """Least sum of gains in any window."""
    first, last = window_rows(chainage_m, window_m, length_m)
    total = np.concatenate([[0.0], np.cumsum(gain)])
    return float((total[last] - total[first]).min())


def uncovered_m(chainage_m: Floats, gain: Floats, need: float, window_m: float, length_m: float) -> float | None:
    """Where the first window begins in which even all candidates are not enough; None if there is none. [m]"""
    first, last = window_rows(chainage_m, window_m, length_m)
    total = np.concatenate([[0.0], np.cumsum(gain)])
    missing = np.flatnonzero(total[last] - total[first] < need - 1e-9)
    if not len(missing):
        return None
    return 0.0 if first[missing[0]] == 0 else float(chainage_m[first[missing[0]] - 1])


def cheapest_cover(
    chainage_m: Floats, cost: Floats, gain: Floats, *, need: float, window_m: float, length_m: float
) -> Cover:
    """The cheapest candidates whose gains add up to a need in every window of a line.

    Parameters
    ----------
    chainage_m : ndarray, shape (N,)
        Not decreasing. [m]
    cost, gain : ndarray, shape (N,)
        Not negative.
    window_m, length_m : float
        [m]

    Returns
    -------
    Cover
        Proved optimal by the chain where every candidate alone is enough, else by branch and bound on lines of up to
        eight windows. Longer lines are solved in overlapping sections, or greedily above 60 windows: the bound is then
        that of the relaxation, which lies about a tenth below the least cost.

    Raises
    ------
    ValueError
        A window is not covered by all candidates together (see `uncovered_m`).
    """
    if uncovered_m(chainage_m, gain, need, window_m, length_m) is not None:
        raise ValueError("a window has too few candidates")
    if np.all(gain >= need):
        chain = cheapest_chain(
            chainage_m,
            cost,
            chainage_m + window_m,
            first_before_m=min(window_m, length_m),
            last_after_m=max(length_m - window_m, 0.0),
        )
        assert chain is not None
        total = float(cost[chain].sum())
        return Cover(chain, total, total)
    return cheapest_sums(chainage_m, cost, gain, need=need, window_m=window_m, length_m=length_m)


def cheapest_sums(
    chainage_m: Floats, cost: Floats, gain: Floats, *, need: float, window_m: float, length_m: float
) -> Cover:
    """`cheapest_cover` as an integer program."""
    rows = window_rows(chainage_m, window_m, length_m)
    gain = np.minimum(gain, need)
    section_m = _SECTION_WINDOWS * window_m
    if length_m <= section_m:
        free = np.ones(len(cost), dtype=bool)
        return _solve(cost, gain, rows, need, free, np.zeros(len(cost), dtype=bool))
    if length_m > _MAX_WINDOWS * window_m:
        indices = greedy_sums(cost, gain, rows, need)
        return Cover(indices, float(cost[indices].sum()), _relaxed_bound(cost, gain, rows, need))
    chosen = np.zeros(len(cost), dtype=bool)
    starts = np.where(rows[0] > 0, chainage_m[rows[0] - 1], 0.0)
    kept_m = 0.0
    while kept_m < length_m:
        inside = (starts >= kept_m - window_m) & (starts <= kept_m + section_m - window_m)
        free = (chainage_m > kept_m) & (chainage_m <= kept_m + section_m + _TOUCH_M) | (chainage_m <= 0) & (kept_m == 0)
        part = _solve(cost, gain, (rows[0][inside], rows[1][inside]), need, free, chosen)
        end_m = kept_m + (section_m if kept_m + section_m >= length_m else section_m / 2)
        found = part.chosen[chainage_m[part.chosen] <= end_m + _TOUCH_M]
        chosen[found] = True
        kept_m = end_m
    indices = np.flatnonzero(chosen)
    return Cover(indices, float(cost[indices].sum()), _relaxed_bound(cost, gain, rows, need))


def greedy_sums(cost: Floats, gain: Floats, rows: tuple[Indices, Indices], need: float) -> Indices:
    """Candidates that complete all rows, taken row by row where most is gained for the cost, then as late as possible.

    Those that turn out to be needless are dropped, the dearest first. Not proved; the time grows with the candidates.
    """
    first, last = rows
    chosen = cost <= 0
    for a, b in zip(first.tolist(), last.tolist(), strict=True):
        missing = need - float(gain[a:b][chosen[a:b]].sum())
        while missing > 1e-9:
            worth = np.where(chosen[a:b], -1.0, np.minimum(gain[a:b], missing) / np.maximum(cost[a:b], 1e-12))
            best = b - 1 - int(np.argmax(worth[::-1] >= worth.max() * (1 - 1e-9)))
            chosen[best] = True
            missing -= float(gain[best])
    _drop_needless(chosen, cost, gain, rows, need)
    return np.flatnonzero(chosen)


def _drop_needless(
    chosen: npt.NDArray[np.bool_], cost: Floats, gain: Floats, rows: tuple[Indices, Indices], need: float
) -> None:
    """Take away candidates without which all rows are still complete; changes `chosen`."""
    first, last = rows
    total = np.concatenate([[0.0], np.cumsum(np.where(chosen, gain, 0.0))])
    spare = total[last] - total[first] - need
    picked = np.flatnonzero(chosen & (cost > 0))
    for k in picked[np.argsort(-cost[picked], kind="stable")].tolist():
        holding = slice(int(np.searchsorted(last, k, side="right")), int(np.searchsorted(first, k, side="right")))
        if (spare[holding] >= gain[k] - 1e-9).all():
            chosen[k] = False
            spare[holding] -= gain[k]


def _relaxed_bound(cost: Floats, gain: Floats, rows: tuple[Indices, Indices], need: float) -> float:
    return float(_program(cost, gain, rows, np.full(len(rows[0]), need), integral=False).fun)


def _solve(
    cost: Floats,
    gain: Floats,
    rows: tuple[Indices, Indices],
    need: float,
    free: npt.NDArray[np.bool_],
    chosen: npt.NDArray[np.bool_],
) -> Cover:
    """The cheapest of the free candidates that complete, with those that are chosen already, all rows."""
    index = np.flatnonzero(free)
    before = np.concatenate([[0], np.cumsum(free)])
    known = np.concatenate([[0.0], np.cumsum(np.where(chosen, gain, 0.0))])
    missing = need - (known[rows[1]] - known[rows[0]])
    open_rows = missing > 1e-9
    own = before[rows[0][open_rows]], before[rows[1][open_rows]]
    if not open_rows.any():
        return Cover(np.empty(0, dtype=np.intp), 0.0, 0.0)
    result = _program(cost[index], gain[index], own, missing[open_rows], integral=True)
    if result.x is None:  # within the limit of nodes no choice was found: all that the relaxation uses are one
        result = _program(cost[index], gain[index], own, missing[open_rows], integral=False)
        picked = index[result.x > 1e-9]
        return Cover(picked, float(cost[picked].sum()), float(result.fun))
    picked = index[result.x > 0.5]
    total = float(cost[picked].sum())
    return Cover(picked, total, min(float(result.mip_dual_bound), total))


def _program(
    cost: Floats, gain: Floats, rows: tuple[Indices, Indices], need: Floats, *, integral: bool
) -> scipy.optimize.OptimizeResult:
    """Result of scipy's solver for one group of rows."""
    first, last = rows
    columns = np.concatenate([np.arange(a, b) for a, b in zip(first.tolist(), last.tolist(), strict=True)])
    pointers = np.concatenate([[0], np.cumsum(last - first)])
    matrix = scipy.sparse.csr_array((gain[columns], columns, pointers), shape=(len(first), len(cost)))
    return scipy.optimize.milp(
        cost,
        integrality=np.full(len(cost), int(integral)),
        bounds=scipy.optimize.Bounds(0, 1),
        constraints=scipy.optimize.LinearConstraint(matrix, need, np.inf),
        options={"mip_rel_gap": _GAP, "node_limit": _NODES},
    )


# === The fewest pairs of CERPMs with which a lane's path stays within an error: close where the curvature changes.


_ROUNDS = 60  # of adapting the limits; source: chosen by measurement, the count no longer falls after 25 to 35
_REPAIRS = 3  # times that gaps with too much error are halved in each round
_FIRST_SHARE = 0.3  # of the error, limit of a curve by itself; below what the spline adds to it
_STRONGER, _WEAKER = 0.5, 1.1  # factors on the limits of gaps with too much and with little error
_LITTLE = 0.6  # share of the error below which a gap may become longer


def fewest_pairs(
    lane: Lane, max_error_m: float, *, max_spacing_m: float, allowed: npt.NDArray[np.bool_] | None = None
) -> Floats:
    """Chainages of the fewest pairs found with which a cubic spline stays within an error.

    Parameters
    ----------
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
