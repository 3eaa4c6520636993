"""/v1/markers: register, list, read and change markers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response
from pydantic import ConfigDict, Discriminator, RootModel, Tag, model_validator

from app.api.http.dependencies import AfterVersion, Caller, Idempotency, MarkerId, Markers, PageSize, Version
from app.api.http.problems import UNION_TAG, Described
from app.api.http.responses import (
    NOT_MODIFIED,
    IfNoneMatch,
    created_response,
    document_response,
    json_response,
    page_response,
    versioned_response,
)
from app.api.http.strict_json import StrictRoute
from app.api.markers.schemas_patch import MarkerPatch
from app.errors import InvalidParameter
from app.families import FAMILIES, FAMILY_NAMES, union_of
from app.families.inputs import MarkerIn
from app.services.markers.accuracy import AccuracyDocument
from app.services.markers.documents import AnyMarkerDetail, VersionDocument, VersionPage
from app.services.markers.plausibility import WarningMode

router = APIRouter(prefix="/v1/markers", tags=["markers"], route_class=StrictRoute)

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
    "", status_code=201, responses=document_response(AnyMarkerDetail, 404, 409, status=201, description="Registered")
)
def post_marker(
    marker: NewMarkerIn, caller: Caller, markers: Markers, idempotency: Idempotency, warnings: Warnings = "store"
) -> Response:
    """Register a marker of any family. With an Idempotency-Key a repeated request gets the first answer again.

    `position_warnings` of the response name what is probably wrong with the position.
    """
    document, replayed = markers.register(caller, marker.root.new(), idempotency, warnings)
    return created_response(document, replayed, path="/v1/markers")


_PUBLIC_PAGE: Described = {
    303: {"description": "Of a browser without a key, as plates from before public pages lead it here: the public page"}
}


@router.get("/{marker_id}", responses={**_PUBLIC_PAGE, **NOT_MODIFIED, **document_response(AnyMarkerDetail, 404)})
def get_marker(marker_id: MarkerId, caller: Caller, markers: Markers, if_none_match: IfNoneMatch = None) -> Response:
    """One marker, with its version as ETag."""
    return versioned_response(markers.get(caller, marker_id), if_none_match)


@router.patch("/{marker_id}", responses=document_response(AnyMarkerDetail, 404, 409, 412, 428))
def patch_marker(
    marker_id: MarkerId,
    patch: MarkerPatch,
    caller: Caller,
    markers: Markers,
    version: Version,
    warnings: Warnings = "store",
) -> Response:
    """Change a marker that is still at the version named by If-Match; a new position may have `position_warnings`."""
    return versioned_response(markers.change(caller, marker_id, patch.change(), version, warnings))


@router.get("/{marker_id}/accuracy", responses=document_response(AccuracyDocument, 404))
def get_marker_accuracy(marker_id: MarkerId, caller: Caller, markers: Markers) -> Response:
    """Accuracy of the marker's survey: NSSDA and ASPRS figures of its RMSE, and whether enough points were checked."""
    return json_response(markers.accuracy(caller, marker_id))


@router.get("/{marker_id}/versions", responses=document_response(VersionPage, 404))
def list_marker_versions(
    marker_id: MarkerId,
    request: Request,
    caller: Caller,
    markers: Markers,
    limit: PageSize = 100,
    after: AfterVersion = 0,
) -> Response:
    """The marker's history, oldest first."""
    page, last = markers.history(caller, marker_id, after=after, limit=limit)
    return page_response(request, {"items": page}, after=last)


@router.get("/{marker_id}/versions/{version}", responses=document_response(VersionDocument, 404))
def get_marker_version(
    marker_id: MarkerId,
    version: Annotated[int, Path(ge=1, lt=2**31, description="Number of the version, 1 for the first.")],
    caller: Caller,
    markers: Markers,
) -> Response:
    """The marker as one version has it."""
    return json_response(markers.version(caller, marker_id, version))
