"""A server under observation: processor time and memory of its processes, and the delay of /healthz meanwhile."""

from __future__ import annotations

import http.client
import multiprocessing
import os
import secrets
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path

import httpx

from app.demo.server import free_ports

_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")
_POLL_S = 0.02
_POLLER = "127.0.0.9"
"""Address of the client that asks for /healthz: no attacker has it."""
_START_S = 300.0
_BUSY_S = 120.0
"""Longest wait for a server to become idle. [s]"""
_IDLE_S = 0.2
"""Processor time of an idle server in a second: /healthz is asked all the time. [s]"""


@dataclass(frozen=True, slots=True)
class Cost:
    """What a request or an attack cost."""

    cpu_s: float  # [s] processor time
    memory_mb: float  # [MB] growth of memory at its peak
    health_ms: float  # [ms] greatest delay of /healthz for another address
    failed: int  # requests of /healthz without an answer of 200


class ObservedServer:
    """A running server, with its processes and a process that asks for /healthz all the time."""

    def __init__(self, process: subprocess.Popen[bytes], port: int, key: str) -> None:
        self._process, self.port = process, port
        self.client = httpx.Client(
            base_url=f"http://127.0.0.1:{port}", headers={"X-API-Key": key}, timeout=600, trust_env=False
        )
        self._slowest_s: Synchronized[float] = multiprocessing.Value("d", 0.0)
        self._failed: Synchronized[int] = multiprocessing.Value("i", 0)
        self._poller = multiprocessing.Process(target=_poll, args=(port, self._slowest_s, self._failed), daemon=True)
        self._poller.start()

    @contextmanager
    def observed(self) -> Iterator[list[Cost]]:
        """Measure what happens in the block; the cost is appended when it ends."""
        before, memory = self._cpu_s(), self._memory_kb("VmRSS")
        for pid in self._pids():
            _reset_peak(pid)
        self._slowest_s.value, self._failed.value = 0.0, 0
        costs: list[Cost] = []
        yield costs
        time.sleep(2 * _POLL_S)  # a delay is known when it is over
        peak = self._memory_kb("VmHWM")
        costs.append(
            Cost(
                self._cpu_s() - before,
                max(0, peak - memory) / 1000,
                self._slowest_s.value * 1000,
                self._failed.value,
            )
        )

    def wait_until_idle(self) -> None:
        """Wait until the decoder processes have started and compiled, or a request or an attack has ended."""
        before_s = -1.0
        deadline_s = time.monotonic() + _BUSY_S
        while (now_s := self._cpu_s()) - before_s > _IDLE_S and time.monotonic() < deadline_s:
            before_s = now_s
            time.sleep(1.0)

    def close(self) -> None:
        """End everything."""
        self._poller.terminate()
        self._poller.join()
        self.client.close()
        self._process.terminate()
        self._process.wait()

    def _pids(self) -> list[int]:
        parents: dict[int, list[int]] = {}
        for path in Path("/proc").glob("[0-9]*/stat"):
            try:
                fields = path.read_text().rpartition(")")[2].split()
            except OSError:
                continue
            parents.setdefault(int(fields[1]), []).append(int(path.parent.name))
        found, waiting = [], [self._process.pid]
        while waiting:
            found.append(waiting.pop())
            waiting += parents.get(found[-1], [])
        return found

    def _cpu_s(self) -> float:
        """Processor time of the server and its children, dead ones included."""
        total = 0
        for pid in self._pids():
            try:
                fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            total += sum(int(field) for field in fields[11:15])  # utime, stime, cutime, cstime; source: man 5 proc
        return total * _TICK_S

    def _memory_kb(self, name: str) -> int:
        total = 0
        for pid in self._pids():
            try:
                lines = Path(f"/proc/{pid}/status").read_text().splitlines()
            except OSError:
                continue
            total += sum(int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))
        return total


def _reset_peak(pid: int) -> None:
    try:
        Path(f"/proc/{pid}/clear_refs").write_text("5")
    except OSError:
        return


def _poll(port: int, slowest_s: Synchronized[float], failed: Synchronized[int]) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60, source_address=(_POLLER, 0))
    while True:
        started_s = time.monotonic()
        try:
            connection.request("GET", "/healthz")
            answer = connection.getresponse()
            answer.read()
            failed.value += answer.status != 200
        except (OSError, http.client.HTTPException):
            connection.close()
            failed.value += 1
        slowest_s.value = max(slowest_s.value, time.monotonic() - started_s)
        time.sleep(_POLL_S)


@contextmanager
def running_server(folder: Path, **settings: str) -> Iterator[ObservedServer]:
    """`waymark serve` on a folder, without limits on rates: single requests are measured. `settings` are variables."""
    key = secrets.token_hex(16)
    (port,) = free_ports(1)
    environment = {name: value for name, value in os.environ.items() if not name.startswith("WAYMARK_")} | {
        "WAYMARK_DATA_DIR": str(folder),
        "WAYMARK_ADMIN_KEY": key,
        "WAYMARK_PORT": str(port),
        "WAYMARK_REQUESTS_PER_S": "0",
        "WAYMARK_KEY_PROCESSOR_S_PER_MIN": "0",
        "WAYMARK_AGENCY_PROCESSOR_S_PER_MIN": "0",
        "WAYMARK_LOG_LEVEL": "ERROR",
        **settings,
    }
    command = [sys.executable, "-c", "from app.cli import main; main()", "serve"]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
    try:
        _wait_until_ready(process, port)
    except BaseException:
        process.kill()
        process.wait()
        raise
    server = ObservedServer(process, port, key)
    try:
        server.wait_until_idle()
        yield server
    finally:
        server.close()


def _wait_until_ready(process: subprocess.Popen[bytes], port: int) -> None:
    deadline_s = time.monotonic() + _START_S
    while time.monotonic() < deadline_s and process.poll() is None:
        try:
            if httpx.get(f"http://127.0.0.1:{port}/readyz", trust_env=False).status_code == 200:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
    raise RuntimeError("the server did not start")
