"""Points as features: pages, counts and extents for GIS clients. A `FeatureTable` says which rows, and of which table.

A page is asked for thousands of times a second, and building a statement costs more than running it. So a statement is
built once for each shape of a question, and every value in it is a bound parameter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property, lru_cache, partial
from operator import attrgetter
from typing import Any, NamedTuple

import orjson
import sqlalchemy as sa

from app.geodesy.systems import is_ellipsoidal
from app.markers.reading import MarkerRow
from app.registry.bulk_load import Columns, JsonTexts, json_objects, json_texts
from app.registry.column_types import AnyColumn, AnySelect
from app.registry.conditions import Condition, between_heights, condition_sql
from app.registry.marker_rows import markers
from app.registry.plan_states import find_plan_states
from app.registry.spatial import Box, proposed_by_index

_WIDE_DEG2 = 2_500.0  # from here on most markers are inside, and the order of the page finds them sooner than the index


class Field(NamedTuple):
    """A property of a feature: its name, its JSON type, its column, and what it means."""

    name: str
    kind: str
    column: AnyColumn
    text: str


_C = markers.c
_side = sa.case((_C.family == "cerpm", _C.spec["side"].as_string()))
FIELDS = (
    Field("family", "string", _C.family, "plate, magnet or cerpm"),
    Field("status", "string", _C.status, "planned, built, surveyed, active, suspect or retired"),
    Field("scheme", "string", _C.scheme, "How the code carries its meaning"),
    Field("code", "string", _C.digits, "Digits of a plate, text of a tag, number of a CERPM"),
    Field("heading_deg", "number", _C.heading_deg, "Direction of travel, clockwise from true north [deg]"),
    Field("heading_rmse_deg", "number", _C.heading_rmse_deg, "Accuracy of the heading [deg]"),
    Field("side", "string", _side, "Side of the lane that a CERPM is on"),
    Field("road", "string", _C.road, "Road's name or number"),
    Field("measure_m", "number", _C.measure_m, "Chainage along the road [m]"),
    Field("offset_m", "number", _C.offset_m, "Offset from the road's axis, left positive [m]"),
    Field("realization", "string", _C.realization, "Reference frame of the position"),
    Field("epoch", "number", _C.epoch, "Coordinate epoch [decimal year]"),
    Field("height_m", "number", _C.height_m, "Height above vertical_datum [m]"),
    Field("vertical_datum", "string", _C.vertical_datum, "What the height is above"),
    Field("horizontal_rmse_m", "number", _C.horizontal_rmse_m, "Horizontal accuracy [m]"),
    Field("vertical_rmse_m", "number", _C.vertical_rmse_m, "Vertical accuracy [m]"),
    Field("survey_method", "string", _C.survey_method, "How it was surveyed"),
    Field("check_points", "integer", _C.check_points, "Independent points that the accuracy was tested at"),
    Field("surveyor", "string", _C.surveyor, "Who surveyed"),
    Field("instrument", "string", _C.instrument, "With what it was surveyed"),
    Field(
        "transform_accuracy_m",
        "number",
        _C.transform_accuracy_m,
        "Accuracy of the reference frame: transformation, realization, epoch [m]",
    ),
    Field(
        "localization_grade",
        "string",
        _C.localization_grade,
        "cm, dm, m or unfit: what a vehicle may be localized by it to",
    ),
    Field("version", "integer", _C.version, "Version of the marker"),
    Field("updated_at", "date-time", _C.updated_at, "When it was last changed"),
)
FIELDS_BY_NAME = {field.name: field for field in FIELDS}
_RETIRED: sa.BindParameter[str] = sa.bindparam("retired", "retired", sa.String())


@dataclass(frozen=True, eq=False)
class FeatureTable:
    """Rows that are the features of a collection of points."""

    table: sa.Table  # with the columns row, id, agency_id, lon_deg, lat_deg and height_m, and a spatial index
    fields: tuple[Field, ...]
    owned: sa.ColumnElement[bool]  # which rows of the table they are
    text: AnyColumn  # the feature as GeoJSON, in one line
    changed: sa.ColumnElement[object]  # time of the last change
    tiled: tuple[str, ...]  # fields that points in tiles have
    cheap_to_count: frozenset[str]  # fields by which rows are counted in little time
    epoch: sa.ColumnElement[object] | None = None  # [decimal year] coordinate epoch of a row
    plans: sa.Table | None = None  # what the columns refer to besides: the plan of each row

    @property
    def source(self) -> sa.FromClause:
        """What is selected from."""
        if self.plans is None:
            return self.table
        return self.table.join(self.plans, self.plans.c.id == self.table.c.plan_id)

    @cached_property
    def columns(self) -> dict[str, sa.ColumnElement[object]]:
        """Columns by the names of their properties."""
        return {field.name: field.column for field in self.fields}

    @property
    def conditions(self) -> list[sa.ColumnElement[bool]]:
        """An agency's rows, by the parameter `agency`."""
        return [self.table.c.agency_id == sa.bindparam("agency"), self.owned]

    def values(self, connection: sa.Connection, agency_id: str) -> dict[str, object]:
        """Values of the parameters that all statements have."""
        values: dict[str, object] = {"agency": agency_id}
        if self.plans is not None:
            states = find_plan_states(connection, agency_id)
            values |= {name: sorted(getattr(states, name)) for name in states._fields}
        return values


TILE_FIELDS = ("family", "status", "code", "heading_deg", "road")
_MARKERS = (_C.feature, _C.updated_at, TILE_FIELDS, frozenset({"family", "code"}), _C.epoch)
ON_ROAD = FeatureTable(markers, FIELDS, _C.status != _RETIRED, *_MARKERS)
RETIRED = FeatureTable(markers, FIELDS, _C.status == _RETIRED, *_MARKERS)


@dataclass(frozen=True, slots=True)
class FeatureFilter:
    """Which features are asked for; None does not narrow."""

    table: FeatureTable = ON_ROAD  # of which collection
    box: Box | None = None
    # [m] lowest and highest ellipsoidal height; markers without one are included
    heights_m: tuple[float, float] | None = None
    # `since`, `until`: bounds of the last change, both inclusive
    since: datetime | None = None
    until: datetime | None = None
    equal: tuple[tuple[str, str | float], ...] = ()  # properties with a value
    where: Condition | None = None  # anything else that is asked of the properties


class _Shape(NamedTuple):
    """What a statement depends on; all else is bound."""

    table: FeatureTable
    wide: tuple[bool, ...]
    heights: bool
    since: bool
    until: bool
    equal: tuple[str, ...]
    where: Condition | None
    after: bool


@dataclass(frozen=True, slots=True)
class Extent:
    """What an agency's markers cover."""

    count: int
    west_deg: float
    south_deg: float
    east_deg: float
    north_deg: float
    first: datetime
    last: datetime
    epoch: float | None


def list_features(
    connection: sa.Connection,
    agency_id: str,
    filtered: FeatureFilter,
    *,
    after: str | None,
    limit: int,
    counted: bool = False,
) -> tuple[list[str], int | None]:
    """Features as `feature_text` writes them, in the order of their ids, and how many match if they are counted."""
    values = _values(connection, agency_id, filtered)
    if after is not None:
        values["after"] = after
    statement = _page(_shape(filtered, after is not None), counted)
    text, matched = connection.execute(statement, {**values, "most": limit}).one()
    return text.split("\n") if text else [], matched


def count_features(connection: sa.Connection, agency_id: str, filtered: FeatureFilter) -> int:
    """How many features a filter leaves."""
    return int(
        connection.execute(_count(_shape(filtered, False)), _values(connection, agency_id, filtered)).scalar_one()
    )


def find_feature(connection: sa.Connection, agency_id: str, feature_id: str, table: FeatureTable) -> str | None:
    """One feature as `list_features` has them."""
    values = {**table.values(connection, agency_id), "id": feature_id}
    return connection.execute(_one(table), values).scalar_one_or_none()


def find_extent(connection: sa.Connection, agency_id: str, table: FeatureTable) -> Extent | None:
    """What the agency's features cover, and their epoch if all state the same one; None without any feature."""
    row = connection.execute(_extent(table), {"agency": agency_id}).one()
    if not row.total:
        return None
    same = row.epochs == row.total and row.min_epoch == row.max_epoch
    return Extent(
        row.total, row.west, row.south, row.east, row.north, row.first, row.last, row.min_epoch if same else None
    )


def _shape(filtered: FeatureFilter, after: bool) -> _Shape:
    parts = filtered.box.parts if filtered.box is not None else ()
    return _Shape(
        filtered.table,
        tuple((p.east_deg - p.west_deg) * (p.north_deg - p.south_deg) >= _WIDE_DEG2 for p in parts),
        filtered.heights_m is not None,
        filtered.since is not None,
        filtered.until is not None,
        tuple(name for name, _ in filtered.equal),
        filtered.where,
        after,
    )


def _values(connection: sa.Connection, agency_id: str, filtered: FeatureFilter) -> dict[str, object]:
    values = filtered.table.values(connection, agency_id)
    for k, box in enumerate(filtered.box.parts if filtered.box is not None else ()):
        values |= {f"w{k}": box.west_deg, f"s{k}": box.south_deg, f"e{k}": box.east_deg, f"n{k}": box.north_deg}
    if filtered.heights_m is not None:
        values["low"], values["high"] = filtered.heights_m
    if filtered.since is not None:
        values["since"] = filtered.since
    if filtered.until is not None:
        values["until"] = filtered.until
    for k, (_, value) in enumerate(filtered.equal):
        values[f"v{k}"] = value
    return values


def in_box(k: int, wide: bool = False, table: sa.Table = markers) -> sa.ColumnElement[bool]:
    """Rows in the box of the parameters wK, sK, eK, nK: the index proposes, the exact columns decide."""
    number = partial(sa.bindparam, type_=sa.Double)
    west, south, east, north = (number(f"{side}{k}") for side in "wsen")
    exact = sa.and_(table.c.lon_deg.between(west, east), table.c.lat_deg.between(south, north))
    if wide:
        return exact
    return sa.and_(proposed_by_index(table, west, south, east, north), exact)


def _conditions(shape: _Shape) -> list[sa.ColumnElement[bool]]:
    table, c = shape.table, shape.table.table.c
    conditions = table.conditions
    if shape.wide:
        conditions.append(sa.or_(*(in_box(k, wide, table.table) for k, wide in enumerate(shape.wide))))
    if shape.heights:
        low, high = sa.bindparam("low", type_=sa.Double), sa.bindparam("high", type_=sa.Double)
        conditions.append(between_heights(table.table, low, high))
    if shape.since:
        conditions.append(table.changed >= sa.bindparam("since", type_=table.changed.type))
    if shape.until:
        conditions.append(table.changed <= sa.bindparam("until", type_=table.changed.type))
    for k, name in enumerate(shape.equal):
        column = table.columns[name]
        conditions.append(column == sa.bindparam(f"v{k}", type_=column.type))
    if shape.where is not None:
        conditions.append(condition_sql(shape.where, table.columns, table.table))
    if shape.after:
        conditions.append(c.id > sa.bindparam("after"))
    return conditions


@lru_cache(maxsize=1024)
def _page(shape: _Shape, counted: bool) -> AnySelect:
    """One row: a line for each feature. A driver that fetches a hundred rows gives way to other threads at each."""
    most = sa.bindparam("most", type_=sa.Integer)
    matched: AnyColumn = sa.null()
    if counted:  # in the same statement, so that it is the same snapshot
        matched = _count(shape._replace(after=False)).correlate(None).scalar_subquery()
    table = shape.table
    rows = sa.select(table.text.label("feature")).select_from(table.source)
    page = rows.where(*_conditions(shape)).order_by(table.table.c.id).limit(most).subquery()
    return sa.select(sa.func.aggregate_strings(page.c.feature, "\n"), matched)


@lru_cache(maxsize=1024)
def _count(shape: _Shape) -> AnySelect:
    return sa.select(sa.func.count()).select_from(shape.table.source).where(*_conditions(shape))


@lru_cache
def _one(table: FeatureTable) -> AnySelect:
    query = sa.select(table.text).select_from(table.source)
    return query.where(*table.conditions, table.table.c.id == sa.bindparam("id"))


@lru_cache
def _extent(table: FeatureTable) -> AnySelect:
    c, epoch = table.table.c, sa.null() if table.epoch is None else table.epoch
    figures: Mapping[str, AnyColumn] = {
        "total": sa.func.count(),
        "west": sa.func.min(c.lon_deg),
        "south": sa.func.min(c.lat_deg),
        "east": sa.func.max(c.lon_deg),
        "north": sa.func.max(c.lat_deg),
        "first": sa.func.min(table.changed),
        "last": sa.func.max(table.changed),
        "epochs": sa.func.count(epoch),
        "min_epoch": sa.func.min(epoch),
        "max_epoch": sa.func.max(epoch),
    }
    columns = (figure.label(name) for name, figure in figures.items())
    return sa.select(*columns).select_from(table.source).where(*table.conditions)


# === A marker's GeoJSON feature, as the row keeps it beside its columns: pages are read a thousand times a second, and
#
# putting a hundred features together for each takes longer than all the rest (decision 0006).
#
# Whatever writes a marker writes this with it. A property that is added to `FIELDS` needs a migration that writes all
# texts again.


PROPERTIES = {field.name: field.column.key or "spec" for field in FIELDS}
"""Properties in their order, and the columns that they come from; of `spec` a CERPM's side."""
_pick = attrgetter(*PROPERTIES.values())


def feature_text(marker: MarkerRow) -> str:
    """The feature of a marker: WGS 84 longitude and latitude, and its height if that is ellipsoidal; one line.

    A height in a geometry is above the ellipsoid: RFC 7946 section 4. Others are in the properties, with their datum.
    """
    lon_deg, lat_deg = marker.lon_deg, marker.lat_deg
    height_m = marker.height_m if is_ellipsoidal(marker.vertical_datum) else None
    properties = dict(zip(PROPERTIES, _pick(marker), strict=True))
    properties["side"] = _cerpm_side(marker.spec) if marker.family == "cerpm" else None
    feature = {
        "type": "Feature",
        "id": marker.id,
        "geometry": {
            "type": "Point",
            "coordinates": (lon_deg, lat_deg) if height_m is None else (lon_deg, lat_deg, height_m),
        },
        "properties": properties,
    }
    return orjson.dumps(feature, option=orjson.OPT_UTC_Z).decode()


def feature_texts(columns: Columns) -> list[str]:
    """As `feature_text`, of markers given by column."""
    same, own = (
        {name: of[column] for name, column in PROPERTIES.items() if column in of} for of in (columns.same, columns.own)
    )
    kinds = zip(columns.values("family"), columns.values("spec"), strict=True)
    properties = Columns(columns.count, same, own).but(
        side=[_cerpm_side(spec) if family == "cerpm" else None for family, spec in kinds],
        updated_at=list(map(_time, columns.values("updated_at"))),
    )
    places = zip(*(json_texts(columns.values(name)) for name in ("lon_deg", "lat_deg", "height_m")), strict=True)
    flat = [not is_ellipsoidal(datum) for datum in columns.values("vertical_datum")]
    coordinates = (
        f"{lon},{lat}" if is_flat or height == "null" else f"{lon},{lat},{height}"
        for (lon, lat, height), is_flat in zip(places, flat, strict=True)
    )
    members: dict[str, Sequence[object]] = {
        "id": columns.values("id"),
        "geometry": JsonTexts([f'{{"type":"Point","coordinates":[{place}]}}' for place in coordinates]),
        "properties": json_objects(properties, names=tuple(PROPERTIES)),
    }
    return json_objects(Columns(columns.count, {"type": "Feature"}, members), names=("type", *members))


@lru_cache(maxsize=64)  # the rows of an import have the same
def _time(at: datetime) -> orjson.Fragment:
    return orjson.Fragment(orjson.dumps(at, option=orjson.OPT_UTC_Z))


def _cerpm_side(spec: Any) -> str | None:
    if isinstance(spec, orjson.Fragment):
        return _side_in(spec.contents)
    return None if spec is None else spec.get("side")


@lru_cache(maxsize=64)  # the rows of an import have the same
def _side_in(spec: bytes | str) -> str | None:
    side: str | None = orjson.loads(spec)["side"]
    return side
