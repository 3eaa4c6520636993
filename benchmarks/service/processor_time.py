"""Processor time of the parts of a service: the cost of a file, independent of the load of the machine."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from benchmarks.faults.server import FaultServer


@dataclass(slots=True)
class ProcessorTime:
    """Processor time, user and system. [s]"""

    # `server`, `decoders`: the web process with the worker, if there is one; and their children
    server: float = 0.0
    decoders: float = 0.0
    # processes of PostgreSQL that serve this database; 0 for SQLite, which runs inside the server
    database: float = 0.0
    clients: float = 0.0  # this process

    def per_file(self, files: int) -> str:
        """Milliseconds a file of each part. [ms]"""
        values = (self.decoders, self.server, self.database, self.clients)
        return " + ".join(f"{1e3 * value / files:.2f}" for value in values)

    @property
    def service_s(self) -> float:
        """All but the clients. [s]"""
        return self.server + self.decoders + self.database


@dataclass(slots=True)
class _Reading:
    """Used so far, by part and process: a process that ends in between keeps its last value."""

    parts: dict[tuple[str, int], float] = field(default_factory=dict)

    @classmethod
    def of(cls, server: FaultServer) -> _Reading:
        reading = cls()
        for pid in server.pids():
            reading._add("server", [psutil.Process(pid)])
            reading._add("decoders", psutil.Process(pid).children(recursive=True))
        reading._add("database", _backends(server.database_name))
        reading._add("clients", [psutil.Process()])
        return reading

    def _add(self, part: str, processes: Sequence[psutil.Process]) -> None:
        for process in processes:
            with suppress(psutil.NoSuchProcess):
                self.parts[part, process.pid] = sum(process.cpu_times()[:2])


def _backends(database: str) -> list[psutil.Process]:
    """PostgreSQL names its processes by user and database."""
    if not database:
        return []
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):
            title = Path(f"/proc/{process.pid}/cmdline").read_bytes().rstrip(b"\0").decode("utf-8", "replace")
            if title.startswith("postgres: ") and database in title.split():
                found.append(process)
    return found


@contextmanager
def counted(server: FaultServer) -> Iterator[ProcessorTime]:
    """What is used while the block runs; complete after it."""
    spent = ProcessorTime()
    before = _Reading.of(server).parts
    yield spent
    after = _Reading.of(server).parts
    for (part, pid), value in after.items():
        setattr(spent, part, getattr(spent, part) + value - before.get((part, pid), 0.0))
