"""What every part of the benchmark prints: a section of tables with its goals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Section:
    """One section of the output."""

    name: str  # after ``### ``, as `benchmarks.readme` looks for it
    text: str  # Markdown
    met: bool  # whether its goals are met

    def __str__(self) -> str:
        return f"### {self.name}\n\n{self.text}\n\nGoals: {'kept' if self.met else 'missed'}.\n"


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Markdown table; the first column is text, the others are right-aligned."""
    lines = ["| " + " | ".join(head) + " |", "|" + "|".join(["---"] + ["--:"] * (len(head) - 1)) + "|"]
    return "\n".join(lines + ["| " + " | ".join(str(cell) for cell in row) + " |" for row in rows])
