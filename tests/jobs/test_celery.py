"""The engine of many processes against a real RabbitMQ: turns, dead letters, lost messages, workers that die."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from kombu import Connection

from app import worker
from app.errors import InvalidParameter, ProcessStopped, Unavailable
from app.jobs.celery_queue import (
    DELIVERY_LIMIT,
    CeleryQueue,
    dead_letter_name,
    declare_queues,
    job_queue,
    make_celery,
    queue_name,
)
from app.jobs.celery_worker import CeleryWorker
from app.registry import agencies, jobs
from app.registry import jobs as store
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.jobs import JobKind, new_job
from app.registry.jobs import jobs as table
from app.services.jobs import Jobs, QueueName, RunningJob
from app.settings import Settings
from tests.brokers import find_broker, own_queues
from tests.databases import PostgresServer
from tests.http import WITHIN_S, wait_until


def now() -> datetime:
    return datetime.now(UTC)


class Handler:
    """Carries out jobs as their input says, in one transaction, and notes them."""

    def __init__(self, database: Database) -> None:
        self.database = database
        self.ran: list[str] = []
        self.held = threading.Event()
        self.held.set()
        self.failures: list[Exception] = []

    def run(self, job: RunningJob) -> None:
        self.ran.append(job.row.input["name"])
        assert self.held.wait(WITHIN_S)
        if self.failures:
            raise self.failures.pop()
        if job.row.input["name"] == "deadly":
            raise ProcessStopped("the file stopped the decoder process, twice", field="file")
        with self.database.write() as connection:
            job.finish(connection, {"answer": 42})


class Fleet:
    """A database, a broker with own queues, and a worker."""

    def __init__(self, database: Database, broker_url: str, prefix: str) -> None:
        self.database, self.url, self.prefix = database, broker_url, prefix
        self.handler = Handler(database)
        self.queue = CeleryQueue(make_celery(broker_url, prefix), prefix)
        handlers = dict.fromkeys(JobKind, self.handler)
        self.jobs = Jobs(database, now, handlers, self.queue)
        self.worker = CeleryWorker(self.queue, tuple(QueueName), 1)
        with database.write() as connection:
            self.agencies = [agencies.add_agency(connection, name, now()) for name in ("one", "two")]

    def add(self, name: str, agency: int = 0, kind: JobKind = JobKind.DECODE, *, submit: bool = True) -> str:
        """A job in the database, and its message."""
        job = new_job(kind, new_id(now()), self.agencies[agency], "x", now(), job_input={"name": name})
        with self.database.write() as connection:
            store.add_job(connection, job)
        if submit:
            self.queue.submit(job.id, job.agency_id, kind)
        return job.id

    def states(self, column: Any = table.c.state) -> dict[str, Any]:
        with self.database.read() as connection:
            return {row.id: row.value for row in connection.execute(sa.select(table.c.id, column.label("value")))}

    def wait_for(self, *states: str) -> None:
        wait_until(lambda: set(self.states().values()) <= set(states), f"all jobs to be {states}")

    def messages(self, name: str) -> int:
        with Connection(self.url) as connection, connection.channel() as channel:
            return int(channel.queue_declare(name, passive=True).message_count)


@pytest.fixture
def fleet(postgres: PostgresServer) -> Iterator[Fleet]:
    database, broker_url = Database(postgres.empty()), find_broker()
    database.open()
    database.migrate()
    with own_queues(broker_url) as prefix:
        made = Fleet(database, broker_url, prefix)
        made.queue.open(made.jobs)
        yield made
        made.handler.held.set()
        made.worker.close()
        made.queue.close()
    database.close()


def test_a_job_waits_for_the_running_one_not_for_those_of_another_agency(fleet: Fleet) -> None:
    fleet.handler.held.clear()
    for number in range(10):
        fleet.add(f"one {number}")
    fleet.worker.open(fleet.jobs)
    wait_until(lambda: fleet.handler.ran, "the first job to run")
    fleet.add("other", agency=1)
    fleet.handler.held.set()
    fleet.wait_for("done")
    assert fleet.handler.ran[:2] == ["one 0", "other"]
    assert len(fleet.handler.ran) == len(set(fleet.handler.ran)) == 11


def test_a_long_job_of_one_queue_holds_up_none_of_another(fleet: Fleet) -> None:
    fleet.handler.held.clear()
    fleet.worker.open(fleet.jobs)
    names = {"plan": JobKind.PLAN, "upload": JobKind.DECODE, "log": JobKind.AUDIT}
    for name, kind in names.items():
        fleet.add(name, kind=kind)
    wait_until(lambda: set(fleet.handler.ran) == set(names), "a job of each queue to run")
    fleet.handler.held.set()
    fleet.wait_for("done")


def test_a_job_that_stops_its_process_is_a_dead_letter_and_others_go_on(fleet: Fleet) -> None:
    fleet.worker.open(fleet.jobs)
    deadly = fleet.add("deadly")
    others = [fleet.add(f"good {number}") for number in range(3)]
    fleet.wait_for("done", "failed")
    assert fleet.states() == {deadly: "failed", **dict.fromkeys(others, "done")}
    assert fleet.states(table.c.dead_letter) == {deadly: True, **dict.fromkeys(others, False)}
    name = dead_letter_name(fleet.prefix)
    wait_until(lambda: fleet.messages(name) == 1, "the dead letter")
    with Connection(fleet.url) as connection, connection.channel() as channel:
        letter = json.loads(channel.basic_get(name, no_ack=True).body)
    assert letter == {"job_id": deadly, "kind": "decode", "reason": "the file stopped the decoder process, twice"}


@pytest.mark.parametrize(
    ("argument", "other", "shown"),
    [("x-delivery-limit", 7, str(DELIVERY_LIMIT)), ("x-dead-letter-exchange", "other", "PREFIX.dead")],
)
def test_the_broker_has_the_limits_of_the_queues(fleet: Fleet, argument: str, other: object, shown: str) -> None:
    queue = job_queue(QueueName.ONLINE, fleet.prefix)
    with Connection(fleet.url) as connection, connection.channel() as channel:
        declare_queues(connection, fleet.prefix)
        arguments = {**queue.queue_arguments, argument: other}
        stored = shown.replace("PREFIX", fleet.prefix)
        with pytest.raises(connection.channel_errors, match=f"inequivalent arg '{argument}'.*current is '{stored}'"):
            channel.queue_declare(queue.name, durable=True, auto_delete=False, arguments=arguments)


def test_a_message_that_no_worker_survives_is_a_dead_letter(fleet: Fleet) -> None:
    name, dead = queue_name(QueueName.ONLINE, fleet.prefix), dead_letter_name(fleet.prefix)
    with Connection(fleet.url) as connection, connection.channel() as channel:
        declare_queues(connection, fleet.prefix)
        fleet.add("never run")
        wait_until(lambda: fleet.messages(name) == 1, "the message")
        for _ in range(DELIVERY_LIMIT + 1):
            message = wait_until(lambda: channel.basic_get(name), "the message again")
            channel.basic_reject(message.delivery_tag, requeue=True)
        wait_until(lambda: fleet.messages(dead) == 1, "the dead letter")
        assert channel.basic_get(name) is None
        assert channel.basic_get(dead, no_ack=True).headers["x-death"][0]["reason"] == "delivery_limit"


def test_a_job_waits_while_a_store_does_not_answer(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.jobs.celery_worker._RETRY_S", 0.01)
    fleet.handler.failures = [Unavailable("no answer"), Unavailable("no answer")]
    fleet.worker.open(fleet.jobs)
    job = fleet.add("patient")
    fleet.wait_for("done")
    assert fleet.handler.ran == ["patient"] * 3
    assert fleet.states(table.c.attempts) == {job: 1}


def test_lost_messages_are_replaced_and_no_more(fleet: Fleet) -> None:
    for number in range(5):
        fleet.add(f"{number}", submit=False)
    for _ in range(3):
        fleet.queue.resubmit(fleet.jobs)
    assert fleet.messages(queue_name(QueueName.ONLINE, fleet.prefix)) == 5
    fleet.worker.open(fleet.jobs)
    fleet.wait_for("done")
    assert sorted(fleet.handler.ran) == [f"{number}" for number in range(5)]


def test_the_job_of_a_dead_worker_runs_again_when_its_lease_has_ended(fleet: Fleet) -> None:
    job = fleet.add("orphan", submit=False)
    with fleet.database.write() as connection:
        assert jobs.start_job(connection, job, now(), "a dead worker") is not None
        assert jobs.start_job(connection, job, now(), "another") is None
        assert jobs.count_startable(connection, now()) == {}
        past = now() - timedelta(seconds=1)
        connection.execute(sa.update(table).where(table.c.id == job).values(lease_until=past))
    fleet.queue.resubmit(fleet.jobs)
    fleet.worker.open(fleet.jobs)
    fleet.wait_for("done")
    assert fleet.states(table.c.attempts) == {job: 2}


def test_a_running_job_keeps_its_lease(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.services.jobs.RENEW_S", 0.01)
    fleet.handler.held.clear()
    fleet.worker.open(fleet.jobs)
    job = fleet.add("long")
    wait_until(lambda: fleet.handler.ran, "the job to run")
    first = fleet.states(table.c.lease_until)[job]
    wait_until(lambda: fleet.states(table.c.lease_until)[job] > first, "the lease to be renewed")
    fleet.handler.held.set()
    fleet.wait_for("done")


def test_a_job_is_accepted_while_the_broker_does_not_answer(postgres: PostgresServer) -> None:
    database = Database(postgres.empty())
    database.open()
    database.migrate()
    fleet = Fleet(database, "amqp://guest:guest@127.0.0.1:1", "waymark_test_nowhere")
    fleet.queue.open(fleet.jobs)
    began = time.monotonic()
    fleet.queue.submit(fleet.add("waiting", submit=False), fleet.agencies[0], JobKind.DECODE)
    assert time.monotonic() - began < WITHIN_S
    fleet.queue.resubmit(fleet.jobs)
    assert set(fleet.states().values()) == {"queued"}
    fleet.queue.close()
    database.close()


@pytest.mark.parametrize(
    ("chosen", "named"),
    [
        ({"database_url": ""}, "WAYMARK_DATABASE_URL"),
        ({"blobs_shared": False}, "WAYMARK_BLOBS_SHARED"),
        ({"broker_url": "redis://127.0.0.1"}, "amqp://"),
    ],
)
def test_a_broker_needs_stores_that_workers_share(chosen: dict[str, Any], named: str) -> None:
    whole: dict[str, Any] = {
        "broker_url": "amqp://guest:guest@127.0.0.1", "database_url": "postgresql+psycopg:///x", "blobs_shared": True,
    }  # fmt: skip
    Settings(**whole)
    with pytest.raises(ValueError, match=named):
        Settings(**{**whole, **chosen})


def test_a_worker_needs_a_broker(settings: Settings) -> None:
    from app.worker import running_worker

    with pytest.raises(InvalidParameter, match="none is set"), running_worker(settings):
        pass


def test_a_worker_waits_for_its_database(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[float] = []

    def away(_database: Database) -> None:
        opened.append(time.monotonic())
        raise Unavailable("the database is starting up")

    monkeypatch.setattr(Database, "open", away)
    monkeypatch.setattr(worker, "_DATABASE_WITHIN_S", 1.0)
    broker_url = "amqp://guest:guest@127.0.0.1:1"
    url = "postgresql+psycopg:///absent?host=/nowhere"
    settings = Settings(data_dir=tmp_path, database_url=url, broker_url=broker_url, blobs_shared=True)
    with pytest.raises(Unavailable, match="is starting up"), worker.running_worker(settings):
        pass
    assert len(opened) > 1
