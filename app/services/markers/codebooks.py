"""Codebooks: which codes an agency's information tags carry, and what they mean."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import timedelta

from app.encoders.magnet import CodebookRules, allocate_codes
from app.errors import Conflict, InvalidParameter, NotFound, StaleVersion, Unavailable, WaymarkError, naming
from app.markers.magnet_codebook import Codebook, Meaning
from app.markers.magnet_design import TagDesign
from app.registry.codebooks import CODEBOOKS, CodebookRow, book_of
from app.registry.database import Database
from app.registry.resources import first_version
from app.services.access.access import Caller
from app.services.access.audit import log_change
from app.services.idempotency import IdempotencyKey, find_earlier, write_once
from app.services.markers.codebook_documents import (
    CodebookDocument,
    CodebookPage,
    EntryDocument,
    EntryList,
    book_columns,
    codebook_document,
    codebook_summary,
    design_figures,
    entry_document,
    rules_columns,
    rules_of,
)
from app.services.ports import Clock

MAX_ENTRIES = 500
_TRIES = 5

MeaningInput = tuple[str, float | str]


class Codebooks:
    """Use cases on codebooks. Codes are worked out before a transaction begins: that can take a second.

    Parameters
    ----------
    database : Database
    clock : Clock
    idempotency_ttl : timedelta
    """

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
        meanings: Sequence[MeaningInput] = (),
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
            values = {**first_version(now), **book_columns(book), "rules": rules_columns(rules), "figures": figures}
            document = answer.store(codebook_document(CODEBOOKS.add(connection, caller.agency_id, values)))
            log_change(connection, caller, "codebook.made", now=now, subject=document["id"], document=document)
        return document, False

    def add_meanings(
        self, caller: Caller, codebook_id: str, meanings: Sequence[MeaningInput], key: IdempotencyKey | None = None
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

    def list_entries(self, caller: Caller, codebook_id: str, meaning: MeaningInput | None) -> EntryList:
        """All entries, or the one with a meaning if there is one."""
        book = book_of(self._get(caller, codebook_id))
        if meaning is None:
            return {"items": [entry_document(*entry) for entry in book.entries]}
        wanted = Meaning(*meaning)  # type: ignore[arg-type]
        return {"items": [entry_document(tag, known) for tag, known in book.entries if known == wanted]}

    def _get(self, caller: Caller, codebook_id: str) -> CodebookRow:
        with self._database.read() as connection:
            return CODEBOOKS.get(connection, caller.agency_id, codebook_id)


def _allocated(book: Codebook, given: Sequence[MeaningInput], rules: CodebookRules) -> Codebook:
    meanings = []
    for number, (kind, value) in enumerate(given):
        with naming(f"meanings.{number}"):
            meanings.append(Meaning(kind, value))  # type: ignore[arg-type]
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
