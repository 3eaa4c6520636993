"""Where a vehicle was while it listened."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PoseTrack:
    """A vehicle's own positions over time.

    Parameters
    ----------
    time_s : array_like, shape (T,)
        Seconds since 1970-01-01 UTC, rising. [s]
    lon_deg, lat_deg : array_like, shape (T,)
        WGS 84 / ITRF. [deg]
    heading_deg : array_like, shape (T,)
        Clockwise from true north; NaN where it is not known. [deg]
    accuracy_m : array_like, shape (T,)
        Horizontal standard deviation of a position; NaN where it is not known. [m]

    Raises
    ------
    InvalidParameter
        Lengths differ, times do not rise, or a position is not finite.
    """

    time_s: Floats
    lon_deg: Floats
    lat_deg: Floats
    heading_deg: Floats
    accuracy_m: Floats

    def __post_init__(self) -> None:
        arrays = {name: np.asarray(getattr(self, name), float) for name in self.__slots__}
        lengths = {len(values) for values in arrays.values()}
        if len(lengths) != 1 or any(values.ndim != 1 for values in arrays.values()):
            raise InvalidParameter("a pose track has one value of each kind per time", field="poses")
        for name in ("time_s", "lon_deg", "lat_deg"):
            if not np.isfinite(arrays[name]).all():
                raise InvalidParameter(f"{name} of a pose is not finite", field=f"poses.{name}", limit="finite numbers")
        if (np.diff(arrays["time_s"]) <= 0).any():
            raise InvalidParameter("times of poses do not rise", field="poses.time_s", limit="rising times")
        for name, values in arrays.items():
            object.__setattr__(self, name, values)
