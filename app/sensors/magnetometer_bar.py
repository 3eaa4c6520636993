"""A bar of magnetometers on a vehicle, and the trace that it records."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from app.errors import InvalidParameter
from app.inputs import Declaration, Number
from app.values import Floats

MAX_SENSORS = 64
"""Sensors of a bar at most. METRO's has 14 (section 6.1)."""
MIN_WIDTH_M = 0.1
"""Smallest distance between the outermost sensors. [m] METRO's is 1.76 m."""
MAX_FIELD_UT = 50_000.0
"""Largest field that a chip reads, per axis. [uT] Source: MLX90393, 5 to 50 mT (METRO section 6.1)."""
MAX_DELAY_S = 0.01
"""Largest time between a time stamp and the reading of an axis. [s] Over three samples of METRO."""

MIN_CLEARANCE_M, MAX_CLEARANCE_M = 0.1, 0.6
"""Clearances that can be declared. [m] Source: as those that are estimated, `app.decoders.magnet.classify`, less
room for the load."""


class SensorRole(StrEnum):
    """What a magnetometer is there for."""

    ARRAY = "array"
    REFERENCE = "reference"


@dataclass(frozen=True, slots=True, eq=False)
class MagnetometerBar:
    """Where the magnetometers of a vehicle sit and how they are turned.

    Raises
    ------
    InvalidParameter
        Fewer than three array sensors or two in one place, positions that are not finite, or lengths that differ.
    """

    # shape (S, 3): [m] in the vehicle frame (ISO 8855: x forward, y left, z up). The origin is the point that moves
    # along the heading (the middle of the rear axle; the bar itself if it is not known). Only differences of z count.
    positions_m: Floats
    # array sensors look for magnets, reference sensors listen to the wheels: each is nearer to its wheel than any array
    # sensor
    roles: tuple[SensorRole, ...]
    # shape (S, 3, 3): rotation of each chip; the identity if left out
    vehicle_from_sensor: Floats = field(default_factory=lambda: np.empty((0, 3, 3)))
    # [s] times after the time stamp at which x, y and z are converted
    axis_delay_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    clearance_m: float | None = None  # [m] of the middle of the array sensors above the road, if it is known

    def __post_init__(self) -> None:
        positions = np.array(self.positions_m, float)
        if positions.ndim != 2 or positions.shape[1:] != (3,) or not np.isfinite(positions).all():
            raise InvalidParameter(
                "each sensor has a finite position x, y, z", field="bar.positions_m", limit="finite metres, S x 3"
            )
        roles = tuple(SensorRole(r) for r in self.roles)
        if len(roles) != len(positions) or len(roles) > MAX_SENSORS:
            raise InvalidParameter(
                f"{len(positions)} positions and {len(roles)} roles",
                field="bar.roles",
                limit=f"as many as sensors, {MAX_SENSORS} at most",
            )
        if roles.count(SensorRole.ARRAY) < 3:
            raise InvalidParameter("a bar has three or more array sensors", field="bar.roles", limit=">= 3 array")
        array = positions[[role is SensorRole.ARRAY for role in roles]]
        if len(np.unique(array, axis=0)) < len(array) or np.ptp(array[:, 1]) < MIN_WIDTH_M:
            raise InvalidParameter(
                "array sensors have places of their own, across the vehicle",
                field="bar.positions_m",
                limit=f"no two alike, {MIN_WIDTH_M:g} m or more from the leftmost to the rightmost",
                cure="give each sensor's place: forward, left, up, in metres",
            )
        turns = np.array(self.vehicle_from_sensor, float)
        if not turns.size:
            turns = np.tile(np.eye(3), (len(roles), 1, 1))
        if (
            turns.shape != (len(roles), 3, 3)
            or not np.allclose(turns @ turns.transpose(0, 2, 1), np.eye(3), atol=1e-6)
            or not np.allclose(np.linalg.det(turns), 1, atol=1e-6)
        ):
            raise InvalidParameter(
                "each sensor has a rotation matrix", field="bar.vehicle_from_sensor", limit="S rotations, 3 x 3"
            )
        delays = tuple(float(d) for d in self.axis_delay_s)
        if len(delays) != 3 or not all(abs(d) <= MAX_DELAY_S for d in delays):
            raise InvalidParameter("three delays", field="bar.axis_delay_s", limit="-0.01 to 0.01 s")
        if self.clearance_m is not None and not MIN_CLEARANCE_M <= self.clearance_m <= MAX_CLEARANCE_M:
            raise InvalidParameter(
                f"the clearance is {self.clearance_m:g} m",
                field="bar.clearance_m",
                limit=f"{MIN_CLEARANCE_M:g} to {MAX_CLEARANCE_M:g} m",
                cure="give the height of the array sensors above the road, or leave it out to have it estimated",
            )
        object.__setattr__(self, "positions_m", positions)
        object.__setattr__(self, "roles", roles)
        object.__setattr__(self, "vehicle_from_sensor", turns)
        object.__setattr__(self, "axis_delay_s", delays)

    @classmethod
    def metro(
        cls, *, forward_m: float = 0.0, references: bool = True, clearance_m: float | None = None
    ) -> MagnetometerBar:
        """METRO's bar: twelve sensors 16 cm apart, and one in each wheel well.

        The order is the array's own: 0-5 the left half outwards, 6 the left reference, 7-12 the right half outwards,
        13 the right reference (reference/formats of the firmware). The references' places are those of a compact car.

        Parameters
        ----------
        forward_m : float
            Of the bar, ahead of the point that moves along the heading. [m]
        references : bool
            With the two reference sensors.
        clearance_m : float, optional
            Above the road, if it is known. [m]
        """
        half = [(forward_m, 0.08 + 0.16 * i, 0.0) for i in range(6)]
        reference = [(forward_m - 0.62, 0.72, 0.52)] if references else []
        left = half + reference
        positions = np.array(left + [(x, -y, z) for x, y, z in left])
        roles = ([SensorRole.ARRAY] * 6 + [SensorRole.REFERENCE] * len(reference)) * 2
        return cls(positions, tuple(roles), clearance_m=clearance_m)

    @property
    def sensor_count(self) -> int:
        """S."""
        return len(self.roles)

    @property
    def array(self) -> npt.NDArray[np.intp]:
        """Indices of the array sensors."""
        return np.array([i for i, role in enumerate(self.roles) if role is SensorRole.ARRAY], np.intp)

    @property
    def references(self) -> npt.NDArray[np.intp]:
        """Indices of the reference sensors."""
        return np.array([i for i, role in enumerate(self.roles) if role is SensorRole.REFERENCE], np.intp)


# === What is declared of a bar.


Triple = tuple[Number, Number, Number]


class SensorDeclaration(Declaration):
    """One magnetometer of the bar."""

    position_m: Triple = Field(description="Forward, left, up in the vehicle (ISO 8855). [m]")
    role: SensorRole = SensorRole.ARRAY
    vehicle_from_sensor: tuple[Triple, Triple, Triple] | None = Field(
        None, description="Rotation of the chip; with it `axes` is not needed."
    )


class BarDeclaration(Declaration):
    """The bar of magnetometers; METRO's twelve and two where no sensors are declared."""

    forward_m: Number = Field(0.0, ge=-20, le=20, description="Ahead of the point that moves along the heading. [m]")
    clearance_m: Number | None = Field(
        None,
        ge=MIN_CLEARANCE_M,
        le=MAX_CLEARANCE_M,
        description="Height of the array sensors above the road; left out, three magnets or more show it. [m]",
    )
    sensors: tuple[SensorDeclaration, ...] | None = Field(None, min_length=3, max_length=MAX_SENSORS)

    @model_validator(mode="after")
    def _is_a_bar(self) -> BarDeclaration:
        _ = self.magnetometers  # refuses sensors that are no bar
        return self

    @cached_property
    def magnetometers(self) -> MagnetometerBar:
        """The bar."""
        if not self.sensors:
            return MagnetometerBar.metro(forward_m=self.forward_m, clearance_m=self.clearance_m)
        positions = np.array([sensor.position_m for sensor in self.sensors])
        positions[:, 0] += self.forward_m
        turns = [sensor.vehicle_from_sensor or np.eye(3) for sensor in self.sensors]
        roles = tuple(sensor.role for sensor in self.sensors)
        return MagnetometerBar(positions, roles, np.array(turns, float), clearance_m=self.clearance_m)

    @property
    def is_turned(self) -> bool:
        """Whether the rotation of a sensor is declared."""
        return any(sensor.vehicle_from_sensor for sensor in self.sensors or ())


# === The trace that a bar records.


@dataclass(frozen=True, slots=True, eq=False)
class MagnetTrace:
    """What a bar and its vehicle recorded, whole or a piece of it.

    Raises
    ------
    InvalidParameter
        Shapes that do not fit, time that stands still or runs backwards, speeds or headings that are not finite.
    """

    t_s: Floats  # shape (T,): [s] Monotonic time of each sample
    field_ut: npt.NDArray[np.floating]  # shape (T, S, 3): [uT] in vehicle axes (ISO 8855); NaN where nothing was read
    # `speed_t_s`, `speed_m_s`: shape (V,): speed over ground and its times. [s, m/s]
    speed_t_s: Floats
    speed_m_s: Floats
    # `heading_t_s`, `heading_deg`: shape (H,), or None: heading, clockwise from north, and its times. [s, deg]
    heading_t_s: Floats | None = None
    heading_deg: Floats | None = None

    def __post_init__(self) -> None:
        t, b = np.asarray(self.t_s, float), np.asarray(self.field_ut)
        if b.ndim != 3 or b.shape[2] != 3 or len(b) != len(t):
            raise InvalidParameter(
                f"{len(t)} times and a field of shape {b.shape}", field="trace.field_ut", limit="shape (T, S, 3)"
            )
        _check_times(t, "trace.t_s")
        object.__setattr__(self, "t_s", t)
        object.__setattr__(self, "field_ut", b)
        self._check_series("speed_t_s", "speed_m_s")
        if (self.heading_t_s is None) != (self.heading_deg is None):
            raise InvalidParameter("headings come with their times", field="trace.heading_t_s", limit="both or none")
        if self.heading_t_s is not None:
            self._check_series("heading_t_s", "heading_deg")

    def _check_series(self, times: str, values: str) -> None:
        t, v = np.asarray(getattr(self, times), float), np.asarray(getattr(self, values), float)
        _check_times(t, f"trace.{times}")
        if t.shape != v.shape or not np.isfinite(v).all():
            raise InvalidParameter(
                f"{values} is one finite value for each time", field=f"trace.{values}", limit="finite"
            )
        object.__setattr__(self, times, t)
        object.__setattr__(self, values, v)

    @property
    def rate_hz(self) -> float:
        """Median sample rate; 0 for fewer than two samples. [Hz]"""
        return float(1 / np.median(np.diff(self.t_s))) if len(self.t_s) > 1 else 0.0

    def between(self, start_s: float, end_s: float) -> MagnetTrace:
        """The piece with start <= t < end of every series."""

        def cut(t: Floats) -> slice:
            return slice(*(int(i) for i in np.searchsorted(t, (start_s, end_s))))

        at, speed = cut(self.t_s), cut(self.speed_t_s)
        heading = None if self.heading_t_s is None else cut(self.heading_t_s)
        return MagnetTrace(
            self.t_s[at], self.field_ut[at], self.speed_t_s[speed], self.speed_m_s[speed],
            None if self.heading_t_s is None or heading is None else self.heading_t_s[heading],
            None if self.heading_deg is None or heading is None else self.heading_deg[heading],
        )  # fmt: skip


def _check_times(t: Floats, name: str) -> None:
    if t.ndim != 1 or not np.isfinite(t).all():
        raise InvalidParameter("times are one row of finite seconds", field=name, limit="finite")
    if t.size > 1 and (bad := np.flatnonzero(np.diff(t) <= 0)).size:
        raise InvalidParameter(
            f"time does not rise from row {bad[0]} ({t[bad[0]]:.6f} s) to the next ({t[bad[0] + 1]:.6f} s)",
            field=name,
            limit="rising",
            cure="sort the rows, or cut the trace where the clock was set",
        )
