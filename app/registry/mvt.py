"""Mapbox Vector Tiles 2.1 of points, for databases that cannot write them. Section numbers are those of the
specification."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from types import NoneType

import numpy as np
import numpy.typing as npt

EXTENT = 4096
_POINT = 1
_MOVE_TO_ONCE = 9  # 4.3.1: command 1, count 1
# keys of fields in a message, 4.1 and the .proto: number << 3 | kind
_FEATURE, _TAGS, _TYPE, _GEOMETRY = 0x12, 0x12, 0x18, 0x22
_DOUBLE = struct.Struct("<d").pack
Value = str | int | float | bool
Numbers = npt.NDArray[np.int64]


def write_layer(name: str, columns: Mapping[str, Sequence[Value | None]], points_px: Numbers) -> bytes:
    """A tile with one layer of points.

    Parameters
    ----------
    name : str
        Name of the layer.
    columns : mapping of sequences, each of length N
        Values of each property, by its name; None is left out.
    points_px : ndarray of int64, shape (N, 2)
        Right of and down from the tile's north-west corner; the tile is `EXTENT` wide. [px]

    Returns
    -------
    bytes
        Empty without points (4.1: a layer has at least one feature).
    """
    if not len(points_px):
        return b""
    distinct = [_distinct(column) for column in columns.values()]
    parts = [b"\x0a", _text(name), _features(_tags(columns.values(), distinct), points_px)]
    for key in columns:
        parts += (b"\x1a", _text(key))
    for values in distinct:
        parts += map(_value, values)
    parts.append(b"\x28" + _varint(EXTENT) + b"\x78\x02")  # extent, version 2
    return b"\x1a" + _sized(b"".join(parts))


def _distinct(column: Sequence[Value | None]) -> list[Value]:
    """The distinct values of a column: True differs from 1, and 1 from 1.0."""
    if len({type(value) for value in column} - {NoneType}) > 1:
        raise ValueError("the values of a property are of one type")
    return [value for value in dict.fromkeys(column) if value is not None]


def _tags(columns: Iterable[Sequence[Value | None]], distinct: Sequence[Sequence[Value]]) -> Numbers:
    """Key and value of each property of each feature, shape (N, 2 x properties); -1 twice for a missing value."""
    tags, first = [], 0
    for k, (column, values) in enumerate(zip(columns, distinct, strict=True)):
        index: dict[Value | None, int] = dict(zip(values, range(first, first + len(values)), strict=True))
        index[None] = -1
        chosen = np.fromiter(map(index.__getitem__, column), np.int64, len(column))
        tags += [np.where(chosen < 0, -1, k), chosen]
        first += len(values)
    return np.column_stack(tags)


def _features(tags: Numbers, points_px: Numbers) -> bytes:
    """All features; a point's feature consists of varints only."""
    count = len(points_px)
    zigzag = (points_px << 1) ^ (points_px >> 63)  # 4.3.2
    tag_bytes = _lengths(tags).sum(axis=1)
    geometry_bytes = 1 + _lengths(zigzag).sum(axis=1)
    body_bytes = 1 + _lengths(tag_bytes) + tag_bytes + 3 + _lengths(geometry_bytes) + geometry_bytes
    numbers = np.column_stack(
        (
            *(np.full(count, _FEATURE), body_bytes, np.full(count, _TAGS), tag_bytes, tags),
            *(np.full((count, 3), (_TYPE, _POINT, _GEOMETRY)), geometry_bytes),
            *(np.full(count, _MOVE_TO_ONCE), zigzag),
        )
    )
    return _varints(numbers[numbers >= 0])


def _lengths(numbers: Numbers) -> Numbers:
    """Length of each value as a varint; 0 for a negative value, which is left out. [byte]"""
    lengths = (numbers >= 0).astype(np.int64)
    for bits in range(7, 64, 7):
        more = numbers >= np.int64(1) << np.int64(bits)
        if not more.any():
            break
        lengths += more
    return lengths


def _varints(numbers: Numbers) -> bytes:
    lengths = _lengths(numbers)
    ends = lengths.cumsum()
    out = np.empty(int(ends[-1]), np.uint8)
    for k in range(int(lengths.max())):
        has = lengths > k
        part = numbers[has] >> (7 * k) & 0x7F
        out[(ends - lengths)[has] + k] = part | np.where(lengths[has] > k + 1, 0x80, 0)
    return out.tobytes()


def _value(value: Value) -> bytes:
    """A value of the layer, with its key and size."""
    if isinstance(value, str):
        text = value.encode()
        size = len(text)
        if size < 126:  # both sizes are varints of one byte
            return b"\x22%c\x0a%c%b" % (size + 2, size, text)
        return b"\x22" + _sized(b"\x0a" + _sized(text))
    if isinstance(value, float):
        return b"\x22\x09\x19" + _DOUBLE(value)
    if isinstance(value, bool):
        return b"\x22\x02\x38" + bytes((value,))
    return b"\x22" + _sized(b"\x30" + _varint((value << 1) ^ (value >> 63)))


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
