"""Magnet tags as values: the paper's examples, text form, limits and the wrong way."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.errors import CodeMismatch, InvalidParameter
from app.markers.magnet import (
    InformationTag,
    LineStyle,
    LineTag,
    Magnet,
    Orientation,
    Polarity,
    parse_tag,
)

N, S = Polarity.N, Polarity.S


def test_the_papers_tag_has_its_middle_magnet_after_one_metre() -> None:
    tag = InformationTag((N, N, N), 4, 1, (1,))  # {"NNN", 0, 3, 4, 1, 3/1}: r = d2/d1, figure 3b
    assert tag.magnets == tuple(Magnet(x, 0.0, N, Orientation.FORWARD) for x in (0.0, 1.0, 4.0))
    assert tag.gaps_m == (1.0, 3.0)
    assert tag.ratios == (3.0,)
    assert tag.text == "NNN_4_1_1-3"
    assert tag.tuple_text == "{NNN, 0°, 3, 4, 1, 3/1}"
    assert [InformationTag("NNN", 4, 1, (p,)).ratios for p in (1, 2, 3)] == [(3.0,), (1.0,), (1 / 3,)]


def test_more_than_three_magnets_have_more_ratios_and_two_have_none() -> None:
    tag = InformationTag.from_gaps("NSNSN", 0.5, [2, 1, 4, 1])
    assert tag.offsets_m == (0.0, 1.0, 1.5, 3.5, 4.0)
    assert tag.ratios == (0.5, 2.0, 0.5)
    assert InformationTag.from_gaps("NS", 1.0, [3]).ratios == ()


def test_line_tags_are_upright_solid_or_dashed() -> None:
    assert (LineTag(N).style, LineTag(S).style) == (LineStyle.SOLID, LineStyle.DASHED)
    assert [LineTag.of_style(style).text for style in LineStyle] == ["N_90", "S_90"]
    (magnet,) = LineTag(S).magnets
    assert (magnet.orientation.phi_deg, magnet.polarity.sign) == (90, -1)
    assert LineTag(S).reversed_wrong_way() == LineTag(S)


def test_the_papers_arrows_are_each_other_driven_the_wrong_way() -> None:
    straight, left = parse_tag("NNN_2_1_1-1"), parse_tag("SSS_2_1_1-1")  # section 8.3
    assert straight.reversed_wrong_way() == left
    assert parse_tag("SNS_4_1_1-3").reversed_wrong_way() == parse_tag("NSN_4_1_3-1")


@st.composite
def tags(draw: st.DrawFn) -> InformationTag:
    magnets = draw(st.integers(2, 7))
    segment_m = draw(st.sampled_from([0.02, 0.05, 0.1, 0.1524, 0.3, 0.5, 0.7, 1.0]))
    gaps = draw(st.lists(st.integers(1, 12), min_size=magnets - 1, max_size=magnets - 1))
    while not 0.5 <= sum(gaps) * segment_m <= 30:
        gaps = [2 * g for g in gaps] if sum(gaps) * segment_m < 0.5 else [max(g // 2, 1) for g in gaps]
    return InformationTag.from_gaps(
        draw(st.lists(st.sampled_from(Polarity), min_size=magnets, max_size=magnets)), segment_m, gaps
    )


@given(tags())
@settings(max_examples=200, deadline=None)
def test_tags_survive_text_and_turning_round(tag: InformationTag) -> None:
    assert parse_tag(tag.text) == tag
    back = tag.reversed_wrong_way()
    assert back.reversed_wrong_way() == tag
    assert back.gap_steps == tag.gap_steps[::-1]
    assert all(a is not b for a, b in zip(back.polarities, reversed(tag.polarities), strict=True))
    for i, gap_m in enumerate(tag.gaps_m):
        assert gap_m == pytest.approx(tag.gap_steps[i] * tag.segment_m, abs=1e-12)
        assert tag.offsets_m[i + 1] - tag.offsets_m[i] == pytest.approx(gap_m, abs=1e-9)
    for i, ratio in enumerate(tag.ratios):
        assert ratio == pytest.approx(tag.gaps_m[i + 1] / tag.gaps_m[0])


def test_lengths_that_floats_cannot_hold_compare_equal() -> None:
    assert InformationTag("NNN", 0.1 * 7, 0.1, (3,)) == InformationTag("NNN", 0.7, 0.1, (3,))


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: InformationTag("N", 4, 1, ()), "polarities"),
        (lambda: InformationTag("NNNNNNNN", 8, 1, (1, 2, 3, 4, 5, 6)), "polarities"),
        (lambda: InformationTag("NXN", 4, 1, (1,)), "polarities"),
        (lambda: InformationTag("nnn", 4, 1, (1,)), "polarities"),
        (lambda: InformationTag("NNN", 4, 1, ()), "positions"),
        (lambda: InformationTag("NNN", 4, 1, (0,)), "positions"),
        (lambda: InformationTag("NNN", 4, 1, (4,)), "positions"),
        (lambda: InformationTag("NNN", 4, 1, (1.0,)), "positions"),  # type: ignore[arg-type]
        (lambda: InformationTag("NNNN", 4, 1, (2, 2)), "positions"),
        (lambda: InformationTag("NNNN", 4, 1, (3, 1)), "positions"),
        (lambda: InformationTag("NNN", math.nan, 1, (1,)), "length_m"),
        (lambda: InformationTag("NNN", 0.4, 0.1, (1,)), "length_m"),
        (lambda: InformationTag("NNN", 4, 0.01, (1,)), "segment_m"),
        (lambda: InformationTag("NNN", 4, 0.3, (1,)), "length_m"),
        (lambda: InformationTag.from_gaps("NNN", 1.0, []), "gap_steps"),
        (lambda: InformationTag.from_gaps("NNN", 1.0, [0, 4]), "gap_steps"),
        (lambda: InformationTag.from_gaps("NNN", math.inf, [1, 3]), "segment_m"),
        (lambda: LineTag("up"), "polarities"),  # type: ignore[arg-type]
    ],
)
def test_what_is_no_tag_is_refused_by_name(make: object, field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        make()  # type: ignore[operator]
    assert caught.value.field == field
    assert caught.value.limit


@pytest.mark.parametrize(
    "text",
    [
        "", "NNN", "NNN_4_1", "NNN_4_1_", "NNN_4_1_1-2", "NNN_4.0_1_1-3", "NNN_04_1_1-3", "NNN_4_1_01-3", "nnn_4_1_1-3",
        "NNN_4_1_1-3 ", "NNN_4_1_1-3\n", "NNN_4_1_1-1-2", "NNN_1e1_1_1-9", "NNN_4_0_1-3", "٠NN_4_1_1-3", "NNN_٤_1_1-3",
        "N_0", "X_90", "N_90\n", "N" * 10000, "NNN_4_1_" + "1-" * 500 + "1", "=cmd",
    ],
)  # fmt: skip
def test_what_is_no_canonical_text_is_refused(text: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        parse_tag(text)
    assert caught.value.limit


def test_the_mismatch_of_a_text_says_what_to_correct() -> None:
    with pytest.raises(CodeMismatch, match="add up to 3 segments, its length is 4"):
        parse_tag("NNN_4_1_1-2")
    with pytest.raises(CodeMismatch, match="is written NNN_4_1_1-3"):
        parse_tag("NNN_4.0_1_1-3")
