"""Cost of a plan against its quality: one panel for the distance between fixes, one for the path error."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from app.planning.optimise import TradeOffPoint, pareto_points
from app.plots.axes import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    Panel,
    Scale,
    circle,
    heading,
    nice_step,
    picture,
    polylines,
    text,
    ticks,
)

_WIDTH, _TOP, _HEIGHT, _LEFT, _RIGHT, _FOOT = 860.0, 84.0, 260.0, 96.0, 24.0, 56.0  # [px] of the picture and its panels
_STEPS = 5  # lines across a panel at least


def draw_trade_off(points: Sequence[TradeOffPoint], currency: str) -> str:
    """SVG of the table of an optimised plan.

    Parameters
    ----------
    points : sequence of TradeOffPoint
        The required quality first, as `optimise_plan` returns them; at least one.
    currency : str

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
    width = (_WIDTH - len(groups) * (_LEFT + _RIGHT)) / len(groups)
    for k, (label, group, value) in enumerate(groups):
        left = k * (width + _LEFT + _RIGHT) + _LEFT
        panel = Panel(left, left + width, _TOP, _TOP + _HEIGHT)
        up = Scale(0.0, float(top), panel.bottom, panel.top)
        parts += [panel.frame(), *_costs(panel, up, step, float(top))]
        parts += _curves(panel, up, sorted(group, key=value), value, asked, front)
        parts.append(text((panel.left + panel.right) / 2, panel.bottom + 42, label, colour=GREY, anchor="middle"))
    parts.append(text(_LEFT, _TOP - 10, f"cost [{currency}]", colour=GREY, anchor="end"))
    return picture(_WIDTH, _TOP + _HEIGHT + _FOOT, parts, INK)


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
