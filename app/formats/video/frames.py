"""Frames of a video: decoded on one thread, in the order of their times, turned upright once."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from app.errors import UnsupportedUpload, is_exhausted
from app.formats.video.container import BAGS, FIELD, VideoKind
from app.formats.video.index import VideoIndex, VideoSegment, is_counted, stamp_of

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.frame import VideoFrame
    from av.video.reformatter import VideoReformatter
    from av.video.stream import VideoStream

_COPY_PX = (16, 16)
_PLANAR = ("yuv420p", "yuvj420p")
_ROTATIONS = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}
Pixels = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class DecodedFrame:
    """One frame of a video.

    Attributes
    ----------
    number : int
        Among the frames of the video.
    time_s : float
        After the first frame of the video. [s]
    rotation_deg : int
        Clockwise, by which it is turned upright: 0, 90, 180 or 270. [deg]
    """

    number: int
    time_s: float
    rotation_deg: int
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
            return _uint8(cv2.resize(full, (full.shape[1] // 2, full.shape[0] // 2), interpolation=cv2.INTER_AREA))
        half = (frame.width // 2, frame.height // 2)
        luma = cv2.resize(_plane(frame, 0), half, interpolation=cv2.INTER_AREA)
        # OpenCV's order is luma, red, blue difference; full range: that of the search makes no difference
        merged = cv2.merge([luma, _plane(frame, 2), _plane(frame, 1)])
        return self._upright(_uint8(cv2.cvtColor(merged, cv2.COLOR_YCrCb2BGR)))

    def bgr(self) -> Pixels:
        """Blue, green, red, shape (H, W, 3)."""
        return self._upright(self._converted("bgr24"))

    def grey(self) -> Pixels:
        """Grey levels, shape (H, W)."""
        return self._upright(self._converted("gray"))

    def _converted(self, form: str) -> Pixels:
        # `to_ndarray(format=...)` makes a converter with a thread for each core for every frame
        return _uint8(self._reformatter.reformat(self._frame, format=form, threads=1).to_ndarray())

    def _upright(self, pixels: Pixels) -> Pixels:
        return _uint8(cv2.rotate(pixels, _ROTATIONS[self.rotation_deg])) if self.rotation_deg else pixels


@dataclass(frozen=True, slots=True)
class PictureFrame:
    """One picture of a bag, as `DecodedFrame`."""

    number: int
    time_s: float
    _pixels: Pixels

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height. [px]"""
        return self._pixels.shape[1], self._pixels.shape[0]

    def half_bgr(self) -> Pixels:
        """The picture at half resolution."""
        size = (self._pixels.shape[1] // 2, self._pixels.shape[0] // 2)
        return _uint8(cv2.resize(self._pixels, size, interpolation=cv2.INTER_AREA))

    def bgr(self) -> Pixels:
        """Blue, green, red."""
        return self._pixels

    def grey(self) -> Pixels:
        """Grey levels."""
        return _uint8(cv2.cvtColor(self._pixels, cv2.COLOR_BGR2GRAY))


AnyFrame = DecodedFrame | PictureFrame


@dataclass(slots=True)
class ReadReport:
    """Frames of a segment that are not among those that were read: together they are all of the segment.

    Attributes
    ----------
    damaged : int
        Frames that could not be decoded.
    other_size : int
        Frames that have another size than the video.
    """

    damaged: int = 0
    other_size: int = 0


def read_frames(index: VideoIndex, segment: VideoSegment, report: ReadReport, *, beyond: int = 0) -> Iterator[AnyFrame]:
    """Decode the frames of a segment, and some beyond its end.

    Parameters
    ----------
    index : VideoIndex
    segment : VideoSegment
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
        from app.formats.bags.drive import read_pictures

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
            if counted:
                if number < segment.first:
                    continue
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


def _uint8(pixels: Any) -> Pixels:
    return np.asarray(pixels, np.uint8)
