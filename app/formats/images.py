"""Uploaded bytes to one frame: the only loader of pictures in Waymark.

Everything that can be known from the header is checked before a codec sees a byte. The orientation is
applied here and nowhere else.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.format import Format, Use, detect_signature

# === EXIF of pictures: the orientation, the focal length, and when and where the picture was taken.
#
# Source: CIPA DC-008 (EXIF 2.32), tags 0x0112, 0x8769, 0x8825, 0x9003, 0x9011, 0x9291 and 0xA405, and in the directory
# of GPS 1 to 4, 0x12 and 0x1F.


_ORIENTATION, _EXIF_IFD, _GPS_IFD = 0x0112, 0x8769, 0x8825
_NORTH_SOUTH, _LATITUDE, _EAST_WEST, _LONGITUDE, _DATUM, _GPS_ERROR = 1, 2, 3, 4, 0x12, 0x1F
_TAKEN, _TAKEN_OFFSET, _TAKEN_FRACTION = 0x9003, 0x9011, 0x9291
_FOCAL_35MM = 0xA405
_ASCII, _SHORT, _LONG, _RATIONAL = 2, 3, 4, 5  # types of values
_DATE = re.compile(r"(\d{4}):(\d\d):(\d\d) (\d\d:\d\d:\d\d)\Z")
_OFFSET = re.compile(r"[+-]\d\d:\d\d\Z")
_MAX_TEXT = 64  # [byte] a date has 20


@dataclass(frozen=True, slots=True)
class PicturePosition:
    """Where the camera's receiver was, in WGS 84."""

    lon_deg: float
    lat_deg: float
    error_m: float | None  # as the receiver states it; None if it does not


@dataclass(frozen=True, slots=True)
class Exif:
    """What is read of a picture's EXIF."""

    orientation: int = 1  # 1 to 8; 1 if there is none or it is invalid
    # when the picture was taken, as RFC 3339 writes it; without a zone where the camera states none
    taken: str | None = None
    focal_35mm: float | None = None  # [mm] focal length that gives the same view on film of 36 x 24 mm
    position: PicturePosition | None = None


def read_exif(tiff: bytes) -> Exif:
    """Read a TIFF header with its directories; what is damaged counts as missing."""
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None or len(tiff) < 8:
        return Exif()
    orientation, at_tag = 1, dict[int, int]()
    for tag, kind, count, at in _entries(tiff, order, _long(tiff, order, 4)):
        if count == 1 and kind in (_SHORT, _LONG) and tag in (_ORIENTATION, _EXIF_IFD, _GPS_IFD):
            value = int(struct.unpack_from(order + ("H" if kind == _SHORT else "I"), tiff, at)[0])
            if tag != _ORIENTATION:
                at_tag[tag] = value
            elif 1 <= value <= 8:
                orientation = value
    of_camera, of_receiver = at_tag.get(_EXIF_IFD, 0), at_tag.get(_GPS_IFD, 0)
    return Exif(
        orientation, _taken(tiff, order, of_camera), _focal_35mm(tiff, order, of_camera),
        _position(tiff, order, of_receiver),
    )  # fmt: skip


def _position(tiff: bytes, order: str, directory: int) -> PicturePosition | None:
    """None where it is incomplete, out of range, 0, 0 as of a receiver without a position, or of another datum."""
    texts, numbers = dict[int, str](), dict[int, float]()
    for tag, kind, count, at in _entries(tiff, order, directory):
        if kind == _ASCII and 0 < count <= _MAX_TEXT:
            texts[tag] = _text(tiff, order, count, at)
        elif kind == _RATIONAL and 0 < count <= 3:
            numbers[tag] = _sexagesimal(tiff, _long(tiff, order, at), order, count)
    if re.sub(r"[\s_-]", "", texts.get(_DATUM, "")).upper() not in ("", "WGS84"):
        return None
    lat_deg = {"N": 1, "S": -1}.get(texts.get(_NORTH_SOUTH, "")[:1], math.nan) * numbers.get(_LATITUDE, math.nan)
    lon_deg = {"E": 1, "W": -1}.get(texts.get(_EAST_WEST, "")[:1], math.nan) * numbers.get(_LONGITUDE, math.nan)
    if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 180) or lat_deg == lon_deg == 0:
        return None
    error_m = numbers.get(_GPS_ERROR, 0.0)
    return PicturePosition(lon_deg, lat_deg, error_m if 0 < error_m < math.inf else None)


def _sexagesimal(tiff: bytes, at: int, order: str, count: int) -> float:
    """The sum of fractions of which each is of a sixtieth of the one before; NaN if one of them is none."""
    if at + 8 * count > len(tiff):
        return math.nan
    pairs = struct.unpack_from(f"{order}{2 * count}I", tiff, at)
    parts = [over / under if under else math.nan for over, under in zip(pairs[::2], pairs[1::2], strict=True)]
    return float(sum(part / 60**k for k, part in enumerate(parts)))


def _focal_35mm(tiff: bytes, order: str, directory: int) -> float | None:
    for tag, kind, count, at in _entries(tiff, order, directory):
        if tag == _FOCAL_35MM and kind == _SHORT and count == 1:
            return float(struct.unpack_from(order + "H", tiff, at)[0]) or None  # 0: unknown
    return None


def _taken(tiff: bytes, order: str, directory: int) -> str | None:
    texts = {}
    for tag, kind, count, at in _entries(tiff, order, directory):
        if tag in (_TAKEN, _TAKEN_OFFSET, _TAKEN_FRACTION) and kind == _ASCII and 0 < count <= _MAX_TEXT:
            texts[tag] = _text(tiff, order, count, at)
    date = _DATE.match(texts.get(_TAKEN, ""))
    if date is None:
        return None
    fraction, offset = texts.get(_TAKEN_FRACTION, ""), texts.get(_TAKEN_OFFSET, "")
    year, month, day, clock = date.groups()
    taken = f"{year}-{month}-{day}T{clock}"
    taken += f".{fraction[:6]}" if fraction.isdecimal() and fraction.isascii() else ""
    return taken + (offset if _OFFSET.match(offset) else "")


def _text(tiff: bytes, order: str, count: int, at: int) -> str:
    start = at if count <= 4 else _long(tiff, order, at)
    return tiff[start : start + count].split(b"\0")[0].decode("ascii", "replace").strip()


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


# === Headers of pictures, and checks of a file's structure before a codec reads it.
#
# The kind is detected by its signature (never by a name or a declared type), the dimensions are compared with the
# limits, the lengths of the parts with the length of the file. Bytes that are not part of the picture (metadata,
# trailing bytes) are left out.
#
# Sources: PNG specification (3rd edition) sections 5 and 11, ITU-T T.81 annex B, CIPA DC-008 (EXIF).


FIELD = "file"
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_SIGNATURE = b"\xff\xd8\xff"
_KINDS = "JPEG (8-bit) or PNG (8-bit, or 16-bit greyscale from a thermal camera)"
SEND_AS_IT_IS = "send a JPEG or PNG as the camera wrote it"
_CONVERT = "convert it without loss, e.g. ffmpeg -i FILE -c copy drive.mp4"
_UNPACK = "send the file itself, or a ZIP of frames"
_OTHER_SIGNATURES: tuple[tuple[tuple[bytes, ...], str, str | None], ...] = (
    ((b"\x00\x00\x00\x01", b"\x00\x00\x01\x67", b"\x00\x00\x01\x40"), "a raw H.264 or H.265 stream", _CONVERT),
    ((b"\x00\x00\x01\xba", b"\x00\x00\x01\xb3"), "an MPEG program stream or a raw stream", _CONVERT),
    ((b"FLV",), "a Flash video", _CONVERT),
    (
        (b"\x28\xb5\x2f\xfd",), "compressed by zstd",
        "expand it, e.g. zstd -d FILE; bags with compressed messages or chunks are read as they are",
    ),
    ((b"\x1f\x8b",), "compressed by gzip", "expand it, e.g. gunzip FILE"),
    ((b"7z\xbc\xaf",), "a 7z archive", _UNPACK),
    ((b"Rar!",), "a RAR archive", _UNPACK),
    (
        (b"#ROSBAG V",), "a ROS bag of an old version",
        "convert it to version 2.0, e.g. rosbag fix or rosbag reindex",
    ),
    ((b"GIF8",), "a GIF", None),
    ((b"BM",), "a BMP", None),
    ((b"II*\x00", b"MM\x00*"), "a TIFF", None),
    ((b"RIFF",), "a WebP or another RIFF file", None),
    ((b"%PDF",), "a PDF", None),
    ((b"PK\x03\x04",), "a ZIP archive", None),
    ((b"ffconcat", b"#EXTM3U"), "a playlist", None),
    ((b"v=0",), "a session description (SDP)", None),
    ((b"<svg",), "an SVG", None),
    ((b"<?xml",), "an XML document", None),
)  # fmt: skip
"""First bytes of other files, their kind, and how a drive in one is made one that is read."""
_MAX_SCANS = 64  # of a progressive JPEG; libjpeg writes about 10
_MIRRORED = (2, 4, 5, 7)
_MARKER = re.compile(rb"\xff+[^\xff]", re.DOTALL)
_NEXT_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]", re.DOTALL)


class ImageKind(StrEnum):
    """Kinds of picture that are read."""

    JPEG = "jpeg"
    PNG = "png"
    VIDEO = "video"
    """A frame of a video; no file of its own."""


@dataclass(frozen=True, slots=True)
class ImageLimits:
    """Limits of a picture."""

    pixels: int = 50_000_000  # largest number of pixels of a frame
    # `side_min_px`, `side_max_px`: [px] shortest and longest side of a frame
    side_min_px: int = 32
    side_max_px: int = 32_768
    file_bytes: int = 32 * 1024**2  # [byte] largest file that is read


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """Properties of a picture by its header."""

    kind: ImageKind
    # `width_px`, `height_px`: [px] size upright, after the orientation is applied
    width_px: int
    height_px: int
    channels: int  # 1 grey, 3 colour (palettes count as colour), 2 and 4 with an alpha channel, which is ignored
    bit_depth: int = 8  # 8 or 16
    orientation: int = 1  # EXIF orientation as stored: 1, 3, 6 or 8
    trailing_bytes: int = 0  # bytes after the picture's end, which are ignored
    # when it was taken by its EXIF, as RFC 3339 writes it; without a zone where the camera states none
    taken: str | None = None
    focal_35mm: float | None = None  # [mm] focal length by its EXIF, for film of 36 x 24 mm
    position: PicturePosition | None = None  # by its EXIF


@dataclass(frozen=True, slots=True)
class ScannedImage:
    """Header of a picture, and the parts of the file that a codec needs: (start, end)."""

    header: ImageHeader
    parts: tuple[tuple[int, int], ...]


def scan_image(data: bytes, limits: ImageLimits, *, thermal: bool) -> ScannedImage:
    """Header and parts of a picture; raises the errors of `inspect_image`.

    `thermal` is true if the frame is declared to come from a thermal camera; only those may have 16 bits.
    """
    if not data:
        raise UnreadableUpload("the file is empty", field=FIELD, limit="at least one picture", cure=SEND_AS_IT_IS)
    if data.startswith(_PNG_SIGNATURE):
        scan = _scan_png(data, limits)
    elif data.startswith(_JPEG_SIGNATURE):
        scan = _scan_jpeg(data, limits)
    else:
        raise unknown_picture(data)
    if scan.header.bit_depth == 16 and not thermal:
        raise UnsupportedUpload(
            "a 16-bit PNG is read from thermal cameras only",
            field=FIELD,
            limit="8 bits a channel",
            cure="set thermal to true in the context, or send 8 bits a channel",
        )
    return scan


def is_picture(head: bytes) -> bool:
    """Whether a file begins like a JPEG or a PNG."""
    return head.startswith((_PNG_SIGNATURE, _JPEG_SIGNATURE))


def unknown_picture(
    head: bytes, accepted: str = _KINDS, cure: str = SEND_AS_IT_IS, *, of_drive: bool = False
) -> UnsupportedUpload:
    """The refusal of a file that is no picture, with its kind and the accepted kinds.

    `of_drive` is true where drives are accepted: then the cure is that of the kind, where it has one.
    """
    kind, drive_cure = next((found[1:] for found in _OTHER_SIGNATURES if head.startswith(found[0])), (None, None))
    if head[4:8] == b"ftyp":
        kind, drive_cure = "a video, HEIC or AVIF", None
    what = f"the file is {kind}, not a JPEG or PNG picture" if kind else "the file is not a JPEG or PNG picture"
    return UnsupportedUpload(what, field=FIELD, limit=accepted, cure=(of_drive and drive_cure) or cure)


def _check_size(width_px: int, height_px: int, limits: ImageLimits) -> None:
    size = f"{width_px} x {height_px} px"
    if min(width_px, height_px) < limits.side_min_px:
        raise UnreadableUpload(
            f"the picture is {size}: too small to hold a plate",
            field=FIELD,
            limit=f"at least {limits.side_min_px} px a side",
            cure="send the whole frame",
        )
    if width_px * height_px > limits.pixels or max(width_px, height_px) > limits.side_max_px:
        raise UploadTooLarge(
            f"the picture is {size}",
            field=FIELD,
            limit=f"{limits.pixels} pixels, {limits.side_max_px} px a side",
            cure="send frames at the camera's resolution, or crop them to the road",
        )


def _checked_exif(tiff: bytes) -> Exif:
    exif = read_exif(tiff)
    if exif.orientation in _MIRRORED:
        raise UnsupportedUpload(
            f"EXIF orientation {exif.orientation} mirrors the picture, and a mirrored plate reads as another code",
            field=FIELD,
            limit="EXIF orientation 1, 3, 6 or 8",
            cure="switch off the camera's mirroring (selfie or rear-view mode), or save the frame upright",
        )
    return exif


def _upright(width_px: int, height_px: int, orientation: int) -> tuple[int, int]:
    return (height_px, width_px) if orientation in (6, 8) else (width_px, height_px)


# --- JPEG -----------------------------------------------------------------------------------------------------------


def _cut_short(kind: str) -> UnreadableUpload:
    return UnreadableUpload(
        f"the {kind} ends before the picture does",
        field=FIELD,
        limit="complete files only",
        cure="send the file again, complete",
    )


@dataclass(slots=True)
class _JpegParts:
    """What the segments of a JPEG have declared so far."""

    size_px: tuple[int, int] | None = None
    components: int = 0
    exif: Exif | None = None
    scans: int = 0


def _scan_jpeg(data: bytes, limits: ImageLimits) -> ScannedImage:
    """Walk the segments up to the end of the picture (T.81 annex B.1)."""
    parts = _JpegParts()
    at = 2
    while True:
        found = _NEXT_MARKER.search(data, at) if parts.scans else _MARKER.match(data, at)
        if found is None:
            raise _cut_short("JPEG") if parts.scans or at >= len(data) - 1 else _bad_jpeg()
        marker, at = data[found.end() - 1], found.end()
        if marker == 0xD9:
            break
        if at + 2 > len(data):
            raise _cut_short("JPEG")
        length = int.from_bytes(data[at : at + 2], "big")
        if length < 2:
            raise _bad_jpeg()
        if at + length > len(data):
            raise _cut_short("JPEG")
        _read_segment(marker, data[at + 2 : at + length], parts, limits)
        at += length
    if parts.size_px is None or not parts.scans:
        raise _bad_jpeg()
    exif = parts.exif or Exif()
    width, height = _upright(*parts.size_px, exif.orientation)
    header = ImageHeader(
        ImageKind.JPEG,
        width,
        height,
        parts.components,
        8,
        exif.orientation,
        len(data) - at,
        exif.taken,
        exif.focal_35mm,
        exif.position,
    )
    return ScannedImage(header, ((0, at),))


def _bad_jpeg() -> UnreadableUpload:
    return UnreadableUpload("the JPEG's segments are damaged", field=FIELD, cure="send the file again, complete")


def _read_segment(marker: int, body: bytes, parts: _JpegParts, limits: ImageLimits) -> None:
    if marker == 0xE1 and body.startswith(b"Exif\x00\x00") and parts.exif is None:
        parts.exif = _checked_exif(body[6:])
    elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
        if parts.size_px is not None:
            raise _bad_jpeg()
        _read_frame_header(marker, body, parts, limits)
    elif marker == 0xDA:
        if parts.size_px is None:
            raise _bad_jpeg()
        parts.scans += 1
        if parts.scans > _MAX_SCANS:
            raise UnsupportedUpload(
                "the JPEG has more scans than any camera writes",
                field=FIELD,
                limit=f"{_MAX_SCANS} scans",
                cure=SEND_AS_IT_IS,
            )


def _read_frame_header(marker: int, body: bytes, parts: _JpegParts, limits: ImageLimits) -> None:
    if len(body) < 6:
        raise _bad_jpeg()
    precision, height, width, components = struct.unpack_from(">BHHB", body)
    if marker not in (0xC0, 0xC1, 0xC2) or precision != 8:
        raise UnsupportedUpload(
            "the JPEG is lossless, arithmetic-coded or deeper than 8 bits",
            field=FIELD,
            limit=_KINDS,
            cure=SEND_AS_IT_IS,
        )
    if components not in (1, 3):
        raise UnsupportedUpload(
            f"the JPEG has {components} components (CMYK is for print, and its colours are not a camera's)",
            field=FIELD,
            limit="greyscale or YCbCr",
            cure="save the frame as RGB",
        )
    _check_size(width, height, limits)
    parts.size_px, parts.components = (width, height), components


# --- PNG ------------------------------------------------------------------------------------------------------------

_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}


def _scan_png(data: bytes, limits: ImageLimits) -> ScannedImage:
    """Walk the chunks. Only the critical ones go to the codec: text and profiles can be compressed bombs."""
    at = len(_PNG_SIGNATURE)
    shape: tuple[int, int, int, int] | None = None
    exif, name, names, parts = Exif(), b"", set(), [(0, at)]
    while name != b"IEND":
        name, end = _next_chunk(data, at)
        if (shape is None) != (name == b"IHDR"):
            raise UnreadableUpload("the PNG does not begin with one header chunk", field=FIELD, cure=SEND_AS_IT_IS)
        if name == b"IHDR":
            shape = _read_png_header(data[at + 8 : end - 4], limits)
        elif name == b"acTL":
            raise UnsupportedUpload(
                "the PNG is animated", field=FIELD, limit="one picture a file", cure="send each frame as its own file"
            )
        elif name == b"eXIf":
            exif = _checked_exif(data[at + 8 : end - 4])
        if name in (b"IHDR", b"PLTE", b"IDAT", b"IEND"):
            parts.append((at, end))
        names.add(name)
        at = end
    if shape is None or b"IDAT" not in names:
        raise UnreadableUpload("the PNG holds no pixels", field=FIELD, cure=SEND_AS_IT_IS)
    width, height, depth, colour = shape
    upright = _upright(width, height, exif.orientation)
    header = ImageHeader(
        ImageKind.PNG,
        *upright,
        _PNG_CHANNELS[colour],
        depth,
        exif.orientation,
        len(data) - at,
        exif.taken,
        exif.focal_35mm,
        exif.position,
    )
    return ScannedImage(header, tuple(parts))


def _next_chunk(data: bytes, at: int) -> tuple[bytes, int]:
    """Name and end of the chunk at an offset, its length checked by the length of the file, its content by the CRC."""
    if at + 12 > len(data):
        raise _cut_short("PNG")
    length, name = struct.unpack_from(">I4s", data, at)
    end = at + 12 + length
    if end > len(data):
        raise UnreadableUpload(
            f"a {_printable(name)} chunk of the PNG declares {length} bytes, but {len(data) - at - 12} follow",
            field=FIELD,
            limit="chunk lengths within the file",
            cure="send the file again, complete",
        )
    if zlib.crc32(memoryview(data)[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
        raise UnreadableUpload(
            f"the checksum of a {_printable(name)} chunk fails: the PNG is damaged",
            field=FIELD,
            cure="send the file again, complete",
        )
    return name, end


def _printable(name: bytes) -> str:
    return name.decode("ascii") if name.isalpha() else "nameless"


def _read_png_header(body: bytes, limits: ImageLimits) -> tuple[int, int, int, int]:
    """Width, height, bit depth and colour type."""
    if len(body) != 13:
        raise UnreadableUpload("the PNG's header chunk has the wrong length", field=FIELD, cure=SEND_AS_IT_IS)
    width, height, depth, colour = struct.unpack_from(">IIBB", body)
    if colour not in _PNG_CHANNELS or (depth != 8 and not (depth == 16 and colour == 0)):
        raise UnsupportedUpload(
            f"the PNG has {depth} bits a channel (colour type {colour})",
            field=FIELD,
            limit=_KINDS,
            cure="save the frame with 8 bits a channel",
        )
    _check_size(width, height, limits)
    return width, height, depth, colour


# === Uploaded bytes to one frame.


_ROTATIONS = {3: cv2.ROTATE_180, 6: cv2.ROTATE_90_CLOCKWISE, 8: cv2.ROTATE_90_COUNTERCLOCKWISE}


@dataclass(frozen=True, slots=True)
class Frame:
    """A decoded picture."""

    pixels: npt.NDArray[np.uint8]  # BGR, shape (H, W, 3), or grey, shape (H, W), for thermal frames
    header: ImageHeader


def inspect_image(data: bytes, limits: ImageLimits | None = None, *, thermal: bool = False) -> ImageHeader:
    """Check a picture's structure without decoding it.

    Parameters
    ----------
    data : bytes
        The upload.
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
