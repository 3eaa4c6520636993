"""Pictures as SVG: a drive's track, the trade-off of an optimised plan, and residuals of a survey on a map."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from app.geodesy.frames import metres_per_radian
from app.planning.optimise import TradeOffPoint, pareto_points
from app.plots.axes import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    RED,
    Panel,
    Scale,
    circle,
    cross,
    heading,
    nice_step,
    outlined,
    picture,
    polylines,
    shape,
    spans,
    stroke,
    text,
    ticks,
)
from app.surveys.comparison import Comparison
from app.surveys.georeference import GeoreferencedSurvey
from app.tracks.types import Track
from app.values import Floats

_WIDTH, _HEIGHT = 1200, 760
_MAP, _SIGMA = Panel(62, 1180, 44, 540), Panel(62, 1180, 590, 720)
_ELLIPSES = 40  # that are drawn along a track
_MAX_MARKERS = 2000  # that are drawn
_ELLIPSE_PX = 14.0  # [px] largest half axis of an ellipse of an ordinary stretch


def plot_track(track: Track, name: str) -> str:
    """SVG of a track.

    The upper panel shows the drive from above: gaps red, ellipses of one standard deviation enlarged by the stated
    factor, markers that were used green and those left out as red crosses. The lower panel has the standard deviation
    over the time, and the limit of gaps.
    """
    places = _local_m(track.lon_deg, track.lat_deg, track)
    fixes = np.array([[r.fix.lon_deg, r.fix.lat_deg] for r in track.fixes[:_MAX_MARKERS]], float).reshape(-1, 2)
    fix_m = _local_m(fixes[:, 0], fixes[:, 1], track)
    east, north = _scales(places)
    line = np.column_stack([east.px(places[:, 0]), north.px(places[:, 1])])
    body = polylines(line, BLUE, 2.0)
    body += polylines(np.where(track.in_gap[:, None], line, np.nan), RED, 2.0)
    factor, ellipses = _ellipses(track, line, abs(east.at(1.0) - east.at(0.0)))
    body += ellipses
    for result, (e, n) in zip(track.fixes, fix_m, strict=False):
        x, y = east.at(float(e)), north.at(float(n))
        title = f"{result.fix.family} {result.fix.marker_id or ''}"
        if math.isfinite(result.distance):
            title += f": {result.distance:.1f} standard deviations"
        body.append(circle(x, y, 3, GREEN, title) if result.used else cross(x, y, 5, RED, 2.0, title))
    parts = [heading(_MAP.left, 20, f"{name}: {track.length_m:.0f} m"), _legend(factor), _MAP.frame()]
    parts += _MAP.clipped("map", body)
    parts += _map_ticks(east, north)
    parts += _sigma_panel(track)
    return picture(_WIDTH, _HEIGHT, parts)


def _local_m(lon_deg: Floats, lat_deg: Floats, track: Track) -> Floats:
    """East and north from the middle of the track, for a picture. [m]"""
    lon = np.radians((lon_deg - track.lon_deg[0] + 180.0) % 360.0 - 180.0)
    lat = np.radians(lat_deg)
    east, north = metres_per_radian(np.radians(np.array([float(np.median(track.lat_deg))])))
    return np.column_stack([lon * east, (lat - math.radians(float(track.lat_deg[0]))) * north])


def _scales(places: Floats) -> tuple[Scale, Scale]:
    """The same scale for both axes."""
    low, high = places.min(axis=0), places.max(axis=0)
    middle, wide, tall = (low + high) / 2, _MAP.right - _MAP.left, _MAP.height
    per_px = max((high[0] - low[0]) / (wide - 40), (high[1] - low[1]) / (tall - 40), 0.02)
    half_e, half_n = per_px * wide / 2, per_px * tall / 2
    return (
        Scale(float(middle[0] - half_e), float(middle[0] + half_e), _MAP.left, _MAP.right),
        Scale(float(middle[1] - half_n), float(middle[1] + half_n), _MAP.bottom, _MAP.top),
    )


def _ellipses(track: Track, line: Floats, px_per_m: float) -> tuple[float, list[str]]:
    """Ellipses at even places, and by what they are enlarged."""
    chosen = np.unique(np.linspace(0, len(line) - 1, min(_ELLIPSES, len(line))).astype(int))
    typical = float(np.median(track.sigma_m))
    factor = max(nice_step(_ELLIPSE_PX / max(typical * px_per_m, 1e-9)), 1.0)
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    around = np.column_stack([np.cos(turn), np.sin(turn)])
    drawn = []
    for k in chosen:
        east, cov, north = track.covariance_m2[k]
        values, vectors = np.linalg.eigh(np.array([[east, cov], [cov, north]]))
        half = np.minimum(np.sqrt(np.maximum(values, 0.0)) * factor * px_per_m, 200.0)
        edge = (around * half) @ vectors.T * np.array([1.0, -1.0]) + line[k]
        path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in edge.tolist()) + "Z"
        drawn.append(shape(path, "none", ORANGE))
    return factor, drawn


def _map_ticks(east: Scale, north: Scale) -> list[str]:
    step = nice_step((east.last - east.first) / 10, up=True)
    parts: list[str] = []
    for at in ticks(east.first, east.last, step):
        parts += _MAP.tick_below(east.at(at), f"{at:g} m")
    for at in ticks(north.first, north.last, step):
        parts.append(_MAP.label_left(north.at(at) + 4, f"{at:g} m"))
    return parts


def _sigma_panel(track: Track) -> list[str]:
    seconds = track.time_s - track.time_s[0]
    sigma = track.sigma_m
    along = Scale(0.0, max(float(seconds[-1]), 1.0), _SIGMA.left, _SIGMA.right)
    up = Scale(0.0, max(float(sigma.max()) * 1.05, 0.05), _SIGMA.bottom, _SIGMA.top, np.sqrt)
    points = np.column_stack([along.px(seconds), up.px(sigma)])
    parts = [_SIGMA.frame()]
    for tick in [t for t in (0.01, 0.1, 0.5, 1, 5, 10, 50, 100, 500) if t <= up.last]:
        parts += [_SIGMA.line_across(up.at(tick)), _SIGMA.label_left(up.at(tick) + 4, f"{tick:g} m")]
    parts += polylines(points, BLUE, 1.5)
    parts += polylines(np.where(track.in_gap[:, None], points, np.nan), RED, 1.5)
    for result in track.fixes[:_MAX_MARKERS]:
        x = along.at(result.time_s - float(track.time_s[0]))
        colour = GREEN if result.used else RED
        parts.append(stroke(f"M{x:.1f} {_SIGMA.bottom:.1f}v-7", colour, 1.5))
    for at in ticks(0.0, along.last, nice_step(along.last / 10, up=True)):
        parts += _SIGMA.tick_below(along.at(at), f"{at:g} s")
    return parts


def _legend(factor: float) -> str:
    entries = [
        ("track", BLUE, True), (", gap", RED, True), (", marker used", GREEN, True), (", left out \u00d7", RED, True),
        (f", standard deviation \u00d7 {factor:g}", ORANGE, True),
    ]  # fmt: skip
    return spans(_MAP.right, 20, entries, colour=GREY, anchor="end")


# === Cost of a plan against its quality: one panel for the distance between fixes, one for the path error.


_TRADE_OFF_WIDTH, _TOP, _TRADE_OFF_HEIGHT, _LEFT, _RIGHT, _FOOT = (
    860.0,
    84.0,
    260.0,
    96.0,
    24.0,
    56.0,
)  # [px] of the picture and its panels
_STEPS = 5  # lines across a panel at least


def draw_trade_off(points: Sequence[TradeOffPoint], currency: str) -> str:
    """SVG of the table of an optimised plan.

    Parameters
    ----------
    points : sequence of TradeOffPoint
        The required quality first, as `optimise_plan` returns them; at least one.

    Returns
    -------
    str
        Optimised plans in blue, even spacing of equal quality in orange, the required quality in black; points that no
        other one is better than are filled.
    """
    asked = points[0]
    by_fixes = [point for point in points if point.path_error_m == asked.path_error_m]
    by_path = [point for point in points if point.fix_every_m == asked.fix_every_m and point.path_error_m is not None]
    costs = [cost for point in points for cost in (point.cost, point.even_cost) if cost is not None]
    step = nice_step(max(costs) / _STEPS)
    top = np.ceil(max(costs) / step) * step
    front = set(pareto_points(points))
    parts = [
        heading(16, 28, "Cost against quality"),
        text(
            16,
            50,
            "blue: optimised, filled where no other plan is better in all; orange: even spacing; black: required",
        ),
    ]
    groups: list[tuple[str, list[TradeOffPoint], Callable[[TradeOffPoint], float]]] = [
        ("a fix at least every [m]", by_fixes, lambda point: point.fix_every_m)
    ]
    if by_path:
        groups.append(("path error at most [cm]", by_path, lambda point: 100 * (point.path_error_m or 0.0)))
    width = (_TRADE_OFF_WIDTH - len(groups) * (_LEFT + _RIGHT)) / len(groups)
    for k, (label, group, value) in enumerate(groups):
        left = k * (width + _LEFT + _RIGHT) + _LEFT
        panel = Panel(left, left + width, _TOP, _TOP + _TRADE_OFF_HEIGHT)
        up = Scale(0.0, float(top), panel.bottom, panel.top)
        parts += [panel.frame(), *_costs(panel, up, step, float(top))]
        parts += _curves(panel, up, sorted(group, key=value), value, asked, front)
        parts.append(text((panel.left + panel.right) / 2, panel.bottom + 42, label, colour=GREY, anchor="middle"))
    parts.append(text(_LEFT, _TOP - 10, f"cost [{currency}]", colour=GREY, anchor="end"))
    return picture(_TRADE_OFF_WIDTH, _TOP + _TRADE_OFF_HEIGHT + _FOOT, parts, INK)


def _costs(panel: Panel, up: Scale, step: float, top: float) -> list[str]:
    parts = []
    for cost in ticks(0.0, top, step):
        parts += [panel.line_across(up.at(cost)), panel.label_left(up.at(cost) + 4, f"{cost:,.0f}")]
    return parts


def _curves(
    panel: Panel,
    up: Scale,
    group: Sequence[TradeOffPoint],
    value: Callable[[TradeOffPoint], float],
    asked: TradeOffPoint,
    front: set[TradeOffPoint],
) -> list[str]:
    first, last = value(group[0]), value(group[-1])
    across = Scale(first / 1.1, last * 1.1, panel.left, panel.right, np.log)
    parts: list[str] = []
    even = [(across.at(value(point)), up.at(point.even_cost)) for point in group if point.even_cost is not None]
    own = [(across.at(value(point)), up.at(point.cost)) for point in group]
    for line, colour, dash in ((even, ORANGE, "5 4"), (own, BLUE, "")):
        if len(line) > 1:
            parts += polylines(np.array(line), colour, 1.6, dash)
    parts += [circle(x, y, 3.0, ORANGE) for x, y in even]
    for point, (x, y) in zip(group, own, strict=True):
        counts = ", ".join(f"{count} {family}" for family, count in point.counts)
        colour = INK if point == asked else BLUE
        title = f"{point.cost:,.2f} at {value(point):.4g}: {counts}"
        parts.append(circle(x, y, 4.5, colour, title))
        if point not in front:
            parts.append(circle(x, y, 2.5, "white"))
        parts += panel.tick_below(x, f"{value(point):.3g}")
    return parts


# === Residuals of an as-built survey on a map: an arrow a marker, long enough to be seen, with a scale for each.


MAX_ARROWS = 1000
"""Of more residuals the longest are drawn."""
_SIDE_PX, _MARGIN_PX, _HEAD_PX, _FOOT_PX = 860.0, 46.0, 64.0, 64.0
_MIN_PX = 180.0  # [px] shortest side of the map
_ARROW_PX = 46.0
"""Length of the arrow of the 90th percentile. [px]"""
_NAMED = 5  # longest residuals that are labelled
_FAINT, _WITHIN, _BEYOND = "#8a929b", "#2b6cb0", "#c53030"


def draw_residuals(survey: GeoreferencedSurvey, comparison: Comparison, tolerance_m: float) -> str | None:
    """SVG of the residuals, north up; None without any. Of more than `MAX_ARROWS` the longest are drawn.

    Parameters
    ----------
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
