"""What many routes return, and its OpenAPI description: documents, pages, cursors, files, times, 304."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from types import MappingProxyType
from typing import Annotated

import orjson
from fastapi import Header, Request, Response

from app.api.http.problems import Described, problem_responses
from app.errors import InvalidParameter
from app.values import JsonObject

BINARY: dict[str, str] = {"type": "string", "format": "binary"}
GEOJSON: JsonObject = {
    "type": "object",
    "description": "A GeoJSON FeatureCollection (RFC 7946).",
    "required": ["type", "features"],
    "properties": {
        "type": {"type": "string", "enum": ["FeatureCollection"]},
        "features": {"type": "array", "items": {"type": "object", "additionalProperties": True}},
    },
    "additionalProperties": True,
}
_SCHEMAS = {"application/geo+json": GEOJSON, "application/json": {"type": "object", "additionalProperties": True}}
NOT_MODIFIED: Described = {304: {"description": "The representation that If-None-Match names is still current"}}

IfNoneMatch = Annotated[
    str | None, Header(alias="If-None-Match", description="ETag of the representation that the client has.")
]
IfMatch = Annotated[
    str | None,
    Header(
        alias="If-Match",
        description='ETag of the version that the change is based on, e.g. `"3"`, or `*` for any version.',
    ),
]
IdempotencyKeyHeader = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        description="1 to 200 printable characters, such as a UUID. A repeated request gets the first response again.",
    ),
]
Prefer = Annotated[
    str | None,
    Header(
        alias="Prefer",
        description="`respond-async` runs the request as a job: the response is 202 Accepted (RFC 7240).",
    ),
]


def wants_job(prefer: str | None) -> bool:
    """Whether a request is to be run as a job, by its Prefer header."""
    return "respond-async" in (prefer or "").lower()


def file_response(
    media_types: Iterable[str],
    description: str = "The file",
    status: int = 200,
    headers: Mapping[str, str] = MappingProxyType({}),
) -> Described:
    """A response that is a file of one of some media types: binary, or GeoJSON; with descriptions of its headers."""
    content = {media_type: {"schema": _SCHEMAS.get(media_type, BINARY)} for media_type in media_types}
    described: JsonObject = {"description": description, "content": content}
    if headers:
        described["headers"] = {
            name: {"description": text, "schema": {"type": "string"}} for name, text in headers.items()
        }
    return {status: described}


def text_response(media_type: str, description: str = "The text", status: int = 200) -> Described:
    """A response that is a text."""
    return {status: {"description": description, "content": {media_type: {"schema": {"type": "string"}}}}}


def document_response(model: object, *problems: int, status: int = 200, description: str | None = None) -> Described:
    """A response that is a document, with the problems that the route can return besides those of every /v1 route."""
    described = {"model": model} if description is None else {"model": model, "description": description}
    return {status: described, **problem_responses(*problems)}


def json_response(content: object, status: int = 200, headers: dict[str, str] | None = None) -> Response:
    """A JSON response, serialised by orjson."""
    text = orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)
    return Response(text, status, headers, media_type="application/json")


def page_response(request: Request, page: object, **cursor: str | int | None) -> Response:
    """A page; if there is a next one, a Link header names it: this URL with the cursor as a parameter."""
    onward = {name: value for name, value in cursor.items() if value}
    url = request.url.include_query_params(**onward)
    return json_response(page, headers={"Link": f'<{url}>; rel="next"'} if onward else None)


def versioned_response(document: Mapping[str, object], if_none_match: str | None = None) -> Response:
    """A document with its version as ETag; 304 where the client has this version."""
    headers = {"ETag": etag_of(document)}
    if if_none_match == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    return json_response(document, headers=headers)


def created_response(
    document: Mapping[str, object], replayed: bool, *, path: str | None = None, status: int = 201
) -> Response:
    """A new document with its Location below `path`, its version as ETag, and whether the response is repeated."""
    headers = {"Idempotency-Replayed": "true"} if replayed else {}
    if path is not None:
        headers["Location"] = f"{path}/{document['id']}"
    if "version" in document:
        headers["ETag"] = etag_of(document)
    return json_response(document, status, headers)


def etag_of(document: Mapping[str, object]) -> str:
    """The ETag of a document with versions."""
    return f'"{document["version"]}"'


# === Where a page ended, as the link to the next page has it.


_ID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")
_PLACE = re.compile(r"(-?[0-9]{1,9}(?:\.[0-9]{1,20})?(?:e-[0-9]{1,3})?),([0-9a-f-]{36})")


def checked_id(after: str | None) -> str | None:
    """The last id of a page in the order of ids.

    Raises
    ------
    InvalidParameter
        It is no id.
    """
    if after is not None and not _ID.fullmatch(after):
        raise no_cursor()
    return after


def cursor_of(after: str | None) -> tuple[float, str] | None:
    """The last distance or measure [m], and its id, of a page in the order of these.

    Raises
    ------
    InvalidParameter
        It is not where a page ended.
    """
    if after is None:
        return None
    found = _PLACE.fullmatch(after)
    if found is None or not math.isfinite(float(found[1])):
        raise no_cursor()
    return float(found[1]), found[2]


def no_cursor() -> InvalidParameter:
    """The error for a value of `after` that no page gave."""
    return InvalidParameter(
        "this is not where a page of this list ended",
        field="after",
        limit="as the link to the next page has it",
        cure="start without after, and follow the links",
    )


# === Times in addresses, queries and bodies.


_RFC3339 = re.compile(
    r"[0-9]{4}-[0-9]{2}-[0-9]{2}[Tt ][0-9]{2}:[0-9]{2}:[0-9]{2}(\.[0-9]{1,6})?([Zz]|[+-][0-9]{2}:[0-9]{2})"
)


def parse_time(text: str, field: str) -> datetime:
    """A time with its zone (RFC 3339).

    Raises
    ------
    InvalidParameter
        It is none.
    """
    try:
        if _RFC3339.fullmatch(text):
            return datetime.fromisoformat(text.upper()).astimezone(UTC)
    except (ValueError, OverflowError):
        pass
    raise InvalidParameter(
        f"{text[:40]!r} is no time",
        field=field,
        limit="RFC 3339 with a zone and at most six decimals, years 1 to 9999",
        cure="write 2026-03-04T05:06:07Z; a + in an address is written %2B",
    )
