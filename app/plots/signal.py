"""The strength of packets over distance, with the fitted path loss, as a panel of an SVG."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.plots.axes import BLUE, GREY, RED, Panel, Scale, dots, polylines, shape, text

Floats = npt.NDArray[np.float64]

PANEL_HEIGHT = 170
_MAX_DOTS = 1500  # packets that are drawn; chosen by hand
_NEAR_M, _FAR_M, _HIGH_DBM, _LOW_DBM = 40.0, 400.0, -100.0, -130.0  # always shown, so that pictures compare
_PAPER_POINTS = ((50.0, -108.0), (340.0, -125.0))  # [m, dBm] CERPM paper, section 4.1


@dataclass(frozen=True, slots=True, eq=False)
class SignalPicture:
    """Strength of packets over distance.

    Attributes
    ----------
    distance_m, rssi_dbm : ndarray, shape (P,)
        NaN where either is not known. [m, dBm]
    at_1m_dbm, exponent : float or None
        Fitted path loss: RSSI = at_1m - 10 exponent log10(distance). [dBm, 1]
    """

    distance_m: Floats
    rssi_dbm: Floats
    at_1m_dbm: float | None = None
    exponent: float | None = None


def signal_panel(signals: SignalPicture, left: float, right: float, top: float) -> list[str]:
    """RSSI over the logarithm of distance: path loss is a straight line there."""
    kept = np.isfinite(signals.distance_m) & np.isfinite(signals.rssi_dbm) & (signals.distance_m > 0)
    distance, rssi = signals.distance_m[kept], signals.rssi_dbm[kept]
    panel = Panel(left, right, top, top + PANEL_HEIGHT)
    near = max(min(distance.min(initial=_NEAR_M), _NEAR_M), 1.0)
    far = max(distance.max(initial=_FAR_M), _FAR_M)
    high = 10 * math.ceil(max(rssi.max(initial=_HIGH_DBM), _HIGH_DBM) / 10)
    low = 10 * math.floor(min(rssi.min(initial=_LOW_DBM), _LOW_DBM) / 10)
    along, up = Scale(near, far, left, right, np.log), Scale(low, high, panel.bottom, top)
    parts = [panel.frame(), text(left, top - 6, "RSSI over distance; ◇ in the paper", colour=GREY)]
    for dbm in range(low, high + 1, 10 if high - low <= 60 else 20):
        parts.append(panel.line_across(up.at(dbm)))
        parts.append(panel.label_left(up.at(dbm) + 4, f"{dbm} dBm".replace("-", "−")))
    for at_m in (m * 10**e for e in range(5) for m in (1, 2, 5)):
        if near <= at_m <= far:
            parts += panel.tick_below(along.at(at_m), f"{at_m} m")
    thinned = slice(None, None, max(math.ceil(len(distance) / _MAX_DOTS), 1))
    points = np.stack([along.px(distance[thinned]), up.px(rssi[thinned])], axis=-1)
    parts.append(dots(points, BLUE, 4, 0.4))
    for paper_m, paper_dbm in _PAPER_POINTS:
        parts.append(shape(f"M{along.at(paper_m):.1f} {up.at(paper_dbm) - 6:.1f}l6 6l-6 6l-6 -6z", "white", GREY))
    return [*parts, *_fitted(signals, panel, along, up)]


def _fitted(signals: SignalPicture, panel: Panel, along: Scale, up: Scale) -> list[str]:
    """The fitted line, and its figures above the panel."""
    caption = "no path loss fitted"
    parts = []
    if signals.at_1m_dbm is not None and signals.exponent is not None:
        at_m = np.geomspace(along.first, along.last, 60)
        dbm = signals.at_1m_dbm - 10 * signals.exponent * np.log10(at_m)
        parts = polylines(np.stack([along.px(at_m), up.px(dbm)], axis=-1), RED, 1.6)
        level = signals.at_1m_dbm - 10 * signals.exponent * math.log10(50)
        caption = f"fitted: {level:.0f} dBm at 50 m, exponent {signals.exponent:.2f}".replace("-", "−")
    return [*parts, text(panel.right, panel.top - 6, caption, colour=RED, anchor="end")]
