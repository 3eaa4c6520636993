"""What commands need from outside: settings, the database, and an agency to act for."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import ValidationError

from app.errors import InvalidParameter
from app.settings import Settings
from app.values import JsonObject

if TYPE_CHECKING:
    from app.control.operations import Values
    from app.registry.database import Database
    from app.services.surveys.exports import Exports
    from app.services.surveys.imports import Imports

_STORE_SECRETS = ("aws_access_key_id", "aws_secret_access_key")
"""Files of the folder of secrets that the client of S3 takes from the environment."""
_NEAR = 0.88
"""How similar a name is to a setting's (`difflib`). WAYMARK_PROT is near, WAYMARK_KEY is not."""


def read_settings(**overrides: object) -> Settings:
    """Settings from the environment; overrides that are None are ignored."""
    _check_names()
    given: JsonObject = {name: value for name, value in overrides.items() if value is not None}
    folder = os.environ.get("WAYMARK_SECRETS_DIR", "")
    if folder and not Path(folder).is_dir():
        raise InvalidParameter(f"{folder} is not a folder", field="WAYMARK_SECRETS_DIR")
    for name in _STORE_SECRETS if folder else ():
        if (file := Path(folder, name)).is_file():
            os.environ.setdefault(name.upper(), file.read_text(encoding="utf-8").strip())
    try:
        return Settings(_secrets_dir=folder or None, **given)
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
    from app.registry.engines import across_agencies

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
    from app.registry.engines import across_agencies

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


def perform(settings: Settings, name: str, values: Values, files: Sequence[int] = (), *, quiet: bool = False) -> Values:
    """Carry out an operation of `app.control.operations`, in the server if one owns the database.

    Its progress is shown unless `quiet`.
    """
    from app.cli.terminal import Progress
    from app.control.client import perform as carry_out
    from app.control.operations import OperatorCases
    from app.formats.json_text import check_values
    from app.services.access.access import Access
    from app.services.ports import utc_now

    def make_cases(database: Database) -> OperatorCases:
        return OperatorCases(
            database,
            utc_now,
            Access(database, utc_now),
            lambda: _imports(settings, database),
            lambda: _exports(database),
        )

    check_values(dict(values), "option")  # arguments that are not UTF-8 have half surrogate pairs
    with Progress(quiet=quiet) as shown:
        return carry_out(settings.resolved_database_url, name, values, make_cases, files, shown.show)


def _imports(settings: Settings, database: Database) -> Imports:
    from app.services.decoder_tasks import SameProcess
    from app.services.ports import utc_now
    from app.services.surveys.imports import Imports
    from app.wiring import marker_rules

    return Imports(database, utc_now, SameProcess(), marker_rules(settings))


def _exports(database: Database) -> Exports:
    from app.services.surveys.exports import Exports

    return Exports(database)
