"""/v1/plans/{plan_id}/package: all files of a plan in one ZIP."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Response
from fastapi.responses import StreamingResponse

from app.api.http.dependencies import Caller, Idempotency, use_cases
from app.api.http.problems import problem_responses
from app.api.http.responses import NOT_MODIFIED, IfNoneMatch, document_response, file_response
from app.api.http.strict_json import StrictRoute
from app.api.plans.plan_jobs import queued_response
from app.api.plans.plans import PlanId
from app.api.plans.schemas import PackageIn
from app.services.plans.packages import Packages
from app.services.plans.plan_jobs import PlanJobDocument

router = APIRouter(prefix="/v1/plans", tags=["plans"], route_class=StrictRoute)

Service = Annotated[Packages, use_cases("packages")]


@router.post(
    "/{plan_id}/package",
    status_code=202,
    responses=document_response(
        PlanJobDocument, 404, 409, status=202, description="Queued; Location leads to its progress"
    ),
)
def post_package(
    plan_id: PlanId, wanted: PackageIn, caller: Caller, packages: Service, idempotency: Idempotency
) -> Response:
    """Pack all files of a plan: drawings, stakeout, bill, maps, drilling sheets, artwork and a manifest with SHA-256.

    Every plate is read back from its drawing first. The package replaces the plan's earlier one.
    """
    return queued_response(*packages.request(caller, plan_id, wanted.options(), idempotency))


@router.get(
    "/{plan_id}/package",
    response_class=StreamingResponse,
    responses={**file_response(["application/zip"], "The package"), **NOT_MODIFIED, **problem_responses(404)},
)
def get_package(plan_id: PlanId, caller: Caller, packages: Service, if_none_match: IfNoneMatch = None) -> Response:
    """The package of a plan, as it was packed last; 404 if its markers were placed anew since."""
    package = packages.open(caller, plan_id)
    headers = {"ETag": f'"{package.sha256}"'}
    if if_none_match == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    headers |= {
        "Content-Length": str(package.size_bytes),
        "Content-Disposition": f'attachment; filename="plan-{plan_id}.zip"',
    }
    return StreamingResponse(package.chunks, headers=headers, media_type="application/zip")
