"""Registering and changing many markers in one request: each item succeeds or fails by itself, or all together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Literal, TypeAlias, cast

import sqlalchemy as sa
from typing_extensions import TypedDict

from app.errors import InvalidParameter, Unavailable, WaymarkError
from app.families.documents import MarkerIn, WarningDocument
from app.registry.database import Database
from app.services.access.access import Caller
from app.services.idempotency import IdempotencyKey, find_earlier, write_once
from app.services.markers.markers import MarkerChange, Markers, Step
from app.services.markers.plausibility import WarningMode
from app.services.ports import Clock
from app.services.request_work import check_deadline

Mode: TypeAlias = Literal["all", "good"]
ALL: Mode = "all"
GOOD: Mode = "good"
MAX_PARTS = 10_000  # magnets and other markers of the items; one to three seconds of a processor
_CREATED, _UPDATED = 201, 200


class ItemProblem(TypedDict):
    """The error of an item."""

    type: str
    title: str
    status: int
    detail: str
    field: str
    limit: str | None
    cure: str | None


class ItemResult(TypedDict):
    """The result of an item: 201 registered, 200 changed, or the status of its problem."""

    index: int
    status: int
    id: str | None
    version: int | None
    problem: ItemProblem | None
    warnings: list[WarningDocument]


class BulkReport(TypedDict):
    """The results of all items."""

    outcome: Literal["stored", "checked", "refused"]
    dry_run: bool
    mode: Mode
    items: int
    created: int
    updated: int
    refused: int
    results: list[ItemResult]


DescribeError = Callable[[int, WaymarkError], ItemProblem]


@dataclass(frozen=True, slots=True)
class MarkerUpdate:
    """A change of one marker that is still at a version."""

    marker_id: str
    version: int
    change: MarkerChange


Item = MarkerIn | MarkerUpdate | WaymarkError
"""What to do, or why the item cannot be read."""


@dataclass(frozen=True, slots=True)
class BulkInput:
    """Items, and what shall become of them."""

    items: Sequence[Item]
    mode: Mode = ALL
    dry_run: bool = False
    warnings: WarningMode = "store"


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
        self, caller: Caller, given: BulkInput, describe: DescribeError, key: IdempotencyKey | None = None
    ) -> tuple[BulkReport, bool]:
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
        InvalidParameter
            The new markers have too many magnets together.
        Unavailable
            The database is busy; nothing is stored.
        """
        now = self._clock()
        if earlier := find_earlier(self._database, caller.agency_id, key, now):
            return earlier, True
        _check_parts(given.items)
        steps = [self._prepared(caller, item, now, given.warnings) for item in given.items]
        try:
            with write_once(self._database, caller.agency_id, key, now, self._ttl, long=True) as (connection, answer):
                if answer.replayed:
                    return answer.response, True
                results = [_result(connection, k, step, describe) for k, step in enumerate(steps)]
                report = _report(given, results)
                if report["outcome"] != "stored":
                    raise _NotStored
                answer.store(report)
        except _NotStored:
            pass
        return report, False

    def _prepared(
        self, caller: Caller, item: Item, now: datetime, warnings: WarningMode
    ) -> tuple[int, Step | WaymarkError]:
        check_deadline()
        if isinstance(item, WaymarkError):
            return 0, item
        try:
            if isinstance(item, MarkerUpdate):
                step = self._markers.prepare_change(caller, item.marker_id, item.change, item.version, now, warnings)
                return _UPDATED, step
            return _CREATED, self._markers.prepare_new(caller, item, now, warnings)
        except Unavailable:
            raise
        except WaymarkError as error:
            return 0, error


def _check_parts(items: Sequence[Item]) -> None:
    count = sum(item.part_count for item in items if isinstance(item, MarkerIn))
    if count > MAX_PARTS:
        raise InvalidParameter(
            f"the items have about {count} magnets and other markers",
            field="items",
            limit=f"{MAX_PARTS} in one request",
            cure="send them in several requests",
        )


def _result(
    connection: sa.Connection, index: int, prepared: tuple[int, Step | WaymarkError], describe: DescribeError
) -> ItemResult:
    status, step = prepared
    check_deadline()
    try:
        if isinstance(step, WaymarkError):
            raise step
        with connection.begin_nested():
            marker = step(connection)
    except Unavailable:
        raise
    except WaymarkError as error:
        problem = describe(index, error)
        return {
            "index": index,
            "status": problem["status"],
            "id": None,
            "version": None,
            "problem": problem,
            "warnings": [],
        }
    of_code = cast("list[WarningDocument]", marker.get("code_warnings", []))  # which plates alone have
    return {
        "index": index,
        "status": status,
        "id": marker["id"],
        "version": marker["version"],
        "problem": None,
        "warnings": [*marker.get("position_warnings", []), *of_code],
    }


def _report(given: BulkInput, results: list[ItemResult]) -> BulkReport:
    refused = sum(result["problem"] is not None for result in results)
    wanted = refused == 0 or (given.mode == GOOD and refused < len(results))
    outcome: Literal["stored", "checked", "refused"] = "checked" if given.dry_run else "stored" if wanted else "refused"
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
