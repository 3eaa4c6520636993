"""/v1/jobs/{job_id}/result: files that jobs have made."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Response
from fastapi.responses import StreamingResponse

from app.api.http.dependencies import Caller, Identifier, use_cases
from app.api.http.problems import problem_responses
from app.api.http.responses import NOT_MODIFIED, IfNoneMatch, created_response, file_response
from app.api.http.strict_json import StrictRoute
from app.services.progress.documents import JobDocument
from app.services.progress.results import JobFiles
from app.services.surveys.exports import STREAMED, WHOLE

router = APIRouter(prefix="/v1/jobs", tags=["jobs"], route_class=StrictRoute)

_TYPES = dict.fromkeys(media.partition(";")[0] for media in ("application/zip", *(STREAMED | WHOLE).values()))


def queued_job(job: JobDocument, replayed: bool) -> Response:
    """202 Accepted for a job that was queued."""
    response = created_response(job, replayed, path="/v1/jobs", status=202)
    response.headers["Retry-After"] = "1"
    return response


@router.get(
    "/{job_id}/result",
    response_class=StreamingResponse,
    responses={**file_response(_TYPES), **NOT_MODIFIED, **problem_responses(404, 409)},
)
def get_job_result(
    job_id: Annotated[Identifier, Path(description="Id of the job.")],
    caller: Caller,
    files: Annotated[JobFiles, use_cases("job_files")],
    if_none_match: IfNoneMatch = None,
) -> Response:
    """The file of a job that writes one: artwork or an export. It is kept for seven days; then 404."""
    file = files.open(caller, job_id)
    headers = {"ETag": f'"{file.sha256}"'}
    if if_none_match == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    headers |= {
        **file.headers,
        "Content-Length": str(file.size_bytes),
        "Content-Disposition": f'attachment; filename="{file.name}"',
    }
    return StreamingResponse(file.chunks, headers=headers, media_type=file.media_type)
