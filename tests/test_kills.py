"""The short mode of the benchmark of kills, and a broker that is away. Broker and database are the tests' own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from kombu import Connection

from app.jobs import queues
from app.jobs.celery_queue import queue_name
from app.main import create_app
from app.services.jobs import QueueName
from app.settings import Settings
from app.worker import running_worker
from benchmarks.service.kills import Fleet, Result, measure_embedded, measure_fleet, own_nodes
from benchmarks.service.nodes import Broker, PostgresCluster, missing_programs
from tests.api.decodes.conftest import post_frame
from tests.api.decodes.test_archives import pack
from tests.conftest import ADMIN_KEY, UNLIMITED, LiveServer
from tests.formats.pictures import png
from tests.http import finished, wait_until
from tests.jobs import standin
from tests.machine import refuse

pytestmark = [
    pytest.mark.slow,
    # Celery warns of its default whenever a connection is lost; as an error it would end the worker
    pytest.mark.filterwarnings("ignore::celery.exceptions.CPendingDeprecationWarning"),
]
SEED, WRITE_S = 15, 1.0


@pytest.fixture(scope="module")
def nodes() -> Iterator[tuple[Broker, PostgresCluster]]:
    """A RabbitMQ node and a PostgreSQL cluster that may be killed."""
    if missing := missing_programs():
        refuse(f"not installed: {missing}")
    with own_nodes() as made:
        yield made


def check(result: Result, kills: dict[str, int]) -> None:
    """Nothing is lost, and there was something of everything that could have been."""
    assert result.faults == []
    assert result.kills == kills
    done = result.done
    assert all((done.uploads, done.jobs, done.imports, done.plans, done.markers)), result.table()


def test_an_embedded_service_that_is_killed_loses_nothing() -> None:
    check(measure_embedded(2, SEED, WRITE_S), {"web": 1, "child": 1})


def test_a_fleet_of_which_everything_is_killed_loses_nothing(nodes: tuple[Broker, PostgresCluster]) -> None:
    check(measure_fleet(*nodes, len(Fleet.victims), SEED, WRITE_S), dict.fromkeys(Fleet.victims, 1))


def test_uploads_wait_for_a_broker_that_is_away(
    nodes: tuple[Broker, PostgresCluster], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(queues, "RESUBMIT_S", 0.2)
    broker, cluster = nodes
    cluster.make_database()
    settings = Settings(
        data_dir=tmp_path / "var", database_url=cluster.url, admin_key=ADMIN_KEY, warm_decoders=False, decode_workers=1,
        broker_url=broker.url, broker_prefix="away", blobs_shared=True, **UNLIMITED,
    )  # fmt: skip
    archive = pack({"0.png": png(standin.frame_that(standin.OBEY))})
    with LiveServer(create_app(settings, decode=standin.decode)) as server, server.client() as client:
        answers = [post_frame(client, archive, name="drive.zip")]
        wait_until(lambda: _messages(broker) >= 1, "the message")  # unfinished jobs are sent again
        broker.kill()
        answers.append(post_frame(client, archive, name="drive.zip"))
        assert client.get("/readyz").status_code == 200
        broker.start()
        assert [answer.status_code for answer in answers] == [202, 202], [answer.text for answer in answers]
        wait_until(lambda: _messages(broker) >= len(answers), "a message for each upload")
        with running_worker(settings, (QueueName.ONLINE,), decode=standin.decode):
            jobs = [finished(client, answer.headers["Location"]) for answer in answers]
    assert [(job["state"], job["attempts"]) for job in jobs] == [("done", 1)] * 2, jobs


def _messages(broker: Broker) -> int:
    with Connection(broker.url) as connection, connection.channel() as channel:
        try:
            return int(channel.queue_declare(queue_name(QueueName.ONLINE, "away"), passive=True).message_count)
        except connection.channel_errors:
            return 0
