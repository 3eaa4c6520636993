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

    @property
    def reach_m(self) -> float:
        """Odometer up to which it is known."""
        return float(self._rows[-1, 0]) if len(self._rows) else -1.0

    def append(self, s: Floats, yaw: Floats) -> None:
        """Add blocks: odometer and yaw (anticlockwise, unwrapped). [m, rad]"""
        if not s.size:
            return
        last = self._rows[-1] if len(self._rows) else np.array([s[0], yaw[0], 0.0, 0.0])
        step = np.diff(np.concatenate(([last[0]], s)))
        middle = (yaw + np.concatenate(([last[1]], yaw[:-1]))) / 2
        x = np.cumsum(np.concatenate(([last[2]], step * np.cos(middle))))[1:]
        y = np.cumsum(np.concatenate(([last[3]], step * np.sin(middle))))[1:]
        self._rows = np.concatenate((self._rows, np.stack([s, yaw, x, y], 1)))

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
