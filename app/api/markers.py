"""/v1/markers: register, list, read and change markers."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Discriminator, RootModel, Tag, model_validator

from app.api.dependencies import Caller, Idempotency, Markers, Version, json_response, next_link
from app.api.problems import UNION_TAG, problem_responses
from app.api.schemas_cerpms import CERPM_EXAMPLES, CerpmMarkerIn, CerpmMarkerOut
from app.api.schemas_magnets import MAGNET_EXAMPLES, MagnetMarkerIn, MagnetMarkerOut, MagnetMarkerSummary
from app.api.schemas_markers import (
    PLATE_EXAMPLES,
    AccuracyOut,
    GeometryIn,
    MarkerId,
    MarkerIn,
    MarkerOut,
    VersionKind,
)
from app.api.schemas_patch import MarkerPatch
from app.api.strict_json import StrictRoute
from app.errors import InvalidParameter
from app.markers.plate import PlateGeometry, PlateScheme
from app.services.cerpm_markers import NewCerpm
from app.services.magnet_markers import NewMagnets
from app.services.plate_markers import GivenCode, NewPlate
from app.services.positions import GivenPosition, naming

router = APIRouter(prefix="/v1/markers", tags=["markers"], route_class=StrictRoute)

MAX_PAGE = 1000
FAMILIES = ("plate", "magnet", "cerpm")


def _family_tag(body: Any) -> str:
    family = body.get("family", "plate") if isinstance(body, dict) else getattr(body, "family", "plate")
    return f"{UNION_TAG}{family}"


class NewMarkerIn(
    RootModel[
        Annotated[
            Annotated[MarkerIn, Tag(f"{UNION_TAG}plate")]
            | Annotated[MagnetMarkerIn, Tag(f"{UNION_TAG}magnet")]
            | Annotated[CerpmMarkerIn, Tag(f"{UNION_TAG}cerpm")],
            Discriminator(_family_tag),
        ]
    ]
):
    """A marker to register: a plate, or magnets or a CERPM where the family says so."""

    model_config = ConfigDict(json_schema_extra={"examples": [*PLATE_EXAMPLES, *MAGNET_EXAMPLES, *CERPM_EXAMPLES]})

    @model_validator(mode="before")
    @classmethod
    def _known_family(cls, body: Any) -> Any:
        if isinstance(body, dict) and body.get("family", "plate") not in FAMILIES:
            raise InvalidParameter(
                f"there is no family {str(body['family'])[:40]!r}",
                field="family",
                limit=f"one of {', '.join(FAMILIES)}",
                cure="leave it out for a plate",
            )
        return body


class VersionOut(BaseModel):
    """One entry of a marker's history."""

    version: int
    at: str
    who: str
    why: str | None
    kind: VersionKind
    sha256: str
    audit_number: int
    marker: MarkerOut | MagnetMarkerSummary | CerpmMarkerOut


class VersionPage(BaseModel):
    """A page of a marker's history, oldest first."""

    items: list[VersionOut]


@router.post(
    "",
    status_code=201,
    response_class=Response,
    responses={
        201: {"model": MarkerOut | MagnetMarkerOut | CerpmMarkerOut, "description": "Registered"},
        **problem_responses(409),
    },
)
def post_marker(marker: NewMarkerIn, caller: Caller, markers: Markers, idempotency: Idempotency) -> Response:
    """Register a plate, magnets or a CERPM. With an Idempotency-Key a repeated request gets the first answer again."""
    document, replayed = markers.register(caller, given_marker(marker), idempotency)
    headers = {"Location": f"/v1/markers/{document['id']}", "ETag": _etag(document)}
    if replayed:
        headers["Idempotency-Replayed"] = "true"
    return json_response(document, 201, headers)


@router.get(
    "/{marker_id}",
    response_class=Response,
    responses={200: {"model": MarkerOut | MagnetMarkerOut | CerpmMarkerOut}, **problem_responses(404)},
)
def get_marker(marker_id: MarkerId, request: Request, caller: Caller, markers: Markers) -> Response:
    """One marker, with its version as ETag."""
    document = markers.get(caller, marker_id)
    etag = {"ETag": _etag(document)}
    if request.headers.get("if-none-match") == etag["ETag"]:
        return Response(status_code=304, headers=etag)
    return json_response(document, headers=etag)


@router.patch(
    "/{marker_id}",
    response_class=Response,
    responses={200: {"model": MarkerOut | MagnetMarkerOut | CerpmMarkerOut}, **problem_responses(404, 409, 412, 428)},
)
def patch_marker(
    marker_id: MarkerId, patch: MarkerPatch, caller: Caller, markers: Markers, version: Version
) -> Response:
    """Change a marker that is still at the version named by If-Match."""
    document = markers.change(caller, marker_id, patch.change(), version)
    return json_response(document, headers={"ETag": _etag(document)})


@router.get(
    "/{marker_id}/accuracy", response_class=Response, responses={200: {"model": AccuracyOut}, **problem_responses(404)}
)
def get_marker_accuracy(marker_id: MarkerId, caller: Caller, markers: Markers) -> Response:
    """How good the marker's survey is: NSSDA and ASPRS figures of its RMSE, and whether enough points were checked."""
    return json_response(markers.accuracy(caller, marker_id))


@router.get(
    "/{marker_id}/versions", response_class=Response, responses={200: {"model": VersionPage}, **problem_responses(404)}
)
def list_marker_versions(
    marker_id: MarkerId,
    request: Request,
    caller: Caller,
    markers: Markers,
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = 100,
    after: Annotated[int, Query(ge=0, lt=2**31, description="Last version of the page before.")] = 0,
) -> Response:
    """The marker's history, oldest first."""
    page, last = markers.history(caller, marker_id, after=after, limit=limit)
    return json_response({"items": page}, headers=next_link(request, after=last) if last else None)


@router.get(
    "/{marker_id}/versions/{version}",
    response_class=Response,
    responses={200: {"model": VersionOut}, **problem_responses(404)},
)
def get_marker_version(
    marker_id: MarkerId,
    version: Annotated[int, Path(ge=1, lt=2**31, description="Number of the version, 1 for the first.")],
    caller: Caller,
    markers: Markers,
) -> Response:
    """The marker as one version has it."""
    return json_response(markers.version(caller, marker_id, version))


def _etag(document: dict[str, Any]) -> str:
    return f'"{document["version"]}"'


def given_marker(marker: NewMarkerIn) -> NewPlate | NewMagnets | NewCerpm:
    """The marker as the use cases know it."""
    new = marker.root
    return _new_plate(new) if isinstance(new, MarkerIn) else new.given()


def _new_plate(marker: MarkerIn) -> NewPlate:
    code = marker.code
    return NewPlate(
        position=GivenPosition(**marker.position.model_dump()),
        code=GivenCode(
            PlateScheme(code.scheme), code.digits, code.check_digits, code.registry_number, code.allow_mismatched_digits
        ),
        geometry=_geometry(marker.geometry),
        **marker.model_dump(exclude={"family", "position", "code", "geometry"}),
    )


def _geometry(given: GeometryIn) -> PlateGeometry:
    with naming("geometry"):
        return PlateGeometry(given.n, given.unit_mm, given.gap_mm, given.thickness_mm)
