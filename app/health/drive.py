"""The vehicle's own errors, estimated from all markers of its drive before any marker is judged.

A camera that is turned shifts every marker; fog, dirt on the lens and a dead sensor miss every marker; a driver on the
wrong way meets every marker reversed. So each pass is compared with the passes of other markers beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.health.passes import Evidence, Pass
from app.health.states import VehicleState

Floats = npt.NDArray[np.float64]

BESIDE = 6
"""Passes on each side that a pass is compared with. Source: by hand; a kilometre of plates 80 m apart."""
MIN_OTHERS = 3
"""Other markers for a common shift: of three, one may have moved. Source: the median's breakdown point."""
MIN_EXPECTED = 0.3
"""Reading probability below which a pass is no evidence of a missing marker. Source: by hand."""
RECENT_PASSES = 6.0
"""Passes of its last minutes that a vehicle's reading rate rests on besides those of the drive. Source: by hand."""
DOUBT_PASSES = 0.7
"""Misses that are added to those of a drive, because its rate is estimated from few passes. Source: as the predictive
probability of a binomial with Jeffreys' prior."""
RATE_LIMITS = (0.05, 1.0)
_MAX_PROBABILITY = 0.95  # source: by hand; a truck in front hides a marker in some percent of passes
MIN_ALIVE = 0.5
"""Readings of other markers, the decaying ones of the last minutes with them, without which a miss is no evidence."""
SILENT_DRIVE_FACTOR = {"cerpm": 0.5}
"""By family: factor on the reading probability of its only marker on a drive that reads none. Nothing shows that the
receiver of CERPMs works, but fog and dirt do not stop it as they stop a camera; of other families such a drive is no
evidence. Source: by hand; 65 drives find a CERPM gone."""
WRONG_WAY_SHARE = 0.6
"""Share of reversed markers from which the vehicle is on the wrong way. Source: by hand."""
STATED_PASSES = 4.0
"""Passes that a decoder's own standard deviation weighs as much as. Source: `python -m benchmarks.health`."""
SIGMA_FLOOR_M = 0.08
"""[m] of what no model has: the road's cross fall, springs, the map. Each axis. Source: by hand."""
_MAD_SIGMA, _MEDIAN_LOSS = 1.4826, 1.2533  # of a normal distribution: MAD to sigma, median's error to the mean's


@dataclass(frozen=True, slots=True)
class JudgedDrive:
    """Evidence of a drive on markers and on the vehicle.

    Attributes
    ----------
    evidence : list of Evidence
        In the order of the passes.
    wrong_way : bool
        The driver is on the wrong way.
    only_one : bool
        A single marker shows it, which may itself be installed in reverse.
    shift_m : (float, float) or None
        Median offset, forward and left. [m]
    """

    evidence: list[Evidence]
    wrong_way: bool
    only_one: bool
    shift_m: tuple[float, float] | None


def judge_drive(passes: Sequence[Pass], vehicle: VehicleState, at_s: float) -> JudgedDrive:
    """Evidence on each marker of a drive; the vehicle's record is updated.

    Parameters
    ----------
    passes : sequence of Pass
        One for each marker of one upload.
    vehicle : VehicleState
        Changed in place.
    at_s : float
        When the drive was recorded. [s since 1970]
    """
    vehicle.age(at_s)
    order = sorted(range(len(passes)), key=lambda k: passes[k].along)
    ordered = [passes[k] for k in order]
    probability = _read_probabilities(ordered, vehicle)
    offset_m, sigma_m, shift_m = _offsets(ordered, vehicle)
    is_reversed, wrong_way, only_one = _directions(ordered)
    quality = _qualities(ordered)
    evidence: list[Evidence | None] = [None] * len(passes)
    for rank, (k, one) in enumerate(zip(order, ordered, strict=True)):
        known = bool(np.isfinite(sigma_m[rank]))
        evidence[k] = Evidence(
            one.marker_id, one.family, one.read, float(probability[rank]),
            (float(offset_m[rank, 0]), float(offset_m[rank, 1])) if known else None,
            float(sigma_m[rank]) if known else 0.0, one.survey_m, is_reversed[rank], only_one,
            float(quality[rank]) if np.isfinite(quality[rank]) else None, one.elsewhere, one.two_places,
        )  # fmt: skip
    vehicle.reads += sum(one.read for one in passes if one.expected >= MIN_EXPECTED)
    vehicle.expected += sum(one.expected for one in passes if one.expected >= MIN_EXPECTED)
    return JudgedDrive([one for one in evidence if one is not None], wrong_way, only_one, shift_m)


def _beside(values: Floats, families: Sequence[str] | None = None) -> Floats:
    """Values of the passes beside each pass but its own, shape (N, 2 BESIDE); NaN outside and of other families."""
    count = len(values)
    index = np.arange(count)[:, None] + np.array([k for k in range(-BESIDE, BESIDE + 1) if k])
    inside = (index >= 0) & (index < count)
    index = np.clip(index, 0, max(count - 1, 0))
    found = np.where(inside, values[index] if count else np.nan, np.nan)
    if families is not None and count:
        names = np.array(families)
        found = np.where(names[index] == names[:, None], found, np.nan)
    return np.asarray(found, dtype=np.float64)


def _median(values: Floats) -> Floats:
    """Medians of values of shape (N, K, D) over K without NaN, shape (N, D); NaN where there is no value."""
    ordered = np.sort(values, axis=1)  # NaN comes last
    count = np.isfinite(values).sum(axis=1, keepdims=True)
    low, high = np.maximum((count - 1) // 2, 0), np.minimum(count // 2, values.shape[1] - 1)
    both = np.take_along_axis(ordered, low, axis=1) + np.take_along_axis(ordered, high, axis=1)
    return np.asarray(np.where(count > 0, both / 2.0, np.nan)[:, 0, :])


def _read_probabilities(passes: Sequence[Pass], vehicle: VehicleState) -> Floats:
    """That this vehicle reads each marker, from the markers beside it and from its last minutes; 0 is no evidence."""
    expected = np.array([one.expected for one in passes])
    enough = expected >= MIN_EXPECTED
    families = [one.family for one in passes]
    reads = np.nansum(_beside(np.where(enough, [one.read for one in passes], np.nan).astype(float), families), axis=1)
    others = np.nansum(_beside(np.where(enough, expected, np.nan), families), axis=1)
    alive = reads + vehicle.reads
    recent = 1.0 + min(vehicle.expected, RECENT_PASSES)
    record = recent * min((vehicle.reads + 1.0) / (vehicle.expected + 1.0), 1.0)
    read = np.array([one.read for one in passes], dtype=np.float64)
    alike = (np.array(families)[:, None] == np.array(families)).astype(np.float64)
    all_reads, all_others = alike @ (enough * read) - enough * read, alike @ (enough * expected) - enough * expected
    rate = np.minimum(
        (reads + record) / (others + recent + DOUBT_PASSES), (all_reads + record) / (all_others + recent + DOUBT_PASSES)
    )
    probability = np.minimum(expected * np.clip(rate, *RATE_LIMITS), _MAX_PROBABILITY)
    is_lone = (all_others <= 0.0) & (vehicle.expected < MIN_EXPECTED)
    silent = np.array([SILENT_DRIVE_FACTOR.get(family, 0.0) for family in families]) * is_lone
    return np.where(enough, np.where(alive >= MIN_ALIVE, 1.0, silent) * probability, 0.0)


def _offsets(passes: Sequence[Pass], vehicle: VehicleState) -> tuple[Floats, Floats, tuple[float, float] | None]:
    """Offsets less the drive's common shift [m], their standard deviations (NaN: none) and the shift."""
    raw = np.array([one.offset_m or (np.nan, np.nan) for one in passes], dtype=np.float64).reshape(-1, 2)
    stated = np.array([one.sigma_m for one in passes])
    absolute = np.array([one.offset_is_absolute for one in passes], dtype=bool)
    found = np.isfinite(raw[:, 0])
    sigma = np.where(found, np.hypot(stated, SIGMA_FLOOR_M), np.nan)
    by_position = found & ~absolute
    if not by_position.any():
        return raw, sigma, None
    heading = np.radians([one.heading_deg or 0.0 for one in passes])
    axes = np.stack([np.sin(heading), np.cos(heading), -np.cos(heading), np.sin(heading)], axis=1).reshape(-1, 2, 2)
    in_vehicle = np.einsum("nij,nj->ni", axes, raw)
    shift, scatter = _common_shift(np.where(by_position[:, None], in_vehicle, np.nan), stated, passes, vehicle)
    common = np.median(in_vehicle[by_position], axis=0)
    vehicle.learn(float(common[0]), float(common[1]), int(by_position.sum()))
    rest = np.einsum("nji,nj->ni", axes, in_vehicle - shift)
    offset = np.where(by_position[:, None], rest, raw)
    return offset, np.where(by_position, scatter, sigma), (float(common[0]), float(common[1]))


def _common_shift(
    in_vehicle: Floats, stated: Floats, passes: Sequence[Pass], vehicle: VehicleState
) -> tuple[Floats, Floats]:
    """Shift of each pass by the passes beside it, or by the vehicle's record, and the error of what is left. [m]"""
    beside = np.stack([_beside(in_vehicle[:, 0]), _beside(in_vehicle[:, 1])], axis=2)
    others = np.isfinite(beside[:, :, 0]).sum(axis=1)
    median = _median(beside)
    spread = _MAD_SIGMA * _median(np.abs(beside - median[:, None, :])).mean(axis=1)
    by_others = others >= MIN_OTHERS
    own = np.array([np.nan if one.position_sigma_m is None else one.position_sigma_m for one in passes])
    shift = np.where(by_others[:, None], median, [vehicle.forward_m, vehicle.left_m])
    by_median = _MEDIAN_LOSS * spread / np.sqrt(np.maximum(others, 1))
    shift_sigma = np.where(by_others, by_median, np.hypot(own, vehicle.shift_sigma_m))
    # what the markers beside it scatter by, this one scatters by too; few of them are weak evidence of it
    pooled = (others * np.nan_to_num(spread) ** 2 + STATED_PASSES * stated**2) / (others + STATED_PASSES)
    variance = np.where(by_others, np.maximum(pooled, stated**2), stated**2)
    return shift, np.sqrt(variance + shift_sigma**2 + SIGMA_FLOOR_M**2)


def _directions(passes: Sequence[Pass]) -> tuple[list[bool | None], bool, bool]:
    """Whether each marker is reversed against the drive's others, whether the vehicle is on the wrong way, and whether
    one marker alone shows a direction.
    """
    shown = [one.reversed for one in passes if one.reversed is not None]
    reversed_ones = sum(shown)
    if len(shown) <= 2 and reversed_ones == 1:  # of two that differ, either may be right
        return [one.reversed for one in passes], len(shown) == 1, True
    wrong_way = reversed_ones > WRONG_WAY_SHARE * len(shown) and reversed_ones >= 2
    against = [None if one.reversed is None else one.reversed != wrong_way for one in passes]
    return against, wrong_way, False


def _qualities(passes: Sequence[Pass]) -> Floats:
    """Quality of each marker less the median of those beside it; NaN where there are fewer than two."""
    raw = np.array([np.nan if one.quality is None else one.quality for one in passes], dtype=np.float64)
    if not np.isfinite(raw).any():
        return raw
    beside = _beside(raw, [one.family for one in passes])
    others = np.isfinite(beside).sum(axis=1)
    median = _median(beside[:, :, None])[:, 0]
    relative = np.array([one.quality_is_relative for one in passes])
    return np.where(relative, raw, np.where(others >= 2, raw - median, np.nan))
