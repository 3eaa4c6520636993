"""A selection of plates to one ZIP: artwork, manifest and quality sheet."""

from __future__ import annotations

import re
import unicodedata
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, BinaryIO

import orjson

from app.encoders.packer import Packer
from app.encoders.plate.artwork import encode_plate, encode_sheets
from app.encoders.plate.colours import COLOURS
from app.encoders.plate.formats import DEFAULT_DPI, ArtworkFormat, write_artwork
from app.encoders.plate.order import ArtworkOptions, PlateOrder
from app.encoders.plate.pdf import write_pdf
from app.encoders.plate.proof import PlateProof, PlateReader, prove_plate
from app.encoders.plate.quality import quality_csv, quality_sheets
from app.errors import InvalidParameter

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
    """Contents of a bundle.

    Parameters
    ----------
    formats : tuple of ArtworkFormat
        Files of each plate.
    artwork : ArtworkOptions
    sheet_mm : (width, height), optional
        Also nest the plates on sheets of this size, in the same formats. [mm]
    dpi : float
        Of PNG files. [1/inch]
    """

    formats: tuple[ArtworkFormat, ...] = (ArtworkFormat.PDF, ArtworkFormat.SVG)
    artwork: ArtworkOptions = field(default_factory=ArtworkOptions)
    sheet_mm: tuple[float, float] | None = None
    dpi: float = DEFAULT_DPI


def write_bundle(
    orders: Sequence[PlateOrder],
    target: BinaryIO,
    *,
    options: BundleOptions | None = None,
    read: PlateReader | None = None,
    progress: Callable[[int], None] | None = None,
) -> dict[str, Any]:
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
) -> tuple[list[tuple[str, bytes]], dict[str, Any]]:
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


def _plate_entry(order: PlateOrder, files: list[str], proof: PlateProof | None) -> dict[str, Any]:
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
    plates: list[dict[str, Any]], files: list[dict[str, Any]], options: BundleOptions, *, proved: bool
) -> dict[str, Any]:
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
