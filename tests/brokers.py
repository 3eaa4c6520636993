"""RabbitMQ for tests: each uses queues with names of its own, and deletes them afterwards."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from kombu import Connection

from app.jobs.celery_queue import dead_letter_name, queue_name
from app.services.jobs import QueueName
from tests.machine import refuse

LOCAL_BROKER = "amqp://guest:guest@127.0.0.1:5672"
_USED: set[tuple[str, str]] = set()
"""URLs and prefixes of all queues of this run."""


def find_broker() -> str:
    """URL of the broker of WAYMARK_TEST_BROKER_URL, or of the local one.

    Without one the tests that need it are skipped; with CI=true they fail.
    """
    url = os.environ.get("WAYMARK_TEST_BROKER_URL") or LOCAL_BROKER
    try:
        with Connection(url, connect_timeout=5) as connection:
            connection.connect()
    except OSError as error:
        reason = f"no RabbitMQ at {LOCAL_BROKER}; WAYMARK_TEST_BROKER_URL names another: {error}"
        refuse(reason)
    return url


@contextmanager
def own_queues(url: str) -> Iterator[str]:
    """A prefix of queues that no other test has; they are deleted at the end."""
    prefix = f"waymark_test_{secrets.token_hex(4)}"
    _USED.add((url, prefix))
    try:
        yield prefix
    finally:
        delete_queues(url, prefix)


def delete_all_queues() -> None:
    """Delete the queues of all tests again: what a test left running may have declared them once more."""
    while _USED:
        delete_queues(*_USED.pop())


def delete_queues(url: str, prefix: str) -> None:
    """Delete the queues and exchanges with a prefix."""
    with Connection(url) as connection:
        for name in (*(queue_name(queue, prefix) for queue in QueueName), dead_letter_name(prefix)):
            with suppress(connection.channel_errors), connection.channel() as channel:
                channel.queue_delete(name)
        for name in (prefix, dead_letter_name(prefix)):
            with suppress(connection.channel_errors), connection.channel() as channel:
                channel.exchange_delete(name)
