"""No process is left behind by `waymark demo --serve`, however it ends."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.http import wait_until

DEMO = """
import sys
import app.demo
from app.demo.server import LocalServer

def serve_only(out, *, say, keep_serving):
    out.mkdir(exist_ok=True)
    with LocalServer(out) as server:
        say("serving")
        server.wait()
    return True

app.demo.run_demo = serve_only
from app.cli import main
sys.argv = ["waymark", "demo", "--serve", "--out", sys.argv[1]]
main()
"""


def children(pid: int) -> set[int]:
    """Processes that a process and its children have started."""
    found: dict[int, list[int]] = {}
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = status.read_text().rpartition(")")[2].split()
        except OSError:
            continue  # ended in the meantime
        found.setdefault(int(fields[1]), []).append(int(status.parent.name))
    result: set[int] = set()
    waiting = [pid]
    while waiting:
        new = [child for child in found.get(waiting.pop(), []) if child not in result]
        result.update(new)
        waiting += new
    return result


def is_running(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_the_demos_server_and_its_processes_end_with_it(number: signal.Signals, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", DEMO, str(tmp_path / "out")], stdout=subprocess.PIPE, start_new_session=True
    )
    with process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"serving\n"
        started = wait_until(
            lambda: len(found := children(process.pid)) >= 2 and found, "the server and its forkserver"
        )
        process.send_signal(number)
        process.wait()
    wait_until(lambda: not any(map(is_running, started)), f"the end of {started}")
