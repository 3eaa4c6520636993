"""Errors as parts of results: why a job failed, or why a file of an archive cannot be used."""

from __future__ import annotations

from typing import NotRequired, cast

from typing_extensions import TypedDict

from app.errors import WaymarkError

_MAX_CHARACTER_BYTES = 6  # of JSON; source: RFC 8259 section 7, \u0001


def cut_text(text: str, max_bytes: int) -> str:
    """A text that takes no more than so many bytes of JSON: what a client sent may be in it."""
    if len(text) * _MAX_CHARACTER_BYTES <= max_bytes:
        return text
    printable = "".join(letter if letter.isprintable() else "?" for letter in text[: max_bytes + 1])
    sent = printable.encode("utf-8", "replace")
    return printable if len(sent) <= max_bytes else f"{sent[: max_bytes - 3].decode('utf-8', 'ignore')}…"


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
