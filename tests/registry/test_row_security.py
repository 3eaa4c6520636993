"""The second lock: a query that forgets whose rows it wants gets one agency's, or none."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from app.registry import agencies
from app.registry.agencies import idempotency_keys
from app.registry.bulk_load import large_load, load_rows
from app.registry.column_types import new_id, select_rows
from app.registry.database import Database
from app.registry.engines import across_agencies, acting_for, seeing_every_agency
from app.registry.markers import codebooks as codebook_table
from app.registry.resources import Resource
from app.registry.tables import metadata
from app.settings import Settings
from tests.api.markers.test_codebooks import DESIGN
from tests.conftest import LiveServer
from tests.http import WITHIN_S

NOW = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)
ALL = sa.select(codebook_table.c.name).order_by(codebook_table.c.name)  # somebody forgot the WHERE


@pytest.fixture(scope="module")
def backend() -> str:
    """SQLite has no such lock."""
    return "postgresql"


@pytest.fixture
def owners(database: Database) -> Iterator[tuple[str, str]]:
    """Two agencies with a codebook each."""
    with database.write() as connection:
        ids = [agencies.add_agency(connection, name, NOW) for name in ("one", "two")]
        connection.execute(sa.insert(codebook_table), [_book(f"of {n}", owner) for n, owner in enumerate(ids, 1)])
    with acting_for(""):
        yield ids[0], ids[1]


def _book(name: str, agency_id: str) -> dict[str, Any]:
    documents: dict[str, Any] = {"design": {}, "rules": {}, "figures": {}, "entries": []}
    owned = {"id": new_id(NOW), "agency_id": agency_id, "name": name, "version": 1, "created_at": NOW}
    return owned | {"updated_at": NOW} | documents


def _seen(database: Database) -> list[str]:
    with database.read() as connection:
        read = list(connection.execute(ALL).scalars())
    assert database.ask(lambda c: list(c.execute(ALL).scalars())) == read
    return read


def test_every_table_of_an_agencys_rows_has_the_lock(database: Database) -> None:
    with database.read() as connection:
        locked = connection.exec_driver_sql(
            """SELECT c.relname FROM pg_class c JOIN pg_policy p ON p.polrelid = c.oid
               WHERE c.relnamespace = current_schema()::regnamespace AND relrowsecurity AND relforcerowsecurity"""
        ).scalars()
        owned = {name for name, table in metadata.tables.items() if "agency_id" in table.c} | {"agencies"}
        assert set(locked) == owned
        role = "SELECT rolsuper OR rolbypassrls FROM pg_roles WHERE rolname = current_user"
        assert connection.exec_driver_sql(role).scalar_one() is False


def test_a_forgotten_condition_shows_ones_own_rows_only(database: Database, owners: tuple[str, str]) -> None:
    for _ in range(2):  # connections are used again
        for number, agency_id in enumerate(owners, 1):
            with acting_for(agency_id):
                assert _seen(database) == [f"of {number}"]
        assert _seen(database) == []
        with across_agencies():
            assert _seen(database) == ["of 1", "of 2"]
    with acting_for("x' OR true --"):
        assert _seen(database) == []


def test_nor_are_rows_of_others_changed_deleted_or_made(database: Database, owners: tuple[str, str]) -> None:
    one, two = owners
    with acting_for(one):
        with database.write() as connection:
            assert connection.execute(sa.update(codebook_table).values(name="mine")).rowcount == 1
            assert connection.execute(sa.delete(codebook_table).where(codebook_table.c.agency_id == two)).rowcount == 0
        for change in (
            sa.insert(codebook_table).values(_book("new", two)),
            sa.update(codebook_table).values(agency_id=two),
        ):
            with pytest.raises(sa.exc.ProgrammingError, match="row-level security"), database.write() as connection:
                connection.execute(change)
    with pytest.raises(sa.exc.ProgrammingError, match="row-level security"), database.write() as connection:
        connection.execute(sa.insert(codebook_table).values(_book("nobody's", one)))
    with across_agencies():
        assert _seen(database) == ["mine", "of 2"]


def test_a_thread_that_was_told_nothing_sees_nothing(database: Database, owners: tuple[str, str]) -> None:
    with acting_for(owners[0]), ThreadPoolExecutor(1) as pool:
        assert pool.submit(_seen, database).result() == []


def test_threads_do_not_mix(database: Database, owners: tuple[str, str]) -> None:
    together = threading.Barrier(8)

    def look(number: int) -> bool:
        together.wait(WITHIN_S)
        with acting_for(owners[number % 2]):
            return all(_seen(database) == [f"of {number % 2 + 1}"] for _ in range(25))

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(look, range(8)))


@pytest.mark.slow
def test_all_rows_for_one_question_and_then_ones_own_again(database: Database, owners: tuple[str, str]) -> None:
    with acting_for(owners[1]), database.read() as connection:
        with seeing_every_agency(connection):
            assert list(connection.execute(ALL).scalars()) == ["of 1", "of 2"]
        assert list(connection.execute(ALL).scalars()) == ["of 2"]


@pytest.mark.parametrize("large", [False, True])
def test_rows_by_copy_pass_the_lock(
    database: Database, owners: tuple[str, str], monkeypatch: pytest.MonkeyPatch, *, large: bool
) -> None:
    monkeypatch.setattr("app.registry.bulk_load.LARGE", 1 if large else 10**9)
    rows = [
        {"agency_id": owners[0], "key": str(n), "request_sha256": "x", "response": {"n": n}, "created_at": NOW}
        | {"expires_at": NOW}
        for n in range(500)
    ]
    with acting_for(owners[0]):
        for part in (rows[:250], rows[250:]):
            with database.write() as connection, large_load(connection, (idempotency_keys,), len(part)):
                load_rows(connection, idempotency_keys, part)
        with pytest.raises(sa.exc.ProgrammingError, match="row-level security"), database.write() as connection:
            load_rows(connection, idempotency_keys, [{**rows[0], "agency_id": owners[1]}])
        count = sa.select(sa.func.count(), sa.func.count(sa.distinct(idempotency_keys.c.key)))
        with database.read() as connection:
            assert connection.execute(count).one() == (500, 500)
    with database.read() as connection:
        assert connection.execute(count).one() == (0, 0)
        forced = "SELECT relforcerowsecurity FROM pg_class WHERE oid = 'idempotency_keys'::regclass"
        assert connection.exec_driver_sql(forced).scalar_one() is True


@pytest.mark.slow
def test_a_request_sees_its_agencys_rows_even_if_the_query_forgets(
    tmp_path: Path,
    new_database_url: Callable[[Path], str],
    serve: Callable[[Settings], LiveServer],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def forgetful(resource: Resource[Any], _agency_id: str, _equal: dict[str, Any]) -> sa.Select[Any]:
        return select_rows(resource.row, resource.table)

    server = serve(Settings(data_dir=tmp_path, database_url=new_database_url(tmp_path), warm_decoders=False))
    with server.agency("one") as one, server.agency("two") as two:
        for client, name in ((one, "first"), (two, "second")):
            assert client.post("/v1/codebooks", json={"name": name, "design": DESIGN}).status_code == 201
        monkeypatch.setattr(Resource, "_select", forgetful)
        for client, name in ((one, "first"), (two, "second")) * 3:
            assert [book["name"] for book in client.get("/v1/codebooks").json()["items"]] == [name]
