"""Roads: registered with an axis and a calibration, changed by versions, and asked for measures and positions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime, timedelta
from itertools import islice

import sqlalchemy as sa

from app.errors import InvalidParameter
from app.families.documents import MarkerDocument
from app.geodesy import check_lon_lat
from app.markers.reading import MarkerRow
from app.registry import roads as store
from app.registry.audit import recording
from app.registry.column_types import row_of
from app.registry.database import Database
from app.registry.resources import first_version
from app.registry.roads import ROAD_SUMMARIES, ROADS, RoadRow
from app.services.access.access import Caller
from app.services.access.audit import author_of, log_change
from app.services.documents import VersionKind, document_of
from app.services.idempotency import IdempotencyKey, find_earlier, write_once
from app.services.markers.searches import marker_document
from app.services.ports import Clock
from app.services.roads.documents import (
    AnyLine,
    AxisIn,
    ChangedRoad,
    MeasuredMarkers,
    OnRoad,
    RoadDocument,
    RoadIn,
    RoadLocatedMany,
    RoadPage,
    RoadPatch,
    RoadPlacedMany,
    RoadVersionDocument,
    RoadVersionPage,
    Route,
    StationIn,
    build_route,
    located_position,
    place_lines,
    placed_reference,
    references_of,
    resolve_calibration,
    road_document,
    road_summary,
    route_of,
    sections,
)

MAX_NAMED = 100
_SAME_M = 5e-5

Range = tuple[float | None, float | None]
Measured = tuple[Mapping[str, object], Route]


class _NotStored(Exception):
    """Ends a transaction whose changes shall not stay."""


class Roads:
    """Use cases on roads, one transaction each.

    Parameters
    ----------
    crs_accuracy_m : float
        Worst stated accuracy of a transformation that is used. [m]
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

    def register(self, caller: Caller, new: RoadIn, key: IdempotencyKey | None = None) -> tuple[ChangedRoad, bool]:
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
        if earlier := find_earlier(self._database, caller.agency_id, key, now):
            return earlier, True
        columns, route = self._columns(new, new.geometry, new.calibration)
        try:
            with write_once(self._database, caller.agency_id, key, now, self._ttl, long=True) as (connection, answer):
                if answer.replayed:
                    return answer.response, True
                ROADS.check_name(connection, caller.agency_id, new.name)
                values = {**columns, **first_version(now), "name": new.name}
                row = ROADS.add(connection, caller.agency_id, values, who=caller.label, why=new.reason)
                document: ChangedRoad = {**road_document(row), "markers": None}
                if new.measure_markers:
                    document["markers"] = _measure(connection, caller, row, route, None, now, new.reason)
                log_change(connection, caller, "road.registered", now=now, subject=row.id, document=document)
                if new.dry_run:
                    raise _NotStored
                answer.store(document)
        except _NotStored:
            document["id"] = None
        return document, False

    def change(self, caller: Caller, road_id: str, change: RoadPatch, version: int | None) -> ChangedRoad:
        """Change a road that is still at `version`, and measure its markers again: their positions stay.

        Raises
        ------
        StaleVersion
            The road was changed since the caller read it.
        InvalidParameter, ReferenceSystemError
            The lines or the calibration cannot be, or lines come without their calibration.
        """
        now = self._clock()
        try:
            with self._database.write(long=True) as connection:
                row = ROADS.get_at(connection, caller.agency_id, road_id, version)
                old = route_of(row)
                columns, route = self._changed(row, change)
                at, who, why = row.version, caller.label, change.reason
                changed = ROADS.update(
                    connection, caller.agency_id, road_id, columns, version=at, now=now, who=who, why=why
                )
                document: ChangedRoad = {**road_document(changed), "markers": None}
                if change.measure_markers:
                    document["markers"] = _measure(connection, caller, changed, route, old, now, change.reason)
                log_change(connection, caller, "road.changed", now=now, subject=road_id, document=document)
                if change.dry_run:
                    raise _NotStored
        except _NotStored:
            pass
        return document

    def get(self, caller: Caller, road_id: str) -> RoadDocument:
        """One road."""
        with self._database.read() as connection:
            return road_document(ROADS.get(connection, caller.agency_id, road_id))

    def page(
        self, caller: Caller, *, name: str | None = None, after: str | None = None, limit: int = 100
    ) -> tuple[RoadPage, str | None]:
        """A page of roads without their geometry, and the id to continue after."""
        with self._database.read() as connection:
            rows, last = ROAD_SUMMARIES.page(connection, caller.agency_id, beyond=after, limit=limit, name=name)
        return RoadPage(items=[road_summary(row) for row in rows]), last

    def history(
        self, caller: Caller, road_id: str, *, after: int = 0, limit: int = 100
    ) -> tuple[RoadVersionPage, int | None]:
        """A page of a road's versions, oldest first, and the version to continue after."""
        with self._database.read() as connection:
            rows, last = ROADS.history(connection, caller.agency_id, road_id, after=after, limit=limit)
        items = [document_of(RoadVersionDocument, row, road=road_document(row_of(RoadRow, row.stored))) for row in rows]
        return {"items": items}, last

    def locate(
        self,
        caller: Caller,
        road_id: str,
        positions: Sequence[tuple[float, float]],
        reach_m: float,
        version: int | None = None,
    ) -> RoadLocatedMany:
        """Measures and offsets of positions (lon_deg, lat_deg); several feet where the road passes more than once.

        Raises
        ------
        InvalidParameter
            A position out of range, or too many edges of the road near the positions.
        """
        for position in positions:
            check_lon_lat(*position)
        head, route = self._route(caller, road_id, version)
        try:
            feet = route.feet(positions, reach_m)
        except InvalidParameter as error:
            error.field = "positions"
            raise
        return {**head, "items": [located_position(route, found) for found in feet]}

    def place(
        self,
        caller: Caller,
        road_id: str,
        references: Sequence[tuple[float, float]],
        version: int | None = None,
    ) -> RoadPlacedMany:
        """Positions of (measure_m, offset_m); none where the measure is on no road, several where it repeats."""
        head, route = self._route(caller, road_id, version)
        return {**head, "items": [placed_reference(route, *reference) for reference in references]}

    def markers(
        self,
        caller: Caller,
        road_id: str,
        *,
        measures_m: Range = (None, None),
        offsets_m: Range = (None, None),
        section: int | None = None,
        after: tuple[int, tuple[float, str] | None] = (0, None),
        limit: int = 100,
    ) -> tuple[list[MarkerDocument], str | None]:
        """A page of the markers along a road, section by section in the order of their measures, and where it ended.

        Parameters
        ----------
        section : int, optional
            Only those of one section, from 0.
        after : tuple
            Section, and measure and id there, where the page before ended.

        Raises
        ------
        InvalidParameter
            There is no such section.
        """
        rows: list[tuple[int, MarkerRow]] = []
        with self._database.read() as connection:
            road = ROADS.get(connection, caller.agency_id, road_id)
            ranges = route_of(road).section_ranges_m()
            if section is not None and section >= len(ranges):
                raise InvalidParameter(
                    f"there is no section {section}",
                    field="section",
                    limit=f"0 to {len(ranges) - 1}",
                    cure="GET the road: it lists its sections",
                )
            for number in range(after[0], len(ranges)) if section is None else [section]:
                found = _on_section(connection, caller.agency_id, road, number, measures_m, offsets_m, after, limit)
                rows += [(number, row) for row in islice(found, limit + 1 - len(rows))]
        page = [marker_document(row) for _, row in rows[:limit]]
        last = f"{rows[limit - 1][0]};{page[-1]['measure_m']!r},{page[-1]['id']}" if len(rows) > limit else None
        return page, last

    # --- steps ------------------------------------------------------------------------------------------------------

    def _route(self, caller: Caller, road_id: str, version: int | None) -> tuple[OnRoad, Route]:
        with self._database.read() as connection:
            row = ROADS.get(connection, caller.agency_id, road_id)
            if version is not None and version != row.version:
                row = row_of(RoadRow, ROADS.get_version(connection, caller.agency_id, road_id, version).stored)
        route = route_of(row)
        return {"road_id": road_id, "road": row.name, "version": row.version, "sections": sections(route)}, route

    def _columns(self, axis: AxisIn, geometry: AnyLine, stations: Sequence[StationIn]) -> Measured:
        placed = place_lines(geometry, axis, self._accuracy_m)
        points = resolve_calibration(build_route(placed.parts, ()).axis, axis, stations, self._accuracy_m)
        route = build_route(placed.parts, points)
        columns = {
            "parts": placed.parts,
            "given": {
                "crs": placed.crs,
                "realization": placed.realization,
                "epoch": placed.epoch,
                "transform_accuracy_m": placed.transform_accuracy_m,
                "declared_realization": axis.realization,
                "declared_epoch": axis.epoch,
                "several": geometry.type == "MultiLineString",
            },
            "calibration": [asdict(point) for point in points],
            "localization_grade": placed.grade,
            "transform_note": placed.note,
            **_extent(route),
        }
        return columns, route

    def _changed(self, row: RoadRow, change: RoadPatch) -> Measured:
        if change.geometry is not None:
            if change.calibration is None and row.calibration:
                raise InvalidParameter(
                    "a new geometry comes with its calibration",
                    field="calibration",
                    limit="the calibration points on the new geometry, or []",
                    cure="send calibration; [] for true metres from 0",
                )
            return self._columns(change, change.geometry, change.calibration or ())
        if change.calibration is None:
            return {}, route_of(row)
        frame = row.given
        axis = AxisIn(
            crs=frame["crs"],
            realization=frame.get("declared_realization"),
            epoch=frame.get("declared_epoch", frame["epoch"]),
        )
        points = resolve_calibration(route_of(row).axis, axis, change.calibration, self._accuracy_m)
        route = build_route(row.parts, points)
        return {"calibration": [asdict(point) for point in points], **_extent(route)}, route


def _extent(route: Route) -> dict[str, float]:
    sections = route.measures.sections
    return {
        "length_m": route.axis.length_m,
        "from_m": min(float(section.measures_m[0]) for section in sections),
        "to_m": max(float(section.measures_m[-1]) for section in sections),
    }


def _measure(
    connection: sa.Connection,
    caller: Caller,
    road: RoadRow,
    route: Route,
    old: Route | None,
    now: datetime,
    reason: str | None,
) -> MeasuredMarkers:
    """Measure every marker that names the road: a version of each whose measure or offset changes."""
    report: MeasuredMarkers = {"measured": 0, "unchanged": 0, "left": 0, "largest_change_m": 0.0, "left_out": []}
    why = f"measured on version {road.version} of road {road.name}" + (f": {reason}" if reason else "")
    with recording(connection, caller.agency_id, author_of(caller), "road.measured", now=now, subject=road.id) as entry:
        for rows in store.walk_named(connection, caller.agency_id, road.name):
            positions = [(row.lon_deg, row.lat_deg) for row in rows]
            references = references_of(route, positions, [row.measure_m for row in rows], old)
            changed, values = [], []
            for row, reference in zip(rows, references, strict=True):
                if reference.measure_m is None or reference.offset_m is None:
                    report["left"] += 1
                    if len(report["left_out"]) < MAX_NAMED:
                        report["left_out"].append({"marker_id": row.id, "why": reference.why_not})
                    continue
                if _is_same(row, reference.measure_m, reference.offset_m):
                    report["unchanged"] += 1
                    continue
                if row.measure_m is not None:
                    moved_m = abs(row.measure_m - reference.measure_m)
                    report["largest_change_m"] = max(report["largest_change_m"], moved_m)
                changed.append(row)
                values.append((reference.measure_m, reference.offset_m))
            report["measured"] += len(changed)
            store.remeasure(connection, entry, changed, values, kind=VersionKind.CHANGE, why=why[:500])
    return report


def _is_same(row: MarkerRow, measure_m: float, offset_m: float) -> bool:
    if row.measure_m is None or row.offset_m is None:
        return False
    return bool(abs(row.measure_m - measure_m) < _SAME_M and abs(row.offset_m - offset_m) < _SAME_M)


def _on_section(
    connection: sa.Connection,
    agency_id: str,
    road: RoadRow,
    number: int,
    measures_m: Range,
    offsets_m: Range,
    after: tuple[int, tuple[float, str] | None],
    at_once: int,
) -> Iterator[MarkerRow]:
    """Markers of one section in the order of their measures; where a measure repeats, the position decides."""
    route = route_of(road)
    ranges = route.section_ranges_m()
    low_m, high_m = ranges[number]
    bounds = (
        max(low_m, -math.inf if measures_m[0] is None else measures_m[0]),
        min(high_m, math.inf if measures_m[1] is None else measures_m[1]),
    )
    low, high = (bound if math.isfinite(bound) else None for bound in bounds)
    place = after[1] if number == after[0] else None
    while bounds[0] <= bounds[1]:
        rows = store.list_on_road(
            connection,
            agency_id,
            road.name,
            measures_m=(low, high),
            offsets_m=offsets_m,
            after=place,
            limit=at_once + 1,
        )
        measures = [row.measure_m or 0.0 for row in rows]
        found = route.sections_of([(row.lon_deg, row.lat_deg) for row in rows], measures)
        yield from (row for row, section in zip(rows, found, strict=True) if section == number)
        if len(rows) <= at_once:
            return
        place = measures[-1], rows[-1].id
