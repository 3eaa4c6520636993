"""Snapshots of an area for vehicles without a connection."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import sqlalchemy as sa
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.encoders.snapshot import write_snapshot
from app.errors import InvalidParameter
from app.geodesy import LocalizationGrade
from app.markers.snapshot import FAMILIES, MAX_MARKERS, key_id_of
from app.registry import bulk, cerpms, codebooks
from app.registry.database import Database
from app.registry.markers import Row
from app.registry.spatial import Box
from app.services.access import Caller
from app.services.codebook_documents import MAX_BOOKS_SEARCHED, book_of
from app.services.fixes import horizontal_rmse_m
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
            markers = list_markers(connection, caller.agency_id, box)
            books = codebooks.list_codebooks(connection, caller.agency_id, after=None, limit=MAX_BOOKS_SEARCHED)
        return write_snapshot(
            markers,
            agency_id=caller.agency_id,
            area_deg=(box.west_deg, box.south_deg, box.east_deg, box.north_deg),
            made_at=now,
            expires_at=now + timedelta(hours=hours),
            key=self._signing_key(),
            codebooks=[book_of(row).to_document() for row in books],
        )

    def public_key(self) -> PublicKey:
        """The key that this server's snapshots are verified with."""
        public = self._signing_key().public_key().public_bytes_raw()
        return PublicKey(key_id_of(public), public)


def list_markers(connection: sa.Connection, agency_id: str, box: Box) -> list[dict[str, Any]]:
    """The agency's markers in a box as a snapshot holds them, in the order of their ids; one too many tells of more."""
    rows: list[Row] = []
    for family in FAMILIES:
        left = MAX_MARKERS + 1 - len(rows)
        rows += bulk.list_for_snapshot(connection, agency_id, family, box, limit=left) if left > 0 else []
    numbers = [int(row["digits"]) for row in rows if row["family"] == "cerpm"] if len(rows) <= MAX_MARKERS else []
    heard = cerpms.list_span_ends(connection, agency_id, numbers)
    rows.sort(key=lambda row: str(row["id"]))
    return [_marker(row, heard) for row in rows]


def _marker(row: Row, heard: Mapping[int, Row]) -> dict[str, Any]:
    marker = {**row, "code": row["digits"], "horizontal_rmse_m": horizontal_rmse_m(row)}
    kind: dict[str, Any] = {}
    if row["family"] == "plate":
        kind = {name: row[name] for name in _PLATE}
    elif row["family"] == "magnet":
        kind = {"scheme": row["scheme"], "meaning": row["meaning"]}
    else:
        least_interval_s = row["interval_s"] * (1 - row["jitter_share"])
        kind = {"side": row["side"], "speed_limit": row["speed_limit"], "least_interval_s": least_interval_s}
        marker |= heard.get(int(row["digits"]), {})
    note = None if row["localization_grade"] == LocalizationGrade.EXACT else row["transform_note"]
    return {**marker, "kind": {**kind, "transform_note": note}}
