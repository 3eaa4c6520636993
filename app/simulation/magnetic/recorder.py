"""A trace as METRO's recorder and array write it: three CSV files, or the serial stream."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.formats.traces.wire import write_stream
from app.sensors.magnetometer_bar import MagnetTrace
from app.values import Floats

# === From the field at a chip to the numbers that it sends: METRO's MLX90393 by default.


@dataclass(frozen=True, slots=True)
class Chip:
    """A magnetometer and the loop that reads it (formats of the METRO array: OSR 0, DIG_FILT 2, GAIN_SEL 7, RES 0).

    Notes
    -----
    The last four are off by default. They draw from a generator of their own, spawned from the drive's, so that all
    else in a drive stays the same with and without them.
    """

    rate_hz: float = 350.0  # [Hz] samples a second
    # `noise_ut`, `count_ut`: [uT] standard deviation of a sample and size of a count, for x, y, z
    noise_ut: tuple[float, float, float] = (1.5, 1.5, 1.9)
    count_ut: tuple[float, float, float] = (0.150, 0.150, 0.242)
    # `offset_ut`, `gain`, `misalignment_deg`, `soft_iron`: spread of the offset, of the gain, of each axis's direction,
    # and of what the car's iron adds to the earth's field, share of it. [uT, 1, deg, 1]
    offset_ut: float = 200.0
    gain: float = 0.02
    misalignment_deg: float = 1.5
    soft_iron: float = 0.05
    axis_delay_s: tuple[float, float, float] = (0.0, 0.00045, 0.0009)  # [s] axes are converted one after the other
    jitter: float = 0.03  # spread of the interval, share of it; one in a thousand is three times as long
    # `stale`, `spikes`: odds that a sensor repeats its last sample, or sends one that is far off
    stale: float = 1e-3
    spikes: float = 2e-4
    range_ut: float = math.inf  # [uT] largest field that an axis shows, its offset included: stronger ones saturate
    # `cross_axis`, `gain_error`: spread of the entries beside and on the diagonal of a 3x3 matrix about the identity,
    # which mixes the axes of each sensor after `gain` and `misalignment_deg`
    cross_axis: float = 0.0
    gain_error: float = 0.0
    stamp_jitter_s: float = 0.0  # [s] spread of the true times of samples about the recorded ones

    def sample_times_s(self, end_s: float, rng: np.random.Generator) -> Floats:
        """Times of the samples from 0 to the end."""
        n = int(end_s * self.rate_hz * 1.1) + 2
        interval = np.maximum(rng.normal(1, self.jitter, n), 0.2) / self.rate_hz
        interval[rng.random(n) < 1e-3 * (self.jitter > 0)] *= 3
        t = np.cumsum(interval)
        return t[t < end_s]

    def axes(self, sensors: int, rng: np.random.Generator) -> Floats:
        """Directions of the axes of each sensor with their gain, shape (S, 3, 3)."""
        turned = np.eye(3) + np.radians(rng.normal(0, self.misalignment_deg, (sensors, 3, 3))) * (1 - np.eye(3))
        turned /= np.linalg.norm(turned, axis=2, keepdims=True)
        scaled: Floats = turned * (1 + rng.normal(0, self.gain, (sensors, 3, 1)))
        return scaled

    def mixed_axes(self, axes: Floats, rng: np.random.Generator) -> Floats:
        """Axes of shape (S, 3, 3) mixed by each sensor's cross-axis sensitivity and gain errors."""
        if not self.cross_axis and not self.gain_error:
            return axes
        spread = self.cross_axis + (self.gain_error - self.cross_axis) * np.eye(3)
        matrix = np.eye(3) + rng.spawn(1)[0].normal(0, 1, axes.shape) * spread
        mixed: Floats = matrix @ axes
        return mixed

    def true_times_s(self, t_s: Floats, rng: np.random.Generator) -> Floats:
        """When samples were really taken, from their recorded times, shape (T,). [s]"""
        if not self.stamp_jitter_s:
            return t_s
        return np.asarray(t_s + rng.spawn(1)[0].normal(0, self.stamp_jitter_s, len(t_s)))

    def read(self, field_ut: Floats, rng: np.random.Generator) -> npt.NDArray[np.float32]:
        """What is sent, from the field along each axis: offset, noise, counts, stale and spiked samples. [uT]"""
        shape = field_ut.shape
        out = field_ut + rng.normal(0, self.offset_ut, shape[1:])
        for axis in range(3):
            out[:, :, axis] += rng.standard_normal(shape[:2], np.float32) * self.noise_ut[axis]
            if math.isfinite(self.range_ut):
                np.clip(out[:, :, axis], -self.range_ut, self.range_ut, out=out[:, :, axis])
            if count := self.count_ut[axis]:
                out[:, :, axis] = np.round(out[:, :, axis] / count) * count
        spiked = np.argwhere(rng.random(shape[:2], np.float32) < self.spikes)
        out[spiked[:, 0], spiked[:, 1]] += rng.normal(0, 300, (len(spiked), 3))
        for i, sensor in np.argwhere(rng.random(shape[:2], np.float32) < self.stale):
            if i:
                out[i, sensor] = out[i - 1, sensor]
        return out.astype(np.float32)


@dataclass(frozen=True, slots=True)
class CanBus:
    """Speed and heading as a vehicle sends them."""

    # `speed_hz`, `heading_hz`: [Hz] rates
    speed_hz: float = 10.0
    heading_hz: float = 100.0
    # `speed_latency_s`, `heading_latency_s`: [s] age of a value when it is stamped
    speed_latency_s: float = 0.05
    heading_latency_s: float = 0.02
    speed_scale: float = 0.01  # share by which it shows too much
    # `speed_count_m_s`, `heading_count_deg`: smallest steps. [m/s, deg]
    speed_count_m_s: float = 0.01 / 3.6
    heading_count_deg: float = 0.1

    def speed(self, t_s: Floats, speed_m_s: Floats) -> tuple[Floats, Floats]:
        """Times and values sent."""
        at = np.arange(0, t_s[-1], 1 / self.speed_hz)
        value = (1 + self.speed_scale) * np.interp(at - self.speed_latency_s, t_s, speed_m_s)
        return at, np.round(value / self.speed_count_m_s) * self.speed_count_m_s

    def heading(self, t_s: Floats, heading_deg: Floats) -> tuple[Floats, Floats]:
        """Times and values sent, 0 to 360 degrees."""
        at = np.arange(0, t_s[-1], 1 / self.heading_hz)
        value = np.interp(at - self.heading_latency_s, t_s, heading_deg)
        return at, np.round(value / self.heading_count_deg) * self.heading_count_deg % 360


# === A trace as METRO's recorder and array write it.


_VEHICLE_FROM_RECORDED = np.array((1.0, -1.0, -1.0), np.float32)  # FRD, as METRO's recorder writes


def write_recorder_files(
    trace: MagnetTrace, *, run: str = "drive_1", steering_wheel_deg: Floats | None = None
) -> dict[str, bytes]:
    """RawData, RawSpeed and RawSWA of a trace, by file name.

    Parameters
    ----------
    trace : MagnetTrace
        Its heading is not written: the recorder has none.
    run : str
        End of the files' names.
    steering_wheel_deg : ndarray, shape (T,), optional
        Angle of the steering wheel at each sample; straight ahead if left out. [deg]

    Notes
    -----
    Axes are FRD, speeds km/h. As the recorder does, each sample repeats the last speed that the bus has sent.
    """
    return {
        f"RawData_{run}.csv": _raw_data(trace),
        f"RawSpeed_{run}.csv": _series(trace.t_s, "Speed", 3.6 * _latest_speed(trace)),
        f"RawSWA_{run}.csv": _series(
            trace.t_s, "SWA", np.zeros(len(trace.t_s)) if steering_wheel_deg is None else steering_wheel_deg
        ),
    }


def write_array_stream(trace: MagnetTrace) -> bytes:
    """The array's serial stream of a trace; it holds neither speed nor heading."""
    return write_stream(trace.t_s, _recorded(trace))


def _recorded(trace: MagnetTrace) -> npt.NDArray[np.float32]:
    field: npt.NDArray[np.float32] = trace.field_ut.astype(np.float32) * _VEHICLE_FROM_RECORDED
    return field


def _raw_data(trace: MagnetTrace) -> bytes:
    field = _recorded(trace).astype(float)
    sensors = field.shape[1]
    row = "%d,%r," + ",".join(['"(%r, %r, %r)"'] * sensors) + "\n"
    out = io.StringIO()
    out.write(",Time Stamp," + ",".join(f"Sensor {i}" for i in range(1, sensors + 1)) + "\n")
    for i, (t, values) in enumerate(zip(trace.t_s.tolist(), field.reshape(len(field), -1).tolist(), strict=True)):
        out.write(row % (i, t, *values))
    return out.getvalue().encode()


def _latest_speed(trace: MagnetTrace) -> Floats:
    """The last speed sent before each sample, the first one before any. [m/s]"""
    if not trace.speed_t_s.size:
        raise InvalidParameter("the trace has no speed", field="trace.speed_m_s", limit="one value or more")
    latest: Floats = trace.speed_m_s[np.maximum(np.searchsorted(trace.speed_t_s, trace.t_s, side="right") - 1, 0)]
    return latest


def _series(t_s: Floats, name: str, values: Floats) -> bytes:
    lines = [f"{i},{t!r},{v!r}\n" for i, (t, v) in enumerate(zip(t_s.tolist(), values.tolist(), strict=True))]
    return (f",Time Stamp,{name}\n" + "".join(lines)).encode()


def write_tables(trace: MagnetTrace) -> dict[str, bytes]:
    """A trace with its speed and heading as plain CSV, by file name: fields in uT and the axes of ISO 8855.

    Values are rounded to 0.001 uT, a hundredth of what a chip resolves.
    """
    names = [f"s{k}_{axis}" for k in range(1, trace.field_ut.shape[1] + 1) for axis in "xyz"]
    flat = trace.field_ut.reshape(len(trace.t_s), -1)
    files = {"field.csv": _table(["t_s", *names], np.column_stack([trace.t_s, flat]), "%.6f" + ",%.3f" * len(names))}
    files["speed.csv"] = _table(["t_s", "speed_m_s"], np.column_stack([trace.speed_t_s, trace.speed_m_s]), "%.6f,%.5f")
    if trace.heading_t_s is not None and trace.heading_deg is not None:
        values = np.column_stack([trace.heading_t_s, trace.heading_deg])
        files["heading.csv"] = _table(["t_s", "heading_deg"], values, "%.6f,%.3f")
    return files


def _table(names: list[str], values: Floats, row: str) -> bytes:
    """CSV; empty cells for NaN."""
    text = (row + "\n") * len(values) % tuple(values.ravel().tolist())
    return (",".join(names) + "\n" + text.replace("nan", "")).encode()
