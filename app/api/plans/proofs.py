"""/v1/plans/{plan_id}/proof: what simulated vehicles read of a plan."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Response

from app.api.http.dependencies import Caller, Idempotency, Version, use_cases
from app.api.http.problems import problem_responses
from app.api.http.responses import document_response
from app.api.http.strict_json import StrictRoute
from app.api.plans.plan_jobs import queued_response
from app.api.plans.plans import PlanId
from app.api.plans.schemas import ProofIn
from app.services.plans.plan_jobs import PlanJobDocument
from app.services.plans.proof_documents import ProofDocument
from app.services.plans.proofs import REPORT_FILE, Proofs

router = APIRouter(prefix="/v1/plans", tags=["plans"], route_class=StrictRoute)

Service = Annotated[Proofs, use_cases("proofs")]


@router.post(
    "/{plan_id}/proof",
    status_code=202,
    responses=document_response(
        PlanJobDocument, 404, 409, 412, 428, status=202, description="Queued; Location leads to its progress"
    ),
)
def post_proof(
    plan_id: PlanId, terms: ProofIn, caller: Caller, proofs: Service, version: Version, idempotency: Idempotency
) -> Response:
    """Prove a plan: simulated vehicles drive over it, and the real decoders read what they record.

    The same plan, terms and seed give the same report. A checked plan is `proved` if no reading was wrong; weak markers
    are listed and change nothing. The proof belongs to the markers as they are placed now: if other rules place them
    anew in the meantime, the plan is not proved.
    """
    return queued_response(*proofs.request(caller, plan_id, terms, version, idempotency))


@router.get("/{plan_id}/proof", responses={**document_response(ProofDocument, 404), **problem_responses(404)})
def get_proof(plan_id: PlanId, caller: Caller, proofs: Service) -> Response:
    """The report of the latest proof: read rates, fixes, gaps, wrong readings, weak markers and their causes.

    The table of its markers is the plan's file `proof.csv`.
    """
    data, row = proofs.file(caller, plan_id, REPORT_FILE)
    return Response(data, media_type="application/json", headers={"ETag": f'"{row.version}-{REPORT_FILE}"'})
