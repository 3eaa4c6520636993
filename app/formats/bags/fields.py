"""Magnetic fields and speeds of a bag: one topic for each magnetometer, with the times of the messages' headers."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, UploadTooLarge
from app.formats.bags.messages import Bag, describe_topics, detect_bag, open_bag, types_of
from app.formats.spooled_file import SpooledFile

Floats = npt.NDArray[np.float64]
FIELDS = types_of("sensor_msgs", "MagneticField")
_SPEEDS: dict[str, Callable[[Any], float]] = {
    **dict.fromkeys(types_of("geometry_msgs", "TwistStamped"), lambda m: m.twist.linear.x),
    **dict.fromkeys(types_of("geometry_msgs", "TwistWithCovarianceStamped"), lambda m: m.twist.twist.linear.x),
    **dict.fromkeys(types_of("nav_msgs", "Odometry"), lambda m: m.twist.twist.linear.x),
}
"""Speed along the vehicle's x axis by type. [m/s]"""
_APART = 3.0
"""A sensor has no value where its nearest ones are farther apart, in median intervals. Source: chosen by hand."""


class BagFields(NamedTuple):
    """What a bag records of a trace.

    Attributes
    ----------
    t_s : ndarray, shape (N,)
        Times of the first sensor. [s since 1970]
    field_t : ndarray, shape (N, S, 3)
        As published; in tesla by the definition of the message.
    speed : (ndarray, ndarray) or None
        Times [s since 1970] and speeds [m/s].
    """

    t_s: Floats
    field_t: npt.NDArray[np.float32]
    speed: tuple[Floats, Floats] | None


def read_fields(file: SpooledFile, sensors: int, max_rows: int) -> BagFields:
    """Read the magnetic fields of a bag, sensor by sensor in the order of the topics' names.

    Raises
    ------
    InvalidParameter
        There are more or fewer topics of magnetic fields than sensors.
    UploadTooLarge
        A topic has more messages than `max_rows`.
    UnreadableUpload, UnsupportedUpload
        As `open_bag`.
    """
    kind = detect_bag(file.head())
    assert kind is not None  # the format was detected
    with open_bag(file, kind) as bag:
        names = sorted((topic.name for topic in bag.topics if topic.type_name in FIELDS), key=_natural)
        if len(names) != sensors:
            raise InvalidParameter(
                f"the bag has {len(names)} topics of magnetic fields, and {sensors} sensors are declared; "
                f"it has {describe_topics(bag.topics)}",
                field="sensors", limit="one topic of sensor_msgs/MagneticField for each sensor",
                cure="declare the bar's sensors, bar.sensors, in the order of the topics' names",
            )  # fmt: skip
        series = [_read(bag, name, _field, max_rows) for name in names]
        speeds = sorted((topic.name, topic.type_name) for topic in bag.topics if topic.type_name in _SPEEDS)
        speed = _read(bag, speeds[0][0], lambda m: [_SPEEDS[speeds[0][1]](m)], max_rows) if speeds else None
    t_s = series[0][0]
    field_t = np.stack([_at(t_s, *one) for one in series], axis=1).astype(np.float32)
    return BagFields(t_s, field_t, None if speed is None else (speed[0], speed[1][:, 0]))


def _field(message: Any) -> list[float]:
    field = message.magnetic_field
    return [field.x, field.y, field.z]


def _read(bag: Bag, topic: str, value: Callable[[Any], list[float]], max_rows: int) -> tuple[Floats, Floats]:
    """Times [s] and values of a topic, shape (N,) and (N, ...)."""
    times: list[float] = []
    values: list[list[float]] = []
    for sent in bag.messages([topic]):
        if len(times) >= max_rows:
            raise UploadTooLarge(
                f"{topic[:80]} has too many messages", field="file", limit=f"{max_rows}",
                cure="cut the recording into shorter ones",
            )  # fmt: skip
        message = bag.decode(sent)
        times.append(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)
        values.append(value(message))
    return np.array(times, float), np.array(values, float).reshape(len(times), -1)


def _at(t_s: Floats, own_t_s: Floats, values: Floats) -> Floats:
    """Values of a sensor at the times of another one; NaN where it has none near."""
    if own_t_s is t_s or not t_s.size:
        return values
    order = np.argsort(own_t_s, kind="stable")
    own_t_s, values = own_t_s[order], values[order]
    if own_t_s.size < 2:
        return np.full((t_s.size, 3), np.nan)
    after = np.clip(np.searchsorted(own_t_s, t_s), 1, own_t_s.size - 1)
    wide = own_t_s[after] - own_t_s[after - 1] > _APART * np.median(np.diff(own_t_s))
    missing = wide | (t_s < own_t_s[0]) | (t_s > own_t_s[-1])
    joined = np.stack([np.interp(t_s, own_t_s, column) for column in values.T], axis=1)
    joined[missing] = np.nan
    return joined


def _natural(name: str) -> list[tuple[int, str]]:
    """Names in the order that people expect: mag_2 before mag_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name[:200])]
