"""FastAPI dependencies of all routes: the caller, the use cases, and parsed headers."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Annotated, Any

from fastapi import Depends, Path, Query, Request
from fastapi.dependencies.models import Dependant

from app.api.http.responses import IdempotencyKeyHeader, IfMatch
from app.errors import InvalidParameter, NotAuthenticated, VersionRequired
from app.inputs import Identifier, Text
from app.services.access.access import Caller as CallerValue
from app.services.idempotency import IdempotencyKey
from app.services.markers.markers import Markers as MarkersService
from app.use_cases import UseCases

MAX_IDEMPOTENCY_KEY = 200

MarkerId = Annotated[Identifier, Path(description="Id of the marker.")]
PageSize = Annotated[int, Query(ge=1, le=1000)]
LastId = Annotated[Identifier | None, Query(description="Last id of the page before.")]
AfterVersion = Annotated[int, Query(ge=0, lt=2**31, description="Last version of the page before.")]
AfterLink = Annotated[Text | None, Query(max_length=100, description="As the link to the next page has it.")]


def use_case(find: Callable[[UseCases], object]) -> Any:
    """A dependency: one of the server's use cases, as in `use_case(lambda cases: cases.plans)`."""

    async def get(request: Request) -> object:  # async: a plain function would cost a hop to a thread
        return find(request.app.state.use_cases)

    return Depends(get)


def caller_of(request: Request) -> CallerValue:
    """The caller that the middleware authenticated."""
    caller = request.scope.get("state", {}).get("caller")
    if not isinstance(caller, CallerValue):
        raise NotAuthenticated("this resource needs a key", field="Authorization")
    return caller


async def get_caller(request: Request) -> CallerValue:
    """As `caller_of`; async, because a plain function would cost a hop to a thread."""
    return caller_of(request)


def checked_idempotency_key(key: str | None) -> str | None:
    """The client's Idempotency-Key, if it sent one."""
    if key is not None and (not 1 <= len(key) <= MAX_IDEMPOTENCY_KEY or not key.isprintable()):
        raise InvalidParameter(
            "the Idempotency-Key is empty, too long or not printable",
            field="Idempotency-Key",
            limit=f"1 to {MAX_IDEMPOTENCY_KEY} printable characters",
            cure="send a UUID",
        )
    return key


async def get_idempotency_key(request: Request, header: IdempotencyKeyHeader = None) -> IdempotencyKey | None:
    """The client's Idempotency-Key with the hash of the request."""
    key = checked_idempotency_key(header)
    if key is None:
        return None
    digest = hashlib.sha256(f"{request.method} {request.url.path}\n".encode() + await request.body())
    return IdempotencyKey(key, digest.hexdigest(), caller_of(request).key_id)


async def get_version(if_match: IfMatch = None) -> int | None:
    """The version named by If-Match; None for `*`.

    Raises
    ------
    VersionRequired
        There is no If-Match.
    InvalidParameter
        It is not an ETag of ours.
    """
    header = (if_match or "").strip()
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


async def find_version(if_match: IfMatch = None) -> int | None:
    """As `get_version`, for clients that may leave If-Match out: they change any version."""
    return await get_version(if_match) if (if_match or "").strip() else None


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
Markers = Annotated[MarkersService, use_case(lambda cases: cases.markers)]
Idempotency = Annotated[IdempotencyKey | None, Depends(get_idempotency_key)]
Version = Annotated[int | None, Depends(get_version)]
SentVersion = Annotated[int | None, Depends(find_version)]
