"""Layouts of magnet markers as drilling sheets."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Response

from app.api.http.dependencies import Caller, MarkerId, use_cases
from app.api.http.problems import problem_responses
from app.api.http.responses import NOT_MODIFIED, IfNoneMatch, file_response
from app.api.http.strict_json import StrictRoute
from app.encoders.magnet import SheetFormat
from app.services.markers.layouts import Layouts

router = APIRouter(prefix="/v1/markers", tags=["layouts"], route_class=StrictRoute)


@router.get(
    "/{marker_id}/layout.{form}",
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
    layouts: Annotated[Layouts, use_cases("layouts")],
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Drilling sheet of a magnet marker: holes with polarity and orientation, checks, materials and costs."""
    headers = {"ETag": f'"{layouts.tag(caller, marker_id, form)}"', "Cache-Control": "private, no-cache"}
    if if_none_match == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    sheet = layouts.sheet(caller, marker_id, form)
    headers["Content-Disposition"] = f'inline; filename="{sheet.file_name}"'
    return Response(sheet.content, headers=headers, media_type=sheet.media_type)
