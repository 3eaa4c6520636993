"""What CERPMs send and are programmed with."""

from __future__ import annotations

import base64
from enum import StrEnum
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from app.api.dependencies import Caller, json_response
from app.api.problems import problem_responses
from app.api.schemas_cerpms import Flag
from app.api.schemas_markers import MarkerId
from app.api.schemas_selection import SelectionIn
from app.api.strict_json import StrictRoute
from app.encoders.cerpm.explain import explain_payload, hex_dump
from app.encoders.cerpm.lorawan import F_PORT
from app.markers.cerpm import MAX_SEQUENCE
from app.services.cerpm_programs import CerpmPayload, CerpmPrograms

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


class ExplainedOut(BaseModel):
    """Some bytes of a message and what they say."""

    offset: int
    length: int
    hex: str
    field: str
    value: str


class PayloadOut(BaseModel):
    """The message of a marker, byte by byte."""

    number: int
    sequence: int
    hex: str
    base64: str
    lorawan_f_port: int
    bytes: list[ExplainedOut]
    note: str | None


class ProgramsIn(SelectionIn):
    """Markers to program, by id or by filter."""

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"examples": [{"status": "surveyed"}, {"bbox": [-86, 42, -85, 43]}]}
    )

    with_keys: Flag = Field(False, description="With the markers' own keys; takes an admin's key.")


async def get_programs(request: Request) -> CerpmPrograms:
    """Use cases on programs."""
    service: CerpmPrograms = request.app.state.programs
    return service


Programs = Annotated[CerpmPrograms, Depends(get_programs)]


@router.get(
    "/markers/{marker_id}/payload.{form}",
    response_class=Response,
    responses={
        200: {
            "model": PayloadOut,
            "content": {"application/octet-stream": {}, "text/plain": {}},
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
        return json_response(_payload_document(payload), headers=headers)
    content = payload.payload if form is PayloadFormat.BIN else hex_dump(payload.payload, payload.key).encode()
    return Response(content, headers=headers, media_type=form.media_type)


@router.post(
    "/programs",
    response_class=Response,
    responses={200: {"content": {"text/csv": {}}}, **problem_responses(404)},
)
def post_programs(wanted: ProgramsIn, caller: Caller, programs: Programs) -> Response:
    """Table for programming a selection of CERPMs, CSV: one row a marker, with its key only if that is asked for."""
    table = programs.programs_csv(caller, wanted.selection(), with_keys=wanted.with_keys)
    headers = {"Content-Disposition": 'attachment; filename="cerpm-programs.csv"', "Cache-Control": "private, no-store"}
    return Response(table, headers=headers, media_type="text/csv")


def _payload_document(payload: CerpmPayload) -> dict[str, Any]:
    return {
        "number": payload.number,
        "sequence": payload.sequence,
        "hex": payload.payload.hex(),
        "base64": base64.b64encode(payload.payload).decode(),
        "lorawan_f_port": F_PORT,
        "bytes": [
            {"offset": p.offset, "length": len(p.hex.split()), "hex": p.hex, "field": p.field, "value": p.value}
            for p in explain_payload(payload.payload, payload.key)
        ],
        "note": payload.note,
    }
