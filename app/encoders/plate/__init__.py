"""Plate to artwork for the workshop: one drawing in millimetres, then SVG, PDF, DXF and PNG, sheets and bundles."""

from app.encoders.plate.bundle import BundleOptions, quality_sheets, safe_names, write_bundle
from app.encoders.plate.drawing import Drawing
from app.encoders.plate.face import ArtworkOptions, PlateOrder, encode_plate, encode_sheets
from app.encoders.plate.proof import PlateReader, prove_plate, render_face
from app.encoders.plate.writers import ArtworkFormat, write_artwork, write_dxf, write_pdf, write_png, write_svg

__all__ = [
    "ArtworkFormat",
    "ArtworkOptions",
    "BundleOptions",
    "Drawing",
    "PlateOrder",
    "PlateReader",
    "encode_plate",
    "encode_sheets",
    "prove_plate",
    "quality_sheets",
    "render_face",
    "safe_names",
    "write_artwork",
    "write_bundle",
    "write_dxf",
    "write_pdf",
    "write_png",
    "write_svg",
]
