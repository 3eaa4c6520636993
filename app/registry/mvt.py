"""Mapbox Vector Tiles 2.1 of points, for databases that cannot write them. Sections are those of the specification."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

EXTENT = 4096
_POINT = 1
_MOVE_TO_ONCE = 9  # 4.3.1: command 1, count 1
Value = str | int | float | bool


def write_layer(
    name: str, names: Sequence[str], points_px: npt.NDArray[np.int64], values: Iterable[Sequence[Value | None]]
) -> bytes:
    """A tile with one layer of points.

    Parameters
    ----------
    name : str
        Name of the layer.
    names : sequence of str
        Names of the properties.
    points_px : ndarray of int64, shape (N, 2)
        Right of and down from the tile's north-west corner; the tile is `EXTENT` wide. [px]
    values : iterable of sequences, length N
        Values of the properties of each point; None is left out.

    Returns
    -------
    bytes
        Empty without points (4.1: a layer holds a feature at least).
    """
    if not len(points_px):
        return b""
    zigzag = (points_px << 1) ^ (points_px >> 63)  # 4.3.2
    numbers: dict[tuple[type, Value], int] = {}
    parts = [b"\x0a", _text(name)]
    for (right, down), row in zip(zigzag.tolist(), values, strict=True):
        tags = bytearray()
        for k, value in enumerate(row):
            if value is not None:
                tags += _varint(k)
                tags += _varint(numbers.setdefault((type(value), value), len(numbers)))
        geometry = bytes((_MOVE_TO_ONCE,)) + _varint(right) + _varint(down)
        feature = b"\x12" + _sized(bytes(tags)) + bytes((0x18, _POINT)) + b"\x22" + _sized(geometry)
        parts += (b"\x12", _sized(feature))
    for key in names:
        parts += (b"\x1a", _text(key))
    for _, value in numbers:
        parts += (b"\x22", _sized(_value(value)))
    parts.append(b"\x28" + _varint(EXTENT) + b"\x78\x02")  # extent, version 2
    return b"\x1a" + _sized(b"".join(parts))


def _value(value: Value) -> bytes:
    if isinstance(value, str):
        return b"\x0a" + _text(value)
    if isinstance(value, bool):
        return b"\x38" + bytes((value,))
    if isinstance(value, int):
        return b"\x30" + _varint((value << 1) ^ (value >> 63))
    return b"\x19" + np.float64(value).tobytes()


def _text(text: str) -> bytes:
    return _sized(text.encode())


def _sized(content: bytes) -> bytes:
    return _varint(len(content)) + content


def _varint(value: int) -> bytes:
    if value < 0x80:
        return bytes((value,))
    made = bytearray()
    while value >= 0x80:
        made.append(value & 0x7F | 0x80)
        value >>= 7
    made.append(value)
    return bytes(made)
