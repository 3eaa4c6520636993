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
    PlateReader,
    write_artwork,
    write_bundle,
)
from app.encoders.plate.bundle import NO_QR_CODE
from app.encoders.plate.formats import DEFAULT_DPI
from app.errors import NotFound, Unavailable
from app.families import FAMILIES, get_family
from app.families.files import ArtworkProof, MarkerArtwork
from app.families.plate.artwork import is_unfit, plate_order
from app.families.plate.plates import PLATE
from app.registry import markers as store
from app.registry.database import Database
from app.registry.marker_rows import MarkerRow
from app.services.access.access import Caller
from app.services.markers.selection import Selection, select_markers

MAX_PLATES = 5_000
_BUNDLES_AT_ONCE = 2


@dataclass(frozen=True, slots=True)
class Artwork:
    """Artwork of one marker with its proof."""

    content: bytes
    media_type: str
    file_name: str
    proof: ArtworkProof
    qr_code: str


@dataclass(frozen=True, slots=True)
class Bundle:
    """A ZIP in a temporary file, which is gone when it is closed."""

    file: IO[bytes]
    size: int
    plates: int
    approximate: int
    lowest_confidence: float
    qr_code: str


class Artworks:
    """Use cases on artwork.

    Parameters
    ----------
    database : Database
    public_url : str
        Start of the addresses of public pages, which go into the QR codes; empty: there are no QR codes.
    read : callable
        Decoder of the self-proof.
    """

    def __init__(self, database: Database, *, public_url: str, read: PlateReader) -> None:
        self._database = database
        self._public_url = public_url
        self._read = read
        self._places = threading.BoundedSemaphore(_BUNDLES_AT_ONCE)
        self.qr_code = qr_code_header(public_url)

    def tag(
        self, caller: Caller, marker_id: str, form: ArtworkFormat, options: ArtworkOptions, dpi: float = DEFAULT_DPI
    ) -> str:
        """What the artwork depends on, as a short hash: it changes when the artwork would.

        Raises
        ------
        NotFound
            There is no such marker, or its family has no artwork.
        """
        row, artwork = self._get(caller, marker_id)
        parts = (artwork.version, self._public_url, row.id, row.version, form, options, dpi)
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]

    def artwork(
        self, caller: Caller, marker_id: str, form: ArtworkFormat, options: ArtworkOptions, dpi: float = DEFAULT_DPI
    ) -> Artwork:
        """Artwork of one marker at true size, drawn, proved and written.

        Raises
        ------
        NotFound
            There is no such marker, or its family has no artwork.
        ProofFailed
            The drawing did not read back as its own code.
        """
        row, artwork = self._get(caller, marker_id)
        drawing = artwork.draw(row, options, record_url=page_url(self._public_url, row.id))
        proof = artwork.prove(row, drawing, self._read)
        written = write_artwork(drawing, form, dpi=dpi)
        return Artwork(written.content, written.media_type, f"{row.id}-r{row.version}.{form}", proof, self.qr_code)

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
            rows = select_markers(connection, caller.agency_id, selection, PLATE.name, most=MAX_PLATES)
        if not self._places.acquire(blocking=False):
            raise Unavailable("other selections are being written", cure="try again in a few seconds")
        file = tempfile.TemporaryFile(prefix="waymark-artwork-")  # noqa: SIM115 - the response reads it
        try:
            manifest = write_bundle(
                [plate_order(row, page_url(self._public_url, row.id)) for row in rows],
                file,
                options=options,
                read=self._read,
            )
        except BaseException:
            file.close()
            raise
        finally:
            self._places.release()
        size = file.tell()
        file.seek(0)
        return Bundle(
            file, size, len(rows), sum(is_unfit(row) for row in rows), _lowest_confidence(manifest), self.qr_code
        )

    def _get(self, caller: Caller, marker_id: str) -> tuple[MarkerRow, MarkerArtwork]:
        with self._database.read() as connection:
            row = store.get_marker(connection, caller.agency_id, marker_id)
        family = get_family(row.family)
        if family.artwork is None:
            raise NotFound(
                f"marker {marker_id} is a {family.label}, which has no artwork",
                field="marker_id",
                limit=", ".join(family.name for family in FAMILIES if family.artwork is not None),
            )
        return row, family.artwork


def page_url(public_url: str, marker_id: str) -> str:
    """Address of a marker's public page, as QR codes contain it; empty if the server has no public address."""
    return f"{public_url}/m/{marker_id}" if public_url else ""


def qr_code_header(public_url: str) -> str:
    """Value of the header Waymark-QR-Code of artwork."""
    return "public-page" if public_url else f'none; reason="{NO_QR_CODE}"'


def _lowest_confidence(manifest: dict[str, Any]) -> float:
    return float(min(plate["proof"]["confidence"] for plate in manifest["plates"]))
