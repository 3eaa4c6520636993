"""Valid files of a format's grammar with random but known content: what is read must be what was written.

Each writer follows the format's own description, not this project's readers. A refusal counts as refused, because a
vehicle's operator can act on it; a value that differs without one is a failure.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from app.errors import WaymarkError

Rng = np.random.Generator
Check = Callable[[], str]
"""Reads a file and compares its content: the difference, empty for none."""
Grammar = Callable[[Rng], tuple[str | bytes, Check]]
"""Writes a random file, and gives what compares its content."""


@dataclass(slots=True)
class Compared:
    """What came of the files of one grammar."""

    tried: int = 0
    refused: int = 0
    failures: list[str] = field(default_factory=list)


def compare(name: str, files: int, seed: int = 1) -> Compared:
    """Write and read files of a grammar; the first failures with their seeds and files."""
    grammar, found = list_grammars()[name], Compared()
    for number in range(files):
        rng = np.random.default_rng([seed, number])
        found.tried += 1
        written: str | bytes = ""
        try:
            written, check = grammar(rng)
            problem = check()
        except WaymarkError as error:
            found.refused += 1
            problem = f"a valid file was refused: {error}"
        if problem and len(found.failures) < 5:
            shown = written if isinstance(written, str) else f"{len(written)} bytes: {written[:200]!r}"
            found.failures.append(f"{name}, seed {seed}/{number}: {problem}\n{shown[:1500]}")
    return found


def list_grammars() -> dict[str, Grammar]:
    """All of them by name."""
    from benchmarks.fuzz.grammar_drives import DRIVE_GRAMMARS
    from benchmarks.fuzz.grammar_logs import LOG_GRAMMARS
    from benchmarks.fuzz.grammar_packets import PACKET_GRAMMARS
    from benchmarks.fuzz.grammar_roads import ROAD_GRAMMARS
    from benchmarks.fuzz.grammar_surveys import SURVEY_GRAMMARS
    from benchmarks.fuzz.grammar_traces import TRACE_GRAMMARS
    from benchmarks.fuzz.grammar_tracks import TRACK_GRAMMARS
    from benchmarks.fuzz.grammar_videos import VIDEO_GRAMMARS

    of_logs = LOG_GRAMMARS | PACKET_GRAMMARS | TRACK_GRAMMARS | TRACE_GRAMMARS
    return of_logs | DRIVE_GRAMMARS | VIDEO_GRAMMARS | ROAD_GRAMMARS | SURVEY_GRAMMARS
