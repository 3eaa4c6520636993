"""Plans of long roads are made by jobs: the caller gets the job, the plan comes later; previews are made at once."""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from datetime import timedelta
from typing import cast

import orjson

from app.errors import InvalidParameter
from app.planning.rules import check_rules
from app.registry import jobs as store
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.jobs import JobKind, new_job
from app.registry.plans import ALIGNMENTS, PLANS
from app.services.access.access import Caller
from app.services.idempotency import IdempotencyKey, write_once
from app.services.jobs import RunningJob
from app.services.plans.documents import PlanPreview, PreviewedMarker
from app.services.plans.plans import Plans
from app.services.plans.proofs import caller_of
from app.services.plans.tasks import MadePlan
from app.services.ports import Clock, JobQueue
from app.services.progress import JobDocument, job_document

IMMEDIATE_LANES_M = 20_000.0
"""Plans of roads with lanes up to this length are made while the caller waits, longer ones by jobs. [m] Some seconds
with all families."""
_STARTED = 0.1


class PlanMaking:
    """Makes plans as jobs.

    Parameters
    ----------
    plans : Plans
        Does the work.
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
        self, caller: Caller, name: str, alignment_id: str, rules: dict[str, object], key: IdempotencyKey | None = None
    ) -> tuple[JobDocument, bool]:
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
            document = answer.store(job_document(job, now))
        self._queue.submit(job.id, job.agency_id, JobKind.PLAN)
        return document, False

    def run(self, job: RunningJob) -> None:
        """Make a plan that was queued; the handler of jobs of the kind `JobKind.PLAN`."""
        job.report_progress(_STARTED)
        given = job.row.input
        self._plans.make(caller_of(job), given["name"], given["alignment_id"], given["rules"], job=job)


# === Plans that are placed and checked to see what rules do; nothing is stored.


_NAME = "preview"
MAX_MARKERS = 10_000
"""Markers of a page: 1.7 MB. As pages of features."""
_KEPT = 4  # previews whose further pages need no computation; a large one takes 5 MB compressed


class PlanPreviews:
    """Shows what rules would place.

    Parameters
    ----------
    making : PlanMaking
        Decides which roads are too long.
    """

    def __init__(self, plans: Plans, making: PlanMaking) -> None:
        self._plans, self._making = plans, making
        self._kept: OrderedDict[bytes, MadePlan] = OrderedDict()
        self._lock = threading.Lock()

    def preview(
        self, caller: Caller, alignment_id: str, rules: dict[str, object], *, after: int = 0, limit: int = MAX_MARKERS
    ) -> tuple[PlanPreview, int | None]:
        """Counts, checks, costs and a page of markers of a plan by these rules, and where the next page begins.

        Parameters
        ----------
        after : int, optional
            Markers of the pages before. The first page is always computed; the pages after it are those of the
            last preview with the same rules, as long as this process keeps it.
        limit : int, optional
            Most markers of the page.

        Raises
        ------
        NotFound
            There is no such alignment.
        InvalidParameter
            The rules are invalid, or do not fit the road; or the road is too long for an immediate response.
        """
        if self._making.is_long(caller, alignment_id):
            raise InvalidParameter(
                "the road is too long for a preview",
                field="alignment_id",
                limit=f"{IMMEDIATE_LANES_M / 1000:g} km of lanes",
                cure="make the plan, which is a job then",
            )
        key = hashlib.sha256(orjson.dumps([caller.agency_id, alignment_id, rules])).digest()
        with self._lock:
            made = self._kept.get(key) if after else None
        if made is None:
            made = self._plans.place(caller, _NAME, alignment_id, rules)
            with self._lock:
                self._kept[key] = made
                self._kept.move_to_end(key)
                if len(self._kept) > _KEPT:
                    self._kept.popitem(last=False)
        count = made.features.count
        members = PreviewedMarker.__annotations__ if count else ()
        columns = {name: made.features.values(name)[after : after + limit] for name in members}
        rows = zip(*columns.values(), strict=True)
        markers = [dict(zip(columns, row, strict=True)) for row in rows]
        onward = after + limit if after + limit < count else None
        return cast("PlanPreview", {**made.summary, "markers": markers}), onward
