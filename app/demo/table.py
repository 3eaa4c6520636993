"""The demo's one table."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field

PAPER_IN_VIEW, PAPER_DECODED = 11, 4  # figure 10 at 30 km/h and 30 frames a second
_HEAD = ("plate", "scheme", "digits", "in view", "decoded", "wrong", "matched", "position [cm]", "heading [deg]")


@dataclass(slots=True)
class Pass:
    """What came of one drive over a plate.

    Attributes
    ----------
    position_errors_m, heading_errors_deg : list of float
        Of the vehicle, horizontal, for each frame with a fix.
    """

    name: str
    scheme: str
    digits: str
    in_view: int = 0
    decoded: int = 0
    wrong: int = 0
    matched: int = 0
    position_errors_m: list[float] = field(default_factory=list)
    heading_errors_deg: list[float] = field(default_factory=list)

    @property
    def is_good(self) -> bool:
        """Nothing was read wrong, and the plate was read, matched and gave a fix at least as often as in the paper."""
        enough = min(self.decoded, self.matched, len(self.position_errors_m)) >= PAPER_DECODED
        return enough and self.wrong == 0


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
    widths = [max(len(row[k]) for row in (_HEAD, *rows)) for k in range(len(_HEAD))]
    lines = [_line(_HEAD, widths), "  ".join("-" * width for width in widths)]
    lines += [_line(row, widths) for row in rows[:count]]
    lines += ["  ".join("-" * width for width in widths)]
    lines += [_line(row, widths) for row in rows[count:]]
    return "\n".join(lines)


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


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    text = [cell.ljust(width) for cell, width in zip(cells[:3], widths[:3], strict=True)]
    numbers = [cell.rjust(width) for cell, width in zip(cells[3:], widths[3:], strict=True)]
    return "  ".join(text + numbers).rstrip()
