"""/v1/plans: markers placed on a road by rules, checked, proved, approved, committed and packed; radio checks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Annotated, cast

import orjson
from fastapi import Path, Query, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import ConfigDict, Field, JsonValue, with_config

from app.api.http.dependencies import AfterVersion, Caller, Idempotency, LastId, PageSize, Version, use_case
from app.api.http.permissions import PLANNERS, READERS
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
from app.api.http.routes import Router
from app.api.jobs import queued_job
from app.api.plans.alignments import Name
from app.formats.surveys.declaration import Unit
from app.inputs import Flag, Identifier, StrictModel, Text
from app.planning.outputs.package import MEDIA_TYPES, OutputOptions, PackageOptions
from app.planning.proof import ProofReport, ProofTerms
from app.planning.radio_checks import RadioCheck, RadioPlan, check_radio
from app.planning.rules import read_rules, rules_schema
from app.services.plans.documents import (
    AsBuiltDocument,
    CommittedPlan,
    PlanDocument,
    PlanPage,
    PlanPreview,
    PlanStatus,
    PlanVersionPage,
    ReadRules,
)
from app.services.plans.making import MAX_MARKERS, PlanMaking, PlanPreviews
from app.services.plans.packages import Packages
from app.services.plans.plans import Plans
from app.services.plans.proofs import PROOF_FILES, REPORT_FILE, Proofs
from app.services.progress import JobDocument, PackageJob, PlanJob, ProofJob
from app.values import JsonObject

# === Bodies of requests: rules are a document as docs/plans.md describes it.


MAX_RULES_TEXT = 50_000
"""Longest text of rules. [characters] 25 times the examples; as YAML it takes seconds."""


class PlanIn(StrictModel):
    """A plan to make: the rules are a document as docs/plans.md describes it."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "name": "L 560, plates every 100 m",
                    "alignment_id": "019cb624-0000-7000-8000-0000000000aa",
                    "rules": {"version": 1, "plates": {"spacing_m": 100}},
                }
            ]
        },
    )

    name: Name
    alignment_id: Identifier
    rules: dict[str, object]


class PlanPreviewIn(StrictModel):
    """Rules to try on an alignment."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "alignment_id": "019cb624-0000-7000-8000-0000000000aa",
                    "rules": {"version": 1, "plates": {"spacing_m": 50}},
                }
            ]
        },
    )

    alignment_id: Identifier
    rules: dict[str, object]


class RulesTextIn(StrictModel):
    """A document of rules as it stands in a file."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"text": "version: 1\nplates:\n  spacing_m: 50\n"}]})

    text: str = Field(max_length=MAX_RULES_TEXT, description="YAML 1.2 or JSON.")


class PlanPatch(StrictModel):
    """What to change of a plan; new rules place and check it again."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"rules": {"version": 1, "plates": {"spacing_m": 50}}, "reason": "closer in the bends"}]
        },
    )

    name: Name | None = None
    rules: dict[str, object] | None = None
    reason: Annotated[Text | None, Field(max_length=500)] = None


class ProofIn(ProofTerms):
    """What is driven, and how; every member has a default."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"drives": 20, "seed": 7, "conditions": ["day", "night+rain"]}, {}]}
    )


# === /v1/plan-rules and /v1/plan-previews: rules of plans, and what they would place.


rule_router = Router("/v1", "plans")

SCHEMA_TYPE = "application/schema+json"
_SCHEMA: dict[int | str, JsonObject] = {
    200: {"description": "JSON Schema, draft 2020-12", "content": {SCHEMA_TYPE: {"schema": {"type": "object"}}}}
}


@rule_router.get("/plan-rules/schema", READERS, responses={**_SCHEMA, **problem_responses()})
def get_rules_schema(caller: Caller) -> Response:
    """Get the JSON Schema of rules.

    For editors and forms.
    """
    return Response(_schema(), media_type=SCHEMA_TYPE)


@rule_router.post("/plan-rules", PLANNERS, expensive=True, responses=document_response(ReadRules))
def post_rules_text(wanted: RulesTextIn, caller: Caller) -> Response:
    """Read and check rules of a file.

    YAML or JSON. Nothing is stored: this is for forms.
    """
    rules = read_rules(wanted.text.encode())
    return json_response(ReadRules(rules=rules.model_dump(mode="json", exclude_unset=True, by_alias=True)))


@rule_router.post("/plan-previews", PLANNERS, expensive=True, responses=document_response(PlanPreview, 404))
def post_plan_preview(
    request: Request,
    wanted: PlanPreviewIn,
    caller: Caller,
    previews: Annotated[PlanPreviews, use_case(lambda cases: cases.plan_previews)],
    after: Annotated[int, Query(ge=0, le=10**7, description="Markers of the pages before.")] = 0,
    limit: Annotated[int, Query(ge=1, le=MAX_MARKERS)] = 1000,
) -> Response:
    """Preview a plan without storing it.

    Places and checks what rules ask for on an alignment, to compare rules before a plan is made.

    On at most 20 km of lanes. Markers have no codes. The counts are those of all markers; `markers` is a page of them,
    and a Link header names the next one, which is requested with the same body.
    """
    page, onward = previews.preview(caller, wanted.alignment_id, wanted.rules, after=after, limit=limit)
    return page_response(request, page, after=onward)


@cache
def _schema() -> bytes:
    return orjson.dumps(rules_schema())


# === /v1/plans.


router = Router("/v1/plans", "plans")

FOLLOWS_MARKERS = ("committed", "built", "surveyed")
"""Statuses that change when markers do, without a new version of the plan."""
PlanId = Annotated[Identifier, Path(description="Id of the plan.")]
Service = Annotated[Plans, use_case(lambda cases: cases.plans)]


@router.post(
    "",
    PLANNERS,
    expensive=True,
    status_code=201,
    responses={
        201: {"model": PlanDocument, "description": "Made"},
        202: {"model": PlanJob, "description": "Queued; Location leads to its progress and to the plan"},
        **problem_responses(404, 409),
    },
)
def post_plan(
    wanted: PlanIn,
    caller: Caller,
    plans: Service,
    making: Annotated[PlanMaking, use_case(lambda cases: cases.plan_making)],
    idempotency: Idempotency,
    prefer: Prefer = None,
) -> Response:
    """Make a plan.

    Places the markers that rules ask for on an alignment, and checks them. Nothing is in the registry yet.

    A plan on more than 20 km of lanes is made by a job, and so is one that is asked for with `Prefer: respond-async`.
    """
    asked = (caller, wanted.name, wanted.alignment_id, wanted.rules, idempotency)
    as_job = wants_job(prefer) or making.is_long(caller, wanted.alignment_id)
    document: PlanDocument | JobDocument
    document, replayed = making.request(*asked) if as_job else plans.make(*asked)
    if "attempts" in document:  # a repeated request gets the first response, whichever it was
        return queued_job(cast("JobDocument", document), replayed)
    return created_response(document, replayed, path="/v1/plans")


@router.get("", READERS, responses=document_response(PlanPage))
def list_plans(
    request: Request,
    caller: Caller,
    plans: Service,
    alignment_id: Annotated[Identifier | None, Query(description="Plans on this alignment: its variants.")] = None,
    status: PlanStatus | None = None,
    limit: PageSize = 100,
    after: LastId = None,
) -> Response:
    """List the plans of an agency.

    In the order they were made, with their counts, verdicts and costs side by side.
    """
    page, last = plans.page(caller, alignment_id=alignment_id, status=status, after=after, limit=limit)
    return page_response(request, page, after=last)


@router.get("/{plan_id}", READERS, responses={**NOT_MODIFIED, **document_response(PlanDocument, 404)})
def get_plan(plan_id: PlanId, caller: Caller, plans: Service, if_none_match: IfNoneMatch = None) -> Response:
    """Get a plan with its findings.

    With its version as ETag. A committed one is always sent: its status follows from its markers.
    """
    plan = plans.get(caller, plan_id)
    return versioned_response(plan, None if plan["status"] in FOLLOWS_MARKERS else if_none_match)


@router.patch("/{plan_id}", PLANNERS, expensive=True, responses=document_response(PlanDocument, 404, 409, 412, 428))
def patch_plan(plan_id: PlanId, patch: PlanPatch, caller: Caller, plans: Service, version: Version) -> Response:
    """Rename a plan, or make it again by other rules.

    Its proof and its approval are then gone.
    """
    changed = plans.change(caller, plan_id, version, name=patch.name, rules=patch.rules, reason=patch.reason)
    return versioned_response(changed)


@router.get("/{plan_id}/versions", READERS, responses=document_response(PlanVersionPage, 404))
def list_plan_versions(
    request: Request, plan_id: PlanId, caller: Caller, plans: Service, limit: PageSize = 100, after: AfterVersion = 0
) -> Response:
    """List the versions of a plan.

    Oldest first.
    """
    page, last = plans.history(caller, plan_id, after=after, limit=limit)
    return page_response(request, page, after=last)


@router.get(
    "/{plan_id}/files/{name}",
    READERS,
    expensive=True,
    responses={**file_response(sorted(set(MEDIA_TYPES.values()))), **problem_responses(404)},
)
def get_plan_file(
    plan_id: PlanId,
    name: Annotated[Text, Path(max_length=60, examples=["bill.csv"])],
    caller: Caller,
    plans: Service,
    proofs: Annotated[Proofs, use_case(lambda cases: cases.proofs)],
    crs: Annotated[Text | None, Query(max_length=64, description="CRS of the stakeout.")] = None,
    unit: Annotated[Unit | None, Query(description="Unit of the stakeout.")] = None,
    realization: Annotated[
        Text | None, Query(max_length=64, description="Realization of that CRS; that of the road if left out.")
    ] = None,
    epoch: Annotated[
        float | None, Query(ge=1950, le=2200, allow_inf_nan=False, description="That of the road if left out.")
    ] = None,
) -> Response:
    """Download a file of a plan.

    Its document, bill, stakeout, drawings, map, or the table of its proof.

    A wrong name is answered with the right ones.
    """
    if name in PROOF_FILES:
        data, row = proofs.file(caller, plan_id, name)
        version = row.version
    else:
        data, version = plans.file(caller, plan_id, name, OutputOptions(crs, unit, realization, epoch))
    media_type = MEDIA_TYPES.get(name.rpartition(".")[2], "application/octet-stream")
    headers = {"ETag": f'"{version}-{name}"', "Content-Disposition": f'attachment; filename="{name}"'}
    return Response(data, media_type=media_type, headers=headers)


@router.post("/{plan_id}/approve", PLANNERS, responses=document_response(PlanDocument, 404, 409, 412, 428))
def approve_plan(plan_id: PlanId, caller: Caller, plans: Service, version: Version) -> Response:
    """Approve a plan.

    One that the holder of another key made and whose checks passed.
    """
    return versioned_response(plans.approve(caller, plan_id, version))


@router.post(
    "/{plan_id}/commit",
    PLANNERS,
    expensive=True,
    status_code=201,
    responses=document_response(CommittedPlan, 404, 409, 412, 428, status=201, description="Committed"),
)
def commit_plan(
    plan_id: PlanId, caller: Caller, plans: Service, version: Version, idempotency: Idempotency
) -> Response:
    """Commit a plan to the registry.

    The markers of an approved plan become planned markers: all of them or none.
    """
    document, replayed = plans.commit(caller, plan_id, version, idempotency)
    return created_response(document, replayed)


@router.get("/{plan_id}/as-built", READERS, expensive=True, responses=document_response(AsBuiltDocument, 404))
def get_as_built(plan_id: PlanId, caller: Caller, plans: Service) -> Response:
    """Compare a plan with what was built and surveyed.

    Residuals, tolerances, and what that does to the checks.
    """
    return json_response(plans.as_built(caller, plan_id))


# === /v1/plans/{plan_id}/package: all files of a plan in one ZIP.


package_router = Router("/v1/plans", "plans")

PackageService = Annotated[Packages, use_case(lambda cases: cases.packages)]


@package_router.post(
    "/{plan_id}/package",
    PLANNERS,
    status_code=202,
    responses=document_response(PackageJob, 404, 409, status=202, description="Queued; Location leads to its progress"),
)
def post_package(
    plan_id: PlanId, wanted: PackageOptions, caller: Caller, packages: PackageService, idempotency: Idempotency
) -> Response:
    """Pack all files of a plan.

    Drawings, stakeout, bill, maps, drilling sheets, artwork and a manifest with SHA-256.

    Every plate is read back from its drawing first. The package replaces the plan's earlier one.
    """
    return queued_job(*packages.request(caller, plan_id, wanted, idempotency))


@package_router.get(
    "/{plan_id}/package",
    READERS,
    response_class=StreamingResponse,
    responses={**file_response(["application/zip"], "The package"), **NOT_MODIFIED, **problem_responses(404)},
)
def get_package(
    plan_id: PlanId, caller: Caller, packages: PackageService, if_none_match: IfNoneMatch = None
) -> Response:
    """Download the package of a plan.

    As it was packed last; 404 if its markers were placed again since.
    """
    package = packages.open(caller, plan_id)
    headers = {"ETag": f'"{package.sha256}"'}
    if if_none_match == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    headers |= {
        "Content-Length": str(package.size_bytes),
        "Content-Disposition": f'attachment; filename="plan-{plan_id}.zip"',
    }
    return StreamingResponse(package.chunks, headers=headers, media_type="application/zip")


# === /v1/plans/{plan_id}/proof: what simulated vehicles read of a plan.


proof_router = Router("/v1/plans", "plans")

ProofService = Annotated[Proofs, use_case(lambda cases: cases.proofs)]


@proof_router.post(
    "/{plan_id}/proof",
    PLANNERS,
    status_code=202,
    responses=document_response(
        ProofJob, 404, 409, 412, 428, status=202, description="Queued; Location leads to its progress"
    ),
)
def post_proof(
    plan_id: PlanId, terms: ProofIn, caller: Caller, proofs: ProofService, version: Version, idempotency: Idempotency
) -> Response:
    """Prove a plan.

    Simulated vehicles drive over it, and the real decoders read what they record.

    The same plan, terms and seed give the same report. A checked plan is `proved` if no reading was wrong; weak markers
    are listed and change nothing. The proof belongs to the markers as they are placed now: if other rules place them
    again in the meantime, the plan is not proved.
    """
    return queued_job(*proofs.request(caller, plan_id, terms, version, idempotency))


@proof_router.get(
    "/{plan_id}/proof", READERS, responses={**document_response(ProofReport, 404), **problem_responses(404)}
)
def get_proof(plan_id: PlanId, caller: Caller, proofs: ProofService) -> Response:
    """Get the report of a plan's latest proof.

    Read rates, fixes, gaps, wrong readings, weak markers and their causes.

    The table of its markers is the plan's file `proof.csv`.
    """
    data, row = proofs.file(caller, plan_id, REPORT_FILE)
    return Response(data, media_type="application/json", headers={"ETag": f'"{row.version}-{REPORT_FILE}"'})


# === /v1/radio-checks: whether markers along a road can be read in time, and lawfully.


radio_router = Router("/v1/radio-checks", "cerpms")

_RADIO_EXAMPLES: list[JsonValue] = [
    {"radio": {"spreading_factor": 7, "bandwidth_hz": 500_000, "interval_s": 2.0}, "design_speed_m_s": 13.4},
    {
        "region": "EU868",
        "radio": {"frequency_hz": 868_300_000, "bandwidth_hz": 125_000, "interval_s": 10.0, "power_dbm": 11.0},
        "road": {"spacing_m": 24.384, "sides": 1},
        "recommend": True,
    },
]


@with_config(ConfigDict(extra="forbid", json_schema_extra={"examples": _RADIO_EXAMPLES}))
@dataclass(frozen=True, slots=True)
class RadioCheckIn(RadioPlan):
    """A plan to check."""

    recommend: Annotated[
        Flag, Field(description="Also search for lawful settings that reach it; takes a second or two.")
    ] = False


@radio_router.post("", READERS, expensive=True, responses=document_response(RadioCheck))
def post_radio_check(wanted: RadioCheckIn, caller: Caller) -> Response:
    """Check the radios of CERPMs on a road.

    Law, link, collisions, reading in time, battery. Nothing is stored.
    """
    return json_response(check_radio(wanted, recommend=wanted.recommend))
