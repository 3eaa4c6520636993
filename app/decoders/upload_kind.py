"""What an upload is, by its content: frames, a magnetometer trace or a packet log."""

from __future__ import annotations

import re
from enum import StrEnum

from app.decoders.archives import is_archive
from app.decoders.cerpm.log_text import decode_text, find_table, is_text, match_columns, numbered_lines
from app.decoders.cerpm.packet_log_raw import looks_like_hex_lines
from app.decoders.cerpm.packet_log_rows import ALIASES, NEEDED
from app.decoders.traces.declaration import TraceLimits
from app.decoders.traces.parts import open_parts
from app.errors import WaymarkError
from app.markers.cerpm import MESSAGE_BYTES, VERSION

PICTURES = (b"\xff\xd8\xff", b"\x89PNG")
_TRACE_MAGIC = (b"PAR1", b"LOGG")
_TRACE_COLUMN = re.compile(r"(s\d+_[xyz]|sensor .*|arbitration_id|time stamp)\Z", re.IGNORECASE)
_TRACKS = ("<", "$G", "$P", "!")
_OURS = 0.9
"""Share of payloads of this version in a file of payloads; of random bytes a sixteenth begins like one."""


class UploadKind(StrEnum):
    """What an upload is decoded as."""

    FRAME = "frame"
    TRACE = "trace"
    PACKETS = "packets"


def guess_kind(name: str, data: bytes) -> UploadKind | None:
    """What an upload is; None where its content does not tell.

    Parameters
    ----------
    name : str
        Of the file.
    data : bytes
        A file, or a ZIP of files. Of each only the beginning is looked at.

    Returns
    -------
    UploadKind or None
        A ZIP of nothing but pictures is frames; one with a packet log or a track in it is packets.
    """
    if data.startswith(PICTURES):
        return UploadKind.FRAME
    if not is_archive(data):
        return _kind_of(name, data)
    try:
        parts = [part for part in open_parts({name: data}, TraceLimits()) if not part.name.startswith(".")]
    except WaymarkError:
        return UploadKind.FRAME  # too many files for a recording; what else is wrong, the archive's reader says
    kinds = {_kind_of(part.name, part.head) for part in parts if not part.head.startswith(PICTURES)}
    if not kinds:
        return UploadKind.FRAME
    return next((kind for kind in (UploadKind.PACKETS, UploadKind.TRACE) if kind in kinds), None)


def _kind_of(name: str, data: bytes) -> UploadKind | None:
    head = data[: 1 << 16]
    if head.startswith(_TRACE_MAGIC):
        return UploadKind.TRACE
    if not is_text(head):
        heads = head[::MESSAGE_BYTES]
        ours = sum(1 for byte in heads if byte >> 4 == VERSION)
        return UploadKind.PACKETS if heads and ours >= _OURS * len(heads) else UploadKind.TRACE
    text, _note = decode_text(name, head)
    start = text.lstrip("\ufeff \t\r\n")
    if start.startswith(("{", "[", *_TRACKS)) or looks_like_hex_lines(text):
        return UploadKind.PACKETS
    _number, header = next(numbered_lines(text), (0, ""))
    columns = find_table(header).columns
    if any(_TRACE_COLUMN.match(column.strip().strip('"')) for column in columns):
        return UploadKind.TRACE
    found = match_columns(columns, ALIASES, {})
    if "payload" in found or all(quantity in found for quantity in NEEDED) or {"lon", "lat"} <= set(found):
        return UploadKind.PACKETS
    return UploadKind.TRACE if re.search(r"\A\s*[^\d\s]", header) else None
