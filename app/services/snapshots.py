"""Snapshots of an area for vehicles without a connection."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.encoders.snapshot import write_snapshot
from app.errors import InvalidParameter
from app.markers.snapshot import MAX_MARKERS, key_id_of
from app.registry import bulk
from app.registry.database import Database
from app.registry.markers import Row
from app.registry.spatial import Box
from app.services.access import Caller
from app.services.ports import Clock

MAX_HOURS = 24.0 * 366
_PLATE = ("scheme", "check_digits", "n", "unit_mm", "gap_mm", "thickness_mm")


@dataclass(frozen=True, slots=True)
class PublicKey:
    """What vehicles verify snapshots with."""

    key_id: bytes
    public_key: bytes


class Snapshots:
    """Use cases on snapshots.

    Parameters
    ----------
    database : Database
    clock : Clock
    signing_key : callable
        The server's key; asked for at the first use.
    """

    def __init__(self, database: Database, clock: Clock, signing_key: Callable[[], Ed25519PrivateKey]) -> None:
        self._database = database
        self._clock = clock
        self._signing_key = signing_key

    def make(self, caller: Caller, box: Box, hours: float) -> bytes:
        """A signed snapshot of the agency's markers in a box, all but the retired ones.

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
            rows = bulk.list_for_snapshot(connection, caller.agency_id, box, limit=MAX_MARKERS + 1)
        return write_snapshot(
            [_marker(row) for row in rows],
            agency_id=caller.agency_id,
            area_deg=(box.west_deg, box.south_deg, box.east_deg, box.north_deg),
            made_at=now,
            expires_at=now + timedelta(hours=hours),
            key=self._signing_key(),
        )

    def public_key(self) -> PublicKey:
        """The key that this server's snapshots are verified with."""
        public = self._signing_key().public_key().public_bytes_raw()
        return PublicKey(key_id_of(public), public)


def _marker(row: Row) -> dict[str, Any]:
    kind: dict[str, Any] = {}
    if row["family"] == "plate":
        kind = {name: row[name] for name in _PLATE}
    elif row["family"] == "cerpm":
        limit = row["speed_limit_value"]
        speed_limit = None if limit is None else {"value": limit, "unit": row["speed_limit_unit"]}
        kind = {"side": row["side"], "speed_limit": speed_limit}
    return {**row, "code": row["digits"], "kind": kind}
