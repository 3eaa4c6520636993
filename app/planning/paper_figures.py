"""Tables of figures that the papers give."""

from __future__ import annotations

import csv
from importlib import resources


def read_figures(name: str) -> list[dict[str, str]]:
    """Lines of a table in `data`, by column."""
    text = (resources.files("app.planning") / "data" / name).read_text("utf-8")
    return list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
