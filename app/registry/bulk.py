"""Markers by the thousand: looked up by box, by digits and by number, and stored a chunk at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Any

import sqlalchemy as sa

from app.registry.audit import AuditEntry
from app.registry.bulk_load import large_load, load_columns
from app.registry.columns import Columns, json_objects
from app.registry.feature_text import feature_texts
from app.registry.markers import PUBLIC, MarkerFilter, Row, conditions_of
from app.registry.spatial import Box, box_around, within_box
from app.registry.tables import marker_versions, markers
from app.registry.tenancy import seeing_every_agency

_CHUNK = 500
_PLACE = (markers.c.lon_deg, markers.c.lat_deg, markers.c.height_m, markers.c.vertical_datum)


def list_places_in(connection: sa.Connection, agency_id: str, box: Box, *, limit: int) -> list[Row]:
    """Places and heights of the agency's markers in a box that may be on the road."""
    query = sa.select(*_PLACE).where(markers.c.agency_id == agency_id, markers.c.status != "retired", within_box(box))
    return list(connection.execute(query.limit(limit)).mappings())


def is_any_near(connection: sa.Connection, agency_id: str, lon_deg: float, lat_deg: float, radius_m: float) -> bool:
    """Whether the agency has a marker in the box around a circle."""
    query = sa.select(markers.c.row).where(
        markers.c.agency_id == agency_id, within_box(box_around(lon_deg, lat_deg, radius_m))
    )
    return connection.execute(query.limit(1)).first() is not None


def list_markers_in(connection: sa.Connection, agency_id: str, family: str, box: Box, *, limit: int) -> list[Row]:
    """The agency's markers of a family in a box that may be on the road."""
    query = sa.select(*PUBLIC).where(
        markers.c.agency_id == agency_id,
        markers.c.family == family,
        markers.c.status != "retired",
        within_box(box),
    )
    return list(connection.execute(query.limit(limit)).mappings())


def list_by_digits(connection: sa.Connection, family: str, digits: Sequence[str]) -> Iterator[Row]:
    """What any agency's markers with these digits are: id, agency_id, digits, n, scheme, place, status."""
    columns = (
        markers.c.id, markers.c.agency_id, markers.c.digits, markers.c.n, markers.c.scheme, markers.c.status,
        markers.c.lon_deg, markers.c.lat_deg, markers.c.digits_match_position,
    )  # fmt: skip
    known = sa.select(sa.literal(1)).where(markers.c.family == family).limit(1)
    with seeing_every_agency(connection):
        wanted = sorted(set(digits)) if digits and connection.execute(known).first() is not None else []
    for start in range(0, len(wanted), _CHUNK):
        query = sa.select(*columns).where(
            markers.c.digits.in_(wanted[start : start + _CHUNK]), markers.c.family == family
        )
        with seeing_every_agency(connection):
            found = connection.execute(query).mappings().all()
        yield from found


def add_markers(
    connection: sa.Connection, entry: AuditEntry, columns: Columns, *, kind: Callable[[str], str], why: str | None
) -> None:
    """Store new markers of the entry's agency, each with the first version of its history.

    The columns are those of `PUBLIC`, the rows in the order of their ids; `kind` tells a version's kind from the
    status.
    """
    kinds = [str(kind(status)) for status in columns.values("status")]
    versions = entry.first_versions(columns.values("id"), json_objects(columns), kinds=kinds, why=why)
    same = {**columns.same, "agency_id": entry.agency_id}
    owned = Columns(columns.count, same, {**columns.own, "feature": feature_texts(columns)})
    load_columns(connection, markers, owned)
    load_columns(connection, marker_versions, versions)


def many_markers(connection: sa.Connection, rows: int) -> AbstractContextManager[None]:
    """Within it `add_markers` stores about this many, in several calls; the indexes may be filled at its end."""
    return large_load(connection, (markers, marker_versions), rows)


def list_records(
    connection: sa.Connection,
    agency_id: str,
    narrowed: MarkerFilter,
    fields: Sequence[str],
    *,
    after: str | None,
    limit: int,
) -> list[dict[str, Any]]:
    """Markers in the order of their ids as flat records of these fields: columns, `code`, and `side` of CERPMs."""
    own = {"code": markers.c.digits, "side": markers.c.spec["side"].as_string()}
    columns = [own[name].label(name) if name in own else markers.c[name] for name in fields]
    query = sa.select(*columns).where(markers.c.agency_id == agency_id, *conditions_of(narrowed))
    if after is not None:
        query = query.where(markers.c.id > after)
    rows = connection.execute(query.order_by(markers.c.id).limit(limit)).all()
    return [dict(zip(fields, row, strict=True)) for row in rows]


def has_heights(connection: sa.Connection, agency_id: str, narrowed: MarkerFilter) -> bool:
    """Whether a marker of the filter has a height."""
    query = sa.select(markers.c.row).where(
        markers.c.agency_id == agency_id, markers.c.height_m.is_not(None), *conditions_of(narrowed)
    )
    return connection.execute(query.limit(1)).first() is not None


_SNAPSHOT = (
    "id", "family", "status", "scheme", "digits", "check_digits", "n", "unit_mm", "gap_mm", "thickness_mm", "lon_deg",
    "lat_deg", "height_m", "vertical_datum", "heading_deg", "horizontal_rmse_m", "vertical_rmse_m", "heading_rmse_deg",
    "localization_grade", "transform_accuracy_m", "transform_note",
)  # fmt: skip


def list_for_snapshot(connection: sa.Connection, agency_id: str, family: str, box: Box, *, limit: int) -> list[Row]:
    """The agency's markers of a family in a box with what vehicles need of them: all but the retired ones.

    Retired CERPMs are among them: whoever has their keys can still send. Of magnets also lane_lon_deg, lane_lat_deg and
    meaning; of CERPMs side, speed_limit, interval_s and jitter_share.
    """
    spec = markers.c.spec
    lane_start, radio = spec["lane"]["points_deg"][0], spec["radio"]
    own: dict[str, tuple[sa.ColumnElement[Any], ...]] = {
        "plate": (),
        "magnet": (
            lane_start[0].as_float().label("lane_lon_deg"),
            lane_start[1].as_float().label("lane_lat_deg"),
            spec["meaning"].label("meaning"),
        ),
        "cerpm": (
            spec["side"].as_string().label("side"),
            spec["speed_limit"].label("speed_limit"),
            radio["interval_s"].as_float().label("interval_s"),
            radio["jitter_share"].as_float().label("jitter_share"),
        ),
    }
    query = sa.select(*(markers.c[name] for name in _SNAPSHOT), *own[family]).where(
        markers.c.agency_id == agency_id,
        markers.c.family == family,
        within_box(box),
    )
    if family != "cerpm":
        query = query.where(markers.c.status != "retired")
    return list(connection.execute(query.limit(limit)).mappings())
