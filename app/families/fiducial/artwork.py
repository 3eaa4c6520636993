"""Artwork of fiducial signs, proved by OpenCV's detector."""

from __future__ import annotations

from app.encoders.fiducial import FiducialOrder, encode_fiducial, prove_fiducial
from app.encoders.plate import ArtworkOptions, Drawing, PlateReader
from app.errors import InvalidParameter
from app.families.fiducial.rows import fiducial_code, fiducial_geometry
from app.families.files import ArtworkProof, MarkerArtwork
from app.registry.marker_rows import MarkerRow


class FiducialArtwork(MarkerArtwork):
    """Drawings of fiducial signs."""

    version = "fiducial/2"

    def draw(self, row: MarkerRow, options: ArtworkOptions, *, record_url: str) -> Drawing:
        """The drawing of a sign.

        Raises
        ------
        InvalidParameter
            Heaters or light sources are asked for: signs have none.
        """
        if options.heaters or options.leds:
            raise InvalidParameter(
                "signs have no heaters and no light sources",
                field="heaters" if options.heaters else "leds",
                limit="plates only",
                cure="leave it out",
            )
        order = FiducialOrder(row.id, fiducial_code(row), fiducial_geometry(row), record_url, row.version)
        return encode_fiducial(order)

    def prove(self, row: MarkerRow, drawing: Drawing, read_plates: PlateReader) -> ArtworkProof:
        """Read a sign back with OpenCV's detector, which gives no confidence but right or wrong."""
        code = fiducial_code(row)
        prove_fiducial(drawing, code, fiducial_geometry(row))
        return ArtworkProof(code.text, 1.0)
