"""One row of the table of faults."""

from __future__ import annotations

from typing import NamedTuple


class FaultRow(NamedTuple):
    """What was tried, what came of it, and what was required."""

    test: str
    tried: str
    survived: str
    goal: str
    met: bool | None  # None: it could not be tried


_WORDS = {True: "yes", False: "**no**", None: "not tried"}


def print_rows(rows: list[FaultRow], *, short: bool) -> None:
    """Print the rows as a table."""
    print(f"### faults{' (short mode)' if short else ''}\n")
    print("| test | tried | survived | goal | |\n|---|---|---|---|---|")
    for row in rows:
        print(f"| {row.test} | {row.tried} | {row.survived} | {row.goal} | {_WORDS[row.met]} |")
    print()
