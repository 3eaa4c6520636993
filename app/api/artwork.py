"""Artwork of plates: one at a time, or a selection as a ZIP."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, ConfigDict, Field, JsonValue

from app.api.dependencies import Caller, Number
from app.api.problems import problem_responses
from app.api.schemas_markers import MarkerId
from app.api.schemas_selection import SelectionIn
from app.api.strict_json import StrictRoute
from app.encoders.plate import ArtworkFormat, ArtworkOptions, BundleOptions
from app.services.artwork import Artworks, Bundle

router = APIRouter(prefix="/v1", tags=["artwork"], route_class=StrictRoute)

_CHUNK = 1 << 18
Resolution = Annotated[float, Field(ge=20, le=300, allow_inf_nan=False)]
Flag = Annotated[bool, Field(strict=True)]
_EXAMPLES: list[JsonValue] = [
    {"bbox": [114.1, 22.2, 114.3, 22.4], "status": "planned", "formats": ["pdf", "dxf"], "heaters": True},
    {"marker_ids": ["0197a3c2-7d1e-7b60-a7a1-52b9a4a7d911"], "sheet": {"width_mm": 1500, "height_mm": 3000}},
]


class SheetIn(BaseModel):
    """A sheet that plates are nested on."""

    model_config = ConfigDict(extra="forbid")

    width_mm: Number = Field(description="Width, up to 5000. [mm]")
    height_mm: Number = Field(description="Height, up to 5000. [mm]")


class ArtworkIn(SelectionIn):
    """Plates to make, by id or by filter, and how."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": _EXAMPLES})

    formats: list[ArtworkFormat] = Field([ArtworkFormat.PDF, ArtworkFormat.SVG], min_length=1, max_length=4)
    heaters: Flag = Field(False, description="Heating tracks under dark units.")
    leds: Flag = Field(False, description="Light sources under light units.")
    resolution_dpi: Resolution = Field(150.0, description="Of PNG files. [1/inch]")
    sheet: SheetIn | None = Field(None, description="Also nest the plates on sheets of this size.")

    def options(self) -> BundleOptions:
        """The options as the encoders know them."""
        return BundleOptions(
            formats=tuple(dict.fromkeys(self.formats)),
            artwork=ArtworkOptions(heaters=self.heaters, leds=self.leds),
            sheet_mm=(self.sheet.width_mm, self.sheet.height_mm) if self.sheet else None,
            dpi=self.resolution_dpi,
        )


async def get_artworks(request: Request) -> Artworks:
    """Use cases on artwork."""
    service: Artworks = request.app.state.artworks
    return service


ArtworkService = Annotated[Artworks, Depends(get_artworks)]


@router.get(
    "/markers/{marker_id}/artwork.{form}",
    response_class=Response,
    responses={200: {"content": {form.media_type: {} for form in ArtworkFormat}}, **problem_responses(404)},
)
def get_artwork(
    marker_id: MarkerId,
    form: ArtworkFormat,
    request: Request,
    caller: Caller,
    artworks: ArtworkService,
    heaters: Annotated[bool, Query(description="Heating tracks under dark units.")] = False,
    leds: Annotated[bool, Query(description="Light sources under light units.")] = False,
    resolution_dpi: Annotated[Resolution, Query(description="Of a PNG. [1/inch]")] = 150.0,
) -> Response:
    """Artwork at true size. It was rendered and read back before it is sent; `Waymark-Proof` says what was read."""
    options = ArtworkOptions(heaters=heaters, leds=leds)
    headers = {
        "ETag": f'"{artworks.tag(caller, marker_id, form, options, resolution_dpi)}"',
        "Cache-Control": "private, no-cache",
    }
    if request.headers.get("if-none-match") == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    artwork = artworks.plate_artwork(caller, marker_id, form, options, resolution_dpi)
    headers["Waymark-Proof"] = f"read-back digits={artwork.proof.digits} confidence={artwork.proof.confidence:.6f}"
    headers["Content-Disposition"] = f'inline; filename="{artwork.file_name}"'
    return Response(artwork.content, headers=headers, media_type=artwork.media_type)


@router.post(
    "/artwork",
    response_class=StreamingResponse,
    responses={200: {"content": {"application/zip": {}}}, **problem_responses(404)},
)
def post_artwork(wanted: ArtworkIn, caller: Caller, artworks: ArtworkService) -> Response:
    """Artwork of a selection as a ZIP with a manifest and a quality sheet; every plate was read back first."""
    bundle = artworks.bundle(caller, wanted.selection(), wanted.options())
    headers = {
        "Content-Length": str(bundle.size),
        "Content-Disposition": 'attachment; filename="waymark-artwork.zip"',
        "Waymark-Proof": f"read-back plates={bundle.plates} lowest-confidence={bundle.lowest_confidence:.6f}",
    }
    if bundle.approximate:
        headers["Waymark-Note"] = f"{bundle.approximate} of {bundle.plates} plates have an approximate position"
    return StreamingResponse(_chunks(bundle), headers=headers, media_type="application/zip")


def _chunks(bundle: Bundle) -> Iterator[bytes]:
    with bundle.file as file:
        while chunk := file.read(_CHUNK):
            yield chunk
