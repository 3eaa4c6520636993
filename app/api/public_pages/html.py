"""The public pages as HTML: no script and no inline style, so that the content security policy can refuse both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fastapi import Response
from starlette.datastructures import Headers
from starlette.types import Scope

from app.api.public_pages.texts import LANGUAGES, Texts, is_public_page, texts_for, wants_json
from app.api.templates import render_page
from app.services.public_pages.pages import PublicMarker

MAX_TEXT = 1000
"""Characters of a description."""
MAX_EMAIL = 254
"""Characters of an address (RFC 5321, section 4.5.3.1.3, without the angle brackets)."""


@dataclass(frozen=True, slots=True)
class FormState:
    """A form as it is shown."""

    token: str
    photo_mb: int  # size that a photo may have
    contact_days: int  # time until an e-mail address is deleted
    values: Mapping[str, str]  # what was typed before, by field
    faults: Mapping[str, str]  # what is wrong, by field
    had_photo: bool = False


def marker_page(texts: Texts, marker: PublicMarker, form: FormState | None, *, up: str = "") -> str:
    """The page of a marker.

    Parameters
    ----------
    form : FormState or None
        None: the agency takes no reports.
    up : str
        Relative address of the page's folder, from where it is shown.
    """
    title = texts.marker if marker.agency is None else f"{texts.marker} – {marker.agency}"
    if form is not None and form.faults:
        title = f"{texts.error_prefix}: {title}"
    facts = _facts(texts, marker)
    values = {"marker": marker, "facts": facts, "form": form, "max_text": MAX_TEXT, "max_email": MAX_EMAIL}
    return _page("marker.html", texts, title, here=f"{up}{marker.id}", up=up, **values)


def thanks_page(texts: Texts, marker: PublicMarker) -> str:
    """The page after a report was received."""
    return _page("thanks.html", texts, texts.thanks, here="thanks", up="../", marker=marker)


def problem_page(texts: Texts, status: int, depth: int) -> str:
    """The page for an error: the same for every cause with this status."""
    title, text = texts.problems.get(status, texts.problems[0])
    return _page("problem.html", texts, title, here="", up="../" * depth, text=text)


def _page(template: str, texts: Texts, title: str, *, here: str, up: str, **values: object) -> str:
    others = [other for other in LANGUAGES.values() if other is not texts]
    return render_page(
        f"public/{template}", texts=texts, title=title, other_languages=others, here=here, up=up, **values
    )


def _facts(texts: Texts, marker: PublicMarker) -> Sequence[tuple[str, str]]:
    measure = (
        None if marker.measure_m is None else f"km {marker.measure_m / 1000:.3f}".replace(".", texts.decimal_point)
    )
    found = (
        (texts.code, marker.code),
        (texts.agency, marker.agency),
        (texts.status, texts.statuses[marker.status] if marker.status is not None else None),
        (texts.revision, None if marker.revision is None else str(marker.revision)),
        (texts.road, marker.road),
        (texts.measure, measure),
    )
    return [(name, value) for name, value in found if value is not None]


# === What all responses to requests for public pages have in common; problems are pages there, too.


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
