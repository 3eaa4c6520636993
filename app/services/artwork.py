"""Markers -> artwork for the workshop. Nothing is handed out that our own decoder has not read back."""

from __future__ import annotations

import hashlib
import tempfile
import threading
from dataclasses import dataclass
from typing import IO, Any

from app.encoders.plate import (
    ArtworkFormat,
    ArtworkOptions,
    BundleOptions,
    PlateOrder,
    PlateProof,
    PlateReader,
    encode_plate,
    prove_plate,
    write_artwork,
    write_bundle,
)
from app.encoders.plate.bundle import ARTWORK_VERSION
from app.encoders.plate.formats import DEFAULT_DPI
from app.encoders.plate.order import MAX_NOTE_LENGTH
from app.errors import NotFound, Unavailable
from app.geodesy import LocalizationGrade
from app.registry import markers as store
from app.registry.database import Database
from app.registry.markers import Row
from app.services.access import Caller
from app.services.marker_selection import Selection, select_markers
from app.services.plate_markers import plate_code, plate_geometry

MAX_PLATES = 5_000
_BUNDLES_AT_ONCE = 2


@dataclass(frozen=True, slots=True)
class PlateArtwork:
    """Artwork of one plate with its proof."""

    content: bytes
    media_type: str
    file_name: str
    proof: PlateProof


@dataclass(frozen=True, slots=True)
class Bundle:
    """A ZIP in a temporary file, which is gone when it is closed."""

    file: IO[bytes]
    size: int
    plates: int
    approximate: int
    lowest_confidence: float


class Artworks:
    """Use cases on artwork.

    Parameters
    ----------
    database : Database
    public_url : str
        Where the registry's records are reached; goes into the QR codes.
    read : callable
        Decoder of the self-proof.
    """

    def __init__(self, database: Database, *, public_url: str, read: PlateReader) -> None:
        self._database = database
        self._public_url = public_url
        self._read = read
        self._places = threading.BoundedSemaphore(_BUNDLES_AT_ONCE)

    def tag(
        self, caller: Caller, marker_id: str, form: ArtworkFormat, options: ArtworkOptions, dpi: float = DEFAULT_DPI
    ) -> str:
        """What the artwork depends on, as a short hash: it changes when the artwork would.

        Raises
        ------
        NotFound
            There is no such plate.
        """
        row = self._get_plate(caller, marker_id)
        parts = (ARTWORK_VERSION, self._public_url, row["id"], row["version"], form, options, dpi)
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]

    def plate_artwork(
        self, caller: Caller, marker_id: str, form: ArtworkFormat, options: ArtworkOptions, dpi: float = DEFAULT_DPI
    ) -> PlateArtwork:
        """Artwork of one plate at true size, drawn, proved and written.

        Raises
        ------
        NotFound
            There is no such plate.
        ProofFailed
            The drawing did not read back as its own code.
        """
        order = self._order(self._get_plate(caller, marker_id))
        drawing = encode_plate(order, options)
        proof = prove_plate(drawing, order.code, order.geometry, self._read)
        written = write_artwork(drawing, form, dpi=dpi)
        return PlateArtwork(written.content, written.media_type, f"{order.plate_id}-r{order.revision}.{form}", proof)

    def bundle(self, caller: Caller, selection: Selection, options: BundleOptions) -> Bundle:
        """Artwork of a selection in one ZIP, every plate proved.

        Raises
        ------
        InvalidParameter
            No plates or too many, or a sheet that is too small.
        NotFound
            A plate is missing.
        Unavailable
            Other selections are being written.
        """
        with self._database.read() as connection:
            rows = select_markers(connection, caller.agency_id, selection, "plate", most=MAX_PLATES)
        if not self._places.acquire(blocking=False):
            raise Unavailable("other selections are being written", cure="try again in a few seconds")
        file = tempfile.TemporaryFile(prefix="waymark-artwork-")  # noqa: SIM115 - the response reads it
        try:
            manifest = write_bundle([self._order(row) for row in rows], file, options=options, read=self._read)
        except BaseException:
            file.close()
            raise
        finally:
            self._places.release()
        size = file.tell()
        file.seek(0)
        return Bundle(file, size, len(rows), sum(_is_approximate(row) for row in rows), _lowest_confidence(manifest))

    def _get_plate(self, caller: Caller, marker_id: str) -> Row:
        with self._database.read() as connection:
            row = store.get_marker(connection, caller.agency_id, marker_id)
        if row["family"] != "plate":
            raise NotFound(f"marker {marker_id} is no plate", field="marker_id", limit="plates have artwork")
        return row

    def _order(self, row: Row) -> PlateOrder:
        return PlateOrder(
            plate_id=row["id"],
            code=plate_code(row),
            geometry=plate_geometry(row),
            record_url=f"{self._public_url}/v1/markers/{row['id']}",
            revision=row["version"],
            lon_deg=row["lon_deg"],
            lat_deg=row["lat_deg"],
            crs=_reference(row),
        )


def _reference(row: Row) -> str:
    """Reference system for the margin: frame and epoch of the position, and a warning if it is only approximate."""
    frame = " ".join(str(row["realization"] or "WGS 84").split())
    text = frame + (f" @ {row['epoch']:.2f}" if row["epoch"] is not None else "")
    if _is_approximate(row):
        warning = str(LocalizationGrade.APPROXIMATE)
        text = f"{text[: MAX_NOTE_LENGTH - len(warning) - 3]} ({warning})"
    return "".join(c if c.isprintable() and c.isascii() else "?" for c in text)[:MAX_NOTE_LENGTH].strip()


def _is_approximate(row: Row) -> bool:
    return bool(row["localization_grade"] != LocalizationGrade.EXACT)


def _lowest_confidence(manifest: dict[str, Any]) -> float:
    return float(min(plate["proof"]["confidence"] for plate in manifest["plates"]))
