"""Assignment of codes to meanings, far enough apart that a decoder does not take one for another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field, with_config

from app.errors import Conflict, InvalidParameter
from app.inputs import INPUT, Flag, Number
from app.markers.magnet import InformationTag, Polarity
from app.markers.magnet_design import (
    MAX_PLACEMENTS,
    Codebook,
    Meaning,
    OdometerError,
    ReadingConditions,
    TagDesign,
    covariance_of,
    placements_of,
    separation_for,
)
from app.values import Floats

_Pattern = tuple[Polarity, ...]


class CodebookFull(Conflict):
    """No further code keeps the distance to the others that the rules ask for."""


@with_config(INPUT)
@dataclass(frozen=True, slots=True)
class CodebookRules:
    """How far apart codes are kept: for the fastest and highest vehicle to be served."""

    speed_m_s: Annotated[Number, Field(description="Speed at which codes must be read, 0.5 to 70. [m/s]")] = 13.4
    clearance_m: Annotated[
        Number,
        Field(
            description="Distance from the sensors to the magnets at which codes must be read: the vehicle's clearance "
            "and the magnets' depth, 0.05 to 1. [m]"
        ),
    ] = 0.30
    odometer: OdometerError = field(default_factory=OdometerError)
    # the polarities being read right
    confusion: Annotated[
        Number, Field(ge=1e-12, lt=0.5, description="Most probability with which a code is taken for another.")
    ] = 0.001
    # nor too near to it: every reading shows the direction
    wrong_way_safe: Annotated[Flag, Field(description="No code is another's reverse, nor its own.")] = False
    survive_missing: Annotated[
        Flag, Field(description="A code is recognised although one magnet is missed; from M = 4 on.")
    ] = False

    def __post_init__(self) -> None:
        """Raises InvalidParameter if a value is outside its limits."""
        _ = self.conditions
        separation_for(self.confusion)

    @property
    def conditions(self) -> ReadingConditions:
        """The worst conditions under which the codes must be read."""
        return ReadingConditions(self.speed_m_s, self.clearance_m, self.odometer)


def allocate_codes(book: Codebook, meanings: Sequence[Meaning], rules: CodebookRules) -> Codebook:
    """Assign codes to further meanings; codes assigned before stay as they are.

    Parameters
    ----------
    book : Codebook
        May be empty.
    meanings : sequence of Meaning
        New ones.

    Returns
    -------
    Codebook
        With the meanings added in their order. The same book, meanings and rules always give the same codes. Of
        designs with more than 4000 placements, that many at equal ranks are assigned.

    Raises
    ------
    CodebookFull
        Not all of them fit; the message says how many were asked for, how many fit, and what limits them.
    Conflict
        A meaning is in the book already, or occurs twice.
    InvalidParameter
        The rules cannot be met by any tag of this design.
    """
    _check_rules(book.design, rules)
    space = _CodeSpace(book.design, rules)
    for tag in book.tags:
        space.take(tag)
    free = space.list_free()
    assigned: list[tuple[InformationTag, Meaning]] = []
    for meaning in meanings:
        chosen = next(free, None)
        if chosen is None:
            raise _full(book, len(meanings), len(assigned), rules)
        space.take(chosen)
        assigned.append((chosen, meaning))
    return Codebook(book.name, book.design, (*book.entries, *assigned))


def _check_rules(design: TagDesign, rules: CodebookRules) -> None:
    if rules.survive_missing and design.magnets < 4:
        raise InvalidParameter(
            f"tags of {design.magnets} magnets do not survive the loss of one: two magnets have no ratio",
            field="survive_missing",
            limit="4 magnets or more",
            cure="choose a design of 4 to 7 magnets",
        )


def codebook_capacity(design: TagDesign, rules: CodebookRules, *, max_count: int = 100_000) -> int:
    """Codes that an empty book of a design takes under these rules, counted up to `max_count`; raises as below."""
    return len(fitting_codes(design, rules, max_count=max_count))


def fitting_codes(design: TagDesign, rules: CodebookRules, *, max_count: int) -> list[InformationTag]:
    """The codes that an empty book of a design takes under these rules, in the order in which they are assigned.

    Parameters
    ----------
    max_count : int
        Codes at most.

    Raises
    ------
    InvalidParameter
        The rules cannot be met by any tag of this design.
    """
    _check_rules(design, rules)
    space = _CodeSpace(design, rules)
    found: list[InformationTag] = []
    for tag in space.list_free():
        space.take(tag)
        found.append(tag)
        if len(found) == max_count:
            break
    return found


def list_conflicts(book: Codebook, rules: CodebookRules) -> list[tuple[InformationTag, InformationTag]]:
    """Pairs of codes of a book that stand nearer than the rules ask for; a tag with itself if it is its own reverse.

    For books that were made by other means, or for stricter rules.
    """
    pairs = _CodeSpace(book.design, rules).list_near_pairs(book.tags)
    return [(book.tags[later], book.tags[earlier]) for later, earlier in pairs]


def _full(book: Codebook, asked: int, fit: int, rules: CodebookRules) -> CodebookFull:
    design, at = book.design, rules.conditions
    safe = design.wrong_way_safe_capacity if rules.wrong_way_safe else design.coupled_capacity
    extra = [
        name
        for name, on in (("wrong-way safe", rules.wrong_way_safe), ("one magnet may be missed", rules.survive_missing))
        if on
    ]
    rule = ", ".join(
        (f"confusion at most {rules.confusion:g} at {at.speed_m_s:g} m/s and {at.clearance_m:g} m clearance", *extra)
    )
    return CodebookFull(
        f"{asked} codes were asked for, {fit} more fit beside the {len(book.entries)} in the book",
        field="meanings",
        limit=f"{rule}; the design itself has {safe} codes of {design.magnets} magnets on {design.length_m:g} m "
        f"in segments of {design.segment_m:g} m",
        cure="take more magnets, a longer tag, a lower speed or clearance, or fewer meanings",
    )


class _Placements(NamedTuple):
    """Placements of a design's magnets, and how they are read."""

    u: Floats  # (K, M - 2), middle magnets' places over the tag's length
    inverse: Floats  # (K, M - 2, M - 2), of the covariance of u


class _CodeSpace:
    """The codes of a design, and which of them are still free.

    Codes are pairs of polarities and a placement. Only codes with the same polarities can be confused, so each
    pattern of polarities has its own row of placements that are blocked.
    """

    def __init__(self, design: TagDesign, rules: CodebookRules) -> None:
        self._design, self._rules = design, rules
        self._limit = separation_for(rules.confusion)
        self._steps = placements_of(design, MAX_PLACEMENTS)
        gaps_m = self._steps.astype(np.float64) * design.segment_m
        self._all = self._placements(gaps_m)
        self._blocked: dict[_Pattern, npt.NDArray[np.bool_]] = {}
        self._near_rows: dict[tuple[int, ...], npt.NDArray[np.bool_]] = {}
        self._lost_rows: dict[tuple[int, ...], list[npt.NDArray[np.bool_]]] = {}
        missed = range(design.magnets) if rules.survive_missing else ()
        self._lost = [self._placements(_without(gaps_m, i)) for i in missed]

    def take(self, tag: InformationTag) -> None:
        """Block what is too near to a tag and, on a wrong-way-safe book, to its reverse."""
        for seen in self._seen_as(tag):
            row = self._row(seen.polarities)
            row |= self._near_placements(seen)
            for pattern, gaps_m in self._remains(seen):
                self._block_remains(pattern, gaps_m)

    def list_free(self) -> Iterator[InformationTag]:
        """Free codes, by placement and then by polarities; what is taken meanwhile is left out."""
        for k in range(len(self._steps)):
            steps = [int(s) for s in self._steps[k]]
            for polarities in product(Polarity, repeat=self._design.magnets):
                if self._row(polarities)[k]:
                    continue
                tag = InformationTag.from_gaps(polarities, self._design.segment_m, steps)
                own_reverse = self._rules.wrong_way_safe and self.list_near_pairs((tag,))
                if not own_reverse:
                    yield tag

    def list_near_pairs(self, tags: Sequence[InformationTag]) -> list[tuple[int, int]]:
        """Indices (later, earlier) of tags that may be confused; twice the same where a tag reads as its reverse."""
        pairs: set[tuple[int, int]] = set()
        for views in (_whole, self._remains):
            by_pattern: dict[_Pattern, list[tuple[int, Floats]]] = {}
            for i, tag in enumerate(tags):
                for pattern, gaps_m in views(tag):
                    by_pattern.setdefault(pattern, []).append((i, gaps_m))
            for i, tag in enumerate(tags):
                for way, seen in enumerate(self._seen_as(tag)):
                    for pattern, gaps_m in views(seen):
                        rivals = by_pattern.get(pattern, [])
                        near = self._near(gaps_m, self._placements(np.array([g for _, g in rivals]))) if rivals else ()
                        pairs |= {
                            (max(i, k), min(i, k))
                            for (k, _), hit in zip(rivals, near, strict=True)
                            if hit and (k != i or way == 1)
                        }
        return sorted(pairs)

    def _seen_as(self, tag: InformationTag) -> tuple[InformationTag, ...]:
        return (tag, tag.reversed_wrong_way()) if self._rules.wrong_way_safe else (tag,)

    def _row(self, pattern: _Pattern) -> npt.NDArray[np.bool_]:
        if pattern not in self._blocked:
            self._blocked[pattern] = np.zeros(len(self._steps), dtype=bool)
        return self._blocked[pattern]

    def _near_placements(self, tag: InformationTag) -> npt.NDArray[np.bool_]:
        """Which placements are too near to a tag's, shape (K,); the same for all polarities, so kept."""
        if tag.gap_steps not in self._near_rows:
            self._near_rows[tag.gap_steps] = self._near(np.array(tag.gaps_m), self._all)
        return self._near_rows[tag.gap_steps]

    def _near(self, gaps_m: Floats, others: _Placements) -> npt.NDArray[np.bool_]:
        """Which of K placements are nearer to a code's than the rules allow, as seen from either side."""
        if len(gaps_m) < 2:  # two magnets have no ratio
            return np.ones(len(others.u), dtype=bool)
        own = self._placements(gaps_m[None])
        delta = others.u - own.u
        from_here = np.einsum("kj,kj->k", delta @ own.inverse[0], delta)  # squared separations
        from_there = np.einsum("kj,kj->k", np.einsum("ki,kij->kj", delta, others.inverse), delta)
        near: npt.NDArray[np.bool_] = np.minimum(from_here, from_there) < self._limit**2
        return near

    def _placements(self, gaps_m: Floats) -> _Placements:
        """Placements of gaps of shape (K, M - 1)."""
        if gaps_m.shape[1] < 2:
            return _Placements(np.empty((len(gaps_m), 0)), np.empty((len(gaps_m), 0, 0)))
        inverse = np.linalg.inv(covariance_of(gaps_m, self._rules.conditions))
        return _Placements(_places(gaps_m), np.asarray(inverse, dtype=np.float64))

    def _remains(self, tag: InformationTag) -> Iterator[tuple[_Pattern, Floats]]:
        """What is left of a tag when one magnet is missed: polarities and gaps, for each of its magnets."""
        if not self._rules.survive_missing:
            return
        gaps_m = np.array([tag.gaps_m])
        for i in range(tag.magnet_count):
            yield tag.polarities[:i] + tag.polarities[i + 1 :], _without(gaps_m, i)[0]

    def _block_remains(self, pattern: _Pattern, gaps_m: Floats) -> None:
        """Block every code that, one magnet missed, is too near to what is left of a code."""
        key = tuple(np.round(gaps_m / self._design.segment_m).astype(int).tolist())
        if key not in self._lost_rows:
            self._lost_rows[key] = [self._near(gaps_m, lost) for lost in self._lost]
        for i, near in enumerate(self._lost_rows[key]):
            for polarity in Polarity:
                row = self._row((*pattern[:i], polarity, *pattern[i:]))
                row |= near


def _whole(tag: InformationTag) -> Iterator[tuple[_Pattern, Floats]]:
    """A tag with none of its magnets missed: polarities and gaps."""
    yield tag.polarities, np.array(tag.gaps_m)


def _without(gaps_m: Floats, missed: int) -> Floats:
    """Gaps, shape (K, M - 2), of tags whose gaps are (K, M - 1), when one of their magnets is missed. [m]"""
    offsets_m = np.concatenate([np.zeros((len(gaps_m), 1)), np.cumsum(gaps_m, axis=1)], axis=1)
    return np.diff(np.delete(offsets_m, missed, axis=1), axis=1)


def _places(gaps_m: Floats) -> Floats:
    """Middle magnets' places over the tag's length, shape (K, M - 2), of gaps of shape (K, M - 1)."""
    places: Floats = np.cumsum(gaps_m, axis=1)
    return places[:, :-1] / places[:, -1:]
