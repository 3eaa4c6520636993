"""Codebooks: which codes an agency's information tags carry, and what they mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime, timedelta

from typing_extensions import TypedDict

from app.encoders.magnet import CodebookRules, allocate_codes, fitting_codes
from app.errors import Conflict, InvalidParameter, NotFound, StaleVersion, Unavailable, WaymarkError, naming
from app.families.magnet.documents import MeaningDocument, meaning_document
from app.markers.magnet import InformationTag
from app.markers.magnet_design import Codebook, Distinguishable, Meaning, OdometerError, TagDesign, distinguishable
from app.registry.database import Database
from app.registry.markers import CODEBOOKS, CodebookRow, book_of
from app.registry.resources import first_version
from app.services.access.access import Caller
from app.services.access.audit import log_change
from app.services.documents import document_of
from app.services.idempotency import IdempotencyKey, find_earlier, write_once
from app.services.ports import Clock

# === Codebooks as they are stored and as clients see them.


class FiguresDocument(TypedDict):
    """Capacities: by equation 2, with coupling, wrong-way safe, and under the rules, counted up to 200 only."""

    ideal_capacity: int
    coupled_capacity: int
    wrong_way_safe_capacity: int
    capacity_under_rules: int
    capacity_is_exact: bool
    distinguishable: Distinguishable


class CodebookSummary(TypedDict):
    """A codebook in a list."""

    id: str
    name: str
    version: int
    design: TagDesign
    rules: CodebookRules
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

    design: TagDesign
    rules: CodebookRules
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
    """Rules of a book's row; the decoder's errors are those of its version, not the book's."""
    return CodebookRules(**{**row.rules, "odometer": OdometerError(**row.rules["odometer"])})


def book_columns(book: Codebook) -> dict[str, object]:
    """Columns that keep a book."""
    document = book.to_document()
    return {name: document[name] for name in ("name", "design", "entries")}


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
        "design": design,
        "rules": rules,
        "figures": _figures(design, rules, len(codes)),
        "codes": [{"code": tag.text, "tuple": tag.tuple_text} for tag in codes],
    }


def design_figures(design: TagDesign, rules: CodebookRules) -> FiguresDocument:
    """How many codes a design has, how many fit the rules, and how many can be distinguished when all are used."""
    return _figures(design, rules, len(fitting_codes(design, rules, max_count=MAX_COUNTED)))


def _figures(design: TagDesign, rules: CodebookRules, fitting: int) -> FiguresDocument:
    return {
        "ideal_capacity": design.ideal_capacity,
        "coupled_capacity": design.coupled_capacity,
        "wrong_way_safe_capacity": design.wrong_way_safe_capacity,
        "capacity_under_rules": fitting,
        "capacity_is_exact": fitting < MAX_COUNTED,
        "distinguishable": distinguishable(design, rules.conditions, accuracy=_ACCURACY),
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


# === Codebooks.


MAX_ENTRIES = 500
_TRIES = 5


class Codebooks:
    """Use cases on codebooks. Codes are worked out before a transaction begins: that can take a second."""

    def __init__(self, database: Database, clock: Clock, idempotency_ttl: timedelta = timedelta(hours=24)) -> None:
        self._database = database
        self._clock = clock
        self._ttl = idempotency_ttl

    def make(
        self,
        caller: Caller,
        name: str,
        design: TagDesign,
        rules: CodebookRules,
        meanings: Sequence[Meaning] = (),
        key: IdempotencyKey | None = None,
    ) -> tuple[CodebookDocument, bool]:
        """Store a new codebook with codes for the meanings.

        Returns
        -------
        codebook : dict
        replayed : bool
            The request had been made before under the same Idempotency-Key; nothing was stored now.

        Raises
        ------
        InvalidParameter
            The name, the design, the rules or a meaning cannot be.
        CodebookFull
            Not all meanings get a code under these rules.
        Conflict
            The agency has a codebook of this name, or a meaning occurs twice.
        """
        now = self._clock()
        if replayed := find_earlier(self._database, caller.agency_id, key, now):
            return replayed, True
        _check_size(len(meanings))
        book = _allocated(Codebook(name, design), meanings, rules)
        figures = design_figures(design, rules)
        with write_once(self._database, caller.agency_id, key, now, self._ttl) as (connection, answer):
            if answer.replayed:
                return answer.response, True
            CODEBOOKS.check_name(connection, caller.agency_id, name)
            values = {**first_version(now), **book_columns(book), "rules": asdict(rules), "figures": figures}
            document = answer.store(codebook_document(CODEBOOKS.add(connection, caller.agency_id, values)))
            log_change(connection, caller, "codebook.made", now=now, subject=document["id"], document=document)
        return document, False

    def add_meanings(
        self, caller: Caller, codebook_id: str, meanings: Sequence[Meaning], key: IdempotencyKey | None = None
    ) -> tuple[CodebookDocument, bool]:
        """Give codes to further meanings; codes given before stay as they are. Returns and raises as `make`.

        Raises
        ------
        NotFound
            There is no such codebook.
        Unavailable
            Others kept changing the book meanwhile.
        """
        for _ in range(_TRIES):
            now = self._clock()
            if replayed := find_earlier(self._database, caller.agency_id, key, now):
                return replayed, True
            row = self._get(caller, codebook_id)
            book = book_of(row)
            try:
                _check_size(len(book.entries) + len(meanings))
                longer = _allocated(book, meanings, rules_of(row))
            except WaymarkError:  # what is in the way may be what the same request added meanwhile
                if replayed := find_earlier(self._database, caller.agency_id, key, now):
                    return replayed, True
                raise
            try:
                with write_once(self._database, caller.agency_id, key, now, self._ttl) as (connection, answer):
                    if answer.replayed:
                        return answer.response, True
                    entries = {"entries": book_columns(longer)["entries"]}
                    changed = CODEBOOKS.update(
                        connection, caller.agency_id, codebook_id, entries, version=row.version, now=now
                    )
                    document = answer.store(codebook_document(changed))
                    log_change(connection, caller, "codebook.extended", now=now, subject=codebook_id, document=document)
            except StaleVersion:
                continue
            return document, False
        raise Unavailable("others are adding to this codebook", cure="try again in a few seconds")

    def get(self, caller: Caller, codebook_id: str) -> CodebookDocument:
        """One codebook with its entries."""
        return codebook_document(self._get(caller, codebook_id))

    def page(self, caller: Caller, *, after: str | None = None, limit: int = 100) -> tuple[CodebookPage, str | None]:
        """A page of codebooks, and the id to continue after if there may be more."""
        with self._database.read() as connection:
            rows, last = CODEBOOKS.page(connection, caller.agency_id, beyond=after, limit=limit)
        return CodebookPage(items=[codebook_summary(row) for row in rows]), last

    def entry(self, caller: Caller, codebook_id: str, code: str) -> EntryDocument:
        """The entry of a code.

        Raises
        ------
        NotFound
            There is no such codebook, or the code is not in it.
        """
        book = book_of(self._get(caller, codebook_id))
        for tag, meaning in book.entries:
            if tag.text == code:
                return entry_document(tag, meaning)
        raise NotFound(f"{code[:60]!r} is not in the codebook {book.name}", field="code")

    def list_entries(self, caller: Caller, codebook_id: str, meaning: Meaning | None) -> EntryList:
        """All entries, or the one with a meaning if there is one."""
        book = book_of(self._get(caller, codebook_id))
        if meaning is None:
            return {"items": [entry_document(*entry) for entry in book.entries]}
        return {"items": [entry_document(tag, known) for tag, known in book.entries if known == meaning]}

    def _get(self, caller: Caller, codebook_id: str) -> CodebookRow:
        with self._database.read() as connection:
            return CODEBOOKS.get(connection, caller.agency_id, codebook_id)


def _allocated(book: Codebook, meanings: Sequence[Meaning], rules: CodebookRules) -> Codebook:
    try:
        with naming("rules"):
            return allocate_codes(book, meanings, rules)
    except Conflict as error:
        error.field = "meanings"
        raise


def _check_size(count: int) -> None:
    if count > MAX_ENTRIES:
        raise InvalidParameter(
            f"the codebook would have {count} entries",
            field="meanings",
            limit=f"at most {MAX_ENTRIES} entries",
            cure="make another codebook for the rest",
        )
