"""Proofs of plans: simulated drives in the decoder processes, unit by unit, as a job that goes on after a restart."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from contextlib import closing
from datetime import timedelta
from functools import partial
from typing import Any, cast

from app.errors import NotFound
from app.planning.proof import ProofTerms, UnitResult
from app.registry import jobs as store
from app.registry.database import Database
from app.registry.ids import new_id
from app.registry.jobs import JobKind, new_job
from app.registry.plans import PLANS, PlanRow
from app.registry.proof_units import add_unit, delete_units, list_units
from app.services.access.access import Caller
from app.services.access.audit import log_change
from app.services.decoder_processes import DecoderProcesses
from app.services.idempotency import IdempotencyKey, find_earlier, write_once
from app.services.jobs import RunningJob
from app.services.plans.alignments import BUSY_WAIT_S
from app.services.plans.fan_out import WAIT_S, tasks_as_done
from app.services.plans.plan_jobs import PlanJobDocument, caller_of, check_only_one, plan_job_document
from app.services.plans.proof_tasks import ListUnitsTask, ProveUnitTask, WriteProofTask, WrittenProof
from app.services.plans.statuses import CHECKED, PROVED
from app.services.ports import Blobs, Clock, JobQueue
from app.services.staged_blobs import delete_unused, staged

REPORT_FILE, TABLE_FILE = "proof.json", "proof.csv"
PROOF_FILES = (REPORT_FILE, TABLE_FILE)
"""Files that a plan has once it is proved."""
_FOLDER = "proofs"


class Proofs:
    """Use cases on proofs of plans.

    Parameters
    ----------
    database, clock, blobs, processes, queue
    in_flight : int
        Units of one proof that are driven at the same time.
    idempotency_ttl : timedelta
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
    ) -> tuple[PlanJobDocument, bool]:
        """Queue the proof of a plan as it is.

        Returns
        -------
        job : PlanJobDocument
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
        check = ListUnitsTask(self._blobs.get(row.document_key), terms, only_check=True)
        self._processes.submit(check, wait_s=BUSY_WAIT_S).result()
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
            document = answer.store(plan_job_document(job))
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
        written = self._processes.submit(WriteProofTask(document, terms, results), wait_s=WAIT_S).result()
        self._store(job, written)

    def _drive(self, job: RunningJob, document: bytes, terms: ProofTerms) -> list[UnitResult]:
        """Results of all units; those that an earlier attempt finished are taken from the database."""
        units = self._processes.submit(ListUnitsTask(document, terms), wait_s=WAIT_S).result()
        agency_id, job_id, total = job.row.agency_id, job.row.id, len(units)
        with self._database.read() as connection:
            results = cast("dict[int, UnitResult]", list_units(connection, agency_id, job_id))
        job.report_progress(len(results) / total, steps=(len(results), total))
        tasks = ((k, ProveUnitTask(document, terms, unit)) for k, unit in enumerate(units) if k not in results)
        with closing(tasks_as_done(self._processes, tasks, self._in_flight)) as done:
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
                result = {
                    "plan_version": job.row.input["plan_version"],
                    "outdated": outdated,
                    **{name: figures[name] for name in ("passed", "weak", "wrong")},
                }
                if not job.finish(connection, result):
                    return
                delete_units(connection, agency_id)
                if outdated:
                    return
                proof = {"job_id": job.row.id, "at": now.isoformat(), "keys": keys, **figures}
                changes: dict[str, Any] = {"proof": proof}
                if (status := status_after(row.status, passed=figures["passed"])) != row.status:
                    changes["status"] = status
                PLANS.update(
                    connection, agency_id, plan_id, changes, version=row.version, now=now, who=caller.label, why="proof"
                )
                log_change(
                    connection, caller, "plan.proved", now=now, subject=plan_id, document=figures,
                    status=status,
                )  # fmt: skip
            stage.keep()
        delete_unused(self._blobs, files_of(row.proof))


def files_of(proof: Mapping[str, Any] | None) -> list[str]:
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
