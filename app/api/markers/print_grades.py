"""/v1/print-grades: a photo of a printed plate -> the grade of its print."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request, Response

from app.api.http.bodies import SpooledPart
from app.api.http.dependencies import Caller, use_cases
from app.api.http.forms import DeclaredForm, form_body, read_declaration
from app.api.http.problems import problem_responses
from app.api.http.responses import BINARY, file_response, json_response
from app.api.http.strict_json import StrictRoute
from app.api.markers.schemas_print_grades import PRINT_EXAMPLE, PrintGradeIn
from app.errors import UnreadableUpload
from app.formats.spooled_file import SpooledFile
from app.services.markers.print_documents import PrintGradeDocument
from app.services.markers.print_grades import PrintDeclaration, PrintGrades

router = APIRouter(prefix="/v1", tags=["artwork"], route_class=StrictRoute)

MAX_DECLARATION_BYTES = 16 * 1024
_CURE = "send multipart/form-data with a file in the part photo, and a part declaration"
_FORM = DeclaredForm("the request for a print grade", "photo", MAX_DECLARATION_BYTES, _CURE)
_BODY = form_body(
    {"photo": {**BINARY, "description": "JPEG or PNG of one printed plate, whole, from straight above, uncropped."}},
    "declaration",
    PrintGradeIn,
    {"photo": "plate.jpg", "declaration": PRINT_EXAMPLE},
)


class PrintGradeFormat(StrEnum):
    """What a grade can be written as."""

    JSON = "json"
    PDF = "pdf"


@dataclass(frozen=True, slots=True)
class _Asked:
    photo: SpooledFile
    declared: PrintDeclaration


async def get_asked(request: Request) -> AsyncIterator[_Asked]:
    """Read the photo and its declaration from the form; the file is deleted when the request ends.

    Raises
    ------
    UnsupportedUpload
        The request is no form.
    UnreadableUpload
        There is no photo in it, or it came as text.
    MalformedRequest
        The form or the declaration's JSON cannot be read.
    """
    async with _FORM.received(request) as (form, text):
        photo = form.get("photo")
        if not isinstance(photo, SpooledPart):
            raise UnreadableUpload("there is no photo in the form", field="photo", limit="one file", cure=_CURE)
        yield _Asked(photo.spooled, (await read_declaration(PrintGradeIn, text, "declaration")).given())


Service = Annotated[PrintGrades, use_cases("print_grades")]
Asked = Annotated[_Asked, Depends(get_asked)]


@router.post(
    "/print-grades",
    openapi_extra=_BODY,
    responses={
        200: {
            "model": PrintGradeDocument,
            "description": "Graded",
            "content": file_response(["application/pdf"])[200]["content"],
        },
        **problem_responses(404, 415),
    },
)
def post_print_grade(
    caller: Caller,
    asked: Asked,
    grades: Service,
    form: Annotated[PrintGradeFormat, Query(alias="format", description="`pdf`: a page to file.")] = (
        PrintGradeFormat.JSON
    ),
) -> Response:
    """Grade a printed plate by a photo, and predict whether it is read at the design speed.

    Each parameter has its value, its grade after ISO/IEC 15415, the cause and the cure. A photo that is too small,
    blurred, over-exposed, oblique or unevenly lit is refused with 422. Nothing is stored: the same photo can be sent
    again and gets the same grade.
    """
    graded = grades.grade(caller, asked.photo, asked.declared, as_pdf=form is PrintGradeFormat.PDF)
    if form is PrintGradeFormat.JSON:
        return json_response(graded.document)
    name = f"waymark-print-grade-{graded.document['plate']['digits']}.pdf"
    headers = {"Content-Disposition": f'inline; filename="{name}"'}
    return Response(graded.pdf, headers=headers, media_type="application/pdf")
