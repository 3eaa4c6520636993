"""Which tags may be on the road, and which of them a row of magnets is.

A row is matched as a whole: the first and the last magnet of a tag are L apart, which gives the scale of the
odometer, and the others must then stand where the tag has them. So a magnet that was missed, or one too many, costs
at most the tag that it belongs to.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.markers.magnet import InformationTag, Polarity, check_magnet_count, segments_in

if TYPE_CHECKING:
    from app.decoders.magnet.assemble import PlacedMagnet

Floats = npt.NDArray[np.float64]

_SCALE = 0.04
_SLACK_M = 0.10
_PLACE_STD_M = 0.004
"""Of a magnet's own placement. [m]"""
_MISSING_COST = 16.0
_EXTRA_COST = 6.0
_FAR_COST = 25.0
"""chi-squared beyond which a magnet does not stand where the tag has one."""


@dataclass(frozen=True, slots=True)
class TagFormat:
    """Tags of M magnets over L metres on a grid of Seg_d, whatever their code.

    Parameters
    ----------
    magnets : int
        M.
    length_m, segment_m : float
        L and Seg_d. [m]
    """

    magnets: int = 3
    length_m: float = 4.0
    segment_m: float = 1.0

    def __post_init__(self) -> None:
        check_magnet_count(self.magnets)
        segments_in(self.length_m, self.segment_m)


@dataclass(frozen=True, slots=True)
class Match:
    """A tag found in a row.

    Attributes
    ----------
    members : tuple of int
        Places in the row of the magnets that are its own.
    tag : InformationTag or None
        None if magnets are missing and the format alone does not tell where they were.
    wrong_way : bool
    missing, extra : int
    cost : float
        chi-squared of its places with penalties.
    probability : float
        Against the next likely tag.
    """

    members: tuple[int, ...]
    tag: InformationTag | None
    wrong_way: bool
    missing: int
    extra: int
    cost: float
    probability: float = 1.0


class TagBook:
    """Tags or formats of tags that may be met.

    Parameters
    ----------
    designs : sequence of InformationTag
        Registered tags; they are told apart by direction too.
    formats : sequence of TagFormat
        Used where no design is given.
    """

    def __init__(self, designs: Sequence[InformationTag] = (), formats: Sequence[TagFormat] = ()) -> None:
        if designs and formats:
            raise InvalidParameter(
                "designs say more than formats", field="formats", limit="designs or formats", cure="leave one out"
            )
        self.formats = tuple(formats)
        both = [(tag, False) for tag in designs]
        legal = {tag.text for tag in designs}
        both += [(tag, True) for tag in designs if tag.reversed_wrong_way().text not in legal]
        self._designs = tuple(both)
        self._met = [tag.reversed_wrong_way() if wrong else tag for tag, wrong in both]
        lengths = [tag.length_m for tag in designs] or [f.length_m for f in formats]
        self.longest_m = max(lengths, default=0.0)
        gaps = [g for tag in designs for g in tag.gaps_m] or [f.length_m for f in formats]
        self.longest_gap_m = max(gaps, default=0.0)
        self._by_count: dict[int, tuple[npt.NDArray[np.intp], Floats, Floats]] = {}
        for count in {tag.magnet_count for tag in self._met}:
            mine = [i for i, tag in enumerate(self._met) if tag.magnet_count == count]
            self._by_count[count] = (
                np.array(mine),
                np.array([self._met[i].offsets_m for i in mine]),
                np.array([[p.sign for p in self._met[i].polarities] for i in mine], float),
            )

    def __bool__(self) -> bool:
        return bool(self._designs or self.formats)

    def best_match(self, row: Sequence[PlacedMagnet]) -> Match | None:
        """The likeliest tag in a row; the earliest of equals."""
        at, signs, std = _along(row)
        if self._designs:
            matches = self._match_designs(at, signs, std)
        else:
            matches = [m for f in self.formats for m in _match_format(f, at, signs, std)]
        if not matches:
            return None
        best = min(matches, key=lambda m: (round(m.cost, 6), m.members[0]))
        rivals = [
            m
            for m in matches
            if (m.tag, m.wrong_way) != (best.tag, best.wrong_way) and m.members[0] <= best.members[-1]
        ]
        against = sum(math.exp(-min((m.cost - best.cost) / 2, 50)) for m in rivals)
        return Match(
            best.members, best.tag, best.wrong_way, best.missing, best.extra, best.cost,
            best.probability / (1 + against),
        )  # fmt: skip

    def _match_designs(self, at: Floats, signs: Floats, std: Floats) -> list[Match]:
        matches = []
        for count, (numbers, offsets, polarities) in self._by_count.items():
            for i, j in combinations(range(len(at)), 2):
                for a, b in combinations(range(count), 2):
                    if count - (b - a) > 2:  # one magnet may be missing at an end
                        continue
                    matches += self._match_pair(i, j, a, b, numbers, offsets, polarities, at, signs, std)
        return matches

    def _match_pair(
        self, i: int, j: int, a: int, b: int, numbers: npt.NDArray[np.intp], offsets: Floats, polarities: Floats,
        at: Floats, signs: Floats, std: Floats,
    ) -> list[Match]:  # fmt: skip
        """Designs whose magnets a and b are the row's i and j."""
        wanted = offsets[:, b] - offsets[:, a]
        scale = (at[j] - at[i]) / wanted
        fits = (abs(at[j] - at[i] - wanted) < _SCALE * wanted + _SLACK_M) & (polarities[:, a] == signs[i])
        fits &= polarities[:, b] == signs[j]
        matches = []
        for k in np.flatnonzero(fits):
            places = at[i] + (offsets[k] - offsets[k, a]) * scale[k]
            members, cost = _assign(places, polarities[k], at, signs, std)
            if i not in members or j not in members:
                continue
            own = [m for m in members if m >= 0]
            missing = members.count(-1)
            if missing > max(offsets.shape[1] - 2, 0) or missing > 1:
                continue
            extra = own[-1] - own[0] + 1 - len(own)
            cost += _MISSING_COST * missing + _EXTRA_COST * extra + ((scale[k] - 1) / 0.015) ** 2
            tag, wrong = self._designs[int(numbers[k])]
            matches.append(Match(tuple(own), tag, wrong, missing, extra, cost))
        return matches


def _along(row: Sequence[PlacedMagnet]) -> tuple[Floats, Floats, Floats]:
    """Chainages of the row by its chords, polarities as signs, standard errors."""
    places = np.array([m.place_m for m in row])
    chords = np.linalg.norm(np.diff(places, axis=0), axis=1) if len(row) > 1 else np.empty(0)
    at = np.concatenate(([0.0], np.cumsum(chords)))
    signs = np.array([m.reading.polarity.sign for m in row], float)
    std = np.array([math.hypot(m.reading.along_std_m, _PLACE_STD_M) for m in row])
    return at, signs, std


def _assign(places: Floats, polarities: Floats, at: Floats, signs: Floats, std: Floats) -> tuple[list[int], float]:
    """The row's magnet at each place, -1 for none, and chi-squared."""
    members: list[int] = []
    cost = 0.0
    for place, sign in zip(places, polarities, strict=True):
        chi = ((at - place) / (1.5 * std)) ** 2 + np.where(signs == sign, 0, np.inf)
        k = int(np.argmin(chi))
        if chi[k] < _FAR_COST and k not in members:
            members.append(k)
            cost += float(chi[k])
        else:
            members.append(-1)
    return members, cost


def _match_format(form: TagFormat, at: Floats, signs: Floats, std: Floats) -> list[Match]:
    """Tags of a format whose first and last magnet are in the row."""
    n = segments_in(form.length_m, form.segment_m)
    matches: list[Match] = []
    for i, j in combinations(range(len(at)), 2):
        length = at[j] - at[i]
        if abs(length - form.length_m) > _SCALE * form.length_m + _SLACK_M:
            continue
        between = range(i + 1, j)
        off = ((length / form.length_m - 1) / 0.015) ** 2
        if len(between) < form.magnets - 2:
            missing = form.magnets - 2 - len(between)
            matches.append(Match((i, *between, j), None, False, missing, 0, off + _MISSING_COST * missing, 0.5))
            continue
        step = (at - at[i]) / length * n
        spread = np.hypot(std, math.hypot(std[i], std[j]) / 2) / length * n
        for middle in combinations(between, form.magnets - 2):
            positions = [round(float(step[k])) for k in middle]
            if any(not a < b for a, b in zip([0, *positions], [*positions, n], strict=True)):
                continue
            miss = [float(step[k]) - p for k, p in zip(middle, positions, strict=True)]
            # the next grid place is the rival of each
            odds = [
                math.exp(min(((m * m) - (1 - abs(m)) ** 2) / (2 * spread[k] ** 2), 0.0))
                for k, m in zip(middle, miss, strict=True)
            ]
            cost = off + sum((m / max(spread[k], 0.05)) ** 2 for k, m in zip(middle, miss, strict=True))
            extra = len(between) - len(middle)
            members = (i, *middle, j)
            polarities = tuple(Polarity.N if signs[k] > 0 else Polarity.S for k in members)
            tag = InformationTag(polarities, form.length_m, form.segment_m, tuple(positions))
            matches.append(
                Match(members, tag, False, 0, extra, cost + _EXTRA_COST * extra, math.prod(1 / (1 + o) for o in odds))
            )
    return matches
