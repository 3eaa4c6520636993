"""A Celery worker whose threads run jobs. Decoder processes do the work, so a thread waits for most of its time.

Threads, and not Celery's processes: a file can stop a decoder process, not the worker, so a process for each job would
protect nothing, and all jobs of a worker share its decoder processes.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any, Protocol

import structlog
from celery.worker import WorkController, state
from celery.worker.consumer import Consumer

from app.errors import Unavailable
from app.jobs.celery_queue import TASK, CeleryQueue, queue_name
from app.registry.jobs import JobKind
from app.services.jobs import QueueName, kinds_in

_LOG = structlog.get_logger(__name__)
_RETRY_S = 2.0
_DELAYED = "celery.worker.consumer.delayed_delivery:DelayedDelivery"


class NextJobs(Protocol):
    """What runs jobs: `app.services.jobs.Jobs`."""

    def run_next(self, kinds: Sequence[JobKind]) -> bool:
        """Run the job of some kinds whose turn it is."""


class JobConsumer(Consumer):  # type: ignore[misc]
    """Takes no more messages from each queue than the worker has threads for it, and needs no queues of delays."""

    class Blueprint(Consumer.Blueprint):  # type: ignore[misc]
        """Celery's, without the 28 queues for messages with delays, which no job has."""

        default_steps = [step for step in Consumer.Blueprint.default_steps if step != _DELAYED]  # noqa: RUF012

    def __init__(self, *arguments: Any, app: Any, initial_prefetch_count: int, **options: Any) -> None:
        queues = len(app.amqp.queues.consume_from)
        super().__init__(*arguments, app=app, initial_prefetch_count=initial_prefetch_count // queues, **options)


class CeleryWorker:
    """Takes messages from queues and runs a job for each.

    Parameters
    ----------
    concurrency : int
        Jobs of each queue that run at the same time: long ones of one queue hold up none of another.
    """

    def __init__(self, queue: CeleryQueue, names: Sequence[QueueName], concurrency: int) -> None:
        self._queue, self._names, self._concurrency = queue, names, concurrency
        self._closing = threading.Event()
        self._ready = threading.Event()
        self._controller: Any = None
        self._thread: threading.Thread | None = None

    def open(self, jobs: NextJobs) -> None:
        """Start to take messages; if the broker does not answer, as soon as it does."""
        celery = self._queue.celery

        def run_job(_job_id: str, queue: str) -> None:
            self._run(jobs, QueueName(queue))

        celery.task(run_job, name=TASK, shared=False)
        celery.finalize()
        celery.set_default()  # the threads of the pool look the task up in the default application
        self._controller = WorkController(
            app=celery, pool_cls="threads", concurrency=self._concurrency * len(self._names),
            queues=[queue_name(name, self._queue.prefix) for name in self._names], hostname=None,
            without_heartbeat=True, without_mingle=True, without_gossip=True, ready_callback=self._is_ready,
        )  # fmt: skip
        state.should_stop = None
        self._thread = threading.Thread(target=self._controller.start, name="jobs-worker", daemon=True)
        self._thread.start()

    def wait_until_ready(self, timeout_s: float) -> bool:
        """Whether it takes messages within a time."""
        return self._ready.wait(timeout_s)

    @property
    def is_running(self) -> bool:
        """Whether it has not ended by itself."""
        return self._thread is not None and self._thread.is_alive()

    def close(self) -> None:
        """Stop after the running jobs; close the decoder processes first to interrupt those."""
        self._closing.set()
        if self._thread is not None:
            state.should_stop = 0
            self._thread.join()
            state.should_stop = None

    def _is_ready(self, _consumer: object) -> None:
        self._ready.set()

    def _run(self, jobs: NextJobs, name: QueueName) -> None:
        if self._closing.is_set():
            self._queue.wake(name)
            return
        try:
            jobs.run_next(kinds_in(name))
        except Unavailable as error:
            _LOG.warning("a job is tried again later", queue=name.value, why=error.message)
            self._closing.wait(_RETRY_S)
            self._queue.wake(name)
        except Exception:  # noqa: BLE001 - the next job must still run; this one is submitted again
            _LOG.exception("a job stopped on an error", queue=name.value)
