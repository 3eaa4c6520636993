"""CERPMs: their numbers, what they say of themselves, and how they send it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from app.encoders.cerpm.settings import RadioSettings
from app.errors import CodeTaken
from app.geodesy import PlacedPosition
from app.markers.cerpm import CerpmMessage, LaneSide, SpeedLimit, SpeedUnit
from app.registry import cerpms
from app.registry.markers import Row
from app.services.access import Caller
from app.services.marker_documents import cerpm_document
from app.services.marker_rules import PLANNED, MarkerRules
from app.services.positions import GivenPosition, place_given, position_columns

FAMILY = "cerpm"


@dataclass(frozen=True, slots=True)
class NewCerpm:
    """A CERPM to register."""

    position: GivenPosition
    number: int | None = None
    side: LaneSide = LaneSide.UNKNOWN
    speed_limit: SpeedLimit | None = None
    dev_eui: str | None = None
    radio: RadioSettings = field(default_factory=RadioSettings)
    status: str = PLANNED
    heading_deg: float | None = None
    heading_rmse_deg: float | None = None
    road: str | None = None
    measure_m: float | None = None
    offset_m: float | None = None
    kind: str | None = None
    reason: str | None = None


class Cerpms:
    """The family of chip-enabled raised pavement markers."""

    def __init__(self, rules: MarkerRules) -> None:
        self._rules = rules

    def prepare(self, caller: Caller, new: NewCerpm, now: datetime) -> PlacedPosition:
        """The marker's place."""
        return place_given(new.position, self._rules.crs_accuracy_m)

    def columns(
        self, connection: sa.Connection, caller: Caller, new: NewCerpm, prepared: PlacedPosition
    ) -> dict[str, Any]:
        """Number, place and what is said of it.

        Raises
        ------
        InvalidParameter
            It does not fit a message.
        CodeTaken
            Another marker carries the number, or once did.
        """
        number = new.number
        if number is None:
            number = cerpms.last_number(connection, caller.agency_id) + 1
        elif (other := cerpms.find_number(connection, caller.agency_id, number)) is not None:
            raise CodeTaken(
                f"the number {number} is marker {other['id']}'s",
                field="number",
                limit="a number names one marker of its agency for ever",
                cure="leave the number out and the next free one is given",
            )
        columns = {
            "family": FAMILY,
            "scheme": FAMILY,
            "digits": str(number),
            "heading_deg": new.heading_deg,
            **position_columns(new.position, prepared),
            "spec": {
                "side": new.side.name.lower(),
                "speed_limit": speed_limit_document(new.speed_limit),
                "dev_eui": new.dev_eui,
                "radio": asdict(new.radio),
            },
        }
        message_of(columns)
        return columns

    def revised(
        self, connection: sa.Connection, caller: Caller, row: Row, values: dict[str, Any], *, moved: bool
    ) -> dict[str, Any]:
        """What is said of the marker after a change.

        Raises
        ------
        InvalidParameter
            It does not fit a message.
        """
        spec = {**row["spec"], **values.get("spec", {})}
        message_of({**row, **values, "spec": spec})
        return {"spec": spec}

    def index(self, connection: sa.Connection, caller: Caller, row: Row) -> None:
        """Nothing: CERPMs are found by the columns that they have."""

    def document(self, row: Row | dict[str, Any]) -> dict[str, Any]:
        """A CERPM."""
        return cerpm_document(row)

    detail = document


def speed_limit_document(limit: SpeedLimit | None) -> dict[str, Any] | None:
    """A speed limit as it is stored."""
    return None if limit is None else {"value": limit.value, "unit": limit.unit.value}


def speed_limit_of(row: Row | dict[str, Any]) -> SpeedLimit | None:
    """Speed limit of a CERPM's row."""
    stored = row["spec"]["speed_limit"]
    return None if stored is None else SpeedLimit(stored["value"], SpeedUnit(stored["unit"]))


def side_of(row: Row | dict[str, Any]) -> LaneSide:
    """Lane side of a CERPM's row."""
    return LaneSide[row["spec"]["side"].upper()]


def radio_of(row: Row | dict[str, Any]) -> RadioSettings:
    """Radio of a CERPM's row."""
    return RadioSettings(**row["spec"]["radio"])


def message_of(row: Row | dict[str, Any], sequence: int = 0) -> CerpmMessage:
    """What a CERPM says of itself; its height only if that is above the ellipsoid.

    Raises
    ------
    InvalidParameter
        It does not fit a message.
    """
    ellipsoidal = row["vertical_datum"] in (None, "ellipsoid")
    return CerpmMessage(
        number=int(row["digits"]),
        lon_deg=row["lon_deg"],
        lat_deg=row["lat_deg"],
        height_m=row["height_m"] if ellipsoidal else None,
        side=side_of(row),
        speed_limit=speed_limit_of(row),
        sequence=sequence,
    )
