"""What a video holds, without decoding it: its frames with their times, its gaps, and where decoding can begin."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge, is_exhausted
from app.formats.video.container import BAGS, EXPECTED, FIELD, VideoFile, VideoKind
from app.sensors.pose_track import PoseTrack

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.stream import VideoStream

CODECS = ("h264", "hevc", "mpeg4", "mjpeg")
"""Codecs that are decoded."""
SEGMENT_S = 10.0
"""[s] of a video that one task decodes. Source: chosen by hand: progress and cancelling every few seconds."""
GAP_S, GAP_FACTOR = 1.0, 5.0
"""[s, 1] as in `app.services.decodes.frame_poses`."""
MAX_RATE_HZ = 1000.0
"""[Hz] frames a second beyond which the times are not those of a camera: recorders that know none write one unit of
time for each frame. Source: that of `frames.rate_hz`."""


@dataclass(frozen=True, slots=True)
class VideoLimits:
    """What a video may be.

    Attributes
    ----------
    pixels : int
        Of a frame; 4096 x 2304. [px]
    side_min_px : int
    frames, streams : int
    duration_s, key_frame_s : float
        Length, and longest time between two frames at which decoding can begin. [s]
    """

    pixels: int = 4096 * 2304
    side_min_px: int = 64
    frames: int = 500_000
    streams: int = 16
    duration_s: float = 4 * 3600.0
    key_frame_s: float = 60.0


@dataclass(frozen=True, slots=True)
class VideoGap:
    """Frames that are missing between two frames; None at an end of the video."""

    after_frame: int | None
    before_frame: int | None
    seconds: float | None
    reason: str


@dataclass(frozen=True, slots=True)
class VideoSegment:
    """A stretch that begins where decoding can begin.

    Attributes
    ----------
    first, end : int
        Its frames: numbers in the order of their times, the end is not included.
    decode_from : int or None
        Where decoding has to begin: at the key frame before, where frames are counted (`is_counted`). None: at the
        first.
    """

    first: int
    end: int
    decode_from: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class VideoIndex:
    """The frames of a video.

    Attributes
    ----------
    file : VideoFile
    codec : str
    width_px, height_px : int
        As coded, before a rotation. [px]
    stamps : ndarray of int64, shape (frames,)
        The container's times in the order of presentation, or numbers of frames where it has none.
    time_s : ndarray, shape (frames,)
        After the first frame. [s]
    segments : tuple of VideoSegment
    created_at : datetime or None
        By the container.
    gaps : tuple of VideoGap
    warnings : tuple of str
    has_clock : bool
        Whether `created_at` is the time of the first frame by the recorder's clock.
    track : PoseTrack or None
        Of the vehicle, where the recording has one.
    """

    file: VideoFile
    codec: str
    width_px: int
    height_px: int
    stamps: npt.NDArray[np.int64]
    time_s: npt.NDArray[np.float64]
    segments: tuple[VideoSegment, ...]
    created_at: datetime | None
    gaps: tuple[VideoGap, ...]
    warnings: tuple[str, ...]
    has_clock: bool = False
    track: PoseTrack | None = None

    @property
    def duration_s(self) -> float:
        """From the first frame to the last. [s]"""
        return float(self.time_s[-1])


def index_video(file: VideoFile, limits: VideoLimits | None = None, *, rate_hz: float | None = None) -> VideoIndex:
    """List the frames of a video.

    Parameters
    ----------
    file : VideoFile
    limits : VideoLimits, optional
    rate_hz : float, optional
        Frames a second of a stream without times. [Hz]

    Raises
    ------
    UnreadableUpload
        It is damaged, or holds no frame.
    UnsupportedUpload
        Its codec is not decoded, or it has several videos.
    UploadTooLarge
        It exceeds a limit.
    InvalidParameter
        It has no times, and no rate is declared.
    """
    limits = limits or VideoLimits()
    if file.kind in BAGS:
        from app.formats.bags.drive import index_bag

        return index_bag(file, limits)
    if file.kind is VideoKind.MJPEG and rate_hz is None:
        raise InvalidParameter(
            "a raw MJPEG stream has no times", field="frames.rate_hz", limit="0.001 to 1000 Hz",
            cure="declare the frame rate, or send an MP4 or AVI",
        )  # fmt: skip
    with file.open() as container:
        stream = _stream_of(container, limits)
        width_px, height_px = _check_size(stream, limits)
        stamps, is_key, damaged, missing = _list_packets(container, stream, file.kind, limits)
        time_base = Fraction(1) / Fraction(rate_hz or 1) if file.kind is VideoKind.MJPEG else stream.time_base
        expected_s = float(stream.duration * stream.time_base) if stream.duration and stream.time_base else None
        created_at = _created_at(container)
        codec = str(stream.codec_context.name)
    order = np.argsort(stamps, kind="stable")
    ordered = stamps[order]
    distinct = np.diff(ordered, prepend=ordered[0] - 1) > 0
    warnings = []
    if not distinct.all():
        warnings.append(f"{int((~distinct).sum())} frames have the time of another frame; they are left out")
    ordered, keys = ordered[distinct], is_key[order][distinct]
    if time_base is None or not time_base > 0:
        raise UnreadableUpload("the video states no unit of its times", field=FIELD, cure="convert it to MP4")
    time_s = (ordered - ordered[0]).astype(float) * float(time_base)
    if time_s[-1] > limits.duration_s:
        raise UploadTooLarge(
            f"the video takes {time_s[-1]:.0f} s", field=FIELD, limit=f"{limits.duration_s:g} s", cure="cut it"
        )
    if len(time_s) > 2 and float(np.median(np.diff(time_s))) < 1 / MAX_RATE_HZ:
        raise UnreadableUpload(
            f"its frames are {float(np.median(np.diff(time_s))):.1g} s apart: their times are not those of a camera",
            field=FIELD, limit=f"{MAX_RATE_HZ:g} frames a second", cure="convert it at its true rate",
        )  # fmt: skip
    if file.kind is not VideoKind.MJPEG and rate_hz is not None:
        warnings.append("frames.rate_hz is not used: the video has times of its own")
    if damaged:
        warnings.append(f"{damaged} packets without a time are left out")
    gaps = _find_gaps(time_s, expected_s, missing)
    segments = cut_segments(time_s, keys, limits)
    if is_counted(file.kind, codec):
        # frames that are shown before a key frame and decoded after it need the frames before the key frame, too
        key_numbers = np.flatnonzero(keys)
        segments = tuple(
            replace(part, decode_from=int(max(key_numbers[key_numbers < part.first], default=0))) for part in segments
        )
    return VideoIndex(
        file, codec, width_px, height_px, ordered, time_s, segments, created_at, tuple(gaps), tuple(warnings)
    )


def _stream_of(container: InputContainer, limits: VideoLimits) -> VideoStream:
    if len(container.streams) > limits.streams:
        raise UploadTooLarge(
            f"the video has {len(container.streams)} streams", field=FIELD, limit=f"{limits.streams} streams"
        )
    videos = list(container.streams.video)
    if not videos:
        raise UnreadableUpload("the file holds no video", field=FIELD, limit=EXPECTED, cure="send the camera's video")
    if len(videos) > 1:
        raise UnsupportedUpload(
            f"the file holds {len(videos)} videos", field=FIELD, limit="one", cure="send each camera's video by itself"
        )
    stream = videos[0]
    name = stream.codec_context.name if stream.codec_context is not None else "unknown"
    if name not in CODECS:
        raise UnsupportedUpload(
            f"the video's codec is {name}",
            field=FIELD,
            limit=EXPECTED,
            cure="convert it, e.g. with ffmpeg -c:v libx264",
        )
    return stream


def _check_size(stream: VideoStream, limits: VideoLimits) -> tuple[int, int]:
    width_px, height_px = int(stream.codec_context.width), int(stream.codec_context.height)
    if width_px * height_px > limits.pixels:
        raise UploadTooLarge(
            f"a frame has {width_px} x {height_px} px", field=FIELD, limit=f"{limits.pixels} pixels",
            cure="record at a lower resolution",
        )  # fmt: skip
    if min(width_px, height_px) < limits.side_min_px:
        raise UnreadableUpload(
            f"a frame has {width_px} x {height_px} px", field=FIELD, limit=f"at least {limits.side_min_px} px a side"
        )
    return width_px, height_px


def _list_packets(
    container: InputContainer, stream: VideoStream, kind: VideoKind, limits: VideoLimits
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_], int, int]:
    """Time and key flag of each packet in the order of the file; packets without a time, and those that are missing."""
    from av.error import FFmpegError

    stamps: list[int] = []
    keys: list[bool] = []
    damaged = there = 0
    try:
        for number, packet in enumerate(container.demux(stream)):
            there += packet.size > 0
            if packet.size == 0 or packet.is_discard:
                continue  # the edit list shows frames of discarded packets never: they are decoded for others
            stamp = stamp_of(packet, number, kind)
            if stamp is None or abs(stamp) > 1 << 60:
                damaged += 1
                continue
            stamps.append(stamp)
            keys.append(bool(packet.is_keyframe))
            if len(stamps) > limits.frames:
                raise UploadTooLarge("the video has too many frames", field=FIELD, limit=f"{limits.frames} frames")
    except FFmpegError as error:
        if is_exhausted(error):
            raise
        # what can be read is read; the gap at the end is stated
    if not stamps:
        raise UnreadableUpload("the video holds no frame with a time", field=FIELD, cure="send the file whole")
    return np.array(stamps, np.int64), np.array(keys, bool), damaged, max(stream.frames - there, 0)


def stamp_of(packet: Packet[Any], number: int, kind: VideoKind) -> int | None:
    """Time of a packet in the container's unit, or its number in a stream without times; None if it has none.

    AVI has times in the order of decoding only; those of presentation that the demuxer adds to them are guesses.
    """
    if kind is VideoKind.MJPEG:
        return number
    return packet.pts if packet.pts is not None and kind is not VideoKind.AVI else packet.dts


def is_counted(kind: VideoKind, codec: str) -> bool:
    """Whether frames have no time of presentation, and are numbered in the order in which the decoder shows them."""
    return kind is VideoKind.AVI and codec != "mjpeg"


def _created_at(container: InputContainer) -> datetime | None:
    text = container.metadata.get("creation_time", "")
    try:
        at = datetime.fromisoformat(text)
    except ValueError:
        return None
    at = at if at.tzinfo is not None else at.replace(tzinfo=UTC)
    return at if 2000 <= at.year < 2100 else None


def find_time_gaps(time_s: npt.NDArray[np.float64]) -> list[VideoGap]:
    """Gaps between the times of successive frames."""
    steps = np.diff(time_s)
    usual_s = float(np.median(steps)) if len(steps) else 0.0
    reason = "no frames in between: the recording or its clock jumped"
    return [
        VideoGap(int(k), int(k) + 1, round(float(steps[k]), 3), reason)
        for k in np.flatnonzero(steps > max(GAP_S, GAP_FACTOR * usual_s))
    ]


def _find_gaps(time_s: npt.NDArray[np.float64], expected_s: float | None, missing: int) -> list[VideoGap]:
    gaps = find_time_gaps(time_s)
    usual_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    missing_s = (expected_s or 0.0) - (float(time_s[-1]) + usual_s)
    if missing_s > max(0.5, 3 * usual_s):
        frames = f": {missing} frames that it declares are missing" if missing else ""
        reason = f"the file ends before the video does{frames}"
        gaps.append(VideoGap(len(time_s) - 1, None, round(missing_s, 3), reason))
    return gaps


def cut_segments(
    time_s: npt.NDArray[np.float64], keys: npt.NDArray[np.bool_], limits: VideoLimits
) -> tuple[VideoSegment, ...]:
    """Segments of about `SEGMENT_S`; frames before the first key frame go with it, the decoder leaves them out."""
    starts = [0]
    for k in np.flatnonzero(keys):
        if time_s[k] - time_s[starts[-1]] >= SEGMENT_S:
            starts.append(int(k))
    ends = [*starts[1:], len(time_s)]
    longest_s = max(float(time_s[end - 1] - time_s[start]) for start, end in zip(starts, ends, strict=True))
    if longest_s > SEGMENT_S + limits.key_frame_s and not math.isclose(longest_s, 0.0):
        raise UnsupportedUpload(
            f"{longest_s:.0f} s of the video have no key frame", field=FIELD, limit=f"{limits.key_frame_s:g} s",
            cure="record or convert it with a key frame every few seconds, e.g. ffmpeg -g 60",
        )  # fmt: skip
    return tuple(VideoSegment(start, end) for start, end in zip(starts, ends, strict=True))
