"""Picture files made by hand, byte by byte where a codec would refuse to write them."""

from __future__ import annotations

import io
import struct
import zlib
from typing import Any

import numpy as np
from PIL import Image


def corner_frame(width: int = 320, height: int = 240) -> np.ndarray[Any, Any]:
    """RGB frame whose quarters differ, so that turning or mirroring it shows: red, green / blue, white."""
    frame = np.zeros((height, width, 3), np.uint8)
    h, w = height // 2, width // 2
    frame[:h, :w], frame[:h, w:], frame[h:, :w], frame[h:, w:] = (250, 5, 5), (5, 250, 5), (5, 5, 250), (250, 250, 250)
    return frame


def jpeg(frame: np.ndarray[Any, Any] | None = None, *, orientation: int | None = None, **options: Any) -> bytes:
    """JPEG written by Pillow."""
    image = Image.fromarray(corner_frame() if frame is None else frame)
    if orientation is not None:
        exif = Image.Exif()
        exif[0x0112] = orientation
        options["exif"] = exif
    if options.pop("cmyk", False):
        image = image.convert("CMYK")
    out = io.BytesIO()
    image.save(out, "JPEG", quality=95, **options)
    return out.getvalue()


def png(frame: np.ndarray[Any, Any] | None = None, **options: Any) -> bytes:
    """PNG written by Pillow."""
    out = io.BytesIO()
    Image.fromarray(corner_frame() if frame is None else frame).save(out, "PNG", **options)
    return out.getvalue()


def chunk(name: bytes, body: bytes, *, length: int | None = None) -> bytes:
    """PNG chunk, with a length that may lie."""
    return (
        struct.pack(">I", len(body) if length is None else length)
        + name
        + body
        + struct.pack(">I", zlib.crc32(name + body))
    )


def raw_png(width: int, height: int, rows: bytes, *, depth: int = 8, colour: int = 2, extra: bytes = b"") -> bytes:
    """PNG from its scan lines as they are, with more chunks before the pixels if wanted."""
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + extra
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


def lying_png() -> bytes:
    """Twelve kilobytes whose pixel chunk says 3.67 GB (upload_traps 2)."""
    header = struct.pack(">IIBBBBB", 64, 64, 8, 2, 0, 0, 0)
    pixels = chunk(b"IDAT", bytes(12_000), length=3_670_000_000 % 2**32)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + pixels + chunk(b"IEND", b"")


def huge_png(width: int = 30_000, height: int = 30_000) -> bytes:
    """A hundred kilobytes that expand to 2.7 GB of pixels (upload_traps 2)."""
    rows = zlib.compressobj(9)
    body = b"".join(rows.compress(bytes(1 + 3 * width)) for _ in range(64)) + rows.flush()
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", body) + chunk(b"IEND", b"")
