"""The list of all formats of uploaded files, and what an upload is by its content."""

from __future__ import annotations

from enum import StrEnum

from app.errors import WaymarkError
from app.formats.alignments.read import ALIGNMENT_FORMATS
from app.formats.format import Confidence, Format, Sample, SpooledFile, Use, detect_format, is_archive
from app.formats.frame_list import is_frame_list
from app.formats.images import FRAME_FORMATS
from app.formats.packets.read import PACKET_FORMATS
from app.formats.poses import POSE_FORMATS
from app.formats.surveys.read import SURVEY_FORMATS
from app.formats.traces.declaration import TraceLimits
from app.formats.traces.formats import TRACE_FORMATS
from app.formats.traces.parts import open_parts
from app.formats.video_file import EXPECTED as VIDEOS
from app.formats.video_file import detect_video, holds_video

FORMATS: tuple[Format[object], ...] = (
    *FRAME_FORMATS,
    *TRACE_FORMATS,
    *PACKET_FORMATS,
    *POSE_FORMATS,
    *SURVEY_FORMATS,
    *ALIGNMENT_FORMATS,
)
"""Of equally likely formats the first is detected."""
_SAMPLE_BYTES = 1 << 16  # [byte] as much as `open_parts` reads of each file at first
_POSE_SUFFIXES = (".gpx", ".nmea", ".nma")


def list_decoded() -> str:
    """All kinds of files that are decoded, for a message."""
    accepted = {use: ", ".join(found.name for found in FORMATS if found.use is use) for use in _DECODED_AS}
    return (
        f"frames ({accepted[Use.FRAME]}, or a ZIP of them); videos ({VIDEOS}, or a ZIP of one); "
        f"traces ({accepted[Use.TRACE]}, or a ZIP of them); packet logs ({accepted[Use.PACKETS]}), "
        f"also in a ZIP with the vehicle's track ({accepted[Use.POSES]})"
    )


class UploadKind(StrEnum):
    """What an upload is decoded as."""

    FRAME = "frame"
    TRACE = "trace"
    PACKETS = "packets"


_DECODED_AS = {
    Use.FRAME: UploadKind.FRAME,
    Use.TRACE: UploadKind.TRACE,
    Use.PACKETS: UploadKind.PACKETS,
    Use.POSES: UploadKind.PACKETS,
}
"""A track comes with a packet log."""


def guess_kind(name: str, file: SpooledFile) -> UploadKind | None:
    """What an upload is; None if its content does not show it.

    Parameters
    ----------
    name : str
        Of the file.
    file : SpooledFile
        A file, or a ZIP of files. Only the beginning of each file is looked at.

    Returns
    -------
    UploadKind or None
        A ZIP of nothing but pictures is frames, also beside a list of frames or a track; one with a packet log in it
        is packets, and so is a track without pictures.
    """
    head = file.head()
    if detect_video(head) is not None or holds_video(file):
        return UploadKind.FRAME
    if not is_archive(head):
        return _guess_file(name, head)
    try:
        with file.open() as stream:
            parts = [part for part in open_parts({name: stream}, TraceLimits()) if not part.name.startswith(".")]
    except WaymarkError:
        return UploadKind.FRAME  # too many files for a recording; the archive's reader reports any other fault
    if any(is_frame_list(part.name) for part in parts):
        return UploadKind.FRAME
    uses = {_guess_use(part.name, part.head) for part in parts}
    kinds = {use and _DECODED_AS[use] for use in uses} - {UploadKind.FRAME}
    if not kinds or uses == {Use.FRAME, Use.POSES}:
        return UploadKind.FRAME
    return next((kind for kind in (UploadKind.PACKETS, UploadKind.TRACE) if kind in kinds), None)


def _guess_file(name: str, data: bytes) -> UploadKind | None:
    use = _guess_use(name, data)
    return None if use is None else _DECODED_AS[use]


def _guess_use(name: str, data: bytes) -> Use | None:
    decoded = [found for found in FORMATS if found.use in _DECODED_AS]
    found = detect_format(Sample(name, data[:_SAMPLE_BYTES]), decoded, Confidence.PLAUSIBLE)
    return None if found is None else found.use


def detect_drive_file(name: str, data: bytes) -> Use:
    """What a file of a drive past CERPMs is: a camera frame, the vehicle's poses, or else packets."""
    if name.lower().endswith(_POSE_SUFFIXES) and detect_format(Sample(name, data), FRAME_FORMATS) is None:
        return Use.POSES
    formats = [found for found in FORMATS if found.use in (Use.FRAME, Use.PACKETS, Use.POSES)]
    found = detect_format(Sample(name, data[:_SAMPLE_BYTES]), formats, Confidence.LIKELY)
    return Use.PACKETS if found is None else found.use
