"""/v1/plan-rules and /v1/plan-previews: rules of plans, and what they would place."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any

import orjson
from fastapi import APIRouter, Query, Request, Response

from app.api.http.dependencies import Caller, use_cases
from app.api.http.problems import problem_responses
from app.api.http.responses import document_response, json_response, page_response
from app.api.http.strict_json import StrictRoute
from app.api.plans.schemas import PlanPreviewIn, RulesTextIn
from app.planning.read_rules import read_rules, rules_schema
from app.services.plans.documents import PlanPreview, ReadRules
from app.services.plans.previews import MAX_MARKERS, PlanPreviews

router = APIRouter(prefix="/v1", tags=["plans"], route_class=StrictRoute)

SCHEMA_TYPE = "application/schema+json"
_SCHEMA: dict[int | str, dict[str, Any]] = {
    200: {"description": "JSON Schema, draft 2020-12", "content": {SCHEMA_TYPE: {"schema": {"type": "object"}}}}
}


@router.get("/plan-rules/schema", responses={**_SCHEMA, **problem_responses()})
def get_rules_schema(caller: Caller) -> Response:
    """The JSON Schema of rules, for editors and forms."""
    return Response(_schema(), media_type=SCHEMA_TYPE)


@router.post("/plan-rules", responses=document_response(ReadRules))
def post_rules_text(wanted: RulesTextIn, caller: Caller) -> Response:
    """Read and check rules of a file, YAML or JSON, and store nothing: for forms."""
    rules = read_rules(wanted.text.encode())
    return json_response(ReadRules(rules=rules.model_dump(mode="json", exclude_unset=True, by_alias=True)))


@router.post("/plan-previews", responses=document_response(PlanPreview, 404))
def post_plan_preview(
    request: Request,
    wanted: PlanPreviewIn,
    caller: Caller,
    previews: Annotated[PlanPreviews, use_cases("plan_previews")],
    after: Annotated[int, Query(ge=0, le=10**7, description="Markers of the pages before.")] = 0,
    limit: Annotated[int, Query(ge=1, le=MAX_MARKERS)] = 1000,
) -> Response:
    """Place and check what rules ask for on an alignment, and store nothing: to compare rules before a plan is made.

    On at most 20 km of lanes. Markers have no codes. The counts are those of all markers; `markers` is a page of them,
    and a Link header names the next one, which is requested with the same body.
    """
    page, onward = previews.preview(caller, wanted.alignment_id, wanted.rules, after=after, limit=limit)
    return page_response(request, page, after=onward)


@cache
def _schema() -> bytes:
    return orjson.dumps(rules_schema())
