"""A picture of a trace with what was found in it, as SVG: the field over the drive, and the bar from above."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from app.decoders.magnet.readings import Finding, LineCrossing, MagnetReading, NoiseFinding, TagReading
from app.markers.magnet import Orientation, Polarity
from app.plots.axes import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    RED,
    Panel,
    Scale,
    circle,
    cross,
    heading,
    nice_step,
    picture,
    polylines,
    shape,
    spans,
    stroke,
    text,
    ticks,
)
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace
from app.values import Floats

_WIDTH, _HEIGHT = 1200, 470
_FIELD, _BAR = Panel(62, 1180, 74, 246), Panel(62, 1180, 284, 422)
_FORWARD, _VERTICAL = "#8fb7b2", "#2d3e50"
_BINS = 1100  # of the field along the drive; about one a pixel
_SLOW_S = 1.0  # what changes more slowly than this is background
_MAX_NOISE = 400  # crosses that are drawn
_BESIDE_CM = 25.0  # shown beyond the ends of the bar
_COLOURS = {Polarity.N: RED, Polarity.S: BLUE}


def plot_trace(trace: MagnetTrace, bar: MagnetometerBar, findings: Sequence[Finding]) -> str:
    """SVG of a trace.

    The upper panel has the largest change of the vertical (dark) and the forward field (light) on any array sensor,
    without samples that stand alone, its root drawn so that high vehicles' magnets show beside iron; the lower one the
    magnets where they passed under the bar: red north, blue south; circles upright, triangles lying.
    """
    speed = np.interp(trace.t_s, trace.speed_t_s, trace.speed_m_s)
    odometer = np.concatenate(([0.0], np.cumsum(np.diff(trace.t_s) * (speed[1:] + speed[:-1]) / 2)))
    length = max(float(odometer[-1]), 1e-3)
    along = Scale(0.0, length, _FIELD.left, _FIELD.right)
    parts = [heading(_FIELD.left, 20, _title(findings, length, trace)), _legend()]
    parts += _field_panel(trace, bar, odometer, along)
    parts += _bar_panel(bar, findings, along)
    step = nice_step(length / 10, up=True)
    for at_m in ticks(0.0, length, step):
        parts += _BAR.tick_below(along.at(at_m), f"{at_m:g} m")
    return picture(_WIDTH, _HEIGHT, parts)


def _title(findings: Sequence[Finding], length_m: float, trace: MagnetTrace) -> str:
    magnets = sum(isinstance(f, MagnetReading) for f in findings)
    tags = sum(isinstance(f, TagReading) for f in findings)
    lines = sum(isinstance(f, LineCrossing) for f in findings)
    seconds = float(trace.t_s[-1] - trace.t_s[0])
    return f"Magnets: {magnets}, tags: {tags}, line crossings: {lines}; {length_m:.0f} m in {seconds:.1f} s"


def _legend() -> str:
    entries = [
        ("field ", "", False), ("vertical", _VERTICAL, True), (", ", "", False), ("forward", _FORWARD, True),
        ("    magnets ", "", False), ("N", _COLOURS[Polarity.N], False), (", ", "", False),
        ("S", _COLOURS[Polarity.S], False), (": \u25cf upright, \u25b6 lying    \u00d7 no magnet", "", False),
    ]  # fmt: skip
    return spans(_FIELD.right, 20, entries, colour=GREY, anchor="end")


def _field_panel(trace: MagnetTrace, bar: MagnetometerBar, odometer: Floats, along: Scale) -> list[str]:
    bins = np.minimum((odometer / along.last * _BINS).astype(int), _BINS - 1)
    starts = np.flatnonzero(np.r_[True, np.diff(bins) > 0])
    curves = []
    for axis in (0, 2):
        curves.append((odometer[starts], np.maximum.reduceat(largest_change(trace, bar, axis), starts)))
    full = max(float(max(c[1].max() for c in curves)), 10.0)

    up = Scale(0.0, full, _FIELD.bottom, _FIELD.top, np.sqrt)
    parts = [_FIELD.frame(), _FIELD.label_left(_FIELD.bottom, "0 µT")]
    for tick in [t for t in (1, 10, 100, 1000, 10_000) if full / 100 <= t <= full]:
        parts += [_FIELD.line_across(up.at(tick)), _FIELD.label_left(up.at(tick) + 4, f"{tick:g} µT")]
    for (at_m, value_ut), colour in zip(curves, (_FORWARD, _VERTICAL), strict=True):
        parts += polylines(np.column_stack([along.px(at_m), up.px(value_ut)]), colour, 1.0)
    return parts


def largest_change(trace: MagnetTrace, bar: MagnetometerBar, axis: int) -> Floats:
    """Largest change of one component on any array sensor, without samples that stand alone, shape (T,). [uT]"""
    largest = np.zeros(len(trace.t_s))
    for sensor in bar.array:
        values = np.nan_to_num(trace.field_ut[:, sensor, axis].astype(float))
        values = scipy.ndimage.median_filter(values, 3, mode="nearest")  # a sample that stands alone is a fault
        largest = np.maximum(largest, np.abs(values - _background(values, trace.rate_hz)))
    return largest


def _background(values: Floats, rate_hz: float) -> Floats:
    """Means over a second, joined by lines: quick, and good enough to look at."""
    size = max(int(rate_hz * _SLOW_S), 1)
    starts = np.arange(0, len(values), size)
    counts = np.diff(np.r_[starts, len(values)])
    means = np.add.reduceat(values, starts) / counts
    joined: Floats = np.interp(np.arange(len(values)), starts + counts / 2, means)
    return joined


def _bar_panel(bar: MagnetometerBar, findings: Sequence[Finding], along: Scale) -> list[str]:
    half_cm = 100 * float(np.ptp(bar.positions_m[bar.array, 1])) / 2 + _BESIDE_CM
    up = Scale(-half_cm, half_cm, _BAR.bottom, _BAR.top)
    parts = [_BAR.frame()]
    for edge_cm, side in ((half_cm - _BESIDE_CM, "left"), (0.0, ""), (_BESIDE_CM - half_cm, "right")):
        y = up.at(edge_cm)
        parts += [_BAR.line_across(y, "#ddd"), _BAR.label_left(y + 4, f"{abs(edge_cm):.0f} cm")]
        parts += [_BAR.label_left(y + 17, side)] if side else []
    noise = [finding for finding in findings if isinstance(finding, NoiseFinding)]
    for found in noise[:_MAX_NOISE]:
        parts.append(cross(along.at(found.odometer_m), up.at(found.lateral_cm), 3, "#999", title=found.reason))
    parts += _tags([finding for finding in findings if isinstance(finding, TagReading)], along)
    for finding in findings:
        if isinstance(finding, LineCrossing):
            parts += _line_crossing(finding, along.at(finding.odometer_m))
        elif isinstance(finding, MagnetReading):
            parts.append(_magnet(finding, along.at(finding.odometer_m), up.at(finding.lateral_cm)))
    return parts


def _line_crossing(crossing: LineCrossing, x: float) -> list[str]:
    return [
        stroke(f"M{x:.1f} {_FIELD.top}V{_BAR.bottom}", ORANGE, dash="4 3"),
        text(x + 3, _BAR.bottom - 4, f"{crossing.style} line, {crossing.side}", colour="#b9770e", size=10),
    ]


def _tags(tags: Sequence[TagReading], along: Scale) -> list[str]:
    """Brackets over the field, labelled in two rows as far as there is room."""
    parts, ends, top = [], [0.0, 0.0], _FIELD.top
    for tag in tags:
        x0, x1 = (along.at(magnet.odometer_m) for magnet in (tag.magnets[0], tag.magnets[-1]))
        colour = RED if tag.wrong_way else GREEN
        label = tag.tag.text if tag.tag is not None else "".join(str(p) for p in tag.polarities)
        label += " WRONG WAY" if tag.wrong_way else ""
        half = 3.6 * len(label)
        middle = min(max((x0 + x1) / 2, half), _WIDTH - half)
        parts.append(stroke(f"M{x0:.1f} {top - 4}v-6H{max(x1, x0 + 2):.1f}v6", colour, 1.5, title=label))
        row = next((row for row, end in enumerate(ends) if middle - half > end), None)
        if row is not None:
            ends[row] = middle + half
            parts.append(text(middle, top - 14 - 15 * row, label, colour=colour, anchor="middle"))
    return parts


def _magnet(magnet: MagnetReading, x: float, y: float) -> str:
    colour = _COLOURS[magnet.polarity]
    title = f"{magnet.polarity} {magnet.phi_deg} deg, {magnet.lateral_cm:.1f} cm, {magnet.confidence:.3f}"
    if magnet.phi_deg is Orientation.UP:
        return circle(x, y, 4, colour, title)
    tip = 5 if magnet.polarity is Polarity.N else -5
    path = f"M{x - tip:.1f} {y - 5:.1f}L{x + tip:.1f} {y:.1f}L{x - tip:.1f} {y + 5:.1f}z"
    return shape(path, colour, title=title)
