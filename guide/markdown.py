"""Pieces of Markdown that generated pages are made of."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from typing import Any


def code(value: object) -> str:
    """A value as code in a line."""
    text = str(value)
    fence = "``" if "`" in text else "`"
    pad = " " if "`" in text else ""
    return f"{fence}{pad}{text}{pad}{fence}"


def cell(text: str) -> str:
    """Text that stands in a cell of a table: one line, without the separator of cells."""
    return re.sub(r"\s+", " ", text).strip().replace("|", "\\|")


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table, or nothing if there are no rows."""
    lines = [f"| {' | '.join(cell(text) for text in row)} |" for row in rows]
    if not lines:
        return ""
    return "\n".join([f"| {' | '.join(head)} |", "|" + "---|" * len(head), *lines]) + "\n\n"


def json_block(value: Any) -> str:
    """An example."""
    return f"```json\n{json.dumps(value, indent=2, ensure_ascii=False)}\n```\n\n"


def menu(names: Iterable[str]) -> str:
    """The pages below a page, for the theme's navigation."""
    return "\n".join(["```{toctree}", ":hidden:", "", *names, "```", ""])
