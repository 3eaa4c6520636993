"""Every process of a service is killed in turn while clients upload, import surveys and commit plans.

The embedded service has a server and a decoder process. The fleet has a server, a worker with its decoder process, and
a RabbitMQ node and a PostgreSQL cluster of its own (`benchmarks.service.nodes`), which are killed too. The moments are
random. After every kill, and when all jobs are done, what was acknowledged has to be there, whole and once.

Run: python -m benchmarks.service --only kills [--short]
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from benchmarks.faults.server import FaultServer
from benchmarks.faults.stored import Stored
from benchmarks.faults.writers import Acknowledged, Kind, PlanCommits, Writers, archive, frame, marker, survey
from benchmarks.service.nodes import Broker, PostgresCluster, missing_programs

CYCLES = 100
_MINUTE_S, _LAST_JOBS_S, _OUTAGE_S = 60.0, 240.0, 2.0
_READY_GOAL_S = {"embedded": 5.0, "fleet": 15.0}
_WRITER_PAUSE_S = 0.1
_WRITE_S = 3.0
_QUIET_EVERY = 5
"""Before every fifth kill jobs may end: one that is killed at each of its starts fails (`MAX_ATTEMPTS`, ten)."""
_COMMAND = ("-c", "import sys; sys.argv[1:] = ['worker']; from app.cli import main; main()")


@dataclass
class Result:
    """What the kills of a run did."""

    engine: str
    done: Acknowledged = field(default_factory=Acknowledged)
    # what was lost, stored in part, or twice; rows without their blob; answers that are no refusal for a time; jobs
    # that failed or were not done; faults of the audit log; processes that ended without being killed
    faults: list[str] = field(default_factory=list)
    kills: dict[str, int] = field(default_factory=dict)
    # [s] by what was killed: seconds from its start to `/readyz`, the slowest
    ready_s: dict[str, float] = field(default_factory=dict)
    slowest_running_s: float = 0.0  # [s] the longest time for which one start of a job was seen running
    last_jobs_s: float = 0.0  # [s] from the last kill until all jobs were done

    def table(self) -> str:
        """As Markdown."""
        done, goal_s = self.done, _READY_GOAL_S[self.engine]
        ready = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in self.ready_s.items())
        uploads, imports, plans = len(done.uploads), len(done.imports), len(done.plans)
        rows = [
            ("kills", ", ".join(f"{name} {number}" for name, number in self.kills.items())),
            ("acknowledged", f"{uploads} uploads, {imports} imports, {plans} plans, {len(done.markers)} markers"),
            ("markers after all jobs", str(done.all_markers)),
            ("lost, in part, twice, without blob, unexpected answers, failed jobs (goal 0)", str(len(self.faults))),
            (f"ready, slowest (goal {goal_s:.0f} s)", ready),
            (f"longest that one start of a job ran (goal {_MINUTE_S:.0f} s)", f"{self.slowest_running_s:.1f} s"),
            ("all jobs done after the last kill", f"{self.last_jobs_s:.1f} s"),
            ("load of the machine at the end", f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"),
        ]
        lines = [f"| {self.engine} | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)]
        return "\n".join([*lines, "", *(f"- {fault}" for fault in self.faults[:20])])


def tables(short: bool, seed: int = 15) -> str:
    """The tables of both engines."""
    found = [measure_embedded(2 if short else CYCLES, seed)]
    if missing := missing_programs():
        return f"{found[0].table()}\n\nFleet: left out, these programs are missing: {missing}"
    with own_nodes() as (broker, cluster):
        found.append(measure_fleet(broker, cluster, len(Fleet.victims) if short else CYCLES, seed))
    return "\n\n".join(result.table() for result in found)


def measure_embedded(cycles: int, seed: int, write_s: float = _WRITE_S) -> Result:
    """Kill a server on SQLite that runs its jobs itself, and its decoder process, each after at most `write_s`."""
    with tempfile.TemporaryDirectory() as folder, _closing(Embedded(FaultServer(Path(folder) / "var"))) as service:
        return _measure(service, cycles, seed, write_s)


def measure_fleet(
    broker: Broker, cluster: PostgresCluster, cycles: int, seed: int, write_s: float = _WRITE_S
) -> Result:
    """Kill the processes of a fleet, each after at most `write_s`; the database is made again."""
    cluster.make_database()
    with tempfile.TemporaryDirectory() as folder, _closing(Fleet(Path(folder), broker, cluster)) as service:
        return _measure(service, cycles, seed, write_s)


@contextmanager
def own_nodes() -> Iterator[tuple[Broker, PostgresCluster]]:
    """A node and a cluster that run; they and all that is in them are gone at the end."""
    with ExitStack() as stack:
        broker, cluster = Broker(), None
        stack.callback(broker.close)
        cluster = PostgresCluster()
        stack.callback(cluster.close)
        for node in (cluster, broker):
            node.start()
        yield broker, cluster


# --- services ---------------------------------------------------------------------------------------------------------


class Embedded:
    """A server that runs its jobs itself."""

    name = "embedded"
    victims: tuple[str, ...] = ("web", "child")
    database_url = ""

    def __init__(self, server: FaultServer) -> None:
        self.server = server

    def start(self) -> float:
        """Returns the seconds until it is ready."""
        return self.server.start()

    def kill(self, victim: str, writers: Writers, choice: random.Random) -> float | None:
        """Kill a process and start it again; returns the seconds until the service is ready, None if it always was."""
        if victim == "web":
            self.server.kill()
            writers.pause()
            return self.server.start()
        _kill_child(self._parent_of_children(), choice)
        return None

    def list_ended(self) -> list[str]:
        """Processes that have ended without being killed; they are started again."""
        assert self.server.process is not None
        if self.server.process.poll() is None:
            return []
        self.server.start()
        return [f"the server ended: {_last_lines(self.server.log)}"]

    def stop(self) -> None:
        """Ask it to end."""
        self.server.stop()

    def close(self) -> None:
        """Kill what still runs."""
        _kill(self.server.process)

    def _parent_of_children(self) -> subprocess.Popen[bytes] | None:
        return self.server.process


class Fleet(Embedded):
    """A server without jobs, a worker, a broker and a database."""

    name = "fleet"
    victims = ("web", "worker", "child", "broker", "database")

    def __init__(self, folder: Path, broker: Broker, cluster: PostgresCluster) -> None:
        self.broker, self.cluster, self.database_url = broker, cluster, cluster.url
        prefix = f"kills_{random.SystemRandom().getrandbits(32):x}"  # the queues are gone with the broker
        settings = {
            "WAYMARK_BROKER_URL": broker.url, "WAYMARK_BROKER_PREFIX": prefix, "WAYMARK_BLOBS_SHARED": "true",
        }  # fmt: skip
        super().__init__(FaultServer(folder / "var", cluster.url, settings))
        self.worker: subprocess.Popen[bytes] | None = None

    def start(self) -> float:
        ready_s = super().start()
        self._start_worker()
        return ready_s

    def kill(self, victim: str, writers: Writers, choice: random.Random) -> float | None:
        if victim == "worker":
            _kill(self.worker)
            self._start_worker()
            return None
        if victim not in ("broker", "database"):
            return super().kill(victim, writers, choice)
        node = self.broker if victim == "broker" else self.cluster
        node.kill()
        time.sleep(choice.uniform(0.0, _OUTAGE_S))
        began = time.monotonic()
        node.start()
        if not self.server.wait_until_ready():
            return float("inf")
        return time.monotonic() - began

    def list_ended(self) -> list[str]:
        ended = super().list_ended()
        assert self.worker is not None
        if self.worker.poll() is not None:
            ended.append(f"the worker ended: {_last_lines(self.server.log)}")
            self._start_worker()
        return ended

    def stop(self) -> None:
        assert self.worker is not None
        self.worker.terminate()
        self.worker.wait(_MINUTE_S)
        super().stop()

    def close(self) -> None:
        _kill(self.worker)
        super().close()

    def _start_worker(self) -> None:
        with self.server.log.open("ab") as log:
            command = [sys.executable, *_COMMAND]
            self.worker = subprocess.Popen(command, env=self.server.environment, stdout=log, stderr=log)

    def _parent_of_children(self) -> subprocess.Popen[bytes] | None:
        return self.worker


def _kill(process: subprocess.Popen[bytes] | None) -> None:
    if process is not None and process.poll() is None:
        process.kill()
        process.wait()


def _kill_child(parent: subprocess.Popen[bytes] | None, choice: random.Random) -> None:
    """Kill a process of a process, if it has one."""
    assert parent is not None
    with suppress(psutil.NoSuchProcess, IndexError):
        choice.choice(psutil.Process(parent.pid).children(recursive=True)).kill()


def _last_lines(log: Path) -> str:
    return " ".join(log.read_text(errors="replace").splitlines()[-3:])[-600:]


@contextmanager
def _closing(service: Embedded) -> Iterator[Embedded]:
    try:
        yield service
    finally:
        service.close()


# --- cycles -----------------------------------------------------------------------------------------------------------


def _measure(service: Embedded, cycles: int, seed: int, write_s: float) -> Result:
    result = Result(service.name, kills=dict.fromkeys(service.victims, 0), ready_s={"first start": service.start()})
    stored = Stored(service.server.folder, service.database_url)
    writers = Writers(service.server.url, seed, _kinds(service.server), _WRITER_PAUSE_S)
    try:
        judge = _Judge(stored, writers, result)
        choice = random.Random(seed)
        for number, victim in enumerate(_victims(service.victims, cycles, choice)):
            writers.resume()
            time.sleep(choice.uniform(0.2, write_s))
            if number % _QUIET_EVERY == _QUIET_EVERY - 1:
                judge.wait_for_jobs(time.monotonic() + _MINUTE_S)
            ready_s = service.kill(victim, writers, choice)
            result.kills[victim] += 1
            if ready_s is not None:
                result.ready_s[victim] = max(result.ready_s.get(victim, 0.0), ready_s)
            result.faults += service.list_ended()
            judge.look()
            done, faults = writers.done, len(result.faults)
            print(
                f"{service.name} {number + 1} of {cycles}, {victim}: {done.count} writes, {faults} faults", flush=True
            )
        killed_at_s = time.monotonic()
        writers.finish()
        judge.wait_for_jobs(killed_at_s + _LAST_JOBS_S)
        result.last_jobs_s = time.monotonic() - killed_at_s
        service.stop()
        judge.end()
        return result
    finally:
        service.close()
        writers.abandon()
        stored.database.close()


def _victims(names: Sequence[str], cycles: int, choice: random.Random) -> list[str]:
    """All of them in turn, in an order that is random in each turn."""
    return [name for _ in range(0, cycles, len(names)) for name in choice.sample(names, len(names))][:cycles]


def _kinds(server: FaultServer) -> tuple[Kind, ...]:
    with server.client() as client:
        answer = client.post("/v1/keys", json={"label": "approver", "scope": "planner"})
        answer.raise_for_status()
        return marker, frame, archive, survey, PlanCommits(answer.json()["key"])


class _Judge:
    """Compares what is stored with what was acknowledged."""

    def __init__(self, stored: Stored, writers: Writers, result: Result) -> None:
        self._stored, self._writers, self._result = stored, writers, result
        self._checked = Acknowledged()
        self._running: dict[tuple[str, str], float] = {}

    def look(self) -> None:
        """After a kill: nothing is lost, in part or without its blob."""
        done = self._writers.done.copy()
        self._result.faults += self._find(done.since(self._checked))
        self._checked = done
        self._watch_running()

    def wait_for_jobs(self, until_s: float) -> None:
        """Until the jobs that there are now are done, or a time."""
        waiting = self._stored.list_unfinished()
        while waiting & self._stored.list_unfinished() and time.monotonic() < until_s:
            self._watch_running()
            time.sleep(0.2)

    def end(self) -> None:
        """When all jobs are done: everything is there once."""
        done, stored = self._writers.done, self._stored
        self._result.done = done
        more = stored.count_markers() - done.all_markers
        self._result.faults += [
            *self._find(done),
            *([f"{more:+d} markers"] if more else []),
            *(f"answer: {answer}" for answer in done.unexpected),
            *(f"failed: {job}" for job in stored.list_failed()),
            *(f"not done: {job}" for job, _ in self._stored.list_running()),
            *(["jobs are not done"] if stored.count_jobs("queued") else []),
            *(f"audit log: {fault}" for fault in stored.list_faults()),
        ]

    def _find(self, done: Acknowledged) -> list[str]:
        return [
            *(f"lost: {what}" for what in self._stored.list_lost(done)),
            *(f"in part: {what}" for what in self._stored.list_partial()),
            *(f"without blob: {key}" for key in self._stored.list_without_blob()),
        ]

    def _watch_running(self) -> None:
        now_s = time.monotonic()
        self._running = {start: self._running.get(start, now_s) for start in self._stored.list_running()}
        longest_s = max((now_s - since_s for since_s in self._running.values()), default=0.0)
        self._result.slowest_running_s = max(self._result.slowest_running_s, longest_s)
