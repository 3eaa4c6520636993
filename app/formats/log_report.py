"""The report about reading an uploaded log: entries, entries left out, warnings."""

from __future__ import annotations

from dataclasses import dataclass, field

MAX_LISTED = 200
"""Entries and warnings beyond this number are only counted. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class LeftOutEntry:
    """An entry that is not in the result.

    Attributes
    ----------
    entry : int
        Which row, line or event it is, from 0.
    reason : str
    """

    entry: int
    reason: str


@dataclass(slots=True)
class LogReport:
    """About reading a log.

    Attributes
    ----------
    format : str
        Name of the detected format.
    entries : int
        Rows, lines or events in it.
    left_out : list of LeftOutEntry
        The first ones.
    left_out_count : int
    reasons : dict of str to int
        Entries left out, by kind.
    warnings : list of str
    """

    format: str = ""
    entries: int = 0
    left_out: list[LeftOutEntry] = field(default_factory=list)
    left_out_count: int = 0
    reasons: dict[str, int] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def leave_out(self, entry: int, kind: str, reason: str) -> None:
        """Count an entry, and list it if there is room."""
        self.left_out_count += 1
        self.reasons[kind] = self.reasons.get(kind, 0) + 1
        if len(self.left_out) < MAX_LISTED:
            self.left_out.append(LeftOutEntry(entry, reason))

    def warn(self, text: str) -> None:
        """Add a warning for the uploader, once."""
        if text not in self.warnings and len(self.warnings) < MAX_LISTED:
            self.warnings.append(text)
