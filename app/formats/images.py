"""Uploaded bytes to one frame: the only loader of pictures in Waymark.

Everything that can be known from the header is checked before a codec sees a byte (`image_headers`). The orientation is
applied here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, UnreadableUpload
from app.formats.format import Format, Use, detect_signature
from app.formats.image_headers import FIELD, SEND_AS_IT_IS, ImageHeader, ImageKind, ImageLimits, scan_image

__all__ = [
    "FRAME_FORMATS",
    "Frame",
    "ImageHeader",
    "ImageKind",
    "ImageLimits",
    "check_thermal_range",
    "inspect_image",
    "load_image",
]

_ROTATIONS = {3: cv2.ROTATE_180, 6: cv2.ROTATE_90_CLOCKWISE, 8: cv2.ROTATE_90_COUNTERCLOCKWISE}


@dataclass(frozen=True, slots=True)
class Frame:
    """A decoded picture.

    Attributes
    ----------
    pixels : ndarray of uint8
        BGR, shape (H, W, 3), or grey, shape (H, W), for thermal frames.
    header : ImageHeader
    """

    pixels: npt.NDArray[np.uint8]
    header: ImageHeader


def inspect_image(data: bytes, limits: ImageLimits | None = None, *, thermal: bool = False) -> ImageHeader:
    """Check a picture's structure without decoding it.

    Parameters
    ----------
    data : bytes
        The upload.
    limits : ImageLimits, optional
    thermal : bool
        Whether the frame is declared to come from a thermal camera; only those may have 16 bits.

    Raises
    ------
    UploadTooLarge
        More pixels than the limit.
    UnsupportedUpload
        Another kind of file, or a variety of JPEG or PNG that no camera writes for us.
    UnreadableUpload
        Damaged, truncated, or lying about its lengths.
    """
    return scan_image(data, limits or ImageLimits(), thermal=thermal).header


def load_image(
    data: bytes,
    limits: ImageLimits | None = None,
    *,
    thermal: bool = False,
    thermal_range: tuple[float, float] | None = None,
) -> Frame:
    """Decode one JPEG or PNG, upright.

    Parameters
    ----------
    data : bytes
        The upload.
    limits : ImageLimits, optional
    thermal : bool
        Return grey instead of BGR.
    thermal_range : (float, float), optional
        Counts of a 16-bit frame that become 0 and 255; by default its 0.5 and 99.5 percentiles. [counts]

    Returns
    -------
    Frame
        uint8 pixels, BGR or (thermal) grey.

    Raises
    ------
    UnreadableUpload, UploadTooLarge, UnsupportedUpload
        As `inspect_image`, or the codec refused it.
    """
    scan = scan_image(data, limits or ImageLimits(), thermal=thermal)
    header, view = scan.header, memoryview(data)
    picture = (
        b"".join(view[start:end] for start, end in scan.parts) if len(scan.parts) > 1 else view[: scan.parts[0][1]]
    )
    flags = cv2.IMREAD_IGNORE_ORIENTATION | (cv2.IMREAD_GRAYSCALE if thermal else cv2.IMREAD_COLOR)
    if header.bit_depth == 16:
        flags |= cv2.IMREAD_ANYDEPTH
    try:
        pixels = cv2.imdecode(np.frombuffer(picture, np.uint8), flags)
    except (cv2.error, MemoryError) as error:
        raise UnreadableUpload(f"the {header.kind} cannot be decoded", field=FIELD, cure=SEND_AS_IT_IS) from error
    if pixels is None or pixels.dtype != (np.uint16 if header.bit_depth == 16 else np.uint8):
        raise UnreadableUpload(
            f"the {header.kind} is damaged and cannot be decoded", field=FIELD, cure="send the file again, complete"
        )
    grey = _eight_bits(pixels, thermal_range) if header.bit_depth == 16 else pixels
    upright = cv2.rotate(grey, _ROTATIONS[header.orientation]) if header.orientation in _ROTATIONS else grey
    if upright.shape[:2] != (header.height_px, header.width_px):
        raise UnreadableUpload(f"the {header.kind} contradicts its own header", field=FIELD, cure=SEND_AS_IT_IS)
    return Frame(np.asarray(upright, dtype=np.uint8), header)


FRAME_FORMATS: tuple[Format[Callable[..., Frame]], ...] = (
    Format("jpeg", Use.FRAME, "JPEG", detect_signature(b"\xff\xd8\xff"), load_image),
    Format("png", Use.FRAME, "PNG", detect_signature(b"\x89PNG"), load_image),
)


def check_thermal_range(thermal_range: tuple[float, float], field: str = "thermal_range") -> None:
    """Refuse a range of counts that is empty, reversed or not finite."""
    low, high = thermal_range
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise InvalidParameter(
            f"the thermal range {low:g} to {high:g} is empty", field=field, limit="low < high, both finite [counts]"
        )


def _eight_bits(counts: npt.NDArray[Any], thermal_range: tuple[float, float] | None) -> npt.NDArray[np.uint8]:
    if thermal_range is not None:
        check_thermal_range(thermal_range)
        low, high = thermal_range
    else:
        low, high = (float(v) for v in np.percentile(counts, (0.5, 99.5)))
    scale = 255.0 / max(high - low, 1.0)
    table = np.clip((np.arange(65536, dtype=np.float64) - low) * scale, 0, 255).round().astype(np.uint8)
    scaled: npt.NDArray[np.uint8] = table[counts]
    return scaled
