"""Queries on roads, their versions and the markers on them. All see one agency only."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime
from typing import NamedTuple, NotRequired

import sqlalchemy as sa
from typing_extensions import TypedDict

from app.markers.reading import MarkerRow
from app.registry.audit import AuditEntry, add_versions
from app.registry.column_types import ID, UtcTime, agency_column, fetch_all, metadata
from app.registry.features import feature_text
from app.registry.marker_rows import MARKERS, markers
from app.registry.resources import Resource

roads = sa.Table(
    "roads",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("name", sa.String(200), nullable=False),
    sa.Column("parts", sa.JSON, nullable=False),  # of the axis: lines of longitude and latitude
    sa.Column("given", sa.JSON, nullable=False),  # frame of the geometry as it came
    sa.Column("calibration", sa.JSON, nullable=False),
    sa.Column("length_m", sa.Double, nullable=False),
    sa.Column("from_m", sa.Double, nullable=False),
    sa.Column("to_m", sa.Double, nullable=False),
    sa.Column("localization_grade", sa.String(64), nullable=False),
    sa.Column("transform_note", sa.String(500)),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
    sa.UniqueConstraint("agency_id", "name"),
    sa.Index("ix_roads_agency_id_id", "agency_id", "id"),
)

road_versions = sa.Table(
    "road_versions",
    metadata,
    sa.Column("road_id", ID, sa.ForeignKey("roads.id"), primary_key=True),
    sa.Column("version", sa.Integer, primary_key=True, autoincrement=False),
    agency_column(),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("who", sa.String(200), nullable=False),
    sa.Column("why", sa.String(500)),
    sa.Column("road", sa.JSON, nullable=False),
)

_CHUNK = 1000


class RoadFrame(TypedDict):
    """The reference system that a road's geometry came in, the frame that it is in now and the accuracy of that, and
    whether it came as a MultiLineString."""

    crs: str
    realization: str | None
    epoch: float | None
    transform_accuracy_m: float | None
    several: bool
    # as they were sent; roads that were registered by earlier releases have neither
    declared_realization: NotRequired[str | None]
    declared_epoch: NotRequired[float | None]


class StoredStation(TypedDict):
    """A calibration point on the axis."""

    part: int
    chainage_m: float
    measure_m: float
    ahead_m: float | None


class RoadSummaryRow(NamedTuple):
    """A road without its geometry."""

    id: str
    name: str
    given: RoadFrame
    length_m: float
    from_m: float
    to_m: float
    localization_grade: str
    transform_note: str | None
    version: int
    created_at: datetime
    updated_at: datetime


class RoadRow(NamedTuple):
    """A road."""

    id: str
    name: str
    parts: list[list[list[float]]]
    given: RoadFrame
    calibration: list[StoredStation]
    length_m: float
    from_m: float
    to_m: float
    localization_grade: str
    transform_note: str | None
    version: int
    created_at: datetime
    updated_at: datetime


ROADS = Resource("road", RoadRow, roads, cure="GET /v1/roads lists yours", versions=road_versions)
ROAD_SUMMARIES = Resource("road", RoadSummaryRow, roads)


def list_on_road(
    connection: sa.Connection,
    agency_id: str,
    road: str,
    *,
    measures_m: tuple[float | None, float | None] = (None, None),
    offsets_m: tuple[float | None, float | None] = (None, None),
    after: tuple[float, str] | None = None,
    limit: int,
) -> list[MarkerRow]:
    """Markers with a measure on a road, in the order of their measures."""
    c = markers.c
    query = MARKERS.where(c.agency_id == agency_id, c.road == road, c.measure_m.is_not(None))
    for column, (low, high) in ((c.measure_m, measures_m), (c.offset_m, offsets_m)):
        if low is not None:
            query = query.where(column >= low)
        if high is not None:
            query = query.where(column <= high)
    if after is not None:
        place = sa.tuple_(sa.literal(after[0], sa.Double), sa.literal(after[1]))
        query = query.where(c.measure_m >= after[0], sa.tuple_(c.measure_m, c.id) > place)
    return fetch_all(connection, query.order_by(c.measure_m, c.id).limit(limit), MarkerRow)


def walk_named(connection: sa.Connection, agency_id: str, road: str) -> Iterator[list[MarkerRow]]:
    """All markers that name a road, in the order of their ids, some at a time."""
    query = MARKERS.where(markers.c.agency_id == agency_id, markers.c.road == road)
    query = query.order_by(markers.c.id).limit(_CHUNK)
    after = ""
    while rows := fetch_all(connection, query.where(markers.c.id > after), MarkerRow):
        yield rows
        after = rows[-1].id


def remeasure(
    connection: sa.Connection,
    entry: AuditEntry,
    rows: Sequence[MarkerRow],
    references: Sequence[tuple[float, float]],
    *,
    kind: str,
    why: str | None,
) -> None:
    """Give markers, in the order of their ids, new measures and offsets: a further version of each."""
    if not rows:
        return
    c = markers.c
    statement = (
        sa.update(markers)
        .where(c.id == sa.bindparam("marker"), c.agency_id == entry.agency_id)
        .values(
            measure_m=sa.bindparam("measure"),
            offset_m=sa.bindparam("offset"),
            version=c.version + 1,
            updated_at=sa.bindparam("now", entry.at, type_=c.updated_at.type),
            feature=sa.bindparam("text"),
        )
    )
    versions, values = [], []
    for row, (measure_m, offset_m) in zip(rows, references, strict=True):
        marker = row._replace(measure_m=measure_m, offset_m=offset_m, version=row.version + 1, updated_at=entry.at)
        values.append({"marker": row.id, "measure": measure_m, "offset": offset_m, "now": entry.at})
        values[-1]["text"] = feature_text(marker)
        versions.append(entry.version(row.id, marker.version, marker._asdict(), kind=kind, why=why))
    connection.execute(statement, values)
    add_versions(connection, versions)
