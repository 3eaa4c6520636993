"""How well distance ratios are read, and which codes can be distinguished.

The places of a tag's magnets are read with an error each; the odometer adds its own to every gap. A code is what
remains when the scale is taken out: u = (place of each middle magnet) / (length of the tag). So an error of scale that
all gaps share, of the odometer or of the wheel's radius, cancels; noise, timing, and whatever changes between gaps
does not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from itertools import product

import numpy as np
import numpy.typing as npt
import scipy

from app.errors import InvalidParameter
from app.markers.magnet import FIELD_UT_M3, MOMENT_AM2
from app.markers.magnet_design import TagDesign

FloatArray = npt.NDArray[np.float64]
MAX_PLACEMENTS = 4000
"""Placements that are examined at most; of larger designs, so many at equal ranks. Source: chosen by hand for speed
(docs/decisions/0013-magnet-tags.md has the times)."""


def _check_fields(values: MagnetErrorModel | OdometerError, may_be_zero: tuple[str, ...]) -> None:
    for item in fields(values):
        value = getattr(values, item.name)
        if not math.isfinite(value) or value < 0 or (value == 0 and item.name not in may_be_zero):
            raise InvalidParameter(
                f"{item.name} is {value}",
                field=item.name,
                limit="0 or more, finite" if item.name in may_be_zero else "above 0, finite",
            )


@dataclass(frozen=True, slots=True)
class MagnetErrorModel:
    """Errors of reading one tag. The defaults are those of Waymark's decoder, to be kept in step with its benchmarks.

    Attributes
    ----------
    placement_m : float
        Standard deviation of a magnet's place in the road. [m] Source: METRO section 8.2 saw less than 3 mm.
    noise_ut : float
        Noise of a sample on the forward axis. [uT] Source: MLX90393 as METRO sets it (section 6.1).
    moment_am2 : float
        Magnetic moment of a magnet. [A m2]
    sample_rate_hz : float
        Of the magnetometers. [Hz] Source: METRO section 6.1.
    channels : float
        Sensor axes of like strength whose evidence the decoder adds up. Source: chosen by hand.
    timing_s : float
        Standard deviation of the time at which a magnet is placed, beyond noise: jitter of the samples, or their
        interval / sqrt(12) for a decoder that works in whole samples. [s] Source: chosen by hand.
    """

    placement_m: float = 0.0015
    noise_ut: float = 1.5
    moment_am2: float = MOMENT_AM2
    sample_rate_hz: float = 350.0
    channels: float = 4.0
    timing_s: float = 0.0001

    def __post_init__(self) -> None:
        _check_fields(self, may_be_zero=("placement_m", "noise_ut", "timing_s"))

    def position_std_m(self, speed_mps: float, clearance_m: float) -> float:
        """Standard deviation of a magnet's place along the lane. [m]

        Notes
        -----
        A pulse of amplitude A and width h, sampled N times, is placed to h (noise / A) / sqrt(N). The field straight
        above a lying magnet falls with the cube of the clearance h, the samples rise with h / speed.
        """
        amplitude_ut = FIELD_UT_M3 * self.moment_am2 / clearance_m**3
        samples = self.channels * self.sample_rate_hz * clearance_m / speed_mps
        noise_m = clearance_m * (self.noise_ut / amplitude_ut) / math.sqrt(samples)
        return math.hypot(noise_m, self.placement_m, self.timing_s * speed_mps)


METRO_ERROR = MagnetErrorModel(channels=1.0, timing_s=1 / 350 / math.sqrt(12))
"""The paper's pipeline: peaks at whole samples of one axis (section 5.2 and equation 1)."""


@dataclass(frozen=True, slots=True)
class OdometerError:
    """Errors of the vehicle's speed that do not cancel in a ratio.

    Attributes
    ----------
    quantum_mps : float
        Step of the speed signal. [m/s] Source: chosen by hand.
    rate_hz : float
        Speeds per second. [Hz] Source: METRO section 7.1.
    drift : float
        Standard deviation of the relative change of scale from one gap to the next (slip, braking, latency). Source:
        chosen by hand.
    """

    quantum_mps: float = 0.01
    rate_hz: float = 10.0
    drift: float = 0.001

    def __post_init__(self) -> None:
        _check_fields(self, may_be_zero=("quantum_mps", "drift"))

    def gap_std_m(self, gaps_m: FloatArray, speed_mps: float) -> FloatArray:
        """Standard deviation of the length of gaps, same shape. [m]"""
        quantised = self.quantum_mps / math.sqrt(12) * np.sqrt(gaps_m / speed_mps / self.rate_hz)
        return np.hypot(quantised, self.drift * gaps_m)


@dataclass(frozen=True, slots=True)
class ReadingConditions:
    """Conditions under which a code must be read: the fastest and highest vehicle, its odometer and its decoder.

    Attributes
    ----------
    speed_mps : float
        [m/s]
    clearance_m : float
        Of the sensors above the magnets. [m]
    odometer : OdometerError
    model : MagnetErrorModel
    """

    speed_mps: float = 13.4
    clearance_m: float = 0.30
    odometer: OdometerError = field(default_factory=OdometerError)
    model: MagnetErrorModel = field(default_factory=MagnetErrorModel)

    def __post_init__(self) -> None:
        for name, value, limits, unit in (
            ("speed_mps", self.speed_mps, (0.5, 70.0), "m/s"),
            ("clearance_m", self.clearance_m, (0.05, 1.0), "m"),
        ):
            if not limits[0] <= value <= limits[1]:
                raise InvalidParameter(
                    f"{name} is {value:g} {unit}",
                    field=name,
                    limit=f"{limits[0]:g} to {limits[1]:g} {unit}",
                    cure="give the design speed and the highest clearance of the vehicles to be served",
                )


def covariance_of(gaps_m: FloatArray, conditions: ReadingConditions) -> FloatArray:
    """Covariance of u, the middle magnets' places over the tag's length, as they are read.

    Parameters
    ----------
    gaps_m : ndarray, shape (K, M - 1)
        Distances between neighbours of K tags. [m]
    conditions : ReadingConditions

    Returns
    -------
    ndarray, shape (K, M - 2, M - 2)
    """
    count = gaps_m.shape[1]
    place_std = conditions.model.position_std_m(conditions.speed_mps, conditions.clearance_m)
    differences = np.eye(count, count + 1, k=1) - np.eye(count, count + 1)
    of_gaps = place_std**2 * (differences @ differences.T)
    gap_std = conditions.odometer.gap_std_m(gaps_m, conditions.speed_mps)
    of_gaps = of_gaps + gap_std[:, :, None] * np.eye(count) * gap_std[:, None, :]
    length = gaps_m.sum(axis=1)[:, None, None]
    u = np.cumsum(gaps_m, axis=1)[:, :-1] / length[:, :, 0]
    slope = (np.tril(np.ones((count - 1, count))) - u[:, :, None]) / length
    covariance: FloatArray = slope @ of_gaps @ slope.transpose(0, 2, 1)
    return covariance


def ratio_std(gaps_m: Sequence[float], conditions: ReadingConditions) -> tuple[float, ...]:
    """Standard deviation of the deviation ratio (measured over true ratio) of d_2/d_1 .. d_(M-1)/d_1, length M - 2."""
    gaps = np.asarray(gaps_m, dtype=np.float64)
    place_std = conditions.model.position_std_m(conditions.speed_mps, conditions.clearance_m)
    own = (conditions.odometer.gap_std_m(gaps, conditions.speed_mps) / gaps) ** 2
    stds = []
    for i in range(1, len(gaps)):
        ends = np.zeros(len(gaps) + 1)
        ends[[0, 1]] += (1 / gaps[0], -1 / gaps[0])
        ends[[i, i + 1]] += (-1 / gaps[i], 1 / gaps[i])
        stds.append(float(math.sqrt(place_std**2 * float(ends @ ends) + float(own[0] + own[i]))))
    return tuple(stds)


def separation(u: FloatArray, covariance: FloatArray, others_u: FloatArray) -> FloatArray:
    """Distance from one code to others in standard deviations of reading it.

    Parameters
    ----------
    u, covariance : ndarray, shapes (M - 2,) and (M - 2, M - 2)
        The code and how it is read.
    others_u : ndarray, shape (K, M - 2)

    Returns
    -------
    ndarray, shape (K,)
        Half of it, in the direction of the other, is where a reader is as likely to take one as the other. Codes of
        two magnets have no ratio: 0.
    """
    if not len(u):
        return np.zeros(len(others_u))
    delta = others_u - u
    distance: FloatArray = np.sqrt(np.sum(delta * np.linalg.solve(covariance, delta.T).T, axis=1))
    return distance


def separation_for(confusion: float) -> float:
    """Separation at which a code is taken for another one with this probability."""
    if not 0 < confusion < 0.5:
        raise InvalidParameter(
            f"confusion is {confusion:g}",
            field="confusion",
            limit="between 0 and 0.5",
            cure="0.001 is one in a thousand",
        )
    return float(-2 * scipy.special.ndtri(confusion))


# --- a design -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Distinguishable:
    """How many codes of a design can be distinguished when all are in use.

    Attributes
    ----------
    share : float
        Share of the codes that are read right with the probability asked for.
    codes : int
        The same as a number of codes, of `capacity`.
    capacity : int
    mean_accuracy, worst_accuracy : float
        Probability that the ratios of a code are read right, at least.
    """

    share: float
    codes: int
    capacity: int
    mean_accuracy: float
    worst_accuracy: float


def distinguishable(design: TagDesign, conditions: ReadingConditions, *, accuracy: float = 0.99) -> Distinguishable:
    """Share of a design's codes that a decoder distinguishes, magnets and polarities being read.

    Parameters
    ----------
    design : TagDesign
    conditions : ReadingConditions
        Speed, clearance, odometer and decoder.
    accuracy : float
        Smallest probability with which a code counts as distinguished.

    Raises
    ------
    InvalidParameter
        `accuracy` is not between 0 and 1.

    Notes
    -----
    Exact for three magnets, whose codes have a neighbour on each side; with more a bound from below, the sum over all
    neighbours on the grid. Designs of more than 4000 placements are sampled at that many equal ranks.
    """
    if not 0 < accuracy < 1:
        raise InvalidParameter(f"accuracy is {accuracy:g}", field="accuracy", limit="between 0 and 1")
    if not design.placements:
        return Distinguishable(0.0, 0, 0, 0.0, 0.0)
    right = 1.0 - np.minimum(_confusion(design, placements_of(design), conditions), 1.0)
    share = float(np.mean(right >= accuracy))
    codes = round(share * design.placements) * 2**design.magnets
    return Distinguishable(share, codes, design.coupled_capacity, float(right.mean()), float(right.min()))


def placements_of(design: TagDesign, max_count: int = MAX_PLACEMENTS) -> npt.NDArray[np.int64]:
    """Gaps in segments, shape (K, M - 1): all placements in rising order, or `max_count` of them at equal ranks."""
    if design.placements <= max_count:
        rows = list(design.list_gap_steps())
    else:
        rows = [design.gap_steps_at(k * (design.placements - 1) // (max_count - 1)) for k in range(max_count)]
    return np.array(rows, dtype=np.int64).reshape(-1, design.magnets - 1)


def _confusion(design: TagDesign, steps: npt.NDArray[np.int64], conditions: ReadingConditions) -> FloatArray:
    """Sum of the probabilities that each placement is taken for one of its neighbours on the grid, shape (K,)."""
    middles = design.magnets - 2
    total = np.zeros(len(steps))
    if not middles:
        return total
    gaps_m = steps.astype(np.float64) * design.segment_m
    inverse = np.asarray(np.linalg.inv(covariance_of(gaps_m, conditions)), dtype=np.float64)
    places = np.cumsum(steps, axis=1)[:, :-1]
    for move in product((-1, 0, 1), repeat=middles):
        if not any(move):
            continue
        moved = np.diff(places + np.array(move), axis=1, prepend=0, append=design.segments)
        exists = (moved >= design.min_gap_steps).all(axis=1)
        delta = np.array(move) / design.segments
        distance = np.sqrt(np.einsum("i,kij,j->k", delta, inverse, delta))
        total += np.where(exists, scipy.special.ndtr(-distance / 2), 0.0)
    return total
