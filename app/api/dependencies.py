"""What routes ask for: the caller, the use cases, and headers parsed once."""

from __future__ import annotations

import hashlib
from typing import Annotated, Any

import orjson
from fastapi import Depends, Request, Response
from fastapi.dependencies.models import Dependant
from pydantic import AfterValidator, Field

from app.errors import InvalidParameter, NotAuthenticated, VersionRequired
from app.services.access import Caller as CallerValue
from app.services.idempotency import IdempotencyKey
from app.services.markers import Markers as MarkersService

MAX_IDEMPOTENCY_KEY = 200


def _plain_text(text: str) -> str:
    if "\x00" in text:
        raise ValueError("a text holds no NUL")
    return text


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Whole = Annotated[int, Field(strict=True)]
Text = Annotated[str, AfterValidator(_plain_text)]
Identifier = Annotated[str, Field(pattern=r"^[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}$")]


async def get_caller(request: Request) -> CallerValue:  # async: a plain function would cost a hop to a thread
    """The caller that the middleware authenticated."""
    caller = request.scope.get("state", {}).get("caller")
    if not isinstance(caller, CallerValue):
        raise NotAuthenticated("this resource needs a key", field="Authorization")
    return caller


async def get_markers(request: Request) -> MarkersService:
    """Use cases on markers."""
    service: MarkersService = request.app.state.markers
    return service


def checked_idempotency_key(request: Request) -> str | None:
    """The client's Idempotency-Key, if it sent one that can be kept."""
    key = request.headers.get("idempotency-key")
    if key is not None and (not 1 <= len(key) <= MAX_IDEMPOTENCY_KEY or not key.isprintable()):
        raise InvalidParameter(
            "the Idempotency-Key is empty, too long or not printable",
            field="Idempotency-Key",
            limit=f"1 to {MAX_IDEMPOTENCY_KEY} printable characters",
            cure="send a UUID",
        )
    return key


async def get_idempotency_key(request: Request) -> IdempotencyKey | None:
    """The client's Idempotency-Key with the hash of the request."""
    key = checked_idempotency_key(request)
    if key is None:
        return None
    digest = hashlib.sha256(f"{request.method} {request.url.path}\n".encode() + await request.body())
    return IdempotencyKey(key, digest.hexdigest())


async def get_version(request: Request) -> int | None:
    """The version named by If-Match; None for `*`.

    Raises
    ------
    VersionRequired
        There is no If-Match.
    InvalidParameter
        It is not an ETag of ours.
    """
    header = request.headers.get("if-match", "").strip()
    if not header:
        raise VersionRequired(
            "a change needs the version that it is based on",
            field="If-Match",
            limit='the ETag of the resource, e.g. "3"',
            cure="read the resource and send its ETag as If-Match",
        )
    if header == "*":
        return None
    digits = header.strip('"')
    if header != f'"{digits}"' or not (digits.isascii() and digits.isdigit()) or len(digits) > 9:
        raise InvalidParameter(
            f"{header[:40]!r} is not an ETag of this resource",
            field="If-Match",
            limit='a strong ETag, e.g. "3"',
            cure="send the ETag as it came",
        )
    return int(digits)


async def refuse_unknown_parameters(request: Request) -> None:
    """Refuse query parameters that the route does not know: a filter with a slip in its name would let all through.

    Raises
    ------
    InvalidParameter
        There is one.
    """
    if not request.query_params:
        return
    known = _query_names(request.scope["route"].dependant)
    unknown = next((name for name in request.query_params if name not in known), None)
    if unknown is not None:
        raise InvalidParameter(
            f"there is no parameter {unknown[:40]!r} here",
            field=unknown[:40],
            limit=", ".join(sorted(known)) or "no query parameters",
            cure=f"leave {unknown[:40]} out, or mend its name",
        )


def _query_names(dependant: Dependant) -> set[str]:
    names = {parameter.alias for parameter in dependant.query_params}
    return names.union(*(_query_names(inner) for inner in dependant.dependencies))


Caller = Annotated[CallerValue, Depends(get_caller)]
Markers = Annotated[MarkersService, Depends(get_markers)]
Idempotency = Annotated[IdempotencyKey | None, Depends(get_idempotency_key)]
Version = Annotated[int | None, Depends(get_version)]


def json_response(content: Any, status: int = 200, headers: dict[str, str] | None = None) -> Response:
    """A response by orjson, without a detour through response models."""
    return Response(orjson.dumps(content), status, headers, media_type="application/json")


def next_link(request: Request, **parameters: str | int) -> dict[str, str]:
    """Link header to the next page: this URL with other parameters."""
    return {"Link": f'<{request.url.include_query_params(**parameters)}>; rel="next"'}
