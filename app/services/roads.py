"""Roads: registered with an axis and a calibration, changed by versions, and asked for measures and positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from typing import Any

import sqlalchemy as sa

from app.errors import Conflict, InvalidParameter, StaleVersion
from app.geodesy import check_lon_lat
from app.registry import roads as store
from app.registry.audit import recording
from app.registry.database import Database
from app.registry.ids import new_id
from app.registry.roads import Row
from app.services.access import Caller
from app.services.audit import author_of, log_change
from app.services.idempotency import IdempotencyKey, find_answer, keep_answer
from app.services.ports import Clock
from app.services.road_documents import road_document, road_summary, sections_document
from app.services.road_given import GivenCalibration, GivenLines, place_lines, settle_calibration
from app.services.road_routes import (
    Route,
    build_route,
    feet_document,
    places_document,
    references_of,
    route_of,
)
from app.services.searches import marker_document
from app.services.version_kinds import VersionKind

MAX_NAMED = 100
_SAME_M = 5e-5

Range = tuple[float | None, float | None]
Measured = tuple[dict[str, Any], Route]


@dataclass(frozen=True, slots=True)
class NewRoad:
    """A road to register."""

    name: str
    lines: GivenLines
    calibration: tuple[GivenCalibration, ...] = ()
    measure_markers: bool = True
    dry_run: bool = False
    reason: str | None = None


@dataclass(frozen=True, slots=True)
class RoadChange:
    """What to change; None stays."""

    lines: GivenLines | None = None
    calibration: tuple[GivenCalibration, ...] | None = None
    measure_markers: bool = True
    dry_run: bool = False
    reason: str | None = None


class _NotStored(Exception):
    """Ends a transaction whose changes shall not stay."""


class Roads:
    """Use cases on roads, one transaction each.

    Parameters
    ----------
    database : Database
    clock : Clock
    crs_accuracy_m : float
        Worst stated accuracy of a transformation that counts as exact. [m]
    idempotency_ttl : timedelta
    """

    def __init__(
        self,
        database: Database,
        clock: Clock,
        crs_accuracy_m: float = 0.1,
        idempotency_ttl: timedelta = timedelta(hours=24),
    ) -> None:
        self._database = database
        self._clock = clock
        self._accuracy_m = crs_accuracy_m
        self._ttl = idempotency_ttl

    def register(self, caller: Caller, new: NewRoad, key: IdempotencyKey | None = None) -> tuple[dict[str, Any], bool]:
        """Store a new road, and measure the markers that name it.

        Returns
        -------
        road : dict
            With what became of the markers.
        replayed : bool

        Raises
        ------
        InvalidParameter, ReferenceSystemError
            The lines or the calibration cannot be.
        Conflict
            The agency has a road of this name.
        """
        now = self._clock()
        with self._database.read() as connection:
            if (answer := find_answer(connection, caller.agency_id, key, now)) is not None:
                return answer, True
        columns, route = self._columns(new.lines, new.calibration)
        document: dict[str, Any] = {}
        try:
            with self._database.write(long=True) as connection:
                if (answer := find_answer(connection, caller.agency_id, key, now)) is not None:
                    return answer, True
                _check_name(connection, caller, new.name)
                values = {"id": new_id(now), "name": new.name, "version": 1, "created_at": now, "updated_at": now}
                row = store.add_road(
                    connection, caller.agency_id, {**columns, **values}, who=caller.label, why=new.reason
                )
                document = road_document(row) | {"markers": None}
                if new.measure_markers:
                    document["markers"] = _measure(connection, caller, row, route, None, now, new.reason)
                log_change(connection, caller, "road.registered", now=now, subject=row["id"], document=document)
                if new.dry_run:
                    raise _NotStored
                keep_answer(connection, caller.agency_id, key, document, now, self._ttl)
        except _NotStored:
            document["id"] = None
        return document, False

    def change(self, caller: Caller, road_id: str, change: RoadChange, version: int | None) -> dict[str, Any]:
        """Change a road that is still at `version`, and measure its markers again: their positions stay.

        Raises
        ------
        StaleVersion
            The road was changed since the caller read it.
        InvalidParameter, ReferenceSystemError
            The lines or the calibration cannot be, or lines come without their calibration.
        """
        now = self._clock()
        document: dict[str, Any] = {}
        try:
            with self._database.write(long=True) as connection:
                row = store.get_road(connection, caller.agency_id, road_id)
                _check_version(row, version)
                old = route_of(row)
                columns, route = self._changed(row, change)
                changed = store.update_road(
                    connection,
                    caller.agency_id,
                    road_id,
                    {**columns, "updated_at": now},
                    version=row["version"],
                    who=caller.label,
                    why=change.reason,
                )
                document = road_document(changed) | {"markers": None}
                if change.measure_markers:
                    document["markers"] = _measure(connection, caller, changed, route, old, now, change.reason)
                log_change(connection, caller, "road.changed", now=now, subject=road_id, document=document)
                if change.dry_run:
                    raise _NotStored
        except _NotStored:
            pass
        return document

    def get(self, caller: Caller, road_id: str) -> dict[str, Any]:
        """One road."""
        with self._database.read() as connection:
            return road_document(store.get_road(connection, caller.agency_id, road_id))

    def page(
        self, caller: Caller, *, name: str | None = None, after: str | None = None, limit: int = 100
    ) -> tuple[list[dict[str, Any]], str | None]:
        """A page of roads without their geometry, and the id to continue after."""
        with self._database.read() as connection:
            rows = store.list_roads(connection, caller.agency_id, name=name, after=after, limit=limit + 1)
        page = [road_summary(row) for row in rows[:limit]]
        return page, page[-1]["id"] if len(rows) > limit else None

    def history(
        self, caller: Caller, road_id: str, *, after: int = 0, limit: int = 100
    ) -> tuple[list[dict[str, Any]], int | None]:
        """A page of a road's versions, oldest first, and the version to continue after."""
        with self._database.read() as connection:
            store.get_road(connection, caller.agency_id, road_id)
            rows = store.list_versions(connection, caller.agency_id, road_id, after=after, limit=limit + 1)
        page = [
            {**{name: row[name] for name in ("version", "at", "who", "why")}, "road": road_document(row["road"])}
            for row in rows[:limit]
        ]
        return page, page[-1]["version"] if len(rows) > limit else None

    def locate(
        self,
        caller: Caller,
        road_id: str,
        positions: Sequence[tuple[float, float]],
        reach_m: float,
        version: int | None = None,
    ) -> dict[str, Any]:
        """Measures and offsets of positions (lon_deg, lat_deg); several feet where the road passes more than once."""
        for position in positions:
            check_lon_lat(*position)
        head, route = self._route(caller, road_id, version)
        items = [feet_document(route, feet) for feet in route.feet(positions, reach_m)]
        return {**head, "items": items}

    def place(
        self,
        caller: Caller,
        road_id: str,
        references: Sequence[tuple[float, float]],
        version: int | None = None,
    ) -> dict[str, Any]:
        """Positions of (measure_m, offset_m); none where the measure is on no road, several where it repeats."""
        head, route = self._route(caller, road_id, version)
        return {**head, "items": [places_document(route, *reference) for reference in references]}

    def markers(
        self,
        caller: Caller,
        road_id: str,
        *,
        measures_m: Range = (None, None),
        offsets_m: Range = (None, None),
        after: tuple[float, str] | None = None,
        limit: int = 100,
    ) -> tuple[list[dict[str, Any]], str | None]:
        """A page of the markers on a road in the order of their measures, and where it ended."""
        with self._database.read() as connection:
            road = store.get_road(connection, caller.agency_id, road_id)["name"]
            rows = store.list_on_road(
                connection,
                caller.agency_id,
                road,
                measures_m=measures_m,
                offsets_m=offsets_m,
                after=after,
                limit=limit + 1,
            )
        page = [marker_document(row) for row in rows[:limit]]
        return page, f"{page[-1]['measure_m']!r},{page[-1]['id']}" if len(rows) > limit else None

    # --- steps ------------------------------------------------------------------------------------------------------

    def _route(self, caller: Caller, road_id: str, version: int | None) -> Measured:
        with self._database.read() as connection:
            row: Any = store.get_road(connection, caller.agency_id, road_id)
            if version is not None and version != row["version"]:
                row = store.get_version(connection, caller.agency_id, road_id, version)
        route = route_of(row)
        return {"road_id": road_id, "road": row["name"], "version": row["version"], **sections_document(route)}, route

    def _columns(self, lines: GivenLines, given: Sequence[GivenCalibration]) -> Measured:
        placed = place_lines(lines, self._accuracy_m)
        points = settle_calibration(build_route(placed.parts, ()).axis, lines, given, self._accuracy_m)
        route = build_route(placed.parts, points)
        columns = {
            "parts": placed.parts,
            "given": {
                "crs": placed.crs,
                "realization": placed.realization,
                "epoch": lines.epoch,
                "several": lines.several,
            },
            "calibration": [asdict(point) for point in points],
            "localization_grade": placed.grade,
            "transform_note": placed.note,
            **_extent(route),
        }
        return columns, route

    def _changed(self, row: Row, change: RoadChange) -> Measured:
        if change.lines is not None:
            if change.calibration is None and row["calibration"]:
                raise InvalidParameter(
                    "a new geometry comes with its calibration",
                    field="calibration",
                    limit="the calibration points on the new geometry, or []",
                    cure="send calibration; [] for true metres from 0",
                )
            return self._columns(change.lines, change.calibration or ())
        if change.calibration is None:
            return {}, route_of(row)
        lines = GivenLines((), crs=row["given"]["crs"], epoch=row["given"]["epoch"])
        points = settle_calibration(route_of(row).axis, lines, change.calibration, self._accuracy_m)
        route = build_route(row["parts"], points)
        return {"calibration": [asdict(point) for point in points], **_extent(route)}, route


def _extent(route: Route) -> dict[str, float]:
    sections = route.measures.sections
    return {
        "length_m": route.axis.length_m,
        "from_m": min(float(section.measures_m[0]) for section in sections),
        "to_m": max(float(section.measures_m[-1]) for section in sections),
    }


def _check_version(row: Row, version: int | None) -> None:
    if version is not None and row["version"] != version:
        raise StaleVersion(
            f"road {row['id']} is at version {row['version']}, the change is based on version {version}",
            field="If-Match",
            limit=f'"{row["version"]}"',
            cure="read the road again and repeat the change on what it is now",
        )


def _check_name(connection: sa.Connection, caller: Caller, name: str) -> None:
    other = store.find_road(connection, caller.agency_id, name)
    if other is not None:
        raise Conflict(
            f"road {other['id']} has this name",
            field="name",
            limit="each name once in an agency",
            cure="change that road, or choose another name",
        )


def _measure(
    connection: sa.Connection,
    caller: Caller,
    road: Row,
    route: Route,
    old: Route | None,
    now: datetime,
    reason: str | None,
) -> dict[str, Any]:
    """Measure every marker that names the road: a version of each whose measure or offset changes."""
    report: dict[str, Any] = {"measured": 0, "unchanged": 0, "left": 0, "largest_change_m": 0.0, "left_out": []}
    why = f"measured on version {road['version']} of road {road['name']}" + (f": {reason}" if reason else "")
    with recording(
        connection, caller.agency_id, author_of(caller), "road.measured", now=now, subject=road["id"]
    ) as entry:
        for rows in store.walk_named(connection, caller.agency_id, road["name"]):
            positions = [(row["lon_deg"], row["lat_deg"]) for row in rows]
            references = references_of(route, positions, [row["measure_m"] for row in rows], old)
            changed, values = [], []
            for row, reference in zip(rows, references, strict=True):
                if reference.measure_m is None or reference.offset_m is None:
                    report["left"] += 1
                    if len(report["left_out"]) < MAX_NAMED:
                        report["left_out"].append({"marker_id": row["id"], "why": reference.why_not})
                    continue
                if _is_same(row, reference.measure_m, reference.offset_m):
                    report["unchanged"] += 1
                    continue
                if row["measure_m"] is not None:
                    moved_m = abs(row["measure_m"] - reference.measure_m)
                    report["largest_change_m"] = max(report["largest_change_m"], moved_m)
                changed.append(row)
                values.append((reference.measure_m, reference.offset_m))
            report["measured"] += len(changed)
            store.remeasure(connection, entry, changed, values, kind=VersionKind.CHANGE, why=why[:500])
    return report


def _is_same(row: Row, measure_m: float, offset_m: float) -> bool:
    if row["measure_m"] is None or row["offset_m"] is None:
        return False
    return bool(abs(row["measure_m"] - measure_m) < _SAME_M and abs(row["offset_m"] - offset_m) < _SAME_M)
