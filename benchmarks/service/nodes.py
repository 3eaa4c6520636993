"""A RabbitMQ node and a PostgreSQL cluster of a benchmark's own, which it may kill.

Each lies in a temporary folder and touches none that the machine runs already: the node has its own name, ports, cookie
and port mapper, the cluster its own socket.
"""

from __future__ import annotations

import glob
import os
import shutil
import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import sqlalchemy as sa
from kombu import Connection

from app.demo.server import free_ports

_WITHIN_S = 120.0
_RABBITMQ = "/usr/lib/rabbitmq/lib/rabbitmq_server-*/sbin/rabbitmq-server"
"""Debian's `rabbitmq-server` is another: it changes to the user of the machine's own node."""
_POSTGRESQL = "/usr/lib/postgresql/*/bin"
_SUPERUSER = "postgres"


def missing_programs() -> str:
    """What has to be installed for both; empty if nothing is missing."""
    wanted = {"rabbitmq-server": _find_rabbitmq(), "initdb": _find_postgresql("initdb"), "epmd": shutil.which("epmd")}
    return ", ".join(name for name, path in wanted.items() if path is None)


class _Node:
    """A server in a folder of its own."""

    def __init__(self, prefix: str) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix=prefix))
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> float:
        """Start it; returns the seconds until it answers."""
        began = time.monotonic()
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(stdout=log, stderr=log, start_new_session=True, **self._command())
        while not self._answers():
            if self.process.poll() is not None or time.monotonic() > began + _WITHIN_S:
                raise RuntimeError(f"{self.process.args!r} did not start: {(self.folder / 'log').read_text()[-2000:]}")
            time.sleep(0.05)
        return time.monotonic() - began

    def kill(self) -> None:
        """Kill all of its processes at once."""
        if self.process is None:
            return
        found: list[psutil.Process] = []
        with suppress(psutil.NoSuchProcess):
            first = psutil.Process(self.process.pid)
            found = [first, *first.children(recursive=True)]
        for process in found:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        self.process.wait(_WITHIN_S)
        psutil.wait_procs(found, timeout=_WITHIN_S)

    def close(self) -> None:
        """Kill it and delete its folder."""
        self.kill()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _command(self) -> dict[str, Any]:
        raise NotImplementedError

    def _answers(self) -> bool:
        raise NotImplementedError


class Broker(_Node):
    """A RabbitMQ node."""

    def __init__(self) -> None:
        super().__init__("waymark-rabbitmq-")
        port, distribution_port, self._mapper_port = free_ports(3)
        self.url = f"amqp://guest:guest@127.0.0.1:{port}"
        names = ("PATH", "LANG", "LC_ALL")
        self._environment = {name: os.environ[name] for name in names if name in os.environ} | {
            "HOME": str(self.folder),  # of the Erlang cookie
            "ERL_EPMD_PORT": str(self._mapper_port),
            "RABBITMQ_NODENAME": f"waymark{port}@localhost",
            "RABBITMQ_NODE_IP_ADDRESS": "127.0.0.1",
            "RABBITMQ_NODE_PORT": str(port),
            "RABBITMQ_DIST_PORT": str(distribution_port),
            "RABBITMQ_MNESIA_BASE": str(self.folder / "mnesia"),
            "RABBITMQ_LOG_BASE": str(self.folder),
            "RABBITMQ_CONF_ENV_FILE": os.devnull,
            "RABBITMQ_CONFIG_FILE": str(self.folder / "none"),
            "RABBITMQ_ENABLED_PLUGINS_FILE": str(self.folder / "plugins"),
        }

    def close(self) -> None:
        """Kill it and its port mapper, and delete its folder."""
        self.kill()
        mapper = ["epmd", "-port", str(self._mapper_port), "-kill"]
        subprocess.run(
            mapper, env=os.environ | {"ERL_EPMD_RELAXED_COMMAND_CHECK": "1"}, capture_output=True, check=False
        )
        super().close()

    def _command(self) -> dict[str, Any]:
        return {"args": [_find_rabbitmq()], "env": self._environment, "cwd": self.folder}

    def _answers(self) -> bool:
        try:
            with Connection(self.url, connect_timeout=5) as connection:
                connection.connect()
        except OSError:
            return False
        return True


class PostgresCluster(_Node):
    """A PostgreSQL cluster with one database, `waymark`, that has PostGIS."""

    def __init__(self) -> None:
        super().__init__("waymark-postgresql-")
        if os.geteuid() == 0:  # PostgreSQL refuses to run as root
            shutil.chown(self.folder, _SUPERUSER)
        self._data = self.folder / "data"
        options = ["--auth=trust", f"--username={_SUPERUSER}", "--encoding=UTF8", "--no-locale", "--no-sync"]
        subprocess.run(
            [_find_postgresql("initdb"), *options, f"--pgdata={self._data}"],
            check=True, capture_output=True, cwd=self.folder, **self._user(),
        )  # fmt: skip
        server = sa.URL.create("postgresql+psycopg", _SUPERUSER, query={"host": str(self.folder)})
        self._server = server.set(database="postgres")
        self.url = server.set(database="waymark").render_as_string(hide_password=False)

    def make_database(self) -> None:
        """Make the database again; the cluster has to run."""
        with _connected(self._server) as connection:
            connection.exec_driver_sql("DROP DATABASE IF EXISTS waymark WITH (FORCE)")
            connection.exec_driver_sql("CREATE DATABASE waymark TEMPLATE template0")
        with _connected(sa.make_url(self.url)) as connection:
            connection.exec_driver_sql("CREATE EXTENSION postgis")

    def _user(self) -> dict[str, Any]:
        return {"user": _SUPERUSER, "group": _SUPERUSER, "extra_groups": []} if os.geteuid() == 0 else {}

    def _command(self) -> dict[str, Any]:
        arguments = ["-D", str(self._data), "-k", str(self.folder), "-c", "listen_addresses="]
        return {"args": [_find_postgresql("postgres"), *arguments], "cwd": self.folder, **self._user()}

    def _answers(self) -> bool:
        try:
            with _connected(self._server) as connection:
                connection.exec_driver_sql("SELECT 1")
        except sa.exc.OperationalError:
            return False
        return True


def _connected(url: sa.URL) -> Any:
    return sa.create_engine(url, isolation_level="AUTOCOMMIT", poolclass=sa.NullPool).connect()


def _find_rabbitmq() -> str | None:
    return next(iter(sorted(glob.glob(_RABBITMQ), reverse=True)), None) or shutil.which("rabbitmq-server")


def _find_postgresql(program: str) -> str:
    folders = sorted(glob.glob(_POSTGRESQL), reverse=True)
    found = next(filter(None, (shutil.which(program, path=folder) for folder in (*folders, None))), None)
    if found is None:
        raise FileNotFoundError(f"{program} of PostgreSQL is not installed")
    return found
