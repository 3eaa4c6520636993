"""Migrations up, down and up again over a registry that holds everything: what the older schema knows stays."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest
import sqlalchemy as sa

from app.markers.reading import MarkerRow
from app.registry.audit import ChainReport, check_history, find_head, version_sha256
from app.registry.bulk_load import load_rows
from app.registry.column_types import row_of
from app.registry.conditions import regraded
from app.registry.database import Database
from app.registry.features import feature_text
from app.registry.history import list_versions
from app.registry.marker_rows import markers
from app.registry.markers import MarkerFilter, list_magnets_in, list_markers
from app.registry.spatial import Box
from app.registry.tables import metadata
from app.services.access.audit import AuditLog

NOW = datetime(2026, 3, 4, 5, 6, 7, 890123, tzinfo=UTC)
AGENCY = "019cb624-0000-7000-8000-00000000aaaa"
DECODE = "019cb624-0000-7000-8000-00000000dddd"
FAMILIES = ("plate", "magnet", "cerpm")
MARKERS = 2_000
LARGE = 11_000
"""Two chunks of 5000 rows, as migration 0010 reads them, and a part of a third; five of 0006, and a part of a sixth."""
EARLIER = {"0003": FAMILIES, "0002": ("plate", "magnet"), "0001": ("plate",)}
MADE_BY_0006 = ("kind", "audit_number", "sha256")
Made = dict[str, list[dict[str, Any]]]


@pytest.fixture
def database(tmp_path: Path, new_database_url: Callable[[Path], str]) -> Iterator[Database]:
    database = Database(new_database_url(tmp_path))
    database.open()
    database.migrate()
    yield database
    database.close()


def _marker(k: int, lon_deg: float, lat_deg: float) -> dict[str, Any]:
    family = FAMILIES[k % 3]
    marker = {
        "row": k + 1,
        "id": f"019cb624-0000-7000-8000-{k:012x}",
        "agency_id": AGENCY,
        "family": family,
        "status": ("active", "retired", "suspect")[k % 7 % 3],
        "scheme": "position" if family == "plate" else None,
        "digits": str(k),
        "digits_match_position": k % 2 == 0 if family == "plate" else None,
        "lon_deg": lon_deg,
        "lat_deg": lat_deg,
        "height_m": 0.1 + k / 3 if k % 5 else None,
        "crs": "EPSG:4326",
        "original": {"lon_deg": lon_deg, "text": "Straße 大道\u0001", "none": None},
        "localization_grade": "exact",
        "road": "A 7 ü" if k % 2 else None,
        "spec": None if family == "plate" else {"b": 1.5, "a": [k, 1e-300, True]},
        "version": 1,
        "created_at": NOW,
        "updated_at": NOW + timedelta(microseconds=k),
    }
    marker |= regraded(marker)
    return {**marker, "feature": feature_text(row_of(MarkerRow, marker))}


def _made(count: int) -> Made:
    """Rows of every table, in an order that foreign keys allow."""
    rng = np.random.default_rng(17)
    places = zip(rng.uniform(-180, 180, count).tolist(), rng.uniform(-90, 90, count).tolist(), strict=True)
    made = [_marker(k, *place) for k, place in enumerate(places)]
    made[0] = _marker(0, 180.0, -90.0)
    owned = {"agency_id": AGENCY, "created_at": NOW}
    decode = {"id": DECODE, "kind": "frame", "context": {"z": 1, "a": 2}, "result": {"n": None}}
    span = {"row": 1, "number": 2, "first_sequence": 3, "last_sequence": 2**40, "decode_id": DECODE}
    key = {
        "id": "key",
        "label": "l",
        "prefix": "p",
        "sha256": "s",
        "holder_id": "key",
        "scope": "viewer",
        "last_used_at": NOW,
    }
    versions = ("version", "agency_id")
    return {
        "agencies": [{"id": AGENCY, "name": "one", "created_at": NOW}],
        "api_keys": [{**key, **owned}],
        "markers": made,
        "marker_versions": [
            {
                "marker_id": m["id"],
                **{name: m[name] for name in versions},
                "at": NOW,
                "who": "w",
                "marker": m["original"],
                "kind": "as-built",
                "audit_number": 1,
                "sha256": "0" * 64,
            }
            for m in made
        ],
        "decodes": [{**decode, **owned}],
        "jobs": [{"id": "job", "kind": "import", "state": "done", "input": {"b": 1}, "progress": 1.0, **owned}],
        "observations": [
            {"decode_id": DECODE, "marker_id": m["id"], "frame": 1, "agency_id": AGENCY, "at": NOW, "what": "seen"}
            for m in made[:300]
        ],
        "idempotency_keys": [
            {"holder_id": "", "key": "k", "request_sha256": "s", "response": {"b": 1}, "expires_at": NOW, **owned}
        ],
        "magnets": [
            {"row": k + 1, "marker_id": m["id"], "number": 1, "agency_id": AGENCY, "polarity": "N", "phi_deg": 90}
            | {"lon_deg": m["lon_deg"], "lat_deg": m["lat_deg"]}
            for k, m in enumerate(made)
            if m["family"] == "magnet"
        ],
        "codebooks": [
            {"id": "book", "name": "n", "design": {}, "rules": {}, "figures": {}, "entries": [], "version": 1, **owned}
            | {"updated_at": NOW}
        ],
        "agency_secrets": [{"wrapped": b"\x00\xff", **owned}],
        "cerpm_spans": [{**span, "agency_id": AGENCY}],
    }


def _fill(database: Database, made: Made) -> None:
    with database.write(long=True) as connection:
        for table, rows in made.items():
            connection.execute(sa.insert(metadata.tables[table]), rows)


def _hashes(database: Database, tables: Sequence[str], families: Sequence[str] = FAMILIES) -> dict[str, str]:
    """SHA-256 of each table's rows in the order of their keys; of markers and theirs, some families only."""
    hashes = {}
    kept = sa.select(markers.c.id).where(markers.c.family.in_(families))
    with database.read() as connection:
        for name in tables:
            table = metadata.tables[name]
            query = sa.select(*(c for c in table.c if c.name not in MADE_BY_0006)).order_by(*table.primary_key.columns)
            if name == "markers":
                query = query.where(table.c.id.in_(kept))
            elif "marker_id" in table.c:
                query = query.where(table.c.marker_id.in_(kept))
            digest = hashlib.sha256()
            for row in connection.execute(query):
                digest.update(orjson.dumps(tuple(row), default=bytes.hex))
            hashes[name] = digest.hexdigest()
    return hashes


def test_rows_are_the_same_on_both_databases(database: Database) -> None:
    made = _made(300)
    _fill(database, made)
    plain = hashlib.sha256()
    columns = [column.name for column in markers.c]
    for marker in made["markers"]:
        plain.update(orjson.dumps([marker.get(name) for name in columns]))
    assert _hashes(database, ["markers"]) == {"markers": plain.hexdigest()}


@pytest.mark.slow
@pytest.mark.parametrize("revision", EARLIER)
def test_down_and_up_keeps_what_the_older_schema_knows(database: Database, revision: str) -> None:
    made = _made(MARKERS)
    _fill(database, made)
    families = EARLIER[revision]
    new = {"0003": {"jobs"}, "0002": {"jobs", "agency_secrets", "cerpm_spans"}}
    new["0001"] = new["0002"] | {"magnets", "codebooks"}
    kept = [name for name in made if name not in new[revision]]
    before = _hashes(database, kept, families)
    database.migrate(revision)
    with database.read() as connection:
        assert not new[revision] & set(sa.inspect(connection).get_table_names())
    database.migrate()
    assert database.is_ready()
    assert _hashes(database, kept) == before
    assert _hashes(database, kept, families) == before
    with database.read() as connection:
        _compare_indexes(connection, [m for m in made["markers"] if m["family"] in families])


def _compare_indexes(connection: sa.Connection, made: list[dict[str, Any]]) -> None:
    """The spatial indexes were filled again: they find what is in the tables."""
    box = Box(-30.0, -20.0, 15.0, 25.0)
    inside = {m["id"] for m in made if -30 <= m["lon_deg"] <= 15 and -20 <= m["lat_deg"] <= 25}
    listed = list_markers(connection, AGENCY, MarkerFilter(box=box), after=None, limit=len(made) + 1)
    assert {row.id for row in listed} == inside
    magnets = {m["id"] for m in made if m["family"] == "magnet" and m["status"] != "retired"}
    assert {row.marker_id for row in list_magnets_in(connection, box)} == inside & magnets
    assert inside


def test_responses_of_a_holder_are_given_to_nobody_else_by_an_older_release(database: Database) -> None:
    """Two holders used one key; the older schema knows only the agency."""
    made = _made(40)
    row = made["idempotency_keys"][0]
    made["idempotency_keys"] += [{**row, "holder_id": "one"}, {**row, "holder_id": "two"}]
    _fill(database, made)
    database.migrate("0014")
    database.migrate()
    with database.read() as connection:
        assert connection.exec_driver_sql("SELECT holder_id, key FROM idempotency_keys").all() == [("", "k")]


ITRF: dict[str, Any] = {"realization": "ITRF2014", "epoch": 2025.4, "transform_accuracy_m": 0.0}
LEGACY: list[tuple[dict[str, Any], str, float | None]] = [
    ({"transform_accuracy_m": 0.0}, "m", 2.0),
    ({"realization": "ITRF2014", "transform_accuracy_m": 0.0}, "dm", 0.27),
    ({"realization": "ITRF2014", "epoch": 2025.4, "transform_accuracy_m": 0.0}, "cm", 0.0),
    (
        {"realization": "ITRF2014", "epoch": 2025.4, "transform_accuracy_m": 0.0, "horizontal_rmse_m": 12.0},
        "unfit",
        0.0,
    ),
    (
        {"realization": "ITRF2014", "epoch": 2025.4, "transform_accuracy_m": 0.0, "horizontal_rmse_m": None},
        "unfit",
        0.0,
    ),
    ({"crs": "EPSG:25832", "realization": "ITRF2014", "epoch": 2025.4, "transform_accuracy_m": 0.1}, "dm", 0.1),
    ({"crs": "EPSG:25832", "transform_note": "from EPSG:25832: no epoch"}, "unfit", None),
    ({"realization": "NAD83(2011)", "transform_note": "not one of EPSG:4326"}, "unfit", None),
]
"""Positions as they were stored before there were grades, with their grade and the accuracy of their frame [m]."""


def test_older_positions_are_graded_and_their_history_verifies(database: Database) -> None:
    made = _made(len(LEGACY))
    datums = ("ellipsoid", "EPSG:7837")
    for k, (marker, version, (position, _, _)) in enumerate(
        zip(made["markers"], made["marker_versions"], LEGACY, strict=True)
    ):
        old = "exact" if "transform_accuracy_m" in position else "approximate, not for localization"
        marker |= {"lon_deg": 8.4, "lat_deg": 49.0, "height_m": 120.5, "vertical_datum": datums[k % 2]}
        unstated = dict.fromkeys(("realization", "epoch", "transform_accuracy_m", "transform_note"))
        marker |= {"horizontal_rmse_m": 0.02, **unstated} | position
        marker |= {"localization_grade": old, "updated_at": NOW, "created_at": NOW}
        names = MarkerRow._fields
        version["marker"] = orjson.loads(orjson.dumps({name: marker.get(name) for name in names if name != "original"}))
        version["sha256"] = version_sha256(AGENCY, marker["id"], 1, NOW, "w", None, "as-built", version["marker"])
    database.migrate("0015")
    _fill(database, made)
    database.migrate()
    with database.read() as connection:
        rows = list_markers(connection, AGENCY, MarkerFilter(), after=None, limit=20)
        features = connection.execute(sa.select(markers.c.feature).order_by(markers.c.id)).scalars().all()
        faults = list(check_history(connection, AGENCY, ChainReport()))
        assert [fault for fault in faults if "entry" not in fault.where + fault.what] == []  # the log has none here
        versions = [list_versions(connection, AGENCY, row.id)[0].marker for row in rows]
    for row, version_row, feature, (_, grade, accuracy_m) in zip(rows, versions, features, LEGACY, strict=True):
        assert row.localization_grade == version_row.localization_grade == grade
        assert row.transform_accuracy_m == (None if accuracy_m is None else pytest.approx(accuracy_m, abs=0.02))
        assert feature == feature_text(row)
        point = orjson.loads(feature)
        assert len(point["geometry"]["coordinates"]) == (3 if row.vertical_datum == "ellipsoid" else 2)
        assert point["properties"]["height_m"] == 120.5
    assert "state horizontal_rmse_m" in (rows[4].transform_note or "")


@pytest.mark.slow
def test_to_nothing_and_back(database: Database) -> None:
    made = _made(100)
    _fill(database, made)
    before = _hashes(database, list(made))
    database.migrate("base")
    database.migrate()
    assert set(_hashes(database, list(made)).values()) == {hashlib.sha256().hexdigest()}
    _fill(database, made)
    assert _hashes(database, list(made)) == before


def test_older_histories_get_kinds_hashes_and_a_first_entry(database: Database) -> None:
    made = _made(40)
    plain = {"lon_deg": 1.0, "lat_deg": 2.0, "height_m": None, "original": {}}
    history = [
        plain | {"status": "planned"},
        plain | {"status": "built"},
        plain | {"status": "surveyed", "lon_deg": 1.1},
        plain | {"status": "surveyed", "lon_deg": 1.2},
    ]
    first = made["marker_versions"][0]
    made["marker_versions"][:1] = [first | {"version": k + 1, "marker": one} for k, one in enumerate(history)]
    made["markers"][0]["version"] = 4
    _fill(database, made)
    database.migrate("0005")
    database.migrate()
    with database.read() as connection:
        kinds = connection.exec_driver_sql(
            f"SELECT kind FROM marker_versions WHERE marker_id = '{first['marker_id']}' ORDER BY version"
        )
        assert kinds.scalars().all() == ["as-planned", "change", "as-built", "resurvey"]
        head = find_head(connection, AGENCY)
    assert head is not None
    assert (head.number, head.versions, head.action) == (1, 43, "history.hashed")
    faults = [fault for _, _, found in AuditLog(database).verify() for fault in found]
    assert {fault.where for fault in faults} == {f"marker {first['marker_id']}"}  # its last version says another place
    faults = [fault for fault in faults if "differs from" not in fault.what]
    assert faults == []


@pytest.mark.slow
def test_more_markers_than_migrations_read_at_once(database: Database) -> None:
    """To the oldest schema that knows all families and back: hashes unchanged, and the new history verifies."""
    made = _made(LARGE)
    _fill_fast(database, made)
    before = _hashes(database, list(made))
    database.migrate("0003")
    database.migrate()
    assert _hashes(database, list(made)) == before
    with database.read() as connection:
        _compare_indexes(connection, made["markers"])
        report = ChainReport()
        assert list(check_history(connection, AGENCY, report)) == []
    assert (report.entries, report.versions) == (1, LARGE)


def _fill_fast(database: Database, made: Made) -> None:
    with database.write(long=True) as connection:
        for name, rows in made.items():
            by_shape: dict[tuple[str, ...], list[dict[str, Any]]] = {}
            for row in rows:
                by_shape.setdefault(tuple(row), []).append(row)
            for alike in by_shape.values():
                load_rows(connection, metadata.tables[name], alike)
