"""Prometheus metrics of what a process has: its jobs' queues, decoder processes and connections to the database.

The metrics of queues are of the whole database, and every process gives the same: take their maximum, never their sum.
All others are of the process that gives them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import sqlalchemy as sa
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from app.errors import Unavailable
from app.jobs.pool import DecodePool
from app.registry.database import Database
from app.registry.engines import across_agencies
from app.registry.jobs import JobCount, count_unfinished
from app.services.decodes.upload_path import written_metrics
from app.services.jobs import QUEUES
from app.services.ports import Clock

_VALID_S = 5.0
"""How long a count of jobs is used again. [s] By hand: a scrape is rarer, and several scrapers cost one query."""


class ProcessMetrics(Collector):
    """What a process reports when it is asked."""

    def __init__(self, database: Database, pool: DecodePool, clock: Clock) -> None:
        self._database, self._pool, self._clock = database, pool, clock
        self._lock = threading.Lock()
        self._counts: Sequence[JobCount] | None = None
        self._until_s = float("-inf")

    def describe(self) -> Iterator[Metric]:
        """Nothing: a registry would otherwise ask the database when this is registered."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        """The metrics now."""
        yield from self._jobs()
        yield from self._decoders()
        yield from self._connections()

    def _jobs(self) -> Iterator[Metric]:
        counts = self._counted()
        up = GaugeMetricFamily("waymark_database_up", "Whether the last question to the database was answered")
        up.add_metric((), float(counts is not None))
        yield up
        if counts is None:
            return
        jobs = GaugeMetricFamily("waymark_jobs", "Unfinished jobs", labels=("kind", "queue", "state"))
        ages = GaugeMetricFamily(
            "waymark_jobs_oldest_seconds", "Age of the oldest unfinished job", labels=("kind", "queue", "state")
        )
        found = {(row.kind, row.state): row for row in counts}
        now = self._clock()
        for kind, queue in QUEUES.items():
            for state in ("queued", "running"):
                row = found.get((kind, state))
                jobs.add_metric((kind, queue, state), row.number if row else 0)
                age_s = max(0.0, (now - row.oldest).total_seconds()) if row else 0.0
                ages.add_metric((kind, queue, state), age_s)
        yield from (jobs, ages)

    def _counted(self) -> Sequence[JobCount] | None:
        with self._lock:
            if time.monotonic() >= self._until_s:
                try:
                    with across_agencies(), self._database.read() as connection:
                        self._counts = count_unfinished(connection)
                except (Unavailable, sa.exc.SQLAlchemyError):
                    self._counts = None
                self._until_s = time.monotonic() + _VALID_S
            return self._counts

    def _decoders(self) -> Iterator[Metric]:
        state = self._pool.describe()
        for name, help_text, value in (
            ("waymark_decoder_processes", "Decoder processes that run", state.running),
            ("waymark_decoder_processes_wanted", "Decoder processes of the settings", state.wanted),
            ("waymark_decoder_memory_bytes", "Resident memory of the decoder processes", state.memory_bytes),
            ("waymark_decoder_tasks_waiting", "Tasks that wait for a decoder process", state.waiting),
        ):
            yield GaugeMetricFamily(name, help_text, value)
        yield CounterMetricFamily(
            "waymark_decoder_starts", "Starts of decoder processes; more than are wanted are restarts", state.starts
        )

    def _connections(self) -> Iterator[Metric]:
        labels = ("pool", "state")
        used = GaugeMetricFamily("waymark_database_connections", "Connections to the database", labels=labels)
        most = GaugeMetricFamily("waymark_database_connections_max", "Most connections", labels=("pool",))
        for name, pool in self._database.pools():
            used.add_metric((name, "in_use"), pool.checkedout())
            used.add_metric((name, "idle"), pool.checkedin())
            most.add_metric((name,), pool.size() + max(0, pool._max_overflow))
        waiting = GaugeMetricFamily(
            "waymark_database_writers_waiting",
            "Transactions of this process that wait to write",
            value=self._database.waiting_writers,
        )
        yield from (used, most, waiting)


class MetricsServer:
    """/metrics and /healthz of a process that serves no other requests.

    Parameters
    ----------
    port : int
        0: none is served.
    """

    def __init__(self, host: str, port: int, metrics: ProcessMetrics) -> None:
        registry = CollectorRegistry()
        registry.register(metrics)
        self._server: ThreadingHTTPServer | None = None
        if port:
            handler = type("_Handler", (_MetricsHandler,), {"registry": registry})
            self._server = ThreadingHTTPServer((host, port), handler)
            self._server.daemon_threads = True
            threading.Thread(target=self._server.serve_forever, name="metrics", daemon=True).start()

    def close(self) -> None:
        """Stop."""
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()


class _MetricsHandler(BaseHTTPRequestHandler):
    registry: CollectorRegistry
    timeout = 10  # of a silent client [s]

    def do_GET(self) -> None:
        """Answer one request."""
        if self.path == "/metrics":
            self._send(200, CONTENT_TYPE_LATEST, written_metrics(self.registry))
        elif self.path == "/healthz":
            self._send(200, "application/json", b'{"status":"ok"}')
        else:
            self._send(404, "text/plain", b"not found\n")

    def log_message(self, *_: object) -> None:
        """Nothing: these are asked all the time."""

    def _send(self, status: int, media_type: str, content: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", media_type)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)
