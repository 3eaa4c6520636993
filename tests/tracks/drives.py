"""A simulated drive as a vehicle's sensors report it: speeds, headings, and fixes by markers of two sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy import signal

from app.geodesy.frames import metres_per_radian
from app.tracks import Clock, PositionFix, Samples, Track, TrackInput
from app.values import Floats

T0_S = 1_760_000_000.0
STEP_S = 0.02


@dataclass(frozen=True, eq=False)
class Truth:
    """Where the vehicle was, every 20 ms; angles in radians."""

    time_s: Floats
    lon: Floats
    lat: Floats
    heading: Floats
    speed_m_s: Floats

    def errors_m(self, track: Track) -> Floats:
        """East and north of the true places from the track's, at its times, shape (N, 2)."""
        lon, lat = (np.interp(track.time_s, self.time_s, values) for values in (self.lon, self.lat))
        east, north = metres_per_radian(lat)
        off = (lon - np.radians(track.lon_deg) + np.pi) % (2 * np.pi) - np.pi
        return np.column_stack([off * east, (lat - np.radians(track.lat_deg)) * north])

    def rms_m(self, track: Track) -> float:
        inside = (track.time_s >= self.time_s[0]) & (track.time_s <= self.time_s[-1])
        return float(np.sqrt((self.errors_m(track)[inside] ** 2).sum(1).mean()))


def drive(
    seconds: float, *, lon_deg: float = 8.0, lat_deg: float = 49.0, speed: object = None, turning: object = None
) -> Truth:
    """A drive on the ellipsoid; speed [m/s] and heading [rad] are functions of the time."""
    t = np.arange(0.0, seconds, STEP_S)
    v = speed(t) if callable(speed) else 14 + 5 * np.sin(2 * np.pi * t / 50)
    psi = turning(t) if callable(turning) else 0.7 + 0.8 * np.sin(2 * np.pi * t / 80)
    lat = np.empty(t.size)
    lon = np.empty(t.size)
    at_lon, at_lat = math.radians(lon_deg), math.radians(lat_deg)
    for k in range(t.size):
        lon[k], lat[k] = at_lon, at_lat
        east, north = (float(value) for value in metres_per_radian(np.float64(at_lat)))
        at_lon += v[k] * math.sin(psi[k]) * STEP_S / east
        at_lat += v[k] * math.cos(psi[k]) * STEP_S / north
    return Truth(T0_S + t, lon, lat, psi, v)


@dataclass
class Recording:
    """Fixes of a drive, and which of them are wrong on purpose."""

    truth: Truth
    rng: np.random.Generator
    fixes: list[PositionFix] = field(default_factory=list)
    wrong: set[int] = field(default_factory=set)

    def see(
        self, at_s: float, *, clock: str = "camera", late_s: float = 0.0, off_m: tuple[float, float] = (0.0, 0.0),
        sigma_m: float = 0.08, marker: str | None = None, heading: bool = True,
        decode_id: str = "",
    ) -> None:  # fmt: skip
        """A fix `at_s` after the start; the clock is `late_s` behind; a wrong one is `off_m` away."""
        k = min(round(at_s / STEP_S), len(self.truth.time_s) - 1)
        east, north = (float(v) for v in metres_per_radian(np.float64(self.truth.lat[k])))
        error = self.rng.normal(0, sigma_m, 2) + off_m
        number = len(self.fixes)
        if off_m != (0.0, 0.0):
            self.wrong.add(number)
        lon_deg = math.degrees(self.truth.lon[k] + error[0] / east)
        self.fixes.append(
            PositionFix(
                clock, float(self.truth.time_s[k]) - late_s, (lon_deg + 180) % 360 - 180,
                math.degrees(self.truth.lat[k] + error[1] / north), (sigma_m**2, 0.0, sigma_m**2),
                math.degrees(self.truth.heading[k]) % 360 + self.rng.normal(0, 0.5) if heading else math.nan,
                0.5 if heading else math.nan, 0.0, marker or f"m{number}", "plate",
                decode_id or f"picture {number}", number,
            )
        )  # fmt: skip

    def along(
        self, every_s: float, start_s: float = 3.0, end_s: float = math.inf, *, clock: str = "camera",
        late_s: float = 0.0, sigma_m: float = 0.08, marker: str | None = None,
    ) -> Recording:  # fmt: skip
        """Fixes at even times."""
        last = min(end_s, float(self.truth.time_s[-1] - self.truth.time_s[0]) - 1.0)
        for at in np.arange(start_s, last, every_s):
            self.see(float(at), clock=clock, late_s=late_s, sigma_m=sigma_m, marker=marker, decode_id="upload")
        return self

    def track_input(
        self, *, samples: bool = True, clocks: tuple[Clock, ...] = (), scale: float = 1.02, bias_deg: float = 1.0
    ) -> TrackInput:
        """All of it, with speeds and headings at 10 Hz by the clock `trace`."""
        truth, every = self.truth, slice(None, None, 5)
        t = truth.time_s[every]
        drift = self._drift(t.size, 0.003)
        speeds = Samples("trace", t, truth.speed_m_s[every] * (scale + drift) + self.rng.normal(0, 0.05, t.size), 0.05)
        heading = np.degrees(truth.heading[every]) + bias_deg + self.rng.normal(0, 0.3, t.size)
        heading += self._drift(t.size, 0.5)
        headings = Samples("trace", t, heading % 360, 0.3)
        known = clocks or (Clock("trace"), Clock("camera"))
        return TrackInput(known, tuple(self.fixes), (speeds,) if samples else (), (headings,) if samples else ())

    def _drift(self, count: int, sigma: float) -> Floats:
        """An error that changes within a minute, as scale and bias do."""
        keep = math.exp(-0.1 / 60.0)
        noise = self.rng.normal(0, sigma, count) * math.sqrt(1 - keep**2)
        noise[0] = self.rng.normal(0, sigma)
        return np.asarray(signal.lfilter([1.0], [1.0, -keep], noise))

    def left_out(self, track: Track) -> set[int]:
        return {result.fix.place for result in track.fixes if not result.used}


def recording(truth: Truth, seed: int = 1) -> Recording:
    return Recording(truth, np.random.default_rng(seed))
