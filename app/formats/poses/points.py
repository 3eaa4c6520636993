"""Points of a track in the order of the file, and the track that they form."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, UnreadableUpload
from app.formats.log_report import LogReport
from app.sensors.pose_track import PoseTrack

Floats = npt.NDArray[np.float64]

FASTEST_M_S = 150.0
"""A point that can only be reached faster than this, from both sides, is an outlier. [m/s] Chosen by hand: 540 km/h."""
_SLACK_M = 30.0  # [m] jump of a receiver that is no outlier; chosen by hand
_M_PER_DEG = 111_195.0  # [m/deg] on a sphere of 6371 km, the Earth's mean radius


@dataclass(frozen=True, slots=True)
class PosePoint:
    """One position.

    Attributes
    ----------
    entry : int
        Row, line or point of the file, from 0.
    time_s : float
        Seconds since 1970-01-01 UTC; NaN where it is not known. [s]
    lon_deg, lat_deg, heading_deg, accuracy_m : float
        As in `PoseTrack`.
    """

    entry: int
    time_s: float
    lon_deg: float
    lat_deg: float
    heading_deg: float = math.nan
    accuracy_m: float = math.nan


def track_of(name: str, points: Iterable[PosePoint], report: LogReport) -> PoseTrack:
    """Points in the order of time, without those that are no positions.

    Raises
    ------
    UnreadableUpload
        No point is left.
    InvalidParameter
        Longitude and latitude are swapped.
    """
    listed = list(points)
    table = np.array(
        [(p.time_s, p.lon_deg, p.lat_deg, p.heading_deg, p.accuracy_m, p.entry) for p in listed], float
    ).reshape(-1, 6)
    _check_swapped(name, table[:, 1], table[:, 2])
    table = _keep(table, np.isfinite(table[:, 1:3]).all(axis=1), "no-position", "there is no position", report)
    inside = (np.abs(table[:, 1]) <= 180) & (np.abs(table[:, 2]) <= 90)
    table = _keep(table, inside, "off-globe", "the position is out of range", report)
    table = _keep(table, (table[:, 1:3] != 0).any(axis=1), "null-island", "0, 0: the receiver had no position", report)
    table = _keep(table, np.isfinite(table[:, 0]), "no-time", "there is no time between 2000 and 2100", report)
    if not len(table):
        first = f"; entry {report.left_out[0].entry}: {report.left_out[0].reason}" if report.left_out else ""
        raise UnreadableUpload(
            f"{name} holds no position with a time{first}",
            field="poses",
            limit="at least one",
            cure="export the track with times; without them the positions cannot be matched with packets",
        )
    if (np.diff(table[:, 0]) < 0).any():
        report.warn("positions were not in the order of their times; they were sorted")
        table = table[np.argsort(table[:, 0], kind="stable")]
    new = np.diff(table[:, 0], prepend=-np.inf) > 0
    table = _keep(table, new, "same-time", "another position has the same time", report)
    table = _keep(table, ~find_jumps(table), "jump", f"faster than {FASTEST_M_S:g} m/s from both sides", report)
    heading = np.where(np.isfinite(table[:, 3]), table[:, 3], np.nan) % 360.0
    accuracy = np.where((table[:, 4] > 0) & np.isfinite(table[:, 4]), table[:, 4], np.nan)
    return PoseTrack(table[:, 0], table[:, 1], table[:, 2], heading, accuracy)


def _keep(table: Floats, good: npt.NDArray[np.bool_], kind: str, reason: str, report: LogReport) -> Floats:
    for entry in table[~good, 5]:
        report.leave_out(int(entry), kind, reason)
    return table[good]


def _check_swapped(name: str, lon_deg: Floats, lat_deg: Floats) -> None:
    with np.errstate(invalid="ignore"):
        bad = (np.abs(lat_deg) > 90) & (np.abs(lat_deg) <= 180) & (np.abs(lon_deg) <= 90)
    if len(bad) and 2 * bad.sum() > len(bad):
        first = int(np.flatnonzero(bad)[0])
        raise InvalidParameter(
            f"latitudes of {name} are out of range (the first is {lat_deg[first]:.6f}), and the longitudes would fit: "
            "the two are swapped",
            field="poses",
            limit="latitude -90 to 90 deg",
            cure="exchange the columns, or declare which is which",
        )


def find_jumps(table: Floats) -> npt.NDArray[np.bool_]:
    """Which rows (time [s], longitude, latitude [deg], ...) can only be reached too fast, from both sides."""
    if len(table) < 3:
        return np.zeros(len(table), bool)
    east = (np.diff(table[:, 1]) + 180) % 360 - 180
    step_m = _M_PER_DEG * np.hypot(east * np.cos(np.radians(table[:-1, 2])), np.diff(table[:, 2]))
    fast = step_m > FASTEST_M_S * np.diff(table[:, 0]) + _SLACK_M
    across = _M_PER_DEG * np.hypot(
        ((table[2:, 1] - table[:-2, 1] + 180) % 360 - 180) * np.cos(np.radians(table[:-2, 2])),
        table[2:, 2] - table[:-2, 2],
    )
    direct = across <= FASTEST_M_S * (table[2:, 0] - table[:-2, 0]) + _SLACK_M
    return np.concatenate(([False], fast[:-1] & fast[1:] & direct, [False]))
