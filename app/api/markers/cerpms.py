"""What CERPMs send and are programmed with."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from fastapi import APIRouter, Query, Response
from pydantic import ConfigDict, Field

from app.api.http.dependencies import Caller, MarkerId, use_cases
from app.api.http.problems import problem_responses
from app.api.http.responses import BINARY, json_response, text_response
from app.api.http.strict_json import StrictRoute
from app.api.markers.schemas_selection import SelectionIn
from app.encoders.cerpm.explain import hex_dump
from app.families.inputs import Flag
from app.markers.cerpm import MAX_SEQUENCE
from app.services.markers.cerpm_programs import CerpmPrograms, PayloadDocument, payload_document

router = APIRouter(prefix="/v1", tags=["cerpms"], route_class=StrictRoute)


class PayloadFormat(StrEnum):
    """How a payload is written."""

    BIN = "bin"
    HEX = "hex"
    JSON = "json"

    @property
    def media_type(self) -> str:
        """Of the file."""
        return {"bin": "application/octet-stream", "hex": "text/plain", "json": "application/json"}[self.value]


class ProgramsIn(SelectionIn):
    """Markers to program, by id or by filter."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"status": "surveyed"}, {"bbox": [-86, 42, -85, 43]}]})

    with_keys: Flag = Field(False, description="With the markers' own keys; takes an admin's key.")


Programs = Annotated[CerpmPrograms, use_cases("programs")]


@router.get(
    "/markers/{marker_id}/payload.{form}",
    responses={
        200: {
            "model": PayloadDocument,
            "content": {"application/octet-stream": {"schema": BINARY}, "text/plain": {"schema": {"type": "string"}}},
        },
        **problem_responses(404),
    },
)
def get_payload(
    marker_id: MarkerId,
    form: PayloadFormat,
    caller: Caller,
    programs: Programs,
    sequence: Annotated[
        int | None, Query(ge=0, le=MAX_SEQUENCE, description="Which transmission; the next one if left out.")
    ] = None,
) -> Response:
    """What a CERPM sends: the 24 bytes, a dump that explains them, or both as JSON. Takes a key that may write."""
    payload = programs.payload(caller, marker_id, sequence)
    headers = {
        "Cache-Control": "private, no-store",
        "Content-Disposition": f'inline; filename="cerpm-{payload.number}.{form}"',
    }
    if payload.note is not None:
        headers["Waymark-Note"] = payload.note.encode("ascii", "replace").decode()
    if form is PayloadFormat.JSON:
        return json_response(payload_document(payload), headers=headers)
    content = payload.payload if form is PayloadFormat.BIN else hex_dump(payload.payload, payload.key).encode()
    return Response(content, headers=headers, media_type=form.media_type)


@router.post("/programs", responses={**text_response("text/csv"), **problem_responses(404)})
def post_programs(wanted: ProgramsIn, caller: Caller, programs: Programs) -> Response:
    """Table for programming a selection of CERPMs, CSV: one row a marker, with its key only if that is asked for."""
    table = programs.programs_csv(caller, wanted.selection(), with_keys=wanted.with_keys)
    headers = {"Content-Disposition": 'attachment; filename="cerpm-programs.csv"', "Cache-Control": "private, no-store"}
    return Response(table, headers=headers, media_type="text/csv")
