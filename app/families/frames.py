"""How the markers of a family are read in camera frames."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np
import numpy.typing as npt
import sqlalchemy as sa

from app.markers.reading import PlatePose
from app.registry.marker_rows import MarkerRow
from app.registry.spatial import distance_m
from app.sensors.camera import Camera

Pixels = npt.NDArray[np.uint8]


class FrameReading(Protocol):
    """What the readings of every family have."""

    @property
    def family(self) -> str: ...
    @property
    def outcome(self) -> str: ...
    @property
    def confidence(self) -> float: ...
    @property
    def pose(self) -> PlatePose | None: ...


class ApproximatePosition(Protocol):
    """Where the vehicle is, and how far from there a marker in view can be."""

    @property
    def lon_deg(self) -> float: ...
    @property
    def lat_deg(self) -> float: ...
    @property
    def reach_m(self) -> float: ...


@dataclass(frozen=True, slots=True)
class Nearby:
    """The agency's markers of one family that could be in view.

    Attributes
    ----------
    rows : tuple of row
        Nearest first.
    complete : bool
        False if there are more than a search may hold.
    """

    rows: tuple[MarkerRow, ...] = ()
    complete: bool = True


@dataclass(frozen=True, slots=True)
class Match:
    """The registered marker that a reading is of, or where an unregistered one would be.

    Attributes
    ----------
    row : row or None
        The registered marker.
    lon_deg, lat_deg : float or None
        Of the registered marker, or by the digits of an unregistered one. [deg]
    distance_m : float or None
        From the approximate position. [m]
    plausible : bool
        Whether that is within the accuracy of the approximate position and the range of view.
    others : tuple of str
        Ids of further markers with the same code within reach.
    note : str
        What to know about the match.
    fits_two_places : bool
        The digits of an unregistered marker fit two places within reach.
    """

    row: MarkerRow | None
    lon_deg: float | None = None
    lat_deg: float | None = None
    distance_m: float | None = None
    plausible: bool = False
    others: tuple[str, ...] = ()
    note: str = ""
    fits_two_places: bool = False

    @property
    def ambiguous(self) -> bool:
        """Whether more than one marker or place fits."""
        return bool(self.others) or self.fits_two_places


ReadingT = TypeVar("ReadingT", bound=FrameReading)
SearchT = TypeVar("SearchT")


class FrameReader(ABC, Generic[ReadingT, SearchT]):
    """Searches frames for the markers of a family, and matches what was read against the registry.

    Attributes
    ----------
    document_type : type
        Shape of a reading as clients see it.
    """

    document_type: ClassVar[Any]

    @abstractmethod
    def search(self, nearby: Nearby, camera: Camera | None) -> SearchT | None:
        """What a decoder process is to look for: plain values that can be pickled; None if there is nothing."""

    @abstractmethod
    def read(self, pixels: Pixels, search: SearchT, *, thermal: bool) -> Sequence[ReadingT]:
        """Read a frame; called in a decoder process."""

    @abstractmethod
    def match(
        self,
        connection: sa.Connection,
        agency_id: str,
        reading: ReadingT,
        position: ApproximatePosition | None,
        nearby: Nearby,
    ) -> Match | None:
        """The registered marker of a reading; None where nothing was read or no position is known."""

    @abstractmethod
    def document(self, reading: ReadingT) -> Any:
        """A reading as clients see it."""

    @abstractmethod
    def observation(self, reading: ReadingT) -> dict[str, Any]:
        """Detail of the observation that a matched reading makes of its marker."""


def nearest_match(rows: Sequence[MarkerRow], position: ApproximatePosition, label: str) -> Match:
    """The nearest of the markers that carry the code of a reading."""
    ranked = sorted(rows, key=lambda row: distance_to_row(row, position))
    row, others = ranked[0], tuple(other.id for other in ranked[1:])
    note = f"ambiguous: {len(ranked)} {label}s within reach carry these digits; this is the nearest" if others else ""
    return Match(row, row.lon_deg, row.lat_deg, distance_to_row(row, position), True, others, note)


def distance_to_row(row: MarkerRow, position: ApproximatePosition) -> float:
    """Distance of a marker from the approximate position. [m]"""
    return distance_m(position.lon_deg, position.lat_deg, row.lon_deg, row.lat_deg)
