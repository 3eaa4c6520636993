"""/v1/webhooks: addresses that are sent the agency's events."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Request, Response
from pydantic import ConfigDict, Field

from app.api.http.dependencies import Caller, Identifier, LastId, PageSize, Text, use_cases
from app.api.http.problems import problem_responses
from app.api.http.responses import document_response, json_response, page_response
from app.api.http.strict_json import StrictRoute
from app.families.inputs import StrictModel
from app.services.webhooks.documents import (
    DeliveryDocument,
    DeliveryPage,
    DeliveryState,
    NewWebhookDocument,
    WebhookDocument,
    WebhookList,
)
from app.services.webhooks.webhooks import Webhooks

router = APIRouter(prefix="/v1/webhooks", tags=["webhooks"], route_class=StrictRoute)

WebhookId = Annotated[Identifier, Path(description="Id of the webhook.")]
DeliveryId = Annotated[Identifier, Path(description="Id of the delivery, the header `webhook-id`.")]
Service = Annotated[Webhooks, use_cases("webhooks")]


class WebhookIn(StrictModel):
    """A webhook to register."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"url": "https://example.org/hooks/waymark", "events": ["job.*"]}]}
    )

    url: Text = Field(min_length=1, max_length=500, description="https, at a public address.")
    events: list[Annotated[Text, Field(min_length=1, max_length=40)]] = Field(
        min_length=1, max_length=20, description="Kinds of events: `job.done`; `job.*` for all that begin so; `*`."
    )


@router.post("", status_code=201, responses=document_response(NewWebhookDocument, 409, status=201))
def post_webhook(webhook: WebhookIn, caller: Caller, webhooks: Service) -> Response:
    """Register a URL. Each event is posted to it, signed as Standard Webhooks are, until it answers with 2xx.

    The secret is in this answer only; an Idempotency-Key is not heeded, because no answer is kept.
    """
    document = webhooks.create(caller, webhook.url, webhook.events)
    headers = {"Location": f"/v1/webhooks/{document['id']}", "Cache-Control": "private, no-store"}
    return json_response(document, 201, headers)


@router.get("", responses=document_response(WebhookList))
def list_webhooks(caller: Caller, webhooks: Service) -> Response:
    """The agency's webhooks."""
    return json_response(webhooks.all(caller))


@router.get("/{webhook_id}", responses=document_response(WebhookDocument, 404))
def get_webhook(webhook_id: WebhookId, caller: Caller, webhooks: Service) -> Response:
    """One webhook."""
    return json_response(webhooks.get(caller, webhook_id))


@router.delete("/{webhook_id}", status_code=204, responses=problem_responses(404))
def delete_webhook(webhook_id: WebhookId, caller: Caller, webhooks: Service) -> Response:
    """Remove a webhook with its deliveries."""
    webhooks.delete(caller, webhook_id)
    return Response(status_code=204)


@router.post("/{webhook_id}/enable", responses=document_response(WebhookDocument, 404))
def enable_webhook(webhook_id: WebhookId, caller: Caller, webhooks: Service) -> Response:
    """Enable a webhook that was disabled because its receiver failed for a day; it gets the events since then."""
    return json_response(webhooks.enable(caller, webhook_id))


@router.get("/{webhook_id}/deliveries", responses=document_response(DeliveryPage, 404))
def list_deliveries(
    request: Request,
    webhook_id: WebhookId,
    caller: Caller,
    webhooks: Service,
    state: DeliveryState | None = None,
    limit: PageSize = 100,
    before: LastId = None,
) -> Response:
    """What was sent to a webhook and how that ended, newest first; kept for 30 days."""
    page, last = webhooks.deliveries(caller, webhook_id, state=state, before=before, limit=limit)
    return page_response(request, page, before=last)


@router.post(
    "/{webhook_id}/deliveries/{delivery_id}/redeliver", responses=document_response(DeliveryDocument, 404, 409)
)
def redeliver(webhook_id: WebhookId, delivery_id: DeliveryId, caller: Caller, webhooks: Service) -> Response:
    """Send a delivery again, with the same id and body."""
    return json_response(webhooks.redeliver(caller, webhook_id, delivery_id))
