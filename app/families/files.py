"""Files that a marker can be downloaded as."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from app.encoders.magnet import SheetFormat
from app.encoders.plate import ArtworkOptions, Drawing, PlateReader
from app.registry.marker_rows import MarkerRow


@dataclass(frozen=True, slots=True)
class ArtworkProof:
    """What was read back from a drawing before it was handed out."""

    digits: str
    confidence: float


class MarkerArtwork(ABC):
    """Drawings of a family's markers at true size.

    Attributes
    ----------
    version : str
        Changes when the same marker would get another drawing.
    """

    version: str

    @abstractmethod
    def draw(self, row: MarkerRow, options: ArtworkOptions, *, record_url: str) -> Drawing:
        """The drawing of a marker, whose public page is at an address; without one it has no QR code.

        Raises
        ------
        InvalidParameter
            The family's artwork does not have these options.
        """

    @abstractmethod
    def prove(self, row: MarkerRow, drawing: Drawing, read_plates: PlateReader) -> ArtworkProof:
        """Render a drawing and read it back.

        Raises
        ------
        ProofFailed
            The drawing did not read back as its own code.
        """


@dataclass(frozen=True, slots=True)
class MarkerSheet:
    """Sheets of a family's markers for the crew.

    Attributes
    ----------
    version : int
        Goes up when the same marker would get another sheet.
    write : callable
        The sheet of a marker in a format.
    """

    version: int
    write: Callable[[MarkerRow, SheetFormat], bytes]
