"""How the points of a survey or a plan become markers of a family, thousands at a time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
import sqlalchemy as sa
from pydantic import BaseModel

from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.roles import CodeForm
from app.formats.surveys.table import Fault, Texts
from app.markers.magnet import Installation
from app.markers.plate import Digits
from app.markers.reading import MarkerRow
from app.planning.alignment import Alignment
from app.planning.plan import PlannedMarker
from app.radio.settings import RadioSettings
from app.registry.bulk_load import Columns
from app.registry.conditions import grade_columns
from app.registry.marker_rows import CodeRow
from app.surveys.georeference import GeoreferencedSurvey
from app.values import Bools, JsonObject

# === Limits that a deployment can set for markers, and the states that their rules ask about.


PLANNED = "planned"
RETIRED = "retired"


@dataclass(frozen=True, slots=True)
class MarkerRules:
    """Limits that a deployment can set."""

    explicit_code_radius_m: float = 20_000.0
    position_code_radius_m: float = 1_000.0
    crs_accuracy_m: float = 0.1
    idempotency_ttl: timedelta = timedelta(hours=24)


ColumnValues = JsonObject
"""Values by column of `markers`: those of a new marker, or those that change."""


def is_placed_again(row: MarkerRow, values: ColumnValues) -> bool:
    """Whether a change gives a position, or puts a retired marker back into use."""
    return "lon_deg" in values or (row.status == RETIRED and values.get("status", RETIRED) != RETIRED)


# === How the markers of a plan become rows of the registry, thousands at a time.


PLAN_METHOD = "placed by a plan"
"""Survey method of markers that nobody has surveyed yet."""
_PLACE_IN_PLAN = ("number", "lane", "station_m", "chainage_m", "offset_m")


class PlannedRow(NamedTuple):
    """A row of `markers`: `covered` planned markers, the first of which has the number."""

    number: int
    columns: ColumnValues
    covered: int = 1


@dataclass(frozen=True, slots=True)
class Commitment:
    """What a family needs to know of a plan that is committed."""

    plan_id: str
    alignment: Alignment
    rules: MarkerRules
    now: datetime
    codebook_id: str | None = None  # of the tags
    radio: RadioSettings = field(default_factory=RadioSettings)  # of the CERPMs
    installation: Installation = field(default_factory=Installation)  # of the magnets
    roads: Mapping[str, str] = field(default_factory=dict)  # names in the registry of roads of the alignment

    def on_road(self, marker: PlannedMarker) -> ColumnValues:
        """Columns of its road, and of its measure there: its station."""
        name = self.alignment.lane(marker.lane).road
        return {"road": self.roads.get(name, name) or None, "measure_m": round(marker.station_m, 4)}

    def original(self, marker: PlannedMarker) -> dict[str, object]:
        """Where a planned marker's position comes from."""
        return {
            "lon_deg": marker.lon_deg,
            "lat_deg": marker.lat_deg,
            **({"height_m": marker.height_m} if marker.height_m is not None else {}),
            "plan": {
                "id": self.plan_id,
                **{name: getattr(marker, name) for name in _PLACE_IN_PLAN},
                **self._frame_of_road(),
            },
        }

    def _frame_of_road(self) -> dict[str, str]:
        """System and realization in which the road came, for exports: those of the position are WGS 84 / ITRF."""
        road = self.alignment
        if not road.crs.startswith("EPSG:"):
            return {}
        realization = road.declared_realization
        return {"crs": road.crs, **({"realization": realization} if realization else {})}

    def position(self, marker: PlannedMarker) -> ColumnValues:
        """Columns of a planned marker's position, and its place on the road."""
        road = self.alignment
        return {
            "lon_deg": marker.lon_deg,
            "lat_deg": marker.lat_deg,
            "height_m": marker.height_m,
            "vertical_datum": (road.vertical_datum or "ellipsoid") if marker.height_m is not None else None,
            "heading_deg": marker.heading_deg,
            "crs": "EPSG:4326",
            "realization": road.realization,
            "epoch": road.epoch,
            "survey_method": PLAN_METHOD,
            **self.on_road(marker),
            "original": self.original(marker),
            **grade_columns(None, road.transform_accuracy_m, None),
        }


# === How the points of a survey become markers of a family, thousands at a time.


Rows = npt.NDArray[np.intp]


@dataclass(slots=True)
class RowCodes:
    """Codes of the rows of a survey that can have one."""

    rows: Rows  # shape (N,): indices of the rows, rising
    digits: Digits  # shape (N,): empty where a code is still to be assigned
    from_file: Bools  # bool, shape (N,): whether the file has it
    scheme: str

    def of(self, chosen: Bools | slice) -> RowCodes:
        """The codes of some of the rows."""
        return RowCodes(self.rows[chosen], self.digits[chosen], self.from_file[chosen], self.scheme)


def listed_codes(survey: GeoreferencedSurvey, rows: Rows) -> Iterator[tuple[int, str]]:
    """Place in `rows` and text of each row that has a code."""
    texts = survey.table.texts.get("code", Texts())
    place_of = np.full(survey.table.rows, -1, dtype=np.intp)
    place_of[rows] = np.arange(len(rows))
    start = 0
    for part in texts.parts():
        for k, text in zip(place_of[start : start + len(part)].tolist(), part, strict=True):
            if text and k >= 0:
                yield k, text
        start += len(part)


def unknown_texts(texts: Texts | None, wanted: Bools, name: str, known: set[str], limit: str) -> Iterator[Fault]:
    """Faults of the wanted rows whose text in a column is not a known one."""
    start = 0
    for part in texts.parts() if texts is not None else ():
        if not known.issuperset(part):
            for k, text in enumerate(part, start):
                if text and text not in known and text.upper() not in known and wanted[k]:
                    yield Fault(k + 1, name, "not_a_marker", f"there is no {name} {text[:40]!r}", limit)
        start += len(part)


def texts_of(survey: GeoreferencedSurvey, rows: Rows, name: str) -> list[str]:
    """Texts of some rows in a column."""
    texts = survey.table.texts[name]
    return [texts[row] for row in rows.tolist()]


DefaultsT = TypeVar("DefaultsT")


class SurveyImport(ABC, Generic[DefaultsT]):
    """The part of an import that only one family knows: its codes, its columns, and when two codes collide."""

    members: ClassVar[type[BaseModel]]  # members of a survey's declaration that only this family has

    @abstractmethod
    def defaults(self, declared: Mapping[str, object]) -> DefaultsT:
        """What a survey's markers have in common, of the declared members.

        Raises
        ------
        InvalidParameter
            The members contradict each other.
        """

    def check_values(
        self, survey: GeoreferencedSurvey, wanted: Bools, declaration: ImportDeclaration
    ) -> Iterator[Fault]:
        """Faults of the wanted rows that no marker of this family can have."""
        yield from ()

    @abstractmethod
    def code_form(self, defaults: DefaultsT, *, compare: bool) -> CodeForm:
        """What the codes of a survey's column look like; with `compare` those of any marker of the family."""

    @abstractmethod
    def read_codes(self, survey: GeoreferencedSurvey, rows: Rows, defaults: DefaultsT) -> tuple[RowCodes, list[Fault]]:
        """Codes of these rows (indices from 0), and the faults of rows whose code is none."""

    def assign_missing(self, connection: sa.Connection, agency_id: str, codes: RowCodes) -> None:
        """Give codes to the rows that are still without one."""

    @abstractmethod
    def is_unique(self, codes: RowCodes) -> bool:
        """Whether two markers may not have the same code however far apart they are."""

    @abstractmethod
    def collides(
        self,
        codes: RowCodes,
        defaults: DefaultsT,
        place: tuple[float, float],
        known: CodeRow,
        agency_id: str,
        rules: MarkerRules,
    ) -> bool:
        """Whether a stored marker, which has the code of a row, keeps the row from being stored.

        Parameters
        ----------
        place : (float, float)
            Longitude and latitude of the row. [deg]
        """

    @abstractmethod
    def columns(self, survey: GeoreferencedSurvey, codes: RowCodes, defaults: DefaultsT) -> Columns:
        """Columns that only markers of this family have."""


def digits_column(codes: RowCodes) -> Sequence[str]:
    """The codes as the registry stores them."""
    return [code.decode() for code in codes.digits.tolist()]
