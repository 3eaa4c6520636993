"""A bag as a drive: the pictures of one topic in the order of their times, and the vehicle's track."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge, WaymarkError
from app.formats.bags.messages import FIELD, Bag, BagKind, Topic, describe_topics, detect_bag, open_bag, types_of
from app.formats.format import SpooledFile
from app.formats.images import ImageLimits, inspect_image, load_image
from app.formats.logs import LogReport
from app.formats.poses import track_of
from app.formats.text import count_of
from app.formats.video_file import (
    PictureFrame,
    ReadReport,
    VideoFile,
    VideoIndex,
    VideoKind,
    VideoLimits,
    VideoSegment,
    cut_segments,
    find_time_gaps,
)
from app.sensors.pose_track import PosePoint, PoseTrack
from app.values import Floats

# === Pictures of bags: compressed ones, and raw ones with their rows of bytes.


COMPRESSED = types_of("sensor_msgs", "CompressedImage")
RAW = types_of("sensor_msgs", "Image")
_TO_BGR = {
    "bgr8": (3, None),
    "8UC3": (3, None),
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "mono8": (1, cv2.COLOR_GRAY2BGR),
    "8UC1": (1, cv2.COLOR_GRAY2BGR),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2BGR),
    **dict.fromkeys(("uyvy", "yuv422"), (2, cv2.COLOR_YUV2BGR_UYVY)),
    **dict.fromkeys(("yuyv", "yuv422_yuy2"), (2, cv2.COLOR_YUV2BGR_YUY2)),
}
"""Bytes of a pixel and conversion by encoding. Source: sensor_msgs/image_encodings.hpp."""


def size_px(type_name: str, message: Any, limits: ImageLimits) -> tuple[int, int]:
    """Width and height of a picture, from its header. [px]"""
    if type_name in COMPRESSED:
        header = inspect_image(bytes(message.data), limits)
        return header.width_px, header.height_px
    width, height = int(message.width), int(message.height)
    if width * height > limits.pixels:
        raise UploadTooLarge(f"a picture has {width} x {height} pixels", field=FIELD, limit=f"{limits.pixels} pixels")
    _check_raw(message)
    return width, height


def pixels_of(type_name: str, message: Any) -> npt.NDArray[np.uint8]:
    """A picture as blue, green, red, shape (height, width, 3)."""
    if type_name in COMPRESSED:
        return load_image(bytes(message.data)).pixels
    bytes_each, conversion = _check_raw(message)
    rows = np.frombuffer(bytes(message.data), np.uint8)[: message.height * message.step]
    used = rows.reshape(message.height, message.step)[:, : message.width * bytes_each]
    pixels = used.reshape((message.height, message.width, bytes_each)[: 2 if bytes_each == 1 else 3])
    return np.ascontiguousarray(pixels) if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion))


def _check_raw(message: Any) -> tuple[int, int | None]:
    encoding = str(message.encoding)
    if encoding not in _TO_BGR:
        raise UnsupportedUpload(
            f"pictures with the encoding {encoding[:40]!r} are not read", field=FIELD, limit=", ".join(_TO_BGR),
            cure="record another encoding, or the topic of compressed pictures",
        )  # fmt: skip
    if encoding.startswith(("yuv", "yuyv", "uyvy")) and message.width % 2:
        raise UnreadableUpload(f"a picture in {encoding} has an odd width", field=FIELD, cure="record it again")
    bytes_each, _ = _TO_BGR[encoding]
    has_rows = 0 < message.width * bytes_each <= message.step and message.height > 0
    if not has_rows or len(message.data) < message.height * message.step:
        raise UnreadableUpload("a picture has fewer bytes than its size needs", field=FIELD, cure="record it again")
    return _TO_BGR[encoding]


# === Magnetic fields and speeds of a bag: one topic for each magnetometer, with the times of the messages' headers.


FIELDS = types_of("sensor_msgs", "MagneticField")
_SPEEDS: dict[str, Callable[[Any], float]] = {
    **dict.fromkeys(types_of("geometry_msgs", "TwistStamped"), lambda m: m.twist.linear.x),
    **dict.fromkeys(types_of("geometry_msgs", "TwistWithCovarianceStamped"), lambda m: m.twist.twist.linear.x),
    **dict.fromkeys(types_of("nav_msgs", "Odometry"), lambda m: m.twist.twist.linear.x),
}
"""Speed along the vehicle's x axis by type. [m/s]"""
_APART = 3.0
"""A sensor has no value where its nearest ones are farther apart, in median intervals."""


class BagFields(NamedTuple):
    """What a bag records of a trace."""

    t_s: Floats  # shape (N,): times of the first sensor. [s since 1970]
    field_t: npt.NDArray[np.float32]  # shape (N, S, 3): as published; in tesla by the definition of the message
    speed: tuple[Floats, Floats] | None  # [m/s] times [s since 1970] and speeds
    unused_speeds: tuple[str, ...]  # topics of further speeds


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
                field="sensors",
                limit="one topic of sensor_msgs/MagneticField for each sensor",
                cure="declare the bar's sensors, bar.sensors, in the order of the topics' names",
            )
        series = [_read(bag, name, _field, max_rows) for name in names]
        speeds = sorted((topic.name, topic.type_name) for topic in bag.topics if topic.type_name in _SPEEDS)
        speed = _read(bag, speeds[0][0], lambda m: [_SPEEDS[speeds[0][1]](m)], max_rows) if speeds else None
    t_s = series[0][0]
    field_t = np.stack([_at(t_s, *one) for one in series], axis=1).astype(np.float32)
    unused = tuple(name for name, _type in speeds[1:])
    return BagFields(t_s, field_t, None if speed is None else (speed[0], speed[1][:, 0]), unused)


def _field(message: Any) -> list[float]:
    field = message.magnetic_field
    return [field.x, field.y, field.z]


def _read(bag: Bag, topic: str, value: Callable[[object], list[float]], max_rows: int) -> tuple[Floats, Floats]:
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


# === A bag as a drive.


FIXES = types_of("sensor_msgs", "NavSatFix")
MAX_FIXES = 200_000
"""[positions] as `PoseLimits`."""
_KINDS = {VideoKind(kind): kind for kind in BagKind}
_NS = 1e-9
_SINCE_NS, _UNTIL_NS = 946_684_800 * 10**9, 4_102_444_800 * 10**9
"""[ns since 1970] 2000 and 2100: other times were written without a clock."""
_CLOCKS_AGREE_S = 1.0
"""[s] between exposure and recording in a live recording; larger in one that was played and recorded again."""


class _Times(NamedTuple):
    """Times of the messages of a topic in the order of recording, shape (N,). [ns since 1970]"""

    recorded_ns: npt.NDArray[np.int64]
    stamp_ns: npt.NDArray[np.int64]  # of their headers

    @property
    def are_stamped(self) -> bool:
        """Whether the headers have times of a clock."""
        return bool(np.all((self.stamp_ns >= _SINCE_NS) & (self.stamp_ns < _UNTIL_NS)))


def index_bag(file: VideoFile, limits: VideoLimits) -> VideoIndex:
    """List the pictures of a bag; raises as `index_video`, or `UnsupportedUpload` where bags are not read.

    Times are the stamps of the messages' headers, which are those of exposure; the times of recording only where a
    topic that is used has no stamps.
    """
    with open_bag(file.file, _KINDS[file.kind]) as bag:
        topic, warnings = _choose_topic(bag)
        listed: list[tuple[int, int]] = []
        first: tuple[int, int] | None = None
        for message in bag.messages([topic.name]):
            if first is None:
                first = size_px(topic.type_name, bag.decode(message), ImageLimits(pixels=limits.pixels))
            listed.append((message.time_ns, message.stamp_ns))
            if len(listed) > limits.frames:
                raise UploadTooLarge("the bag has too many pictures", field=FIELD, limit=f"{limits.frames}")
        if first is None:
            raise _without_pictures(bag.topics)
        pictures = _Times(*np.array(listed, np.int64).T)
        receiver = _choose_receiver(bag, warnings)
    by_stamp = pictures.are_stamped and (receiver is None or receiver.times.are_stamped)
    _compare_clocks(pictures, by_stamp, warnings)
    frame_ns, recorded_ns = _rising(pictures.stamp_ns if by_stamp else pictures.recorded_ns, pictures.recorded_ns)
    if len(frame_ns) < len(listed):
        left_out = count_of(len(listed) - len(frame_ns), "picture")
        warnings.append(f"{left_out} left out, with the time of another one or out of order")
    if not _SINCE_NS <= frame_ns[0] < _UNTIL_NS:
        raise UnreadableUpload(
            "the bag's pictures have no time between 2000 and 2100", field=FIELD, cure="record with the clock set"
        )
    time_s = (frame_ns - frame_ns[0]).astype(float) * _NS
    if time_s[-1] > limits.duration_s:
        raise UploadTooLarge(f"the bag takes {time_s[-1]:.0f} s", field=FIELD, limit=f"{limits.duration_s:g} s")
    segments = cut_segments(time_s, np.ones(len(frame_ns), bool), limits)
    began_at = datetime.fromtimestamp(float(frame_ns[0]) * _NS, UTC)
    return VideoIndex(
        file, topic.name, *first, recorded_ns, time_s, segments, began_at, tuple(find_time_gaps(time_s)),
        tuple(warnings), has_clock=True, track=_track_of(receiver, by_stamp, warnings),
    )  # fmt: skip


def _compare_clocks(pictures: _Times, by_stamp: bool, warnings: list[str]) -> None:
    if not by_stamp:
        warnings.append("messages have no time between 2000 and 2100 in their headers; the times of recording are used")
        return
    late_s = float(np.median(pictures.recorded_ns - pictures.stamp_ns)) * _NS
    if abs(late_s) > _CLOCKS_AGREE_S:
        shown = f"{abs(late_s):.1f} s" if abs(late_s) < 86_400 else f"{abs(late_s) / 86_400:.1f} days"
        order = "after" if late_s > 0 else "before"
        warnings.append(
            f"the pictures were recorded {shown} {order} the times in their headers, as when a bag is played and "
            "recorded again; the times in the headers are used"
        )


def _rising(
    time_ns: npt.NDArray[np.int64], recorded_ns: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Times of the messages whose times rise in the order of recording; those that are left out are as few as possible
    where single ones are too early, or too late."""
    last = np.maximum.accumulate(np.concatenate(([-1], time_ns[:-1])))
    following = np.minimum.accumulate(np.concatenate((time_ns[1:], [np.iinfo(np.int64).max]))[::-1])[::-1]
    kept = max(time_ns > last, time_ns < following, key=np.count_nonzero)
    kept &= np.diff(recorded_ns, prepend=-1) > 0
    return time_ns[kept], recorded_ns[kept]


def read_pictures(index: VideoIndex, segment: VideoSegment, report: ReadReport, last: int) -> Iterator[PictureFrame]:
    """Decode the pictures from a segment's first to the one before `last`."""
    start, end = int(index.stamps[segment.first]), int(index.stamps[last - 1]) + 1
    with open_bag(index.file.file, _KINDS[index.file.kind]) as bag:
        done = -1
        for message in bag.messages([index.codec], start_ns=start, end_ns=end):
            number = int(np.searchsorted(index.stamps, message.time_ns))
            if number <= done or number >= last or index.stamps[number] != message.time_ns:
                continue
            done = number
            try:
                pixels = pixels_of(message.topic.type_name, bag.decode(message))
            except WaymarkError:
                report.damaged += 1
                continue
            if pixels.shape[:2] != (index.height_px, index.width_px):
                report.other_size += 1
                continue
            yield PictureFrame(number, float(index.time_s[number]), pixels)


def _choose_topic(bag: Bag) -> tuple[Topic, list[str]]:
    """The first topic of pictures, of compressed ones if there are some, and warnings about those that are not used."""
    pictures = [topic for topic in bag.topics if topic.type_name in (*COMPRESSED, *RAW)]
    images = sorted(pictures, key=lambda topic: (topic.type_name in RAW, topic.name))
    if not images:
        raise _without_pictures(bag.topics)
    unused = [topic for topic in bag.topics if topic is not images[0] and topic.type_name not in FIXES]
    warnings = []
    if unused:
        warnings.append(f"topics that are not used: {describe_topics(unused)}")
    return images[0], warnings


def _without_pictures(topics: list[Topic]) -> InvalidParameter:
    has_fields = any(topic.type_name in FIELDS for topic in topics)
    return InvalidParameter(
        f"the bag has no pictures; it has {describe_topics(topics)}",
        field=FIELD,
        limit="topics of sensor_msgs/CompressedImage or sensor_msgs/Image, and for the track sensor_msgs/NavSatFix; "
        "sensor_msgs/MagneticField where a trace is declared",
        cure="declare the trace in the context: trace with bar and axes"
        if has_fields
        else "record the topic of compressed pictures, e.g. /camera/image_raw/compressed",
    )


class _Receiver(NamedTuple):
    """Positions of a topic, in the order of recording."""

    topic: str
    times: _Times
    points: tuple[PosePoint, ...]  # without their times


def _choose_receiver(bag: Bag, warnings: list[str]) -> _Receiver | None:
    """The topic with the most positions, of those with as many the most accurate one; warnings name the others."""
    found = [_read_receiver(bag, topic.name) for topic in bag.topics if topic.type_name in FIXES]
    found.sort(key=lambda one: (-len(one.points), _median_accuracy_m(one.points), one.topic))
    for other in found[1:] if found and found[0].points else found:
        used = f"; {found[0].topic} is used, with {len(found[0].points)}" if found[0].points else ""
        warnings.append(f"{other.topic} holds {count_of(len(other.points), 'position')}{used}")
    return found[0] if found and found[0].points else None


def _read_receiver(bag: Bag, topic: str) -> _Receiver:
    times: list[tuple[int, int]] = []
    points: list[PosePoint] = []
    for entry, message in enumerate(bag.messages([topic])):
        if entry >= MAX_FIXES:
            raise UploadTooLarge("the bag holds too many positions", field=FIELD, limit=f"{MAX_FIXES}")
        fix = bag.decode(message)
        if fix.status.status < 0:
            continue  # NavSatStatus.STATUS_NO_FIX
        times.append((message.time_ns, message.stamp_ns))
        points.append(PosePoint(entry, math.nan, fix.longitude, fix.latitude, math.nan, _accuracy_m(fix)))
    return _Receiver(topic, _Times(*np.array(times, np.int64).reshape(-1, 2).T), tuple(points))


def _median_accuracy_m(points: tuple[PosePoint, ...]) -> float:
    known = [point.accuracy_m for point in points if math.isfinite(point.accuracy_m)]
    return float(np.median(known)) if known else math.inf


def _track_of(receiver: _Receiver | None, by_stamp: bool, warnings: list[str]) -> PoseTrack | None:
    if receiver is None:
        return None
    time_s = (receiver.times.stamp_ns if by_stamp else receiver.times.recorded_ns) * _NS
    points = [replace(point, time_s=at) for point, at in zip(receiver.points, time_s.tolist(), strict=True)]
    report = LogReport()
    try:
        track = track_of(receiver.topic, points, report)
    except WaymarkError as error:
        warnings.append(f"{receiver.topic} is not used: {error}")
        return None
    if report.left_out_count:
        reason = report.left_out[0].reason
        warnings.append(f"{receiver.topic}: {count_of(report.left_out_count, 'position')} left out ({reason})")
    return track


def _accuracy_m(fix: Any) -> float:
    """Radial standard deviation by the covariance of east, north, up; NaN where its type is unknown."""
    if fix.position_covariance_type == 0:
        return math.nan
    return math.sqrt(max(float(fix.position_covariance[0]) + float(fix.position_covariance[4]), 0.0))
