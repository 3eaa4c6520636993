"""A video in a ZIP archive, beside the vehicle's track: it is read where it lies, without being unpacked."""

from __future__ import annotations

import struct
import zipfile
from dataclasses import dataclass

from app.errors import UnsupportedUpload, WaymarkError
from app.formats.archives import ArchiveLimits, count_members, is_archive, list_names, read_members
from app.formats.frame_list import is_beside_frames
from app.formats.spooled_file import SpooledFile
from app.formats.video.container import FIELD, VideoFile, detect_video

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
