"""`waymark demo --serve`: no process is left behind, however it ends; it listens where the settings say."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from app.demo.server import free_ports
from tests.http import WITHIN_S, wait_until

DEMO = """
import sys
import app.demo
from app.demo.server import LocalServer

def serve_only(out, *, say, keep_serving, **where):
    out.mkdir(exist_ok=True)
    with LocalServer(out, **where) as server:
        say("serving " + server.url)
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
        assert process.stdout.readline().startswith(b"serving http://127.0.0.1:")
        started = wait_until(
            lambda: len(found := children(process.pid)) >= 2 and found, "the server and its forkserver"
        )
        process.send_signal(number)
        process.wait()
    wait_until(lambda: not any(map(is_running, started)), f"the end of {started}")


@pytest.mark.slow
@pytest.mark.timeout(1800)  # a loaded machine takes minutes to start a server
@pytest.mark.parametrize(("host", "reached_at"), [(None, "127.0.0.1"), ("0.0.0.0", "127.0.0.1"), ("::1", "[::1]")])
def test_the_demo_serves_on_the_host_and_port_of_the_settings(
    host: str | None, reached_at: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (port,) = free_ports(1)
    monkeypatch.setenv("WAYMARK_PORT", str(port))
    if host is not None:
        monkeypatch.setenv("WAYMARK_HOST", host)
    command = [sys.executable, "-c", DEMO, str(tmp_path / "out")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as process:
        try:
            assert process.stdout is not None
            url = f"http://{reached_at}:{port}"
            assert process.stdout.readline().decode() == f"serving {url}\n"
            assert httpx.get(f"{url}/healthz", trust_env=False, timeout=WITHIN_S).status_code == 200
        finally:
            process.terminate()


@pytest.mark.slow
def test_the_demo_takes_no_port_that_another_program_uses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        monkeypatch.setenv("WAYMARK_PORT", str(port))
        command = [sys.executable, "-c", DEMO, str(tmp_path / "out")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert f"port {port}" in done.stderr
