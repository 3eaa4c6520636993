"""A worker: the server's use cases without HTTP, which take jobs from the broker's queues."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager

import structlog

from app.control.metrics import MetricsServer, ProcessMetrics
from app.decoding.frames import DecodePlates, decode_plates
from app.errors import InvalidParameter, Unavailable
from app.jobs.celery_queue import CeleryQueue
from app.jobs.celery_worker import CeleryWorker
from app.registry.database import Database, head_revision
from app.services.jobs import QueueName
from app.services.ports import utc_now
from app.settings import Settings
from app.wiring import Outside, connect_outside, make_use_cases

_LOG = structlog.get_logger(__name__)
_DATABASE_WITHIN_S = 60.0
_ASK_EVERY_S = 0.5


@contextmanager
def running_worker(
    settings: Settings,
    names: Sequence[QueueName] = tuple(QueueName),
    concurrency: int = 1,
    *,
    decode: DecodePlates = decode_plates,
) -> Iterator[CeleryWorker]:
    """A worker that takes jobs while the block runs; its running jobs are interrupted at the end and wait again.

    Raises
    ------
    InvalidParameter
        No broker is set.
    Unavailable
        The database does not answer, or has an older schema.
    """
    outside = connect_outside(settings, decode)
    if not isinstance(outside.queue, CeleryQueue):
        raise InvalidParameter(
            "a worker takes jobs from a broker, and none is set",
            field="WAYMARK_BROKER_URL",
            cure="set WAYMARK_BROKER_URL=amqp://..., or use waymark serve alone, which runs the jobs itself",
        )
    jobs = make_use_cases(settings, outside, decode).jobs
    worker = CeleryWorker(outside.queue, names, concurrency)
    try:
        _wait_for_database(outside.database)
        outside.blobs.open()
        outside.spool.open(alone=False)
        if settings.warm_decoders:
            outside.pool.warm()
        outside.queue.open(jobs)
        worker.open(jobs)
        with closing(metrics_server(settings, outside)):
            yield worker
    finally:
        outside.pool.close()
        worker.close()
        outside.queue.close()
        outside.database.close()


def metrics_server(settings: Settings, outside: Outside) -> MetricsServer:
    """What answers /metrics and /healthz of the worker."""
    metrics = ProcessMetrics(outside.database, outside.pool, utc_now)
    return MetricsServer(settings.host, settings.worker_metrics_port, metrics)


def _wait_for_database(database: Database) -> None:
    """Open the database as soon as it answers, which it may not while it starts, and the server has migrated it."""
    last_s = time.monotonic() + _DATABASE_WITHIN_S
    while True:
        try:
            database.open()
            if database.current_revision() == head_revision():
                return
            missing = Unavailable(
                f"{database.name} has another schema than this release",
                cure="run waymark migrate, or start waymark serve of this release",
            )
        except Unavailable as error:
            missing = error
        if time.monotonic() > last_s:
            raise missing
        _LOG.info("the worker waits for the database", why=missing.message)
        time.sleep(_ASK_EVERY_S)
