"""The frames of a video: listed without decoding it, and decoded."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge, is_exhausted
from app.formats.bags.drive import index_bag, read_pictures
from app.formats.video_file import (
    BAGS,
    EXPECTED,
    FIELD,
    PictureFrame,
    Pixels,
    ReadReport,
    VideoFile,
    VideoGap,
    VideoIndex,
    VideoKind,
    VideoLimits,
    VideoSegment,
    as_uint8,
    cut_segments,
    find_time_gaps,
)

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.frame import VideoFrame
    from av.video.reformatter import VideoReformatter
    from av.video.stream import VideoStream


# === What a video holds, without decoding it.


CODECS = ("h264", "hevc", "mpeg4", "mjpeg")
"""Codecs that are decoded."""
MAX_RATE_HZ = 1000.0
"""[Hz] frames a second beyond which the times are not those of a camera: recorders that know none write one unit of
time for each frame. Source: that of `frames.rate_hz`."""


def index_video(file: VideoFile, limits: VideoLimits | None = None, *, rate_hz: float | None = None) -> VideoIndex:
    """List the frames of a video.

    Parameters
    ----------
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
        codec, declared = str(stream.codec_context.name), int(stream.frames)
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
    hidden = declared - len(stamps) - damaged
    if file.kind is VideoKind.MP4 and hidden > 0 and not any(gap.before_frame is None for gap in gaps):
        # libavformat may also leave out the last frame in the order of decoding where an edit ends with a key frame
        warnings.append(f"the edit list of the video leaves out {hidden} of its {declared} frames")
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


def _find_gaps(time_s: npt.NDArray[np.float64], expected_s: float | None, missing: int) -> list[VideoGap]:
    gaps = find_time_gaps(time_s)
    usual_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    missing_s = (expected_s or 0.0) - (float(time_s[-1]) + usual_s)
    if missing_s > max(0.5, 3 * usual_s):
        frames = f": {missing} frames that it declares are missing" if missing else ""
        reason = f"the file ends before the video does{frames}"
        gaps.append(VideoGap(len(time_s) - 1, None, round(missing_s, 3), reason))
    return gaps


# === Frames of a video: decoded on one thread, in the order of their times, turned upright once.


_COPY_PX = (16, 16)
_PLANAR = ("yuv420p", "yuvj420p")
_ROTATIONS = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}


@dataclass(frozen=True, slots=True)
class DecodedFrame:
    """One frame of a video."""

    number: int  # among the frames of the video
    time_s: float  # [s] after the first frame of the video
    rotation_deg: int  # [deg] clockwise, by which it is turned upright: 0, 90, 180 or 270
    _frame: VideoFrame
    _reformatter: VideoReformatter

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height upright. [px]"""
        size = (self._frame.width, self._frame.height)
        return size if self.rotation_deg % 180 == 0 else (size[1], size[0])

    def half_bgr(self) -> Pixels:
        """The frame at half resolution, shape (H // 2, W // 2, 3), without a conversion at full resolution."""
        frame = self._frame
        if frame.format.name not in _PLANAR or frame.width % 2 or frame.height % 2:
            full = self.bgr()
            return as_uint8(cv2.resize(full, (full.shape[1] // 2, full.shape[0] // 2), interpolation=cv2.INTER_AREA))
        half = (frame.width // 2, frame.height // 2)
        luma = cv2.resize(_plane(frame, 0), half, interpolation=cv2.INTER_AREA)
        # OpenCV's order is luma, red, blue difference; full range: that of the search makes no difference
        merged = cv2.merge([luma, _plane(frame, 2), _plane(frame, 1)])
        return self._upright(as_uint8(cv2.cvtColor(merged, cv2.COLOR_YCrCb2BGR)))

    def bgr(self) -> Pixels:
        """Blue, green, red, shape (H, W, 3)."""
        return self._upright(self._converted("bgr24"))

    def grey(self) -> Pixels:
        """Grey levels, shape (H, W)."""
        return self._upright(self._converted("gray"))

    def _converted(self, form: str) -> Pixels:
        # `to_ndarray(format=...)` makes a converter with a thread for each core for every frame
        return as_uint8(self._reformatter.reformat(self._frame, format=form, threads=1).to_ndarray())

    def _upright(self, pixels: Pixels) -> Pixels:
        return as_uint8(cv2.rotate(pixels, _ROTATIONS[self.rotation_deg])) if self.rotation_deg else pixels


AnyFrame = DecodedFrame | PictureFrame


def read_frames(index: VideoIndex, segment: VideoSegment, report: ReadReport, *, beyond: int = 0) -> Iterator[AnyFrame]:
    """Decode the frames of a segment, and some beyond its end.

    Parameters
    ----------
    report : ReadReport
        Filled while frames are read; complete when the first frame beyond the segment comes, or none is left.
    beyond : int
        Frames after the segment's end that are read too. [frame]

    Raises
    ------
    UnsupportedUpload
        The video is mirrored, or turned by no multiple of 90 degrees.
    MemoryError, BlockingIOError
        This process has no memory, or no thread, left for the codec.
    """
    last = min(segment.end + beyond, len(index.stamps))
    if index.file.kind in BAGS:
        yield from read_pictures(index, segment, report, last)
        return
    from av.video.reformatter import VideoReformatter

    with index.file.open() as container:
        stream = container.streams.video[0]
        stream.thread_type = "NONE"
        stream.codec_context.thread_count = 1
        reformatter = VideoReformatter()
        turn = _Turn(VideoReformatter())
        done = segment.first - 1
        for frame, number in _decode(index, segment, container, stream):
            if number <= done:
                continue  # before the segment
            report.damaged += max(min(number, segment.end) - done - 1, 0)
            done = number
            if number >= last:
                return
            if (frame.width, frame.height) != (index.width_px, index.height_px):
                report.other_size += number < segment.end
                continue
            yield DecodedFrame(number, float(index.time_s[number]), turn.of(frame), frame, reformatter)
        report.damaged += max(segment.end - done - 1, 0)


def _decode(
    index: VideoIndex, segment: VideoSegment, container: InputContainer, stream: VideoStream
) -> Iterator[tuple[VideoFrame, int]]:
    """Decoded frames with their numbers, from where decoding of the segment begins."""
    from av.error import FFmpegError

    counted = is_counted(index.file.kind, index.codec)
    failed = shown = 0  # of the segment, where frames are counted
    for packet, stamp in _packets(index, segment, container, stream):
        try:
            frames = packet.decode() if packet.size else stream.codec_context.decode(None)
        except FFmpegError as error:
            if is_exhausted(error):
                raise
            failed += stamp is not None and stamp >= index.stamps[segment.first]
            continue
        for frame in frames:
            at = frame.pts if frame.pts is not None else frame.dts
            number = int(np.searchsorted(index.stamps, at)) if at is not None else len(index.stamps)
            if number == len(index.stamps) or index.stamps[number] != at:
                continue  # not in the index
            if counted and number < segment.first:
                continue
            if frame.is_corrupt:
                failed += 1
                continue  # the codec has filled in what was lost
            if counted:
                number = segment.first + failed + shown
                shown += 1
            yield frame, number


def _packets(
    index: VideoIndex, segment: VideoSegment, container: InputContainer, stream: VideoStream
) -> Iterator[tuple[Packet[Any], int | None]]:
    """Packets from where decoding of the segment begins, with their times in the index; the last one is empty."""
    from av.error import FFmpegError

    kind = index.file.kind
    start = int(index.stamps[segment.first if segment.decode_from is None else segment.decode_from])
    if kind is VideoKind.MP4 and segment.first > 0:
        container.seek(start, stream=stream, backward=True, any_frame=False)
    packets = enumerate(container.demux(stream))
    while True:
        try:
            number, packet = next(packets)
        except StopIteration:
            return
        except FFmpegError as error:
            if is_exhausted(error):
                raise
            return  # the file ends here; the index states the gap
        stamp = stamp_of(packet, number, kind)
        if kind is not VideoKind.MP4 and packet.size:
            if stamp is None or stamp < start:
                continue  # these containers have no index that can be trusted, and reading is cheap
            packet.pts = stamp  # that of the frame that is in this packet
        yield packet, stamp
        if not packet.size:
            return


class _Turn:
    """Rotation of the frames of a video.

    The display matrix is read once for each rotation, from a small copy of the frame: what PyAV returns for it refers
    to the frame and the frame to it, so that both, and the codec's buffers, stay until a full garbage collection.
    """

    def __init__(self, reformatter: VideoReformatter) -> None:
        self._reformatter = reformatter
        self._by_pyav: dict[int, int] = {}

    def of(self, frame: VideoFrame) -> int:
        """As `rotation_of`."""
        if frame.rotation not in self._by_pyav:
            copy = self._reformatter.reformat(frame, *_COPY_PX, format="gray", threads=1)
            self._by_pyav[frame.rotation] = rotation_of(copy)
        return self._by_pyav[frame.rotation]


def rotation_of(frame: VideoFrame) -> int:
    """Clockwise rotation that turns a frame upright, by its display matrix. [deg]

    Raises
    ------
    UnsupportedUpload
        The matrix mirrors, or turns by no multiple of 90 degrees.
    """
    matrix = _display_matrix(frame)
    if matrix is None:
        return 0
    a, b, c, d = matrix
    if a * d - b * c < 0:
        raise UnsupportedUpload(
            "the video is mirrored, and a mirrored plate reads as another code",
            field=FIELD,
            limit="videos that are not mirrored",
            cure="switch off the camera's mirroring (selfie or rear-view mode)",
        )
    turn = round(math.degrees(math.atan2(b, a)))
    if turn % 90:
        raise UnsupportedUpload(f"the video is turned by {turn} degrees", field=FIELD, limit="multiples of 90 degrees")
    return turn % 360


def _display_matrix(frame: VideoFrame) -> tuple[float, float, float, float] | None:
    """Upper left part of the frame's display matrix (ISO/IEC 14496-12, section 8.3.2); None without one."""
    side: Any = frame.side_data.get("DISPLAYMATRIX")
    if side is None:
        return None
    a, b, _u, c, d, *_rest = struct.unpack_from("<9i", bytes(side))
    return (a / 65536, b / 65536, c / 65536, d / 65536) if a or b or c or d else None


def _plane(frame: VideoFrame, number: int) -> Pixels:
    plane: Any = frame.planes[number]
    rows: npt.NDArray[Any] = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
    return rows[: plane.height, : plane.width]
