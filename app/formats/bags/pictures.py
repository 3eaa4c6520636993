"""Pictures of bags: compressed ones, and raw ones with their rows of bytes."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from app.errors import UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.bags.messages import FIELD, types_of
from app.formats.images import ImageLimits, inspect_image, load_image

COMPRESSED = types_of("sensor_msgs", "CompressedImage")
RAW = types_of("sensor_msgs", "Image")
_TO_BGR = {
    "bgr8": (3, None),
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "mono8": (1, cv2.COLOR_GRAY2BGR),
}
"""Bytes of a pixel and conversion by encoding. Source: sensor_msgs/image_encodings.hpp."""


def size_px(type_name: str, message: Any, limits: ImageLimits) -> tuple[int, int]:
    """Width and height of a picture, from its header. [px]"""
    if type_name in COMPRESSED:
        header = inspect_image(bytes(message.data), limits)
        return header.width_px, header.height_px
    width, height = int(message.width), int(message.height)
    if width * height > limits.pixels:
        raise UploadTooLarge(f"a picture has {width} x {height} pixels", field=FIELD, limit=f"{limits.pixels} pixels")
    _check_raw(message)
    return width, height


def pixels_of(type_name: str, message: Any) -> npt.NDArray[np.uint8]:
    """A picture as blue, green, red, shape (height, width, 3)."""
    if type_name in COMPRESSED:
        return load_image(bytes(message.data)).pixels
    bytes_each, conversion = _check_raw(message)
    rows = np.frombuffer(bytes(message.data), np.uint8)[: message.height * message.step]
    used = rows.reshape(message.height, message.step)[:, : message.width * bytes_each]
    pixels = used.reshape(message.height, message.width, bytes_each)
    return np.ascontiguousarray(pixels) if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion))


def _check_raw(message: Any) -> tuple[int, int | None]:
    encoding = str(message.encoding)
    if encoding not in _TO_BGR:
        raise UnsupportedUpload(
            f"pictures with the encoding {encoding[:40]!r} are not read", field=FIELD, limit=", ".join(_TO_BGR),
            cure="record another encoding, or the topic of compressed pictures",
        )  # fmt: skip
    bytes_each, _ = _TO_BGR[encoding]
    has_rows = 0 < message.width * bytes_each <= message.step and message.height > 0
    if not has_rows or len(message.data) < message.height * message.step:
        raise UnreadableUpload("a picture has fewer bytes than its size needs", field=FIELD, cure="record it again")
    return _TO_BGR[encoding]
