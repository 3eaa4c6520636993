"""Registering and changing many markers in one request: each item succeeds or fails by itself, or all together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import sqlalchemy as sa

from app.errors import Unavailable, WaymarkError
from app.registry.database import Database
from app.services.access import Caller
from app.services.cerpm_markers import NewCerpm
from app.services.idempotency import IdempotencyKey, find_answer, keep_answer
from app.services.magnet_markers import NewMagnets
from app.services.markers import MarkerChange, Markers, Step
from app.services.plate_markers import NewPlate
from app.services.ports import Clock

ALL, GOOD = "all", "good"
_CREATED, _UPDATED = 201, 200

Problem = dict[str, Any]
DescribeError = Callable[[int, WaymarkError], Problem]


@dataclass(frozen=True, slots=True)
class MarkerUpdate:
    """A change of one marker that is still at a version."""

    marker_id: str
    version: int
    change: MarkerChange


Item = NewPlate | NewMagnets | NewCerpm | MarkerUpdate | WaymarkError
"""What to do, or why the item cannot be read."""


@dataclass(frozen=True, slots=True)
class GivenBulk:
    """Items, and what shall become of them."""

    items: Sequence[Item]
    mode: str = ALL
    dry_run: bool = False


class _NotStored(Exception):
    """Ends a transaction whose changes shall not stay."""


class BulkMarkers:
    """The use case: one transaction, in which each item has a savepoint of its own."""

    def __init__(self, database: Database, clock: Clock, markers: Markers, idempotency_ttl: timedelta) -> None:
        self._database = database
        self._clock = clock
        self._markers = markers
        self._ttl = idempotency_ttl

    def run(
        self, caller: Caller, given: GivenBulk, describe: DescribeError, key: IdempotencyKey | None = None
    ) -> tuple[dict[str, Any], bool]:
        """Do what the items say.

        Parameters
        ----------
        describe : callable
            The problem document of an item's error, from its index and the error.

        Returns
        -------
        report : dict
            `outcome` is ``stored``, ``checked`` (dry run) or ``refused``: then nothing is stored.
        replayed : bool
            The request had been made before under the same Idempotency-Key.

        Raises
        ------
        Unavailable
            The database is busy; nothing is stored.
        """
        now = self._clock()
        with self._database.read() as connection:
            if (answer := find_answer(connection, caller.agency_id, key, now)) is not None:
                return answer, True
        steps = [self._prepared(caller, item, now) for item in given.items]
        report: dict[str, Any] = {}
        try:
            with self._database.write(long=True) as connection:
                if (answer := find_answer(connection, caller.agency_id, key, now)) is not None:
                    return answer, True
                results = [_result(connection, k, step, describe) for k, step in enumerate(steps)]
                report = _report(given, results)
                if report["outcome"] != "stored":
                    raise _NotStored
                keep_answer(connection, caller.agency_id, key, report, now, self._ttl)
        except _NotStored:
            pass
        return report, False

    def _prepared(self, caller: Caller, item: Item, now: datetime) -> tuple[int, Step | WaymarkError]:
        if isinstance(item, WaymarkError):
            return 0, item
        try:
            if isinstance(item, MarkerUpdate):
                return _UPDATED, self._markers.prepare_change(caller, item.marker_id, item.change, item.version, now)
            return _CREATED, self._markers.prepare_new(caller, item, now)
        except Unavailable:
            raise
        except WaymarkError as error:
            return 0, error


def _result(
    connection: sa.Connection, index: int, prepared: tuple[int, Step | WaymarkError], describe: DescribeError
) -> dict[str, Any]:
    status, step = prepared
    try:
        if isinstance(step, WaymarkError):
            raise step
        with connection.begin_nested():
            marker = step(connection)
    except Unavailable:
        raise
    except WaymarkError as error:
        problem = describe(index, error)
        return {"index": index, "status": problem["status"], "id": None, "version": None, "problem": problem}
    return {"index": index, "status": status, "id": marker["id"], "version": marker["version"], "problem": None}


def _report(given: GivenBulk, results: list[dict[str, Any]]) -> dict[str, Any]:
    refused = sum(result["problem"] is not None for result in results)
    wanted = refused == 0 or (given.mode == GOOD and refused < len(results))
    outcome = "checked" if given.dry_run else "stored" if wanted else "refused"
    if outcome != "stored":  # what these ids name is not there
        for result in results:
            if result["status"] == _CREATED:
                result["id"] = None
    return {
        "outcome": outcome,
        "dry_run": given.dry_run,
        "mode": given.mode,
        "items": len(results),
        "created": sum(result["status"] == _CREATED for result in results),
        "updated": sum(result["status"] == _UPDATED for result in results),
        "refused": refused,
        "results": results,
    }
