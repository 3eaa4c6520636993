"""Containers of videos, recognised by their first bytes and opened with one fixed demuxer each.

A demuxer that is chosen by content may follow a playlist to another file. Here the first bytes choose one of three
demuxers, none of which opens other files, and the file is read through an object of ours, not by its name.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, BinaryIO

from app.errors import UnreadableUpload
from app.formats.bags.messages import detect_bag
from app.formats.spooled_file import SpooledFile

if TYPE_CHECKING:
    from av.container import InputContainer

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
