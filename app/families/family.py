"""What a family of markers declares. All other code asks the declaration; `app.families.FAMILIES` lists them.

docs/add-a-family.md describes how a family is added.
"""

from __future__ import annotations

import secrets
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, ClassVar, Generic, Protocol, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt
import sqlalchemy as sa
from pydantic import JsonValue

from app.decoding.declarations import CoarsePosition
from app.decoding.frames import Match, Nearby, Pixels
from app.encoders.magnet import SheetFormat
from app.encoders.plate import ArtworkOptions, Drawing, PlateReader
from app.families.documents import FamilyChange, MarkerDocument, MarkerIn
from app.families.surveys import ColumnValues, Commitment, MarkerRules, PlannedRow, SurveyImport
from app.markers.reading import MarkerRow, PlatePose
from app.planning.outputs.hd_map import MapMarker
from app.planning.plan import PlannedMarker
from app.registry.database import Database
from app.registry.lines import LineSource
from app.registry.marker_rows import CodeRow
from app.sensors.camera import Camera

# === Files that a marker can be downloaded as.


@dataclass(frozen=True, slots=True)
class ArtworkProof:
    """What was read back from a drawing before it was handed out."""

    digits: str
    confidence: float


def rounded(values: npt.NDArray[np.float64] | None, places: int) -> list[list[float]] | None:
    """The rows of an array, rounded."""
    return None if values is None else np.round(values, places).tolist()


# === How the markers of a family are read in camera frames.


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


ReadingT = TypeVar("ReadingT", bound=FrameReading)
SearchT = TypeVar("SearchT")


class FrameReader(ABC, Generic[ReadingT, SearchT]):
    """Searches frames for the markers of a family, and matches what was read against the registry."""

    document_type: ClassVar[Any]  # shape of a reading as clients see it

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
        position: CoarsePosition | None,
        nearby: Nearby,
    ) -> Match | None:
        """The registered marker of a reading; None where nothing was read or no position is known."""

    def orient(
        self, reading: ReadingT, match: Match, camera: Camera, heading_deg: float | None
    ) -> tuple[ReadingT, str]:
        """A reading with its pose as the matched marker and the vehicle's heading decide, and why it may be wrong."""
        return reading, ""

    @abstractmethod
    def document(self, reading: ReadingT) -> Any:
        """A reading as clients see it."""

    @abstractmethod
    def observation(self, reading: ReadingT) -> dict[str, object]:
        """Detail of the observation that a matched reading makes of its marker."""


# === What a family of markers declares. All other code asks the declaration; `app.families.FAMILIES` lists them.


New = TypeVar("New", bound=MarkerIn)
Prepared = TypeVar("Prepared")


@dataclass(frozen=True, slots=True)
class Registration:
    """What a family may ask while it registers or changes a marker."""

    agency_id: str  # agency of the marker
    now: datetime
    rules: MarkerRules
    database: Database  # for reads before the transaction begins, such as a codebook, which never changes
    random_bits: Callable[[int], int] = secrets.randbits  # source of the registry numbers that plates get


class Family(ABC, Generic[New, Prepared]):
    """One family of markers: everything that distinguishes it from the others."""

    name: ClassVar[str]  # as it is stored and as clients send it
    label: ClassVar[str]  # one marker in a sentence
    title: ClassVar[str]  # the family in a heading
    schema: ClassVar[type[MarkerIn]]  # a marker that is to be registered, as requests have it
    examples: ClassVar[Sequence[JsonValue]]  # bodies that the API's documentation shows
    change: ClassVar[type[FamilyChange] | None] = None  # members of a change that only this family has
    document_type: ClassVar[Any]  # shape of a marker in lists and histories
    detail_type: ClassVar[Any]  # shape of a marker by itself
    has_index: ClassVar[bool] = False  # whether `index` stores something
    in_snapshots_when_retired: ClassVar[bool] = False
    artwork_version: ClassVar[str | None] = None  # another one if a marker would get another drawing; None: no artwork
    sheet_version: ClassVar[int | None] = None  # the same for the crew's sheet
    survey: ClassVar[SurveyImport[Any] | None] = None  # how points of a survey become its markers
    frames: ClassVar[FrameReader[Any, Any] | None] = None  # how its markers are read in camera frames
    lines: ClassVar[LineSource | None] = None  # lines that its markers make along a road

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
    ) -> ColumnValues:
        """Columns of a new marker: its code, place, heading and spec.

        Raises
        ------
        InvalidParameter, Conflict
            The marker contradicts itself, a limit, or what is stored.
        """

    def revise(
        self, connection: sa.Connection, registration: Registration, row: MarkerRow, values: ColumnValues
    ) -> ColumnValues:
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

    def feature_members(self, properties: Mapping[str, object]) -> dict[str, object]:
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

    # --- what is built: the drawing at true size for the workshop, the sheet for the crew -------------------------

    def draw(self, row: MarkerRow, options: ArtworkOptions, *, record_url: str) -> Drawing:
        """The drawing of a marker, whose public page is at an address; without one it has no QR code.

        Raises
        ------
        InvalidParameter
            The family's artwork does not have these options.
        """
        raise NotImplementedError(f"the family {self.name} has no artwork")

    def prove(self, row: MarkerRow, drawing: Drawing, read_plates: PlateReader) -> ArtworkProof:
        """Render a drawing and read it back.

        Raises
        ------
        ProofFailed
            The drawing did not read back as its own code.
        """
        raise NotImplementedError(f"the family {self.name} has no artwork")

    def write_sheet(self, row: MarkerRow, form: SheetFormat) -> bytes:
        """The sheet of a marker in a format."""
        raise NotImplementedError(f"the family {self.name} has no sheet")

    # --- plans ----------------------------------------------------------------------------------------------------

    def planned_rows(self, commitment: Commitment, markers: Sequence[PlannedMarker]) -> Iterator[PlannedRow]:
        """Rows of the planned markers of this family, in the order of their numbers.

        A row has the columns that differ from those of an empty marker.
        """
        raise NotImplementedError(f"no plan has markers of the family {self.name}")

    def taken_numbers(self, agency_id: str, known: Iterable[CodeRow]) -> set[int]:
        """Registry numbers that planned markers may not have, because stored ones have them.

        Parameters
        ----------
        agency_id : str
            Of the plan.
        known : iterable of rows
            As `app.registry.markers.list_by_digits` returns them for the codes of the plan.
        """
        return set()

    # --- snapshots: what vehicles without a connection get (docs/snapshots.md) ------------------------------------

    def snapshot_columns(self) -> tuple[sa.ColumnElement[Any], ...]:
        """What is read of the spec of each marker, with labels; the whole spec without any."""
        return ()

    @abstractmethod
    def snapshot_kind(self, row: MarkerRow) -> dict[str, object]:
        """What a marker has in common with others of its kind; plain values."""

    def snapshot_members(
        self, connection: sa.Connection, agency_id: str, codes: Sequence[str]
    ) -> Mapping[str, Sequence[object]]:
        """Further columns of markers with these codes, by the names of `write_snapshot`; None for a missing value."""
        return {}


AnyFamily: TypeAlias = Family[Any, Any]


def map_point(row: MarkerRow, **members: Any) -> MapMarker:
    """A marker as one thing of an HD map, with members that only its family knows."""
    place = (row.lon_deg, row.lat_deg, row.height_m, row.heading_deg)
    return MapMarker(row.id, row.family, row.digits, *place, vertical_datum=row.vertical_datum, **members)
