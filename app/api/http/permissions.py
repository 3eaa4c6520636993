"""Who may call what: one table of every route. The middleware asks it before a body is read; a test compares it with
the application's routes.

A route that is missing here is refused to everybody. docs/access.md says what each scope is for.
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

from app.api.http.page_addresses import PAGES
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

_OGC_ITEMS = "/ogc/collections/{collection}/items"
_OGC_TILES = "/ogc/collections/{collection}/tiles"

PERMISSIONS: dict[str, Allowed] = {
    # --- the pages, the documentation, the operator's
    **{f"GET {path}": PUBLIC for path in PAGES},
    "GET /v1/page-settings": PUBLIC,
    "GET /static": PUBLIC,
    "GET /guide": PUBLIC,
    "GET /docs": PUBLIC,
    "GET /redoc": PUBLIC,
    "GET /openapi.json": PUBLIC,
    "GET /healthz": PUBLIC,
    "GET /readyz": PUBLIC,
    "GET /metrics": PUBLIC,
    # --- public pages; what they show is up to the agency
    "GET /m/{marker_id}": PUBLIC,
    "GET /m/{marker_id}/thanks": PUBLIC,
    "POST /m/{marker_id}/reports": PUBLIC,
    "GET /v1/public-page": READERS,
    "PUT /v1/public-page": ADMINS,
    "GET /v1/damage-reports": READERS,
    "GET /v1/damage-reports/{report_id}": READERS,
    "GET /v1/damage-reports/{report_id}/photo": READERS,
    "DELETE /v1/damage-reports/{report_id}/photo": SURVEYORS,
    "GET /v1/damage-reports/{report_id}/contact": SURVEYORS,  # an e-mail address: for those who decide
    "DELETE /v1/damage-reports/{report_id}/contact": SURVEYORS,
    "POST /v1/damage-reports/{report_id}/accept": SURVEYORS,
    "POST /v1/damage-reports/{report_id}/reject": SURVEYORS,
    # --- markers and what is made from them
    "GET /v1/markers": READERS,
    "POST /v1/markers": PLANNERS,
    "POST /v1/markers/search": READERS,
    "POST /v1/markers/bulk": SURVEYORS,  # registering as POST /v1/markers
    "GET /v1/markers/{marker_id}": READERS,
    "PATCH /v1/markers/{marker_id}": SURVEYORS,
    "GET /v1/markers/{marker_id}/accuracy": READERS,
    "GET /v1/markers/{marker_id}/versions": READERS,
    "GET /v1/markers/{marker_id}/versions/{version}": READERS,
    "GET /v1/markers/{marker_id}/observations": READERS,
    "GET /v1/markers/{marker_id}/observations/summary": READERS,
    "GET /v1/markers/{marker_id}/health": READERS,
    "GET /v1/markers/{marker_id}/artwork.{form}": READERS,
    "GET /v1/markers/{marker_id}/layout.{form}": READERS,
    "GET /v1/markers/{marker_id}/payload.{form}": PLANNERS,  # who has a payload can speak for the marker
    "POST /v1/artwork": READERS,
    "POST /v1/plate-drafts": READERS,  # nothing is stored
    "POST /v1/plate-drafts/artwork.{form}": READERS,
    "POST /v1/plate-drafts/pass": READERS,
    "POST /v1/plate-drafts/view": READERS,
    "POST /v1/print-grades": READERS,  # fabricators; nothing is stored
    "POST /v1/programs": PLANNERS,  # with the markers' keys: admins, see app/services/markers/programs.py
    "POST /v1/radio-checks": READERS,
    "GET /v1/imports": SURVEYORS,
    "POST /v1/imports": SURVEYORS,
    "GET /v1/imports/{import_id}": SURVEYORS,
    "POST /v1/imports/{import_id}/cancel": SURVEYORS,
    "POST /v1/exports": READERS,
    "GET /v1/exports/{kind}": READERS,
    "GET /v1/snapshots": EVERYBODY,  # vehicles without a connection decode with it
    "GET /v1/snapshots/trust": EVERYBODY,
    "GET /v1/audit": ADMINS | OPERATORS,
    "POST /v1/audit/verifications": ADMINS,
    "GET /v1/audit/verifications/{verification_id}": ADMINS,
    # --- plans
    "GET /v1/alignments": READERS,
    "POST /v1/alignments": PLANNERS,
    "GET /v1/alignments/{alignment_id}": READERS,
    "GET /v1/alignments/{alignment_id}/source": READERS,
    "GET /v1/alignments/{alignment_id}/map.{form}": READERS,
    "GET /v1/alignments/{alignment_id}/profile": READERS,
    "GET /v1/plan-rules/schema": READERS,
    "POST /v1/plan-rules": PLANNERS,
    "POST /v1/plan-previews": PLANNERS,
    "GET /v1/plans": READERS,
    "POST /v1/plans": PLANNERS,
    "GET /v1/plans/{plan_id}": READERS,
    "PATCH /v1/plans/{plan_id}": PLANNERS,
    "GET /v1/plans/{plan_id}/versions": READERS,
    "GET /v1/plans/{plan_id}/files/{name}": READERS,
    "POST /v1/plans/{plan_id}/approve": PLANNERS,
    "POST /v1/plans/{plan_id}/commit": PLANNERS,
    "GET /v1/plans/{plan_id}/as-built": READERS,
    "GET /v1/plans/{plan_id}/proof": READERS,
    "POST /v1/plans/{plan_id}/proof": PLANNERS,
    "GET /v1/plans/{plan_id}/package": READERS,
    "POST /v1/plans/{plan_id}/package": PLANNERS,
    "GET /v1/plan-jobs": READERS,
    "GET /v1/plan-jobs/{job_id}": READERS,
    "POST /v1/plan-jobs/{job_id}/cancel": PLANNERS,
    # --- jobs of every kind: which kinds a scope sees is in app/services/progress.py
    "GET /v1/jobs": EVERYBODY,
    "GET /v1/jobs/{job_id}": EVERYBODY,
    "GET /v1/jobs/{job_id}/events": EVERYBODY,
    "GET /v1/jobs/{job_id}/result": READERS,
    "POST /v1/jobs/{job_id}/cancel": EVERYBODY,  # viewers: artwork and exports that they asked for
    "GET /v1/reprocessings": ADMINS,
    "POST /v1/reprocessings": ADMINS,
    "GET /v1/reprocessings/{reprocessing_id}": ADMINS,
    "GET /v1/reprocessings/{reprocessing_id}/report": ADMINS,
    "GET /v1/reprocessings/{reprocessing_id}/report.csv": ADMINS,
    "POST /v1/reprocessings/{reprocessing_id}/cancel": ADMINS,
    "POST /v1/reprocessings/{reprocessing_id}/accept": ADMINS,
    "GET /v1/decodes/{decode_id}/versions": EVERYBODY,
    "GET /v1/events": EVERYBODY,
    "GET /v1/webhooks": PLANNERS,
    "POST /v1/webhooks": PLANNERS,
    "GET /v1/webhooks/{webhook_id}": PLANNERS,
    "DELETE /v1/webhooks/{webhook_id}": PLANNERS,
    "POST /v1/webhooks/{webhook_id}/enable": PLANNERS,
    "GET /v1/webhooks/{webhook_id}/deliveries": PLANNERS,
    "POST /v1/webhooks/{webhook_id}/deliveries/{delivery_id}/redeliver": PLANNERS,
    # --- roads
    "GET /v1/roads": READERS,
    "POST /v1/roads": PLANNERS,
    "GET /v1/roads/{road_id}": READERS,
    "PATCH /v1/roads/{road_id}": PLANNERS,
    "GET /v1/roads/{road_id}/versions": READERS,
    "GET /v1/roads/{road_id}/locate": READERS,
    "POST /v1/roads/{road_id}/locate": READERS,
    "GET /v1/roads/{road_id}/position": READERS,
    "POST /v1/roads/{road_id}/position": READERS,
    "GET /v1/roads/{road_id}/markers": READERS,
    # --- marker health
    "GET /v1/maintenance": READERS,
    "GET /v1/maintenance.{form}": READERS,
    "GET /v1/maintenance/{item_id}": READERS,
    "POST /v1/maintenance/{item_id}/approve": SURVEYORS,
    "POST /v1/maintenance/{item_id}/dismiss": SURVEYORS,
    # --- codebooks
    "POST /v1/codebook-drafts": READERS,  # nothing is stored
    "GET /v1/codebooks": READERS,
    "POST /v1/codebooks": PLANNERS,
    "GET /v1/codebooks/{codebook_id}": READERS,
    "GET /v1/codebooks/{codebook_id}/entries": READERS,
    "POST /v1/codebooks/{codebook_id}/entries": PLANNERS,
    "GET /v1/codebooks/{codebook_id}/entries/{code}": READERS,
    # --- decodes
    "GET /v1/decodes": EVERYBODY,
    "POST /v1/decodes": UPLOADERS,
    "GET /v1/decodes/{decode_id}": EVERYBODY,
    "POST /v1/decodes/{decode_id}/cancel": UPLOADERS,
    "GET /v1/decodes/{decode_id}/plot.svg": EVERYBODY,
    "GET /v1/decodes/{decode_id}/samples": EVERYBODY,
    "GET /v1/decodes/{decode_id}/packets": EVERYBODY,
    "GET /v1/decodes/{decode_id}/track.{form}": EVERYBODY,
    "GET /v1/decodes/{decode_id}/readings.{form}": EVERYBODY,
    "GET /v1/decodes/{decode_id}/lane.geojson": EVERYBODY,
    "GET /v1/decodes/{decode_id}/overlay.{form}": EVERYBODY,
    "GET /v1/decodes/{decode_id}/annotated.{form}": EVERYBODY,
    # --- uploads in parts
    "POST /v1/uploads": UPLOADERS,
    "OPTIONS /v1/uploads": UPLOADERS,
    "GET /v1/uploads/{upload_id}": UPLOADERS,
    "PATCH /v1/uploads/{upload_id}": UPLOADERS,
    "DELETE /v1/uploads/{upload_id}": UPLOADERS,
    "POST /v1/uploads/{upload_id}/complete": UPLOADERS,
    "OPTIONS /v1/uploads/{upload_id}": UPLOADERS,
    # --- drives
    "GET /v1/drives": EVERYBODY,
    "POST /v1/drives": UPLOADERS,
    "GET /v1/drives/{drive_id}": EVERYBODY,
    "DELETE /v1/drives/{drive_id}": UPLOADERS,
    "POST /v1/drives/{drive_id}/cancel": UPLOADERS,
    "GET /v1/drives/{drive_id}/track.{form}": EVERYBODY,
    "GET /v1/drives/{drive_id}/plot.svg": EVERYBODY,
    # --- fleet
    "GET /v1/vehicles": READERS,
    "POST /v1/vehicles": PLANNERS,
    "GET /v1/vehicles/{vehicle_id}": READERS,
    "PATCH /v1/vehicles/{vehicle_id}": PLANNERS,
    "DELETE /v1/vehicles/{vehicle_id}": PLANNERS,
    "GET /v1/vehicles/{vehicle_id}/versions": READERS,
    "PUT /v1/vehicles/{vehicle_id}/calibration": PLANNERS,
    "GET /v1/calibration-boards/board.{form}": READERS,
    "GET /v1/calibrations": READERS,
    "POST /v1/calibrations": SURVEYORS,
    "GET /v1/calibrations/{calibration_id}": READERS,
    "PUT /v1/vehicles/{vehicle_id}/keys/{key_id}": ADMINS,
    "DELETE /v1/vehicles/{vehicle_id}/keys/{key_id}": ADMINS,
    # --- keys
    "GET /v1/server-settings": ADMINS,
    "GET /v1/me": EVERYBODY | OPERATORS,
    "GET /v1/agencies": OPERATORS,
    "POST /v1/agencies": OPERATORS,
    "GET /v1/keys": ADMINS | OPERATORS,
    "POST /v1/keys": ADMINS,  # an operator's key is created on the server's machine only
    "GET /v1/keys/{key_id}": ADMINS | OPERATORS,
    "POST /v1/keys/{key_id}/rotate": ADMINS | OPERATORS,
    "DELETE /v1/keys/{key_id}": ADMINS | OPERATORS,
    # --- OGC API
    "GET /ogc": READERS,
    "GET /ogc/": READERS,
    "GET /ogc/conformance": READERS,
    "GET /ogc/api": READERS,
    "GET /ogc/collections": READERS,
    "GET /ogc/collections/{collection}": READERS,
    "GET /ogc/collections/{collection}/schema": READERS,
    "GET /ogc/collections/{collection}/geojson-schema": READERS,
    "GET /ogc/collections/{collection}/queryables": READERS,
    f"GET {_OGC_ITEMS}": READERS,
    f"POST {_OGC_ITEMS}": PLANNERS,
    f"OPTIONS {_OGC_ITEMS}": READERS,
    f"GET {_OGC_ITEMS}/{{feature}}": READERS,
    f"PUT {_OGC_ITEMS}/{{feature}}": SURVEYORS,
    f"PATCH {_OGC_ITEMS}/{{feature}}": SURVEYORS,
    f"DELETE {_OGC_ITEMS}/{{feature}}": PLANNERS,
    f"OPTIONS {_OGC_ITEMS}/{{feature}}": READERS,
    "GET /ogc/tileMatrixSets": READERS,
    "GET /ogc/tileMatrixSets/{matrix_set}": READERS,
    f"GET {_OGC_TILES}": READERS,
    f"GET {_OGC_TILES}/{{matrix_set}}": READERS,
    f"GET {_OGC_TILES}/{{matrix_set}}/tilejson": READERS,
    f"GET {_OGC_TILES}/{{matrix_set}}/style": READERS,
    f"GET {_OGC_TILES}/{{matrix_set}}/{{zoom}}/{{row}}/{{column}}": READERS,
}


class Permissions:
    """The table, prepared for a look-up at each request.

    Parameters
    ----------
    table : mapping of str to set of Scope
        By method and path template, e.g. ``GET /v1/markers/{marker_id}``. A parameter fills no more than one segment.
    """

    def __init__(self, table: Mapping[str, Allowed] = PERMISSIONS) -> None:
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
