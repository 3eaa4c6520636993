"""Errors as parts of results: why a job failed, or why a file of an archive cannot be used."""

from __future__ import annotations

from typing import NotRequired, cast

from typing_extensions import TypedDict

from app.errors import WaymarkError


class ErrorCause(TypedDict):
    """The input at fault, the limit that it broke and what to do, as far as they are known."""

    field: NotRequired[str]
    limit: NotRequired[str]
    cure: NotRequired[str]


class ErrorDocument(ErrorCause):
    """An error: its kind, and the input at fault."""

    kind: str
    detail: str


def error_document(error: WaymarkError) -> ErrorDocument:
    """An error as it is stored in a job or in a result."""
    return {
        "kind": type(error).__name__,
        "detail": error.message,
        **error_cause(error.field, error.limit, error.cure),
    }


def error_cause(field: str | None, limit: str | None, cure: str | None) -> ErrorCause:
    """What is known of an error's cause."""
    known = {"field": field, "limit": limit, "cure": cure}
    return cast("ErrorCause", {name: text for name, text in known.items() if text is not None})
