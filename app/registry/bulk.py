"""Markers by the thousand: looked up by box, by digits and by number, and stored a chunk at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import sqlalchemy as sa

from app.geodesy.vertical import ELLIPSOID
from app.registry.audit import AuditEntry
from app.registry.bulk_load import large_load, load_columns
from app.registry.columns import Columns, json_objects
from app.registry.feature_text import feature_texts
from app.registry.marker_rows import MARKERS, CodeRow, MarkerRow
from app.registry.markers import MarkerFilter, conditions_of
from app.registry.rows import fetch_all, select_rows
from app.registry.spatial import Box, box_around, within_box
from app.registry.tables import marker_versions, markers
from app.registry.tenancy import seeing_every_agency

_CHUNK = 500


class PlaceRow(NamedTuple):
    """Where a marker is, and the row of the survey that it comes from."""

    lon_deg: float
    lat_deg: float
    height_m: float | None
    vertical_datum: str | None
    id: str
    family: str
    survey_file_sha256: str | None
    point: str | None


def list_places_in(
    connection: sa.Connection, agency_id: str, box: Box, *, limit: int, ignoring: str = ""
) -> list[PlaceRow]:
    """Places and heights of the agency's markers, but one, in a box that may be on the road."""
    own = {"point": markers.c.original["point"].as_string().label("point")}
    columns = [own[name] if name in own else markers.c[name] for name in PlaceRow._fields]
    query = sa.select(*columns).where(
        markers.c.agency_id == agency_id, markers.c.status != "retired", markers.c.id != ignoring, within_box(box)
    )
    return fetch_all(connection, query.limit(limit), PlaceRow)


def is_any_near(
    connection: sa.Connection, agency_id: str, lon_deg: float, lat_deg: float, radius_m: float, *, ignoring: str = ""
) -> bool:
    """Whether the agency has a marker, besides one, in the box around a circle."""
    query = sa.select(markers.c.row).where(
        markers.c.agency_id == agency_id,
        markers.c.id != ignoring,
        within_box(box_around(lon_deg, lat_deg, radius_m)),
    )
    return connection.execute(query.limit(1)).first() is not None


def list_markers_in(connection: sa.Connection, agency_id: str, family: str, box: Box, *, limit: int) -> list[MarkerRow]:
    """The agency's markers of a family in a box that may be on the road."""
    query = MARKERS.where(
        markers.c.agency_id == agency_id,
        markers.c.family == family,
        markers.c.status != "retired",
        within_box(box),
    )
    return fetch_all(connection, query.limit(limit), MarkerRow)


def list_by_digits(connection: sa.Connection, family: str, digits: Sequence[str]) -> Iterator[CodeRow]:
    """Any agency's markers with these digits."""
    known = sa.select(sa.literal(1)).where(markers.c.family == family).limit(1)
    with seeing_every_agency(connection):
        wanted = sorted(set(digits)) if digits and connection.execute(known).first() is not None else []
    for start in range(0, len(wanted), _CHUNK):
        query = select_rows(CodeRow, markers).where(
            markers.c.digits.in_(wanted[start : start + _CHUNK]), markers.c.family == family
        )
        with seeing_every_agency(connection):
            found = fetch_all(connection, query, CodeRow)
        yield from found


def add_markers(
    connection: sa.Connection, entry: AuditEntry, columns: Columns, *, kind: Callable[[str], str], why: str | None
) -> None:
    """Store new markers of the entry's agency, each with the first version of its history.

    The columns are those of `MarkerRow`, the rows in the order of their ids; `kind` gives a version's kind from
    the status.
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
    filtered: MarkerFilter,
    fields: Sequence[str],
    *,
    after: str | None,
    limit: int,
) -> list[dict[str, Any]]:
    """Markers in the order of their ids as flat records of these fields: columns, `code`, and `side` of CERPMs."""
    own = {"code": markers.c.digits, "side": markers.c.spec["side"].as_string()}
    columns = [own[name].label(name) if name in own else markers.c[name] for name in fields]
    query = sa.select(*columns).where(markers.c.agency_id == agency_id, *conditions_of(filtered))
    if after is not None:
        query = query.where(markers.c.id > after)
    rows = connection.execute(query.order_by(markers.c.id).limit(limit)).all()
    return [dict(zip(fields, row, strict=True)) for row in rows]


def count_records(
    connection: sa.Connection, agency_id: str, filtered: MarkerFilter, *, with_retired: bool = True
) -> int:
    """Number of the agency's markers that a filter leaves."""
    query = sa.select(sa.func.count()).select_from(markers)
    if not with_retired:
        query = query.where(markers.c.status != "retired")
    return int(connection.execute(query.where(markers.c.agency_id == agency_id, *conditions_of(filtered))).scalar_one())


def have_ellipsoidal_heights(connection: sa.Connection, agency_id: str, filtered: MarkerFilter) -> bool:
    """Whether every marker of the filter has an ellipsoidal height."""
    lacks = sa.or_(markers.c.height_m.is_(None), markers.c.vertical_datum != ELLIPSOID)
    query = sa.select(markers.c.row).where(markers.c.agency_id == agency_id, lacks, *conditions_of(filtered))
    return connection.execute(query.limit(1)).first() is None


SNAPSHOT_COLUMNS = (
    "id", "family", "status", "scheme", "digits", "check_digits", "n", "unit_mm", "gap_mm", "thickness_mm", "lon_deg",
    "lat_deg", "height_m", "vertical_datum", "heading_deg", "horizontal_rmse_m", "vertical_rmse_m", "heading_rmse_deg",
    "localization_grade", "transform_accuracy_m", "transform_note", "epoch",
)  # fmt: skip


_BLOCK = 5_000


def read_for_snapshot(
    connection: sa.Connection,
    agency_id: str,
    family: str,
    box: Box,
    *,
    columns: Sequence[sa.ColumnElement[Any]] = (),
    with_retired: bool = False,
) -> Iterator[dict[str, tuple[Any, ...]]]:
    """The agency's markers of a family in a box with what vehicles need of them, some at a time, by columns.

    The columns are `spec`, or in its place further `columns` by their labels.
    """
    further = columns or (markers.c.spec,)
    names = (*SNAPSHOT_COLUMNS, *(column.name for column in further))
    query = sa.select(*(markers.c[name] for name in SNAPSHOT_COLUMNS), *further)
    query = query.where(*_in_snapshot(agency_id, family, box, with_retired))
    found = connection.execute(query, execution_options={"stream_results": True})
    for rows in found.partitions(_BLOCK):
        yield dict(zip(names, zip(*rows, strict=True), strict=True))


def count_for_snapshot(
    connection: sa.Connection, agency_id: str, family: str, box: Box, *, with_retired: bool, limit: int
) -> int:
    """How many `read_for_snapshot` returns; no more than `limit` are counted."""
    query = sa.select(markers.c.row).where(*_in_snapshot(agency_id, family, box, with_retired)).limit(limit)
    return int(connection.execute(sa.select(sa.func.count()).select_from(query.subquery())).scalar_one())


def _in_snapshot(agency_id: str, family: str, box: Box, with_retired: bool) -> list[sa.ColumnElement[bool]]:
    conditions = [markers.c.agency_id == agency_id, markers.c.family == family, within_box(box)]
    return conditions if with_retired else [*conditions, markers.c.status != "retired"]
