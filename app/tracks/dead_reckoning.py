"""The drive by its speeds and headings alone: a path in a plane that starts anywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.geodesy.ellipsoid import metres_per_radian
from app.tracks.time_base import TimeBase
from app.tracks.types import Floats, PositionFix, Samples


@dataclass(frozen=True, slots=True, eq=False)
class DeadReckoning:
    """The drive without fixes.

    Attributes
    ----------
    east_m, north_m, odometer_m, speed_m_s, heading_rad : ndarray, shape (N,)
        At the nodes; the headings are unwrapped, and 0 where there are none.
    has_heading, has_speed : bool
    """

    east_m: Floats
    north_m: Floats
    odometer_m: Floats
    speed_m_s: Floats
    heading_rad: Floats
    has_heading: bool
    has_speed: bool


def dead_reckon(
    base: TimeBase, speeds: tuple[Samples, ...], headings: tuple[Samples, ...], offsets: dict[str, float]
) -> DeadReckoning:
    """Speeds and headings at the nodes, held where there are none, and the path that they give."""
    time = base.time_s
    speed = _at(time, speeds, offsets)
    heading = _at(time, tuple(_unwrapped(series) for series in headings), offsets)
    has_speed, has_heading = speed is not None, heading is not None
    v = speed if speed is not None else np.zeros(base.count)
    psi = np.radians(heading) if heading is not None else np.zeros(base.count)
    between = (v[1:] + v[:-1]) / 2 * base.step_s
    turn = (psi[1:] + psi[:-1]) / 2
    path = [np.concatenate([[0.0], np.cumsum(step)]) for step in (between * np.sin(turn), between * np.cos(turn))]
    odometer = np.concatenate([[0.0], np.cumsum(np.abs(between))])
    return DeadReckoning(path[0], path[1], odometer, v, psi, has_heading, has_speed)


def _unwrapped(series: Samples) -> Samples:
    return Samples(series.clock, series.time_s, np.unwrap(series.value, period=360.0), series.sigma)


def _at(time: Floats, all_series: tuple[Samples, ...], offsets: dict[str, float]) -> Floats | None:
    """Values at times: of the series that covers most of each time, held before its begin and after its end."""
    found: Floats | None = None
    for series in sorted(all_series, key=lambda series: series.time_s.size):
        if not series.time_s.size:
            continue
        t = series.time_s + offsets[series.clock]
        value = np.interp(time, t, series.value)
        inside = (time >= t[0]) & (time <= t[-1])
        found = value if found is None else np.where(inside, value, found)
    return found


def local_m(fixes: tuple[PositionFix, ...]) -> Floats:
    """East and north of fixes from the first one, for comparisons of neighbours, shape (K, 2). [m]"""
    lon = np.radians(np.array([fix.lon_deg for fix in fixes]))
    lat = np.radians(np.array([fix.lat_deg for fix in fixes]))
    east, north = metres_per_radian(lat)
    turn = (np.diff(lon) + np.pi) % (2 * np.pi) - np.pi
    steps_e = np.concatenate([[0.0], turn * (east[1:] + east[:-1]) / 2])
    steps_n = np.concatenate([[0.0], np.diff(lat) * (north[1:] + north[:-1]) / 2])
    return np.column_stack([np.cumsum(steps_e), np.cumsum(steps_n)])
