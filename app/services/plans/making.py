"""Plans of long roads are made by jobs: the caller gets the job, and the plan comes later."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

from app.planning.read_rules import check_rules
from app.registry import jobs as store
from app.registry.database import Database
from app.registry.ids import new_id
from app.registry.jobs import JobKind, new_job
from app.registry.plans import ALIGNMENTS, PLANS
from app.services.access.access import Caller
from app.services.idempotency import IdempotencyKey, write_once
from app.services.jobs import RunningJob
from app.services.plans.plan_jobs import PlanJobDocument, caller_of, plan_job_document
from app.services.plans.plans import Plans
from app.services.ports import Clock, JobQueue

IMMEDIATE_LANES_M = 20_000.0
"""Plans of roads with lanes up to this length are made while the caller waits, longer ones by jobs. [m]
Source: chosen by hand, some seconds with all families."""
_STARTED = 0.1


class PlanMaking:
    """Makes plans as jobs.

    Parameters
    ----------
    database, clock, queue
    plans : Plans
        Does the work.
    idempotency_ttl : timedelta
    """

    def __init__(
        self, database: Database, clock: Clock, queue: JobQueue, *, plans: Plans, idempotency_ttl: timedelta
    ) -> None:
        self._database, self._clock, self._queue = database, clock, queue
        self._plans, self._ttl = plans, idempotency_ttl

    def is_long(self, caller: Caller, alignment_id: str) -> bool:
        """Whether a plan on this alignment takes too long for an immediate response.

        Raises
        ------
        NotFound
            There is no such alignment.
        """
        with self._database.read() as connection:
            row = ALIGNMENTS.get(connection, caller.agency_id, alignment_id)
        return bool(row.summary["lane_length_m"] > IMMEDIATE_LANES_M)

    def request(
        self, caller: Caller, name: str, alignment_id: str, rules: dict[str, Any], key: IdempotencyKey | None = None
    ) -> tuple[PlanJobDocument, bool]:
        """Queue the making of a plan; returns the job and whether the request had been made before.

        Raises
        ------
        NotFound
            There is no such alignment.
        InvalidParameter
            The rules cannot be; whether they fit the road is found out by the job.
        Conflict
            The agency has a plan of this name.
        """
        check_rules(rules)
        now, agency_id = self._clock(), caller.agency_id
        job_input = {"name": name, "alignment_id": alignment_id, "rules": rules, "label": caller.label}
        job = new_job(JobKind.PLAN, new_id(now), agency_id, caller.key_id, now, job_input=job_input)
        with write_once(self._database, agency_id, key, now, self._ttl) as (connection, answer):
            if answer.replayed:
                return answer.response, True
            ALIGNMENTS.get(connection, agency_id, alignment_id)
            PLANS.check_name(connection, agency_id, name)
            store.add_job(connection, job)
            document = answer.store(plan_job_document(job))
        self._queue.submit(job.id, job.agency_id, JobKind.PLAN)
        return document, False

    def run(self, job: RunningJob) -> None:
        """Make a plan that was queued; the handler of jobs of the kind `JobKind.PLAN`."""
        job.report_progress(_STARTED)
        given = job.row.input
        self._plans.make(caller_of(job), given["name"], given["alignment_id"], given["rules"], job=job)
