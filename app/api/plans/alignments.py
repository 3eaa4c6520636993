"""/v1/alignments: roads that plans are made for."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Path, Query, Request, Response
from pydantic import ConfigDict, Field

from app.api.http.bodies import (
    FORM,
    SpooledPart,
    check_parts,
    form_body,
    idempotency_of,
    media_type_of,
    read_declaration,
    read_text,
    received_form,
)
from app.api.http.dependencies import Caller, LastId, PageSize, use_case
from app.api.http.permissions import PLANNERS, READERS
from app.api.http.problems import problem_responses, reference
from app.api.http.responses import (
    BINARY,
    NOT_MODIFIED,
    IdempotencyKeyHeader,
    IfNoneMatch,
    created_response,
    document_response,
    file_response,
    json_response,
    page_response,
    versioned_response,
)
from app.api.http.routes import Router
from app.api.markers.searches import Filtered
from app.errors import MalformedRequest, UnreadableUpload, UnsupportedUpload
from app.formats.alignments.geometry import AlignmentDeclaration
from app.formats.alignments.read import RoadLanes
from app.formats.format import SpooledFile
from app.inputs import Identifier, StrictModel, Text
from app.services.idempotency import IdempotencyKey
from app.services.plans.alignments import Alignments
from app.services.plans.documents import AlignmentDocument, AlignmentPage, AlignmentProfile
from app.services.plans.tasks import MAX_SAMPLES, MapForm

Name = Annotated[Text, Field(min_length=1, max_length=80)]


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignmentIn(AlignmentDeclaration):
    """What is declared of a file with a road, and the name of the alignment."""

    name: Name


class RoadAlignmentIn(StrictModel):
    """Lanes along a registered road; they stay as they are when the road is changed."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "name": "L 560, two lanes",
                    "road_id": "019cb624-0000-7000-8000-0000000000aa",
                    "lanes": {
                        "forward": 1, "backward": 1, "width_m": 3.5, "speed_limit_kmh": 70, "centre_style": "dashed",
                    },
                }
            ]
        },
    )  # fmt: skip

    name: Name
    road_id: Identifier
    lanes: RoadLanes


router = Router("/v1/alignments", "plans")

MAX_DECLARATION_BYTES = 64 * 1024
MAX_WITHIN_M = 100.0
"""Farthest markers that a map of a road may have. [m] Source: `app.planning.outputs.hd_opendrive.MAX_BESIDE_M`."""
JSON = "application/json"
_CURE = f"send multipart/form-data with the parts file and declaration, or {JSON} with road_id and lanes"
_BODY = form_body(
    {"file": {**BINARY, "description": "GeoJSON, GeoPackage, zipped Shapefile, LandXML, DXF, lanelet2 or OpenDRIVE."}},
    "declaration",
    AlignmentIn,
    {"file": "road.geojson", "declaration": {"name": "L 560, km 12 to 14"}},
    **{JSON: {"schema": reference(RoadAlignmentIn)}},
)

AlignmentId = Annotated[Identifier, Path(description="Id of the alignment.")]
Service = Annotated[Alignments, use_case(lambda cases: cases.alignments)]


@dataclass(frozen=True, slots=True)
class _Upload:
    file: SpooledFile
    file_name: str
    declared: AlignmentIn | RoadAlignmentIn
    idempotency: IdempotencyKey | None


async def get_upload(request: Request, idempotency_key: IdempotencyKeyHeader = None) -> AsyncIterator[_Upload]:
    """Read the file and its declaration from the form, or the registered road and its lanes from JSON.

    Raises
    ------
    UnsupportedUpload, UnreadableUpload, MalformedRequest
        The request is neither, has no file, or other parts than a file and a declaration.
    """
    if media_type_of(request) == JSON:
        text = await request.body()
        _check_length(text)
        road = await read_declaration(RoadAlignmentIn, text, "body")
        yield _Upload(SpooledFile.of(b""), "", road, idempotency_of(request, idempotency_key, text))
        return
    if media_type_of(request) != FORM:
        raise UnsupportedUpload(
            "a road comes as a form, or is named in JSON", field="Content-Type", limit=f"{FORM}, {JSON}", cure=_CURE
        )
    async with received_form(request, max_files=2, max_fields=2, max_part_size=MAX_DECLARATION_BYTES) as form:
        check_parts(form, None, "file", "declaration")
        part = form.get("file")
        if not isinstance(part, SpooledPart):
            raise UnreadableUpload("there is no file in the form", field="file", limit="a part file", cure=_CURE)
        file, file_name = part.spooled, (part.filename or "")[:200]
        text = await read_text(form, "declaration", MAX_DECLARATION_BYTES)
        _check_length(text)
        declared = await read_declaration(AlignmentIn, text, "body", "declaration")
        yield _Upload(file, file_name, declared, idempotency_of(request, idempotency_key, text, file))


def _check_length(declaration: bytes) -> None:
    if len(declaration) > MAX_DECLARATION_BYTES:
        raise MalformedRequest("the declaration is too long", field="declaration", limit="64 KiB", cure=_CURE)


@router.post(
    "",
    PLANNERS,
    expensive=True,
    status_code=201,
    openapi_extra=_BODY,
    responses=document_response(AlignmentDocument, 404, 409, 415, status=201, description="Stored"),
)
def post_alignment(upload: Annotated[_Upload, Depends(get_upload)], caller: Caller, alignments: Service) -> Response:
    """Store an alignment of a file or of a registered road.

    Its lanes have width, direction, curvature, grade and design speed.
    """
    declared = upload.declared
    if isinstance(declared, RoadAlignmentIn):
        document, replayed = alignments.add_of_road(
            caller, declared.name, declared.road_id, declared.lanes, upload.idempotency
        )
        return created_response(document, replayed, path="/v1/alignments")
    document, replayed = alignments.add(
        caller, declared.name, upload.file, upload.file_name, declared, upload.idempotency
    )
    return created_response(document, replayed, path="/v1/alignments")


@router.get("", READERS, responses=document_response(AlignmentPage))
def list_alignments(
    request: Request, caller: Caller, alignments: Service, limit: PageSize = 100, after: LastId = None
) -> Response:
    """List the alignments of an agency.

    In the order they were made.
    """
    page, last = alignments.page(caller, after=after, limit=limit)
    return page_response(request, page, after=last)


@router.get("/{alignment_id}", READERS, responses={**NOT_MODIFIED, **document_response(AlignmentDocument, 404)})
def get_alignment(
    alignment_id: AlignmentId, caller: Caller, alignments: Service, if_none_match: IfNoneMatch = None
) -> Response:
    """Get an alignment.

    With its version as ETag.
    """
    return versioned_response(alignments.get(caller, alignment_id), if_none_match)


@router.get(
    "/{alignment_id}/source",
    READERS,
    responses={**file_response(["application/octet-stream"], "The file as it came"), **problem_responses(404)},
)
def get_source(alignment_id: AlignmentId, caller: Caller, alignments: Service) -> Response:
    """Download the file of an alignment as it was uploaded."""
    data, _name = alignments.source(caller, alignment_id)
    return Response(data, media_type="application/octet-stream")


@router.get("/{alignment_id}/profile", READERS, expensive=True, responses=document_response(AlignmentProfile, 404))
def get_profile(
    alignment_id: AlignmentId,
    caller: Caller,
    alignments: Service,
    samples: Annotated[int, Query(ge=2, le=MAX_SAMPLES, description="Of each lane at most.")] = 1000,
) -> Response:
    """Get the lanes of an alignment to draw them.

    Lines, stations, curvature, events and areas in which nothing is installed.
    """
    return json_response(alignments.profile(caller, alignment_id, samples))


@router.get(
    "/{alignment_id}/map.{form}",
    READERS,
    expensive=True,
    responses={**file_response(["application/xml"], "The map"), **problem_responses(404)},
)
def get_map(
    alignment_id: AlignmentId,
    form: Annotated[MapForm, Path(description="`osm` for lanelet2, `xodr` for OpenDRIVE 1.7.")],
    caller: Caller,
    alignments: Service,
    filtered: Filtered,
    within_m: Annotated[
        float, Query(gt=0, le=MAX_WITHIN_M, allow_inf_nan=False, description="From the nearest lane's centre line.")
    ] = 20.0,
) -> Response:
    """Download an alignment as an HD map.

    The lanes with the agency's markers near them, planned or on the road.
    """
    data = alignments.write_map(caller, alignment_id, form, filtered, within_m)
    return Response(data, media_type="application/xml")
