"""Agencies, as the server's operator creates them over HTTP. An operator's key reads no agency's rows."""

from __future__ import annotations

import base64
from datetime import timedelta
from typing import Any, cast

from app.errors import Conflict
from app.registry import agencies as store
from app.registry.database import Database
from app.registry.tenancy import across_agencies
from app.services.access.access import Caller, Scope, add_key, check_agency_name
from app.services.access.agency_secrets import AgencySecrets
from app.services.access.audit import author_of, log_change
from app.services.access.documents import AgencyDocument, AgencyPage, NewAgencyDocument
from app.services.access.key_text import new_key, shown_part
from app.services.documents import document_of
from app.services.idempotency import IdempotencyKey, write_once
from app.services.ports import Clock


class Agencies:
    """Use cases on agencies, one transaction each.

    Parameters
    ----------
    database : Database
    clock : Clock
    secrets : AgencySecrets
        Encrypts the text of a first key, which a repeated request is answered with.
    idempotency_ttl : timedelta
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
        name : str
        label : str
            What histories call the holder of the admin key.
        key : IdempotencyKey, optional

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
            document: dict[str, Any] = {
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

    def _opened(self, document: dict[str, Any]) -> NewAgencyDocument:
        """A stored response with the text of its key."""
        sealed = base64.b64decode(document["admin_key"]["key"])
        text = self._secrets.unseal(_owner(document["id"]), sealed).decode()
        return cast("NewAgencyDocument", {**document, "admin_key": {**document["admin_key"], "key": text}})


def _owner(agency_id: str) -> str:
    """Binds an encrypted key to its agency and purpose."""
    return f"first-key:{agency_id}"
