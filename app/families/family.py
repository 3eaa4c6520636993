"""What a family of markers declares. All other code asks the declaration; `app.families.FAMILIES` lists them.

docs/add-a-family.md describes how a family is added.
"""

from __future__ import annotations

import secrets
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, ClassVar, Generic, TypeVar

import sqlalchemy as sa
from pydantic import JsonValue

from app.families.documents import MarkerDocument
from app.families.files import MarkerArtwork, MarkerSheet
from app.families.frames import FrameReader
from app.families.inputs import FamilyChange, MarkerIn
from app.families.new_marker import NewMarker
from app.families.planned import PlannedMarkers
from app.families.rules import MarkerRules
from app.families.snapshot import SnapshotRecord
from app.families.surveys import SurveyImport
from app.planning.outputs.hd_map import MapMarker
from app.registry.database import Database
from app.registry.lines import LineSource
from app.registry.marker_rows import MarkerRow

New = TypeVar("New", bound=NewMarker)
Prepared = TypeVar("Prepared")


@dataclass(frozen=True, slots=True)
class Registration:
    """What a family may ask while it registers or changes a marker.

    Attributes
    ----------
    agency_id : str
        Agency of the marker.
    now : datetime
    rules : MarkerRules
    database : Database
        For reads before the transaction begins, such as a codebook, which never changes.
    random_bits : callable
        Source of the registry numbers that plates get.
    """

    agency_id: str
    now: datetime
    rules: MarkerRules
    database: Database
    random_bits: Callable[[int], int] = secrets.randbits


class Family(ABC, Generic[New, Prepared]):
    """One family of markers: everything that distinguishes it from the others.

    Attributes
    ----------
    name : str
        As it is stored and as clients send it.
    label, title : str
        One marker in a sentence, and the family in a heading.
    schema : type of MarkerIn
        Body of a request that registers a marker.
    examples : sequence of JSON value
        Bodies that the API's documentation shows.
    lines : LineSource or None
        Lines that the family's markers make along a road.
    survey : SurveyImport or None
        How points of a survey become the family's markers.
    artwork : MarkerArtwork or None
        Drawing of a marker at true size, for the workshop.
    frames : FrameReader or None
        How the family's markers are read in camera frames.
    sheet : MarkerSheet or None
        Sheet of a marker for the crew that builds it.
    planned : PlannedMarkers or None
        How markers of a plan become the family's markers.
    snapshot : SnapshotRecord
        What vehicles get of a marker in the snapshot of an area.
    change : type of FamilyChange or None
        Members of a change that only this family has.
    document_type, detail_type : type
        Shapes of a marker in lists and histories, and by itself.
    """

    name: ClassVar[str]
    label: ClassVar[str]
    title: ClassVar[str]
    schema: ClassVar[type[MarkerIn]]
    examples: ClassVar[Sequence[JsonValue]]
    change: ClassVar[type[FamilyChange] | None] = None
    snapshot: ClassVar[SnapshotRecord]
    lines: ClassVar[LineSource | None] = None
    survey: ClassVar[SurveyImport[Any] | None] = None
    artwork: ClassVar[MarkerArtwork | None] = None
    frames: ClassVar[FrameReader[Any, Any] | None] = None
    sheet: ClassVar[MarkerSheet | None] = None
    planned: ClassVar[PlannedMarkers | None] = None
    document_type: ClassVar[Any]
    detail_type: ClassVar[Any]

    # --- registering and changing ---------------------------------------------------------------------------------

    @abstractmethod
    def prepare(self, registration: Registration, new: New) -> Prepared:
        """Work out what takes time, before the transaction begins.

        Raises
        ------
        InvalidParameter, ReferenceSystemError, NotFound
            The marker contradicts itself or names what does not exist.
        """

    @abstractmethod
    def columns(
        self, connection: sa.Connection, registration: Registration, new: New, prepared: Prepared
    ) -> dict[str, Any]:
        """Columns of a new marker: its code, place, heading and spec.

        Raises
        ------
        InvalidParameter, Conflict
            The marker contradicts itself, a limit, or what is stored.
        """

    def revise(
        self, connection: sa.Connection, registration: Registration, row: MarkerRow, values: dict[str, Any]
    ) -> dict[str, Any]:
        """Further columns of a marker that gets these values.

        Parameters
        ----------
        row : MarkerRow
            The marker as it is stored.
        values : dict
            Columns that change; `spec` has only the members of the spec that change.
        """
        return {}

    def index(self, connection: sa.Connection, agency_id: str, row: MarkerRow) -> None:
        """Store what searches need besides the marker's row, after the marker was stored or moved."""

    def feature_members(self, properties: Mapping[str, Any]) -> dict[str, Any]:
        """Members of the request that registers the marker of a point feature, besides those of all families.

        Parameters
        ----------
        properties : mapping
            Of the feature, without those that are null.

        Raises
        ------
        InvalidParameter
            Markers of this family are no points.
        """
        return {}

    # --- documents ------------------------------------------------------------------------------------------------

    @abstractmethod
    def document(self, row: MarkerRow) -> MarkerDocument:
        """A marker as lists and histories show it."""

    def detail(self, row: MarkerRow) -> MarkerDocument:
        """A marker by itself."""
        return self.document(row)

    def map_markers(self, row: MarkerRow) -> Sequence[MapMarker]:
        """A marker as HD maps contain it: one point, where the family declares nothing else."""
        return (map_point(row),)


def map_point(row: MarkerRow, **members: Any) -> MapMarker:
    """A marker as one thing of an HD map, with members that only its family knows."""
    return MapMarker(
        row.id, row.family, row.digits, row.lon_deg, row.lat_deg, row.height_m, row.heading_deg,
        vertical_datum=row.vertical_datum, **members,
    )  # fmt: skip
