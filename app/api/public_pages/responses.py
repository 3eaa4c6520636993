"""What all responses to requests for public pages have in common; problems are pages there, too."""

from __future__ import annotations

from fastapi import Response
from starlette.datastructures import Headers
from starlette.types import Scope

from app.api.public_pages.html import problem_page
from app.api.public_pages.negotiation import is_public_page, texts_for, wants_json
from app.api.public_pages.texts import Texts

_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; style-src 'self'; img-src 'self'; form-action 'self'; base-uri 'none'; "
        "frame-ancestors 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "X-Robots-Tag": "noindex",
    "Vary": "Accept, Accept-Language",
}


def page_response(page: str | Response, texts: Texts | None = None, status: int = 200) -> Response:
    """A page, or another response, with the headers of public pages."""
    response = Response(page, status, media_type="text/html") if isinstance(page, str) else page
    response.headers.update(_HEADERS)
    if texts is not None:
        response.headers["Content-Language"] = texts.language
    return response


def as_page(problem: Response, scope: Scope) -> Response:
    """A problem document as a page, where a public page was asked for by a client that does not prefer JSON."""
    if not is_public_page(scope):
        return problem
    if wants_json(Headers(scope=scope)):
        return page_response(problem)
    texts = texts_for(scope)
    depth = max(0, scope["path"].count("/") - 2)
    page = page_response(problem_page(texts, problem.status_code, depth), texts, problem.status_code)
    for name in ("Retry-After", "Connection", "Allow"):
        if name in problem.headers:
            page.headers[name] = problem.headers[name]
    return page
