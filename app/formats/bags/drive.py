"""A bag as a drive: the pictures of one topic in the order of their times, and the vehicle's track."""

from __future__ import annotations

import math
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

import numpy as np

from app.errors import InvalidParameter, UnreadableUpload, UploadTooLarge, WaymarkError
from app.formats.bags.fields import FIELDS
from app.formats.bags.messages import FIELD, Bag, BagKind, Topic, describe_topics, open_bag, types_of
from app.formats.bags.pictures import COMPRESSED, RAW, pixels_of, size_px
from app.formats.images import ImageLimits
from app.formats.log_report import LogReport
from app.formats.poses.points import PosePoint, track_of
from app.formats.video.container import VideoFile, VideoKind
from app.formats.video.frames import PictureFrame, ReadReport
from app.formats.video.index import VideoIndex, VideoLimits, VideoSegment, cut_segments, find_time_gaps
from app.sensors.pose_track import PoseTrack

FIXES = types_of("sensor_msgs", "NavSatFix")
MAX_FIXES = 200_000
"""[positions] chosen by hand, as `PoseLimits`."""
_KINDS = {VideoKind(kind): kind for kind in BagKind}
_NS = 1e-9


def index_bag(file: VideoFile, limits: VideoLimits) -> VideoIndex:
    """List the pictures of a bag; raises as `index_video`, or `UnsupportedUpload` where bags are not read."""
    with open_bag(file.file, _KINDS[file.kind]) as bag:
        topic, warnings = _choose_topic(bag)
        stamps: list[int] = []
        first: tuple[int, int] | None = None
        for message in bag.messages([topic.name]):
            if first is None:
                first = size_px(topic.type_name, bag.decode(message), ImageLimits(pixels=limits.pixels))
            stamps.append(message.time_ns)
            if len(stamps) > limits.frames:
                raise UploadTooLarge("the bag has too many pictures", field=FIELD, limit=f"{limits.frames}")
        if first is None:
            raise _without_pictures(bag.topics)
        track = _read_track(bag, warnings)
    ordered = np.unique(np.array(stamps, np.int64))
    if len(ordered) < len(stamps):
        warnings.append(f"{len(stamps) - len(ordered)} pictures have the time of another one; they are left out")
    if not 946_684_800 <= ordered[0] * _NS <= 4_102_444_800:
        raise UnreadableUpload(
            "the bag's pictures have no time between 2000 and 2100", field=FIELD, cure="record with the clock set"
        )
    time_s = (ordered - ordered[0]).astype(float) * _NS
    if time_s[-1] > limits.duration_s:
        raise UploadTooLarge(f"the bag takes {time_s[-1]:.0f} s", field=FIELD, limit=f"{limits.duration_s:g} s")
    segments = cut_segments(time_s, np.ones(len(ordered), bool), limits)
    began_at = datetime.fromtimestamp(float(ordered[0]) * _NS, UTC)
    return VideoIndex(
        file, topic.name, *first, ordered, time_s, segments, began_at, tuple(find_time_gaps(time_s)), tuple(warnings),
        has_clock=True, track=track,
    )  # fmt: skip


def read_pictures(index: VideoIndex, segment: VideoSegment, report: ReadReport, last: int) -> Iterator[PictureFrame]:
    """Decode the pictures from a segment's first to the one before `last`."""
    start, end = int(index.stamps[segment.first]), int(index.stamps[last - 1]) + 1
    with open_bag(index.file.file, _KINDS[index.file.kind]) as bag:
        done = -1
        for message in bag.messages([index.codec], start_ns=start, end_ns=end):
            number = int(np.searchsorted(index.stamps, message.time_ns))
            if number <= done or number >= last:
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
        f"the bag has no pictures; it has {describe_topics(topics)}", field=FIELD,
        limit="topics of sensor_msgs/CompressedImage or sensor_msgs/Image, and for the track sensor_msgs/NavSatFix; "
        "sensor_msgs/MagneticField where a trace is declared",
        cure="declare the trace in the context: trace with bar and axes"
        if has_fields
        else "record the topic of compressed pictures, e.g. /camera/image_raw/compressed",
    )  # fmt: skip


def _read_track(bag: Bag, warnings: list[str]) -> PoseTrack | None:
    names = [topic.name for topic in bag.topics if topic.type_name in FIXES]
    if not names:
        return None
    points = []
    for entry, message in enumerate(bag.messages(names[:1])):
        if entry >= MAX_FIXES:
            raise UploadTooLarge("the bag holds too many positions", field=FIELD, limit=f"{MAX_FIXES}")
        fix = bag.decode(message)
        if fix.status.status < 0:
            continue  # NavSatStatus.STATUS_NO_FIX
        points.append(PosePoint(entry, message.time_ns * _NS, fix.longitude, fix.latitude, math.nan, _accuracy_m(fix)))
    if not points:
        warnings.append(f"{names[0]} holds no position")
        return None
    report = LogReport()
    try:
        track = track_of(names[0], points, report)
    except WaymarkError as error:
        warnings.append(f"{names[0]} is not used: {error}")
        return None
    if report.left_out_count:
        warnings.append(f"{names[0]}: {report.left_out_count} positions were left out ({report.left_out[0].reason})")
    return track


def _accuracy_m(fix: Any) -> float:
    """Radial standard deviation by the covariance of east, north, up; NaN where its type is unknown."""
    if fix.position_covariance_type == 0:
        return math.nan
    return math.sqrt(max(float(fix.position_covariance[0]) + float(fix.position_covariance[4]), 0.0))
