"""Artwork of plates: their drawing, proved by the plate decoder."""

from __future__ import annotations

from app.encoders.plate import ArtworkOptions, Drawing, PlateOrder, PlateReader, encode_plate, prove_plate
from app.encoders.plate.bundle import ARTWORK_VERSION
from app.encoders.plate.order import reference_text
from app.families.files import ArtworkProof, MarkerArtwork
from app.families.plate.rows import plate_code, plate_geometry
from app.geodesy import UNFIT_TEXT
from app.registry.marker_rows import MarkerRow


class PlateArtwork(MarkerArtwork):
    """Drawings of plates."""

    version = ARTWORK_VERSION

    def draw(self, row: MarkerRow, options: ArtworkOptions, *, record_url: str) -> Drawing:
        """The drawing of a plate."""
        return encode_plate(plate_order(row, record_url), options)

    def prove(self, row: MarkerRow, drawing: Drawing, read_plates: PlateReader) -> ArtworkProof:
        """Read a plate back with the plate decoder."""
        proof = prove_plate(drawing, plate_code(row), plate_geometry(row), read_plates)
        return ArtworkProof(proof.digits, proof.confidence)


def plate_order(row: MarkerRow, record_url: str) -> PlateOrder:
    """The plate of a row as the workshop is asked to make it."""
    return PlateOrder(
        plate_id=row.id,
        code=plate_code(row),
        geometry=plate_geometry(row),
        record_url=record_url,
        revision=row.version,
        lon_deg=row.lon_deg,
        lat_deg=row.lat_deg,
        crs=reference_system(row),
    )


def reference_system(row: MarkerRow) -> str:
    """Reference system for the margin, with a warning if the position is not for localization."""
    warning = UNFIT_TEXT if is_unfit(row) else None
    return reference_text(row.realization, row.epoch, warning)


def is_unfit(row: MarkerRow) -> bool:
    """Whether the position is not fit for localization."""
    return row.localization_grade == "unfit"
