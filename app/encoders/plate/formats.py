"""The file formats of artwork, each with its writer and media type."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from app.encoders.plate.drawing import Drawing
from app.encoders.plate.dxf import write_dxf
from app.encoders.plate.pdf import write_pdf
from app.encoders.plate.png import write_png
from app.encoders.plate.svg import write_svg

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
    drawing : Drawing
    form : ArtworkFormat
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
