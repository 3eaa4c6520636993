"""Readings -> plates of the registry."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import sqlalchemy as sa

from app.errors import NotFound
from app.markers.plate import PlateCode, PlateScheme, resolve_position
from app.markers.reading import PlateReading
from app.registry import markers as store
from app.registry.markers import MarkerFilter, Row
from app.registry.spatial import distance_m
from app.services.decode_context import CoarsePosition
from app.services.plate_markers import plate_code

MAX_CODEBOOK = 500
_M_PER_DEG = 111_000.0


@dataclass(frozen=True, slots=True)
class NearbyPlates:
    """The agency's plates that could be in view.

    Attributes
    ----------
    rows : tuple of row
        Nearest first.
    codebook : tuple of PlateCode
        Their codes, without repetitions; empty if it is not complete.
    complete : bool
        False if there are more than a codebook may hold; then there is no codebook.
    """

    rows: tuple[Row, ...] = ()
    codebook: tuple[PlateCode, ...] = ()
    complete: bool = True


@dataclass(frozen=True, slots=True)
class Match:
    """The plate of the registry that a reading is of, or where an unregistered one would be.

    Attributes
    ----------
    row : row or None
        The registered plate.
    lon_deg, lat_deg : float or None
        Of the registered plate, or what the digits of an unregistered one say. [deg]
    distance_m : float or None
        From the coarse position. [m]
    plausible : bool
        Whether that is within the coarse accuracy and the range of view.
    others : tuple of str
        Ids of further plates with the same digits within reach.
    note : str
        What to know about the match.
    """

    row: Row | None
    lon_deg: float | None = None
    lat_deg: float | None = None
    distance_m: float | None = None
    plausible: bool = False
    others: tuple[str, ...] = ()
    note: str = ""

    @property
    def ambiguous(self) -> bool:
        """Whether more than one plate or place fits."""
        return bool(self.others) or self.note.startswith("ambiguous")


def find_nearby_plates(connection: sa.Connection, agency_id: str, position: CoarsePosition | None) -> NearbyPlates:
    """Plates of the agency within the coarse accuracy and the range of view."""
    if position is None:
        return NearbyPlates()
    rows = store.list_plates_near(
        connection, agency_id, position.lon_deg, position.lat_deg, position.reach_m, limit=MAX_CODEBOOK + 1
    )
    if len(rows) > MAX_CODEBOOK:
        return NearbyPlates(tuple(rows[:MAX_CODEBOOK]), complete=False)
    return NearbyPlates(tuple(rows), tuple(dict.fromkeys(plate_code(row) for row in rows)))


def match_reading(
    connection: sa.Connection,
    agency_id: str,
    reading: PlateReading,
    position: CoarsePosition | None,
    nearby: NearbyPlates,
) -> Match | None:
    """The registry's plate with the digits that were read, nearest to the coarse position.

    Returns
    -------
    Match or None
        None where nothing was read or there is no coarse position to look from.
    """
    code = reading.code
    if code is None or position is None:
        return None
    rows: Sequence[Row] = [row for row in nearby.rows if _carries(row, code)]
    if not nearby.complete:
        around = MarkerFilter(near=(position.lon_deg, position.lat_deg, position.reach_m), digits=code.digits)
        found = store.list_markers(connection, agency_id, around, after=None, limit=MAX_CODEBOOK)
        rows = [row for row in found if row["status"] != "retired" and _carries(row, code)]
    if rows:
        return _nearest(rows, position)
    if code.scheme is PlateScheme.ID:
        return _match_elsewhere(connection, agency_id, code, position)
    return _resolve_unregistered(code, position)


def _carries(row: Row, code: PlateCode) -> bool:
    return bool(row["digits"] == code.digits and row["n"] == code.n)


def _distance_m(row: Row, position: CoarsePosition) -> float:
    return distance_m(position.lon_deg, position.lat_deg, row["lon_deg"], row["lat_deg"])


def _nearest(rows: Sequence[Row], position: CoarsePosition) -> Match:
    ranked = sorted(rows, key=lambda row: _distance_m(row, position))
    row, others = ranked[0], tuple(str(other["id"]) for other in ranked[1:])
    note = f"ambiguous: {len(ranked)} plates within reach carry these digits; this is the nearest" if others else ""
    return Match(row, row["lon_deg"], row["lat_deg"], _distance_m(row, position), True, others, note)


def _match_elsewhere(connection: sa.Connection, agency_id: str, code: PlateCode, position: CoarsePosition) -> Match:
    """An id plate names itself wherever it is: one far from its place was moved or copied."""
    known = store.find_id_code(connection, code.digits, code.n)
    try:
        row = store.get_marker(connection, agency_id, known["id"]) if known is not None else None
    except NotFound:  # another agency's
        row = None
    if row is None:
        return Match(None, note="no plate of this agency carries this registry number")
    note = "the plate is registered elsewhere: moved, copied, or the coarse position is wrong"
    if row["status"] == "retired":
        note = "the plate is retired"
    return Match(row, row["lon_deg"], row["lat_deg"], _distance_m(row, position), False, (), note)


def _resolve_unregistered(code: PlateCode, position: CoarsePosition) -> Match:
    resolved = resolve_position(code, position.lon_deg, position.lat_deg)
    away_m = distance_m(position.lon_deg, position.lat_deg, resolved.lon_deg, resolved.lat_deg)
    next_m = resolved.next_distance_deg * _M_PER_DEG * math.cos(math.radians(position.lat_deg))
    plausible = away_m <= position.reach_m
    if not plausible:
        note = "the digits say a place out of reach of the coarse position: not a position plate, or a misread"
    elif next_m <= position.reach_m:
        note = "ambiguous: the decimals fit two places within reach of the coarse position"
    else:
        note = "not registered; the position is what its digits say"
    return Match(None, resolved.lon_deg, resolved.lat_deg, away_m, plausible, (), note)
