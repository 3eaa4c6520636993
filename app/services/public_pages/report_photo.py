"""What a decoder process is asked to do with the photo of a damage report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from app.formats.images import ImageLimits
from app.formats.spooled_file import SpooledFile
from app.services.decoder_processes import Task

MAX_SIDE_PX = 2048
"""Longest side of the stored photo. [px] Source: chosen by hand: damage is seen, and a photo takes 0.5 MB."""
JPEG_QUALITY = 85


@dataclass(frozen=True, slots=True)
class ReportPhotoTask(Task[bytes]):
    """A photo to decode and to write again as a JPEG: upright, smaller, and without metadata.

    Attributes
    ----------
    photo : SpooledFile
        JPEG or PNG.
    limits : ImageLimits
    """

    is_long: ClassVar[bool] = False

    photo: SpooledFile
    limits: ImageLimits
