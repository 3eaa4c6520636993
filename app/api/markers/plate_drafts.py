"""/v1/plate-drafts: plates before they are registered. Nothing is stored."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Response

from app.api.http.dependencies import Caller, use_cases
from app.api.http.problems import problem_responses
from app.api.http.responses import document_response, file_response, json_response
from app.api.http.strict_json import StrictRoute
from app.api.markers.schemas_plate_drafts import CameraPassIn, CameraViewIn, DraftArtworkIn, PlateDraftIn
from app.encoders.plate import ArtworkFormat
from app.services.markers.plate_draft_documents import CameraPassDocument, PlateDraftDocument
from app.services.markers.plate_drafts import PlateDrafts

router = APIRouter(prefix="/v1/plate-drafts", tags=["artwork"], route_class=StrictRoute)

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
Drafts = Annotated[PlateDrafts, use_cases("plate_drafts")]


@router.post("", responses=document_response(PlateDraftDocument))
def post_plate_draft(wanted: PlateDraftIn, caller: Caller, drafts: Drafts) -> Response:
    """Code, units and every dimension of a plate that is not registered.

    Without a registry number, a plate of the scheme `id` has an example of one: registering it allocates a free one.
    Whether the code is free is not checked.
    """
    return json_response(drafts.document(wanted.draft()))


@router.post(
    "/artwork.{form}",
    responses={
        **file_response((form.media_type for form in ArtworkFormat), headers=_ARTWORK_HEADERS),
        **problem_responses(),
    },
)
def post_draft_artwork(form: ArtworkFormat, wanted: DraftArtworkIn, caller: Caller, drafts: Drafts) -> Response:
    """Artwork of a plate that is not registered, at true size, rendered and read back.

    There is no QR code, because the plate is not registered. The margin is labelled "a draft, not registered".
    """
    artwork = drafts.artwork(wanted.draft(), form, wanted.options(), wanted.resolution_dpi)
    headers = {
        "Waymark-Proof": f"read-back digits={artwork.proof.digits} confidence={artwork.proof.confidence:.6f}",
        "Content-Disposition": f'inline; filename="{artwork.file_name}"',
    }
    return Response(artwork.content, headers=headers, media_type=artwork.media_type)


@router.post("/pass", responses=document_response(CameraPassDocument))
def post_camera_pass(wanted: CameraPassIn, caller: Caller, drafts: Drafts) -> Response:
    """Frames of a pass of a camera over a plate, rows of each unit, motion blur, and predicted read rates.

    The road is flat and straight. The rates are those that plans predict, by the fitted models of read rates.
    """
    return json_response(drafts.camera_pass(wanted.draft(), wanted.way()))


@router.post(
    "/view",
    responses={**file_response(["image/jpeg"], "The picture", headers=_VIEW_HEADERS), **problem_responses()},
)
def post_camera_view(wanted: CameraViewIn, caller: Caller, drafts: Drafts) -> Response:
    """Picture of a plate as a camera sees it in one frame of a pass, to scale and with motion blur; it is decoded too.

    Road, light, sensor and noise are simulated, the same for every picture of a condition.
    """
    view = drafts.view(wanted.draft(), wanted.way(), wanted.ahead_m, wanted.terms())
    headers = {
        "Waymark-Reading": f"{view.reading} confidence={view.confidence:.4f}",
        "Waymark-Exposure": f"{view.exposure_s:.6f}",
        "Waymark-Corners": " ".join(f"{x:.1f},{y:.1f}" for x, y in view.corners_px),
    }
    return Response(view.jpeg, headers=headers, media_type="image/jpeg")
