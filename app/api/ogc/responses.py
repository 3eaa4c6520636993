"""What every answer under /ogc has in common: media types, absolute links, and who may see what."""

from __future__ import annotations

import re
from urllib.parse import urlencode

import orjson
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from app.api.ogc.query import refuse
from app.api.ogc.shapes import Link
from app.services.markers.feature_crs import FeatureCrs

JSON = "application/json"
GEOJSON = "application/geo+json"
SCHEMA = "application/schema+json"
OPENAPI = "application/vnd.oai.openapi+json;version=3.0"
HTML = "text/html"
MVT = "application/vnd.mapbox-vector-tile"
MAP_STYLE = "application/vnd.mapbox.style+json"
_OPTIONS = orjson.OPT_NAIVE_UTC | orjson.OPT_UTC_Z
_QUALITY = re.compile(r"0(\.[0-9]{0,3})?|1(\.0{0,3})?", re.ASCII)
_HOST = re.compile(r"[A-Za-z0-9.\-]+(:[0-9]{1,5})?|\[[0-9A-Fa-f:.]+\](:[0-9]{1,5})?", re.ASCII)
_PREFIX = re.compile(r"(/[A-Za-z0-9._~\-]+)*/?", re.ASCII)


def base_url(request: Request) -> str:
    """Where the client reaches /ogc: as the deployment says, or as the proxy or the client says."""
    configured: str = request.app.state.public_url
    if configured:
        return f"{configured}/ogc"
    headers = request.headers
    scheme = _first(headers.get("x-forwarded-proto"))
    scheme = scheme if scheme in ("http", "https") else request.url.scheme
    host = _first(headers.get("x-forwarded-host")) or headers.get("host", "")
    prefix = _first(headers.get("x-forwarded-prefix"))
    if not _HOST.fullmatch(host):
        host = request.url.netloc
    if not _PREFIX.fullmatch(prefix):
        prefix = ""
    return f"{scheme}://{host}{prefix.rstrip('/')}/ogc"


def _first(header: str | None) -> str:
    return (header or "").partition(",")[0].strip()


def link(href: str, rel: str, kind: str, title: str | None = None) -> Link:
    """A link."""
    made: Link = {"href": href, "rel": rel, "type": kind}
    if title is not None:
        made["title"] = title
    return made


def with_query(url: str, pairs: list[tuple[str, str]]) -> str:
    """A URL with parameters."""
    return f"{url}?{urlencode(pairs)}" if pairs else url


def negotiate(
    request: Request, form: str | None, *kinds: str, names: tuple[str, ...] = ("json",), html: bool = False
) -> bool:
    """Whether the client is to get HTML. A client that wants none of these media types is refused.

    Parameters
    ----------
    form : str or None
        The parameter `f`; it wins over the Accept header.
    kinds : str
        Media types of the document, the first of which any client gets that accepts everything.
    names : tuple of str
        What `f` may name besides html.
    html : bool
        Whether there is a page as well.

    Raises
    ------
    MalformedRequest
        `f` names another format.
    HTTPException
        406: the Accept header names others only.
    """
    names = (*names, "html") if html else names
    if form is not None:
        if form not in names:
            refuse("f", "this format is not offered", ", ".join(names))
        return form == "html"
    accepted = request.headers.get("accept")
    if accepted is None:
        return False
    wanted = _weights(accepted)
    anything = max(wanted.get("*/*", 0.0), wanted.get("application/*", 0.0))
    document = max((wanted.get(kind.partition(";")[0], anything) for kind in kinds), default=0.0)
    page = max(wanted.get(name, 0.0) for name in (HTML, "text/*")) if html else 0.0
    if max(document, page) == 0.0:
        raise HTTPException(406, f"this is sent as {', '.join((*kinds, HTML) if html else kinds)}")
    return page > document


def _weights(accepted: str) -> dict[str, float]:
    """The quality of each media type of an Accept header (RFC 9110, 12.5.1); one that cannot be read is 1."""
    found: dict[str, float] = {}
    for part in accepted.lower().split(","):
        kind, *parameters = (piece.strip() for piece in part.split(";"))
        quality = next((text[2:].strip() for text in parameters if text.startswith("q=")), "1")
        found[kind] = float(quality) if _QUALITY.fullmatch(quality) else 1.0
    return found


def answer(
    content: object,
    kind: str = JSON,
    *,
    status: int = 200,
    crs: FeatureCrs | None = None,
    headers: dict[str, str] | None = None,
) -> Response:
    """A JSON document, as the key's owner alone may keep it."""
    sent = {"Cache-Control": "private, no-cache", **(headers or {})}
    if crs is not None:
        sent["Content-Crs"] = f"<{crs}>"
    return Response(orjson.dumps(content, option=_OPTIONS), status, sent, media_type=kind)
