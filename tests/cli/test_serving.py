"""The server's process ends although a request does not."""

from __future__ import annotations

import resource
import signal
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest

from app.cli import serving
from benchmarks.faults.server import FaultServer
from tests.http import WITHIN_S

STUCK = """
import sys, time
import uvicorn
from starlette.applications import Starlette
from starlette.routing import Route
from app.cli.serving import StoppingServer

def stuck(_request):
    print("stuck", flush=True)
    time.sleep(3600)

app = Starlette(routes=[Route("/", stuck)])
config = uvicorn.Config(app, fd=int(sys.argv[1]), log_config=None, lifespan="off", timeout_graceful_shutdown=1)
StoppingServer(config).run()
"""


def test_sigterm_ends_the_server_although_a_request_does_not_end() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        descriptor = listener.fileno()
        process = subprocess.Popen(
            [sys.executable, "-c", STUCK, str(descriptor)], pass_fds=[descriptor], stdout=subprocess.PIPE
        )
        with process, socket.create_connection(listener.getsockname(), WITHIN_S) as client:
            client.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
            assert process.stdout is not None
            assert process.stdout.readline() == b"stuck\n"
            process.send_signal(signal.SIGTERM)
            assert process.wait(WITHIN_S) == -signal.SIGTERM


@pytest.mark.parametrize(
    ("soft", "hard", "connections"),
    [(1024, 20_000, 1000), (1024, resource.RLIM_INFINITY, 1000), (256, 256, 48), (64, 64, 12), (1024, 4096, 1000)],
)
def test_there_are_files_for_all_connections(
    monkeypatch: pytest.MonkeyPatch, soft: int, hard: int, connections: int
) -> None:
    limits = [soft]
    monkeypatch.setattr(serving.resource, "getrlimit", lambda _which: (limits[-1], hard))
    monkeypatch.setattr(serving.resource, "setrlimit", lambda _which, both: limits.append(both[0]))
    possible, backlog = serving._possible_connections(1000)
    assert possible == connections
    spare = limits[-1] - 2 * possible - backlog
    assert spare >= min(512, limits[-1] // 2) - 1


@pytest.mark.slow
def test_a_server_with_few_files_accepts_and_answers(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    server = FaultServer(tmp_path / "var")
    server.start(preexec=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (256, 256)))
    assert resource.getrlimit(resource.RLIMIT_NOFILE) == before
    try:
        with ExitStack() as held:
            for number in range(400):
                client = held.enter_context(socket.socket())
                client.bind((f"127.0.0.{1 + number % 5}", 0))
                client.settimeout(WITHIN_S)
                client.connect(("127.0.0.1", server.port))
            transport = httpx.HTTPTransport(local_address="127.0.0.6")
            with httpx.Client(base_url=server.url, transport=transport, timeout=WITHIN_S) as other:
                for _ in range(20):
                    assert other.get("/readyz", headers={"Connection": "close"}).status_code == 200
    finally:
        server.stop()
    log = server.log.read_text()
    assert "fewer connections are allowed" in log
    assert "Too many open files" not in log
