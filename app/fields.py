"""Types of the fields of requests: texts and numbers are not converted into each other, and no number is infinite."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field


def _plain_text(text: str) -> str:
    if "\x00" in text:
        raise ValueError("a text holds no NUL")
    return text


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Whole = Annotated[int, Field(strict=True)]
Flag = Annotated[bool, Field(strict=True)]
Text = Annotated[str, AfterValidator(_plain_text)]
