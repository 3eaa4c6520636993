"""The web pages: the files of `static/`, with a content security policy that allows nothing else."""

from __future__ import annotations

from pathlib import Path

import orjson
from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.responses import FileResponse
from starlette.datastructures import MutableHeaders
from starlette.staticfiles import StaticFiles
from starlette.types import Message, Receive, Scope, Send

STATIC = Path(__file__).resolve().parents[3] / "static"
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-cache",
}
_REDOC_STYLES = (
    "'sha256-47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=' 'sha256-QMIg+bpjm3JdElJ388KYke01izlUW0UoNOeKjpMxdgc='"
)
"""Hashes of the two style elements that Redoc makes: an empty one, which its script fills, and that of its menu."""

router = APIRouter()


@router.get("/", response_class=FileResponse, include_in_schema=False)
def get_page() -> FileResponse:
    """The page; everything else that it needs is under /static."""
    return FileResponse(STATIC / "index.html", headers=_HEADERS)


@router.get("/docs", response_class=FileResponse, include_in_schema=False)
def get_docs() -> FileResponse:
    """The API's documentation by Swagger UI, from static/vendor."""
    return FileResponse(STATIC / "docs.html", headers=_HEADERS)


@router.get("/redoc", response_class=FileResponse, include_in_schema=False)
def get_redoc() -> FileResponse:
    """The API's reference by Redoc, from static/vendor."""
    policy = _HEADERS["Content-Security-Policy"].replace("style-src 'self'", f"style-src 'self' {_REDOC_STYLES}")
    return FileResponse(STATIC / "redoc.html", headers=_HEADERS | {"Content-Security-Policy": policy})


@router.get("/openapi.json", include_in_schema=False)
def get_openapi_document(request: Request) -> Response:
    """The OpenAPI document, written once: it takes the server longer than most requests."""
    state = request.app.state
    if not hasattr(state, "openapi_json"):
        state.openapi_json = orjson.dumps(request.app.openapi())
    return Response(state.openapi_json, media_type="application/json", headers={"Cache-Control": "no-cache"})


def mount_static(app: FastAPI) -> None:
    """Serve the page's scripts, style and pictures."""
    app.mount("/static", _Files(directory=STATIC))


class _Files(StaticFiles):
    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_policy(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        await super().__call__(scope, receive, send_with_policy)
