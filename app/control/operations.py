"""The operations of an operator: each takes plain values and open files, and returns plain values.

On an SQLite file that a server owns, the server carries them out (`app.control.server`); otherwise the command does.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from app.errors import InvalidParameter
from app.formats.format import SpooledFile
from app.registry.agencies import find_agency
from app.registry.database import Database
from app.registry.engines import across_agencies, acting_for
from app.registry.markers import MarkerFilter, count_records
from app.services.access.access import Access, Caller, Scope, parse_scope
from app.services.ports import Clock

if TYPE_CHECKING:
    from app.services.surveys.exports import Exports
    from app.services.surveys.imports import Imports

_CHUNK_BYTES = 1024**2


@dataclass(frozen=True, slots=True)
class OperatorCases:
    """The use cases that operations need; the ones of surveys are made when they are asked for: they load much."""

    database: Database
    clock: Clock
    access: Access
    imports: Callable[[], Imports]
    exports: Callable[[], Exports]


Values = Mapping[str, Any]
Report = Callable[[str, float, float], None]
"""Takes the name of a step, how much of it is done, and all of it. It returns at once and raises nothing."""
Operation = Callable[[OperatorCases, Values, Sequence[int], Report], Values]
"""Takes arguments, descriptors of open files and what shows progress; returns the result. Both mappings are JSON."""


def show_nothing(_step: str, _done: float, _total: float) -> None:
    """Show no progress."""


def create_key(cases: OperatorCases, values: Values, _files: Sequence[int], _report: Report) -> Values:
    """Create a key for an agency, or for an operator where no agency is named."""
    days = values["days"]
    expires_at = cases.clock() + timedelta(days=days) if days else None
    if values["agency"] is None:
        return {"key": cases.access.create_operator_key(values["label"], expires_at)}
    with across_agencies():
        key = cases.access.create_key(values["agency"], parse_scope(values["scope"]), values["label"], expires_at)
    return {"key": key}


def import_survey(cases: OperatorCases, values: Values, files: Sequence[int], report: Report) -> Values:
    """Import the survey in the first file."""
    from app.services.surveys.import_report import DeclarationIn, import_input
    from app.services.surveys.imports import SETTLED

    with TemporaryDirectory(prefix="waymark-import-") as folder, operator(cases.database, values["agency"]) as caller:
        survey = Path(folder, "survey")  # decoder processes open it by its path, and not all paths are theirs
        with os.fdopen(os.dup(files[0]), "rb") as given_file, survey.open("xb") as copy:
            shutil.copyfileobj(given_file, copy, _CHUNK_BYTES)
        given = import_input(DeclarationIn.model_validate(values["declaration"]), SpooledFile.at(survey))
        found, _ = cases.imports().run(
            caller, given, step=lambda done: report("check", done / SETTLED, 1.0), stored=partial(report, "store")
        )
    return {"report": found}


def export_markers(cases: OperatorCases, values: Values, files: Sequence[int], report: Report) -> Values:
    """Write an agency's markers into the first file."""
    from app.services.markers.searches import parse_box

    box = parse_box(values["bbox"]) if values["bbox"] else None
    filtered = MarkerFilter(box=box, status=values["status"], family=values["family"])
    with TemporaryDirectory(prefix="waymark-export-") as folder, operator(cases.database, values["agency"]) as caller:
        with cases.database.read() as connection:
            total = count_records(connection, caller.agency_id, filtered)
        path, left_out = cases.exports().write_file(
            caller, values["kind"], filtered, Path(folder), lambda done: report("export", min(done, total), total)
        )
        with path.open("rb") as content, os.fdopen(os.dup(files[0]), "wb") as file:
            shutil.copyfileobj(content, file, _CHUNK_BYTES)
            file.flush()
            os.fsync(file.fileno())
    return {"left_out": list(left_out)}


OPERATIONS: Mapping[str, Operation] = {"key": create_key, "import": import_survey, "export": export_markers}


@contextmanager
def operator(database: Database, agency: str) -> Iterator[Caller]:
    """An administrator of an agency: whoever may run commands on the server's machine."""
    with across_agencies(), database.read() as connection:
        agency_id = find_agency(connection, agency)
    if agency_id is None:
        raise InvalidParameter(f"there is no agency {agency[:80]!r}", cure="create it with waymark key")
    with acting_for(agency_id):
        yield Caller(agency_id, "command-line", "command line", Scope.ADMIN)
