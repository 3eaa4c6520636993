"""A picture of a drive's track, as SVG: from above with its ellipses and markers, and its accuracy over the drive."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from app.geodesy.ellipsoid import metres_per_radian
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
    ticks,
)
from app.tracks.types import Track

Floats = npt.NDArray[np.float64]

_WIDTH, _HEIGHT = 1200, 760
_MAP, _SIGMA = Panel(62, 1180, 44, 540), Panel(62, 1180, 590, 720)
_ELLIPSES = 40  # that are drawn along a track; source: by hand
_MAX_MARKERS = 2000  # that are drawn; source: by hand
_ELLIPSE_PX = 14.0  # [px] largest half axis of an ellipse of an ordinary stretch; source: by hand


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
        title = f"{result.fix.family} {result.fix.marker_id or ''}: {result.distance:.1f} standard deviations"
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
