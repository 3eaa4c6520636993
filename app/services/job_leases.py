"""Keeps the leases of the jobs that run in this process, so that no other process starts them too."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count

import structlog

from app.errors import Unavailable
from app.registry import job_leases as store
from app.registry.database import Database
from app.registry.tenancy import across_agencies
from app.services.ports import Clock

RENEW_S = store.LEASE.total_seconds() / 3
_LOG = structlog.get_logger(__name__)
_HOST_CHARACTERS = 60  # the column has 100


class LeaseKeeper:
    """A thread that renews the leases of running jobs; it lives as long as one runs."""

    def __init__(self, database: Database, clock: Clock) -> None:
        self._database, self._clock = database, clock
        self._lock = threading.Lock()
        self._runners: set[str] = set()
        self._numbers = count(1)
        self._ended = threading.Event()

    def new_runner(self) -> str:
        """Name of a run of a job, which no other has."""
        return f"{socket.gethostname()[:_HOST_CHARACTERS]}:{os.getpid()}:{next(self._numbers)}:{os.urandom(4).hex()}"

    @contextmanager
    def keep(self, runner: str) -> Iterator[None]:
        """Renew the lease of a run until the block ends."""
        if self._database.path is not None:
            yield  # this process owns the database
            return
        with self._lock:
            self._runners.add(runner)
            if len(self._runners) == 1:
                self._ended = threading.Event()
                threading.Thread(target=self._renew, args=(self._ended,), name="job-leases", daemon=True).start()
        try:
            yield
        finally:
            with self._lock:
                self._runners.discard(runner)
                if not self._runners:
                    self._ended.set()

    def _renew(self, ended: threading.Event) -> None:
        while not ended.wait(RENEW_S):
            with self._lock:
                runners = sorted(self._runners)
            try:
                with across_agencies(), self._database.write_aside() as connection:
                    store.renew_leases(connection, runners, self._clock())
            except Unavailable as error:
                _LOG.warning("the leases of jobs were not renewed", why=error.message)
