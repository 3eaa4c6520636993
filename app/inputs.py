"""What comes in: the base and the types of its models, and how a document that is not valid is refused."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Annotated, Self, TypeVar

from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, Field, ValidationError

from app.errors import InvalidParameter, WaymarkError

ModelT = TypeVar("ModelT", bound=BaseModel)


INPUT = ConfigDict(extra="forbid")
"""Of every part of a request: members that it does not know are refused."""


class StrictModel(BaseModel):
    """Base of every part of a request."""

    model_config = INPUT


class Declaration(StrictModel):
    """Base of what is declared of a file or a vehicle: sent by a client, stored as it is, and read by the core."""

    model_config = ConfigDict(frozen=True)

    @classmethod
    def of(cls, declared: Declaration | None) -> Self:
        """This model with the members that are declared in one that it extends."""
        return cls(**declared.model_dump(exclude_unset=True)) if declared is not None else cls()


def _plain_text(text: str) -> str:
    if "\x00" in text:
        raise ValueError("a text holds no NUL")
    return text


MIN_YEAR, MAX_YEAR = 1900, 2200
"""Years of times in requests, so that no offset and no length of a recording leads out of the calendar of Python and
PostgreSQL."""


def _check_year(time: datetime) -> datetime:
    if not MIN_YEAR <= time.year < MAX_YEAR:
        raise InvalidParameter(
            "the time is too far away",
            limit=f"years {MIN_YEAR} to {MAX_YEAR - 1}",
            cure="send an RFC 3339 time with its offset, e.g. 2026-03-04T05:06:07Z",
        )
    return time


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Whole = Annotated[int, Field(strict=True)]
Flag = Annotated[bool, Field(strict=True)]
Text = Annotated[str, AfterValidator(_plain_text)]
Identifier = Annotated[str, Field(pattern=r"^[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}$")]
Name = Annotated[Text, Field(min_length=1, max_length=120)]
"""Name of a column, a file, a signal."""
Time = Annotated[AwareDatetime, AfterValidator(_check_year)]
"""A time with its zone in a query or a body."""

_CONSTRAINTS = {
    "ge": "at least {}",
    "gt": "more than {}",
    "le": "at most {}",
    "lt": "less than {}",
    "min_length": "at least {} long",
    "max_length": "at most {} long",
    "pattern": "pattern {}",
    "expected": "one of {}",
}


def parse_input(model: type[ModelT], document: object, *where: str) -> ModelT:
    """A model from a document that is at the path `where` of a request.

    Raises
    ------
    InvalidParameter
        It is not valid; `parts` has all faults if there are several.
    """
    try:
        return model.model_validate(document)
    except ValidationError as error:
        found = [input_error(item, [*where, *map(str, item["loc"])]) for item in error.errors(include_url=False)]
        first = found[0]
        first.parts = tuple(found[1:])
        raise first from None


_OBJECTS = {"dataclass_type", "dict_type", "model_attributes_type", "model_type"}
"""Types of pydantic's errors, whose messages name Python's types, for what is no JSON object."""


def input_error(item: Mapping[str, object], path: list[str], whole: str = "body") -> InvalidParameter:
    """The fault that an error of pydantic names, at a path of the input; an empty path is that of the `whole`."""
    at = ".".join(path) or whole
    context = item.get("ctx")
    context = context if isinstance(context, Mapping) else {}
    limits = [text.format(context[name]) for name, text in _CONSTRAINTS.items() if name in context]
    cause = context.get("error")
    if isinstance(cause, WaymarkError):
        field = _joined(path, cause.field) or at
        return InvalidParameter(cause.message, field=field, limit=cause.limit, cure=cause.cure or _cure(field))
    near = f"did you mean {context['near']}? If not, " if "near" in context else ""
    cures = {"missing": f"send {at}", "extra_forbidden": f"{near}leave {at} out"}
    message = "Input should be an object" if item["type"] in _OBJECTS else str(item["msg"])
    return InvalidParameter(
        f"{at}: {message}",
        field=at,
        limit=", ".join(limits) or message,
        cure=cures.get(str(item["type"]), _cure(at)),
    )


def _cure(field: str) -> str:
    return f"correct {field}; /docs describes its values"


def _joined(path: list[str], field: str | None) -> str:
    """The field that a check of the model at a path names: below the path, which it may repeat the end of."""
    inner = field.split(".") if field else []
    if path[: len(inner)] == inner:
        return ".".join(path)
    shared = next((k for k in range(min(len(path), len(inner)), 0, -1) if path[-k:] == inner[:k]), 0)
    return ".".join([*path, *inner[shared:]])
