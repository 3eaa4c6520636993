"""The job queue of many processes: messages in RabbitMQ announce work, the jobs' rows define it.

A message wakes a worker, which then runs the job of its queue whose turn it is (`Jobs.run_next`), so that one agency's
thousand jobs do not hold up another's. A message too few is replaced, one too many finds nothing to do.
"""

from __future__ import annotations

import threading
from collections import Counter
from contextlib import AbstractContextManager, suppress
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple, Protocol

import structlog
from celery import Celery
from kombu import Exchange, Queue
from kombu.exceptions import KombuError

from app.jobs.queues import Resubmission
from app.registry.jobs import JobKind
from app.services.jobs import QUEUES, QueueName

# === Celery's settings: quorum queues, confirmed publishing, messages that are acknowledged when their job ended.


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


# === The job queue of many processes.


_LOG = structlog.get_logger(__name__)
_AGAIN_S = 1.0
_CLOSE_S = 2.0


class CountedJobs(Protocol):
    """What counts jobs: `app.services.jobs.Jobs`."""

    def counted(self) -> AbstractContextManager[dict[JobKind, int] | None]:
        """Numbers of jobs that nobody runs; None while another process counts them."""


class _Token(NamedTuple):
    """There is a job in a queue."""

    job_id: str
    queue: QueueName


class _DeadLetter(NamedTuple):
    job_id: str
    kind: JobKind
    reason: str


class CeleryQueue:
    """Publishes messages on jobs, with confirms, in a thread: no request waits for the broker.

    If the broker does not answer, the job's row is stored all the same, and a message follows when it answers again.

    Parameters
    ----------
    celery : Celery
        From `make_celery`.
    """

    def __init__(self, celery: Celery, prefix: str) -> None:
        self.celery, self.prefix = celery, prefix
        self._queues = {name: job_queue(name, prefix) for name in QueueName}
        self._waiting: SimpleQueue[_Token | _DeadLetter | None] = SimpleQueue()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._publish_all, name="jobs-publisher", daemon=True)
        self._resubmission: Resubmission | None = None

    def open(self, jobs: CountedJobs) -> None:
        """Start to publish, and to replace messages that are missing."""
        self._thread.start()
        self._resubmission = Resubmission(lambda: self.resubmit(jobs))

    def submit(self, job_id: str, agency_id: str, kind: JobKind) -> None:
        """Publish that there is a job."""
        self._waiting.put(_Token(job_id, QUEUES[kind]))

    def wake(self, queue: QueueName) -> None:
        """Publish that there is a job of any kind of a queue."""
        self._waiting.put(_Token("", queue))

    def bury(self, job_id: str, kind: JobKind, reason: str) -> None:
        """Publish a dead letter."""
        self._waiting.put(_DeadLetter(job_id, kind, reason))

    def close(self) -> None:
        """Publish what is waiting, unless the broker does not answer."""
        if self._resubmission is not None:
            self._resubmission.close()
        self._closing.set()
        self._waiting.put(None)
        if self._thread.is_alive():
            self._thread.join(_CLOSE_S)

    def resubmit(self, jobs: CountedJobs) -> None:
        """Publish as many messages as jobs have none. One process at a time does so."""
        with jobs.counted() as counts:
            if counts is None:
                return
            waiting: Counter[QueueName] = Counter()
            for kind, number in counts.items():
                waiting[QUEUES[kind]] += number
            if not waiting:
                return
            try:
                with self.celery.connection_for_write() as connection:
                    self._replace_missing(connection, waiting)
            except (*connection_errors(self.celery), KombuError) as error:
                _LOG.warning("the broker does not answer", why=str(error)[:200])

    def _replace_missing(self, connection: Any, waiting: Counter[QueueName]) -> None:
        declare_queues(connection, self.prefix)
        with connection.Producer() as producer:
            for name, number in waiting.items():
                there = self._queues[name](producer.channel).queue_declare(passive=True).message_count
                for _ in range(number - there):
                    self._publish(producer, _Token("", name))

    # --- the thread ---------------------------------------------------------------------------------------------------

    def _publish_all(self) -> None:
        kept: _DeadLetter | None = None
        while True:
            try:
                with self.celery.connection_for_write() as connection:
                    declare_queues(connection, self.prefix)
                    with connection.Producer() as producer:
                        if kept is not None:
                            self._publish(producer, kept)
                            kept = None
                        while (message := self._next(connection)) is not None:
                            kept = message if isinstance(message, _DeadLetter) else None
                            self._publish(producer, message)
                            kept = None
                return
            except (*connection_errors(self.celery), KombuError) as error:
                _LOG.warning("the broker does not answer", why=str(error)[:200])
            if self._closing.wait(_AGAIN_S):
                return
            self._forget_tokens()

    def _next(self, connection: Any) -> _Token | _DeadLetter | None:
        """The next message; heartbeats are sent while there is none."""
        while True:
            try:
                return self._waiting.get(timeout=_AGAIN_S)
            except Empty:
                connection.heartbeat_check()
                with suppress(TimeoutError):
                    connection.drain_events(timeout=0.001)

    def _forget_tokens(self) -> None:
        """`resubmit` publishes them when the broker answers again; dead letters are kept."""
        letters = []
        with suppress(Empty):
            while True:
                message = self._waiting.get_nowait()
                if not isinstance(message, _Token):
                    letters.append(message)
        for message in letters:
            self._waiting.put(message)

    def _publish(self, producer: Any, message: _Token | _DeadLetter) -> None:
        if isinstance(message, _Token):
            self.celery.send_task(
                TASK, args=[message.job_id, message.queue.value], producer=producer,
                queue=self._queues[message.queue], retry=False, confirm_timeout=ANSWER_S,
            )  # fmt: skip
            return
        queue = dead_letter_queue(self.prefix)
        producer.publish(
            message._asdict(), exchange=queue.exchange, routing_key=queue.routing_key, serializer="json",
            delivery_mode="persistent", confirm_timeout=ANSWER_S,
        )  # fmt: skip


def connection_errors(celery: Celery) -> tuple[type[Exception], ...]:
    """What a broker that does not answer raises."""
    connection = celery.connection_for_write()
    return (*connection.connection_errors, *connection.channel_errors, TimeoutError)
