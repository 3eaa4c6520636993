"""Proofs of plans: simulated drives in the decoder processes, unit by unit, as a job that goes on after a restart."""

from __future__ import annotations

import queue
import threading
import zlib
from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from contextvars import copy_context
from datetime import timedelta
from functools import partial
from typing import TypeVar, TypeVarTuple, cast

import sqlalchemy as sa

from app.errors import Conflict, NotFound, Unavailable
from app.planning.proof import ProofTerms, UnitResult
from app.registry import jobs as store
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.jobs import UNFINISHED, JobKind, new_job
from app.registry.plans import PLANS, PlanRow, add_unit, delete_units, list_units
from app.services.access.access import Caller, Scope
from app.services.access.audit import log_change
from app.services.blobs import delete_unused, staged
from app.services.idempotency import IdempotencyKey, find_earlier, write_once
from app.services.jobs import RunningJob
from app.services.plans.alignments import BUSY_WAIT_S
from app.services.plans.documents import ProofResult
from app.services.plans.tasks import WrittenProof, check_proof, list_proof_units, prove_unit, write_proof
from app.services.ports import Blobs, Clock, DecoderProcesses, JobQueue, Pending
from app.services.progress import JobDocument, job_document
from app.values import JsonObject

# === Many tasks of one job in the decoder processes, a limited number of them at the same time.


KeyT = TypeVar("KeyT")
ArgumentsT = TypeVarTuple("ArgumentsT")
ResultT = TypeVar("ResultT")
WAIT_S = 60.0
"""How long a job waits for a place among the tasks of the decoder processes before it is put back. [s] As decodes."""


def results_as_done(
    processes: DecoderProcesses,
    task: Callable[[*ArgumentsT], ResultT],
    arguments: Mapping[KeyT, tuple[*ArgumentsT]],
    in_flight: int,
) -> Generator[tuple[KeyT, ResultT]]:
    """Results in the order in which they come. Those on their way are stopped where the caller goes no further.

    Parameters
    ----------
    arguments : mapping of key to tuple
        The task is carried out with each of them.
    in_flight : int
        Tasks that wait or are carried out at the same time; uploads of vehicles queue behind no more than these.
    """
    feeder = _Feeder(processes)
    pool = ThreadPoolExecutor(in_flight, thread_name_prefix="plan-tasks")
    done: queue.SimpleQueue[Future[ResultT]] = queue.SimpleQueue()  # in the order in which they ended
    try:
        futures: dict[Future[ResultT], KeyT] = {}
        for key, one in arguments.items():
            futures[pool.submit(copy_context().run, feeder.carry_out, task, one)] = key
        for future in futures:
            future.add_done_callback(done.put)
        for _ in range(len(futures)):
            future = done.get()
            yield futures.pop(future), future.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        feeder.stop()
        pool.shutdown()


def results_in_order(
    processes: DecoderProcesses,
    task: Callable[[*ArgumentsT], ResultT],
    arguments: Iterable[tuple[*ArgumentsT]],
    in_flight: int,
) -> Generator[ResultT]:
    """Results in the order of the arguments; otherwise as `results_as_done`. Only `in_flight` results are in memory."""
    waiting: deque[Pending[ResultT]] = deque()
    try:
        for one in arguments:
            waiting.append(processes.submit(task, *one, wait_s=WAIT_S))
            if len(waiting) >= in_flight:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        for pending in waiting:
            pending.cancel()


class _Feeder:
    """Hands tasks over from several threads, and stops those that are on their way."""

    def __init__(self, processes: DecoderProcesses) -> None:
        self._processes = processes
        self._lock = threading.Lock()
        self._running: set[Pending[object]] = set()
        self._stopped = threading.Event()

    def carry_out(self, task: Callable[[*ArgumentsT], ResultT], arguments: tuple[*ArgumentsT]) -> ResultT:
        """Hand a task over and wait for its result."""
        if self._stopped.is_set():
            raise Unavailable("the job was stopped")
        pending = self._processes.submit(task, *arguments, wait_s=WAIT_S)
        with self._lock:
            self._running.add(pending)
        if self._stopped.is_set():
            pending.cancel()
        try:
            return pending.result()
        finally:
            with self._lock:
                self._running.discard(pending)

    def stop(self) -> None:
        """Stop the tasks."""
        self._stopped.set()
        with self._lock:
            running = list(self._running)
        for pending in running:
            pending.cancel()


# === The life of a plan.


DRAFT, CHECKED, PROVED, APPROVED, COMMITTED = "draft", "checked", "proved", "approved", "committed"


# === Jobs about plans: making one of a long road, proving one, packing its files.


def check_only_one(connection: sa.Connection, agency_id: str, kind: JobKind, plan_id: str) -> None:
    """Refuse a second job of a kind about a plan while one is unfinished.

    Raises
    ------
    Conflict
    """
    other = store.find_job_about(connection, agency_id, kind, plan_id, UNFINISHED)
    if other is not None:
        raise Conflict(
            f"job {other.id} about this plan is {other.state}",
            field="plan_id",
            limit=f"one {kind} of a plan at a time",
            cure=f"wait for it, or cancel it: POST /v1/jobs/{other.id}/cancel",
        )


def caller_of(job: RunningJob) -> Caller:
    """Whom a job acts for: the permissions were checked when it was queued."""
    return Caller(job.row.agency_id, job.row.holder_id or "", job.row.input["label"], Scope.PLANNER)


# === Proofs of plans.


REPORT_FILE, TABLE_FILE = "proof.json", "proof.csv"
PROOF_FILES = (REPORT_FILE, TABLE_FILE)
"""Files that a plan has once it is proved."""
_FOLDER = "proofs"


class Proofs:
    """Use cases on proofs of plans.

    Parameters
    ----------
    in_flight : int
        Units of one proof that are driven at the same time.
    """

    def __init__(
        self, database: Database, clock: Clock, blobs: Blobs, processes: DecoderProcesses, queue: JobQueue,
        *, in_flight: int = 2, idempotency_ttl: timedelta = timedelta(hours=24),
    ) -> None:  # fmt: skip
        self._database, self._clock, self._blobs = database, clock, blobs
        self._processes, self._queue = processes, queue
        self._in_flight, self._ttl = in_flight, idempotency_ttl

    def request(
        self, caller: Caller, plan_id: str, terms: ProofTerms, version: int | None, key: IdempotencyKey | None = None
    ) -> tuple[JobDocument, bool]:
        """Queue the proof of a plan as it is.

        Returns
        -------
        job : JobDocument
        replayed : bool
            The request had been made before under the same Idempotency-Key.

        Raises
        ------
        NotFound, StaleVersion
        InvalidParameter
            The plan has nothing to prove or no such camera, or there are too many units.
        Conflict
            Another proof of the plan is unfinished.
        """
        now, agency_id = self._clock(), caller.agency_id
        if earlier := find_earlier(self._database, agency_id, key, now):
            return earlier, True
        with self._database.read() as connection:
            row = PLANS.get_at(connection, agency_id, plan_id, version)
        self._processes.run(check_proof, self._blobs.get(row.document_key), terms, wait_s=BUSY_WAIT_S)
        job_input = {
            "document_key": row.document_key,
            "plan_version": row.version,
            "terms": terms.model_dump(mode="json"),
            "label": caller.label,
        }
        job = new_job(
            JobKind.PROOF, new_id(now), agency_id, caller.key_id, now, job_input=job_input, subject_id=plan_id
        )
        with write_once(self._database, agency_id, key, now, self._ttl) as (connection, answer):
            if answer.replayed:
                return answer.response, True
            PLANS.get_at(connection, agency_id, plan_id, row.version)
            check_only_one(connection, agency_id, JobKind.PROOF, plan_id)
            delete_units(connection, agency_id)
            store.add_job(connection, job)
            document = answer.store(job_document(job, now))
        self._queue.submit(job.id, job.agency_id, JobKind.PROOF)
        return document, False

    def file(self, caller: Caller, plan_id: str, name: str) -> tuple[bytes, PlanRow]:
        """A file of a plan's proof: `REPORT_FILE` or `TABLE_FILE`; and the plan.

        Raises
        ------
        NotFound
            There is no such plan, or it was not proved since its last change.
        """
        with self._database.read() as connection:
            row = PLANS.get(connection, caller.agency_id, plan_id)
        if row.proof is None:
            raise NotFound(
                f"plan {plan_id} has no proof",
                field="plan_id",
                limit="plans that were proved since their markers were placed",
                cure=f"POST /v1/plans/{plan_id}/proof, and wait for the job",
            )
        return zlib.decompress(self._blobs.get(row.proof["keys"][name])), row

    def run(self, job: RunningJob) -> None:
        """Prove a plan; the handler of jobs of the kind `JobKind.PROOF`."""
        terms = ProofTerms.model_validate(job.row.input["terms"])
        document = self._blobs.get(job.row.input["document_key"])
        results = self._drive(job, document, terms)
        written = self._processes.run(write_proof, document, terms, results, wait_s=WAIT_S)
        self._store(job, written)

    def _drive(self, job: RunningJob, document: bytes, terms: ProofTerms) -> list[UnitResult]:
        """Results of all units; those that an earlier attempt finished are taken from the database."""
        units = self._processes.run(list_proof_units, document, terms, wait_s=WAIT_S)
        agency_id, job_id, total = job.row.agency_id, job.row.id, len(units)
        with self._database.read() as connection:
            results = cast("dict[int, UnitResult]", list_units(connection, agency_id, job_id))
        job.report_progress(len(results) / total, steps=(len(results), total))
        missing = {k: (document, terms, unit) for k, unit in enumerate(units) if k not in results}
        with closing(results_as_done(self._processes, prove_unit, missing, self._in_flight)) as done:
            for number, result in done:
                results[number] = result
                keep = partial(add_unit, agency_id=agency_id, job_id=job_id, number=number, result=result)
                job.report_progress(len(results) / total, steps=(len(results), total), keep=keep)
        return [results[number] for number in range(total)]

    def _store(self, job: RunningJob, written: WrittenProof) -> None:
        """Store the proof in the plan if its markers are still those that were proved, and finish the job."""
        caller, agency_id, now = caller_of(job), job.row.agency_id, self._clock()
        plan_id, figures = job.row.subject_id, written.summary
        assert plan_id is not None
        with staged(self._blobs) as stage:
            keys = {
                REPORT_FILE: stage.put(_FOLDER, written.report),
                TABLE_FILE: stage.put(_FOLDER, written.table),
            }
            with self._database.write() as connection:
                row = PLANS.get(connection, agency_id, plan_id)
                outdated = row.document_key != job.row.input["document_key"]
                result = ProofResult(
                    plan_version=job.row.input["plan_version"],
                    outdated=outdated,
                    passed=figures["passed"],
                    weak=figures["weak"],
                    wrong=figures["wrong"],
                )
                if not job.finish(connection, result):
                    return
                delete_units(connection, agency_id)
                if outdated:
                    return
                proof = {"job_id": job.row.id, "at": now.isoformat(), "keys": keys, **figures}
                changes: dict[str, object] = {"proof": proof}
                if (status := status_after(row.status, passed=figures["passed"])) != row.status:
                    changes["status"] = status
                PLANS.update(
                    connection, agency_id, plan_id, changes, version=row.version, now=now, who=caller.label, why="proof"
                )
                log_change(connection, caller, "plan.proved", now=now, subject=plan_id, document=figures, status=status)
            stage.keep()
        delete_unused(self._blobs, files_of(row.proof))


def files_of(proof: JsonObject | None) -> list[str]:
    """Keys of the blobs of a plan's proof."""
    return list(proof["keys"].values()) if proof is not None else []


def status_after(status: str, *, passed: bool) -> str:
    """The status of a plan after a proof.

    A checked plan is proved if no reading was wrong, and a proved one is checked again if one was. Weak markers do not
    matter. Drafts stay drafts, and what was approved stays so.
    """
    if status in (CHECKED, PROVED):
        return PROVED if passed else CHECKED
    return status
