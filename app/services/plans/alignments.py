"""Alignments: roads that plans are made for, kept as the files that they came as."""

from __future__ import annotations

from dataclasses import fields
from datetime import timedelta

import sqlalchemy as sa
from pydantic import TypeAdapter

from app.errors import InvalidParameter
from app.formats.alignments.geometry import AlignmentDeclaration
from app.formats.alignments.read import RegisteredRoad, RoadLanes, write_registered_road
from app.formats.format import SpooledFile
from app.geodesy import LocalizationGrade
from app.registry.database import Database
from app.registry.markers import MarkerFilter, is_any_near
from app.registry.plan_features import add_lanes
from app.registry.plans import ALIGNMENTS, AlignmentRow, list_for_map
from app.registry.resources import first_version
from app.registry.roads import ROADS, RoadRow
from app.registry.spatial import Box
from app.roads.lane_line import CalibrationPoint
from app.services.access.access import Caller
from app.services.access.audit import log_change
from app.services.blobs import staged
from app.services.documents import document_of
from app.services.idempotency import IdempotencyKey, find_earlier, idempotent
from app.services.plans.documents import AlignmentDocument, AlignmentPage, AlignmentProfile, RoadSummary
from app.services.plans.tasks import MapForm, RoadFile, profile_road, summarize_road, write_map
from app.services.ports import Blobs, Clock, DecoderProcesses
from app.surveys.location_checks import KNOWN_M

BUSY_WAIT_S = 10.0
"""How long a request waits for a decoder process. [s] As imports."""
MAX_MAP_MARKERS = 50_000
"""Markers around a road that a map is chosen from. Bounds the memory."""
_LON_LAT = ("OGC:CRS84", "EPSG:4326")
"""Reference systems without an area of use that would show exchanged coordinates."""
_DECLARED = tuple(field.name for field in fields(AlignmentDeclaration))
_DECLARATION = TypeAdapter(AlignmentDeclaration)


class Alignments:
    """Use cases on alignments.

    Parameters
    ----------
    accuracy_m : float
        Worst stated accuracy of a transformation that is used. [m]
    """

    def __init__(
        self, database: Database, clock: Clock, blobs: Blobs, processes: DecoderProcesses,
        *, accuracy_m: float, idempotency_ttl: timedelta = timedelta(hours=24),
    ) -> None:  # fmt: skip
        self._database, self._clock, self._blobs, self._processes = database, clock, blobs, processes
        self._accuracy_m, self._ttl = accuracy_m, idempotency_ttl

    def add(
        self,
        caller: Caller,
        name: str,
        file: SpooledFile,
        file_name: str,
        declaration: AlignmentDeclaration,
        key: IdempotencyKey | None = None,
    ) -> tuple[AlignmentDocument, bool]:
        """Read a road and store it; returns the document and whether the request had been made before.

        Raises
        ------
        UnreadableUpload, UnsupportedUpload, InvalidParameter, ReferenceSystemError
            The file, the declaration, or both together cannot be used.
        Conflict
            The agency has an alignment of this name.
        """
        if earlier := find_earlier(self._database, caller.agency_id, key, self._clock()):
            return earlier, True
        road = RoadFile(file, file_name, declaration, name, self._accuracy_m)
        return self._add(caller, road, {}, key)

    def add_of_road(
        self, caller: Caller, name: str, road_id: str, lanes: RoadLanes, key: IdempotencyKey | None = None
    ) -> tuple[AlignmentDocument, bool]:
        """Store lanes along a registered road, as it is now; returns as `add`.

        Raises
        ------
        NotFound
            There is no such road.
        InvalidParameter
            No lanes are declared, or they cannot be along this axis.
        Conflict
            The agency has an alignment of this name.
        """
        if earlier := find_earlier(self._database, caller.agency_id, key, self._clock()):
            return earlier, True
        with self._database.read() as connection:
            row = ROADS.get(connection, caller.agency_id, road_id)
        data = write_registered_road(_registered_road(row, lanes))
        declaration = AlignmentDeclaration(realization=row.given["realization"], epoch=row.given["epoch"])
        source = {"road_id": road_id, "road_version": row.version, "lanes": lanes.model_dump(mode="json")}
        road = RoadFile(SpooledFile.of(data), "road.json", declaration, name, self._accuracy_m)
        return self._add(caller, road, source, key)

    def _add(
        self, caller: Caller, road: RoadFile, source: dict[str, object], key: IdempotencyKey | None
    ) -> tuple[AlignmentDocument, bool]:
        now, agency_id, name = self._clock(), caller.agency_id, road.name
        declared = {member: getattr(road.declaration, member) for member in _DECLARED}
        with self._database.read() as connection:
            ALIGNMENTS.check_name(connection, agency_id, name)
        read = self._processes.run(summarize_road, road, wait_s=BUSY_WAIT_S)
        warnings = read.summary["warnings"]
        with self._database.read() as connection:
            if exchanged := _exchanged_warning(connection, agency_id, read.summary):
                warnings = [exchanged, *warnings]
        with staged(self._blobs) as stage:
            source_key = stage.add("alignments", road.file)
            with (
                self._database.write() as connection,
                idempotent(connection, agency_id, key, now, self._ttl) as answer,
            ):
                if answer.replayed:
                    return answer.response, True
                ALIGNMENTS.check_name(connection, agency_id, name)
                values: dict[str, object] = {
                    **first_version(now),
                    "name": name,
                    "source_key": source_key,
                    "source_sha256": road.file.sha256,
                    "declaration": {
                        **{member: value for member, value in declared.items() if value is not None},
                        "file_name": road.file_name,
                        **source,
                    },
                    "summary": {**read.summary, "warnings": warnings},
                }
                document = answer.store(alignment_document(ALIGNMENTS.add(connection, agency_id, values)))
                add_lanes(connection, agency_id, document["id"], read.lanes)
                log_change(connection, caller, "alignment.added", now=now, subject=document["id"], document=document)
            stage.keep()
        return document, False

    def write_map(
        self, caller: Caller, alignment_id: str, form: MapForm, filtered: MarkerFilter, within_m: float
    ) -> bytes:
        """The lanes of an alignment with the agency's markers near them as an HD map; retired markers are left out.

        Raises
        ------
        NotFound
            There is no such alignment.
        InvalidParameter
            The filter asks for retired markers, or there are too many around the road.
        """
        if filtered.status == "retired":
            raise InvalidParameter(
                "maps have no retired markers", field="status", limit="any other status", cure="leave status out"
            )
        with self._database.read() as connection:
            row = ALIGNMENTS.get(connection, caller.agency_id, alignment_id)
            box = Box(*row.summary["extent_deg"]).widened(within_m)
            found = list_for_map(connection, caller.agency_id, filtered, box, limit=MAX_MAP_MARKERS + 1)
        if len(found) > MAX_MAP_MARKERS:
            raise InvalidParameter(
                f"more than {MAX_MAP_MARKERS} markers lie around the road",
                field="bbox",
                limit=f"{MAX_MAP_MARKERS} markers",
                cure="send a bbox, a family or another filter, or cut the road into sections",
            )
        with self._blobs.opened(row.source_key) as file:
            road = road_of(row, file, self._accuracy_m)
            return self._processes.run(write_map, road, form, tuple(found), within_m, wait_s=BUSY_WAIT_S)

    def profile(self, caller: Caller, alignment_id: str, samples: int) -> AlignmentProfile:
        """The lanes of an alignment to draw, with at most so many samples each.

        Raises
        ------
        NotFound
            There is no such alignment.
        """
        with self._database.read() as connection:
            row = ALIGNMENTS.get(connection, caller.agency_id, alignment_id)
        with self._blobs.opened(row.source_key) as file:
            road = road_of(row, file, self._accuracy_m)
            return self._processes.run(profile_road, road, samples, wait_s=BUSY_WAIT_S)

    def get(self, caller: Caller, alignment_id: str) -> AlignmentDocument:
        """One alignment."""
        with self._database.read() as connection:
            return alignment_document(ALIGNMENTS.get(connection, caller.agency_id, alignment_id))

    def page(self, caller: Caller, *, after: str | None = None, limit: int = 100) -> tuple[AlignmentPage, str | None]:
        """A page of alignments, and the id to continue after if there are more."""
        with self._database.read() as connection:
            rows, last = ALIGNMENTS.page(connection, caller.agency_id, beyond=after, limit=limit)
        return {"items": [alignment_document(row) for row in rows]}, last

    def source(self, caller: Caller, alignment_id: str) -> tuple[bytes, str]:
        """The file as it came, and its name."""
        with self._database.read() as connection:
            row = ALIGNMENTS.get(connection, caller.agency_id, alignment_id)
        return self._blobs.get(row.source_key), row.declaration.get("file_name") or "road"


def road_of(row: AlignmentRow, file: SpooledFile, accuracy_m: float) -> RoadFile:
    """The road of a stored alignment."""
    declared = _DECLARATION.validate_python({k: value for k, value in row.declaration.items() if k in _DECLARED})
    return RoadFile(file, row.declaration.get("file_name", ""), declared, row.name, accuracy_m)


def alignment_document(row: AlignmentRow) -> AlignmentDocument:
    """An alignment as clients see it."""
    own = ("id", "name", "declaration", "source_sha256", "version", "created_at", "updated_at")
    return document_of(
        AlignmentDocument, row, **{name: value for name, value in row.summary.items() if name not in own}
    )


def _exchanged_warning(connection: sa.Connection, agency_id: str, summary: RoadSummary) -> str | None:
    """The warning if registered markers show that longitude and latitude are exchanged, as for surveys."""
    west, south, east, north = summary["extent_deg"]
    lon_deg, lat_deg = (west + east) / 2, (south + north) / 2
    if summary["crs"] not in _LON_LAT or west > east or abs(lon_deg) > 90.0:
        return None
    if is_any_near(connection, agency_id, lon_deg, lat_deg, KNOWN_M):
        return None
    if not is_any_near(connection, agency_id, lat_deg, lon_deg, KNOWN_M):
        return None
    return (
        f"No marker is registered within {KNOWN_M / 1000:g} km of the road, but some are near it if longitude and "
        "latitude are exchanged. Check the order of the coordinates: GeoJSON has the longitude first."
    )


def _registered_road(row: RoadRow, lanes: RoadLanes) -> RegisteredRoad:
    """A road of the registry as the source of an alignment."""
    return RegisteredRoad(
        road_id=row.id,
        version=row.version,
        name=row.name,
        exact=row.localization_grade != LocalizationGrade.UNFIT,
        note=row.transform_note,
        accuracy_m=row.given.get("transform_accuracy_m"),
        lanes=lanes,
        calibration=[CalibrationPoint(**point) for point in row.calibration],
        parts=[[(point[0], point[1]) for point in part] for part in row.parts],
    )
