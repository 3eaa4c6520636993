"""Codebooks: which codes an agency's information tags carry, and what they mean."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import Any

from app.encoders.magnet import CodebookRules, allocate_codes
from app.errors import Conflict, InvalidParameter, NotFound, StaleVersion, Unavailable, WaymarkError
from app.markers.magnet_codebook import Codebook, Meaning
from app.markers.magnet_design import TagDesign
from app.registry import codebooks as store
from app.registry.codebooks import Row
from app.registry.database import Database
from app.registry.ids import new_id
from app.services.access import Caller
from app.services.audit import log_change
from app.services.codebook_documents import (
    book_columns,
    book_of,
    codebook_document,
    codebook_summary,
    design_figures,
    entry_document,
    rules_columns,
    rules_of,
)
from app.services.idempotency import IdempotencyKey, find_answer, keep_answer
from app.services.ports import Clock
from app.services.positions import naming

MAX_ENTRIES = 500
_TRIES = 5

GivenMeaning = tuple[str, float | str]


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
        meanings: Sequence[GivenMeaning] = (),
        key: IdempotencyKey | None = None,
    ) -> tuple[dict[str, Any], bool]:
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
        if replayed := self._find_answer(caller, key, now):
            return replayed, True
        _check_size(len(meanings))
        book = _allocated(Codebook(name, design), meanings, rules)
        figures = design_figures(design, rules)
        with self._database.write() as connection:
            answer = find_answer(connection, caller.agency_id, key, now)
            if answer is not None:
                return answer, True
            other = store.find_codebook(connection, caller.agency_id, name)
            if other is not None:
                raise Conflict(
                    f"codebook {other} has this name",
                    field="name",
                    limit="each name once in an agency",
                    cure="choose another name, or add the meanings to that codebook",
                )
            values = {
                "id": new_id(now),
                **book_columns(book),
                "rules": rules_columns(rules),
                "figures": figures,
                "version": 1,
                "created_at": now,
                "updated_at": now,
            }
            document = codebook_document(store.add_codebook(connection, caller.agency_id, values))
            log_change(connection, caller, "codebook.made", now=now, subject=document["id"], document=document)
            keep_answer(connection, caller.agency_id, key, document, now, self._ttl)
        return document, False

    def add_meanings(
        self, caller: Caller, codebook_id: str, meanings: Sequence[GivenMeaning], key: IdempotencyKey | None = None
    ) -> tuple[dict[str, Any], bool]:
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
            if replayed := self._find_answer(caller, key, now):
                return replayed, True
            row = self._get(caller, codebook_id)
            book = book_of(row)
            try:
                _check_size(len(book.entries) + len(meanings))
                longer = _allocated(book, meanings, rules_of(row))
            except WaymarkError:  # what is in the way may be what the same request added meanwhile
                if replayed := self._find_answer(caller, key, now):
                    return replayed, True
                raise
            try:
                with self._database.write() as connection:
                    answer = find_answer(connection, caller.agency_id, key, now)
                    if answer is not None:
                        return answer, True
                    entries = book_columns(longer)["entries"]
                    changed = store.replace_entries(
                        connection, caller.agency_id, codebook_id, entries, version=row["version"], now=now
                    )
                    document = codebook_document(changed)
                    log_change(connection, caller, "codebook.extended", now=now, subject=codebook_id, document=document)
                    keep_answer(connection, caller.agency_id, key, document, now, self._ttl)
            except StaleVersion:
                continue
            return document, False
        raise Unavailable("others are adding to this codebook", cure="try again in a few seconds")

    def get(self, caller: Caller, codebook_id: str) -> dict[str, Any]:
        """One codebook with its entries."""
        return codebook_document(self._get(caller, codebook_id))

    def page(
        self, caller: Caller, *, after: str | None = None, limit: int = 100
    ) -> tuple[list[dict[str, Any]], str | None]:
        """A page of codebooks, and the id to continue after if there may be more."""
        with self._database.read() as connection:
            rows = store.list_codebooks(connection, caller.agency_id, after=after, limit=limit + 1)
        page = [codebook_summary(row) for row in rows[:limit]]
        return page, page[-1]["id"] if len(rows) > limit else None

    def entry(self, caller: Caller, codebook_id: str, code: str) -> dict[str, Any]:
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

    def list_entries(self, caller: Caller, codebook_id: str, meaning: GivenMeaning | None) -> list[dict[str, Any]]:
        """All entries, or the one with a meaning if there is one."""
        book = book_of(self._get(caller, codebook_id))
        if meaning is None:
            return [entry_document(*entry) for entry in book.entries]
        wanted = Meaning(*meaning)  # type: ignore[arg-type]
        return [entry_document(tag, known) for tag, known in book.entries if known == wanted]

    def _get(self, caller: Caller, codebook_id: str) -> Row:
        with self._database.read() as connection:
            return store.get_codebook(connection, caller.agency_id, codebook_id)

    def _find_answer(self, caller: Caller, key: IdempotencyKey | None, now: datetime) -> dict[str, Any] | None:
        if key is None:
            return None
        with self._database.read() as connection:
            return find_answer(connection, caller.agency_id, key, now)


def _allocated(book: Codebook, given: Sequence[GivenMeaning], rules: CodebookRules) -> Codebook:
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
