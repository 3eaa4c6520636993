"""Codebooks as they are stored."""

from __future__ import annotations

from datetime import datetime
from typing import Any, NamedTuple

from app.markers.magnet_codebook import CODEBOOK_FORMAT, Codebook
from app.registry.resources import Resource
from app.registry.tables import codebooks


class CodebookRow(NamedTuple):
    """A codebook; its design, rules, figures and entries are JSON."""

    id: str
    name: str
    design: Any
    rules: Any
    figures: Any
    entries: Any
    version: int
    created_at: datetime
    updated_at: datetime


CODEBOOKS = Resource("codebook", CodebookRow, codebooks)


def book_of(row: CodebookRow) -> Codebook:
    """The codebook that a row stores."""
    return Codebook.from_document(
        {"format": CODEBOOK_FORMAT, "name": row.name, "design": row.design, "entries": row.entries}
    )
