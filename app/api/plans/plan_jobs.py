"""/v1/plan-jobs: progress, results and cancelling of jobs about plans."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query, Request, Response

from app.api.http.dependencies import Caller, Identifier, LastId, PageSize, use_cases
from app.api.http.responses import created_response, document_response, json_response, page_response
from app.api.http.strict_json import StrictRoute
from app.registry.jobs import JobState
from app.services.plans.plan_jobs import PlanJobDocument, PlanJobPage, PlanJobs

router = APIRouter(prefix="/v1/plan-jobs", tags=["plans"], route_class=StrictRoute)

JobId = Annotated[Identifier, Path(description="Id of the job.")]
Service = Annotated[PlanJobs, use_cases("plan_jobs")]


def queued_response(job: PlanJobDocument, replayed: bool) -> Response:
    """202 Accepted for a job that was queued."""
    response = created_response(job, replayed, path="/v1/plan-jobs", status=202)
    response.headers["Retry-After"] = "1"
    return response


@router.get("", responses=document_response(PlanJobPage))
def list_plan_jobs(
    request: Request,
    caller: Caller,
    jobs: Service,
    plan_id: Annotated[Identifier | None, Query(description="Jobs about this plan.")] = None,
    state: JobState | None = None,
    limit: PageSize = 100,
    before: LastId = None,
) -> Response:
    """Jobs about plans without their results, newest first."""
    page, last = jobs.page(caller, plan_id=plan_id, state=state, before=before, limit=limit)
    return page_response(request, page, before=last)


@router.get("/{job_id}", responses=document_response(PlanJobDocument, 404))
def get_plan_job(job_id: JobId, caller: Caller, jobs: Service) -> Response:
    """A job with its progress, or its result."""
    document = jobs.get(caller, job_id)
    waiting = document["state"] in ("queued", "running")
    return json_response(document, headers={"Retry-After": "1"} if waiting else None)


@router.post("/{job_id}/cancel", responses=document_response(PlanJobDocument, 404))
def cancel_plan_job(job_id: JobId, caller: Caller, jobs: Service) -> Response:
    """Ask a queued or running job to stop; a finished one stays as it is."""
    return json_response(jobs.cancel(caller, job_id))
