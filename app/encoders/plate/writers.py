"""Drawings as files: SVG, PDF, DXF and PNG, each with its media type."""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from typing import TYPE_CHECKING
from xml.sax.saxutils import escape

import cv2
import numpy as np
import numpy.typing as npt
import shapely
from shapely.geometry.base import BaseGeometry

from app.encoders.pdf import POINTS_PER_MM, Box, PdfFile
from app.encoders.plate.drawing import (
    FACE_LAYERS,
    INKS,
    SHEET_LAYERS,
    UNDER_LAYERS,
    Boxes,
    Drawing,
    Layer,
    Modules,
    Part,
    Shape,
    Stroke,
    Text,
    contours_mm,
    origin_mm,
    pdf_run,
    run_units,
    scale_mm,
    svg_run,
)
from app.errors import InvalidParameter
from app.values import Floats

if TYPE_CHECKING:
    from ezdxf.layouts.layout import Modelspace


# === Drawing to pixels, for the PNG writer and for the proof.


Image = npt.NDArray[np.uint8]
_SHIFT = 4
_SUBPIXELS = 1 << _SHIFT


def paint(
    image: Image, drawing: Drawing, layers: Iterable[Layer], px_per_mm: float, origin_mm: tuple[float, float]
) -> None:
    """Paint some layers of a drawing into an image.

    Parameters
    ----------
    image : ndarray of uint8, shape (H, W, 3), BGR
        Painted in place.
    layers : iterable of Layer
        Bottom to top.
    px_per_mm : float
        Scale. [px/mm]
    origin_mm : (x, y)
        Point of the sheet at the image's upper left corner (the outer corner of its first pixel). [mm]

    Notes
    -----
    Edges of rectangles fall on rounded positions measured from the origin, never on accumulated rounded sizes.
    """
    by_layer = drawing.by_layer()
    for layer in layers:
        for part in by_layer.get(layer, ()):
            _paint_part(image, part, px_per_mm, origin_mm)


def _paint_part(image: Image, part: Part, px_per_mm: float, origin_mm: tuple[float, float]) -> None:
    bgr = INKS[part.layer].rgb[::-1]
    if isinstance(part, (Boxes, Modules)):
        boxes = part.boxes_mm
        left, top = _edges_px(boxes[:, [0, 3]], px_per_mm, origin_mm).T.tolist()
        right, bottom = _edges_px(boxes[:, [2, 1]], px_per_mm, origin_mm).T.tolist()
        for x0, y0, x1, y1 in zip(left, top, right, bottom, strict=True):
            image[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = bgr
    elif isinstance(part, Shape):
        _fill(image, [part.points_mm], bgr, px_per_mm, origin_mm)
    elif isinstance(part, Stroke):
        points = _subpixels(part.points_mm, px_per_mm, origin_mm)
        thickness = max(1, round(part.width_mm * px_per_mm))
        cv2.polylines(image, [points], part.closed, bgr, thickness, cv2.LINE_AA, _SHIFT)
    else:
        _fill(image, contours_mm(part), bgr, px_per_mm, origin_mm)


def _edges_px(points_mm: Floats, px_per_mm: float, origin_mm: tuple[float, float]) -> npt.NDArray[np.intp]:
    """Rounded positions of edges from the image's corner, halves up."""
    offsets = (points_mm - np.array(origin_mm)) * np.array([px_per_mm, -px_per_mm])
    edges: npt.NDArray[np.intp] = np.floor(offsets + 0.5 + 1e-9).astype(np.intp)
    return edges


def _subpixels(points_mm: Floats, px_per_mm: float, origin_mm: tuple[float, float]) -> npt.NDArray[np.int32]:
    """Positions with pixel centres at integers, in fixed point for OpenCV."""
    offsets = (points_mm - np.array(origin_mm)) * np.array([px_per_mm, -px_per_mm]) - 0.5
    points: npt.NDArray[np.int32] = np.round(offsets * _SUBPIXELS).astype(np.int32)
    return points


def _fill(
    image: Image,
    contours: list[Floats],
    bgr: tuple[int, ...],
    px_per_mm: float,
    origin_mm: tuple[float, float],
) -> None:
    if contours:
        polygons = [_subpixels(contour, px_per_mm, origin_mm) for contour in contours]
        cv2.fillPoly(image, polygons, bgr, cv2.LINE_AA, _SHIFT)


# === Drawing -> PNG with its resolution.


DPI = (36.0, 1200.0)
MAX_PIXELS = 64_000_000
_MM_PER_INCH = 25.4
_SIGNATURE_AND_HEADER = 8 + 25
_COMPRESSION = 3


def write_png(drawing: Drawing, *, dpi: float = 150.0) -> bytes:
    """Write a drawing as an 8-bit RGB PNG.

    Parameters
    ----------
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


# === Drawing to SVG in millimetres: width and height in mm, a viewBox in mm, a named group for each layer.


_ORDER = (*UNDER_LAYERS, *FACE_LAYERS, *SHEET_LAYERS)


def write_svg(drawing: Drawing) -> bytes:
    """Write a drawing as SVG 1.1.

    Returns
    -------
    bytes
        UTF-8. Each layer is a group (an Inkscape layer) whose id is the layer's name; all filled shapes of a layer are
        one path, lines and texts are paths of their own. Text is outlined. Heaters and light sources come first and
        lie under the opaque face. The same drawing always gives the same bytes.
    """
    width, height = f"{drawing.width_mm:.7g}", f"{drawing.height_mm:.7g}"
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:inkscape="http://www.inkscape.org/namespaces/inkscape" '
        f'version="1.1" width="{width}mm" height="{height}mm" viewBox="0 0 {width} {height}">',
        f"<title>{escape(drawing.title)}</title>",
        f'<rect id="SHEET" width="{width}" height="{height}" fill="#ffffff"/>',
    ]
    by_layer = drawing.by_layer()
    for layer in _ORDER:
        parts = by_layer.get(layer)
        if not parts:
            continue
        areas = "".join(_area(p, drawing.height_mm) for p in parts if isinstance(p, (Boxes, Shape)))
        lines.append(
            f'<g id="{layer}" inkscape:groupmode="layer" inkscape:label="{layer}" fill="{INKS[layer].hex}" '
            f'stroke="none">'
        )
        if areas:
            lines.append(f'<path d="{areas}"/>')
        lines += [_line(p, drawing.height_mm) for p in parts if not isinstance(p, (Boxes, Shape))]
        lines.append("</g>")
    lines.append("</svg>\n")
    return "\n".join(lines).encode()


@lru_cache(maxsize=1024)
def _area(part: Boxes | Shape, sheet_height_mm: float) -> str:
    """Path data of filled shapes, y down."""
    if isinstance(part, Boxes):
        left, bottom, right, top = part.boxes_mm.T
        values = np.stack([left, sheet_height_mm - top, right, sheet_height_mm - bottom, left], axis=1)
        return "M%.7g %.7gH%.7gV%.7gH%.7gZ" * len(values) % tuple(values.ravel().tolist())
    return "M" + _points(part.points_mm, sheet_height_mm) + "Z"


@lru_cache(maxsize=1024)
def _line(part: Part, sheet_height_mm: float) -> str:
    """Element of a line or a text, y down."""
    if isinstance(part, Stroke):
        data = "M" + _points(part.points_mm, sheet_height_mm) + ("Z" if part.closed else "")
        return f'<path d="{data}" fill="none" stroke="{INKS[part.layer].hex}" stroke-width="{part.width_mm:.7g}"/>'
    if isinstance(part, Modules):
        place = (
            f"matrix({part.module_mm:.7g} 0 0 {part.module_mm:.7g} {part.x_mm:.7g} {sheet_height_mm - part.y_mm:.7g})"
        )
        return f'<path transform="{place}" d="{"".join([_run(*run) for run in part.runs])}"/>'
    if isinstance(part, (Boxes, Shape)):
        raise TypeError("areas are joined into one path")
    x, y = origin_mm(part)
    scale = f"{scale_mm(part):.6g}"
    place = f"matrix({scale} 0 0 -{scale} {x:.7g} {sheet_height_mm - y:.7g})"
    return f'<path transform="{place}" d="{svg_run(part.text)}"/>'


@lru_cache(maxsize=1 << 16)
def _run(row: int, start: int, count: int) -> str:
    return f"M{start} {row}h{count}v1h-{count}z"


def _points(points: np.ndarray[tuple[int, ...], np.dtype[np.float64]], sheet_height_mm: float) -> str:
    values = points * np.array([1.0, -1.0]) + np.array([0.0, sheet_height_mm])
    return "L".join(["%.7g %.7g"] * len(values)) % tuple(values.ravel().tolist())


# === Drawings to PDF/X-4 at true size, every layer in a spot ink of its own.


_INK_NAMES = {Layer.BLEED: str(Layer.BASE), Layer.CROP: "All"}
"""Bleed is printed with the base's ink; crop marks are in the registration colour, that is on every separation."""
_MIN_REPEATS = 3  # a text that occurs as often is written once, as a form


def write_pdf(drawings: Drawing | Sequence[Drawing], *, compress: bool = True) -> bytes:
    """Write drawings as the pages of a PDF/X-4.

    Parameters
    ----------
    compress : bool
        Deflate the pages; leave it out where an archive compresses the file again.

    Returns
    -------
    bytes
        A page for each drawing, and after it a page for what lies under the face, if anything does. TrimBox is the
        plate's outer edge (the sheet, where it holds several plates or none), BleedBox is larger by the bleed. Text
        is outlined. The same drawings always give the same bytes.
    """
    sheets = [drawings] if isinstance(drawings, Drawing) else list(drawings)
    pages: list[tuple[Drawing, tuple[Layer, ...]]] = []
    for drawing in sheets:
        pages.append((drawing, (Layer.BLEED, *FACE_LAYERS, *SHEET_LAYERS)))
        if any(part.layer in UNDER_LAYERS for part in drawing.parts):
            pages.append((drawing, (*UNDER_LAYERS, *SHEET_LAYERS)))
    forms = _repeated_texts(pages)
    file = PdfFile(sheets[0].title, compress=compress, print_ready=True)
    resources = file.add(_resources(file.next_number + 1, len(forms)))
    for text in forms:
        _add_form(file, text)
    for drawing, layers in pages:
        file.add_page(_page_boxes(drawing), resources, _content(drawing, layers, forms))
    return file.to_bytes()


def _repeated_texts(pages: Sequence[tuple[Drawing, tuple[Layer, ...]]]) -> dict[str, str]:
    """Names of the forms in which texts that occur often are written once."""
    counts = Counter(part.text for drawing, _ in pages for part in drawing.parts if isinstance(part, Text))
    often = [text for text, count in counts.items() if count >= _MIN_REPEATS]
    return {text: f"T{i}" for i, text in enumerate(often)}


def _add_form(file: PdfFile, text: str) -> None:
    """A text as a form, painted with the colour in force where it is used (8.10)."""
    box = f"/BBox [-100 -100 {run_units(text) + 100} 350]"
    file.add_stream(pdf_run(text).encode("ascii"), f"/Type /XObject /Subtype /Form {box} ")


@lru_cache(maxsize=64)
def _resources(first_form: int, forms: int) -> bytes:
    """A separation colour space for each ink (8.6.6.4), a state in which strokes overprint (11.7.4), the forms."""
    spaces = []
    for layer, ink in INKS.items():
        full = " ".join(f"{share:g}" for share in ink.cmyk)
        tint = f"<< /FunctionType 2 /Domain [0 1] /C0 [0 0 0 0] /C1 [{full}] /N 1 >>"
        spaces.append(f"/{layer} [/Separation /{_INK_NAMES.get(layer, layer)} /DeviceCMYK {tint}]")
    states = "/OVER << /Type /ExtGState /OP true /OPM 1 >>"
    texts = " ".join(f"/T{i} {first_form + i} 0 R" for i in range(forms))
    return f"<< /ColorSpace << {' '.join(spaces)} >> /ExtGState << {states} >> /XObject << {texts} >> >>".encode()


def _page_boxes(drawing: Drawing) -> dict[str, Box]:
    """MediaBox, BleedBox and TrimBox. [mm]"""
    sheet = (0.0, 0.0, drawing.width_mm, drawing.height_mm)
    is_one_plate = len(drawing.trim_mm) == 1
    left, bottom, right, top = drawing.trim_mm[0] if is_one_plate else sheet
    bleed = drawing.bleed_mm if is_one_plate else 0.0
    return {
        "MediaBox": sheet,
        "BleedBox": (left - bleed, bottom - bleed, right + bleed, top + bleed),
        "TrimBox": (left, bottom, right, top),
    }


def _content(drawing: Drawing, layers: Sequence[Layer], forms: Mapping[str, str]) -> bytes:
    """Operators that paint a page; the user space is turned into millimetres first."""
    scale = f"{POINTS_PER_MM:.9g}"
    pieces = [f"{scale} 0 0 {scale} 0 0 cm"]
    by_layer = drawing.by_layer()
    if drawing.trim_mm and Layer.BASE in by_layer:
        by_layer[Layer.BLEED] = [_bleed(drawing)]
    for layer in layers:
        if layer in by_layer:
            _paint_layer(pieces, layer, by_layer[layer], forms)
    return "\n".join(pieces).encode("ascii")


def _bleed(drawing: Drawing) -> Boxes:
    grown = np.array(drawing.trim_mm) + drawing.bleed_mm * np.array([-1.0, -1.0, 1.0, 1.0])
    return Boxes(Layer.BLEED, grown)


def _paint_layer(pieces: list[str], layer: Layer, parts: list[Part], forms: Mapping[str, str]) -> None:
    """One path for all areas of a layer, then its lines, then its texts."""
    pieces.append(f"/{layer} cs 1 scn")
    areas = [_area_pdf(part) for part in parts if isinstance(part, (Boxes, Shape))]
    if areas:
        pieces += [*areas, "f"]
    pieces += [_modules(part) for part in parts if isinstance(part, Modules)]
    strokes = [_stroke(part) for part in parts if isinstance(part, Stroke)]
    if strokes:  # overprinted: a cut line must not knock a white hairline out of the inks below
        pieces += [f"q /OVER gs /{layer} CS 1 SCN", *strokes, "Q"]
    pieces += [_text(part, forms.get(part.text)) for part in parts if isinstance(part, Text)]


@lru_cache(maxsize=1024)
def _area_pdf(part: Boxes | Shape) -> str:
    if isinstance(part, Boxes):
        low, high = part.boxes_mm[:, :2], part.boxes_mm[:, 2:]
        values = np.hstack([low, high - low])
        return "%.7g %.7g %.7g %.7g re\n" * len(values) % tuple(values.ravel().tolist())
    return _points_pdf(part.points_mm) + " h"


def _modules(part: Modules) -> str:
    scale = f"{part.module_mm:.7g}"
    runs = "\n".join([_run_pdf(*run) for run in part.runs])
    return f"q {scale} 0 0 -{scale} {part.x_mm:.7g} {part.y_mm:.7g} cm\n{runs}\nf Q"


@lru_cache(maxsize=1 << 16)
def _run_pdf(row: int, start: int, count: int) -> str:
    return f"{start} {row} {count} 1 re"


@lru_cache(maxsize=1024)
def _stroke(part: Stroke) -> str:
    return f"{part.width_mm:.7g} w {_points_pdf(part.points_mm)} {'s' if part.closed else 'S'}"


@lru_cache(maxsize=1024)
def _text(part: Text, form: str | None) -> str:
    x, y = origin_mm(part)
    scale = f"{scale_mm(part):.6g}"
    glyphs = f"/{form} Do" if form else pdf_run(part.text)
    return f"q {scale} 0 0 {scale} {x:.7g} {y:.7g} cm\n{glyphs}\nQ"


def _points_pdf(points: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    operators = "%.7g %.7g m " + "%.7g %.7g l " * (len(points) - 1)
    return operators % tuple(points.ravel().tolist())


# === Drawing -> DXF in millimetres, for routers, plotters and CAD.


LAYERS = (
    Layer.CUT,
    Layer.CODE_DARK,
    Layer.CODE_LIGHT,
    Layer.MARK_RED,
    Layer.MARK_GREEN,
    Layer.ENGRAVE,
    Layer.HEATER,
    Layer.LED,
    Layer.NOTE,
)
"""No BASE or BLEED, which are ink only and would be cut in vain; the plate's outline is CUT."""

_MILLIMETRES = 4
_ALIGNMENTS = {
    "start": "LEFT",
    "middle": "CENTER",
    "end": "RIGHT",
}
_DATES = re.compile(r"(\$TD(?:CREATE|UPDATE)\n 40\n)[^\n]*")
_GUIDS = re.compile(r"(\$(?:FINGERPRINT|VERSION)GUID\n  2\n)[^\n]*")
_STAMPS = re.compile(r"^(\d+\.\d+[^ \n]*) @ \d{4}-\d\d-\d\dT[^\n]*$", re.MULTILINE)


def write_dxf(drawing: Drawing) -> bytes:
    """Write a drawing as DXF R2010.

    Returns
    -------
    bytes
        Model space in millimetres (``$INSUNITS`` = 4). Areas are closed LWPOLYLINE, those of a layer that touch are
        merged; engraved text is outlined, notes are TEXT. The same drawing always gives the same bytes.
    """
    from ezdxf.document import Drawing as DxfDocument

    document = DxfDocument.new("R2010")
    document.header["$INSUNITS"] = _MILLIMETRES
    document.header["$MEASUREMENT"] = 1
    document.header["$LUNITS"] = 2
    for layer in LAYERS:
        document.layers.add(str(layer), color=INKS[layer].aci)
    space = document.modelspace()
    by_layer = drawing.by_layer()
    by_layer[Layer.NOTE] = by_layer.get(Layer.NOTE, []) + by_layer.get(Layer.CROP, [])
    for layer in LAYERS:
        parts = by_layer.get(layer, [])
        for ring in _merged_rings([p for p in parts if isinstance(p, (Boxes, Modules, Shape))]):
            space.add_lwpolyline(ring, close=True, dxfattribs={"layer": str(layer)})
        for part in parts:
            if isinstance(part, Stroke):
                space.add_lwpolyline(part.points_mm.tolist(), close=part.closed, dxfattribs={"layer": str(layer)})
            elif isinstance(part, Text):
                _add_text(space, part)
    document.header["$EXTMIN"] = space.dxf.extmin = (0.0, 0.0, 0.0)
    document.header["$EXTMAX"] = space.dxf.extmax = (drawing.width_mm, drawing.height_mm, 0.0)
    stream = io.StringIO()
    document.write(stream)
    return _undated(stream.getvalue()).encode(document.output_encoding, errors="dxfreplace")


def _merged_rings(parts: list[Part]) -> list[list[tuple[float, float]]]:
    """Outlines and holes of the union of areas, in millimetres."""
    areas: list[BaseGeometry] = []
    for part in parts:
        if isinstance(part, (Boxes, Modules)):
            areas += list(shapely.box(*part.boxes_mm.T))
        elif isinstance(part, Shape):
            areas.append(shapely.Polygon(part.points_mm))
    merged = shapely.get_parts(shapely.union_all(areas))
    return [_ring(shapely.get_coordinates(ring)) for area in merged for ring in (area.exterior, *area.interiors)]


def _ring(points: Floats) -> list[tuple[float, float]]:
    return [(x, y) for x, y in np.round(points[:-1], 6).tolist()]


def _add_text(space: Modelspace, text: Text) -> None:
    from ezdxf.enums import TextEntityAlignment

    attributes = {"layer": str(text.layer)}
    if text.layer is Layer.ENGRAVE:
        for contour in contours_mm(text):
            space.add_lwpolyline(np.round(contour, 6).tolist(), close=True, dxfattribs=attributes)
        return
    entity = space.add_text(text.text, height=text.height_mm, dxfattribs=attributes)
    entity.set_placement((text.x_mm, text.y_mm), align=TextEntityAlignment[_ALIGNMENTS[text.anchor]])


def _undated(dxf: str) -> str:
    """Take the time of writing and the random ids out, which ezdxf puts into every file."""
    dxf = _DATES.sub(r"\g<1>2451545.0", dxf)
    dxf = _GUIDS.sub(r"\g<1>{00000000-0000-0000-0000-000000000000}", dxf)
    return _STAMPS.sub(r"\1", dxf)


# === The file formats of artwork, each with its writer and media type.


DEFAULT_DPI = 150.0


class ArtworkFormat(StrEnum):
    """What artwork can be written as; the value is the file's extension."""

    SVG = "svg"
    PDF = "pdf"
    DXF = "dxf"
    PNG = "png"

    @property
    def media_type(self) -> str:
        """For HTTP's Content-Type."""
        return _MEDIA_TYPES[self]


_MEDIA_TYPES = {
    ArtworkFormat.SVG: "image/svg+xml",
    ArtworkFormat.PDF: "application/pdf",
    ArtworkFormat.DXF: "image/vnd.dxf",
    ArtworkFormat.PNG: "image/png",
}


@dataclass(frozen=True, slots=True)
class Artwork:
    """A written drawing."""

    content: bytes
    media_type: str


def write_artwork(drawing: Drawing, form: ArtworkFormat, *, dpi: float = DEFAULT_DPI, compress: bool = True) -> Artwork:
    """Write a drawing in one format.

    Parameters
    ----------
    dpi : float
        For PNG. [1/inch]
    compress : bool
        For PDF: leave it out where the file goes into an archive.
    """
    match form:
        case ArtworkFormat.SVG:
            content = write_svg(drawing)
        case ArtworkFormat.PDF:
            content = write_pdf(drawing, compress=compress)
        case ArtworkFormat.DXF:
            content = write_dxf(drawing)
        case ArtworkFormat.PNG:
            content = write_png(drawing, dpi=dpi)
    return Artwork(content, form.media_type)
