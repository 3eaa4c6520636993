"""POST /v1/markers/bulk: many markers in one request, a result for each."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Literal

from fastapi import APIRouter, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import ConfigDict, Field, JsonValue, TypeAdapter

from app.api.http.dependencies import Caller, Idempotency, Identifier, use_cases
from app.api.http.permissions import PERMISSIONS
from app.api.http.problems import FieldError, Problem, kind_of, problem_responses, report_problem, validation_fault
from app.api.http.responses import created_response
from app.api.http.strict_json import StrictRoute, validated
from app.api.markers.markers import WARNINGS_TEXT, NewMarkerIn
from app.api.markers.schemas_patch import MarkerPatch
from app.errors import InvalidParameter, WaymarkError
from app.families.inputs import StrictModel
from app.families.plate.inputs import PLATE_EXAMPLES
from app.services.error_documents import cut_text
from app.services.markers.bulk import BulkInput, BulkReport, Item, ItemProblem, MarkerUpdate
from app.services.markers.bulk import BulkMarkers as BulkMarkersService
from app.services.markers.plausibility import WarningMode

router = APIRouter(prefix="/v1/markers", tags=["markers"], route_class=StrictRoute)

MAX_ITEMS = 1000
_MAX_TEXT_BYTES = 160  # source: 1,000 problems of four texts then take less than 1 MB


class UpdateIn(StrictModel):
    """A change of a marker that is still at a version."""

    id: Identifier
    version: Annotated[int, Field(strict=True, ge=1, lt=2**31)] = Field(description="As If-Match of a single change.")
    change: MarkerPatch


class ItemIn(StrictModel):
    """A marker to register, or a change of one."""

    create: NewMarkerIn | None = None
    update: UpdateIn | None = None


_ITEM = TypeAdapter(ItemIn)


class BulkIn(StrictModel):
    """Items, and what shall become of them. Each item is checked by itself."""

    model_config = ConfigDict(
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
    warnings: WarningMode = Field("store", description=WARNINGS_TEXT)


class RefusedItems(Problem):
    """The problem document of items that were refused, with the report."""

    report: BulkReport


Bulk = Annotated[BulkMarkersService, use_cases("bulk_markers")]


@router.post(
    "/bulk",
    responses={
        200: {"model": BulkReport, "description": "Stored, or checked"},
        **problem_responses(409, refused=RefusedItems),
    },
)
def post_bulk(body: BulkIn, request: Request, caller: Caller, bulk: Bulk, idempotency: Idempotency) -> Response:
    """Register and change up to 1000 markers in one transaction, with a result for each.

    Refused items of the mode `all` answer 422, with the report in the problem; nothing is stored then.
    """
    if any(isinstance(item, dict) and "create" in item for item in body.items):
        caller.require(PERMISSIONS["POST /v1/markers"])
    items = [_read(item) for item in body.items]
    report, replayed = bulk.run(
        caller, BulkInput(items, body.mode, body.dry_run, body.warnings), partial(_described, body.items), idempotency
    )
    if report["outcome"] == "refused":
        return _refused(request, report)
    return created_response(report, replayed, status=200)


def _read(item: JsonValue) -> Item:
    if isinstance(item, dict) and not item.keys() & ItemIn.model_fields.keys():
        return InvalidParameter(
            "an item is an object with create or update",
            field="create",
            limit="{create: a marker} or {update: {id, version, change}}",
            cure='put the marker into create: {"create": {"position": ...}}',
        )
    try:
        read = validated(_ITEM, item, "body")
        if (read.create is None) == (read.update is None):
            return InvalidParameter(
                "an item registers a marker or changes one",
                field="create",
                limit="create or update",
                cure="send one of the two",
            )
        if read.create is not None:
            return read.create.root.new()
        assert read.update is not None
        return MarkerUpdate(read.update.id, read.update.version, read.update.change.change())
    except RequestValidationError as error:
        fault = validation_fault(error.errors()[0])
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


def _described(items: list[JsonValue], index: int, error: WaymarkError) -> ItemProblem:
    kind = kind_of(error)
    if kind is None:
        raise error
    return {
        "type": kind.type,
        "title": kind.title,
        "status": kind.status,
        "detail": _cut(error.message),
        "field": _cut(f"items.{index}.{_path(items[index], error.field)}".rstrip(".")),
        "limit": None if error.limit is None else _cut(error.limit),
        "cure": None if error.cure is None else _cut(error.cure),
    }


def _cut(text: str) -> str:
    return cut_text(text, _MAX_TEXT_BYTES)


def _refused(request: Request, report: BulkReport) -> Response:
    first = next(result["problem"] for result in report["results"] if result["problem"] is not None)
    fault = FieldError(
        first["field"],
        f"{first['field']}: {first['detail']}; {report['refused']} of {report['items']} items are refused",
        "all items good" if report["mode"] == "all" else "one good item at least",
        first["cure"] or 'correct the items, or send mode "good" to store the others',
    )
    return report_problem("bulk-refused", "The items were refused", fault, request.scope, report)
