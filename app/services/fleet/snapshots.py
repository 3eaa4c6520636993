"""Snapshots of an area for vehicles without a connection."""

from __future__ import annotations

from collections.abc import Callable
from datetime import timedelta
from typing import Any

import sqlalchemy as sa
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.encoders.snapshot import write_snapshot
from app.errors import InvalidParameter
from app.families import FAMILIES
from app.geodesy import decimal_year
from app.markers.snapshot import MAX_MARKERS, MAX_VALIDITY, Trust
from app.registry import bulk
from app.registry.codebooks import CODEBOOKS, book_of
from app.registry.database import Database
from app.registry.marker_rows import MarkerRow
from app.registry.spatial import Box
from app.services.access.access import Caller
from app.services.decodes.fixes import horizontal_rmse_m, marker_at
from app.services.markers.codebook_documents import MAX_BOOKS_SEARCHED
from app.services.ports import Clock

MAX_HOURS = MAX_VALIDITY / timedelta(hours=1)
_MEMBERS = (
    "id", "family", "status", "lon_deg", "lat_deg", "height_m", "vertical_datum", "heading_deg", "vertical_rmse_m",
    "heading_rmse_deg", "localization_grade",
)  # fmt: skip


class Snapshots:
    """Use cases on snapshots.

    Parameters
    ----------
    database : Database
    clock : Clock
    signing_keys : callable
        The server's keys, of which the first signs; called for every snapshot, so that a rotation needs no restart.
    """

    def __init__(
        self, database: Database, clock: Clock, signing_keys: Callable[[], tuple[Ed25519PrivateKey, ...]]
    ) -> None:
        self._database = database
        self._clock = clock
        self._signing_keys = signing_keys

    def make(self, caller: Caller, box: Box, hours: float) -> bytes:
        """A signed snapshot of the agency's markers in a box, all but the retired ones, and its codebooks.

        It holds no secret: the keys of CERPMs are symmetric, who can verify with one can sign with it.

        Raises
        ------
        InvalidParameter
            There are too many, or it would hold for too long.
        """
        if not 0 < hours <= MAX_HOURS:
            raise InvalidParameter(
                f"a snapshot cannot hold for {hours:g} h", field="hours", limit=f"above 0, at most {MAX_HOURS:g} h"
            )
        now = self._clock()
        with self._database.read() as connection:
            markers = list_markers(connection, caller.agency_id, box, decimal_year(now))
            books, _ = CODEBOOKS.page(connection, caller.agency_id, limit=MAX_BOOKS_SEARCHED)
        return write_snapshot(
            markers,
            agency_id=caller.agency_id,
            area_deg=(box.west_deg, box.south_deg, box.east_deg, box.north_deg),
            made_at=now,
            expires_at=now + timedelta(hours=hours),
            key=self._signing_keys()[0],
            codebooks=[book_of(row).to_document() for row in books],
        )

    def trust(self, caller: Caller) -> Trust:
        """What vehicles verify the agency's snapshots with."""
        return Trust(caller.agency_id, tuple(key.public_key().public_bytes_raw() for key in self._signing_keys()))


def list_markers(connection: sa.Connection, agency_id: str, box: Box, epoch: float) -> list[dict[str, Any]]:
    """The agency's markers in a box as a snapshot holds them, in the order of their ids, where they are at an epoch.

    If there are more than fit, one more than fits is returned.
    """
    records: list[dict[str, Any]] = []
    for family in FAMILIES:
        left = MAX_MARKERS + 1 - len(records)
        if left <= 0:
            break
        snapshot = family.snapshot
        rows = bulk.list_for_snapshot(
            connection,
            agency_id,
            family.name,
            box,
            columns=snapshot.columns(),
            with_retired=snapshot.with_retired,
            limit=left,
        )
        members = snapshot.members(connection, agency_id, rows) if len(rows) < left else {}
        records += [_record(row, epoch, snapshot.kind(row), members.get(row.id, {})) for row in rows]
    return sorted(records, key=lambda record: str(record["id"]))


def _record(stored: MarkerRow, epoch: float, kind: dict[str, Any], members: dict[str, Any]) -> dict[str, Any]:
    row = marker_at(stored, epoch)
    note = row.transform_note if row.localization_grade == "unfit" else None
    record = (
        {name: getattr(row, name) for name in _MEMBERS}
        | (row.spec or {})
        | {"code": row.digits, "horizontal_rmse_m": horizontal_rmse_m(row)}
    )
    for name, shift in (("lane_lon_deg", row.lon_deg - stored.lon_deg), ("lane_lat_deg", row.lat_deg - stored.lat_deg)):
        if record.get(name) is not None:
            record[name] += shift
    return record | members | {"kind": kind | {"transform_note": note}}
