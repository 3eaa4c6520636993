"""Celery's settings: quorum queues, confirmed publishing, messages that are acknowledged when their job ended."""

from __future__ import annotations

from typing import Any

from celery import Celery
from kombu import Exchange, Queue

from app.services.job_queues import QueueName

TASK = "waymark.run_job"
DELIVERY_LIMIT = 20
"""How often a message is delivered before it becomes a dead letter. A job fails by itself after fewer starts
(`app.services.jobs.MAX_ATTEMPTS`), so only a message that no worker survives gets there."""
MAX_DEAD_LETTERS = 100_000
"""Dead letters that the broker keeps, the newest ones. The rows of the jobs are kept as long as all others."""
ANSWER_S = 4.0
"""How long the broker has for a connection and for the confirmation of a message. [s] Source: Celery's default."""
_HEARTBEAT_S = 10.0


def make_celery(broker_url: str, prefix: str) -> Celery:
    """A Celery application; nothing is connected yet.

    Parameters
    ----------
    broker_url : str
        amqp://USER:PASSWORD@HOST:PORT/VHOST, or amqps://.
    prefix : str
        First part of the names of exchanges and queues.
    """
    celery = Celery(prefix, broker=broker_url, set_as_current=False, fixups=[])
    celery.conf.update(
        task_queues=[job_queue(name, prefix) for name in QueueName],
        task_default_queue=queue_name(QueueName.ONLINE, prefix),
        task_create_missing_queues=False,
        task_acks_late=True,
        task_reject_on_worker_lost=True,
        task_ignore_result=True,
        task_store_errors_even_if_ignored=False,
        task_serializer="json",
        accept_content=["json"],
        worker_prefetch_multiplier=1,
        worker_detect_quorum_queues=True,
        worker_consumer="app.jobs.celery_worker:JobConsumer",
        worker_enable_remote_control=False,
        worker_send_task_events=False,
        worker_hijack_root_logger=False,
        worker_redirect_stdouts=False,
        worker_cancel_long_running_tasks_on_connection_loss=False,
        broker_transport_options={"confirm_publish": True},
        broker_connection_timeout=ANSWER_S,
        broker_connection_retry_on_startup=True,
        broker_connection_max_retries=None,
        broker_heartbeat=_HEARTBEAT_S,
    )
    return celery


def queue_name(name: QueueName, prefix: str) -> str:
    """Name of a queue in the broker."""
    return f"{prefix}.{name}"


def dead_letter_name(prefix: str) -> str:
    """Name of the exchange and of the queue of dead letters."""
    return f"{prefix}.dead"


def job_queue(name: QueueName, prefix: str) -> Queue:
    """A queue of jobs: replicated, and with a limit on deliveries."""
    exchange = Exchange(prefix, type="direct", durable=True)
    full_name = queue_name(name, prefix)
    arguments = {
        "x-queue-type": "quorum",
        "x-delivery-limit": DELIVERY_LIMIT,
        "x-dead-letter-exchange": dead_letter_name(prefix),
    }
    return Queue(full_name, exchange, routing_key=full_name, durable=True, queue_arguments=arguments)


def dead_letter_queue(prefix: str) -> Queue:
    """The queue of dead letters."""
    name = dead_letter_name(prefix)
    arguments = {"x-queue-type": "quorum", "x-max-length": MAX_DEAD_LETTERS}
    exchange = Exchange(name, type="fanout", durable=True)
    return Queue(name, exchange, routing_key=name, durable=True, queue_arguments=arguments)


def declare_queues(connection: Any, prefix: str) -> None:
    """Create the exchanges and queues that do not exist yet."""
    with connection.channel() as channel:
        for queue in (dead_letter_queue(prefix), *(job_queue(name, prefix) for name in QueueName)):
            queue(channel).declare()
