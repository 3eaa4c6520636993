"""Drawing -> PNG with its resolution."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np

from app.encoders.plate.drawing import FACE_LAYERS, SHEET_LAYERS, UNDER_LAYERS, Drawing
from app.encoders.plate.raster import Image, paint
from app.errors import InvalidParameter

DPI = (36.0, 1200.0)
MAX_PIXELS = 64_000_000
_MM_PER_INCH = 25.4
_SIGNATURE_AND_HEADER = 8 + 25
_COMPRESSION = 3


def write_png(drawing: Drawing, *, dpi: float = 150.0) -> bytes:
    """Write a drawing as an 8-bit RGB PNG.

    Parameters
    ----------
    drawing : Drawing
    dpi : float
        Resolution, 36 to 1200; the sheet may not exceed 64 million pixels. [1/inch]

    Returns
    -------
    bytes
        A PNG with a pHYs chunk. Unit edges are at rounded cumulative positions, without smoothing.

    Raises
    ------
    InvalidParameter
        The resolution is outside its limits or the image would be too large.
    """
    low, high = DPI
    if not low <= dpi <= high:
        raise InvalidParameter(
            f"the resolution is {dpi:g} dpi", field="dpi", limit=f"{low:g} to {high:g} dpi", cure="150 is usual"
        )
    per_metre = round(dpi / _MM_PER_INCH * 1000)
    px_per_mm = per_metre / 1000  # as pHYs stores it, so the file has true size
    width, height = round(drawing.width_mm * px_per_mm), round(drawing.height_mm * px_per_mm)
    if width * height > MAX_PIXELS:
        raise InvalidParameter(
            f"{drawing.width_mm:g} x {drawing.height_mm:g} mm at {dpi:g} dpi are {width * height} pixels",
            field="dpi",
            limit=f"{MAX_PIXELS} pixels",
            cure="choose a lower resolution or a smaller sheet",
        )
    image: Image = np.full((height, width, 3), 255, dtype=np.uint8)
    paint(image, drawing, (*UNDER_LAYERS, *FACE_LAYERS, *SHEET_LAYERS), px_per_mm, (0.0, drawing.height_mm))
    encoded, content = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, _COMPRESSION])
    if not encoded:
        raise RuntimeError("OpenCV could not encode the image")
    return _with_resolution(content.tobytes(), per_metre)


def _with_resolution(png: bytes, per_metre: int) -> bytes:
    """Insert a pHYs chunk (PNG specification, 11.3.5.3) behind the header."""
    body = b"pHYs" + struct.pack(">IIB", per_metre, per_metre, 1)
    chunk = struct.pack(">I", 9) + body + struct.pack(">I", zlib.crc32(body))
    return png[:_SIGNATURE_AND_HEADER] + chunk + png[_SIGNATURE_AND_HEADER:]
