"""POST /v1/markers/bulk: many markers in one request, a result for each."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, Literal

import orjson
from fastapi import APIRouter, Depends, Request, Response
from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError

from app.api.dependencies import Caller, Idempotency, Identifier, json_response
from app.api.markers import NewMarkerIn, given_marker
from app.api.permissions import PERMISSIONS
from app.api.problems import MEDIA_TYPE, kind_of, problem_responses, validation_fault
from app.api.schemas_markers import PLATE_EXAMPLES
from app.api.schemas_patch import MarkerPatch
from app.api.strict_json import StrictRoute
from app.errors import InvalidParameter, WaymarkError
from app.services.bulk_markers import BulkMarkers as BulkMarkersService
from app.services.bulk_markers import GivenBulk, Item, MarkerUpdate

router = APIRouter(prefix="/v1/markers", tags=["markers"], route_class=StrictRoute)

MAX_ITEMS = 1000
_REFUSED = {"type": "urn:waymark:problem:bulk-refused", "title": "The items were refused", "status": 422}


class UpdateIn(BaseModel):
    """A change of a marker that is still at a version."""

    model_config = ConfigDict(extra="forbid")

    id: Identifier
    version: Annotated[int, Field(strict=True, ge=1, lt=2**31)] = Field(description="As If-Match of a single change.")
    change: MarkerPatch


class ItemIn(BaseModel):
    """A marker to register, or a change of one."""

    model_config = ConfigDict(extra="forbid")

    create: NewMarkerIn | None = None
    update: UpdateIn | None = None


class BulkIn(BaseModel):
    """Items, and what shall become of them. Each item is checked by itself."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "items": [
                        {"create": PLATE_EXAMPLES[0]},
                        {
                            "update": {
                                "id": "019cb624-0000-7000-8000-00000000aaaa",
                                "version": 3,
                                "change": {"status": "retired", "reason": "resurfaced"},
                            }
                        },
                    ],
                    "mode": "good",
                    "dry_run": True,
                }
            ]
        },
    )

    items: list[JsonValue] = Field(
        min_length=1,
        max_length=MAX_ITEMS,
        description="Each `{create: a marker}` or `{update: {id, version, change}}`, as POST and PATCH take them.",
    )
    mode: Literal["all", "good"] = Field("all", description="Store all items or none, or those that are good.")
    dry_run: Annotated[bool, Field(strict=True)] = Field(False, description="Say what would happen; store nothing.")


class RowProblem(BaseModel):
    """What is wrong with an item."""

    type: str
    title: str
    status: int
    detail: str
    field: str | None = None
    limit: str | None = None
    cure: str | None = None


class ResultOut(BaseModel):
    """What became of an item: 201 registered, 200 changed, or the status of its problem."""

    index: int
    status: int
    id: str | None
    version: int | None
    problem: RowProblem | None


class BulkReportOut(BaseModel):
    """What became of all items."""

    outcome: Literal["stored", "checked", "refused"]
    dry_run: bool
    mode: Literal["all", "good"]
    items: int
    created: int
    updated: int
    refused: int
    results: list[ResultOut]


async def get_bulk(request: Request) -> BulkMarkersService:
    """The use case."""
    service: BulkMarkersService = request.app.state.bulk_markers
    return service


Bulk = Annotated[BulkMarkersService, Depends(get_bulk)]


@router.post(
    "/bulk",
    response_class=Response,
    responses={200: {"model": BulkReportOut, "description": "Stored, or checked"}, **problem_responses(409)},
)
def post_bulk(body: BulkIn, request: Request, caller: Caller, bulk: Bulk, idempotency: Idempotency) -> Response:
    """Register and change up to 1000 markers in one transaction, with a result for each.

    Refused items of the mode `all` answer 422, with the report in the problem; nothing is stored then.
    """
    if any(isinstance(item, dict) and "create" in item for item in body.items):
        caller.require(PERMISSIONS["POST /v1/markers"])
    items = [_read(item) for item in body.items]
    report, replayed = bulk.run(
        caller, GivenBulk(items, body.mode, body.dry_run), partial(_described, body.items), idempotency
    )
    if report["outcome"] == "refused":
        return _refused(request, report)
    return json_response(report, headers={"Idempotency-Replayed": "true"} if replayed else None)


def _read(item: JsonValue) -> Item:
    try:
        read = ItemIn.model_validate(item)
        if (read.create is None) == (read.update is None):
            return InvalidParameter(
                "an item registers a marker or changes one",
                field="create",
                limit="create or update",
                cure="send one of the two",
            )
        if read.create is not None:
            return given_marker(read.create)
        assert read.update is not None
        return MarkerUpdate(read.update.id, read.update.version, read.update.change.change())
    except ValidationError as error:
        first = error.errors()[0]
        fault = validation_fault({**first, "loc": ("body", *first["loc"])})
        return InvalidParameter(fault.detail, field=fault.field, limit=fault.limit, cure=fault.cure)
    except WaymarkError as error:
        return error


_OF_UPDATES = {"If-Match": "update.version", "marker_id": "update.id"}


def _path(item: JsonValue, field: str | None) -> str:
    """Path of an input at fault in the item, from its path in the marker or the change."""
    if field is None or not isinstance(item, dict):
        return ""
    if field.split(".")[0] in ItemIn.model_fields:
        return field
    if "create" in item:
        return f"create.{field}"
    return _OF_UPDATES.get(field, f"update.change.{field}")


def _described(items: list[JsonValue], index: int, error: WaymarkError) -> dict[str, Any]:
    kind = kind_of(error)
    if kind is None:
        raise error
    return {
        "type": kind.type,
        "title": kind.title,
        "status": kind.status,
        "detail": error.message,
        "field": f"items.{index}.{_path(items[index], error.field)}".rstrip("."),
        "limit": error.limit,
        "cure": error.cure,
    }


def _refused(request: Request, report: dict[str, Any]) -> Response:
    first = next(result["problem"] for result in report["results"] if result["problem"] is not None)
    body = {
        **_REFUSED,
        "detail": f"{first['field']}: {first['detail']}; {report['refused']} of {report['items']} items are refused",
        "instance": request.url.path,
        "request_id": request.scope.get("state", {}).get("request_id"),
        "field": first["field"],
        "limit": "all items good" if report["mode"] == "all" else "one good item at least",
        "cure": first["cure"] or 'correct the items, or send mode "good" to store the others',
        "report": report,
    }
    return Response(orjson.dumps(body), 422, media_type=MEDIA_TYPE)
