"""/v1/markers: register, list, read and change markers, one or many; what vehicles observed of them."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal

from fastapi import Path, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    JsonValue,
    RootModel,
    Tag,
    TypeAdapter,
    create_model,
    model_validator,
)

from app.api.http.dependencies import AfterVersion, Caller, Idempotency, MarkerId, Markers, PageSize, Version, use_case
from app.api.http.permissions import PLANNERS, READERS, SURVEYORS
from app.api.http.problems import (
    UNION_TAG,
    Described,
    FieldError,
    Problem,
    kind_of,
    problem_responses,
    report_problem,
    validation_fault,
)
from app.api.http.responses import (
    NOT_MODIFIED,
    IfNoneMatch,
    created_response,
    document_response,
    json_response,
    page_response,
    versioned_response,
)
from app.api.http.routes import Router
from app.api.http.strict_json import validated
from app.errors import InvalidParameter, WaymarkError
from app.families import FAMILIES, FAMILY_NAMES, union_of
from app.families.documents import POSITION_EXAMPLE, Headed, MarkerIn, PositionIn
from app.families.plate.plates import PLATE_EXAMPLES
from app.inputs import Identifier, StrictModel, Text, Time
from app.markers.reading import Status
from app.services.documents import cut_text
from app.services.markers.bulk import BulkInput, BulkReport, Item, ItemProblem, MarkerUpdate
from app.services.markers.bulk import BulkMarkers as BulkMarkersService
from app.services.markers.markers import (
    AnyMarkerDetail,
    MarkerChange,
    ObservationPage,
    ObservationSummary,
    VersionDocument,
    VersionPage,
    place_of,
)
from app.services.markers.markers import Observations as ObservationsService
from app.services.markers.plausibility import AccuracyDocument, WarningMode

# === Schema of changes to a marker of any family.


if TYPE_CHECKING:

    class _FamilyChanges(BaseModel):
        """Members of a change that only one family has, of all families."""

else:
    _FamilyChanges = create_model("_FamilyChanges", __base__=tuple(f.change for f in FAMILIES if f.change is not None))


class MarkerPatch(Headed, _FamilyChanges):
    """Members to change; a member that is null is cleared, one that is left out stays."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {"status": "surveyed", "position": POSITION_EXAMPLE, "reason": "as-built survey"},
                {"status": "retired", "reason": "resurfaced"},
            ]
        },
    )

    status: Status = Field("planned", description="New status.")
    position: PositionIn = Field(
        default_factory=PositionIn,
        description="New position; replaces the whole of the old. Of an information tag: where its first magnet was "
        "surveyed; the others follow.",
    )

    def change(self) -> MarkerChange:
        """The change as the use cases know it."""
        named = self.model_fields_set
        spec = {
            family.name: self.model_dump(mode="json", include=members)
            for family in FAMILIES
            if family.change is not None and (members := named & family.change.model_fields.keys())
        }
        values = self.model_dump(include=(named & Headed.model_fields.keys() | named & {"status"}) - {"kind", "reason"})
        position = self.position if "position" in named else None
        if not values and not spec and position is None:
            raise InvalidParameter(
                "the patch changes nothing", field="body", limit="at least one member", cure="name what to change"
            )
        return MarkerChange(values, position, self.kind, self.reason, spec)


# === /v1/markers: register, list, read and change markers.


router = Router("/v1/markers", "markers")

_DEFAULT_FAMILY = FAMILY_NAMES[0]
WARNINGS_TEXT = "What a warning about a position means: the marker is stored, or refused with 422."
Warnings = Annotated[WarningMode, Query(description=WARNINGS_TEXT)]


def _family_tag(body: Any) -> str:
    is_json = isinstance(body, dict)
    family = body.get("family", _DEFAULT_FAMILY) if is_json else getattr(body, "family", _DEFAULT_FAMILY)
    return f"{UNION_TAG}{family}"


if TYPE_CHECKING:
    _AnyMarkerIn = MarkerIn
else:
    _AnyMarkerIn = Annotated[
        union_of(Annotated[family.schema, Tag(f"{UNION_TAG}{family.name}")] for family in FAMILIES),
        Discriminator(_family_tag),
    ]


class NewMarkerIn(RootModel[_AnyMarkerIn]):
    """A marker to register: of the family that it names, or a plate if it names none."""

    model_config = ConfigDict(json_schema_extra={"examples": [e for family in FAMILIES for e in family.examples]})

    @model_validator(mode="before")
    @classmethod
    def _known_family(cls, body: Any) -> Any:
        if isinstance(body, dict) and body.get("family", _DEFAULT_FAMILY) not in FAMILY_NAMES:
            raise InvalidParameter(
                f"there is no family {str(body['family'])[:40]!r}",
                field="family",
                limit=f"one of {', '.join(FAMILY_NAMES)}",
                cure=f"leave it out for a {_DEFAULT_FAMILY}",
            )
        return body


@router.post(
    "",
    PLANNERS,
    status_code=201,
    responses=document_response(AnyMarkerDetail, 404, 409, status=201, description="Registered"),
)
def post_marker(
    marker: NewMarkerIn, caller: Caller, markers: Markers, idempotency: Idempotency, warnings: Warnings = "store"
) -> Response:
    """Register a marker of any family.

    With an Idempotency-Key a repeated request gets the first answer again.

    `position_warnings` of the response name what is probably wrong with the position.
    """
    document, replayed = markers.register(caller, marker.root, idempotency, warnings)
    return created_response(document, replayed, path="/v1/markers")


_PUBLIC_PAGE: Described = {
    303: {"description": "Of a browser without a key, as plates from before public pages lead it here: the public page"}
}


@router.get(
    "/{marker_id}", READERS, responses={**_PUBLIC_PAGE, **NOT_MODIFIED, **document_response(AnyMarkerDetail, 404)}
)
def get_marker(marker_id: MarkerId, caller: Caller, markers: Markers, if_none_match: IfNoneMatch = None) -> Response:
    """Get a marker.

    With its version as ETag.
    """
    return versioned_response(markers.get(caller, marker_id), if_none_match)


@router.patch("/{marker_id}", SURVEYORS, responses=document_response(AnyMarkerDetail, 404, 409, 412, 428))
def patch_marker(
    marker_id: MarkerId,
    patch: MarkerPatch,
    caller: Caller,
    markers: Markers,
    version: Version,
    warnings: Warnings = "store",
) -> Response:
    """Change a marker.

    One that is still at the version named by If-Match; a new position may have `position_warnings`.
    """
    return versioned_response(markers.change(caller, marker_id, patch.change(), version, warnings))


@router.get("/{marker_id}/accuracy", READERS, responses=document_response(AccuracyDocument, 404))
def get_marker_accuracy(marker_id: MarkerId, caller: Caller, markers: Markers) -> Response:
    """Get the accuracy of a marker's survey.

    NSSDA and ASPRS figures of its RMSE, and whether enough points were checked.
    """
    return json_response(markers.accuracy(caller, marker_id))


@router.get("/{marker_id}/versions", READERS, responses=document_response(VersionPage, 404))
def list_marker_versions(
    marker_id: MarkerId,
    request: Request,
    caller: Caller,
    markers: Markers,
    limit: PageSize = 100,
    after: AfterVersion = 0,
) -> Response:
    """List the versions of a marker.

    Oldest first.
    """
    page, last = markers.history(caller, marker_id, after=after, limit=limit)
    return page_response(request, {"items": page}, after=last)


@router.get("/{marker_id}/versions/{version}", READERS, responses=document_response(VersionDocument, 404))
def get_marker_version(
    marker_id: MarkerId,
    version: Annotated[int, Path(ge=1, lt=2**31, description="Number of the version, 1 for the first.")],
    caller: Caller,
    markers: Markers,
) -> Response:
    """Get a version of a marker."""
    return json_response(markers.version(caller, marker_id, version))


# === /v1/markers/{marker_id}/observations: what vehicles saw of a marker.


observation_router = Router("/v1/markers/{marker_id}/observations", "markers")


Observations = Annotated[ObservationsService, use_case(lambda cases: cases.observations)]


@observation_router.get("", READERS, responses=document_response(ObservationPage, 404))
def list_marker_observations(
    marker_id: MarkerId,
    request: Request,
    caller: Caller,
    observations: Observations,
    what: Annotated[Text | None, Query(min_length=1, max_length=32, examples=["seen"])] = None,
    since: Time | None = None,
    until: Time | None = None,
    limit: PageSize = 100,
    after: Annotated[Text | None, Query(max_length=120, description="As the link to the next page has it.")] = None,
) -> Response:
    """List the observations of a marker.

    What decodes saw of it, newest first.

    `what` is `seen`, `missed`, `ambiguous`, `out-of-place`, `out-of-reach`, `moved`, `cloned`, `wrong-way` or
    `off-line`.
    """
    page, last = observations.page(
        caller,
        marker_id,
        what=what,
        since=since,
        until=until,
        before=place_of(after) if after is not None else None,
        limit=limit,
    )
    return page_response(request, page, after=last)


@observation_router.get("/summary", READERS, responses=document_response(ObservationSummary, 404))
def get_observation_summary(marker_id: MarkerId, caller: Caller, observations: Observations) -> Response:
    """Summarise the observations of a marker.

    When it was seen first and last, and how often which way.
    """
    return json_response(observations.summary(caller, marker_id))


# === POST /v1/markers/bulk: many markers in one request, a result for each.


bulk_router = Router("/v1/markers", "markers")

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


Bulk = Annotated[BulkMarkersService, use_case(lambda cases: cases.bulk_markers)]


@bulk_router.post(
    "/bulk",
    SURVEYORS,
    expensive=True,
    responses={
        200: {"model": BulkReport, "description": "Stored, or checked"},
        **problem_responses(409, refused=RefusedItems),
    },
)
def post_bulk(body: BulkIn, request: Request, caller: Caller, bulk: Bulk, idempotency: Idempotency) -> Response:
    """Register and change up to 1000 markers in one transaction.

    The response has a result for each.

    Refused items of the mode `all` answer 422, with the report in the problem; nothing is stored then.
    """
    if any(isinstance(item, dict) and "create" in item for item in body.items):
        caller.require(PLANNERS)  # as POST /v1/markers
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
            return read.create.root
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
