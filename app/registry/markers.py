"""Queries on markers, and on what single families add. All but `find_code_near` see one agency only."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache, partial
from typing import Any, NamedTuple

import sqlalchemy as sa

from app.errors import NotFound, StaleVersion
from app.geodesy.systems import ELLIPSOID
from app.markers.magnet_design import CODEBOOK_FORMAT, Codebook
from app.markers.reading import MarkerRow
from app.registry.agencies import agency_secrets
from app.registry.audit import AuditEntry, add_versions
from app.registry.bulk_load import Columns, json_objects, large_load, load_columns
from app.registry.column_types import (
    ID,
    AnySelect,
    UtcTime,
    agency_column,
    fetch_all,
    fetch_in,
    find_one,
    metadata,
    row_of,
    select_rows,
)
from app.registry.engines import seeing_every_agency
from app.registry.features import feature_text, feature_texts
from app.registry.marker_rows import MARKERS, CodeRow, marker_versions, markers
from app.registry.resources import Resource
from app.registry.spatial import (
    Area,
    Box,
    box_around,
    distance_to,
    proposed_by_index,
    within_area,
    within_box,
    within_radius,
)
from app.values import JsonObject

# where the magnets of magnet markers lie: what follows from their layouts, kept for searches
magnets = sa.Table(
    "magnets",
    metadata,
    sa.Column("row", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), primary_key=True, autoincrement=True),
    sa.Column("marker_id", ID, sa.ForeignKey("markers.id"), nullable=False),
    sa.Column("number", sa.Integer, nullable=False),
    agency_column(),
    sa.Column("lon_deg", sa.Double, nullable=False),
    sa.Column("lat_deg", sa.Double, nullable=False),
    sa.Column("polarity", sa.String(1), nullable=False),
    sa.Column("phi_deg", sa.Integer, nullable=False),
    sa.UniqueConstraint("marker_id", "number"),
    sqlite_autoincrement=True,
)

codebooks = sa.Table(
    "codebooks",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("name", sa.String(80), nullable=False),
    sa.Column("design", sa.JSON, nullable=False),
    sa.Column("rules", sa.JSON, nullable=False),
    sa.Column("figures", sa.JSON, nullable=False),
    sa.Column("entries", sa.JSON, nullable=False),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
    sa.UniqueConstraint("agency_id", "name"),
    sa.Index("ix_codebooks_agency_id_id", "agency_id", "id"),
)

# which transmissions of a CERPM were received and when: what is sent again is known by it
cerpm_spans = sa.Table(
    "cerpm_spans",
    metadata,
    sa.Column("row", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), primary_key=True, autoincrement=True),
    agency_column(),
    sa.Column("number", sa.BigInteger, nullable=False),
    sa.Column("first_sequence", sa.BigInteger, nullable=False),
    sa.Column("last_sequence", sa.BigInteger, nullable=False),
    sa.Column("first_heard_s", sa.Double),  # seconds since 1970-01-01 UTC; null where the log had no times
    sa.Column("last_heard_s", sa.Double),
    sa.Column("decode_id", ID, sa.ForeignKey("decodes.id"), nullable=False),
    sa.Index("ix_cerpm_spans_agency_id_number", "agency_id", "number"),
    sqlite_autoincrement=True,
)

# === Codebooks as they are stored.


class CodebookRow(NamedTuple):
    """A codebook; its design, rules, figures and entries are JSON."""

    id: str
    name: str
    design: object
    rules: Any
    figures: object
    entries: Any
    version: int
    created_at: datetime
    updated_at: datetime


CODEBOOKS = Resource("codebook", CodebookRow, codebooks)


def book_of(row: CodebookRow) -> Codebook:
    """The codebook that a row stores."""
    return Codebook.from_document(
        {"format": CODEBOOK_FORMAT, "name": row.name, "design": row.design, "entries": row.entries}
    )


# === Where single magnets lie. Their rows follow from the layouts of their markers.


class MagnetRow(NamedTuple):
    """Where a magnet of a marker lies."""

    row: int
    marker_id: str
    number: int
    agency_id: str
    lon_deg: float
    lat_deg: float
    phi_deg: int


def replace_magnets(
    connection: sa.Connection, agency_id: str, marker_id: str, holes: Sequence[Mapping[str, object]]
) -> None:
    """Store where the magnets of a marker lie: number, lon_deg, lat_deg, polarity, phi_deg of each."""
    connection.execute(
        sa.delete(magnets).where(magnets.c.marker_id == marker_id, magnets.c.agency_id == agency_id),
    )
    connection.execute(sa.insert(magnets), [{"marker_id": marker_id, "agency_id": agency_id, **hole} for hole in holes])


def list_magnets_in(connection: sa.Connection, box: Box, *, ignoring: str | None = None) -> list[MagnetRow]:
    """Magnets of any agency inside a box that may be in the road, but for those of one marker."""
    query = (
        select_rows(MagnetRow, magnets)
        .join(markers, markers.c.id == magnets.c.marker_id)
        .where(within_box(box, magnets), markers.c.status != "retired")
    )
    if ignoring is not None:
        query = query.where(magnets.c.marker_id != ignoring)
    with seeing_every_agency(connection):
        return fetch_all(connection, query, MagnetRow)


# === Queries on CERPMs: their numbers, their agency's secret, and which transmissions were received.


_CHUNK = 500


class SpanRow(NamedTuple):
    """Transmissions of a CERPM that one upload had; times are seconds since 1970-01-01 UTC, None without a clock."""

    row: int
    number: int
    first_sequence: int
    last_sequence: int
    first_heard_s: float | None
    last_heard_s: float | None


def find_secret(connection: sa.Connection, agency_id: str) -> bytes | None:
    """The agency's wrapped key, if it has one."""
    query = sa.select(agency_secrets.c.wrapped).where(agency_secrets.c.agency_id == agency_id)
    return connection.execute(query).scalar_one_or_none()


def add_secret(connection: sa.Connection, agency_id: str, wrapped: bytes, now: datetime) -> None:
    """Keep the agency's wrapped key."""
    connection.execute(sa.insert(agency_secrets).values(agency_id=agency_id, wrapped=wrapped, created_at=now))


def find_number(connection: sa.Connection, agency_id: str, number: int) -> MarkerRow | None:
    """The agency's marker that carries, or once carried, this number."""
    query = MARKERS.where(
        markers.c.agency_id == agency_id, markers.c.family == "cerpm", markers.c.digits == str(number)
    )
    return find_one(connection, query, MarkerRow)


def last_number(connection: sa.Connection, agency_id: str) -> int:
    """The highest number of the agency; 0 without any."""
    number = sa.cast(markers.c.digits, sa.BigInteger)
    query = sa.select(sa.func.max(number)).where(markers.c.agency_id == agency_id, markers.c.family == "cerpm")
    return int(connection.execute(query).scalar_one() or 0)


def list_by_number(connection: sa.Connection, agency_id: str, numbers: Iterable[int]) -> dict[int, MarkerRow]:
    """The agency's markers with these numbers, retired ones too."""
    query = MARKERS.where(markers.c.agency_id == agency_id, markers.c.family == "cerpm")
    found = fetch_in(connection, query, MarkerRow, markers.c.digits, map(str, numbers))
    return {int(row.digits): row for row in found}


def list_spans(
    connection: sa.Connection, agency_id: str, numbers: Iterable[int], before_decode: str | None = None
) -> dict[int, list[SpanRow]]:
    """What was received of each of these markers before, or before a decode, in the order it was uploaded."""
    query = select_rows(SpanRow, cerpm_spans).where(cerpm_spans.c.agency_id == agency_id).order_by(cerpm_spans.c.row)
    if before_decode is not None:
        query = query.where(cerpm_spans.c.decode_id < before_decode)
    found: dict[int, list[SpanRow]] = {}
    for row in fetch_in(connection, query, SpanRow, cerpm_spans.c.number, numbers):
        found.setdefault(row.number, []).append(row)
    return found


def newest_row(spans: Mapping[int, Sequence[SpanRow]]) -> int:
    """Key of the span that was stored last; 0 without any."""
    return max((span.row for of_marker in spans.values() for span in of_marker), default=0)


def list_span_ends(connection: sa.Connection, agency_id: str, numbers: Iterable[int]) -> dict[int, SpanRow]:
    """From the first to the last transmission that was ever received from each of these markers, by number.

    Only of markers that were received; `row` is that of the span that was stored last.
    """
    wanted, mine = list(numbers), cerpm_spans.c
    first, last = sa.func.min(mine.first_sequence), sa.func.max(mine.last_sequence)
    found: dict[int, SpanRow] = {}
    for start in range(0, len(wanted), _CHUNK):
        chosen = (mine.agency_id == agency_id, mine.number.in_(wanted[start : start + _CHUNK]))
        ends = sa.select(mine.number, first.label("first"), last.label("last")).where(*chosen).group_by(mine.number)
        end = ends.subquery()
        query = (
            sa.select(
                sa.func.max(mine.row),
                mine.number,
                end.c.first,
                end.c.last,
                _time_of(mine.first_sequence == end.c.first, mine.first_heard_s),
                _time_of(mine.last_sequence == end.c.last, mine.last_heard_s),
            )
            .join(end, end.c.number == mine.number)
            .where(*chosen)
            .group_by(mine.number, end.c.first, end.c.last)
        )
        found.update({row.number: row for row in fetch_all(connection, query, SpanRow)})
    return found


def _time_of(end: sa.ColumnElement[bool], heard_s: sa.ColumnElement[float]) -> sa.ColumnElement[float | None]:
    """When an end was received first; null where one log that has it had no times."""
    untimed = sa.func.count(sa.case((sa.and_(end, heard_s.is_(None)), 1)))
    return sa.case((untimed > 0, None), else_=sa.func.min(sa.case((end, heard_s))))


def add_spans(connection: sa.Connection, agency_id: str, decode_id: str, spans: Sequence[Mapping[str, Any]]) -> None:
    """Keep what a decode received: number, first_sequence, last_sequence, first_heard_s, last_heard_s of each."""
    if spans:
        rows = [{"agency_id": agency_id, "decode_id": decode_id, **span} for span in spans]
        connection.execute(sa.insert(cerpm_spans), rows)


# === Queries on markers. All but `find_code_near` see one agency only.


@dataclass(frozen=True, slots=True)
class MarkerFilter:
    """What a list of markers is filtered to; None does not narrow."""

    box: Box | None = None
    near: tuple[float, float, float] | None = None
    digits: str | None = None
    status: str | None = None
    family: str | None = None
    area: Area | None = None
    road: str | None = None
    from_m: float | None = None
    to_m: float | None = None


def get_marker(connection: sa.Connection, agency_id: str, marker_id: str) -> MarkerRow:
    """One marker.

    Raises
    ------
    NotFound
        There is none with this id, or it belongs to another agency.
    """
    query = MARKERS.where(markers.c.id == marker_id, markers.c.agency_id == agency_id)
    row = find_one(connection, query, MarkerRow)
    if row is None:
        raise NotFound(f"there is no marker {marker_id}", field="marker_id")
    return row


def get_markers(connection: sa.Connection, agency_id: str, marker_ids: list[str]) -> list[MarkerRow]:
    """Several markers, in the order asked for.

    Raises
    ------
    NotFound
        One is missing, or belongs to another agency.
    """
    found = {row.id: row for row in find_markers(connection, agency_id, marker_ids)}
    missing = next((marker_id for marker_id in marker_ids if marker_id not in found), None)
    if missing is not None:
        raise NotFound(f"there is no marker {missing}", field="marker_ids")
    return [found[marker_id] for marker_id in marker_ids]


def find_markers(connection: sa.Connection, agency_id: str, marker_ids: list[str]) -> list[MarkerRow]:
    """Those of several markers that the agency has, in any order."""
    query = MARKERS.where(markers.c.agency_id == agency_id)
    return list(fetch_in(connection, query, MarkerRow, markers.c.id, marker_ids))


def list_markers(
    connection: sa.Connection, agency_id: str, filtered: MarkerFilter, *, after: str | None, limit: int
) -> list[MarkerRow]:
    """Markers in the order of their ids, which is the order they were registered in."""
    query = MARKERS.where(markers.c.agency_id == agency_id, *conditions_of(filtered))
    if after is not None:
        query = query.where(markers.c.id > after)
    return fetch_all(connection, query.order_by(markers.c.id).limit(limit), MarkerRow)


def conditions_of(filtered: MarkerFilter) -> list[sa.ColumnElement[bool]]:
    """What a filter asks of a row."""
    conditions = []
    if filtered.box is not None:
        conditions.append(within_box(filtered.box))
    if filtered.near is not None:
        conditions.append(within_radius(*filtered.near))
    if filtered.digits is not None:
        conditions.append(markers.c.digits == filtered.digits)
    if filtered.status is not None:
        conditions.append(markers.c.status == filtered.status)
    if filtered.family is not None:
        conditions.append(markers.c.family == filtered.family)
    if filtered.area is not None:
        conditions.append(within_area(filtered.area))
    if filtered.road is not None:
        conditions.append(markers.c.road == filtered.road)
    if filtered.from_m is not None:
        conditions.append(markers.c.measure_m >= filtered.from_m)
    if filtered.to_m is not None:
        conditions.append(markers.c.measure_m <= filtered.to_m)
    return conditions


def list_near(
    connection: sa.Connection,
    agency_id: str,
    families: tuple[str, ...],
    lon_deg: float,
    lat_deg: float,
    radius_m: float,
    *,
    limit: int = 1000,
) -> list[MarkerRow]:
    """The agency's markers of some families within a radius, all but the retired ones, nearest first."""
    parts = box_around(lon_deg, lat_deg, radius_m).parts
    values = {"agency": agency_id, "lon": lon_deg, "lat": lat_deg, "radius": radius_m, "most": limit}
    for k, box in enumerate(parts):
        values |= {f"w{k}": box.west_deg, f"s{k}": box.south_deg, f"e{k}": box.east_deg, f"n{k}": box.north_deg}
    return fetch_all(connection, _near(len(parts), families), MarkerRow, values)


@lru_cache
def _near(parts: int, families: tuple[str, ...]) -> AnySelect:
    """Statement of `list_near`, built once: every frame runs it, and building it costs more."""
    number = partial(sa.bindparam, type_=sa.Double)
    proposed = (
        proposed_by_index(markers, *(number(f"{side}{k}") for side in ("w", "s", "e", "n"))) for k in range(parts)
    )
    distance = distance_to(number("lon"), number("lat"))
    return (
        MARKERS.where(
            markers.c.agency_id == sa.bindparam("agency"),
            markers.c.family.in_(families),
            markers.c.status != "retired",
            sa.or_(*proposed),
            distance <= number("radius"),
        )
        .order_by(distance, markers.c.id)
        .limit(sa.bindparam("most", type_=sa.Integer))
    )


def find_code_near(
    connection: sa.Connection,
    digits: str,
    lon_deg: float,
    lat_deg: float,
    radius_m: float,
    *,
    mismatched_radius_m: float,
    ignoring: str | None = None,
) -> CodeRow | None:
    """A plate of any agency that carries these digits and may be on the road.

    It lies within `radius_m`, or within `mismatched_radius_m` if its digits are not those of its own position.
    """
    query = select_rows(CodeRow, markers).where(
        markers.c.digits == digits,
        markers.c.status != "retired",
        sa.or_(
            within_radius(lon_deg, lat_deg, radius_m),
            sa.and_(markers.c.digits_match_position.is_(False), within_radius(lon_deg, lat_deg, mismatched_radius_m)),
        ),
    )
    if ignoring is not None:
        query = query.where(markers.c.id != ignoring)
    with seeing_every_agency(connection):
        return find_one(connection, query.limit(1), CodeRow)


def find_id_code(connection: sa.Connection, digits: str, n: int) -> CodeRow | None:
    """The plate of any agency that carries, or once carried, these digits of the id scheme."""
    query = select_rows(CodeRow, markers).where(markers.c.digits == digits, markers.c.n == n, markers.c.scheme == "id")
    with seeing_every_agency(connection):
        return find_one(connection, query, CodeRow)


def add_marker(
    connection: sa.Connection, entry: AuditEntry, values: Mapping[str, Any], *, kind: str, why: str | None
) -> MarkerRow:
    """Store a new marker of the entry's agency with the first version of its history."""
    feature = feature_text(row_of(MarkerRow, values))
    connection.execute(sa.insert(markers).values(agency_id=entry.agency_id, feature=feature, **values))
    return _recorded(connection, entry, values["id"], kind=kind, why=why)


def update_marker(
    connection: sa.Connection,
    entry: AuditEntry,
    marker_id: str,
    changes: Mapping[str, Any],
    *,
    version: int,
    kind: str,
    why: str | None,
) -> MarkerRow:
    """Change a marker that is still at the version the caller read, and add to its history.

    Raises
    ------
    StaleVersion
        It was changed since.
    """
    changes = {**changes, "version": version + 1, "updated_at": entry.at}
    feature = feature_text(get_marker(connection, entry.agency_id, marker_id)._replace(**changes))
    statement = (
        sa.update(markers)
        .where(markers.c.id == marker_id, markers.c.agency_id == entry.agency_id, markers.c.version == version)
        .values(**changes, feature=feature)
    )
    if connection.execute(statement).rowcount != 1:
        raise StaleVersion(f"marker {marker_id} is no longer at version {version}", field="If-Match")
    return _recorded(connection, entry, marker_id, kind=kind, why=why)


def _recorded(connection: sa.Connection, entry: AuditEntry, marker_id: str, *, kind: str, why: str | None) -> MarkerRow:
    row = get_marker(connection, entry.agency_id, marker_id)
    add_versions(connection, [entry.version(marker_id, row.version, row._asdict(), kind=kind, why=why)])
    return row


# === Markers by the thousand: looked up by box, by digits and by number, and stored a chunk at a time.


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
) -> list[JsonObject]:
    """Markers in the order of their ids as flat records of these fields: columns, `code`, `side` of CERPMs, and
    `origin_crs` and `origin_realization`, in which a marker, or the road of its plan, came."""
    own = {
        "code": markers.c.digits,
        "side": markers.c.spec["side"].as_string(),
        "origin_crs": _origin_crs(),
        "origin_realization": _origin_realization(),
    }
    columns = [own[name].label(name) if name in own else markers.c[name] for name in fields]
    query = sa.select(*columns).where(markers.c.agency_id == agency_id, *conditions_of(filtered))
    if after is not None:
        query = query.where(markers.c.id > after)
    rows = connection.execute(query.order_by(markers.c.id).limit(limit)).all()
    return [dict(zip(fields, row, strict=True)) for row in rows]


def _origin_crs() -> sa.ColumnElement[str]:
    return sa.func.coalesce(markers.c.original[("plan", "crs")].as_string(), markers.c.crs)


def _origin_realization() -> sa.ColumnElement[str | None]:
    of_plan, own = markers.c.original[("plan", "realization")], markers.c.original["realization"]
    return sa.func.coalesce(of_plan.as_string(), own.as_string())


class MarkerOrigin(NamedTuple):
    """How a marker, or the road of its plan, came."""

    crs: str
    realization: str | None
    transform_accuracy_m: float | None


def find_origins(connection: sa.Connection, agency_id: str, ids: Sequence[str]) -> dict[str, MarkerOrigin]:
    """Origins of markers, by their ids."""
    columns = (markers.c.id, _origin_crs(), _origin_realization(), markers.c.transform_accuracy_m)
    query = sa.select(*columns).where(markers.c.agency_id == agency_id, markers.c.id.in_(ids))
    return {str(row[0]): MarkerOrigin(*row[1:]) for row in connection.execute(query)}


def origins(connection: sa.Connection, agency_id: str, filtered: MarkerFilter) -> list[tuple[str, str | None]]:
    """Systems and vertical datums in which markers, or the roads of their plans, came; the most frequent first."""
    crs = _origin_crs()
    query = sa.select(crs, markers.c.vertical_datum).where(markers.c.agency_id == agency_id, *conditions_of(filtered))
    query = query.group_by(crs, markers.c.vertical_datum).order_by(sa.func.count().desc(), crs).limit(100)
    return [(str(name), datum) for name, datum in connection.execute(query)]


def count_records(
    connection: sa.Connection, agency_id: str, filtered: MarkerFilter, *, with_retired: bool = True
) -> int:
    """Number of the agency's markers that a filter leaves."""
    query = sa.select(sa.func.count()).select_from(markers)
    if not with_retired:
        query = query.where(markers.c.status != "retired")
    return int(connection.execute(query.where(markers.c.agency_id == agency_id, *conditions_of(filtered))).scalar_one())


def have_heights(connection: sa.Connection, agency_id: str, filtered: MarkerFilter, *, ellipsoidal: bool) -> bool:
    """Whether every marker of the filter has a height, or an ellipsoidal one."""
    lacks: sa.ColumnElement[bool] = markers.c.height_m.is_(None)
    if ellipsoidal:
        lacks = sa.or_(lacks, markers.c.vertical_datum != ELLIPSOID)
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
    columns: Sequence[sa.ColumnElement[object]] = (),
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
