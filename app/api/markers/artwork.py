"""Artwork: of one marker, or of a selection of plates as a ZIP."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any

from fastapi import APIRouter, Query, Response
from fastapi.responses import StreamingResponse
from pydantic import ConfigDict, Field, JsonValue

from app.api.http.dependencies import Caller, Idempotency, MarkerId, Number, use_cases
from app.api.http.problems import problem_responses
from app.api.http.responses import NOT_MODIFIED, IfNoneMatch, Prefer, file_response, wants_job
from app.api.http.strict_json import StrictRoute
from app.api.jobs.files import queued_job
from app.api.markers.schemas_selection import SelectionIn
from app.encoders.plate import ArtworkFormat, ArtworkOptions
from app.families.inputs import Flag, StrictModel
from app.services.markers.artwork import Artworks, Bundle
from app.services.markers.artwork_jobs import ArtworkJobs, bundle_options
from app.services.progress.documents import JobDocument

router = APIRouter(prefix="/v1", tags=["artwork"], route_class=StrictRoute)

_CHUNK = 1 << 18
Resolution = Annotated[float, Field(ge=20, le=300, allow_inf_nan=False)]
_EXAMPLES: list[JsonValue] = [
    {"bbox": [114.1, 22.2, 114.3, 22.4], "status": "planned", "formats": ["pdf", "dxf"], "heaters": True},
    {"marker_ids": ["0197a3c2-7d1e-7b60-a7a1-52b9a4a7d911"], "sheet": {"width_mm": 1500, "height_mm": 3000}},
]


class SheetIn(StrictModel):
    """A sheet that plates are nested on."""

    width_mm: Number = Field(description="Width, up to 5000. [mm]")
    height_mm: Number = Field(description="Height, up to 5000. [mm]")


class ArtworkIn(SelectionIn):
    """Plates to make, by id or by filter, and how."""

    model_config = ConfigDict(json_schema_extra={"examples": _EXAMPLES})

    formats: list[ArtworkFormat] = Field([ArtworkFormat.PDF, ArtworkFormat.SVG], min_length=1, max_length=4)
    heaters: Flag = Field(False, description="Heating tracks under dark units.")
    leds: Flag = Field(False, description="Light sources under light units.")
    resolution_dpi: Resolution = Field(150.0, description="Of PNG files. [1/inch]")
    sheet: SheetIn | None = Field(None, description="Also nest the plates on sheets of this size.")

    def declared(self) -> dict[str, Any]:
        """The options as they are stored in a job."""
        return self.model_dump(include={"formats", "heaters", "leds", "resolution_dpi", "sheet"}, mode="json")


_HEADERS = {
    "Waymark-Proof": "What the decoder read from the drawing.",
    "Waymark-QR-Code": '`public-page`: the QR code opens the public page. `none; reason="..."`: there is none.',
}
ArtworkService = Annotated[Artworks, use_cases("artworks")]


@router.get(
    "/markers/{marker_id}/artwork.{form}",
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
    """Artwork at true size. It was rendered and read back before it is sent; `Waymark-Proof` holds what was read.

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
    response_class=StreamingResponse,
    responses={
        **file_response(["application/zip"], headers=_HEADERS),
        202: {"model": JobDocument, "description": "Queued; Location leads to its progress"},
        **problem_responses(404),
    },
)
def post_artwork(
    wanted: ArtworkIn,
    caller: Caller,
    artworks: ArtworkService,
    jobs: Annotated[ArtworkJobs, use_cases("artwork_jobs")],
    idempotency: Idempotency,
    prefer: Prefer = None,
) -> Response:
    """Artwork of a selection as a ZIP with a manifest and a quality sheet; every plate was read back first.

    More than 10 plates, or any with `Prefer: respond-async`, become a job: 202, with the ZIP at its `links.result`.
    Without a public address of the server the plates have no QR codes; `notes` of the manifest states the reason.
    """
    if wants_job(prefer) or jobs.is_job(caller, wanted.selection()):
        return queued_job(*jobs.submit(caller, wanted.selection(), wanted.declared(), idempotency))
    bundle = artworks.bundle(caller, wanted.selection(), bundle_options(wanted.declared()))
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
