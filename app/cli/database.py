"""What commands need from outside: settings, the database, and an agency to act for."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from typing import TYPE_CHECKING

from pydantic import ValidationError

from app.errors import InvalidParameter
from app.settings import Settings

if TYPE_CHECKING:
    from app.registry.database import Database
    from app.services.access.access import Caller

_NEAR = 0.88
"""How similar a name is to a setting's (`difflib`). Source: by hand; WAYMARK_PROT is near, WAYMARK_KEY is not."""


def read_settings(**overrides: object) -> Settings:
    """Settings from the environment; overrides that are None are ignored."""
    _check_names()
    try:
        return Settings.model_validate({name: value for name, value in overrides.items() if value is not None})
    except ValidationError as error:
        first = error.errors()[0]
        name = "WAYMARK_" + "_".join(str(part) for part in first["loc"]).upper()
        raise InvalidParameter(f"{name.removesuffix('_')}: {first['msg']}", cure="see docs/settings.md") from error


def _check_names() -> None:
    """Refuse variables whose names are nearly those of settings; others may belong to other programs."""
    known = [f"WAYMARK_{name.upper()}" for name in Settings.model_fields]
    for name in sorted(os.environ):
        if name.startswith("WAYMARK_") and name not in known and (near := get_close_matches(name, known, 1, _NEAR)):
            raise InvalidParameter(
                f"there is no setting {name}", field=name, cure=f"did you mean {near[0]}? See docs/settings.md"
            )


@contextmanager
def owned_database(settings: Settings) -> Iterator[Database]:
    """The database for reading and writing; an SQLite file that another process owns is refused."""
    from app.registry.database import Database
    from app.registry.tenancy import across_agencies

    database = Database(settings.resolved_database_url)
    database.open()
    try:
        with across_agencies():
            yield database
    finally:
        database.close()


@contextmanager
def readable_database(settings: Settings) -> Iterator[Database]:
    """The database for reading only, also while a server runs on it."""
    from app.registry.database import Database, head_revision
    from app.registry.tenancy import across_agencies

    database = Database(settings.resolved_database_url)
    if database.path is not None and not database.path.exists():
        raise InvalidParameter(
            f"there is no database {database.name}", cure="set WAYMARK_DATA_DIR or WAYMARK_DATABASE_URL"
        )
    try:
        if database.current_revision() != head_revision():
            raise InvalidParameter(f"{database.name} has an older schema", cure="run waymark migrate")
        with across_agencies():
            yield database
    finally:
        database.close()


@contextmanager
def operator(database: Database, agency: str) -> Iterator[Caller]:
    """An administrator of an agency: whoever may run commands on the server's machine."""
    from app.registry.agencies import find_agency
    from app.registry.tenancy import across_agencies, acting_for
    from app.services.access.access import Caller, Scope

    with across_agencies(), database.read() as connection:
        agency_id = find_agency(connection, agency)
    if agency_id is None:
        raise InvalidParameter(f"there is no agency {agency[:80]!r}", cure="create it with waymark key")
    with acting_for(agency_id):
        yield Caller(agency_id, "command-line", "command line", Scope.ADMIN)
