"""Drawing -> PDF at true size, every layer in a spot ink of its own.

Written by hand: a drawing needs a dozen kinds of PDF object (ISO 32000-1), and reportlab takes ten times as long for
them, names a font that is not embedded on every page, and packs streams as text.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np

from app.encoders.plate.colours import INKS
from app.encoders.plate.drawing import (
    FACE_LAYERS,
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
)
from app.encoders.plate.lettering import origin_mm, pdf_run, run_units, scale_mm

POINTS_PER_MM = 72.0 / 25.4
_INK_NAMES = {Layer.BLEED: str(Layer.BASE), Layer.CROP: "All"}
"""Bleed is printed with the base's ink; crop marks are in the registration colour, that is on every separation."""
_CATALOG, _PAGES, _INFO, _RESOURCES, _FIRST_FREE = 1, 2, 3, 4, 5
_COMPRESSION = 6
_REPEATED = 3


def write_pdf(drawings: Drawing | Sequence[Drawing], *, compress: bool = True) -> bytes:
    """Write drawings as the pages of a PDF 1.4.

    Parameters
    ----------
    drawings : Drawing or sequence of Drawing
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
    first_page = _FIRST_FREE + len(forms)
    kids = " ".join(f"{first_page + 2 * i} 0 R" for i in range(len(pages)))
    objects = [
        f"<< /Type /Catalog /Pages {_PAGES} 0 R >>".encode(),
        f"<< /Type /Pages /Count {len(pages)} /Kids [{kids}] >>".encode(),
        f"<< /Title {_text_string(sheets[0].title)} /Creator (Waymark) /Producer (Waymark) /Trapped /False >>".encode(),
        _resources(len(forms)),
        *(_form(text, compress) for text in forms),
    ]
    for i, (drawing, layers) in enumerate(pages):
        objects.append(_page(drawing, contents=first_page + 2 * i + 1))
        objects.append(_stream(_content(drawing, layers, forms), compress))
    return _file(objects)


def _repeated_texts(pages: Sequence[tuple[Drawing, tuple[Layer, ...]]]) -> dict[str, str]:
    """Names of the forms in which texts that occur often are written once."""
    counts = Counter(part.text for drawing, _ in pages for part in drawing.parts if isinstance(part, Text))
    often = [text for text, count in counts.items() if count >= _REPEATED]
    return {text: f"T{i}" for i, text in enumerate(often)}


def _form(text: str, compress: bool) -> bytes:
    """A text as a form, painted with the colour in force where it is used (8.10)."""
    box = f"/BBox [-100 -100 {run_units(text) + 100} 350]"
    return _stream(pdf_run(text).encode("ascii"), compress, f"/Type /XObject /Subtype /Form {box} ")


def _file(objects: list[bytes]) -> bytes:
    """Number the objects from 1, and close with the cross-reference table and the trailer (ISO 32000-1, 7.5)."""
    chunks = [b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n"]
    position, offsets = len(chunks[0]), []
    for number, body in enumerate(objects, start=1):
        chunk = b"%d 0 obj\n%b\nendobj\n" % (number, body)
        offsets.append(position)
        position += len(chunk)
        chunks.append(chunk)
    size = len(objects) + 1
    chunks.append(b"xref\n0 %d\n0000000000 65535 f \n" % size)
    chunks += [b"%010d 00000 n \n" % offset for offset in offsets]
    trailer = b"trailer\n<< /Size %d /Root %d 0 R /Info %d 0 R >>\nstartxref\n%d\n%%%%EOF\n"
    chunks.append(trailer % (size, _CATALOG, _INFO, position))
    return b"".join(chunks)


def _text_string(text: str) -> str:
    """A text string of the document's properties, in UTF-16 with its mark (7.9.2.2)."""
    return f"<feff{text.encode('utf-16-be').hex()}>"


@lru_cache(maxsize=64)
def _resources(forms: int) -> bytes:
    """A separation colour space for each ink (8.6.6.4), a state in which strokes overprint (11.7.4), the forms."""
    spaces = []
    for layer, ink in INKS.items():
        full = " ".join(f"{share:g}" for share in ink.cmyk)
        tint = f"<< /FunctionType 2 /Domain [0 1] /C0 [0 0 0 0] /C1 [{full}] /N 1 >>"
        spaces.append(f"/{layer} [/Separation /{_INK_NAMES.get(layer, layer)} /DeviceCMYK {tint}]")
    states = "/OVER << /Type /ExtGState /OP true /OPM 1 >>"
    texts = " ".join(f"/T{i} {_FIRST_FREE + i} 0 R" for i in range(forms))
    return f"<< /ColorSpace << {' '.join(spaces)} >> /ExtGState << {states} >> /XObject << {texts} >> >>".encode()


def _page(drawing: Drawing, contents: int) -> bytes:
    left, bottom, right, top = 0.0, 0.0, drawing.width_mm, drawing.height_mm
    bleed = 0.0
    if len(drawing.trim_mm) == 1:
        left, bottom, right, top = drawing.trim_mm[0]
        bleed = drawing.bleed_mm
    boxes = {
        "MediaBox": (0.0, 0.0, drawing.width_mm, drawing.height_mm),
        "BleedBox": (left - bleed, bottom - bleed, right + bleed, top + bleed),
        "TrimBox": (left, bottom, right, top),
    }
    rows = " ".join(
        f"/{name} [{' '.join(f'{v * POINTS_PER_MM:.4f}' for v in values)}]" for name, values in boxes.items()
    )
    return (
        f"<< /Type /Page /Parent {_PAGES} 0 R {rows} /Resources {_RESOURCES} 0 R /Contents {contents} 0 R >>".encode()
    )


def _stream(content: bytes, compress: bool, entries: str = "") -> bytes:
    packing = "/Filter /FlateDecode " if compress else ""
    if compress:
        content = zlib.compress(content, _COMPRESSION)
    return f"<< {entries}{packing}/Length {len(content)} >>\nstream\n".encode() + content + b"\nendstream"


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
    areas = [_area(part) for part in parts if isinstance(part, (Boxes, Shape))]
    if areas:
        pieces += [*areas, "f"]
    pieces += [_modules(part) for part in parts if isinstance(part, Modules)]
    strokes = [_stroke(part) for part in parts if isinstance(part, Stroke)]
    if strokes:  # overprinted: a cut line must not knock a white hairline out of the inks below
        pieces += [f"q /OVER gs /{layer} CS 1 SCN", *strokes, "Q"]
    pieces += [_text(part, forms.get(part.text)) for part in parts if isinstance(part, Text)]


@lru_cache(maxsize=1024)
def _area(part: Boxes | Shape) -> str:
    if isinstance(part, Boxes):
        low, high = part.boxes_mm[:, :2], part.boxes_mm[:, 2:]
        values = np.hstack([low, high - low])
        return "%.7g %.7g %.7g %.7g re\n" * len(values) % tuple(values.ravel().tolist())
    return _points(part.points_mm) + " h"


def _modules(part: Modules) -> str:
    scale = f"{part.module_mm:.7g}"
    runs = "\n".join([_run(*run) for run in part.runs])
    return f"q {scale} 0 0 -{scale} {part.x_mm:.7g} {part.y_mm:.7g} cm\n{runs}\nf Q"


@lru_cache(maxsize=1 << 16)
def _run(row: int, start: int, count: int) -> str:
    return f"{start} {row} {count} 1 re"


@lru_cache(maxsize=1024)
def _stroke(part: Stroke) -> str:
    return f"{part.width_mm:.7g} w {_points(part.points_mm)} {'s' if part.closed else 'S'}"


@lru_cache(maxsize=1024)
def _text(part: Text, form: str | None) -> str:
    x, y = origin_mm(part)
    scale = f"{scale_mm(part):.6g}"
    glyphs = f"/{form} Do" if form else pdf_run(part.text)
    return f"q {scale} 0 0 {scale} {x:.7g} {y:.7g} cm\n{glyphs}\nQ"


def _points(points: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    operators = "%.7g %.7g m " + "%.7g %.7g l " * (len(points) - 1)
    return operators % tuple(points.ravel().tolist())
