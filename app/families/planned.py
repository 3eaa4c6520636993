"""How the markers of a plan become rows of the registry, thousands at a time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, ClassVar, NamedTuple

from app.families.rules import MarkerRules
from app.planning.alignment import Alignment
from app.planning.plan import PlannedMarker
from app.radio.settings import RadioSettings
from app.registry.grade_columns import grade_columns
from app.registry.marker_rows import CodeRow

PLAN_METHOD = "placed by a plan"
"""Survey method of markers that nobody has surveyed yet."""


class PlannedRow(NamedTuple):
    """A row of `markers`: `covered` planned markers, the first of which has the number."""

    number: int
    columns: dict[str, Any]
    covered: int = 1


@dataclass(frozen=True, slots=True)
class Commitment:
    """What a family needs to know of a plan that is committed.

    Attributes
    ----------
    plan_id : str
    alignment : Alignment
    rules : MarkerRules
    now : datetime
    codebook_id : str or None
        Of the tags.
    radio : RadioSettings
        Of the CERPMs.
    """

    plan_id: str
    alignment: Alignment
    rules: MarkerRules
    now: datetime
    codebook_id: str | None = None
    radio: RadioSettings = field(default_factory=RadioSettings)

    def original(self, marker: PlannedMarker) -> dict[str, Any]:
        """Where a planned marker's position comes from."""
        return {
            "lon_deg": marker.lon_deg,
            "lat_deg": marker.lat_deg,
            **({"height_m": marker.height_m} if marker.height_m is not None else {}),
            "plan": {
                "id": self.plan_id, "number": marker.number, "lane": marker.lane, "chainage_m": marker.chainage_m,
                "offset_m": marker.offset_m,
            },
        }  # fmt: skip

    def position(self, marker: PlannedMarker) -> dict[str, Any]:
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
            "original": self.original(marker),
            **grade_columns(None, road.transform_accuracy_m, None),
        }


class PlannedMarkers(ABC):
    """The part of committing a plan that only one family knows.

    Attributes
    ----------
    needs_index : bool
        Whether `Family.index` stores something for these markers.
    """

    needs_index: ClassVar[bool] = False

    @abstractmethod
    def rows(self, commitment: Commitment, markers: Sequence[PlannedMarker]) -> Iterator[PlannedRow]:
        """Rows of the planned markers of this family, in the order of their numbers.

        A row has the columns that differ from those of an empty marker.
        """

    def taken_numbers(self, agency_id: str, known: Iterable[CodeRow]) -> set[int]:
        """Registry numbers that planned markers may not have, because stored ones have them.

        Parameters
        ----------
        agency_id : str
            Of the plan.
        known : iterable of rows
            As `app.registry.bulk.list_by_digits` returns them for the codes of the plan.
        """
        return set()
