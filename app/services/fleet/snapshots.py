"""Snapshots of an area for vehicles without a connection."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from datetime import timedelta
from typing import Any

import numpy as np
import orjson
import sqlalchemy as sa
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.encoders.snapshot import Block, kind_text, too_many_markers, write_snapshot
from app.errors import InvalidParameter
from app.families import FAMILIES
from app.families.family import Family
from app.geodesy import LocalizationGrade, decimal_year, move_to_epoch
from app.geodesy.place import GRADE_LIMITS_M
from app.markers.reading import MarkerRow
from app.markers.snapshot import MAX_MARKERS, MAX_VALIDITY, Trust
from app.registry import markers
from app.registry.column_types import row_of
from app.registry.database import Database
from app.registry.markers import CODEBOOKS, book_of
from app.registry.spatial import Box
from app.services.access.access import Caller
from app.services.markers.codebooks import MAX_BOOKS_SEARCHED
from app.services.ports import Clock
from app.services.request_work import check_deadline
from app.values import JsonObject

MAX_HOURS = MAX_VALIDITY / timedelta(hours=1)
_SAME = ("scheme", "check_digits", "n", "unit_mm", "gap_mm", "thickness_mm")
_LANE = ("lane_lon_deg", "lane_lat_deg")


class Snapshots:
    """Use cases on snapshots.

    Parameters
    ----------
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
            books, _ = CODEBOOKS.page(connection, caller.agency_id, limit=MAX_BOOKS_SEARCHED)
            return write_snapshot(
                read_blocks(connection, caller.agency_id, box, decimal_year(now)),
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


def read_blocks(connection: sa.Connection, agency_id: str, box: Box, epoch: float) -> Iterator[Block]:
    """The agency's markers in a box as a snapshot holds them, where they are at an epoch.

    Raises
    ------
    InvalidParameter
        There are more than fit; known before the first is read.
    """
    left = MAX_MARKERS
    for family in FAMILIES:
        found = (connection, agency_id, family.name, box)
        left -= markers.count_for_snapshot(*found, with_retired=family.in_snapshots_when_retired, limit=left + 1)
        if left < 0:
            raise too_many_markers()
    for family in FAMILIES:
        found = (connection, agency_id, family.name, box)
        columns, with_retired = family.snapshot_columns(), family.in_snapshots_when_retired
        known: dict[tuple[object, ...], bytes] = {}
        for block in markers.read_for_snapshot(*found, columns=columns, with_retired=with_retired):
            check_deadline()
            moved = _at_epoch(block, epoch)
            code, kind = block["digits"], _kinds(family, block, moved["localization_grade"].tolist(), known)
            yield {**block, **moved, **family.snapshot_members(connection, agency_id, code), "code": code, "kind": kind}


def _at_epoch(block: Block, epoch: float) -> JsonObject:
    """Columns of a block that change with the position, as `matching.marker_at` moves it to an epoch."""
    names = ("lon_deg", "lat_deg", "epoch", "transform_accuracy_m", "horizontal_rmse_m")
    lon, lat, stated, frame_m, survey_m = (np.array(block[name], dtype=np.float64) for name in names)
    moves = np.isfinite(stated) & np.isfinite(frame_m)
    moved = move_to_epoch(lon[moves], lat[moves], stated[moves], epoch)
    shift = {"lon_deg": moved.lon_deg - lon[moves], "lat_deg": moved.lat_deg - lat[moves]}
    lon[moves], lat[moves] = moved.lon_deg, moved.lat_deg
    frame_m[moves] = np.hypot(frame_m[moves], moved.accuracy_m)
    total_m = np.hypot(survey_m, np.nan_to_num(frame_m))
    fit = np.array(block["localization_grade"]) != LocalizationGrade.UNFIT
    fit[moves] = total_m[moves] < GRADE_LIMITS_M[LocalizationGrade.M]
    found: JsonObject = {"lon_deg": lon, "lat_deg": lat, "horizontal_rmse_m": total_m}
    found["localization_grade"] = np.where(fit, "fit", LocalizationGrade.UNFIT)
    for name, shift_deg in shift.items():
        if f"lane_{name}" in block:
            start = np.array(block[f"lane_{name}"], dtype=np.float64)
            start[moves] += shift_deg
            found[f"lane_{name}"] = start
    return found


def _kinds(
    family: Family[Any, Any], block: Block, grades: Sequence[str], known: dict[tuple[object, ...], bytes]
) -> list[bytes]:
    """The kind of each marker of a block, as it is in snapshots, made once for all markers that are `known` by it."""
    spec = [name for name in block if name not in markers.SNAPSHOT_COLUMNS and name not in _LANE]
    notes = [
        note if grade == LocalizationGrade.UNFIT else None
        for note, grade in zip(block["transform_note"], grades, strict=True)
    ]
    columns = [*(block[name] for name in _SAME), *(map(_hashable, block[name]) for name in spec), notes]
    found = []
    for k, key in enumerate(zip(*columns, strict=True)):
        if (text := known.get(key)) is None:
            values = {name: block[name][k] for name in (*_SAME, *spec)}
            row = row_of(MarkerRow, {**values, "spec": values.get("spec", values)})
            text = known[key] = kind_text(family.name, family.snapshot_kind(row) | {"transform_note": notes[k]})
        found.append(text)
    return found


def _hashable(value: object) -> object:
    return orjson.dumps(value) if isinstance(value, dict | list) else value
