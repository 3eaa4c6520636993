"""Commands while an embedded server runs: they reach it through its socket, and nobody else does."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import orjson
import pytest

from app import cli
from app.control.client import short_address, socket_path
from app.main import create_app
from app.settings import Settings
from tests.conftest import ADMIN_KEY, LiveServer

CSV = "name,lon,lat\n" + "".join(f"P{k},{8.4 + k / 1000},49.0\n" for k in range(5))
DECLARED = orjson.dumps({"crs": "EPSG:4326", "family": "plate"}).decode()
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A data folder whose path is longer than an address of a socket may be."""
    return tmp_path / "/".join(["a-folder-with-a-long-name"] * 5)


@pytest.fixture
def waymark(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    monkeypatch.setenv("WAYMARK_DATA_DIR", str(folder))

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["waymark", *arguments])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        printed = capsys.readouterr()
        return int(ended.value.code or 0), printed.out, printed.err

    return run


def server_of(folder: Path) -> LiveServer:
    settings = Settings(data_dir=folder, admin_key=ADMIN_KEY, warm_decoders=False)  # type: ignore[arg-type]
    return LiveServer(create_app(settings))


@pytest.mark.slow
def test_import_export_and_errors_while_the_server_runs(waymark: Run, folder: Path, tmp_path: Path) -> None:
    survey, out = tmp_path / "survey.csv", tmp_path / "out.geojson"
    survey.write_text(CSV)
    with server_of(folder) as server, server.client() as client:
        agency = "default"
        with server.app.state.database.read() as connection:
            agency = connection.exec_driver_sql("SELECT name FROM agencies").scalar_one()
        status, printed, error = waymark("import", str(survey), "--agency", agency, "--declaration", DECLARED)
        assert status == 0, printed + error
        assert "store: 100%, 5 of 5" in error
        assert len(client.get("/v1/markers").json()["items"]) == 5
        status, _, error = waymark("export", str(out), "--agency", agency, "--format", "geojson")
        assert status == 0
        assert "export: 100%, 5 of 5\n" in error  # the server, which is in this process, may write its log between
        assert len(orjson.loads(out.read_bytes())["features"]) == 5
        status, _, error = waymark("export", str(tmp_path / "b"), "--agency", "nobody", "--format", "csv")
        assert (status, "there is no agency 'nobody'" in error, "waymark key" in error) == (1, True, True)
        assert not (tmp_path / "b").exists()
        for name in ("status", "family", "format"):
            status, _, error = waymark("export", str(tmp_path / "b"), "--agency", agency, f"--{name}", "nonsense")
            assert (status, f"there is no {name} 'nonsense'" in error) == (1, True)
        assert not list(tmp_path.glob(".waymark-*"))
    assert not socket_path(folder / "waymark.sqlite3").exists()
    assert waymark("export", str(tmp_path / "c"), "--agency", agency, "--format", "csv")[0] == 0


def test_the_socket_is_the_servers_users_alone(folder: Path) -> None:
    path = socket_path(folder / "waymark.sqlite3")
    with server_of(folder):
        assert path.stat().st_mode & 0o777 == 0o600
        for request in (b"", b"{", b'{"operation": "__class__", "values": {}}', b"[1]", b'{"operation": "key"}'):
            with socket.socket(socket.AF_UNIX) as client, short_address(path) as address:
                client.connect(address)
                client.sendall(request)
                client.shutdown(socket.SHUT_WR)
                answer = b"".join(iter(lambda c=client: c.recv(65_536), b""))
            assert "does not know" in orjson.loads(answer)["error"]["message"]


AS_ANOTHER = """
import os, socket, sys
os.setuid(12_345)
with socket.socket(socket.AF_UNIX) as client:
    client.connect(sys.argv[1])
    client.sendall(b'{"operation": "key", "values": {}}')
    client.shutdown(socket.SHUT_WR)
    print(client.recv(65536).decode())
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="becomes another user")
def test_another_user_is_refused_whatever_the_rights_of_the_file(folder: Path) -> None:
    path = socket_path(folder / "waymark.sqlite3")
    with server_of(folder):
        path.chmod(0o666)
        asked = subprocess.run(
            [sys.executable, "-I", "-c", AS_ANOTHER, path.name], cwd=path.parent,
            capture_output=True, text=True, check=False,
        )  # fmt: skip
    assert "this user may not run commands of this server" in asked.stdout, asked.stderr
