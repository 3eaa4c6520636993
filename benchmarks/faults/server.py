"""A server that is started, killed and started again on the same data."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import httpx
import psutil

from app.demo.server import free_ports

ADMIN_KEY = "an-admin-key-for-the-faults"
HEADERS = {"X-API-Key": ADMIN_KEY}
_WITHIN_S = 120.0
_COMMAND = (sys.executable, "-c", "from app.cli import main; main()")


class FaultServer:
    """`waymark serve` on a folder, and a database if that is not a file in it.

    Parameters
    ----------
    folder : Path
        Data folder.
    database_url : str, optional
        Empty: an SQLite file in the folder.
    settings : mapping, optional
        Further environment variables.
    """

    def __init__(self, folder: Path, database_url: str = "", settings: Mapping[str, str] | None = None) -> None:
        self.folder = folder
        (self.port,) = free_ports(1)
        self.url = f"http://127.0.0.1:{self.port}"
        plain = {name: value for name, value in os.environ.items() if not name.startswith("WAYMARK_")}
        self.environment = plain | {
            "WAYMARK_DATA_DIR": str(folder),
            "WAYMARK_DATABASE_URL": database_url,
            "WAYMARK_ADMIN_KEY": ADMIN_KEY,
            "WAYMARK_REQUESTS_PER_S": "0",
            "WAYMARK_LOG_FORMAT": "json",
            "WAYMARK_WARM_DECODERS": "false",
            **(settings or {}),
        }
        self.log = folder.with_name(folder.name + ".log")
        self.process: subprocess.Popen[bytes] | None = None
        self.workers: list[subprocess.Popen[bytes]] = []

    @property
    def database_name(self) -> str:
        """Of the database in PostgreSQL; empty for SQLite."""
        return self.environment["WAYMARK_DATABASE_URL"].partition("?")[0].rpartition("/")[2]

    def pids(self) -> list[int]:
        """Of the process, and of the workers beside it."""
        return [self.pid, *(worker.pid for worker in self.workers)]

    def start_worker(self) -> None:
        """Start `waymark worker` beside the server."""
        with self.log.open("ab") as log:
            self.workers.append(subprocess.Popen([*_COMMAND, "worker"], env=self.environment, stdout=log, stderr=log))

    @property
    def pid(self) -> int:
        """Of the process."""
        assert self.process is not None
        return self.process.pid

    def start(self, preexec: Callable[[], None] | None = None) -> float:
        """Start the process, and call something in it first; returns the seconds until `/readyz` was 200."""
        began = time.monotonic()
        with self.log.open("ab") as log:
            command = [*_COMMAND, "serve", "--port", str(self.port)]
            self.process = subprocess.Popen(command, env=self.environment, stdout=log, stderr=log, preexec_fn=preexec)
        if not self.wait_until_ready():
            raise RuntimeError(f"the server did not start; see {self.log}")
        return time.monotonic() - began

    def wait_until_ready(self) -> bool:
        """Wait until `/readyz` is 200; False if it does not get so, or the process ends."""
        assert self.process is not None
        deadline = time.monotonic() + _WITHIN_S
        while self.process.poll() is None and time.monotonic() < deadline:
            with suppress(httpx.TransportError):
                if httpx.get(f"{self.url}/readyz", trust_env=False, timeout=10).status_code == 200:
                    return True
            time.sleep(0.02)
        return False

    def kill(self) -> list[psutil.Process]:
        """Kill the server at once; returns the children that it had."""
        assert self.process is not None
        children: list[psutil.Process] = psutil.Process(self.pid).children(recursive=True)
        self.process.kill()
        self.process.wait(_WITHIN_S)
        return children

    def stop(self) -> float:
        """Ask the server to end; returns the seconds until it did."""
        assert self.process is not None
        began = time.monotonic()
        for process in (*self.workers, self.process):
            process.terminate()
        for process in (*self.workers, self.process):
            process.wait(_WITHIN_S)
        self.workers.clear()
        return time.monotonic() - began

    def client(self) -> httpx.Client:
        """A client with the admin's key."""
        return httpx.Client(base_url=self.url, headers=HEADERS, trust_env=False, timeout=60)


def seconds_until_gone(processes: Sequence[psutil.Process]) -> float:
    """Seconds until none of these processes is left. [s]"""
    began = time.monotonic()
    _gone, alive = psutil.wait_procs(processes, timeout=60)
    return time.monotonic() - began if not alive else float("inf")
