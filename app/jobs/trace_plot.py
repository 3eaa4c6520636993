"""A picture of a trace with what was found in it, as SVG: the field over the drive, and the bar from above."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from app.decoders.magnet.readings import Finding, LineCrossing, MagnetReading, NoiseFinding, TagReading
from app.markers.magnet import Orientation, Polarity
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace

Floats = npt.NDArray[np.float64]

_WIDTH, _HEIGHT = 1200, 470
_LEFT, _RIGHT = 62, 1180
_FIELD, _BAR = (74, 246), (284, 422)  # top and bottom of the two panels
_FORWARD, _VERTICAL = "#8fb7b2", "#2d3e50"
_BINS = 1100
_SLOW_S = 1.0  # what changes more slowly than this is background
_MAX_NOISE = 400
_BESIDE_CM = 25.0  # shown beyond the ends of the bar
_COLOURS = {Polarity.N: "#c0392b", Polarity.S: "#1f5fa8"}


def plot_trace(trace: MagnetTrace, bar: MagnetometerBar, findings: Sequence[Finding]) -> str:
    """SVG of a trace.

    The upper panel has the largest change of the vertical (dark) and the forward field (light) on any array sensor,
    without samples that stand alone, its root drawn so that high vehicles' magnets show beside iron; the lower one the
    magnets where they passed under the bar: red north, blue south; circles upright, triangles lying.
    """
    speed = np.interp(trace.t_s, trace.speed_t_s, trace.speed_m_s)
    odometer = np.concatenate(([0.0], np.cumsum(np.diff(trace.t_s) * (speed[1:] + speed[:-1]) / 2)))
    length = max(float(odometer[-1]), 1e-3)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" width="{_WIDTH}" '
        f'height="{_HEIGHT}" font-family="sans-serif" font-size="12">',
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="white"/>',
        f'<text x="{_LEFT}" y="20" font-size="15" font-weight="bold">{_title(findings, length, trace)}</text>',
        _legend(),
    ]
    parts += _field_panel(trace, bar, odometer, length)
    parts += _bar_panel(bar, findings, length)
    parts += _axis(length)
    return "\n".join([*parts, "</svg>\n"])


def _title(findings: Sequence[Finding], length_m: float, trace: MagnetTrace) -> str:
    magnets = sum(isinstance(f, MagnetReading) for f in findings)
    tags = sum(isinstance(f, TagReading) for f in findings)
    lines = sum(isinstance(f, LineCrossing) for f in findings)
    seconds = float(trace.t_s[-1] - trace.t_s[0])
    return f"Magnets: {magnets}, tags: {tags}, line crossings: {lines}; {length_m:.0f} m in {seconds:.1f} s"


def _legend() -> str:
    north, south = _COLOURS[Polarity.N], _COLOURS[Polarity.S]
    return (
        f'<text x="{_RIGHT}" y="20" text-anchor="end" fill="#555" xml:space="preserve">field '
        f'<tspan fill="{_VERTICAL}" font-weight="bold">vertical</tspan>, <tspan fill="{_FORWARD}" font-weight="bold">'
        f'forward</tspan>    magnets <tspan fill="{north}">N</tspan>, <tspan fill="{south}">S</tspan>: '
        "\u25cf upright, \u25b6 lying    \u00d7 no magnet</text>"
    )


def _x(odometer_m: float, length_m: float) -> float:
    return _LEFT + (_RIGHT - _LEFT) * min(max(odometer_m / length_m, 0.0), 1.0)


def _field_panel(trace: MagnetTrace, bar: MagnetometerBar, odometer: Floats, length_m: float) -> list[str]:
    top, bottom = _FIELD
    bins = np.minimum((odometer / length_m * _BINS).astype(int), _BINS - 1)
    starts = np.flatnonzero(np.r_[True, np.diff(bins) > 0])
    curves = []
    for axis in (0, 2):
        largest = np.zeros(len(trace.t_s))
        for sensor in bar.array:
            values = np.nan_to_num(trace.field_ut[:, sensor, axis].astype(float))
            values = ndimage.median_filter(values, 3, mode="nearest")  # a sample that stands alone is a fault
            largest = np.maximum(largest, np.abs(values - _background(values, trace.rate_hz)))
        curves.append((odometer[starts], np.maximum.reduceat(largest, starts)))
    full = max(float(max(c[1].max() for c in curves)), 10.0)

    def y(value_ut: float) -> float:
        return bottom - (bottom - top) * float(np.sqrt(min(value_ut / full, 1.0)))

    parts = [_frame(top, bottom), _label(_LEFT - 6, bottom, "0 µT")]
    for tick in [t for t in (1, 10, 100, 1000, 10_000) if full / 100 <= t <= full]:
        parts.append(f'<line x1="{_LEFT}" x2="{_RIGHT}" y1="{y(tick):.1f}" y2="{y(tick):.1f}" stroke="#eee"/>')
        parts.append(_label(_LEFT - 6, y(tick) + 4, f"{tick:g} µT"))
    for (at, value), colour in zip(curves, (_FORWARD, _VERTICAL), strict=True):
        points = " ".join(f"{_x(s, length_m):.1f},{y(v):.1f}" for s, v in zip(at.tolist(), value.tolist(), strict=True))
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1"/>')
    return parts


def _background(values: Floats, rate_hz: float) -> Floats:
    """Means over a second, joined by lines: quick, and good enough to look at."""
    size = max(int(rate_hz * _SLOW_S), 1)
    starts = np.arange(0, len(values), size)
    counts = np.diff(np.r_[starts, len(values)])
    means = np.add.reduceat(values, starts) / counts
    joined: Floats = np.interp(np.arange(len(values)), starts + counts / 2, means)
    return joined


def _bar_panel(bar: MagnetometerBar, findings: Sequence[Finding], length_m: float) -> list[str]:
    top, bottom = _BAR
    half_cm = 100 * float(np.ptp(bar.positions_m[bar.array, 1])) / 2 + _BESIDE_CM
    middle = (top + bottom) / 2

    def y(lateral_cm: float) -> float:
        return middle - (bottom - top) / 2 * min(max(lateral_cm / half_cm, -1.0), 1.0)

    parts = [_frame(top, bottom)]
    for edge_cm, side in ((half_cm - _BESIDE_CM, "left"), (0.0, ""), (_BESIDE_CM - half_cm, "right")):
        at = y(edge_cm)
        parts.append(f'<line x1="{_LEFT}" x2="{_RIGHT}" y1="{at:.1f}" y2="{at:.1f}" stroke="#ddd"/>')
        parts.append(_label(_LEFT - 6, at + 4, f"{abs(edge_cm):.0f} cm"))
        parts.append(_label(_LEFT - 6, at + 17, side))
    noise = [finding for finding in findings if isinstance(finding, NoiseFinding)]
    for left_out in noise[:_MAX_NOISE]:
        x0, y0 = _x(left_out.odometer_m, length_m), y(left_out.lateral_cm)
        cross = f'<path d="M{x0 - 3:.1f} {y0 - 3:.1f}l6 6m0 -6l-6 6" stroke="#999">'
        parts.append(f"{cross}<title>{escape(left_out.reason)}</title></path>")
    parts += _tags([finding for finding in findings if isinstance(finding, TagReading)], length_m)
    for finding in findings:
        if isinstance(finding, LineCrossing):
            x0 = _x(finding.odometer_m, length_m)
            text = f"{finding.style} line, {finding.side}"
            parts.append(
                f'<line x1="{x0:.1f}" x2="{x0:.1f}" y1="{_FIELD[0]}" y2="{bottom}" '
                f'stroke="#d68910" stroke-dasharray="4 3"/>'
                f'<text x="{x0 + 3:.1f}" y="{bottom - 4}" fill="#b9770e" font-size="10">{text}</text>'
            )
        elif isinstance(finding, MagnetReading):
            parts.append(_magnet(finding, _x(finding.odometer_m, length_m), y(finding.lateral_cm)))
    return parts


def _tags(tags: Sequence[TagReading], length_m: float) -> list[str]:
    """Brackets over the field, labelled in two rows as far as there is room."""
    parts, ends = [], [0.0, 0.0]
    for tag in tags:
        x0, x1 = (_x(magnet.odometer_m, length_m) for magnet in (tag.magnets[0], tag.magnets[-1]))
        colour = "#c0392b" if tag.wrong_way else "#1e8449"
        text = tag.tag.text if tag.tag is not None else "".join(str(p) for p in tag.polarities)
        text += " WRONG WAY" if tag.wrong_way else ""
        half = 3.6 * len(text)
        middle = min(max((x0 + x1) / 2, half), _WIDTH - half)
        bracket = f"M{x0:.1f} {_FIELD[0] - 4}v-6H{max(x1, x0 + 2):.1f}v6"
        parts.append(
            f'<path d="{bracket}" fill="none" stroke="{colour}" stroke-width="1.5"><title>{escape(text)}</title></path>'
        )
        row = next((row for row, end in enumerate(ends) if middle - half > end), None)
        if row is not None:
            ends[row] = middle + half
            parts.append(
                f'<text x="{middle:.1f}" y="{_FIELD[0] - 14 - 15 * row}" fill="{colour}" text-anchor="middle">'
                f"{escape(text)}</text>"
            )
    return parts


def _magnet(magnet: MagnetReading, x0: float, y0: float) -> str:
    colour = _COLOURS[magnet.polarity]
    title = (
        f"<title>{magnet.polarity} {magnet.phi_deg} deg, {magnet.lateral_cm:.1f} cm, {magnet.confidence:.3f}</title>"
    )
    if magnet.orientation is Orientation.UP:
        return f'<circle cx="{x0:.1f}" cy="{y0:.1f}" r="4" fill="{colour}">{title}</circle>'
    tip = 5 if magnet.polarity is Polarity.N else -5
    return (
        f'<path d="M{x0 - tip:.1f} {y0 - 5:.1f}L{x0 + tip:.1f} {y0:.1f}L{x0 - tip:.1f} {y0 + 5:.1f}z" fill="{colour}">'
        f"{title}</path>"
    )


def _axis(length_m: float) -> list[str]:
    step = 10 ** np.floor(np.log10(length_m / 4))
    step = next(step * k for k in (1, 2, 5, 10) if length_m / (step * k) <= 10)
    parts = []
    for k in range(int(length_m / step) + 1):
        x0 = _x(k * step, length_m)
        parts.append(f'<line x1="{x0:.1f}" x2="{x0:.1f}" y1="{_BAR[1]}" y2="{_BAR[1] + 5}" stroke="#555"/>')
        parts.append(f'<text x="{x0:.1f}" y="{_BAR[1] + 19}" text-anchor="middle">{k * step:g} m</text>')
    return parts


def _frame(top: int, bottom: int) -> str:
    return f'<rect x="{_LEFT}" y="{top}" width="{_RIGHT - _LEFT}" height="{bottom - top}" fill="none" stroke="#bbb"/>'


def _label(x: float, y: float, text: str) -> str:
    return f'<text x="{x}" y="{y}" text-anchor="end" fill="#555">{text}</text>'
