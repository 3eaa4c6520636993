"""Who may call what: scopes, which routes name at their functions, and the key in a request.

The middleware asks before a body is read. A path without a route is refused. docs/access.md describes the
scopes.
"""

from __future__ import annotations

import base64
import binascii
from collections import defaultdict
from collections.abc import Mapping
from re import Pattern
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.routing import compile_path

from app.errors import NotAllowed, NotAuthenticated
from app.services.access.access import AGENCY_SCOPES, Scope

Allowed = frozenset[Scope]

PUBLIC: Allowed = frozenset()
"""Scopes of routes that need no key."""
EVERYBODY: Allowed = frozenset(AGENCY_SCOPES)
"""Any key of an agency. Vehicles see only their own rows through such a route."""
READERS: Allowed = EVERYBODY - {Scope.VEHICLE}
UPLOADERS: Allowed = EVERYBODY - {Scope.VIEWER}
SURVEYORS: Allowed = READERS - {Scope.VIEWER}
PLANNERS: Allowed = frozenset({Scope.PLANNER, Scope.ADMIN})
ADMINS: Allowed = frozenset({Scope.ADMIN})
OPERATORS: Allowed = frozenset({Scope.OPERATOR})
"""Keys of the server's operators. They read no agency's rows; of keys and the audit log they see the operators' own."""


class Permissions:
    """Who may use which route, prepared for a look-up at each request.

    Parameters
    ----------
    table : mapping of str to set of Scope
        By method and path template, e.g. ``GET /v1/markers/{marker_id}``. A parameter fills no more than one segment.
    """

    def __init__(self, table: Mapping[str, Allowed]) -> None:
        self._plain: dict[tuple[str, str], Allowed] = {}
        self._templates: dict[tuple[str, int], list[tuple[Pattern[str], Allowed]]] = defaultdict(list)
        # where two templates fit a path, that with fewer parameters is meant: /markers/summary, not /markers/{id}
        for route, allowed in sorted(table.items(), key=lambda item: item[0].count("{")):
            method, _, path = route.partition(" ")
            if "{" in path:
                self._templates[method, path.count("/")].append((compile_path(path)[0], allowed))
            else:
                self._plain[method, path] = allowed

    def find(self, method: str, path: str) -> Allowed | None:
        """Scopes that may use a route; None if the table does not contain it. HEAD is treated as GET."""
        method = "GET" if method == "HEAD" else method
        allowed = self._plain.get((method, path))
        if allowed is None:
            candidates = self._templates.get((method, path.count("/")), ())
            allowed = next((found for pattern, found in candidates if pattern.match(path)), None)
        return allowed


# === The key in a request's headers: Bearer, X-API-Key, or the password of HTTP Basic (RFC 7617), which GIS clients and
#
# spreadsheets send.
#
# A browser that was asked for a password repeats it by itself, also for requests that another site's page makes. Such
# requests are refused unless they open a page (docs/access.md, "Browsers").


CHALLENGES = ('Bearer realm="waymark"', 'Basic realm="waymark", charset="UTF-8"')
"""Values of WWW-Authenticate, each in a field of its own: many clients do not read a list of challenges."""
SECURITY_SCHEMES = {
    "bearer": {"type": "http", "scheme": "bearer"},
    "apiKey": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
    "basic": {"type": "http", "scheme": "basic", "description": "The key is the password. The user name is ignored."},
}
"""How OpenAPI documents describe the ways to send a key."""
SECURITY: list[dict[str, list[str]]] = [{name: []} for name in SECURITY_SCHEMES]
"""Each way suffices."""
_LIMIT = "Authorization: Bearer KEY, X-API-Key: KEY, or Authorization: Basic with the key as the password"


def key_in(headers: Headers) -> str:
    """The key that a request sends.

    Raises
    ------
    NotAuthenticated
        There is none, or Basic credentials cannot be read.
    NotAllowed
        A browser sends Basic credentials on behalf of another site.
    """
    scheme, _, sent = headers.get("authorization", "").partition(" ")
    scheme, sent = scheme.lower(), sent.strip()
    found = sent if scheme == "bearer" else headers.get("x-api-key", "").strip()
    if not found and scheme == "basic":
        found = _password(sent)
        _refuse_other_sites(headers)
    if not found:
        raise NotAuthenticated(
            "this resource requires a key",
            field="Authorization",
            limit=_LIMIT,
            cure="send the admin key that the server printed at its first start, or a key that was created with it",
        )
    return found


def _password(sent: str) -> str:
    try:
        user, separator, password = base64.b64decode(sent, validate=True).decode("utf-8").partition(":")
    except (binascii.Error, ValueError):
        user, separator, password = "", "", ""
    if separator and (password.strip() or not user):
        return password.strip()
    raise NotAuthenticated(
        "the Basic credentials have no password" if separator else "the Basic credentials cannot be read",
        field="Authorization",
        limit=_LIMIT,
        cure="send the key as the password, with any user name: Basic base64(USER:KEY)",
    )


def _refuse_other_sites(headers: Headers) -> None:
    """Fetch metadata if the browser sends them, else the Origin; other clients send neither."""
    site = headers.get("sec-fetch-site")
    if site is None:
        origin = headers.get("origin")
        is_own = origin is None or urlsplit(origin).netloc in (headers.get("host"), headers.get("x-forwarded-host"))
    else:
        opens_page = headers.get("sec-fetch-mode") == "navigate" and "origin" not in headers
        is_own = site in ("same-origin", "none") or opens_page
    if not is_own:
        raise NotAllowed(
            "the page of another site sends a request with the password that this browser remembers",
            field="Authorization",
            limit="with Basic: requests of this server's own pages, and links that open a page",
            cure="send the key as Authorization: Bearer KEY",
        )
