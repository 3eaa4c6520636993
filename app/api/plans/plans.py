"""/v1/plans: markers placed on a road by rules, checked, approved, committed, and compared with what was built."""

from __future__ import annotations

from typing import Annotated, Literal, cast

from fastapi import APIRouter, Path, Query, Request, Response

from app.api.http.dependencies import (
    AfterVersion,
    Caller,
    Idempotency,
    Identifier,
    LastId,
    PageSize,
    Text,
    Version,
    use_cases,
)
from app.api.http.problems import problem_responses
from app.api.http.responses import (
    NOT_MODIFIED,
    IfNoneMatch,
    Prefer,
    created_response,
    document_response,
    file_response,
    json_response,
    page_response,
    versioned_response,
    wants_job,
)
from app.api.http.strict_json import StrictRoute
from app.api.plans.plan_jobs import queued_response
from app.api.plans.schemas import PlanIn, PlanPatch
from app.planning.outputs.files import MEDIA_TYPES
from app.services.plans.documents import (
    AsBuiltDocument,
    CommittedPlan,
    PlanDocument,
    PlanPage,
    PlanStatus,
    PlanVersionPage,
)
from app.services.plans.making import PlanMaking
from app.services.plans.plan_jobs import PlanJobDocument
from app.services.plans.plans import Plans
from app.services.plans.proofs import PROOF_FILES, Proofs

router = APIRouter(prefix="/v1/plans", tags=["plans"], route_class=StrictRoute)

FOLLOWS_MARKERS = ("committed", "built", "surveyed")
"""Statuses that change when markers do, without a new version of the plan."""
PlanId = Annotated[Identifier, Path(description="Id of the plan.")]
Service = Annotated[Plans, use_cases("plans")]


@router.post(
    "",
    status_code=201,
    responses={
        201: {"model": PlanDocument, "description": "Made"},
        202: {"model": PlanJobDocument, "description": "Queued; Location leads to its progress and to the plan"},
        **problem_responses(404, 409),
    },
)
def post_plan(
    wanted: PlanIn,
    caller: Caller,
    plans: Service,
    making: Annotated[PlanMaking, use_cases("plan_making")],
    idempotency: Idempotency,
    prefer: Prefer = None,
) -> Response:
    """Place the markers that rules ask for on an alignment, and check them. Nothing is in the registry yet.

    A plan on more than 20 km of lanes is made by a job, and so is one that is asked for with `Prefer: respond-async`.
    """
    asked = (caller, wanted.name, wanted.alignment_id, wanted.rules, idempotency)
    as_job = wants_job(prefer) or making.is_long(caller, wanted.alignment_id)
    document: PlanDocument | PlanJobDocument
    document, replayed = making.request(*asked) if as_job else plans.make(*asked)
    if "attempts" in document:  # a repeated request gets the first response, whichever it was
        return queued_response(cast("PlanJobDocument", document), replayed)
    return created_response(document, replayed, path="/v1/plans")


@router.get("", responses=document_response(PlanPage))
def list_plans(
    request: Request,
    caller: Caller,
    plans: Service,
    alignment_id: Annotated[Identifier | None, Query(description="Plans on this alignment: its variants.")] = None,
    status: PlanStatus | None = None,
    limit: PageSize = 100,
    after: LastId = None,
) -> Response:
    """Plans in the order they were made, with their counts, verdicts and costs side by side."""
    page, last = plans.page(caller, alignment_id=alignment_id, status=status, after=after, limit=limit)
    return page_response(request, page, after=last)


@router.get("/{plan_id}", responses={**NOT_MODIFIED, **document_response(PlanDocument, 404)})
def get_plan(plan_id: PlanId, caller: Caller, plans: Service, if_none_match: IfNoneMatch = None) -> Response:
    """One plan with its findings, with its version as ETag. A committed one is always sent: its status follows from its
    markers.
    """
    plan = plans.get(caller, plan_id)
    return versioned_response(plan, None if plan["status"] in FOLLOWS_MARKERS else if_none_match)


@router.patch("/{plan_id}", responses=document_response(PlanDocument, 404, 409, 412, 428))
def patch_plan(plan_id: PlanId, wanted: PlanPatch, caller: Caller, plans: Service, version: Version) -> Response:
    """Rename a plan, or place and check it again by other rules; its proof and its approval are then gone."""
    return versioned_response(plans.change(caller, plan_id, wanted.change(), version))


@router.get("/{plan_id}/versions", responses=document_response(PlanVersionPage, 404))
def list_plan_versions(
    request: Request, plan_id: PlanId, caller: Caller, plans: Service, limit: PageSize = 100, after: AfterVersion = 0
) -> Response:
    """The history of a plan, oldest first."""
    page, last = plans.history(caller, plan_id, after=after, limit=limit)
    return page_response(request, page, after=last)


@router.get(
    "/{plan_id}/files/{name}",
    responses={**file_response(sorted(set(MEDIA_TYPES.values()))), **problem_responses(404)},
)
def get_plan_file(
    plan_id: PlanId,
    name: Annotated[Text, Path(max_length=60, examples=["bill.csv"])],
    caller: Caller,
    plans: Service,
    proofs: Annotated[Proofs, use_cases("proofs")],
    crs: Annotated[Text | None, Query(max_length=64, description="CRS of the stakeout.")] = None,
    unit: Annotated[Literal["m", "ft-us", "ft-intl"] | None, Query(description="Unit of the stakeout.")] = None,
) -> Response:
    """A file of a plan: its document, bill, stakeout, drawings, map, or the table of its proof.

    A wrong name is answered with the right ones.
    """
    if name in PROOF_FILES:
        data, row = proofs.file(caller, plan_id, name)
        version = row.version
    else:
        data, version = plans.file(caller, plan_id, name, crs=crs, unit=unit)
    media_type = MEDIA_TYPES.get(name.rpartition(".")[2], "application/octet-stream")
    headers = {"ETag": f'"{version}-{name}"', "Content-Disposition": f'attachment; filename="{name}"'}
    return Response(data, media_type=media_type, headers=headers)


@router.post("/{plan_id}/approve", responses=document_response(PlanDocument, 404, 409, 412, 428))
def approve_plan(plan_id: PlanId, caller: Caller, plans: Service, version: Version) -> Response:
    """Approve a plan that the holder of another key made and whose checks passed."""
    return versioned_response(plans.approve(caller, plan_id, version))


@router.post(
    "/{plan_id}/commit",
    status_code=201,
    responses=document_response(CommittedPlan, 404, 409, 412, 428, status=201, description="Committed"),
)
def commit_plan(
    plan_id: PlanId, caller: Caller, plans: Service, version: Version, idempotency: Idempotency
) -> Response:
    """Make the markers of an approved plan planned markers of the registry: all of them or none."""
    document, replayed = plans.commit(caller, plan_id, version, idempotency)
    return created_response(document, replayed)


@router.get("/{plan_id}/as-built", responses=document_response(AsBuiltDocument, 404))
def get_as_built(plan_id: PlanId, caller: Caller, plans: Service) -> Response:
    """A plan beside what was built and surveyed: residuals, tolerances, and what that does to the checks."""
    return json_response(plans.as_built(caller, plan_id))
