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
from kombu.exceptions import KombuError

from app.jobs.celery_app import ANSWER_S, TASK, dead_letter_queue, declare_queues, job_queue
from app.jobs.resubmission import Resubmission
from app.registry.jobs import JobKind
from app.services.job_queues import QUEUES, QueueName

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
    prefix : str
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
