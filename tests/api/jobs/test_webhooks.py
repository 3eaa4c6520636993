"""Webhooks over real sockets on both databases: signed, repeated, logged, and never sent to private addresses."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import itertools
import json
import socket
import ssl
import threading
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from app.errors import InvalidParameter
from app.registry.engines import across_agencies
from app.registry.jobs import JobKind
from app.registry.webhooks import webhook_deliveries
from app.registry.webhooks import webhooks as webhook_table
from app.services import webhooks as delivery_module
from app.services.access.access import Scope
from app.services.webhooks import GIVE_UP_AFTER, LEASE, WebhookDelivery, is_wanted, signed_headers
from app.storage import webhook_sender
from app.storage.webhook_sender import WebhookSender, check_url, is_public
from tests.api.jobs.test_jobs import add, finish
from tests.conftest import LiveServer
from tests.http import created, refused, wait_until

pytestmark = pytest.mark.both_databases


class Receiver:
    """A web server on this machine that records its requests and answers as configured."""

    def __init__(self) -> None:
        self.got: list[tuple[dict[str, str], bytes]] = []
        self.statuses: list[int] = []
        self.headers: dict[str, str] = {}
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                receiver.got.append(({k.lower(): v for k, v in self.headers.items()}, body))
                self.send_response(receiver.statuses.pop(0) if receiver.statuses else 204)
                for name, value in receiver.headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.port = self.server.server_port
        self.thread = threading.Thread(target=self.server.serve_forever, daemon=True)
        self.thread.start()

    def close(self) -> None:
        self.server.shutdown()
        self.server.server_close()


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    running = Receiver()
    yield running
    running.close()


@pytest.fixture
def clock() -> list[datetime]:
    """The time of the tests' own deliveries, in a list so that it can be set."""
    return [datetime.now(UTC)]


def at_home(_host: str, _port: int) -> list[str]:
    return ["127.0.0.1"]


@pytest.fixture
def worker(server: LiveServer, clock: list[datetime], monkeypatch: pytest.MonkeyPatch) -> Iterator[WebhookDelivery]:
    """Deliveries by the test: those of the server itself rest. Names lead to this machine."""
    state = server.app.state
    monkeypatch.setattr(state.use_cases.webhook_delivery, "work", lambda: 0)
    monkeypatch.setattr(state.use_cases.webhooks, "_check_url", lambda _url: None)
    sender = WebhookSender(at_home, loopback=True, total_s=5.0)
    yield WebhookDelivery(state.database, lambda: clock[0], state.use_cases.webhooks._secrets, sender)
    with across_agencies(), state.database.write() as connection:
        connection.execute(webhook_deliveries.delete())
        connection.execute(webhook_table.delete())


def hook(client: httpx.Client, receiver: Receiver, *events: str) -> dict[str, Any]:
    url = f"http://hooks.example:{receiver.port}/in?a=1"
    return created(client, "/v1/webhooks", url=url, events=list(events or ("job.*",)))


def verify(secret: str, headers: dict[str, str], body: bytes) -> None:
    """As docs/progress.md has it."""
    signed = f"{headers['webhook-id']}.{headers['webhook-timestamp']}.".encode() + body
    key = base64.b64decode(secret.removeprefix("whsec_"))
    expected = base64.b64encode(hmac.digest(key, signed, hashlib.sha256)).decode()
    sent = [one.partition(",")[2] for one in headers["webhook-signature"].split() if one.startswith("v1,")]
    assert any(hmac.compare_digest(expected, one) for one in sent)


def deliveries(client: httpx.Client, webhook: dict[str, Any]) -> list[dict[str, Any]]:
    answer = client.get(f"/v1/webhooks/{webhook['id']}/deliveries")
    assert answer.status_code == 200, answer.text
    return list(answer.json()["items"])


def test_the_signature_is_that_of_standard_webhooks() -> None:
    # source: the example of the specification's libraries (standard-webhooks, test of `sign`)
    secret = base64.b64decode("MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw")
    headers = signed_headers(secret, "msg_p5jXN8AQM9LWM0D4loKWxJek", 1614265330, b'{"test": 2432232314}')
    assert headers["webhook-signature"] == "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE="


def test_an_event_is_delivered_signed(
    client: httpx.Client, server: LiveServer, receiver: Receiver, worker: WebhookDelivery, clock: list[datetime]
) -> None:
    before = add(server, client)
    finish(server, before)
    webhook = hook(client, receiver)
    assert webhook["secret"].startswith("whsec_")
    assert "secret" not in client.get(f"/v1/webhooks/{webhook['id']}").json()
    job = add(server, client, JobKind.DECODE)
    finish(server, job, "failed")
    assert worker.work() == 1  # not of what was before
    ((headers, body),) = receiver.got
    verify(webhook["secret"], headers, body)
    with pytest.raises(AssertionError):
        verify(webhook["secret"], headers, body + b" ")
    assert headers["host"] == f"hooks.example:{receiver.port}"
    document = json.loads(body)
    assert document["type"] == "job.failed"
    assert document["data"]["job"] == f"/v1/jobs/{job.id}"
    (delivered,) = deliveries(client, webhook)
    assert (delivered["state"], delivered["attempts"], delivered["status"]) == ("delivered", 1, 204)
    assert delivered["id"] == headers["webhook-id"]
    assert worker.work() == 0
    again = client.post(f"/v1/webhooks/{webhook['id']}/deliveries/{delivered['id']}/redeliver")
    assert again.json()["state"] == "waiting"
    clock[0] = datetime.now(UTC)
    assert worker.work() == 1
    assert receiver.got[1][0]["webhook-id"] == delivered["id"]
    assert receiver.got[1][1] == body
    assert client.delete(f"/v1/webhooks/{webhook['id']}").status_code == 204
    refused(client.get(f"/v1/webhooks/{webhook['id']}"), 404, "not-found")


@pytest.mark.slow
def test_a_server_delivers_by_itself(serve: Callable[..., LiveServer], settings: Any, receiver: Receiver) -> None:
    server = serve(settings.model_copy(update={"webhooks_to_loopback": True}))
    with server.client() as client:
        url = f"http://127.0.0.1:{receiver.port}/"
        created(client, "/v1/webhooks", url=url, events=["*"])
        finish(server, add(server, client))
        wait_until(lambda: receiver.got, "the delivery")


@pytest.mark.slow
def test_what_fails_is_repeated_for_a_day_and_then_disabled(
    client: httpx.Client, server: LiveServer, receiver: Receiver, worker: WebhookDelivery, clock: list[datetime]
) -> None:
    webhook = hook(client, receiver)
    finish(server, add(server, client))
    receiver.statuses = [500, 302, 429] + [503] * 100
    receiver.headers = {"Location": f"http://127.0.0.1:{receiver.port}/other"}
    started, waits = clock[0], []
    while client.get(f"/v1/webhooks/{webhook['id']}").json()["state"] == "active":
        assert worker.work() == 1
        assert worker.work() == 0  # not before it is due
        (delivery,) = deliveries(client, webhook)
        if delivery["due_at"] is not None:
            due_at = datetime.fromisoformat(delivery["due_at"])
            waits.append((due_at - clock[0]).total_seconds())
            clock[0] = due_at
    assert 3.7 < waits[0] < 6.3
    assert all(later > 1.5 * earlier for earlier, later in itertools.pairwise(waits[:6]))
    assert clock[0] - started == GIVE_UP_AFTER
    assert len(receiver.got) == delivery["attempts"] == len(waits) + 1  # a redirect was not followed
    assert (delivery["state"], delivery["status"], delivery["error"]) == ("failed", 503, "status 503")
    assert "status 503" in client.get(f"/v1/webhooks/{webhook['id']}").json()["reason"]
    finish(server, add(server, client))
    assert worker.work() == 0
    refused(client.post(f"/v1/webhooks/{webhook['id']}/deliveries/{delivery['id']}/redeliver"), 409, "conflict")
    receiver.statuses = []
    assert client.post(f"/v1/webhooks/{webhook['id']}/enable").json()["state"] == "active"
    clock[0] = max(clock[0], datetime.now(UTC))
    assert worker.work() == 1  # what happened meanwhile is not lost


def test_a_receiver_that_is_gone_is_not_asked_again(
    client: httpx.Client, server: LiveServer, receiver: Receiver, worker: WebhookDelivery
) -> None:
    webhook = hook(client, receiver)
    receiver.statuses = [410]
    finish(server, add(server, client))
    assert worker.work() == 1
    assert client.get(f"/v1/webhooks/{webhook['id']}").json()["reason"] == "the receiver answered 410 Gone"


def test_nothing_is_lost_when_the_server_is_killed(
    client: httpx.Client, server: LiveServer, receiver: Receiver, worker: WebhookDelivery, clock: list[datetime],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    webhook = hook(client, receiver)
    finish(server, add(server, client))

    class Killed(BaseException):
        pass

    def die(*_: object) -> None:
        raise Killed

    with monkeypatch.context() as patched:  # after it was sent, before that is noted
        patched.setattr(worker, "_record", die)
        with pytest.raises(Killed):
            worker.work()
    assert len(receiver.got) == 1
    assert worker.work() == 0  # the lease of the dead one
    clock[0] += LEASE
    assert worker.work() == 1
    first, second = receiver.got
    assert first[0]["webhook-id"] == second[0]["webhook-id"]  # by which the receiver knows that it is the same
    assert deliveries(client, webhook)[0]["state"] == "delivered"


def test_two_processes_send_each_event_once(
    client: httpx.Client, server: LiveServer, receiver: Receiver, worker: WebhookDelivery
) -> None:
    hook(client, receiver)
    for _ in range(12):
        finish(server, add(server, client))
    threads = [threading.Thread(target=worker.work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    ids = [headers["webhook-id"] for headers, _ in receiver.got]
    assert (len(ids), len(set(ids))) == (12, 12)


def test_a_webhook_gets_the_kinds_that_it_wants(
    client: httpx.Client, server: LiveServer, receiver: Receiver, worker: WebhookDelivery
) -> None:
    hook(client, receiver, "job.cancelled", "maintenance.*")
    finish(server, add(server, client))
    finish(server, add(server, client), "cancelled")
    worker.work()
    assert [json.loads(body)["type"] for _, body in receiver.got] == ["job.cancelled"]
    assert is_wanted("maintenance.suspect", ["maintenance.*"])
    assert not is_wanted("maintenance", ["maintenance.*"])
    assert not is_wanted("jobs.done", ["job.*", "job"])


@pytest.mark.usefixtures("worker")
def test_secrets_are_sealed_and_agencies_apart(client: httpx.Client, server: LiveServer, receiver: Receiver) -> None:
    with server.agency("strangers", Scope.ADMIN) as stranger:
        webhook = hook(client, receiver)
        secret = base64.b64decode(webhook["secret"].removeprefix("whsec_"))
        with server.app.state.database.read() as connection:
            stored = connection.execute(webhook_table.select()).mappings().all()
        assert all(secret not in row["sealed_secret"] for row in stored)
        for path in ("", "/deliveries"):
            refused(stranger.get(f"/v1/webhooks/{webhook['id']}{path}"), 404, "not-found")
        assert stranger.get("/v1/webhooks").json()["items"] == []


@pytest.mark.parametrize(
    "url",
    [
        "http://example.org/", "ftp://example.org/", "https:///x", "https://u:p@example.org/", "https://example.org:22/",
        "https://example.org/#f", "https://exämple.org/", "https://example.org/a b", "https://example.org:99999/",
        "https://exa\nmple.org/", "https://example.org\\@127.0.0.1/", "https://[::1/", "x" * 600,
        "https://a..b/", "https://.example.org/", "https://example.org./", "https://-a.org/", "https://a-.org/",
        f"https://{'a' * 64}.org/", f"https://{'a.' * 130}org/", "https://exa%6dple.org/", "https://example.org:/",
        "https://example.org:0/", "https://@example.org/", "https://user@example.org/", "https://a.org:80:80/",
        "https://localhost/", "https://LOCALHOST:8443/", "https://x.localhost/", "https://db.internal/", "https://nas/",
        "https://printer.local/", "https://router.home.arpa/", "https://x.onion/", "https://x.localdomain/",
        "https://127.0.0.1/", "https://127.1/", "https://0177.0.0.1/", "https://0x7f.1/", "https://0x7f000001/",
        "https://2130706433/", "https://017700000001/", "https://8.8.8/", "https://8.8.8.8./", "https://1.2.3.4.5/",
        "https://256.1.1.1/", "https://08.8.8.8/", "https://10.0.0.1/", "https://169.254.169.254/latest",
        "https://192.0.0.170/", "https://100.100.100.200/", "https://example.0x/", "https://[::1]/", "https://[::]/",
        "https://[::ffff:127.0.0.1]/", "https://[::ffff:8.8.8.8]/", "https://[64:ff9b::808:808]/",
        "https://[2002:7f00:1::]/", "https://[2001:0:1::1]/", "https://[fe80::1%25eth0]/", "https://[fd00::1]/",
        "https://[2606:4700::1111%25eth0]/", "https://[4000::1]/", "https://[8.8.8.8]/", "https://[v1.x]/",
    ],
)  # fmt: skip
def test_urls_that_are_refused(client: httpx.Client, url: str) -> None:
    with pytest.raises(InvalidParameter):
        check_url(url)
    problem = refused(client.post("/v1/webhooks", json={"url": url, "events": ["*"]}), 422, field=None)
    assert problem["errors"][0]["field"].endswith("url") if "errors" in problem else problem["field"] == "url"


@pytest.mark.parametrize(
    "url",
    [
        "https://example.org/", "https://EXAMPLE.org:8443/a?b=c%20d", "https://a-b.example.co.uk", "https://8.8.8.8/",
        "https://xn--exmple-cua.org/", "https://_x.example.org/", "https://[2606:4700::1111]:8443/", "https://1.example/",
    ],
)  # fmt: skip
def test_urls_that_are_accepted(url: str) -> None:
    assert check_url(url).hostname


def test_a_name_with_a_private_address_is_refused_at_registration() -> None:
    with pytest.raises(InvalidParameter, match="not public"):
        WebhookSender(lambda _host, _port: ["8.8.8.8", "10.0.0.1"]).check_url("https://example.org/")

    def unknown(_host: str, _port: int) -> list[str]:
        raise socket.gaierror(socket.EAI_NONAME, "no such name")

    WebhookSender(unknown).check_url("https://example.org/")
    WebhookSender(lambda _host, _port: ["8.8.8.8"]).check_url("https://example.org/")


@pytest.mark.parametrize("host", ["a..b", f"{'a' * 64}.org", "xn--\u0e00.org", "no-such-name.invalid"])
def test_a_name_that_cannot_be_resolved_is_an_outcome(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhook_sender, "check_url", lambda url, loopback: urlsplit(url))  # as rows of before
    sent = asyncio.run(WebhookSender().send(f"https://{host}/", {}, b"{}"))
    assert (sent.status, sent.succeeded) == (None, False)
    assert "cannot be resolved" in str(sent.error)


def test_one_bad_webhook_does_not_stop_the_others(
    client: httpx.Client, server: LiveServer, receiver: Receiver, worker: WebhookDelivery,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """A row as older versions stored it, and a defect of the sender for it."""
    bad = created(client, "/v1/webhooks", url="https://a..b/", events=["job.*"])
    good = hook(client, receiver)
    send = worker._sender.send

    async def send_or_fail(url: str, headers: Mapping[str, str], body: bytes) -> Any:
        if "a..b" in url:
            raise UnicodeError("label empty or too long")
        return await send(url, headers, body)

    monkeypatch.setattr(worker._sender, "send", send_or_fail)
    finish(server, add(server, client))
    worker.work()
    assert [one["state"] for one in deliveries(client, good)] == ["delivered"]
    [failed] = deliveries(client, bad)
    assert (failed["state"], failed["error"]) == ("waiting", "a defect of the server: UnicodeError")


@pytest.mark.parametrize(
    "address",
    [
        "127.0.0.1", "127.8.9.1", "10.0.0.1", "172.16.5.4", "192.168.1.1", "169.254.169.254", "100.64.0.1", "0.0.0.0",
        "224.0.0.1", "255.255.255.255", "198.18.0.1", "192.0.2.1", "240.0.0.1", "192.88.99.1", "::1", "::", "fe80::1",
        "fe80::1%eth0", "fc00::1", "fd12::1", "ff02::1", "::ffff:8.8.8.8", "::ffff:127.0.0.1", "64:ff9b::7f00:1",
        "64:ff9b::808:808", "64:ff9b:1::1", "2002:7f00:1::", "2001::1", "::127.0.0.1", "fec0::1", "2001:db8::1", "x",
        "192.0.0.9", "192.0.0.170", "2001:20::1", "3fff::1", "4000::1", "100::1", "5f00::1", "2606:4700::1111%eth0",
    ],
)  # fmt: skip
def test_addresses_that_are_not_public(address: str) -> None:
    assert not is_public(address)

    def resolve(_host: str, _port: int) -> list[str]:
        return ["8.8.8.8", address]  # one bad address in the answer is enough

    sent = asyncio.run(WebhookSender(resolve).send("https://example.org/", {}, b"{}"))
    assert sent.error == "the host's address is not public"


@pytest.mark.parametrize("address", ["8.8.8.8", "93.184.215.14", "2606:4700::1111", "2a00:1450:4001::1"])
def test_public_addresses(address: str) -> None:
    assert is_public(address)


def test_the_connection_goes_to_the_address_that_was_checked(receiver: Receiver) -> None:
    """A name that resolves to something else the second time (DNS rebinding) is not resolved a second time."""
    answers = [["127.0.0.1"], ["127.0.0.2"]]
    asked: list[str] = []

    def rebinding(host: str, _port: int) -> list[str]:
        asked.append(host)
        return answers.pop(0)

    sender = WebhookSender(rebinding, loopback=True)
    sent = asyncio.run(sender.send(f"http://rebind.example:{receiver.port}/", {}, b"{}"))
    assert (sent.status, asked) == (204, ["rebind.example"])
    assert receiver.got[0][0]["host"] == f"rebind.example:{receiver.port}"


@pytest.mark.parametrize(("name", "error"), [("hooks.example", None), ("other.example", "CERTIFICATE_VERIFY_FAILED")])
def test_the_certificate_is_that_of_the_name(receiver: Receiver, tmp_path: Path, name: str, error: str | None) -> None:
    """The connection goes to an address, but the certificate must be of the name in the URL."""
    key, subject = ec.generate_private_key(ec.SECP256R1()), x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder().subject_name(subject).issuer_name(subject).public_key(key.public_key())
        .serial_number(1).not_valid_before(now - timedelta(days=1)).not_valid_after(now + timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False).sign(key, hashes.SHA256())
    )  # fmt: skip
    file = tmp_path / "tls.pem"
    pem = serialization.Encoding.PEM
    private = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    file.write_bytes(certificate.public_bytes(pem) + private)
    served = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    served.load_cert_chain(file)
    receiver.server.socket = served.wrap_socket(receiver.server.socket, server_side=True)
    receiver.server.handle_error = lambda *_: None  # type: ignore[method-assign]
    trusted = ssl.create_default_context(cafile=str(file))
    sender = WebhookSender(at_home, loopback=True, tls=trusted)
    sent = asyncio.run(sender.send(f"https://hooks.example:{receiver.port}/", {}, b"{}"))
    if error is None:
        assert sent.status == 204, sent.error
    else:
        assert error in (sent.error or "")
        assert receiver.got == []


def test_without_the_setting_this_machine_is_refused(client: httpx.Client, receiver: Receiver) -> None:
    wrong = client.post("/v1/webhooks", json={"url": f"http://127.0.0.1:{receiver.port}/", "events": ["*"]})
    refused(wrong, 422, "invalid-parameter", field="url")
    sent = asyncio.run(WebhookSender().send(f"https://127.0.0.1:{receiver.port}/", {}, b"{}"))
    assert (sent.error, receiver.got) == ("the URL cannot be used: its address is not public", [])
    kinds = client.post("/v1/webhooks", json={"url": "https://example.org/", "events": ["job done"]})
    refused(kinds, 422, "invalid-parameter", field="events")


def test_a_receiver_that_sends_byte_after_byte_is_left_in_time() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def drip() -> None:
            connection, _ = listening.accept()
            with connection:
                try:
                    while True:
                        connection.sendall(b"HTTP/1.1 200 OK\r\n"[:1])
                        if stop.wait(0.05):
                            return
                except OSError:
                    return

        stop = threading.Event()
        thread = threading.Thread(target=drip)
        thread.start()
        sender = WebhookSender(at_home, loopback=True, total_s=0.5)
        sent = asyncio.run(sender.send(f"http://slow.example:{listening.getsockname()[1]}/", {}, b"{}"))
        stop.set()
        thread.join()
    assert sent.status is None
    assert sent.error is not None


def test_what_is_kept_no_longer_is_deleted(
    client: httpx.Client, server: LiveServer, receiver: Receiver, worker: WebhookDelivery, clock: list[datetime]
) -> None:
    webhook = hook(client, receiver)
    finish(server, add(server, client))
    clock[0] = datetime.now(UTC) + delivery_module.KEPT + timedelta(hours=1)
    worker.delete_old()  # the event waits for its delivery
    assert worker.work() == 1
    clock[0] += delivery_module.KEPT + timedelta(hours=1)
    worker.delete_old()
    assert deliveries(client, webhook) == []
    assert client.get("/v1/events").json()["items"] == []
