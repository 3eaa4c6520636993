"""Videos: which files are videos, what they hold, and their frames."""

from __future__ import annotations

import io
import math
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from enum import StrEnum
from fractions import Fraction
from typing import TYPE_CHECKING, Any, BinaryIO

import cv2
import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge, WaymarkError, is_exhausted
from app.formats.bags.messages import detect_bag
from app.formats.format import ArchiveLimits, SpooledFile, count_members, is_archive, list_names, read_members
from app.formats.frame_list import is_beside_frames
from app.sensors.pose_track import PoseTrack

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.frame import VideoFrame
    from av.video.reformatter import VideoReformatter
    from av.video.stream import VideoStream


# === Containers of videos, recognised by their first bytes and opened with one fixed demuxer each.
#
# A demuxer that is chosen by content may follow a playlist to another file. Here the first bytes choose one of three
# demuxers, none of which opens other files, and the file is read through an object of ours, not by its name.


FIELD = "file"
EXPECTED = "MP4 or MOV (H.264, H.265, MPEG-4), AVI or raw stream (MJPEG), MCAP, ROS 2 bag (.db3) or ROS 1 bag"
_PICTURE_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"mif1", b"msf1", b"avif", b"avis")
"""Major brands of pictures in the container of MP4. Source: ISO/IEC 23008-12, section 10."""
_OPTIONS = {"protocol_whitelist": "none", "enable_drefs": "0", "use_absolute_path": "0"}
"""No demuxer opens anything but the file that it was given."""


class VideoKind(StrEnum):
    """Containers that are read."""

    MP4 = "mp4"
    AVI = "avi"
    MJPEG = "mjpeg"
    MCAP = "mcap"
    ROS1 = "ros1"
    ROS2_SQLITE = "ros2-sqlite"
    """Bags: their pictures are read by `app.formats.bags`, not by a demuxer."""


BAGS = (VideoKind.MCAP, VideoKind.ROS1, VideoKind.ROS2_SQLITE)
_DEMUXERS = {VideoKind.MP4: "mov", VideoKind.AVI: "avi", VideoKind.MJPEG: "mjpeg"}


def detect_video(head: bytes, *, is_stream: bool = False) -> VideoKind | None:
    """The kind of a video by its first bytes; None if it is none.

    Parameters
    ----------
    head : bytes
        At least the first 12.
    is_stream : bool
        Whether a JPEG is declared to be the first of a stream of pictures.
    """
    if head[4:8] == b"ftyp" and head[8:12] not in _PICTURE_BRANDS:
        return VideoKind.MP4
    if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
        return VideoKind.AVI
    bag = detect_bag(head)
    if bag is not None:
        return VideoKind(bag)
    return VideoKind.MJPEG if is_stream and head[:3] == b"\xff\xd8\xff" else None


@dataclass(frozen=True, slots=True)
class VideoFile:
    """A video, or the part of a file that is one.

    Attributes
    ----------
    file : SpooledFile
    kind : VideoKind
    offset, size : int
        Of the video in the file; size 0 is all that follows. [byte]
    """

    file: SpooledFile
    kind: VideoKind
    offset: int = 0
    size: int = 0

    @contextmanager
    def open(self) -> Iterator[InputContainer]:
        """Open the container.

        Raises
        ------
        UnreadableUpload
            It is damaged, or it is another kind of file.
        """
        import av
        from av.error import FFmpegError

        with self.file.open() as whole, _Part(whole, self.offset, self.size) as part:
            try:
                # fixed: PyAV must not choose the demuxer by the content
                container = av.open(part, "r", format=_DEMUXERS[self.kind], options=dict(_OPTIONS))
            except (FFmpegError, ValueError, IndexError) as error:
                raise UnreadableUpload(
                    f"the {self.kind.upper()} has no index that can be read: it is damaged or cut off",
                    field=FIELD,
                    limit=EXPECTED,
                    cure="send the file whole; a recorder that lost power writes no index (moov), repair it first",
                ) from error
            with container:
                yield container


class _Part(io.RawIOBase):
    """A part of an open file as a file."""

    def __init__(self, whole: BinaryIO, offset: int, size: int) -> None:
        super().__init__()
        self._whole, self._offset = whole, offset
        end = whole.seek(0, io.SEEK_END)
        self._size = min(size, end - offset) if size else end - offset
        self._at = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        self._at = max(start + offset, 0)
        return self._at

    def read(self, size: int = -1) -> bytes:
        left = max(self._size - self._at, 0)
        self._whole.seek(self._offset + self._at)
        data = self._whole.read(left if size < 0 else min(size, left))
        self._at += len(data)
        return data


# === A video in a ZIP archive, beside the vehicle's track: it is read where it lies, without being unpacked.


_BAG_SUFFIXES = (".db3", ".mcap", ".bag")
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", *_BAG_SUFFIXES)
"""Names of videos in an archive; the content decides what they are."""
_LOCAL_HEADER_BYTES = 30  # PKWARE APPNOTE, section 4.3.7


@dataclass(frozen=True, slots=True)
class PackedVideo:
    """A video of an archive, and the files beside it: name and content of each."""

    name: str
    video: VideoFile
    beside: tuple[tuple[str, bytes], ...]


def holds_video(file: SpooledFile) -> bool:
    """Whether a file is an archive in which a name is that of a video."""
    if not is_archive(file.head()):
        return False
    try:
        return any(name.lower().endswith(VIDEO_SUFFIXES) for name in list_names(file))
    except WaymarkError:
        return False


def open_packed_video(file: SpooledFile, limits: ArchiveLimits) -> PackedVideo:
    """The only video of an archive.

    Raises
    ------
    UnreadableUpload, UploadTooLarge
        As `count_members`.
    UnsupportedUpload
        There are several videos, or the video is compressed, encrypted, or of another kind.
    """
    count_members(file, limits)
    with file.open() as stream, zipfile.ZipFile(stream) as archive:
        videos = [info for info in archive.infolist() if info.filename.lower().endswith(VIDEO_SUFFIXES)]
        if len(videos) != 1:
            raise UnsupportedUpload(
                f"the archive holds {len(videos)} videos", field=FIELD, limit="one video beside a track",
                cure="send each video in an archive of its own",
            )  # fmt: skip
        info = videos[0]
        if info.filename.lower().endswith(_BAG_SUFFIXES):
            raise UnsupportedUpload(
                "a bag in an archive is not read", field=FIELD, limit="a bag as it is",
                cure="send the .db3, .mcap or .bag file itself; metadata.yaml is not needed",
            )  # fmt: skip
        if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1:
            raise UnsupportedUpload(
                "the video is compressed in the archive, or encrypted", field=FIELD, limit="stored as it is",
                cure="pack it without compression, e.g. zip -0",
            )  # fmt: skip
        stream.seek(info.header_offset)
        header = stream.read(_LOCAL_HEADER_BYTES)
        if len(header) < _LOCAL_HEADER_BYTES or header[:4] != b"PK\x03\x04":
            raise UnsupportedUpload("the archive's directory is damaged", field=FIELD, cure="pack it again")
        name_bytes, extra_bytes = struct.unpack_from("<HH", header, 26)
        offset = info.header_offset + _LOCAL_HEADER_BYTES + name_bytes + extra_bytes
        stream.seek(offset)
        kind = detect_video(stream.read(16))
    if kind is None or info.file_size <= 0 or offset + info.file_size > file.size:
        raise UnsupportedUpload("the file that is named as a video is none", field=FIELD, limit="MP4, MOV or AVI")
    beside = tuple((m.name, m.data) for m in read_members(file, limits, only=is_beside_frames) if m.error is None)
    return PackedVideo(info.filename[-120:], VideoFile(file, kind, offset, info.file_size), beside)


# === What a video holds, without decoding it: its frames with their times, its gaps, and where decoding can begin.


CODECS = ("h264", "hevc", "mpeg4", "mjpeg")
"""Codecs that are decoded."""
SEGMENT_S = 10.0
"""[s] of a video that one task decodes. Progress and cancelling every few seconds."""
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


# === Frames of a video: decoded on one thread, in the order of their times, turned upright once.


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
