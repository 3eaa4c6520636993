"""What the use cases on markers have in common: their limits, and what a family of markers does for them."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Protocol, TypeVar

import sqlalchemy as sa

from app.registry.markers import Row
from app.services.access import Caller

PLANNED = "planned"
RETIRED = "retired"


@dataclass(frozen=True, slots=True)
class MarkerRules:
    """Limits that a deployment can set."""

    explicit_code_radius_m: float = 20_000.0
    position_code_radius_m: float = 1_000.0
    crs_accuracy_m: float = 0.1
    idempotency_ttl: timedelta = timedelta(hours=24)


class NewMarker(Protocol):
    """What every family asks of a marker that is to be registered."""

    @property
    def status(self) -> str: ...
    @property
    def heading_rmse_deg(self) -> float | None: ...
    @property
    def road(self) -> str | None: ...
    @property
    def measure_m(self) -> float | None: ...
    @property
    def offset_m(self) -> float | None: ...
    @property
    def kind(self) -> str | None: ...
    @property
    def reason(self) -> str | None: ...


New = TypeVar("New", bound=NewMarker, contravariant=True)
Prepared = TypeVar("Prepared")


class MarkerFamily(Protocol[New, Prepared]):
    """What differs between families of markers."""

    def prepare(self, caller: Caller, new: New, now: datetime) -> Prepared:
        """What takes time and can be worked out before the transaction."""

    def columns(self, connection: sa.Connection, caller: Caller, new: New, prepared: Prepared) -> dict[str, Any]:
        """Columns of a new marker: its code, place and heading.

        Raises
        ------
        InvalidParameter, Conflict
            The marker contradicts itself, a limit, or what is stored.
        """

    def revised(
        self, connection: sa.Connection, caller: Caller, row: Row, values: dict[str, Any], *, moved: bool
    ) -> dict[str, Any]:
        """Further columns of a marker that gets these values: at a new place where it `moved`, or back in use."""

    def index(self, connection: sa.Connection, caller: Caller, row: Row) -> None:
        """Keep what searches need, after the marker was stored or moved."""

    def document(self, row: Row | dict[str, Any]) -> dict[str, Any]:
        """A marker as lists and histories show it."""

    def detail(self, row: Row | dict[str, Any]) -> dict[str, Any]:
        """A marker by itself."""


def is_back_in_use(row: Row, values: dict[str, Any]) -> bool:
    """Whether a retired marker is to be used again."""
    return bool(row["status"] == RETIRED and values.get("status", RETIRED) != RETIRED)
