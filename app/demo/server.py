"""`waymark serve` in a process of its own, on a free loopback port, with a folder of its own."""

from __future__ import annotations

import ctypes
import os
import random
import secrets
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

import httpx

from app.errors import Unavailable, WaymarkError

# === Ports for servers that the demo, benchmarks and tests start.


FIRST, LAST = 20_000, 32_000
"""Below the ports that systems hand out to clients (Linux from 32768, others from 49152 on): a connection to somewhere
else cannot take a port before its server starts, nor while the server is started again."""


def free_ports(number: int) -> list[int]:
    """Different ports of this machine that nothing listens at.

    Raises
    ------
    OSError
        No port is free.
    """
    found: list[int] = []
    with ExitStack() as probes:
        for port in random.SystemRandom().sample(range(FIRST, LAST), LAST - FIRST):
            if len(found) == number:
                return found
            probe = probes.enter_context(socket.socket())
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            found.append(port)
    raise OSError(f"fewer than {number} of the ports {FIRST} to {LAST} are free")


# === `waymark serve` in a process of its own, on a free loopback port, with a folder of its own.


_START_TIMEOUT_S = 180.0
_WILDCARDS = {"": "127.0.0.1", "0.0.0.0": "127.0.0.1", "::": "[::1]"}
"""Where this machine reaches a server that listens on all addresses."""
_PR_SET_PDEATHSIG = 1  # Linux's prctl(2)
_PRCTL = getattr(ctypes.CDLL(None), "prctl", None)


class LocalServer:
    """A server while the block runs.

    Parameters
    ----------
    host : str, optional
        Address to listen on.
    port : int, optional
        Free port to listen on; without, any.

    Attributes
    ----------
    url, key : str
        Where it listens, and its admin key.
    """

    def __init__(self, folder: Path, host: str = "127.0.0.1", port: int | None = None) -> None:
        self._folder = folder
        self._host = host
        self.key = secrets.token_urlsafe(32)
        self._port = free_ports(1)[0] if port is None else port
        self.url = f"http://{_WILDCARDS.get(host, f'[{host}]' if ':' in host else host)}:{self._port}"

    def __enter__(self) -> LocalServer:
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("WAYMARK_")}
        environment = inherited | {
            "WAYMARK_DATA_DIR": str(self._folder),
            "WAYMARK_ADMIN_KEY": self.key,
            "WAYMARK_DECODE_WORKERS": "2",  # frames come one at a time, and a proof drives in both
        }
        command = [sys.executable, "-c", "from app.cli import main; main()", "serve", "--host", self._host]
        command += ["--port", str(self._port)]
        self._log_path = self._folder / "server.log"
        with self._log_path.open("wb") as log:
            self._process = subprocess.Popen(
                command, env=environment, stdout=log, stderr=log, preexec_fn=_end_with_the_demo
            )
        try:
            self._wait()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self._process.terminate()
        try:
            self._process.wait(40)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def wait(self) -> None:
        """Until the server ends or the user interrupts."""
        try:
            self._process.wait()
        except KeyboardInterrupt:
            return

    def client(self) -> httpx.Client:
        """A client that sends the key; one connection is kept open."""
        headers = {"Authorization": f"Bearer {self.key}"}
        return httpx.Client(base_url=self.url, headers=headers, timeout=120, trust_env=False)

    def _wait(self) -> None:
        deadline = time.monotonic() + _START_TIMEOUT_S
        with self.client() as client:
            while True:
                try:
                    if client.get("/readyz").status_code == 200:
                        return
                except httpx.TransportError:
                    pass  # not listening yet
                if self._process.poll() is not None or time.monotonic() > deadline:
                    last = self._log_path.read_text(errors="replace")[-2000:]
                    raise Unavailable(f"the demo's server did not start:\n{last}", cure="see the log above")
                time.sleep(0.1)


def _end_with_the_demo() -> None:
    """In the server's process: have the kernel stop it when the demo is killed; only Linux can do so."""
    if _PRCTL is not None:
        _PRCTL(_PR_SET_PDEATHSIG, signal.SIGTERM)


def checked(answer: httpx.Response) -> httpx.Response:
    """The answer.

    Raises
    ------
    WaymarkError
        The server refused the request.
    """
    if answer.is_error:
        raise WaymarkError(
            f"{answer.request.method} {answer.request.url.path} answered {answer.status_code}: {answer.text}"
        )
    return answer
