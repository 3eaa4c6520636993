"""Which files are videos, and what is known of one: its frames with their times, its gaps and its segments."""

from __future__ import annotations

import io
import math
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import TYPE_CHECKING, BinaryIO

import cv2
import numpy as np
import numpy.typing as npt

from app.errors import UnreadableUpload, UnsupportedUpload, WaymarkError
from app.formats.bags.messages import detect_bag
from app.formats.format import (
    HEAD_BYTES,
    ArchiveLimits,
    SpooledFile,
    count_members,
    is_archive,
    list_names,
    read_members,
)
from app.formats.frame_list import is_beside_frames
from app.sensors.pose_track import PoseTrack

if TYPE_CHECKING:
    from av.container import InputContainer

Pixels = npt.NDArray[np.uint8]

# === Containers of videos, recognised by their first bytes and opened with one fixed demuxer each.
#
# A demuxer that is chosen by content may follow a playlist to another file. Here the first bytes choose one of five
# demuxers, none of which opens other files, and the file is read through an object of ours, not by its name.


FIELD = "file"
EXPECTED = (
    "MP4, MOV, MPEG-TS or Matroska (H.264, H.265, MPEG-4), AVI or raw stream (MJPEG), MCAP, ROS 2 bag (.db3) or "
    "ROS 1 bag"
)
_EBML_MAGIC = b"\x1a\x45\xdf\xa3"
_TS_SYNC, _TS_PACKETS = 0x47, ((188, 0), (192, 4))
"""First byte of a packet of an MPEG transport stream (ISO/IEC 13818-1); lengths of packets, and where the first one
begins: Blu-ray and AVCHD put four bytes before each."""
_PICTURE_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"mif1", b"msf1", b"avif", b"avis")
"""Major brands of pictures in the container of MP4. Source: ISO/IEC 23008-12, section 10."""
_OPTIONS = {"protocol_whitelist": "none", "enable_drefs": "0", "use_absolute_path": "0"}
"""No demuxer opens anything but the file that it was given."""


class VideoKind(StrEnum):
    """Containers that are read."""

    MP4 = "mp4"
    AVI = "avi"
    MJPEG = "mjpeg"
    MPEG_TS = "mpeg-ts"
    MATROSKA = "matroska"
    MCAP = "mcap"
    ROS1 = "ros1"
    ROS2_SQLITE = "ros2-sqlite"
    """Bags: their pictures are read by `app.formats.bags`, not by a demuxer."""


BAGS = (VideoKind.MCAP, VideoKind.ROS1, VideoKind.ROS2_SQLITE)
_DEMUXERS = {
    VideoKind.MP4: "mov",
    VideoKind.AVI: "avi",
    VideoKind.MJPEG: "mjpeg",
    VideoKind.MPEG_TS: "mpegts",
    VideoKind.MATROSKA: "matroska",
}


def detect_video(head: bytes, *, is_stream: bool = False) -> VideoKind | None:
    """The kind of a video by its first bytes; None if it is none.

    Parameters
    ----------
    head : bytes
        At least the first `HEAD_BYTES` of a longer file.
    is_stream : bool
        Whether a JPEG is declared to be the first of a stream of pictures.
    """
    if head[4:8] == b"ftyp" and head[8:12] not in _PICTURE_BRANDS:
        return VideoKind.MP4
    if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
        return VideoKind.AVI
    if head.startswith(_EBML_MAGIC):
        return VideoKind.MATROSKA
    if any(_is_transport_stream(head, length, first) for length, first in _TS_PACKETS):
        return VideoKind.MPEG_TS
    bag = detect_bag(head)
    if bag is not None:
        return VideoKind(bag)
    return VideoKind.MJPEG if is_stream and head[:3] == b"\xff\xd8\xff" else None


def _is_transport_stream(head: bytes, length: int, first: int) -> bool:
    """Whether packets of a length begin with the sync byte, three at least."""
    starts = head[first : first + 20 * length : length]
    return len(starts) >= 3 and not starts.strip(bytes([_TS_SYNC]))


@dataclass(frozen=True, slots=True)
class VideoFile:
    """A video, or the part of a file that is one."""

    file: SpooledFile
    kind: VideoKind
    # `offset`, `size`: [byte] of the video in the file; size 0 is all that follows
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
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".ts", ".mts", ".m2ts", ".mkv", ".webm", *_BAG_SUFFIXES)
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
        kind = detect_video(stream.read(min(HEAD_BYTES, info.file_size)))
    if kind is None or info.file_size <= 0 or offset + info.file_size > file.size:
        raise UnsupportedUpload("the file that is named as a video is none", field=FIELD, limit=EXPECTED)
    beside = tuple((m.name, m.data) for m in read_members(file, limits, only=is_beside_frames) if m.error is None)
    return PackedVideo(info.filename[-120:], VideoFile(file, kind, offset, info.file_size), beside)


# === What is known of a video: its frames with their times, its gaps, and where decoding can begin.


SEGMENT_S = 10.0
"""[s] of a video that one task decodes. Progress and cancelling every few seconds."""
GAP_S, GAP_FACTOR = 1.0, 5.0
"""[s, 1] as in `app.services.decodes.frame_poses`."""


@dataclass(frozen=True, slots=True)
class VideoLimits:
    """What a video may be."""

    pixels: int = 4096 * 2304  # [px] of a frame; 4096 x 2304
    side_min_px: int = 64
    frames: int = 500_000
    streams: int = 16
    # `duration_s`, `key_frame_s`: [s] length, and longest time between two frames at which decoding can begin
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
    """A stretch that begins where decoding can begin."""

    # `first`, `end`: its frames: numbers in the order of their times, the end is not included
    first: int
    end: int
    # where decoding has to begin: at the key frame before, where frames are counted (`is_counted`). None: at the first.
    decode_from: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class VideoIndex:
    """The frames of a video."""

    file: VideoFile
    codec: str
    # `width_px`, `height_px`: [px] as coded, before a rotation
    width_px: int
    height_px: int
    # shape (frames,): the container's times in the order of presentation, or numbers of frames where it has none
    stamps: npt.NDArray[np.int64]
    time_s: npt.NDArray[np.float64]  # shape (frames,): [s] after the first frame
    segments: tuple[VideoSegment, ...]
    created_at: datetime | None  # by the container
    gaps: tuple[VideoGap, ...]
    warnings: tuple[str, ...]
    has_clock: bool = False  # whether `created_at` is the time of the first frame by the recorder's clock
    track: PoseTrack | None = None  # of the vehicle, where the recording has one

    @property
    def duration_s(self) -> float:
        """From the first frame to the last. [s]"""
        return float(self.time_s[-1])


def find_time_gaps(time_s: npt.NDArray[np.float64]) -> list[VideoGap]:
    """Gaps between the times of successive frames."""
    steps = np.diff(time_s)
    usual_s = float(np.median(steps)) if len(steps) else 0.0
    reason = "no frames in between: the recording or its clock jumped"
    return [
        VideoGap(int(k), int(k) + 1, round(float(steps[k]), 3), reason)
        for k in np.flatnonzero(steps > max(GAP_S, GAP_FACTOR * usual_s))
    ]


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


# === Pictures of bags, and what was not read.


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
        return as_uint8(cv2.resize(self._pixels, size, interpolation=cv2.INTER_AREA))

    def bgr(self) -> Pixels:
        """Blue, green, red."""
        return self._pixels

    def grey(self) -> Pixels:
        """Grey levels."""
        return as_uint8(cv2.cvtColor(self._pixels, cv2.COLOR_BGR2GRAY))


@dataclass(slots=True)
class ReadReport:
    """Frames of a segment that are not among those that were read: together they are all of the segment."""

    damaged: int = 0  # frames that could not be decoded
    other_size: int = 0  # frames that have another size than the video


def as_uint8(pixels: object) -> Pixels:
    return np.asarray(pixels, np.uint8)
