"""Photos of damage reports, written anew inside a decoder process."""

from __future__ import annotations

import cv2

from app.errors import UnreadableUpload
from app.formats.images import load_image
from app.jobs.memory_limit import memory_is_the_limit
from app.services.public_pages.report_photo import JPEG_QUALITY, MAX_SIDE_PX, ReportPhotoTask


def write_report_photo(task: ReportPhotoTask, _before: None) -> bytes:
    """Decode a photo and encode its pixels: nothing else of the file remains, EXIF with its position least of all."""
    with memory_is_the_limit("photo", "send a photo of 12 megapixels or fewer"):
        pixels: cv2.typing.MatLike = load_image(task.photo.read(), task.limits).pixels
        factor = MAX_SIDE_PX / max(pixels.shape[:2])
        if factor < 1.0:
            size = tuple(max(1, round(side * factor)) for side in pixels.shape[1::-1])
            pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
        done, content = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise UnreadableUpload("the photo cannot be written as a JPEG", field="photo")
    return content.tobytes()
