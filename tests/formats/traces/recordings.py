"""Recordings that the tests read."""

from __future__ import annotations

import io
import zipfile

import numpy as np

from app.sensors.magnetometer_bar import BarDeclaration, MagnetTrace

FRD = np.array((1.0, -1.0, -1.0), np.float32)


def make_trace(samples: int = 2000, *, seed: int = 0, offset_ut: float = 200.0, sensors: int = 14) -> MagnetTrace:
    """A drive without magnets: offsets, noise, the earth's field turning, speed at 10 Hz and heading at 100 Hz."""
    rng = np.random.default_rng(seed)
    interval = np.maximum(rng.normal(1, 0.03, samples), 0.2) / 350
    interval[rng.random(samples) < 1e-3] *= 3
    t = np.cumsum(interval)
    t -= t[0]
    field = rng.normal(0, offset_ut, (sensors, 3)) + rng.normal(0, 1.6, (samples, sensors, 3)) + (15, 0, -50)
    field[:, :, :2] += 18 * np.stack([np.cos(t / 9), np.sin(t / 9)], 1)[:, None]
    speed_t = np.arange(0, t[-1] + 0.1, 0.1)
    speed = np.round((13 + 2 * np.sin(speed_t / 3)) * 360) / 360
    heading_t = np.arange(0, t[-1], 0.01)
    return MagnetTrace(t, field.astype(np.float32), speed_t, speed, heading_t, (355 + 2 * heading_t) % 360)


def bar_of(sensors: int, turns: np.ndarray | None = None) -> BarDeclaration:
    """A bar of so many sensors in a row, without references; `turns` are rotations of its chips."""
    rotations = [None] * sensors if turns is None else turns.tolist()
    row = [{"position_m": (0.0, 0.16 * k, 0.0), "vehicle_from_sensor": rotations[k]} for k in range(sensors)]
    return BarDeclaration.model_validate({"sensors": row})


def plain_csv(
    trace: MagnetTrace, *, scale: float = 1.0, delimiter: str = ",", decimal: str = ".", rows: slice = slice(None)
) -> bytes:
    """A CSV file with the default names of columns, and the speed in it."""
    names = [f"s{i}_{axis}" for i in range(1, trace.field_ut.shape[1] + 1) for axis in "xyz"]
    lines = [delimiter.join(["t_s", *names, "speed_m_s"])]
    speed = np.interp(trace.t_s, trace.speed_t_s, trace.speed_m_s)
    flat = trace.field_ut.reshape(len(trace.t_s), -1) * scale
    for t, values, v in zip(trace.t_s[rows], flat[rows], speed[rows], strict=True):
        cells = [f"{t:.6f}", *(f"{x:.7g}" for x in values), f"{v:.4f}"]
        lines.append(delimiter.join(c.replace(".", decimal) for c in cells))
    return ("\n".join(lines) + "\n").encode()


def zipped(files: dict[str, bytes]) -> bytes:
    """A ZIP archive of files."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return out.getvalue()
