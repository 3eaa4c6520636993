"""EXIF of pictures: the orientation, the focal length, and when the picture was taken.

Source: CIPA DC-008 (EXIF 2.32), tags 0x0112, 0x8769, 0x9003, 0x9011, 0x9291 and 0xA405.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass

_ORIENTATION, _EXIF_IFD = 0x0112, 0x8769
_TAKEN, _TAKEN_OFFSET, _TAKEN_FRACTION = 0x9003, 0x9011, 0x9291
_FOCAL_35MM = 0xA405
_ASCII, _SHORT, _LONG = 2, 3, 4  # types of values
_DATE = re.compile(r"(\d{4}):(\d\d):(\d\d) (\d\d:\d\d:\d\d)\Z")
_OFFSET = re.compile(r"[+-]\d\d:\d\d\Z")
_MAX_TEXT = 64  # [byte] chosen by hand; a date has 20


@dataclass(frozen=True, slots=True)
class Exif:
    """What is read of a picture's EXIF.

    Attributes
    ----------
    orientation : int
        1 to 8; 1 if there is none or it is invalid.
    taken : str or None
        When the picture was taken, as RFC 3339 writes it; without a zone where the camera states none.
    focal_35mm : float or None
        Focal length that gives the same view on film of 36 x 24 mm. [mm]
    """

    orientation: int = 1
    taken: str | None = None
    focal_35mm: float | None = None


def read_exif(tiff: bytes) -> Exif:
    """Read a TIFF header with its directories; what is damaged counts as missing."""
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None or len(tiff) < 8:
        return Exif()
    orientation, exif_at = 1, None
    for tag, kind, count, at in _entries(tiff, order, _long(tiff, order, 4)):
        if count == 1 and kind in (_SHORT, _LONG) and tag in (_ORIENTATION, _EXIF_IFD):
            value = int(struct.unpack_from(order + ("H" if kind == _SHORT else "I"), tiff, at)[0])
            if tag == _EXIF_IFD:
                exif_at = value
            elif 1 <= value <= 8:
                orientation = value
    if exif_at is None:
        return Exif(orientation)
    return Exif(orientation, _taken(tiff, order, exif_at), _focal_35mm(tiff, order, exif_at))


def _focal_35mm(tiff: bytes, order: str, directory: int) -> float | None:
    for tag, kind, count, at in _entries(tiff, order, directory):
        if tag == _FOCAL_35MM and kind == _SHORT and count == 1:
            return float(struct.unpack_from(order + "H", tiff, at)[0]) or None  # 0: unknown
    return None


def _taken(tiff: bytes, order: str, directory: int) -> str | None:
    texts = {}
    for tag, kind, count, at in _entries(tiff, order, directory):
        if tag in (_TAKEN, _TAKEN_OFFSET, _TAKEN_FRACTION) and kind == _ASCII and 0 < count <= _MAX_TEXT:
            start = at if count <= 4 else _long(tiff, order, at)
            texts[tag] = tiff[start : start + count].split(b"\0")[0].decode("ascii", "replace").strip()
    date = _DATE.match(texts.get(_TAKEN, ""))
    if date is None:
        return None
    fraction, offset = texts.get(_TAKEN_FRACTION, ""), texts.get(_TAKEN_OFFSET, "")
    year, month, day, clock = date.groups()
    taken = f"{year}-{month}-{day}T{clock}"
    taken += f".{fraction[:6]}" if fraction.isdecimal() and fraction.isascii() else ""
    return taken + (offset if _OFFSET.match(offset) else "")


def _entries(tiff: bytes, order: str, directory: int) -> Iterator[tuple[int, int, int, int]]:
    """Tag, type, count and the place of the value of each entry of a directory."""
    if not 0 < directory <= len(tiff) - 2:
        return
    (entries,) = struct.unpack_from(order + "H", tiff, directory)
    for k in range(entries):
        at = directory + 2 + 12 * k
        if at + 12 > len(tiff):
            return
        tag, kind, count = struct.unpack_from(order + "HHI", tiff, at)
        yield tag, kind, count, at + 8


def _long(tiff: bytes, order: str, at: int) -> int:
    return int(struct.unpack_from(order + "I", tiff, at)[0])
