"""Plate to artwork for the workshop: one drawing in millimetres, then SVG, PDF, DXF and PNG, sheets and bundles."""

from app.encoders.plate.artwork import encode_plate, encode_sheets
from app.encoders.plate.bundle import BundleOptions, safe_names, write_bundle
from app.encoders.plate.drawing import Drawing
from app.encoders.plate.dxf import write_dxf
from app.encoders.plate.formats import ArtworkFormat, write_artwork
from app.encoders.plate.order import ArtworkOptions, PlateOrder
from app.encoders.plate.pdf import write_pdf
from app.encoders.plate.png import write_png
from app.encoders.plate.proof import PlateReader, prove_plate, render_face
from app.encoders.plate.quality import quality_sheets
from app.encoders.plate.svg import write_svg

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
