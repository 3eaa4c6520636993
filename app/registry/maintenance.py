"""Queries on the work list: faults that are suspected, and what people decided on them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any, NamedTuple

import orjson
import sqlalchemy as sa

from app.errors import NotFound
from app.registry.features import FeatureTable, Field
from app.registry.health_tables import maintenance_items
from app.registry.rows import fetch_all, find_one, select_rows
from app.registry.spatial import Box, within_box

_M = maintenance_items.c


class ItemRow(NamedTuple):
    """A fault that is suspected.

    Attributes
    ----------
    subject : str
        As of `HealthRow`, or the drive of a driver on the wrong way.
    decode_id : str or None
        The upload that made it an item; None for damage reports.
    what : str
        A fault, ``wrong-way-driver``, or ``reported`` by people.
    state, outcome : str, str or None
        open, approved or dismissed; and what was approved.
    ratio : float
        Logarithm of the likelihood ratio. [nat]
    evidence : dict
        JSON: limits, displacement, uploads, damage reports.
    """

    id: str
    subject: str
    marker_id: str | None
    decode_id: str | None
    family: str
    code: str | None
    what: str
    state: str
    outcome: str | None
    road: str | None
    measure_m: float | None
    lon_deg: float
    lat_deg: float
    height_m: float | None
    priority: float
    ratio: float
    vehicles: int
    passes: int
    first_at: datetime
    last_at: datetime
    evidence: dict[str, Any]
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
    state: str | None = None
    family: str | None = None
    box: Box | None = None
    min_priority: float | None = None
    marker_id: str | None = None

    @property
    def conditions(self) -> list[sa.ColumnElement[bool]]:
        """As SQL."""
        equal = {"road": self.road, "what": self.what, "state": self.state, "family": self.family}
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
        "what", "string", _M.what, "missing, moved, cloned, wrong-way, fading, unregistered, wrong-way-driver, reported"
    ),
    Field("status", "string", _M.state, "open, approved or dismissed"),
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
    query = _ITEMS.where(_M.agency_id == agency_id, _M.subject == subject, _M.what == what, _M.state == "open")
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
    values = {**row._asdict(), "status": row.state}
    return orjson.dumps(
        {
            "type": "Feature",
            "id": row.id,
            "geometry": {"type": "Point", "coordinates": [row.lon_deg, row.lat_deg]},
            "properties": {field.name: values[field.name] for field in ITEM_FIELDS},
        }
    ).decode()
