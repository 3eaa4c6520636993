"""What the API returns about keys and the audit log."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import Field, JsonValue
from typing_extensions import TypedDict

from app.services.access.access import Scope


class KeyDocument(TypedDict):
    """A key, without its text. Keys that replace one another have the same `holder_id`."""

    id: str
    holder_id: str
    label: str
    scope: Scope
    prefix: Annotated[str, Field(description="The first characters of the key.")]
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None
    last_used_at: Annotated[datetime | None, Field(description="To the minute.")]
    valid: bool


class NewKeyDocument(KeyDocument):
    """A key with its text, which is shown only in this response."""

    key: str


class KeyPage(TypedDict):
    """A page of keys; the Link header leads to the next one."""

    items: list[KeyDocument]


class AgencyDocument(TypedDict):
    """An agency."""

    id: str
    name: str
    created_at: datetime


class NewAgencyDocument(AgencyDocument):
    """An agency with its first key. The key's text is shown only in this response, and where the request is repeated
    with its Idempotency-Key."""

    admin_key: NewKeyDocument


class AgencyPage(TypedDict):
    """A page of agencies, oldest first; the Link header leads to the next one."""

    items: list[AgencyDocument]


class AuditHead(TypedDict):
    """The newest entry of a log. Compare it with a copy that is stored elsewhere: a log that was cut differs."""

    number: int
    hash: str


class AuditEntryDocument(TypedDict):
    """One operation, with the hash of the entry before it."""

    number: int
    at: datetime
    who: str
    key_id: str | None
    action: str
    subject: str | None
    detail: dict[str, JsonValue] | None
    versions: int
    digest: str
    previous_hash: str
    hash: str


class AuditPage(TypedDict):
    """A page of the log, oldest first, and its head."""

    items: list[AuditEntryDocument]
    head: AuditHead | None
