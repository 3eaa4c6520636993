"""Codes are given so that drawn readings are not mistaken, and given codes stay."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.encoders.magnet.codebook import (
    CodebookFull,
    CodebookRules,
    allocate_codes,
    codebook_capacity,
    list_conflicts,
)
from app.errors import Conflict, InvalidParameter
from app.markers.magnet import InformationTag, parse_tag
from app.markers.magnet_design import (
    Codebook,
    MagnetErrorModel,
    Meaning,
    MeaningKind,
    OdometerError,
    ReadingConditions,
    TagDesign,
)

FINE = TagDesign(3, 4.0, 0.05)
HARD = ReadingConditions(20.0, 0.35)


def notices(count: int, start: int = 0) -> list[Meaning]:
    return [Meaning(MeaningKind.NOTICE, f"notice {i}") for i in range(start, start + count)]


def rules_at(at: ReadingConditions, confusion: float = 0.001, **flags: bool) -> CodebookRules:
    return CodebookRules(at.speed_m_s, at.clearance_m, at.odometer, confusion, **flags)


def book_of(design: TagDesign, count: int, rules: CodebookRules) -> Codebook:
    return allocate_codes(Codebook("book", design), notices(count), rules)


def read_tag(tag: InformationTag, at: ReadingConditions, count: int, seed: int) -> np.ndarray:
    """Middle magnets' places over the length as they are read, shape (count, M - 2)."""
    rng = np.random.default_rng(seed)
    gaps = np.array(tag.gaps_m)
    places = np.array(tag.offsets_m) + rng.normal(
        0, at.model.position_std_m(at.speed_m_s, at.clearance_m), (count, tag.magnet_count)
    )
    read = np.diff(places) + rng.normal(0, at.odometer.gap_std_m(gaps, at.speed_m_s), (count, len(gaps)))
    return np.cumsum(read, axis=1)[:, :-1] / read.sum(axis=1)[:, None]


def mistaken(book: Codebook, at: ReadingConditions, count: int = 4000) -> float:
    """Largest share of readings of a code that are nearer to another code with its polarities."""
    worst = 0.0
    for i, tag in enumerate(book.tags):
        rivals = [other for other in book.tags if other.polarities == tag.polarities]
        u = np.array([np.cumsum(t.gaps_m)[:-1] / t.length_m for t in rivals])
        read = read_tag(tag, at, count, seed=i)
        nearest = np.linalg.norm(read[:, None] - u[None], axis=2).argmin(axis=1)
        worst = max(worst, float(np.mean(nearest != rivals.index(tag))))
    return worst


def test_codes_of_a_full_book_are_not_mistaken() -> None:
    rules = rules_at(HARD, confusion=0.001)
    count = codebook_capacity(FINE, rules)
    assert 8 < count < FINE.coupled_capacity
    book = book_of(FINE, count, rules)
    assert len(set(book.tags)) == count
    assert mistaken(book, HARD) < 0.004  # two neighbours at 0.001 each, and the luck of 4000 draws
    assert list_conflicts(book, rules) == []
    every = Codebook("all", FINE, tuple(zip(FINE.list_codes(), notices(FINE.coupled_capacity), strict=True)))
    assert mistaken(every, HARD, 300) > 0.2  # without the rules they would be


def test_easier_conditions_and_laxer_rules_hold_more_codes() -> None:
    strict = codebook_capacity(FINE, rules_at(HARD, 0.0001))
    lax = codebook_capacity(FINE, rules_at(HARD, 0.01))
    easy = codebook_capacity(FINE, rules_at(ReadingConditions(13.4, 0.16), 0.01))
    assert strict < lax < easy == FINE.coupled_capacity


@given(
    st.integers(2, 7),
    st.sampled_from([(3.0, 0.25), (3.5, 0.1), (4.0, 0.5)]),
    st.booleans(),
    st.sampled_from([0.16, 0.30, 0.40]),
    st.integers(1, 12),
)
@settings(max_examples=30, deadline=None)
def test_books_keep_their_rules(
    magnets: int, size: tuple[float, float], wrong_way: bool, clearance_m: float, asked: int
) -> None:
    design = TagDesign(magnets, *size)
    rules = rules_at(ReadingConditions(13.4, clearance_m), 0.001, wrong_way_safe=wrong_way)
    capacity = codebook_capacity(design, rules, max_count=asked)
    book = book_of(design, min(asked, capacity), rules)
    assert all(design.admits(tag) for tag in book.tags)
    assert list_conflicts(book, rules) == []
    assert book_of(design, min(asked, capacity), rules) == book
    if wrong_way:
        assert not {tag.reversed_wrong_way() for tag in book.tags} & set(book.tags)
    if capacity < asked:
        with pytest.raises(CodebookFull):
            book_of(design, asked, rules)


def test_a_wrong_way_safe_book_takes_half_of_an_odd_design() -> None:
    design = TagDesign(3, 4.0, 0.5)
    at = ReadingConditions(13.4, 0.16)
    assert codebook_capacity(design, rules_at(at)) == design.coupled_capacity == 56
    assert codebook_capacity(design, rules_at(at, wrong_way_safe=True)) == design.wrong_way_safe_capacity == 28
    four = TagDesign(4, 3.0, 0.5)
    assert four.wrong_way_safe_capacity == (four.coupled_capacity - four.own_reverses) // 2
    assert codebook_capacity(four, rules_at(at, wrong_way_safe=True)) == four.wrong_way_safe_capacity


def test_the_papers_arrows_are_named_as_a_wrong_way_pair() -> None:
    straight, left, both = (parse_tag(t) for t in ("NNN_2_1_1-1", "SSS_2_1_1-1", "SNS_2_1_1-1"))
    assert isinstance(straight, InformationTag)
    assert isinstance(left, InformationTag)
    assert isinstance(both, InformationTag)
    book = Codebook("arrows", TagDesign(3, 2.0, 1.0), tuple(zip((straight, left, both), notices(3), strict=True)))
    at = ReadingConditions(13.4, 0.16)
    assert list_conflicts(book, rules_at(at)) == []
    assert list_conflicts(book, rules_at(at, wrong_way_safe=True)) == [(left, straight)]


@pytest.mark.parametrize("wrong_way", [False, True])
@pytest.mark.parametrize("design", [TagDesign(4, 3.0, 0.25), TagDesign(5, 4.0, 0.25)])
def test_a_lost_magnet_leaves_the_code_readable(design: TagDesign, wrong_way: bool) -> None:
    at = ReadingConditions(13.4, 0.25)
    rules = rules_at(at, wrong_way_safe=wrong_way, survive_missing=True)
    book = book_of(design, 12, rules)
    seen: list[tuple[int, tuple[str, ...], np.ndarray]] = []
    for i, tag in enumerate(book.tags):
        for way in (tag, tag.reversed_wrong_way())[: 2 if wrong_way else 1]:
            for lost in range(design.magnets):
                places = np.delete(np.array(way.offsets_m), lost)
                u = (places[1:-1] - places[0]) / (places[-1] - places[0])
                seen.append((2 * i + (way != tag), way.polarities[:lost] + way.polarities[lost + 1 :], u))
    for (i, pattern, u), (k, other, v) in itertools.combinations(seen, 2):
        if pattern == other and i != k:
            assert np.abs(u - v).max() > 0.01  # about six standard deviations
    assert list_conflicts(book, rules) == []
    plain = book_of(design, 12, rules_at(at, wrong_way_safe=wrong_way))
    assert list_conflicts(plain, rules)  # codes given without the rule do not keep it


def test_three_magnets_do_not_survive_the_loss_of_one() -> None:
    with pytest.raises(InvalidParameter, match="two magnets have no ratio") as caught:
        book_of(FINE, 1, CodebookRules(survive_missing=True))
    assert caught.value.field == "survive_missing"


def test_adding_keeps_what_was_given() -> None:
    rules = rules_at(HARD, wrong_way_safe=True)
    first = book_of(FINE, 5, rules)
    second = allocate_codes(first, notices(6, start=5), rules)
    assert second.entries[:5] == first.entries
    assert len(second.entries) == 11
    assert list_conflicts(second, rules) == []


def test_codes_given_elsewhere_are_kept_clear_of() -> None:
    given_tag = parse_tag("NNN_4_0.05_33-47")
    assert isinstance(given_tag, InformationTag)
    rules = rules_at(HARD)
    book = Codebook("old", FINE, ((given_tag, Meaning(MeaningKind.ARROW, "left")),))
    full = allocate_codes(book, notices(40), rules)
    assert full.tags[0] == given_tag
    assert list_conflicts(full, rules) == []


def test_a_full_book_says_how_many_fit_and_why() -> None:
    rules = rules_at(HARD, wrong_way_safe=True)
    fits = codebook_capacity(FINE, rules)
    book = book_of(FINE, fits - 2, rules)
    with pytest.raises(CodebookFull, match=rf"5 codes were asked for, 2 more fit beside the {fits - 2}") as caught:
        allocate_codes(book, notices(5, start=1000), rules)
    assert "confusion at most 0.001 at 20 m/s and 0.35 m" in str(caught.value.limit)
    assert "wrong-way safe" in str(caught.value.limit)
    assert "244 codes" in str(caught.value.limit)
    assert caught.value.cure


def test_a_design_without_room_is_full_from_the_start() -> None:
    with pytest.raises(CodebookFull, match="1 codes were asked for, 0 more fit"):
        book_of(TagDesign(7, 2.0, 0.5), 1, CodebookRules())


def test_a_meaning_gets_one_code() -> None:
    rules = CodebookRules()
    with pytest.raises(Conflict, match="meaning occurs twice"):
        allocate_codes(Codebook("x", FINE), [notices(1)[0]] * 2, rules)


def test_a_large_design_gives_a_thousand_codes() -> None:
    design = TagDesign(7, 6.0, 0.1)
    rules = rules_at(ReadingConditions(20.0, 0.30), wrong_way_safe=True)
    book = book_of(design, 1000, rules)
    assert len(book.entries) == 1000
    assert not {tag.reversed_wrong_way() for tag in book.tags} & set(book.tags)


def test_a_poor_odometer_costs_codes() -> None:
    good = rules_at(ReadingConditions(13.4, 0.25))
    poor = rules_at(ReadingConditions(13.4, 0.25, OdometerError(drift=0.03), MagnetErrorModel()))
    assert codebook_capacity(FINE, poor) < codebook_capacity(FINE, good)


def test_the_documented_codes_of_longer_tags_are_those_of_the_error_model() -> None:
    text = (Path(__file__).parents[3] / "docs" / "plans.md").read_text("utf-8")
    rows = re.findall(r"^\| (\d+) m, ([\d.]+) m[^|]*\|\s*(\d+) \|(.+)\|$", text, re.MULTILINE)
    assert len(rows) == 5
    for length, segment, codes, cells in rows:
        design = TagDesign(3, float(length), float(segment))
        assert design.coupled_capacity == int(codes)
        for distance_m, cell in zip((0.3, 0.4, 0.5), cells.split("|"), strict=True):
            rules = [CodebookRules(speed_m_s=kmh / 3.6, clearance_m=distance_m) for kmh in (50, 80, 110, 130)]
            assert [codebook_capacity(design, one) for one in rules] == [int(count) for count in cell.split(",")]
