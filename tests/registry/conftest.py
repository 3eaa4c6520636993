"""The registry's tests run on both databases."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from app.registry.database import Database


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def backend(request: pytest.FixtureRequest) -> str:
    """Each test runs twice."""
    return str(request.param)


@pytest.fixture
def empty_database(tmp_path: Path, new_database_url: Callable[[Path], str]) -> Iterator[Database]:
    """An open database without a schema."""
    database = Database(new_database_url(tmp_path / "db"))
    database.open()
    yield database
    database.close()


@pytest.fixture
def database(empty_database: Database) -> Database:
    """An open database with the newest schema."""
    empty_database.migrate()
    return empty_database
