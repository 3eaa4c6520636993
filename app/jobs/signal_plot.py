"""The strength of packets over distance, with the fitted path loss, as a panel of an SVG."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.jobs.plot_strokes import LEFT, RIGHT, dots, frame, label, polylines

Floats = npt.NDArray[np.float64]

PANEL_HEIGHT = 170
_MOST_DOTS = 1500
_DOTS, _LINE, _PAPER = "#1f5fa8", "#c0392b", "#555"
_PAPER_POINTS = ((50.0, -108.0), (340.0, -125.0))  # CERPM paper, section 4.1


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


_Place = Callable[[npt.ArrayLike, npt.ArrayLike], Floats]


def signal_panel(signals: SignalPicture, top: int) -> list[str]:
    """RSSI over the logarithm of distance: path loss is a straight line there."""
    kept = np.isfinite(signals.distance_m) & np.isfinite(signals.rssi_dbm) & (signals.distance_m > 0)
    distance, rssi = signals.distance_m[kept], signals.rssi_dbm[kept]
    bottom = top + PANEL_HEIGHT
    near = max(min(distance.min(initial=40.0), 40.0), 1.0)
    far = max(distance.max(initial=400.0), 400.0)
    high = 10 * math.ceil(max(rssi.max(initial=-100.0), -100.0) / 10)
    low = 10 * math.floor(min(rssi.min(initial=-130.0), -130.0) / 10)

    def px(at_m: npt.ArrayLike, dbm: npt.ArrayLike) -> Floats:
        x = LEFT + (RIGHT - LEFT) * np.log(np.asarray(at_m, float) / near) / math.log(far / near)
        y = bottom - PANEL_HEIGHT * (np.asarray(dbm, float) - low) / (high - low)
        return np.stack([np.clip(x, LEFT, RIGHT), np.clip(y, top, bottom)], axis=-1)

    parts = [
        frame(top, PANEL_HEIGHT),
        f'<text x="{LEFT}" y="{top - 6}" fill="{_PAPER}">RSSI over distance; ◇ in the paper</text>',
    ]
    for dbm in range(low, high + 1, 10 if high - low <= 60 else 20):
        y = float(px(near, dbm)[1])
        parts.append(f'<path d="M{LEFT} {y:.1f}H{RIGHT}" stroke="#eee"/>')
        parts.append(label(LEFT - 6, y + 4, f"{dbm} dBm".replace("-", "−")))
    for at in (m * 10**e for e in range(5) for m in (1, 2, 5)):
        if near <= at <= far:
            x = float(px(at, low)[0])
            parts.append(f'<path d="M{x:.1f} {bottom}v5" stroke="#555"/>')
            parts.append(f'<text x="{x:.1f}" y="{bottom + 19}" text-anchor="middle">{at} m</text>')
    thinned = slice(None, None, max(math.ceil(len(distance) / _MOST_DOTS), 1))
    parts.append(dots(px(distance[thinned], rssi[thinned]), _DOTS, 4, 0.4))
    for x, y in (px(*point).tolist() for point in _PAPER_POINTS):
        parts.append(
            f'<path d="M{x:.1f} {y - 6:.1f}l6 6l-6 6l-6 -6z" fill="white" stroke="{_PAPER}" stroke-width="1.5"/>'
        )
    return [*parts, *_fitted(signals, px, near, far, top)]


def _fitted(signals: SignalPicture, px: _Place, near: float, far: float, top: int) -> list[str]:
    text = "no path loss fitted"
    parts = []
    if signals.at_1m_dbm is not None and signals.exponent is not None:
        at = np.geomspace(near, far, 60)
        line = px(at, signals.at_1m_dbm - 10 * signals.exponent * np.log10(at))
        parts = polylines(line, _LINE, 1.6)
        level = signals.at_1m_dbm - 10 * signals.exponent * math.log10(50)
        text = f"fitted: {level:.0f} dBm at 50 m, exponent {signals.exponent:.2f}".replace("-", "−")
    parts.append(f'<text x="{RIGHT}" y="{top - 6}" text-anchor="end" fill="{_LINE}">{text}</text>')
    return parts
