"""Declarations that commands get as JSON: the same schemas as over HTTP."""

from __future__ import annotations

from typing import TypeVar

from pydantic import BaseModel, ValidationError

from app.errors import InvalidParameter

Model = TypeVar("Model", bound=BaseModel)


def read_declaration(schema: type[Model], declared: str, guide: str) -> Model:
    """A declaration checked by its schema.

    Parameters
    ----------
    schema : type of BaseModel
    declared : str
        JSON.
    guide : str
        Document that explains the declaration.

    Raises
    ------
    InvalidParameter
        It is not JSON, or not as the schema has it.
    """
    try:
        return schema.model_validate_json(declared)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise InvalidParameter(f"--declaration {place}: {first['msg']}", cure=f"see {guide}") from error
