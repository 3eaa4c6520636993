"""Where magnets lie on the plane: speed integrated along the heading, and the place on the bar (equation 1)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


class VehiclePath:
    """The path of the vehicle's origin by odometer and heading; straight ahead where there is no heading.

    Parameters
    ----------
    forward_m : float
        Of the bar, ahead of the point that moves along the heading. [m]
    """

    def __init__(self, forward_m: float) -> None:
        self._forward_m = forward_m
        self._rows = np.empty((0, 4))  # odometer, yaw, x, y
        self._headings = np.empty((0, 2))  # time, yaw (rad, anticlockwise, unwrapped)
        self._waiting = np.empty((0, 2))  # odometer, time

    @property
    def reach_m(self) -> float:
        """Odometer up to which it is known."""
        return float(self._rows[-1, 0]) if len(self._rows) else -1.0

    def append(self, s: Floats, t: Floats, headings: Floats, *, final: bool = False) -> None:
        """Add blocks (odometer and time), and rows of time and heading in degrees."""
        if len(headings):
            yaw = -np.radians(headings[:, 1])
            before = self._headings[-1:, 1]
            yaw = np.unwrap(np.concatenate((before, yaw)))[len(before) :]
            self._headings = np.concatenate((self._headings, np.stack([headings[:, 0], yaw], 1)))
        self._waiting = np.concatenate((self._waiting, np.stack([s, t], 1)))
        known = len(self._waiting)
        if len(self._headings) and not final:
            known = int(np.searchsorted(self._waiting[:, 1], self._headings[-1, 0], side="right"))
        if not known:
            return
        now, self._waiting = self._waiting[:known], self._waiting[known:]
        yaw = np.interp(now[:, 1], *self._headings.T) if len(self._headings) else np.zeros(known)
        last = self._rows[-1] if len(self._rows) else np.array([now[0, 0], yaw[0], 0.0, 0.0])
        step = np.diff(np.concatenate(([last[0]], now[:, 0])))
        middle = (yaw + np.concatenate(([last[1]], yaw[:-1]))) / 2
        x = np.cumsum(np.concatenate(([last[2]], step * np.cos(middle))))[1:]
        y = np.cumsum(np.concatenate(([last[3]], step * np.sin(middle))))[1:]
        self._rows = np.concatenate((self._rows, np.stack([now[:, 0], yaw, x, y], 1)))
        if len(self._headings) > 4000:
            oldest = self._waiting[0, 1] if len(self._waiting) else now[-1, 1]
            self._headings = self._headings[max(int(np.searchsorted(self._headings[:, 0], oldest)) - 2, 0) :].copy()

    def forget(self, before_m: float) -> None:
        """Drop what lies before a distance, in large pieces."""
        n = int(np.searchsorted(self._rows[:, 0], before_m))
        if n > 1000:
            self._rows = self._rows[n:].copy()

    def position_m(self, odometer_m: float, lateral_m: float) -> Floats:
        """Position of a magnet that the bar passed at an odometer, so far to the left of its middle, shape (2,). [m]"""
        s = self._rows[:, 0]
        yaw, x, y = (np.interp(odometer_m, s, self._rows[:, k]) for k in (1, 2, 3))
        c, n = np.cos(yaw), np.sin(yaw)
        return np.array([x + self._forward_m * c - lateral_m * n, y + self._forward_m * n + lateral_m * c])
