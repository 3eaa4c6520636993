"""Designs of information tags: their codes, one by one, and how many there are.

Source: METRO paper, section 4.2, equation 2 and figures 5 and 17a.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from math import comb

from app.errors import InvalidParameter
from app.markers.magnet import (
    MIN_GAP_M,
    InformationTag,
    Polarity,
    check_magnet_count,
    rounded_m,
    segments_in,
    ticks_from_m,
)


@dataclass(frozen=True, slots=True)
class TagDesign:
    """What the tags of a family share: {M, L, Seg_d}, and how near neighbours may stand.

    Parameters
    ----------
    magnets : int
        M, 2 to 7.
    length_m : float
        L, a whole number of segments. [m]
    segment_m : float
        Seg_d. [m]
    min_gap_m : float
        Least distance between neighbours; 0.5 m keeps their fields apart, 0 gives the paper's ideal. [m]

    Raises
    ------
    InvalidParameter
        A value is outside the limits of a tag.
    """

    magnets: int
    length_m: float
    segment_m: float
    min_gap_m: float = MIN_GAP_M

    def __post_init__(self) -> None:
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
