"""Migration 0027 on rows of the revision before it: other names and values, and back to the same rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import orjson
import pytest
import sqlalchemy as sa

from app.registry.database import Database
from app.registry.decodes import get_decode
from app.registry.health import get_item
from app.registry.public_pages import get_report

NOW = datetime(2026, 3, 4, 5, 6, 7, 890123, tzinfo=UTC)
AGENCY = "019cb624-0000-7000-8000-00000000aaaa"
MARKER = "019cb624-0000-7000-8000-00000000bbbb"
ITEM_STATES = ("open", "approved", "dismissed")
REPORT_STATES = ("new", "accepted", "rejected")
CONTEXT = {"packets": {"file_name": "log.csv", "columns": {"speed_km_h": "limit"}}}
RESULT = {"lane": {"speed_limits_km_h": [50], "path": {"curvature_1pm": [0.1], "note": "curvature_1pm"}}}
NAMED = {"lane": {"speed_limits_kmh": [50], "path": {"curvature_per_m": [0.1], "note": "curvature_per_m"}}}
_JSON = sa.JSON(none_as_null=True)


def _id(k: int) -> str:
    return f"019cb624-0000-7000-8000-{k:012x}"


def _feature(k: int) -> str:
    return orjson.dumps({"id": _id(k), "properties": {"status": ITEM_STATES[k], "note": "state"}}).decode()


@pytest.fixture
def database(tmp_path: Path, new_database_url: Callable[[Path], str]) -> Iterator[Database]:
    """A database at the revision before, with items and reports in every state."""
    database = Database(new_database_url(tmp_path))
    database.open()
    database.migrate("0026")
    with database.write() as connection:
        _insert(connection)
    yield database
    database.close()


def _insert(connection: sa.Connection) -> None:
    owned = {"agency_id": AGENCY, "created_at": NOW}
    place = {"lon_deg": 1.0, "lat_deg": 2.0}
    marker = {
        "family": "plate", "status": "active", "crs": "EPSG:4326", "original": {}, "localization_grade": "exact",
        "version": 1, "updated_at": NOW, "feature": "", **place, **owned,
    }  # fmt: skip
    items = [
        {
            "id": _id(k), "subject": MARKER, "marker_id": MARKER, "family": "plate", "what": "missing", "state": state,
            "priority": 0.5, "ratio": 3.0, "vehicles": 2, "passes": 3, "first_at": NOW, "last_at": NOW, "evidence": {},
            "version": 1, "updated_at": NOW, "feature": _feature(k), **place, **owned,
        }
        for k, state in enumerate(ITEM_STATES)
    ]  # fmt: skip
    reports = [
        {
            "id": _id(k), "marker_id": MARKER, "form_nonce": str(k), "kind": "dirty", "language": "en", "state": state,
            "item_id": _id(1) if state == "accepted" else None, **owned,
        }
        for k, state in enumerate(REPORT_STATES)
    ]  # fmt: skip
    decode = {"id": _id(9), "kind": "packets", "context": CONTEXT, "result": RESULT, **owned}
    job = {"id": _id(9), "kind": "decode", "state": "done", "input": CONTEXT, "progress": 1.0, **owned}
    inputs = {"decodes": [{"decode_id": _id(9), "sigma_s": 0.5}]}
    drive = {**job, "id": _id(8), "kind": "drive", "input": inputs}
    run = {"id": _id(0), "who": "w", "criteria": {}, "decodes": 1, "accepted_at": NOW, "accepted_by": "chief", **owned}
    contact = {"report_id": _id(1), "email": "a@example.org", **owned}
    rows: dict[str, list[dict[str, Any]]] = {
        "agencies": [{"id": AGENCY, "name": "one", "created_at": NOW}], "markers": [{"id": MARKER, **marker}],
        "maintenance_items": items, "damage_reports": reports, "damage_report_contacts": [contact],
        "jobs": [job, drive], "decodes": [decode], "reprocessings": [run],
    }  # fmt: skip
    for name, values in rows.items():
        connection.execute(sa.insert(_like(name, values[0])), values)


def _like(name: str, values: dict[str, Any]) -> sa.TableClause:
    kinds = {dict: _JSON, datetime: sa.DateTime(timezone=True)}
    return sa.table(name, *(sa.column(column, kinds.get(type(value))) for column, value in values.items()))


def _rows(database: Database) -> dict[str, list[dict[str, Any]]]:
    names = ("maintenance_items", "damage_reports", "damage_report_contacts", "decodes", "jobs", "reprocessings")
    with database.read() as connection:
        return {
            name: [
                {column: _read(value) for column, value in row.items()}
                for row in connection.execute(sa.text(f"SELECT * FROM {name} ORDER BY 1, 2")).mappings()
            ]
            for name in names
        }


def _read(value: object) -> object:
    return orjson.loads(value) if isinstance(value, str) and value.startswith("{") else value


def test_decisions_and_units_have_the_new_words(database: Database) -> None:
    database.migrate()
    assert database.is_ready()
    with database.read() as connection:
        for k, status in enumerate(("open", "approved", "rejected")):
            assert get_item(connection, AGENCY, _id(k)).status == status
            feature = connection.execute(
                sa.text("SELECT feature FROM maintenance_items WHERE id = :id"), {"id": _id(k)}
            )
            assert orjson.loads(feature.scalar_one())["properties"] == {"status": status, "note": "state"}
        for k, status in enumerate(("new", "approved", "rejected")):
            row = get_report(connection, AGENCY, _id(k))
            assert (row.report.status, row.report.item_id) == (status, _id(1) if k == 1 else None)
        assert get_report(connection, AGENCY, _id(1)).has_contact
        decode = get_decode(connection, AGENCY, _id(9))
        assert decode.result == NAMED
        assert decode.context == {"packets": {"columns": {"speed_kmh": "limit"}}, "file_name": "log.csv"}
        drive = connection.execute(sa.text("SELECT input FROM jobs WHERE kind = 'drive'")).scalar_one()
        named = drive if isinstance(drive, dict) else orjson.loads(drive)
        assert named["decodes"] == [{"id": _id(9), "clock_sigma_s": 0.5}]
        approved = sa.text("SELECT approved_by FROM reprocessings")
        assert connection.execute(approved).scalar_one() == "chief"


@pytest.mark.parametrize("values", [("maintenance_items", "dismissed"), ("damage_reports", "accepted")])
def test_the_old_values_are_refused(database: Database, values: tuple[str, str]) -> None:
    database.migrate()
    with pytest.raises(sa.exc.IntegrityError), database.write() as connection:
        connection.execute(sa.text(f"UPDATE {values[0]} SET status = :old"), {"old": values[1]})


def test_back_and_forth_changes_nothing(database: Database) -> None:
    before = _rows(database)
    for _ in range(2):
        database.migrate()
        assert _rows(database) != before
        database.migrate("0026")
        assert _rows(database) == before
    database.migrate()
    assert database.is_ready()
    with database.write() as connection, pytest.raises(sa.exc.IntegrityError):
        connection.execute(sa.text("DELETE FROM markers"))
