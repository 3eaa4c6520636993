"""Codebooks as they are stored and as clients see them."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from typing_extensions import TypedDict

from app.encoders.magnet import CodebookRules, fitting_codes
from app.errors import naming
from app.families.magnet.documents import MeaningDocument, meaning_document
from app.markers.magnet import InformationTag
from app.markers.magnet_codebook import Codebook, Meaning
from app.markers.magnet_design import TagDesign
from app.markers.magnet_error import OdometerError, ReadingConditions, distinguishable
from app.registry.codebooks import CodebookRow, book_of
from app.services.documents import document_of


class DesignDocument(TypedDict):
    """Design of a codebook."""

    magnets: int
    length_m: float
    segment_m: float
    min_gap_m: float


class OdometerDocument(TypedDict):
    """Errors of the vehicle's speed."""

    quantum_mps: float
    rate_hz: float
    drift: float


class RulesDocument(TypedDict):
    """Rules of a codebook."""

    speed_mps: float
    clearance_m: float
    odometer: OdometerDocument
    confusion: float
    wrong_way_safe: bool
    survive_missing: bool


class DistinguishableDocument(TypedDict):
    """How many codes are read right with probability `accuracy` when all of the design are in use."""

    accuracy: float
    share: float
    codes: int
    mean_accuracy: float
    worst_accuracy: float


class FiguresDocument(TypedDict):
    """Capacities: by equation 2, with coupling, wrong-way safe, and under the rules, counted up to 200 only."""

    ideal_capacity: int
    coupled_capacity: int
    wrong_way_safe_capacity: int
    capacity_under_rules: int
    capacity_is_exact: bool
    distinguishable: DistinguishableDocument


class CodebookSummary(TypedDict):
    """A codebook in a list."""

    id: str
    name: str
    version: int
    design: DesignDocument
    rules: RulesDocument
    figures: FiguresDocument
    entry_count: int
    created_at: datetime
    updated_at: datetime


class EntryDocument(TypedDict):
    """A code and its meaning."""

    code: str
    tuple: str
    meaning: MeaningDocument


class CodebookDocument(CodebookSummary):
    """A codebook with its entries, in the order in which they were added."""

    entries: list[EntryDocument]


class CodeDocument(TypedDict):
    """A code."""

    code: str
    tuple: str


class CodebookDraftDocument(TypedDict):
    """A codebook that is not made yet. `codes` are those that fit, in the order of their assignment, up to 200."""

    design: DesignDocument
    rules: RulesDocument
    figures: FiguresDocument
    codes: list[CodeDocument]


class CodebookPage(TypedDict):
    """A page of codebooks; the Link header leads to the next one."""

    items: list[CodebookSummary]


class EntryList(TypedDict):
    """Entries of a codebook."""

    items: list[EntryDocument]


MAX_COUNTED = 200
"""Up to which the codes that fit are counted, so that no request takes long."""
MAX_BOOKS_SEARCHED = 50
"""Of an agency's codebooks the oldest, whose formats are looked for where no tag is registered."""
_ACCURACY = 0.99


def rules_of(row: CodebookRow) -> CodebookRules:
    """Rules of a book's row."""
    rules = dict(row.rules)
    speed, clearance, odometer = (rules.pop(name) for name in ("speed_mps", "clearance_m", "odometer"))
    return CodebookRules(ReadingConditions(speed, clearance, OdometerError(**odometer)), **rules)


def book_columns(book: Codebook) -> dict[str, Any]:
    """Columns that keep a book."""
    document = book.to_document()
    return {name: document[name] for name in ("name", "design", "entries")}


def rules_columns(rules: CodebookRules) -> RulesDocument:
    """Rules as plain values; the decoder's errors are those of its version, not the book's."""
    at = rules.conditions
    return {
        "speed_mps": at.speed_mps,
        "clearance_m": at.clearance_m,
        "odometer": document_of(OdometerDocument, at.odometer),
        "confusion": rules.confusion,
        "wrong_way_safe": rules.wrong_way_safe,
        "survive_missing": rules.survive_missing,
    }


def codebook_draft(design: TagDesign, rules: CodebookRules) -> CodebookDraftDocument:
    """A codebook that is not made yet, with the codes that its first meanings would get.

    Raises
    ------
    InvalidParameter
        The rules cannot be met by any tag of this design.
    """
    with naming("rules"):
        codes = fitting_codes(design, rules, max_count=MAX_COUNTED)
    return {
        "design": document_of(DesignDocument, design),
        "rules": rules_columns(rules),
        "figures": _figures(design, rules, len(codes)),
        "codes": [{"code": tag.text, "tuple": tag.tuple_text} for tag in codes],
    }


def design_figures(design: TagDesign, rules: CodebookRules) -> FiguresDocument:
    """How many codes a design has, how many fit the rules, and how many can be distinguished when all are used."""
    return _figures(design, rules, len(fitting_codes(design, rules, max_count=MAX_COUNTED)))


def _figures(design: TagDesign, rules: CodebookRules, fitting: int) -> FiguresDocument:
    apart = distinguishable(design, rules.conditions, accuracy=_ACCURACY)
    return {
        "ideal_capacity": design.ideal_capacity,
        "coupled_capacity": design.coupled_capacity,
        "wrong_way_safe_capacity": design.wrong_way_safe_capacity,
        "capacity_under_rules": fitting,
        "capacity_is_exact": fitting < MAX_COUNTED,
        "distinguishable": document_of(DistinguishableDocument, apart, accuracy=_ACCURACY),
    }


def codebook_summary(row: CodebookRow) -> CodebookSummary:
    """A codebook as lists show it."""
    return document_of(CodebookSummary, row, entry_count=len(row.entries))


def codebook_document(row: CodebookRow) -> CodebookDocument:
    """A codebook with its entries."""
    return {**codebook_summary(row), "entries": [entry_document(*entry) for entry in book_of(row).entries]}


def entry_document(tag: InformationTag, meaning: Meaning) -> EntryDocument:
    """A code and its meaning."""
    return {"code": tag.text, "tuple": tag.tuple_text, "meaning": meaning_document(meaning)}
