"""A trace as METRO's recorder and array write it: three CSV files, or the serial stream."""

from __future__ import annotations

import io

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.formats.traces.wire import write_stream
from app.sensors.magnetometer_bar import MagnetTrace

Floats = npt.NDArray[np.float64]

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
