"""Webhooks and deliveries as clients see them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal, cast

from pydantic import Field
from typing_extensions import TypedDict

from app.registry.webhooks import DeliveryRow, WebhookRow

WebhookState = Literal["active", "disabled"]
DeliveryState = Literal["waiting", "delivered", "failed"]


class WebhookDocument(TypedDict):
    """A webhook, without its secret."""

    id: str
    url: str
    events: Annotated[list[str], Field(description="Kinds of events; `job.*` are all that begin so, `*` is all.")]
    state: WebhookState
    reason: Annotated[str | None, Field(description="Why it is disabled.")]
    last_success_at: datetime | None
    who: Annotated[str, Field(description="Label of the key that registered it.")]
    created_at: datetime


class NewWebhookDocument(WebhookDocument):
    """A webhook that was just registered."""

    secret: Annotated[str, Field(description="For verifying signatures; it is shown once.")]


class WebhookList(TypedDict):
    """All webhooks of the agency, oldest first."""

    items: list[WebhookDocument]


class DeliveryDocument(TypedDict):
    """One event for one webhook."""

    id: Annotated[str, Field(description="The header `webhook-id`; the same in all attempts.")]
    event_id: int
    kind: Annotated[str, Field(description="Of the event.")]
    state: DeliveryState
    attempts: int
    due_at: Annotated[datetime | None, Field(description="Of the next attempt; null if there is none.")]
    status: Annotated[int | None, Field(description="Of the last response.")]
    error: Annotated[str | None, Field(description="Why the last attempt failed.")]
    body: Annotated[str, Field(description="JSON, as it is signed and sent.")]
    created_at: datetime
    ended_at: datetime | None


class DeliveryPage(TypedDict):
    """A page of deliveries, newest first; the Link header leads to the next one."""

    items: list[DeliveryDocument]


def webhook_document(row: WebhookRow) -> WebhookDocument:
    """A webhook as clients see it."""
    names = WebhookDocument.__annotations__
    return cast("WebhookDocument", {name: value for name, value in row._asdict().items() if name in names})


def delivery_document(row: DeliveryRow) -> DeliveryDocument:
    """A delivery as clients see it."""
    names = DeliveryDocument.__annotations__
    found = {name: value for name, value in row._asdict().items() if name in names}
    return cast("DeliveryDocument", {**found, "due_at": row.due_at if row.state == "waiting" else None})
