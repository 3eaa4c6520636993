"""Plates without the registry: drafts of plates that are not registered, and grades of printed ones."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

from fastapi import Depends, Query, Request, Response
from pydantic import ConfigDict, Field, JsonValue

from app.api.http.bodies import DeclaredForm, SpooledPart, form_body, read_declaration
from app.api.http.dependencies import Caller, use_case
from app.api.http.permissions import READERS
from app.api.http.problems import problem_responses
from app.api.http.responses import BINARY, document_response, file_response, json_response
from app.api.http.routes import Router
from app.encoders.plate import ArtworkFormat
from app.errors import InvalidParameter, UnreadableUpload, naming
from app.families.plate.plates import SCHEME_DESCRIPTION, GeometryIn
from app.formats.format import SpooledFile
from app.inputs import Identifier, Number, StrictModel, Text
from app.markers.plate import RECOMMENDED_SCHEME, PlateCode, PlateScheme, recommended_geometry
from app.planning.predict.rates import CameraPass
from app.planning.rules import CameraRules
from app.services.markers.plate_drafts import (
    DraftToDraw,
    DraftToPass,
    DraftToView,
    PlateDraft,
    PlateDraftDocument,
    PlateDrafts,
)
from app.services.markers.print_documents import PrintGradeDocument
from app.services.markers.print_grades import PrintDeclaration, PrintGrades

# === /v1/plate-drafts: plates before they are registered. Nothing is stored.


draft_router = Router("/v1/plate-drafts", "artwork")

_ARTWORK_HEADERS = {"Waymark-Proof": "What the decoder read from the drawing."}
_VIEW_HEADERS = {
    "Waymark-Reading": (
        "`alone`: the decoder reads the plate in this picture; `with-registry`: it does if it knows the plate and its "
        "neighbours; `not-read`. With the confidence, 0 to 1."
    ),
    "Waymark-Exposure": "Of the picture; by night at least as long as the light requires. [s]",
    "Waymark-Corners": (
        "Outer corners of the plate, clockwise from the triangle's: `x,y x,y x,y x,y`; empty if it is not in view. [px]"
    ),
}
Drafts = Annotated[PlateDrafts, use_case(lambda cases: cases.plate_drafts)]


@draft_router.post("", READERS, responses=document_response(PlateDraftDocument))
def post_plate_draft(wanted: PlateDraft, caller: Caller, drafts: Drafts) -> Response:
    """Design a plate that is not registered.

    Its code, units and every dimension.

    Without a registry number, a plate of the scheme `id` has an example of one: registering it allocates a free one.
    Whether the code is free is not checked.
    """
    return json_response(drafts.document(wanted))


@draft_router.post(
    "/artwork.{form}",
    READERS,
    expensive=True,
    responses={
        **file_response((form.media_type for form in ArtworkFormat), headers=_ARTWORK_HEADERS),
        **problem_responses(),
    },
)
def post_draft_artwork(form: ArtworkFormat, wanted: DraftToDraw, caller: Caller, drafts: Drafts) -> Response:
    """Make the artwork of a plate that is not registered.

    At true size, rendered and read back.

    There is no QR code, because the plate is not registered. The margin is labelled "a draft, not registered".
    """
    artwork = drafts.artwork(wanted, form)
    headers = {
        "Waymark-Proof": f"read-back digits={artwork.proof.digits} confidence={artwork.proof.confidence:.6f}",
        "Content-Disposition": f'inline; filename="{artwork.file_name}"',
    }
    return Response(artwork.content, headers=headers, media_type=artwork.media_type)


@draft_router.post("/pass", READERS, responses=document_response(CameraPass))
def post_camera_pass(wanted: DraftToPass, caller: Caller, drafts: Drafts) -> Response:
    """Predict what a camera reads of a plate as it passes.

    Frames of the pass, rows of each unit, motion blur, and predicted read rates.

    The road is flat and straight. The rates are those that plans predict, by the fitted models of read rates.
    """
    return json_response(drafts.camera_pass(wanted))


@draft_router.post(
    "/view",
    READERS,
    expensive=True,
    responses={**file_response(["image/jpeg"], "The picture", headers=_VIEW_HEADERS), **problem_responses()},
)
def post_camera_view(wanted: DraftToView, caller: Caller, drafts: Drafts) -> Response:
    """Draw a plate as a camera sees it.

    In one frame of a pass, to scale and with motion blur; it is decoded too.

    Road, light, sensor and noise are simulated, the same for every picture of a condition.
    """
    view = drafts.view(wanted)
    headers = {
        "Waymark-Reading": f"{view.reading} confidence={view.confidence:.4f}",
        "Waymark-Exposure": f"{view.exposure_s:.6f}",
        "Waymark-Corners": " ".join(f"{x:.1f},{y:.1f}" for x, y in view.corners_px),
    }
    return Response(view.jpeg, headers=headers, media_type="image/jpeg")


# === Schemas of print grades.


PRINT_EXAMPLE: dict[str, JsonValue] = {
    "code": {"scheme": "position", "digits": "023792168411"},
    "geometry": {"n": 8, "unit_mm": 35.0, "gap_mm": 5.0},
    "speed_kmh": 60.0,
}


class PrintCodeIn(StrictModel):
    """The code that the plate should have."""

    scheme: PlateScheme = Field(RECOMMENDED_SCHEME, description=SCHEME_DESCRIPTION)
    digits: Text = Field(min_length=1, max_length=64, description="One hexadecimal digit a cell, row by row.")
    check_digits: Annotated[int, Field(strict=True, ge=1, le=2)] = Field(1, description="For `position-check`.")

    def code(self, n: int) -> PlateCode:
        """The code as the core knows it."""
        with naming("code"):
            return PlateCode(self.digits, self.scheme, n, self.check_digits)


class PrintGradeIn(StrictModel):
    """What the photo should show, and the design speed. Without a code, the plate is what the photo shows."""

    model_config = ConfigDict(json_schema_extra={"examples": [PRINT_EXAMPLE, {"speed_kmh": 80.0}]})

    marker_id: Identifier | None = Field(None, description="The registered plate; in place of `code` and `geometry`.")
    code: PrintCodeIn | None = None
    geometry: GeometryIn | None = Field(None, description="Of the drawing; that of the scheme if left out.")
    camera: CameraRules = Field(default_factory=CameraRules, description="Camera of the vehicles.")
    speed_kmh: Number = Field(60.0, ge=5.0, le=250.0, description="Design speed. [km/h]")

    def declaration(self) -> PrintDeclaration:
        """The declaration as the use case takes it.

        Raises
        ------
        InvalidParameter
            A marker and a code, or digits that the plate cannot hold.
        """
        if self.marker_id is not None and (self.code is not None or self.geometry is not None):
            raise InvalidParameter(
                "the declaration names a marker and gives a code or a geometry too",
                field="marker_id",
                limit="a marker, or a code and a geometry",
                cure="leave code and geometry out: the marker has them",
            )
        scheme = self.code.scheme if self.code is not None else RECOMMENDED_SCHEME
        geometry = None if self.geometry is None else self.geometry.of_scheme(scheme)
        if self.code is not None and geometry is None:
            geometry = recommended_geometry(scheme)
        code = None if self.code is None or geometry is None else self.code.code(geometry.n)
        return PrintDeclaration(self.marker_id, code, geometry, self.camera, self.speed_kmh)


# === /v1/print-grades: a photo of a printed plate -> the grade of its print.


print_grade_router = Router("/v1", "artwork")

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
        yield _Asked(photo.spooled, (await read_declaration(PrintGradeIn, text, "declaration")).declaration())


Service = Annotated[PrintGrades, use_case(lambda cases: cases.print_grades)]
Asked = Annotated[_Asked, Depends(get_asked)]


@print_grade_router.post(
    "/print-grades",
    READERS,
    expensive=True,
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
    """Grade a printed plate by a photo.

    The response predicts whether it is read at the design speed.

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
