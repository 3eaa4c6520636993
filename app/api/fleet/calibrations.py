"""/v1/calibration-boards: boards to print; /v1/calibrations: photos of them -> the camera's intrinsics."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Depends, Path, Query, Request, Response

from app.api.fleet.schemas_calibrations import DECLARATION_EXAMPLE, CalibrationIn
from app.api.http.bodies import SpooledPart
from app.api.http.dependencies import Caller, Identifier, LastId, use_cases
from app.api.http.forms import DeclaredForm, form_body, idempotency_of, read_declaration
from app.api.http.problems import problem_responses
from app.api.http.responses import (
    BINARY,
    IdempotencyKeyHeader,
    created_response,
    document_response,
    file_response,
    json_response,
    page_response,
)
from app.api.http.strict_json import StrictRoute
from app.encoders.calibration_board import encode_board
from app.encoders.plate import ArtworkFormat, write_artwork
from app.errors import UnreadableUpload
from app.formats.spooled_file import SpooledFile
from app.sensors.calibration_board import CalibrationBoard
from app.services.fleet.calibrations import MAX_PHOTOS, Calibrations
from app.services.fleet.documents import CalibrationDocument, CalibrationPage
from app.services.idempotency import IdempotencyKey

router = APIRouter(prefix="/v1", tags=["fleet"], route_class=StrictRoute)

MAX_DECLARATION_BYTES = 16 * 1024
_CURE = "send multipart/form-data with several parts photos, or one ZIP of them, and a part declaration"
_FORM = DeclaredForm("a calibration", "photos", MAX_DECLARATION_BYTES, _CURE, max_files=MAX_PHOTOS)
_BODY = form_body(
    {
        "photos": {
            "type": "array",
            "items": BINARY,
            "description": f"JPEG or PNG, or a ZIP of them; {MAX_PHOTOS} at most, 12 to 20 are good.",
        }
    },
    "declaration",
    CalibrationIn,
    {"photos": ["1.jpg", "2.jpg"], "declaration": DECLARATION_EXAMPLE},
)


@dataclass(frozen=True, slots=True)
class _Asked:
    photos: tuple[tuple[str, SpooledFile], ...]
    declared: CalibrationIn
    idempotency: IdempotencyKey | None


async def get_asked(request: Request, idempotency_key: IdempotencyKeyHeader = None) -> AsyncIterator[_Asked]:
    """Read the photos and their declaration from the form; the files are deleted when the request ends.

    Raises
    ------
    UnsupportedUpload
        The request is no form.
    UnreadableUpload
        There is no photo in it, or one came as text.
    MalformedRequest
        The form or the declaration's JSON cannot be read.
    """
    async with _FORM.received(request) as (form, text):
        files = form.getlist("photos")
        if not files or not all(isinstance(file, SpooledPart) for file in files):
            raise UnreadableUpload("there is no photo in the form", field="photos", limit="files", cure=_CURE)
        photos = [
            ((file.filename or f"photo {k}")[:120], file.spooled)
            for k, file in enumerate(files)
            if isinstance(file, SpooledPart)
        ]
        key = idempotency_of(request, idempotency_key, text, *(file for _name, file in photos))
        yield _Asked(tuple(photos), await read_declaration(CalibrationIn, text, "declaration"), key)


Service = Annotated[Calibrations, use_cases("calibrations")]
Asked = Annotated[_Asked, Depends(get_asked)]


@router.get(
    "/calibration-boards/board.{form}",
    responses={**file_response(form.media_type for form in ArtworkFormat), **problem_responses()},
)
def get_board(
    form: ArtworkFormat,
    caller: Caller,
    columns: Annotated[int, Query(description="Squares across.", ge=1, le=1000)] = 7,
    rows: Annotated[int, Query(description="Squares down.", ge=1, le=1000)] = 10,
    square_mm: Annotated[float, Query(allow_inf_nan=False, description="Side of a square. [mm]")] = 25.0,
    marker_mm: Annotated[float, Query(allow_inf_nan=False, description="Side of a marker. [mm]")] = 18.0,
    resolution_dpi: Annotated[float, Query(ge=36, le=300, allow_inf_nan=False, description="Of a PNG.")] = 150.0,
) -> Response:
    """A calibration board at true size, with a bar to measure the print by. Print it at 100 %, flat and matt."""
    board = CalibrationBoard(columns, rows, square_mm, marker_mm)
    artwork = write_artwork(encode_board(board), form, dpi=resolution_dpi)
    headers = {"Content-Disposition": f'inline; filename="waymark-board-{columns}x{rows}-{square_mm:g}mm.{form}"'}
    return Response(artwork.content, headers=headers, media_type=artwork.media_type)


@router.post(
    "/calibrations",
    status_code=201,
    openapi_extra=_BODY,
    responses=document_response(CalibrationDocument, 409, 415, status=201, description="Calibrated"),
)
def post_calibration(caller: Caller, asked: Asked, calibrations: Service) -> Response:
    """Calibrate a camera from photos of a board; photos that cannot be used are left out, each with its reason.

    What is not good enough is refused with a named reason. `PUT /v1/vehicles/{id}/calibration` puts the result into a
    vehicle's camera. The photos are not kept.
    """
    document, replayed = calibrations.run(
        caller, asked.photos, asked.declared.board.given(), asked.declared.coefficients, asked.idempotency
    )
    return created_response(document, replayed, path="/v1/calibrations")


@router.get("/calibrations", responses=document_response(CalibrationPage))
def list_calibrations(
    request: Request,
    caller: Caller,
    calibrations: Service,
    limit: Annotated[int, Query(ge=1, le=100)] = 100,
    before: LastId = None,
) -> Response:
    """Calibrations, newest first."""
    page, last = calibrations.page(caller, before=before, limit=limit)
    return page_response(request, page, before=last)


@router.get("/calibrations/{calibration_id}", responses=document_response(CalibrationDocument, 404))
def get_calibration(
    calibration_id: Annotated[Identifier, Path(description="Id of the calibration.")],
    caller: Caller,
    calibrations: Service,
) -> Response:
    """One calibration with what became of each photo."""
    return json_response(calibrations.get(caller, calibration_id))
