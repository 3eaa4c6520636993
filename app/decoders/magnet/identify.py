"""Identification: which of the tags that may be on the road a row of magnets is.

A row is matched as a whole: the first and the last magnet of a tag are L apart, which gives the scale of the odometer,
and the others must then stand where the tag has them. So a magnet that was missed, or one too many, costs at most the
tag that it belongs to.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.decoders.magnet.readings import PlacedMagnet
from app.errors import InvalidParameter
from app.markers.magnet import InformationTag, Polarity, check_magnet_count, segments_in

Floats = npt.NDArray[np.float64]

_MAX_SCALE_ERROR = 0.04  # share by which the odometer may be off; source: by hand, several times a wheel's wear
_MAX_LENGTH_ERROR_M = 0.10  # [m] more that a distance may be off; source: by hand, no measurement kept
_SCALE_STD = 0.015  # standard deviation of the odometer's scale; source: by hand, tyres and pressure
_PLACEMENT_STD_M = 0.004  # [m] of a magnet's place in the road; source: METRO section 8.2 saw less than 0.003
_STD_FACTOR = 1.5  # on a place's standard error, for what the fit does not know; source: by hand
_MISSING_COST = 16.0  # chi-squared of a missing magnet; source: by hand, no measurement kept
_EXTRA_COST = 6.0  # chi-squared of a magnet that is not of the tag; source: by hand, no measurement kept
_MAX_PLACE_COST = 25.0  # chi-squared up to which a magnet stands where the tag has one: five sigma; source: by hand
_MAX_MISSING = 1  # magnets of a tag that may be missing; source: by hand, two leave too many tags alike
_MIN_GRID_STD = 0.05  # [segments] smallest standard error of a place on the grid; source: by hand
_MISSING_PROBABILITY = 0.5  # of a format with missing magnets, whose code is unknown; source: by hand


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
class Identification:
    """A tag found in a row of magnets.

    Attributes
    ----------
    members : tuple of int
        Indices in the row of the tag's magnets.
    tag : InformationTag or None
        None if magnets are missing and the format alone does not show where they were.
    wrong_way : bool
        The tag was passed against the direction of legal travel.
    missing, extra : int
        Magnets of the tag that are not in the row, and magnets between its own that are not of it.
    cost : float
        Chi-squared of its places with penalties.
    probability : float
        Against the other tags that fit.
    """

    members: tuple[int, ...]
    tag: InformationTag | None
    wrong_way: bool
    missing: int
    extra: int
    cost: float
    probability: float = 1.0


class _Row(NamedTuple):
    """Magnets of a row: chainage along its chords [m], polarity as a sign, standard error of the chainage [m]."""

    at: Floats
    signs: Floats
    std: Floats


class _TagTable(NamedTuple):
    """Tags with the same number of magnets: index among all, offsets (T, M) [m], polarities as signs (T, M)."""

    numbers: npt.NDArray[np.intp]
    offsets: Floats
    signs: Floats


class TagCandidates:
    """Tags that may be on the road, or formats of them.

    Parameters
    ----------
    tags : sequence of InformationTag
        Registered tags; the direction of travel is identified too.
    formats : sequence of TagFormat
        Used where no tag is registered.

    Raises
    ------
    InvalidParameter
        Both tags and formats were passed.
    """

    def __init__(self, tags: Sequence[InformationTag] = (), formats: Sequence[TagFormat] = ()) -> None:
        if tags and formats:
            raise InvalidParameter(
                "tags and formats exclude each other", field="formats", limit="tags or formats", cure="leave one out"
            )
        self.formats = tuple(formats)
        legal = {tag.text for tag in tags}
        self._tags = [(tag, False) for tag in tags]
        self._tags += [(tag, True) for tag in tags if tag.reversed_wrong_way().text not in legal]
        lengths = [tag.length_m for tag in tags] or [f.length_m for f in formats]
        self.longest_m = max(lengths, default=0.0)
        gaps = [g for tag in tags for g in tag.gaps_m] or [f.length_m for f in formats]
        self.longest_gap_m = max(gaps, default=0.0)
        self._tables = _tag_tables([tag.reversed_wrong_way() if wrong else tag for tag, wrong in self._tags])

    def __bool__(self) -> bool:
        return bool(self._tags or self.formats)

    def identify(self, magnets: Sequence[PlacedMagnet]) -> Identification | None:
        """The likeliest tag in a row; the earliest of equals."""
        row = _make_row(magnets)
        if self._tags:
            matches = self._match_tags(row)
        else:
            matches = [m for f in self.formats for m in _match_format(f, row)]
        if not matches:
            return None
        best = min(matches, key=lambda m: (round(m.cost, 6), m.members[0]))
        rivals = [
            m
            for m in matches
            if (m.tag, m.wrong_way) != (best.tag, best.wrong_way) and m.members[0] <= best.members[-1]
        ]
        against = sum(math.exp(-min((m.cost - best.cost) / 2, 50)) for m in rivals)
        return replace(best, probability=best.probability / (1 + against))

    def _match_tags(self, row: _Row) -> list[Identification]:
        matches = []
        for table in self._tables:
            count = table.offsets.shape[1]
            for i, j in combinations(range(len(row.at)), 2):
                for a, b in combinations(range(count), 2):
                    if count - (b - a) <= 1 + _MAX_MISSING:  # a magnet may be missing at an end
                        matches += self._match_pair((i, j), (a, b), table, row)
        return matches

    def _match_pair(
        self, pair: tuple[int, int], ends: tuple[int, int], table: _TagTable, row: _Row
    ) -> list[Identification]:
        """Tags whose magnets at the two ends are a pair of the row: they give the scale, the others must fit."""
        (i, j), (a, b) = pair, ends
        length = row.at[j] - row.at[i]
        expected = table.offsets[:, b] - table.offsets[:, a]
        scale = length / expected
        fits = abs(length - expected) < _MAX_SCALE_ERROR * expected + _MAX_LENGTH_ERROR_M
        fits &= (table.signs[:, a] == row.signs[i]) & (table.signs[:, b] == row.signs[j])
        matches = []
        for k in np.flatnonzero(fits):
            places = row.at[i] + (table.offsets[k] - table.offsets[k, a]) * scale[k]
            members, cost = _assign_magnets(places, table.signs[k], row)
            missing = members.count(-1)
            if i not in members or j not in members or missing > min(table.offsets.shape[1] - 2, _MAX_MISSING):
                continue
            own = [m for m in members if m >= 0]
            extra = own[-1] - own[0] + 1 - len(own)
            cost += _MISSING_COST * missing + _EXTRA_COST * extra + ((scale[k] - 1) / _SCALE_STD) ** 2
            tag, wrong = self._tags[int(table.numbers[k])]
            matches.append(Identification(tuple(own), tag, wrong, missing, extra, cost))
        return matches


def _tag_tables(tags: Sequence[InformationTag]) -> list[_TagTable]:
    """The tags as they are passed, in tables by their number of magnets."""
    tables = []
    for count in {tag.magnet_count for tag in tags}:
        numbers = [i for i, tag in enumerate(tags) if tag.magnet_count == count]
        offsets = np.array([tags[i].offsets_m for i in numbers])
        signs = np.array([[p.sign for p in tags[i].polarities] for i in numbers], float)
        tables.append(_TagTable(np.array(numbers), offsets, signs))
    return tables


def _make_row(magnets: Sequence[PlacedMagnet]) -> _Row:
    places = np.array([m.place_m for m in magnets])
    chords = np.linalg.norm(np.diff(places, axis=0), axis=1) if len(magnets) > 1 else np.empty(0)
    return _Row(
        np.concatenate(([0.0], np.cumsum(chords))),
        np.array([m.reading.polarity.sign for m in magnets], float),
        np.array([math.hypot(m.reading.relative_std_m, _PLACEMENT_STD_M) for m in magnets]),
    )


def _assign_magnets(places: Floats, signs: Floats, row: _Row) -> tuple[list[int], float]:
    """The row's magnet at each place of a tag, -1 for none, and chi-squared."""
    members: list[int] = []
    cost = 0.0
    for place, sign in zip(places, signs, strict=True):
        chi2 = ((row.at - place) / (_STD_FACTOR * row.std)) ** 2 + np.where(row.signs == sign, 0, np.inf)
        k = int(np.argmin(chi2))
        if chi2[k] < _MAX_PLACE_COST and k not in members:
            members.append(k)
            cost += float(chi2[k])
        else:
            members.append(-1)
    return members, cost


def _match_format(form: TagFormat, row: _Row) -> list[Identification]:
    """Tags of a format whose first and last magnet are in the row."""
    matches: list[Identification] = []
    for i, j in combinations(range(len(row.at)), 2):
        length = row.at[j] - row.at[i]
        if abs(length - form.length_m) > _MAX_SCALE_ERROR * form.length_m + _MAX_LENGTH_ERROR_M:
            continue
        between = range(i + 1, j)
        scale_cost = ((length / form.length_m - 1) / _SCALE_STD) ** 2
        missing = form.magnets - 2 - len(between)
        if missing > 0:
            cost = scale_cost + _MISSING_COST * missing
            matches.append(Identification((i, *between, j), None, False, missing, 0, cost, _MISSING_PROBABILITY))
            continue
        for middle in combinations(between, form.magnets - 2):
            match = _match_on_grid(form, row, (i, *middle, j), scale_cost)
            if match is not None:
                matches.append(match)
    return matches


def _match_on_grid(form: TagFormat, row: _Row, members: tuple[int, ...], scale_cost: float) -> Identification | None:
    """The tag of a format whose magnets are these; None if two of them are nearest to one place of the grid."""
    i, *middle, j = members
    n, length = segments_in(form.length_m, form.segment_m), row.at[j] - row.at[i]
    step = (row.at - row.at[i]) / length * n
    std = np.hypot(row.std, math.hypot(row.std[i], row.std[j]) / 2) / length * n
    positions = [round(float(step[k])) for k in middle]
    if any(not a < b for a, b in zip([0, *positions], [*positions, n], strict=True)):
        return None
    off = [float(step[k]) - p for k, p in zip(middle, positions, strict=True)]
    # the next place of the grid is the rival of each
    odds = [
        math.exp(min(((d * d) - (1 - abs(d)) ** 2) / (2 * std[k] ** 2), 0.0)) for k, d in zip(middle, off, strict=True)
    ]
    cost = scale_cost + sum((d / max(std[k], _MIN_GRID_STD)) ** 2 for k, d in zip(middle, off, strict=True))
    extra = j - i + 1 - len(members)
    polarities = tuple(Polarity.N if row.signs[k] > 0 else Polarity.S for k in members)
    tag = InformationTag(polarities, form.length_m, form.segment_m, tuple(positions))
    probability = math.prod(1 / (1 + o) for o in odds)
    return Identification(members, tag, False, 0, extra, cost + _EXTRA_COST * extra, probability)
