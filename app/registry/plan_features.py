"""Markers that are planned in plans, and lanes of alignments, as features for GIS clients."""

from __future__ import annotations

from collections.abc import Generator, Sequence

import sqlalchemy as sa
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.functions import FunctionElement

from app.registry.bulk_load import Columns, load_columns
from app.registry.column_types import ID, agency_column, metadata
from app.registry.features import Extent, FeatureFilter, FeatureTable, Field
from app.registry.lines import Line
from app.registry.plan_states import BUILT, COMMITTED, SURVEYED, plans
from app.registry.plans import alignments
from app.registry.spatial import Box

FEATURE_ID = sa.String(48)
"""Id of an alignment or a plan, a point, and a number of five or seven digits, so that texts are in its order."""

alignment_lanes = sa.Table(
    "alignment_lanes",
    metadata,
    sa.Column("id", FEATURE_ID, primary_key=True),
    agency_column(),
    sa.Column("alignment_id", ID, sa.ForeignKey("alignments.id"), nullable=False),
    sa.Column("west_deg", sa.Double, nullable=False),
    sa.Column("south_deg", sa.Double, nullable=False),
    sa.Column("east_deg", sa.Double, nullable=False),
    sa.Column("north_deg", sa.Double, nullable=False),
    sa.Column("properties", sa.JSON, nullable=False),
    sa.Column("points_deg", sa.JSON, nullable=False),
    sa.Index("ix_alignment_lanes_agency_id_id", "agency_id", "id"),
)

planned_markers = sa.Table(
    "planned_markers",
    metadata,
    # the integer key is what the spatial index refers to
    sa.Column("row", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), primary_key=True, autoincrement=True),
    sa.Column("id", FEATURE_ID, nullable=False, unique=True),
    agency_column(),
    sa.Column("plan_id", ID, sa.ForeignKey("plans.id"), nullable=False),
    sa.Column("number", sa.Integer, nullable=False),
    sa.Column("family", sa.String(16), nullable=False),
    sa.Column("code", sa.String(64), nullable=False),
    sa.Column("purpose", sa.String(32), nullable=False),
    sa.Column("lane", sa.Text, nullable=False),
    sa.Column("side", sa.String(16)),
    sa.Column("chainage_m", sa.Double, nullable=False),
    sa.Column("station_m", sa.Double, nullable=False),
    sa.Column("offset_m", sa.Double, nullable=False),
    sa.Column("heading_deg", sa.Double, nullable=False),
    sa.Column("vertical_datum", sa.String(64)),
    sa.Column("lon_deg", sa.Double, nullable=False),
    sa.Column("lat_deg", sa.Double, nullable=False),
    sa.Column("height_m", sa.Double),
    # the feature between its id and what follows from the plan: registry/features_of_plans.py
    sa.Column("feature", sa.Text, nullable=False),
    sa.Index("ix_planned_markers_agency_id_id", "agency_id", "id"),
    sa.Index("ix_planned_markers_plan_id", "plan_id"),
    sqlite_autoincrement=True,
)

_PAGE = 200  # lanes that are read at a time
_P = planned_markers.c


class _JsonText(FunctionElement[str]):
    """A text as a JSON string."""

    name = "waymark_json_text"
    type = sa.String()
    inherit_cache = True


@compiles(_JsonText, "sqlite")
def _by_json_quote(element: _JsonText, compiler: SQLCompiler, **how: object) -> str:
    return f"json_quote({compiler.process(element.clauses, **how)})"


@compiles(_JsonText, "postgresql")
def _by_to_json(element: _JsonText, compiler: SQLCompiler, **how: object) -> str:
    return f"to_json(({compiler.process(element.clauses, **how)})::text)::text"


def _one_of(name: str) -> sa.ColumnElement[bool]:
    """Plans whose ids are in a parameter; see `FeatureTable.values`."""
    return plans.c.id.in_(sa.bindparam(name, expanding=True, type_=sa.String()))


_STATUS = sa.case(
    (plans.c.status != COMMITTED, plans.c.status),
    (_one_of("built"), BUILT),
    (_one_of("surveyed"), SURVEYED),
    else_=COMMITTED,
)
PLAN_FIELDS = (
    Field("number", "integer", _P.number, "In its plan, from 1"),
    Field("family", "string", _P.family, "plate, magnet or cerpm"),
    Field("code", "string", _P.code, "Digits of a plate, text of a tag, number of a CERPM"),
    Field("purpose", "string", _P.purpose, "Why it is there"),
    Field("lane", "string", _P.lane, "Name of the lane"),
    Field("side", "string", _P.side, "Side of the lane that a line magnet or a CERPM is on"),
    Field("chainage_m", "number", _P.chainage_m, "Along the lane [m]"),
    Field("station_m", "number", _P.station_m, "Station as signs and drawings show it [m]"),
    Field("offset_m", "number", _P.offset_m, "From the lane's centre line, left positive [m]"),
    Field("heading_deg", "number", _P.heading_deg, "Direction of travel, clockwise from true north [deg]"),
    Field("height_m", "number", _P.height_m, "Height above vertical_datum [m]"),
    Field("vertical_datum", "string", _P.vertical_datum, "What the height is above"),
    Field("plan_id", "string", _P.plan_id, "Id of the plan"),
    Field("plan", "string", plans.c.name, "Name of the plan"),
    Field("status", "string", _STATUS, "Of the plan: draft, checked, proved, approved, committed, built or surveyed"),
)
OF_MARKER = tuple(field.name for field in PLAN_FIELDS[:12])
"""Properties that are in the stored part of a feature; the others follow from the plan."""
_TEXT = sa.literal_column('\'{"type":"Feature","id":"\'', sa.String()).concat(_P.id).concat('",')
_TEXT = _TEXT.concat(_P.feature).concat(',"plan_id":"').concat(_P.plan_id).concat('","plan":')
_TEXT = _TEXT.concat(_JsonText(plans.c.name)).concat(',"status":"').concat(_STATUS).concat('"}}')
PLANNED = FeatureTable(
    planned_markers, PLAN_FIELDS, sa.true(), _TEXT, plans.c.updated_at, ("family", "status", "code", "number", "plan"),
    frozenset({"plan_id"}), plans=plans,
)  # fmt: skip


def replace_planned(connection: sa.Connection, agency_id: str, plan_id: str, rows: Columns) -> None:
    """Store the markers of a plan in place of those that it had.

    Parameters
    ----------
    rows : Columns
        Those of `planned_markers` but the ids.
    """
    connection.execute(sa.delete(planned_markers).where(_P.plan_id == plan_id, _P.agency_id == agency_id))
    if rows.count:
        ids = [f"{plan_id}.{number:07d}" for number in rows.values("number")]
        same = {**rows.same, "agency_id": agency_id, "plan_id": plan_id}
        load_columns(connection, planned_markers, Columns(rows.count, same, {**rows.own, "id": ids}))


# --- lanes of alignments ----------------------------------------------------------------------------------------------

LANE_FIELDS = tuple(
    Field(name, kind, sa.null(), text)
    for name, kind, text in (
        ("alignment_id", "string", "Id of the alignment"),
        ("alignment", "string", "Name of the alignment"),
        ("lane", "string", "Name of the lane"),
        ("road", "string", "Name of the road"),
        ("length_m", "number", "Along the centre line of the lane [m]"),
        ("min_width_m", "number", "Least width [m]"),
        ("max_width_m", "number", "Greatest width [m]"),
        ("min_speed_kmh", "number", "Least design speed [km/h]"),
        ("max_speed_kmh", "number", "Greatest design speed [km/h]"),
        ("min_radius_m", "number", "Of the sharpest bend; null on a straight [m]"),
        ("max_curvature_per_m", "number", "Of the sharpest bend [1/m]"),
        ("max_grade", "number", "Steepest rise or fall per distance"),
        ("left_style", "string", "Paint of the left boundary"),
        ("right_style", "string", "Paint of the right boundary"),
        ("localization_grade", "string", "cm, dm, m or unfit: best grade that positions along it can have"),
    )
)


class AlignmentLanes:
    """The lanes of alignments as lines, by alignment and lane."""

    def read(
        self, connection: sa.Connection, agency_id: str, filtered: FeatureFilter, after: str | None
    ) -> Generator[Line]:
        """The agency's lanes after one, as many as are taken; those that are not near the box may be left out."""
        c = alignment_lanes.c
        query = sa.select(c.id, c.properties, c.points_deg, alignments.c.name).join(alignments)
        query = query.where(c.agency_id == agency_id, *_near(filtered.box))
        if filtered.since is not None:
            query = query.where(alignments.c.updated_at >= filtered.since)
        if filtered.until is not None:
            query = query.where(alignments.c.updated_at <= filtered.until)
        query, last = query.order_by(c.id).limit(_PAGE), after or ""
        while rows := connection.execute(query.where(c.id > last)).all():
            yield from (_line(*row) for row in rows)
            last = rows[-1].id

    def find(self, connection: sa.Connection, agency_id: str, lane_id: str) -> Line | None:
        """The lane with an id."""
        c = alignment_lanes.c
        query = sa.select(c.id, c.properties, c.points_deg, alignments.c.name).join(alignments)
        row = connection.execute(query.where(c.agency_id == agency_id, c.id == lane_id)).one_or_none()
        return None if row is None else _line(*row)

    def extent(self, connection: sa.Connection, agency_id: str) -> Extent | None:
        """What the agency's lanes cover."""
        c, f = alignment_lanes.c, sa.func
        box = f.min(c.west_deg), f.min(c.south_deg), f.max(c.east_deg), f.max(c.north_deg)
        times = f.min(alignments.c.updated_at), f.max(alignments.c.updated_at)
        query = sa.select(f.count(), *box, *times).select_from(alignment_lanes.join(alignments))
        count, west, south, east, north, first, last = connection.execute(query.where(c.agency_id == agency_id)).one()
        return Extent(count, west, south, east, north, first, last, None) if count else None


def add_lanes(
    connection: sa.Connection,
    agency_id: str,
    alignment_id: str,
    lanes: Sequence[tuple[dict[str, object], list[list[float]]]],
) -> None:
    """Store the properties and the points [lon, lat] of the lanes of a new alignment."""
    rows = [
        {
            "id": f"{alignment_id}.{number:05d}", "agency_id": agency_id, "alignment_id": alignment_id,
            "west_deg": min(lon for lon, _ in points), "south_deg": min(lat for _, lat in points),
            "east_deg": max(lon for lon, _ in points), "north_deg": max(lat for _, lat in points),
            "properties": properties, "points_deg": points,
        }
        for number, (properties, points) in enumerate(lanes, 1)
    ]  # fmt: skip
    if rows:
        connection.execute(sa.insert(alignment_lanes), rows)


def _near(box: Box | None) -> list[sa.ColumnElement[bool]]:
    if box is None:
        return []
    c = alignment_lanes.c
    parts = [
        sa.and_(
            c.west_deg <= part.east_deg,
            c.east_deg >= part.west_deg,
            c.south_deg <= part.north_deg,
            c.north_deg >= part.south_deg,
        )
        for part in box.parts
    ]
    return [sa.or_(*parts)]


def _line(lane_id: str, properties: dict[str, object], points: list[tuple[float, float]], alignment: str) -> Line:
    named = {"alignment_id": lane_id.partition(".")[0], "alignment": alignment, **properties}
    return Line(lane_id, named, [(lon, lat) for lon, lat in points])
