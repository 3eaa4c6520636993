"""Drawings to PDF/X-4 at true size, every layer in a spot ink of its own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np

from app.encoders.pdf import POINTS_PER_MM, Box, PdfFile
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

_INK_NAMES = {Layer.BLEED: str(Layer.BASE), Layer.CROP: "All"}
"""Bleed is printed with the base's ink; crop marks are in the registration colour, that is on every separation."""
_MIN_REPEATS = 3  # a text that occurs as often is written once, as a form; chosen by hand


def write_pdf(drawings: Drawing | Sequence[Drawing], *, compress: bool = True) -> bytes:
    """Write drawings as the pages of a PDF/X-4.

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
