"""Kinds of decodes."""

from __future__ import annotations

from enum import StrEnum


class DecodeKind(StrEnum):
    """What was decoded."""

    FRAME = "frame"
    ARCHIVE = "archive"
    VIDEO = "video"
    TRACE = "trace"
    PACKETS = "packets"
