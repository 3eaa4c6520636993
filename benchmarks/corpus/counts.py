"""What was read in a group of recordings, in one way of reading it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

RECORDINGS = Path(__file__).parent / "recordings"
TRUTH = "truth.json"


@dataclass(frozen=True, slots=True)
class Count:
    """Of one way of reading a group."""

    possible: int  # what there is to be read
    read: int
    wrong: tuple[str, ...] = ()  # sure readings that are not true, with the file


Counts = Mapping[str, Count]
Reader = Callable[[Path, Sequence[Any]], Counts]
"""From a group's folder and its truth to the counts of each way of reading it."""


def read_truth(folder: Path) -> list[Any]:
    """What is true of the recordings of a group, in the order of their names."""
    found: list[Any] = json.loads((folder / TRUTH).read_text())
    return found


def write_truth(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """One line a recording, so that a change of one is one line of a diff."""
    lines = [json.dumps(row, separators=(",", ":")) for row in rows]
    (folder / TRUTH).write_text("[\n" + ",\n".join(lines) + "\n]\n")


class Tally:
    """Counts that grow from recording to recording."""

    def __init__(self) -> None:
        self._ways: dict[str, list[Any]] = {}

    def add(self, way: str, possible: int, read: int, wrong: Sequence[str] = ()) -> None:
        """Add what one recording gave."""
        have = self._ways.setdefault(way, [0, 0, ()])
        self._ways[way] = [have[0] + possible, have[1] + read, (*have[2], *wrong)]

    @property
    def counts(self) -> Counts:
        """Of all recordings."""
        return {way: Count(*have) for way, have in self._ways.items()}
