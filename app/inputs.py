"""Types of the fields that inputs have, and how strictly inputs are read."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field


def _plain_text(text: str) -> str:
    if "\x00" in text:
        raise ValueError("a text holds no NUL")
    return text


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Whole = Annotated[int, Field(strict=True)]
Flag = Annotated[bool, Field(strict=True)]
Text = Annotated[str, AfterValidator(_plain_text)]
Identifier = Annotated[str, Field(pattern=r"^[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}$")]

INPUT = ConfigDict(extra="forbid", json_schema_serialization_defaults_required=True)
"""Of every part of a request: members that it does not know are refused. A response has all members."""


class StrictModel(BaseModel):
    """Base of the parts of a request."""

    model_config = INPUT
