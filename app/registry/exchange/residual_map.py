"""Residuals of an as-built survey on a map: an arrow a marker, long enough to be seen, with a scale for each."""

from __future__ import annotations

import math
from html import escape

import numpy as np
import numpy.typing as npt

from app.registry.exchange.compare import Comparison
from app.registry.exchange.place import PlacedSurvey

MAX_ARROWS = 1000
_SIDE_PX, _MARGIN_PX, _HEAD_PX, _FOOT_PX = 860.0, 46.0, 64.0, 64.0
_LEAST_PX = 180.0
_ARROW_PX = 46.0
"""Length of the arrow of the 90th percentile. [px]"""
_NAMED = 5
_INK, _FAINT, _WITHIN, _BEYOND = "#1c1f23", "#8a929b", "#2b6cb0", "#c53030"

Floats = npt.NDArray[np.float64]


def draw_residuals(survey: PlacedSurvey, comparison: Comparison, tolerance_m: float) -> str | None:
    """SVG of the residuals, north up; None without any. Of more than `MAX_ARROWS` the longest are drawn.

    Parameters
    ----------
    survey : PlacedSurvey
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
    least, span = base_m.min(axis=0), np.maximum(np.ptp(base_m, axis=0), 1e-6)
    scale = (_SIDE_PX - 2 * _MARGIN_PX) / max(float(span.max()), 1.0)
    plot = np.maximum(span * scale + 2 * _MARGIN_PX, _LEAST_PX)
    width, height = max(float(plot[0]), _SIDE_PX / 2), float(plot[1])
    offset = (np.array([width, height]) - span * scale) / 2
    at = (base_m - least) * scale + offset
    at[:, 1] = _HEAD_PX + height - at[:, 1]
    usual_m = max(float(np.quantile(length_m[rows], 0.9)), 1e-4)
    exaggeration = _ARROW_PX / usual_m  # [px/m]
    tip = at + np.column_stack([comparison.east_m[rows], -comparison.north_m[rows]]) * exaggeration
    beyond = length_m[rows] > tolerance_m
    total = _HEAD_PX + height + _FOOT_PX
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {total:.0f}" width="{width:.0f}" '
        f'height="{total:.0f}" font-family="sans-serif" font-size="12" fill="{_INK}">',
        f'<rect width="{width:.0f}" height="{total:.0f}" fill="#ffffff"/>',
        *_title(comparison, tolerance_m, len(rows)),
        f'<rect x="0.5" y="{_HEAD_PX}" width="{width - 1:.0f}" height="{height:.0f}" fill="none" stroke="#d5dae0"/>',
        *_arrows(at, tip, beyond),
        *_names(tip, at, rows, length_m[rows]),
        *_north(width - 26, _HEAD_PX + 16),
        *_bars(width, _HEAD_PX + height, scale, exaggeration),
        "</svg>",
    ]
    return "\n".join(parts)


def _title(comparison: Comparison, tolerance_m: float, drawn: int) -> list[str]:
    figures = comparison.document(tolerance_m)
    first = f"Residuals of {figures['matched']} markers, surveyed minus registered"
    if drawn < figures["matched"]:
        first += f"; the {drawn} longest"
    second = (
        f"median {_metres(figures['median_m'])}, RMSE {_metres(figures['rmse_m'])}, longest "
        f"{_metres(figures['max_m'])}; {figures['beyond_tolerance']} beyond {_metres(tolerance_m)} (red)"
    )
    return [
        f'<text x="16" y="26" font-size="15" font-weight="bold">{escape(first)}</text>',
        f'<text x="16" y="47">{escape(second)}</text>',
    ]


def _arrows(at: Floats, tip: Floats, beyond: npt.NDArray[np.bool_]) -> list[str]:
    drawn = []
    for (x, y), (u, v), is_beyond in zip(at.tolist(), tip.tolist(), beyond.tolist(), strict=True):
        colour = _BEYOND if is_beyond else _WITHIN
        drawn.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2" fill="{_FAINT}"/>')
        drawn.append(
            f'<path d="M{x:.1f} {y:.1f}L{u:.1f} {v:.1f}{_head(x, y, u, v)}" fill="none" stroke="{colour}" '
            'stroke-width="1.4"/>'
        )
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
        side = ("end", -6.0) if u < at[k, 0] else ("start", 6.0)
        text = f"row {rows[k] + 1}: {_metres(float(length_m[k]))}"
        place = f'x="{u + side[1]:.1f}" y="{v + 4:.1f}" text-anchor="{side[0]}" font-size="11"'
        drawn.append(f'<text {place} stroke="#ffffff" stroke-width="3" fill="#ffffff">{text}</text>')
        drawn.append(f"<text {place}>{text}</text>")
    return drawn


def _north(x: float, y: float) -> list[str]:
    return [
        f'<path d="M{x:.1f} {y:.1f}l7 24l-7 -6l-7 6z" fill="{_INK}"/>',
        f'<text x="{x:.1f}" y="{y + 38:.1f}" text-anchor="middle" font-weight="bold">N</text>',
    ]


def _bars(width: float, bottom: float, scale: float, exaggeration: float) -> list[str]:
    """A bar for the map, and one for the arrows, which are drawn longer than the map would have them."""
    map_m, arrow_m = _round(110 / scale), _round(110 / exaggeration)
    return [
        *_bar(16, bottom + 24, map_m * scale, f"map: {_metres(map_m)}"),
        *_bar(width / 2, bottom + 24, arrow_m * exaggeration, f"arrows: {_metres(arrow_m)}"),
        f'<text x="{width / 2:.0f}" y="{bottom + 54:.0f}" fill="{_FAINT}" font-size="11">arrows are '
        f"{exaggeration / scale:,.0f} times as long as on the map</text>",
    ]


def _bar(x: float, y: float, length: float, text: str) -> list[str]:
    return [
        f'<path d="M{x:.1f} {y - 5:.1f}v10M{x:.1f} {y:.1f}h{length:.1f}m0 -5v10" fill="none" stroke="{_INK}" '
        'stroke-width="1.4"/>',
        f'<text x="{x + length + 8:.1f}" y="{y + 4:.1f}">{text}</text>',
    ]


def _round(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above the value."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(max(step for step in (1, 2, 5) if step * power <= value) * power)


def _metres(value: float) -> str:
    if value >= 1000:
        return f"{value / 1000:g} km"
    if value >= 1:
        return f"{value:.3g} m"
    return f"{value * 1000:.3g} mm"
