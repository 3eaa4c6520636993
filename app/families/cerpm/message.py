"""The row of a CERPM as values of the core: what it sends, its side, its speed limit and its radio."""

from __future__ import annotations

from typing import Any

from app.markers.cerpm import CerpmMessage, LaneSide, SpeedLimit, SpeedUnit
from app.radio.settings import RadioSettings
from app.registry.marker_rows import MarkerRow


def speed_limit_document(limit: SpeedLimit | None) -> dict[str, Any] | None:
    """A speed limit as it is stored."""
    return None if limit is None else {"value": limit.value, "unit": limit.unit.value}


def speed_limit_of(row: MarkerRow) -> SpeedLimit | None:
    """Speed limit of a CERPM's row."""
    stored = row.spec["speed_limit"]
    return None if stored is None else SpeedLimit(stored["value"], SpeedUnit(stored["unit"]))


def side_of(row: MarkerRow) -> LaneSide:
    """Lane side of a CERPM's row."""
    return LaneSide[row.spec["side"].upper()]


def radio_of(row: MarkerRow) -> RadioSettings:
    """Radio of a CERPM's row."""
    return RadioSettings(**row.spec["radio"])


def message_of(row: MarkerRow, sequence: int = 0) -> CerpmMessage:
    """The message that a CERPM sends; with its height only if that is above the ellipsoid.

    Raises
    ------
    InvalidParameter
        It does not fit a message.
    """
    ellipsoidal = row.vertical_datum in (None, "ellipsoid")
    return CerpmMessage(
        number=int(row.digits),
        lon_deg=row.lon_deg,
        lat_deg=row.lat_deg,
        height_m=row.height_m if ellipsoidal else None,
        side=side_of(row),
        speed_limit=speed_limit_of(row),
        sequence=sequence,
    )
