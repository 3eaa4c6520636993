"""Webhooks are registered, listed and removed, and their deliveries read and sent again."""

from __future__ import annotations

import re
import secrets
from collections.abc import Callable, Sequence
from datetime import timedelta

from app.errors import Conflict, InvalidParameter
from app.registry import webhooks as store
from app.registry.database import Database
from app.registry.events import newest_event
from app.registry.ids import new_id
from app.registry.webhooks import WebhookRow
from app.services.access.access import Caller
from app.services.access.agency_secrets import AgencySecrets
from app.services.access.audit import log_change
from app.services.ports import Clock
from app.services.webhooks.documents import (
    DeliveryDocument,
    DeliveryPage,
    NewWebhookDocument,
    WebhookDocument,
    WebhookList,
    delivery_document,
    webhook_document,
)
from app.services.webhooks.signature import SECRET_BYTES, secret_text

MAX_WEBHOOKS = 20
"""Of an agency. Source: chosen by hand."""
GIVE_UP_AFTER = timedelta(days=1)
"""How long a delivery is tried; then its webhook is disabled."""
_KIND = re.compile(r"\*|[a-z]+(\.[a-z-]+)*(\.\*)?")


class Webhooks:
    """Use cases on webhooks.

    Parameters
    ----------
    database : Database
    clock : Clock
    secrets : AgencySecrets
        Seals the secrets of webhooks.
    check_url : callable
        Refuses URLs that cannot be used.
    """

    def __init__(
        self, database: Database, clock: Clock, secrets: AgencySecrets, check_url: Callable[[str], None]
    ) -> None:
        self._database, self._clock = database, clock
        self._secrets, self._check_url = secrets, check_url

    def create(self, caller: Caller, url: str, events: Sequence[str]) -> NewWebhookDocument:
        """Register a URL for events from now on; the answer has the secret, which nobody is shown again.

        Raises
        ------
        InvalidParameter
            The URL or a kind of events cannot be used.
        Conflict
            The agency has too many.
        """
        self._check_url(url)
        for kind in events:
            if _KIND.fullmatch(kind) is None:
                raise InvalidParameter(
                    f"{kind[:40]!r} is no kind of events", field="events", limit="job.done, job.*, *, ..."
                )
        now, agency_id = self._clock(), caller.agency_id
        secret, webhook_id = secrets.token_bytes(SECRET_BYTES), new_id(now)
        sealed = self._secrets.seal(secret_owner(agency_id, webhook_id), secret)
        with self._database.write() as connection:
            if store.count_webhooks(connection, agency_id) >= MAX_WEBHOOKS:
                raise Conflict(
                    f"the agency has {MAX_WEBHOOKS} webhooks", limit=f"{MAX_WEBHOOKS} of an agency",
                    cure="delete one that is not needed",
                )  # fmt: skip
            row = WebhookRow(
                webhook_id, agency_id, url, list(dict.fromkeys(events)), sealed, "active", None,
                newest_event(connection, agency_id), None, caller.label, now,
            )  # fmt: skip
            store.add_webhook(connection, row)
            log_change(connection, caller, "webhook.added", now=now, subject=row.id, url=url)
        return {**webhook_document(row), "secret": secret_text(secret)}

    def all(self, caller: Caller) -> WebhookList:
        """The agency's webhooks."""
        with self._database.read() as connection:
            return {"items": [webhook_document(row) for row in store.list_webhooks(connection, caller.agency_id)]}

    def get(self, caller: Caller, webhook_id: str) -> WebhookDocument:
        """One webhook."""
        with self._database.read() as connection:
            return webhook_document(store.get_webhook(connection, caller.agency_id, webhook_id))

    def delete(self, caller: Caller, webhook_id: str) -> None:
        """Remove a webhook with its deliveries."""
        with self._database.write() as connection:
            row = store.get_webhook(connection, caller.agency_id, webhook_id)
            store.delete_webhook(connection, webhook_id)
            log_change(connection, caller, "webhook.deleted", now=self._clock(), subject=webhook_id, url=row.url)

    def enable(self, caller: Caller, webhook_id: str) -> WebhookDocument:
        """Enable a webhook that was disabled: it gets all events since then. An active one stays as it is."""
        now = self._clock()
        with self._database.write() as connection:
            row = store.get_webhook(connection, caller.agency_id, webhook_id)
            if row.state == "disabled":
                store.change_webhook(connection, webhook_id, state="active", reason=None)
                store.postpone_giving_up(connection, webhook_id, now + GIVE_UP_AFTER, now)
                log_change(connection, caller, "webhook.enabled", now=now, subject=webhook_id)
            return webhook_document(store.get_webhook(connection, caller.agency_id, webhook_id))

    def deliveries(
        self, caller: Caller, webhook_id: str, *, state: str | None = None, before: str | None = None, limit: int = 100
    ) -> tuple[DeliveryPage, str | None]:
        """A page of deliveries, newest first, and the id to continue before."""
        with self._database.read() as connection:
            store.get_webhook(connection, caller.agency_id, webhook_id)
            rows = store.list_deliveries(connection, webhook_id, state=state, before=before, limit=limit + 1)
        page = DeliveryPage(items=[delivery_document(row) for row in rows[:limit]])
        return page, rows[limit - 1].id if len(rows) > limit else None

    def redeliver(self, caller: Caller, webhook_id: str, delivery_id: str) -> DeliveryDocument:
        """Send a delivery again, now, with its id and its body as they were.

        Raises
        ------
        NotFound
        Conflict
            The webhook is disabled.
        """
        now = self._clock()
        with self._database.write() as connection:
            webhook = store.get_webhook(connection, caller.agency_id, webhook_id)
            store.get_delivery(connection, webhook_id, delivery_id)
            if webhook.state != "active":
                raise Conflict(
                    "the webhook is disabled", field="webhook_id", cure=f"POST /v1/webhooks/{webhook_id}/enable"
                )
            store.change_delivery(
                connection, delivery_id, state="waiting", due_at=now, give_up_at=now + GIVE_UP_AFTER, ended_at=None
            )
            return delivery_document(store.get_delivery(connection, webhook_id, delivery_id))


def secret_owner(agency_id: str, webhook_id: str) -> str:
    """For what a webhook's secret is sealed."""
    return f"{agency_id} webhook {webhook_id}"
