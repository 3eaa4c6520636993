"""Live sources of uploads: messages of a broker are collected, stored on disk and sent to the server."""

from __future__ import annotations

import os
import queue
import threading
import time
import uuid
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import httpx
import orjson
import paho.mqtt.client as mqtt
import structlog
from paho.mqtt.enums import CallbackAPIVersion

from app.errors import InvalidParameter, NotAllowed, Unavailable
from app.values import JsonObject

# === Messages on disk until the server has accepted them. No message that was acknowledged to a broker is lost.


_COLLECTING = "collecting.jsonl"
_BATCH = "batch-*.jsonl"


class Spool:
    """A folder of messages as JSON lines: one file that is appended to, and batches that wait to be sent.

    Parameters
    ----------
    folder : Path
        Created if need be; one process at a time.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._refused = folder / "refused"
        self._refused.mkdir(parents=True, exist_ok=True)
        self._file = (folder / _COLLECTING).open("ab")
        self.messages = self._count()
        """Number of messages in the file that is appended to."""

    def add(self, messages: Iterable[JsonObject]) -> None:
        """Append messages; they are on the disk when this returns."""
        lines = [orjson.dumps(message) + b"\n" for message in messages]
        self._file.write(b"".join(lines))
        self._file.flush()
        os.fsync(self._file.fileno())
        self.messages += len(lines)

    def cut(self) -> Path | None:
        """Turn the collected messages into a batch; its name stays its idempotency key."""
        if not self.messages:
            return None
        self._file.close()
        batch = self._folder / f"batch-{uuid.uuid4()}.jsonl"
        (self._folder / _COLLECTING).rename(batch)
        self._file = (self._folder / _COLLECTING).open("ab")
        self.messages = 0
        return batch

    def list_batches(self) -> list[Path]:
        """Batches that wait, oldest first."""
        return sorted(self._folder.glob(_BATCH), key=lambda path: path.stat().st_mtime_ns)

    def refuse(self, batch: Path, why: JsonObject) -> None:
        """Set aside a batch that the server refused finally, with the problem document."""
        (self._refused / f"{batch.stem}.problem.json").write_bytes(orjson.dumps(why, option=orjson.OPT_INDENT_2))
        batch.rename(self._refused / batch.name)

    def close(self) -> None:
        """Close the file that is appended to."""
        self._file.close()

    def _count(self) -> int:
        path = self._folder / _COLLECTING
        content = path.read_bytes()
        if content and not content.endswith(
            b"\n"
        ):  # the machine stopped in the middle of a line, before it was acknowledged
            whole = content[: content.rfind(b"\n") + 1]
            path.write_bytes(whole)
            content = whole
        return content.count(b"\n")


# === Uplinks from an MQTT broker (ChirpStack, The Things Stack, a receiver's own), sent to the server as packet logs.
#
# Each message is written to the spool before it is acknowledged, and each batch is sent under a key of its own until
# the server has it: a broker, a server or a process that stops in between costs time, not packets.


DEFAULT_TOPICS = ("application/+/device/+/event/up", "v3/+/devices/+/up")
_MAX_TEXT_BYTES = 256 * 1024  # [byte] longest message that is stored
_RETRY_S = (1.0, 60.0)
_LOG = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class MqttSource:
    """The broker that uplinks come from."""

    url: str  # mqtt://[USER:PASSWORD@]HOST[:PORT], or mqtts:// for TLS
    topics: tuple[str, ...] = DEFAULT_TOPICS  # ChirpStack v4 and The Things Stack v3 unless others are named
    client_id: str = "waymark-ingest"  # the broker keeps what it could not deliver under this name

    def __post_init__(self) -> None:
        parts = urlsplit(self.url)
        if parts.scheme not in ("mqtt", "mqtts") or not parts.hostname:
            raise InvalidParameter(
                f"{self.url} is no address of a broker",
                field="broker",
                limit="mqtt://HOST[:PORT] or mqtts://HOST[:PORT]",
            )
        if not self.topics or not self.client_id:
            raise InvalidParameter("a topic and a client id are needed", field="topic")


@dataclass(frozen=True, slots=True)
class Sink:
    """The server that packet logs are sent to."""

    # `server`, `key`: waymark's URL and a key with the scope `vehicle`
    server: str
    key: str
    context: JsonObject = field(default_factory=dict)  # of each upload, as POST /v1/decodes takes it
    # `batch_messages`, `batch_s`: [s] a batch is sent when it has so many messages, or is so old
    batch_messages: int = 1000
    batch_s: float = 10.0


class MqttIngest:
    """Collects uplinks and sends them on, until `stop` is called.

    Parameters
    ----------
    folder : Path
        Of the spool.
    on_decode : callable, optional
        Gets each decode that the server answers with.
    """

    def __init__(
        self, source: MqttSource, sink: Sink, folder: Path, on_decode: Callable[[JsonObject], None] | None = None
    ) -> None:
        self._source, self._sink = source, sink
        self._spool = Spool(folder)
        self._on_decode = on_decode or (lambda _decode: None)
        self._messages: queue.SimpleQueue[mqtt.MQTTMessage | None] = queue.SimpleQueue()
        self._stopping = threading.Event()
        self.listening = threading.Event()
        """Set when the broker has accepted the subscription."""
        self._fatal: Exception | None = None
        self._client = self._make_client()
        self._http = httpx.Client(base_url=sink.server, headers={"Authorization": f"Bearer {sink.key}"}, timeout=120)

    def run(self) -> None:
        """Collect and send until `stop`; then send what was collected.

        Raises
        ------
        Unavailable
            The broker cannot be reached at the start.
        NotAllowed
            The broker or the server refuses to let this client in.
        """
        try:
            self._connect()
            self._client.loop_start()
            self._collect()
        finally:
            self._client.disconnect()
            self._client.loop_stop()
            self._spool.close()
            self._http.close()
        if self._fatal is not None:
            raise self._fatal

    def stop(self) -> None:
        """End `run`; may be called from a signal handler."""
        self._stopping.set()
        self._messages.put(None)

    # --- the broker's side ----------------------------------------------------------------------------------------

    def _connect(self) -> None:
        parts = urlsplit(self._source.url)
        port = parts.port or (8883 if parts.scheme == "mqtts" else 1883)
        try:
            self._client.connect(str(parts.hostname), port, keepalive=30)
        except OSError as error:
            raise Unavailable(
                f"the broker at {parts.hostname}:{port} does not answer: {error}", field="broker"
            ) from error

    def _make_client(self) -> mqtt.Client:
        parts = urlsplit(self._source.url)
        client = mqtt.Client(
            CallbackAPIVersion.VERSION2, client_id=self._source.client_id, clean_session=False, manual_ack=True
        )
        if parts.username is not None:
            client.username_pw_set(unquote(parts.username), unquote(parts.password or ""))
        if parts.scheme == "mqtts":
            client.tls_set()
        client.on_connect = self._subscribe
        client.on_subscribe = lambda *_: self.listening.set()
        client.on_message = lambda _client, _data, message: self._messages.put(message)
        return client

    def _subscribe(self, client: mqtt.Client, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._fail(NotAllowed(f"the broker refused the connection: {reason}", field="broker"))
            return
        client.subscribe([(topic, 1) for topic in self._source.topics])
        _LOG.info("listening", topics=self._source.topics)

    # --- the spool's and the server's side ------------------------------------------------------------------------

    def _collect(self) -> None:
        retry_s, next_try, cut_at = _RETRY_S[0], 0.0, time.monotonic() + self._sink.batch_s
        while True:
            self._keep(self._next_messages())
            now = time.monotonic()
            stopping = self._stopping.is_set()
            if stopping or self._spool.messages >= self._sink.batch_messages or now >= cut_at:
                self._spool.cut()
                cut_at = now + self._sink.batch_s
            if stopping or now >= next_try:
                sent = self._send_batches()
                retry_s = _RETRY_S[0] if sent else min(2 * retry_s, _RETRY_S[1])
                next_try = now if sent else now + retry_s
            if stopping:
                return

    def _next_messages(self) -> list[mqtt.MQTTMessage]:
        """Messages that arrived, after a short wait."""
        found: list[mqtt.MQTTMessage] = []
        try:
            message = self._messages.get(timeout=0.2)
            while True:
                if message is not None:
                    found.append(message)
                message = self._messages.get_nowait()
        except queue.Empty:
            return found

    def _keep(self, messages: list[mqtt.MQTTMessage]) -> None:
        if not messages:
            return
        received_at = datetime.now(UTC).isoformat()
        entries = [_entry(message, received_at) for message in messages]
        self._spool.add(entry for entry in entries if entry is not None)
        for message in messages:
            self._client.ack(message.mid, message.qos)

    def _send_batches(self) -> bool:
        """Whether the server accepted, or refused finally, every waiting batch."""
        for batch in self._spool.list_batches():
            data = batch.read_bytes()
            try:
                answer = self._http.post(
                    "/v1/decodes",
                    files={"file": (batch.name, data, "application/x-ndjson")},
                    data={"context": orjson.dumps(self._sink.context).decode()},
                    headers={"Idempotency-Key": batch.stem},
                )
            except httpx.HTTPError as error:
                _LOG.warning("the server does not answer; the batch waits", batch=batch.name, error=str(error))
                return False
            if answer.status_code in (401, 403):
                self._fail(NotAllowed(f"the server refuses the key: {answer.status_code}", field="key"))
                return False
            if answer.status_code in (408, 429) or answer.status_code >= 500:
                _LOG.warning("the server is busy; the batch waits", batch=batch.name, status=answer.status_code)
                return False
            if answer.is_success:
                batch.unlink()
                decode = answer.json()
                _LOG.info(
                    "sent", batch=batch.name, decode=decode["id"], summary=(decode.get("summary") or {}).get("text")
                )
                self._on_decode(decode)
            else:
                _LOG.error("the server refused a batch; it is put aside", batch=batch.name, problem=answer.text[:1000])
                self._spool.refuse(batch, answer.json())
        return True

    def _fail(self, error: Exception) -> None:
        self._fatal = self._fatal or error
        self.stop()


def _entry(message: mqtt.MQTTMessage, received_at: str) -> JsonObject | None:
    """A message with its topic as a line of the log; None for one that is no JSON object."""
    try:
        if len(message.payload) > _MAX_TEXT_BYTES:
            raise ValueError("too long")
        payload = orjson.loads(message.payload)
        if not isinstance(payload, dict):
            raise ValueError("no JSON object")
    except ValueError as error:
        _LOG.warning("a message was left out", topic=message.topic, why=str(error))
        return None
    return {"topic": message.topic, "received_at": received_at, "payload": payload}
