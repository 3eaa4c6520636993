"""The picture of cost against quality."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np

from app.planning.optimise import TradeOffPoint
from app.plots.axes import BLUE, INK, ORANGE
from app.plots.track import draw_trade_off

SVG = "{http://www.w3.org/2000/svg}"


def point(every_m: float, error_m: float | None, cost: float, even: float | None) -> TradeOffPoint:
    return TradeOffPoint(every_m, error_m, cost, cost, even, (("cerpm", 4), ("plate", round(cost / 100))))


def circles(svg: str) -> list[tuple[str, float, float]]:
    root = ElementTree.fromstring(svg)
    return [(c.get("fill", ""), float(c.get("cx", "")), float(c.get("cy", ""))) for c in root.iter(f"{SVG}circle")]


def test_points_lie_at_their_cost_and_quality() -> None:
    table = [point(100, None, 1000, 1200), point(50, None, 2000, 2400), point(200, None, 500, None)]
    svg = draw_trade_off(table, "EUR")
    drawn = circles(svg)
    own = sorted((x, y) for colour, x, y in drawn if colour in (BLUE, INK))
    assert len(own) == 3
    assert len([1 for colour, *_ in drawn if colour == ORANGE]) == 2
    x, y = np.array(own).T
    # distances on a logarithmic scale, costs on a linear one
    assert np.allclose(np.diff(x), np.diff(x)[0], atol=0.2)
    assert np.isclose((y[1] - y[0]) / (y[2] - y[1]), 2, atol=0.02)
    assert [colour for colour, *_ in drawn].count(INK) == 1
    texts = [element.text for element in ElementTree.fromstring(svg).iter(f"{SVG}text")]
    assert {"cost [EUR]", "a fix at least every [m]", "50", "100", "200", "2,000"} <= set(texts)
    assert "path error at most [cm]" not in texts


def test_path_errors_have_a_panel_and_beaten_points_are_hollow() -> None:
    table = [point(100, 0.05, 1000, 1500), point(50, 0.05, 1300, None), point(100, 0.025, 1000, 1800)]
    svg = draw_trade_off(table, "USD")
    texts = [element.text for element in ElementTree.fromstring(svg).iter(f"{SVG}text")]
    assert "path error at most [cm]" in texts
    # the same cost at half the path error is better: the required point is hollow in both panels
    assert [colour for colour, *_ in circles(svg)].count("white") == 2
    titles = [element.text for element in ElementTree.fromstring(svg).iter(f"{SVG}title")]
    assert "1,300.00 at 50: 4 cerpm, 13 plate" in titles
