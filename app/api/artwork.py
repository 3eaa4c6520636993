"""Artwork of plates: one at a time, or a selection as a ZIP."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, ConfigDict, Field, JsonValue, model_validator

from app.api.dependencies import Caller, Identifier, Number
from app.api.problems import problem_responses
from app.api.schemas_markers import MarkerId, Status
from app.api.strict_json import StrictRoute
from app.encoders.plate import ArtworkFormat, ArtworkOptions, BundleOptions
from app.errors import InvalidParameter
from app.geodesy import check_lon_lat
from app.registry.markers import MarkerFilter
from app.registry.spatial import Box
from app.services.artwork import MAX_PLATES, Artworks, Bundle, Selection

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


class ArtworkIn(BaseModel):
    """Plates to make, by id or by filter, and how."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": _EXAMPLES})

    marker_ids: list[Identifier] | None = Field(None, min_length=1, description=f"Ids of 1 to {MAX_PLATES} plates.")
    bbox: Annotated[list[Number], Field(min_length=4, max_length=4)] | None = Field(
        None, description="west, south, east, north. [deg]"
    )
    status: Status | None = Field(None, description="Only plates with this status.")
    formats: list[ArtworkFormat] = Field([ArtworkFormat.PDF, ArtworkFormat.SVG], min_length=1, max_length=4)
    heaters: Flag = Field(False, description="Heating tracks under dark units.")
    leds: Flag = Field(False, description="Light sources under light units.")
    resolution_dpi: Resolution = Field(150.0, description="Of PNG files. [1/inch]")
    sheet: SheetIn | None = Field(None, description="Also nest the plates on sheets of this size.")

    @model_validator(mode="after")
    def _by_id_or_by_filter(self) -> ArtworkIn:
        if (self.marker_ids is None) == (self.bbox is None and self.status is None):
            raise InvalidParameter(
                "plates are selected by id, or by a filter",
                field="marker_ids",
                limit="marker_ids; or bbox, status or both",
                cure="send one of the two",
            )
        return self

    def selection(self) -> Selection:
        """The selection as the use cases know it."""
        box = None
        if self.bbox is not None:
            west, south, east, north = self.bbox
            check_lon_lat(west, south, field="bbox")
            check_lon_lat(east, north, field="bbox")
            if south > north:
                raise InvalidParameter("bbox has its south above its north", field="bbox", limit="south <= north")
            box = Box(west, south, east, north)
        return Selection(tuple(self.marker_ids or ()), MarkerFilter(box=box, status=self.status))

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
