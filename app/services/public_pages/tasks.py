"""Photos of damage reports, written again in a decoder process."""

from __future__ import annotations

import cv2

from app.errors import UnreadableUpload
from app.formats.format import SpooledFile
from app.formats.images import ImageLimits, load_image
from app.services.decoder_tasks import decoder_task

MAX_SIDE_PX = 2048
"""Longest side of the stored photo. [px] Damage can be seen, and a photo takes 0.5 MB."""
JPEG_QUALITY = 85


@decoder_task("photo", "send a photo of 12 megapixels or fewer", is_long=False)
def write_report_photo(photo: SpooledFile, limits: ImageLimits) -> bytes:
    """Decode a JPEG or PNG, and encode its pixels as a JPEG: upright and smaller.

    Nothing else of the file remains, EXIF with its position least of all.
    """
    pixels: cv2.typing.MatLike = load_image(photo.read(), limits).pixels
    factor = MAX_SIDE_PX / max(pixels.shape[:2])
    if factor < 1.0:
        size = tuple(max(1, round(side * factor)) for side in pixels.shape[1::-1])
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    done, content = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise UnreadableUpload("the photo cannot be written as a JPEG", field="photo")
    return content.tobytes()
