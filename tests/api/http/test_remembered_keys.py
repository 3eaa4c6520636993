"""A key that was just checked is not looked up again, unless anything may have changed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import sqlalchemy as sa

from app.errors import NotAuthenticated
from app.registry.agencies import api_keys
from app.registry.database import Database
from app.services.access.access import Access, Scope

pytestmark = pytest.mark.both_databases


@pytest.fixture
def database(tmp_path: Path, new_database_url: Callable[[Path], str]) -> Iterator[Database]:
    database = Database(new_database_url(tmp_path))
    database.open()
    database.migrate()
    yield database
    database.close()


def test_a_key_is_remembered_until_something_is_written_or_a_second_is_over(database: Database) -> None:
    now = datetime(2026, 3, 4, tzinfo=UTC)
    access = Access(database, lambda: now)
    key = access.create_key("a", Scope.ADMIN, "a")
    assert access.recall(key) is None
    access.authenticate(key)  # notes the use of the key, which is a write
    caller = access.authenticate(key)
    assert access.recall(key) == caller
    assert access.recall(f"{key}x") is None
    now += timedelta(seconds=0.9)
    assert access.recall(key) == caller
    now += timedelta(seconds=0.2)
    assert access.recall(key) is None
    access.authenticate(key)
    assert access.recall(key) is not None
    with database.write() as connection:
        connection.execute(sa.update(api_keys).values(revoked_at=now))
    assert access.recall(key) is None
    with pytest.raises(NotAuthenticated):
        access.authenticate(key)


def test_a_key_is_not_remembered_beyond_its_expiry(database: Database) -> None:
    now = datetime(2026, 3, 4, tzinfo=UTC)
    access = Access(database, lambda: now)
    key = access.create_key("a", Scope.VIEWER, "a", now + timedelta(seconds=0.5))
    access.authenticate(key)
    access.authenticate(key)
    assert access.recall(key) is not None
    now += timedelta(seconds=0.5)
    assert access.recall(key) is None
