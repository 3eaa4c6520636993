"""Report about reading a trace: what was read, replaced and left out."""

from __future__ import annotations

from dataclasses import dataclass, field

from app.formats.traces.declaration import TraceFormat
from app.sensors.magnetometer_bar import MagnetTrace

MAX_LISTED = 200
"""Gaps and notes beyond this are only counted. Source: chosen by hand, bounds the answer."""


@dataclass(frozen=True, slots=True)
class TraceGap:
    """A stretch without usable samples.

    Attributes
    ----------
    part : str
        File.
    sample : int
        Index in the trace of the first sample after it.
    t_s : float
        Time of the sample before it. [s]
    lost_s : float
        Time lost; for a stream a lower bound, as bytes that were cut out cannot be counted. [s]
    skipped_bytes : int
        Bytes of the file that belong to no sample. [byte]
    """

    part: str
    sample: int
    t_s: float
    lost_s: float
    skipped_bytes: int = 0


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Values or rows of a file that are not in the trace.

    Attributes
    ----------
    part : str
        File.
    what : str
        Kind of loss, e.g. `rows-malformed`.
    count : int
    reason : str
        For people, with the first place.
    """

    part: str
    what: str
    count: int
    reason: str


@dataclass(slots=True)
class TraceReport:
    """About reading a trace.

    Attributes
    ----------
    formats : dict of str to TraceFormat
        Detected or declared format of each file.
    samples : int
    rate_hz : float
        Median. [Hz]
    duration_s : float
        From the first sample to the last. [s]
    gaps : list of TraceGap
        The first ones.
    gap_count : int
    left_out : list of LeftOut
    clock_offsets_s : dict of str to float
        Added to the times of a file to get the trace's. [s]
    speed_coverage, heading_coverage : float
        Share of the trace with a value within a second, 0 to 1.
    warnings : list of str
    """

    formats: dict[str, TraceFormat] = field(default_factory=dict)
    samples: int = 0
    rate_hz: float = 0.0
    duration_s: float = 0.0
    gaps: list[TraceGap] = field(default_factory=list)
    gap_count: int = 0
    left_out: list[LeftOut] = field(default_factory=list)
    clock_offsets_s: dict[str, float] = field(default_factory=dict)
    speed_coverage: float = 0.0
    heading_coverage: float = 0.0
    warnings: list[str] = field(default_factory=list)

    def add_gap(self, gap: TraceGap) -> None:
        """Count a gap, and list it if there is room."""
        self.gap_count += 1
        if len(self.gaps) < MAX_LISTED:
            self.gaps.append(gap)

    def leave_out(self, part: str, what: str, count: int, reason: str) -> None:
        """Note a loss; the same kind in the same file adds up under its first reason."""
        if not count:
            return
        for i, known in enumerate(self.left_out):
            if (known.part, known.what) == (part, what):
                self.left_out[i] = LeftOut(part, what, known.count + count, known.reason)
                return
        self.left_out.append(LeftOut(part, what, count, reason))

    def warn(self, text: str) -> None:
        """Add a warning for the uploader."""
        if text not in self.warnings and len(self.warnings) < MAX_LISTED:
            self.warnings.append(text)


@dataclass(frozen=True, slots=True, eq=False)
class TraceFile:
    """A trace and the report about reading it."""

    trace: MagnetTrace
    report: TraceReport
