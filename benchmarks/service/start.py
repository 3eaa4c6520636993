"""What a start costs, and what an idle server holds.

Processor time counts from the start of the command until /readyz is 200: of the server's process, and of all processes
with its children, which import the decoders at the same time. The memory is the proportional set size of all of them
when both decoder processes are ready: a page that several share counts once. The first start of all, which writes the
compiled files of Python and Numba, is not counted.

Run: python -m benchmarks.service --only start [--short]
"""

from __future__ import annotations

import re
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import psutil

from benchmarks.faults.server import FaultServer

GOAL_START_S, GOAL_OPENAPI_S, GOAL_MIB = 2.0, 0.05, 450.0
DECODERS = 2
_SETTINGS = {
    "PYTHONDONTWRITEBYTECODE": "",
    "WAYMARK_DECODE_WORKERS": str(DECODERS),
    "WAYMARK_WARM_DECODERS": "true",
}
_WITHIN_S = 300.0
_PSS = re.compile(r"^Pss: +(\d+) kB$", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Start:
    """One start of a server."""

    # `server_s`, `all_s`: [s] processor time until it was ready: of the server's process, and with its children
    server_s: float
    all_s: float
    openapi_s: float  # [s] processor time of the server for the first request of /openapi.json
    pss_mib: dict[str, float]  # [MiB] memory of each process when the decoders are ready


def measure(folder: Path) -> Start:
    """Start a server on a data folder, and stop it."""
    server = FaultServer(folder, settings=_SETTINGS)
    server.start()
    try:
        process = psutil.Process(server.pid)
        server_s = _processor_s(process)
        all_s = server_s + sum(_processor_s(child) for child in process.children(recursive=True))
        _wait_for_decoders(server)
        with server.client() as client:
            before_s = _processor_s(process)
            client.get("/openapi.json").raise_for_status()
            openapi_s = _processor_s(process) - before_s
        return Start(server_s, all_s, openapi_s, _memory(process))
    finally:
        server.stop()


def _processor_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _wait_for_decoders(server: FaultServer) -> None:
    """Wait until both processes have started, and the one that compiles for traces has done so."""
    last_s = time.monotonic() + _WITHIN_S
    with server.client() as client:
        while time.monotonic() < last_s:
            found = dict(re.findall(r"^(waymark_decoder\w+) (\S+)$", client.get("/metrics").text, re.MULTILINE))
            if float(found["waymark_decoder_starts_total"]) >= DECODERS and not float(
                found["waymark_decoder_tasks_waiting"]
            ):
                time.sleep(2.0)  # the task that was handed over last
                return
            time.sleep(0.2)
    raise RuntimeError(f"the decoder processes did not start; see {server.log}")


def _memory(server: psutil.Process) -> dict[str, float]:
    found: dict[str, float] = {}
    decoders = 0
    for process in (server, *server.children(recursive=True)):
        name = "server"
        if process.pid != server.pid:
            command = " ".join(process.cmdline())
            parent = process.ppid()
            if parent != server.pid:
                decoders += 1
                name = f"decoder {decoders}"
            else:
                name = "resource tracker" if "resource_tracker" in command else "forkserver"
        match = _PSS.search(Path(f"/proc/{process.pid}/smaps_rollup").read_text())
        found[name] = int(match[1]) / 1024 if match else 0.0
    return found


def tables(short: bool) -> str:
    """Starts on new and on existing folders, and the memory of the last one."""
    rows = []
    with tempfile.TemporaryDirectory() as parent:
        measure(Path(parent, "first"))
        for number in range(1 if short else 3):
            folder = Path(parent, f"data-{number}")
            for name in ("new", "existing"):
                rows.append((name, measure(folder)))
    lines = [
        "| data folder | server until /readyz is 200 [CPU s] | with its children [CPU s] | first /openapi.json [CPU s] "
        "| all processes [MiB] |",
        "|---|---|---|---|---|",
        *(
            f"| {name} | {row.server_s:.2f} | {row.all_s:.2f} | {row.openapi_s:.2f} | {sum(row.pss_mib.values()):.0f} |"
            for name, row in rows
        ),
        f"| goal | {GOAL_START_S:g} | | {GOAL_OPENAPI_S:g} | {GOAL_MIB:g} |",
        "",
        "| process | memory [MiB] |",
        "|---|---|",
        *(f"| {name} | {mib:.0f} |" for name, mib in rows[-1][1].pss_mib.items()),
    ]
    return "\n".join(lines)
