"""Events become deliveries, and deliveries are sent until they are taken: at least once, whatever is killed when.

Both steps leave their state in the database. A process that is killed while it sends holds a lease that ends.
"""

from __future__ import annotations

import asyncio
import random
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from typing import Protocol

import orjson
import sqlalchemy as sa
import structlog

from app.errors import Unavailable
from app.registry import webhooks as store
from app.registry.database import Database
from app.registry.events import EventRow, list_events
from app.registry.ids import new_ids
from app.registry.tenancy import across_agencies
from app.registry.webhooks import DeliveryRow, WebhookRow
from app.services.access.agency_secrets import AgencySecrets
from app.services.ports import Clock
from app.services.webhooks.signature import signed_headers
from app.services.webhooks.webhooks import GIVE_UP_AFTER, secret_owner

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
    """The periodic work on webhooks; several processes of one database may do it at the same time.

    Parameters
    ----------
    database : Database
    clock : Clock
    secrets : AgencySecrets
    sender : Sender
    """

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
    return any(
        one in ("*", kind) or (one.endswith(".*") and kind.startswith(one[:-1])) for one in wanted
    )  # fmt: skip


def delay_s(attempts: int) -> float:
    """Time until the next attempt, up to a quarter more or less, so that many that failed together part. [s]"""
    return min(MAX_DELAY_S, FIRST_DELAY_S * 3.0 ** (attempts - 1)) * _RANDOM.uniform(0.75, 1.25)


def _body(event: EventRow) -> str:
    """An event as receivers get it; the members are those of Standard Webhooks."""
    data = {"event_id": event.id, "subject_id": event.subject_id, **(event.detail or {})}
    if event.kind.startswith("job."):
        data["job"] = f"/v1/jobs/{event.subject_id}"
    return orjson.dumps({"type": event.kind, "timestamp": event.at, "data": data}).decode()
