"""Codebooks as they are stored and as clients see them."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from app.encoders.magnet import CodebookRules, codebook_capacity
from app.markers.magnet import InformationTag
from app.markers.magnet_codebook import CODEBOOK_FORMAT, Codebook, Meaning
from app.markers.magnet_design import TagDesign
from app.markers.magnet_error import OdometerError, ReadingConditions, told_apart
from app.registry.codebooks import Row
from app.services.marker_documents import meaning_document

MOST_COUNTED = 200
"""Up to which the codes that fit are counted, so that no request takes long."""
MAX_BOOKS_SEARCHED = 50
"""Of an agency's codebooks the oldest, whose formats are looked for where no tag is registered."""
_ACCURACY = 0.99


def book_of(row: Row) -> Codebook:
    """The book of a row."""
    return Codebook.from_document({**row, "format": CODEBOOK_FORMAT})


def rules_of(row: Row) -> CodebookRules:
    """Rules of a book's row."""
    rules = dict(row["rules"])
    speed, clearance, odometer = (rules.pop(name) for name in ("speed_mps", "clearance_m", "odometer"))
    return CodebookRules(ReadingConditions(speed, clearance, OdometerError(**odometer)), **rules)


def book_columns(book: Codebook) -> dict[str, Any]:
    """Columns that keep a book."""
    document = book.to_document()
    return {name: document[name] for name in ("name", "design", "entries")}


def rules_columns(rules: CodebookRules) -> dict[str, Any]:
    """Rules as plain values; the decoder's errors are those of its version, not the book's."""
    at = rules.conditions
    return {
        "speed_mps": at.speed_mps,
        "clearance_m": at.clearance_m,
        "odometer": asdict(at.odometer),
        "confusion": rules.confusion,
        "wrong_way_safe": rules.wrong_way_safe,
        "survive_missing": rules.survive_missing,
    }


def design_figures(design: TagDesign, rules: CodebookRules) -> dict[str, Any]:
    """How many codes a design has, how many of them fit the rules, and how many are told apart when all are used."""
    fitting = codebook_capacity(design, rules, most=MOST_COUNTED)
    apart = told_apart(design, rules.conditions, accuracy=_ACCURACY)
    return {
        "ideal_capacity": design.ideal_capacity,
        "coupled_capacity": design.coupled_capacity,
        "wrong_way_safe_capacity": design.wrong_way_safe_capacity,
        "capacity_under_rules": fitting,
        "capacity_is_exact": fitting < MOST_COUNTED,
        "told_apart": {"accuracy": _ACCURACY, **{k: v for k, v in asdict(apart).items() if k != "capacity"}},
    }


def codebook_summary(row: Row) -> dict[str, Any]:
    """A codebook as lists show it."""
    return {
        "id": row["id"],
        "name": row["name"],
        "version": row["version"],
        "design": row["design"],
        "rules": row["rules"],
        "figures": row["figures"],
        "entry_count": len(row["entries"]),
        "created_at": row["created_at"],
        "updated_at": row["updated_at"],
    }


def codebook_document(row: Row) -> dict[str, Any]:
    """A codebook with its entries."""
    return {**codebook_summary(row), "entries": [entry_document(*entry) for entry in book_of(row).entries]}


def entry_document(tag: InformationTag, meaning: Meaning) -> dict[str, Any]:
    """A code and its meaning."""
    return {"code": tag.text, "tuple": tag.tuple_text, "meaning": meaning_document(meaning)}
