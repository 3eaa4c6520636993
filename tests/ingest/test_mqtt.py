"""Uplinks through a real broker into a real server."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import paho.mqtt.client as mqtt
import pytest
from paho.mqtt.enums import CallbackAPIVersion

from app.demo.cerpms import BuiltLane, build_lane
from app.demo.server import free_ports
from app.encoders.cerpm import encode_message
from app.errors import InvalidParameter, NotAllowed, Unavailable
from app.ingest import MqttIngest, MqttSource, Sink
from app.main import create_app
from app.services.access.access import Scope
from app.settings import Settings
from app.simulation.radio.drive import drive_past
from app.simulation.radio.link import Radio
from tests.api.decodes.test_packets import chirpstack_uplink
from tests.conftest import ADMIN_KEY, LiveServer
from tests.http import WITHIN_S, wait_until
from tests.jobs import standin
from tests.machine import refuse

pytestmark = pytest.mark.slow

BROKER = ("127.0.0.1", 1883)


@pytest.fixture(scope="module")
def broker() -> str:
    """The broker of this machine."""
    try:
        socket.create_connection(BROKER, timeout=2).close()
    except OSError:
        refuse(f"no MQTT broker, e.g. Debian's mosquitto, listens on port {BROKER[1]}")
    return f"mqtt://{BROKER[0]}:{BROKER[1]}"


@pytest.fixture(scope="module")
def road(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[LiveServer, httpx.Client, BuiltLane, str]]:
    """A server with markers along a lane, and a vehicle's key."""
    settings = Settings(data_dir=tmp_path_factory.mktemp("mqtt") / "var", admin_key=ADMIN_KEY, decode_workers=1)
    with LiveServer(create_app(settings, decode=standin.decode)) as server, server.client() as client:
        key = server.app.state.use_cases.access.create_key("default", Scope.VEHICLE, "receivers")
        yield server, client, build_lane(client, np.random.default_rng(1950)), key


def uplinks(built: BuiltLane, seed: int) -> list[dict[str, Any]]:
    """What a network server publishes of a drive."""
    start = np.full(len(built.installed), seed * 1000)
    heard = drive_past(
        built.lane, built.installed, np.random.default_rng(seed), radio=Radio(interval_s=2.0), first_sequence=start,
        start_s=1.78e9 + seed * 10_000.0, sign=lambda m: encode_message(m, built.keys[m.number]),
    )  # fmt: skip
    return [chirpstack_uplink(packet) for packet in heard.packets]


def publish(topic: str, messages: list[dict[str, Any] | str]) -> None:
    client = mqtt.Client(CallbackAPIVersion.VERSION2)
    client.connect(*BROKER)
    client.loop_start()
    sent = [client.publish(topic, m if isinstance(m, str) else json.dumps(m), qos=1) for m in messages]
    for info in sent:
        info.wait_for_publish(WITHIN_S)
    client.disconnect()
    client.loop_stop()


class Running:
    """An ingest in a thread of its own."""

    def __init__(self, source: MqttSource, sink: Sink, folder: Path) -> None:
        self.decodes: list[dict[str, Any]] = []
        self.error: Exception | None = None
        self.ingest = MqttIngest(source, sink, folder, self.decodes.append)
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        try:
            self.ingest.run()
        except Exception as error:  # noqa: BLE001 - the test looks at it
            self.error = error

    def __enter__(self) -> Running:
        self._thread.start()
        assert self.ingest.listening.wait(WITHIN_S)
        return self

    def __exit__(self, *_: object) -> None:
        self.ingest.stop()
        self._thread.join(WITHIN_S)
        assert not self._thread.is_alive()

    @property
    def authentic(self) -> int:
        return sum(decode["report"]["verdicts"]["authentic"] for decode in self.decodes)


def test_uplinks_become_decodes_and_nothing_else_does(
    broker: str, road: tuple[LiveServer, httpx.Client, BuiltLane, str], tmp_path: Path
) -> None:
    server, client, built, key = road
    name = uuid.uuid4().hex
    topic = f"application/{name}/device/0011223344556677/event/up"
    source = MqttSource(broker, (f"application/{name}/device/+/event/up",), client_id=f"test-{name}")
    messages = uplinks(built, 51)
    with Running(source, Sink(server.url, key, {"packets": {}}, batch_s=1.0), tmp_path) as running:
        publish(topic, [*messages, "no JSON", "[1, 2]"])
        wait_until(lambda: running.authentic >= len(messages), "the packets")
    assert running.error is None
    assert running.authentic == len(messages)
    assert list(tmp_path.glob("batch-*")) == []
    stored = client.get("/v1/decodes").json()["items"]
    assert {decode["id"] for decode in running.decodes} <= {decode["id"] for decode in stored}


def test_a_server_that_is_away_costs_time_not_packets(
    broker: str, road: tuple[LiveServer, httpx.Client, BuiltLane, str], tmp_path: Path
) -> None:
    server, _client, built, key = road
    name = uuid.uuid4().hex
    topic = f"application/{name}/device/00/event/up"
    source = MqttSource(broker, (topic,), client_id=f"test-{name}")
    messages = uplinks(built, 52)
    nowhere = f"http://127.0.0.1:{free_ports(1)[0]}"
    half = len(messages) // 2
    with Running(source, Sink(nowhere, key, {"packets": {}}, batch_s=0.3), tmp_path) as away:
        publish(topic, messages[:half])
        wait_until(lambda: sum(b.read_bytes().count(b"\n") for b in tmp_path.glob("batch-*")) >= half, "the spool")
    assert away.error is None
    assert away.decodes == []
    publish(topic, messages[half:])  # nobody listens now: the broker keeps them
    with Running(source, Sink(server.url, key, {"packets": {}}, batch_s=0.3), tmp_path) as back:
        wait_until(lambda: back.authentic >= len(messages), "the packets")
    assert back.authentic == len(messages)
    assert list(tmp_path.glob("batch-*")) == []


def test_a_batch_that_is_refused_for_good_is_put_aside(
    broker: str, road: tuple[LiveServer, httpx.Client, BuiltLane, str], tmp_path: Path
) -> None:
    server, _client, _built, key = road
    topic = f"cerpms/{uuid.uuid4().hex}"
    source = MqttSource(broker, (topic,), client_id=f"test-{uuid.uuid4().hex}")
    with Running(source, Sink(server.url, key, {"packets": {}}, batch_s=0.3), tmp_path) as running:
        publish(topic, [{"this is": "no uplink"}])
        wait_until(lambda: any((tmp_path / "refused").glob("*.problem.json")), "the refusal")
    problem = json.loads(next((tmp_path / "refused").glob("*.problem.json")).read_bytes())
    assert problem["status"] in (415, 422)
    assert running.error is None
    assert list(tmp_path.glob("batch-*")) == []


def test_who_is_not_let_in_is_told(
    broker: str, road: tuple[LiveServer, httpx.Client, BuiltLane, str], tmp_path: Path
) -> None:
    server = road[0]
    topic = f"cerpms/{uuid.uuid4().hex}"
    source = MqttSource(broker, (topic,), client_id=f"test-{uuid.uuid4().hex}")
    with Running(source, Sink(server.url, "no such key", {"packets": {}}, batch_s=0.2), tmp_path) as running:
        publish(topic, [{"payload": "00"}])
        wait_until(lambda: running.error is not None, "the refusal")
    assert isinstance(running.error, NotAllowed)
    assert list(tmp_path.glob("batch-*"))  # it waits for a better key
    with pytest.raises(Unavailable, match="does not answer"):
        MqttIngest(MqttSource("mqtt://127.0.0.1:1"), Sink("http://x", "k"), tmp_path / "other").run()
    with pytest.raises(InvalidParameter, match="no address of a broker"):
        MqttSource("http://127.0.0.1")


def test_the_command_sends_what_it_has_when_it_is_stopped(
    broker: str, road: tuple[LiveServer, httpx.Client, BuiltLane, str], tmp_path: Path
) -> None:
    server, client, built, key = road
    topic = f"application/{uuid.uuid4().hex}/device/00/event/up"
    messages = uplinks(built, 53)
    before = len(client.get("/v1/decodes").json()["items"])
    command = [sys.executable, "-c", "from app.cli import main; main()", "ingest", "mqtt", "--broker", broker]
    options = ["--server", server.url, "--topic", topic, "--client-id", topic[-8:], "--spool", str(tmp_path / "spool")]
    process = subprocess.Popen(
        [*command, *options, "--batch-s", "600"], env={**os.environ, "WAYMARK_KEY": key}, stderr=subprocess.PIPE
    )
    assert process.stderr is not None
    line = b""
    while b"listening" not in line:
        line = process.stderr.readline()
        assert line
    publish(topic, messages)
    spool = tmp_path / "spool" / "collecting.jsonl"
    wait_until(lambda: spool.exists() and spool.read_bytes().count(b"\n") == len(messages), "the spool")
    process.send_signal(signal.SIGTERM)
    _out, told = process.communicate(timeout=WITHIN_S)
    assert process.returncode == 0, told.decode()
    assert len(client.get("/v1/decodes").json()["items"]) == before + 1
    assert not spool.read_bytes()
