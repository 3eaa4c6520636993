"""Webhooks: events of an agency, sent to addresses that it chose."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import random
import re
import secrets
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Annotated, Literal, Protocol, cast

import orjson
import sqlalchemy as sa
import structlog
from pydantic import Field
from typing_extensions import TypedDict

from app.errors import Conflict, InvalidParameter, Unavailable
from app.registry import webhooks as store
from app.registry.column_types import new_id, new_ids
from app.registry.database import Database
from app.registry.engines import across_agencies
from app.registry.webhooks import DeliveryRow, EventRow, WebhookRow, list_events, newest_event
from app.services.access.access import Caller
from app.services.access.agency_secrets import AgencySecrets
from app.services.access.audit import log_change
from app.services.ports import Clock

# === Signatures of the Standard Webhooks specification (standardwebhooks.com, version 1).


PREFIX = "whsec_"
SECRET_BYTES = 32
"""Source: the specification asks for 24 to 64."""


def secret_text(secret: bytes) -> str:
    """A secret as its owner gets it."""
    return PREFIX + base64.b64encode(secret).decode()


def signed_headers(secret: bytes, message_id: str, timestamp_s: int, body: bytes) -> dict[str, str]:
    """Headers of a message: its id, when it was sent, and the signature over both and the body."""
    signed = b"%s.%d.%s" % (message_id.encode(), timestamp_s, body)
    signature = base64.b64encode(hmac.digest(secret, signed, hashlib.sha256)).decode()
    return {
        "webhook-id": message_id,
        "webhook-timestamp": str(timestamp_s),
        "webhook-signature": f"v1,{signature}",
    }


# === Webhooks and deliveries as clients see them.


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


# === Webhooks are registered, listed and removed, and their deliveries read and sent again.


MAX_WEBHOOKS = 20
"""Of an agency."""
GIVE_UP_AFTER = timedelta(days=1)
"""How long a delivery is tried; then its webhook is disabled."""
_KIND = re.compile(r"\*|[a-z]+(\.[a-z-]+)*(\.\*)?")


class Webhooks:
    """Use cases on webhooks.

    Parameters
    ----------
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
                    f"the agency has {MAX_WEBHOOKS} webhooks",
                    limit=f"{MAX_WEBHOOKS} of an agency",
                    cure="delete one that is not needed",
                )
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


# === Events become deliveries, and deliveries are sent until they are taken: at least once, whatever is killed when.
#
# Both steps leave their state in the database. A process that is killed while it sends holds a lease that ends.


LEASE = timedelta(seconds=60)
"""When a delivery that was cut off is sent again: well after the longest request."""
FIRST_DELAY_S, MAX_DELAY_S = 5.0, 4 * 3600.0
"""Between attempts: three times as long each time. [s] Source: the schedule of Standard Webhooks, up to hours."""
EVENTS_AT_ONCE = 200
SENT_AT_ONCE, SENT_PER_WEBHOOK = 32, 4
KEPT = timedelta(days=30)
"""How long events and ended deliveries are kept."""
_GONE = 410
_RANDOM = random.Random()  # its own: threads that share the module's disturb whoever has seeded it
_LOG = structlog.get_logger(__name__)


class Outcome(Protocol):
    """How a request ended."""

    @property
    def status(self) -> int | None:
        """Of the response."""

    @property
    def error(self) -> str | None:
        """What went wrong."""

    @property
    def succeeded(self) -> bool:
        """Whether the receiver took it."""


@dataclass(frozen=True, slots=True)
class Unsent:
    """Nothing could be sent."""

    error: str
    status: None = None
    succeeded: bool = False


class Sender(Protocol):
    """Posts to the outside."""

    async def send(self, url: str, headers: Mapping[str, str], body: bytes) -> Outcome:
        """Post a body; raises nothing."""


class WebhookDelivery:
    """The periodic work on webhooks; several processes of one database may do it at the same time."""

    def __init__(self, database: Database, clock: Clock, secrets: AgencySecrets, sender: Sender) -> None:
        self._database, self._clock = database, clock
        self._secrets, self._sender = secrets, sender
        self._stopping = threading.Event()

    def stop(self) -> None:
        """End a `try_to_work` that runs: what it was sending is sent again later."""
        self._stopping.set()

    def try_to_work(self) -> None:
        """As `work`; a database that does not answer is tried again the next time."""
        try:
            self.work()
        except (Unavailable, sa.exc.SQLAlchemyError) as error:
            _LOG.warning("webhooks could not be served", why=str(error))

    def work(self) -> int:
        """Turn new events into deliveries, and send what is due. Returns the number of attempts."""
        sent = 0
        with across_agencies():
            self._add_deliveries()
            while not self._stopping.is_set():
                with self._database.read() as connection:
                    if not store.has_due(connection, self._clock()):
                        break
                with self._database.write() as connection:
                    now = self._clock()
                    leased = store.lease_due(
                        connection, now, now + LEASE, per_webhook=SENT_PER_WEBHOOK, limit=SENT_AT_ONCE
                    )
                for (delivery, webhook), outcome in zip(leased, asyncio.run(self._send(leased)), strict=True):
                    sent += outcome is not None
                    self._record(delivery, webhook, outcome)
        return sent

    def delete_old(self) -> None:
        """Delete deliveries and events that are kept no longer."""
        with across_agencies(), self._database.write() as connection:
            store.delete_old(connection, self._clock() - KEPT)

    # --- events -------------------------------------------------------------------------------------------------------

    def _add_deliveries(self) -> None:
        with self._database.read() as connection:
            behind = store.list_webhooks_behind(connection)
        for webhook in behind:
            while self._add_some(webhook) == EVENTS_AT_ONCE and not self._stopping.is_set():
                pass

    def _add_some(self, webhook: WebhookRow) -> int:
        """Make deliveries of the next events of a webhook; the place in the events moves on with them."""
        now = self._clock()
        with self._database.write() as connection:
            found = [row for row in store.list_webhooks_behind(connection) if row.id == webhook.id]
            if not found:
                return 0  # it was deleted or disabled, or another process did this
            webhook = found[0]
            events = list_events(connection, webhook.agency_id, after=webhook.last_event_id, limit=EVENTS_AT_ONCE)
            wanted = [event for event in events if is_wanted(event.kind, webhook.events)]
            store.add_deliveries(
                connection,
                [
                    DeliveryRow(
                        delivery_id, webhook.agency_id, webhook.id, event.id, event.kind, _body(event), "waiting", 0,
                        now, now + GIVE_UP_AFTER, None, None, now, None,
                    )
                    for delivery_id, event in zip(new_ids(now, len(wanted)), wanted, strict=True)
                ],
            )  # fmt: skip
            store.change_webhook(connection, webhook.id, last_event_id=events[-1].id)
        return len(events)

    # --- attempts -----------------------------------------------------------------------------------------------------

    async def _send(self, leased: list[tuple[DeliveryRow, WebhookRow]]) -> list[Outcome | None]:
        """Send together; None for those that were cut off because the server stops."""
        tasks = [asyncio.create_task(self._send_one(*one)) for one in leased]
        waiting = set(tasks)
        while waiting:
            _done, waiting = await asyncio.wait(waiting, timeout=0.1)
            if self._stopping.is_set():
                break
        for task in waiting:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        return [None if task.cancelled() else task.result() for task in tasks]

    async def _send_one(self, delivery: DeliveryRow, webhook: WebhookRow) -> Outcome:
        try:
            secret = self._secrets.unseal(secret_owner(webhook.agency_id, webhook.id), webhook.sealed_secret)
            body = delivery.body.encode()
            headers = signed_headers(secret, delivery.id, int(self._clock().timestamp()), body)
            return await self._sender.send(webhook.url, headers, body)
        except Unavailable as error:
            return Unsent(error.message)
        except Exception as error:  # noqa: BLE001 - one delivery must not end those of other agencies
            _LOG.exception("a delivery failed by a defect of the server", webhook_id=webhook.id)
            return Unsent(f"a defect of the server: {type(error).__name__}")

    def _record(self, delivery: DeliveryRow, webhook: WebhookRow, outcome: Outcome | None) -> None:
        now = self._clock()
        with self._database.write() as connection:
            if outcome is None:
                store.change_delivery(connection, delivery.id, due_at=now, attempts=delivery.attempts - 1)
                return
            seen = {"status": outcome.status, "error": outcome.error}
            if outcome.succeeded:
                store.change_delivery(connection, delivery.id, state="delivered", ended_at=now, **seen)
                store.change_webhook(connection, webhook.id, last_success_at=now)
                return
            gone = outcome.status == _GONE
            if gone or now >= delivery.give_up_at:
                store.change_delivery(connection, delivery.id, state="failed", ended_at=now, **seen)
                why = "the receiver answered 410 Gone" if gone else f"a delivery failed for a day: {outcome.error}"
                store.change_webhook(connection, webhook.id, state="disabled", reason=why[:500])
                _LOG.warning("a webhook was disabled", webhook_id=webhook.id, agency_id=webhook.agency_id)
                return
            due_at = now + timedelta(seconds=delay_s(delivery.attempts))
            store.change_delivery(connection, delivery.id, due_at=min(due_at, delivery.give_up_at), **seen)


def is_wanted(kind: str, wanted: list[str]) -> bool:
    """Whether a kind of events is among those of a webhook."""
    return any(one in ("*", kind) or (one.endswith(".*") and kind.startswith(one[:-1])) for one in wanted)


def delay_s(attempts: int) -> float:
    """Time until the next attempt, up to a quarter more or less, so that many that failed together part. [s]"""
    return min(MAX_DELAY_S, FIRST_DELAY_S * 3.0 ** (attempts - 1)) * _RANDOM.uniform(0.75, 1.25)


def _body(event: EventRow) -> str:
    """An event as receivers get it; the members are those of Standard Webhooks."""
    data = {"event_id": event.id, "subject_id": event.subject_id, **(event.detail or {})}
    if event.kind.startswith("job."):
        data["job"] = f"/v1/jobs/{event.subject_id}"
    return orjson.dumps({"type": event.kind, "timestamp": event.at, "data": data}).decode()
