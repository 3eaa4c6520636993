"""Layouts of magnet markers as drilling sheets."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Request, Response

from app.api.dependencies import Caller
from app.api.problems import problem_responses
from app.api.schemas_markers import MarkerId
from app.encoders.magnet import SheetFormat
from app.services.layouts import Layouts

router = APIRouter(prefix="/v1/markers", tags=["layouts"])


async def get_layouts(request: Request) -> Layouts:
    """Use cases on layouts."""
    service: Layouts = request.app.state.layouts
    return service


@router.get(
    "/{marker_id}/layout.{form}",
    response_class=Response,
    responses={200: {"content": {form.media_type: {} for form in SheetFormat}}, **problem_responses(404)},
)
def get_layout(
    marker_id: MarkerId,
    form: SheetFormat,
    request: Request,
    caller: Caller,
    layouts: Annotated[Layouts, Depends(get_layouts)],
) -> Response:
    """Drilling sheet of a magnet marker: holes with polarity and orientation, checks, materials and costs."""
    headers = {"ETag": f'"{layouts.tag(caller, marker_id, form)}"', "Cache-Control": "private, no-cache"}
    if request.headers.get("if-none-match") == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    sheet = layouts.sheet(caller, marker_id, form)
    headers["Content-Disposition"] = f'inline; filename="{sheet.file_name}"'
    return Response(sheet.content, headers=headers, media_type=sheet.media_type)
