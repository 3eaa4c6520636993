"""Keys of an agency, as its admins keep them, and agencies, as the operator does. Key texts are only in the answer."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import cast

from app.errors import Conflict, InvalidParameter
from app.registry import agencies as store
from app.registry.agencies import KeyRow
from app.registry.database import Database
from app.registry.engines import across_agencies
from app.services.access.access import Access, Caller, Scope, add_key, check_agency_name, new_key, shown_part
from app.services.access.agency_secrets import AgencySecrets
from app.services.access.audit import (
    AgencyDocument,
    AgencyPage,
    KeyDocument,
    KeyPage,
    NewAgencyDocument,
    NewKeyDocument,
    author_of,
    log_change,
)
from app.services.documents import document_of
from app.services.idempotency import IdempotencyKey, write_once
from app.services.ports import Clock
from app.values import JsonObject

MAX_LIFETIME = timedelta(days=3653)
MAX_OVERLAP = timedelta(days=30)


@dataclass(frozen=True, slots=True)
class NewKey:
    """What a key shall be."""

    scope: Scope
    label: str  # what histories call its holder
    expires_at: datetime | None = None  # None: it does not expire


class Keys:
    """Use cases on keys, one transaction each.

    Parameters
    ----------
    access : Access
        Knows which keys were just used.
    """

    def __init__(self, database: Database, clock: Clock, access: Access) -> None:
        self._database = database
        self._clock = clock
        self._access = access

    def create(self, caller: Caller, wanted: NewKey) -> NewKeyDocument:
        """A new key, with its text.

        Raises
        ------
        InvalidParameter
            It would have expired already, or lasts too long.
        """
        now = self._clock()
        expires_at = _checked_expiry(wanted.expires_at, now)
        key = new_key()
        with self._database.write() as connection:
            key_id = add_key(
                connection,
                key,
                agency_id=caller.agency_id,
                scope=wanted.scope,
                label=wanted.label,
                now=now,
                expires_at=expires_at,
                author=author_of(caller),
            )
            row = store.KEYS.get(connection, caller.agency_id, key_id)
        return {**self._document(row), "key": key}

    def get(self, caller: Caller, key_id: str) -> KeyDocument:
        """One key of the agency, without its text."""
        with self._database.read() as connection:
            return self._document(store.KEYS.get(connection, caller.agency_id, key_id))

    def page(self, caller: Caller, *, after: str | None = None, limit: int = 100) -> tuple[KeyPage, str | None]:
        """A page of the agency's keys, oldest first, and the id to continue after if there may be more."""
        with self._database.read() as connection:
            rows, last = store.KEYS.page(connection, caller.agency_id, beyond=after, limit=limit)
        return KeyPage(items=[self._document(row) for row in rows]), last

    def rotate(
        self, caller: Caller, key_id: str, *, overlap: timedelta, expires_at: datetime | None = None
    ) -> NewKeyDocument:
        """A new key for the holder of another, with its text; the other one ends after the overlap.

        Parameters
        ----------
        overlap : timedelta
            How long both are valid.
        expires_at : datetime, optional
            Of the new key. Without, it lasts as long as the old one did.

        Raises
        ------
        NotFound
            There is none with this id, or it belongs to another agency.
        Conflict
            The key has ended, or another one took over already.
        """
        now = self._clock()
        expires_at = _checked_expiry(expires_at, now)
        key = new_key()
        with self._database.write() as connection:
            old = store.KEYS.get(connection, caller.agency_id, key_id)
            if not _is_valid(old, now):
                raise Conflict("the key has ended", field="key_id", cure="make a new one: POST /v1/keys")
            successor = store.find_successor(connection, caller.agency_id, old)
            if successor is not None:
                raise Conflict(f"the key {successor} took over from this one", field="key_id", cure="rotate that one")
            if expires_at is None and old.expires_at is not None:
                expires_at = now + (old.expires_at - old.created_at)
            new_id = add_key(
                connection,
                key,
                agency_id=caller.agency_id,
                scope=Scope(old.scope),
                label=old.label,
                now=now,
                expires_at=expires_at,
                holder_id=old.holder_id,
                author=author_of(caller),
            )
            ends_at = now + overlap
            if old.expires_at is None or ends_at < old.expires_at:
                store.expire_key(connection, key_id, ends_at)
            row = store.KEYS.get(connection, caller.agency_id, new_id)
        return {**self._document(row), "key": key}

    def revoke(self, caller: Caller, key_id: str) -> None:
        """End a key now. Ending one that has ended changes nothing.

        Raises
        ------
        NotFound
            There is none with this id, or it belongs to another agency.
        Conflict
            It is the agency's last valid admin key.
        """
        now = self._clock()
        with self._database.write() as connection:
            row = store.KEYS.get(connection, caller.agency_id, key_id)
            if not _is_valid(row, now):
                return
            last = row.scope == Scope.ADMIN and not store.has_admin_key(
                connection, caller.agency_id, besides=key_id, now=now
            )
            if last:
                raise Conflict(
                    "this is the agency's last valid admin key",
                    field="key_id",
                    limit="one admin key",
                    cure="make another admin key first",
                )
            store.revoke_key(connection, caller.agency_id, key_id, now, author=author_of(caller))

    def _document(self, row: KeyRow) -> KeyDocument:
        now = self._clock()
        last_use = self._access.last_use(row)
        return document_of(KeyDocument, row, scope=Scope(row.scope), last_used_at=last_use, valid=_is_valid(row, now))


def _is_valid(row: KeyRow, now: datetime) -> bool:
    return row.revoked_at is None and (row.expires_at is None or row.expires_at > now)


def _checked_expiry(at: datetime | None, now: datetime) -> datetime | None:
    if at is not None and not now < at <= now + MAX_LIFETIME:
        raise InvalidParameter(
            f"a key cannot expire at {at.isoformat()}",
            field="expires_at",
            limit=f"after now, within {MAX_LIFETIME.days} days",
            cure="leave it out for a key that does not expire",
        )
    return at


# === Agencies, as the server's operator creates them over HTTP. An operator's key reads no agency's rows.


class Agencies:
    """Use cases on agencies, one transaction each.

    Parameters
    ----------
    secrets : AgencySecrets
        Encrypts the text of a first key, which a repeated request is answered with.
    """

    def __init__(self, database: Database, clock: Clock, secrets: AgencySecrets, idempotency_ttl: timedelta) -> None:
        self._database = database
        self._clock = clock
        self._secrets = secrets
        self._ttl = idempotency_ttl

    def create(
        self, caller: Caller, name: str, label: str, key: IdempotencyKey | None = None
    ) -> tuple[NewAgencyDocument, bool]:
        """Create an agency with an admin key.

        Parameters
        ----------
        caller : Caller
            An operator.
        label : str
            What histories call the holder of the admin key.

        Returns
        -------
        document : NewAgencyDocument
        replayed : bool
            The request was carried out before.

        Raises
        ------
        InvalidParameter
            No agency can have the name.
        Conflict
            An agency has the name.
        """
        check_agency_name(name, field="name")
        now, text = self._clock(), new_key()
        with (
            across_agencies(),
            write_once(self._database, caller.agency_id, key, now, self._ttl) as (connection, answer),
        ):
            if answer.replayed:
                return self._opened(answer.response), True
            if store.find_agency(connection, name) is not None:
                raise Conflict(
                    f"there is an agency {name!r}",
                    field="name",
                    limit="each name once",
                    cure="choose another name; an admin of that agency creates its further keys: POST /v1/keys",
                )
            author = author_of(caller)
            agency_id = store.add_agency(connection, name, now)
            key_id = add_key(
                connection, text, agency_id=agency_id, scope=Scope.ADMIN, label=label, now=now, author=author
            )
            log_change(connection, caller, "agency.created", now=now, subject=agency_id, name=name)
            document: dict[str, object] = {
                "id": agency_id, "name": name, "created_at": now.isoformat(),
                "admin_key": {
                    "id": key_id, "holder_id": key_id, "label": label, "scope": Scope.ADMIN, "prefix": shown_part(text),
                    "created_at": now.isoformat(), "expires_at": None, "revoked_at": None, "last_used_at": None,
                    "valid": True,
                    "key": base64.b64encode(self._secrets.seal(_owner(agency_id), text.encode())).decode(),
                },
            }  # fmt: skip
            return self._opened(answer.store(document)), False

    def page(self, *, after: str | None = None, limit: int = 100) -> tuple[AgencyPage, str | None]:
        """A page of agencies, oldest first, and the id to continue after if there are more."""
        with across_agencies(), self._database.read() as connection:
            rows = store.page_agencies(connection, after=after, limit=limit + 1)
        items = [document_of(AgencyDocument, row) for row in rows[:limit]]
        return AgencyPage(items=items), rows[limit - 1].id if len(rows) > limit else None

    def _opened(self, document: JsonObject) -> NewAgencyDocument:
        """A stored response with the text of its key."""
        sealed = base64.b64decode(document["admin_key"]["key"])
        text = self._secrets.unseal(_owner(document["id"]), sealed).decode()
        return cast("NewAgencyDocument", {**document, "admin_key": {**document["admin_key"], "key": text}})


def _owner(agency_id: str) -> str:
    """Binds an encrypted key to its agency and purpose."""
    return f"first-key:{agency_id}"
