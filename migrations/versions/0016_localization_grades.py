"""Grades of positions by their accuracy, in place of exact and approximate; heights of features.

A feature's geometry keeps only ellipsoidal heights, and the property height_m has every height. Grades are computed by
the rule of the application as it is when this runs: a later change of that rule comes with a migration of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import orjson
import sqlalchemy as sa
from alembic import op

from app.geodesy import grade_accuracy
from app.geodesy.place import stored_frame
from app.registry.conditions import regraded

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None

CHUNK = 5000
EXACT, APPROXIMATE = "exact", "approximate, not for localization"
FORMER_LIMIT_M = 0.1
"""Worst accuracy of a transformation whose result was exact, where a road does not keep it. [m]"""
PROPERTIES = {
    "family": "family", "status": "status", "scheme": "scheme", "code": "digits", "heading_deg": "heading_deg",
    "heading_rmse_deg": "heading_rmse_deg", "side": "side", "road": "road", "measure_m": "measure_m",
    "offset_m": "offset_m", "realization": "realization", "epoch": "epoch", "height_m": "height_m",
    "vertical_datum": "vertical_datum", "horizontal_rmse_m": "horizontal_rmse_m",
    "vertical_rmse_m": "vertical_rmse_m", "survey_method": "survey_method", "check_points": "check_points",
    "surveyor": "surveyor", "instrument": "instrument", "transform_accuracy_m": "transform_accuracy_m",
    "localization_grade": "localization_grade", "version": "version", "updated_at": "updated_at",
}  # fmt: skip
_own = {"row", "id", "lon_deg", "lat_deg", "crs", "transform_note", *PROPERTIES.values()} - {"side", "updated_at"}
markers = sa.table(
    "markers",
    *(sa.column(name) for name in sorted(_own)),
    sa.column("updated_at", sa.DateTime(timezone=True)),
    sa.column("spec", sa.JSON),
    sa.column("feature"),
)
planned = sa.table("planned_markers", *(sa.column(n) for n in ("row", "height_m", "vertical_datum", "feature")))
roads = sa.table("roads", sa.column("id"), sa.column("localization_grade"), sa.column("given", sa.JSON),
                 sa.column("parts", sa.JSON))  # fmt: skip
alignments = sa.table("alignments", sa.column("id"), sa.column("declaration", sa.JSON), sa.column("summary", sa.JSON))
lanes = sa.table("alignment_lanes", sa.column("id"), sa.column("alignment_id"), sa.column("properties", sa.JSON))


def upgrade() -> None:
    _change_markers(lambda row: regraded(row), heights=True)
    _change_planned(heights=True)
    connection = op.get_bind()
    for row in connection.execute(sa.select(roads)).mappings().all():
        given, place = row["given"], row["parts"][0][0]
        accuracy_m = _accuracy_m(row["localization_grade"], given["crs"], place, given)
        values = {"given": {**given, "transform_accuracy_m": accuracy_m}, "localization_grade": _grade(accuracy_m)}
        connection.execute(sa.update(roads).where(roads.c.id == row["id"]).values(**values))
    for row in connection.execute(sa.select(alignments)).mappings().all():
        summary = row["summary"]
        was, place = summary["localization_grade"], summary["extent_deg"]
        accuracy_m = _accuracy_m(was, summary["crs"], place, {**summary, "epoch": row["declaration"].get("epoch")})
        _grade_alignment(row, _grade(accuracy_m))


def downgrade() -> None:
    _change_markers(lambda row: {"localization_grade": _former(row["transform_accuracy_m"] is not None)}, heights=False)
    _change_planned(heights=False)
    connection = op.get_bind()
    for row in connection.execute(sa.select(roads)).mappings().all():
        given = {name: value for name, value in row["given"].items() if name != "transform_accuracy_m"}
        values = {"given": given, "localization_grade": _former(row["localization_grade"] != "unfit")}
        connection.execute(sa.update(roads).where(roads.c.id == row["id"]).values(**values))
    for row in connection.execute(sa.select(alignments)).mappings().all():
        _grade_alignment(row, _former(row["summary"]["localization_grade"] != "unfit"))


def _former(stated: bool) -> str:
    return EXACT if stated else APPROXIMATE


def _grade(accuracy_m: float | None) -> str:
    return str(grade_accuracy(accuracy_m))


def _accuracy_m(was: str, crs: str, place: list[float], frame: dict[str, Any]) -> float | None:
    if was != EXACT:
        return None
    stated = (frame.get("realization"), frame.get("epoch"))
    return stored_frame(crs, (place[0], place[1]), *stated, FORMER_LIMIT_M)[0]


def _grade_alignment(row: sa.RowMapping, grade: str) -> None:
    connection = op.get_bind()
    summary = {**row["summary"], "localization_grade": grade}
    connection.execute(sa.update(alignments).where(alignments.c.id == row["id"]).values(summary=summary))
    mine = sa.select(lanes).where(lanes.c.alignment_id == row["id"])
    for lane in connection.execute(mine).mappings().all():
        properties = {**lane["properties"], "localization_grade": grade}
        connection.execute(sa.update(lanes).where(lanes.c.id == lane["id"]).values(properties=properties))


def _change_markers(change: Callable[[dict[str, Any]], dict[str, Any]], *, heights: bool) -> None:
    c = markers.c
    side = sa.case((c.family == "cerpm", c.spec["side"].as_string())).label("side")
    query = sa.select(*(c[name] for name in sorted(_own)), c.updated_at, side)
    changed = ("localization_grade", "transform_accuracy_m", "transform_note", "feature")
    update = sa.update(markers).where(c.row == sa.bindparam("_row"))
    update = update.values({name: sa.bindparam(f"_{name}") for name in changed})
    for rows in _chunks(query, c.row):
        values = []
        for row in rows:
            new = {**row, **change(row)}
            new["feature"] = _text(new, heights=heights)
            values.append({"_row": row["row"], **{f"_{name}": new[name] for name in changed}})
        op.get_bind().execute(update, values)


def _chunks(query: sa.Select[Any], row: sa.ColumnClause[Any]) -> Iterator[list[dict[str, Any]]]:
    last = -1
    query = query.order_by(row).limit(CHUNK)
    while rows := [dict(found) for found in op.get_bind().execute(query.where(row > last)).mappings()]:
        yield rows
        last = rows[-1]["row"]


def _text(row: dict[str, Any], *, heights: bool) -> str:
    """The feature of a marker; with `heights` as this revision writes it, without as 0010 did."""
    names = PROPERTIES if heights else {name: column for name, column in PROPERTIES.items() if name != "height_m"}
    flat = row["height_m"] is None or (heights and row["vertical_datum"] not in (None, "ellipsoid"))
    place = (row["lon_deg"], row["lat_deg"], row["height_m"])
    feature = {
        "type": "Feature",
        "id": row["id"],
        "geometry": {"type": "Point", "coordinates": place[:2] if flat else place},
        "properties": {name: row[column] for name, column in names.items()},
    }
    return orjson.dumps(feature, option=orjson.OPT_UTC_Z | orjson.OPT_NAIVE_UTC).decode()


def _change_planned(*, heights: bool) -> None:
    c = planned.c
    update = sa.update(planned).where(c.row == sa.bindparam("_row")).values(feature=sa.bindparam("_feature"))
    for rows in _chunks(sa.select(planned), c.row):
        op.get_bind().execute(update, [{"_row": r["row"], "_feature": _planned_text(r, heights=heights)} for r in rows])


def _planned_text(row: dict[str, Any], *, heights: bool) -> str:
    feature = orjson.loads("{" + row["feature"] + "}}")
    place, height_m = feature["geometry"]["coordinates"][:2], row["height_m"]
    if height_m is not None and (not heights or row["vertical_datum"] in (None, "ellipsoid")):
        place.append(height_m)
    properties = {name: value for name, value in feature["properties"].items() if name != "height_m"}
    if heights:
        datum = properties.pop("vertical_datum")
        properties |= {"height_m": height_m, "vertical_datum": datum}
    feature = {"geometry": {**feature["geometry"], "coordinates": place}, "properties": properties}
    return orjson.dumps(feature).decode()[1:-2]
