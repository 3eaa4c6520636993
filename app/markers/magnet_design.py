"""Designs of information tags and codebooks: their codes, one by one, how many there are, and errors of reading.

Source: METRO paper, section 4.2, equation 2 and figures 5 and 17a.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields
from enum import StrEnum
from itertools import product
from math import comb
from typing import Annotated, Final, Literal, NotRequired

import numpy as np
import numpy.typing as npt
import scipy
from pydantic import Field, SkipValidation, WithJsonSchema, with_config
from typing_extensions import TypedDict

from app.errors import CodeMismatch, Conflict, InvalidParameter
from app.inputs import INPUT, Number, Whole
from app.markers.magnet import (
    FIELD_UT_M3,
    MIN_GAP_M,
    MOMENT_AM2,
    InformationTag,
    Installation,
    Polarity,
    check_magnet_count,
    parse_tag,
    rounded_m,
    segments_in,
    ticks_from_m,
)
from app.values import Floats, JsonObject


@with_config(INPUT)
@dataclass(frozen=True, slots=True)
class TagDesign:
    """What the tags of a codebook share: {M, L, Seg_d}, and how near neighbours may stand."""

    magnets: Annotated[Whole, Field(description="M, 2 to 7.")]
    length_m: Annotated[Number, Field(description="L, from the first magnet to the last, 0.5 to 30. [m]")]
    segment_m: Annotated[
        Number, Field(description="Seg_d, the grid of the middle magnets; L is a whole number of it. [m]")
    ]
    # 0.5 m keeps the fields of neighbours apart, 0 gives the paper's ideal
    min_gap_m: Annotated[Number, Field(description="Least distance between neighbours, 0.5 or more. [m]")] = MIN_GAP_M

    def __post_init__(self) -> None:
        """Raises InvalidParameter if a value is outside the limits of a tag."""
        check_magnet_count(self.magnets)
        segments_in(self.length_m, self.segment_m)
        object.__setattr__(self, "length_m", rounded_m(self.length_m, "length_m"))
        object.__setattr__(self, "segment_m", rounded_m(self.segment_m, "segment_m"))
        if not 0 <= self.min_gap_m <= self.length_m:
            raise InvalidParameter(
                f"min_gap_m is {self.min_gap_m:g} m, the tag is {self.length_m:g} m long",
                field="min_gap_m",
                limit=f"0 to {self.length_m:g} m",
                cure=f"{MIN_GAP_M:g} m keeps the fields of neighbours apart",
            )
        object.__setattr__(self, "min_gap_m", rounded_m(self.min_gap_m, "min_gap_m"))

    @classmethod
    def of(cls, tag: InformationTag, min_gap_m: float = MIN_GAP_M) -> TagDesign:
        """The design that a tag belongs to."""
        return cls(tag.magnet_count, tag.length_m, tag.segment_m, min_gap_m)

    @property
    def segments(self) -> int:
        """n = L / Seg_d."""
        return segments_in(self.length_m, self.segment_m)

    @property
    def min_gap_steps(self) -> int:
        """g, the least distance between neighbours in segments, at least 1."""
        step = ticks_from_m(self.segment_m, "segment_m")
        return max(-(-ticks_from_m(self.min_gap_m, "min_gap_m") // step), 1)

    @property
    def ideal_capacity(self) -> int:
        """Codes without coupling: 2^M C(n - 1, M - 2) (equation 2)."""
        return int(2**self.magnets * comb(self.segments - 1, self.magnets - 2))

    @property
    def placements(self) -> int:
        """Ways to place the middle magnets, neighbours at least g apart: C(n - (M-1) g + M - 2, M - 2)."""
        spare = self.segments - (self.magnets - 1) * self.min_gap_steps
        return comb(spare + self.magnets - 2, self.magnets - 2) if spare >= 0 else 0

    @property
    def coupled_capacity(self) -> int:
        """Codes with neighbours at least `min_gap_m` apart: 2^M times the placements."""
        return int(2**self.magnets * self.placements)

    @property
    def own_reverses(self) -> int:
        """Codes that a wrong-way driver reads as they are: none for odd M, whose middle magnet always flips.

        Notes
        -----
        Half of the polarities are free, and the gaps read the same from both ends: k = (M - 2) / 2 of them and the
        middle one, which takes up whatever is left.
        """
        if self.magnets % 2:
            return 0
        g, k = self.min_gap_steps, (self.magnets - 2) // 2
        spare = self.segments - (self.magnets - 1) * g
        if spare < 0:
            return 0
        return int(2 ** (self.magnets // 2) * sum(comb(s + k - 1, k - 1) if k else 1 for s in _halves(spare, k)))

    @property
    def wrong_way_safe_capacity(self) -> int:
        """Most codes of which none is another's reverse, nor its own: half of the rest."""
        return (self.coupled_capacity - self.own_reverses) // 2

    def list_gap_steps(self) -> Iterator[tuple[int, ...]]:
        """Distances between neighbours in segments, (M - 1,) each, in rising order; made as they are asked for."""
        yield from _compositions(self.segments, self.magnets - 1, self.min_gap_steps)

    def gap_steps_at(self, rank: int) -> tuple[int, ...]:
        """The placement with this rank in `list_gap_steps`, without listing the others.

        Raises
        ------
        InvalidParameter
            There are not so many placements.
        """
        if not 0 <= rank < self.placements:
            raise InvalidParameter(f"there is no placement {rank}", field="rank", limit=f"0 to {self.placements - 1}")
        gaps, left, parts = [], self.segments, self.magnets - 1
        while parts > 1:
            gap, g = self.min_gap_steps, self.min_gap_steps
            while rank >= (behind := comb(left - gap - (parts - 1) * g + parts - 2, parts - 2)):
                rank, gap = rank - behind, gap + 1
            gaps.append(gap)
            left, parts = left - gap, parts - 1
        return (*gaps, left)

    def list_codes(self) -> Iterator[InformationTag]:
        """Every tag of the design, by gaps and then by polarities from NN..N to SS..S; made as they are asked for."""
        for gaps in self.list_gap_steps():
            ends = [0]
            for gap in gaps:
                ends.append(ends[-1] + gap)
            for polarities in product(Polarity, repeat=self.magnets):
                yield InformationTag(polarities, self.length_m, self.segment_m, tuple(ends[1:-1]))

    def admits(self, tag: InformationTag) -> bool:
        """Whether a tag is one of this design."""
        same = (tag.magnet_count, tag.length_m, tag.segment_m) == (self.magnets, self.length_m, self.segment_m)
        return same and min(tag.gap_steps) >= self.min_gap_steps


def _halves(spare: int, k: int) -> range:
    """Segments beyond g that each half of a palindrome may take; without pairs the middle gap takes all."""
    return range(spare // 2 + 1) if k else range(1)


def _compositions(total: int, parts: int, least: int) -> Iterator[tuple[int, ...]]:
    """Ordered sums of `total` in `parts` parts of at least `least`."""
    if total < parts * least:
        return
    if parts == 1:
        yield (total,)
        return
    for first in range(least, total - (parts - 1) * least + 1):
        for rest in _compositions(total - first, parts - 1, least):
            yield (first, *rest)


# === How well distance ratios are read, and which codes can be distinguished.
#
# The places of a tag's magnets are read with an error each; the odometer adds its own to every gap. A code is what
# remains when the scale is taken out: u = (place of each middle magnet) / (length of the tag). So an error of scale
# that all gaps share, of the odometer or of the wheel's radius, cancels; noise, timing, and whatever changes between
# gaps does not.


MAX_PLACEMENTS = 4000
"""Placements that are examined at most; of larger designs, so many at equal ranks. Chosen for speed
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
    """Errors of reading one tag. The defaults are those of our decoder, to be kept in step with its benchmarks."""

    # standard deviation of a magnet's place in the road. [m] Source: METRO section 8.2 saw less than 3 mm.
    placement_m: float = 0.0015
    # noise of a sample on the forward axis. [uT] Source: MLX90393 as METRO sets it (section 6.1).
    noise_ut: float = 1.5
    moment_am2: float = MOMENT_AM2  # [A m2] magnetic moment of a magnet
    sample_rate_hz: float = 350.0  # of the magnetometers. [Hz] Source: METRO section 6.1.
    channels: float = 4.0  # sensor axes of like strength whose evidence the decoder adds up
    # standard deviation of the time at which a magnet is placed, beyond noise: jitter of the samples, or their interval
    # / sqrt(12) for a decoder that works in whole samples. [s]
    timing_s: float = 0.0001

    def __post_init__(self) -> None:
        _check_fields(self, may_be_zero=("placement_m", "noise_ut", "timing_s"))

    def position_std_m(self, speed_m_s: float, clearance_m: float) -> float:
        """Standard deviation of a magnet's place along the lane. [m]

        Notes
        -----
        A pulse of amplitude A and width h, sampled N times, is placed to h (noise / A) / sqrt(N). The field straight
        above a lying magnet falls with the cube of the clearance h, the samples rise with h / speed.
        """
        amplitude_ut = FIELD_UT_M3 * self.moment_am2 / clearance_m**3
        samples = self.channels * self.sample_rate_hz * clearance_m / speed_m_s
        noise_m = clearance_m * (self.noise_ut / amplitude_ut) / math.sqrt(samples)
        return math.hypot(noise_m, self.placement_m, self.timing_s * speed_m_s)


METRO_ERROR = MagnetErrorModel(channels=1.0, timing_s=1 / 350 / math.sqrt(12))
"""The paper's pipeline: peaks at whole samples of one axis (section 5.2 and equation 1)."""


@with_config(INPUT)
@dataclass(frozen=True, slots=True)
class OdometerError:
    """Errors of the vehicle's speed that do not cancel in a ratio."""

    quantum_m_s: Annotated[Number, Field(ge=0, le=5, description="Step of the speed signal. [m/s]")] = 0.01
    rate_hz: Annotated[Number, Field(ge=0.1, le=1000, description="Speeds a second. [Hz]")] = 10.0  # METRO section 7.1
    # standard deviation; by slip, braking, latency
    drift: Annotated[Number, Field(ge=0, le=0.1, description="Relative change of scale from one gap to the next.")] = (
        0.001
    )

    def __post_init__(self) -> None:
        _check_fields(self, may_be_zero=("quantum_m_s", "drift"))

    def gap_std_m(self, gaps_m: Floats, speed_m_s: float) -> Floats:
        """Standard deviation of the length of gaps, same shape. [m]"""
        quantised = self.quantum_m_s / math.sqrt(12) * np.sqrt(gaps_m / speed_m_s / self.rate_hz)
        return np.hypot(quantised, self.drift * gaps_m)


@dataclass(frozen=True, slots=True)
class ReadingConditions:
    """Conditions under which a code must be read: the fastest and highest vehicle, its odometer and its decoder."""

    speed_m_s: float = 13.4
    clearance_m: float = 0.30  # [m] of the sensors above the magnets: their depth adds to the vehicle's clearance
    odometer: OdometerError = field(default_factory=OdometerError)
    model: MagnetErrorModel = field(default_factory=MagnetErrorModel)

    def __post_init__(self) -> None:
        for name, value, limits, unit in (
            ("speed_m_s", self.speed_m_s, (0.5, 70.0), "m/s"),
            ("clearance_m", self.clearance_m, (0.05, 1.0), "m"),
        ):
            if not limits[0] <= value <= limits[1]:
                raise InvalidParameter(
                    f"{name} is {value:g} {unit}",
                    field=name,
                    limit=f"{limits[0]:g} to {limits[1]:g} {unit}",
                    cure="give the design speed and the highest clearance of the vehicles to be served",
                )


def covariance_of(gaps_m: Floats, conditions: ReadingConditions) -> Floats:
    """Covariance of u, the middle magnets' places over the tag's length, as they are read.

    Parameters
    ----------
    gaps_m : ndarray, shape (K, M - 1)
        Distances between neighbours of K tags. [m]

    Returns
    -------
    ndarray, shape (K, M - 2, M - 2)
    """
    count = gaps_m.shape[1]
    place_std = conditions.model.position_std_m(conditions.speed_m_s, conditions.clearance_m)
    differences = np.eye(count, count + 1, k=1) - np.eye(count, count + 1)
    of_gaps = place_std**2 * (differences @ differences.T)
    gap_std = conditions.odometer.gap_std_m(gaps_m, conditions.speed_m_s)
    of_gaps = of_gaps + gap_std[:, :, None] * np.eye(count) * gap_std[:, None, :]
    length = gaps_m.sum(axis=1)[:, None, None]
    u = np.cumsum(gaps_m, axis=1)[:, :-1] / length[:, :, 0]
    slope = (np.tril(np.ones((count - 1, count))) - u[:, :, None]) / length
    covariance: Floats = slope @ of_gaps @ slope.transpose(0, 2, 1)
    return covariance


def ratio_std(gaps_m: Sequence[float], conditions: ReadingConditions) -> tuple[float, ...]:
    """Standard deviation of the deviation ratio (measured over true ratio) of d_2/d_1 .. d_(M-1)/d_1, length M - 2."""
    gaps = np.asarray(gaps_m, dtype=np.float64)
    place_std = conditions.model.position_std_m(conditions.speed_m_s, conditions.clearance_m)
    own = (conditions.odometer.gap_std_m(gaps, conditions.speed_m_s) / gaps) ** 2
    stds = []
    for i in range(1, len(gaps)):
        ends = np.zeros(len(gaps) + 1)
        ends[[0, 1]] += (1 / gaps[0], -1 / gaps[0])
        ends[[i, i + 1]] += (-1 / gaps[i], 1 / gaps[i])
        stds.append(float(math.sqrt(place_std**2 * float(ends @ ends) + float(own[0] + own[i]))))
    return tuple(stds)


def separation(u: Floats, covariance: Floats, others_u: Floats) -> Floats:
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
    distance: Floats = np.sqrt(np.sum(delta * np.linalg.solve(covariance, delta.T).T, axis=1))
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
    """How many codes of a design are read right with the probability `accuracy` when all are in use."""

    accuracy: float
    share: float  # of the codes
    codes: int  # the same as a number of codes
    # `mean_accuracy`, `worst_accuracy`: probability that the ratios of a code are read right, at least
    mean_accuracy: float
    worst_accuracy: float


def distinguishable(design: TagDesign, conditions: ReadingConditions, *, accuracy: float = 0.99) -> Distinguishable:
    """Share of a design's codes that a decoder distinguishes, magnets and polarities being read.

    Parameters
    ----------
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
        return Distinguishable(accuracy, 0.0, 0, 0.0, 0.0)
    right = 1.0 - np.minimum(_confusion(design, placements_of(design), conditions), 1.0)
    share = float(np.mean(right >= accuracy))
    codes = round(share * design.placements) * 2**design.magnets
    return Distinguishable(accuracy, share, codes, float(right.mean()), float(right.min()))


def placements_of(design: TagDesign, max_count: int = MAX_PLACEMENTS) -> npt.NDArray[np.int64]:
    """Gaps in segments, shape (K, M - 1): all placements in rising order, or `max_count` of them at equal ranks."""
    if design.placements <= max_count:
        rows = list(design.list_gap_steps())
    else:
        rows = [design.gap_steps_at(k * (design.placements - 1) // (max_count - 1)) for k in range(max_count)]
    return np.array(rows, dtype=np.int64).reshape(-1, design.magnets - 1)


def _confusion(design: TagDesign, steps: npt.NDArray[np.int64], conditions: ReadingConditions) -> Floats:
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


# === What the codes of information tags mean: meanings and the book that an agency keeps of them.
#
# Source: METRO paper, sections 4, 6.3, 8.3 and 10 (arrows, stop line ahead, "prepare a 125 degree right turn").


MAX_NAME = 80
CODEBOOK_FORMAT = "waymark-codebook/1"


class MeaningKind(StrEnum):
    """Kinds of messages to a vehicle."""

    ARROW = "arrow"
    STOP_LINE_AHEAD = "stop-line-ahead"
    SPEED_LIMIT_KMH = "speed-limit-kmh"
    SPEED_LIMIT_MPH = "speed-limit-mph"
    BEND_LEFT = "bend-left"
    BEND_RIGHT = "bend-right"
    NOTICE = "notice"


class Arrow(StrEnum):
    """Directions that an arrow on the lane shows."""

    STRAIGHT = "straight"
    LEFT = "left"
    RIGHT = "right"
    STRAIGHT_LEFT = "straight-left"
    STRAIGHT_RIGHT = "straight-right"
    LEFT_RIGHT = "left-right"
    U_TURN = "u-turn"


_NUMBERS: dict[MeaningKind, tuple[str, float, float]] = {
    MeaningKind.STOP_LINE_AHEAD: ("m", 1.0, 500.0),
    MeaningKind.SPEED_LIMIT_KMH: ("km/h", 5.0, 150.0),
    MeaningKind.SPEED_LIMIT_MPH: ("mph", 5.0, 90.0),
    MeaningKind.BEND_LEFT: ("deg", 1.0, 180.0),
    MeaningKind.BEND_RIGHT: ("deg", 1.0, 180.0),
}
"""Unit and limits of the kinds whose value is a number."""


@with_config(INPUT)
@dataclass(frozen=True, slots=True)
class Meaning:
    """What a tag means."""

    kind: Annotated[
        MeaningKind,
        Field(
            description="arrow, stop-line-ahead [m], speed-limit-kmh, speed-limit-mph, bend-left, bend-right [deg], "
            "notice"
        ),
    ]
    value: Annotated[
        SkipValidation[float | str],
        WithJsonSchema({"anyOf": [{"type": "number"}, {"type": "string", "maxLength": 80}]}),
        Field(description="A number in the kind's unit, the arrow, or the text of the notice: 1 to 80 characters."),
    ]

    def __post_init__(self) -> None:
        """Raises InvalidParameter if the value does not belong to the kind."""
        try:
            kind = MeaningKind(self.kind)
        except ValueError as error:
            raise InvalidParameter(
                f"{str(self.kind)[:40]!r} is no kind of meaning", field="kind", limit=", ".join(MeaningKind)
            ) from error
        object.__setattr__(self, "kind", kind)
        object.__setattr__(self, "value", _checked_value(kind, self.value))

    @property
    def unit(self) -> str:
        """Unit of the value; empty for arrows and notices."""
        return _NUMBERS[self.kind][0] if self.kind in _NUMBERS else ""

    @property
    def text(self) -> str:
        """For people, e.g. ``bend right 125 deg``."""
        value = f"{self.value:g}" if isinstance(self.value, float) else self.value
        kind = {MeaningKind.SPEED_LIMIT_KMH: "speed limit", MeaningKind.SPEED_LIMIT_MPH: "speed limit"}.get(
            self.kind, self.kind.value.replace("-", " ")
        )
        return value if self.kind is MeaningKind.NOTICE else f"{kind} {value} {self.unit}".rstrip()


def _checked_value(kind: MeaningKind, value: float | str) -> float | str:
    if kind in _NUMBERS:
        unit, low, high = _NUMBERS[kind]
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise InvalidParameter(
                f"the value of {kind} is {str(value)[:40]!r}", field="value", limit=f"{low:g} to {high:g} {unit}"
            )
        return float(value)
    if kind is MeaningKind.ARROW:
        if not isinstance(value, str) or value not in set(Arrow):
            raise InvalidParameter(f"{str(value)[:40]!r} is no arrow", field="value", limit=", ".join(Arrow))
        return Arrow(value).value
    check_name("value", value)
    return value


def check_name(field: str, text: object) -> None:
    """Refuse what is not a printable line of text."""
    plain = isinstance(text, str) and 1 <= len(text) <= MAX_NAME and text.isprintable() and text == text.strip()
    if not plain:
        raise InvalidParameter(
            f"{field} is not a line of text that can be printed",
            field=field,
            limit=f"1 to {MAX_NAME} printable characters without spaces at the ends",
        )


@dataclass(frozen=True, slots=True)
class Codebook:
    """The codes of one design and what they mean.

    Raises
    ------
    InvalidParameter
        A tag is not of the design.
    Conflict
        A code or a meaning occurs twice.
    """

    name: str  # 1 to 80 printable characters
    design: TagDesign  # what all its tags share
    entries: tuple[tuple[InformationTag, Meaning], ...] = ()  # in the order in which they were added

    def __post_init__(self) -> None:
        check_name("name", self.name)
        object.__setattr__(self, "entries", tuple(self.entries))
        for tag, _ in self.entries:
            if not self.design.admits(tag):
                raise CodeMismatch(
                    f"{tag.text} is not a code of this book",
                    field="entries",
                    limit=f"M = {self.design.magnets}, L = {self.design.length_m:g} m, "
                    f"Seg_d = {self.design.segment_m:g} m, neighbours at least {self.design.min_gap_m:g} m apart",
                )
        for what, values in (("code", self.tags), ("meaning", tuple(meaning for _, meaning in self.entries))):
            if len(set(values)) != len(values):
                raise Conflict(f"a {what} occurs twice in the book", field="entries", limit=f"each {what} once")

    @property
    def tags(self) -> tuple[InformationTag, ...]:
        """The codes, in the order in which they were added."""
        return tuple(tag for tag, _ in self.entries)

    def find_meaning(self, tag: InformationTag) -> Meaning | None:
        """What a tag means, or None if it is not in the book."""
        return dict(self.entries).get(tag)

    def find_tag(self, meaning: Meaning) -> InformationTag | None:
        """The code of a meaning, or None if it has none."""
        return next((tag for tag, known in self.entries if known == meaning), None)

    def to_document(self) -> dict[str, object]:
        """As plain values, for JSON."""
        design = self.design
        return {
            "format": CODEBOOK_FORMAT,
            "name": self.name,
            "design": {
                "magnets": design.magnets,
                "length_m": design.length_m,
                "segment_m": design.segment_m,
                "min_gap_m": design.min_gap_m,
            },
            "entries": [{"code": t.text, "kind": m.kind.value, "value": m.value} for t, m in self.entries],
        }

    @classmethod
    def from_document(cls, document: JsonObject) -> Codebook:
        """The book that `to_document` wrote.

        Raises
        ------
        InvalidParameter
            It is not one: a part is missing, of the wrong type, or outside its limits.
        """
        if document.get("format") != CODEBOOK_FORMAT:
            raise InvalidParameter("this is not a codebook", field="format", limit=CODEBOOK_FORMAT)
        try:
            design = TagDesign(**document["design"])
            entries = tuple((parse_tag(e["code"]), Meaning(e["kind"], e["value"])) for e in document["entries"])
        except (KeyError, TypeError, AttributeError) as error:
            raise InvalidParameter(
                f"the codebook is incomplete or of the wrong form: {error}",
                field="document",
                limit="name, design {magnets, length_m, segment_m, min_gap_m}, entries [{code, kind, value}]",
            ) from error
        if not all(isinstance(tag, InformationTag) for tag, _ in entries):
            raise CodeMismatch("line tags have no place in a codebook", field="entries", limit="information tags")
        return cls(document.get("name", ""), design, entries)  # type: ignore[arg-type]


# === What the row of a magnet marker has in its column `spec`.


INFORMATION_TAG: Final = "information-tag"


class StoredMeaning(TypedDict):
    """The kind of a meaning and its value."""

    kind: str
    value: float | str


class StoredLane(TypedDict):
    """Vertices in WGS 84, and in `given` the coordinates that were sent where they were of another system."""

    points_deg: list[list[float]]
    height_m: float | None
    given: list[list[float]] | None


class StoredNeighbour(TypedDict):
    """The nearest magnet of another marker with an orientation."""

    name: str
    lon_deg: float
    lat_deg: float
    phi_deg: int


class MagnetSpec(TypedDict):
    """What the layout of a magnet marker follows from."""

    kind: Literal["information-tag", "line-tag"]
    tag: str
    codebook_id: str | None
    meaning: StoredMeaning | None
    lane: StoredLane
    place: dict[str, float | None]  # of `TagPlace` or `LinePlace`
    site: JsonObject  # of `Site`
    neighbours: list[StoredNeighbour]
    installation: NotRequired[JsonObject]  # of `Installation`; markers of earlier releases have none


def installation_of(spec: MagnetSpec) -> Installation:
    """How the magnets are fixed."""
    return Installation(**(spec.get("installation") or {}))


def meaning_of(spec: MagnetSpec) -> Meaning | None:
    """What the tag means, if it is in a codebook."""
    stored = spec["meaning"]
    return None if stored is None else Meaning(MeaningKind(stored["kind"]), stored["value"])
