"""Files of METRO's recorder: RawData, RawSpeed and RawSWA, written by pandas with tuples as text."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from app.formats.columns import require_columns
from app.formats.delimited import Dialect, NumberColumns
from app.formats.traces.declaration import TraceLimits
from app.formats.traces.parts import Part
from app.formats.traces.report import TraceReport
from app.formats.traces.text_table import read_header, read_rows

Floats = npt.NDArray[np.float64]

TIME = "Time Stamp"
_TUPLES = Dialect(removed=b'"()')
_CURE = "send the recorder's files as they were written, or declare the columns of a plain CSV"


def read_raw_data(
    part: Part, sensors: int, limits: TraceLimits, report: TraceReport
) -> tuple[Floats, npt.NDArray[np.float32]]:
    """Times (T,) [s] and fields (T, S, 3) [uT], as recorded.

    Raises
    ------
    InvalidParameter
        Columns are missing.
    UploadTooLarge, UnreadableUpload
    """
    names = read_header(part, ",")
    wanted = [f"Sensor {i}" for i in range(1, sensors + 1)]
    require_columns(part.name, names, [TIME, *wanted], cure=_CURE)
    place: dict[str, int] = {}
    at = 0
    for name in names:  # a tuple takes three cells once its brackets are gone
        place[name] = at
        at += 3 if name.startswith("Sensor ") else 1
    places = (place[TIME], *(place[name] + axis for name in wanted for axis in range(3)))
    t, field = [], []
    for rows in read_rows(part, NumberColumns(part.name, places, at, _TUPLES), limits, report):
        t.append(rows[:, 0])
        with np.errstate(over="ignore"):
            field.append(rows[:, 1:].astype(np.float32).reshape(-1, sensors, 3))
    if not t:
        return np.empty(0), np.empty((0, sensors, 3), np.float32)
    return np.concatenate(t), np.concatenate(field)


def read_raw_series(part: Part, column: str, limits: TraceLimits, report: TraceReport) -> tuple[Floats, Floats]:
    """Times [s] and values of RawSpeed (`Speed`, km/h) or RawSWA (`SWA`, degrees).

    The recorder repeats the last CAN value with each sample; only changes and one value a tenth of a second are kept.

    Raises
    ------
    InvalidParameter
        Columns are missing.
    """
    names = read_header(part, ",")
    require_columns(part.name, names, [TIME, column], cure=_CURE)
    columns = NumberColumns(part.name, (names.index(TIME), names.index(column)), len(names))
    blocks = list(read_rows(part, columns, limits, report))
    rows = np.concatenate(blocks) if blocks else np.empty((0, 2))
    return thin_held(rows[:, 0], rows[:, 1])


def thin_held(t: Floats, value: Floats, hold_s: float = 0.1) -> tuple[Floats, Floats]:
    """Values that were held between updates, at their updates: interpolating stairs would lag by half a step."""
    if len(t) < 3 or np.mean(value[1:] == value[:-1]) < 0.5:
        return t, value
    keep = np.flatnonzero(np.concatenate(([True], value[1:] != value[:-1])))
    ends = np.concatenate((keep[1:], [len(t)]))
    long = np.flatnonzero(t[ends - 1] - t[keep] > 1.5 * hold_s)
    between = [np.searchsorted(t, np.arange(t[keep[i]] + hold_s, t[ends[i] - 1], hold_s)) for i in long]
    at = np.unique(np.concatenate([keep, [len(t) - 1], *between]))
    return t[at], value[at]
