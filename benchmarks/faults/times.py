"""How long a start, a stop and the end of the children take."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import httpx

from benchmarks.faults.rows import FaultRow
from benchmarks.faults.server import FaultServer, seconds_until_gone

_READY_S, _STOP_S, _CHILDREN_S = 5.0, 5.0, 2.0


def measure_times(repetitions: int) -> list[FaultRow]:
    """Rows of the table; the slowest of some repetitions counts."""
    ready, stopped, gone = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        server = FaultServer(Path(folder) / "var", settings={"WAYMARK_WARM_DECODERS": "true"})
        server.start()
        for _ in range(repetitions):
            _wait_for_decoders(server)
            gone.append(seconds_until_gone(server.kill()))
            ready.append(server.start())
        for _ in range(repetitions):
            stopped.append(server.stop())
            server.start()
        server.stop()
    load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    return [
        _row("ready after a kill", load, ready, _READY_S),
        _row("SIGTERM", load, stopped, _STOP_S),
        _row("decoder processes after a kill", load, gone, _CHILDREN_S),
    ]


def _row(test: str, load: str, seconds: list[float], goal_s: float) -> FaultRow:
    tried = f"{len(seconds)} times, {load}"
    return FaultRow(test, tried, f"slowest {max(seconds):.1f} s", f"{goal_s:.0f} s", max(seconds) <= goal_s)


def _wait_for_decoders(server: FaultServer) -> None:
    """Until a decoder process answers."""
    deadline = time.monotonic() + 120
    with server.client() as client:
        while time.monotonic() < deadline:
            response = client.post("/v1/decodes", files={"file": ("frame.jpg", b"no picture")})
            if response.status_code != httpx.codes.SERVICE_UNAVAILABLE:
                return
            time.sleep(0.2)
