"""`waymark serve` as people start it: a process, a socket, a folder."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from app.demo.server import free_ports
from tests.http import WITHIN_S

ROOT = Path(__file__).resolve().parents[3]
WAYMARK = [sys.executable, "-c", "from app.cli import main; main()"]


def _environment(folder: Path, **extra: str) -> dict[str, str]:
    plain = {name: value for name, value in os.environ.items() if not name.startswith("WAYMARK_")}
    own = {"WAYMARK_DATA_DIR": str(folder), "WAYMARK_WARM_DECODERS": "false", "PYTHONPATH": str(ROOT)}
    return {**plain, **own, **extra}


class _Served:
    url = ""
    output = ""
    logs = ""


@contextmanager
def _serving(folder: Path, **extra: str) -> Iterator[_Served]:
    served, port = _Served(), free_ports(1)[0]
    process = subprocess.Popen(
        [*WAYMARK, "serve", "--port", str(port)],
        env=_environment(folder, **extra),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    served.url = f"http://127.0.0.1:{port}"
    try:
        deadline = time.monotonic() + WITHIN_S
        while True:
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline
            try:
                if httpx.get(f"{served.url}/readyz", trust_env=False).status_code == 200:
                    break
            except httpx.TransportError:
                time.sleep(0.05)
        yield served
    finally:
        process.send_signal(signal.SIGTERM)
        served.output, served.logs = process.communicate(timeout=WITHIN_S)
    assert process.returncode in (0, -signal.SIGTERM), served.logs


@pytest.mark.slow
def test_a_fresh_server_prints_its_key_once_and_keeps_what_it_is_told(tmp_path: Path) -> None:
    with _serving(tmp_path / "new" / "var") as first:
        assert httpx.get(f"{first.url}/v1/markers", trust_env=False).status_code == 401
        for elsewhere in ("127.0.0.2", "[::1]"):  # it listens on 127.0.0.1 alone
            with pytest.raises(httpx.ConnectError):
                httpx.get(f"{first.url}/healthz".replace("127.0.0.1", elsewhere), trust_env=False)
    key = re.fullmatch(r"Admin key \(shown once, keep it\): (wm_\w{8}_\w{43}_\w{6})\n", first.output)
    assert key, first.output
    assert key[1] not in first.logs
    assert "Pool" not in first.logs, "nobody wants to read of each connection"
    headers = {"X-API-Key": key[1]}
    with _serving(tmp_path / "new" / "var", WAYMARK_LOG_FORMAT="json") as second:
        body = {"position": {"lon_deg": 1.5, "lat_deg": 2.5}}
        made = httpx.post(f"{second.url}/v1/markers", json=body, headers=headers, trust_env=False)
        assert made.status_code == 201
        rival = subprocess.run(
            [*WAYMARK, "serve", "--port", str(free_ports(1)[0])],
            env=_environment(tmp_path / "new" / "var"),
            capture_output=True,
            text=True,
            check=False,
            timeout=WITHIN_S,
        )
    assert second.output == ""
    assert '"path":"/v1/markers"' in second.logs
    assert rival.returncode == 1
    assert "in use by another Waymark process" in rival.stderr
    assert "Traceback" not in rival.stderr
