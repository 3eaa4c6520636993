"""The demo's tables: plates, magnets, and CERPMs."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field

FIX_WITHIN_M = 0.5
"""Largest error of a position at a tag that counts as right. [m]"""
PAPER_IN_VIEW, PAPER_DECODED = 11, 4  # figure 10 at 30 km/h and 30 frames a second
_METRO: tuple[tuple[str, ...], ...] = (
    ("METRO, figure 13a", "", "48", "0.97 / 1.00"),
    ("METRO, figure 14b", "25 cm", "", "1.00 / 1.00"),
    ("METRO, figure 14b", "30 cm", "", "0.87 / 0.93"),
    ("METRO, figure 14", "35 cm", "", "0.47 / 0.67", "0.50"),
    ("METRO, parked cars", "", "48", "", "", "", "", "", "0.989 ± 0.019"),
    ("METRO, curvy road", "", "16", "", "", "", "", "", "0.965 ± 0.044"),
)
"""The paper's field trials: lying / upright magnets, tags, deviation ratio."""
_TRACE_HEAD = (
    "drive", "clearance", "km/h", "magnets", "tags", "matched", "wrong", "wrong way", "ratio", "along [cm]",
    "across [cm]", "dashed", "solid", "false",
)  # fmt: skip
PATH_WITHIN_M = 0.1
"""Largest RMS error of a path that counts as right. [m]"""
_LANE_HEAD = (
    "drive", "markers", "packets", "accepted", "refused", "left out", "path RMS [cm]", "worst [cm]", "coverage",
    "own track [cm]", "steering [cm]",
)  # fmt: skip
_HEAD = ("plate", "scheme", "digits", "in view", "decoded", "wrong", "matched", "position [cm]", "heading [deg]")


@dataclass(slots=True)
class Pass:
    """Result of one drive over a plate."""

    name: str
    scheme: str
    digits: str
    in_view: int = 0
    decoded: int = 0
    wrong: int = 0
    matched: int = 0
    # `position_errors_m`, `heading_errors_deg`: of the vehicle, horizontal, for each frame with a fix
    position_errors_m: list[float] = field(default_factory=list)
    heading_errors_deg: list[float] = field(default_factory=list)

    @property
    def is_good(self) -> bool:
        """Whether no digits were wrong, and decodes, matches and fixes are as many as the paper's or more."""
        enough = min(self.decoded, self.matched, len(self.position_errors_m)) >= PAPER_DECODED
        return enough and self.wrong == 0


@dataclass(slots=True)
class TraceResult:
    """Result of one drive over magnets."""

    name: str
    clearance_m: float
    speed_kmh: float
    wrong_way: bool
    # `tags`, `right`, `matched`, `wrong`, `flagged`: tags on the road, decoded correctly, matched with their own
    # marker, decoded as something else, reported as passed the wrong way
    tags: int
    # `passed`, `found`, `false`: magnets under the bar, those decoded with the right polarity and orientation, readings
    # without a magnet
    passed: int = 0
    found: int = 0
    false: int = 0
    right: int = 0
    matched: int = 0
    wrong: int = 0
    flagged: int = 0
    deviations: list[float] = field(default_factory=list)  # measured over true distance ratio
    # `along_m`, `across_m`: [m] errors of the vehicle's position at a tag
    along_m: list[float] = field(default_factory=list)
    across_m: list[float] = field(default_factory=list)
    departures: dict[str, tuple[int, int, int]] = field(default_factory=dict)

    @property
    def is_good(self) -> bool:
        """Whether all tags were decoded, matched and gave a position, and the reported direction was right."""
        near = sum(math.hypot(*off_m) < FIX_WITHIN_M for off_m in zip(self.along_m, self.across_m, strict=True))
        whole = self.right == self.matched == near == self.tags
        return whole and self.wrong == 0 and self.flagged == (self.tags if self.wrong_way else 0)


@dataclass(slots=True)
class LaneResult:
    """Result of one drive past CERPMs."""

    name: str
    markers: int
    # `packets`, `authentic`, `true_packets`: uploaded packets, accepted ones, and those that the markers themselves
    # sent in this drive
    packets: int
    authentic: int
    true_packets: int
    left_out: list[int]  # numbers of the markers that the path leaves out
    moved: int | None  # number of the marker that sends a wrong position
    # `path_rms_m`, `path_max_m`: [m] of the path from the lane's true centre line
    path_rms_m: float = math.nan
    path_max_m: float = math.nan
    coverage: float = 0.0  # share of the true centre line that has a path
    track_rms_m: float = math.nan  # [m] of the vehicle's own track from it
    steering_rms_m: float = math.nan  # [m] of a simulated drive along the path

    @property
    def is_good(self) -> bool:
        """Whether no forged packet was accepted, only the moved marker was left out, and the path follows the lane."""
        expected = [self.moved] if self.moved is not None else []
        return self.authentic <= self.true_packets and self.left_out == expected and self.path_rms_m < PATH_WITHIN_M


def draw_table(passes: Sequence[Pass]) -> str:
    """Table of passes, their sum per drive, and the paper's row beside them."""
    rows = [_row(p) for p in passes]
    count = len(passes)
    errors_m = [error for p in passes for error in p.position_errors_m]
    turns_deg = [error for p in passes for error in p.heading_errors_deg]
    mean = [
        f"{sum(getattr(p, name) for p in passes) / count:.1f}" for name in ("in_view", "decoded", "wrong", "matched")
    ]
    rows.append(("mean of a drive", "", "", *mean, _median(errors_m, 100, 1), _median(turns_deg, 1, 2)))
    rows.append(
        ("paper, figure 10", "position", "023792168411", f"{PAPER_IN_VIEW}", f"{PAPER_DECODED}", "-", "-", "-", "-")
    )
    return draw_rows(_HEAD, rows[:count], rows[count:], left=3)


def draw_trace_table(results: Sequence[TraceResult]) -> str:
    """Table of drives over magnets, with the paper's field trials below."""
    blank = ("",) * len(_TRACE_HEAD)
    return draw_rows(
        _TRACE_HEAD,
        [_trace_row(result) for result in results],
        [(row + blank)[: len(blank)] for row in _METRO],
        left=1,
    )


def draw_lane_table(results: Sequence[LaneResult]) -> str:
    """Table of drives past CERPMs."""
    rows = [
        (
            r.name,
            f"{r.markers}",
            f"{r.packets}",
            f"{r.authentic}",
            f"{r.packets - r.authentic}",
            ", ".join(str(number) for number in r.left_out) or "-",
            f"{100 * r.path_rms_m:.1f}",
            f"{100 * r.path_max_m:.1f}",
            f"{100 * r.coverage:.1f} %",
            f"{100 * r.track_rms_m:.1f}",
            f"{100 * r.steering_rms_m:.1f}",
        )
        for r in results
    ]
    return draw_rows(_LANE_HEAD, rows, left=1)


def _trace_row(r: TraceResult) -> tuple[str, ...]:
    ratio = f"{statistics.mean(r.deviations):.3f} ± {statistics.stdev(r.deviations):.3f}" if r.deviations[1:] else "-"
    departures = (
        (f"{right} of {actual}" if actual else "-") + (f" + {false} false" if false else "")
        for right, actual, false in r.departures.values()
    )
    return (
        r.name,
        f"{100 * r.clearance_m:.0f} cm",
        f"{r.speed_kmh:.0f}",
        f"{r.found} of {r.passed}",
        f"{r.right} of {r.tags}",
        f"{r.matched}",
        f"{r.wrong}",
        f"{r.flagged}",
        ratio,
        _rms(r.along_m),
        _rms(r.across_m),
        *departures,
        f"{r.false}",
    )


def _rms(errors_m: Sequence[float]) -> str:
    return f"{100 * math.sqrt(statistics.fmean(e * e for e in errors_m)):.1f}" if errors_m else "-"


def draw_rows(
    head: Sequence[str], rows: Sequence[Sequence[str]], below: Sequence[Sequence[str]] = (), *, left: int
) -> str:
    """Rows, and below a rule those to compare them with; the first columns are texts, the others numbers."""
    widths = [max(len(row[k]) for row in (head, *rows, *below)) for k in range(len(head))]
    rule = "  ".join("-" * width for width in widths)
    lines = [_line(head, widths, left), rule, *(_line(row, widths, left) for row in rows)]
    compared = [rule, *(_line(row, widths, left) for row in below)] if below else []
    return "\n".join([*lines, *compared])


def _row(p: Pass) -> tuple[str, ...]:
    counts = (f"{p.in_view}", f"{p.decoded}", f"{p.wrong}", f"{p.matched}")
    return (
        p.name,
        p.scheme,
        p.digits,
        *counts,
        _median(p.position_errors_m, 100, 1),
        _median(p.heading_errors_deg, 1, 2),
    )


def _median(values: Sequence[float], scale: float, places: int) -> str:
    finite = [value for value in values if math.isfinite(value)]
    return f"{scale * statistics.median(finite):.{places}f}" if finite else "-"


def _line(cells: Sequence[str], widths: Sequence[int], left: int) -> str:
    text = [cell.ljust(width) for cell, width in zip(cells[:left], widths[:left], strict=True)]
    numbers = [cell.rjust(width) for cell, width in zip(cells[left:], widths[left:], strict=True)]
    return "  ".join(text + numbers).rstrip()
