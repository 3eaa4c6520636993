"""A selection of plates to one ZIP: artwork, manifest and quality sheet."""

from __future__ import annotations

import io
import re
import unicodedata
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from typing import BinaryIO

import numpy as np
import orjson

from app.encoders.packer import Packer
from app.encoders.plate.drawing import (
    COLOURS,
    Boxes,
    ColourSpec,
    Drawing,
    Layer,
    Part,
    Shape,
    Stroke,
    Text,
    box_points,
    fitted_height_mm,
    moved,
)
from app.encoders.plate.face import (
    PLAIN,
    SIDE_TOLERANCE_MM,
    UNIT_TOLERANCE_MM,
    ArtworkOptions,
    PlateOrder,
    code_face,
    encode_plate,
    encode_sheets,
    fixed_face,
)
from app.encoders.plate.proof import PlateProof, PlateReader, prove_plate
from app.encoders.plate.writers import DEFAULT_DPI, ArtworkFormat, write_artwork, write_pdf
from app.errors import InvalidParameter
from app.formats.text import TableWriter
from app.markers.plate import PlateGeometry

# === Quality sheet of a selection: what the inspector compares, measures and ticks, as drawings and as CSV.


PAGE_MM = (210.0, 297.0)
PER_PAGE = 3
THICKNESS_TOLERANCE_MM = 1.0
DIAGONAL_TOLERANCE_MM = 0.7

_LEFT_MM, _RIGHT_MM = 15.0, 195.0
_BLOCK_MM = 84.0
_FACE_MM = 52.0
_CAPS_MM = 2.1
_LINE_MM = 0.15
_CHECKS = (
    "units as in the picture",
    "triangle top left",
    "no text on the face",
    "back mark: id and arrow",
    "QR opens the record",
)
_CSV_HEADER = (
    "plate_id,revision,digits,scheme,n,unit_mm,gap_mm,thickness_mm,side_mm,marker_mm,"
    "side_tolerance_mm,unit_tolerance_mm,gap_tolerance_mm,thickness_tolerance_mm,diagonal_tolerance_mm,"
    "lon_deg,lat_deg,crs,record_url,measured_side_mm,measured_unit_mm,measured_gap_mm,measured_thickness_mm,"
    "measured_marker_mm,measured_diagonal_difference_mm,code_ok,colours_ok,qr_ok,inspector,date"
)
_BLANK_COLUMNS = 11


def dimension_limits_mm(geometry: PlateGeometry) -> tuple[tuple[str, float, float], ...]:
    """What is measured on a plate: name, nominal value, tolerance. [mm]"""
    return (
        ("outer edge", geometry.side_mm, SIDE_TOLERANCE_MM),
        ("unit", geometry.unit_mm, UNIT_TOLERANCE_MM),
        ("gap", geometry.gap_mm, UNIT_TOLERANCE_MM),
        ("marker", 2 * geometry.unit_mm + geometry.gap_mm, UNIT_TOLERANCE_MM),
        ("thickness", geometry.thickness_mm, THICKNESS_TOLERANCE_MM),
        ("diagonals differ", 0.0, DIAGONAL_TOLERANCE_MM),
    )


def quality_sheets(orders: Sequence[PlateOrder]) -> list[Drawing]:
    """Pages in A4: the colour specification, then three plates a page to inspect."""
    total = 1 + -(-len(orders) // PER_PAGE)
    pages = [_page(1, total, _colour_parts(len(orders)))]
    for number, start in enumerate(range(0, len(orders), PER_PAGE), start=2):
        parts: list[Part] = []
        for slot, order in enumerate(orders[start : start + PER_PAGE]):
            parts += _block(order, PAGE_MM[1] - 26.0 - slot * _BLOCK_MM)
        pages.append(_page(number, total, parts))
    return pages


def quality_csv(orders: Sequence[PlateOrder]) -> bytes:
    """The same as rows in UTF-8, with empty columns for what is measured."""
    stream = io.StringIO()
    writer = TableWriter(stream)
    writer.write_row(_CSV_HEADER.split(","))
    for order in orders:
        limits = dimension_limits_mm(order.geometry)
        nominal = {name: value for name, value, _ in limits}
        tolerance = {name: value for name, _, value in limits}
        geometry = order.geometry
        writer.write_row(
            [
                order.plate_id,
                order.revision,
                order.code.digits,
                order.code.scheme.value,
                geometry.n,
                *(f"{v:g}" for v in (geometry.unit_mm, geometry.gap_mm, geometry.thickness_mm, geometry.side_mm)),
                f"{nominal['marker']:g}",
                *(tolerance[k] for k in ("outer edge", "unit", "gap", "thickness", "diagonals differ")),
                "" if order.lon_deg is None else f"{order.lon_deg:.9f}",
                "" if order.lat_deg is None else f"{order.lat_deg:.9f}",
                order.crs,
                order.record_url,
                *[""] * _BLANK_COLUMNS,
            ]
        )
    return stream.getvalue().encode()


def _page(number: int, total: int, parts: Sequence[Part]) -> Drawing:
    top = PAGE_MM[1] - 15.0
    frame = (
        Text(Layer.NOTE, "Waymark quality sheet", _LEFT_MM, top, 3.2),
        Text(Layer.NOTE, f"page {number} of {total}", _RIGHT_MM, top, 2.2, "end"),
        _rule(_LEFT_MM, _RIGHT_MM, top - 3.0),
    )
    return Drawing("Waymark quality sheet", *PAGE_MM, (*frame, *parts))


def _rule(left: float, right: float, y: float) -> Stroke:
    return Stroke(Layer.NOTE, np.array([(left, y), (right, y)]), _LINE_MM)


def _tick(x: float, y: float) -> Stroke:
    return Stroke(Layer.NOTE, box_points(x, y - 0.4, x + 3.0, y + 2.6), _LINE_MM, closed=True)


# --- colour specification -------------------------------------------------------------------------------------------


def _colour_parts(plates: int) -> list[Part]:
    y = PAGE_MM[1] - 30.0
    parts: list[Part] = [
        Text(Layer.NOTE, f"{plates} plates. Colours to be met, new and under daylight:", _LEFT_MM, y, 2.4)
    ]
    columns = (_LEFT_MM + 10.0, 62.0, 108.0, 158.0)
    y -= 9.0
    for x, label in zip(columns, ("area", "RAL Classic", "ASTM D4956", "ASTM D6628"), strict=True):
        parts.append(Text(Layer.NOTE, label, x, y, _CAPS_MM))
    parts.append(_rule(_LEFT_MM, _RIGHT_MM, y - 2.0))
    for spec in COLOURS:
        y -= 13.0
        parts.append(Boxes(spec.layer, np.array([[_LEFT_MM, y - 1.0, _LEFT_MM + 6.0, y + 5.0]])))
        room = (columns[1] - columns[0], 44.0, 48.0, _RIGHT_MM - columns[3])
        for x, width, text in zip(columns, room, (spec.area, spec.ral, spec.sheeting, spec.marking), strict=True):
            parts.append(Text(Layer.NOTE, text, x, y + 2.0, fitted_height_mm(text, _CAPS_MM, width - 2.0)))
        parts.append(Text(Layer.NOTE, _chromaticity(spec), columns[1], y - 2.2, 1.7))
        parts.append(_rule(_LEFT_MM, _RIGHT_MM, y - 5.0))
    notes = (
        "Chromaticity limits: daytime, CIE 1931, D65, 45/0 geometry; 23 CFR 655 subpart F, appendix, table 1.",
        "All dimensions are in millimetres. The plate's size is its outer edge, the border gap included.",
        "A box is ticked when the plate meets the line beside it; measured values are written into the frames.",
    )
    for i, note in enumerate(notes):
        parts.append(Text(Layer.NOTE, note, _LEFT_MM, y - 14.0 - 5.0 * i, 1.9))
    return parts


def _chromaticity(spec: ColourSpec) -> str:
    if not spec.chromaticity_xy:
        return "no chromaticity specified; matt"
    return "x, y within " + "  ".join(f"({x:.3f}, {y:.3f})" for x, y in spec.chromaticity_xy)


# --- a plate --------------------------------------------------------------------------------------------------------


def _block(order: PlateOrder, top: float) -> list[Part]:
    scale = _FACE_MM / order.geometry.side_mm
    face = [_scaled(part, scale) for part in code_face(order.code, order.geometry, PLAIN)]
    x, y = _LEFT_MM + _FACE_MM / 2, top - 12.0 - _FACE_MM / 2
    title_mm = fitted_height_mm(order.plate_id, 3.2, 90.0)
    digits_mm = fitted_height_mm(order.grouped_digits, 2.8, 60.0)
    return [
        *_fixed_block(order.geometry, top),
        *moved(face, x, y),
        Text(Layer.NOTE, order.plate_id, _LEFT_MM, top - 7.0, title_mm),
        Text(Layer.NOTE, f"revision {order.revision}", 125.0, top - 7.0, 2.2, "end"),
        Text(Layer.NOTE, order.grouped_digits, _RIGHT_MM, top - 7.0, digits_mm, "end"),
    ]


@lru_cache(maxsize=64)
def _fixed_block(geometry: PlateGeometry, top: float) -> tuple[Part, ...]:
    """All of a plate's block but its id and its units."""
    scale = _FACE_MM / geometry.side_mm
    x, y = _LEFT_MM + _FACE_MM / 2, top - 12.0 - _FACE_MM / 2
    parts: list[Part] = list(moved((_scaled(p, scale) for p in fixed_face(geometry, PLAIN)), x, y))
    row = top - 15.0
    for label, nominal, tolerance in dimension_limits_mm(geometry):
        wanted = f"{nominal:g} ± {tolerance:g}" if nominal else f"≤ {tolerance:g}"
        parts += [
            Text(Layer.NOTE, label, 72.0, row, _CAPS_MM),
            Text(Layer.NOTE, wanted, 112.0, row, _CAPS_MM, "end"),
            Stroke(Layer.NOTE, box_points(115.0, row - 1.5, 132.0, row + 3.5), _LINE_MM, closed=True),
        ]
        row -= 7.0
    for i, spec in enumerate(COLOURS):
        text = f"{spec.area}: {spec.ral}"
        line = top - 15.0 - 5.0 * i
        parts += [_tick(137.0, line), Text(Layer.NOTE, text, 142.0, line, fitted_height_mm(text, _CAPS_MM, 53.0))]
    for i, check in enumerate(_CHECKS):
        line = top - 42.0 - 5.0 * i
        parts += [_tick(137.0, line), Text(Layer.NOTE, check, 142.0, line, _CAPS_MM)]
    foot = top - 73.0
    parts += [
        Text(Layer.NOTE, "inspector", 72.0, foot, _CAPS_MM),
        _rule(88.0, 132.0, foot - 0.5),
        Text(Layer.NOTE, "date", 137.0, foot, _CAPS_MM),
        _rule(146.0, _RIGHT_MM, foot - 0.5),
        _rule(_LEFT_MM, _RIGHT_MM, top - 80.0),
    ]
    return tuple(parts)


def _scaled(part: Part, scale: float) -> Part:
    """A part of the face at another size, round the plate's centre."""
    if isinstance(part, Boxes):
        return Boxes(part.layer, part.boxes_mm * scale)
    if isinstance(part, Shape):
        return Shape(part.layer, part.points_mm * scale)
    raise TypeError("a face has areas only")


# === A selection of plates to one ZIP.


MANIFEST_FORMAT = "waymark-artwork/1"
ARTWORK_VERSION = "2"
NO_QR_CODE = "the server has no public address"
"""Why artwork has no QR code: in headers and manifests."""
MAX_PLATES = 10_000
_UNSAFE = re.compile(r"[^A-Za-z0-9._-]+")
_RESERVED = re.compile(r"(?i)^(con|prn|aux|nul|com\d|lpt\d)(\.|$)")
_LONGEST_STEM = 60


@dataclass(frozen=True, slots=True)
class BundleOptions:
    """Contents of a bundle."""

    formats: tuple[ArtworkFormat, ...] = (ArtworkFormat.PDF, ArtworkFormat.SVG)  # files of each plate
    artwork: ArtworkOptions = field(default_factory=ArtworkOptions)
    sheet_mm: tuple[float, float] | None = None  # [mm] also nest the plates on sheets of this size, in the same formats
    dpi: float = DEFAULT_DPI  # [1/inch] of PNG files


def write_bundle(
    orders: Sequence[PlateOrder],
    target: BinaryIO,
    *,
    options: BundleOptions | None = None,
    read: PlateReader | None = None,
    progress: Callable[[int], None] | None = None,
) -> dict[str, object]:
    """Write the artwork of a selection into one ZIP, proving every plate on the way.

    Parameters
    ----------
    orders : sequence of PlateOrder
        1 to 10,000 plates, in the order of the manifest.
    target : binary file
        Written from the start to the end; need not be seekable.
    options : BundleOptions, optional
        PDF and SVG by default.
    read : callable, optional
        Reader that reads each drawing back; without it nothing is proved, which the manifest states.
    progress : callable, optional
        Called with the number of finished plates after each one.

    Returns
    -------
    dict
        The manifest, as it is in the ZIP.

    Raises
    ------
    InvalidParameter
        No plates, too many, no formats, or a sheet that is too small.
    ProofFailed
        A drawing did not read back as its own code; the ZIP is unfinished and must be thrown away.
    """
    options = options or BundleOptions()
    if not 1 <= len(orders) <= MAX_PLATES:
        raise InvalidParameter(
            f"{len(orders)} plates were selected",
            field="plates",
            limit=f"1 to {MAX_PLATES} plates",
            cure="split the selection",
        )
    if not options.formats:
        raise InvalidParameter("no format was requested", field="formats", limit="at least one of svg, pdf, dxf, png")
    names = plate_names(orders)
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        packer = Packer(archive)
        plates = []
        for done, (order, name) in enumerate(zip(orders, names, strict=True), start=1):
            files, entry = plate_files(order, name, options, read)
            _add_all(packer, files)
            plates.append(entry)
            if progress:
                progress(done)
        _add_all(packer, sheet_files(orders, options))
        manifest = bundle_manifest(plates, list(packer.entries), options, proved=read is not None)
        packer.add("manifest.json", orjson.dumps(manifest, option=orjson.OPT_INDENT_2))
    return manifest


def safe_names(names: Sequence[str]) -> list[str]:
    """File names, without extension, for arbitrary texts: plain ASCII, unique also where case does not count.

    No separators, no leading dot, no device names of Windows, at most 60 characters and a number where two would
    be alike.
    """
    taken: set[str] = set()
    safe = []
    for name in names:
        ascii_name = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
        stem = _UNSAFE.sub("_", ascii_name).strip("._-")[:_LONGEST_STEM].rstrip("._-") or "plate"
        if _RESERVED.match(stem):
            stem = f"plate_{stem}"
        unique, number = stem, 2
        while unique.lower() in taken:
            unique, number = f"{stem}_{number}", number + 1
        taken.add(unique.lower())
        safe.append(unique)
    return safe


def plate_names(orders: Sequence[PlateOrder]) -> list[str]:
    """Names of the plates' files, without extension."""
    return safe_names([f"{order.plate_id}-r{order.revision}" for order in orders])


def _add_all(packer: Packer, files: Sequence[tuple[str, bytes]]) -> None:
    for name, content in files:
        packer.add(name, content)


def plate_files(
    order: PlateOrder, name: str, options: BundleOptions, read: PlateReader | None
) -> tuple[list[tuple[str, bytes]], dict[str, object]]:
    """The files of a plate, by their names in the ZIP, and its entry in the manifest; raises as `write_bundle`."""
    drawing = encode_plate(order, options.artwork)
    proof = prove_plate(drawing, order.code, order.geometry, read) if read else None
    files = [
        (f"plates/{name}.{form}", write_artwork(drawing, form, dpi=options.dpi, compress=False).content)
        for form in options.formats
    ]
    return files, _plate_entry(order, [path for path, _content in files], proof)


def sheet_files(orders: Sequence[PlateOrder], options: BundleOptions) -> list[tuple[str, bytes]]:
    """Sheets with nested plates, where these are wanted, and the quality sheets, by their names in the ZIP."""
    files = []
    if options.sheet_mm:
        width, height = options.sheet_mm
        sheets = encode_sheets(orders, width_mm=width, height_mm=height, options=options.artwork)
        for number, sheet in enumerate(sheets, start=1):
            for form in options.formats:
                content = write_artwork(sheet, form, dpi=options.dpi, compress=False).content
                files.append((f"sheets/sheet-{number:04d}.{form}", content))
    files.append(("quality.pdf", write_pdf(quality_sheets(orders), compress=False)))
    files.append(("quality.csv", quality_csv(orders)))
    return files


def _plate_entry(order: PlateOrder, files: list[str], proof: PlateProof | None) -> dict[str, object]:
    code, geometry = order.code, order.geometry
    return {
        "plate_id": order.plate_id,
        "revision": order.revision,
        "record_url": order.record_url or None,
        "code": {"digits": code.digits, "scheme": code.scheme.value, "n": code.n, "check_digits": code.check_digits},
        "geometry": {**asdict(geometry), "side_mm": geometry.side_mm},
        "position": None if order.lon_deg is None else {"lon_deg": order.lon_deg, "lat_deg": order.lat_deg},
        "crs": order.crs,
        "proof": None if proof is None else {"read_back": proof.digits, "confidence": round(proof.confidence, 6)},
        "files": files,
    }


def bundle_manifest(
    plates: list[dict[str, object]], files: list[dict[str, object]], options: BundleOptions, *, proved: bool
) -> dict[str, object]:
    """The manifest of a bundle, from the entries of its plates and files."""
    without_qr = sum(plate["record_url"] is None for plate in plates)
    return {
        "format": MANIFEST_FORMAT,
        "artwork_version": ARTWORK_VERSION,
        "units": "mm",
        "proved": proved,
        "options": {"heaters": options.artwork.heaters, "leds": options.artwork.leds, "sheet_mm": options.sheet_mm},
        "colours": [asdict(spec) for spec in COLOURS],
        "notes": [] if without_qr == 0 else [f"{without_qr} of {len(plates)} plates have no QR code: {NO_QR_CODE}"],
        "plates": plates,
        "files": files,
    }
