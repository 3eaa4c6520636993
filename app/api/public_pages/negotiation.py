"""What a client wants of a public page: HTML or JSON, and in which language (RFC 9110, section 12.5)."""

from __future__ import annotations

from collections.abc import Iterator

from starlette.datastructures import Headers, QueryParams
from starlette.types import Scope

from app.api.public_pages.texts import Texts
from app.api.public_pages.texts_de import GERMAN
from app.api.public_pages.texts_en import ENGLISH

LANGUAGES = {texts.language: texts for texts in (ENGLISH, GERMAN)}
PREFIX = "/m/"
"""Start of the paths of public pages."""
_MAX_HEADER = 500
"""Characters of a header that are looked at. Source: chosen by hand; browsers send about 100."""


def is_public_page(scope: Scope) -> bool:
    """Whether a request is for a public page."""
    return str(scope.get("path", "")).startswith(PREFIX)


def wants_json(headers: Headers) -> bool:
    """Whether a client prefers JSON to HTML; without a preference it gets HTML."""
    quality = {"application/json": 0.0, "text/html": 0.0}
    for name, q in _weighted(headers.get("accept", "")):
        if name in quality:
            quality[name] = max(quality[name], q)
        elif name in ("application/problem+json", "application/*"):
            quality["application/json"] = max(quality["application/json"], q)
        elif name == "text/*":
            quality["text/html"] = max(quality["text/html"], q)
    return quality["application/json"] > quality["text/html"]


def accepts_html(headers: Headers) -> bool:
    """Whether a client names HTML, as browsers do."""
    return any(name == "text/html" and q > 0 for name, q in _weighted(headers.get("accept", "")))


def texts_for(scope: Scope) -> Texts:
    """The texts in the language of the parameter `lang`, else the preferred one of Accept-Language, else English."""
    chosen = QueryParams(scope.get("query_string", b"")).get("lang", "")
    if chosen in LANGUAGES:
        return LANGUAGES[chosen]
    best, best_q = ENGLISH, 0.0
    for name, q in _weighted(Headers(scope=scope).get("accept-language", "")):
        texts = LANGUAGES.get(name.partition("-")[0])
        if texts is not None and q > best_q:
            best, best_q = texts, q
    return best


def _weighted(header: str) -> Iterator[tuple[str, float]]:
    """The members of a header with their weights; a weight that is none counts as 0."""
    for member in header[:_MAX_HEADER].lower().split(","):
        name, *parameters = (part.strip() for part in member.split(";"))
        weight = next((text[2:] for text in parameters if text.startswith("q=")), "1")
        try:
            q = float(weight)
        except ValueError:
            q = 0.0
        yield name, q if 0.0 <= q <= 1.0 else 0.0
