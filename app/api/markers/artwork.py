"""Artwork of markers, drilling sheets of magnets, and programs of CERPMs."""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum
from typing import Annotated

from fastapi import Query, Response
from fastapi.responses import StreamingResponse
from pydantic import ConfigDict, Field, JsonValue

from app.api.http.dependencies import Caller, Idempotency, MarkerId, use_case
from app.api.http.permissions import PLANNERS, READERS
from app.api.http.problems import problem_responses
from app.api.http.responses import (
    BINARY,
    NOT_MODIFIED,
    IfNoneMatch,
    Prefer,
    file_response,
    json_response,
    text_response,
    wants_job,
)
from app.api.http.routes import Router
from app.api.jobs import queued_job
from app.api.markers.searches import SelectionIn
from app.encoders.cerpm import hex_dump
from app.encoders.magnet import SheetFormat
from app.encoders.plate import ArtworkFormat, ArtworkOptions
from app.inputs import Flag
from app.markers.cerpm import MAX_SEQUENCE
from app.services.markers.artwork import ArtworkJobs, Artworks, ArtworkTerms, Bundle, Resolution
from app.services.markers.programs import CerpmPrograms, Layouts, PayloadDocument, payload_document
from app.services.progress import OtherJob

router = Router("/v1", "artwork")

_CHUNK = 1 << 18
_EXAMPLES: list[JsonValue] = [
    {"bbox": [114.1, 22.2, 114.3, 22.4], "status": "planned", "formats": ["pdf", "dxf"], "heaters": True},
    {"marker_ids": ["0197a3c2-7d1e-7b60-a7a1-52b9a4a7d911"], "sheet": {"width_mm": 1500, "height_mm": 3000}},
]


class ArtworkIn(SelectionIn, ArtworkTerms):
    """Plates to make, by id or by filter, and how."""

    model_config = ConfigDict(json_schema_extra={"examples": _EXAMPLES})


_HEADERS = {
    "Waymark-Proof": "What the decoder read from the drawing.",
    "Waymark-QR-Code": '`public-page`: the QR code opens the public page. `none; reason="..."`: there is none.',
}
ArtworkService = Annotated[Artworks, use_case(lambda cases: cases.artworks)]


@router.get(
    "/markers/{marker_id}/artwork.{form}",
    READERS,
    responses={
        **file_response((form.media_type for form in ArtworkFormat), headers=_HEADERS),
        **NOT_MODIFIED,
        **problem_responses(404),
    },
)
def get_artwork(
    marker_id: MarkerId,
    form: ArtworkFormat,
    caller: Caller,
    artworks: ArtworkService,
    heaters: Annotated[bool, Query(description="Of a plate: heating tracks under dark units.")] = False,
    leds: Annotated[bool, Query(description="Of a plate: light sources under light units.")] = False,
    resolution_dpi: Annotated[Resolution, Query(description="Of a PNG. [1/inch]")] = 150.0,
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Download the artwork of a marker at true size.

    It was rendered and read back before it is sent; `Waymark-Proof` holds what was read.

    The QR code on the margin has the address of the marker's public page. Without a public address of the server the
    artwork has none, and the margin and `Waymark-QR-Code` state the reason.
    """
    options = ArtworkOptions(heaters=heaters, leds=leds)
    headers = {
        "ETag": f'"{artworks.tag(caller, marker_id, form, options, resolution_dpi)}"',
        "Cache-Control": "private, no-cache",
    }
    if if_none_match == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    artwork = artworks.artwork(caller, marker_id, form, options, resolution_dpi)
    headers["Waymark-Proof"] = f"read-back digits={artwork.proof.digits} confidence={artwork.proof.confidence:.6f}"
    headers["Waymark-QR-Code"] = artwork.qr_code
    headers["Content-Disposition"] = f'inline; filename="{artwork.file_name}"'
    return Response(artwork.content, headers=headers, media_type=artwork.media_type)


@router.post(
    "/artwork",
    READERS,
    expensive=True,
    response_class=StreamingResponse,
    responses={
        **file_response(["application/zip"], headers=_HEADERS),
        202: {"model": OtherJob, "description": "Queued; Location leads to its progress"},
        **problem_responses(404),
    },
)
def post_artwork(
    wanted: ArtworkIn,
    caller: Caller,
    artworks: ArtworkService,
    jobs: Annotated[ArtworkJobs, use_case(lambda cases: cases.artwork_jobs)],
    idempotency: Idempotency,
    prefer: Prefer = None,
) -> Response:
    """Make the artwork of several markers.

    A ZIP with a manifest and a quality sheet; every plate was read back first.

    More than 10 plates, or any with `Prefer: respond-async`, become a job: 202, with the ZIP at its `links.result`.
    Without a public address of the server the plates have no QR codes; `notes` of the manifest states the reason.
    """
    if wants_job(prefer) or jobs.is_job(caller, wanted.selection()):
        return queued_job(*jobs.submit(caller, wanted.selection(), wanted, idempotency))
    bundle = artworks.bundle(caller, wanted.selection(), wanted.options)
    headers = {
        "Content-Length": str(bundle.size),
        "Content-Disposition": 'attachment; filename="waymark-artwork.zip"',
        "Waymark-Proof": f"read-back plates={bundle.plates} lowest-confidence={bundle.lowest_confidence:.6f}",
        "Waymark-QR-Code": bundle.qr_code,
    }
    if bundle.approximate:
        headers["Waymark-Note"] = (
            f"{bundle.approximate} of {bundle.plates} plates have a position that is not for localization"
        )
    return StreamingResponse(_chunks(bundle), headers=headers, media_type="application/zip")


def _chunks(bundle: Bundle) -> Iterator[bytes]:
    with bundle.file as file:
        while chunk := file.read(_CHUNK):
            yield chunk


# === Layouts of magnet markers as drilling sheets.


layout_router = Router("/v1/markers", "artwork")


@layout_router.get(
    "/{marker_id}/layout.{form}",
    READERS,
    responses={
        **file_response(form.media_type.partition(";")[0] for form in SheetFormat),
        **NOT_MODIFIED,
        **problem_responses(404),
    },
)
def get_layout(
    marker_id: MarkerId,
    form: SheetFormat,
    caller: Caller,
    layouts: Annotated[Layouts, use_case(lambda cases: cases.layouts)],
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Download the drilling sheet of a magnet marker.

    Holes with polarity and orientation, checks, materials and costs.
    """
    headers = {"ETag": f'"{layouts.tag(caller, marker_id, form)}"', "Cache-Control": "private, no-cache"}
    if if_none_match == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    sheet = layouts.sheet(caller, marker_id, form)
    headers["Content-Disposition"] = f'inline; filename="{sheet.file_name}"'
    return Response(sheet.content, headers=headers, media_type=sheet.media_type)


# === What CERPMs send and are programmed with.


program_router = Router("/v1", "cerpms")


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


Programs = Annotated[CerpmPrograms, use_case(lambda cases: cases.programs)]


@program_router.get(
    "/markers/{marker_id}/payload.{form}",
    PLANNERS,  # who has a payload can speak for the marker
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
    """Download the message that a CERPM sends.

    The 24 bytes, a dump that explains them, or both as JSON. Takes a key that may write.
    """
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


@program_router.post(
    "/programs",
    PLANNERS,  # with the markers' keys: admins, see app/services/markers/programs.py
    expensive=True,
    responses={**text_response("text/csv"), **problem_responses(404)},
)
def post_programs(wanted: ProgramsIn, caller: Caller, programs: Programs) -> Response:
    """Make a table for programming several CERPMs.

    CSV: one row a marker, with its key only if that is asked for.
    """
    table = programs.programs_csv(caller, wanted.selection(), with_keys=wanted.with_keys)
    headers = {"Content-Disposition": 'attachment; filename="cerpm-programs.csv"', "Cache-Control": "private, no-store"}
    return Response(table, headers=headers, media_type="text/csv")
