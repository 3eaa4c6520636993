"""Residuals of an as-built survey on a map: an arrow a marker, long enough to be seen, with a scale for each."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from app.plots.axes import INK, Panel, circle, heading, nice_step, outlined, picture, shape, stroke, text
from app.surveys.comparison import Comparison
from app.surveys.georeference import GeoreferencedSurvey

MAX_ARROWS = 1000
"""Of more residuals the longest are drawn. Chosen by hand."""
_SIDE_PX, _MARGIN_PX, _HEAD_PX, _FOOT_PX = 860.0, 46.0, 64.0, 64.0
_MIN_PX = 180.0  # [px] shortest side of the map
_ARROW_PX = 46.0
"""Length of the arrow of the 90th percentile. [px]"""
_NAMED = 5  # longest residuals that are labelled
_FAINT, _WITHIN, _BEYOND = "#8a929b", "#2b6cb0", "#c53030"

Floats = npt.NDArray[np.float64]


def draw_residuals(survey: GeoreferencedSurvey, comparison: Comparison, tolerance_m: float) -> str | None:
    """SVG of the residuals, north up; None without any. Of more than `MAX_ARROWS` the longest are drawn.

    Parameters
    ----------
    survey : GeoreferencedSurvey
    comparison : Comparison
    tolerance_m : float
        Longer ones are red. [m]
    """
    length_m = comparison.horizontal_m
    rows = np.flatnonzero(np.isfinite(length_m))
    if not len(rows):
        return None
    rows = np.sort(rows[np.argsort(-length_m[rows], kind="stable")[:MAX_ARROWS]])
    east, north = survey.east_m[rows], survey.north_m[rows]
    # where the marker was registered: the arrow leads from there to where it was found
    base_m = np.column_stack([east - comparison.east_m[rows], north - comparison.north_m[rows]])
    corner, span = base_m.min(axis=0), np.maximum(np.ptp(base_m, axis=0), 1e-6)
    scale = (_SIDE_PX - 2 * _MARGIN_PX) / max(float(span.max()), 1.0)
    plot = np.maximum(span * scale + 2 * _MARGIN_PX, _MIN_PX)
    width, height = max(float(plot[0]), _SIDE_PX / 2), float(plot[1])
    offset = (np.array([width, height]) - span * scale) / 2
    at = (base_m - corner) * scale + offset
    at[:, 1] = _HEAD_PX + height - at[:, 1]
    usual_m = max(float(np.quantile(length_m[rows], 0.9)), 1e-4)
    exaggeration = _ARROW_PX / usual_m  # [px/m]
    tip = at + np.column_stack([comparison.east_m[rows], -comparison.north_m[rows]]) * exaggeration
    beyond = length_m[rows] > tolerance_m
    total = _HEAD_PX + height + _FOOT_PX
    panel = Panel(0.5, width - 0.5, _HEAD_PX, _HEAD_PX + height)
    parts = [
        *_title(comparison, tolerance_m, len(rows)),
        panel.frame(),
        *_arrows(at, tip, beyond),
        *_names(tip, at, rows, length_m[rows]),
        *_north(width - 26, _HEAD_PX + 16),
        *_bars(width, panel.bottom, scale, exaggeration),
    ]
    return picture(width, total, parts, INK)


def _title(comparison: Comparison, tolerance_m: float, drawn: int) -> list[str]:
    figures = comparison.document(tolerance_m)
    first = f"Residuals of {figures['matched']} markers, surveyed minus registered"
    if drawn < figures["matched"]:
        first += f"; the {drawn} longest"
    second = (
        f"median {_metres(figures['median_m'])}, RMSE {_metres(figures['rmse_m'])}, longest "
        f"{_metres(figures['max_m'])}; {figures['beyond_tolerance']} beyond {_metres(tolerance_m)} (red)"
    )
    return [heading(16, 26, first), text(16, 47, second)]


def _arrows(at: Floats, tip: Floats, beyond: npt.NDArray[np.bool_]) -> list[str]:
    drawn = []
    for (x, y), (u, v), is_beyond in zip(at.tolist(), tip.tolist(), beyond.tolist(), strict=True):
        colour = _BEYOND if is_beyond else _WITHIN
        drawn.append(circle(x, y, 2, _FAINT))
        drawn.append(stroke(f"M{x:.1f} {y:.1f}L{u:.1f} {v:.1f}{_head(x, y, u, v)}", colour, 1.4))
    return drawn


def _head(x: float, y: float, u: float, v: float) -> str:
    """The two strokes of an arrow's head, smaller on a short arrow."""
    length = math.hypot(u - x, v - y)
    size = min(6.0, 0.5 * length)
    turn = math.atan2(v - y, u - x)
    ends = [(u - size * math.cos(turn + a), v - size * math.sin(turn + a)) for a in (0.45, -0.45)]
    return "".join(f"M{u:.1f} {v:.1f}L{p:.1f} {q:.1f}" for p, q in ends)


def _names(tip: Floats, at: Floats, rows: npt.NDArray[np.intp], length_m: Floats) -> list[str]:
    """Row and residual of the longest ones, beside their arrows' ends."""
    drawn: list[str] = []
    taken: list[tuple[float, float]] = []
    for k in np.argsort(-length_m, kind="stable")[:_NAMED].tolist():
        u, v = tip[k].tolist()
        if any(abs(u - x) < 110 and abs(v - y) < 14 for x, y in taken):
            continue
        taken.append((u, v))
        anchor, gap = ("end", -6.0) if u < at[k, 0] else ("start", 6.0)
        drawn.append(outlined(u + gap, v + 4, f"row {rows[k] + 1}: {_metres(float(length_m[k]))}", INK, anchor))
    return drawn


def _north(x: float, y: float) -> list[str]:
    return [
        shape(f"M{x:.1f} {y:.1f}l7 24l-7 -6l-7 6z", INK),
        text(x, y + 38, "N", anchor="middle", bold=True),
    ]


def _bars(width: float, bottom: float, scale: float, exaggeration: float) -> list[str]:
    """A bar for the map, and one for the arrows, which are drawn longer than the map would have them."""
    map_m, arrow_m = nice_step(110 / scale), nice_step(110 / exaggeration)
    times = f"arrows are {exaggeration / scale:,.0f} times as long as on the map"
    return [
        *_bar(16, bottom + 24, map_m * scale, f"map: {_metres(map_m)}"),
        *_bar(width / 2, bottom + 24, arrow_m * exaggeration, f"arrows: {_metres(arrow_m)}"),
        text(width / 2, bottom + 54, times, colour=_FAINT, size=11),
    ]


def _bar(x: float, y: float, length: float, content: str) -> list[str]:
    return [
        stroke(f"M{x:.1f} {y - 5:.1f}v10M{x:.1f} {y:.1f}h{length:.1f}m0 -5v10", INK, 1.4),
        text(x + length + 8, y + 4, content),
    ]


def _metres(value: float) -> str:
    if value >= 1000:
        return f"{value / 1000:g} km"
    if value >= 1:
        return f"{value:.3g} m"
    return f"{value * 1000:.3g} mm"
