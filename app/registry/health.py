"""Queries on marker health: states of tests, readings of unknown codes, the work list, and the evidence."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, NamedTuple

import orjson
import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from app.errors import NotFound
from app.registry.column_types import (
    COUNTED_ID,
    ID,
    UtcTime,
    agency_column,
    fetch_all,
    fetch_in,
    find_one,
    metadata,
    one_of,
    select_rows,
)
from app.registry.decodes import NewObservation, decodes, observations
from app.registry.features import FeatureTable, Field
from app.registry.spatial import Box, within_box
from app.registry.vehicles import vehicle_uploads
from app.values import JsonObject

ITEM_STATUSES = ("open", "approved", "rejected")

# tests of a marker, a code that is not registered, a stretch, or a vehicle's own errors: app/health/states.py
marker_health = sa.Table(
    "marker_health",
    metadata,
    sa.Column("agency_id", ID, sa.ForeignKey("agencies.id"), primary_key=True),
    sa.Column("subject", sa.String(200), primary_key=True),  # a marker's id, code:..., stretch:..., vehicle:...
    sa.Column("marker_id", ID, sa.ForeignKey("markers.id")),
    sa.Column("lon_deg", sa.Double),  # of a code that is not registered, or of a stretch
    sa.Column("lat_deg", sa.Double),
    sa.Column("passes", sa.BigInteger, nullable=False),
    sa.Column("reads", sa.BigInteger, nullable=False),
    sa.Column("read_at", UtcTime),  # last read at its place
    sa.Column("last_at", UtcTime, nullable=False),
    sa.Column("ratios", sa.JSON, nullable=False),  # logarithms of the likelihood ratios, by fault
    sa.Column("quality", sa.Double),  # mean of the record, in standard deviations of a pass
    sa.Column("state", sa.JSON, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
)

# what decodes read where nothing is registered
unregistered_readings = sa.Table(
    "unregistered_readings",
    metadata,
    sa.Column("decode_id", ID, sa.ForeignKey("decodes.id"), primary_key=True),
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
    agency_column(),
    sa.Column("family", sa.String(16), nullable=False),
    sa.Column("code", sa.String(64), nullable=False),
    sa.Column("lon_deg", sa.Double, nullable=False),
    sa.Column("lat_deg", sa.Double, nullable=False),
    sa.Column("confidence", sa.Double, nullable=False),
    sa.Column("at", UtcTime, nullable=False),
)

# the work list: faults that are suspected, and what people decided
maintenance_items = sa.Table(
    "maintenance_items",
    metadata,
    # the integer key is what the spatial index refers to
    sa.Column("row", COUNTED_ID, primary_key=True, autoincrement=True),
    sa.Column("id", ID, nullable=False, unique=True),
    agency_column(),
    sa.Column("subject", sa.String(200), nullable=False),
    sa.Column("marker_id", ID, sa.ForeignKey("markers.id")),
    sa.Column("decode_id", ID, sa.ForeignKey("decodes.id")),  # that made it an item
    sa.Column("family", sa.String(16), nullable=False),
    sa.Column("code", sa.String(64)),
    sa.Column("what", sa.String(32), nullable=False),
    sa.Column("status", sa.String(16), nullable=False),
    sa.Column("outcome", sa.String(16)),
    sa.Column("road", sa.String(200)),
    sa.Column("measure_m", sa.Double),
    sa.Column("lon_deg", sa.Double, nullable=False),
    sa.Column("lat_deg", sa.Double, nullable=False),
    sa.Column("height_m", sa.Double),
    sa.Column("priority", sa.Double, nullable=False),
    sa.Column("ratio", sa.Double, nullable=False),
    sa.Column("vehicles", sa.Integer, nullable=False),
    sa.Column("passes", sa.Integer, nullable=False),
    sa.Column("first_at", UtcTime, nullable=False),
    sa.Column("last_at", UtcTime, nullable=False),
    sa.Column("evidence", sa.JSON, nullable=False),
    sa.Column("note", sa.String(500)),
    sa.Column("decided_by", sa.String(200)),
    sa.Column("decided_at", UtcTime),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
    # the feature that GIS clients read, written with every change of the row
    sa.Column("feature", sa.Text, nullable=False),
    one_of("status", ITEM_STATUSES),
    sa.Index("ix_maintenance_items_agency_id_id", "agency_id", "id"),
    sa.Index("ix_maintenance_items_agency_id_subject", "agency_id", "subject"),
    sa.Index("ix_maintenance_items_agency_id_status_priority_id", "agency_id", "status", "priority", "id"),
    sqlite_autoincrement=True,
)

_H, _U = marker_health.c, unregistered_readings.c


class HealthRow(NamedTuple):
    """Tests of a marker, of a code that is not registered, of a stretch, or a vehicle's own errors."""

    subject: str
    marker_id: str | None
    lon_deg: float | None
    lat_deg: float | None
    passes: int
    reads: int
    read_at: datetime | None
    last_at: datetime
    ratios: dict[str, float]
    quality: float | None
    state: JsonObject
    updated_at: datetime


class NewUnregistered(NamedTuple):
    """A marker that a decode read where none is registered; `number` counts them in the decode."""

    number: int
    family: str
    code: str
    lon_deg: float
    lat_deg: float
    confidence: float
    at: datetime


class EvidenceDecode(NamedTuple):
    """A decode that observed a marker: its kind, the frame, and when."""

    decode_id: str
    kind: str
    frame: int
    at: datetime
    what: str


class StoredDecode(NamedTuple):
    """A decode that is done, with what identifies its vehicle."""

    id: str
    kind: str
    holder_id: str | None
    vehicle_id: str | None


_ROWS = select_rows(HealthRow, marker_health)
_CHANGED = [name for name in HealthRow._fields if name not in ("subject", "marker_id")]


def _upsert(insert: sqlite.Insert | postgresql.Insert) -> sa.Insert:
    """Insert rows, or replace those of the same subjects."""
    return insert.on_conflict_do_update(
        index_elements=["agency_id", "subject"], set_={column: insert.excluded[column] for column in _CHANGED}
    )


_UPSERT = {  # built once: building a statement costs more than running it
    "sqlite": _upsert(sqlite.insert(marker_health)),
    "postgresql": _upsert(postgresql.insert(marker_health)),
}
_ADD_UNREGISTERED = {
    "sqlite": sqlite.insert(unregistered_readings).on_conflict_do_nothing(),
    "postgresql": postgresql.insert(unregistered_readings).on_conflict_do_nothing(),
}


def find_health(connection: sa.Connection, agency_id: str, subjects: Collection[str]) -> dict[str, HealthRow]:
    """Rows of some subjects of an agency."""
    query = _ROWS.where(_H.agency_id == agency_id)
    return {row.subject: row for row in fetch_in(connection, query, HealthRow, _H.subject, subjects)}


def find_marker_health(connection: sa.Connection, agency_id: str, marker_id: str) -> HealthRow | None:
    """The row of one marker."""
    return find_one(connection, _ROWS.where(_H.agency_id == agency_id, _H.subject == marker_id), HealthRow)


def list_codes(connection: sa.Connection, agency_id: str, family: str, code: str) -> list[HealthRow]:
    """Places where a code was read that is not registered there."""
    prefix = f"code:{family}:{code}:"
    # the character after ':' is ';'
    query = _ROWS.where(_H.agency_id == agency_id, _H.subject >= prefix, _H.subject < prefix[:-1] + ";")
    return fetch_all(connection, query.order_by(_H.subject), HealthRow)


def store_health(connection: sa.Connection, agency_id: str, rows: Sequence[HealthRow]) -> None:
    """Store rows in place of those of the same subjects."""
    if rows:
        values = [{**row._asdict(), "agency_id": agency_id} for row in rows]
        connection.execute(_UPSERT[connection.dialect.name], values)


def delete_health(connection: sa.Connection, agency_id: str) -> None:
    """Forget the states of an agency, to compute them again."""
    connection.execute(sa.delete(marker_health).where(_H.agency_id == agency_id))


def add_unregistered(
    connection: sa.Connection, agency_id: str, decode_id: str, rows: Sequence[NewUnregistered]
) -> None:
    """Store readings of codes that are not registered; a row that is there already stays."""
    if rows:
        values = [{**row._asdict(), "agency_id": agency_id, "decode_id": decode_id} for row in rows]
        connection.execute(_ADD_UNREGISTERED[connection.dialect.name], values)


def list_evidence(connection: sa.Connection, agency_id: str, marker_id: str, *, limit: int) -> list[EvidenceDecode]:
    """The newest decodes that observed a marker."""
    o = observations.c
    query = (
        sa.select(o.decode_id, decodes.c.kind, o.frame, o.at, o.what)
        .join(decodes, decodes.c.id == o.decode_id)
        .where(o.agency_id == agency_id, o.marker_id == marker_id)
        .order_by(o.at.desc(), o.decode_id.desc(), o.frame)
        .limit(limit)
    )
    return fetch_all(connection, query, EvidenceDecode)


def iterate_decodes(connection: sa.Connection, agency_id: str, page: int = 500) -> Iterator[StoredDecode]:
    """All decodes of an agency with observations or readings, in the order in which they were uploaded."""
    last = ""
    columns = (decodes.c.id, decodes.c.kind, decodes.c.holder_id, vehicle_uploads.c.vehicle_id)
    query = (
        sa.select(*columns)
        .select_from(decodes.outerjoin(vehicle_uploads, vehicle_uploads.c.decode_id == decodes.c.id))
        .where(decodes.c.agency_id == agency_id)
        .order_by(decodes.c.id)
        .limit(page)
    )
    while rows := fetch_all(connection, query.where(decodes.c.id > last), StoredDecode):
        yield from rows
        last = rows[-1].id


def list_of_decode(
    connection: sa.Connection, agency_id: str, decode_id: str
) -> tuple[list[NewObservation], list[NewUnregistered]]:
    """What a decode observed of markers, and what it read where none is registered."""
    o = observations.c
    seen = select_rows(NewObservation, observations).where(o.agency_id == agency_id, o.decode_id == decode_id)
    unknown = select_rows(NewUnregistered, unregistered_readings).where(
        _U.agency_id == agency_id, _U.decode_id == decode_id
    )
    return (
        fetch_all(connection, seen.order_by(o.marker_id, o.frame), NewObservation),
        fetch_all(connection, unknown.order_by(_U.number), NewUnregistered),
    )


# === Queries on the work list: faults that are suspected, and what people decided on them.


_M = maintenance_items.c


class ItemRow(NamedTuple):
    """A fault that is suspected."""

    id: str
    subject: str  # as of `HealthRow`, or the drive of a driver on the wrong way
    marker_id: str | None
    decode_id: str | None  # the upload that made it an item; None for damage reports
    family: str
    code: str | None
    what: str  # a fault, ``wrong-way-driver``, or ``reported`` by people
    # `status`, `outcome`: open, approved or rejected; and what was approved
    status: str
    outcome: str | None
    road: str | None
    measure_m: float | None
    lon_deg: float
    lat_deg: float
    height_m: float | None
    priority: float
    ratio: float  # [nat] logarithm of the likelihood ratio
    vehicles: int
    passes: int
    first_at: datetime
    last_at: datetime
    evidence: JsonObject  # JSON: limits, displacement, uploads, damage reports
    note: str | None
    decided_by: str | None
    decided_at: datetime | None
    version: int
    created_at: datetime
    updated_at: datetime


@dataclass(frozen=True, slots=True)
class ItemFilter:
    """Which items are meant; None lets all through."""

    road: str | None = None
    what: str | None = None
    status: str | None = None
    family: str | None = None
    box: Box | None = None
    min_priority: float | None = None
    marker_id: str | None = None

    @property
    def conditions(self) -> list[sa.ColumnElement[bool]]:
        """As SQL."""
        equal = {"road": self.road, "what": self.what, "status": self.status, "family": self.family}
        found = [
            _M[name] == value for name, value in {**equal, "marker_id": self.marker_id}.items() if value is not None
        ]
        if self.box is not None:
            found.append(within_box(self.box, maintenance_items))
        if self.min_priority is not None:
            found.append(_M.priority >= self.min_priority)
        return found


_ITEMS = select_rows(ItemRow, maintenance_items)
ITEM_FIELDS = (
    Field(
        "what",
        "string",
        _M.what,
        "missing, moved, cloned, wrong-way, fading, unregistered, shifted, turned, wrong-way-driver, reported",
    ),
    Field("status", "string", _M.status, "open, approved or rejected"),
    Field("outcome", "string", _M.outcome, "What was approved: suspect, retired, resurvey or none"),
    Field("priority", "number", _M.priority, "0 to 1, the most urgent first"),
    Field("marker_id", "string", _M.marker_id, "Id of the marker"),
    Field("family", "string", _M.family, "plate, fiducial, magnet or cerpm"),
    Field("code", "string", _M.code, "Digits of a plate, text of a tag, number of a CERPM"),
    Field("road", "string", _M.road, "Road's name or number"),
    Field("measure_m", "number", _M.measure_m, "Chainage along the road [m]"),
    Field("vehicles", "integer", _M.vehicles, "Distinct vehicles that the evidence is of"),
    Field("passes", "integer", _M.passes, "Passes that the evidence is of"),
    Field("ratio", "number", _M.ratio, "Logarithm of the likelihood ratio [nat]"),
    Field("first_at", "date-time", _M.first_at, "When the evidence began"),
    Field("last_at", "date-time", _M.last_at, "Newest evidence"),
    Field("updated_at", "date-time", _M.updated_at, "When it was last changed"),
)
MAINTENANCE = FeatureTable(
    maintenance_items, ITEM_FIELDS, sa.true(), _M.feature, _M.updated_at, ("what", "status", "family", "priority"),
    frozenset({"status"}),
)  # fmt: skip


def get_item(connection: sa.Connection, agency_id: str, item_id: str) -> ItemRow:
    """One item.

    Raises
    ------
    NotFound
        There is none with this id, or it belongs to another agency.
    """
    row = find_one(connection, _ITEMS.where(_M.agency_id == agency_id, _M.id == item_id), ItemRow)
    if row is None:
        raise NotFound(f"there is no item {item_id}", field="item_id", cure="GET /v1/maintenance lists yours")
    return row


def find_open(connection: sa.Connection, agency_id: str, subject: str, what: str) -> ItemRow | None:
    """The open item of a subject and a fault."""
    query = _ITEMS.where(_M.agency_id == agency_id, _M.subject == subject, _M.what == what, _M.status == "open")
    return find_one(connection, query.limit(1), ItemRow)


def list_items(
    connection: sa.Connection, agency_id: str, filtered: ItemFilter,
    *, after: tuple[float, str] | None = None, limit: int = 100,
) -> list[ItemRow]:  # fmt: skip
    """Items, the most urgent first."""
    query = _ITEMS.where(_M.agency_id == agency_id, *filtered.conditions)
    if after is not None:
        priority, item_id = after
        query = query.where(sa.or_(_M.priority < priority, sa.and_(_M.priority == priority, _M.id < item_id)))
    return fetch_all(connection, query.order_by(_M.priority.desc(), _M.id.desc()).limit(limit), ItemRow)


def iterate_items(
    connection: sa.Connection, agency_id: str, filtered: ItemFilter, page: int = 500
) -> Iterator[ItemRow]:
    """All items of a filter, the most urgent first."""
    after: tuple[float, str] | None = None
    while rows := list_items(connection, agency_id, filtered, after=after, limit=page):
        yield from rows
        after = (rows[-1].priority, rows[-1].id)


def add_item(connection: sa.Connection, agency_id: str, row: ItemRow) -> None:
    """Store a new item."""
    connection.execute(
        sa.insert(maintenance_items).values({**row._asdict(), "agency_id": agency_id, "feature": _feature(row)})
    )


def change_item(connection: sa.Connection, agency_id: str, row: ItemRow, changes: Mapping[str, Any]) -> ItemRow:
    """Change an item."""
    changed = row._replace(**changes)
    own = sa.update(maintenance_items).where(_M.id == row.id, _M.agency_id == agency_id)
    connection.execute(own.values(**changes, feature=_feature(changed)))
    return changed


def _feature(row: ItemRow) -> str:
    """The item as a GeoJSON feature in one line."""
    values = row._asdict()
    return orjson.dumps(
        {
            "type": "Feature",
            "id": row.id,
            "geometry": {"type": "Point", "coordinates": [row.lon_deg, row.lat_deg]},
            "properties": {field.name: values[field.name] for field in ITEM_FIELDS},
        }
    ).decode()
