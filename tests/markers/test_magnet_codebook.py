"""Meanings and books: what is accepted, what is refused, and the way through JSON."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from app.errors import Conflict, InvalidParameter
from app.markers.magnet import InformationTag, parse_tag
from app.markers.magnet_design import Codebook, Meaning, MeaningKind, TagDesign

DESIGN = TagDesign(3, 2.0, 1.0)


def tag(text: str) -> InformationTag:
    found = parse_tag(text)
    assert isinstance(found, InformationTag)
    return found


PAPER_BOOK = Codebook(  # METRO section 8.3
    "arrows",
    DESIGN,
    (
        (tag("NNN_2_1_1-1"), Meaning(MeaningKind.ARROW, "straight")),
        (tag("SSS_2_1_1-1"), Meaning(MeaningKind.ARROW, "left")),
        (tag("SNS_2_1_1-1"), Meaning(MeaningKind.ARROW, "straight-right")),
    ),
)


@pytest.mark.parametrize(
    ("kind", "value", "text"),
    [
        ("bend-right", 125, "bend right 125 deg"),
        ("stop-line-ahead", 20.0, "stop line ahead 20 m"),
        ("speed-limit-mph", 30, "speed limit 30 mph"),
        ("speed-limit-kmh", 50, "speed limit 50 km/h"),
        ("arrow", "straight-left", "arrow straight-left"),
        ("notice", "bridge freezes", "bridge freezes"),
    ],
)
def test_meanings_have_a_kind_a_value_and_a_unit(kind: str, value: Any, text: str) -> None:
    assert Meaning(MeaningKind(kind), value).text == text


@pytest.mark.parametrize(
    ("kind", "value", "field"),
    [
        ("arrow", "up", "value"),
        ("arrow", 3.0, "value"),
        ("bend-left", 0.0, "value"),
        ("bend-left", 181.0, "value"),
        ("bend-left", math.nan, "value"),
        ("bend-left", "90", "value"),
        ("bend-left", True, "value"),
        ("stop-line-ahead", math.inf, "value"),
        ("speed-limit-mph", 500, "value"),
        ("notice", "", "value"),
        ("notice", "a\nb", "value"),
        ("notice", "a" * 81, "value"),
        ("notice", 5, "value"),
        ("banner", "x", "kind"),
    ],
)
def test_values_that_do_not_belong_to_the_kind_are_refused(kind: Any, value: Any, field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        Meaning(kind, value)
    assert caught.value.field == field
    assert caught.value.limit


def test_a_book_answers_both_ways() -> None:
    assert PAPER_BOOK.find_meaning(tag("SSS_2_1_1-1")) == Meaning(MeaningKind.ARROW, "left")
    assert PAPER_BOOK.find_meaning(tag("NSN_2_1_1-1")) is None
    assert PAPER_BOOK.find_tag(Meaning(MeaningKind.ARROW, "straight")) == tag("NNN_2_1_1-1")
    assert PAPER_BOOK.find_tag(Meaning(MeaningKind.ARROW, "u-turn")) is None


def test_a_book_survives_json() -> None:
    assert Codebook.from_document(json.loads(json.dumps(PAPER_BOOK.to_document()))) == PAPER_BOOK


def test_a_code_or_a_meaning_occurs_once() -> None:
    (code, meaning), (other, other_meaning), _ = PAPER_BOOK.entries
    with pytest.raises(Conflict, match="code occurs twice"):
        Codebook("x", DESIGN, ((code, meaning), (code, other_meaning)))
    with pytest.raises(Conflict, match="meaning occurs twice"):
        Codebook("x", DESIGN, ((code, meaning), (other, meaning)))


def changed(**parts: Any) -> dict[str, Any]:
    return {**PAPER_BOOK.to_document(), **parts}


@pytest.mark.parametrize(
    "document",
    [
        {},
        changed(format="waymark-codebook/2"),
        changed(design={"magnets": 3}),
        changed(design=None),
        changed(design={"magnets": 3, "length_m": "4", "segment_m": 1.0}),
        changed(design={"magnets": 3.5, "length_m": 2.0, "segment_m": 1.0}),
        changed(entries=None),
        changed(entries=[{"code": "NNN_2_1_1-1"}]),
        changed(entries=[{"code": 5, "kind": "arrow", "value": "left"}]),
        changed(entries=[{"code": "N_90", "kind": "arrow", "value": "left"}]),
        changed(entries=[{"code": "NNN_4_1_1-3", "kind": "arrow", "value": "left"}]),
        changed(entries=["NNN_2_1_1-1"]),
        changed(name=None),
        changed(name="a\tb"),
    ],
)
def test_what_is_no_book_is_refused(document: dict[str, Any]) -> None:
    with pytest.raises(InvalidParameter) as caught:
        Codebook.from_document(document)
    assert caught.value.limit


def test_a_book_holds_codes_of_its_design_only() -> None:
    with pytest.raises(InvalidParameter, match="not a code of this book"):
        Codebook("x", TagDesign(3, 2.0, 0.5), ((tag("NNN_2_1_1-1"), Meaning(MeaningKind.ARROW, "left")),))
