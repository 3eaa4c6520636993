"""Documents made from values whose attributes have the same names, documents of errors, and kinds of versions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from enum import StrEnum
from typing import TYPE_CHECKING, NotRequired, TypeVar, cast

import numpy as np
import numpy.typing as npt
from typing_extensions import TypedDict

from app.errors import InvalidParameter, WaymarkError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

DocumentT = TypeVar("DocumentT")
InstanceT = TypeVar("InstanceT", bound="DataclassInstance")


def document_of(document: type[DocumentT], source: object, **others: object) -> DocumentT:
    """A document with the attributes of a value that its members are named after, and with other members.

    Parameters
    ----------
    document : type
        A TypedDict.
    source : object
        A row or another value; it has an attribute for each member that is not in `others`.
    **others
        Members that differ from the source's, or that it does not have.
    """
    names = document.__annotations__
    return cast(DocumentT, {name: others[name] if name in others else getattr(source, name) for name in names})


def rounded(source: InstanceT, places: Mapping[str, int]) -> InstanceT:
    """A dataclass with its numbers rounded to so many places, by the names of their fields: long lists take less."""
    values: dict[str, object] = {}
    for name in source.__dataclass_fields__.keys() & places.keys():
        value = getattr(source, name)
        if isinstance(value, tuple):
            values[name] = tuple(round(one, places[name]) for one in value)
        elif value is not None:
            values[name] = round(value, places[name])
    return replace(source, **values)


def listed(values: npt.ArrayLike, places: int) -> list[float | None]:
    """Numbers of a column, rounded; None for those that are not finite."""
    column: list[float] = (np.round(np.asarray(values, float), places) + 0.0).tolist()  # no negative zero
    return [value if math.isfinite(value) else None for value in column]


# === Errors as parts of results: why a job failed, or why a file of an archive cannot be used.


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


# === What kind of version a change of a marker makes: as somebody says, or by what changes.


_PLANNED, _BUILT = "planned", "built"


class VersionKind(StrEnum):
    """Why a marker has a further version (docs/history.md)."""

    AS_PLANNED = "as-planned"
    AS_BUILT = "as-built"
    RESURVEY = "resurvey"
    CORRECTION = "correction"
    CHANGE = "change"


def kind_of_new(status: str, said: str | None = None) -> VersionKind:
    """Kind of a marker's first version: as planned, or as built where it is said to be on the road.

    Raises
    ------
    InvalidParameter
        It is not of the kind that was asked for.
    """
    fitting = [VersionKind.AS_PLANNED] if status == _PLANNED else [VersionKind.AS_BUILT, VersionKind.RESURVEY]
    if said is not None and said not in fitting:
        raise _refused(said, f"the first version of a marker that is {status}", *fitting)
    return VersionKind(said) if said is not None else fitting[0]


def kind_of_change(old_status: str, new_status: str, *, moved: bool, said: str | None = None) -> VersionKind:
    """Kind of a further version.

    Parameters
    ----------
    moved : bool
        The change gives a position.
    said : str, optional
        Kind that was asked for.

    Raises
    ------
    InvalidParameter
        The change is not of the kind that was asked for.
    """
    if said == VersionKind.CORRECTION:
        return VersionKind.CORRECTION
    if new_status == _PLANNED:
        fitting = [VersionKind.AS_PLANNED]
    elif not moved:
        fitting = [VersionKind.CHANGE]
    elif old_status in (_PLANNED, _BUILT):
        fitting = [VersionKind.AS_BUILT, VersionKind.RESURVEY]
    else:
        fitting = [VersionKind.RESURVEY, VersionKind.AS_BUILT]
    if said is not None and said not in fitting:
        what = f"a change {'with' if moved else 'without'} a position of a marker that is then {new_status}"
        raise _refused(said, what, *fitting, VersionKind.CORRECTION)
    return VersionKind(said) if said is not None else fitting[0]


def _refused(said: str, what: str, *fitting: VersionKind) -> InvalidParameter:
    return InvalidParameter(
        f"{what} is no version of the kind {said}",
        field="kind",
        limit=" or ".join(fitting),
        cure="leave the kind out, or send the status and the position that belong to it",
    )
