"""The server's process ends although a request does not."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys

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
