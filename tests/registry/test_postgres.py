"""What only PostgreSQL has: a server that may be away, limits on statements, sessions that the code relies on."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
import sqlalchemy as sa

from app.errors import Unavailable
from app.registry import engines
from app.registry.database import Database
from tests.databases import PostgresServer


@pytest.fixture(scope="module")
def backend() -> str:
    return "postgresql"


@pytest.fixture
def second(database: Database) -> Iterator[Database]:
    """The same database from another process."""
    second = Database(database.url.render_as_string(hide_password=False))
    yield second
    second.close()


def test_sessions_are_what_the_code_relies_on(database: Database) -> None:
    with database.read() as connection:
        shown = {
            name: connection.exec_driver_sql(f"SHOW {name}").scalar()
            for name in ("timezone", "transaction_isolation", "transaction_read_only", "statement_timeout", "jit")
        }
    assert shown == {
        "timezone": "UTC",
        "transaction_isolation": "repeatable read",
        "transaction_read_only": "on",
        "statement_timeout": "1min",
        "jit": "off",
    }
    with database.write() as connection:
        assert connection.exec_driver_sql("SHOW transaction_isolation").scalar() == "read committed"
        assert connection.exec_driver_sql("SHOW transaction_read_only").scalar() == "off"
    with database.write(long=True) as connection:
        assert connection.exec_driver_sql("SHOW statement_timeout").scalar() == "0"
    with database.write() as connection:
        assert connection.exec_driver_sql("SHOW statement_timeout").scalar() == "1min"


def test_options_of_the_url_come_last(database: Database) -> None:
    url = database.url.update_query_dict({"options": f"{database.url.query['options']} -c statement_timeout=1234"})
    chosen = Database(url.render_as_string(hide_password=False))
    with chosen.read() as connection:
        assert connection.exec_driver_sql("SHOW statement_timeout").scalar() == "1234ms"
    chosen.close()


def test_a_read_cannot_write(database: Database) -> None:
    with pytest.raises(sa.exc.InternalError, match="read-only"), database.read() as connection:
        connection.exec_driver_sql("DELETE FROM markers")


def test_a_writer_that_waits_too_long_is_told_so(
    database: Database, monkeypatch: pytest.MonkeyPatch, second: Database
) -> None:
    monkeypatch.setitem(engines._SESSION, "lock_timeout", "50")
    impatient = Database(database.url.render_as_string(hide_password=False))
    with second.write():
        with pytest.raises(Unavailable, match="busy"), impatient.write():
            pass
        assert impatient.is_ready()  # requests wait for each other, and others are answered
    impatient.close()


def test_migrations_of_two_processes_wait_for_each_other(
    empty_database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(engines._SESSION, "lock_timeout", "50")
    second = Database(empty_database.url.render_as_string(hide_password=False))
    both = [threading.Thread(target=database.migrate) for database in (empty_database, second)]
    with empty_database.write():
        both[1].start()
        both[1].join(0.2)
        assert both[1].is_alive()
    both[0].start()
    for thread in both:
        thread.join()
    assert empty_database.is_ready()
    second.close()


def test_a_statement_without_end_is_ended(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(engines._SESSION, "statement_timeout", "50")
    impatient = Database(database.url.render_as_string(hide_password=False))
    with pytest.raises(Unavailable, match="for one statement"), impatient.read() as connection:
        connection.exec_driver_sql("SELECT pg_sleep(5)")
    impatient.close()


def test_a_connection_that_was_cut_is_replaced(database: Database, second: Database) -> None:
    def number() -> int:
        with database.read() as connection:
            return int(connection.exec_driver_sql("SELECT pg_backend_pid()").scalar_one())

    cut = number()
    with second.write() as connection:
        connection.exec_driver_sql("SET LOCAL ROLE NONE")  # the tests' own role may not
        assert connection.exec_driver_sql(f"SELECT pg_terminate_backend({cut}, 5000)").scalar()
    assert number() != cut


def test_a_question_is_asked_again_where_its_connection_was_cut(database: Database, second: Database) -> None:
    def number(connection: sa.Connection) -> int:
        return int(connection.exec_driver_sql("SELECT pg_backend_pid()").scalar_one())

    cut = database.ask(number)
    assert database.ask(number) == cut
    with second.write() as connection:
        connection.exec_driver_sql("SET LOCAL ROLE NONE")  # the tests' own role may not
        assert connection.exec_driver_sql(f"SELECT pg_terminate_backend({cut}, 5000)").scalar()
    assert database.ask(number) != cut


def test_a_question_can_neither_write_nor_take_for_ever(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(sa.exc.InternalError, match="read-only"):
        database.ask(lambda connection: connection.exec_driver_sql("DELETE FROM agencies"))
    monkeypatch.setitem(engines._SESSION, "statement_timeout", "50")
    impatient = Database(database.url.render_as_string(hide_password=False))
    with pytest.raises(Unavailable, match="for one statement"):
        impatient.ask(lambda connection: connection.exec_driver_sql("SELECT pg_sleep(5)"))
    impatient.close()


def test_a_connection_in_use_is_closed_when_it_comes_back(database: Database, second: Database) -> None:
    with second.read() as connection:
        session = connection.exec_driver_sql("SELECT pg_backend_pid()").scalar()
        driver = connection.connection.driver_connection
        second.disconnect()
        assert connection.exec_driver_sql("SELECT 1").scalar() == 1  # whoever uses it may end
    assert session
    assert driver is not None
    assert driver.closed
    with second.read() as connection:
        assert connection.exec_driver_sql("SELECT pg_backend_pid()").scalar() != session


def test_a_thread_that_outlives_the_database_leaves_no_connection_open(second: Database) -> None:
    second.close()
    with second.read() as connection:
        driver = connection.connection.driver_connection
    assert driver is not None
    assert driver.closed
    second.ask(lambda connection: connection.exec_driver_sql("SELECT 1").scalar())
    assert [pool.checkedin() for _, pool in second.pools()] == [0, 0]


def test_a_server_that_is_away_is_unavailable() -> None:
    database = Database("postgresql+psycopg://waymark:secret@127.0.0.1:1/waymark")
    with pytest.raises(Unavailable, match="cannot be reached") as refused:
        database.open()
    assert refused.value.cure == "start the server, or correct WAYMARK_DATABASE_URL"
    assert "secret" not in refused.value.message
    with pytest.raises(Unavailable, match="cannot be reached"), database.read():
        pass
    with pytest.raises(Unavailable, match="cannot be reached"):
        database.ask(lambda connection: connection.exec_driver_sql("SELECT 1"))
    assert not database.is_ready()


def test_a_database_without_postgis_is_refused(postgres: PostgresServer) -> None:
    database = Database(postgres.create())
    with pytest.raises(Unavailable, match="has no PostGIS") as refused:
        database.open()
    assert "CREATE EXTENSION postgis" in str(refused.value.cure)
    database.close()


def test_the_operator_is_told_where_the_policies_do_not_bind_or_cost_too_much(postgres: PostgresServer) -> None:
    bound = sa.make_url(postgres.empty())
    database = Database(bound.render_as_string(hide_password=False))
    assert database.list_warnings() == []
    database.close()
    own = Database(postgres.url.set(database=bound.database).render_as_string(hide_password=False))
    assert "does not bind" in own.list_warnings()[0]
    change = "ALTER FUNCTION geometry_overlaps(geometry, geometry) {}LEAKPROOF"
    try:
        with own.write() as connection:
            connection.exec_driver_sql(change.format("NOT "))
        assert "ALTER FUNCTION" in database.list_warnings()[0]
    finally:
        with own.write() as connection:
            connection.exec_driver_sql(change.format(""))
        own.close()
        database.close()
