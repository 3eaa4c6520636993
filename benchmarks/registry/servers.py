"""Databases and servers of a run: `waymark serve` on either database, and tipg on the same PostGIS table."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
import sqlalchemy as sa

from app.demo.server import free_ports

PEER = ("tipg==1.6.1", "uvicorn==0.54.0", "uvloop==0.23.0", "httptools==0.9.0")
_LOCAL = "postgresql+psycopg://postgres@127.0.0.1:5432/postgres"


def postgres_url(name: str) -> sa.URL:
    """A database of the server that WAYMARK_TEST_POSTGRES_URL names, or of the local one."""
    return sa.make_url(os.environ.get("WAYMARK_TEST_POSTGRES_URL") or _LOCAL).set(database=name)


def make_database(name: str) -> str:
    """URL of a new, empty database with PostGIS."""
    drop_database(name)
    with _connected(postgres_url("postgres")) as connection:
        connection.exec_driver_sql(f"CREATE DATABASE {name} TEMPLATE template0 ENCODING 'UTF8'")
    with _connected(postgres_url(name)) as connection:
        connection.exec_driver_sql("CREATE EXTENSION postgis")
    return postgres_url(name).render_as_string(hide_password=False)


def settle(url: str) -> None:
    """Let PostgreSQL finish what follows a great import, for both servers alike, before anything is measured."""
    with _connected(sa.make_url(url)) as connection:
        connection.exec_driver_sql("VACUUM ANALYZE markers")
        connection.exec_driver_sql("CHECKPOINT")


def drop_database(name: str) -> None:
    """Drop a database, whoever is still connected to it."""
    with _connected(postgres_url("postgres")) as connection:
        connection.exec_driver_sql(f"DROP DATABASE IF EXISTS {name} WITH (FORCE)")


@contextmanager
def _connected(url: sa.URL) -> Iterator[sa.Connection]:
    engine = sa.create_engine(url, isolation_level="AUTOCOMMIT", poolclass=sa.NullPool)
    try:
        with engine.connect() as connection:
            yield connection
    finally:
        engine.dispose()


def cpu_s(port: int, url: str) -> float:
    """CPU time so far of the server on a port and of the backends of a database on this machine. [s]"""
    processes = [child for child in psutil.Process().children() if str(port) in child.cmdline()]
    processes += [worker for server in processes for worker in server.children(recursive=True)]
    with _connected(sa.make_url(url)) as connection:
        query = "SELECT pid FROM pg_stat_activity WHERE datname = current_database() AND pid <> pg_backend_pid()"
        pids = [row[0] for row in connection.exec_driver_sql(query)]
    for pid in pids:
        with suppress(psutil.Error):
            processes.append(psutil.Process(pid))
    total = 0.0
    for process in processes:
        with suppress(psutil.Error):
            times = process.cpu_times()
            total += times.user + times.system
    return total


@contextmanager
def waymark(url: str, folder: Path) -> Iterator[int]:
    """`waymark serve` on a database; gives its port."""
    environment = {"WAYMARK_DATABASE_URL": url, "WAYMARK_DATA_DIR": str(folder), "WAYMARK_LOG_FORMAT": "json"}
    environment |= {"WAYMARK_WARM_DECODERS": "false", "WAYMARK_REQUESTS_PER_S": "0"}
    code = "from app.cli import main; main()"
    with _running([sys.executable, "-c", code, "serve", "--port"], environment, "/healthz") as port:
        yield port


@contextmanager
def tipg(url: str, environment_folder: Path) -> Iterator[int]:
    """tipg with two workers on a PostgreSQL database; gives its port.

    Raises
    ------
    OSError, subprocess.CalledProcessError
        It could not be installed or started.
    """
    python = _install(environment_folder)
    environment = {
        "DATABASE_URL": sa.make_url(url).set(drivername="postgresql").render_as_string(hide_password=False),
        "TIPG_DB_SCHEMAS": '["public"]',
        "DB_MIN_CONN_SIZE": "8",
        "DB_MAX_CONN_SIZE": "8",
    }
    command = [
        str(python),
        "-m",
        "uvicorn",
        "tipg.main:app",
        "--workers",
        "2",
        "--loop",
        "uvloop",
        "--http",
        "httptools",
    ]
    with _running([*command, "--no-access-log", "--port"], environment, "/healthz") as port:
        yield port


def _install(folder: Path) -> Path:
    """tipg in a virtual environment of its own: it is no dependency of ours."""
    python, done = folder / "bin" / "python", folder / "installed"
    if not done.exists():
        uv = [sys.executable, "-m", "uv"]
        subprocess.run([*uv, "venv", "--quiet", "--clear", "--python", sys.executable, str(folder)], check=True)
        subprocess.run([*uv, "pip", "install", "--quiet", "--python", str(python), *PEER], check=True)
        done.touch()
    return python


@contextmanager
def _running(command: list[str], environment: dict[str, str], ready: str) -> Iterator[int]:
    (port,) = free_ports(1)
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen([*command, str(port)], env=os.environ | environment, stdout=log, stderr=log)
        try:
            _wait(process, port, ready)
            yield port
        finally:
            process.terminate()
            process.wait(60)


def _wait(process: subprocess.Popen[bytes], port: int, path: str) -> None:
    deadline = time.monotonic() + 120
    while True:
        try:
            with socket.create_connection(("127.0.0.1", port), timeout=5) as probe:
                probe.sendall(f"GET {path} HTTP/1.0\r\n\r\n".encode())
                if b" 200 " in probe.recv(64):
                    return
        except OSError:
            pass
        if time.monotonic() > deadline or process.poll() is not None:
            raise OSError(f"the server did not start: {process.args!r}")
        time.sleep(0.1)
